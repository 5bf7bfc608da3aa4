//! How large a scene is, and lengths in it.

use std::time::Duration;

use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{
    error::ApiError,
    extract::{CallerApi, Id, JsonBody},
    fields::Fields,
};
use crate::service::{Measured, ScaleSpec, ScaleThing, SceneScale};

/// How large a scene is: `metres` with either `points` or `thing`, or `metres_per_unit`. Nothing:
/// as the capture says it.
#[derive(Debug, Default, Serialize, Deserialize, ToSchema)]
#[serde(default)]
pub(super) struct ScaleBody {
    /// A length, metres.
    metres: Option<f64>,
    /// It is that between these two points of the world.
    points: Option<[[f64; 3]; 2]>,
    /// It is that of a side of this thing.
    thing: Option<ScaleThing>,
    /// Metres of a unit of the world.
    metres_per_unit: Option<f64>,
    /// Milliseconds to wait for semantics that are being made.
    wait_ms: Option<u64>,
}

/// Points of a scene.
#[derive(Debug, Default, Serialize, Deserialize, ToSchema)]
pub(super) struct MeasureBody {
    /// Points of the world, in the order in which they are joined: one at least, and at most
    /// `parts_max` of the configuration (64 by default).
    points: Vec<[f64; 3]>,
}

/// How large a scene is: metres, up and the ground
#[utoipa::path(
    get, path = "/v1/scenes/{id}/scale", operation_id = "get_scale", tag = "scenes", params(Id),
    responses((status = 200, description = "What is known", body = SceneScale))
)]
pub(super) async fn get(
    CallerApi(api): CallerApi,
    Id(id): Id,
    fields: Fields,
) -> Result<Json<SceneScale>, ApiError> {
    fields.finish()?;
    Ok(Json(api.service.scale(&id).await?))
}

/// Say how large a scene is
///
/// By two points and the length between them, by a side of the box of a thing that a text finds,
/// or by metres a unit. It is kept with the scene. Nothing is drawn or written in another size:
/// lengths are said in metres.
#[utoipa::path(
    put, path = "/v1/scenes/{id}/scale", operation_id = "set_scale", tag = "scenes", params(Id),
    request_body = ScaleBody,
    responses((status = 200, description = "What is known now", body = SceneScale))
)]
pub(super) async fn set(
    CallerApi(api): CallerApi,
    Id(id): Id,
    JsonBody(mut body): JsonBody,
) -> Result<Json<SceneScale>, ApiError> {
    let ScaleBody { metres, points, thing, metres_per_unit, wait_ms } = body.take()?;
    body.finish()?;
    let spec = ScaleSpec { metres, points, thing, metres_per_unit };
    Ok(Json(api.service.set_scale(&id, spec, wait_ms.map(Duration::from_millis)).await?))
}

/// Lengths, area and heights over the ground of points of a scene
#[utoipa::path(
    post, path = "/v1/scenes/{id}/measure", operation_id = "measure", tag = "scenes", params(Id),
    request_body = MeasureBody,
    responses((status = 200, description = "The lengths", body = Measured))
)]
pub(super) async fn measure(
    CallerApi(api): CallerApi,
    Id(id): Id,
    JsonBody(mut body): JsonBody,
) -> Result<Json<Measured>, ApiError> {
    let MeasureBody { points } = body.take()?;
    body.finish()?;
    Ok(Json(api.service.measure(&id, points).await?))
}
