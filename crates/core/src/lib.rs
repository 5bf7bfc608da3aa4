//! The nouns of SegSplat: cameras, photos, Gaussians, statuses; errors, limits and stage times.
//!
//! Every other crate of the workspace uses this one; it uses none of them.

pub mod cache;
pub mod error;
pub mod limits;
pub mod meter;
pub mod scene;
