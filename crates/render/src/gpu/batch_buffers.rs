//! The buffers of a submission: of a batch of views, of a backward pass and of a step of training.

use std::sync::Arc;

use super::{
    device::Gpu,
    pipelines::{BACKDROP_HEIGHT, BACKDROP_WIDTH},
};
use crate::scene::Backdrop;

/// Sizes of a batch.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct BatchSizes {
    pub(super) views: u32,
    /// Gaussians of the scene.
    pub(super) count: u32,
    /// Rows of its blocks; 0 without.
    pub(super) rows: u32,
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
    /// Gaussians that cull leaves, of all views, and the workgroups of the stages that read them.
    pub(super) rows: wgpu::Buffer,
    pub(super) dispatch: wgpu::Buffer,
    /// Which tiles each Gaussian touches.
    pub(super) touched: wgpu::Buffer,
    /// Photos of all views.
    pub(super) sources: wgpu::Buffer,
    /// Maps of all views, up to [`super::pipelines::VIEWS_MAX`].
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

/// What a step has beside the buffers of a backward pass.
#[derive(Clone, Debug)]
pub(super) struct TrainingBuffers {
    pub(super) row: wgpu::Buffer,
    /// Pixels of all photos, RGBA.
    pub(super) photos: wgpu::Buffer,
    pub(super) exposures: wgpu::Buffer,
    pub(super) by_windows: wgpu::Buffer,
    pub(super) partials: wgpu::Buffer,
    pub(super) moments: wgpu::Buffer,
    /// Of the camera, of each workgroup that adds up.
    pub(super) pose_sums: wgpu::Buffer,
}

/// A copy at the end of a submission.
#[derive(Clone, Copy, Debug)]
pub(super) struct BufferCopy<'a> {
    /// Buffer and its first byte.
    pub(super) from: (&'a wgpu::Buffer, u64),
    pub(super) to: (&'a wgpu::Buffer, u64),
    pub(super) bytes: u64,
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

    /// What the stages expect to be zeros: plans, the counts of the tiles, and of workgroups.
    pub(super) fn zeros(&self) -> [&wgpu::Buffer; 3] {
        [&self.plans, &self.ends, &self.dispatch]
    }
}
