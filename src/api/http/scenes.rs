//! Scenes: create, list, show, delete, watch.

use std::{convert::Infallible, time::Duration};

use axum::{
    Json,
    extract::Request,
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{
        IntoResponse, Response,
        sse::{self, KeepAlive, Sse},
    },
};
use futures_util::{Stream, StreamExt};

use super::{
    error::ApiError,
    extract::{Called, Id},
    openapi::{self, CreateParams, IdParam, ListParams, Scene, UploadForm},
    params::Params,
    receive::receive,
};
use crate::{
    api::{
        Api, request_id,
        semantics::{check_bundle, mode},
    },
    error::{Error, Result},
    scene::StageTime,
    service::{
        CreateScene, Density, Event, Page, PageRequest, SceneOptions, SceneState, SceneStatus,
    },
};

/// `POST /v1/scenes`
#[utoipa::path(
    post, path = "/v1/scenes", operation_id = "create_scene", tag = "scenes",
    params(CreateParams, ("Idempotency-Key" = Option<String>, Header)),
    request_body(content = UploadForm, content_type = "multipart/form-data"),
    responses(
        (status = 201, description = "Made", body = Scene),
        (status = 202, description = "Taken; see Location", body = Scene),
    )
)]
pub(super) async fn create(
    Called(api): Called,
    mut params: Params,
    request: Request,
) -> Result<Response, ApiError> {
    let idempotency_key = idempotency_key(request.headers())?;
    let request_id = request.headers().get(request_id::HEADER);
    let request_id = request_id.and_then(|id| id.to_str().ok()).map(str::to_owned);
    let (upload, _guard) = receive(&api, request, &mut params).await?;
    let (options, wait) = options(&api, params)?;
    let request = CreateScene { upload, options, idempotency_key, wait, request_id };
    let created = api.service.create_scene(request).await?;
    if let (Some(error), Some(_)) = (&created.status.error, wait) {
        return Err(ApiError::of_scene(error.to_error(), &created.status.id));
    }
    let status = match created.status.state {
        SceneState::Done => StatusCode::CREATED,
        _ => StatusCode::ACCEPTED,
    };
    let times = created.status.report.as_ref().map(|report| server_timing(&report.stages));
    let location = format!("/v1/scenes/{}", created.status.id);
    let body = Json(created.status);
    let mut answer = (status, [(header::LOCATION, location)], body).into_response();
    if let Some(value) = times.and_then(|times| HeaderValue::from_str(&times).ok()) {
        answer.headers_mut().insert("server-timing", value);
    }
    if created.replayed {
        answer.headers_mut().insert("idempotency-replayed", HeaderValue::from_static("true"));
    }
    Ok(answer)
}

/// `stage;dur=ms` of each stage.
fn server_timing(stages: &[StageTime]) -> String {
    let times = stages.iter().map(|time| format!("{};dur={:.2}", time.stage, time.ms));
    times.collect::<Vec<_>>().join(", ")
}

/// `GET /v1/scenes`
#[utoipa::path(
    get, path = "/v1/scenes", operation_id = "list_scenes", tag = "scenes", params(ListParams),
    responses((status = 200, description = "A page, newest first", body = openapi::Page))
)]
pub(super) async fn list(Called(api): Called, mut params: Params) -> Result<Json<Page>, ApiError> {
    let page = PageRequest { limit: params.whole("limit")?, after: params.text("after")? };
    params.finish()?;
    Ok(Json(api.service.list(&page).await?))
}

/// `GET /v1/scenes/{id}`
#[utoipa::path(
    get, path = "/v1/scenes/{id}", operation_id = "get_scene", tag = "scenes", params(IdParam),
    responses((status = 200, description = "The scene", body = Scene))
)]
pub(super) async fn get(
    Called(api): Called,
    Id(id): Id,
    params: Params,
) -> Result<Json<SceneStatus>, ApiError> {
    params.finish()?;
    Ok(Json(api.service.get(&id).await?))
}

/// `DELETE /v1/scenes/{id}`
#[utoipa::path(
    delete, path = "/v1/scenes/{id}", operation_id = "delete_scene", tag = "scenes",
    params(IdParam), responses((status = 204, description = "Gone"))
)]
pub(super) async fn delete(
    Called(api): Called,
    Id(id): Id,
    params: Params,
) -> Result<StatusCode, ApiError> {
    params.finish()?;
    api.service.delete(&id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// `GET /v1/scenes/{id}/events`
#[utoipa::path(
    get, path = "/v1/scenes/{id}/events", operation_id = "watch_scene", tag = "scenes",
    params(IdParam),
    responses((
        status = 200, content_type = "text/event-stream", body = String,
        description = "Events queued, running, done, failed, cancelled, each with JSON data"
    ))
)]
pub(super) async fn events(
    Called(api): Called,
    Id(id): Id,
    params: Params,
) -> Result<Sse<impl Stream<Item = Result<sse::Event, Infallible>>>, ApiError> {
    params.finish()?;
    let events = api.service.watch(&id).await?.map(|event| Ok(sse_event(&event)));
    Ok(Sse::new(events).keep_alive(KeepAlive::new().interval(Duration::from_secs(15))))
}

/// The event's name as SSE's `event`, the whole of it as JSON in `data`.
fn sse_event(event: &Event) -> sse::Event {
    let named = sse::Event::default().event(event.name());
    let data = serde_json::to_string(event).unwrap_or_else(|_| "{}".to_owned());
    named.data(data)
}

fn options(api: &Api, mut params: Params) -> Result<(SceneOptions, Option<Duration>)> {
    let semantics = params.text("semantics")?.map(|text| mode(&text)).transpose()?;
    if let Some(bundle) = params.text("bundle")? {
        check_bundle(&bundle, &api.service.models())?;
    }
    let density = params.text("density")?.map(|text| Density::named(&text)).transpose()?;
    let options = SceneOptions {
        max_views: params.whole("max_views")?,
        density: density.unwrap_or_default(),
        semantics: semantics.unwrap_or_default(),
    };
    let wait = params.whole::<u64>("wait_ms")?.map(Duration::from_millis);
    params.finish()?;
    Ok((options, wait))
}

/// 1 to 255 printable ASCII characters.
fn idempotency_key(headers: &HeaderMap) -> Result<Option<String>> {
    let Some(value) = headers.get("idempotency-key") else { return Ok(None) };
    match value.to_str() {
        Ok(key) if (1..=255).contains(&key.len()) => Ok(Some(key.to_owned())),
        _ => Err(Error::invalid("Idempotency-Key must be 1 to 255 printable ASCII characters")),
    }
}
