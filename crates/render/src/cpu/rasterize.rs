//! The last stages: the Gaussians of a tile in the order of depth, then the front-to-back blend of
//! colour, depth, alpha and labels. Shaders: `shaders/tile_sort.wgsl`, `shaders/rasterize.wgsl`
//!
//! A tile is cut into cells of 4 x 4 pixels. Gaussians are staged in batches. Each one marks the
//! cells that its ellipse may touch. The marks are transposed, so that each cell has one bit for
//! each Gaussian of the batch. Then each cell blends the Gaussians with a set bit; the state of its
//! pixels stays in registers. A cell whose rays have all ended blends no more. (The shader cuts a
//! tile into parts of 4 x 2 pixels and tests boxes instead of ellipses. The pixels are the same.)
//!
//! Besides alpha, the blend sums packed channels: colour, depth, and the row of a table, as the
//! request asks. Pixel weights are summed in one bin for each entry that occurs in the tile, so the
//! size of the bank does not matter.

use super::{
    bin::value,
    cell::{
        CELL, CELL_X, CELL_Y, CELLS, Cell, GROUP, NO_BIN, PIXEL_X, PIXEL_Y, PIXELS, Staged, Tile,
        TileScratch, place,
    },
    footprint::Footprint,
    lanes::{LaneKernel, Lanes, Numbers, exp2_neg},
    paint::{CHANNELS, Paint},
    store::{PictureRows, Store},
};
use crate::{
    Labels,
    constants::{ALPHA_MAX, ALPHA_MIN, BATCH_SIZE, TILE_SIZE, TRANSMITTANCE_MIN},
    switches::Skip,
};

/// Pairs of a tile that are sorted first.
const PORTION: usize = 1024;
/// Powers are exponents of 2: half the squared distance times log2 e.
pub(super) const SQRT_LOG2_E: f64 = 1.201_122_408_786_449_8;
/// Slack for the rounding of a cell's bound, in addition to the footprint's slack.
const POWER_SLACK: f32 = 1e-4;

/// Blends the Gaussians of the pairs, in any order, over the pixels of `tile`, and writes them to
/// `out` from row 0 and `column` on.
pub fn rasterize_tile(
    footprints: &[Footprint],
    pairs: &mut [u64],
    tile: Tile,
    column: usize,
    paint: &Paint<'_>,
    scratch: &mut TileScratch,
    out: &mut PictureRows<'_>,
) {
    if *paint.labels == Labels::Weights {
        scratch.bins.open(pairs, paint.entries);
    }
    paint.options.width.run(Blend { footprints, pairs, tile, paint, scratch: &mut *scratch });
    paint.options.width.run(Store { tile, paint, column, scratch, out });
}

/// A tile, its Gaussians and the scratch to blend them in.
struct Blend<'a> {
    footprints: &'a [Footprint],
    pairs: &'a mut [u64],
    tile: Tile,
    paint: &'a Paint<'a>,
    scratch: &'a mut TileScratch,
}

impl LaneKernel for Blend<'_> {
    /// Runs the loop that is compiled for the channels of the frame.
    #[inline(always)]
    fn run<S: Lanes>(self, simd: S) {
        let [.., channels] = self.paint.layout();
        let weights = *self.paint.labels == Labels::Weights;
        match (channels, weights) {
            (0, false) => self.blend::<S, 0, false>(simd),
            (1, false) => self.blend::<S, 1, false>(simd),
            (3, false) => self.blend::<S, 3, false>(simd),
            (4, false) => self.blend::<S, 4, false>(simd),
            (5, false) => self.blend::<S, 5, false>(simd),
            (7, false) => self.blend::<S, 7, false>(simd),
            (_, false) => self.blend::<S, CHANNELS, false>(simd),
            (0, true) => self.blend::<S, 0, true>(simd),
            (1, true) => self.blend::<S, 1, true>(simd),
            (3, true) => self.blend::<S, 3, true>(simd),
            (_, true) => self.blend::<S, 4, true>(simd),
        }
    }
}

