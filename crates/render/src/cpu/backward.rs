//! The backward pass of the CPU renderer: see [`crate::backward`] for what it computes. Its twins
//! are `shaders/rasterize_backward.wgsl`, `shaders/project_backward.wgsl` and
//! `shaders/shade_backward.wgsl`.
//!
//! 1. The frame is drawn; its footprints and bins stay.
//! 2. Each tile goes through its Gaussians front to back once more, with the statements of the
//!    blend, so that the same ones count. What all Gaussians behind one are worth is the worth of
//!    the pixel, which the frame tells, less what came before. Each Gaussian of the tile gets ten
//!    sums over its pixels. With `p = u² + v²` for the power, the sums are those of `dL/dp` times
//!    1, u, v, u², uv and v²: they stay exact for the longest needles.
//! 3. Each chunk of Gaussians adds up the sums of its pairs, in the order of the tiles, and goes
//!    back through the projection in f64.
//!
//! No number is shared by two tasks, and no sum depends on the number of threads.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::{
    bin::{self, Bins, chunk_of},
    cell::{CELL_X, CELL_Y, CELLS, PIXEL_X, PIXEL_Y, PIXELS, Staged, Tile, place},
    footprint::Footprint,
    lanes::{KernelOptions, LaneKernel, Lanes, Numbers, exp2_neg},
    paint::Paint,
    pool::Pool,
    project::Projected,
    rasterize::{Rest, SQRT_LOG2_E, along_axes, met, stage},
    shade,
    tiles::Grid,
};
use crate::{
    Frame, RenderRequest,
    backward::{FrameGradients, Gradients, basis_slopes},
    constants::{
        ALPHA_MAX, ALPHA_MIN, BATCH_SIZE, BLUR_PX2, OWN_SIZE, PIXEL_PX2, TILE_SIZE,
        TRANSMITTANCE_MIN,
    },
    scene::Gaussians,
    view::View,
};

/// Sums of a Gaussian over pixels: of dL/dpower times 1, u, v, u², uv, v²; of the weight times
/// dL/dcolour; of the weight times dL/d(sum of depths).
const SUMS: usize = 10;
type Sums = [f32; SUMS];

/// Scratch of one worker. Its contents are undefined between tiles.
#[derive(Debug, Default)]
pub(super) struct BackwardScratch {
    pairs: Vec<u64>,
    staged: Vec<Staged>,
    cells: Vec<Seeds>,
}

/// What a cell's pixels say, one row for each number.
#[derive(Clone, Copy, Debug)]
struct Seeds {
    /// Transmittance while the ray goes on, 0 after it has ended.
    transmittance: Numbers,
    /// What the Gaussians from here on are worth.
    rest: Numbers,
    /// dL/dcolour.
    color: [Numbers; 3],
    /// dL/d(sum of depths): dL/ddepth over alpha.
    depth: Numbers,
    /// The worth of a weight without colour and depth of its own.
    base: Numbers,
}

impl Seeds {
    const NONE: Self = Self {
        transmittance: Numbers::ZERO,
        rest: Numbers::ZERO,
        color: [Numbers::ZERO; 3],
        depth: Numbers::ZERO,
        base: Numbers::ZERO,
    };
}

/// What a tile says of its Gaussians.
#[derive(Debug, Default)]
struct TileSums {
    /// Where the pairs of each chunk start.
    starts: Vec<u32>,
    /// Of each pair, in the order of the scene.
    sums: Vec<Sums>,
}

/// A frame, what lies behind it, and what the loss says of it.
#[derive(Clone, Copy)]
pub(super) struct Pictures<'a> {
    pub(super) frame: &'a Frame,
    pub(super) behind: &'a Frame,
    pub(super) by: &'a FrameGradients,
}

