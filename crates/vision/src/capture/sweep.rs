//! One photo against another: planes parallel to the first are swept from infinity to close by,
//! the second photo is warped onto it by each plane's homography, and 7x7 windows are compared by
//! zero-mean normalised cross-correlation (ZNCC).
//!
//! A plane at inverse depth w maps ray r of the first camera to K' (R r + w t) of the second.

use glam::{DMat3, DVec3};

use super::gray::{GrayView, Grid, RADIUS, STRIDE};

/// Nearest plane, in baselines.
const NEAREST_BASELINES: f64 = 0.45;
/// Planes lie at most this far apart, in pixels of the second picture.
const STEP_PX: f64 = 1.0;
/// Planes beyond infinity, pixels: where a true infinity lands when the pose is slightly off.
const BEYOND_PX: f64 = 2.0;
/// Most planes: past this the step grows.
const PLANES_MAX: usize = 600;
/// Least ZNCC of a match.
const SCORE_MIN: f32 = 0.80;
/// A rival peak at least [`RIVAL_PLANES`] away may have at most this share of the best score's
/// place between -1 and 1: (1 - best) / (1 - rival).
const RIVAL_RATIO_MAX: f32 = 0.75;
/// Planes within which scores belong to the same peak.
const RIVAL_PLANES: usize = 3;
/// Largest distance between a pixel and where its match leads back to, pixels.
const LEFT_RIGHT_PX: f64 = 1.5;

/// A second camera seen from a first, in pixels of the small pictures.
#[derive(Clone, Copy, Debug)]
pub(super) struct Relative {
    /// K' R
    kr: DMat3,
    /// K' t
    kt: DVec3,
    baseline: f64,
}

impl Relative {
    /// From the poses and lenses of two views.
    pub(super) fn new(reference: &GrayView, source: &GrayView) -> Self {
        let k = source.camera.intrinsics;
        let k = DMat3::from_cols(
            DVec3::new(k.fx, 0.0, 0.0),
            DVec3::new(0.0, k.fy, 0.0),
            DVec3::new(k.cx, k.cy, 1.0),
        );
        let (from, to) = (&reference.camera.camera_to_world, &source.camera.camera_to_world);
        let to_camera = to.rotation().transpose();
        let shift = from.center() - to.center();
        Self {
            kr: k * to_camera * from.rotation(),
            kt: k * (to_camera * shift),
            baseline: shift.length(),
        }
    }

    /// Where the point of `ray` at inverse depth `w` falls; `None` behind the camera.
    pub(super) fn pixel(&self, ray: DVec3, w: f64) -> Option<(f64, f64)> {
        let p = self.kr * ray + self.kt * w;
        (p.z > 1e-9).then(|| (p.x / p.z, p.y / p.z))
    }

    /// Depth in the second camera of the point of `ray` at depth 1/w, times w.
    pub(super) fn relative_depth(&self, ray: DVec3, w: f64) -> f64 {
        (self.kr * ray + self.kt * w).z
    }

    /// Inverse depths from beyond infinity to close by, at most a pixel apart.
    fn planes(&self, reference: &GrayView, source: &GrayView) -> Vec<f64> {
        const GRID: usize = 5;
        let mut rays = Vec::with_capacity(GRID * GRID);
        for gy in 0..GRID {
            for gx in 0..GRID {
                let at = |g: usize, n: usize| (n - 1) as f64 * g as f64 / (GRID - 1) as f64;
                rays.push(reference.ray(at(gx, reference.width), at(gy, reference.height)));
            }
        }
        let w_max = 1.0 / (NEAREST_BASELINES * self.baseline);
        let longest = w_max / 40.0;
        let shortest = w_max / PLANES_MAX as f64;
        let (width, height) = (source.width as f64, source.height as f64);
        let step_at = |w: f64| {
            let mut speed = 0.0_f64;
            for &ray in &rays {
                let p = self.kr * ray + self.kt * w;
                if p.z <= 1e-6 {
                    continue;
                }
                let (u, v) = (p.x / p.z, p.y / p.z);
                // Outside by less than half a picture still counts: windows between grid points.
                if u < -0.5 * width || v < -0.5 * height || u > 1.5 * width || v > 1.5 * height {
                    continue;
                }
                let du = (self.kt.x - u * self.kt.z) / p.z;
                let dv = (self.kt.y - v * self.kt.z) / p.z;
                speed = speed.max(du.hypot(dv));
            }
            if speed > 0.0 { (STEP_PX / speed).clamp(shortest, longest) } else { longest }
        };
        let first = step_at(0.0);
        let mut planes = Vec::new();
        let mut w = -BEYOND_PX / STEP_PX * first;
        while w < w_max && planes.len() < 2 * PLANES_MAX {
            planes.push(w);
            w += if w < 0.0 { first } else { step_at(w) };
        }
        planes
    }
}

