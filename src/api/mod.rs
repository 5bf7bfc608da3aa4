//! HTTP and gRPC on one port, both thin over [`Service`].
//!
//! What both share is here: keys and hosts, request ids, the limits of an upload. `axum` stays in
//! [`http`], `tonic` in [`grpc`].

pub mod grpc;
pub mod http;

mod access;
mod drain;
mod hosts;
mod inference;
mod request_id;
mod upload;

use std::{any::Any, error::Error as _, sync::Arc};

use self::{access::Access, drain::Drain, upload::UploadBudget};
use crate::{
    config::Config,
    error::{Error, ErrorCode, Result},
    keys::Caller,
    service::Service,
};

pub use self::http::Server;

/// What every handler of both transports has. Cloning shares everything.
#[derive(Clone, Debug)]
pub struct Api {
    service: Service,
    uploads: UploadBudget,
    access: Arc<Access>,
    drain: Drain,
}

impl Api {
    /// The API of `service`, with the keys that its configuration names.
    ///
    /// # Errors
    /// `invalid_request` when the keys file cannot be used.
    pub fn new(service: Service) -> Result<Self> {
        let uploads = UploadBudget::new(service.limits().uploads_bytes_max);
        let access = Arc::new(Access::new(service.config())?);
        Ok(Self { service, uploads, access, drain: Drain::default() })
    }

    /// The same for one caller. The middleware adds the caller to each request whose key it has
    /// checked.
    fn for_caller(&self, caller: Option<&Caller>) -> Result<Self> {
        let caller = caller.ok_or_else(|| Error::internal("the caller's key was not checked"))?;
        Ok(Self { service: self.service.for_caller(caller.clone()), ..self.clone() })
    }

    /// Whether the networks can be run by themselves now.
    fn networks_ready(&self) -> bool {
        self.service.networks_ready() && !self.drain.is_stopping()
    }

    /// Reads what `config` names again; the call that this gives puts its keys and limits in force.
    fn read_again(&self, config: &Config) -> Result<impl FnOnce()> {
        let put_keys = self.access.read_again(config)?;
        let limits = config.limits.clone();
        Ok(move || {
            let (keys, later) = (put_keys(), self.service.reload(limits));
            tracing::info!(keys, "keys and limits are read again");
            if !later.is_empty() {
                tracing::warn!(limits = ?later, "these limits change only with the next start");
            }
        })
    }
}

/// What an answer holds until its last byte is sent. Handlers of both transports put it beside
/// their answers.
#[derive(Clone)]
struct Held {
    _what: Arc<dyn Any + Send + Sync>,
}

impl Held {
    fn new(what: Arc<impl Send + Sync + 'static>) -> Self {
        Self { _what: what }
    }
}

/// Logs an error with its causes: callers' faults at `info`, ours at `error`, and what a server
/// that stops refuses, which may be thousands, at `debug`. `ms`: time of the call.
fn log_error(error: &Error, ms: Option<f64>) {
    let code = error.code().name();
    let mut message = error.message().to_owned();
    let mut source = error.source();
    while let Some(cause) = source {
        message.push_str(": ");
        message.push_str(&cause.to_string());
        source = cause.source();
    }
    if error.code() == ErrorCode::Stopping {
        tracing::debug!(code, ms, "{message}");
    } else if error.code().row().http >= 500 {
        tracing::error!(code, ms, "{message}");
    } else {
        tracing::info!(code, ms, "{message}");
    }
}

/// Stages and milliseconds as a `Server-Timing` value.
fn server_timing<'a>(stages: impl Iterator<Item = (&'a str, f64)>) -> String {
    let times = stages.map(|(stage, ms)| format!("{stage};dur={ms:.2}"));
    times.collect::<Vec<_>>().join(", ")
}