impl Pictures<'_> {
    /// What pixel `at` of the picture says: rest, dL/dcolour, dL/d(sum of depths), base.
    fn seed(&self, at: usize) -> [f32; 6] {
        let number = |of: &Option<Vec<f32>>| of.as_ref().map_or(0.0, |of| f64::from(of[at]));
        let color = |of: &Option<Vec<[f32; 3]>>| of.as_ref().map_or([0.0; 3], |of| of[at]);
        let by_color = color(&self.by.color);
        let (shown, behind) = (color(&self.frame.color), color(&self.behind.color));
        let dot = |of: [f32; 3]| -> f64 {
            by_color.iter().zip(of).map(|(&g, v)| f64::from(g) * f64::from(v)).sum()
        };
        let alpha = number(&self.frame.alpha);
        let by_alpha = number(&self.by.alpha);
        let by_depth = if alpha > 0.0 { number(&self.by.depth) / alpha } else { 0.0 };
        let rest = dot(shown) - dot(behind) + by_alpha * alpha;
        let base = by_alpha - dot(behind) - by_depth * number(&self.frame.depth);
        let [r, g, b] = by_color;
        [rest as f32, r, g, b, by_depth as f32, base as f32]
    }
}

/// One backward pass.
pub(super) struct Pass<'a> {
    pub(super) options: KernelOptions,
    pub(super) scratches: &'a Pool<BackwardScratch>,
    pub(super) gaussians: &'a Gaussians,
    pub(super) request: &'a RenderRequest,
    pub(super) view: &'a View,
    pub(super) grid: Grid,
    pub(super) projected: &'a Projected,
    pub(super) bins: &'a [Bins],
    pub(super) pictures: Pictures<'a>,
}

impl Pass<'_> {
    /// Writes what the pictures say of each Gaussian into `gradients`.
    pub(super) fn run(&self, gradients: &mut Gradients) {
        self.gather(&self.tiles(), gradients);
    }

    /// What each tile says.
    fn tiles(&self) -> Vec<TileSums> {
        let paint = Paint::new(self.request, self.view, &[], 0.0, self.options);
        let tiles_x = self.grid.tiles_x();
        let of_tile = |tile: u32| {
            let mut out = TileSums::default();
            let mut scratch = self.scratches.take();
            scratch.pairs.clear();
            for bins in self.bins {
                out.starts.push(scratch.pairs.len() as u32);
                scratch.pairs.extend(bins.of(tile as usize));
            }
            out.sums.resize(scratch.pairs.len(), [0.0; SUMS]);
            if !scratch.pairs.is_empty() {
                let (x, y) = (tile % tiles_x * TILE_SIZE, tile / tiles_x * TILE_SIZE);
                let place = Tile {
                    x,
                    y,
                    width: TILE_SIZE.min(self.grid.width - x),
                    height: TILE_SIZE.min(self.grid.height - y),
                };
                let ids: Vec<u32> = scratch.pairs.iter().map(|&pair| bin::value(pair)).collect();
                // Pairs come in the order of the scene: places sort like numbers do.
                for (at, pair) in scratch.pairs.iter_mut().enumerate() {
                    *pair = *pair >> 32 << 32 | at as u64;
                }
                let (footprints, scratch) = (&self.projected.footprints[..], &mut scratch);
                let (pictures, ids, sums) = (self.pictures, &ids[..], &mut out.sums[..]);
                self.options.width.run(TileBackward {
                    footprints,
                    ids,
                    tile: place,
                    paint: &paint,
                    pictures,
                    scratch,
                    sums,
                });
            }
            self.scratches.give(scratch);
            out
        };
        (0..self.grid.tile_count()).into_par_iter().with_max_len(1).map(of_tile).collect()
    }

    /// Adds up what the tiles say of each Gaussian and goes back through the projection.
    fn gather(&self, tiles: &[TileSums], gradients: &mut Gradients) {
        let chunk = chunk_of(self.gaussians.len(), &self.grid);
        let k = self.gaussians.sh_count();
        let Gradients { means, quats, scales, opacities, sh, seen } = gradients;
        let out = means.par_chunks_mut(chunk).zip(quats.par_chunks_mut(chunk));
        let out = out.zip(scales.par_chunks_mut(chunk)).zip(opacities.par_chunks_mut(chunk));
        let out = out.zip(sh.par_chunks_mut(chunk * k)).zip(seen.par_chunks_mut(chunk));
        let out = out.with_max_len(1).enumerate();
        out.for_each(|(at, (((((means, quats), scales), opacities), sh), seen))| {
            let first = at * chunk;
            let mut sums = vec![[0.0; SUMS]; means.len()];
            for (tile, found) in tiles.iter().enumerate() {
                let start = found.starts[at] as usize;
                let pairs = self.bins[at].of(tile);
                for (&pair, more) in pairs.iter().zip(&found.sums[start..]) {
                    let sum: &mut Sums = &mut sums[bin::value(pair) as usize - first];
                    sum.iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
                }
            }
            for (i, sums) in sums.iter().enumerate() {
                seen[i] = self.projected.tiles_per_gauss[first + i] > 0;
                if *sums == [0.0; SUMS] {
                    continue;
                }
                let back = self.back(first + i, sums);
                means[i] = back.mean.map(narrowed);
                quats[i] = back.quat.map(narrowed);
                scales[i] = back.scales.map(narrowed);
                opacities[i] = narrowed(back.opacity);
                let by_sh = &mut sh[i * k..(i + 1) * k];
                for (channel, weights) in by_sh.iter_mut().zip(back.basis) {
                    *channel = back.color.map(|by| narrowed(by * weights));
                }
            }
        });
    }
}

