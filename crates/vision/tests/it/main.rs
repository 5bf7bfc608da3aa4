//! The stages from photos to a scene, one by one.
#![allow(
    clippy::panic,
    clippy::print_stdout,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "helpers of tests are tests too"
)]

mod assign;
mod backdrop;
mod bank;
mod bitset;
mod bundle;
mod capture;
mod check;
mod colours;
mod crops;
mod fit;
mod frame;
mod geometry;
mod instances;
mod literal;
mod palette;
mod photos;
mod quality;
mod refine;
mod room;
mod sample;
mod score;
mod segment;
mod thin;
mod union;
mod votes;

use segsplat_vision::models::NetworkOptions;

/// The defaults, with the library that `scripts/setup` put into the repository's target folder:
/// these tests do not run in the root of the repository, where the search begins.
fn network_options() -> NetworkOptions {
    let library = segsplat_testing::root().join("target/ort");
    let named =
        ["ORT_DYLIB_PATH", "CARGO_TARGET_DIR"].iter().any(|v| std::env::var_os(v).is_some());
    let ort_library = (!named && library.is_dir()).then_some(library);
    NetworkOptions { ort_library, ..NetworkOptions::default() }
}
