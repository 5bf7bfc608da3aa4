//! What the test files share: where things are, and how a test says that it was skipped.
#![allow(dead_code, reason = "not every build of the tests uses every helper")]

pub(crate) mod cluster;
pub(crate) mod compare;
pub(crate) mod doors;
pub(crate) mod faults;
pub(crate) mod meaning;
pub(crate) mod process;
pub(crate) mod scenes;
pub(crate) mod server;
pub(crate) mod stand;

use std::path::{Path, PathBuf};

/// The repository's root.
pub(crate) fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// True where absence of data, library or adapter is a failure and not a skip.
pub(crate) fn strict() -> bool {
    std::env::var("CI").is_ok_and(|v| v == "true" || v == "1")
}

/// Prints `skipped: why` and goes on; fails where [`strict`].
pub(crate) fn skipped(why: &str) {
    assert!(!strict(), "skipped: {why}; with CI=true that is a failure");
    println!("skipped: {why}");
}

/// The shared photo data: `SEGSPLAT_SHARED_DATA`, else `../shared/data` beside the repository.
///
/// `None` (said on standard output) where there is none; a failure where [`strict`].
pub(crate) fn shared_data() -> Option<PathBuf> {
    let named = std::env::var_os("SEGSPLAT_SHARED_DATA").map(PathBuf::from);
    let folder = named.unwrap_or_else(|| root().join("../shared/data"));
    if folder.join("scenes").is_dir() {
        return Some(folder);
    }
    skipped("no shared photo data (set SEGSPLAT_SHARED_DATA)");
    None
}

/// A folder of the shared photo scenes.
pub(crate) fn shared_scene(name: &str) -> Option<PathBuf> {
    shared_data().map(|data| data.join("scenes").join(name))
}
