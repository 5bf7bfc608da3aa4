//! A tile in work: its cells of pixels, its Gaussians as the blend needs them, and the bins of its
//! entries.

use super::{bin::value, footprint::Footprint, lanes::Numbers, paint::CHANNELS};
use crate::constants::{BATCH_SIZE, TILE_SIZE};

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

const SIDE: usize = TILE_SIZE as usize;
/// Side of a cell, pixels.
pub(super) const CELL: usize = 4;
/// Cells in a row of a tile.
pub(super) const ACROSS: usize = SIDE / CELL;
/// Cells of a tile.
pub(super) const CELLS: usize = ACROSS * ACROSS;
/// Pixels of a cell.
pub(super) const PIXELS: usize = CELL * CELL;
/// Gaussians of a batch: their marks are transposed together.
pub(super) const GROUP: usize = 64;
/// Centres of the cells, relative to the centre of the tile, pixels.
pub(super) const CELL_X: Numbers = along(ACROSS, false, CELL as f32);
pub(super) const CELL_Y: Numbers = along(ACROSS, true, CELL as f32);
/// Centres of a cell's pixels, relative to the centre of the cell.
pub(super) const PIXEL_X: Numbers = along(CELL, false, 1.0);
pub(super) const PIXEL_Y: Numbers = along(CELL, true, 1.0);

/// Columns (or rows) of a square of `side` x `side`, `step` apart, counted from its middle.
const fn along(side: usize, rows: bool, step: f32) -> Numbers {
    let mut out = [0.0; 16];
    let mut i = 0;
    while i < 16 {
        let k = if rows { i / side } else { i % side };
        out[i] = (k as f32 - (side - 1) as f32 / 2.0) * step;
        i += 1;
    }
    Numbers(out)
}

/// Bin of a Gaussian without a bin.
pub(super) const NO_BIN: u32 = u32::MAX;

/// A Gaussian of a tile, ready for the blend of all cells. At (x, y), pixels from the centre of the
/// tile, alpha is the opacity times 2^-(u² + v²) with `u = ux x + uy y + u0` and `v = vy y + v0`.
/// Where the Gaussian is visible, all terms are small, because the blur bounds `ux`, `uy` and `vy`.
/// So f32 is precise enough.
#[derive(Clone, Copy, Debug, Default)]
#[repr(C, align(64))]
pub(super) struct Staged {
    pub(super) ux: f32,
    pub(super) uy: f32,
    pub(super) u0: f32,
    pub(super) vy: f32,
    pub(super) v0: f32,
    /// Power at which alpha is under 1/255, with slack.
    pub(super) power_max: f32,
    pub(super) opacity: f32,
    pub(super) channels: [f32; CHANNELS],
    /// Bin of its entry, if weights are asked for.
    pub(super) bin: u32,
}

/// The pixels of a cell, one row for each number.
#[derive(Clone, Copy, Debug)]
pub(super) struct Cell {
    /// Transmittance while the ray goes on, 0 after it has ended.
    pub(super) transmittance: Numbers,
    /// Accumulated opacity.
    pub(super) alpha: Numbers,
    /// Accumulated channels.
    pub(super) channels: [Numbers; CHANNELS],
}

impl Cell {
    pub(super) const CLEAR: Self = Self {
        transmittance: Numbers::ONE,
        alpha: Numbers::ZERO,
        channels: [Numbers::ZERO; CHANNELS],
    };
}

/// Weights of the entries that occur in a tile.
#[derive(Debug, Default)]
pub(super) struct EntryBins {
    /// Entries that occur, ascending. Bin b belongs to `present[b]`.
    pub(super) present: Vec<u16>,
    /// `[65536]` bin of each entry, [`NO_BIN`] if it does not occur; empty before the first tile.
    pub(super) bin_of: Vec<u32>,
    /// `[CELLS, present.len()]` sums.
    pub(super) sums: Vec<Numbers>,
}

impl EntryBins {
    /// Makes a bin for each entry over 0 of the Gaussians of `pairs`. All sums are 0.
    pub(super) fn open(&mut self, pairs: &[u64], entries: &[u16]) {
        self.bin_of.resize(1 << u16::BITS, NO_BIN);
        for left in self.present.drain(..) {
            self.bin_of[usize::from(left)] = NO_BIN;
        }
        for &pair in pairs {
            let entry = entries[value(pair) as usize];
            let bin = &mut self.bin_of[usize::from(entry)];
            if entry != 0 && *bin == NO_BIN {
                *bin = 0;
                self.present.push(entry);
            }
        }
        self.present.sort_unstable();
        for (bin, entry) in (0_u32..).zip(&self.present) {
            self.bin_of[usize::from(*entry)] = bin;
        }
        self.sums.clear();
        self.sums.resize(CELLS * self.present.len(), Numbers::ZERO);
    }

    /// The sums of a cell, one for each bin.
    #[inline(always)]
    pub(super) fn of_cell(&mut self, cell: usize) -> &mut [Numbers] {
        let count = self.present.len();
        &mut self.sums[cell * count..(cell + 1) * count]
    }
}

/// Scratch of one worker. Its contents are undefined between tiles.
#[derive(Debug)]
pub struct TileScratch {
    /// Pairs of a tile.
    pub(super) pairs: Vec<u64>,
    pub(super) fetched: Vec<Footprint>,
    pub(super) staged: Vec<Staged>,
    pub(super) marks: [[u64; CELLS]; BATCH_SIZE / GROUP],
    pub(super) cells: [Cell; CELLS],
    pub(super) bins: EntryBins,
}

impl Default for TileScratch {
    fn default() -> Self {
        Self {
            pairs: Vec::new(),
            fetched: vec![Footprint::default(); BATCH_SIZE],
            staged: vec![Staged::default(); BATCH_SIZE],
            marks: [[0; CELLS]; BATCH_SIZE / GROUP],
            cells: [Cell::CLEAR; CELLS],
            bins: EntryBins::default(),
        }
    }
}

/// Column and row in the tile of a pixel of a cell.
#[inline(always)]
pub(super) const fn place(cell: usize, pixel: usize) -> (usize, usize) {
    (cell % ACROSS * CELL + pixel % CELL, cell / ACROSS * CELL + pixel / CELL)
}
