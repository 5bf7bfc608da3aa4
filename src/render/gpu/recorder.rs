//! The stages as recorded dispatches: which kernel, over which buffers, in how many workgroups.

use bytemuck::Zeroable;
use wgpu::{BindGroupEntry, BindingResource, BufferBinding, BufferUsages};

use super::{
    buffers::{FootprintRow, PlanRow, ScanParams, Slot, SortParams},
    device::Gpu,
    pipelines::{COUNT_FROM_PLAN, GROUPS_X_MAX, Kernels, SCAN_BLOCK, SORT_BLOCK, WORKGROUP_SIZE},
};
use crate::error::Result;

/// Distance of two uniforms in the table of parameters: the portable alignment.
const PARAMS_STRIDE: usize = 256;
/// Sort digits and scan levels of a frame, at most: 8 digits of 3 uniforms and a scan besides.
const PARAMS_MAX: usize = 64;
/// Levels of a prefix sum: 2048³ numbers are more than any buffer holds.
const SCAN_LEVELS: usize = 3;
const RADIX_BITS: u32 = 8;
/// Entries a pixel that room is made for at first: what a pixel at an edge sees of a room.
pub(super) const ENTRY_SLOTS_MIN: u32 = 8;

/// How many pairs a sort has: known now, or known to the plan on the device.
#[derive(Clone, Copy, Debug)]
pub(super) enum PairCount {
    /// This many.
    Known(u32),
    /// `Plan.isects`, at most this many.
    Planned(u32),
}

/// Two buffers that a sort writes to in turn, for keys and values.
#[derive(Clone, Debug)]
pub(super) struct Pairs {
    pub(super) keys: [wgpu::Buffer; 2],
    pub(super) values: [wgpu::Buffer; 2],
}

/// Buffers of a frame; they grow and stay.
#[derive(Debug)]
pub(super) struct Scratch {
    pub(super) view: Slot,
    params: Slot,
    pub(super) plan: Slot,
    pub(super) footprints: Slot,
    pub(super) shaded: Slot,
    pub(super) isect_offsets: Slot,
    depth_pairs: [Slot; 4],
    isect_pairs: [Slot; 4],
    digit_counts: Slot,
    scan_sums: [Slot; SCAN_LEVELS],
    pub(super) ranges: Slot,
    pub(super) table: Slot,
    pub(super) entries: Slot,
    /// Entries a pixel that the last views needed.
    pub(super) entry_slots: u32,
    pub(super) pictures: Slot,
    pub(super) staging: Slot,
}

impl Default for Scratch {
    fn default() -> Self {
        let uniform = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        let plan = BufferUsages::STORAGE
            | BufferUsages::INDIRECT
            | BufferUsages::COPY_SRC
            | BufferUsages::COPY_DST;
        Self {
            view: Slot::new("view", uniform),
            params: Slot::new("params", uniform),
            plan: Slot::new("plan", plan),
            footprints: Slot::storage("footprints"),
            shaded: Slot::storage("shaded footprints"),
            isect_offsets: Slot::storage("tile pair offsets"),
            depth_pairs: [const { Slot::storage("depth pairs") }; 4],
            isect_pairs: [const { Slot::storage("tile pairs") }; 4],
            digit_counts: Slot::storage("digit counts"),
            scan_sums: [const { Slot::storage("block sums") }; SCAN_LEVELS],
            ranges: Slot::storage("tile ranges"),
            table: Slot::new("label table", BufferUsages::STORAGE | BufferUsages::COPY_DST),
            entries: Slot::storage("entry slots"),
            entry_slots: ENTRY_SLOTS_MIN,
            pictures: Slot::storage("pictures"),
            staging: Slot::new("staging", BufferUsages::MAP_READ | BufferUsages::COPY_DST),
        }
    }
}

impl Scratch {
    /// Buffers for `count` pairs of (depth, Gaussian).
    pub(super) fn depth_pairs(&mut self, gpu: &Gpu, count: u32) -> Result<Pairs> {
        pairs(&mut self.depth_pairs, gpu, count)
    }

    /// Buffers for `count` pairs of (tile, Gaussian).
    pub(super) fn isect_pairs(&mut self, gpu: &Gpu, count: u32) -> Result<Pairs> {
        pairs(&mut self.isect_pairs, gpu, count)
    }

    /// Tile pairs that the buffers hold now.
    pub(super) fn isect_capacity(&self) -> u32 {
        (self.isect_pairs[0].size_bytes() / 4) as u32
    }
}

