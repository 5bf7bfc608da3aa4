//! SegSplat Server: posed photos in, a 3D Gaussian scene out, views at any pose.
//!
//! # Layout: the folder is the pipeline
//!
//! ```text
//! photos + cameras ─▶ api ─▶ service ─▶ jobs ─▶ pipeline ─────────────────────▶ store ─▶ scene id
//!                                               photos ▸ capture ▸ models ▸ lift
//! scene id + camera ─▶ api ─▶ service ─▶ store ─▶ render ─▶ colour, depth, alpha
//! ```
//!
//! | layer | modules | may use |
//! |---|---|---|
//! | L0 the crates below | [`cache`], [`error`], [`limits`], [`scene`], [`formats`], [`render`], [`photos`], [`capture`], [`models`], [`lift`], [`refine`], [`segment`], [`semantics`], [`pipeline`], [`sample`] | their own tables |
//! | L0 of the server | [`config`], [`crypto`], [`keys`], [`telemetry`] | L0 |
//! | L1 | [`store`] | L0 |
//! | L2 | [`jobs`] | L1 |
//! | L3 | [`service`] | L1, L2 |
//! | L4 | [`api`] | L3; the only place that knows HTTP and gRPC |
//! | L5 | `main`, [`cli`] | everything |
//!
//! `tests/it/tidy.rs` reads the `use crate::…` lines and compares the code with this table.
//! Frames, units and orders: `docs/conventions.md`. Why things are as they are: `docs/adr/`.

pub mod api;
pub mod cli;
pub mod config;
pub mod crypto;
pub mod jobs;
pub mod keys;
pub mod service;
pub mod store;
pub mod telemetry;

pub use segsplat_core::{cache, error, limits, names, scene};
pub use segsplat_formats as formats;
pub use segsplat_render as render;
pub use segsplat_vision::{
    capture, lift, models, photos, pipeline, refine, sample, segment, semantics,
};

/// The numeric example of `docs/conventions.md`, run by the doc tests.
#[cfg(doctest)]
#[doc = include_str!("../docs/conventions.md")]
pub mod conventions {}
