//! Stage 8, the end: from the sums of a tile to its pixels. What lies behind is put under colour,
//! and numbers become levels where those are asked for. Shader: `shaders/rasterize.wgsl`

use super::{
    lanes::{LaneKernel, Lanes},
    paint::{Behind, Paint},
    rasterize::{
        ACROSS, CELL, CELL_X, CELL_Y, CELLS, Cell, Numbers, PIXEL_X, PIXEL_Y, PIXELS, Tile,
        TileScratch,
    },
    sky::Sky,
};
use crate::{
    Labels, Samples,
    constants::{HALF_LEVEL, TILE_SIZE},
    labels::{BLEND_WIDTH, WeightRows, selected},
    levels::level,
};

/// A row of tiles of the pictures; `None` for kinds not asked for.
#[derive(Debug, Default)]
pub struct RowOut<'a> {
    /// `[rows * width]` colours.
    pub color: Option<&'a mut [[f32; 3]]>,
    /// `[rows * width]` expected depths.
    pub depth: Option<&'a mut [f32]>,
    /// `[rows * width]` opacities.
    pub alpha: Option<&'a mut [f32]>,
    /// `[rows * width]` colours in levels.
    pub rgb: Option<&'a mut [[u8; 3]]>,
    /// `[rows * width]` colours and opacities in levels.
    pub rgba: Option<&'a mut [[u8; 4]]>,
    /// `[rows * width]` opacities in levels.
    pub alpha_levels: Option<&'a mut [u8]>,
    /// `[rows * width]` blended labels.
    pub blend: Option<&'a mut [[f32; BLEND_WIDTH]]>,
    /// `[rows * width]` mask.
    pub mask: Option<&'a mut [u8]>,
    /// Weights of the rows.
    pub weights: Option<WeightRows>,
}

/// A blended tile and where its pixels go: `out` starts at the tile's first row and has rows of
/// `picture_width` pixels.
pub(super) struct Store<'a, 'b> {
    pub(super) tile: Tile,
    pub(super) paint: &'a Paint<'a>,
    pub(super) picture_width: u32,
    pub(super) scratch: &'a mut TileScratch,
    pub(super) out: &'a mut RowOut<'b>,
}

impl LaneKernel for Store<'_, '_> {
    #[inline(always)]
    fn run<S: Lanes>(self, simd: S) {
        let Self { tile, paint, picture_width, scratch, out } = self;
        let width = picture_width as usize;
        for at in 0..CELLS {
            let (x, y) = (at % ACROSS * CELL, at / ACROSS * CELL);
            let columns = (tile.width as usize).saturating_sub(x).min(CELL);
            let rows = (tile.height as usize).saturating_sub(y).min(CELL);
            if columns == 0 || rows == 0 {
                continue;
            }
            let cell = &mut scratch.cells[at];
            for i in 0..PIXELS / S::F32_LANES {
                let alpha = simd.min_f32s(cell.alpha.at(simd, i), simd.splat_f32s(1.0));
                cell.alpha.put(simd, i, alpha);
            }
            if paint.has_color() {
                match &paint.behind {
                    Behind::Color(color) => over_color(simd, cell, color),
                    Behind::Sky(sky) => over_sky(simd, cell, (tile, at), sky, paint.samples),
                }
            }
            for row in 0..rows {
                let first = (y + row) * width + tile.x as usize + x;
                write(paint, cell, row * CELL, first..first + columns, out);
            }
        }
        if let Some(weights) = &mut out.weights {
            list(tile, scratch, weights);
        }
    }
}

/// Puts one colour behind a cell.
#[inline(always)]
fn over_color<S: Lanes>(simd: S, cell: &mut Cell, color: &[f32; 3]) {
    for i in 0..PIXELS / S::F32_LANES {
        let room = simd.sub_f32s(simd.splat_f32s(1.0), cell.alpha.at(simd, i));
        for (sum, &behind) in cell.channels.iter_mut().zip(color) {
            let under = simd.mul_f32s(room, simd.splat_f32s(behind));
            sum.put(simd, i, simd.add_f32s(sum.at(simd, i), under));
        }
    }
}

