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
//! | L0 nouns | [`scene`], [`error`], [`limits`], [`keys`], [`config`], [`crypto`], [`telemetry`] | nothing above (`scene` uses `error`, `limits`) |
//! | L1 verbs | [`photos`], [`capture`], [`models`], [`lift`], [`segment`], [`semantics`], [`render`], [`store`], [`sample`] | L0; never each other |
//! | L2 | [`pipeline`] | L1: the only place that knows the order of the stages |
//! | L3 | [`jobs`] | `pipeline`, `store` |
//! | L4 | [`service`] | `jobs`, `store`, `render`, `semantics`, `models` |
//! | L5 | [`api`] | `service`; the only place that knows HTTP and gRPC |
//! | L6 | `main`, [`cli`] | everything |
//!
//! `tests/it/tidy.rs` reads the `use crate::…` lines and holds the code to this table.
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

pub use segsplat_core::{cache, error, limits, scene};
pub use segsplat_render as render;
pub use segsplat_vision::{capture, lift, models, photos, pipeline, sample, segment, semantics};

/// The numeric example of `docs/conventions.md`, run by the doc tests.
#[cfg(doctest)]
#[doc = include_str!("../docs/conventions.md")]
pub mod conventions {}
