//! The small grey picture of a photo that is compared, and the pixels of it that can be matched.

use glam::DVec3;
use rayon::prelude::*;

use crate::scene::{Camera, PosedPhoto};

/// Pixels of the small picture, about: 160x120 or 106x188.
const AREA: f64 = 20_000.0;
/// Candidates lie on a grid of this many pixels.
pub(super) const STRIDE: usize = 2;
/// Half side of the matching window: 7x7.
pub(super) const RADIUS: usize = 3;
/// Least standard deviation of a window worth matching, of full scale 1: 4/255 is over the noise
/// of a compressed photo at this size.
const TEXTURE_MIN: f32 = 4.0 / 255.0;
/// Rows of a small picture that one thread averages at a time.
const ROWS_A_TASK: usize = 8;

/// A photo reduced to grey at matching size, with its camera and its matchable pixels.
#[derive(Clone, Debug)]
pub(super) struct GrayView {
    pub(super) width: usize,
    pub(super) height: usize,
    /// `[height * width]`, 0..1 less the picture's mean.
    pub(super) gray: Vec<f32>,
    /// `[height * width]`: whether the whole window around the pixel has a source.
    pub(super) valid: Option<Vec<bool>>,
    /// `[height * width]`: whether the pixel lacks a source.
    pub(super) holes: Vec<bool>,
    /// Camera of the small picture.
    pub(super) camera: Camera,
    /// Matchable pixels on the grid, row by row.
    pub(super) candidates: Vec<Candidate>,
    /// `row_start[y]..row_start[y + 1]`: the candidates of grid row y.
    pub(super) row_start: Vec<usize>,
}

/// A pixel whose window has texture.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    /// Column, pixels of the small picture.
    pub(super) x: u16,
    /// Row.
    pub(super) y: u16,
    /// Mean of the window.
    pub(super) mean: f32,
    /// Sum of squared deviations of the window.
    pub(super) energy: f32,
}

impl GrayView {
    /// Reduces a photo by area averages and finds its matchable pixels.
    pub(super) fn new(posed: &PosedPhoto) -> Self {
        let photo = &posed.photo;
        let size = [photo.width as usize, photo.height as usize];
        let line = |y: usize, into: &mut [f32]| {
            let pixels = photo.rgb[y * size[0] * 3..].chunks_exact(3);
            into.iter_mut().zip(pixels).for_each(|(v, rgb)| *v = luma(rgb));
        };
        let mut view = Self::averaged(size, AREA, posed.camera, line, photo.valid.as_deref());
        let mean = view.gray.iter().sum::<f32>() / view.gray.len() as f32;
        view.gray.iter_mut().for_each(|v| *v -= mean);
        view.find_candidates();
        view
    }

    /// The same view with about `area` pixels, if it has more.
    pub(super) fn reduced(&self, area: f64) -> Self {
        let line = |y: usize, into: &mut [f32]| {
            into.copy_from_slice(&self.gray[y * self.width..][..self.width]);
        };
        let sourced: Option<Vec<bool>> =
            self.valid.as_ref().map(|_| self.holes.iter().map(|hole| !hole).collect());
        let size = [self.width, self.height];
        let mut view = Self::averaged(size, area, self.camera, line, sourced.as_deref());
        view.find_candidates();
        view
    }

    /// Averages over areas of a picture of `w0` x `h0`, about `area` pixels, without candidates.
    /// `line` writes a row of the picture; `sourced` says which of its pixels have a source.
    fn averaged(
        [w0, h0]: [usize; 2],
        area: f64,
        camera: Camera,
        line: impl Fn(usize, &mut [f32]) + Sync,
        sourced: Option<&[bool]>,
    ) -> Self {
        let scale = (area / (w0 * h0) as f64).sqrt().min(1.0);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "positive")]
        let side = |n: usize| ((n as f64 * scale).round() as usize).max(1);
        let (width, height) = (side(w0), side(h0));
        let (columns, rows) = (spans(w0, width), spans(h0, height));
        let mut gray = vec![0.0_f32; width * height];
        let mut holes = vec![false; width * height];
        let out = gray.par_chunks_mut(width).zip(holes.par_chunks_mut(width));
        out.zip(&rows).with_min_len(ROWS_A_TASK).for_each_init(
            || vec![0.0_f32; w0],
            |values, ((gray, holes), rows)| {
                for &(row, row_weight) in rows {
                    line(row, values);
                    for (out, columns) in gray.iter_mut().zip(&columns) {
                        let mean: f32 = columns.iter().map(|&(c, weight)| weight * values[c]).sum();
                        *out += row_weight * mean;
                    }
                    let Some(sourced) = sourced else { continue };
                    let sourced = &sourced[row * w0..][..w0];
                    if sourced.contains(&false) {
                        for (hole, columns) in holes.iter_mut().zip(&columns) {
                            *hole |= columns.iter().any(|&(c, _)| !sourced[c]);
                        }
                    }
                }
            },
        );
        let valid = sourced.map(|_| whole_windows(&holes, width, height));
        let intrinsics = camera.intrinsics.resized(width as u32, height as u32);
        let camera = Camera { intrinsics, ..camera };
        let (candidates, row_start) = (vec![], vec![]);
        Self { width, height, gray, valid, holes, camera, candidates, row_start }
    }

    fn find_candidates(&mut self) {
        let n = ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as f32;
        for grid_y in 0..self.height.div_ceil(STRIDE) {
            self.row_start.push(self.candidates.len());
            let y = grid_y * STRIDE;
            if y < RADIUS || y + RADIUS >= self.height || self.width <= 2 * RADIUS {
                continue;
            }
            for x in (0..self.width).step_by(STRIDE) {
                if x < RADIUS || x + RADIUS >= self.width || !self.is_valid(x, y) {
                    continue;
                }
                let (mut sum, mut squares) = (0.0_f32, 0.0_f32);
                for row in y - RADIUS..=y + RADIUS {
                    for v in
                        &self.gray[row * self.width + x - RADIUS..=row * self.width + x + RADIUS]
                    {
                        sum += v;
                        squares += v * v;
                    }
                }
                let energy = squares - sum * sum / n;
                if energy > n * TEXTURE_MIN * TEXTURE_MIN {
                    let (x, y) = (x as u16, y as u16);
                    self.candidates.push(Candidate { x, y, mean: sum / n, energy });
                }
            }
        }
        self.row_start.push(self.candidates.len());
    }

    /// Whether the window around a pixel has a source everywhere.
    pub(super) fn is_valid(&self, x: usize, y: usize) -> bool {
        self.valid.as_ref().is_none_or(|valid| valid[y * self.width + x])
    }

    /// Direction of a pixel's ray in camera coordinates, z = 1.
    pub(super) fn ray(&self, x: f64, y: f64) -> DVec3 {
        self.camera.intrinsics.unproject(x + 0.5, y + 0.5, 1.0)
    }
}

