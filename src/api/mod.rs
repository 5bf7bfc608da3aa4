//! Two doors, one house: HTTP and gRPC on one port, both thin over [`Service`].
//!
//! What the two share lives here: who is let in, request ids, what an upload may hold. `axum`
//! stays in [`http`], `tonic` in [`grpc`].

pub mod grpc;
pub mod http;

mod access;
mod hosts;
mod life;
mod request_id;
mod upload;

use std::sync::Arc;

use self::{access::Access, life::Life, upload::UploadBudget};
use crate::{config::Config, error::Result, keys::Caller, service::Service};

pub use self::http::{Doors, serve};

/// What every handler of both doors holds. Cloning shares everything.
#[derive(Clone, Debug)]
pub struct Api {
    service: Service,
    uploads: UploadBudget,
    access: Arc<Access>,
    life: Life,
}

impl Api {
    /// The doors of `service`, with the keys that its configuration names.
    ///
    /// # Errors
    /// `invalid_request` when the keys file cannot be used.
    pub fn new(service: Service) -> Result<Self> {
        let uploads = UploadBudget::new(service.limits().uploads_bytes_max);
        let access = Arc::new(Access::new(service.config())?);
        Ok(Self { service, uploads, access, life: Life::default() })
    }

    /// The same for one caller.
    fn for_caller(&self, caller: &Caller) -> Self {
        Self { service: self.service.for_caller(caller.clone()), ..self.clone() }
    }

    /// Puts the keys and limits of `config` in force. On an error nothing changes.
    ///
    /// # Errors
    /// `invalid_request` when the keys file cannot be used.
    pub fn reload(&self, config: &Config) -> Result<()> {
        let keys = self.access.reload(config)?;
        let later = self.service.reload(config.limits.clone());
        tracing::info!(keys, "keys and limits are read again");
        if !later.is_empty() {
            tracing::warn!(limits = ?later, "these change only with the next start");
        }
        Ok(())
    }
}
