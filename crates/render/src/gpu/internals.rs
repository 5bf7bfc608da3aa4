//! Single stages on given inputs. The tests compare them with the CPU stages.

use bytemuck::{Pod, Zeroable};

use super::{
    Context, GpuRenderer,
    buffers::{FootprintRow, PlanRow, ViewRow, narrow},
    device::Gpu,
    pipelines::{
        GROUPS_RANGES, GROUPS_TILES, GROUPS_X_MAX, NO_PICTURE, SORT_BLOCK, WORKGROUP_SIZE,
    },
    readback,
    recorder::{Copy, DIGITS_MAX, LabelBuffers, Recorder, SceneBuffers, sorted_half},
    scratch::{BatchBuffers, Need},
};
use crate::{RenderRequest, error::Result, scene::Gaussians, view::View};

/// What `project` gives.
#[derive(Clone, Debug)]
pub struct ProjectedRows {
    /// `[N]`; means nothing for a dropped Gaussian.
    pub footprints: Vec<FootprintRow>,
    /// `[N]` tiles touched, 0 for a dropped Gaussian.
    pub tiles: Vec<u32>,
    /// `[N]` bits of t.z, or `DROPPED_KEY`.
    pub depth_keys: Vec<u32>,
    /// Gaussians that touch the picture.
    pub visible: u32,
}

/// Keys and values, or tiles and Gaussians.
pub type KeysValues = (Vec<u32>, Vec<u32>);

