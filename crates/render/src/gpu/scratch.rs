//! Buffers of a batch of views. They grow and serve the next batch too.

use std::{collections::HashMap, sync::Arc};

use wgpu::BufferUsages;

use super::{
    batch_buffers::{BackwardBuffers, BatchBuffers, BatchSizes},
    bindings::Bindings,
    buffers::{DeviceScene, FootprintRow, PlanRow, ViewRow},
    device::{Gpu, STORAGE},
    pipelines::{BACKDROP_HEIGHT, BACKDROP_WIDTH, VIEWS_MAX},
};
use crate::{error::Result, scene::Backdrop};

/// First room of a pixel, in weights: a pixel at an edge of an object shows about as many entries.
pub(super) const WEIGHT_SLOTS_MIN: u32 = 8;
const VIEW_BYTES: u64 = size_of::<ViewRow>() as u64 * VIEWS_MAX as u64;
/// Bytes of a backdrop: a word for each cell.
const BACKDROP_BYTES: u64 = 4 * (BACKDROP_WIDTH * BACKDROP_HEIGHT) as u64;
/// Workgroups along x, y and z.
const DISPATCH_BYTES: u64 = 12;
const UNIFORM: BufferUsages = BufferUsages::UNIFORM.union(BufferUsages::COPY_DST);

/// Buffers of earlier batches, and what the last views needed.
#[derive(Debug)]
pub(super) struct Scratch {
    /// By their labels. Their contents are undefined between frames.
    buffers: HashMap<&'static str, wgpu::Buffer>,
    pub(super) bindings: Bindings,
    /// Tile pairs of a view that the last views needed.
    pub(super) isects: u32,
    /// Weights a pixel that the last views needed.
    pub(super) weight_slots: u32,
    /// Those on the device, in their order.
    pub(super) backdrops: Vec<Arc<Backdrop>>,
    /// Gaussians of the last backward pass: a refinement brings others with each step, which take
    /// their place.
    pub(super) learnt: Option<DeviceScene>,
}

impl Default for Scratch {
    fn default() -> Self {
        Self {
            buffers: HashMap::new(),
            bindings: Bindings::default(),
            isects: 0,
            weight_slots: WEIGHT_SLOTS_MIN,
            backdrops: Vec::new(),
            learnt: None,
        }
    }
}

impl Scratch {
    /// Buffers for `need`.
    /// Errors: `limit_exceeded` when the adapter cannot hold or bind as much.
    pub(super) fn room(&mut self, gpu: &Gpu, need: &BatchSizes) -> Result<BatchBuffers> {
        let (views, count, capacity) =
            (u64::from(need.views), u64::from(need.count), u64::from(need.capacity));
        let footprint_bytes = size_of::<FootprintRow>() as u64;
        let tiles = u64::from(need.tiles);
        let color_bytes = if need.shades { views * count * 12 } else { 0 };
        let mut sized = |label, usage, size_bytes| self.sized(gpu, label, usage, size_bytes);
        let staging = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        let views_buffer = sized("views", UNIFORM, VIEW_BYTES)?;
        let staging = sized("staging", staging, need.staging_bytes)?;
        let dispatch = sized("dispatch", STORAGE | BufferUsages::INDIRECT, DISPATCH_BYTES)?;
        let mut storage = |label, size_bytes| sized(label, STORAGE, size_bytes);
        Ok(BatchBuffers {
            views: views_buffer,
            plans: storage("plans", views * size_of::<PlanRow>() as u64)?,
            footprints: storage("footprints", views * count * footprint_bytes)?,
            rows: storage("rows", views * u64::from(need.rows) * 4)?,
            touched: storage("tiles of Gaussians", views * count * 4)?,
            sources: storage("photos", need.source_bytes)?,
            backdrops: storage("backdrops", BACKDROP_BYTES * u64::from(VIEWS_MAX))?,
            colors: storage("colours", color_bytes)?,
            starts: storage("starts of lists", tiles * 4)?,
            ends: storage("ends of lists", tiles * 4)?,
            pairs: storage("tile pairs", views * capacity * 16)?,
            lists: storage("lists of tiles", tiles * 8)?,
            pictures: storage("pictures", need.picture_bytes)?,
            table: storage("label table", need.table_bytes)?,
            slots: storage("weight slots", need.slot_bytes)?,
            dispatch,
            staging,
        })
    }

    /// Buffers of a backward pass: bytes of the pictures, of the sums and of the derivatives.
    /// Errors: `limit_exceeded` when the adapter cannot hold or bind as much.
    pub(super) fn backward_room(
        &mut self,
        gpu: &Gpu,
        [picture_bytes, sum_bytes, gradient_bytes]: [u64; 3],
    ) -> Result<BackwardBuffers> {
        let staging = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        Ok(BackwardBuffers {
            by_pictures: self.sized(gpu, "loss", STORAGE, picture_bytes)?,
            sums: self.sized(gpu, "sums of tile pairs", STORAGE, sum_bytes)?,
            gradients: self.sized(gpu, "gradients", STORAGE, gradient_bytes)?,
            staging: self.sized(gpu, "staging", staging, gradient_bytes)?,
        })
    }

    /// A buffer to read `size_bytes` from.
    /// Errors: `limit_exceeded` when the adapter cannot hold as much.
    pub(super) fn staging(&mut self, gpu: &Gpu, size_bytes: u64) -> Result<wgpu::Buffer> {
        let usage = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        self.sized(gpu, "staging", usage, size_bytes)
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
