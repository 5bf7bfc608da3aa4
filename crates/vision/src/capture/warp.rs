//! The inner loops of a plane sweep, compiled for the widest vectors of the processor.
//!
//! Each number is computed by the same operations in the same order whatever the width, and
//! nothing is fused, so that every processor finds the same matches. The straightforward form is
//! in the tests, which hold the loops to it bit by bit.

use std::ops::Range;

use glam::DVec3;

use super::{
    gray::{GrayView, RADIUS, STRIDE},
    relative::Relative,
};
use crate::vectorised;

/// Side of the matching window.
const SIDE: usize = 2 * RADIUS + 1;
/// Pixels of the matching window.
const N: f32 = (SIDE * SIDE) as f32;
/// Added to a whole number under 2^23, it leaves the number in the lowest bits.
const WHOLE: f32 = 8_388_608.0;
const WHOLE_BITS: u32 = (1 << 23) - 1;

/// Numbers that the loops take together; rows are padded to a multiple.
const LANES: usize = 16;
type Lane = [f32; LANES];

/// What the planes of one sweep share.
pub(super) struct Warp<'a> {
    reference: &'a GrayView,
    source: &'a GrayView,
    relative: &'a Relative,
    /// Lanes of a row of the reference.
    width: usize,
    /// `[height]` where the first pixel of each row falls at infinity, homogeneous, and the step to
    /// the next pixel.
    rows: Vec<(DVec3, DVec3)>,
    /// `[height, width]` of the reference.
    gray: Vec<Lane>,
    /// `[rows of the grid, width]` mean and energy of the window around each candidate, else 0.
    means: Vec<Lane>,
    energies: Vec<Lane>,
    /// `[height - 1, width]` of the source: a pixel and the step to its right neighbour, the same
    /// of the pixel below.
    corners: Vec<[f32; 4]>,
}

/// Buffers of one thread, each a row of the reference.
pub(super) struct Lines {
    /// 0, 1, 2 ...
    columns: Vec<Lane>,
    /// The warped rows under the window, and which columns of each have a source; others are 0.
    rows: [Vec<Lane>; SIDE],
    ranges: [Range<usize>; SIDE],
    /// Sums over these rows: of the warped grey, of its square, and times the reference's.
    sums: Vec<[Lane; 3]>,
    /// Scores of a row of the grid.
    scores: Vec<Lane>,
}

impl Lines {
    pub(super) fn new(width: usize) -> Self {
        let lanes = width.div_ceil(LANES);
        let column = |i: usize| std::array::from_fn(|k| (i * LANES + k) as f32);
        Self {
            columns: (0..lanes).map(column).collect(),
            rows: std::array::from_fn(|_| vec![[0.0; LANES]; lanes]),
            ranges: std::array::from_fn(|_| 0..0),
            // One more, for windows that look to the right.
            sums: vec![[[0.0; LANES]; 3]; lanes + 1],
            scores: vec![[0.0; LANES]; lanes],
        }
    }
}

/// The lanes that hold these columns.
fn lanes_of(columns: &Range<usize>) -> Range<usize> {
    columns.start / LANES..columns.end.div_ceil(LANES)
}

impl<'a> Warp<'a> {
    /// `None` where the source has no two pixels each way.
    pub(super) fn new(
        reference: &'a GrayView,
        source: &'a GrayView,
        relative: &'a Relative,
    ) -> Option<Self> {
        if source.width < 2 || source.height < 2 {
            return None;
        }
        let width = reference.width.div_ceil(LANES);
        let row = |y: usize| {
            let first = reference.ray(0.0, y as f64);
            let step = relative.kr * (reference.ray(1.0, y as f64) - first);
            (relative.kr * first, step)
        };
        let mut gray = vec![[0.0; LANES]; width * reference.height];
        let lines = reference.gray.chunks_exact(reference.width);
        for (padded, line) in gray.chunks_exact_mut(width).zip(lines) {
            padded.as_flattened_mut()[..line.len()].copy_from_slice(line);
        }
        let mut means = vec![[0.0; LANES]; width * reference.row_start.len()];
        let mut energies = means.clone();
        for c in &reference.candidates {
            let row = usize::from(c.y) / STRIDE * width * LANES;
            means.as_flattened_mut()[row + usize::from(c.x)] = c.mean;
            energies.as_flattened_mut()[row + usize::from(c.x)] = c.energy;
        }
        let pairs = source.gray.iter().zip(&source.gray[1..]);
        let corners = pairs.clone().zip(pairs.skip(source.width));
        let corner = |((a, b), (c, d)): ((&f32, &f32), (&f32, &f32))| [*a, b - a, *c, d - c];
        Some(Self {
            reference,
            source,
            relative,
            width,
            rows: (0..reference.height).map(row).collect(),
            gray,
            means,
            energies,
            corners: corners.map(corner).collect(),
        })
    }

