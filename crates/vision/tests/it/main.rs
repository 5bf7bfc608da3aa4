//! The stages from photos to a scene, one by one.
#![allow(
    clippy::panic,
    clippy::print_stdout,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "helpers of tests are tests too"
)]

mod archives;
mod assign;
mod backdrop;
mod bank;
mod bitset;
mod bundle;
mod cameras;
mod capture;
mod captures;
mod cases;
mod check;
mod colours;
mod context;
mod crops;
mod fit;
mod frame;
mod geometry;
mod instances;
mod literal;
mod matcher;
mod palette;
mod photos;
mod quality;
mod refine;
mod room;
mod sample;
mod score;
mod segment;
mod thin;
mod tracks;
mod union;
mod votes;

use segsplat_vision::models::NetworkOptions;

/// The defaults, with the library that tests use.
fn network_options() -> NetworkOptions {
    NetworkOptions { ort_library: segsplat_testing::ort_library(), ..NetworkOptions::default() }
}
