//! One frame: its bands, the room for its Gaussian-tile pairs, its pictures read back.

use std::ops::Range;

use super::{
    buffers::{PlanRow, Scene, SceneLabels, ViewRow},
    device::Gpu,
    pipelines::{Kernels, NO_PICTURE},
    readback,
    recorder::{ENTRY_SLOTS_MIN, LabelBuffers, PairCount, Recorder, Scratch, footprint_bytes},
};
use crate::{
    error::{Error, Result},
    render::{
        Entries, Frame, FrameStats, Kinds, Labels, RenderRequest,
        constants::TILE_SIZE,
        labels::{BLEND_WIDTH, EntryRows},
        view::View,
    },
};

/// Fewest Gaussian-tile pairs that room is made for.
const ISECT_CAPACITY_MIN: u32 = 1 << 16;
/// Times a band is drawn: the first may lack room, the second knows what it needs.
const ATTEMPTS_MAX: u32 = 3;
/// How much more room for entries is made when it does not suffice.
const ENTRY_SLOTS_GROWTH: u32 = 4;
const PLAN_BYTES: u64 = size_of::<PlanRow>() as u64;

/// A frame without Gaussians.
pub(super) fn background(view: &View, request: &RenderRequest) -> Frame {
    let pixels = view.width as usize * view.height as usize;
    Frame {
        width: view.width,
        height: view.height,
        color: request.kinds.color.then(|| vec![request.background; pixels]),
        depth: request.kinds.depth.then(|| vec![0.0; pixels]),
        alpha: request.kinds.alpha.then(|| vec![0.0; pixels]),
        blend: matches!(request.labels, Labels::Blend(_)).then(|| vec![[0.0; 4]; pixels]),
        entries: (request.labels == Labels::Entries).then(|| Entries::none(pixels)),
        stats: FrameStats::default(),
    }
}

/// Where each picture of a band starts in the buffer of pictures, in floats; and its entry slots.
struct Layout {
    color: u32,
    depth: u32,
    alpha: u32,
    blend: u32,
    floats: u64,
    /// Pixels of the band.
    pixels: u64,
    /// Entries a pixel has room for; 0 where none are wanted.
    slots: u32,
}

impl Layout {
    fn new(kinds: Kinds, labels: &Labels, pixels: u64, slots: u32) -> Self {
        let mut floats = 0;
        let mut take = |wanted: bool, channels: u64| {
            let start = if wanted { floats as u32 } else { NO_PICTURE };
            floats += if wanted { channels * pixels } else { 0 };
            start
        };
        let color = take(kinds.color, 3);
        let depth = take(kinds.depth, 1);
        let alpha = take(kinds.alpha, 1);
        let blend = take(matches!(labels, Labels::Blend(_)), BLEND_WIDTH as u64);
        Self { color, depth, alpha, blend, floats, pixels, slots }
    }

    fn picture_bytes(&self) -> u64 {
        self.floats * 4
    }

    /// A count a pixel, then an index and a weight a slot.
    fn slot_bytes(&self) -> u64 {
        if self.slots == 0 { 0 } else { self.pixels * 4 * (1 + 2 * u64::from(self.slots)) }
    }
}

/// How an attempt at a band ended.
enum Outcome {
    /// In the frame.
    Drawn,
    /// So many tile pairs are too many for one band.
    Pairs(u32),
    /// A pixel has more entries than room; there is more room now.
    Slots,
}

/// A frame being drawn.
pub(super) struct Drawing<'a> {
    pub(super) gpu: &'a Gpu,
    pub(super) kernels: &'a Kernels,
    pub(super) scratch: &'a mut Scratch,
    pub(super) scene: &'a Scene,
    pub(super) row: ViewRow,
    pub(super) kinds: Kinds,
    pub(super) wanted: &'a Labels,
    /// The scene's bank indices, where labels are wanted.
    pub(super) labels: Option<&'a SceneLabels>,
    pub(super) isects_max: u32,
    pub(super) frame: Frame,
    /// Entries of the bands drawn, from top to bottom.
    pub(super) entries: Vec<EntryRows>,
    /// Most entries of a pixel in them.
    pub(super) entries_max: u32,
}

