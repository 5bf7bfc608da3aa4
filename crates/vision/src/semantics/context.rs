//! The context of a mask: the mean of the dense features of its whole photo under it.
//!
//! A crop shows a thing without its place. The features of the whole photo know both. An embedding
//! of a mask is the sum of the two at length 1, the context times a weight.

use rayon::prelude::*;

use super::rows::scale_to_unit;
use crate::scene::{DenseFeatures, PhotoMasks};

/// `[masks * dim]` contexts of length 1: the mean of the features under each mask, each cell
/// weighed by how much of it lies under the mask. A mask without cells has a row of zeros.
///
/// Masks that come with their whole cells ([`PhotoMasks::wholes`]) are taken whole.
#[must_use]
pub fn contexts(features: &DenseFeatures, masks: &PhotoMasks) -> Vec<f32> {
    let cells = features.columns * features.rows;
    let shares = shares(masks, [features.columns, features.rows]);
    let context = |shares: &[f64]| -> Vec<f32> {
        let under: Vec<(usize, f64)> =
            shares.iter().copied().enumerate().filter(|(_, share)| *share > 0.0).collect();
        #[expect(clippy::cast_possible_truncation, reason = "embeddings are f32")]
        let mean = |feature: &[f32]| -> f32 {
            under.iter().map(|&(cell, share)| share * f64::from(feature[cell])).sum::<f64>() as f32
        };
        let mut row: Vec<f32> = features.data.chunks_exact(cells.max(1)).map(mean).collect();
        scale_to_unit(&mut row);
        row
    };
    shares.par_chunks_exact(cells.max(1)).flat_map_iter(context).collect()
}

/// `[masks * rows * columns]` share of the photo that lies in a cell and under a mask, times a
/// factor that all have in common.
fn shares(masks: &PhotoMasks, [columns, rows]: [usize; 2]) -> Vec<f64> {
    let map = &masks.map;
    let (across, down) = (overlaps(map.width, columns), overlaps(map.height, rows));
    let mut shares = vec![0.0; masks.masks.len() * rows * columns];
    let mut add = |mask: usize, at: usize| {
        let Some(of) = shares.chunks_exact_mut((rows * columns).max(1)).nth(mask) else { return };
        let width = map.width as usize;
        for &(y, high) in &down[at / width] {
            across[at % width].iter().for_each(|&(x, wide)| of[y * columns + x] += high * wide);
        }
    };
    if masks.wholes.is_empty() {
        let covered = map.index.iter().enumerate().filter(|(_, mask)| **mask > 0);
        covered.for_each(|(at, mask)| add(usize::from(*mask) - 1, at));
    }
    for (mask, runs) in masks.wholes.iter().enumerate() {
        for &[first, count] in runs {
            (first..first.saturating_add(count))
                .map(|at| at as usize)
                .filter(|at| *at < map.index.len())
                .for_each(|at| add(mask, at));
        }
    }
    shares
}

/// For each of `count` cells along an axis: which of `into` coarser ones it lies in, and how much
/// of it.
fn overlaps(count: u32, into: usize) -> Vec<Vec<(usize, f64)>> {
    let size = into as f64 / f64::from(count.max(1));
    let cell = |i: u32| {
        let [from, to] = [f64::from(i) * size, f64::from(i + 1) * size];
        let parts = (from as usize..into).take_while(move |part| (*part as f64) < to);
        let part = |part: usize| (part, to.min(part as f64 + 1.0) - from.max(part as f64));
        parts.map(part).filter(|(_, share)| *share > 0.0).collect()
    };
    (0..count).map(cell).collect()
}

/// Adds a context of length 1 to the embedding of the crop, also of length 1; their sum has length
/// 1. A sum of no length stays the crop's.
pub fn add_context(crop: &mut [f32], context: &[f32], weight: f64) {
    #[expect(clippy::cast_possible_truncation, reason = "embeddings are f32")]
    let sum = |(a, b): (&f32, &f32)| (f64::from(*a) + weight * f64::from(*b)) as f32;
    let mut both: Vec<f32> = crop.iter().zip(context).map(sum).collect();
    if scale_to_unit(&mut both) {
        crop.copy_from_slice(&both);
    }
}
