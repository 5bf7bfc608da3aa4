//! Stage 8: front-to-back blend of colour, depth and alpha. Partner: `shaders/rasterize.wgsl`
//!
//! A tile is cut into cells of [`LANES`] pixels of one row. Gaussians are staged a batch at a time
//! and entered in the list of each cell that their footprint meets; then each cell blends its list
//! with the state of its pixels in registers. A cell whose rays have all ended takes no more.

use super::{
    lanes::{F8, exp_neg},
    project::Footprint,
    radix_sort,
};
use crate::render::constants::{
    ALPHA_MAX, ALPHA_MIN, BATCH_SIZE, LANES, TILE_SIZE, TRANSMITTANCE_MIN,
};

const SIDE: usize = TILE_SIZE as usize;
/// Cells in a row of a tile.
const ACROSS: usize = SIDE / LANES;
/// Cells of a tile.
const CELLS: usize = SIDE * ACROSS;
/// The lane's place in its cell.
const LANE: F8 = F8([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);

/// What a Gaussian needs to be blended, the same for all cells of a tile.
#[derive(Clone, Copy, Debug, Default)]
struct Staged {
    inv_sx: f32,
    opacity: f32,
    depth: f32,
    color: [f32; 3],
}

/// A Gaussian in the list of a cell: half the squared distance at lane i is
/// `(along + inv_sx · i)² + across`.
#[derive(Clone, Copy, Debug, Default)]
struct Entry {
    along: f32,
    across: f32,
    staged: u32,
}

/// The pixels of a cell.
#[derive(Clone, Copy, Debug)]
struct Cell {
    /// Transmittance while the ray goes on, 0 after it has ended.
    transmittance: F8,
    /// Accumulated opacity.
    alpha: F8,
    /// Accumulated colour.
    color: [F8; 3],
    /// Accumulated opacity times t.z.
    depth: F8,
}

impl Cell {
    const CLEAR: Self = Self {
        transmittance: F8::splat(1.0),
        alpha: F8::splat(0.0),
        color: [F8::splat(0.0); 3],
        depth: F8::splat(0.0),
    };
}

/// Scratch of one worker; its contents mean nothing between tiles.
#[derive(Debug)]
pub struct TileScratch {
    staged: Vec<Staged>,
    entries: Vec<Entry>,
    counts: [usize; CELLS],
    cells: [Cell; CELLS],
}

impl Default for TileScratch {
    fn default() -> Self {
        Self {
            staged: vec![Staged::default(); BATCH_SIZE],
            entries: vec![Entry::default(); BATCH_SIZE * CELLS],
            counts: [0; CELLS],
            cells: [Cell::CLEAR; CELLS],
        }
    }
}

/// A row of tiles of the pictures; `None` for kinds not asked for.
#[derive(Debug)]
pub struct RowOut<'a> {
    /// `[rows * width]` colours.
    pub color: Option<&'a mut [[f32; 3]]>,
    /// `[rows * width]` expected depths.
    pub depth: Option<&'a mut [f32]>,
    /// `[rows * width]` opacities.
    pub alpha: Option<&'a mut [f32]>,
}

/// Place and size of a tile, pixels.
#[derive(Clone, Copy, Debug)]
pub struct Tile {
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Columns inside the picture.
    pub width: u32,
    /// Rows inside the picture.
    pub height: u32,
}

/// Blends the Gaussians `isects` (depth order) over the pixels of `tile`.
///
/// `picture_width` is the stride of `out`, which starts at the tile's first row.
pub fn rasterize_tile(
    footprints: &[Footprint],
    isects: &[u64],
    tile: Tile,
    background: [f32; 3],
    picture_width: u32,
    scratch: &mut TileScratch,
    out: &mut RowOut<'_>,
) {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        #[expect(unsafe_code, reason = "a call into code compiled for AVX2")]
        // SAFETY: the processor has AVX2, which was asked the line above.
        unsafe {
            blend_avx2(footprints, isects, tile, scratch);
        }
        return store(tile, background, picture_width, scratch, out);
    }
    blend(footprints, isects, tile, scratch);
    store(tile, background, picture_width, scratch, out);
}

/// [`blend`], compiled for 256-bit registers. No operation is fused, so the bits are the same.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn blend_avx2(footprints: &[Footprint], isects: &[u64], tile: Tile, scratch: &mut TileScratch) {
    blend(footprints, isects, tile, scratch);
}

