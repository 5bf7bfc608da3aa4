//! What the tests of the GPU renderer look at: single stages on given inputs, the structs and
//! numbers that host and shaders share, and the state of the devices. The product uses none of it.

use bytemuck::{Pod, Zeroable};

use super::{
    GpuRenderer,
    adapter::{Adapter, OpenDevice},
    buffers::{DeviceScene, narrow},
    frame::plain,
    pipelines::{
        self, GROUPS_RANGES, GROUPS_TILES, GROUPS_X_MAX, RasterLabels, SCAN_BLOCK, SORT_BLOCK,
        WORKGROUP_SIZE,
    },
    readback,
    recorder::{Bindings, Copy, DIGITS_MAX, Recorder, SceneBuffers, sorted_half},
    scratch::{BatchBuffers, Need},
};
pub use super::{
    buffers::{FootprintRow, GaussianRow, PlanRow, SortParams, ViewRow},
    pipelines::{SHADERS, SHARED, Shader},
};
use crate::{RenderRequest, error::Result, scene::Gaussians, view::View};

/// Depth key of a dropped Gaussian.
pub const DROPPED_KEY: u32 = pipelines::DROPPED_KEY;
/// Value of a pair that was counted and not emitted.
pub const NO_GAUSSIAN: u32 = pipelines::NO_GAUSSIAN;

/// The inside of a [`GpuRenderer`]. Stages run on its first device.
#[derive(Clone, Copy, Debug)]
pub struct Internals<'a>(&'a GpuRenderer);

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
    /// The inside, for tests.
    pub fn internals(&self) -> Internals<'_> {
        Internals(self)
    }
}

