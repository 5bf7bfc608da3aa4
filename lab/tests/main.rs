//! One test binary: links ONNX Runtime and wgpu once.
#![allow(clippy::panic, clippy::print_stdout, clippy::unwrap_used, reason = "tests")]

mod bench;
mod cameras;
mod frames;
mod labels;
mod metrics;
mod photos;
mod report;
mod scenes;
mod semantics;
mod tally;
mod triples;
mod words;

use std::path::Path;

use clap::Parser as _;
use segsplat_core::{
    error::{ErrorCode, Result},
    scene::{Camera, Photo, PosedPhoto},
};
use segsplat_lab::Cli;
use segsplat_testing::{opened, ort_library};
use serde_json::Value;

/// The rows of a command line.
fn lab(arguments: &[&str]) -> Result<Vec<Value>> {
    segsplat_lab::run(&Cli::try_parse_from([&["segsplat-lab"], arguments].concat()).unwrap())
}

/// The rows of a command for a folder; `None` without ONNX Runtime.
fn measured(
    command: &str,
    bundle: &Path,
    folder: &Path,
    rest: &[&str],
) -> Option<Result<Vec<Value>>> {
    let [folder, bundle] = [folder, bundle].map(|p| p.to_str().unwrap());
    let mut line = vec![command, folder, "--bundle", bundle, "--threads", "2"];
    line.extend(rest);
    let library = ort_library();
    if let Some(library) = &library {
        line.extend(["--ort-library", library.to_str().unwrap()]);
    }
    match lab(&line) {
        Err(e) if e.code() == ErrorCode::ModelUnavailable => opened(Err(e)),
        rows => Some(rows),
    }
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
