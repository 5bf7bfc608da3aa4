//! The small viewer page at `/`: one file, no scripts from elsewhere.

use axum::{
    http::header,
    response::{Html, IntoResponse, Response},
};

const PAGE: &str = include_str!("../../../web/index.html");

/// The page talks to this server alone.
const POLICY: &str = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; \
                      img-src 'self' blob: data:; connect-src 'self'; form-action 'self'; \
                      base-uri 'none'; frame-ancestors 'none'";

/// The viewer page
#[utoipa::path(
    get, path = "/", operation_id = "viewer", tag = "server",
    responses((
        status = 200, content_type = "text/html", body = String, description = "Viewer page"
    ))
)]
pub(super) async fn index() -> Response {
    ([(header::CONTENT_SECURITY_POLICY, POLICY)], Html(PAGE)).into_response()
}