/// An f32 that is finite: what f64 holds and f32 does not says nothing.
fn narrowed(value: f64) -> f32 {
    let narrow = value as f32;
    if narrow.is_finite() { narrow } else { 0.0 }
}

/// A tile and its Gaussians.
struct TileBackward<'a> {
    footprints: &'a [Footprint],
    /// Gaussian of each pair, in the order of the scene.
    ids: &'a [u32],
    tile: Tile,
    paint: &'a Paint<'a>,
    pictures: Pictures<'a>,
    scratch: &'a mut BackwardScratch,
    sums: &'a mut [Sums],
}

impl LaneKernel for TileBackward<'_> {
    #[inline(always)]
    fn run<S: Lanes>(self, simd: S) {
        if self.pictures.by.depth.is_some() {
            self.back::<S, true>(simd);
        } else {
            self.back::<S, false>(simd);
        }
    }
}

impl TileBackward<'_> {
    #[inline(always)]
    fn back<S: Lanes, const DEPTH: bool>(self, simd: S) {
        let Self { footprints, ids, tile, paint, pictures, scratch, sums } = self;
        let BackwardScratch { pairs, staged, cells } = scratch;
        let mut open = seed(cells, tile, pictures);
        let mut rest = Rest::new(pairs);
        let mut sorted: &[u64] = &[];
        while open != 0 {
            if sorted.is_empty() {
                sorted = rest.nearest();
            }
            let batch = &sorted[..BATCH_SIZE.min(sorted.len())];
            sorted = &sorted[batch.len()..];
            if batch.is_empty() {
                break;
            }
            staged.clear();
            staged.extend(batch.iter().map(|&pair| {
                let id = ids[bin::value(pair) as usize] as usize;
                let footprint = footprints[id];
                let mut staged = Staged::default();
                stage(&footprint, tile, &mut staged);
                paint.put_channels(&footprint, id, &mut staged.channels);
                staged
            }));
            for (gaussian, &pair) in staged.iter().zip(batch) {
                let met = u32::from(met(simd, gaussian)) & open;
                if met != 0 {
                    let sum = &mut sums[bin::value(pair) as usize];
                    open = gaussian_back::<S, DEPTH>(simd, gaussian, cells, met, open, sum);
                }
            }
        }
    }
}

