//! The page at `/`: one file, no scripts from elsewhere.

use axum::{
    http::header,
    response::{Html, IntoResponse, Response},
};

use crate::service::VIEWER;

/// The viewer page
#[utoipa::path(
    get, path = "/", operation_id = "viewer", tag = "server",
    responses((
        status = 200, content_type = "text/html", body = String, description = "Viewer page"
    ))
)]
pub(super) async fn index() -> Response {
    let policy = [(header::CONTENT_SECURITY_POLICY, VIEWER.policy.as_str())];
    (policy, Html(VIEWER.html.as_str())).into_response()
}
