//! Which keypoints of two photos show the same thing: those whose descriptors are each other's most
//! similar.

use crate::vectorised;

/// Rows and columns of similarities that are computed together.
const ROWS: usize = 4;
const COLUMNS: usize = 16;

/// The descriptors of a photo's keypoints, laid out to be compared with those of others.
#[derive(Clone, Debug)]
pub struct Descriptors {
    dim: usize,
    count: usize,
    /// `[count * dim]`, filled up with rows of 0 to whole [`ROWS`].
    rows: Vec<f32>,
    /// The same as `[count / COLUMNS, dim, COLUMNS]`, filled up with 0.
    columns: Vec<f32>,
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
        let count = descriptors.len() / dim.max(1);
        let mut rows = descriptors.to_vec();
        rows.resize(count.next_multiple_of(ROWS) * dim, 0.0);
        let mut columns = vec![0.0; count.next_multiple_of(COLUMNS) * dim];
        let mut mean = vec![0.0; dim];
        for (i, row) in descriptors.chunks_exact(dim.max(1)).enumerate() {
            let tile = i / COLUMNS * COLUMNS * dim;
            for (k, value) in row.iter().enumerate() {
                columns[tile + k * COLUMNS + i % COLUMNS] = *value;
                mean[k] += value / count as f32;
            }
        }
        Self { dim, count, rows, columns, mean }
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
        let mut best = Best::of(self.count, other.count);
        vectorised(
            #[inline(always)]
            || self.compare(other, &mut best),
        );
        let mutual = |(i, &(similarity, j)): (usize, &(f32, usize))| {
            let is_mutual = best.of_columns.get(j)?.1 == i;
            let keypoints = [u32::try_from(i).ok()?, u32::try_from(j).ok()?];
            (is_mutual && similarity > least).then_some(KeypointPair { keypoints, similarity })
        };
        best.of_rows.iter().enumerate().filter_map(mutual).collect()
    }

    #[inline(always)]
    fn compare(&self, other: &Self, best: &mut Best) {
        let dim = self.dim;
        for (at, rows) in self.rows.chunks_exact(ROWS * dim).enumerate() {
            for (tile, columns) in other.columns.chunks_exact(COLUMNS * dim).enumerate() {
                let mut sums = [[0.0_f32; COLUMNS]; ROWS];
                for (k, column) in columns.as_chunks::<COLUMNS>().0.iter().enumerate() {
                    for (r, sums) in sums.iter_mut().enumerate() {
                        let value = rows[r * dim + k];
                        for (sum, other) in sums.iter_mut().zip(column) {
                            *sum += value * other;
                        }
                    }
                }
                for (r, sums) in sums.iter().enumerate() {
                    best.take(at * ROWS + r, tile * COLUMNS, sums);
                }
            }
        }
    }
}

/// The most similar column of each row and row of each column, with the cosine; of equal ones the
/// first.
struct Best {
    of_rows: Vec<(f32, usize)>,
    of_columns: Vec<(f32, usize)>,
}

impl Best {
    fn of(rows: usize, columns: usize) -> Self {
        let none = |count| vec![(f32::NEG_INFINITY, usize::MAX); count];
        Self { of_rows: none(rows), of_columns: none(columns) }
    }

    #[inline(always)]
    fn take(&mut self, row: usize, first: usize, sums: &[f32; COLUMNS]) {
        let Some(of_row) = self.of_rows.get_mut(row) else { return };
        let columns = self.of_columns.iter_mut().skip(first);
        for (i, (sum, of_column)) in sums.iter().zip(columns).enumerate() {
            if *sum > of_row.0 {
                *of_row = (*sum, first + i);
            }
            if *sum > of_column.0 {
                *of_column = (*sum, row);
            }
        }
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
