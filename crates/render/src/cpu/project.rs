//! Stage 1: Gaussians to footprints; some are dropped. Shader: `shaders/project.wgsl`
//!
//! In: means, quats, scales, opacities `[N]` of the Gaussians shown. Out: [`Footprint`] `[N]`. A
//! dropped Gaussian touches no tile (`tiles_per_gauss` is 0). All arithmetic is f64; the results
//! become f32 at the end.

use std::ops::Range;

use rayon::prelude::*;

use super::{
    cull::Shown,
    footprint::Footprint,
    lanes::{KernelOptions, LaneKernel, Lanes, Numbers, Row, Wide, ln},
    tiles::{BLOCK, Ellipses, Grid, TileSpans},
};
use crate::{
    Layer, RenderRequest, Source,
    constants::{ALPHA_MIN, BLUR_PX2, FOOTPRINT_SLACK, OWN_SIZE, PIXEL_PX2},
    scene::Gaussians,
    view::View,
};

/// Gaussians of a task: enough to hide the cost of a task, few enough to balance two cores.
const CHUNK: usize = 1024;
/// Numbers that a task writes into new scratch.
const FRESH: usize = 1 << 14;

/// Output of the stage, `[N]` each.
#[derive(Debug, Default)]
pub struct Projected {
    /// The Gaussians that are projected; set by the stage before.
    pub shown: Shown,
    /// Footprints; undefined where dropped.
    pub footprints: Vec<Footprint>,
    /// Tiles touched, for the emission; undefined where dropped.
    pub tile_spans: Vec<TileSpans>,
    /// Tiles touched; 0 where dropped.
    pub tiles_per_gauss: Vec<u32>,
}

/// Projects the Gaussians that are shown for `request`, of which `view` is the camera.
/// `tiles_per_gauss[i]` is 0 if Gaussian i of them is dropped.
pub fn project(
    gaussians: &Gaussians,
    request: &RenderRequest,
    view: &View,
    options: KernelOptions,
    projected: &mut Projected,
) {
    let Projected { shown, footprints, tile_spans, tiles_per_gauss } = projected;
    let count = shown.len(gaussians.len());
    let shown = &*shown;
    resize(footprints, count);
    resize(tile_spans, count);
    resize(tiles_per_gauss, count);
    let chunks = footprints
        .par_chunks_mut(CHUNK)
        .zip(tile_spans.par_chunks_mut(CHUNK))
        .zip(tiles_per_gauss.par_chunks_mut(CHUNK));
    chunks.enumerate().for_each(|(chunk, ((footprints, spans), tiles))| {
        let first = chunk * CHUNK;
        let out = (footprints, spans, tiles);
        options.width.run(Chunk { gaussians, shown, request, view, options, first, out });
    });
}

/// Sets the length of scratch. What is new is written by all threads: for millions of Gaussians
/// most of the time goes to pages that the system gives to whom writes them first.
fn resize<T: Default + Send>(scratch: &mut Vec<T>, count: usize) {
    if count > scratch.capacity() {
        // Nothing in it has to be copied.
        *scratch = Vec::with_capacity(count);
    }
    scratch.truncate(count);
    let more = (scratch.len()..count).into_par_iter().with_min_len(FRESH);
    scratch.par_extend(more.map(|_| T::default()));
}

/// Gaussians of a task and where their footprints go.
struct Chunk<'a> {
    gaussians: &'a Gaussians,
    shown: &'a Shown,
    request: &'a RenderRequest,
    view: &'a View,
    options: KernelOptions,
    first: usize,
    out: (&'a mut [Footprint], &'a mut [TileSpans], &'a mut [u32]),
}

impl LaneKernel for Chunk<'_> {
    #[inline(always)]
    fn run<S: Lanes>(self, simd: S) {
        let Self { request, view, options, out: (footprints, spans, tiles), .. } = self;
        let magnifies = !request.sources.is_empty();
        let block_options = BlockOptions {
            antialiased: request.antialiased,
            magnifies,
            merged: self.shown.merged().is_some(),
        };
        let grid = Grid::whole(view, options);
        let out = footprints.chunks_mut(BLOCK).zip(spans.chunks_mut(BLOCK));
        let out = out.zip(tiles.chunks_mut(BLOCK)).enumerate();
        let (mut block, mut ellipses) = (Block::default(), Ellipses::default());
        for (at, ((footprints, spans), tiles)) in out {
            tiles.fill(0);
            let first = self.first + at * BLOCK;
            let places = first..first + footprints.len();
            block.load(self.gaussians, self.shown, places.clone());
            if magnifies {
                block.load_widths(self.gaussians, self.shown, places, &request.sources);
            }
            if !block.project(simd, view, block_options) {
                continue;
            }
            block.bound_powers(simd);
            let mut seen = 0_u32;
            for (k, footprint) in footprints.iter_mut().enumerate() {
                if block.put_footprint(k, footprint) {
                    ellipses.set(k, footprint);
                    seen |= 1 << k;
                }
            }
            ellipses.touch(simd, &grid);
            for (k, (spans, tiles)) in spans.iter_mut().zip(tiles).enumerate() {
                if seen >> k & 1 == 1 {
                    (*spans, *tiles) = ellipses.spans(k, &footprints[k], &grid);
                }
            }
        }
    }
}

