//! One frame: its bands, the room for its Gaussian-tile pairs, its pictures read back.

use std::ops::Range;

use super::{
    buffers::{PlanRow, Scene, ViewRow},
    device::Gpu,
    pipelines::{Kernels, NO_PICTURE},
    readback,
    recorder::{PairCount, Recorder, Scratch, footprint_bytes},
};
use crate::{
    error::{Error, Result},
    render::{
        Entries, Frame, FrameStats, Kinds, Labels, RenderRequest, constants::TILE_SIZE, view::View,
    },
};

/// Fewest Gaussian-tile pairs that room is made for.
const ISECT_CAPACITY_MIN: u32 = 1 << 16;
/// Times a band is drawn: the first may lack room, the second knows what it needs.
const ATTEMPTS_MAX: u32 = 3;
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

/// Where each picture of a band starts in the buffer of pictures, in floats.
struct Layout {
    color: u32,
    depth: u32,
    alpha: u32,
    floats: u64,
}

impl Layout {
    fn new(kinds: Kinds, pixels: u64) -> Self {
        let mut floats = 0;
        let mut take = |wanted: bool, channels: u64| {
            let start = if wanted { floats as u32 } else { NO_PICTURE };
            floats += if wanted { channels * pixels } else { 0 };
            start
        };
        let color = take(kinds.color, 3);
        let depth = take(kinds.depth, 1);
        let alpha = take(kinds.alpha, 1);
        Self { color, depth, alpha, floats }
    }
}

/// A frame being drawn.
pub(super) struct Drawing<'a> {
    pub(super) gpu: &'a Gpu,
    pub(super) kernels: &'a Kernels,
    pub(super) scratch: &'a mut Scratch,
    pub(super) scene: &'a Scene,
    pub(super) row: ViewRow,
    pub(super) kinds: Kinds,
    pub(super) isects_max: u32,
    pub(super) frame: Frame,
}