impl Blend<'_> {
    #[inline(always)]
    fn blend<S: Lanes, const K: usize, const WEIGHTS: bool>(self, simd: S) {
        let Self { footprints, pairs, tile, paint, scratch } = self;
        let by_parts = paint.options.skips(Skip::EllipseParts);
        // Without the skip no ray is short enough.
        let ends = paint.options.skips(Skip::EndedRays);
        let ray_end = if ends { paint.ray_end.transmittance } else { -1.0 };
        let mut open = clear(&mut scratch.cells, tile);
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
            // Footprints lie far apart in memory. This loop is short, so that the processor fetches
            // many of them at the same time.
            let fetched = &mut scratch.fetched[..batch.len()];
            for (fetched, &isect) in fetched.iter_mut().zip(batch) {
                *fetched = footprints[value(isect) as usize];
            }
            let staged = &mut scratch.staged[..batch.len()];
            for ((staged, footprint), &isect) in staged.iter_mut().zip(fetched).zip(batch) {
                let id = value(isect) as usize;
                stage(footprint, tile, staged);
                paint.put_channels(footprint, id, &mut staged.channels);
                staged.bin = match WEIGHTS {
                    true => scratch.bins.bin_of[usize::from(paint.entries[id])],
                    false => NO_BIN,
                };
            }
            let groups = staged.chunks(GROUP).zip(&mut scratch.marks);
            for (group, marks) in groups {
                let mut met_by = [0_u16; GROUP];
                for (bits, gaussian) in met_by.iter_mut().zip(group) {
                    *bits = if by_parts { met(simd, gaussian) } else { u16::MAX };
                }
                *marks = transposed(&met_by);
            }
            let groups = batch.len().div_ceil(GROUP);
            let mut cells = open;
            while cells != 0 {
                let at = cells.trailing_zeros() as usize;
                cells &= cells - 1;
                let marks = &scratch.marks[..groups];
                let (cell, sums) = (&mut scratch.cells[at], scratch.bins.of_cell(at));
                let mut goes_on = false;
                for i in 0..PIXELS / S::F32_LANES {
                    let staged = &scratch.staged;
                    goes_on |= blend_cell::<S, K, WEIGHTS>(
                        simd,
                        (at, i),
                        ray_end,
                        cell,
                        staged,
                        marks,
                        sums,
                    );
                }
                if !goes_on {
                    open &= !(1 << at);
                }
            }
        }
    }
}

/// Pairs that are not sorted yet. Most rays end after few Gaussians, so the nearest are sorted
/// first.
pub(super) struct Rest<'a> {
    pairs: &'a mut [u64],
    portion: usize,
}

impl<'a> Rest<'a> {
    /// All of these.
    pub(super) fn new(pairs: &'a mut [u64]) -> Self {
        Self { pairs, portion: PORTION }
    }

    /// The nearest of the rest, sorted; empty if there are none. Each portion is twice the last.
    #[inline(never)]
    pub(super) fn nearest(&mut self) -> &'a [u64] {
        let pairs = std::mem::take(&mut self.pairs);
        let count = self.portion.min(pairs.len());
        if count < pairs.len() {
            pairs.select_nth_unstable(count);
        }
        let (near, far) = pairs.split_at_mut(count);
        near.sort_unstable();
        self.pairs = far;
        self.portion *= 2;
        near
    }
}

/// Transposes marks (bit c of Gaussian i) to rows (bit i of cell c).
#[inline(always)]
fn transposed(met_by: &[u16; GROUP]) -> [u64; CELLS] {
    let mut marks = [0; CELLS];
    for (block, met_by) in met_by.chunks_exact(8).enumerate() {
        for half in 0..2 {
            // 8 x 8 bits in a word, transposed by three exchanges (Hacker's Delight, 7-3).
            let mut word = 0_u64;
            for (i, bits) in met_by.iter().enumerate() {
                word |= u64::from(bits >> (8 * half) & 0xff) << (8 * i);
            }
            for (shift, mask) in
                [(7, 0x00aa_00aa_00aa_00aa), (14, 0x0000_cccc_0000_cccc), (28, 0xf0f0_f0f0)]
            {
                let t = (word ^ word >> shift) & mask;
                word ^= t ^ t << shift;
            }
            for k in 0..8 {
                marks[8 * half + k] |= (word >> (8 * k) & 0xff) << (8 * block);
            }
        }
    }
    marks
}

