//! Cameras from generated matches, with exact truth.

mod generated;
mod mend;
mod solved;
