//! One integration binary: links ONNX Runtime, wgpu and tonic once.

mod common;
mod tidy;
