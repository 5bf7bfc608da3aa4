//! The page at `/`: one file, no scripts from elsewhere; and photos for a first try.

use axum::{
    extract::State,
    http::header,
    response::{Html, IntoResponse, Response},
};

use super::{error::ApiError, extract::CallerApi, fields::Fields};
use crate::{api::Api, service::VIEWER};

/// The viewer page
///
/// The origins whose pages may call may also show it in a frame.
#[utoipa::path(
    get, path = "/", operation_id = "viewer", tag = "server",
    responses((
        status = 200, content_type = "text/html", body = String, description = "Viewer page"
    ))
)]
pub(super) async fn index(State(api): State<Api>) -> Response {
    let origins = &api.service.config().cors_origins;
    let framed = if origins.is_empty() { "'none'".to_owned() } else { origins.join(" ") };
    let policy = format!("{}; frame-ancestors {framed}", VIEWER.policy);
    ([(header::CONTENT_SECURITY_POLICY, policy)], Html(VIEWER.html.as_str())).into_response()
}

/// Generated photos of a room with their cameras, for a first try
#[utoipa::path(
    get, path = "/sample.zip", operation_id = "sample", tag = "server",
    responses((
        status = 200, content_type = "application/zip", body = Vec<u8>,
        description = "A capture that `POST /v1/scenes` takes as it is"
    ))
)]
pub(super) async fn sample(
    CallerApi(api): CallerApi,
    fields: Fields,
) -> Result<Response, ApiError> {
    fields.finish()?;
    let zip = api.service.sample().await?;
    Ok(([(header::CONTENT_TYPE, "application/zip")], zip).into_response())
}
