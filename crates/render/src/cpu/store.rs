//! Stage 8, the end: from the sums of a tile to its pixels. What lies behind is put under colour,
//! and numbers become levels where those are asked for. Shader: `shaders/rasterize.wgsl`

use std::ops::Range;

use super::{
    cell::{
        ACROSS, CELL, CELL_X, CELL_Y, CELLS, Cell, PIXEL_X, PIXEL_Y, PIXELS, Tile, TileScratch,
    },
    lanes::{LaneKernel, Lanes, Numbers},
    paint::{Behind, Paint},
    sky::Sky,
};
use crate::{
    Frame, Labels, Samples,
    budget::RayEnd,
    constants::{HALF_LEVEL, TILE_SIZE, TRANSMITTANCE_MIN},
    labels::{BLEND_WIDTH, WeightRows, selected},
    levels::level,
};

/// Rows of pixels of a part of a picture.
pub type Pixels<'a, T> = Option<Vec<&'a mut [T]>>;

/// A part of the pictures, row of pixels by row; `None` for kinds not asked for.
#[derive(Debug, Default)]
pub struct PictureRows<'a> {
    /// Colours.
    pub color: Pixels<'a, [f32; 3]>,
    /// Expected depths.
    pub depth: Pixels<'a, f32>,
    /// Opacities.
    pub alpha: Pixels<'a, f32>,
    /// Colours in levels.
    pub rgb: Pixels<'a, [u8; 3]>,
    /// Colours and opacities in levels.
    pub rgba: Pixels<'a, [u8; 4]>,
    /// Opacities in levels.
    pub alpha_levels: Pixels<'a, u8>,
    /// Blended labels.
    pub blend: Pixels<'a, [f32; BLEND_WIDTH]>,
    /// Mask.
    pub mask: Pixels<'a, u8>,
    /// Weights of the rows.
    pub weights: Option<WeightRows>,
}

/// How large the pieces of a part are; the last one may be smaller.
#[derive(Clone, Copy, Debug)]
pub(super) enum Cut {
    /// So many rows, from the top.
    Rows(usize),
    /// So many columns, from the left.
    Columns(usize),
}

/// Gives rows of pixels piece by piece.
fn pieces<'a, T>(mut all: Pixels<'a, T>, cut: Cut) -> impl FnMut() -> Pixels<'a, T> {
    let left = |row: &mut &'a mut [T], width: usize| {
        let whole = std::mem::take(row);
        let (left, rest) = whole.split_at_mut(width.min(whole.len()));
        *row = rest;
        left
    };
    move || {
        let all = all.as_mut()?;
        Some(match cut {
            Cut::Rows(height) => all.drain(..height.min(all.len())).collect(),
            Cut::Columns(width) => all.iter_mut().map(|row| left(row, width)).collect(),
        })
    }
}

impl<'a> PictureRows<'a> {
    /// The pictures of a frame from a row of pixels on, without weights.
    pub(super) fn of(frame: &'a mut Frame, first: usize) -> Self {
        fn rows<T>(all: &mut Option<Vec<T>>, width: usize, first: usize) -> Pixels<'_, T> {
            Some(all.as_mut()?.chunks_mut(width).skip(first).collect())
        }
        let (width, levels) = (frame.width as usize, &mut frame.levels);
        Self {
            color: rows(&mut frame.color, width, first),
            depth: rows(&mut frame.depth, width, first),
            alpha: rows(&mut frame.alpha, width, first),
            rgb: rows(&mut levels.rgb, width, first),
            rgba: rows(&mut levels.rgba, width, first),
            alpha_levels: rows(&mut levels.alpha, width, first),
            blend: rows(&mut frame.blend, width, first),
            mask: rows(&mut frame.mask, width, first),
            weights: None,
        }
    }

    /// Cuts a part without weights into `count` pieces.
    pub(super) fn split(self, count: usize, cut: Cut) -> Vec<Self> {
        let mut color = pieces(self.color, cut);
        let mut depth = pieces(self.depth, cut);
        let mut alpha = pieces(self.alpha, cut);
        let mut rgb = pieces(self.rgb, cut);
        let mut rgba = pieces(self.rgba, cut);
        let mut alpha_levels = pieces(self.alpha_levels, cut);
        let mut blend = pieces(self.blend, cut);
        let mut mask = pieces(self.mask, cut);
        let part = |_| PictureRows {
            color: color(),
            depth: depth(),
            alpha: alpha(),
            rgb: rgb(),
            rgba: rgba(),
            alpha_levels: alpha_levels(),
            blend: blend(),
            mask: mask(),
            weights: None,
        };
        (0..count).map(part).collect()
    }
}

/// A blended tile and the part where its pixels go, from row 0 and this column on.
pub(super) struct Store<'a, 'b> {
    pub(super) tile: Tile,
    pub(super) paint: &'a Paint<'a>,
    pub(super) column: usize,
    pub(super) scratch: &'a mut TileScratch,
    pub(super) out: &'a mut PictureRows<'b>,
}

