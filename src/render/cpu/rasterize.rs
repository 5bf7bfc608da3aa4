//! Stage 8: front-to-back blend of colour, depth, alpha and labels. Partner:
//! `shaders/rasterize.wgsl`
//!
//! A tile is cut into cells of [`LANES`] pixels of one row. Gaussians are staged a batch at a time
//! and entered in the list of each cell that their footprint meets; then each cell blends its list
//! with the state of its pixels in registers. A cell whose rays have all ended takes no more.
//!
//! What is blended beside alpha is a row of channels, packed: colour, depth and a label's row of
//! the table, as far as they were asked for. Entries are summed in one bin for each index that
//! occurs in the tile, so a Gaussian touches one bin a cell however large the bank is.

use super::{
    lanes::{F8, exp_neg},
    project::Footprint,
    radix_sort,
};
use crate::render::{
    Kinds, Labels, RenderRequest,
    constants::{ALPHA_MAX, ALPHA_MIN, BATCH_SIZE, LANES, TILE_SIZE, TRANSMITTANCE_MIN},
    labels::{BLEND_WIDTH, EntryRows},
};

const SIDE: usize = TILE_SIZE as usize;
/// Cells in a row of a tile.
const ACROSS: usize = SIDE / LANES;
/// Cells of a tile.
const CELLS: usize = SIDE * ACROSS;
/// The lane's place in its cell.
const LANE: F8 = F8([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);

/// Most channels: colour, depth, labels.
const CHANNELS: usize = 3 + 1 + BLEND_WIDTH;
/// Bin of a Gaussian that enters none.
const NO_BIN: u32 = u32::MAX;

/// What a Gaussian is blended with, chosen once a frame.
#[derive(Clone, Copy, Debug)]
pub struct Paint<'a> {
    /// Pictures wanted.
    kinds: Kinds,
    /// Behind everything, in colour.
    background: [f32; 3],
    /// Labels wanted.
    labels: &'a Labels,
    /// `[N]` bank index of each Gaussian.
    index: &'a [u16],
}

impl<'a> Paint<'a> {
    /// What `request` asks for, of Gaussians with the bank indices `index`, `[N]`.
    #[must_use]
    pub fn new(request: &'a RenderRequest, index: &'a [u16]) -> Self {
        let RenderRequest { kinds, background, labels, .. } = request;
        Self { kinds: *kinds, background: *background, labels, index }
    }

    /// Labels wanted.
    #[must_use]
    pub fn labels(&self) -> &'a Labels {
        self.labels
    }

    /// First channel of depth and of labels, and the number of all.
    fn layout(&self) -> [usize; 3] {
        let depth = if self.kinds.color { 3 } else { 0 };
        let label = depth + usize::from(self.kinds.depth);
        let blend = matches!(self.labels, Labels::Blend(_));
        [depth, label, label + if blend { BLEND_WIDTH } else { 0 }]
    }

    /// The channels of Gaussian `id`.
    #[inline(always)]
    fn channels(&self, footprint: &Footprint, id: usize) -> [f32; CHANNELS] {
        let [depth, label, _] = self.layout();
        let mut channels = [0.0; CHANNELS];
        if self.kinds.color {
            channels[..3].copy_from_slice(&footprint.color);
        }
        if self.kinds.depth {
            channels[depth] = footprint.depth;
        }
        if let Labels::Blend(table) = self.labels {
            let row = Labels::row(table, self.index[id]);
            channels[label..label + BLEND_WIDTH].copy_from_slice(&row);
        }
        channels
    }
}

/// What a Gaussian needs to be blended, the same for all cells of a tile.
#[derive(Clone, Copy, Debug, Default)]
struct Staged {
    inv_sx: f32,
    opacity: f32,
    channels: [f32; CHANNELS],
    /// Bin of its index, where entries are wanted.
    bin: u32,
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
    /// Accumulated channels.
    channels: [F8; CHANNELS],
}

impl Cell {
    const CLEAR: Self = Self {
        transmittance: F8::splat(1.0),
        alpha: F8::splat(0.0),
        channels: [F8::splat(0.0); CHANNELS],
    };
}

/// Scratch of one worker; its contents mean nothing between tiles.
#[derive(Debug)]
pub struct TileScratch {
    staged: Vec<Staged>,
    entries: Vec<Entry>,
    counts: [usize; CELLS],
    cells: [Cell; CELLS],
    bins: Bins,
}

impl Default for TileScratch {
    fn default() -> Self {
        Self {
            staged: vec![Staged::default(); BATCH_SIZE],
            entries: vec![Entry::default(); BATCH_SIZE * CELLS],
            counts: [0; CELLS],
            cells: [Cell::CLEAR; CELLS],
            bins: Bins::default(),
        }
    }
}

