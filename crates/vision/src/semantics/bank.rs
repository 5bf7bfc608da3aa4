//! The bank: K-Means over the embeddings of all masks of all photos.
//!
//! The result is the same to the last bit every time: a fixed seed, ties by number, f64 sums in the
//! order of the embeddings. Threads never add to the same sum.

use std::collections::{HashMap, HashSet};

use rayon::prelude::*;

use super::rows::sum_of;
use crate::{
    error::{Error, Result},
    limits::BANK_ROWS_MAX,
    scene::Bank,
};

/// Seed of the first centre and of the draws after it.
const SEED: u64 = 0x5e65_9141;
/// Most rounds of K-Means. A usual bank needs ten.
const ROUNDS_MAX: usize = 100;
/// Embeddings that one thread compares at a time, with all centres and with one.
const ROWS_A_TASK: usize = 4;
const ROWS_A_SEED: usize = 128;
/// Embeddings whose distances to all others are kept while seeds are drawn.
const TRIED_MAX: usize = 512;

/// A bank and the entry of each embedding.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Clusters {
    /// Plain centroids, `[M * dim]`. A scoring profile may scale them to length 1.
    pub bank: Bank,
    /// `[N]` entry of each embedding, 1 to M.
    pub entries: Vec<u16>,
}

/// Number of rows for this many embeddings and photos: `lambda` times the mean number of masks of a
/// photo, rounded up.
#[must_use]
pub fn rows_wanted(features: usize, views: usize, lambda: f64) -> usize {
    let rows = lambda * features as f64 / views.max(1) as f64;
    // 1.2 has no exact f64: what rounding puts over a whole number is no further row.
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates")]
    let rows = (rows - 1e-9 * rows.max(1.0)).ceil() as usize;
    rows.clamp(usize::from(features > 0), BANK_ROWS_MAX)
}

/// Clusters `[N * dim]` embeddings into `wanted` rows, at most one for each distinct embedding.
/// Without embeddings the bank is empty.
///
/// # Errors
/// `internal` when the length is not a multiple of `dim` or a number is not finite.
pub fn bank(features: &[f32], dim: usize, wanted: usize) -> Result<Clusters> {
    if features.is_empty() {
        return Ok(Clusters { bank: Bank { dim, rows: Vec::new() }, entries: Vec::new() });
    }
    if dim == 0 || !features.len().is_multiple_of(dim) {
        return Err(Error::internal(format!(
            "bank: {} numbers are no whole number of features of {dim}",
            features.len()
        )));
    }
    if let Some(at) = features.iter().position(|v| !v.is_finite()) {
        return Err(Error::internal(format!("bank: feature {} is not finite", at / dim)));
    }
    let rows: Vec<&[f32]> = features.chunks_exact(dim).collect();
    let wanted = wanted.min(distinct(&rows)).max(1);
    let mut centres = seeds(&rows, wanted);
    let mut nearest = assign(&rows, &centres);
    for _ in 0..ROUNDS_MAX {
        fill_empty(&mut nearest, wanted);
        centres = means(&rows, &nearest, wanted);
        let next = assign(&rows, &centres);
        let settled = next.iter().zip(&nearest).all(|(a, b)| a.0 == b.0);
        nearest = next;
        if settled {
            break;
        }
    }
    // The last assignment may leave a row empty. Then the one before it is used.
    fill_empty(&mut nearest, wanted);
    let centres = means(&rows, &nearest, wanted);
    #[expect(clippy::cast_possible_truncation, reason = "rows are f32")]
    let rows = centres.iter().flatten().map(|v| *v as f32).collect();
    let entries = nearest.iter().map(|(m, _)| u16::try_from(m + 1).unwrap_or(u16::MAX)).collect();
    Ok(Clusters { bank: Bank { dim, rows }, entries })
}

/// Number of distinct embeddings; -0 equals 0.
fn distinct(rows: &[&[f32]]) -> usize {
    let bits = |row: &[f32]| row.iter().map(|v| (v + 0.0).to_bits()).collect::<Vec<u32>>();
    rows.iter().map(|row| bits(row)).collect::<HashSet<_>>().len()
}

/// Squared distance.
fn distance(row: &[f32], centre: &[f64]) -> f64 {
    sum_of(row, centre, |a, b| (a - b) * (a - b))
}

/// The nearest centre of each embedding and its squared distance. The first one wins a tie.
fn assign(rows: &[&[f32]], centres: &[Vec<f64>]) -> Vec<(usize, f64)> {
    rows.par_iter()
        .with_min_len(ROWS_A_TASK)
        .map(|row| {
            let mut best = (0, f64::INFINITY);
            for (m, centre) in centres.iter().enumerate() {
                let d = distance(row, centre);
                if d < best.1 {
                    best = (m, d);
                }
            }
            best
        })
        .collect()
}

