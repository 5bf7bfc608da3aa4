//! Where a decoder's grid of logits lies on a photo, and the logits at other places of the photo.

use crate::scene::Photo;

/// A decoder's grid and the photo in it: the photo fills the left top of a square of pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PhotoGrid {
    /// `[width, height]` of the grid of logits.
    pub(super) grid: [usize; 2],
    /// Side of the square that the network sees, pixels.
    pub(super) side: u32,
    /// `[width, height]` of the photo in it, pixels.
    pub(super) resized: [u32; 2],
}

/// Weights of a resampling along one axis: for each output, its first source and four weights.
#[derive(Clone, Debug)]
struct Axis(Vec<(usize, [f32; 4])>);

/// A resampling of the grid's logits to a map over the whole photo.
#[derive(Clone, Debug)]
pub(super) struct Resample {
    grid: [usize; 2],
    columns: Axis,
    rows: Axis,
}

impl PhotoGrid {
    /// Cells of the grid that the photo fills, `[width, height]`.
    pub(super) fn filled(&self) -> [f64; 2] {
        let share = |axis: usize| f64::from(self.resized[axis]) / f64::from(self.side.max(1));
        [share(0) * self.grid[0] as f64, share(1) * self.grid[1] as f64]
    }

    /// Whole cells of the grid that lie over the photo, `[width, height]`; at least one each way.
    pub(super) fn cells(&self) -> [usize; 2] {
        let filled = self.filled();
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a grid")]
        [0, 1].map(|axis| (filled[axis].round() as usize).clamp(1, self.grid[axis].max(1)))
    }

    /// Resampling to a map of `[width, height]` cells over the whole photo, in one step.
    pub(super) fn to_map(self, map: [usize; 2]) -> Resample {
        let filled = self.filled();
        let axis = |axis: usize| Axis::direct(self.grid[axis], filled[axis], map[axis]);
        Resample { grid: self.grid, columns: axis(0), rows: axis(1) }
    }

    /// Resampling to the photo's pixels as in Segment Anything: to the square, then to the photo.
    pub(super) fn to_photo(self, photo: &Photo) -> Resample {
        let size = [photo.width as usize, photo.height as usize];
        // A grid finer than the square needs only one step.
        if self.grid.iter().any(|&cells| cells > self.side as usize) {
            return self.to_map(size);
        }
        let axis = |axis: usize| {
            let square = Axis::direct(self.grid[axis], self.grid[axis] as f64, self.side as usize);
            let resized = self.resized[axis] as usize;
            square.then(&Axis::direct(resized, resized as f64, size[axis]))
        };
        Resample { grid: self.grid, columns: axis(0), rows: axis(1) }
    }
}

impl Axis {
    /// Bilinear, corners not aligned: `outputs` cells over the first `length` of `sources` cells.
    fn direct(sources: usize, length: f64, outputs: usize) -> Self {
        let scale = length / outputs as f64;
        let last = sources.max(1) - 1;
        let taps = (0..outputs).map(|i| {
            let at = ((i as f64 + 0.5) * scale - 0.5).max(0.0);
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a cell")]
            let first = (at as usize).min(last);
            #[expect(clippy::cast_possible_truncation, reason = "a weight")]
            let weight = (at - first as f64).min(1.0) as f32;
            if first == last {
                return (first, [1.0, 0.0, 0.0, 0.0]);
            }
            (first, [1.0 - weight, weight, 0.0, 0.0])
        });
        Self(taps.collect())
    }

    /// This resampling, then `next`. The outputs must be denser than the sources.
    fn then(&self, next: &Self) -> Self {
        let both = next.0.iter().map(|(first, weights)| {
            let start = self.0.get(*first).map_or(0, |tap| tap.0);
            let mut sum = [0.0; 4];
            for (tap, weight) in self.0.iter().skip(*first).zip(weights) {
                for (i, inner) in tap.1.iter().enumerate() {
                    // Two neighbouring outputs begin at most one source apart.
                    if let Some(s) = sum.get_mut(tap.0 - start + i) {
                        *s += weight * inner;
                    }
                }
            }
            (start, sum)
        });
        Self(both.collect())
    }
}

impl Axis {
    /// The weights as a matrix, `[outputs * sources]`.
    fn dense(&self, sources: usize) -> Vec<f32> {
        let mut matrix = vec![0.0; self.0.len() * sources];
        for (row, (first, weights)) in matrix.chunks_exact_mut(sources).zip(&self.0) {
            // A weight that has no source is 0.
            row[*first..].iter_mut().zip(weights).for_each(|(out, weight)| *out += weight);
        }
        matrix
    }
}

