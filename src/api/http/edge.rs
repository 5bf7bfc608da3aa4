//! What every call passes on its way in and out: request id, deadline, error body, log line.

use std::{
    any::Any,
    convert::Infallible,
    sync::Arc,
    time::{Duration, Instant},
};

use axum::{
    body::Body,
    extract::{FromRequestParts, Request, State},
    http::{HeaderMap, HeaderValue, Method, StatusCode, header, request::Parts, uri::Authority},
    middleware::Next,
    response::{IntoResponse, Response},
};
use tracing::{Instrument, Span, field::Empty};

use super::{
    connection::{Pace, TooSlow},
    error::{ApiError, Fault, panic_error},
    held::hold,
};
use crate::{
    api::{
        Api,
        access::{self, Access, Pass},
        grpc,
        life::Inside,
        request_id,
    },
    error::{Error, ErrorCode},
    keys::Scope,
    telemetry::{self, meter},
};

/// The caller's own deadline, for handlers that hand it on.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Deadline(pub(super) Option<Duration>);

impl<S: Sync> FromRequestParts<S> for Deadline {
    type Rejection = Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Infallible> {
        Ok(parts.extensions.get().copied().unwrap_or_default())
    }
}

/// Name of the call that gave an answer, for metrics.
#[derive(Clone, Copy, Debug)]
struct Call(&'static str);

/// Around every HTTP call.
pub(super) async fn rest(
    State((access, pace)): State<(Arc<Access>, Pace)>,
    request: Request,
    next: Next,
) -> Response {
    let id = id_of(request.headers());
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let span = tracing::info_span!("http", %method, path, request_id = id, key = Empty);
    follow(&span, request.headers());
    rest_within(&access, pace, request, next, id, method, path).instrument(span).await
}

async fn rest_within(
    access: &Access,
    pace: Pace,
    request: Request,
    next: Next,
    id: String,
    method: Method,
    path: String,
) -> Response {
    let (mut request, too_slow) = watch_body(request, pace);
    if let Ok(value) = HeaderValue::from_str(&id) {
        request.headers_mut().insert(request_id::HEADER, value);
    }
    let started = Instant::now();
    let allowed = access.check_hosts(hosts_of(&request));
    let deadline = allowed.and_then(|()| deadline_of_query(request.uri().query()));
    let mut response = match deadline {
        Err(error) => ApiError::from(error).into_response(),
        Ok(None) => next.run(request).await,
        Ok(Some(deadline)) => {
            request.extensions_mut().insert(Deadline(Some(deadline)));
            match tokio::time::timeout(deadline, next.run(request)).await {
                Ok(response) => response,
                Err(_) => ApiError::from(deadline_passed(deadline)).into_response(),
            }
        }
    };
    if too_slow.get() && !response.status().is_success() {
        response = ApiError::from(pace.error()).into_response();
    }
    if response.extensions().get::<Fault>().is_none() && is_bare_refusal(&response) {
        // A refusal of the framework's own, before any handler of ours.
        response = dress(&response);
    }
    let status = response.status().as_u16();
    let took = started.elapsed();
    let ms = took.as_secs_f64() * 1e3;
    let call = response.extensions().get::<Call>().map_or(access::OTHER, |Call(name)| name);
    let fault = response.extensions_mut().remove::<Fault>();
    let code = fault.as_ref().map_or("ok", |fault| fault.error().code().name());
    meter::answered("http", call, code, took);
    if let Some(fault) = fault {
        log_fault(fault.error(), &format!("{method} {path}"), ms);
        response = fault.write(response, &id);
    } else {
        tracing::debug!(status, ms, "served");
    }
    stamp(&mut response, &id);
    time(&mut response, ms);
    response
}

/// Makes the call a part of the caller's own trace.
fn follow(span: &Span, headers: &HeaderMap) {
    if let Some(parent) = headers.get("traceparent").and_then(|value| value.to_str().ok()) {
        telemetry::follow(span, parent);
    }
}

/// Adds the whole time to those of the stages.
fn time(response: &mut Response, ms: f64) {
    if let Ok(value) = HeaderValue::from_str(&format!("total;dur={ms:.2}")) {
        response.headers_mut().append("server-timing", value);
    }
}

/// Around each route: lets the caller in, or not, and says which call it is.
pub(super) async fn guard(
    State((api, call, scope)): State<(Api, &'static str, Option<Scope>)>,
    mut request: Request,
    next: Next,
) -> Response {
    let held = scope.map(|scope| {
        check_origin(&api, &request)?;
        let_in(&api, scope, &mut request)
    });
    let mut response = match held {
        None => next.run(request).await,
        Some(Ok(held)) => hold(next.run(request).await, held),
        Some(Err(error)) => ApiError::from(error).into_response(),
    };
    response.extensions_mut().insert(Call(call));
    response
}

/// The request with its body watched.
fn watch_body(request: Request, pace: Pace) -> (Request, TooSlow) {
    let (parts, body) = request.into_parts();
    let (body, too_slow) = pace.watch(body);
    (Request::from_parts(parts, body), too_slow)
}

/// Every host that a call names: the host of its target (`:authority` in HTTP/2) and those of its
/// `host` headers.
fn hosts_of(request: &Request) -> impl Iterator<Item = &str> {
    let named = request.headers().get_all(header::HOST).iter();
    let named = named.map(|host| host.to_str().unwrap_or("not text"));
    request.uri().authority().map(Authority::as_str).into_iter().chain(named)
}

/// Refuses pages of other origins where no key is asked for: a browser on this machine would let
/// any page of the web in. The host that the origin is held against is an allowed one.
fn check_origin(api: &Api, request: &Request) -> Result<(), Error> {
    let Some(origin) = request.headers().get(header::ORIGIN) else { return Ok(()) };
    if api.access.asks() {
        return Ok(());
    }
    let origin = origin.to_str().unwrap_or_default();
    let host = request.headers().get(header::HOST).and_then(|host| host.to_str().ok());
    let host = host.or_else(|| request.uri().authority().map(|host| host.as_str()));
    let own = origin.split_once("://").map(|(_, host)| host);
    let named = &api.service.config().cors_origins;
    if (own.is_some() && own == host) || named.iter().any(|name| name == "*" || name == origin) {
        return Ok(());
    }
    let shown: String = origin.chars().take(80).collect();
    Err(Error::new(
        ErrorCode::PermissionDenied,
        format!("a page of {shown:?} calls; name it in cors_origins to let it"),
    ))
}

/// Asks for the key and counts the call in; what it gives is held until the answer is sent.
fn let_in(api: &Api, scope: Scope, request: &mut Request) -> Result<(Inside, Pass), Error> {
    let inside = api.life.enter()?;
    let shown = request.headers_mut().remove(header::AUTHORIZATION);
    let shown = shown.as_ref().map(|value| value.to_str().unwrap_or_default());
    let pass = api.access.admit(shown, scope)?;
    if let Some(key) = &pass.key {
        Span::current().record("key", &**key);
    }
    request.extensions_mut().insert(pass.caller.clone());
    Ok((inside, pass))
}

/// Around every gRPC call.
pub(super) async fn rpc(
    State((api, pace)): State<(Api, Pace)>,
    request: Request,
    next: Next,
) -> Response {
    let id = id_of(request.headers());
    let path = request.uri().path().to_owned();
    let span = tracing::info_span!("grpc", path, request_id = id, key = Empty);
    follow(&span, request.headers());
    rpc_within(api, pace, request, next, id, path).instrument(span).await
}

async fn rpc_within(
    api: Api,
    pace: Pace,
    request: Request,
    next: Next,
    id: String,
    path: String,
) -> Response {
    let (mut request, too_slow) = watch_body(request, pace);
    if let Ok(value) = HeaderValue::from_str(&id) {
        request.headers_mut().insert(request_id::HEADER, value);
    }
    let started = Instant::now();
    let (call, scope) = access::of_rpc(&path);
    let allowed = api.access.check_hosts(hosts_of(&request));
    let held =
        allowed.and_then(|()| scope.map(|scope| let_in(&api, scope, &mut request)).transpose());
    let mut response = match (held, deadline_of_grpc(request.headers())) {
        (Err(error), _) => {
            log_fault(&error, &path, 0.0);
            grpc::refusal(&error).map(Body::new)
        }
        (Ok(held), None) => hold(next.run(request).await, held),
        (Ok(held), Some(deadline)) => {
            match tokio::time::timeout(deadline, next.run(request)).await {
                Ok(response) => hold(response, held),
                Err(_) => grpc::refusal(&deadline_passed(deadline)).map(Body::new),
            }
        }
    };
    if too_slow.get() {
        response = grpc::refusal(&pace.error()).map(Body::new);
    }
    let took = started.elapsed();
    let ms = took.as_secs_f64() * 1e3;
    grpc::complete(response.headers_mut());
    let text = |name| response.headers().get(name).and_then(|value| value.to_str().ok());
    meter::answered("grpc", call, text("segsplat-code").unwrap_or("ok"), took);
    tracing::debug!(status = text("grpc-status"), ms, "served");
    stamp(&mut response, &id);
    time(&mut response, ms);
    response
}

/// Answer of a gRPC call that panicked.
pub(super) fn rpc_panicked(panic: Box<dyn Any + Send + 'static>) -> Response {
    let error = panic_error(panic);
    log_fault(&error, "gRPC", 0.0);
    grpc::refusal(&error).map(Body::new)
}

/// Answer of a gRPC service or method that is not there.
pub(super) fn rpc_unimplemented(path: &str) -> Response {
    grpc::unimplemented(path).map(Body::new)
}

/// Whether the caller speaks gRPC.
pub(super) fn is_grpc(headers: &HeaderMap) -> bool {
    headers
        .get(header::CONTENT_TYPE)
        .and_then(|value| value.to_str().ok())
        .is_some_and(|value| value.starts_with("application/grpc"))
}

fn id_of(headers: &HeaderMap) -> String {
    request_id::accept(headers.get(request_id::HEADER).and_then(|value| value.to_str().ok()))
}

fn stamp(response: &mut Response, id: &str) {
    if let Ok(value) = HeaderValue::from_str(id) {
        response.headers_mut().insert(request_id::HEADER, value);
    }
    response
        .headers_mut()
        .insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
}

/// An error status without a body of ours: ours is JSON, the framework's is text.
fn is_bare_refusal(response: &Response) -> bool {
    let ours = response
        .headers()
        .get(header::CONTENT_TYPE)
        .is_some_and(|value| value.as_bytes().starts_with(b"application/json"));
    let status = response.status();
    (status.is_client_error() || status.is_server_error()) && !ours && !is_grpc(response.headers())
}

/// Puts a refusal of the framework's own into our shape, keeping its headers.
fn dress(response: &Response) -> Response {
    let error = match response.status() {
        StatusCode::NOT_FOUND | StatusCode::METHOD_NOT_ALLOWED => {
            Error::new(ErrorCode::NotFound, "no such route or method")
        }
        StatusCode::PAYLOAD_TOO_LARGE => {
            Error::new(ErrorCode::LimitExceeded, "the body is over the limit")
        }
        status if status.is_client_error() => {
            Error::invalid(format!("the request cannot be read ({status})"))
        }
        status => Error::internal(format!("the server answered {status}")),
    };
    let mut dressed = ApiError::from(error).into_response();
    *dressed.status_mut() = response.status();
    dressed.headers_mut().extend(response.headers().clone());
    dressed
}

/// Faults of the caller at `info`, ours at `error` with the chain of sources.
fn log_fault(error: &Error, call: &str, ms: f64) {
    let code = error.code().name();
    let mut message = error.message().to_owned();
    let mut source = std::error::Error::source(error);
    while let Some(cause) = source {
        message.push_str(": ");
        message.push_str(&cause.to_string());
        source = cause.source();
    }
    if error.code().row().http >= 500 {
        tracing::error!(call, code, ms, "{message}");
    } else {
        tracing::info!(call, code, ms, "{message}");
    }
}

fn deadline_passed(deadline: Duration) -> Error {
    Error::new(
        ErrorCode::DeadlineExceeded,
        format!("the call's deadline of {} ms passed", deadline.as_millis()),
    )
}

/// `deadline_ms=` of a query string.
fn deadline_of_query(query: Option<&str>) -> Result<Option<Duration>, Error> {
    let value =
        query.unwrap_or_default().split('&').find_map(|pair| pair.strip_prefix("deadline_ms="));
    let Some(value) = value else { return Ok(None) };
    match value.parse::<u64>() {
        Ok(ms) if ms > 0 => Ok(Some(Duration::from_millis(ms))),
        _ => {
            let shown: String = value.chars().take(40).collect();
            Err(Error::invalid(format!(
                "deadline_ms is {shown:?}; it must be a whole number over 0"
            )))
        }
    }
}

/// `grpc-timeout`: up to eight digits and a unit of H, M, S, m, u or n; others are ignored.
fn deadline_of_grpc(headers: &HeaderMap) -> Option<Duration> {
    let text = headers.get("grpc-timeout")?.to_str().ok()?;
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    let value: u64 = digits.parse().ok().filter(|_| digits.len() <= 8)?;
    match unit {
        "H" => Some(Duration::from_secs(value * 3_600)),
        "M" => Some(Duration::from_secs(value * 60)),
        "S" => Some(Duration::from_secs(value)),
        "m" => Some(Duration::from_millis(value)),
        "u" => Some(Duration::from_micros(value)),
        "n" => Some(Duration::from_nanos(value)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn grpc_timeouts_are_read_in_every_unit_and_nonsense_is_ignored() {
        let read = |text: &str| {
            let mut headers = HeaderMap::new();
            headers.insert("grpc-timeout", HeaderValue::from_str(text).unwrap());
            deadline_of_grpc(&headers)
        };
        assert_eq!(read("2H"), Some(Duration::from_secs(7_200)));
        assert_eq!(read("3S"), Some(Duration::from_secs(3)));
        assert_eq!(read("250m"), Some(Duration::from_millis(250)));
        assert_eq!(read("5u"), Some(Duration::from_micros(5)));
        for odd in ["", "S", "5", "5x", "-5S", "123456789S"] {
            assert_eq!(read(odd), None, "{odd}");
        }
    }
}