/// Clears the cells. Returns one bit for each cell with pixels inside the picture. The rays of
/// pixels outside have ended.
fn clear(cells: &mut [Cell; CELLS], tile: Tile) -> u32 {
    cells.fill(Cell::CLEAR);
    let mut open = (1 << CELLS) - 1;
    if (tile.width, tile.height) == (TILE_SIZE, TILE_SIZE) {
        return open;
    }
    for (i, cell) in cells.iter_mut().enumerate() {
        for (pixel, transmittance) in cell.transmittance.0.iter_mut().enumerate() {
            let (x, y) = place(i, pixel);
            if x >= tile.width as usize || y >= tile.height as usize {
                *transmittance = 0.0;
            }
        }
        if cell.transmittance == Numbers::ZERO {
            open &= !(1 << i);
        }
    }
    open
}

/// The footprint, relative to the tile; channels and bin stay. Computed in f64; the small results
/// become f32. Written number by number: a whole one would wait for its parts.
#[inline(always)]
pub(super) fn stage(footprint: &Footprint, tile: Tile, staged: &mut Staged) {
    let half = f64::from(TILE_SIZE) / 2.0;
    let x = footprint.mean[0] - (f64::from(tile.x) + half);
    let y = footprint.mean[1] - (f64::from(tile.y) + half);
    let ux = f64::from(footprint.conic_x) * SQRT_LOG2_E;
    let vy = f64::from(footprint.conic_y) * SQRT_LOG2_E;
    staged.ux = ux as f32;
    staged.uy = (-ux * footprint.conic_shear) as f32;
    staged.u0 = (-ux * (x - footprint.conic_shear * y)) as f32;
    staged.vy = vy as f32;
    staged.v0 = (-vy * y) as f32;
    staged.power_max = footprint.power_max * std::f32::consts::LOG2_E + POWER_SLACK;
    staged.opacity = footprint.opacity;
}

/// One bit for each cell that the ellipse may touch. In a cell, u and v stay within a box. Its
/// distance from 0 is compared with `power_max`.
#[inline(always)]
pub(super) fn met<S: Lanes>(simd: S, gaussian: &Staged) -> u16 {
    let mut bits = 0;
    let half = (CELL - 1) as f32 / 2.0;
    let wide = simd.splat_f32s(half * (gaussian.ux.abs() + gaussian.uy.abs()));
    let tall = simd.splat_f32s(half * gaussian.vy);
    let zero = simd.splat_f32s(0.0);
    for i in 0..CELLS / S::F32_LANES {
        let (x, y) = (CELL_X.at(simd, i), CELL_Y.at(simd, i));
        let (u, v) = along_axes(simd, gaussian, x, y);
        let du = simd.max_f32s(simd.sub_f32s(simd.abs(u), wide), zero);
        let dv = simd.max_f32s(simd.sub_f32s(simd.abs(v), tall), zero);
        let nearest = simd.fused(du, du, simd.mul_f32s(dv, dv));
        let near = simd.less_than_or_equal_f32s(nearest, simd.splat_f32s(gaussian.power_max));
        bits |= simd.bits(near) << (i * S::F32_LANES);
    }
    bits as u16
}

/// u and v at places from the middle of the tile.
#[inline(always)]
pub(super) fn along_axes<S: Lanes>(
    simd: S,
    gaussian: &Staged,
    x: S::f32s,
    y: S::f32s,
) -> (S::f32s, S::f32s) {
    let u = simd.fused(y, simd.splat_f32s(gaussian.uy), simd.splat_f32s(gaussian.u0));
    let u = simd.fused(x, simd.splat_f32s(gaussian.ux), u);
    let v = simd.fused(y, simd.splat_f32s(gaussian.vy), simd.splat_f32s(gaussian.v0));
    (u, v)
}

