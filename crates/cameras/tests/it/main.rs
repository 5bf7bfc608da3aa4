//! Cameras from generated matches, with exact truth.

mod generated;
mod guessed;
mod mend;
mod solved;
