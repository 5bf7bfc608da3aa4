//! Buffers of a batch of views. They grow and serve the next batch too.

use std::collections::HashMap;

use wgpu::BufferUsages;

use super::{
    buffers::{FootprintRow, PlanRow, SortParams, ViewRow},
    device::{Gpu, STORAGE},
    pipelines::{GROUPS_RANGES, SCAN_BLOCK, SORT_BLOCK, VIEWS_MAX},
    recorder::{Bindings, DIGIT_BITS, DIGITS, DIGITS_MAX},
};
use crate::error::Result;

/// First room of a pixel, in weights: a pixel at an edge of an object shows about as many entries.
pub(super) const WEIGHT_SLOTS_MIN: u32 = 8;
/// Distance of two uniforms in the table of parameters: the portable alignment.
const PARAMS_STRIDE: u64 = 256;
const VIEW_BYTES: u64 = size_of::<ViewRow>() as u64 * VIEWS_MAX as u64;
const GROUPS_BYTES: u64 = 16 * (GROUPS_RANGES as u64 + 1);
const UNIFORM: BufferUsages = BufferUsages::UNIFORM.union(BufferUsages::COPY_DST);

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

/// Buffers of earlier batches, and what the last views needed.
#[derive(Debug)]
pub(super) struct Scratch {
    /// By their labels. Their contents are undefined between frames.
    buffers: HashMap<&'static str, wgpu::Buffer>,
    params: Option<wgpu::Buffer>,
    pub(super) bindings: Bindings,
    /// Tile pairs of a view that the last views needed.
    pub(super) isects: u32,
    /// Weights a pixel that the last views needed.
    pub(super) weight_slots: u32,
}

impl Default for Scratch {
    fn default() -> Self {
        Self {
            buffers: HashMap::new(),
            params: None,
            bindings: Bindings::default(),
            isects: 0,
            weight_slots: WEIGHT_SLOTS_MIN,
        }
    }
}

impl Scratch {
    /// Buffers for `need`.
    /// Errors: `limit_exceeded` when the adapter cannot hold or bind as much.
    pub(super) fn room(&mut self, gpu: &Gpu, need: &Need) -> Result<BatchBuffers> {
        let (views, count, capacity) =
            (u64::from(need.views), u64::from(need.count), u64::from(need.capacity));
        let footprint_bytes = size_of::<FootprintRow>() as u64;
        let digits = u64::from(DIGITS) * (count.max(capacity).div_ceil(SORT_BLOCK.into()) + 1);
        let blocks = count.div_ceil(SCAN_BLOCK.into());
        let color_bytes = if need.shades { views * count * 12 } else { 0 };
        let params = match &self.params {
            Some(params) => params.clone(),
            None => self.params.insert(upload_params(gpu)?).clone(),
        };
        let mut sized = |label, usage, size_bytes| self.sized(gpu, label, usage, size_bytes);
        let staging = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        let views_buffer = sized("views", UNIFORM, VIEW_BYTES)?;
        let groups = sized("groups", STORAGE | BufferUsages::INDIRECT, GROUPS_BYTES)?;
        let staging = sized("staging", staging, need.staging_bytes)?;
        let mut storage = |label, size_bytes| sized(label, STORAGE, size_bytes);
        Ok(BatchBuffers {
            views: views_buffer,
            params,
            plans: storage("plans", views * size_of::<PlanRow>() as u64)?,
            groups,
            groups_unasked: storage("groups unasked", GROUPS_BYTES)?,
            footprints: storage("footprints", views * count * footprint_bytes)?,
            tiles: storage("tiles of Gaussians", views * count * 4)?,
            depth_keys: storage("depth keys", views * count * 8)?,
            depth_ids: storage("depth order", views * count * 8)?,
            tile_keys: storage("tile keys", views * capacity * 8)?,
            isect_ids: storage("tile pairs", views * capacity * 8)?,
            digit_counts: storage("digit counts", views * digits * 4)?,
            block_sums: storage("block sums", views * blocks * 4)?,
            colors: storage("colours", color_bytes)?,
            ranges: storage("tile ranges", u64::from(need.ranges) * 4)?,
            pictures: storage("pictures", need.picture_bytes)?,
            table: storage("label table", need.table_bytes)?,
            slots: storage("weight slots", need.slot_bytes)?,
            staging,
        })
    }

    /// The buffer of a label, replaced if it is shorter than `size_bytes`.
    /// Errors: `limit_exceeded` when the adapter cannot hold or bind that many bytes.
    fn sized(
        &mut self,
        gpu: &Gpu,
        label: &'static str,
        usage: BufferUsages,
        size_bytes: u64,
    ) -> Result<wgpu::Buffer> {
        if let Some(buffer) = self.buffers.get(label).filter(|one| one.size() >= size_bytes) {
            return Ok(buffer.clone());
        }
        // Free the old buffer before the new one is allocated.
        self.buffers.remove(label);
        let buffer = gpu.create_buffer(label, size_bytes, usage)?;
        self.buffers.insert(label, buffer.clone());
        Ok(buffer)
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

/// The parameters of digit `pass_at` of a sort.
pub(super) fn digit(by_tile: u32, pass_at: u32) -> SortParams {
    SortParams { shift: pass_at * DIGIT_BITS, pass_at, by_tile, reserved: 0 }
}

/// Place of a digit's parameters in the table of all.
pub(super) fn params_of(digit: SortParams) -> u64 {
    u64::from(digit.by_tile * DIGITS_MAX + digit.pass_at) * PARAMS_STRIDE
}

fn upload_params(gpu: &Gpu) -> Result<wgpu::Buffer> {
    let size_bytes = PARAMS_STRIDE * u64::from(2 * DIGITS_MAX);
    let buffer = gpu.create_buffer("sort parameters", size_bytes, UNIFORM)?;
    for one in (0..2 * DIGITS_MAX).map(|at| digit(at / DIGITS_MAX, at % DIGITS_MAX)) {
        gpu.queue.write_buffer(&buffer, params_of(one), bytemuck::bytes_of(&one));
    }
    Ok(buffer)
}
