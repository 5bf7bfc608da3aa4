//! A frame in work: where its pictures lie in the buffers of the device, and how they come out of
//! the read-back.

use std::ops::Range;

use bytemuck::Pod;
use glam::DVec3;
use rayon::prelude::*;

use super::{
    buffers::{DeviceScene, PlanRow, ViewRow},
    pipelines::NO_PICTURE,
    scratch::{Scratch, WEIGHT_SLOTS_MIN},
};
use crate::{
    DepthSteps, Frame, Labels, RenderRequest, Samples,
    constants::TILE_SIZE,
    error::Result,
    labels::{BLEND_WIDTH, WeightRows},
    view::View,
};

/// Factor by which the room for weights grows when it is too small.
const WEIGHT_SLOTS_GROWTH: u32 = 4;
/// Pictures of more bytes than this are copied by all cores.
const PARALLEL_BYTES: usize = 4 << 20;

/// Places of a band's pictures in the buffers of its batch: first words, or [`NO_PICTURE`].
pub(super) struct Layout {
    /// The band's rows of tiles.
    pub(super) rows: Range<u32>,
    pub(super) color: u32,
    /// In f32. Where it is asked for in steps it is not read back: it lies behind all pictures that
    /// are.
    pub(super) depth: u32,
    pub(super) alpha: u32,
    pub(super) blend: u32,
    pub(super) alpha_bytes: u32,
    pub(super) mask: u32,
    pub(super) steps: u32,
    /// Words of the pictures that are read back.
    pub(super) words: u64,
    /// Words of those that are not.
    pub(super) inner_words: u64,
    /// Pixels of the band.
    pixels: u64,
    /// Room of a pixel, in weights; 0 if none are asked for.
    pub(super) slots: u32,
    pub(super) tiles: u32,
}

impl Layout {
    pub(super) fn picture_bytes(&self) -> u64 {
        self.words * 4
    }

    /// Words: one count for each pixel, then an entry and a weight for each slot.
    pub(super) fn slot_bytes(&self) -> u64 {
        if self.slots == 0 { 0 } else { self.pixels * 4 * (1 + 2 * u64::from(self.slots)) }
    }

    pub(super) fn all_bytes(&self) -> u64 {
        self.picture_bytes() + self.inner_words * 4 + self.slot_bytes()
    }
}

/// What the device says of the band of one view.
pub(super) struct ReadBack<'a> {
    pub(super) plan: PlanRow,
    pub(super) pictures: &'a [u8],
    /// Counts, then entries and weights, of the pixels.
    pub(super) slots: &'a [u32],
}

/// Result of one view of a submission.
pub(super) struct Ended {
    /// Counts of the device.
    pub(super) plan: PlanRow,
    pub(super) complete: bool,
    /// New room of a pixel, in weights, if the old one was too small.
    pub(super) more_slots: Option<u32>,
}

/// A frame in work. Its bands are drawn from top to bottom.
pub(super) struct Drawing<'a> {
    pub(super) row: ViewRow,
    pub(super) request: &'a RenderRequest,
    frame: Frame,
    /// Weights of the bands drawn.
    weights: Vec<WeightRows>,
    /// Most weights of a pixel in them.
    weights_max: u32,
}

impl<'a> Drawing<'a> {
    /// Errors: those of [`View::new`].
    pub(super) fn new(
        origin: DVec3,
        request: &'a RenderRequest,
        scene: &DeviceScene,
    ) -> Result<Self> {
        let view = View::new(origin, request)?;
        let row = ViewRow::of(&view, request, scene.brightest);
        // The bands are appended.
        let frame = Frame::blank([view.width, view.height], request, 0);
        let mut drawing = Self { row, request, frame, weights: Vec::new(), weights_max: 0 };
        drawing.draws(scene);
        Ok(drawing)
    }

    /// The next bands are of `scene`, the whole or a part.
    pub(super) fn draws(&mut self, scene: &DeviceScene) {
        let row = &mut self.row;
        (row.gaussian_count, row.sh_count) = (scene.count, scene.sh_count);
        row.block_count = scene.block_count();
    }

