//! What every call passes on its way in and out: request id, deadline, key, error body, log line.

use std::{
    sync::{Arc, atomic::Ordering},
    time::{Duration, Instant},
};

use axum::{
    body::Body,
    extract::{Query, Request, State},
    http::{HeaderMap, HeaderValue, StatusCode, header, uri::Authority},
    middleware::Next,
    response::{IntoResponse, Response},
};
use tracing::{Instrument, Span, field::Empty};

use super::{
    body::{Pace, hold},
    error::{ApiError, asks_for_problem},
    headers::{is_grpc, text_of},
};
use crate::{
    api::{Api, Held, access, access::Access, grpc, log_error, request_id},
    error::{Error, ErrorCode, Result, short},
    keys::Scope,
    telemetry::{self, meter},
};

/// Answers of fewer bytes are not counted.
const LARGE_ANSWER_BYTES: u64 = 256 << 10;

/// The caller's own deadline, for handlers that hand it on.
#[derive(Clone, Copy, Debug)]
pub(super) struct Deadline(pub(super) Option<Duration>);

/// How a call came in, which decides how errors go out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Transport {
    Http,
    Grpc,
}

impl Transport {
    /// Name in metrics.
    fn name(self) -> &'static str {
        match self {
            Self::Http => "http",
            Self::Grpc => "grpc",
        }
    }

    /// The answer of an error. [`around`] logs it and writes HTTP's body.
    pub(super) fn refusal(self, error: Error) -> Response {
        let error = ApiError::from(error);
        match self {
            Self::Http => error.into_response(),
            Self::Grpc => {
                let mut response = grpc::refusal(error.error()).map(Body::new);
                response.extensions_mut().insert(error);
                response
            }
        }
    }

    /// How this request is answered: over HTTP where it comes to gRPC but does not speak it.
    fn answers(self, request: &Request) -> Self {
        if is_grpc(request.headers()) { self } else { Self::Http }
    }

    fn deadline(self, request: &Request) -> Result<Option<Duration>> {
        match self {
            Self::Http => deadline_of_query(request),
            Self::Grpc => Ok(deadline_of_grpc(request.headers())),
        }
    }
}

/// What [`around`] works with.
pub(super) type Around = (Transport, Arc<Access>, Pace);