fn pairs(slots: &mut [Slot; 4], gpu: &Gpu, count: u32) -> Result<Pairs> {
    let bytes = u64::from(count) * 4;
    let [k0, k1, v0, v1] = slots;
    Ok(Pairs {
        keys: [k0.ensure(gpu, bytes)?, k1.ensure(gpu, bytes)?],
        values: [v0.ensure(gpu, bytes)?, v1.ensure(gpu, bytes)?],
    })
}

/// What rasterize binds for the labels wanted: the Gaussians in depth order, their bank indices,
/// and the table or the slots.
#[derive(Clone, Copy, Debug)]
pub(super) enum LabelBuffers<'a> {
    None,
    Blend { depth_ids: &'a wgpu::Buffer, index: &'a wgpu::Buffer, table: &'a wgpu::Buffer },
    Entries { depth_ids: &'a wgpu::Buffer, index: &'a wgpu::Buffer, slots: &'a wgpu::Buffer },
}

/// Workgroups of a dispatch.
enum Groups<'a> {
    /// This many in a row, folded into two dimensions where they are many.
    Row(u32),
    Grid(u32, u32),
    /// Three u32 in the plan at this offset.
    Planned(&'a wgpu::Buffer, u64),
}

/// Records stages into one compute pass; the table of parameters is written when it ends.
pub(super) struct Recorder<'a> {
    pub(super) gpu: &'a Gpu,
    kernels: &'a Kernels,
    encoder: wgpu::CommandEncoder,
    pass: Option<wgpu::ComputePass<'static>>,
    params: Vec<u8>,
    params_buffer: wgpu::Buffer,
    pub(super) plan: wgpu::Buffer,
    digit_counts: wgpu::Buffer,
    scan_sums: [wgpu::Buffer; SCAN_LEVELS],
}

impl<'a> Recorder<'a> {
    /// Starts a submission whose sorts and prefix sums have `numbers_max` numbers at most.
    pub(super) fn new(
        gpu: &'a Gpu,
        kernels: &'a Kernels,
        scratch: &mut Scratch,
        numbers_max: u32,
    ) -> Result<Self> {
        let digits = u64::from(numbers_max.div_ceil(SORT_BLOCK).max(1)) * u64::from(WORKGROUP_SIZE);
        let mut sums = digits.max(u64::from(numbers_max));
        let digit_counts = scratch.digit_counts.ensure(gpu, digits * 4)?;
        let [s0, s1, s2] = &mut scratch.scan_sums;
        let mut level = |slot: &mut Slot| {
            sums = sums.div_ceil(u64::from(SCAN_BLOCK));
            slot.ensure(gpu, sums * 4)
        };
        let scan_sums = [level(s0)?, level(s1)?, level(s2)?];
        let plan = scratch.plan.ensure(gpu, size_of::<PlanRow>() as u64)?;
        let params_buffer = scratch.params.ensure(gpu, (PARAMS_STRIDE * PARAMS_MAX) as u64)?;
        let mut encoder = gpu.device.create_command_encoder(&Default::default());
        encoder.clear_buffer(&plan, 0, None);
        let pass = encoder.begin_compute_pass(&Default::default()).forget_lifetime();
        Ok(Self {
            gpu,
            kernels,
            encoder,
            pass: Some(pass),
            params: Vec::new(),
            params_buffer,
            plan,
            digit_counts,
            scan_sums,
        })
    }

    /// Ends the stages; `copies` are (from, offset, to, offset, bytes). Submits everything.
    pub(super) fn submit(
        mut self,
        copies: &[(&wgpu::Buffer, u64, &wgpu::Buffer, u64, u64)],
    ) -> wgpu::SubmissionIndex {
        drop(self.pass.take());
        for &(from, from_offset, to, to_offset, size) in copies.iter().filter(|copy| copy.4 > 0) {
            self.encoder.copy_buffer_to_buffer(from, from_offset, to, to_offset, Some(size));
        }
        if !self.params.is_empty() {
            self.gpu.queue.write_buffer(&self.params_buffer, 0, &self.params);
        }
        self.gpu.queue.submit([self.encoder.finish()])
    }

    /// Keeps a uniform for the submission; its place in the table.
    fn uniform(&mut self, value: &impl bytemuck::Pod) -> u64 {
        let offset = self.params.len();
        assert!(offset < PARAMS_STRIDE * PARAMS_MAX, "the table holds a frame; this is a bug");
        self.params.extend_from_slice(bytemuck::bytes_of(value));
        self.params.resize(offset + PARAMS_STRIDE, 0);
        offset as u64
    }