#[expect(clippy::missing_errors_doc, reason = "all have the errors of `Renderer::render`")]
impl Internals<'_> {
    /// Scenes kept on all devices now.
    pub fn scenes_held(self) -> usize {
        self.0.adapters.iter().map(Adapter::scenes_held).sum()
    }

    /// Submissions so far, and views drawn by them.
    pub fn submissions(self) -> (u64, u64) {
        let both = self.0.adapters.iter().map(Adapter::submissions);
        both.fold((0, 0), |sum, one| (sum.0 + one.0, sum.1 + one.1))
    }

    /// Makes every device seem lost at once, whatever runs on it.
    pub fn lose_devices(self) {
        self.0.adapters.iter().for_each(Adapter::lose_device);
    }

    /// Stage 1.
    pub fn project(self, gaussians: &Gaussians, request: &RenderRequest) -> Result<ProjectedRows> {
        let row = scene_row(gaussians, request)?;
        self.run(row, 0, Some(gaussians), |stage| {
            let (room, n) = (&stage.room, gaussians.len());
            let parts = [
                (&room.footprints, 0, n * size_of::<FootprintRow>()),
                (&room.tiles, 0, n * 4),
                (&room.depth_keys, 0, n * 4),
                (&room.plans, 0, size_of::<PlanRow>()),
            ];
            let [footprints, tiles, depth_keys, plans] =
                stage.read(parts, |stages| stages.project(stage.scene()))?;
            Ok(ProjectedRows {
                footprints: cast(&footprints),
                tiles: cast(&tiles),
                depth_keys: cast(&depth_keys),
                visible: cast::<PlanRow>(&plans)[0].visible,
            })
        })
    }

    /// Stage 2: the order of `keys` that are not `DROPPED_KEY`; equal ones keep their order.
    pub fn depth_sort(self, keys: &[u32]) -> Result<Vec<u32>> {
        let gaussian_count = narrow("keys", keys.len())?;
        self.run(ViewRow { gaussian_count, ..ViewRow::zeroed() }, 0, None, |stage| {
            let room = &stage.room;
            let kept = || keys.iter().copied().filter(|&key| key != DROPPED_KEY);
            let plan = PlanRow {
                key_min: kept().min().unwrap_or(u32::MAX),
                key_max: kept().max().unwrap_or(0),
                ..PlanRow::default()
            };
            stage.write(&room.depth_keys, keys);
            stage.write(&room.plans, &[plan]);
            let parts =
                [(&room.depth_ids, 0, 8 * keys.len()), (&room.plans, 0, size_of::<PlanRow>())];
            let [ids, plans] = stage.read(parts, |stages| stages.depth_sort(DIGITS_MAX))?;
            let plan = cast::<PlanRow>(&plans)[0];
            let first = (plan.passes as usize & 1) * keys.len();
            Ok(cast::<u32>(&ids)[first..first + plan.sorted as usize].to_vec())
        })
    }

    /// Stage 6: a stable sort by the lowest `key_bits` bits.
    pub fn radix_sort(self, keys: &[u32], values: &[u32], key_bits: u32) -> Result<KeysValues> {
        let count = narrow("pairs", keys.len())?;
        let row = ViewRow { gaussian_count: 1, isect_capacity: count, ..ViewRow::zeroed() };
        self.run(row, 0, None, |stage| {
            let room = &stage.room;
            stage.write(&room.tile_keys, keys);
            stage.write(&room.isect_ids, values);
            stage.plan_pairs(count);
            let (half, start) = (keys.len() * 4, sorted_half(key_bits) as usize * keys.len() * 4);
            let parts = [(&room.tile_keys, start, half), (&room.isect_ids, start, half)];
            let [keys, values] = stage.read(parts, |stages| stages.tile_sort(key_bits))?;
            Ok((cast(&keys), cast(&values)))
        })
    }

    /// Stage 3: of `numbers`, the sum before each block of `SCAN_BLOCK`, and the whole sum; sums
    /// stay at `u32::MAX`.
    pub fn prefix_sum(self, numbers: &[u32]) -> Result<(Vec<u32>, u32)> {
        let gaussian_count = narrow("numbers", numbers.len())?;
        self.run(ViewRow { gaussian_count, ..ViewRow::zeroed() }, 0, None, |stage| {
            let room = &stage.room;
            stage.in_order(numbers);
            let blocks = gaussian_count.div_ceil(SCAN_BLOCK) as usize;
            let parts = [(&room.block_sums, 0, blocks * 4), (&room.plans, 0, size_of::<PlanRow>())];
            let [sums, plans] = stage.read(parts, |stages| stages.prefix_sum())?;
            Ok((cast(&sums), cast::<PlanRow>(&plans)[0].needed))
        })
    }

    /// Stage 4: colours of the Gaussians that touch `tiles` tiles; the others' mean nothing.
    pub fn shade(
        self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        tiles: &[u32],
    ) -> Result<Vec<[f32; 3]>> {
        let row = scene_row(gaussians, request)?;
        self.run(row, 0, Some(gaussians), |stage| {
            stage.write(&stage.room.tiles, tiles);
            let parts = [(&stage.room.colors, 0, gaussians.len() * 12)];
            let [colors] = stage.read(parts, |stages| stages.shade(stage.scene()))?;
            Ok(cast(&colors))
        })
    }

    /// Stages 3 and 5: the pairs of `footprints`, which are in depth order and touch `tiles` tiles.
    pub fn emit_isects(
        self,
        view: &View,
        footprints: &[FootprintRow],
        tiles: &[u32],
    ) -> Result<KeysValues> {
        let total: u32 = tiles.iter().sum();
        let row = ViewRow {
            gaussian_count: narrow("footprints", footprints.len())?,
            isect_capacity: total,
            ..ViewRow::new(view, [0.0; 3], false)
        };
        self.run(row, 0, None, |stage| {
            let (room, size) = (&stage.room, total as usize * 4);
            stage.in_order(tiles);
            stage.write(&room.footprints, footprints);
            let parts = [(&room.tile_keys, 0, size), (&room.isect_ids, 0, size)];
            let [keys, ids] = stage.read(parts, |stages| {
                stages.prefix_sum();
                stages.emit_isects();
            })?;
            Ok((cast(&keys), cast(&ids)))
        })
    }

    /// Stage 7 over sorted tile keys; one more number than there are tiles.
    pub fn tile_ranges(self, view: &View, tile_keys: &[u32]) -> Result<Vec<u32>> {
        let count = narrow("tile pairs", tile_keys.len())?;
        let row = ViewRow {
            gaussian_count: 1,
            isect_capacity: count,
            ..ViewRow::new(view, [0.0; 3], false)
        };
        self.run(row, 0, None, |stage| {
            stage.write(&stage.room.tile_keys, tile_keys);
            stage.plan_pairs(count);
            let size = (view.tiles_x() * view.tiles_y() + 1) as usize * 4;
            let [ranges] =
                stage.read([(&stage.room.ranges, 0, size)], |stages| stages.tile_ranges())?;
            Ok(cast(&ranges))
        })
    }

    /// Stage 8: `[H, W]` of colour, depth and alpha, in this order: `[5 * H * W]` floats.
    pub fn rasterize(
        self,
        view: &View,
        background: [f32; 3],
        footprints: &[FootprintRow],
        colors: &[[f32; 3]],
        isect_ids: &[u32],
        ranges: &[u32],
    ) -> Result<Vec<f32>> {
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
        self.run(row, size, None, |stage| {
            let room = &stage.room;
            stage.write(&room.footprints, footprints);
            stage.write(&room.colors, colors);
            stage.write(&room.isect_ids, isect_ids);
            stage.write(&room.ranges, ranges);
            let tiles = [view.tiles_x(), view.tiles_y()];
            let [pictures] = stage.read([(&room.pictures, 0, size)], |stages| {
                stages.rasterize(stage.scene(), (RasterLabels::None, None), (true, true), tiles);
            })?;
            Ok(cast(&pictures))
        })
    }

    /// Makes room for one view, with the scene of `gaussians` where a stage reads it.
    fn run<T>(
        self,
        row: ViewRow,
        picture_bytes: usize,
        gaussians: Option<&Gaussians>,
        work: impl FnOnce(&Stage) -> Result<T>,
    ) -> Result<T> {
        self.0.adapters[0].with_context(|context| {
            let need = Need {
                views: 1,
                count: row.gaussian_count,
                capacity: row.isect_capacity,
                ranges: row.tiles_x * row.tiles_y + 1,
                shades: true,
                picture_bytes: picture_bytes as u64,
                ..Need::default()
            };
            let scene = gaussians.map(|gaussians| context.scene(gaussians, false)).transpose()?;
            let room = context.scratch.room(&context.on.gpu, &need)?;
            room.begin(&context.on.gpu, std::slice::from_ref(&row));
            work(&Stage { on: context.on.clone(), room, row, scene })
        })
    }
}