    /// ZNCC of every candidate of the reference under the plane at inverse depth `w`. Scores of
    /// candidates whose window leaves the source are left as they are.
    pub(super) fn plane(&self, w: f64, lines: &mut Lines, scores: &mut [f32]) {
        vectorised(
            #[inline(always)]
            || self.plane_lanes(w, lines, scores),
        );
    }

    #[inline(always)]
    fn plane_lanes(&self, w: f64, lines: &mut Lines, scores: &mut [f32]) {
        let shift = self.relative.kt * w;
        lines.sums.fill([[0.0; LANES]; 3]);
        lines.ranges = std::array::from_fn(|_| 0..0);
        for y in 0..self.reference.height {
            let slot = y % SIDE;
            if y >= SIDE {
                self.add::<false>(y - SIDE, lines);
            }
            let range = self.span(shift, y);
            self.warp_row(shift, y, range.clone(), lines);
            lines.ranges[slot] = range;
            self.add::<true>(y, lines);
            if y < 2 * RADIUS || !(y - RADIUS).is_multiple_of(STRIDE) {
                continue;
            }
            let from = lines.ranges.iter().map(|r| r.start).max().unwrap_or(0);
            let to = lines.ranges.iter().map(|r| r.end).min().unwrap_or(0);
            if from + 2 * RADIUS < to {
                self.score_row((y - RADIUS) / STRIDE, from..to, lines, scores);
            }
        }
    }

