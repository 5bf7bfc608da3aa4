//! Records the stages as dispatches: which kernel, over how many workgroups.

use super::{
    batch_buffers::BufferCopy,
    bindings::{Bindings, Inputs},
    device::Gpu,
    pipelines::{GROUPS_X_MAX, Kernel, Kernels, POSE_GROUPS, RasterKinds, WORKGROUP_SIZE},
    profile::Marks,
};
use crate::{
    Kinds,
    error::{Error, Result},
};

/// Workgroups that look for the farthest depth of a view.
const FARTHEST_GROUPS: u32 = 64;
/// Blocks that a workgroup of cull tests.
const BLOCKS_TESTED: u32 = 8;

/// Workgroups of a dispatch.
#[derive(Clone, Copy)]
enum Groups {
    /// Along x and y, for each view.
    Given([u32; 2]),
    /// As cull says.
    Left,
}

/// Records the stages of one batch of views into one compute pass.
pub(super) struct Recorder<'a> {
    gpu: &'a Gpu,
    kernels: &'a Kernels,
    bindings: &'a mut Bindings,
    inputs: Inputs<'a>,
    encoder: wgpu::CommandEncoder,
    pass: Option<wgpu::ComputePass<'static>>,
    marks: Option<&'a mut Marks>,
    /// Error of the first kernel that was refused.
    failed: Option<Error>,
}

impl<'a> Recorder<'a> {
    /// Starts a submission. Sets the buffers `cleared` to zeros.
    pub(super) fn new(
        gpu: &'a Gpu,
        kernels: &'a Kernels,
        bindings: &'a mut Bindings,
        inputs: Inputs<'a>,
        cleared: &[&wgpu::Buffer],
        mut marks: Option<&'a mut Marks>,
    ) -> Self {
        bindings.renew(gpu);
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        cleared.iter().for_each(|buffer| encoder.clear_buffer(buffer, 0, None));
        let mut pass = encoder.begin_compute_pass(&Default::default()).forget_lifetime();
        if let Some(marks) = &mut marks {
            marks.start(&mut pass);
        }
        Self { gpu, kernels, bindings, inputs, encoder, pass: Some(pass), marks, failed: None }
    }

    /// Ends the stages and submits everything.
    /// Errors: `internal` when a kernel of it was refused.
    pub(super) fn submit(mut self, copies: &[BufferCopy<'_>]) -> Result<()> {
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
        for &BufferCopy { from, to, bytes } in copies.iter().filter(|copy| copy.bytes > 0) {
            self.encoder.copy_buffer_to_buffer(from.0, from.1, to.0, to.1, Some(bytes));
        }
        self.gpu.queue.submit([self.encoder.finish()]);
        Ok(())
    }

    /// Records one dispatch of `x` times `y` workgroups a view.
    fn dispatch(&mut self, kernel: Kernel, groups: [u32; 2]) {
        self.record(kernel, Groups::Given(groups));
    }

    fn record(&mut self, kernel: Kernel, groups: Groups) {
        let pipeline = match self.kernels.get(self.gpu, kernel) {
            Ok(pipeline) => pipeline,
            Err(error) => {
                self.failed.get_or_insert(error);
                return;
            }
        };
        let group = self.bindings.group(self.gpu, kernel, &pipeline, &self.inputs);
        let Some(pass) = &mut self.pass else { return };
        pass.set_pipeline(&pipeline);
        pass.set_bind_group(0, group, &[]);
        match groups {
            Groups::Given([x, y]) => pass.dispatch_workgroups(x, y, self.inputs.views),
            Groups::Left => pass.dispatch_workgroups_indirect(&self.inputs.room.dispatch, 0),
        }
        if let Some(marks) = &mut self.marks {
            marks.mark(pass, kernel.name());
        }
    }

    /// An invocation for each of `count` numbers, folded into two dimensions if they are too many
    /// for one.
    fn row(&mut self, kernel: Kernel, count: u32) {
        self.dispatch(kernel, split(count.div_ceil(WORKGROUP_SIZE)));
    }

    /// A stage with an invocation for each Gaussian.
    pub(super) fn gaussians(&mut self, kernel: Kernel) {
        self.row(kernel, self.inputs.count);
    }

    /// A stage with an invocation for each Gaussian that cull has left, if the scene has blocks.
    fn shown(&mut self, kernel: Kernel) {
        match self.inputs.blocks {
            0 => self.gaussians(kernel),
            _ => self.record(kernel, Groups::Left),
        }
    }

    /// A stage with a workgroup for each of `tiles` (columns, rows) of the largest view.
    pub(super) fn tiles(&mut self, kernel: Kernel, tiles: [u32; 2]) {
        self.dispatch(kernel, tiles);
    }

    /// Stage 3: where the lists of the tiles start.
    pub(super) fn prefix_sum(&mut self) {
        self.dispatch(Kernel::PrefixSum, [1, 1]);
    }

    /// The stages of pictures of `kinds`, over `tiles` (columns, rows) of the largest view.
    pub(super) fn draw(&mut self, kinds: RasterKinds, tiles: [u32; 2]) {
        if self.inputs.blocks > 0 {
            self.dispatch(Kernel::Cull, split(self.inputs.blocks.div_ceil(BLOCKS_TESTED)));
        }
        self.shown(Kernel::Project);
        if kinds.color && !self.inputs.flat {
            self.shown(Kernel::Shade);
        }
        self.prefix_sum();
        self.shown(Kernel::EmitIsects);
        self.tiles(Kernel::TileSort, tiles);
        self.tiles(Kernel::Rasterize(kinds), tiles);
    }

    /// Stage 7 over pictures of at most `words` words.
    pub(super) fn depth_steps(&mut self, words: u32) {
        self.dispatch(Kernel::Farthest, [FARTHEST_GROUPS, 1]);
        self.row(Kernel::DepthSteps, words);
    }

    /// The backward pass of one whole view of `tiles` (columns, rows), of which all stages so far
    /// have left their buffers: of the pictures `kinds`.
    pub(super) fn backward(&mut self, kinds: Kinds, tiles: [u32; 2]) {
        self.tiles(Kernel::RasterizeBackward(kinds), tiles);
        self.gaussians(Kernel::ProjectBackward);
        self.gaussians(Kernel::ShadeBackward);
    }

    /// What the loss says of the camera of one view, after its backward pass.
    pub(super) fn pose_gradient(&mut self) {
        self.dispatch(Kernel::PoseGradient, [POSE_GROUPS, 1]);
    }

    /// Compares the picture of one whole view of `tiles` (columns, rows) with its photo: what that
    /// says of the picture, and, where it `moves`, the step of the photo's exposure.
    pub(super) fn compare(&mut self, [columns, rows]: [u32; 2], moves: bool) {
        self.tiles(Kernel::LossWindows, [3 * columns, rows]);
        self.tiles(Kernel::PhotoLoss, [3 * columns, rows]);
        if moves {
            self.dispatch(Kernel::Exposure, [1, 1]);
        }
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