/// Fills the cells. Returns one bit for each cell with pixels inside the picture.
fn seed(cells: &mut Vec<Seeds>, tile: Tile, pictures: Pictures<'_>) -> u32 {
    cells.clear();
    cells.resize(CELLS, Seeds::NONE);
    let width = pictures.frame.width as usize;
    let mut open = 0;
    for (at, cell) in cells.iter_mut().enumerate() {
        for pixel in 0..PIXELS {
            let (x, y) = place(at, pixel);
            if x >= tile.width as usize || y >= tile.height as usize {
                continue;
            }
            let of_pixel = (tile.y as usize + y) * width + tile.x as usize + x;
            let [rest, r, g, b, depth, base] = pictures.seed(of_pixel);
            cell.transmittance.0[pixel] = 1.0;
            cell.rest.0[pixel] = rest;
            cell.depth.0[pixel] = depth;
            cell.base.0[pixel] = base;
            for (row, value) in cell.color.iter_mut().zip([r, g, b]) {
                row.0[pixel] = value;
            }
            open |= 1 << at;
        }
    }
    open
}

/// Takes one Gaussian through the cells that it may touch. Returns the cells whose rays go on.
#[inline(always)]
fn gaussian_back<S: Lanes, const DEPTH: bool>(
    simd: S,
    gaussian: &Staged,
    cells: &mut [Seeds],
    mut met: u32,
    mut open: u32,
    out: &mut Sums,
) -> u32 {
    let zero = simd.splat_f32s(0.0);
    let one = simd.splat_f32s(1.0);
    let end = simd.splat_f32s(TRANSMITTANCE_MIN);
    let mut sums = [zero; SUMS];
    while met != 0 {
        let at = met.trailing_zeros() as usize;
        met &= met - 1;
        let cell = &mut cells[at];
        let mut goes_on = false;
        for i in 0..PIXELS / S::F32_LANES {
            let x = simd.add_f32s(PIXEL_X.at(simd, i), simd.splat_f32s(CELL_X.0[at]));
            let y = simd.add_f32s(PIXEL_Y.at(simd, i), simd.splat_f32s(CELL_Y.0[at]));
            // The statements of the blend.
            let (u, v) = along_axes(simd, gaussian, x, y);
            let power = simd.fused(u, u, simd.mul_f32s(v, v));
            let full = simd.mul_f32s(exp2_neg(simd, power), simd.splat_f32s(gaussian.opacity));
            let alpha = simd.min_f32s(full, simd.splat_f32s(ALPHA_MAX));
            let counts = simd.less_than_or_equal_f32s(simd.splat_f32s(ALPHA_MIN), alpha);
            let transmittance = cell.transmittance.at(simd, i);
            if simd.bits(counts) == 0 {
                goes_on |= simd.bits(simd.greater_than_f32s(transmittance, zero)) != 0;
                continue;
            }
            let alpha = simd.select_f32s(counts, alpha, zero);
            let passes = simd.sub_f32s(one, alpha);
            let next = simd.mul_f32s(transmittance, passes);
            let lives = simd.greater_than_f32s(next, end);
            let weight = simd.select_f32s(lives, simd.mul_f32s(alpha, transmittance), zero);
            let by_color =
                [cell.color[0].at(simd, i), cell.color[1].at(simd, i), cell.color[2].at(simd, i)];
            let by_depth = cell.depth.at(simd, i);
            let mut worth = cell.base.at(simd, i);
            for (by, &value) in by_color.iter().zip(&gaussian.channels) {
                worth = simd.fused(*by, simd.splat_f32s(value), worth);
            }
            if DEPTH {
                worth = simd.fused(by_depth, simd.splat_f32s(gaussian.channels[3]), worth);
            }
            let rest = simd.sub_f32s(cell.rest.at(simd, i), simd.mul_f32s(weight, worth));
            cell.rest.put(simd, i, rest);
            cell.transmittance.put(simd, i, simd.select_f32s(lives, next, zero));
            goes_on |= simd.bits(lives) != 0;
            let by_alpha =
                simd.sub_f32s(simd.mul_f32s(transmittance, worth), simd.div_f32s(rest, passes));
            let free = simd.and_m32s(lives, simd.less_than_f32s(full, simd.splat_f32s(ALPHA_MAX)));
            let by_power =
                simd.select_f32s(free, simd.mul_f32s(simd.sub_f32s(zero, alpha), by_alpha), zero);
            let (by_u, by_v) = (simd.mul_f32s(by_power, u), simd.mul_f32s(by_power, v));
            sums[0] = simd.add_f32s(sums[0], by_power);
            sums[1] = simd.add_f32s(sums[1], by_u);
            sums[2] = simd.add_f32s(sums[2], by_v);
            sums[3] = simd.fused(by_u, u, sums[3]);
            sums[4] = simd.fused(by_u, v, sums[4]);
            sums[5] = simd.fused(by_v, v, sums[5]);
            for (sum, by) in sums[6..9].iter_mut().zip(by_color) {
                *sum = simd.fused(weight, by, *sum);
            }
            if DEPTH {
                sums[9] = simd.fused(weight, by_depth, sums[9]);
            }
        }
        if !goes_on {
            open &= !(1 << at);
        }
    }
    for (out, sum) in out.iter_mut().zip(sums) {
        *out = simd.reduce_sum_f32s(sum);
    }
    open
}