impl LaneKernel for Store<'_, '_> {
    #[inline(always)]
    fn run<S: Lanes>(self, simd: S) {
        let Self { tile, paint, column, scratch, out } = self;
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
            let early = paint.ray_end.transmittance > TRANSMITTANCE_MIN;
            if early {
                cover(simd, cell, paint.ray_end);
            }
            if paint.has_color() {
                match &paint.behind {
                    Behind::Color(color) => over_color(simd, cell, color),
                    Behind::Sky(sky) => over_sky(simd, cell, tile, at, sky, paint.samples),
                }
            }
            if early {
                uncover(simd, cell);
            }
            for row in 0..rows {
                let to = column + x..column + x + columns;
                write(paint, cell, &PixelRun { first: row * CELL, row: y + row, to }, out);
            }
        }
        if let Some(weights) = &mut out.weights {
            list(tile, column, scratch, weights);
        }
    }
}

/// Puts the colour that is assumed behind rays that ended early where their light goes. Then they
/// are opaque; their transmittance is what they had left, and that of all others is 0.
#[inline(always)]
fn cover<S: Lanes>(simd: S, cell: &mut Cell, end: RayEnd) {
    let zero = simd.splat_f32s(0.0);
    for i in 0..PIXELS / S::F32_LANES {
        let left = cell.transmittance.at(simd, i);
        let ended = simd.less_than_or_equal_f32s(left, simd.splat_f32s(end.transmittance));
        let left = simd.select_f32s(ended, left, zero);
        cell.transmittance.put(simd, i, left);
        cell.alpha.put(simd, i, simd.add_f32s(cell.alpha.at(simd, i), left));
        for sum in &mut cell.channels[..3] {
            let covered = simd.fused(left, simd.splat_f32s(end.behind), sum.at(simd, i));
            sum.put(simd, i, covered);
        }
    }
}

/// Takes back half of the opacity that [`cover`] gave: the middle of what may be behind.
#[inline(always)]
fn uncover<S: Lanes>(simd: S, cell: &mut Cell) {
    for i in 0..PIXELS / S::F32_LANES {
        let half = simd.mul_f32s(cell.transmittance.at(simd, i), simd.splat_f32s(0.5));
        cell.alpha.put(simd, i, simd.sub_f32s(cell.alpha.at(simd, i), half));
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
    tile: Tile,
    at: usize,
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

/// A row of a cell's pixels, from number `first` on, and where it goes.
struct PixelRun {
    first: usize,
    row: usize,
    /// Columns.
    to: Range<usize>,
}

/// Writes a row of a cell.
#[inline(always)]
fn write(paint: &Paint<'_>, cell: &Cell, run: &PixelRun, out: &mut PictureRows<'_>) {
    let [depth_at, label_at, _] = paint.layout();
    let Cell { alpha, channels, .. } = cell;
    let alpha = &alpha.0;
    let color = |i: usize| [channels[0].0[i], channels[1].0[i], channels[2].0[i]];
    let labels = |i: usize| {
        let at = |k: usize| channels[label_at + k].0[i];
        [at(0), at(1), at(2), at(3)]
    };
    put(&mut out.color, run, color);
    put(&mut out.depth, run, |i| match alpha[i] > 0.0 {
        true => channels[depth_at].0[i] / alpha[i],
        false => 0.0,
    });
    put(&mut out.alpha, run, |i| alpha[i]);
    put(&mut out.rgb, run, |i| {
        let [r, g, b] = color(i);
        [level(r), level(g), level(b)]
    });
    put(&mut out.rgba, run, |i| {
        let [r, g, b] = color(i);
        [level(r), level(g), level(b), level(alpha[i])]
    });
    put(&mut out.alpha_levels, run, |i| level(alpha[i]));
    put(&mut out.blend, run, labels);
    if let Labels::Mask { coverage_floor, .. } = paint.labels {
        put(&mut out.mask, run, |i| u8::from(selected(labels(i), *coverage_floor)) * u8::MAX);
    }
}

/// Puts what `of` gives for the pixels of a row where they go.
#[inline(always)]
fn put<T>(out: &mut Pixels<'_, T>, run: &PixelRun, of: impl Fn(usize) -> T) {
    if let Some(rows) = out {
        for (i, pixel) in (run.first..).zip(&mut rows[run.row][run.to.clone()]) {
            *pixel = of(i);
        }
    }
}

/// Lists the weights of a tile's pixels, row by row.
fn list(tile: Tile, first: usize, scratch: &mut TileScratch, weights: &mut WeightRows) {
    for row in 0..tile.height as usize {
        for column in 0..tile.width as usize {
            let cell = row / CELL * ACROSS + column / CELL;
            let pixel = row % CELL * CELL + column % CELL;
            let count = scratch.bins.present.len();
            let sums = &scratch.bins.sums[cell * count..(cell + 1) * count];
            for (entry, sum) in scratch.bins.present.iter().zip(sums) {
                if sum.0[pixel] > 0.0 {
                    weights.push(first + column, row, *entry, sum.0[pixel]);
                }
            }
        }
    }
}