    /// The columns of row `y` that have a source under the plane that adds `shift`.
    fn span(&self, shift: DVec3, y: usize) -> Range<usize> {
        let (start, step) = (self.rows[y].0 + shift, self.rows[y].1);
        // In front, and between the centres of the outermost pixels: five half-planes along the
        // row.
        let (u_max, v_max) = (self.source.width as f64 - 0.5, self.source.height as f64 - 0.5);
        let mut span = (0.0_f64, self.reference.width as f64 - 1.0);
        for (constant, slope) in [
            (start.z - 1e-6, step.z),
            (start.x - 0.5 * start.z, step.x - 0.5 * step.z),
            (start.y - 0.5 * start.z, step.y - 0.5 * step.z),
            (u_max * start.z - start.x, u_max * step.z - step.x),
            (v_max * start.z - start.y, v_max * step.z - step.y),
        ] {
            if slope.abs() < 1e-12 {
                if constant < 0.0 {
                    return 0..0;
                }
            } else if slope > 0.0 {
                span.0 = span.0.max(-constant / slope);
            } else {
                span.1 = span.1.min(-constant / slope);
            }
        }
        if span.0 > span.1 {
            return 0..0;
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..=width")]
        let (from, to) = (span.0.ceil() as usize, span.1.floor() as usize + 1);
        from..to
    }

    /// Warps the columns of a row of the source under the plane.
    #[inline(always)]
    fn warp_row(&self, shift: DVec3, y: usize, range: Range<usize>, lines: &mut Lines) {
        let (start, step) = ((self.rows[y].0 + shift).as_vec3(), self.rows[y].1.as_vec3());
        let stride = self.source.width as f32;
        let (x_top, y_top) = ((self.source.width - 2) as f32, (self.source.height - 2) as f32);
        let (from, to) = (range.start as f32, range.end as f32);
        let corners = &self.corners[..];
        let lanes = lanes_of(&range);
        let out = &mut lines.rows[y % SIDE][lanes.clone()];
        for (out, columns) in out.iter_mut().zip(&lines.columns[lanes]) {
            let (mut right, mut down, mut at) = ([0.0; LANES], [0.0; LANES], [0_u32; LANES]);
            for k in 0..LANES {
                let t = columns[k];
                let inverse = 1.0 / (start.z + step.z * t);
                let u = (start.x + step.x * t) * inverse - 0.5;
                let v = (start.y + step.y * t) * inverse - 0.5;
                let (u0, v0) = (within(u, x_top).floor(), within(v, y_top).floor());
                right[k] = (u - u0).clamp(0.0, 1.0);
                down[k] = (v - v0).clamp(0.0, 1.0);
                at[k] = (v0 * stride + u0 + WHOLE).to_bits() & WHOLE_BITS;
            }
            let mut quads = [[0.0; 4]; LANES];
            for k in 0..LANES {
                quads[k] = corners[at[k] as usize];
            }
            for k in 0..LANES {
                let upper = quads[k][0] + right[k] * quads[k][1];
                let lower = quads[k][2] + right[k] * quads[k][3];
                let value = upper + down[k] * (lower - upper);
                let inside = (columns[k] >= from) & (columns[k] < to);
                out[k] = if inside { value } else { 0.0 };
            }
        }
    }

    /// Adds the warped row `y` to the sums, or takes it off.
    #[inline(always)]
    fn add<const ON: bool>(&self, y: usize, lines: &mut Lines) {
        let lanes = lanes_of(&lines.ranges[y % SIDE]);
        let row = &lines.rows[y % SIDE][lanes.clone()];
        let gray = &self.gray[y * self.width..][lanes.clone()];
        for ((sums, row), gray) in lines.sums[lanes].iter_mut().zip(row).zip(gray) {
            for k in 0..LANES {
                let v = row[k];
                let terms = [v, v * v, v * gray[k]];
                for (sums, term) in sums.iter_mut().zip(terms) {
                    sums[k] = if ON { sums[k] + term } else { sums[k] - term };
                }
            }
        }
    }

    /// Scores the candidates of a row of the grid whose windows lie within `columns`.
    #[inline(always)]
    fn score_row(
        &self,
        grid_row: usize,
        columns: Range<usize>,
        lines: &mut Lines,
        scores: &mut [f32],
    ) {
        let (first, last) = (columns.start + RADIUS, columns.end - RADIUS);
        let starts = &self.reference.row_start;
        let row = starts[grid_row]..starts[grid_row + 1];
        let candidates = &self.reference.candidates[row.clone()];
        let place = |x: usize| candidates.partition_point(|c| usize::from(c.x) < x);
        let chosen = place(first)..place(last);
        if chosen.is_empty() {
            return;
        }
        // Each lane's window begins RADIUS columns before it.
        let lanes = lanes_of(&(first - RADIUS..last - RADIUS));
        for lane in lanes {
            let near = &lines.sums[lane..lane + 2];
            let [sums, squares, products]: [Lane; 3] =
                std::array::from_fn(|of| windows(&near[0][of], &near[1][of]));
            let known = grid_row * self.width * LANES + lane * LANES + RADIUS;
            let means = &self.means.as_flattened()[known..known + LANES];
            let energies = &self.energies.as_flattened()[known..known + LANES];
            let scores = &mut lines.scores[lane];
            for k in 0..LANES {
                let own = squares[k] - sums[k] * sums[k] / N;
                // Under the texture floor of the candidates the score would be noise.
                let floor = 0.25 * if energies[k] < 0.01 { energies[k] } else { 0.01 };
                let covariance = products[k] - means[k] * sums[k];
                let norm = (energies[k] * if own > floor { own } else { floor }).sqrt();
                scores[k] = (covariance / norm).clamp(-0.999, 1.0);
            }
        }
        let found = lines.scores.as_flattened();
        let out = &mut scores[row][chosen.clone()];
        for (score, c) in out.iter_mut().zip(&candidates[chosen]) {
            *score = found[usize::from(c.x) - RADIUS];
        }
    }
}

/// `v` within 0 and `top`.
#[inline(always)]
fn within(v: f32, top: f32) -> f32 {
    let v = if v > 0.0 { v } else { 0.0 };
    if v < top { v } else { top }
}

/// Sums of [`SIDE`] neighbours, each lane the first of its own; `next` follows the lanes.
#[inline(always)]
fn windows(lanes: &Lane, next: &Lane) -> Lane {
    let mut near = [0.0; 2 * LANES];
    near[..LANES].copy_from_slice(lanes);
    near[LANES..].copy_from_slice(next);
    let mut sums = *lanes;
    for shift in 1..SIDE {
        for k in 0..LANES {
            sums[k] += near[k + shift];
        }
    }
    sums
}

/// The best score of each candidate and its plane, of `[planes, candidates]` scores.
pub(super) fn find_best(volume: &[f32], count: usize) -> (Vec<f32>, Vec<u32>) {
    let (mut best, mut at) = (vec![-1.0_f32; count], vec![0_u32; count]);
    vectorised(
        #[inline(always)]
        || {
            for (plane, scores) in (0_u32..).zip(volume.chunks_exact(count.max(1))) {
                for ((best, at), score) in best.iter_mut().zip(&mut at).zip(scores) {
                    let better = score > best;
                    *best = if better { *score } else { *best };
                    *at = if better { plane } else { *at };
                }
            }
        },
    );
    (best, at)
}

/// The best score of each candidate more than `apart` planes away from its best plane.
pub(super) fn find_rivals(volume: &[f32], best_plane: &[u32], apart: u32) -> Vec<f32> {
    let mut rival = vec![-1.0_f32; best_plane.len()];
    vectorised(
        #[inline(always)]
        || {
            let planes = volume.chunks_exact(best_plane.len().max(1));
            for (plane, scores) in (0_u32..).zip(planes) {
                for ((rival, at), score) in rival.iter_mut().zip(best_plane).zip(scores) {
                    // Unsigned: what lies before wraps round to far away.
                    let near = plane.wrapping_sub(*at).wrapping_add(apart) <= 2 * apart;
                    let better = !near & (score > rival);
                    *rival = if better { *score } else { *rival };
                }
            }
        },
    );
    rival
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;
    use crate::scene::{Camera, CameraToWorld, Intrinsics, Photo, PosedPhoto};

    /// Numbers from 0 to 1, the same every time.
    struct Draw(u64);

    impl Draw {
        fn next(&mut self) -> f64 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (self.0 >> 40) as f64 / (1_u64 << 24) as f64
        }

        fn between(&mut self, from: f64, to: f64) -> f64 {
            from + (to - from) * self.next()
        }
    }

