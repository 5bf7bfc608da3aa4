//! Liveness, readiness, metrics and models.

use axum::{
    Json,
    extract::State,
    http::{StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::Serialize;
use utoipa::ToSchema;

use super::{error::ApiError, extract::CallerApi, fields::Fields};
use crate::{
    api::Api,
    service::{ModelsInfo, Readiness},
    telemetry::meter::{self, Readings},
};

/// Whether the process answers.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct Liveness {
    /// True.
    live: bool,
}

/// Whether the process answers
#[utoipa::path(
    get, path = "/healthz", operation_id = "live", tag = "server",
    responses((status = 200, description = "It answers", body = Liveness))
)]
pub(super) async fn live() -> Json<Liveness> {
    Json(Liveness { live: true })
}

/// Whether new work is taken: 200, else 503 with the same body
#[utoipa::path(
    get, path = "/readyz", operation_id = "ready", tag = "server",
    responses(
        (status = 200, description = "New work is taken", body = Readiness),
        (status = 503, description = "Not now", body = Readiness),
    )
)]
pub(super) async fn ready(State(api): State<Api>) -> Response {
    let mut readiness = api.service.ready();
    readiness.ready &= !api.drain.is_stopping();
    (status(readiness.ready), Json(readiness)).into_response()
}

/// The status that says whether something is ready.
pub(super) fn status(ready: bool) -> StatusCode {
    if ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE }
}

/// Metrics of the process
#[utoipa::path(
    get, path = "/metrics", operation_id = "metrics", tag = "server",
    responses((
        status = 200, content_type = "text/plain", body = String,
        description = "Metrics in the text format of Prometheus; needs an admin's key"
    ))
)]
pub(super) async fn metrics(State(api): State<Api>) -> Result<Response, ApiError> {
    let readiness = api.service.ready();
    let text = meter::text(Readings {
        ready: readiness.ready && !api.drain.is_stopping(),
        jobs_queued: readiness.jobs_queued,
        jobs_running: readiness.jobs_running,
        renders: readiness.renders,
        cache_bytes: api.service.cached_bytes(),
        photos_bytes: api.service.photos_bytes(),
        uploads_held_bytes: api.uploads.held_bytes(),
    })?;
    Ok(([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response())
}

/// The model bundle and the renderer
#[utoipa::path(
    get, path = "/v1/models", operation_id = "models", tag = "server",
    responses((status = 200, description = "Bundle and renderer", body = ModelsInfo))
)]
pub(super) async fn models(
    CallerApi(api): CallerApi,
    fields: Fields,
) -> Result<Json<ModelsInfo>, ApiError> {
    fields.finish()?;
    Ok(Json(api.service.models()))
}
