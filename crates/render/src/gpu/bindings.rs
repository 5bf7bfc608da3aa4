//! What each kernel binds, at the numbers of its shader, and the bind groups of earlier frames.

use std::collections::HashMap;

use wgpu::{BindGroupEntry, Buffer};

use super::{
    batch_buffers::{BackwardBuffers, BatchBuffers, TrainingBuffers},
    buffers::DeviceScene,
    device::Gpu,
    pipelines::{Kernel, Kernels, RasterLabels},
};

/// Number of bind groups kept: those of a few frames.
const BINDINGS_MAX: usize = 256;

/// What the kernels of a submission read and write.
#[derive(Clone, Copy)]
pub(super) struct Inputs<'a> {
    pub(super) room: &'a BatchBuffers,
    /// `None` for stages that read none: their colours are in the room.
    pub(super) scene: Option<&'a DeviceScene>,
    pub(super) backward: Option<&'a BackwardBuffers>,
    pub(super) training: Option<&'a TrainingBuffers>,
    /// Gradients of earlier photos of a step.
    pub(super) earlier: Option<&'a Buffer>,
    /// Whether rasterize takes colours out of the harmonics.
    pub(super) flat: bool,
    /// Views of the batch.
    pub(super) views: u32,
    /// Gaussians of the scene.
    pub(super) count: u32,
    /// Its blocks; 0: it has none.
    pub(super) blocks: u32,
}

impl<'a> Inputs<'a> {
    /// Those of a frame of `views` views.
    pub(super) fn new(
        kernels: &Kernels,
        room: &'a BatchBuffers,
        scene: Option<&'a DeviceScene>,
        views: u32,
    ) -> Self {
        let flat = scene.is_some_and(|scene| kernels.flat(scene.sh_count));
        let count = scene.map_or(0, |scene| scene.count);
        let blocks = scene.map_or(0, DeviceScene::block_count);
        Self {
            room,
            scene,
            backward: None,
            training: None,
            earlier: None,
            flat,
            views,
            count,
            blocks,
        }
    }
}

/// Declares what kernels bind, and which buffer each is.
macro_rules! bound {
    ($inputs:ident; $($name:ident = $buffer:expr;)+) => {
        #[derive(Clone, Copy)]
        enum Bound {
            $($name),+
        }

        impl Bound {
            fn buffer<'a>(self, $inputs: &Inputs<'a>) -> Option<&'a Buffer> {
                Some(match self {
                    $(Self::$name => $buffer),+
                })
            }
        }
    };
}

bound! { inputs;
    Nothing = return None;
    Views = &inputs.room.views;
    Blocks = &inputs.scene?.blocks.as_ref()?.bounds;
    Order = &inputs.scene?.blocks.as_ref()?.order;
    Rows = &inputs.room.rows;
    Dispatch = &inputs.room.dispatch;
    Gaussians = &inputs.scene?.gaussians;
    Sh = &inputs.scene?.sh;
    Entries = &inputs.scene?.labels.as_ref()?.entries;
    Footprints = &inputs.room.footprints;
    Touched = &inputs.room.touched;
    Plans = &inputs.room.plans;
    Starts = &inputs.room.starts;
    Ends = &inputs.room.ends;
    Sources = &inputs.room.sources;
    Shaded = &inputs.room.colors;
    Colors = if inputs.flat { &inputs.scene?.sh } else { &inputs.room.colors };
    Pairs = &inputs.room.pairs;
    Lists = &inputs.room.lists;
    Pictures = &inputs.room.pictures;
    Backdrops = &inputs.room.backdrops;
    Table = &inputs.room.table;
    Slots = &inputs.room.slots;
    ByPictures = &inputs.backward?.by_pictures;
    Sums = &inputs.backward?.sums;
    Gradients = &inputs.backward?.gradients;
    Training = &inputs.training?.row;
    Photos = &inputs.training?.photos;
    Exposures = &inputs.training?.exposures;
    ByWindows = &inputs.training?.by_windows;
    Partials = &inputs.training?.partials;
    Moments = &inputs.training?.moments;
    PoseSums = &inputs.training?.pose_sums;
    Earlier = inputs.earlier?;
}

