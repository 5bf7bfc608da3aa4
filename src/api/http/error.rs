//! Errors as HTTP answers: status of the one table, body `{code, message, request_id, details}`, or
//! problem details (RFC 9457) where a caller asks for them.

use std::{any::Any, sync::Arc};

use axum::{
    Json,
    body::Body,
    extract::Request,
    http::{HeaderValue, Method, StatusCode, Uri, header},
    response::{IntoResponse, Response},
};
use serde::Serialize;
use utoipa::ToSchema;

use super::headers::is_grpc;
use crate::{
    api::grpc::{self, retry_after_s},
    error::{Error, ErrorCode, short},
    scene::SceneId,
};

/// The body of every error.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ErrorBody {
    /// Stable `snake_case` code.
    code: &'static str,
    /// Names input, value and bound.
    message: String,
    /// Finds the call in the log; also in the header `x-request-id`.
    request_id: String,
    /// More about it.
    details: ErrorDetails,
    /// The message again, under the name that the Open Inference Protocol gives it (`/v2`).
    #[serde(skip_serializing_if = "Option::is_none")]
    error: Option<String>,
}

/// More about an error.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ErrorDetails {
    /// Whether the same call may succeed later.
    retry: bool,
    /// When, seconds from now.
    #[serde(skip_serializing_if = "Option::is_none")]
    retry_after_s: Option<u32>,
    /// The scene it is about.
    #[serde(skip_serializing_if = "Option::is_none")]
    scene: Option<String>,
}

/// The body of an error as problem details (RFC 9457), with the members of ours.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ProblemBody {
    /// A URI that names the code and leads nowhere.
    #[serde(rename = "type")]
    kind: String,
    /// The code in words.
    title: String,
    /// The status of the answer.
    status: u16,
    /// Names input, value and bound.
    detail: String,
    /// The path that was asked.
    instance: String,
    /// Stable `snake_case` code.
    code: &'static str,
    /// Finds the call in the log; also in the header `x-request-id`.
    request_id: String,
    /// More about it.
    details: ErrorDetails,
}

/// Media type of problem details.
pub(super) const PROBLEM: &str = "application/problem+json";

/// Whether a caller names the media type of problem details in `Accept`, with a weight over 0.
pub(super) fn asks_for_problem(accept: Option<&str>) -> bool {
    accept.into_iter().flat_map(|accept| accept.split(',')).any(|range| {
        let mut pieces = range.split(';').map(str::trim);
        let named = pieces.next().is_some_and(|kind| kind.eq_ignore_ascii_case(PROBLEM));
        let weight = pieces.find_map(|piece| piece.strip_prefix("q="));
        named && weight.is_none_or(|weight| weight.parse::<f32>().is_ok_and(|q| q > 0.0))
    })
}

impl ProblemBody {
    fn new(body: ErrorBody, status: StatusCode, path: &str) -> Self {
        let ErrorBody { code, message, request_id, details, .. } = body;
        let words = code.replace('_', " ");
        let title = words[..1].to_uppercase() + &words[1..];
        Self {
            kind: format!("urn:segsplat:error:{code}"),
            title,
            status: status.as_u16(),
            detail: message,
            instance: path.to_owned(),
            code,
            request_id,
            details,
        }
    }
}

/// An error of a handler. It travels beside the answer to the middleware, which logs it and writes
/// the body, which holds the request's id.
#[derive(Clone, Debug)]
pub(super) struct ApiError {
    error: Arc<Error>,
    scene: Option<SceneId>,
}

impl From<Error> for ApiError {
    fn from(error: Error) -> Self {
        Self { error: Arc::new(error), scene: None }
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.error.code().row().http)
            .unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let mut response = status.into_response();
        response.extensions_mut().insert(self);
        response
    }
}

impl ApiError {
    /// The error with the scene it is about, for `details`.
    pub(super) fn of_scene(error: Error, id: &SceneId) -> Self {
        Self { scene: Some(id.clone()), ..Self::from(error) }
    }

    pub(super) fn error(&self) -> &Error {
        &self.error
    }

    /// What a caller is told of it.
    pub(super) fn body(&self, request_id: &str) -> ErrorBody {
        let error = self.error();
        ErrorBody {
            error: None,
            code: error.code().name(),
            message: error.message().to_owned(),
            request_id: request_id.to_owned(),
            details: ErrorDetails {
                retry: error.code().row().retry,
                retry_after_s: retry_after_s(error),
                scene: self.scene.as_ref().map(ToString::to_string),
            },
        }
    }

    /// Writes body and headers into `response`, as problem details where the caller asks for them.
    pub(super) fn write(
        &self,
        response: Response,
        request_id: &str,
        path: &str,
        as_problem: bool,
    ) -> Response {
        let error = self.error();
        let mut body = self.body(request_id);
        if path == "/v2" || path.starts_with("/v2/") {
            body.error = Some(error.message().to_owned());
        }
        let (mut parts, _) = response.into_parts();
        parts.headers.remove(header::CONTENT_LENGTH);
        parts.headers.remove(header::CONTENT_TYPE);
        parts.headers.append(header::VARY, HeaderValue::from_static("accept"));
        let (status, headers) = (parts.status, parts.headers);
        let mut answer = match as_problem {
            false => (status, headers, Json(body)).into_response(),
            true => {
                let body = Json(ProblemBody::new(body, status, path));
                let mut answer = (status, headers, body).into_response();
                let kind = HeaderValue::from_static(PROBLEM);
                answer.headers_mut().insert(header::CONTENT_TYPE, kind);
                answer
            }
        };
        if error.code() == ErrorCode::Unauthenticated {
            let bearer = HeaderValue::from_static("Bearer realm=\"segsplat\"");
            answer.headers_mut().insert(header::WWW_AUTHENTICATE, bearer);
        }
        if let Some(seconds) = retry_after_s(error) {
            answer.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from(seconds));
        }
        answer
    }
}

/// Answer of a path that no route has; gRPC callers get gRPC's own `UNIMPLEMENTED`.
pub(super) async fn no_such_route(request: Request) -> Response {
    if is_grpc(request.headers()) {
        return grpc::unimplemented(request.uri().path()).map(Body::new);
    }
    let message = format!("no such route: {} {}", request.method(), short(request.uri().path()));
    ApiError::from(Error::new(ErrorCode::NotFound, message)).into_response()
}

/// Answer of a path that has other methods; axum adds `Allow`.
pub(super) async fn method_not_allowed(method: Method, uri: Uri) -> Response {
    let message = format!("{} has no method {method}", short(uri.path()));
    ApiError::from(Error::new(ErrorCode::MethodNotAllowed, message)).into_response()
}

/// The error of a panic, with its text as the source.
pub(super) fn panic_error(panic: Box<dyn Any + Send + 'static>) -> Error {
    let text = panic.downcast::<String>().map(|text| *text);
    let text = text.or_else(|panic| panic.downcast::<&'static str>().map(|text| text.to_string()));
    let text = text.unwrap_or_else(|_| "a panic without text".to_owned());
    Error::internal("a fault of the server; the request id finds it in the log").caused_by(text)
}

#[cfg(test)]
mod tests {
    use super::asks_for_problem;

    #[test]
    fn problem_details_are_for_those_who_name_them() {
        for accept in ["application/problem+json", "image/png, Application/Problem+JSON;q=0.5"] {
            assert!(asks_for_problem(Some(accept)), "{accept}");
        }
        let others = ["*/*", "application/json", "application/problem+json;q=0", "q=1", ""];
        for accept in others.map(Some).into_iter().chain([None]) {
            assert!(!asks_for_problem(accept), "{accept:?}");
        }
    }
}
