//! Records the stages as dispatches: which kernel, which buffers, how many workgroups.

use std::collections::HashMap;

use wgpu::BindGroupEntry;

use super::{
    device::Gpu,
    pipelines::{GROUPS_X_MAX, Kernel, Kernels, RasterKinds, RasterLabels, WORKGROUP_SIZE},
    profile::Marks,
    scratch::{BackwardBuffers, BatchBuffers},
    trainer::TrainingBuffers,
};
use crate::{
    Kinds,
    error::{Error, Result},
};

/// Number of bind groups kept: those of a few frames.
const BINDINGS_MAX: usize = 256;

/// Bind groups of earlier frames, for the next ones.
#[derive(Debug, Default)]
pub(super) struct Bindings {
    /// [`Gpu::generation`] that they were made in.
    generation: u64,
    groups: HashMap<(Kernel, Vec<wgpu::Buffer>), wgpu::BindGroup>,
}

/// The buffers of a scene that stages read.
#[derive(Clone, Copy, Debug)]
pub(super) struct SceneBuffers<'a> {
    pub(super) gaussians: &'a wgpu::Buffer,
    pub(super) sh: &'a wgpu::Buffer,
    /// Spherical harmonics of each Gaussian.
    pub(super) sh_count: u32,
}

/// Workgroups that look for the farthest depth of a view.
const FARTHEST_GROUPS: u32 = 64;

/// Workgroups of a dispatch, over the views of the batch.
enum Groups {
    /// This many, folded into two dimensions if they are too many for one.
    Row(u32),
    Grid(u32, u32),
}

/// A copy at the end of a submission: from, offset, to, offset, bytes.
pub(super) type Copy<'a> = (&'a wgpu::Buffer, u64, &'a wgpu::Buffer, u64, u64);

/// Records the stages of one batch of views into one compute pass.
pub(super) struct Recorder<'a> {
    pub(super) gpu: &'a Gpu,
    kernels: &'a Kernels,
    bindings: &'a mut Bindings,
    room: &'a BatchBuffers,
    /// Views of the batch.
    views: u32,
    /// Gaussians of the scene.
    count: u32,
    encoder: wgpu::CommandEncoder,
    pass: Option<wgpu::ComputePass<'static>>,
    marks: Option<&'a mut Marks>,
    /// Error of the first kernel that was refused.
    failed: Option<Error>,
}

