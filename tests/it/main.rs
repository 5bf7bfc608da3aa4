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
mod capture;
mod cli;
mod colour_words;
mod colours;
mod common;
mod compose;
mod containers;
mod crop;
mod errors;
mod evaluate;
mod fast;
mod faults;
mod fuzz;
mod fuzz_input;
mod geometry;
mod grpc;
mod hostile;
mod http;
mod jobs;
mod kill;
mod label_twins;
mod labels;
mod licences;
mod life;
mod literal;
mod load;
mod magnify;
mod oracle;
mod photos;
mod pitfalls;
mod pool;
mod props;
mod replicas;
mod sample;
mod segment;
mod shader_layout;
mod skips;
mod store;
mod telemetry;
mod texts;
mod tidy;
mod tls;
mod twins;
mod understand;
mod views;
mod widths;