/// Blends the marked Gaussians into vector `i` of cell `at`: K channels and the bins. Returns
/// whether any ray goes on: has a transmittance over `ray_end`. It stops when none does.
#[inline(always)]
fn blend_cell<S: Lanes, const K: usize, const WEIGHTS: bool>(
    simd: S,
    (at, i): (usize, usize),
    ray_end: f32,
    cell: &mut Cell,
    staged: &[Staged],
    marks: &[[u64; CELLS]],
    sums: &mut [Numbers],
) -> bool {
    let zero = simd.splat_f32s(0.0);
    let end = simd.splat_f32s(TRANSMITTANCE_MIN);
    let ray_end = simd.splat_f32s(ray_end);
    let x = simd.add_f32s(PIXEL_X.at(simd, i), simd.splat_f32s(CELL_X.0[at]));
    let y = simd.add_f32s(PIXEL_Y.at(simd, i), simd.splat_f32s(CELL_Y.0[at]));
    let mut transmittance = cell.transmittance.at(simd, i);
    let mut alpha_sum = cell.alpha.at(simd, i);
    let mut channels = [zero; K];
    for (channel, sum) in channels.iter_mut().zip(&cell.channels) {
        *channel = sum.at(simd, i);
    }
    let mut goes_on = true;
    'all: for (group, marks) in marks.iter().enumerate() {
        let mut bits = marks[at];
        while bits != 0 {
            let gaussian = &staged[group * GROUP + bits.trailing_zeros() as usize];
            bits &= bits - 1;
            let (u, v) = along_axes(simd, gaussian, x, y);
            let power = simd.fused(u, u, simd.mul_f32s(v, v));
            let alpha = simd.mul_f32s(exp2_neg(simd, power), simd.splat_f32s(gaussian.opacity));
            let alpha = simd.min_f32s(alpha, simd.splat_f32s(ALPHA_MAX));
            let counts = simd.less_than_or_equal_f32s(simd.splat_f32s(ALPHA_MIN), alpha);
            let alpha = simd.select_f32s(counts, alpha, zero);
            let next = simd.mul_f32s(transmittance, simd.sub_f32s(simd.splat_f32s(1.0), alpha));
            // The Gaussian that would end the ray is not added, and none after it: no factor is
            // over 1. So the next product need not wait for this comparison.
            let lives = simd.greater_than_f32s(next, end);
            let weight = simd.select_f32s(lives, simd.mul_f32s(alpha, transmittance), zero);
            transmittance = next;
            alpha_sum = simd.add_f32s(alpha_sum, weight);
            for (sum, &value) in channels.iter_mut().zip(&gaussian.channels) {
                *sum = simd.fused(weight, simd.splat_f32s(value), *sum);
            }
            if WEIGHTS && let Some(sum) = sums.get_mut(gaussian.bin as usize) {
                sum.put(simd, i, simd.add_f32s(sum.at(simd, i), weight));
            }
            if simd.bits(simd.greater_than_f32s(transmittance, ray_end)) == 0 {
                goes_on = false;
                break 'all;
            }
        }
        // Before a product is too small for f32.
        transmittance = left(simd, transmittance);
    }
    let transmittance = left(simd, transmittance);
    cell.transmittance.put(simd, i, transmittance);
    cell.alpha.put(simd, i, alpha_sum);
    for (channel, sum) in channels.into_iter().zip(&mut cell.channels) {
        sum.put(simd, i, channel);
    }
    goes_on
}

/// These transmittances, 0 of rays that have ended.
#[inline(always)]
fn left<S: Lanes>(simd: S, transmittance: S::f32s) -> S::f32s {
    let lives = simd.greater_than_f32s(transmittance, simd.splat_f32s(TRANSMITTANCE_MIN));
    simd.select_f32s(lives, transmittance, simd.splat_f32s(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn portions_come_in_order_and_hold_every_pair() {
        let mut random = 9_u32;
        for count in [0, 1, PORTION, PORTION + 1, 5 * PORTION] {
            let mut pairs: Vec<u64> = (0..count as u64)
                .map(|id| {
                    random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    u64::from(random >> 24) << 32 | id
                })
                .collect();
            let mut want = pairs.clone();
            want.sort_unstable();
            let mut rest = Rest::new(&mut pairs);
            let portions = std::iter::repeat_with(|| rest.nearest());
            let got: Vec<u64> =
                portions.take_while(|all| !all.is_empty()).flatten().copied().collect();
            assert_eq!(got, want, "{count} pairs");
        }
    }

    #[test]
    fn transposed_marks_are_the_same_marks() {
        let mut random = 9_u32;
        let met_by: [u16; GROUP] = std::array::from_fn(|_| {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (random >> 13) as u16
        });
        let marks = transposed(&met_by);
        for (gaussian, bits) in met_by.iter().enumerate() {
            for (cell, marks) in marks.iter().enumerate() {
                let (want, got) = (bits >> cell & 1 == 1, marks >> gaussian & 1 == 1);
                assert_eq!(got, want, "Gaussian {gaussian}, cell {cell}");
            }
        }
    }
}
