//! Buffers of a batch of views. They grow and serve the next batch too.

use std::{collections::HashMap, sync::Arc};

use wgpu::BufferUsages;

use super::{
    buffers::{DeviceScene, FootprintRow, PlanRow, ViewRow},
    device::{Gpu, STORAGE},
    pipelines::{BACKDROP_HEIGHT, BACKDROP_WIDTH, VIEWS_MAX},
    recorder::Bindings,
};
use crate::{error::Result, scene::Backdrop};

/// First room of a pixel, in weights: a pixel at an edge of an object shows about as many entries.
pub(super) const WEIGHT_SLOTS_MIN: u32 = 8;
const VIEW_BYTES: u64 = size_of::<ViewRow>() as u64 * VIEWS_MAX as u64;
/// Bytes of a backdrop: a word for each cell.
const BACKDROP_BYTES: u64 = 4 * (BACKDROP_WIDTH * BACKDROP_HEIGHT) as u64;
const UNIFORM: BufferUsages = BufferUsages::UNIFORM.union(BufferUsages::COPY_DST);

/// Sizes of a batch.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Need {
    pub(super) views: u32,
    /// Gaussians of the scene.
    pub(super) count: u32,
    /// Tile pairs of each view.
    pub(super) capacity: u32,
    /// Tiles of all views, and one more for each view.
    pub(super) tiles: u32,
    /// Whether shade has colours to write.
    pub(super) shades: bool,
    pub(super) source_bytes: u64,
    pub(super) picture_bytes: u64,
    pub(super) table_bytes: u64,
    pub(super) slot_bytes: u64,
    pub(super) staging_bytes: u64,
}

/// The buffers of one batch, each at least as large as needed.
#[derive(Clone, Debug)]
pub(super) struct BatchBuffers {
    pub(super) views: wgpu::Buffer,
    pub(super) plans: wgpu::Buffer,
    pub(super) footprints: wgpu::Buffer,
    /// Tiles that each Gaussian touches.
    pub(super) touched: wgpu::Buffer,
    /// Photos of all views.
    pub(super) sources: wgpu::Buffer,
    /// Maps of all views, up to [`VIEWS_MAX`].
    pub(super) backdrops: wgpu::Buffer,
    pub(super) colors: wgpu::Buffer,
    pub(super) starts: wgpu::Buffer,
    pub(super) ends: wgpu::Buffer,
    /// Two halves of all views.
    pub(super) pairs: wgpu::Buffer,
    pub(super) lists: wgpu::Buffer,
    pub(super) pictures: wgpu::Buffer,
    pub(super) table: wgpu::Buffer,
    pub(super) slots: wgpu::Buffer,
    pub(super) staging: wgpu::Buffer,
}

/// What a backward pass has beside the buffers of its frame.
#[derive(Clone, Debug)]
pub(super) struct BackwardBuffers {
    /// What the loss says of the pictures, in their places.
    pub(super) by_pictures: wgpu::Buffer,
    /// Of each tile pair.
    pub(super) sums: wgpu::Buffer,
    /// Of each Gaussian, then of the harmonics.
    pub(super) gradients: wgpu::Buffer,
    pub(super) staging: wgpu::Buffer,
}

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
    pub(super) fn room(&mut self, gpu: &Gpu, need: &Need) -> Result<BatchBuffers> {
        let (views, count, capacity) =
            (u64::from(need.views), u64::from(need.count), u64::from(need.capacity));
        let footprint_bytes = size_of::<FootprintRow>() as u64;
        let tiles = u64::from(need.tiles);
        let color_bytes = if need.shades { views * count * 12 } else { 0 };
        let mut sized = |label, usage, size_bytes| self.sized(gpu, label, usage, size_bytes);
        let staging = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        let views_buffer = sized("views", UNIFORM, VIEW_BYTES)?;
        let staging = sized("staging", staging, need.staging_bytes)?;
        let mut storage = |label, size_bytes| sized(label, STORAGE, size_bytes);
        Ok(BatchBuffers {
            views: views_buffer,
            plans: storage("plans", views * size_of::<PlanRow>() as u64)?,
            footprints: storage("footprints", views * count * footprint_bytes)?,
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

/// First cell of backdrop `at` of a batch.
pub(super) fn first_cell(at: usize) -> u32 {
    at as u32 * BACKDROP_WIDTH * BACKDROP_HEIGHT
}

impl BatchBuffers {
    /// Uploads the backdrops of a batch, unless they are those `held`.
    pub(super) fn put_backdrops(
        &self,
        gpu: &Gpu,
        wanted: &[Arc<Backdrop>],
        held: &[Arc<Backdrop>],
    ) {
        for (at, backdrop) in wanted.iter().enumerate() {
            if held.get(at).is_some_and(|held| Arc::ptr_eq(held, backdrop)) {
                continue;
            }
            let word = |&[r, g, b]: &[u8; 3]| u32::from_le_bytes([r, g, b, 0]);
            let words: Vec<u32> = backdrop.cells().iter().map(word).collect();
            let start = u64::from(first_cell(at)) * 4;
            gpu.queue.write_buffer(&self.backdrops, start, bytemuck::cast_slice(&words));
        }
    }

    /// What the stages expect to be zeros: plans, and the counts of the tiles.
    pub(super) fn zeros(&self) -> [&wgpu::Buffer; 2] {
        [&self.plans, &self.ends]
    }
}
