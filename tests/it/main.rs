//! One integration binary: links ONNX Runtime, wgpu and tonic once.
#![allow(
    clippy::panic,
    clippy::print_stdout,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "helpers of tests are tests too"
)]

mod access;
mod asking;
mod bad_input;
mod cli;
mod colour_words;
mod common;
mod containers;
mod crop;
mod errors;
mod faults;
mod fuzz_input;
mod grpc;
mod hostile;
mod http;
mod jobs;
mod kill;
mod licences;
mod life;
mod load;
mod magnify;
mod proto;
mod replicas;
mod sample;
mod schedule;
mod store;
mod telemetry;
mod texts;
mod tidy;
mod tls;
mod understand;