#[inline(always)]
fn blend(footprints: &[Footprint], isects: &[u64], tile: Tile, scratch: &mut TileScratch) {
    scratch.cells.fill(Cell::CLEAR);
    // One bit a cell: set while some ray in it goes on.
    let mut open = 0_u32;
    for cell in 0..CELLS {
        let inside =
            cell / ACROSS < tile.height as usize && cell % ACROSS * LANES < tile.width as usize;
        open |= u32::from(inside) << cell;
    }
    for batch in isects.chunks(BATCH_SIZE) {
        scratch.counts.fill(0);
        for (slot, &isect) in batch.iter().enumerate() {
            let footprint = &footprints[radix_sort::value(isect) as usize];
            scratch.staged[slot] = Staged {
                inv_sx: footprint.inv_sx,
                opacity: footprint.opacity,
                depth: footprint.depth,
                color: footprint.color,
            };
            enter(footprint, slot, tile, open, &mut scratch.entries, &mut scratch.counts);
        }
        for cell in 0..CELLS {
            let entries = &scratch.entries[cell * BATCH_SIZE..][..scratch.counts[cell]];
            if !entries.is_empty() && blend_cell(&mut scratch.cells[cell], entries, &scratch.staged)
            {
                open &= !(1 << cell);
            }
        }
        if open == 0 {
            break;
        }
    }
}

/// Enters a Gaussian in the list of every open cell that its footprint meets.
#[inline(always)]
fn enter(
    footprint: &Footprint,
    slot: usize,
    tile: Tile,
    open: u32,
    entries: &mut [Entry],
    counts: &mut [usize; CELLS],
) {
    let x = footprint.mean[0] - f64::from(tile.x) - 0.5;
    let y = footprint.mean[1] - f64::from(tile.y) - 0.5;
    let tall = f64::from(footprint.reach.sqrt() / footprint.inv_sy) + 1e-3;
    let last_row = f64::from(tile.height - 1);
    if y + tall < 0.0 || y - tall > last_row {
        return;
    }
    let first = (y - tall).max(0.0) as usize;
    let last = (y + tall).min(last_row) as usize;
    let side = f64::from(TILE_SIZE - 1);
    let (px_per_sx, inv_sx) = (1.0 / footprint.inv_sx, f64::from(footprint.inv_sx));
    for row in first..=last {
        let dy = row as f64 - y;
        let across = dy as f32 * footprint.inv_sy;
        let across = across * across;
        let left_over = footprint.reach - across;
        if left_over < 0.0 {
            continue;
        }
        let half = f64::from(left_over.sqrt() * px_per_sx) + 1e-3;
        let center = x + footprint.slope * dy;
        if center + half < 0.0 || center - half > side {
            continue;
        }
        let first_cell = (center - half).max(0.0) as usize / LANES;
        let last_cell = (center + half).min(side) as usize / LANES;
        for column in first_cell..=last_cell {
            let cell = row * ACROSS + column;
            if open >> cell & 1 == 1 {
                let along = ((column * LANES) as f64 - center) * inv_sx;
                let entry = Entry { along: along as f32, across, staged: slot as u32 };
                entries[cell * BATCH_SIZE + counts[cell]] = entry;
                counts[cell] += 1;
            }
        }
    }
}

/// Blends a list into a cell; whether every ray of it has ended.
#[inline(always)]
fn blend_cell(cell: &mut Cell, entries: &[Entry], staged: &[Staged]) -> bool {
    let mut at = *cell;
    let mut ended = false;
    for entry in entries {
        let gaussian = &staged[entry.staged as usize];
        let along = LANE * F8::splat(gaussian.inv_sx) + F8::splat(entry.along);
        let power = along * along + F8::splat(entry.across);
        let alpha = (exp_neg(power) * F8::splat(gaussian.opacity)).min(ALPHA_MAX);
        let alpha = alpha.zero_under(ALPHA_MIN);
        let next = at.transmittance * (F8::splat(1.0) - alpha);
        // The Gaussian that would end the ray is not added; an ended ray stays at 0.
        let weight = (alpha * at.transmittance).zero_where_not_over(next, TRANSMITTANCE_MIN);
        at.transmittance = next.zero_where_not_over(next, TRANSMITTANCE_MIN);
        at.alpha = at.alpha + weight;
        for channel in 0..3 {
            at.color[channel] = at.color[channel] + weight * F8::splat(gaussian.color[channel]);
        }
        at.depth = at.depth + weight * F8::splat(gaussian.depth);
        if at.transmittance.is_zero() {
            ended = true;
            break;
        }
    }
    *cell = at;
    ended
}

/// Writes every pixel of the tile, blended over the background.
fn store(
    tile: Tile,
    background: [f32; 3],
    picture_width: u32,
    scratch: &TileScratch,
    out: &mut RowOut<'_>,
) {
    for row in 0..tile.height as usize {
        for column in 0..tile.width as usize {
            let at = row * picture_width as usize + tile.x as usize + column;
            let cell = &scratch.cells[row * ACROSS + column / LANES];
            let lane = column % LANES;
            let alpha = cell.alpha.0[lane].min(1.0);
            if let Some(color) = &mut out.color {
                color[at] = std::array::from_fn(|channel| {
                    cell.color[channel].0[lane] + (1.0 - alpha) * background[channel]
                });
            }
            if let Some(depth) = &mut out.depth {
                depth[at] = if alpha > 0.0 { cell.depth.0[lane] / cell.alpha.0[lane] } else { 0.0 };
            }
            if let Some(out) = &mut out.alpha {
                out[at] = alpha;
            }
        }
    }
}
