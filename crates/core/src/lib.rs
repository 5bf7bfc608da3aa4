//! The types that every other crate uses: cameras, photos, Gaussians, statuses, errors, limits and
//! stage times. This crate uses no other crate of the workspace.

pub mod cache;
pub mod error;
pub mod limits;
pub mod meter;
pub mod names;
pub mod scene;