    /// Records one dispatch. Buffers are bound at their number; `params` at 0.
    fn dispatch(
        &mut self,
        kernel: &wgpu::ComputePipeline,
        params: Option<u64>,
        buffers: &[(u32, &wgpu::Buffer)],
        groups: &Groups<'_>,
    ) {
        let mut entries: Vec<_> = buffers
            .iter()
            .map(|&(binding, buffer)| BindGroupEntry {
                binding,
                resource: buffer.as_entire_binding(),
            })
            .collect();
        if let Some(offset) = params {
            entries.push(BindGroupEntry {
                binding: 0,
                resource: BindingResource::Buffer(BufferBinding {
                    buffer: &self.params_buffer,
                    offset,
                    size: wgpu::BufferSize::new(16),
                }),
            });
        }
        let group = self.gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: None,
            layout: &kernel.get_bind_group_layout(0),
            entries: &entries,
        });
        let Some(pass) = &mut self.pass else { return };
        pass.set_pipeline(kernel);
        pass.set_bind_group(0, &group, &[]);
        match *groups {
            Groups::Row(count) => {
                let x = count.clamp(1, GROUPS_X_MAX);
                pass.dispatch_workgroups(x, count.div_ceil(x), 1);
            }
            Groups::Grid(x, y) => pass.dispatch_workgroups(x, y, 1),
            Groups::Planned(plan, offset) => pass.dispatch_workgroups_indirect(plan, offset),
        }
    }

    /// Stage 1 over `count` Gaussians.
    pub(super) fn project(
        &mut self,
        view: &wgpu::Buffer,
        gaussians: &wgpu::Buffer,
        footprints: &wgpu::Buffer,
        pairs: &Pairs,
        count: u32,
    ) {
        let plan = self.plan.clone();
        self.dispatch(
            &self.kernels.project,
            None,
            &[
                (0, view),
                (1, gaussians),
                (2, footprints),
                (3, &pairs.keys[0]),
                (4, &pairs.values[0]),
                (5, &plan),
            ],
            &Groups::Row(count.div_ceil(WORKGROUP_SIZE)),
        );
    }

    /// Stages 2 and 6: sorts by the lowest `key_bits` bits; which of the two buffers holds the
    /// result.
    pub(super) fn sort(&mut self, pairs: &Pairs, count: PairCount, key_bits: u32) -> usize {
        let plan = self.plan.clone();
        let counts = self.digit_counts.clone();
        let (param, blocks_max) = match count {
            PairCount::Known(count) => (count, count.div_ceil(SORT_BLOCK)),
            PairCount::Planned(max) => (COUNT_FROM_PLAN, max.div_ceil(SORT_BLOCK)),
        };
        let groups = |plan| match count {
            PairCount::Known(_) => Groups::Row(blocks_max),
            PairCount::Planned(_) => {
                Groups::Planned(plan, std::mem::offset_of!(PlanRow, sort_groups) as u64)
            }
        };
        let mut from = 0;
        for shift in (0..key_bits).step_by(RADIX_BITS as usize) {
            let params = self.uniform(&SortParams { shift, count: param, reserved: [0; 2] });
            let to = 1 - from;
            self.dispatch(
                &self.kernels.histogram,
                Some(params),
                &[(1, &plan), (2, &pairs.keys[from]), (6, &counts)],
                &groups(&plan),
            );
            let numbers_max = blocks_max * WORKGROUP_SIZE;
            let numbers = match count {
                PairCount::Known(_) => numbers_max,
                PairCount::Planned(_) => COUNT_FROM_PLAN,
            };
            self.scan_level(&counts, numbers, numbers_max, 0);
            self.dispatch(
                &self.kernels.scatter,
                Some(params),
                &[
                    (1, &plan),
                    (2, &pairs.keys[from]),
                    (3, &pairs.values[from]),
                    (4, &pairs.keys[to]),
                    (5, &pairs.values[to]),
                    (6, &counts),
                ],
                &groups(&plan),
            );
            from = to;
        }
        from
    }

    /// Stage 3: exclusive prefix sum of `count` numbers, in place.
    pub(super) fn prefix_sum(&mut self, numbers: &wgpu::Buffer, count: u32) {
        self.scan_level(numbers, count, count, 0);
    }

    fn scan_level(&mut self, numbers: &wgpu::Buffer, count: u32, count_max: u32, level: usize) {
        let plan = self.plan.clone();
        let sums = self.scan_sums[level].clone();
        let blocks = count_max.div_ceil(SCAN_BLOCK);
        let params = self.uniform(&ScanParams { count, ..ScanParams::zeroed() });
        let buffers = [(1, &plan), (2, numbers), (3, &sums)];
        self.dispatch(&self.kernels.scan_blocks, Some(params), &buffers, &Groups::Row(blocks));
        if blocks > 1 {
            self.scan_level(&sums, blocks, blocks, level + 1);
            self.dispatch(&self.kernels.add_blocks, Some(params), &buffers, &Groups::Row(blocks));
        }
    }

    /// Stage 4 over `count` Gaussians in the order of `ids`.
    #[expect(clippy::too_many_arguments, reason = "the buffers of the stage, one a binding")]
    pub(super) fn shade(
        &mut self,
        view: &wgpu::Buffer,
        gaussians: &wgpu::Buffer,
        sh: &wgpu::Buffer,
        footprints: &wgpu::Buffer,
        ids: &wgpu::Buffer,
        shaded: &wgpu::Buffer,
        isect_offsets: &wgpu::Buffer,
        count: u32,
    ) {
        self.dispatch(
            &self.kernels.shade,
            None,
            &[
                (0, view),
                (1, gaussians),
                (2, sh),
                (3, footprints),
                (4, ids),
                (5, shaded),
                (6, isect_offsets),
            ],
            &Groups::Row(count.div_ceil(WORKGROUP_SIZE)),
        );
    }

    /// Holds the total of pairs against the capacity and sizes the stages that follow.
    pub(super) fn make_plan(
        &mut self,
        view: &wgpu::Buffer,
        shaded: &wgpu::Buffer,
        isect_offsets: &wgpu::Buffer,
    ) {
        let plan = self.plan.clone();
        let inputs = [(0, view), (1, shaded), (2, isect_offsets), (3, &plan)];
        self.dispatch(&self.kernels.make_plan, None, &inputs, &Groups::Row(1));
    }

    /// Stage 5: the plan, then the pairs of `count` shaded footprints.
    pub(super) fn emit_isects(
        &mut self,
        view: &wgpu::Buffer,
        shaded: &wgpu::Buffer,
        isect_offsets: &wgpu::Buffer,
        pairs: &Pairs,
        count: u32,
    ) {
        self.make_plan(view, shaded, isect_offsets);
        let plan = self.plan.clone();
        let inputs = [(0, view), (1, shaded), (2, isect_offsets), (3, &plan)];
        self.dispatch(
            &self.kernels.emit_isects,
            None,
            &[&inputs[..], &[(4, &pairs.keys[0]), (5, &pairs.values[0])]].concat(),
            &Groups::Row(count.div_ceil(WORKGROUP_SIZE)),
        );
    }

    /// Stage 7 over sorted tile keys.
    pub(super) fn tile_ranges(
        &mut self,
        view: &wgpu::Buffer,
        tile_keys: &wgpu::Buffer,
        ranges: &wgpu::Buffer,
    ) {
        let plan = self.plan.clone();
        self.dispatch(
            &self.kernels.tile_ranges,
            None,
            &[(0, view), (1, &plan), (2, tile_keys), (3, ranges)],
            &Groups::Planned(&plan, std::mem::offset_of!(PlanRow, range_groups) as u64),
        );
    }

    /// Stage 8 over `tiles` (columns, rows).
    #[expect(clippy::too_many_arguments, reason = "the buffers of the stage, one a binding")]
    pub(super) fn rasterize(
        &mut self,
        view: &wgpu::Buffer,
        shaded: &wgpu::Buffer,
        isect_ids: &wgpu::Buffer,
        ranges: &wgpu::Buffer,
        pictures: &wgpu::Buffer,
        labels: &LabelBuffers<'_>,
        tiles: [u32; 2],
    ) {
        let mut buffers = vec![(0, view), (1, shaded), (2, isect_ids), (3, ranges), (4, pictures)];
        let kernel = match *labels {
            LabelBuffers::None => &self.kernels.rasterize,
            LabelBuffers::Blend { depth_ids, index, table } => {
                buffers.extend([(5, depth_ids), (6, index), (7, table)]);
                &self.kernels.rasterize_blend
            }
            LabelBuffers::Entries { depth_ids, index, slots } => {
                buffers.extend([(5, depth_ids), (6, index), (7, slots)]);
                &self.kernels.rasterize_entries
            }
        };
        self.dispatch(kernel, None, &buffers, &Groups::Grid(tiles[0], tiles[1]));
    }
}

/// Bytes of `count` footprints.
pub(super) fn footprint_bytes(count: u32) -> u64 {
    u64::from(count) * size_of::<FootprintRow>() as u64
}
