//! gRPC: `segsplat.v1.SceneService`, `inference.GRPCInferenceService`, health and reflection.
//!
//! Errors have the code of the table in metadata `segsplat-code`, because several codes share one
//! gRPC status.

mod convert;
mod inference_service;
mod scene_service;
mod status;

use futures_util::FutureExt;
use tonic::service::Routes;
use tonic_health::{ServingStatus, server::HealthReporter};

use self::pb_inference::grpc_inference_service_server::GrpcInferenceServiceServer;
use super::{Api, drain::Drain};
use crate::error::{Error, Result};

pub(super) use self::status::{complete, refusal, retry_after_s, unimplemented};

/// A module of generated code.
macro_rules! generated {
    ($(#[$doc:meta] $name:ident: $file:literal;)+) => {$(
        #[$doc]
        #[allow(
            missing_docs,
            unreachable_pub,
            missing_debug_implementations,
            clippy::all,
            clippy::doc_markdown,
            clippy::missing_errors_doc,
            clippy::unwrap_used,
            clippy::use_self,
            clippy::allow_attributes_without_reason,
            clippy::enum_glob_use,
            clippy::semicolon_if_nothing_returned,
            clippy::implicit_clone,
            reason = "generated code"
        )]
        pub mod $name {
            include!(concat!(env!("CARGO_MANIFEST_DIR"), "/proto/generated/", $file));
        }
    )+};
}

generated! {
    /// Messages and services of `proto/segsplat/v1/`; `tests/it/proto.rs` compares them.
    pb: "segsplat.v1.rs";
    /// Those of `proto/inference/`.
    pb_inference: "inference.rs";
}

/// Descriptors of both, for reflection and for the test that compares HTTP and gRPC.
pub const DESCRIPTORS: &[u8] = include_bytes!("../../../proto/generated/descriptors.bin");

/// Largest picture sent as one message: 4096 x 4096 x 3 f32 and its headers.
const MESSAGE_BYTES_MAX: usize = 256 << 20;

/// The routes of gRPC, to be merged with those of HTTP.
///
/// # Errors
/// `internal` when the descriptors are damaged.
///
/// # Panics
/// Outside of a tokio runtime.
pub fn routes(api: Api) -> Result<Routes> {
    // The camera JSON goes in one message with the header; all else comes in smaller pieces.
    let decoding_max = api.service.limits().json_bytes_max + (1 << 20);
    let drain = api.drain.clone();
    let inference = api.service.config().limits.inference_bytes_max + (1 << 20);
    let networks = GrpcInferenceServiceServer::new(api.clone())
        .max_decoding_message_size(inference)
        .max_encoding_message_size(MESSAGE_BYTES_MAX);
    let scenes = pb::scene_service_server::SceneServiceServer::new(api)
        .max_decoding_message_size(decoding_max)
        .max_encoding_message_size(MESSAGE_BYTES_MAX);
    let damaged = |e| Error::internal("the gRPC descriptors are damaged").caused_by(e);
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };
    Ok(Routes::new(scenes)
        .add_service(networks)
        .add_service(health(drain))
        .add_service(reflection().build_v1().map_err(damaged)?)
        .add_service(reflection().build_v1alpha().map_err(damaged)?))
}

/// Says that server and service serve, until the server begins to stop.
fn health(
    drain: Drain,
) -> tonic_health::pb::health_server::HealthServer<tonic_health::server::HealthService> {
    let reporter = HealthReporter::new();
    let service = tonic_health::server::HealthService::from_health_reporter(reporter.clone());
    let name = pb::scene_service_server::SERVICE_NAME;
    // Nobody else has the lock yet, so this is ready at once.
    reporter.set_service_status(name, ServingStatus::Serving).now_or_never();
    tokio::spawn(async move {
        drain.stopping().await;
        for name in ["", name] {
            reporter.set_service_status(name, ServingStatus::NotServing).await;
        }
    });
    tonic_health::pb::health_server::HealthServer::new(service)
}
