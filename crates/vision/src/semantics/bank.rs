//! The bank: K-Means over the embeddings of all masks of all photos.
//!
//! The result is the same to the last bit every time: a fixed seed, ties by number, f64 sums in the
//! order of the embeddings. Threads never add to the same sum.

use std::collections::HashSet;

use rayon::prelude::*;

use crate::{
    error::{Error, Result},
    limits::BANK_ROWS_MAX,
    scene::Bank,
};

/// Seed of the first centre and of the draws after it.
const SEED: u64 = 0x5e65_9141;
/// Most rounds of K-Means. A usual bank needs ten.
const ROUNDS_MAX: usize = 100;

/// A bank and the entry of each embedding.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Clusters {
    /// Plain centroids, `[M * dim]`. A scoring profile may scale them to length 1.
    pub bank: Bank,
    /// `[N]` entry of each embedding, 1 to M.
    pub index: Vec<u16>,
}

/// Number of rows for this many embeddings and photos: 1.2 times the mean number of masks of a
/// photo, rounded up.
#[must_use]
pub fn rows_wanted(features: usize, views: usize) -> usize {
    (6 * features).div_ceil(5 * views.max(1)).min(BANK_ROWS_MAX)
}

/// Clusters `[N * dim]` embeddings of `views` photos into [`rows_wanted`] rows, at most one for
/// each distinct embedding. Without embeddings the bank is empty.
///
/// # Errors
/// `internal` when the length is not a multiple of `dim` or a number is not finite.
pub fn bank(features: &[f32], dim: usize, views: usize) -> Result<Clusters> {
    if features.is_empty() {
        return Ok(Clusters { bank: Bank { dim, rows: Vec::new() }, index: Vec::new() });
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
    let wanted = rows_wanted(rows.len(), views).min(distinct(&rows)).max(1);
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
    let index = nearest.iter().map(|(m, _)| u16::try_from(m + 1).unwrap_or(u16::MAX)).collect();
    Ok(Clusters { bank: Bank { dim, rows }, index })
}

/// Number of distinct embeddings; -0 equals 0.
fn distinct(rows: &[&[f32]]) -> usize {
    let bits = |row: &[f32]| row.iter().map(|v| (v + 0.0).to_bits()).collect::<Vec<u32>>();
    rows.iter().map(|row| bits(row)).collect::<HashSet<_>>().len()
}

/// Squared distance, four sums in a fixed order.
fn distance(row: &[f32], centre: &[f64]) -> f64 {
    let mut sums = [0.0_f64; 4];
    let (quads, of) = (row.chunks_exact(4), centre.chunks_exact(4));
    let square = |a: f32, b: f64| (f64::from(a) - b) * (f64::from(a) - b);
    let rest: f64 = quads.remainder().iter().zip(of.remainder()).map(|(a, b)| square(*a, *b)).sum();
    for (x, y) in quads.zip(of) {
        for (lane, sum) in sums.iter_mut().enumerate() {
            *sum += square(x[lane], y[lane]);
        }
    }
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

/// The nearest centre of each embedding and its squared distance. The first one wins a tie.
fn assign(rows: &[&[f32]], centres: &[Vec<f64>]) -> Vec<(usize, f64)> {
    rows.par_iter()
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
    let mut centres = vec![centre(first.min(rows.len() - 1))];
    let far = |row: &&[f32]| distance(row, &centres[0]);
    let mut distances: Vec<f64> = rows.par_iter().map(far).collect();
    while centres.len() < count {
        let total: f64 = distances.iter().sum();
        let mut best: Option<(f64, Vec<f64>, Vec<f64>)> = None;
        for _ in 0..draws {
            let candidate = centre(pick(&distances, draw.share() * total));
            let closer: Vec<f64> = rows
                .par_iter()
                .zip(&distances)
                .map(|(row, old)| distance(row, &candidate).min(*old))
                .collect();
            let left: f64 = closer.iter().sum();
            if best.as_ref().is_none_or(|(least, ..)| left < *least) {
                best = Some((left, candidate, closer));
            }
        }
        let Some((_, candidate, closer)) = best else { break };
        centres.push(candidate);
        distances = closer;
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
    use super::*;

    /// `count` unit features of `dim` numbers around `groups` directions.
    fn features(count: usize, dim: usize, groups: usize, spread: f64, seed: u64) -> Vec<f32> {
        let mut draw = Draw(seed);
        let mut normal = || (0..6).map(|_| draw.share() - 0.5).sum::<f64>();
        let ways: Vec<Vec<f64>> =
            (0..groups).map(|_| (0..dim).map(|_| normal()).collect()).collect();
        (0..count)
            .flat_map(|i| {
                let row: Vec<f64> =
                    ways[i % groups].iter().map(|v| v + spread * normal()).collect();
                let length = row.iter().map(|v| v * v).sum::<f64>().sqrt();
                row.into_iter().map(move |v| (v / length) as f32)
            })
            .collect()
    }

    fn threads(count: usize) -> rayon::ThreadPool {
        rayon::ThreadPoolBuilder::new().num_threads(count).build().unwrap()
    }

    #[test]
    fn rows_are_1_2_times_the_masks_of_a_photo_rounded_up() {
        let cases = [(0, 2, 0), (1, 2, 1), (10, 2, 6), (40, 2, 24), (41, 2, 25), (5, 1, 6)];
        for (features, views, rows) in cases {
            assert_eq!(rows_wanted(features, views), rows, "{features} of {views}");
        }
        assert_eq!(rows_wanted(1_000_000, 1), BANK_ROWS_MAX);
    }

    #[test]
    fn no_features_one_feature_and_equal_features_are_legal() {
        assert_eq!(bank(&[], 8, 2).unwrap().bank.len(), 0);
        let one = bank(&[0.6, 0.8], 2, 2).unwrap();
        assert_eq!((one.bank.rows, one.index), (vec![0.6, 0.8], vec![1]));
        let equal = bank(&[0.6, 0.8, 0.6, 0.8, 0.6, 0.8], 2, 1).unwrap();
        assert_eq!((equal.bank.len(), equal.index), (1, vec![1, 1, 1]));
        let two = bank(&[0.0, 1.0, -0.0, 1.0, 1.0, 0.0], 2, 1).unwrap();
        assert_eq!(two.bank.len(), 2, "-0 is 0");
    }

    #[test]
    fn what_is_no_feature_is_refused() {
        assert!(bank(&[0.5; 7], 3, 2).is_err() && bank(&[0.5], 0, 2).is_err());
        let error = bank(&[0.0, 1.0, f32::NAN, 1.0], 2, 2).unwrap_err();
        assert!(error.message().contains("feature 1"), "{error}");
    }

    #[test]
    fn the_bank_is_the_same_bit_for_bit_on_any_number_of_threads() {
        let data = features(240, 37, 50, 0.8, 3);
        let alone = threads(1).install(|| bank(&data, 37, 3)).unwrap();
        assert_eq!(alone.bank.len(), 96);
        for count in [2, 3, 8] {
            let many = threads(count).install(|| bank(&data, 37, 3)).unwrap();
            let same = many.bank.rows.iter().zip(&alone.bank.rows);
            assert!(same.into_iter().all(|(a, b)| a.to_bits() == b.to_bits()), "{count}");
            assert_eq!(many.index, alone.index, "{count} threads");
        }
    }

    #[test]
    fn groups_that_lie_apart_are_found() {
        let data = features(60, 32, 12, 0.05, 11);
        let found = bank(&data, 32, 6).unwrap();
        assert_eq!(found.bank.len(), 12);
        for (i, index) in found.index.iter().enumerate() {
            assert_eq!(*index, found.index[i % 12], "feature {i}");
        }
        let used: HashSet<u16> = found.index.iter().copied().collect();
        assert_eq!(used.len(), 12, "no two groups share a row");
    }

    #[test]
    fn each_row_is_the_mean_of_its_features_and_none_is_empty() {
        let data = features(90, 16, 7, 1.0, 5);
        let found = bank(&data, 16, 2).unwrap();
        assert_eq!(found.bank.len(), 54);
        for m in 1..=54_u16 {
            let own: Vec<usize> = (0..90).filter(|&i| found.index[i] == m).collect();
            assert!(!own.is_empty(), "row {m}");
            for d in 0..16 {
                let sum: f64 = own.iter().map(|i| f64::from(data[i * 16 + d])).sum();
                let row = f64::from(found.bank.row(usize::from(m) - 1)[d]);
                assert!((sum / own.len() as f64 - row).abs() < 1e-6, "row {m}, number {d}");
            }
        }
    }

    #[test]
    fn an_empty_cluster_gets_the_farthest_feature_of_a_larger_one() {
        let mut nearest = vec![(0, 0.5), (0, 0.9), (0, 0.9), (1, 2.0)];
        fill_empty(&mut nearest, 3);
        let clusters: Vec<usize> = nearest.iter().map(|n| n.0).collect();
        assert_eq!(clusters, [0, 2, 0, 1], "the first of equals; the only one of 1 stays");
    }
}