/// What the projection of a block computes.
#[derive(Clone, Copy)]
struct BlockOptions {
    antialiased: bool,
    /// Whether widths are loaded.
    magnifies: bool,
    /// Whether some may be merged.
    merged: bool,
}

/// A block of Gaussians and their footprints, one row for each number.
#[derive(Default)]
struct Block {
    mean: [Row; 3],
    quat: [Row; 4],
    scale: [Row; 3],
    /// Width of the source pixel in the world; 0 where it is not known.
    width: Row,
    opacity: Row,
    /// Opacities that it stands for, in sum; 0 of a Gaussian of the scene. Loaded if any is merged.
    sum: Row,
    center: [Row; 2],
    conic_shear: Row,
    conic_x: Row,
    conic_y: Row,
    depth: Row,
    /// Half the squared distance at which alpha reaches 1/255, with slack.
    power_max: Numbers,
    /// 1 for a Gaussian that may be visible, else 0.
    kept: Row,
}

impl Block {
    /// Loads the Gaussians at these places of those shown.
    #[inline(always)]
    fn load(&mut self, gaussians: &Gaussians, shown: &Shown, places: Range<usize>) {
        if let Shown::All = shown {
            // They lie side by side.
            let rows = gaussians.means()[places.clone()].iter();
            let rows = rows.zip(&gaussians.quats()[places.clone()]);
            let rows = rows.zip(&gaussians.scales()[places.clone()]);
            let rows = rows.zip(&gaussians.opacities()[places]);
            for (k, (((mean, quat), scale), &opacity)) in rows.enumerate() {
                self.set(k, mean, quat, scale, opacity);
            }
            return;
        }
        for (k, at) in places.enumerate() {
            let (of, id) = shown.find(gaussians, at);
            let (mean, quat, scale) = (&of.means()[id], &of.quats()[id], &of.scales()[id]);
            self.set(k, mean, quat, scale, of.opacities()[id]);
            self.sum[k] = shown.sum(gaussians, at);
        }
    }

    #[inline(always)]
    fn set(&mut self, k: usize, mean: &[f32; 3], quat: &[f32; 4], scale: &[f32; 3], opacity: f32) {
        for (row, &value) in self.mean.iter_mut().zip(mean) {
            row[k] = f64::from(value);
        }
        for (row, &value) in self.quat.iter_mut().zip(quat) {
            row[k] = f64::from(value);
        }
        for (row, &value) in self.scale.iter_mut().zip(scale) {
            row[k] = f64::from(value);
        }
        self.opacity[k] = f64::from(opacity);
    }

    #[inline(always)]
    fn load_widths(
        &mut self,
        gaussians: &Gaussians,
        shown: &Shown,
        places: Range<usize>,
        sources: &[Source],
    ) {
        for (k, at) in places.enumerate() {
            self.width[k] = 0.0;
            let (of, id) = shown.find(gaussians, at);
            if let Some(source) = sources.get(usize::from(of.source()[id].view)) {
                let mut depth = 0.0;
                for (axis, mean) in self.mean.iter().enumerate() {
                    let from = mean[k] - f64::from(source.center[axis]);
                    depth += from * f64::from(source.axis[axis]);
                }
                self.width[k] = depth.max(0.0) * f64::from(source.scale);
                if source.layer == Layer::LeftOut {
                    // It reaches no bound, whatever is made of it.
                    self.opacity[k] = f64::NAN;
                }
            }
        }
    }

