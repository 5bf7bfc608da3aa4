//! Errors as gRPC statuses with the table's code beside them.

use tonic::{
    Code, Status,
    codegen::http::{HeaderMap, HeaderValue, Response},
    metadata::MetadataMap,
};

use crate::{
    api::log_error,
    error::{Error, ErrorCode, TABLE, short},
};

/// Metadata key of the table's code.
const CODE: &str = "segsplat-code";

/// The status of an error: number, code, message, when to try again.
pub(super) fn status(error: &Error) -> Status {
    let row = error.code().row();
    let mut metadata = MetadataMap::new();
    if let Ok(value) = row.name.parse() {
        metadata.insert(CODE, value);
    }
    if let Some(seconds) = retry_after_s(error) {
        metadata.insert("retry-after", seconds.into());
    }
    Status::with_metadata(Code::from(row.grpc), error.message(), metadata)
}

/// The same, with a line in the log.
pub(super) fn logged(error: &Error) -> Status {
    log_error(error, None);
    status(error)
}

/// Seconds after which the same call may succeed, where that is known.
pub(in crate::api) fn retry_after_s(error: &Error) -> Option<u32> {
    error.retry_after().or_else(|| (error.code() == ErrorCode::Overloaded).then_some(1))
}

/// The error behind a status that tonic made while it read the caller's messages.
pub(super) fn unreadable(status: &Status) -> Error {
    match status.code() {
        // tonic refuses a message by its length prefix, before its bytes come.
        Code::OutOfRange | Code::ResourceExhausted => Error::new(
            ErrorCode::LimitExceeded,
            format!("message over the limit: {}", status.message()),
        ),
        Code::Cancelled => Error::new(ErrorCode::Cancelled, "the caller went away"),
        Code::DeadlineExceeded => Error::new(ErrorCode::DeadlineExceeded, "the deadline passed"),
        _ => Error::invalid(format!("message unreadable: {}", status.message())),
    }
}

/// A whole answer that is only an error.
pub(in crate::api) fn refusal(error: &Error) -> Response<tonic::body::Body> {
    status(error).into_http()
}

/// Answer of a service or method that is not there.
pub(in crate::api) fn unimplemented(path: &str) -> Response<tonic::body::Body> {
    let mut status = Status::unimplemented(format!("no such service or method: {}", short(path)));
    if let Ok(value) = ErrorCode::NotFound.name().parse() {
        status.metadata_mut().insert(CODE, value);
    }
    status.into_http()
}

/// Gives an error that tonic itself answered with (an unreadable message, an unknown method) the
/// code that our own errors have.
pub(in crate::api) fn complete(headers: &mut HeaderMap) {
    let Some(number) = headers.get("grpc-status").and_then(|value| value.to_str().ok()) else {
        return;
    };
    if number == "0" || headers.contains_key(CODE) {
        return;
    }
    let code = match number.parse::<i32>().map(Code::from) {
        Ok(Code::Unimplemented) => ErrorCode::NotFound,
        // Ours always have a code, so these come from tonic's reading of the request.
        Ok(Code::OutOfRange | Code::ResourceExhausted) => ErrorCode::LimitExceeded,
        Ok(Code::Internal | Code::InvalidArgument) => ErrorCode::InvalidRequest,
        Ok(other) => TABLE
            .iter()
            .find(|row| row.grpc == other as i32)
            .map_or(ErrorCode::Internal, |row| row.code),
        Err(_) => ErrorCode::Internal,
    };
    if code != ErrorCode::NotFound {
        headers.insert("grpc-status", HeaderValue::from(code.row().grpc));
    }
    headers.insert(CODE, HeaderValue::from_static(code.name()));
}
