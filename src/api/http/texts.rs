//! Texts to a scene: search in 3D and in a view, and names for what is under a pixel.

use std::time::Duration;

use axum::{Extension, Json};
use serde::Deserialize;
use utoipa::IntoParams;

use super::{
    error::ApiError,
    extract::{CallerApi, Id, JsonBody},
    fields::Fields,
    middleware::Deadline,
    render::{camera, scoring},
};
use crate::{
    api::server_timing,
    service::{
        CameraFields, PickSpec, Picked, QueryAnswer, QuerySpec, ScoringOptions, ViewOptions,
    },
};

/// Search a scene by texts, in 3D and in a view
#[utoipa::path(
    post, path = "/v1/scenes/{id}/query", operation_id = "query", tag = "texts",
    params(Id), request_body = QuerySpec,
    responses((status = 200, description = "What each text found", body = QueryAnswer))
)]
pub(super) async fn query(
    CallerApi(api): CallerApi,
    Id(id): Id,
    Extension(Deadline(deadline)): Extension<Deadline>,
    JsonBody(mut body): JsonBody,
) -> Result<([(&'static str, String); 1], Json<QueryAnswer>), ApiError> {
    let f = &mut body;
    let of_view: Option<CameraFields> = f.value("camera")?;
    let spec = QuerySpec {
        texts: f.value("texts")?.unwrap_or_default(),
        camera: of_view.map(|fields| camera(fields, "camera")).transpose()?,
        options: ViewOptions { deadline, ..f.take()? },
        boxes: f.value("boxes")?.unwrap_or_default(),
        mask: f.value("mask")?.unwrap_or_default(),
        relevancy: f.value("relevancy")?.unwrap_or_default(),
        scoring: f.take()?,
        wait: f.value("wait_ms")?.map(Duration::from_millis),
    };
    body.finish()?;
    let answer = api.service.query(&id, spec).await?;
    Ok(([("server-timing", server_timing(answer.times.stages()))], Json(answer)))
}

/// A pixel, and texts that may name what is under it.
#[derive(Debug, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub(super) struct PickParams {
    /// Across, pixels of the picture.
    x: f64,
    /// Down, pixels of the picture.
    y: f64,
    /// A text that may name the entry; may be given many times.
    #[serde(default)]
    label: Vec<String>,
    /// Milliseconds to wait for semantics that are being made.
    wait_ms: Option<u64>,
}

/// What is under a pixel of a view
#[utoipa::path(
    get, path = "/v1/scenes/{id}/pick", operation_id = "pick", tag = "texts",
    params(Id, PickParams, CameraFields, ViewOptions, ScoringOptions),
    responses((status = 200, description = "What is under the pixel", body = Picked))
)]
pub(super) async fn pick(
    CallerApi(api): CallerApi,
    Id(id): Id,
    Extension(Deadline(deadline)): Extension<Deadline>,
    mut fields: Fields,
) -> Result<Json<Picked>, ApiError> {
    let f = &mut fields;
    let camera = camera(f.take()?, "camera")?;
    let labels = f.all("label")?;
    let params = PickParams { label: labels, ..f.take()? };
    let PickParams { x, y, label, wait_ms } = params;
    let spec = PickSpec {
        camera,
        x,
        y,
        options: ViewOptions { deadline, ..f.take()? },
        labels: label,
        scoring: scoring(f)?,
        wait: wait_ms.map(Duration::from_millis),
    };
    fields.finish()?;
    Ok(Json(api.service.pick(&id, spec).await?))
}