/// Puts the backdrop behind cell `at` of a tile where enough light passes it.
#[inline(always)]
fn over_sky<S: Lanes>(
    simd: S,
    cell: &mut Cell,
    (tile, at): (Tile, usize),
    sky: &Sky<'_>,
    samples: Samples,
) {
    let least = if samples == Samples::F32 { f32::MIN_POSITIVE } else { HALF_LEVEL };
    let mut rooms = Numbers::ZERO;
    let mut open = 0;
    for i in 0..PIXELS / S::F32_LANES {
        let room = simd.sub_f32s(simd.splat_f32s(1.0), cell.alpha.at(simd, i));
        let shows = simd.less_than_or_equal_f32s(simd.splat_f32s(least), room);
        open |= simd.bits(shows) << (i * S::F32_LANES);
        rooms.put(simd, i, room);
    }
    if open == 0 {
        return;
    }
    let middle = TILE_SIZE as f32 / 2.0 - 0.5;
    let [x, y] = [(tile.x, &CELL_X), (tile.y, &CELL_Y)].map(|(first, cells)| {
        // Columns and rows of the part drawn: whole numbers of at most 18 bits.
        first as f32 + middle + cells.0[at]
    });
    let (mut us, mut vs) = (Numbers::ZERO, Numbers::ZERO);
    for i in 0..PIXELS / S::F32_LANES {
        let x = simd.add_f32s(PIXEL_X.at(simd, i), simd.splat_f32s(x));
        let y = simd.add_f32s(PIXEL_Y.at(simd, i), simd.splat_f32s(y));
        let (u, v) = sky.places(simd, x, y);
        us.put(simd, i, u);
        vs.put(simd, i, v);
    }
    while open != 0 {
        let pixel = open.trailing_zeros() as usize;
        open &= open - 1;
        let behind = sky.color(us.0[pixel], vs.0[pixel]);
        for (sum, behind) in cell.channels.iter_mut().zip(behind) {
            sum.0[pixel] += rooms.0[pixel] * behind;
        }
    }
}

/// Writes a row of a cell, from number `first` of its pixels on, to the places `to`.
#[inline(always)]
fn write(
    paint: &Paint<'_>,
    cell: &Cell,
    first: usize,
    to: std::ops::Range<usize>,
    out: &mut RowOut<'_>,
) {
    let [depth_at, label_at, _] = paint.layout();
    let Cell { alpha, channels, .. } = cell;
    let color = |i: usize| [channels[0].0[i], channels[1].0[i], channels[2].0[i]];
    let labels = |i: usize| {
        let at = |k: usize| channels[label_at + k].0[i];
        [at(0), at(1), at(2), at(3)]
    };
    if let Some(out) = &mut out.color {
        for (i, out) in (first..).zip(&mut out[to.clone()]) {
            *out = color(i);
        }
    }
    if let Some(out) = &mut out.depth {
        for (i, out) in (first..).zip(&mut out[to.clone()]) {
            let alpha = alpha.0[i];
            *out = if alpha > 0.0 { channels[depth_at].0[i] / alpha } else { 0.0 };
        }
    }
    if let Some(out) = &mut out.alpha {
        for (i, out) in (first..).zip(&mut out[to.clone()]) {
            *out = alpha.0[i];
        }
    }
    if let Some(out) = &mut out.rgb {
        for (i, out) in (first..).zip(&mut out[to.clone()]) {
            let [r, g, b] = color(i);
            *out = [level(r), level(g), level(b)];
        }
    }
    if let Some(out) = &mut out.rgba {
        for (i, out) in (first..).zip(&mut out[to.clone()]) {
            let [r, g, b] = color(i);
            *out = [level(r), level(g), level(b), level(alpha.0[i])];
        }
    }
    if let Some(out) = &mut out.alpha_levels {
        for (i, out) in (first..).zip(&mut out[to.clone()]) {
            *out = level(alpha.0[i]);
        }
    }
    if let Some(out) = &mut out.blend {
        for (i, out) in (first..).zip(&mut out[to.clone()]) {
            *out = labels(i);
        }
    }
    if let (Some(out), Labels::Mask { coverage_floor, .. }) = (&mut out.mask, paint.labels) {
        for (i, out) in (first..).zip(&mut out[to]) {
            *out = u8::from(selected(labels(i), *coverage_floor)) * u8::MAX;
        }
    }
}

/// Lists the weights of a tile's pixels, row by row.
fn list(tile: Tile, scratch: &mut TileScratch, weights: &mut WeightRows) {
    for row in 0..tile.height as usize {
        for column in 0..tile.width as usize {
            let cell = row / CELL * ACROSS + column / CELL;
            let pixel = row % CELL * CELL + column % CELL;
            let count = scratch.bins.present.len();
            let sums = &scratch.bins.sums[cell * count..(cell + 1) * count];
            for (entry, sum) in scratch.bins.present.iter().zip(sums) {
                if sum.0[pixel] > 0.0 {
                    weights.push(tile.x as usize + column, row, *entry, sum.0[pixel]);
                }
            }
        }
    }
}