impl Resample {
    /// The weights as two matrices, `[height * grid height]` and `[grid width * width]`: between
    /// them the grid becomes the map.
    pub(super) fn matrices(&self) -> [Vec<f32>; 2] {
        let ([width, height], columns) = (self.grid, self.columns.dense(self.grid[0]));
        let outputs = self.columns.0.len();
        let turned = (0..width).flat_map(|x| (0..outputs).map(move |i| [i, x]));
        let turned = turned.map(|[i, x]| columns[i * width + x]).collect();
        [self.rows.dense(height), turned]
    }

    /// `[width, height]` of the result.
    pub(super) fn size(&self) -> [usize; 2] {
        [self.columns.0.len(), self.rows.0.len()]
    }

    /// One mask's logits, row-major.
    pub(super) fn apply(&self, logits: &[f32]) -> Vec<f32> {
        let [width, height] = self.size();
        let mut out = Vec::with_capacity(width * height);
        let mut line = vec![0.0_f32; self.grid[0] + 4];
        let mut before = None;
        for tap in &self.rows.0 {
            // Rows with the same weights are equal.
            if before == Some(tap) {
                let from = out.len() - width;
                out.extend_from_within(from..);
                continue;
            }
            before = Some(tap);
            line.fill(0.0);
            let sources = logits.chunks_exact(self.grid[0]).skip(tap.0);
            for (row, weight) in sources.zip(tap.1).filter(|(_, weight)| *weight != 0.0) {
                line.iter_mut().zip(row).for_each(|(sum, v)| *sum += weight * v);
            }
            out.extend(self.columns.0.iter().map(|(first, weights)| {
                let source = &line[*first..*first + 4];
                source.iter().zip(weights).map(|(v, w)| v * w).sum::<f32>()
            }));
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(grid: [usize; 2]) -> Vec<f32> {
        let [w, h] = grid;
        (0..h).flat_map(|y| (0..w).map(move |x| (x + 10 * y) as f32)).collect()
    }

    #[test]
    fn a_ramp_stays_where_the_photo_is() {
        // 40x24 of the 64-pixel square: 20x12 of the 32 cells.
        let photo_grid = PhotoGrid { grid: [32, 32], side: 64, resized: [40, 24] };
        assert_eq!(photo_grid.cells(), [20, 12], "cells over the photo");
        let photo = Photo { width: 100, height: 60, rgb: vec![0; 18_000], valid: None };
        for resample in [photo_grid.to_map([50, 30]), photo_grid.to_photo(&photo)] {
            let [w, h] = resample.size();
            let values = resample.apply(&ramp([32, 32]));
            for (x, y) in [(w / 2, h / 2), (w / 4, 2 * h / 3), (w - 6, h / 4)] {
                let (u, v) = ((x as f32 + 0.5) / w as f32, (y as f32 + 0.5) / h as f32);
                let wanted = (u * 20.0 - 0.5) + 10.0 * (v * 12.0 - 0.5);
                let found = values[y * w + x];
                assert!((found - wanted).abs() < 1e-3, "({x}, {y}) of {w}x{h}: {found} {wanted}");
            }
        }
    }

    #[test]
    fn two_steps_are_what_torch_gives() {
        // F.interpolate(bilinear) of a 4x4 grid to 8x8, its first 8x6 to 5x3.
        let photo_grid = PhotoGrid { grid: [4, 4], side: 8, resized: [8, 6] };
        let photo = Photo { width: 5, height: 3, rgb: vec![0; 45], valid: None };
        let logits: Vec<f32> = (0..16).map(|i| ((i * 7) % 11) as f32 - 4.0).collect();
        let found = photo_grid.to_photo(&photo).apply(&logits);
        let torch = [
            -2.828_125, 0.6875, 1.0625, 1.4375, 4.953_125, 0.531_25, -0.25, 1.5, 2.8375, 1.196_875,
            -1.306_25, 1.35, 2.0, 0.175, -2.325,
        ];
        assert_eq!(found.len(), torch.len(), "pixels");
        for (a, b) in found.iter().zip(torch) {
            assert!((a - b).abs() < 1e-5, "{found:?}");
        }
    }
}
