//! Headers of requests and answers as text.

use axum::http::{HeaderMap, header};

/// Whether these are headers of gRPC: `application/grpc`, with a format behind a plus or without.
/// gRPC-Web is not served.
pub(super) fn is_grpc(headers: &HeaderMap) -> bool {
    let kind = text_of(headers, header::CONTENT_TYPE.as_str()).unwrap_or_default();
    let kind = kind.split([';', '+']).next().unwrap_or_default().trim();
    kind.eq_ignore_ascii_case("application/grpc")
}

/// The value of a header, where it is text.
pub(super) fn text_of<'a>(headers: &'a HeaderMap, name: &str) -> Option<&'a str> {
    headers.get(name)?.to_str().ok()
}
