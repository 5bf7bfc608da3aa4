//! Which pages of other origins may call from a browser: none, unless the configuration names them.

use std::time::Duration;

use axum::http::{HeaderName, HeaderValue, Method, header};
use tower_http::cors::{Any, CorsLayer};

use crate::error::{Error, Result};

/// How long a browser may keep the answer to its preflight request.
const MAX_AGE: Duration = Duration::from_secs(600);

/// Headers that a page may send.
const ALLOWED: [HeaderName; 6] = [
    HeaderName::from_static("idempotency-key"),
    HeaderName::from_static("x-request-id"),
    HeaderName::from_static("traceparent"),
    header::AUTHORIZATION,
    header::CONTENT_TYPE,
    header::IF_NONE_MATCH,
];
/// Headers that a page may read.
const EXPOSED: [HeaderName; 12] = [
    HeaderName::from_static("x-request-id"),
    HeaderName::from_static("x-depth-scale"),
    HeaderName::from_static("x-camera-to-world"),
    HeaderName::from_static("x-intrinsics"),
    HeaderName::from_static("x-shape"),
    HeaderName::from_static("x-error"),
    HeaderName::from_static("x-detail"),
    HeaderName::from_static("server-timing"),
    HeaderName::from_static("idempotency-replayed"),
    header::ETAG,
    header::LOCATION,
    header::RETRY_AFTER,
];

/// The rules for these origins, `*` for all; `None` where none is named.
///
/// Pages send keys in a header, never in a cookie, so credentials stay off.
pub(super) fn layer(origins: &[String]) -> Result<Option<CorsLayer>> {
    if origins.is_empty() {
        return Ok(None);
    }
    let rules = CorsLayer::new()
        .allow_methods([Method::GET, Method::POST, Method::PUT, Method::DELETE])
        .allow_headers(ALLOWED)
        .expose_headers(EXPOSED)
        .max_age(MAX_AGE);
    if origins.iter().any(|origin| origin == "*") {
        return Ok(Some(rules.allow_origin(Any)));
    }
    let origins = origins.iter().map(|origin| named(origin)).collect::<Result<Vec<_>>>()?;
    Ok(Some(rules.allow_origin(origins)))
}

/// `scheme://host` or `scheme://host:port`, as browsers send it.
fn named(origin: &str) -> Result<HeaderValue> {
    let host = origin.strip_prefix("https://").or_else(|| origin.strip_prefix("http://"));
    let plain = host.is_some_and(|host| {
        !host.is_empty() && host.bytes().all(|c| c.is_ascii_alphanumeric() || b".-:[]".contains(&c))
    });
    HeaderValue::from_str(origin).ok().filter(|_| plain).ok_or_else(|| {
        Error::invalid(format!(
            "cors_origins: {origin:?} is not an origin; give https://host or https://host:port"
        ))
    })
}