/// A confident match of a candidate of the first photo.
#[derive(Clone, Copy, Debug)]
pub(super) struct Match {
    /// Index into the first view's candidates.
    pub(super) candidate: usize,
    /// Inverse depth in the first camera, 1 / world units; may be slightly negative.
    pub(super) w: f64,
    /// Change of inverse depth that moves the match by one pixel.
    pub(super) w_per_px: f64,
}

/// What one sweep of one direction found.
#[derive(Clone, Debug)]
pub(super) struct Sweep {
    /// Confident by score and distinctness, before the return check; sorted by candidate.
    pub(super) matches: Vec<Match>,
    /// Candidates that some plane brought inside the other photo.
    pub(super) inside: usize,
    /// Candidates whose best plane is the nearest one that was searched.
    pub(super) at_nearest: usize,
}

/// Compares `reference` with `source` over all planes.
pub(super) fn sweep(reference: &GrayView, source: &GrayView, relative: &Relative) -> Sweep {
    let planes = relative.planes(reference, source);
    let count = reference.candidates.len();
    let mut volume = vec![-1.0_f32; planes.len() * count];
    let mut warp = Warp::new(reference.width);
    for (&w, scores) in planes.iter().zip(volume.chunks_exact_mut(count.max(1))) {
        warp.plane(reference, source, relative, w, scores);
    }
    let mut best = vec![-1.0_f32; count];
    let mut best_plane = vec![0_u32; count];
    for (plane, scores) in volume.chunks_exact(count.max(1)).enumerate() {
        for ((best, at), &score) in best.iter_mut().zip(&mut best_plane).zip(scores) {
            if score > *best {
                *best = score;
                *at = plane as u32;
            }
        }
    }
    let mut rival = vec![-1.0_f32; count];
    for (plane, scores) in volume.chunks_exact(count.max(1)).enumerate() {
        for ((rival, &at), &score) in rival.iter_mut().zip(&best_plane).zip(scores) {
            if (at as usize).abs_diff(plane) > RIVAL_PLANES && score > *rival {
                *rival = score;
            }
        }
    }
    let mut matches = Vec::new();
    let mut at_nearest = 0;
    let inside = best.iter().filter(|&&score| score > -1.0).count();
    for candidate in 0..count {
        let (score, plane) = (best[candidate], best_plane[candidate] as usize);
        // A peak at the last plane is no peak.
        if score >= SCORE_MIN && plane + 1 == planes.len() {
            at_nearest += 1;
        }
        if score < SCORE_MIN || plane == 0 || plane + 1 >= planes.len() {
            continue;
        }
        if 1.0 - score > RIVAL_RATIO_MAX * (1.0 - rival[candidate]) {
            continue;
        }
        let before = volume[(plane - 1) * count + candidate];
        let after = volume[(plane + 1) * count + candidate];
        let bend = before - 2.0 * score + after;
        let shift = if before > -1.0 && after > -1.0 && bend < -1e-6 {
            f64::from(0.5 * (before - after) / bend).clamp(-0.5, 0.5)
        } else {
            0.0
        };
        let gap = if shift < 0.0 {
            planes[plane] - planes[plane - 1]
        } else {
            planes[plane + 1] - planes[plane]
        };
        let w = planes[plane] + shift * gap;
        let at = reference.candidates[candidate];
        let ray = reference.ray(f64::from(at.x), f64::from(at.y));
        let Some((u, v)) = relative.pixel(ray, w) else { continue };
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
        let (px, py) = (
            (u.max(0.0) as usize).min(source.width - 1),
            (v.max(0.0) as usize).min(source.height - 1),
        );
        if !source.is_valid(px, py) {
            continue;
        }
        let ahead = relative.pixel(ray, w + gap).unwrap_or((u, v));
        let moved = (ahead.0 - u).hypot(ahead.1 - v).max(1e-6);
        matches.push(Match { candidate, w, w_per_px: gap / moved });
    }
    Sweep { matches, inside, at_nearest }
}

