//! What the tests of all crates share: generated scenes, comparison of pictures, the oracles of
//! the backward pass and of the loss, places of files, and how a test reports that it was skipped.
#![allow(
    clippy::expect_used,
    clippy::missing_panics_doc,
    clippy::panic,
    clippy::print_stdout,
    reason = "helpers of tests are tests too"
)]

pub mod backward;
pub mod captures;
pub mod compare;
pub mod frames;
pub mod labels;
pub mod loss;
pub mod scenes;

use std::path::{Path, PathBuf};

use segsplat_core::error::{ErrorCode, Result};

/// The repository's root.
#[must_use]
pub fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
}

/// The ONNX Runtime that tests name to the program: `SEGSPLAT_ORT_LIBRARY`, else the checkout's,
/// which a test program that is built elsewhere does not find; `None` where it finds one by itself.
#[must_use]
pub fn ort_library() -> Option<PathBuf> {
    let named = std::env::var_os("SEGSPLAT_ORT_LIBRARY").map(PathBuf::from);
    let found =
        ["ORT_DYLIB_PATH", "CARGO_TARGET_DIR"].iter().any(|v| std::env::var_os(v).is_some());
    named.or_else(|| Some(root().join("target/ort")).filter(|folder| !found && folder.is_dir()))
}

/// True where the absence of a library or an adapter is a failure and not a skip.
#[must_use]
pub fn strict() -> bool {
    std::env::var("CI").is_ok_and(|v| v == "true" || v == "1")
}

/// Prints `skipped: why` and goes on; fails where [`strict`].
pub fn skipped(why: &str) {
    assert!(!strict(), "skipped: {why}; with CI=true that is a failure");
    println!("skipped: {why}");
}

/// What was opened; `None` where ONNX Runtime or a network is missing, which is then [`skipped`].
pub fn opened<T>(result: Result<T>) -> Option<T> {
    match result {
        Err(e) if e.code() == ErrorCode::ModelUnavailable => {
            // What the library itself said is the source.
            let source = std::error::Error::source(&e).map(ToString::to_string);
            skipped(&format!("{e}: {}", source.unwrap_or_default()));
            None
        }
        opened => Some(opened.expect("networks that open")),
    }
}

/// The shared photo data: `SEGSPLAT_SHARED_DATA`, else `../shared/data` beside the repository.
///
/// It is no part of the repository, and every test with it has another on `tests/fixtures/room`.
/// `None` (said on standard output) where there is none, also in CI; a failure where the variable
/// names a folder without scenes.
#[must_use]
pub fn shared_data() -> Option<PathBuf> {
    let named = std::env::var_os("SEGSPLAT_SHARED_DATA").map(PathBuf::from);
    let required = named.is_some();
    let folder = named.unwrap_or_else(|| root().join("../shared/data"));
    if folder.join("scenes").is_dir() {
        return Some(folder);
    }
    assert!(!required, "SEGSPLAT_SHARED_DATA is {}, which has no scenes", folder.display());
    println!("skipped: no shared photo data (set SEGSPLAT_SHARED_DATA)");
    None
}

/// A folder of the shared photo scenes.
#[must_use]
pub fn shared_scene(name: &str) -> Option<PathBuf> {
    shared_data().map(|data| data.join("scenes").join(name))
}