    /// EWA projection of the block. Returns whether any Gaussian may be visible.
    #[inline(always)]
    fn project<S: Lanes>(&mut self, simd: S, view: &View, options: BlockOptions) -> bool {
        let BlockOptions { antialiased, magnifies, merged } = options;
        let mut any_kept = false;
        self.kept = [0.0; BLOCK];
        // No `map` of arrays from here on: what it calls is not compiled for the processor.
        let number = |value: f64| Wide::of(simd, value);
        let mut w = [[number(0.0); 3]; 3];
        let mut moved = [number(0.0); 3];
        for (row, (w, moved)) in w.iter_mut().zip(&mut moved).enumerate() {
            for (column, w) in w.iter_mut().enumerate() {
                *w = number(view.rotation.col(column)[row]);
            }
            *moved = number(view.translation[row]);
        }
        let blur = number(f64::from(BLUR_PX2));
        let larger_focal = view.focal[0].max(view.focal[1]) / f64::from(OWN_SIZE);
        for i in 0..BLOCK / S::F64_LANES {
            let at = |row: &Row| Wide::at(simd, row, i);
            let mean = [at(&self.mean[0]), at(&self.mean[1]), at(&self.mean[2])];
            let t = [
                dot(w[0], mean) + moved[0],
                dot(w[1], mean) + moved[1],
                dot(w[2], mean) + moved[2],
            ];
            let kept = t[2].at_least(number(view.near));
            if !any(simd, kept) {
                continue;
            }
            any_kept = true;
            let per_z = number(1.0) / t[2];
            let slope = [t[0] * per_z, t[1] * per_z];
            let bounded = [
                slope[0].max(number(view.slope_min[0])).min(number(view.slope_max[0])),
                slope[1].max(number(view.slope_min[1])).min(number(view.slope_max[1])),
            ];
            // Rows of M = J W R diag(scales), so that the 2D covariance is M Mᵀ.
            let quat = [at(&self.quat[0]), at(&self.quat[1]), at(&self.quat[2]), at(&self.quat[3])];
            let columns = rotation(number(1.0), number(2.0), quat);
            // What the blur lost or has too much: see `plan`. Neighbours are alike, so most vectors
            // need neither of the two, which then would change no bit.
            let (mut lost, mut learnt, mut drawn) = (None, blur, blur);
            let mut filtered = false;
            if magnifies {
                let width = at(&self.width);
                let p = width * number(larger_focal) * per_z;
                let larger = p.at_least(number(1.0));
                if any(simd, larger) {
                    let share = (number(1.0) - number(1.0) / (p * p)).only(larger);
                    lost = Some(blur * width * width * share);
                }
                let size = (p * number(f64::from(OWN_SIZE).powi(2))).min(number(1.0));
                let known = width.at_least(number(f64::MIN_POSITIVE));
                let smaller = (number(1.0) - size * size).only(known);
                // The antialiased mode has a rule of its own.
                filtered = !antialiased && any(simd, smaller.at_least(number(f64::MIN_POSITIVE)));
                if filtered {
                    learnt = blur * (number(1.0) - smaller);
                    drawn = learnt + number(f64::from(PIXEL_PX2)) * smaller;
                }
            }
            let mut local = w;
            for (k, column) in columns.into_iter().enumerate() {
                let mut scale = at(&self.scale[k]);
                if let Some(lost) = lost {
                    scale = scale.times_plus(scale, lost).sqrt();
                }
                for row in 0..3 {
                    local[row][k] = dot(w[row], column) * scale;
                }
            }
            let [row_x, row_y, row_z] = local;
            let m0 = image_row(row_x, row_z, bounded[0], number(view.focal[0]) * per_z);
            let m1 = image_row(row_y, row_z, bounded[1], number(view.focal[1]) * per_z);
            let (xx, yy) = (dot(m0, m0), dot(m1, m1));
            // det(M Mᵀ) as a sum of squares (Cauchy-Binet): it cannot cancel or go negative.
            let cross = [
                m0[1] * m1[2] - m0[2] * m1[1],
                m0[2] * m1[0] - m0[0] * m1[2],
                m0[0] * m1[1] - m0[1] * m1[0],
            ];
            let det_sharp = dot(cross, cross);
            let det = det_sharp + drawn * (xx + yy) + drawn * drawn;
            let var_y = yy + drawn;
            let half = number(0.5);
            if merged && !antialiased {
                let stands = at(&self.sum).at_least(number(f64::MIN_POSITIVE));
                // What its members cover with the blur that they were learnt with (`merged`).
                let det_learnt = det_sharp + learnt * (xx + yy) + learnt * learnt;
                let opacity = at(&self.opacity);
                let spread = at(&self.sum) * learnt;
                let covers =
                    opacity * opacity * det_sharp + opacity * spread * (xx + yy) + spread * spread;
                let all = (covers / det_learnt).sqrt();
                (opacity + (all - opacity).only(stands)).put(&mut self.opacity, i);
            }
            if antialiased {
                let share = (det_sharp / det).sqrt();
                (at(&self.opacity) * share).put(&mut self.opacity, i);
            } else if filtered {
                // Its sum over the picture stays, less what is under the least alpha.
                let det_learnt = det_sharp + learnt * (xx + yy) + learnt * learnt;
                let opacity = at(&self.opacity);
                let over = opacity - number(f64::from(ALPHA_MIN));
                let gone = (number(1.0) - (det_learnt / det).sqrt()) * over;
                (opacity - gone).put(&mut self.opacity, i);
            }
            if merged {
                let stands = at(&self.sum).at_least(number(f64::MIN_POSITIVE));
                let opacity = at(&self.opacity);
                let most = opacity.min(opacity.sqrt());
                (opacity + (most - opacity).only(stands)).put(&mut self.opacity, i);
            }
            for (k, (center, slope)) in self.center.iter_mut().zip(slope).enumerate() {
                let place = number(view.focal[k]) * slope + number(view.principal[k]);
                place.put(center, i);
            }
            (dot(m0, m1) / var_y).put(&mut self.conic_shear, i);
            (half * var_y / det).sqrt().put(&mut self.conic_x, i);
            (half / var_y).sqrt().put(&mut self.conic_y, i);
            t[2].put(&mut self.depth, i);
            number(1.0).only(kept).put(&mut self.kept, i);
        }
        any_kept
    }