/// A scene's view, for stages that write no picture.
fn scene_row(gaussians: &Gaussians, request: &RenderRequest) -> Result<ViewRow> {
    let view = View::new(gaussians.origin(), request)?;
    Ok(ViewRow {
        gaussian_count: narrow("gaussians", gaussians.len())?,
        sh_count: gaussians.sh_count() as u32,
        ..ViewRow::new(&view, plain(request)?, request.antialiased)
    })
}

/// The buffers of a stage that runs alone.
struct Stage {
    on: OpenDevice,
    room: BatchBuffers,
    row: ViewRow,
    scene: Option<DeviceScene>,
}

impl Stage {
    /// What stages read of the scene. Without one, rasterize reads the colours in the room.
    fn scene(&self) -> SceneBuffers<'_> {
        let (gaussians, sh) = (&self.room.footprints, &self.room.colors);
        let none = SceneBuffers { gaussians, sh, sh_count: 0 };
        self.scene.as_ref().map_or(none, DeviceScene::buffers)
    }

    fn write<T: Pod>(&self, to: &wgpu::Buffer, values: &[T]) {
        self.on.gpu.queue.write_buffer(to, 0, bytemuck::cast_slice(values));
    }

    /// Sets `tiles` as the counts of Gaussians that lie in depth order.
    fn in_order(&self, tiles: &[u32]) {
        let ids: Vec<u32> = (0..tiles.len() as u32).collect();
        self.write(&self.room.tiles, tiles);
        self.write(&self.room.depth_ids, &ids);
        self.write(&self.room.plans, &[PlanRow { sorted: ids.len() as u32, ..PlanRow::default() }]);
    }

    /// Sets the plan of `count` pairs, as `scan_sums` makes it.
    fn plan_pairs(&self, count: u32) {
        let plan = PlanRow { isects: count, needed: count, ..PlanRow::default() };
        self.write(&self.room.plans, &[plan]);
        let blocks = [
            (GROUPS_TILES, count.div_ceil(SORT_BLOCK)),
            (GROUPS_RANGES, (count + WORKGROUP_SIZE) / WORKGROUP_SIZE),
        ];
        for (at, blocks) in blocks {
            let x = blocks.clamp(1, GROUPS_X_MAX);
            let groups = [x, blocks.div_ceil(x), 1, 0];
            let (to, at) = (&self.room.groups, u64::from(at) * 16);
            self.on.gpu.queue.write_buffer(to, at, bytemuck::cast_slice(&groups));
        }
    }

    /// Runs what is recorded, and reads parts of buffers: first byte, bytes.
    fn read<const N: usize>(
        &self,
        parts: [(&wgpu::Buffer, usize, usize); N],
        record: impl FnOnce(&mut Recorder<'_>),
    ) -> Result<[Vec<u8>; N]> {
        let gpu = &self.on.gpu;
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
            let (mut bindings, sizes) = (Bindings::default(), (1, self.row.gaussian_count));
            let kernels = &self.on.kernels;
            let mut stages = Recorder::new(gpu, kernels, &mut bindings, &self.room, sizes, None);
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
}

fn cast<T: Pod>(bytes: &[u8]) -> Vec<T> {
    bytemuck::pod_collect_to_vec(bytes)
}
