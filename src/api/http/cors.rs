//! Which pages of other origins may call from a browser: none, unless the configuration names them.

use std::time::Duration;

use axum::http::{HeaderName, HeaderValue, Method, header};
use tower_http::cors::{Any, CorsLayer};

use crate::error::{Error, Result};

/// How long a browser may keep an answer to its preflight question.
const MAX_AGE: Duration = Duration::from_secs(600);

/// The rules for these origins, `*` for all; `None` where none is named.
///
/// Keys travel in a header that pages set themselves, never in a cookie, so credentials stay off.
pub(super) fn layer(origins: &[String]) -> Result<Option<CorsLayer>> {
    if origins.is_empty() {
        return Ok(None);
    }
    let own = |names: &[&'static str]| -> Vec<HeaderName> {
        names.iter().copied().map(HeaderName::from_static).collect()
    };
    let mut allowed = own(&["idempotency-key", "x-request-id", "traceparent"]);
    allowed.extend([header::AUTHORIZATION, header::CONTENT_TYPE, header::IF_NONE_MATCH]);
    let mut exposed = own(&[
        "x-request-id",
        "x-depth-scale",
        "x-camera-to-world",
        "x-intrinsics",
        "server-timing",
        "idempotency-replayed",
    ]);
    exposed.extend([header::ETAG, header::LOCATION, header::RETRY_AFTER]);
    let rules = CorsLayer::new()
        .allow_methods([Method::GET, Method::POST, Method::DELETE])
        .allow_headers(allowed)
        .expose_headers(exposed)
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
            "cors_origins: {origin:?} is no origin; give https://host or https://host:port"
        ))
    })
}