    /// Where the alphas of all reach 1/255.
    #[inline(always)]
    fn bound_powers<S: Lanes>(&mut self, simd: S) {
        let mut over = Numbers::ZERO;
        for (over, &opacity) in over.0.iter_mut().zip(&self.opacity) {
            *over = opacity as f32 * ALPHA_MIN.recip();
        }
        for i in 0..BLOCK / S::F32_LANES {
            let ln = ln(simd, simd.max_f32s(over.at(simd, i), simd.splat_f32s(1.0)));
            let bound = simd.add_f32s(ln, simd.splat_f32s(FOOTPRINT_SLACK));
            self.power_max.put(simd, i, bound);
        }
    }

    /// Writes the footprint of Gaussian `k`, less its colour. Returns false if it is not visible.
    #[inline(always)]
    fn put_footprint(&self, k: usize, to: &mut Footprint) -> bool {
        // The comparison is false for a NaN.
        let seen = self.kept[k] > 0.0 && self.opacity[k] >= f64::from(ALPHA_MIN);
        if !seen {
            return false;
        }
        let (x, y, shear) = (self.center[0][k], self.center[1][k], self.conic_shear[k]);
        let (conic_x, conic_y) = (self.conic_x[k] as f32, self.conic_y[k] as f32);
        let depth = self.depth[k] as f32;
        // Infinite variances and determinants give a 0 or a NaN here.
        let finite = x.is_finite() && y.is_finite() && shear.is_finite() && depth.is_finite();
        let wide = |inv: f32| inv > 0.0 && inv.is_finite();
        if !(finite && wide(conic_x) && wide(conic_y)) {
            return false;
        }
        // Number by number: a whole one would wait for its parts.
        to.mean = [x, y];
        to.conic_shear = shear;
        to.conic_x = conic_x;
        to.conic_y = conic_y;
        to.power_max = self.power_max.0[k];
        to.opacity = self.opacity[k] as f32;
        to.depth = depth;
        true
    }
}

/// Whether any lane of the mask is set.
#[inline(always)]
fn any<S: Lanes>(simd: S, mask: S::m64s) -> bool {
    simd.first_true_m64s(mask) < S::F64_LANES
}

/// Columns of the rotation of a quaternion of any length, wxyz.
#[inline(always)]
fn rotation<S: Lanes>(one: Wide<S>, two: Wide<S>, quat: [Wide<S>; 4]) -> [[Wide<S>; 3]; 3] {
    let [w, x, y, z] = quat;
    let scale = two / (w * w + x * x + y * y + z * z);
    let (xx, yy, zz) = (x * x * scale, y * y * scale, z * z * scale);
    let (xy, xz, yz) = (x * y * scale, x * z * scale, y * z * scale);
    let (wx, wy, wz) = (w * x * scale, w * y * scale, w * z * scale);
    [
        [one - (yy + zz), xy + wz, xz - wy],
        [xy - wz, one - (xx + zz), yz + wx],
        [xz + wy, yz - wx, one - (xx + yy)],
    ]
}

/// A row of M: `(row - row_z · slope) · focal`.
#[inline(always)]
fn image_row<S: Lanes>(
    row: [Wide<S>; 3],
    row_z: [Wide<S>; 3],
    slope: Wide<S>,
    focal: Wide<S>,
) -> [Wide<S>; 3] {
    [
        (row[0] - row_z[0] * slope) * focal,
        (row[1] - row_z[1] * slope) * focal,
        (row[2] - row_z[2] * slope) * focal,
    ]
}

#[inline(always)]
fn dot<S: Lanes>(a: [Wide<S>; 3], b: [Wide<S>; 3]) -> Wide<S> {
    a[0].times_plus(b[0], a[1].times_plus(b[1], a[2] * b[2]))
}
