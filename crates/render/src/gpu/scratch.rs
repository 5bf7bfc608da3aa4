//! Buffers of a batch of views. They grow and serve the next batch too.

use wgpu::BufferUsages;

use super::{
    buffers::{FootprintRow, PlanRow, Slot, SortParams, ViewRow},
    device::Gpu,
    pipelines::{GROUPS_RANGES, SCAN_BLOCK, SORT_BLOCK, VIEWS_MAX},
    recorder::{Bindings, DIGIT_BITS, DIGITS, DIGITS_MAX},
};
use crate::error::Result;

/// First room of a pixel, in weights: a pixel at an edge of an object shows about as many entries.
pub(super) const ENTRY_SLOTS_MIN: u32 = 8;
/// Distance of two uniforms in the table of parameters: the portable alignment.
const PARAMS_STRIDE: u64 = 256;
const VIEW_BYTES: u64 = size_of::<ViewRow>() as u64 * VIEWS_MAX as u64;
const GROUPS_BYTES: u64 = 16 * (GROUPS_RANGES as u64 + 1);

/// Sizes of a batch.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Need {
    pub(super) views: u32,
    /// Gaussians of the scene.
    pub(super) count: u32,
    /// Tile pairs of each view.
    pub(super) capacity: u32,
    /// Numbers of tile ranges, of all views.
    pub(super) ranges: u32,
    /// Whether shade has colours to write.
    pub(super) shades: bool,
    pub(super) picture_bytes: u64,
    pub(super) table_bytes: u64,
    pub(super) slot_bytes: u64,
    pub(super) staging_bytes: u64,
}

/// The buffers of one batch, each at least as large as needed.
#[derive(Clone, Debug)]
pub(super) struct BatchBuffers {
    pub(super) views: wgpu::Buffer,
    pub(super) params: wgpu::Buffer,
    pub(super) plans: wgpu::Buffer,
    pub(super) groups: wgpu::Buffer,
    /// Bound in place of `groups` where a kernel is sized by them.
    pub(super) groups_unasked: wgpu::Buffer,
    pub(super) footprints: wgpu::Buffer,
    pub(super) tiles: wgpu::Buffer,
    /// Two halves of all views, as the three after it.
    pub(super) depth_keys: wgpu::Buffer,
    pub(super) depth_ids: wgpu::Buffer,
    pub(super) tile_keys: wgpu::Buffer,
    pub(super) isect_ids: wgpu::Buffer,
    pub(super) digit_counts: wgpu::Buffer,
    pub(super) block_sums: wgpu::Buffer,
    pub(super) colors: wgpu::Buffer,
    pub(super) ranges: wgpu::Buffer,
    pub(super) pictures: wgpu::Buffer,
    pub(super) table: wgpu::Buffer,
    pub(super) slots: wgpu::Buffer,
    pub(super) staging: wgpu::Buffer,
}

/// Slots of a room, and what the last views needed.
#[derive(Debug)]
pub(super) struct Scratch {
    views: Slot,
    params: Option<wgpu::Buffer>,
    plans: Slot,
    groups: Slot,
    groups_unasked: Slot,
    footprints: Slot,
    tiles: Slot,
    depth_keys: Slot,
    depth_ids: Slot,
    tile_keys: Slot,
    isect_ids: Slot,
    digit_counts: Slot,
    block_sums: Slot,
    colors: Slot,
    ranges: Slot,
    pictures: Slot,
    table: Slot,
    slots: Slot,
    staging: Slot,
    pub(super) bindings: Bindings,
    /// Tile pairs of a view that the last views needed.
    pub(super) isects: u32,
    /// Entries a pixel that the last views needed.
    pub(super) weight_slots: u32,
}

impl Default for Scratch {
    fn default() -> Self {
        let uniform = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        let copied = BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
        Self {
            views: Slot::new("views", uniform),
            params: None,
            plans: Slot::storage("plans"),
            groups: Slot::new("groups", copied | BufferUsages::INDIRECT),
            groups_unasked: Slot::storage("groups unasked"),
            footprints: Slot::storage("footprints"),
            tiles: Slot::storage("tiles of Gaussians"),
            depth_keys: Slot::storage("depth keys"),
            depth_ids: Slot::storage("depth order"),
            tile_keys: Slot::storage("tile keys"),
            isect_ids: Slot::storage("tile pairs"),
            digit_counts: Slot::storage("digit counts"),
            block_sums: Slot::storage("block sums"),
            colors: Slot::storage("colours"),
            ranges: Slot::storage("tile ranges"),
            pictures: Slot::storage("pictures"),
            table: Slot::storage("label table"),
            slots: Slot::storage("entry slots"),
            staging: Slot::new("staging", BufferUsages::MAP_READ | BufferUsages::COPY_DST),
            bindings: Bindings::default(),
            isects: 0,
            weight_slots: ENTRY_SLOTS_MIN,
        }
    }
}