/// How a view blurs a Gaussian: nothing is lost, or what was learnt is what is drawn.
struct Blur {
    /// Variance that is added to each axis, world units².
    lost: f64,
    /// The blur that it was learnt with, as large as the view shows it, px².
    learnt: f64,
    /// The blur that is drawn, px².
    drawn: f64,
    /// Derivatives by the centre and by t.z: of what is lost, or of the square of the size.
    slope: (DVec3, f64),
}

/// Derivatives by the numbers of a Gaussian, before they become f32.
struct Back {
    mean: [f64; 3],
    quat: [f64; 4],
    scales: [f64; 3],
    opacity: f64,
    /// By the colour before its negatives became 0, and the weights of the coefficients in it.
    color: [f64; 3],
    basis: [f64; 16],
}

impl Pass<'_> {
    /// From a footprint's sums to the Gaussian, by `Σ = M Mᵀ + blur`, `M = J W R diag(scales)`.
    fn back(&self, i: usize, sums: &Sums) -> Back {
        let (gaussians, view, request) = (self.gaussians, self.view, self.request);
        let footprint = &self.projected.footprints[i];
        let [by_power, u, v, uu, uv, vv, red, green, blue, by_depth] = sums.map(f64::from);
        let [u, v] = [u, v].map(|sum| sum / SQRT_LOG2_E);
        let [uu, uv, vv] = [uu, uv, vv].map(|sum| sum / (SQRT_LOG2_E * SQRT_LOG2_E));
        let (cx, cy) = (f64::from(footprint.conic_x), f64::from(footprint.conic_y));
        // dpower/dplace = a u + b v, for a step of the pixel against the centre.
        let (a, b) = ([2.0 * cx, -2.0 * cx * footprint.conic_shear], 2.0 * cy);
        let by_place = [-(a[0] * u), -(a[1] * u + b * v)];

        let mean = DVec3::from(gaussians.means()[i].map(f64::from));
        let t = view.rotation * mean + view.translation;
        let per_z = t.z.recip();
        let [fx, fy] = view.focal;
        let slope = [t.x * per_z, t.y * per_z];
        let bounded: [f64; 2] =
            std::array::from_fn(|k| slope[k].max(view.slope_min[k]).min(view.slope_max[k]));
        let [qw, qx, qy, qz] = gaussians.quats()[i].map(f64::from);
        let turned = view.rotation * rotation([qw, qx, qy, qz]);
        let Blur { lost, learnt, drawn, slope: slope_of_blur } = self.blur(i, mean, t.z);
        let scales = DVec3::from(gaussians.scales()[i].map(f64::from));
        let squares = scales * scales + lost;
        // Rows of J W R: a column is what an axis of the Gaussian is on the picture.
        let row =
            |k: usize, focal: f64| (turned.row(k) - turned.row(2) * bounded[k]) * (focal * per_z);
        let sharp = [row(0, fx), row(1, fy)];
        // a and b along each axis. a is (row x - shear · row y) of J W R: a difference of what is
        // long in needles. It is taken apart (Cauchy-Binet), with 1 / (variance of y) = b² / 2.
        let normal = sharp[0].cross(sharp[1]);
        let beside = (squares * sharp[1]).cross(normal);
        let along_a = (drawn * sharp[0] + beside) * (a[0] * 0.5 * b * b);
        let along_b = sharp[1] * b;
        // The derivative by the covariance is -(a u + b v)² / 2 as a matrix, summed: here times
        // axes.
        let mut by_u = -(uu * along_a + uv * along_b);
        let mut by_v = -(uv * along_a + vv * along_b);
        // The opacity goes with √(det less blurred / det): by the covariance that is half the
        // difference of the inverses, that of the blurs · inverse less blurred · inverse / 2.
        let opacity = f64::from(gaussians.opacities()[i]);
        let shown = f64::from(footprint.opacity);
        let (inner, least) =
            if request.antialiased { (0.0, 0.0) } else { (learnt, f64::from(ALPHA_MIN)) };
        let sharp_det = (after(squares) * before(squares)).dot(normal * normal);
        let wide = squares.dot(sharp[0] * sharp[0] + sharp[1] * sharp[1]);
        let det = sharp_det + inner * (wide + inner);
        let mut by_opacity = -by_power / shown;
        let mut by_size = 0.0;
        if inner < drawn && det > 0.0 {
            let by_log = -by_power * (shown - least) / shown;
            let by_share = 0.5 * by_log * (drawn - inner) / det;
            let skewed = sharp[1] + footprint.conic_shear * sharp[0];
            by_u += by_share * (inner * along_a + a[0] * (squares * skewed).cross(normal));
            by_v += by_share * (inner * along_b + b * normal.cross(squares * sharp[0]));
            by_opacity *= (shown - least) / (opacity - least);
            // The blurs go with the square of the size, where it is under 1.
            let (blur, pixel) = (f64::from(BLUR_PX2), f64::from(PIXEL_PX2));
            let long = a[0] * a[0] + a[1] * a[1];
            let by_drawn = -0.5
                * (long * (uu + 0.5 * by_log) + 2.0 * a[1] * b * uv + b * b * (vv + 0.5 * by_log));
            by_size = blur * 0.5 * by_log * (wide + 2.0 * inner) / det + (blur - pixel) * by_drawn;
        }
        let by_square = 0.5 * (along_a * by_u + along_b * by_v);
        let by_sharp = [squares * by_u * a[0], squares * (by_u * a[1] + by_v * b)];
        // By two axes each: 1 and 2, 2 and 0, 0 and 1.
        let mixed = after(along_a) * before(by_u) + after(along_b) * before(by_v);
        // J W R: its rows are rows of W R times the focal length over z, less the slope's share.
        let by_bound =
            [0, 1].map(|k: usize| -view.focal[k] * per_z * by_sharp[k].dot(turned.row(2)));
        // The variances that the place decides: what was lost, or the square of the size.
        let by_variance = if lost > 0.0 { by_square.element_sum() } else { by_size };
        let mut by_t = DVec3::new(by_place[0] * fx * per_z, by_place[1] * fy * per_z, 0.0);
        for k in 0..2 {
            if bounded[k] == slope[k] {
                by_t[k] += by_bound[k] * per_z;
            }
            by_t.z -= by_t[k] * slope[k];
        }
        by_t.z -= (by_sharp[0].dot(sharp[0]) + by_sharp[1].dot(sharp[1])) * per_z;
        by_t.z += by_depth + by_variance * slope_of_blur.1;
        // A turn about one axis moves variance between the other two: nothing where they are equal.
        let (next, last) = (after(scales), before(scales));
        let by_turn = mixed * (next - last) * (next + last);
        let (color, basis, by_place) = self.color(i, mean, [red, green, blue]);
        let by_mean = view.rotation.transpose() * by_t + slope_of_blur.0 * by_variance + by_place;
        Back {
            mean: by_mean.into(),
            quat: of_turn([qw, qx, qy, qz], by_turn),
            scales: (2.0 * scales * by_square).into(),
            opacity: by_opacity,
            color,
            basis,
        }
    }

    /// How the view blurs Gaussian `i`. See [`crate::plan`].
    fn blur(&self, i: usize, mean: DVec3, z: f64) -> Blur {
        let blur = f64::from(BLUR_PX2);
        let plain = Blur { lost: 0.0, learnt: blur, drawn: blur, slope: (DVec3::ZERO, 0.0) };
        let source = self.request.sources.get(usize::from(self.gaussians.source()[i].view));
        let Some(source) = source else { return plain };
        let [center, axis] = [source.center, source.axis].map(|v| DVec3::from(v.map(f64::from)));
        let scale = f64::from(source.scale);
        let width = (mean - center).dot(axis).max(0.0) * scale;
        let focal = self.view.focal[0].max(self.view.focal[1]);
        let own = f64::from(OWN_SIZE);
        let (least, size) = (own / focal, width * focal * own / z);
        if width > least * z {
            let lost = blur * (width * width - (least * z).powi(2));
            let slope = (axis * (2.0 * blur * width * scale), -2.0 * blur * least * least * z);
            return Blur { lost, slope, ..plain };
        }
        if width == 0.0 || size >= 1.0 || self.request.antialiased {
            return plain;
        }
        let square = size * size;
        let learnt = blur * square;
        Blur {
            learnt,
            drawn: learnt + f64::from(PIXEL_PX2) * (1.0 - square),
            slope: (axis * (2.0 * square / width * scale), -2.0 * square / z),
            ..plain
        }
    }

    /// By the sums of the harmonics, the weight of each coefficient in them, and by the centre.
    fn color(&self, i: usize, mean: DVec3, by: [f64; 3]) -> ([f64; 3], [f64; 16], DVec3) {
        let k = self.gaussians.sh_count();
        let sh = &self.gaussians.sh()[i * k..(i + 1) * k];
        let toward = mean - self.view.center;
        let direction = toward.normalize_or_zero();
        let shown = self.projected.footprints[i].color;
        let by: [f64; 3] = std::array::from_fn(|c| if shown[c] > 0.0 { by[c] } else { 0.0 });
        let basis = shade::basis(direction.as_vec3().into()).map(f64::from);
        if k == 1 {
            return (by, basis, DVec3::ZERO);
        }
        let mut by_direction = DVec3::ZERO;
        for (coefficient, slope) in sh.iter().zip(basis_slopes(direction.into())) {
            let worth: f64 = coefficient.iter().zip(by).map(|(&c, by)| f64::from(c) * by).sum();
            by_direction += DVec3::from(slope) * worth;
        }
        let across = by_direction - direction * by_direction.dot(direction);
        let length = toward.length();
        (by, basis, if length > 0.0 { across / length } else { DVec3::ZERO })
    }
}