impl Drawing<'_> {
    /// Draws the tile rows `rows`; halves them while they are over a limit of the adapter.
    pub(super) fn rows(&mut self, rows: Range<u32>) -> Result<()> {
        let pixel_rows = (rows.end * TILE_SIZE).min(self.row.height) - rows.start * TILE_SIZE;
        let layout = Layout::new(self.kinds, u64::from(pixel_rows) * u64::from(self.row.width));
        let tiles = self.row.tiles_x * (rows.end - rows.start);
        let single = rows.end - rows.start == 1;
        let floats_max = (self.gpu.binding_bytes_max - PLAN_BYTES) / 4;
        if single || layout.floats.max(u64::from(tiles) + 1) <= floats_max {
            let Some(needed) = self.band(&rows, &layout, tiles)? else { return Ok(()) };
            if single {
                return Err(Error::limit(
                    "render: Gaussian-tile pairs in one row of tiles",
                    needed,
                    self.capacity_max(),
                ));
            }
        }
        let middle = rows.start.midpoint(rows.end);
        self.rows(rows.start..middle)?;
        self.rows(middle..rows.end)
    }

    fn capacity_max(&self) -> u32 {
        let bound = u32::try_from(self.gpu.binding_bytes_max / 4).unwrap_or(u32::MAX);
        self.isects_max.min(bound)
    }

    /// Draws one band into the frame; the pairs that it has when they are too many for one band.
    fn band(&mut self, rows: &Range<u32>, layout: &Layout, tiles: u32) -> Result<Option<u32>> {
        let capacity_max = self.capacity_max();
        let guess = self.row.gaussian_count.saturating_mul(4).max(ISECT_CAPACITY_MIN);
        let mut capacity = self.scratch.isect_capacity().max(guess).min(capacity_max);
        for _ in 0..ATTEMPTS_MAX {
            let plan = self.attempt(rows, layout, tiles, capacity)?;
            if plan.needed <= capacity {
                let stats = &mut self.frame.stats;
                stats.visible = stats.visible.max(u64::from(plan.visible));
                stats.intersections += u64::from(plan.isects);
                return Ok(None);
            }
            if plan.needed > capacity_max {
                return Ok(Some(plan.needed));
            }
            // A quarter more: the next camera sees about as much.
            capacity = plan.needed.saturating_add(plan.needed / 4).min(capacity_max);
        }
        Err(Error::internal("render: the need of tile pairs grew from one attempt to the next"))
    }

    /// All stages over one band, with room for `capacity` pairs.
    fn attempt(
        &mut self,
        rows: &Range<u32>,
        layout: &Layout,
        tiles: u32,
        capacity: u32,
    ) -> Result<PlanRow> {
        let (gpu, scratch, scene) = (self.gpu, &mut *self.scratch, self.scene);
        let count = self.row.gaussian_count;
        let row = ViewRow {
            row_start: rows.start,
            row_end: rows.end,
            isect_capacity: capacity,
            color_start: layout.color,
            depth_start: layout.depth,
            alpha_start: layout.alpha,
            ..self.row
        };
        let picture_bytes = layout.floats * 4;
        let view = scratch.view.ensure(gpu, size_of::<ViewRow>() as u64)?;
        let footprints = scratch.footprints.ensure(gpu, footprint_bytes(count))?;
        let shaded = scratch.shaded.ensure(gpu, footprint_bytes(count))?;
        let isect_offsets = scratch.isect_offsets.ensure(gpu, u64::from(count) * 4)?;
        let depth_pairs = scratch.depth_pairs(gpu, count)?;
        let isect_pairs = scratch.isect_pairs(gpu, capacity)?;
        let ranges = scratch.ranges.ensure(gpu, (u64::from(tiles) + 1) * 4)?;
        let pictures = scratch.pictures.ensure(gpu, picture_bytes)?;
        let staging = scratch.staging.ensure(gpu, PLAN_BYTES + picture_bytes)?;
        let submission = gpu.scoped("render", || {
            gpu.queue.write_buffer(&view, 0, bytemuck::bytes_of(&row));
            let mut stages = Recorder::new(gpu, self.kernels, scratch, count.max(capacity))?;
            stages.project(&view, &scene.gaussians, &footprints, &depth_pairs, count);
            let by_depth = stages.sort(&depth_pairs, PairCount::Known(count), u32::BITS);
            let ids = &depth_pairs.values[by_depth];
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
            stages.rasterize(&view, &shaded, ids, &ranges, &pictures, grid);
            let plan = stages.plan.clone();
            Ok(stages.submit(&[
                (&plan, 0, &staging, 0, PLAN_BYTES),
                (&pictures, 0, &staging, PLAN_BYTES, picture_bytes),
            ]))
        })??;
        let first = rows.start as usize * (TILE_SIZE * row.width) as usize;
        readback::read(gpu, submission, &staging, PLAN_BYTES + picture_bytes, |bytes| {
            let (plan, pictures) = bytes.split_at(PLAN_BYTES as usize);
            let plan: PlanRow = bytemuck::pod_read_unaligned(plan);
            if plan.needed <= capacity {
                store(&mut self.frame, layout, pictures, first);
            }
            plan
        })
    }
}

/// Copies the pictures of a band to the frame, from pixel `first` on.
fn store(frame: &mut Frame, layout: &Layout, pictures: &[u8], first: usize) {
    let end = layout.floats as usize * 4;
    let part = |start: u32, stop: &[u32]| {
        // A picture ends where the next one that was asked for starts.
        let stop = stop.iter().find(|&&stop| stop != NO_PICTURE);
        &pictures[start as usize * 4..stop.map_or(end, |&stop| stop as usize * 4)]
    };
    let copy = |out: &mut [u8], from: &[u8]| out[..from.len()].copy_from_slice(from);
    if let Some(color) = &mut frame.color {
        let from = part(layout.color, &[layout.depth, layout.alpha]);
        copy(bytemuck::cast_slice_mut(&mut color[first..]), from);
    }
    if let Some(depth) = &mut frame.depth {
        let from = part(layout.depth, &[layout.alpha]);
        copy(bytemuck::cast_slice_mut(&mut depth[first..]), from);
    }
    if let Some(alpha) = &mut frame.alpha {
        copy(bytemuck::cast_slice_mut(&mut alpha[first..]), part(layout.alpha, &[]));
    }
}