impl Drawing<'_> {
    /// The frame of all bands.
    pub(super) fn finish(mut self) -> Result<Frame> {
        if *self.wanted == Labels::Entries {
            // The next view needs about as much; one odd view makes room for itself alone.
            self.scratch.entry_slots = self.entries_max.next_power_of_two().max(ENTRY_SLOTS_MIN);
            self.frame.entries = Some(Entries::join(self.entries)?);
        }
        Ok(self.frame)
    }

    /// Draws the tile rows `rows`; halves them while they are over a limit of the adapter.
    pub(super) fn rows(&mut self, rows: Range<u32>) -> Result<()> {
        let pixel_rows = (rows.end * TILE_SIZE).min(self.row.height) - rows.start * TILE_SIZE;
        let pixels = u64::from(pixel_rows) * u64::from(self.row.width);
        let layout = Layout::new(self.kinds, self.wanted, pixels, self.entry_slots());
        let tiles = self.row.tiles_x * (rows.end - rows.start);
        let single = rows.end - rows.start == 1;
        let bytes = layout.picture_bytes() + layout.slot_bytes();
        let bytes_max = self.gpu.binding_bytes_max - PLAN_BYTES;
        if single || bytes.max((u64::from(tiles) + 1) * 4) <= bytes_max {
            match self.band(&rows, &layout, tiles)? {
                Outcome::Drawn => return Ok(()),
                // Whether the band still fits is asked again; slots grow to a bound.
                Outcome::Slots => return self.rows(rows),
                Outcome::Pairs(needed) if single => {
                    return Err(Error::limit(
                        "render: Gaussian-tile pairs in one row of tiles",
                        needed,
                        self.capacity_max(),
                    ));
                }
                Outcome::Pairs(_) => {}
            }
        }
        let middle = rows.start.midpoint(rows.end);
        self.rows(rows.start..middle)?;
        self.rows(middle..rows.end)
    }

    /// Entries to make room for: as many as the last views needed, never more than there can be.
    fn entry_slots(&self) -> u32 {
        match (self.wanted, self.labels) {
            (Labels::Entries, Some(labels)) => self.scratch.entry_slots.min(labels.distinct.max(1)),
            _ => 0,
        }
    }

    fn capacity_max(&self) -> u32 {
        let bound = u32::try_from(self.gpu.binding_bytes_max / 4).unwrap_or(u32::MAX);
        self.isects_max.min(bound)
    }

    /// Draws one band into the frame.
    fn band(&mut self, rows: &Range<u32>, layout: &Layout, tiles: u32) -> Result<Outcome> {
        let capacity_max = self.capacity_max();
        let guess = self.row.gaussian_count.saturating_mul(4).max(ISECT_CAPACITY_MIN);
        let mut capacity = self.scratch.isect_capacity().max(guess).min(capacity_max);
        for _ in 0..ATTEMPTS_MAX {
            let (plan, entries) = self.attempt(rows, layout, tiles, capacity)?;
            if plan.needed <= capacity {
                if entries > layout.slots {
                    self.scratch.entry_slots = layout.slots.saturating_mul(ENTRY_SLOTS_GROWTH);
                    return Ok(Outcome::Slots);
                }
                self.entries_max = self.entries_max.max(entries);
                let stats = &mut self.frame.stats;
                stats.visible = stats.visible.max(u64::from(plan.visible));
                stats.intersections += u64::from(plan.isects);
                return Ok(Outcome::Drawn);
            }
            if plan.needed > capacity_max {
                return Ok(Outcome::Pairs(plan.needed));
            }
            // A quarter more: the next camera sees about as much.
            capacity = plan.needed.saturating_add(plan.needed / 4).min(capacity_max);
        }
        Err(Error::internal("render: the need of tile pairs grew from one attempt to the next"))
    }

    /// All stages over one band, with room for `capacity` pairs; also the most entries of a pixel.
    fn attempt(
        &mut self,
        rows: &Range<u32>,
        layout: &Layout,
        tiles: u32,
        capacity: u32,
    ) -> Result<(PlanRow, u32)> {
        let (gpu, scratch, scene) = (self.gpu, &mut *self.scratch, self.scene);
        let count = self.row.gaussian_count;
        // An empty table is one row of zeros.
        let table = match self.wanted {
            Labels::Blend(table) if table.is_empty() => &[[0.0; BLEND_WIDTH]],
            Labels::Blend(table) => &table[..table.len().min(1 << u16::BITS)],
            _ => &[],
        };
        let label_rows = table.len() as u32;
        let table_bytes: &[u8] = bytemuck::cast_slice(table);
        let row = ViewRow {
            row_start: rows.start,
            row_end: rows.end,
            isect_capacity: capacity,
            color_start: layout.color,
            depth_start: layout.depth,
            alpha_start: layout.alpha,
            blend_start: layout.blend,
            label_rows,
            entry_slots: layout.slots,
            ..self.row
        };
        let (picture_bytes, slot_bytes) = (layout.picture_bytes(), layout.slot_bytes());
        let total_bytes = PLAN_BYTES + picture_bytes + slot_bytes;
        let view = scratch.view.ensure(gpu, size_of::<ViewRow>() as u64)?;
        let footprints = scratch.footprints.ensure(gpu, footprint_bytes(count))?;
        let shaded = scratch.shaded.ensure(gpu, footprint_bytes(count))?;
        let isect_offsets = scratch.isect_offsets.ensure(gpu, u64::from(count) * 4)?;
        let depth_pairs = scratch.depth_pairs(gpu, count)?;
        let isect_pairs = scratch.isect_pairs(gpu, capacity)?;
        let ranges = scratch.ranges.ensure(gpu, (u64::from(tiles) + 1) * 4)?;
        let pictures = scratch.pictures.ensure(gpu, picture_bytes)?;
        let staging = scratch.staging.ensure(gpu, total_bytes)?;
        let table = scratch.table.ensure(gpu, table_bytes.len() as u64)?;
        let slots = scratch.entries.ensure(gpu, slot_bytes)?;
        let submission = gpu.scoped("render", || {
            gpu.queue.write_buffer(&view, 0, bytemuck::bytes_of(&row));
            if !table_bytes.is_empty() {
                gpu.queue.write_buffer(&table, 0, table_bytes);
            }
            let mut stages = Recorder::new(gpu, self.kernels, scratch, count.max(capacity))?;
            stages.project(&view, &scene.gaussians, &footprints, &depth_pairs, count);
            let by_depth = stages.sort(&depth_pairs, PairCount::Known(count), u32::BITS);
            let ids = &depth_pairs.values[by_depth];
            let depth_ids = ids;
            let offsets = &isect_offsets;
            stages.shade(
                &view,
                &scene.gaussians,
                &scene.sh,
                &footprints,
                ids,
                &shaded,
                offsets,
                count,
            );
            stages.prefix_sum(offsets, count);
            stages.emit_isects(&view, &shaded, offsets, &isect_pairs, count);
            let tile_bits = u32::BITS - (tiles - 1).leading_zeros();
            let by_tile = stages.sort(&isect_pairs, PairCount::Planned(capacity), tile_bits);
            stages.tile_ranges(&view, &isect_pairs.keys[by_tile], &ranges);
            let grid = [row.tiles_x, rows.end - rows.start];
            let ids = &isect_pairs.values[by_tile];
            let labels = match (self.wanted, self.labels) {
                (Labels::Blend(_), Some(SceneLabels { index, .. })) => {
                    LabelBuffers::Blend { depth_ids, index, table: &table }
                }
                (Labels::Entries, Some(SceneLabels { index, .. })) => {
                    LabelBuffers::Entries { depth_ids, index, slots: &slots }
                }
                _ => LabelBuffers::None,
            };
            stages.rasterize(&view, &shaded, ids, &ranges, &pictures, &labels, grid);
            let plan = stages.plan.clone();
            Ok(stages.submit(&[
                (&plan, 0, &staging, 0, PLAN_BYTES),
                (&pictures, 0, &staging, PLAN_BYTES, picture_bytes),
                (&slots, 0, &staging, PLAN_BYTES + picture_bytes, slot_bytes),
            ]))
        })??;
        let first = rows.start as usize * (TILE_SIZE * row.width) as usize;
        readback::read(gpu, submission, &staging, total_bytes, |bytes| {
            let (plan, rest) = bytes.split_at(PLAN_BYTES as usize);
            let (pictures, slots) = rest.split_at(picture_bytes as usize);
            let plan: PlanRow = bytemuck::pod_read_unaligned(plan);
            let mut entries = 0;
            if plan.needed <= capacity {
                let slots: &[u32] = bytemuck::cast_slice(slots);
                let counts = &slots[..slots.len().min(layout.pixels as usize)];
                entries = counts.iter().copied().max().unwrap_or(0);
                if entries <= layout.slots {
                    store(&mut self.frame, layout, pictures, first);
                    if layout.slots > 0 {
                        self.entries.push(entry_rows(slots, layout, row.width as usize));
                    }
                }
            }
            (plan, entries)
        })
    }
}

