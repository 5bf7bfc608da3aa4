//! One test binary: links ONNX Runtime and wgpu once.
#![allow(clippy::panic, clippy::print_stdout, clippy::unwrap_used, reason = "tests")]

mod frames;
mod labels;
mod metrics;
mod report;
mod scenes;
mod semantics;
mod tally;
mod triples;
mod words;

use clap::Parser as _;
use segsplat_core::{
    error::Result,
    scene::{Camera, Photo, PosedPhoto},
};
use segsplat_lab::Cli;
use serde_json::Value;

/// The rows of a command line.
fn lab(arguments: &[&str]) -> Result<Vec<Value>> {
    segsplat_lab::run(&Cli::try_parse_from([&["segsplat-lab"], arguments].concat()).unwrap())
}

/// A photo of these pixels by this camera.
fn posed(camera: Camera, rgb: Vec<u8>) -> PosedPhoto {
    let lens = camera.intrinsics;
    let photo = Photo { width: lens.width, height: lens.height, rgb, valid: None };
    PosedPhoto { file: String::new(), photo, camera, intrinsics_made_for: None }
}

/// The bytes of a `.npy` file.
fn npy(kind: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({shape}), }}\n");
    let length = u16::try_from(header.len()).unwrap().to_le_bytes();
    [b"\x93NUMPY\x01\x00", length.as_slice(), header.as_bytes(), data].concat()
}