    /// A photo of smooth noise, partly flat, partly without source, from somewhere.
    fn view(draw: &mut Draw) -> GrayView {
        let (width, height) = (draw.between(20.0, 90.0) as u32, draw.between(20.0, 90.0) as u32);
        let (fine, flat) = (draw.between(0.2, 1.5), draw.between(0.0, 0.4) * f64::from(width));
        let mut rgb = Vec::new();
        for y in 0..height {
            for x in 0..width {
                let wave = (f64::from(x) * fine).sin() * (f64::from(y) * fine * 0.7).cos();
                let noise = draw.between(0.0, 0.15);
                let v = if f64::from(x) < flat { 0.5 } else { 0.5 + 0.3 * wave + noise };
                let v = (255.0 * v) as u8;
                rgb.extend([v, v, v / 2]);
            }
        }
        let valid =
            (draw.next() < 0.5).then(|| (0..width * height).map(|_| draw.next() > 0.001).collect());
        let focal = draw.between(0.6, 1.6) * f64::from(width);
        let intrinsics = Intrinsics {
            fx: focal,
            fy: focal * draw.between(0.9, 1.1),
            cx: draw.between(0.3, 0.7) * f64::from(width),
            cy: draw.between(0.3, 0.7) * f64::from(height),
            width,
            height,
        };
        let turn = DQuat::from_scaled_axis(
            DVec3::new(draw.next() - 0.5, draw.next() - 0.5, draw.next() - 0.5) * 0.7,
        );
        let at = DVec3::new(draw.next(), draw.next(), 0.3 * draw.next());
        let [x, y, z] = glam::DMat3::from_quat(turn).transpose().to_cols_array_2d();
        let row = |r: [f64; 3], t: f64| [r[0], r[1], r[2], t];
        let pose = [row(x, at.x), row(y, at.y), row(z, at.z), [0.0, 0.0, 0.0, 1.0]].concat();
        let pose: [f64; 16] = pose.try_into().unwrap();
        GrayView::new(&PosedPhoto {
            file: String::new(),
            photo: Photo { width, height, rgb, valid },
            camera: Camera {
                intrinsics,
                camera_to_world: CameraToWorld::from_row_major(&pose, "a view").unwrap(),
            },
            intrinsics_made_for: None,
        })
    }