impl GpuRenderer {
    /// Stage 1.
    ///
    /// # Errors
    /// As [`crate::Renderer::render`].
    pub fn project(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<ProjectedRows> {
        let row = view_row(gaussians, request)?;
        self.with_context(|context| {
            let (scene, _) = context.scene(gaussians, false)?;
            let room = room(context, &row, 0)?;
            let n = gaussians.len();
            let parts = [
                (&room.footprints, 0, n * 32),
                (&room.tiles, 0, n * 4),
                (&room.depth_keys, 0, n * 4),
                (&room.plans, 0, size_of::<PlanRow>()),
            ];
            let buffers = SceneBuffers {
                gaussians: &scene.gaussians,
                sh: &scene.sh,
                sh_count: scene.sh_count,
            };
            let [footprints, tiles, depth_keys, plans] =
                run(context, &room, &row, parts, |stages| stages.project(buffers))?;
            Ok(ProjectedRows {
                footprints: cast(&footprints),
                tiles: cast(&tiles),
                depth_keys: cast(&depth_keys),
                visible: cast::<PlanRow>(&plans)[0].visible,
            })
        })
    }

    /// Stage 2: the order of `keys` that are not `DROPPED_KEY`; equal ones stay as they lie.
    ///
    /// # Errors
    /// As [`crate::Renderer::render`].
    pub fn depth_sort(&self, keys: &[u32]) -> Result<Vec<u32>> {
        self.with_context(|context| {
            let count = narrow("keys", keys.len())?;
            let row = ViewRow { gaussian_count: count, ..ViewRow::zeroed() };
            let room = room(context, &row, 0)?;
            let kept = || keys.iter().copied().filter(|&key| key != super::pipelines::DROPPED_KEY);
            let plan = PlanRow {
                key_min: kept().min().unwrap_or(u32::MAX),
                key_max: kept().max().unwrap_or(0),
                ..PlanRow::default()
            };
            let half = keys.len() * 4;
            let parts = [(&room.depth_ids, 0, 2 * half), (&room.plans, 0, size_of::<PlanRow>())];
            let write = |gpu: &Gpu| {
                gpu.queue.write_buffer(&room.depth_keys, 0, bytemuck::cast_slice(keys));
                gpu.queue.write_buffer(&room.plans, 0, bytemuck::bytes_of(&plan));
            };
            let [ids, plans] = run_from(context, &room, &row, parts, write, |stages| {
                stages.depth_sort(DIGITS_MAX);
            })?;
            let plan = cast::<PlanRow>(&plans)[0];
            let first = (plan.passes as usize & 1) * keys.len();
            Ok(cast::<u32>(&ids)[first..first + plan.sorted as usize].to_vec())
        })
    }

    /// Stage 6: a stable sort by the lowest `key_bits` bits.
    ///
    /// # Errors
    /// As [`crate::Renderer::render`].
    pub fn radix_sort(&self, keys: &[u32], values: &[u32], key_bits: u32) -> Result<KeysValues> {
        self.with_context(|context| {
            let count = narrow("pairs", keys.len())?;
            let row = ViewRow { gaussian_count: 1, isect_capacity: count, ..ViewRow::zeroed() };
            let room = room(context, &row, 0)?;
            let (half, start) = (keys.len() * 4, sorted_half(key_bits) as usize * keys.len() * 4);
            let parts = [(&room.tile_keys, start, half), (&room.isect_ids, start, half)];
            let write = |gpu: &Gpu| {
                gpu.queue.write_buffer(&room.tile_keys, 0, bytemuck::cast_slice(keys));
                gpu.queue.write_buffer(&room.isect_ids, 0, bytemuck::cast_slice(values));
                plan_pairs(gpu, &room, count);
            };
            let [keys, values] =
                run_from(context, &room, &row, parts, write, |stages| stages.tile_sort(key_bits))?;
            Ok((cast(&keys), cast(&values)))
        })
    }

    /// Stage 3: of `numbers`, the sum before each block of `SCAN_BLOCK`, and the whole sum; sums
    /// stay at `u32::MAX`.
    ///
    /// # Errors
    /// As [`crate::Renderer::render`].
    pub fn prefix_sum(&self, numbers: &[u32]) -> Result<(Vec<u32>, u32)> {
        self.with_context(|context| {
            let count = narrow("numbers", numbers.len())?;
            let row = ViewRow { gaussian_count: count, ..ViewRow::zeroed() };
            let room = room(context, &row, 0)?;
            let blocks = numbers.len().div_ceil(super::pipelines::SCAN_BLOCK as usize);
            let parts = [(&room.block_sums, 0, blocks * 4), (&room.plans, 0, size_of::<PlanRow>())];
            let write = |gpu: &Gpu| in_order(gpu, &room, numbers);
            let [sums, plans] =
                run_from(context, &room, &row, parts, write, |stages| stages.prefix_sum())?;
            Ok((cast(&sums), cast::<PlanRow>(&plans)[0].needed))
        })
    }

    /// Stage 4: colours of the Gaussians that touch `tiles` tiles; the others' mean nothing.
    ///
    /// # Errors
    /// As [`crate::Renderer::render`].
    pub fn shade(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        tiles: &[u32],
    ) -> Result<Vec<[f32; 3]>> {
        let row = view_row(gaussians, request)?;
        self.with_context(|context| {
            let (scene, _) = context.scene(gaussians, false)?;
            let room = room(context, &row, 0)?;
            let parts = [(&room.colors, 0, gaussians.len() * 12)];
            let write = |gpu: &Gpu| {
                gpu.queue.write_buffer(&room.tiles, 0, bytemuck::cast_slice(tiles));
            };
            let buffers = SceneBuffers {
                gaussians: &scene.gaussians,
                sh: &scene.sh,
                sh_count: scene.sh_count,
            };
            let [colors] =
                run_from(context, &room, &row, parts, write, |stages| stages.shade(buffers))?;
            Ok(cast(&colors))
        })
    }

    /// Stages 3 and 5: the pairs of `footprints`, which are in depth order and touch `tiles` tiles.
    ///
    /// # Errors
    /// As [`crate::Renderer::render`].
    pub fn emit_isects(
        &self,
        view: &View,
        footprints: &[FootprintRow],
        tiles: &[u32],
    ) -> Result<KeysValues> {
        self.with_context(|context| {
            let total: u32 = tiles.iter().sum();
            let row = ViewRow {
                gaussian_count: narrow("footprints", footprints.len())?,
                isect_capacity: total,
                ..ViewRow::new(view, [0.0; 3], false)
            };
            let room = room(context, &row, 0)?;
            let size = total as usize * 4;
            let parts = [(&room.tile_keys, 0, size), (&room.isect_ids, 0, size)];
            let write = |gpu: &Gpu| {
                in_order(gpu, &room, tiles);
                gpu.queue.write_buffer(&room.footprints, 0, bytemuck::cast_slice(footprints));
            };
            let [keys, ids] = run_from(context, &room, &row, parts, write, |stages| {
                stages.prefix_sum();
                stages.emit_isects();
            })?;
            Ok((cast(&keys), cast(&ids)))
        })
    }

    /// Stage 7 over sorted tile keys; one more number than there are tiles.
    ///
    /// # Errors
    /// As [`crate::Renderer::render`].
    pub fn tile_ranges(&self, view: &View, tile_keys: &[u32]) -> Result<Vec<u32>> {
        self.with_context(|context| {
            let count = narrow("tile pairs", tile_keys.len())?;
            let row = ViewRow {
                gaussian_count: 1,
                isect_capacity: count,
                ..ViewRow::new(view, [0.0; 3], false)
            };
            let room = room(context, &row, 0)?;
            let size = (view.tiles_x() * view.tiles_y() + 1) as usize * 4;
            let parts = [(&room.ranges, 0, size)];
            let write = |gpu: &Gpu| {
                gpu.queue.write_buffer(&room.tile_keys, 0, bytemuck::cast_slice(tile_keys));
                plan_pairs(gpu, &room, count);
            };
            let [ranges] =
                run_from(context, &room, &row, parts, write, |stages| stages.tile_ranges())?;
            Ok(cast(&ranges))
        })
    }

    /// Stage 8: `[H, W]` of colour, depth and alpha, in this order: `[5 * H * W]` floats.
    ///
    /// # Errors
    /// As [`crate::Renderer::render`].
    pub fn rasterize(
        &self,
        view: &View,
        background: [f32; 3],
        footprints: &[FootprintRow],
        colors: &[[f32; 3]],
        isect_ids: &[u32],
        ranges: &[u32],
    ) -> Result<Vec<f32>> {
        self.with_context(|context| {
            let pixels = view.width * view.height;
            let row = ViewRow {
                gaussian_count: narrow("footprints", footprints.len())?,
                isect_capacity: narrow("tile pairs", isect_ids.len())?,
                color_start: 0,
                depth_start: pixels * 3,
                alpha_start: pixels * 4,
                ..ViewRow::new(view, background, false)
            };
            let size = pixels as usize * 20;
            let room = room(context, &row, size)?;
            let parts = [(&room.pictures, 0, size)];
            let write = |gpu: &Gpu| {
                gpu.queue.write_buffer(&room.footprints, 0, bytemuck::cast_slice(footprints));
                gpu.queue.write_buffer(&room.colors, 0, bytemuck::cast_slice(colors));
                gpu.queue.write_buffer(&room.isect_ids, 0, bytemuck::cast_slice(isect_ids));
                gpu.queue.write_buffer(&room.ranges, 0, bytemuck::cast_slice(ranges));
            };
            let (gaussians, sh) = (&room.footprints, &room.colors);
            let buffers = SceneBuffers { gaussians, sh, sh_count: 0 };
            let tiles = [view.tiles_x(), view.tiles_y()];
            let [pictures] = run_from(context, &room, &row, parts, write, |stages| {
                stages.rasterize(buffers, &LabelBuffers::None, (true, true), tiles);
            })?;
            Ok(cast(&pictures))
        })
    }
}

fn view_row(gaussians: &Gaussians, request: &RenderRequest) -> Result<ViewRow> {
    let view = View::new(gaussians.origin(), request)?;
    Ok(ViewRow {
        gaussian_count: narrow("gaussians", gaussians.len())?,
        sh_count: gaussians.sh_count() as u32,
        color_start: 0,
        depth_start: NO_PICTURE,
        alpha_start: NO_PICTURE,
        blend_start: NO_PICTURE,
        ..ViewRow::new(&view, request.background, request.antialiased)
    })
}

fn room(context: &mut Context, row: &ViewRow, picture_bytes: usize) -> Result<BatchBuffers> {
    let need = Need {
        views: 1,
        count: row.gaussian_count,
        capacity: row.isect_capacity,
        ranges: row.tiles_x * row.tiles_y + 1,
        shades: true,
        picture_bytes: picture_bytes as u64,
        ..Need::default()
    };
    context.scratch.room(&context.on.gpu, &need)
}

/// `tiles` as the counts of Gaussians that lie in depth order.
fn in_order(gpu: &Gpu, room: &BatchBuffers, tiles: &[u32]) {
    let ids: Vec<u32> = (0..tiles.len() as u32).collect();
    let plan = PlanRow { sorted: tiles.len() as u32, ..PlanRow::default() };
    gpu.queue.write_buffer(&room.tiles, 0, bytemuck::cast_slice(tiles));
    gpu.queue.write_buffer(&room.depth_ids, 0, bytemuck::cast_slice(&ids));
    gpu.queue.write_buffer(&room.plans, 0, bytemuck::bytes_of(&plan));
}

/// The plan of `count` pairs, as `scan_sums` makes it.
fn plan_pairs(gpu: &Gpu, room: &BatchBuffers, count: u32) {
    let plan = PlanRow { isects: count, needed: count, ..PlanRow::default() };
    gpu.queue.write_buffer(&room.plans, 0, bytemuck::bytes_of(&plan));
    let blocks = [
        (GROUPS_TILES, count.div_ceil(SORT_BLOCK)),
        (GROUPS_RANGES, (count + WORKGROUP_SIZE) / WORKGROUP_SIZE),
    ];
    for (at, blocks) in blocks {
        let x = blocks.clamp(1, GROUPS_X_MAX);
        let groups = [x, blocks.div_ceil(x), 1, 0];
        gpu.queue.write_buffer(&room.groups, u64::from(at) * 16, bytemuck::cast_slice(&groups));
    }
}

/// Part of a buffer: first byte, bytes.
type Part<'a> = (&'a wgpu::Buffer, usize, usize);

