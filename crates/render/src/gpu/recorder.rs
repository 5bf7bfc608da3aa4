//! Records the stages as dispatches: which kernel, which buffers, how many workgroups.

use std::collections::HashMap;

use wgpu::{BindGroupEntry, BindingResource, BufferBinding};

use super::{
    buffers::SortParams,
    device::Gpu,
    pipelines::{
        GROUPS_DEPTH, GROUPS_DIGITS, GROUPS_RANGES, GROUPS_TILES, GROUPS_X_MAX, Kernel, Kernels,
        RasterLabels, SCAN_BLOCK, SORT_BLOCK, WORKGROUP_SIZE,
    },
    profile::Marks,
    scratch::{BatchBuffers, digit, params_of},
};
use crate::error::{Error, Result};

/// Values of a digit of the radix sort.
pub(super) const DIGITS: u32 = 256;
/// Bits of a digit.
pub(super) const DIGIT_BITS: u32 = 8;
/// Digits of a key, at most.
pub(super) const DIGITS_MAX: u32 = 4;
/// Number of bind groups kept: those of a few frames.
const BINDINGS_MAX: usize = 256;

/// Bind groups of earlier frames, for the next ones.
#[derive(Debug, Default)]
pub(super) struct Bindings {
    /// [`Gpu::generation`] that they were made in.
    generation: u64,
    groups: HashMap<(Kernel, u64, Vec<wgpu::Buffer>), wgpu::BindGroup>,
}

/// The buffers of a scene that stages read.
#[derive(Clone, Copy, Debug)]
pub(super) struct SceneBuffers<'a> {
    pub(super) gaussians: &'a wgpu::Buffer,
    pub(super) sh: &'a wgpu::Buffer,
    /// Spherical harmonics of each Gaussian.
    pub(super) sh_count: u32,
}

/// The kind of labels that rasterize blends, and the entries of the Gaussians where it does.
pub(super) type LabelInputs<'a> = (RasterLabels, Option<&'a wgpu::Buffer>);