/// Weights of the indices that occur in a tile.
#[derive(Debug, Default)]
struct Bins {
    /// Indices that occur, ascending; bin b is of `present[b]`.
    present: Vec<u16>,
    /// `[65536]` bin of each index, [`NO_BIN`] where it does not occur; empty before the first.
    bin_of: Vec<u32>,
    /// `[CELLS, present.len()]` sums.
    sums: Vec<F8>,
}

impl Bins {
    /// A bin for every index but 0 of the Gaussians `isects`, all sums 0.
    fn open(&mut self, isects: &[u64], index: &[u16]) {
        self.bin_of.resize(1 << u16::BITS, NO_BIN);
        for left in self.present.drain(..) {
            self.bin_of[usize::from(left)] = NO_BIN;
        }
        for &isect in isects {
            let label = index[radix_sort::value(isect) as usize];
            let bin = &mut self.bin_of[usize::from(label)];
            if label != 0 && *bin == NO_BIN {
                *bin = 0;
                self.present.push(label);
            }
        }
        self.present.sort_unstable();
        for (bin, label) in (0_u32..).zip(&self.present) {
            self.bin_of[usize::from(*label)] = bin;
        }
        self.sums.clear();
        self.sums.resize(CELLS * self.present.len(), F8::splat(0.0));
    }

    /// The sums of a cell, one a bin.
    #[inline(always)]
    fn of_cell(&mut self, cell: usize) -> &mut [F8] {
        let count = self.present.len();
        &mut self.sums[cell * count..(cell + 1) * count]
    }
}

/// A row of tiles of the pictures; `None` for kinds not asked for.
#[derive(Debug, Default)]
pub struct RowOut<'a> {
    /// `[rows * width]` colours.
    pub color: Option<&'a mut [[f32; 3]]>,
    /// `[rows * width]` expected depths.
    pub depth: Option<&'a mut [f32]>,
    /// `[rows * width]` opacities.
    pub alpha: Option<&'a mut [f32]>,
    /// `[rows * width]` blended labels.
    pub blend: Option<&'a mut [[f32; BLEND_WIDTH]]>,
    /// Entries of the rows.
    pub entries: Option<EntryRows>,
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
    paint: &Paint<'_>,
    picture_width: u32,
    scratch: &mut TileScratch,
    out: &mut RowOut<'_>,
) {
    let work = Work { footprints, isects, tile, paint };
    if *paint.labels == Labels::Entries {
        scratch.bins.open(isects, paint.index);
    }
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        #[expect(unsafe_code, reason = "a call into code compiled for AVX2")]
        // SAFETY: the processor has AVX2, which was asked the line above.
        unsafe {
            blend_avx2(&work, scratch);
        }
        return store(tile, paint, picture_width, scratch, out);
    }
    blend(&work, scratch);
    store(tile, paint, picture_width, scratch, out);
}

/// A tile and what falls on it.
struct Work<'a> {
    footprints: &'a [Footprint],
    isects: &'a [u64],
    tile: Tile,
    paint: &'a Paint<'a>,
}

/// [`blend`], compiled for 256-bit registers. No operation is fused, so the bits are the same.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn blend_avx2(work: &Work<'_>, scratch: &mut TileScratch) {
    blend(work, scratch);
}

/// The loop with the channels that the frame asks for: what is not wanted is not computed.
#[inline(always)]
fn blend(work: &Work<'_>, scratch: &mut TileScratch) {
    let [.., channels] = work.paint.layout();
    match (channels, *work.paint.labels == Labels::Entries) {
        (0, false) => blend_channels::<0, false>(work, scratch),
        (1, false) => blend_channels::<1, false>(work, scratch),
        (3, false) => blend_channels::<3, false>(work, scratch),
        // Four alone compile to shuffles of four instead of lanes of eight, a quarter slower; with
        // a fifth that stays 0 they do not.
        (4 | 5, false) => blend_channels::<5, false>(work, scratch),
        (7, false) => blend_channels::<7, false>(work, scratch),
        (_, false) => blend_channels::<CHANNELS, false>(work, scratch),
        (0, true) => blend_channels::<0, true>(work, scratch),
        (1, true) => blend_channels::<1, true>(work, scratch),
        (3, true) => blend_channels::<3, true>(work, scratch),
        (_, true) => blend_channels::<4, true>(work, scratch),
    }
}

