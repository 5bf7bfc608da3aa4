//! The tests of the server that take seconds; the slow ones are in `tests/slow`.
#![allow(
    clippy::panic,
    clippy::print_stdout,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "helpers of tests are tests too"
)]

mod access;
mod answers;
mod asking;
mod bad_input;
mod captures;
mod cli;
mod colour_words;
#[allow(unused_imports, reason = "the slow tests use the rest")]
mod common;
mod containers;
mod crop;
mod doors_agree;
mod edits;
mod errors;
mod faults;
mod fields;
mod folders;
mod formats;
mod growing;
mod grpc;
mod hostile;
mod http;
mod inference;
mod jobs;
mod keys;
mod known_words;
mod levels;
mod licences;
mod life;
mod limits;
mod magnify;
mod offline;
mod paper;
mod proto;
mod raw;
mod received;
mod refine;
mod scale;
mod schedule;
mod slow_callers;
mod splat_scenes;
mod splats;
mod store;
mod stored;
mod telemetry;
mod texts;
mod tidy;
mod tls;
mod understand;
mod uploads;