/// Workgroups of a dispatch, over the views of the batch.
enum Groups {
    /// This many, folded into two dimensions if they are too many for one.
    Row(u32),
    Grid(u32, u32),
    /// The number that the device wrote into this row of `groups`.
    Planned(u32),
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
    /// Starts a submission of `views` views of `count` Gaussians in `room`.
    pub(super) fn new(
        gpu: &'a Gpu,
        kernels: &'a Kernels,
        bindings: &'a mut Bindings,
        room: &'a BatchBuffers,
        (views, count): (u32, u32),
        mut marks: Option<&'a mut Marks>,
    ) -> Self {
        let generation = gpu.generation();
        if bindings.generation != generation || bindings.groups.len() > BINDINGS_MAX {
            bindings.groups.clear();
            bindings.generation = generation;
        }
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
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

    /// Records one dispatch. Buffers are bound at their number, the digit's parameters at 1.
    fn dispatch(
        &mut self,
        kernel: Kernel,
        digit: Option<SortParams>,
        buffers: &[(u32, &wgpu::Buffer)],
        groups: &Groups,
    ) {
        let offset = digit.map_or(0, params_of);
        let pipeline = match self.kernels.get(self.gpu, kernel) {
            Ok(pipeline) => pipeline,
            Err(error) => {
                self.failed.get_or_insert(error);
                return;
            }
        };
        let key = (kernel, offset, buffers.iter().map(|(_, buffer)| (*buffer).clone()).collect());
        let (gpu, params) = (self.gpu, &self.room.params);
        let group = self.bindings.groups.entry(key).or_insert_with(|| {
            let mut entries: Vec<_> = buffers
                .iter()
                .map(|&(binding, buffer)| BindGroupEntry {
                    binding,
                    resource: buffer.as_entire_binding(),
                })
                .collect();
            if digit.is_some() {
                let resource = BindingResource::Buffer(BufferBinding {
                    buffer: params,
                    offset,
                    size: wgpu::BufferSize::new(size_of::<SortParams>() as u64),
                });
                entries.push(BindGroupEntry { binding: 1, resource });
            }
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
            Groups::Planned(row) => {
                pass.dispatch_workgroups_indirect(&self.room.groups, u64::from(row) * 16);
            }
        }
        if let Some(marks) = &mut self.marks {
            marks.mark(pass, kernel.name());
        }
    }

    /// Stage 1.
    pub(super) fn project(&mut self, scene: SceneBuffers<'_>) {
        let room = self.room;
        let buffers = [
            (0, &room.views),
            (1, scene.gaussians),
            (2, &room.footprints),
            (3, &room.depth_keys),
            (4, &room.tiles),
            (5, &room.plans),
        ];
        let groups = Groups::Row(self.count.div_ceil(WORKGROUP_SIZE));
        self.dispatch(Kernel::Project, None, &buffers, &groups);
    }

    /// Stage 2: sorts the Gaussians by depth, without the dropped ones, by at most `digits` digits.
    /// Only the device knows how many digits it took, and so which half holds the result.
    pub(super) fn depth_sort(&mut self, digits: u32) {
        let blocks = self.count.div_ceil(SORT_BLOCK);
        for pass_at in 0..digits {
            let groups = match pass_at {
                0 => [Groups::Row(blocks), Groups::Row(self.spines()), Groups::Row(blocks)],
                _ => [
                    Groups::Planned(GROUPS_DEPTH + pass_at - 1),
                    Groups::Planned(GROUPS_DIGITS + pass_at - 1),
                    Groups::Planned(GROUPS_DEPTH + pass_at - 1),
                ],
            };
            self.sort_digit(digit(0, pass_at), &groups);
        }
    }

    /// Stage 6: a stable sort of tile pairs by the lowest `key_bits` bits. The result is in the
    /// half [`sorted_half`].
    pub(super) fn tile_sort(&mut self, key_bits: u32) {
        for pass_at in 0..key_bits.div_ceil(DIGIT_BITS) {
            let planned = || Groups::Planned(GROUPS_TILES);
            self.sort_digit(digit(1, pass_at), &[planned(), Groups::Row(self.spines()), planned()]);
        }
    }

    /// Workgroups of spine: one a digit, or one for all.
    fn spines(&self) -> u32 {
        if self.kernels.serial { 1 } else { DIGITS }
    }

    fn sort_digit(&mut self, digit: SortParams, groups: &[Groups; 3]) {
        let room = self.room;
        let (keys, values) = match digit.by_tile {
            0 => (&room.depth_keys, &room.depth_ids),
            _ => (&room.tile_keys, &room.isect_ids),
        };
        let (views, plans, counts) = (&room.views, &room.plans, &room.digit_counts);
        let by_block = [(0, views), (2, plans), (3, keys), (5, counts)];
        self.dispatch(Kernel::Histogram, Some(digit), &by_block, &groups[0]);
        // Only the first digit of the depth sort writes the groups of the others.
        let planner = digit.by_tile == 0 && digit.pass_at == 0;
        let asked = if planner { &room.groups } else { &room.groups_unasked };
        let by_digit = [(0, views), (2, plans), (5, counts), (6, asked)];
        self.dispatch(Kernel::Spine, Some(digit), &by_digit, &groups[1]);
        let moved = [(0, views), (2, plans), (3, keys), (4, values), (5, counts)];
        self.dispatch(Kernel::Scatter, Some(digit), &moved, &groups[2]);
    }

    /// Stage 3: start places of blocks of [`SCAN_BLOCK`] Gaussians, and the sizes of later stages.
    pub(super) fn prefix_sum(&mut self) {
        let room = self.room;
        let buffers = [
            (0, &room.views),
            (1, &room.plans),
            (2, &room.depth_ids),
            (3, &room.tiles),
            (4, &room.block_sums),
        ];
        let blocks = self.count.div_ceil(SCAN_BLOCK);
        self.dispatch(Kernel::SumBlocks, None, &buffers, &Groups::Row(blocks));
        let buffers =
            [(0, &room.views), (1, &room.plans), (4, &room.block_sums), (5, &room.groups)];
        self.dispatch(Kernel::ScanSums, None, &buffers, &Groups::Row(1));
    }

    /// Stage 4: colours of a scene of a degree over 0.
    pub(super) fn shade(&mut self, scene: SceneBuffers<'_>) {
        let room = self.room;
        let buffers = [
            (0, &room.views),
            (1, scene.gaussians),
            (2, scene.sh),
            (3, &room.tiles),
            (4, &room.colors),
        ];
        let groups = Groups::Row(self.count.div_ceil(WORKGROUP_SIZE));
        self.dispatch(Kernel::Shade, None, &buffers, &groups);
    }

    /// Stage 5.
    pub(super) fn emit_isects(&mut self) {
        let room = self.room;
        let buffers = [
            (0, &room.views),
            (1, &room.plans),
            (2, &room.footprints),
            (3, &room.tiles),
            (4, &room.depth_ids),
            (5, &room.block_sums),
            (6, &room.tile_keys),
            (7, &room.isect_ids),
        ];
        let groups = Groups::Row(self.count.div_ceil(SCAN_BLOCK));
        self.dispatch(Kernel::EmitIsects, None, &buffers, &groups);
    }

    /// Stage 7.
    pub(super) fn tile_ranges(&mut self) {
        let room = self.room;
        let buffers = [(0, &room.views), (1, &room.plans), (2, &room.tile_keys), (3, &room.ranges)];
        self.dispatch(Kernel::TileRanges, None, &buffers, &Groups::Planned(GROUPS_RANGES));
    }

    /// Stage 8 over `tiles` (columns, rows) of the largest view.
    pub(super) fn rasterize(
        &mut self,
        scene: SceneBuffers<'_>,
        (labels, entries): LabelInputs<'_>,
        (color, depth): (bool, bool),
        tiles: [u32; 2],
    ) {
        let room = self.room;
        let flat = self.kernels.flat(scene.sh_count);
        let colors = if flat { scene.sh } else { &room.colors };
        let mut buffers = vec![
            (0, &room.views),
            (1, &room.footprints),
            (2, &room.isect_ids),
            (3, &room.ranges),
            (4, &room.pictures),
            (5, colors),
        ];
        if let Some(entries) = entries {
            let weights = labels == RasterLabels::Weights;
            buffers.extend([(6, entries), (7, if weights { &room.slots } else { &room.table })]);
        }
        let kernel = Kernel::Rasterize { color, depth, labels };
        self.dispatch(kernel, None, &buffers, &Groups::Grid(tiles[0], tiles[1]));
    }
}

/// Workgroups along x and y, together at least `count`. One dimension has at most 65,535.
fn split(count: u32) -> [u32; 2] {
    let x = count.clamp(1, GROUPS_X_MAX);
    [x, count.div_ceil(x)]
}

/// Which half of the pairs holds them after a tile sort of `key_bits` bits.
pub(super) fn sorted_half(key_bits: u32) -> u32 {
    key_bits.div_ceil(DIGIT_BITS) & 1
}

/// Bits of the ids of `tiles` tiles; at least one digit.
pub(super) fn tile_bits(tiles: u32) -> u32 {
    (u32::BITS - tiles.saturating_sub(1).leading_zeros()).max(1)
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