    /// The frame of all bands.
    pub(super) fn finish(mut self, scratch: &mut Scratch) -> Result<Frame> {
        if self.request.labels == Labels::Weights {
            // The next view needs about the same room. One unusual view does not change that.
            scratch.weight_slots = self.weights_max.next_power_of_two().max(WEIGHT_SLOTS_MIN);
            self.frame.weights = Some(WeightRows::join(self.weights)?);
        }
        // Depth in steps came so from the device, unless it was drawn in bands.
        let stepped = self.frame.levels.depth.is_some();
        Ok(if stepped { self.frame } else { self.frame.finish(self.request.samples) })
    }

    /// All rows of tiles.
    pub(super) fn whole(&self) -> Range<u32> {
        0..self.row.tiles_y
    }

    /// Columns and rows of tiles.
    pub(super) fn tiles(&self) -> [u32; 2] {
        [self.row.tiles_x, self.row.tiles_y]
    }

    pub(super) fn layout(&self, rows: Range<u32>, slots: u32) -> Layout {
        let pixel_rows = (rows.end * TILE_SIZE).min(self.row.height) - rows.start * TILE_SIZE;
        let pixels = u64::from(pixel_rows) * u64::from(self.row.width);
        let RenderRequest { kinds, labels, samples, .. } = self.request;
        let exact = *samples == Samples::F32;
        let mut words = 0;
        let mut take = |wanted: bool, size: u64| {
            let start = if wanted { words as u32 } else { NO_PICTURE };
            words += if wanted { size } else { 0 };
            start
        };
        // Rows of numbers that share words start at whole ones.
        let packed = |bytes: u32| {
            u64::from(pixel_rows) * (u64::from(self.row.width) * u64::from(bytes)).div_ceil(4)
        };
        // Steps are of one size in all bands.
        let stepped = kinds.depth && !exact && rows == self.whole();
        let color_words = match samples {
            Samples::F32 => 3 * pixels,
            Samples::Levels => packed(3),
            Samples::LevelsRgba => pixels,
        };
        let color = take(kinds.color, color_words);
        let alpha = take(kinds.alpha && exact, pixels);
        let blend = take(matches!(labels, Labels::Blend(_)), BLEND_WIDTH as u64 * pixels);
        let alpha_bytes = take(kinds.alpha && !exact, packed(1));
        let mask = take(matches!(labels, Labels::Mask { .. }), packed(1));
        let steps = take(stepped, packed(2));
        let depth = take(kinds.depth && !stepped, pixels);
        let depth = if stepped { 0 } else { depth };
        let inner_words = if stepped { pixels } else { 0 };
        let tiles = self.row.tiles_x * (rows.end - rows.start);
        Layout {
            rows,
            color,
            depth,
            alpha,
            blend,
            alpha_bytes,
            mask,
            steps,
            words,
            inner_words,
            pixels,
            slots,
            tiles,
        }
    }

    /// Rows of the table to blend. An empty table is one row of zeros.
    pub(super) fn table(&self) -> &[[f32; BLEND_WIDTH]] {
        match self.request.labels.table() {
            Some([]) => &[[0.0; BLEND_WIDTH]],
            Some(table) => &table[..table.len().min(1 << u16::BITS)],
            None => &[],
        }
    }

    /// Copies a band out of the read-back, if there was room for all of it.
    pub(super) fn take(&mut self, layout: &Layout, capacity: u32, read: &ReadBack<'_>) -> Ended {
        let ReadBack { plan, slots, .. } = *read;
        let mut ended = Ended { plan, complete: false, more_slots: None };
        if plan.needed > capacity {
            return ended;
        }
        let counts = &slots[..slots.len().min(layout.pixels as usize)];
        let weights = counts.iter().copied().max().unwrap_or(0);
        if weights > layout.slots {
            ended.more_slots = Some(layout.slots.saturating_mul(WEIGHT_SLOTS_GROWTH));
            return ended;
        }
        self.store(layout, read);
        self.weights_max = self.weights_max.max(weights);
        let stats = &mut self.frame.stats;
        stats.visible = stats.visible.max(u64::from(plan.visible));
        stats.intersections += u64::from(plan.isects);
        Ended { complete: true, ..ended }
    }

