//! One test binary: links ONNX Runtime and wgpu once.
#![allow(clippy::panic, clippy::print_stdout, clippy::unwrap_used, reason = "tests")]

mod frames;
mod report;
mod semantics;
