//! The errors: a stable code, a message for the client, and a cause for the log.
//!
//! A new code is one row of [`TABLE`]. HTTP, gRPC, the command line and `docs/errors.md` read it.

use std::fmt;

/// Result of everything fallible in this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// One row of the error table.
#[derive(Clone, Copy, Debug)]
pub struct ErrorRow {
    /// The code.
    pub code: ErrorCode,
    /// Its stable `snake_case` name, the truth for clients.
    pub name: &'static str,
    /// HTTP status.
    pub http: u16,
    /// gRPC status number.
    pub grpc: i32,
    /// Exit code of the command line.
    pub exit: u8,
    /// Whether the same call may succeed later.
    pub retry: bool,
}

macro_rules! table {
    ($($(#[$doc:meta])+ $code:ident: $name:literal, $http:literal, $grpc:literal, $exit:literal,
        $retry:literal;)+) => {
        /// Stable, machine-readable kind of an error.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        #[non_exhaustive]
        pub enum ErrorCode {
            $($(#[$doc])+ $code,)+
        }

        /// The one table, in the order of the codes. gRPC numbers are those of `google.rpc.Code`.
        pub static TABLE: [ErrorRow; [$(ErrorCode::$code),+].len()] = [
            $(ErrorRow {
                code: ErrorCode::$code,
                name: $name,
                http: $http,
                grpc: $grpc,
                exit: $exit,
                retry: $retry,
            },)+
        ];
    };
}

// Code: name, HTTP status, gRPC status, exit code, whether the same call may succeed later.
table! {
    /// The request itself is wrong: a missing part, a bad number, an impossible pose.
    InvalidRequest: "invalid_request", 400, 3, 2, false;
    /// A photo or archive cannot be read as what it claims to be.
    PhotoUnreadable: "photo_unreadable", 422, 3, 2, false;
    /// The cameras of photos that came without could not be solved, or the photos do not confirm
    /// them.
    CamerasUnsolved: "cameras_unsolved", 422, 3, 2, false;
    /// A stated limit is exceeded; the message names limit, value and maximum.
    LimitExceeded: "limit_exceeded", 413, 3, 2, false;
    /// An idempotency key was used again with other photos or options.
    IdempotencyKeyReused: "idempotency_key_reused", 422, 3, 2, false;
    /// No scene of this id.
    SceneNotFound: "scene_not_found", 404, 5, 3, false;
    /// No such route or resource.
    NotFound: "not_found", 404, 5, 3, false;
    /// The path is there, but not with this method.
    MethodNotAllowed: "method_not_allowed", 405, 12, 3, false;
    /// No encoding that `Accept` names fits what was asked.
    NotAcceptable: "not_acceptable", 406, 3, 2, false;
    /// The content type of a call is not one that it takes.
    UnsupportedMediaType: "unsupported_media_type", 415, 3, 2, false;
    /// The scene exists but is not done, or its semantics are still being made.
    SceneNotReady: "scene_not_ready", 409, 9, 4, true;
    /// A text was asked of a scene that was made with `semantics=off`.
    SemanticsOff: "semantics_off", 409, 9, 4, false;
    /// No key was shown, or one that nobody knows.
    Unauthenticated: "unauthenticated", 401, 16, 8, false;
    /// The key may not do this: its scope is too narrow.
    PermissionDenied: "permission_denied", 403, 7, 8, false;
    /// Too much work is queued; try again after the time given.
    Overloaded: "overloaded", 429, 8, 5, true;
    /// The server is stopping; another one, or the next, takes the call.
    Stopping: "stopping", 503, 14, 6, true;
    /// The deadline of the call passed.
    DeadlineExceeded: "deadline_exceeded", 504, 4, 5, true;
    /// The caller went away or asked to stop.
    Cancelled: "cancelled", 499, 1, 5, false;
    /// The model bundle or ONNX Runtime is missing or does not match its manifest.
    ModelUnavailable: "model_unavailable", 503, 14, 6, true;
    /// The store cannot be read or written now.
    StoreUnavailable: "store_unavailable", 503, 14, 6, true;
    /// No usable GPU adapter where one was required.
    GpuUnavailable: "gpu_unavailable", 503, 14, 6, true;
    /// A stored scene fails its checksum.
    SceneCorrupt: "scene_corrupt", 500, 15, 7, false;
    /// What is stored is whole, and another version of the program wrote it: that one can read it.
    OtherVersion: "other_version", 501, 12, 7, false;
    /// A fault of ours.
    Internal: "internal", 500, 13, 1, false;
}

impl ErrorCode {
    /// The row of this code.
    pub fn row(self) -> &'static ErrorRow {
        &TABLE[self as usize]
    }

    /// Stable `snake_case` name.
    pub fn name(self) -> &'static str {
        self.row().name
    }
}

/// An error with its code and a message that names the input, the value and the bound. The message
/// is shown to clients: it holds no path of this machine and no source chain. The source, where
/// there is one, is for the log.
#[derive(Debug, thiserror::Error)]
#[error("{message}")]
pub struct Error {
    code: ErrorCode,
    message: String,
    /// Seconds after which a retry may succeed, for `overloaded`.
    retry_after_s: Option<u32>,
    #[source]
    source: Option<Box<dyn std::error::Error + Send + Sync>>,
}

/// The first characters of a text from a caller or a file, for messages.
pub fn short(text: &str) -> String {
    text.chars().take(80).collect()
}

impl Error {
    /// An error of `code` with a message for the client.
    pub fn new(code: ErrorCode, message: impl Into<String>) -> Self {
        Self { code, message: message.into(), retry_after_s: None, source: None }
    }

    /// The same error with the cause kept for the log.
    #[must_use]
    pub fn caused_by(
        mut self,
        source: impl Into<Box<dyn std::error::Error + Send + Sync>>,
    ) -> Self {
        self.source = Some(source.into());
        self
    }

    /// Says when to try again.
    #[must_use]
    pub fn retry_after_s(mut self, seconds: u32) -> Self {
        self.retry_after_s = Some(seconds);
        self
    }

    /// The request is wrong.
    pub fn invalid(message: impl Into<String>) -> Self {
        Self::new(ErrorCode::InvalidRequest, message)
    }

    /// A photo or archive is unreadable.
    pub fn photo(message: impl Into<String>) -> Self {
        Self::new(ErrorCode::PhotoUnreadable, message)
    }

    /// `what` is over a limit: "photo 3: 9200x7000 px is over 24,000,000 px".
    pub fn limit(
        what: impl fmt::Display,
        value: impl fmt::Display,
        bound: impl fmt::Display,
    ) -> Self {
        Self::new(ErrorCode::LimitExceeded, format!("{what}: {value} is over {bound}"))
    }

    /// A file that cannot be read or written now: `what` was to be done. The cause is kept for the
    /// log.
    pub fn unavailable(what: &str, cause: std::io::Error) -> Self {
        let why = format!("the store cannot {what} now: {}", cause.kind());
        Self::new(ErrorCode::StoreUnavailable, why).caused_by(cause)
    }

    /// A fault of ours.
    pub fn internal(message: impl Into<String>) -> Self {
        Self::new(ErrorCode::Internal, message)
    }

    /// The code.
    pub fn code(&self) -> ErrorCode {
        self.code
    }

    /// The message for the client.
    pub fn message(&self) -> &str {
        &self.message
    }

    /// Seconds after which a retry may succeed.
    pub fn retry_after(&self) -> Option<u32> {
        self.retry_after_s
    }
}