impl Scratch {
    /// Buffers for `need`.
    ///
    /// # Errors
    /// `limit_exceeded` when the adapter cannot hold or bind as much.
    pub(super) fn room(&mut self, gpu: &Gpu, need: &Need) -> Result<BatchBuffers> {
        let (views, count, capacity) =
            (u64::from(need.views), u64::from(need.count), u64::from(need.capacity));
        let sorted = count.max(capacity);
        let digits = u64::from(DIGITS) * (sorted.div_ceil(u64::from(SORT_BLOCK)) + 1);
        let color_bytes = if need.shades { views * count * 12 } else { 0 };
        let params = match &self.params {
            Some(params) => params.clone(),
            None => self.params.insert(upload_params(gpu)?).clone(),
        };
        Ok(BatchBuffers {
            views: self.views.ensure(gpu, VIEW_BYTES)?,
            params,
            plans: self.plans.ensure(gpu, views * size_of::<PlanRow>() as u64)?,
            groups: self.groups.ensure(gpu, GROUPS_BYTES)?,
            groups_unasked: self.groups_unasked.ensure(gpu, GROUPS_BYTES)?,
            footprints: self
                .footprints
                .ensure(gpu, views * count * size_of::<FootprintRow>() as u64)?,
            tiles: self.tiles.ensure(gpu, views * count * 4)?,
            depth_keys: self.depth_keys.ensure(gpu, views * count * 8)?,
            depth_ids: self.depth_ids.ensure(gpu, views * count * 8)?,
            tile_keys: self.tile_keys.ensure(gpu, views * capacity * 8)?,
            isect_ids: self.isect_ids.ensure(gpu, views * capacity * 8)?,
            digit_counts: self.digit_counts.ensure(gpu, views * digits * 4)?,
            block_sums: self
                .block_sums
                .ensure(gpu, views * count.div_ceil(u64::from(SCAN_BLOCK)) * 4)?,
            colors: self.colors.ensure(gpu, color_bytes)?,
            ranges: self.ranges.ensure(gpu, u64::from(need.ranges) * 4)?,
            pictures: self.pictures.ensure(gpu, need.picture_bytes)?,
            table: self.table.ensure(gpu, need.table_bytes)?,
            slots: self.slots.ensure(gpu, need.slot_bytes)?,
            staging: self.staging.ensure(gpu, need.staging_bytes)?,
        })
    }
}

impl BatchBuffers {
    /// Sets what the stages start from: the cameras, empty plans, no groups asked for.
    pub(super) fn begin(&self, gpu: &Gpu, views: &[ViewRow]) {
        let plans = vec![PlanRow::default(); views.len()];
        gpu.queue.write_buffer(&self.views, 0, bytemuck::cast_slice(views));
        gpu.queue.write_buffer(&self.plans, 0, bytemuck::cast_slice(&plans));
        gpu.queue.write_buffer(&self.groups, 0, &[0; GROUPS_BYTES as usize]);
    }
}

/// Place of a digit's parameters in the table of all.
pub(super) fn params_of(digit: SortParams) -> u64 {
    u64::from(digit.by_tile * DIGITS_MAX + digit.pass_at) * PARAMS_STRIDE
}

fn upload_params(gpu: &Gpu) -> Result<wgpu::Buffer> {
    let mut bytes = vec![0; (PARAMS_STRIDE * u64::from(2 * DIGITS_MAX)) as usize];
    for by_tile in 0..2 {
        for pass_at in 0..DIGITS_MAX {
            let digit = SortParams { shift: pass_at * DIGIT_BITS, pass_at, by_tile, reserved: 0 };
            let at = params_of(digit) as usize;
            bytes[at..at + size_of::<SortParams>()].copy_from_slice(bytemuck::bytes_of(&digit));
        }
    }
    let usage = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
    let buffer = gpu.create_buffer("sort parameters", bytes.len() as u64, usage)?;
    gpu.queue.write_buffer(&buffer, 0, &bytes);
    Ok(buffer)
}
