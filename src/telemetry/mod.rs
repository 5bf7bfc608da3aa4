//! Metrics for Prometheus, traces for OTLP, the log.
//!
//! [`meter`] knows every metric there is; [`log`] starts the log and, where a collector is named,
//! sends the spans of each call to it.

pub mod log;
pub mod meter;

pub use self::log::{follow, start, traceparent};
