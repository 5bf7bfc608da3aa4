//! From masks and embeddings to meaning: crops, the bank, an index a Gaussian, scores of a text.
//!
//! In: photos, their masks and one embedding a mask, all from elsewhere. Out: a [`Bank`] of few
//! rows, the row of each Gaussian, and for a text embedding the tables, maps and parts in 3D that
//! answer "where is it?". Nothing here knows a network, a renderer or a word.
//!
//! The formulas are those of `docs/conventions.md` in their short forms: no feature of the
//! embedding's length is ever made for a pixel.

mod assign;
mod bank;
mod crops;
mod palette;
mod parts;
mod score;
mod views;

pub use self::{
    assign::{NetworkPicture, from_source, relabel},
    bank::{Clusters, bank, rows_wanted},
    crops::Cutter,
    palette::{colour, palette_table},
    parts::{Box3, Part, PartOptions, Pieces},
    score::{Scorer, Scoring, TextScores, ViewNorms, mask_from_blend},
    views::{Views, merge},
};

use crate::scene::Bank;

/// Length of a row in f64.
fn norm(row: &[f32]) -> f64 {
    dot(row, row).sqrt()
}

/// Dot product in f64 with four sums in a fixed order, so the bits are always the same.
fn dot(a: &[f32], b: &[f32]) -> f64 {
    let mut sums = [0.0_f64; 4];
    let (quads_a, quads_b) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = quads_a
        .remainder()
        .iter()
        .zip(quads_b.remainder())
        .map(|(x, y)| f64::from(*x) * f64::from(*y))
        .sum();
    for (x, y) in quads_a.zip(quads_b) {
        for (lane, sum) in sums.iter_mut().enumerate() {
            *sum += f64::from(x[lane]) * f64::from(y[lane]);
        }
    }
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

/// The rows scaled to length 1. A row of zeros stays zero.
fn unit_rows(bank: &Bank) -> Vec<f32> {
    let mut rows = bank.rows.clone();
    for row in rows.chunks_exact_mut(bank.dim.max(1)) {
        let length = norm(row);
        if length > 0.0 {
            #[expect(clippy::cast_possible_truncation, reason = "rows are f32")]
            row.iter_mut().for_each(|v| *v = (f64::from(*v) / length) as f32);
        }
    }
    rows
}