#[inline(always)]
fn blend_channels<const K: usize, const ENTRIES: bool>(work: &Work<'_>, scratch: &mut TileScratch) {
    let Work { footprints, isects, tile, paint } = *work;
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
            let id = radix_sort::value(isect) as usize;
            let footprint = &footprints[id];
            scratch.staged[slot] = Staged {
                inv_sx: footprint.inv_sx,
                opacity: footprint.opacity,
                channels: paint.channels(footprint, id),
                bin: match ENTRIES {
                    true => scratch.bins.bin_of[usize::from(paint.index[id])],
                    false => NO_BIN,
                },
            };
            enter(footprint, slot, tile, open, &mut scratch.entries, &mut scratch.counts);
        }
        for cell in 0..CELLS {
            let entries = &scratch.entries[cell * BATCH_SIZE..][..scratch.counts[cell]];
            if entries.is_empty() {
                continue;
            }
            let (at, sums) = (&mut scratch.cells[cell], scratch.bins.of_cell(cell));
            if blend_cell::<K, ENTRIES>(at, entries, &scratch.staged, sums) {
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

/// Blends a list into a cell: K channels, and the cell's bins; whether every ray of it has ended.
#[inline(always)]
fn blend_cell<const K: usize, const ENTRIES: bool>(
    cell: &mut Cell,
    entries: &[Entry],
    staged: &[Staged],
    sums: &mut [F8],
) -> bool {
    let (mut transmittance, mut alpha_sum) = (cell.transmittance, cell.alpha);
    let mut channels: [F8; K] = std::array::from_fn(|channel| cell.channels[channel]);
    let mut ended = false;
    for entry in entries {
        let gaussian = &staged[entry.staged as usize];
        let along = LANE * F8::splat(gaussian.inv_sx) + F8::splat(entry.along);
        let power = along * along + F8::splat(entry.across);
        let alpha = (exp_neg(power) * F8::splat(gaussian.opacity)).min(ALPHA_MAX);
        let alpha = alpha.zero_under(ALPHA_MIN);
        let next = transmittance * (F8::splat(1.0) - alpha);
        // The Gaussian that would end the ray is not added; an ended ray stays at 0.
        let weight = (alpha * transmittance).zero_where_not_over(next, TRANSMITTANCE_MIN);
        transmittance = next.zero_where_not_over(next, TRANSMITTANCE_MIN);
        alpha_sum = alpha_sum + weight;
        for (sum, &value) in channels.iter_mut().zip(&gaussian.channels) {
            *sum = *sum + weight * F8::splat(value);
        }
        if ENTRIES && let Some(sum) = sums.get_mut(gaussian.bin as usize) {
            *sum = *sum + weight;
        }
        if transmittance.is_zero() {
            ended = true;
            break;
        }
    }
    (cell.transmittance, cell.alpha) = (transmittance, alpha_sum);
    cell.channels[..K].copy_from_slice(&channels);
    ended
}

/// Writes every pixel of the tile, colour blended over the background.
fn store(
    tile: Tile,
    paint: &Paint<'_>,
    picture_width: u32,
    scratch: &TileScratch,
    out: &mut RowOut<'_>,
) {
    let [depth_at, label_at, _] = paint.layout();
    for row in 0..tile.height as usize {
        for column in 0..tile.width as usize {
            let at = row * picture_width as usize + tile.x as usize + column;
            let cell = &scratch.cells[row * ACROSS + column / LANES];
            let lane = column % LANES;
            let alpha = cell.alpha.0[lane].min(1.0);
            if let Some(color) = &mut out.color {
                color[at] = std::array::from_fn(|channel| {
                    cell.channels[channel].0[lane] + (1.0 - alpha) * paint.background[channel]
                });
            }
            if let Some(depth) = &mut out.depth {
                let sum = cell.channels[depth_at].0[lane];
                depth[at] = if alpha > 0.0 { sum / cell.alpha.0[lane] } else { 0.0 };
            }
            if let Some(out) = &mut out.alpha {
                out[at] = alpha;
            }
            if let Some(blend) = &mut out.blend {
                blend[at] = std::array::from_fn(|k| cell.channels[label_at + k].0[lane]);
            }
        }
    }
    if let Some(entries) = &mut out.entries {
        store_entries(tile, &scratch.bins, entries);
    }
}

/// Writes the bins over 0 of every pixel.
fn store_entries(tile: Tile, bins: &Bins, entries: &mut EntryRows) {
    let count = bins.present.len();
    if count == 0 {
        return;
    }
    let mut touched = Vec::with_capacity(count);
    for (cell, sums) in bins.sums.chunks_exact(count).enumerate() {
        touched.clear();
        touched.extend(bins.present.iter().zip(sums).filter(|(_, sum)| !sum.is_zero()));
        let (row, first) = (cell / ACROSS, cell % ACROSS * LANES);
        if row >= tile.height as usize {
            break;
        }
        for column in first..(first + LANES).min(tile.width as usize) {
            for (label, sum) in &touched {
                let weight = sum.0[column - first];
                if weight > 0.0 {
                    entries.push(tile.x as usize + column, row, **label, weight);
                }
            }
        }
    }
}
