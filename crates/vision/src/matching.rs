//! Which keypoints of two photos show the same thing: those whose descriptors are each other's most
//! similar.

use nalgebra::DMatrix;

use crate::vectorised;

/// Keypoints of the second photo that are compared together: their similarities stay in the cache.
const TOGETHER: usize = 64;

/// The descriptors of a photo's keypoints, laid out to be compared with those of others.
#[derive(Clone, Debug)]
pub struct Descriptors {
    /// `[dim, count]`: each is a column.
    columns: DMatrix<f32>,
    /// `[count, dim]`: each is a row.
    rows: DMatrix<f32>,
    /// Mean of all, `[dim]`.
    mean: Vec<f32>,
}

/// Two keypoints that match.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeypointPair {
    /// Their places among those of their photos.
    pub keypoints: [u32; 2],
    /// Cosine of their descriptors.
    pub similarity: f32,
}

impl Descriptors {
    /// `[N * dim]` descriptors of length 1.
    #[must_use]
    pub fn new(descriptors: &[f32], dim: usize) -> Self {
        let columns = DMatrix::from_column_slice(dim, descriptors.len() / dim.max(1), descriptors);
        let mean = columns.column_mean().as_slice().to_vec();
        Self { rows: columns.transpose(), columns, mean }
    }

    fn count(&self) -> usize {
        self.columns.ncols()
    }

    /// How much two photos look alike: the larger the more.
    #[must_use]
    pub fn alike(&self, other: &Self) -> f32 {
        self.mean.iter().zip(&other.mean).map(|(a, b)| a * b).sum()
    }

    /// The pairs of keypoints that are each other's most similar, with a cosine over `least`, in
    /// the order of the first photo's keypoints.
    #[must_use]
    pub fn matched(&self, other: &Self, least: f32) -> Vec<KeypointPair> {
        let [of_these, of_others] = self.most_similar(other);
        let mutual = |i: usize| {
            let (j, similarity) = (of_these.places[i], of_these.cosines[i]);
            let keypoints = [u32::try_from(i).ok()?, j];
            let is_mutual = *of_others.places.get(j as usize)? == keypoints[0];
            (is_mutual && similarity > least).then_some(KeypointPair { keypoints, similarity })
        };
        (0..self.count()).filter_map(mutual).collect()
    }

    /// The most similar of the other's keypoints to each of these, and of these to each of the
    /// other's.
    fn most_similar(&self, other: &Self) -> [MostSimilar; 2] {
        let mut of_these = MostSimilar::none(self.count());
        let mut of_others = MostSimilar::none(0);
        if self.count() == 0 {
            return [of_these, of_others];
        }
        let mut cosines = DMatrix::zeros(self.count(), TOGETHER);
        for first in (0..other.count()).step_by(TOGETHER) {
            let columns = other.columns.columns(first, TOGETHER.min(other.count() - first));
            cosines.columns_mut(0, columns.ncols()).gemm(1.0, &self.rows, &columns, 0.0);
            let each = cosines.as_slice().chunks_exact(self.count()).take(columns.ncols());
            vectorised(
                #[inline(always)]
                || {
                    for (place, cosines) in (first as u32..).zip(each) {
                        of_these.keep(cosines, place);
                        of_others.add(cosines);
                    }
                },
            );
        }
        [of_these, of_others]
    }
}

/// The most similar keypoint to each of some: its place and its cosine; of equal ones the first.
struct MostSimilar {
    cosines: Vec<f32>,
    places: Vec<u32>,
}

impl MostSimilar {
    fn none(count: usize) -> Self {
        Self { cosines: vec![f32::NEG_INFINITY; count], places: vec![u32::MAX; count] }
    }

    /// Takes one more keypoint, with its cosine to each of these.
    #[inline(always)]
    fn keep(&mut self, cosines: &[f32], place: u32) {
        let kept = self.cosines.iter_mut().zip(&mut self.places);
        for ((kept, kept_place), cosine) in kept.zip(cosines) {
            let is_larger = *cosine > *kept;
            *kept = if is_larger { *cosine } else { *kept };
            *kept_place = if is_larger { place } else { *kept_place };
        }
    }

    /// Adds a keypoint, with its cosine to each of the others.
    #[inline(always)]
    fn add(&mut self, cosines: &[f32]) {
        let mut lanes = [f32::NEG_INFINITY; 16];
        let (whole, rest) = cosines.as_chunks::<16>();
        for cosines in whole {
            for (lane, cosine) in lanes.iter_mut().zip(cosines) {
                *lane = if *cosine > *lane { *cosine } else { *lane };
            }
        }
        let largest = lanes.iter().chain(rest).copied().fold(f32::NEG_INFINITY, f32::max);
        let place = cosines.iter().position(|cosine| *cosine == largest);
        self.cosines.push(largest);
        self.places.push(place.map_or(u32::MAX, |place| place as u32));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `[count * 8]` rows of length 1 that differ.
    fn rows(count: usize, seed: usize) -> Vec<f32> {
        let row = |i: usize| {
            let raw = (0..8).map(|k| (((i + seed) * 31 + k * 17) as f32 * 0.37).sin());
            let raw: Vec<f32> = raw.collect();
            let length = raw.iter().map(|v| v * v).sum::<f32>().sqrt();
            raw.into_iter().map(move |v| v / length)
        };
        (0..count).flat_map(row).collect()
    }

    /// The same by definition.
    fn plain(a: &[f32], b: &[f32], least: f32) -> Vec<[u32; 2]> {
        let cosine = |i: usize, j: usize| -> f32 {
            let (a, b) = (&a[8 * i..8 * i + 8], &b[8 * j..8 * j + 8]);
            a.iter().zip(b).map(|(a, b)| a * b).sum()
        };
        let (n, m) = (a.len() / 8, b.len() / 8);
        let of_row = |i| (0..m).rev().max_by(|x, y| cosine(i, *x).total_cmp(&cosine(i, *y)));
        let of_column = |j| (0..n).rev().max_by(|x, y| cosine(*x, j).total_cmp(&cosine(*y, j)));
        let pair = |i: usize| {
            let j = of_row(i)?;
            let fits = of_column(j) == Some(i) && cosine(i, j) > least;
            fits.then_some([i as u32, j as u32])
        };
        (0..n).filter_map(pair).collect()
    }

    #[test]
    fn matches_are_those_of_the_definition() {
        for (n, m, least) in [(1, 1, -2.0), (5, 40, 0.5), (33, 16, 0.0), (0, 7, 0.0), (7, 0, 0.0)] {
            let (a, b) = (rows(n, 3), rows(m, 11));
            let found = Descriptors::new(&a, 8).matched(&Descriptors::new(&b, 8), least);
            let found: Vec<[u32; 2]> = found.into_iter().map(|pair| pair.keypoints).collect();
            assert_eq!(found, plain(&a, &b, least), "{n} with {m}");
        }
        let same = Descriptors::new(&rows(20, 0), 8);
        assert_eq!(same.matched(&same, 0.9).len(), 20, "each matches itself");
    }
}