impl<'a> Recorder<'a> {
    /// Starts a submission of `views` views of `count` Gaussians in `room`. Sets the buffers
    /// `cleared` to zeros.
    pub(super) fn new(
        gpu: &'a Gpu,
        kernels: &'a Kernels,
        bindings: &'a mut Bindings,
        (room, cleared): (&'a BatchBuffers, &[&wgpu::Buffer]),
        (views, count): (u32, u32),
        mut marks: Option<&'a mut Marks>,
    ) -> Self {
        let generation = gpu.generation();
        if bindings.generation != generation || bindings.groups.len() > BINDINGS_MAX {
            bindings.groups.clear();
            bindings.generation = generation;
        }
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        cleared.iter().for_each(|buffer| encoder.clear_buffer(buffer, 0, None));
        let mut pass = encoder.begin_compute_pass(&Default::default()).forget_lifetime();
        if let Some(marks) = &mut marks {
            marks.start(&mut pass);
        }
        Self {
            gpu,
            kernels,
            bindings,
            room,
            views,
            count,
            encoder,
            pass: Some(pass),
            marks,
            failed: None,
        }
    }

    /// Ends the stages and submits everything.
    /// Errors: `internal` when a kernel of it was refused.
    pub(super) fn submit(mut self, copies: &[Copy<'_>]) -> Result<()> {
        if let Some(error) = self.failed.take() {
            return Err(error);
        }
        if let (Some(marks), Some(pass)) = (&mut self.marks, &mut self.pass) {
            marks.end(pass);
        }
        drop(self.pass.take());
        if let Some(marks) = &self.marks {
            marks.resolve(&mut self.encoder);
        }
        for &(from, from_offset, to, to_offset, size) in copies.iter().filter(|copy| copy.4 > 0) {
            self.encoder.copy_buffer_to_buffer(from, from_offset, to, to_offset, Some(size));
        }
        self.gpu.queue.submit([self.encoder.finish()]);
        Ok(())
    }

    /// Records one dispatch. Buffers are bound at their number.
    fn dispatch(&mut self, kernel: Kernel, buffers: &[(u32, &wgpu::Buffer)], groups: &Groups) {
        let pipeline = match self.kernels.get(self.gpu, kernel) {
            Ok(pipeline) => pipeline,
            Err(error) => {
                self.failed.get_or_insert(error);
                return;
            }
        };
        let key = (kernel, buffers.iter().map(|(_, buffer)| (*buffer).clone()).collect());
        let gpu = self.gpu;
        let group = self.bindings.groups.entry(key).or_insert_with(|| {
            let entries: Vec<_> = buffers
                .iter()
                .map(|&(binding, buffer)| BindGroupEntry {
                    binding,
                    resource: buffer.as_entire_binding(),
                })
                .collect();
            gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
                label: None,
                layout: &pipeline.get_bind_group_layout(0),
                entries: &entries,
            })
        });
        let Some(pass) = &mut self.pass else { return };
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, &*group, &[]);
        match *groups {
            Groups::Row(count) => {
                let [x, y] = split(count);
                pass.dispatch_workgroups(x, y, self.views);
            }
            Groups::Grid(x, y) => pass.dispatch_workgroups(x, y, self.views),
        }
        if let Some(marks) = &mut self.marks {
            marks.mark(pass, kernel.name());
        }
    }

    /// The stages of pictures of `kinds`, over `tiles` (columns, rows) of the largest view.
    pub(super) fn draw(
        &mut self,
        scene: SceneBuffers<'_>,
        kinds: RasterKinds,
        entries: Option<&wgpu::Buffer>,
        tiles: [u32; 2],
    ) {
        self.project(scene);
        if kinds.color && !self.kernels.flat(scene.sh_count) {
            self.shade(scene);
        }
        self.prefix_sum();
        self.emit_isects();
        self.tile_sort(tiles);
        self.rasterize(scene, kinds, entries, tiles);
    }

    /// Stage 1.
    pub(super) fn project(&mut self, scene: SceneBuffers<'_>) {
        let room = self.room;
        let buffers = [
            (0, &room.views),
            (1, scene.gaussians),
            (2, &room.footprints),
            (3, &room.touched),
            (4, &room.plans),
            (5, &room.ends),
            (6, &room.sources),
        ];
        let groups = Groups::Row(self.count.div_ceil(WORKGROUP_SIZE));
        self.dispatch(Kernel::Project, &buffers, &groups);
    }

    /// Stage 2: colours of a scene of a degree over 0.
    pub(super) fn shade(&mut self, scene: SceneBuffers<'_>) {
        let room = self.room;
        let buffers = [
            (0, &room.views),
            (1, scene.gaussians),
            (2, scene.sh),
            (3, &room.touched),
            (4, &room.colors),
        ];
        let groups = Groups::Row(self.count.div_ceil(WORKGROUP_SIZE));
        self.dispatch(Kernel::Shade, &buffers, &groups);
    }

    /// Stage 3: where the lists of the tiles start.
    pub(super) fn prefix_sum(&mut self) {
        let room = self.room;
        let buffers = [(0, &room.views), (1, &room.plans), (2, &room.starts), (3, &room.ends)];
        self.dispatch(Kernel::PrefixSum, &buffers, &Groups::Row(1));
    }

    /// Stage 4.
    pub(super) fn emit_isects(&mut self) {
        let room = self.room;
        let buffers = [
            (0, &room.views),
            (1, &room.plans),
            (2, &room.footprints),
            (3, &room.touched),
            (4, &room.starts),
            (5, &room.ends),
            (6, &room.pairs),
        ];
        let groups = Groups::Row(self.count.div_ceil(WORKGROUP_SIZE));
        self.dispatch(Kernel::EmitIsects, &buffers, &groups);
    }

    /// Stage 5 over `tiles` (columns, rows) of the largest view.
    pub(super) fn tile_sort(&mut self, tiles: [u32; 2]) {
        let room = self.room;
        let buffers = [
            (0, &room.views),
            (1, &room.starts),
            (2, &room.ends),
            (3, &room.pairs),
            (4, &room.lists),
        ];
        self.dispatch(Kernel::TileSort, &buffers, &Groups::Grid(tiles[0], tiles[1]));
    }

    /// Stage 6 over `tiles` (columns, rows) of the largest view. Labels need the entries of the
    /// Gaussians.
    pub(super) fn rasterize(
        &mut self,
        scene: SceneBuffers<'_>,
        kinds: RasterKinds,
        entries: Option<&wgpu::Buffer>,
        tiles: [u32; 2],
    ) {
        let room = self.room;
        let mut buffers = vec![
            (0, &room.views),
            (1, &room.footprints),
            (2, &room.pairs),
            (3, &room.lists),
            (4, &room.pictures),
            (5, self.colors(scene)),
            (8, &room.backdrops),
        ];
        let inputs = match kinds.labels {
            RasterLabels::None => None,
            RasterLabels::Blend => entries.zip(Some(&room.table)),
            RasterLabels::Weights => entries.zip(Some(&room.slots)),
        };
        if let Some((entries, rows)) = inputs {
            buffers.extend([(6, entries), (7, rows)]);
        }
        self.dispatch(Kernel::Rasterize(kinds), &buffers, &Groups::Grid(tiles[0], tiles[1]));
    }

    /// Where rasterize finds colours.
    fn colors<'b>(&self, scene: SceneBuffers<'b>) -> &'b wgpu::Buffer
    where
        'a: 'b,
    {
        if self.kernels.flat(scene.sh_count) { scene.sh } else { &self.room.colors }
    }

    /// The backward pass of one whole view of `tiles` (columns, rows), of which all stages so far
    /// have left their buffers: of the pictures `kinds`.
    pub(super) fn backward(
        &mut self,
        scene: SceneBuffers<'_>,
        kinds: Kinds,
        backward: &BackwardBuffers,
        tiles: [u32; 2],
    ) {
        let room = self.room;
        let buffers = [
            (0, &room.views),
            (1, &room.footprints),
            (2, &room.pairs),
            (3, &room.lists),
            (4, &room.pictures),
            (5, self.colors(scene)),
            (6, &backward.by_pictures),
            (7, &backward.sums),
            (8, &room.backdrops),
        ];
        let groups = Groups::Grid(tiles[0], tiles[1]);
        self.dispatch(Kernel::RasterizeBackward(kinds), &buffers, &groups);
        let groups = Groups::Row(self.count.div_ceil(WORKGROUP_SIZE));
        let buffers = [
            (0, &room.views),
            (1, scene.gaussians),
            (2, &room.footprints),
            (3, &room.touched),
            (4, &room.lists),
            (5, &room.pairs),
            (6, &backward.sums),
            (7, &room.sources),
            (8, &backward.gradients),
        ];
        self.dispatch(Kernel::ProjectBackward, &buffers, &groups);
        let buffers =
            [(0, &room.views), (1, scene.gaussians), (2, scene.sh), (3, &backward.gradients)];
        self.dispatch(Kernel::ShadeBackward, &buffers, &groups);
    }

    /// Compares the picture of one whole view of `tiles` (columns, rows) with its photo: what that
    /// says of the picture, and the step of the photo's exposure.
    pub(super) fn compare(
        &mut self,
        training: &TrainingBuffers,
        backward: &BackwardBuffers,
        tiles: [u32; 2],
    ) {
        let room = self.room;
        let groups = Groups::Grid(3 * tiles[0], tiles[1]);
        let mut buffers = vec![
            (0, &room.views),
            (1, &training.row),
            (2, &room.pictures),
            (3, &training.photos),
            (4, &training.exposures),
            (5, &training.by_windows),
            (6, &training.partials),
        ];
        self.dispatch(Kernel::LossWindows, &buffers, &groups);
        buffers.push((7, &backward.by_pictures));
        self.dispatch(Kernel::PhotoLoss, &buffers, &groups);
        let buffers = [
            (0, &room.views),
            (1, &training.row),
            (2, &room.plans),
            (3, &training.partials),
            (4, &training.exposures),
        ];
        self.dispatch(Kernel::Exposure, &buffers, &Groups::Row(1));
    }

    /// Adds what earlier photos of a step say to what this one says.
    pub(super) fn add_earlier(&mut self, earlier: &wgpu::Buffer, backward: &BackwardBuffers) {
        let buffers = [(0, &self.room.views), (3, &backward.gradients), (7, earlier)];
        let groups = Groups::Row(self.count.div_ceil(WORKGROUP_SIZE));
        self.dispatch(Kernel::AddEarlier, &buffers, &groups);
    }

    /// Moves the Gaussians.
    pub(super) fn adam(
        &mut self,
        scene: SceneBuffers<'_>,
        training: &TrainingBuffers,
        backward: &BackwardBuffers,
    ) {
        let buffers = [
            (0, &self.room.views),
            (1, &training.row),
            (2, &self.room.plans),
            (3, &backward.gradients),
            (4, scene.gaussians),
            (5, scene.sh),
            (6, &training.moments),
        ];
        let groups = Groups::Row(self.count.div_ceil(WORKGROUP_SIZE));
        self.dispatch(Kernel::Adam, &buffers, &groups);
    }

    /// Stage 7 over pictures of at most `words` words.
    pub(super) fn depth_steps(&mut self, words: u32) {
        let room = self.room;
        let buffers = [(0, &room.views), (1, &room.plans), (2, &room.pictures)];
        self.dispatch(Kernel::Farthest, &buffers, &Groups::Grid(FARTHEST_GROUPS, 1));
        self.dispatch(Kernel::DepthSteps, &buffers, &Groups::Row(words.div_ceil(WORKGROUP_SIZE)));
    }
}

/// Workgroups along x and y, together at least `count`. One dimension has at most 65,535.
fn split(count: u32) -> [u32; 2] {
    let x = count.clamp(1, GROUPS_X_MAX);
    [x, count.div_ceil(x)]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A dispatch over the limit of a dimension launches nothing, and says nothing.
    #[test]
    fn more_workgroups_than_a_dimension_holds_are_split() {
        for count in [0, 1, 32_768, 32_769, 65_535, 65_536, 70_000, u32::MAX / WORKGROUP_SIZE] {
            let [x, y] = split(count);
            assert!(x >= 1 && x.max(y) <= 65_535, "{count}: {x} x {y}");
            let rows = u64::from(x) * u64::from(y);
            assert!(rows >= u64::from(count), "{count}: {x} x {y} are too few");
            assert!(rows < u64::from(count.max(1)) + u64::from(x), "{count}: a row for nothing");
        }
    }
}