/// Mean of the embeddings of each cluster, summed in their order.
fn means(rows: &[&[f32]], nearest: &[(usize, f64)], count: usize) -> Vec<Vec<f64>> {
    let dim = rows.first().map_or(0, |row| row.len());
    let mut sums = vec![vec![0.0_f64; dim]; count];
    let mut sizes = vec![0.0_f64; count];
    for (row, (m, _)) in rows.iter().zip(nearest) {
        sizes[*m] += 1.0;
        sums[*m].iter_mut().zip(*row).for_each(|(sum, v)| *sum += f64::from(*v));
    }
    for (sum, size) in sums.iter_mut().zip(sizes) {
        sum.iter_mut().for_each(|v| *v /= size.max(1.0));
    }
    sums
}

/// Moves the embedding that is farthest from its centre to each empty cluster. Its old cluster must
/// keep at least one; the first one wins a tie.
fn fill_empty(nearest: &mut [(usize, f64)], count: usize) {
    let mut sizes = vec![0_usize; count];
    nearest.iter().for_each(|(m, _)| sizes[*m] += 1);
    for empty in 0..count {
        if sizes[empty] > 0 {
            continue;
        }
        let mut farthest: Option<usize> = None;
        for (i, (m, d)) in nearest.iter().enumerate() {
            if sizes[*m] > 1 && farthest.is_none_or(|of| *d > nearest[of].1) {
                farthest = Some(i);
            }
        }
        let Some(taken) = farthest else { return };
        sizes[nearest[taken].0] -= 1;
        sizes[empty] = 1;
        nearest[taken] = (empty, 0.0);
    }
}

/// k-means++: draws the next centre with a probability by squared distance to the centres so far.
/// Of a few draws it takes the one with the smallest sum of distances; the first one wins a tie.
fn seeds(rows: &[&[f32]], count: usize) -> Vec<Vec<f64>> {
    let mut draw = Draw(SEED);
    let centre = |i: usize| rows[i].iter().map(|v| f64::from(*v)).collect::<Vec<f64>>();
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "a share of the features' number, and a handful of draws"
    )]
    let (first, draws) =
        ((draw.share() * rows.len() as f64) as usize, 2 + (count as f64).ln().floor() as usize);
    let to_all = |i: usize| -> Vec<f64> {
        let centre = centre(i);
        let rows = rows.par_iter().with_min_len(ROWS_A_SEED);
        rows.map(|row| distance(row, &centre)).collect()
    };
    let first = first.min(rows.len() - 1);
    let mut centres = vec![centre(first)];
    let mut distances = to_all(first);
    // An embedding that was tried once is likely to be tried again.
    let mut tried: HashMap<usize, Vec<f64>> = HashMap::new();
    while centres.len() < count {
        let total: f64 = distances.iter().sum();
        let picked: Vec<usize> =
            (0..draws).map(|_| pick(&distances, draw.share() * total)).collect();
        if tried.len() + draws > TRIED_MAX {
            tried.clear();
        }
        let new: HashSet<usize> =
            picked.iter().copied().filter(|i| !tried.contains_key(i)).collect();
        tried.par_extend(new.into_par_iter().map(|i| (i, to_all(i))));
        let closer = |i: usize| tried[&i].iter().zip(&distances).map(|(new, old)| new.min(*old));
        let sums = picked.iter().map(|&i| (closer(i).sum::<f64>(), i));
        let Some((_, best)) = sums.reduce(|a, b| if b.0 < a.0 { b } else { a }) else { break };
        centres.push(centre(best));
        distances = closer(best).collect();
    }
    centres
}

/// The embedding at which the running sum of the distances passes `target`. Its distance is 0 only
/// if all are.
fn pick(distances: &[f64], target: f64) -> usize {
    let mut sum = 0.0;
    let mut last = 0;
    for (i, d) in distances.iter().enumerate() {
        if *d > 0.0 {
            last = i;
            sum += d;
            if sum > target {
                break;
            }
        }
    }
    last
}

/// `SplitMix64`: the same numbers on every machine.
struct Draw(u64);

impl Draw {
    /// A number from 0 up to, but not including, 1.
    fn share(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::fill_empty;

    #[test]
    fn an_empty_cluster_gets_the_farthest_feature_of_a_larger_one() {
        let mut nearest = vec![(0, 0.5), (0, 0.9), (0, 0.9), (1, 2.0)];
        fill_empty(&mut nearest, 3);
        let clusters: Vec<usize> = nearest.iter().map(|n| n.0).collect();
        assert_eq!(clusters, [0, 2, 0, 1], "the first of equals; the only one of 1 stays");
    }
}
