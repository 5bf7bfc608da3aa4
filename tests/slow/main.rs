//! The tests of the server that take long: load, kills, replicas, fuzzed input, the sample.
#![allow(
    clippy::panic,
    clippy::print_stdout,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "helpers of tests are tests too"
)]

mod cameras;
#[path = "../it/common/mod.rs"]
#[allow(unused_imports, reason = "the quick tests use the rest")]
mod common;
mod conventions;
mod fuzz_input;
mod grow_kill;
mod grow_stream;
mod kill;
mod load;
mod many_uploads;
mod refine_kill;
mod replicas;
mod sample;
