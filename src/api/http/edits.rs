//! The edits of a scene.

use std::time::Duration;

use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{
    error::ApiError,
    extract::{CallerApi, Id, JsonBody},
    fields::Fields,
};
use crate::service::{EditSpec, SceneEdits};

/// A list of edits.
#[derive(Debug, Default, Serialize, Deserialize, ToSchema)]
pub(super) struct EditsBody {
    /// The edits, in the order in which they are applied; an empty list brings the scene back.
    edits: Vec<EditSpec>,
    /// Milliseconds to wait for semantics that are being made.
    #[serde(default)]
    wait_ms: Option<u64>,
}

/// The edits of a scene, and how many Gaussians each took
#[utoipa::path(
    get, path = "/v1/scenes/{id}/edits", operation_id = "get_edits", tag = "scenes", params(Id),
    responses((status = 200, description = "The edits", body = SceneEdits))
)]
pub(super) async fn get(
    CallerApi(api): CallerApi,
    Id(id): Id,
    fields: Fields,
) -> Result<Json<SceneEdits>, ApiError> {
    fields.finish()?;
    Ok(Json(api.service.edits(&id).await?))
}

/// Replace the edits of a scene
///
/// The list is kept with the scene and applied, in its order, to the scene as it was made: in
/// views, answers to texts, picks and exports. So a shorter list is an undo, and an empty one
/// brings back every bit.
#[utoipa::path(
    put, path = "/v1/scenes/{id}/edits", operation_id = "set_edits", tag = "scenes", params(Id),
    request_body = EditsBody,
    responses((status = 200, description = "The edits that are kept", body = SceneEdits))
)]
pub(super) async fn set(
    CallerApi(api): CallerApi,
    Id(id): Id,
    JsonBody(mut body): JsonBody,
) -> Result<Json<SceneEdits>, ApiError> {
    let EditsBody { edits, wait_ms } = body.take()?;
    body.finish()?;
    Ok(Json(api.service.set_edits(&id, edits, wait_ms.map(Duration::from_millis)).await?))
}
