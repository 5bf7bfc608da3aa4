//! From masks and embeddings to meaning: crops, tracks, the bank, an entry for each Gaussian,
//! scores of a text.
//!
//! In: photos, their masks and one embedding for each mask. Out: a
//! [`Bank`](segsplat_core::scene::Bank) of few rows, the entry of each Gaussian, and for a text
//! embedding the tables, maps and instances in 3D that answer
//! "where is it?". This module knows no network, no renderer and no word.
//!
//! The formulas are the short forms of `docs/conventions.md`: no pixel gets a feature of the
//! embedding's length.

mod assign;
mod bank;
mod context;
mod crops;
mod instances;
mod palette;
mod rows;
mod score;
mod tracks;
mod views;
mod words;

pub use self::{
    assign::{from_source, relabel},
    bank::{Clusters, bank, rows_wanted},
    context::{add_context, contexts},
    crops::Cutter,
    instances::{Box3, Components, Instance, InstanceOptions},
    palette::{colour, palette_table},
    rows::mean_row,
    score::{Scorer, Scoring, TextScores, ViewNorms},
    tracks::{Tracks, tracks},
    views::{Views, merge},
    words::WordBank,
};
