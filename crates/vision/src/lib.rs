//! From posed photos to Gaussians and their semantics: every stage between an upload and a scene.
//!
//! | layer | modules | may use |
//! |---|---|---|
//! | L1 stages | [`photos`], [`capture`], [`models`], [`lift`], [`segment`], [`semantics`], [`sample`] | `segsplat_core`; never each other |
//! | L2 order | [`pipeline`] | L1; the only place that knows their order |

pub mod capture;
pub mod lift;
pub mod models;
pub mod photos;
pub mod pipeline;
pub mod sample;
pub mod segment;
pub mod semantics;

use segsplat_core::{error, limits, meter, scene};