    /// Copies the pictures and weights of a band out of the read-back.
    fn store(&mut self, layout: &Layout, &ReadBack { plan, pictures, slots }: &ReadBack<'_>) {
        let pixels = layout.pixels as usize;
        let width = self.row.width as usize;
        let all = width * self.row.height as usize;
        let part = |start: u32, words: usize| {
            let start = start as usize * 4;
            &pictures[start..start + pixels * words * 4]
        };
        let from = |start: u32| &pictures[start as usize * 4..];
        let rows = pixels / width;
        let Frame { color, depth, alpha, levels, blend, mask, .. } = &mut self.frame;
        if let Some(color) = color {
            append(color, all, part(layout.color, 3), |color| color);
        }
        if let Some(rgb) = &mut levels.rgb {
            append_rows(rgb, all, from(layout.color), [width, rows]);
        }
        if let Some(rgba) = &mut levels.rgba {
            append(rgba, all, part(layout.color, 1), |word: [u8; 4]| word);
        }
        if let Some(alpha) = &mut levels.alpha {
            append_rows(alpha, all, from(layout.alpha_bytes), [width, rows]);
        }
        if let Some(alpha) = alpha {
            append(alpha, all, part(layout.alpha, 1), |alpha| alpha);
        }
        if layout.steps != NO_PICTURE {
            let mut steps = Vec::new();
            append_rows(&mut steps, all, from(layout.steps), [width, rows]);
            levels.depth =
                Some(DepthSteps { steps, ..DepthSteps::to(f32::from_bits(plan.farthest)) });
            *depth = None;
        } else if let Some(depth) = depth {
            append(depth, all, part(layout.depth, 1), |depth| depth);
        }
        if let Some(blend) = blend {
            append(blend, all, part(layout.blend, BLEND_WIDTH), |row| row);
        }
        if let Some(mask) = mask {
            append_rows(mask, all, from(layout.mask), [width, rows]);
        }
        if layout.slots > 0 {
            self.weights.push(weight_rows(slots, layout, width));
        }
    }
}

/// Copies the values that `bytes` hold to the end of `to`, which gets `all` values in the end; many
/// by all cores, for most of the time goes into new pages.
fn append<F: Pod + Send + Sync, T: Send>(
    to: &mut Vec<T>,
    all: usize,
    bytes: &[u8],
    read: impl Fn(F) -> T + Send + Sync,
) {
    let values: &[F] = bytemuck::cast_slice(bytes);
    to.reserve_exact(all - to.len());
    if bytes.len() < PARALLEL_BYTES {
        to.extend(values.iter().map(|value| read(*value)));
    } else {
        let values = values.par_iter().with_min_len(PARALLEL_BYTES / 16);
        to.par_extend(values.map(|value| read(*value)));
    }
}

/// Copies rows of numbers that share words to the end of `to`, as [`append`] does.
fn append_rows<T: Pod + Send + Sync>(
    to: &mut Vec<T>,
    all: usize,
    bytes: &[u8],
    [width, rows]: [usize; 2],
) {
    let stride = (width * size_of::<T>()).next_multiple_of(4);
    if stride == width * size_of::<T>() {
        return append(to, all, &bytes[..stride * rows], |value| value);
    }
    to.reserve_exact(all - to.len());
    for row in bytes.chunks_exact(stride).take(rows) {
        to.extend_from_slice(bytemuck::cast_slice(&row[..width * size_of::<T>()]));
    }
}

/// The weights of a band's pixels, ascending, out of its slots.
fn weight_rows(slots: &[u32], layout: &Layout, width: usize) -> WeightRows {
    let pixels = layout.pixels as usize;
    let mut rows = WeightRows::new(pixels / width, width);
    let mut pixel = Vec::with_capacity(layout.slots as usize);
    for (i, &count) in slots[..pixels].iter().enumerate() {
        let plane = |slot: usize| pixels * (1 + slot) + i;
        pixel.clear();
        pixel.extend((0..count as usize).map(|slot| {
            let weight = f32::from_bits(slots[plane(2 * slot + 1)]);
            (slots[plane(2 * slot)] as u16, weight)
        }));
        pixel.sort_unstable_by_key(|pair| pair.0);
        for &(entry, weight) in &pixel {
            rows.push(i % width, i / width, entry, weight);
        }
    }
    rows
}