fn run<const N: usize>(
    context: &mut Context,
    room: &BatchBuffers,
    row: &ViewRow,
    parts: [Part<'_>; N],
    record: impl FnOnce(&mut Recorder<'_>),
) -> Result<[Vec<u8>; N]> {
    run_from(context, room, row, parts, |_| {}, record)
}

/// Writes inputs, runs what is recorded, and reads parts of buffers.
fn run_from<const N: usize>(
    context: &mut Context,
    room: &BatchBuffers,
    row: &ViewRow,
    parts: [Part<'_>; N],
    write: impl FnOnce(&Gpu),
    record: impl FnOnce(&mut Recorder<'_>),
) -> Result<[Vec<u8>; N]> {
    let gpu = &context.on.gpu;
    let total = parts.iter().map(|part| part.2 as u64).sum::<u64>();
    let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
    let staging = gpu.create_buffer("staging", total, usage)?;
    let mut at = 0;
    let copies: [Copy<'_>; N] = parts.map(|(buffer, first, size)| {
        let to = at;
        at += size as u64;
        (buffer, first as u64, &staging, to, size as u64)
    });
    gpu.scoped("stage", || {
        room.begin(gpu, std::slice::from_ref(row));
        write(gpu);
        let bindings = &mut context.scratch.bindings;
        let sizes = (1, row.gaussian_count);
        let mut stages = Recorder::new(gpu, &context.on.kernels, bindings, room, sizes, None);
        record(&mut stages);
        stages.submit(&copies)
    })??;
    readback::read(gpu, &staging, total.max(4), |bytes| {
        let mut rest = bytes;
        parts.map(|(_, _, size)| {
            let (part, tail) = rest.split_at(size);
            rest = tail;
            part.to_vec()
        })
    })
}

fn cast<T: Pod>(bytes: &[u8]) -> Vec<T> {
    bytemuck::pod_collect_to_vec(bytes)
}