/// Keeps the matches that lead back to where they came from.
pub(super) fn consistent(
    (reference, source): (&GrayView, &GrayView),
    (there, back): (&Relative, &Relative),
    forward: &Sweep,
    backward: &Sweep,
) -> Vec<Match> {
    let found = backward.matches.iter().map(|m| {
        let at = source.candidates[m.candidate];
        (at.x, at.y, m.w)
    });
    let grid = Grid::new(source, found);
    let leads_back = |m: &&Match| {
        let at = reference.candidates[m.candidate];
        let (x, y) = (f64::from(at.x), f64::from(at.y));
        let Some((u, v)) = there.pixel(reference.ray(x, y), m.w) else { return false };
        // The depth found at that cell, seen along the exact ray of the match.
        let returned = grid.at(u, v).and_then(|w| back.pixel(source.ray(u - 0.5, v - 0.5), w));
        returned.is_some_and(|(bu, bv)| (bu - x - 0.5).hypot(bv - y - 0.5) <= LEFT_RIGHT_PX)
    };
    forward.matches.iter().filter(leads_back).copied().collect()
}

/// Buffers of one sweep: the warped rows and the running column sums.
struct Warp {
    width: usize,
    rows: Vec<f32>,
    ranges: [(usize, usize); 2 * RADIUS + 1],
    sum: Vec<f32>,
    squares: Vec<f32>,
    products: Vec<f32>,
}

impl Warp {
    fn new(width: usize) -> Self {
        Self {
            width,
            rows: vec![0.0; width * (2 * RADIUS + 1)],
            ranges: [(0, 0); 2 * RADIUS + 1],
            sum: vec![0.0; width],
            squares: vec![0.0; width],
            products: vec![0.0; width],
        }
    }

    /// ZNCC of every candidate of `reference` under one plane; -1 where its window leaves `source`.
    fn plane(
        &mut self,
        reference: &GrayView,
        source: &GrayView,
        relative: &Relative,
        w: f64,
        scores: &mut [f32],
    ) {
        const SIDE: usize = 2 * RADIUS + 1;
        let width = self.width;
        self.sum.fill(0.0);
        self.squares.fill(0.0);
        self.products.fill(0.0);
        self.rows.fill(0.0);
        self.ranges = [(0, 0); SIDE];
        for y in 0..reference.height {
            let slot = y % SIDE;
            let row = &mut self.rows[slot * width..(slot + 1) * width];
            if y >= SIDE && self.ranges[slot].0 < self.ranges[slot].1 {
                let old = &reference.gray[(y - SIDE) * width..(y - SIDE + 1) * width];
                for x in 0..width {
                    self.sum[x] -= row[x];
                    self.squares[x] -= row[x] * row[x];
                    self.products[x] -= row[x] * old[x];
                }
            }
            let range = warp_row(reference, source, relative, w, y, row);
            self.ranges[slot] = range;
            if range.0 < range.1 {
                let new = &reference.gray[y * width..(y + 1) * width];
                for x in 0..width {
                    self.sum[x] += row[x];
                    self.squares[x] += row[x] * row[x];
                    self.products[x] += row[x] * new[x];
                }
            }
            if y < 2 * RADIUS || !(y - RADIUS).is_multiple_of(STRIDE) {
                continue;
            }
            let from = self.ranges.iter().map(|r| r.0).max().unwrap_or(0) + RADIUS;
            let to = self.ranges.iter().map(|r| r.1).min().unwrap_or(0);
            if from + RADIUS >= to {
                continue;
            }
            self.score_row(reference, (y - RADIUS) / STRIDE, from..to - RADIUS, scores);
        }
    }

