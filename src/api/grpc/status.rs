//! Errors as gRPC statuses with the table's code beside them.

use tonic::{
    Code, Status,
    codegen::http::{HeaderMap, HeaderValue, Response},
    metadata::MetadataMap,
};

use crate::error::{Error, ErrorCode, TABLE};

/// Metadata key of the table's code.
const CODE: &str = "segsplat-code";

/// The status of an error: number, code, message, when to try again.
pub(super) fn status(error: &Error) -> Status {
    let row = error.code().row();
    let mut metadata = MetadataMap::new();
    if let Ok(value) = row.name.parse() {
        metadata.insert(CODE, value);
    }
    let overloaded = (error.code() == ErrorCode::Overloaded).then_some(1);
    if let Some(seconds) = error.retry_after().or(overloaded) {
        metadata.insert("retry-after", seconds.into());
    }
    Status::with_metadata(Code::from(row.grpc), error.message(), metadata)
}

/// The same, after a line in the log: callers' faults at `info`, ours at `error`.
pub(super) fn logged(error: &Error) -> Status {
    let code = error.code().name();
    let source = std::error::Error::source(error).map(ToString::to_string);
    if error.code().row().http >= 500 {
        tracing::error!(code, source, "{error}");
    } else {
        tracing::info!(code, source, "{error}");
    }
    status(error)
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
    let shown: String = path.chars().take(80).collect();
    let mut status = Status::unimplemented(format!("no such service or method: {shown}"));
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_has_its_number_and_its_name_in_metadata() {
        for row in &TABLE {
            let status = status(&Error::new(row.code, "why"));
            assert_eq!(status.code() as i32, row.grpc, "{}", row.name);
            assert_eq!(status.metadata().get(CODE).unwrap(), row.name);
            assert_eq!(status.message(), "why");
        }
        let busy = status(&Error::new(ErrorCode::Overloaded, "busy").retry_after_s(7));
        assert_eq!(busy.metadata().get("retry-after").unwrap(), "7");
    }

    #[test]
    fn tonics_own_refusals_get_a_code_and_ours_are_left_alone() {
        let completed = |status: &str, code: Option<&'static str>| {
            let mut headers = HeaderMap::new();
            headers.insert("grpc-status", status.parse().unwrap());
            if let Some(code) = code {
                headers.insert(CODE, HeaderValue::from_static(code));
            }
            complete(&mut headers);
            let text = |key| headers.get(key).map(|v: &HeaderValue| v.to_str().unwrap().to_owned());
            (text("grpc-status").unwrap(), text(CODE))
        };
        assert_eq!(completed("0", None), ("0".to_owned(), None));
        let limit = ("3".to_owned(), Some("limit_exceeded".to_owned()));
        assert_eq!(completed("11", None), limit);
        let invalid = ("3".to_owned(), Some("invalid_request".to_owned()));
        assert_eq!(completed("13", None), invalid);
        let internal = ("13".to_owned(), Some("internal".to_owned()));
        assert_eq!(completed("13", Some("internal")), internal);
        let missing = ("12".to_owned(), Some("not_found".to_owned()));
        assert_eq!(completed("12", None), missing);
    }
}