/// What a kernel binds, from number 0 on.
#[rustfmt::skip]
fn bound(kernel: Kernel) -> &'static [Bound] {
    use Bound::{
        Backdrops, Blocks, ByPictures, ByWindows, Colors, Dispatch, Earlier, Ends, Entries,
        Exposures, Footprints, Gaussians, Gradients, Lists, Moments, Nothing, Order, Pairs,
        Partials, Photos, Pictures, Plans, PoseSums, Rows, Sh, Shaded, Slots, Sources, Starts,
        Sums, Table, Touched, Training, Views,
    };
    match kernel {
        Kernel::Cull => &[Views, Blocks, Order, Plans, Rows, Dispatch],
        Kernel::Project => &[Views, Gaussians, Footprints, Touched, Plans, Ends, Sources, Rows],
        Kernel::Shade => &[Views, Gaussians, Sh, Touched, Shaded, Plans, Rows],
        Kernel::PrefixSum => &[Views, Plans, Starts, Ends],
        Kernel::EmitIsects => &[Views, Plans, Footprints, Touched, Starts, Ends, Pairs, Rows],
        Kernel::TileSort => &[Views, Starts, Ends, Pairs, Lists],
        Kernel::Rasterize(kinds) => match kinds.labels {
            RasterLabels::None =>
                &[Views, Footprints, Pairs, Lists, Pictures, Colors, Nothing, Nothing, Backdrops],
            RasterLabels::Blend =>
                &[Views, Footprints, Pairs, Lists, Pictures, Colors, Entries, Table, Backdrops],
            RasterLabels::Weights =>
                &[Views, Footprints, Pairs, Lists, Pictures, Colors, Entries, Slots, Backdrops],
        },
        Kernel::Farthest | Kernel::DepthSteps => &[Views, Plans, Pictures],
        Kernel::RasterizeBackward(_) =>
            &[Views, Footprints, Pairs, Lists, Pictures, Colors, ByPictures, Sums, Backdrops],
        Kernel::ProjectBackward =>
            &[Views, Gaussians, Footprints, Touched, Lists, Pairs, Sums, Sources, Gradients],
        Kernel::ShadeBackward => &[Views, Gaussians, Sh, Gradients],
        Kernel::LossWindows =>
            &[Views, Training, Pictures, Photos, Exposures, ByWindows, Partials],
        Kernel::PhotoLoss =>
            &[Views, Training, Pictures, Photos, Exposures, ByWindows, Partials, ByPictures],
        Kernel::Exposure => &[Views, Training, Plans, Partials, Exposures],
        Kernel::PoseGradient => &[Views, Gaussians, Gradients, PoseSums],
        Kernel::AddEarlier =>
            &[Views, Nothing, Nothing, Gradients, Nothing, Nothing, Nothing, Earlier],
        Kernel::Adam => &[Views, Training, Plans, Gradients, Gaussians, Sh, Moments],
    }
}

/// Bind groups of earlier frames, for the next ones.
#[derive(Debug, Default)]
pub(super) struct Bindings {
    /// [`Gpu::generation`] that they were made in.
    generation: u64,
    groups: HashMap<(Kernel, Vec<Buffer>), wgpu::BindGroup>,
}

impl Bindings {
    /// Drops all where a buffer of one may be gone, or where there are too many.
    pub(super) fn renew(&mut self, gpu: &Gpu) {
        let generation = gpu.generation();
        if self.generation != generation || self.groups.len() > BINDINGS_MAX {
            self.groups.clear();
            self.generation = generation;
        }
    }

    /// The bind group of a kernel for these buffers.
    pub(super) fn group(
        &mut self,
        gpu: &Gpu,
        kernel: Kernel,
        pipeline: &wgpu::ComputePipeline,
        inputs: &Inputs<'_>,
    ) -> &wgpu::BindGroup {
        let numbered = (0..).zip(bound(kernel));
        let numbered = numbered.filter_map(|(at, bound)| Some((at, bound.buffer(inputs)?)));
        let buffers: Vec<(u32, &Buffer)> = numbered.collect();
        let key = (kernel, buffers.iter().map(|(_, buffer)| (*buffer).clone()).collect());
        self.groups.entry(key).or_insert_with(|| {
            let entries = buffers.iter().map(|&(binding, buffer)| BindGroupEntry {
                binding,
                resource: buffer.as_entire_binding(),
            });
            gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: None,
                layout: &pipeline.get_bind_group_layout(0),
                entries: &entries.collect::<Vec<_>>(),
            })
        })
    }
}
