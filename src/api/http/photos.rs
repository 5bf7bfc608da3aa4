//! Photos that join a scene, or leave it.

use std::time::Duration;

use axum::{
    Json,
    extract::{FromRequestParts, RawPathParams, Request},
    http::{StatusCode, request::Parts},
    response::{IntoResponse, Response},
};
use serde::Deserialize;
use utoipa::IntoParams;

use super::{
    error::ApiError,
    extract::{CallerApi, Id},
    fields::Fields,
    multipart::{ArchiveBody, UploadForm, read_on, read_upload},
    scenes::{idempotency_key, preferred_wait, tell_applied, wait_or},
};
use crate::{
    api::Api,
    error::{Error, Result},
    service::{AddPhotos, SceneStatus},
};

/// How long a change of photos is waited for.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(default)]
#[into_params(parameter_in = Query)]
pub(super) struct PhotosParams {
    /// Milliseconds to wait for the version with the change before answering.
    wait_ms: Option<u64>,
}

/// The `{name}` of the path.
#[derive(Clone, Debug, IntoParams)]
#[into_params(names("name"), parameter_in = Path)]
pub(super) struct PhotoName(
    /// File name of a photo, as the scene's `cameras` have it; a slash in it as `%2F`.
    String,
);

impl FromRequestParts<Api> for PhotoName {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, api: &Api) -> Result<Self, ApiError> {
        let params = RawPathParams::from_request_parts(parts, api)
            .await
            .map_err(|e| Error::invalid(format!("path: {e}")))?;
        let name = params.iter().find(|(name, _)| *name == "name");
        Ok(Self(name.map_or("", |(_, value)| value).to_owned()))
    }
}

/// Add photos to a scene
///
/// Posed photos, as a create call takes them, in the frame of the scene's own cameras. Only they go
/// through the networks. The version with them takes the place of the one before, which is served
/// meanwhile; the scene's edits stay.
#[utoipa::path(
    post, path = "/v1/scenes/{id}/photos", operation_id = "add_photos", tag = "scenes",
    params(
        Id, PhotosParams,
        (
            "Idempotency-Key" = Option<String>, Header,
            description = "Calls with one key add the photos once; 422 with other photos",
        ),
        ("Prefer" = Option<String>, Header, description = "`wait=SECONDS` (RFC 7240)"),
    ),
    request_body(content(
        (UploadForm = "multipart/form-data"),
        (ArchiveBody = "application/zip"),
        (ArchiveBody = "application/x-tar"),
    )),
    responses(
        (status = 200, description = "The scene with them", body = SceneStatus),
        (status = 202, description = "Taken; see `growth`", body = SceneStatus),
    )
)]
pub(super) async fn add(
    CallerApi(api): CallerApi,
    Id(id): Id,
    mut fields: Fields,
    request: Request,
) -> Result<Response, ApiError> {
    let idempotency_key = idempotency_key(request.headers())?;
    let preferred = preferred_wait(request.headers());
    if let Err(error) = api.service.get(&id).await {
        read_on(request.into_body().into_data_stream());
        return Err(error.into());
    }
    let (upload, _guard) = read_upload(&api, request, &mut fields, 1, Some(id.clone())).await?;
    let PhotosParams { wait_ms } = fields.take()?;
    fields.finish()?;
    let (wait, preferred) = wait_or(wait_ms.map(Duration::from_millis), preferred);
    let request = AddPhotos { upload, idempotency_key, wait };
    let added = api.service.add_photos(&id, request).await?;
    let mut answer = changed(added.status).into_response();
    tell_applied(answer.headers_mut(), preferred, added.replayed);
    Ok(answer)
}

/// Take a photo out of a scene
///
/// The version without it takes the place of the one before. The file itself stays in the store
/// as long as a photo that came with it is in the scene; of the create call until the scene is
/// deleted.
#[utoipa::path(
    delete, path = "/v1/scenes/{id}/photos/{name}", operation_id = "remove_photo", tag = "scenes",
    params(Id, PhotoName, PhotosParams),
    responses(
        (status = 200, description = "The scene without it", body = SceneStatus),
        (status = 202, description = "Taken; see `growth`", body = SceneStatus),
    )
)]
pub(super) async fn remove(
    CallerApi(api): CallerApi,
    Id(id): Id,
    PhotoName(name): PhotoName,
    mut fields: Fields,
) -> Result<(StatusCode, Json<SceneStatus>), ApiError> {
    let PhotosParams { wait_ms } = fields.take()?;
    fields.finish()?;
    let wait = wait_ms.map(Duration::from_millis);
    Ok(changed(api.service.remove_photo(&id, name, wait).await?))
}

fn changed(status: SceneStatus) -> (StatusCode, Json<SceneStatus>) {
    let code = if status.is_growing() { StatusCode::ACCEPTED } else { StatusCode::OK };
    (code, Json(status))
}