/// The entries of a band's pixels, ascending, out of its slots.
fn entry_rows(slots: &[u32], layout: &Layout, width: usize) -> EntryRows {
    let pixels = layout.pixels as usize;
    let mut rows = EntryRows::new(pixels / width, width);
    let mut pixel = Vec::with_capacity(layout.slots as usize);
    for (i, &count) in slots[..pixels].iter().enumerate() {
        let plane = |slot: usize| pixels * (1 + slot) + i;
        let held = (0..count as usize).map(|slot| {
            let weight = f32::from_bits(slots[plane(2 * slot + 1)]);
            (slots[plane(2 * slot)] as u16, weight)
        });
        pixel.clear();
        pixel.extend(held);
        pixel.sort_unstable_by_key(|entry| entry.0);
        for &(index, weight) in &pixel {
            rows.push(i % width, i / width, index, weight);
        }
    }
    rows
}

/// Copies the pictures of a band to the frame, from pixel `first` on.
fn store(frame: &mut Frame, layout: &Layout, pictures: &[u8], first: usize) {
    let pixels = layout.pixels as usize;
    let part = |start: u32, channels: usize| {
        let start = start as usize * 4;
        &pictures[start..start + pixels * channels * 4]
    };
    let copy = |out: &mut [u8], from: &[u8]| out[..from.len()].copy_from_slice(from);
    if let Some(color) = &mut frame.color {
        copy(bytemuck::cast_slice_mut(&mut color[first..]), part(layout.color, 3));
    }
    if let Some(depth) = &mut frame.depth {
        copy(bytemuck::cast_slice_mut(&mut depth[first..]), part(layout.depth, 1));
    }
    if let Some(alpha) = &mut frame.alpha {
        copy(bytemuck::cast_slice_mut(&mut alpha[first..]), part(layout.alpha, 1));
    }
    if let Some(blend) = &mut frame.blend {
        copy(bytemuck::cast_slice_mut(&mut blend[first..]), part(layout.blend, BLEND_WIDTH));
    }
}