    fn score_row(
        &self,
        reference: &GrayView,
        grid_row: usize,
        columns: std::ops::Range<usize>,
        scores: &mut [f32],
    ) {
        let n = ((2 * RADIUS + 1) * (2 * RADIUS + 1)) as f32;
        let row = reference.row_start[grid_row]..reference.row_start[grid_row + 1];
        for (c, score) in reference.candidates[row.clone()].iter().zip(&mut scores[row]) {
            let x = usize::from(c.x);
            if !columns.contains(&x) {
                continue;
            }
            let window = x - RADIUS..=x + RADIUS;
            let sum: f32 = self.sum[window.clone()].iter().sum();
            let squares: f32 = self.squares[window.clone()].iter().sum();
            let products: f32 = self.products[window].iter().sum();
            let energy = squares - sum * sum / n;
            // Under the texture floor of the candidates the score would be noise.
            let covariance = products - c.mean * sum;
            let norm = (c.energy * energy.max(0.25 * c.energy.min(0.01))).sqrt();
            *score = (covariance / norm).clamp(-0.999, 1.0);
        }
    }
}

/// Warps one row of `source` under the plane; returns the columns with a source, others are 0.
fn warp_row(
    reference: &GrayView,
    source: &GrayView,
    relative: &Relative,
    w: f64,
    y: usize,
    row: &mut [f32],
) -> (usize, usize) {
    let start = relative.kr * reference.ray(0.0, y as f64) + relative.kt * w;
    let step = relative.kr * (reference.ray(1.0, y as f64) - reference.ray(0.0, y as f64));
    // In front, and between the centres of the outermost pixels: five half-planes along the row.
    let (u_max, v_max) = (source.width as f64 - 0.5, source.height as f64 - 0.5);
    let mut span = (0.0_f64, row.len() as f64 - 1.0);
    for (constant, slope) in [
        (start.z - 1e-6, step.z),
        (start.x - 0.5 * start.z, step.x - 0.5 * step.z),
        (start.y - 0.5 * start.z, step.y - 0.5 * step.z),
        (u_max * start.z - start.x, u_max * step.z - step.x),
        (v_max * start.z - start.y, v_max * step.z - step.y),
    ] {
        if slope.abs() < 1e-12 {
            if constant < 0.0 {
                span.1 = -1.0;
            }
        } else if slope > 0.0 {
            span.0 = span.0.max(-constant / slope);
        } else {
            span.1 = span.1.min(-constant / slope);
        }
    }
    row.fill(0.0);
    if span.0 > span.1 {
        return (0, 0);
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..=width")]
    let (from, to) = (span.0.ceil() as usize, span.1.floor() as usize + 1);
    let (x_top, y_top) = ((source.width - 2) as f32, (source.height - 2) as f32);
    let stride = source.width;
    let start = [start.x as f32, start.y as f32, start.z as f32];
    let step = [step.x as f32, step.y as f32, step.z as f32];
    for (x, out) in row[from..to].iter_mut().enumerate() {
        let t = (from + x) as f32;
        let inverse = 1.0 / (start[2] + step[2] * t);
        let u = (start[0] + step[0] * t) * inverse - 0.5;
        let v = (start[1] + step[1] * t) * inverse - 0.5;
        let (u0, v0) = (u.max(0.0).min(x_top).floor(), v.max(0.0).min(y_top).floor());
        let (a, b) = ((u - u0).clamp(0.0, 1.0), (v - v0).clamp(0.0, 1.0));
        let i = v0 as usize * stride + u0 as usize;
        let quad = [
            source.gray[i],
            source.gray[i + 1],
            source.gray[i + stride],
            source.gray[i + stride + 1],
        ];
        let upper = quad[0] + a * (quad[1] - quad[0]);
        let lower = quad[2] + a * (quad[3] - quad[2]);
        *out = upper + b * (lower - upper);
    }
    (from, to)
}
