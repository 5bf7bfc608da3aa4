//! Texts are packed with gzip for callers who take it: the page, the documents, lists of scenes.
//! Pictures and files of Gaussians are packed by themselves.

use std::io::Write;

use axum::{
    body::{Body, Bytes, to_bytes},
    extract::Request,
    http::{HeaderMap, HeaderValue, header},
    middleware::Next,
    response::{IntoResponse, Response},
};
use flate2::{Compression, write::GzEncoder};
use http_body::Body as _;

use super::{error::ApiError, headers::text_of};
use crate::error::Error;

/// Fewer bytes go in one packet anyway; more would take a processor too long.
const PACKED_BYTES: std::ops::RangeInclusive<u64> = 1 << 10..=1 << 20;
const TEXTS: [&str; 3] = ["application/json", "text/html", "text/plain"];

/// Around each HTTP route.
pub(super) async fn pack(request: Request, next: Next) -> Response {
    let takes_gzip = takes_gzip(request.headers());
    let mut response = next.run(request).await;
    if !is_text(&response) {
        return response;
    }
    let vary = HeaderValue::from_static("accept-encoding");
    response.headers_mut().append(header::VARY, vary);
    if !takes_gzip {
        return response;
    }
    let (mut parts, body) = response.into_parts();
    match packed(body).await {
        Ok(bytes) => {
            parts.headers.remove(header::CONTENT_LENGTH);
            parts.headers.insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
            Response::from_parts(parts, Body::from(bytes))
        }
        Err(error) => ApiError::from(error).into_response(),
    }
}

fn is_text(response: &Response) -> bool {
    let kind = text_of(response.headers(), header::CONTENT_TYPE.as_str()).unwrap_or_default();
    TEXTS.iter().any(|text| kind.starts_with(text))
        && response.body().size_hint().exact().is_some_and(|size| PACKED_BYTES.contains(&size))
}

/// Whether `Accept-Encoding` names gzip with a weight over 0.
fn takes_gzip(headers: &HeaderMap) -> bool {
    let accepted = headers.get_all(header::ACCEPT_ENCODING).iter();
    let codings = accepted.filter_map(|value| value.to_str().ok()).flat_map(|v| v.split(','));
    codings.into_iter().any(|coding| {
        let mut pieces = coding.split(';').map(str::trim);
        let named = pieces.next().is_some_and(|name| name.eq_ignore_ascii_case("gzip"));
        let weight = pieces.find_map(|piece| piece.strip_prefix("q="));
        named && weight.is_none_or(|weight| weight.parse::<f32>().is_ok_and(|q| q > 0.0))
    })
}

async fn packed(body: Body) -> Result<Vec<u8>, Error> {
    let lost = |e| Error::internal("the answer is not whole").caused_by(e);
    let whole: Bytes = to_bytes(body, usize::MAX).await.map_err(lost)?;
    let pack = move || {
        let mut gzip = GzEncoder::new(Vec::new(), Compression::default());
        gzip.write_all(&whole).and_then(|()| gzip.finish())
    };
    tokio::task::spawn_blocking(pack)
        .await
        .map_err(std::io::Error::other)
        .flatten()
        .map_err(|e| Error::internal("the answer cannot be packed").caused_by(e))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gzip_is_for_those_who_name_it() {
        let takes = |value: &'static str| {
            let mut headers = HeaderMap::new();
            headers.insert(header::ACCEPT_ENCODING, HeaderValue::from_static(value));
            takes_gzip(&headers)
        };
        assert!(takes("gzip") && takes("br;q=1, GZIP; q=0.5"));
        assert!(!takes("identity") && !takes("gzip;q=0") && !takes("br") && !takes("*"));
        assert!(!takes_gzip(&HeaderMap::new()));
    }
}
