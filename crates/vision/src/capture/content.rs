//! Whether two photos show the same things at all, for any cameras.
//!
//! Corners of one photo are searched in the whole other photo, at a quarter of the matching size,
//! and back. A match counts when its neighbours moved the same way. Rotations in the picture of
//! more than about 20 degrees are not found.

use super::gray::GrayView;

const RADIUS: usize = 3;
/// One corner is taken from each cell of this side, pixels of the reduced picture.
const CELL: usize = 7;
const SCORE_MIN: f32 = 0.85;
const RETURN_PX: usize = 2;
/// Finds this near one another must have moved alike.
const NEAR_PX: f32 = 24.0;
/// Moved alike: within this many pixels and this share of their distance.
const ALIKE_PX: f32 = 2.0;
const ALIKE_SHARE: f32 = 0.2;
const SUPPORT: usize = 3;

/// A picture of half the sides, with window sums for correlation.
struct Small {
    width: usize,
    height: usize,
    gray: Vec<f32>,
    /// Mean and root of the energy of the window around each pixel; 0 energy where none fits.
    stats: Vec<(f32, f32)>,
}

const N: f32 = ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as f32;

impl Small {
    fn new(view: &GrayView) -> Self {
        let (width, height) = (view.width / 2, view.height / 2);
        let mut gray = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                let i = 2 * y * view.width + 2 * x;
                let quad = [i, i + 1, i + view.width, i + view.width + 1];
                gray.push(0.25 * quad.iter().map(|&i| view.gray[i]).sum::<f32>());
            }
        }
        let mut small = Self { width, height, gray, stats: vec![] };
        small.stats = (0..width * height)
            .map(|i| {
                let (x, y) = (i % width, i / width);
                if !small.fits(x, y) {
                    return (0.0, 0.0);
                }
                let (mut sum, mut squares) = (0.0_f32, 0.0_f32);
                for v in small.window(x, y).flatten() {
                    sum += v;
                    squares += v * v;
                }
                (sum / N, (squares - sum * sum / N).max(0.0).sqrt())
            })
            .collect();
        small
    }

    fn fits(&self, x: usize, y: usize) -> bool {
        x >= RADIUS && y >= RADIUS && x + RADIUS < self.width && y + RADIUS < self.height
    }

    fn window(&self, x: usize, y: usize) -> impl Iterator<Item = &[f32]> {
        (y - RADIUS..=y + RADIUS).map(move |row| {
            &self.gray[row * self.width + x - RADIUS..=row * self.width + x + RADIUS]
        })
    }

    /// The pixel of the largest smaller eigenvalue of the structure tensor in each cell.
    fn corners(&self) -> Vec<(usize, usize)> {
        let mut corners = Vec::new();
        for cy in 0..self.height / CELL {
            for cx in 0..self.width / CELL {
                let mut best = (2e-3_f32, None);
                for y in cy * CELL..(cy + 1) * CELL {
                    for x in cx * CELL..(cx + 1) * CELL {
                        if !(self.fits(x, y) && self.fits(x + 1, y + 1) && x > RADIUS && y > RADIUS)
                        {
                            continue;
                        }
                        let value = self.cornerness(x, y);
                        if value > best.0 {
                            best = (value, Some((x, y)));
                        }
                    }
                }
                corners.extend(best.1);
            }
        }
        corners
    }

    fn cornerness(&self, x: usize, y: usize) -> f32 {
        let (mut xx, mut xy, mut yy) = (0.0_f32, 0.0_f32, 0.0_f32);
        for row in y - 2..=y + 2 {
            for col in x - 2..=x + 2 {
                let i = row * self.width + col;
                let dx = self.gray[i + 1] - self.gray[i - 1];
                let dy = self.gray[i + self.width] - self.gray[i - self.width];
                xx += dx * dx;
                xy += dx * dy;
                yy += dy * dy;
            }
        }
        0.5 * (xx + yy - ((xx - yy).powi(2) + 4.0 * xy * xy).sqrt())
    }

    /// Best place in `self` for the window of `other` at (x, y), and its ZNCC.
    fn search(&self, other: &Self, x: usize, y: usize) -> (usize, usize, f32) {
        let mut patch = [0.0_f32; (2 * RADIUS + 1) * (2 * RADIUS + 1)];
        let (mean, root) = other.stats[y * other.width + x];
        for (slot, value) in patch.iter_mut().zip(other.window(x, y).flatten()) {
            *slot = (value - mean) / root.max(1e-6);
        }
        let mut best = (0, 0, -1.0_f32);
        for row in RADIUS..self.height.saturating_sub(RADIUS) {
            for col in RADIUS..self.width.saturating_sub(RADIUS) {
                let root = self.stats[row * self.width + col].1;
                if root < 0.05 {
                    continue;
                }
                let mut sum = 0.0_f32;
                for (line, part) in self.window(col, row).zip(patch.chunks_exact(2 * RADIUS + 1)) {
                    sum += line.iter().zip(part).map(|(a, b)| a * b).sum::<f32>();
                }
                let score = sum / root;
                if score > best.2 {
                    best = (col, row, score);
                }
            }
        }
        best
    }
}

/// Share of the corners of `a` that are found again in `b` in good company, 0..1.
pub(super) fn common(a: &GrayView, b: &GrayView) -> f64 {
    let (a, b) = (Small::new(a), Small::new(b));
    let corners = a.corners();
    let mut finds: Vec<[f32; 4]> = Vec::new();
    for &(x, y) in &corners {
        let (u, v, score) = b.search(&a, x, y);
        if score < SCORE_MIN {
            continue;
        }
        let (bx, by, _) = a.search(&b, u, v);
        if bx.abs_diff(x) <= RETURN_PX && by.abs_diff(y) <= RETURN_PX {
            finds.push([x as f32, y as f32, u as f32 - x as f32, v as f32 - y as f32]);
        }
    }
    let alike = |p: &[f32; 4], q: &[f32; 4]| {
        let apart = (p[0] - q[0]).hypot(p[1] - q[1]);
        let moved = (p[2] - q[2]).hypot(p[3] - q[3]);
        apart > 0.0 && apart < NEAR_PX && moved < ALIKE_PX + ALIKE_SHARE * apart
    };
    let company = |p: &&[f32; 4]| finds.iter().filter(|q| alike(p, q)).count() >= SUPPORT;
    finds.iter().filter(company).count() as f64 / corners.len().max(1) as f64
}
