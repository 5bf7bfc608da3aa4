//! Two doors, one house: HTTP and gRPC on one port, both thin over [`Service`].
//!
//! What the two share lives here: request ids, what an upload may hold, which camera fields go
//! together, what can be asked of semantics. `axum` stays in [`http`], `tonic` in [`grpc`].

pub mod grpc;
pub mod http;

mod camera;
mod request_id;
mod semantics;
mod upload;

use self::upload::UploadBudget;
use crate::service::Service;

pub use self::http::serve;

/// What every handler of both doors holds. Cloning shares everything.
#[derive(Clone, Debug)]
pub struct Api {
    service: Service,
    uploads: UploadBudget,
}

impl Api {
    /// The doors of `service`.
    #[must_use]
    pub fn new(service: Service) -> Self {
        let uploads = UploadBudget::new(service.limits().uploads_bytes_max);
        Self { service, uploads }
    }
}