    /// One pixel of `source` under the plane, as the definition says; `None` without a source.
    fn warped(warp: &Warp<'_>, w: f64, x: usize, y: usize) -> Option<f32> {
        let (source, range) = (warp.source, warp.span(warp.relative.kt * w, y));
        if !range.contains(&x) {
            return None;
        }
        let (start, step) = (warp.rows[y].0 + warp.relative.kt * w, warp.rows[y].1);
        let along = |start: f64, step: f64| start as f32 + step as f32 * x as f32;
        let inverse = 1.0 / along(start.z, step.z);
        let u = along(start.x, step.x) * inverse - 0.5;
        let v = along(start.y, step.y) * inverse - 0.5;
        let u0 = u.max(0.0).min((source.width - 2) as f32).floor();
        let v0 = v.max(0.0).min((source.height - 2) as f32).floor();
        let (a, b) = ((u - u0).clamp(0.0, 1.0), (v - v0).clamp(0.0, 1.0));
        let gray = |dx: usize, dy: usize| {
            source.gray[(v0 as usize + dy) * source.width + u0 as usize + dx]
        };
        let upper = gray(0, 0) + a * (gray(1, 0) - gray(0, 0));
        let lower = gray(0, 1) + a * (gray(1, 1) - gray(0, 1));
        Some(upper + b * (lower - upper))
    }

    /// ZNCC of every candidate under a plane: sums down each column, then over seven columns. The
    /// sums of a column are those of the rows so far, less the rows that left the window.
    fn slow(warp: &Warp<'_>, w: f64) -> Vec<f32> {
        let (reference, width) = (warp.reference, warp.reference.width);
        let mut scores = vec![-1.0; reference.candidates.len()];
        let mut sums = vec![[0.0_f32; 3]; width];
        let terms = |x: usize, y: usize| {
            let v = warped(warp, w, x, y).unwrap_or(0.0);
            [v, v * v, v * reference.gray[y * width + x]]
        };
        for y in 0..reference.height {
            for (x, sums) in sums.iter_mut().enumerate() {
                if y >= SIDE {
                    sums.iter_mut().zip(terms(x, y - SIDE)).for_each(|(s, v)| *s -= v);
                }
                sums.iter_mut().zip(terms(x, y)).for_each(|(s, v)| *s += v);
            }
            for (c, score) in reference.candidates.iter().zip(&mut scores) {
                let (cx, cy) = (usize::from(c.x), usize::from(c.y));
                let mut window = (0..SIDE * SIDE).map(|k| (cx + k % SIDE, cy + k / SIDE));
                let inside = |(x, y): (usize, usize)| {
                    warp.span(warp.relative.kt * w, y - RADIUS).contains(&(x - RADIUS))
                };
                if cy + RADIUS != y || !window.all(inside) {
                    continue;
                }
                let sum = |k: usize| -> f32 {
                    sums[cx - RADIUS..=cx + RADIUS].iter().map(|sums| sums[k]).sum()
                };
                let energy = sum(1) - sum(0) * sum(0) / N;
                let norm = (c.energy * energy.max(0.25 * c.energy.min(0.01))).sqrt();
                *score = ((sum(2) - c.mean * sum(0)) / norm).clamp(-0.999, 1.0);
            }
        }
        scores
    }

    #[test]
    fn the_loops_find_what_the_definition_finds_to_the_last_bit() {
        let mut draw = Draw(7);
        let (mut seen, mut all) = (0, 0);
        for pair in 0..24 {
            let (a, b) = (view(&mut draw), view(&mut draw));
            let relative = Relative::new(&a, &b);
            let warp = Warp::new(&a, &b, &relative).unwrap();
            let mut lines = Lines::new(a.width);
            let planes = relative.planes(&a, &b);
            for &w in planes.iter().step_by(1 + planes.len() / 12) {
                let mut fast = vec![-1.0; a.candidates.len()];
                warp.plane(w, &mut lines, &mut fast);
                let slow = slow(&warp, w);
                let bits = |scores: &[f32]| scores.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
                assert_eq!(bits(&fast), bits(&slow), "pair {pair}, plane {w}");
                seen += fast.iter().filter(|v| **v > -1.0).count();
                all += fast.len();
            }
        }
        assert!(seen > all / 20, "{seen} of {all} candidates have a score");
    }

    #[test]
    fn the_best_plane_is_the_first_of_the_best_and_its_rivals_are_apart() {
        // Two candidates, six planes.
        let volume = [0.1, 0.2, 0.9, 0.3, 0.8, 0.3, 0.5, 0.1, 0.9, 0.0, 0.7, 0.25_f32];
        let (best, at) = find_best(&volume, 2);
        assert_eq!((&best[..], &at[..]), (&[0.9, 0.3][..], &[1, 1][..]));
        assert_eq!(find_rivals(&volume, &at, 1), [0.9, 0.25]);
        assert_eq!(find_rivals(&volume, &at, 3), [0.7, 0.25]);
        assert_eq!(find_rivals(&volume, &at, 4), [-1.0, -1.0]);
    }
}
