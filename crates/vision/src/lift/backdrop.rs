//! The photos' colours by direction, spread to where no photo looked.
//!
//! Each photo's pixels fall into the map's cells; empty cells take the colours of the coarser
//! levels of a pyramid (pull-push), so a border goes on outwards and fades into the mean.

use rayon::prelude::*;

use crate::scene::{Backdrop, PosedPhoto};

/// Pixels taken a photo along its longer side: several for each cell at any field of view.
const SAMPLES: usize = 192;

/// Sums of colour and their weight, for each cell of a level.
#[derive(Clone)]
struct Level {
    width: usize,
    height: usize,
    cells: Vec<[f32; 4]>,
}

/// The backdrop of a scene; black where there are no photos.
#[must_use]
pub fn backdrop(photos: &[PosedPhoto]) -> Backdrop {
    let seen = photos
        .par_iter()
        .map(observe)
        .reduce(|| Level::empty(Backdrop::WIDTH, Backdrop::HEIGHT), |a, b| a.plus(&b));
    let filled = fill(seen.normalised());
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..255")]
    let byte = |v: f32| v.round().clamp(0.0, 255.0) as u8;
    let cells = filled.cells.iter().map(|c| [byte(c[0]), byte(c[1]), byte(c[2])]).collect();
    Backdrop::from_cells(cells).unwrap_or_default()
}

/// Where one photo's pixels fall.
fn observe(posed: &PosedPhoto) -> Level {
    let mut level = Level::empty(Backdrop::WIDTH, Backdrop::HEIGHT);
    let (width, height) = (posed.photo.width as usize, posed.photo.height as usize);
    let step = (width.max(height) / SAMPLES).max(1);
    let rotation = posed.camera.camera_to_world.rotation();
    let of_row = |y: usize| -> Vec<(usize, usize)> {
        let pixels = (step / 2..width).step_by(step).map(|x| (x, y * width + x));
        let seen = pixels.filter(|(_, at)| posed.photo.valid.as_ref().is_none_or(|v| v[*at]));
        seen.map(|(x, at)| {
            let ray = posed.camera.intrinsics.unproject(x as f64 + 0.5, y as f64 + 0.5, 1.0);
            let (u, v) = Backdrop::position(rotation * ray);
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in range")]
            let cell = (v as usize).min(Backdrop::HEIGHT - 1) * Backdrop::WIDTH
                + (u as usize).min(Backdrop::WIDTH - 1);
            (cell, at)
        })
        .collect()
    };
    let rows = (step / 2..height).into_par_iter().step_by(step);
    let cells: Vec<Vec<(usize, usize)>> = rows.map(of_row).collect();
    // Whole numbers under 2^24: their sums are exact in any order.
    for (cell, at) in cells.into_iter().flatten() {
        for c in 0..3 {
            level.cells[cell][c] += f32::from(posed.photo.rgb[at * 3 + c]);
        }
        level.cells[cell][3] += 1.0;
    }
    level
}

/// Pull-push: means of ever larger cells, then back down into the holes.
fn fill(finest: Level) -> Level {
    if finest.width < 2 || finest.height < 2 {
        return finest;
    }
    let coarse = fill(finest.halved());
    let mut out = finest;
    for y in 0..out.height {
        for x in 0..out.width {
            let at = y * out.width + x;
            let weight = out.cells[at][3];
            if weight < 1.0 {
                let behind = coarse.between(x, y);
                let cell = &mut out.cells[at];
                for (own, behind) in cell.iter_mut().zip(behind).take(3) {
                    *own = *own * weight + behind * (1.0 - weight);
                }
                cell[3] = weight.max(behind[3]);
            }
        }
    }
    out
}

impl Level {
    fn empty(width: usize, height: usize) -> Self {
        Self { width, height, cells: vec![[0.0; 4]; width * height] }
    }

    fn plus(mut self, other: &Self) -> Self {
        for (own, more) in self.cells.iter_mut().flatten().zip(other.cells.iter().flatten()) {
            *own += more;
        }
        self
    }

    /// Sums to means; weights to 0 or 1.
    fn normalised(mut self) -> Self {
        for cell in &mut self.cells {
            if cell[3] > 0.0 {
                *cell = [cell[0] / cell[3], cell[1] / cell[3], cell[2] / cell[3], 1.0];
            }
        }
        self
    }

    /// Half the size: weighted means; one seen child is enough for a full weight.
    fn halved(&self) -> Self {
        let mut half = Self::empty(self.width / 2, self.height / 2);
        for y in 0..half.height {
            for x in 0..half.width {
                let child = |(dx, dy)| (self.cells[(2 * y + dy) * self.width + 2 * x + dx], 1.0);
                let mean = mean([(0, 0), (1, 0), (0, 1), (1, 1)].map(child));
                half.cells[y * half.width + x] = [mean[0], mean[1], mean[2], mean[3].min(1.0)];
            }
        }
        half
    }

    /// Bilinear value of this level at cell (x, y) of the level twice as fine; longitude wraps.
    fn between(&self, x: usize, y: usize) -> [f32; 4] {
        let (u, v) = ((x as f32 - 0.5) / 2.0, (y as f32 - 0.5) / 2.0);
        let (u0, v0) = (u.floor(), v.floor());
        mean([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)].map(|(dx, dy)| {
            let wx = if dx == 0.0 { 1.0 - (u - u0) } else { u - u0 };
            let wy = if dy == 0.0 { 1.0 - (v - v0) } else { v - v0 };
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in range")]
            let (cx, cy) = (
                ((u0 + dx) as i64).rem_euclid(self.width as i64) as usize,
                ((v0 + dy).max(0.0) as usize).min(self.height - 1),
            );
            (self.cells[cy * self.width + cx], wx * wy)
        }))
    }
}

/// Mean colour of cells by their weights, each times its share, and the sum of these.
fn mean(cells: [([f32; 4], f32); 4]) -> [f32; 4] {
    let mut sum = [0.0_f32; 4];
    for (cell, share) in cells {
        let weight = share * cell[3];
        (0..3).for_each(|c| sum[c] += cell[c] * weight);
        sum[3] += weight;
    }
    let w = sum[3];
    if w > 0.0 { [sum[0] / w, sum[1] / w, sum[2] / w, w] } else { sum }
}
