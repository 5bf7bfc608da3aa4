//! The renderers against the oracle and against each other.
#![allow(
    clippy::panic,
    clippy::print_stdout,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "helpers of tests are tests too"
)]

mod adam;
mod backward;
mod blocks;
mod coarse;
#[path = "../common/mod.rs"]
mod common;
mod compare;
mod compose;
mod crop;
mod error;
mod fuzz;
mod growth;
mod label_twins;
mod labels;
mod merged;
mod one_pass;
mod oracle;
mod parts;
mod pitfalls;
mod pool;
mod pose;
mod props;
mod reference;
mod shader_layout;
mod skips;
mod smaller;
mod stages;
mod streamed;
mod train;
mod twins;
mod widths;