/// The rotation of a quaternion of any length, wxyz.
fn rotation([w, x, y, z]: [f64; 4]) -> DMat3 {
    let s = 2.0 / (w * w + x * x + y * y + z * z);
    DMat3::from_cols(
        DVec3::new(1.0 - s * (y * y + z * z), s * (x * y + w * z), s * (x * z - w * y)),
        DVec3::new(s * (x * y - w * z), 1.0 - s * (x * x + z * z), s * (y * z + w * x)),
        DVec3::new(s * (x * z + w * y), s * (y * z - w * x), 1.0 - s * (x * x + y * y)),
    )
}

/// By the quaternion, at right angles to it, from what is known by turns about the Gaussian's axes.
fn of_turn(quat: [f64; 4], by: DVec3) -> [f64; 4] {
    let square: f64 = quat.iter().map(|v| v * v).sum();
    let [w, x, y, z] = quat.map(|v| 2.0 * v / square);
    let v = DVec3::new(x, y, z);
    let by_v = w * by + v.cross(by);
    [-v.dot(by), by_v.x, by_v.y, by_v.z]
}

/// The numbers of the axes after each: y, z, x.
fn after(DVec3 { x, y, z }: DVec3) -> DVec3 {
    DVec3::new(y, z, x)
}

/// The numbers of the axes before each: z, x, y.
fn before(DVec3 { x, y, z }: DVec3) -> DVec3 {
    DVec3::new(z, x, y)
}
