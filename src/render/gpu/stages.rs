//! One stage at a time from given inputs: what the tests compare with the CPU twin of each shader.

use bytemuck::{Pod, Zeroable};

use super::{
    Engine, GpuRenderer,
    buffers::{FootprintRow, PlanRow, ViewRow, narrow},
    device::Gpu,
    pipelines::NO_PICTURE,
    readback,
    recorder::{LabelBuffers, PairCount, Pairs, Recorder, footprint_bytes},
};
use crate::{
    error::Result,
    render::{RenderRequest, view::View},
    scene::Gaussians,
};

/// What `project` gives.
#[derive(Clone, Debug)]
pub struct Projected {
    /// `[N]`; `tiles` is 0 for a dropped Gaussian.
    pub footprints: Vec<FootprintRow>,
    /// `[N]` bits of t.z, or `DROPPED_KEY`.
    pub depth_keys: Vec<u32>,
    /// Gaussians that touch the picture.
    pub visible: u32,
}

/// Keys and values, or tiles and places in depth order.
pub type KeysValues = (Vec<u32>, Vec<u32>);

impl GpuRenderer {
    /// Stage 1.
    ///
    /// # Errors
    /// As [`crate::render::Renderer::render`].
    pub fn project(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Projected> {
        let view_row = view_row(gaussians, request)?;
        self.with_engine(|engine| {
            let count = narrow("gaussians", gaussians.len())?;
            let scene = engine.scenes.get(&engine.gpu, gaussians)?;
            let view = uniform(engine, &view_row)?;
            let footprints =
                engine.scratch.footprints.ensure(&engine.gpu, footprint_bytes(count))?;
            let pairs = engine.scratch.depth_pairs(&engine.gpu, count)?;
            let mut stages = recorder(engine, count)?;
            stages.project(&view, &scene.gaussians, &footprints, &pairs, count);
            let plan = stages.plan.clone();
            let n = gaussians.len();
            let parts = [(&footprints, n * 48), (&pairs.keys[0], n * 4), (&plan, 48)];
            let [footprints, depth_keys, plan] = finish(stages, parts)?;
            let plan: Vec<PlanRow> = cast(&plan);
            Ok(Projected {
                footprints: cast(&footprints),
                depth_keys: cast(&depth_keys),
                visible: plan[0].visible,
            })
        })
    }

    /// Stages 2 and 6: a stable sort by the lowest `key_bits` bits.
    ///
    /// # Errors
    /// As [`crate::render::Renderer::render`].
    pub fn radix_sort(&self, keys: &[u32], values: &[u32], key_bits: u32) -> Result<KeysValues> {
        self.with_engine(|engine| {
            let count = narrow("pairs", keys.len())?;
            let pairs = upload_pairs(&engine.gpu, keys, values)?;
            let mut stages = recorder(engine, count)?;
            let at = stages.sort(&pairs, PairCount::Known(count), key_bits);
            let size = keys.len() * 4;
            let parts = [(&pairs.keys[at], size), (&pairs.values[at], size)];
            let [keys, values] = finish(stages, parts)?;
            Ok((cast(&keys), cast(&values)))
        })
    }

    /// Stage 3: exclusive sums that stay at `u32::MAX`.
    ///
    /// # Errors
    /// As [`crate::render::Renderer::render`].
    pub fn prefix_sum(&self, numbers: &[u32]) -> Result<Vec<u32>> {
        self.with_engine(|engine| {
            let count = narrow("numbers", numbers.len())?;
            let buffer = engine.gpu.upload("numbers", bytemuck::cast_slice(numbers))?;
            let mut stages = recorder(engine, count)?;
            stages.prefix_sum(&buffer, count);
            let [sums] = finish(stages, [(&buffer, numbers.len() * 4)])?;
            Ok(cast(&sums))
        })
    }

    /// Stage 4: `ids` in depth order.
    ///
    /// # Errors
    /// As [`crate::render::Renderer::render`].
    pub fn shade(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        footprints: &[FootprintRow],
        ids: &[u32],
    ) -> Result<Vec<FootprintRow>> {
        let view_row = view_row(gaussians, request)?;
        self.with_engine(|engine| {
            let count = view_row.gaussian_count;
            let scene = engine.scenes.get(&engine.gpu, gaussians)?;
            let view = uniform(engine, &view_row)?;
            let footprints = engine.gpu.upload("footprints", bytemuck::cast_slice(footprints))?;
            let ids = engine.gpu.upload("ids", bytemuck::cast_slice(ids))?;
            let shaded = engine.scratch.shaded.ensure(&engine.gpu, footprint_bytes(count))?;
            let offsets = engine.scratch.isect_offsets.ensure(&engine.gpu, u64::from(count) * 4)?;
            let mut stages = recorder(engine, count)?;
            stages.shade(
                &view,
                &scene.gaussians,
                &scene.sh,
                &footprints,
                &ids,
                &shaded,
                &offsets,
                count,
            );
            let size = footprint_bytes(count) as usize;
            let [shaded] = finish(stages, [(&shaded, size)])?;
            Ok(cast(&shaded))
        })
    }

    /// Stage 5: the pairs of `shaded`, whose `tiles` add up to `isect_offsets`.
    ///
    /// # Errors
    /// As [`crate::render::Renderer::render`].
    pub fn emit_isects(
        &self,
        view: &View,
        shaded: &[FootprintRow],
        isect_offsets: &[u32],
    ) -> Result<KeysValues> {
        self.with_engine(|engine| {
            let count = narrow("footprints", shaded.len())?;
            let last = shaded.last().map_or(0, |footprint| footprint.tiles);
            let total = isect_offsets.last().map_or(0, |offset| offset + last);
            let row = ViewRow {
                gaussian_count: count,
                isect_capacity: total,
                ..ViewRow::new(view, [0.0; 3], false)
            };
            let view = uniform(engine, &row)?;
            let shaded = engine.gpu.upload("footprints", bytemuck::cast_slice(shaded))?;
            let offsets = engine.gpu.upload("offsets", bytemuck::cast_slice(isect_offsets))?;
            let pairs = engine.scratch.isect_pairs(&engine.gpu, total)?;
            let mut stages = recorder(engine, count.max(total))?;
            stages.emit_isects(&view, &shaded, &offsets, &pairs, count);
            let size = total as usize * 4;
            let parts = [(&pairs.keys[0], size), (&pairs.values[0], size)];
            let [keys, ids] = finish(stages, parts)?;
            Ok((cast(&keys), cast(&ids)))
        })
    }

    /// Stage 7 over sorted tile keys; one more number than there are tiles.
    ///
    /// # Errors
    /// As [`crate::render::Renderer::render`].
    pub fn tile_ranges(&self, view: &View, tile_keys: &[u32]) -> Result<Vec<u32>> {
        self.with_engine(|engine| {
            let count = narrow("tile pairs", tile_keys.len())?;
            let row = ViewRow {
                gaussian_count: 1,
                isect_capacity: count,
                ..ViewRow::new(view, [0.0; 3], false)
            };
            let uniform = uniform(engine, &row)?;
            // One Gaussian that touches as many tiles makes the plan.
            let one = FootprintRow { tiles: count, ..FootprintRow::zeroed() };
            let shaded = engine.gpu.upload("footprints", bytemuck::bytes_of(&one))?;
            let offsets = engine.gpu.upload("offsets", &[0; 4])?;
            let keys = engine.gpu.upload("tile keys", bytemuck::cast_slice(tile_keys))?;
            let size = (view.tiles_x() * view.tiles_y() + 1) as usize * 4;
            let ranges = engine.scratch.ranges.ensure(&engine.gpu, size as u64)?;
            let mut stages = recorder(engine, count)?;
            stages.make_plan(&uniform, &shaded, &offsets);
            stages.tile_ranges(&uniform, &keys, &ranges);
            let [ranges] = finish(stages, [(&ranges, size)])?;
            Ok(cast(&ranges))
        })
    }

    /// Stage 8: `[H, W]` of colour, depth and alpha, in this order: `[5 * H * W]` floats.
    ///
    /// # Errors
    /// As [`crate::render::Renderer::render`].
    pub fn rasterize(
        &self,
        view: &View,
        background: [f32; 3],
        shaded: &[FootprintRow],
        isect_ids: &[u32],
        ranges: &[u32],
    ) -> Result<Vec<f32>> {
        self.with_engine(|engine| {
            let pixels = view.width * view.height;
            let row = ViewRow {
                color_start: 0,
                depth_start: pixels * 3,
                alpha_start: pixels * 4,
                ..ViewRow::new(view, background, false)
            };
            let uniform = uniform(engine, &row)?;
            let shaded = engine.gpu.upload("footprints", bytemuck::cast_slice(shaded))?;
            let ids = engine.gpu.upload("ids", bytemuck::cast_slice(isect_ids))?;
            let ranges = engine.gpu.upload("ranges", bytemuck::cast_slice(ranges))?;
            let size = pixels as usize * 20;
            let pictures = engine.scratch.pictures.ensure(&engine.gpu, size as u64)?;
            let mut stages = recorder(engine, 1)?;
            let tiles = [view.tiles_x(), view.tiles_y()];
            let labels = LabelBuffers::None;
            stages.rasterize(&uniform, &shaded, &ids, &ranges, &pictures, &labels, tiles);
            let [pictures] = finish(stages, [(&pictures, size)])?;
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

fn uniform(engine: &mut Engine, row: &ViewRow) -> Result<wgpu::Buffer> {
    let view = engine.scratch.view.ensure(&engine.gpu, size_of::<ViewRow>() as u64)?;
    engine.gpu.queue.write_buffer(&view, 0, bytemuck::bytes_of(row));
    Ok(view)
}

fn recorder(engine: &mut Engine, numbers_max: u32) -> Result<Recorder<'_>> {
    Recorder::new(&engine.gpu, &engine.kernels, &mut engine.scratch, numbers_max)
}

fn upload_pairs(gpu: &Gpu, keys: &[u32], values: &[u32]) -> Result<Pairs> {
    let [keys, values] = [keys, values].map(bytemuck::cast_slice);
    Ok(Pairs {
        keys: [gpu.upload("keys", keys)?, gpu.upload("keys", keys)?],
        values: [gpu.upload("values", values)?, gpu.upload("values", values)?],
    })
}

/// Submits, and reads the first bytes of each buffer.
fn finish<const N: usize>(
    stages: Recorder<'_>,
    parts: [(&wgpu::Buffer, usize); N],
) -> Result<[Vec<u8>; N]> {
    let gpu = stages.gpu;
    let total = parts.iter().map(|part| part.1 as u64).sum::<u64>();
    let usage = wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST;
    let staging = gpu.create_buffer("staging", total, usage)?;
    let mut at = 0;
    let copies = parts.map(|(buffer, size)| {
        let to = at;
        at += size as u64;
        (buffer, 0, &staging, to, size as u64)
    });
    let submission = gpu.scoped("stage", || stages.submit(&copies))?;
    readback::read(gpu, submission, &staging, total.max(4), |bytes| {
        let mut rest = bytes;
        parts.map(|(_, size)| {
            let (part, tail) = rest.split_at(size);
            rest = tail;
            part.to_vec()
        })
    })
}

fn cast<T: Pod>(bytes: &[u8]) -> Vec<T> {
    bytemuck::pod_collect_to_vec(bytes)
}