/// Inverse depths on the grid of the candidates of a view; NaN where none is known.
#[derive(Clone, Debug)]
pub(super) struct Grid {
    columns: usize,
    rows: usize,
    w: Vec<f64>,
}

impl Grid {
    /// The grid of `view` with `(x, y, w)` at the cells of the pixels (x, y).
    pub(super) fn new(view: &GrayView, points: impl Iterator<Item = (u16, u16, f64)>) -> Self {
        let (columns, rows) = (view.width.div_ceil(STRIDE), view.height.div_ceil(STRIDE));
        let mut w = vec![f64::NAN; columns * rows];
        for (x, y, value) in points {
            w[usize::from(y) / STRIDE * columns + usize::from(x) / STRIDE] = value;
        }
        Self { columns, rows, w }
    }

    /// The value of the cell at a place, in pixels; `None` outside or where nothing is known.
    pub(super) fn at(&self, u: f64, v: f64) -> Option<f64> {
        let cell = |c: f64, n: usize| {
            let cell = ((c - 0.5) / STRIDE as f64).round();
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "checked")]
            (cell >= 0.0 && cell < n as f64).then_some(cell as usize)
        };
        let (x, y) = (cell(u, self.columns)?, cell(v, self.rows)?);
        Some(self.w[y * self.columns + x]).filter(|w| !w.is_nan())
    }

    /// What is known at most two cells away from the cell of the pixel (x, y).
    pub(super) fn around(&self, x: usize, y: usize) -> impl Iterator<Item = f64> + '_ {
        let near = |at: usize, n: usize| at.saturating_sub(2)..(at + 3).min(n);
        let (columns, rows) = (near(x / STRIDE, self.columns), near(y / STRIDE, self.rows));
        rows.flat_map(move |row| &self.w[row * self.columns..][columns.clone()])
            .copied()
            .filter(|w| !w.is_nan())
    }
}

fn luma(rgb: &[u8]) -> f32 {
    (0.299 * f32::from(rgb[0]) + 0.587 * f32::from(rgb[1]) + 0.114 * f32::from(rgb[2])) / 255.0
}

/// For each output cell the input cells it covers and their weights, which sum to 1.
fn spans(n0: usize, n: usize) -> Vec<Vec<(usize, f32)>> {
    let step = n0 as f64 / n as f64;
    (0..n)
        .map(|i| {
            let (from, to) = (i as f64 * step, (i + 1) as f64 * step);
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in range")]
            let (first, last) = (from as usize, (to.ceil() as usize).min(n0));
            (first..last)
                .map(|c| {
                    let part = (to.min((c + 1) as f64) - from.max(c as f64)).max(0.0);
                    #[expect(clippy::cast_possible_truncation, reason = "a weight of 0..1")]
                    let weight = (part / step) as f32;
                    (c, weight)
                })
                .collect()
        })
        .collect()
}

/// Marks the pixels whose window holds no hole.
fn whole_windows(holes: &[bool], width: usize, height: usize) -> Vec<bool> {
    let mut valid = vec![true; width * height];
    for y in 0..height {
        for x in 0..width {
            if !holes[y * width + x] {
                continue;
            }
            for row in y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(height) {
                let line = &mut valid[row * width..(row + 1) * width];
                line[x.saturating_sub(RADIUS)..(x + RADIUS + 1).min(width)].fill(false);
            }
        }
    }
    valid
}