/// Name of the call that gave an answer, for metrics.
#[derive(Clone, Copy, Debug)]
struct Call(&'static str);

/// Around every call.
pub(super) async fn around(
    State(state): State<Around>,
    mut request: Request,
    next: Next,
) -> Response {
    let id = text_of(request.headers(), request_id::HEADER);
    let id = request_id::accept(id);
    let (method, path) = (request.method(), request.uri().path());
    let span = match state.0 {
        Transport::Http => {
            tracing::info_span!("http", %method, path, request_id = id, key = Empty)
        }
        Transport::Grpc => tracing::info_span!("grpc", path, request_id = id, key = Empty),
    };
    // The call becomes a part of the caller's own trace.
    if let Some(parent) = text_of(request.headers(), "traceparent") {
        telemetry::follow(&span, parent);
    }
    set(request.headers_mut(), request_id::HEADER, &id);
    let mut response = within(state, request, next, &id).instrument(span).await;
    set(response.headers_mut(), request_id::HEADER, &id);
    set(response.headers_mut(), header::X_CONTENT_TYPE_OPTIONS.as_str(), "nosniff");
    response
}

async fn within(
    (transport, access, pace): Around,
    request: Request,
    next: Next,
    id: &str,
) -> Response {
    let started = Instant::now();
    let path = request.uri().path().to_owned();
    let as_problem = asks_for_problem(text_of(request.headers(), "accept"));
    let (mut request, too_slow) = pace.watch(request);
    let answers = transport.answers(&request);
    let allowed = access.check_hosts(hosts_of(&request));
    let mut response = match allowed.and_then(|()| transport.deadline(&request)) {
        Err(error) => answers.refusal(error),
        Ok(deadline) => {
            request.extensions_mut().insert(Deadline(deadline));
            match deadline {
                None => next.run(request).await,
                Some(max) => {
                    let answered = tokio::time::timeout(max, next.run(request)).await;
                    answered.unwrap_or_else(|_| answers.refusal(deadline_passed(max)))
                }
            }
        }
    };
    if too_slow.load(Ordering::Acquire)
        && (answers == Transport::Grpc || !response.status().is_success())
    {
        response = answers.refusal(pace.error());
    }
    let call = match transport {
        Transport::Grpc => {
            grpc::complete(response.headers_mut());
            access::of_rpc(&path).0
        }
        Transport::Http => {
            if response.extensions().get::<ApiError>().is_none() && is_bare_refusal(&response) {
                response = with_our_body(&response);
            }
            response.extensions().get::<Call>().map_or(access::OTHER, |Call(name)| name)
        }
    };
    let took = started.elapsed();
    let ms = took.as_secs_f64() * 1e3;
    let error = response.extensions_mut().remove::<ApiError>();
    let code = error.as_ref().map(|error| error.error().code().name());
    let code = code.or_else(|| text_of(response.headers(), "segsplat-code")).unwrap_or("ok");
    meter::answered(transport.name(), call, code, took);
    if let Some(error) = error {
        log_error(error.error(), Some(ms));
        if answers == Transport::Http {
            response = error.write(response, id, &path, as_problem);
        }
    } else {
        tracing::debug!(status = response.status().as_u16(), ms, code, "served");
    }
    // The whole time goes beside those of the stages.
    if let Ok(value) = HeaderValue::from_str(&format!("total;dur={ms:.2}")) {
        response.headers_mut().append("server-timing", value);
    }
    response
}

/// Around each HTTP route: [`admit`], and says which call it is.
pub(super) async fn http_guard(
    State((api, call, scope)): State<(Api, &'static str, Option<Scope>)>,
    request: Request,
    next: Next,
) -> Response {
    let mut response = admit(&api, Transport::Http, scope, request, next).await;
    response.extensions_mut().insert(Call(call));
    response
}

/// Around each gRPC call: [`admit`].
pub(super) async fn grpc_guard(State(api): State<Api>, request: Request, next: Next) -> Response {
    let (_, scope) = access::of_rpc(request.uri().path());
    admit(&api, Transport::Grpc, scope, request, next).await
}

/// The guard of both doors: checks the origin, for gRPC the content type, and the key. Counts the
/// call as open, until the answer is sent.
async fn admit(
    api: &Api,
    transport: Transport,
    scope: Option<Scope>,
    mut request: Request,
    next: Next,
) -> Response {
    let answers = transport.answers(&request);
    let origin = scope.map_or(Ok(()), |_| check_origin(api, &request));
    if let Err(error) = origin.and_then(|()| check_content_type(transport, request.headers())) {
        return answers.refusal(error);
    }
    let Some(scope) = scope else { return next.run(request).await };
    let admitted = api.drain.open_call().and_then(|call| {
        let shown = request.headers_mut().remove(header::AUTHORIZATION);
        let shown = shown.as_ref().map(|value| value.to_str().unwrap_or_default());
        let admission = api.access.admit(shown, scope)?;
        if let Some(key) = &admission.key {
            Span::current().record("key", &**key);
        }
        request.extensions_mut().insert(admission.caller.clone());
        Ok((call, admission))
    });
    let held = match admitted {
        Ok(held) => held,
        Err(error) => return answers.refusal(error),
    };
    let mut response = next.run(request).await;
    let own = match response.extensions_mut().remove::<Held>() {
        None => match whole_answer(api, &response) {
            Ok(bytes) => bytes,
            Err(error) => return answers.refusal(error),
        },
        own => own,
    };
    hold(response, (held, own))
}

/// The bytes of an answer that is in memory as a whole, where it is not small.
fn whole_answer(api: &Api, response: &Response) -> Result<Option<Held>> {
    let bytes = http_body::Body::size_hint(response.body()).exact().unwrap_or(0);
    if bytes < LARGE_ANSWER_BYTES {
        return Ok(None);
    }
    api.service.answer_bytes(bytes).map(|bytes| Some(Held::new(Arc::new(bytes))))
}

/// Lets only what says that it is gRPC come to a method of gRPC: a page of the web can send bytes
/// of any other type without asking first.
fn check_content_type(transport: Transport, headers: &HeaderMap) -> Result<()> {
    if transport == Transport::Http || is_grpc(headers) {
        return Ok(());
    }
    let given = text_of(headers, header::CONTENT_TYPE.as_str()).unwrap_or_default();
    let message = format!("content-type is {:?}; it must be application/grpc", short(given));
    Err(Error::new(ErrorCode::UnsupportedMediaType, message))
}

/// Every host that a call names: that of its target, which is `:authority` in HTTP/2, and those of
/// its `host` headers.
fn hosts_of(request: &Request) -> impl Iterator<Item = &str> {
    let named = request.headers().get_all(header::HOST).iter();
    let named = named.map(|host| host.to_str().unwrap_or("not text"));
    request.uri().authority().map(Authority::as_str).into_iter().chain(named)
}

/// Refuses pages of other origins where callers need no key: else a browser on this machine would
/// let any page of the web call. The origin is compared with an allowed host.
fn check_origin(api: &Api, request: &Request) -> Result<()> {
    let Some(origin) = request.headers().get(header::ORIGIN) else { return Ok(()) };
    if api.access.needs_keys() {
        return Ok(());
    }
    let origin = origin.to_str().unwrap_or_default();
    let host = text_of(request.headers(), header::HOST.as_str());
    let host = host.or_else(|| request.uri().authority().map(Authority::as_str));
    let own = origin.split_once("://").map(|(_, host)| host);
    let named = &api.service.config().cors_origins;
    if (own.is_some() && own == host) || named.iter().any(|name| name == "*" || name == origin) {
        return Ok(());
    }
    let message =
        format!("a page of {:?} calls; to allow it, name it in cors_origins", short(origin));
    Err(Error::new(ErrorCode::PermissionDenied, message))
}

fn set(headers: &mut HeaderMap, name: &'static str, text: &str) {
    if let Ok(value) = HeaderValue::from_str(text) {
        headers.insert(name, value);
    }
}

/// An error status without a body of ours: ours is JSON, the framework's is text.
fn is_bare_refusal(response: &Response) -> bool {
    let kind = text_of(response.headers(), "content-type").unwrap_or_default();
    let status = response.status();
    (status.is_client_error() || status.is_server_error())
        && !kind.starts_with("application/json")
        && !is_grpc(response.headers())
}

/// Puts a refusal of the framework's own into our shape and keeps its headers.
fn with_our_body(response: &Response) -> Response {
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
    let mut ours = Transport::Http.refusal(error);
    *ours.status_mut() = response.status();
    ours.headers_mut().extend(response.headers().clone());
    ours
}

fn deadline_passed(deadline: Duration) -> Error {
    Error::new(
        ErrorCode::DeadlineExceeded,
        format!("the call's deadline of {} ms passed", deadline.as_millis()),
    )
}

/// `deadline_ms` of a query string, at most once.
fn deadline_of_query(request: &Request) -> Result<Option<Duration>> {
    let pairs = Query::<Vec<(String, String)>>::try_from_uri(request.uri());
    // What cannot be read is refused where the rest is read.
    let Ok(Query(pairs)) = pairs else { return Ok(None) };
    let mut values = pairs.into_iter().filter(|(name, _)| name == "deadline_ms");
    let Some((_, value)) = values.next() else { return Ok(None) };
    if values.next().is_some() {
        return Err(Error::invalid("deadline_ms is given twice"));
    }
    match value.parse::<u64>() {
        Ok(ms) if ms > 0 => Ok(Some(Duration::from_millis(ms))),
        _ => {
            let must = "it must be a whole number over 0";
            Err(Error::invalid(format!("deadline_ms is {:?}; {must}", short(&value))))
        }
    }
}

/// `grpc-timeout`: up to eight digits and a unit of H, M, S, m, u or n; others are ignored.
fn deadline_of_grpc(headers: &HeaderMap) -> Option<Duration> {
    let text = text_of(headers, "grpc-timeout")?;
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
