//! What the tests of the GPU renderer look at: single stages on given inputs, the structs and
//! numbers that host and shaders share, and the state of the devices. The product has none of it.

use std::sync::atomic::{AtomicU64, Ordering};

use bytemuck::{Pod, Zeroable};

use super::{
    GpuRenderer,
    adapter::Adapter,
    batch_buffers::{BatchBuffers, BatchSizes, BufferCopy},
    bindings::{Bindings, Inputs},
    buffers::{DeviceScene, narrow},
    context::OpenDevice,
    pipelines::{Kernel, RasterKinds, RasterLabels},
    readback,
    recorder::Recorder,
};
pub use super::{
    buffers::{BlockRow, FootprintRow, GaussianRow, PlanRow, SourceRow, TrainingRow, ViewRow},
    pipelines::{SHADERS, SHARED, Shader},
};
use crate::{
    RenderRequest,
    budget::brightest,
    error::Result,
    scene::Gaussians,
    train::{Trainer as _, TrainingSet, TrainingStep},
    view::View,
};

/// The inside of a [`GpuRenderer`]. Stages run on its first device.
#[derive(Clone, Copy, Debug)]
pub struct Internals<'a>(&'a GpuRenderer);

/// What `project` gives.
#[derive(Clone, Debug)]
pub struct ProjectedRows {
    /// `[N]`; means nothing for a dropped Gaussian.
    pub footprints: Vec<FootprintRow>,
    /// `[N]` tiles touched, 0 for a dropped Gaussian.
    pub touched: Vec<u32>,
    /// `[N]` words that say which these are: `shaders/common/tiles.wgsl`.
    pub words: Vec<u32>,
    /// Gaussians that touch each tile.
    pub tiles: Vec<u32>,
    /// Gaussians that touch the picture.
    pub visible: u32,
}

/// (depth key, Gaussian) of each tile.
pub type TileLists = Vec<Vec<[u32; 2]>>;

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
        self.0.adapters.iter().map(|adapter| adapter.shapes.lock().len()).sum()
    }

    /// Submissions so far, and views drawn by them.
    pub fn submissions(self) -> (u64, u64) {
        let of = |count: fn(&Adapter) -> &AtomicU64| {
            self.0.adapters.iter().map(|one| count(one).load(Ordering::Relaxed)).sum()
        };
        (of(|adapter| &adapter.submissions), of(|adapter| &adapter.views))
    }

    /// Makes every device seem lost at once, whatever runs on it.
    pub fn lose_devices(self) {
        for adapter in &self.0.adapters {
            if let Some(opened) = &adapter.state.lock().opened {
                opened.gpu.give_up("lost on purpose".to_owned());
            }
        }
    }

    /// What the loss says of the picture that a trainer of `set` draws first, `[H * W]` by colour,
    /// as photo `at` was exposed, after its first step.
    pub fn loss_gradient(
        self,
        set: &TrainingSet<'_>,
        at: usize,
        step: &TrainingStep,
    ) -> Result<Vec<[f32; 3]>> {
        let mut trainer = self.0.adapters[0].trainer(set, u64::MAX)?;
        trainer.step(&[at], step)?;
        trainer.by_picture(at)
    }

    /// Stage 1.
    pub fn project(self, gaussians: &Gaussians, request: &RenderRequest) -> Result<ProjectedRows> {
        let row = scene_row(gaussians, request)?;
        let sources: Vec<SourceRow> = request.sources.iter().map(SourceRow::from).collect();
        self.run(row, 0, Some(gaussians), |stage| {
            let (room, n) = (&stage.room, gaussians.len());
            stage.write(&room.sources, &sources);
            let parts = [
                (&room.footprints, 0, n * size_of::<FootprintRow>()),
                (&room.touched, 0, n * 4),
                (&room.ends, 0, (row.tiles_x * row.tiles_y) as usize * 4),
                (&room.plans, 0, size_of::<PlanRow>()),
            ];
            let [footprints, words, tiles, plans] =
                stage.read(parts, |stages| stages.gaussians(Kernel::Project))?;
            let words: Vec<u32> = cast(&words);
            let in_square = |word: u32| (word & 15).count_ones();
            let count = |&word: &u32| if word >= 1 << 31 { in_square(word) } else { word };
            Ok(ProjectedRows {
                footprints: cast(&footprints),
                touched: words.iter().map(count).collect(),
                words,
                tiles: cast(&tiles),
                visible: cast::<PlanRow>(&plans)[0].visible,
            })
        })
    }

    /// Stage 3: of the counts of `columns` by rows of tiles, the sum before each, and the whole
    /// sum; sums stay at `u32::MAX`.
    pub fn prefix_sum(self, counts: &[u32], columns: u32) -> Result<Vec<u32>> {
        let tiles = narrow("tiles", counts.len())?;
        let row = ViewRow {
            gaussian_count: 1,
            tiles_x: columns,
            tiles_y: tiles / columns,
            row_end: tiles / columns,
            ..ViewRow::zeroed()
        };
        self.run(row, 0, None, |stage| {
            let room = &stage.room;
            stage.write(&room.ends, counts);
            let parts = [
                (&room.starts, 0, (counts.len() + 1) * 4),
                (&room.ends, 0, counts.len() * 4),
                (&room.plans, 0, size_of::<PlanRow>()),
            ];
            let [sums, ends, plans] = stage.read(parts, |stages| stages.prefix_sum())?;
            let (sums, ends): (Vec<u32>, Vec<u32>) = (cast(&sums), cast(&ends));
            let needed = cast::<PlanRow>(&plans)[0].needed;
            if sums.last() != Some(&needed) || ends != sums[..counts.len()] {
                return Err(crate::error::Error::internal("starts and ends differ"));
            }
            Ok(sums)
        })
    }

    /// Stage 2: colours of the Gaussians that touch `tiles` tiles; the others' mean nothing.
    pub fn shade(
        self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        tiles: &[u32],
    ) -> Result<Vec<[f32; 3]>> {
        let row = ViewRow { color_start: 0, ..scene_row(gaussians, request)? };
        self.run(row, 0, Some(gaussians), |stage| {
            stage.write(&stage.room.touched, tiles);
            let parts = [(&stage.room.colors, 0, gaussians.len() * 12)];
            let [colors] = stage.read(parts, |stages| stages.gaussians(Kernel::Shade))?;
            Ok(cast(&colors))
        })
    }

    /// Stages 3 to 5: the lists of the tiles, sorted, from what `project` gives.
    pub fn lists(self, view: &View, rows: &ProjectedRows) -> Result<TileLists> {
        let total: u32 = rows.tiles.iter().sum();
        let row = ViewRow {
            gaussian_count: narrow("footprints", rows.footprints.len())?,
            isect_capacity: total,
            ..ViewRow::new(view, [0.0; 3], false)
        };
        self.run(row, 0, None, |stage| {
            let (room, tiles) = (&stage.room, [view.tiles_x(), view.tiles_y()]);
            stage.write(&room.footprints, &rows.footprints);
            stage.write(&room.touched, &rows.words);
            stage.write(&room.ends, &rows.tiles);
            let parts =
                [(&room.lists, 0, rows.tiles.len() * 8), (&room.pairs, 0, total as usize * 16)];
            let [lists, pairs] = stage.read(parts, |stages| {
                stages.prefix_sum();
                stages.gaussians(Kernel::EmitIsects);
                stages.tiles(Kernel::TileSort, tiles);
            })?;
            let pairs: Vec<[u32; 2]> = cast(&pairs);
            let list = |&[first, end]: &[u32; 2]| pairs[first as usize..end as usize].to_vec();
            Ok(cast(&lists).iter().map(list).collect())
        })
    }

    /// Stage 5: the lists `lists` of as many tiles, sorted.
    pub fn tile_sort(self, lists: &[Vec<[u32; 2]>]) -> Result<TileLists> {
        let pairs = lists.concat();
        let tiles = narrow("tiles", lists.len())?;
        let row = ViewRow {
            gaussian_count: 1,
            isect_capacity: narrow("pairs", pairs.len())?,
            tiles_x: tiles,
            tiles_y: 1,
            row_end: 1,
            ..ViewRow::zeroed()
        };
        let mut starts = vec![0];
        for list in lists {
            starts.push(starts[starts.len() - 1] + list.len() as u32);
        }
        self.run(row, 0, None, |stage| {
            let room = &stage.room;
            stage.write(&room.starts, &starts);
            stage.write(&room.ends, &starts[1..]);
            stage.write(&room.pairs, &pairs);
            let parts = [(&room.lists, 0, lists.len() * 8), (&room.pairs, 0, pairs.len() * 16)];
            let [lists, pairs] =
                stage.read(parts, |stages| stages.tiles(Kernel::TileSort, [tiles, 1]))?;
            let pairs: Vec<[u32; 2]> = cast(&pairs);
            let list = |&[first, end]: &[u32; 2]| pairs[first as usize..end as usize].to_vec();
            Ok(cast(&lists).iter().map(list).collect())
        })
    }

    /// Stage 6: `[H, W]` of colour, depth and alpha, in this order: `[5 * H * W]` floats.
    pub fn rasterize(
        self,
        view: &View,
        background: [f32; 3],
        footprints: &[FootprintRow],
        colors: &[[f32; 3]],
        isect_ids: &[u32],
        ranges: &[u32],
    ) -> Result<Vec<f32>> {
        let pairs: Vec<[u32; 2]> = isect_ids.iter().map(|&id| [0, id]).collect();
        let lists: Vec<[u32; 2]> = ranges.windows(2).map(|ends| [ends[0], ends[1]]).collect();
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
            stage.write(&room.pairs, &pairs);
            stage.write(&room.lists, &lists);
            let tiles = [view.tiles_x(), view.tiles_y()];
            let [pictures] = stage.read([(&room.pictures, 0, size)], |stages| {
                let labels = RasterLabels::None;
                let kinds = RasterKinds { color: true, depth: true, bytes: false, labels };
                stages.tiles(Kernel::Rasterize(kinds), tiles);
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
            let need = BatchSizes {
                views: 1,
                count: row.gaussian_count,
                capacity: row.isect_capacity,
                tiles: row.tiles_x * row.tiles_y + 1,
                shades: true,
                source_bytes: u64::from(row.source_count) * size_of::<SourceRow>() as u64,
                picture_bytes: picture_bytes as u64,
                ..BatchSizes::default()
            };
            let scene =
                gaussians.map(|gaussians| context.scene(gaussians, false, false)).transpose()?;
            let room = context.scratch.room(&context.on.gpu, &need)?;
            let stage = Stage { on: context.on.clone(), room, row, scene };
            stage.write(&stage.room.views, &[row]);
            stage.write(&stage.room.plans, &[PlanRow::default()]);
            stage.write(&stage.room.ends, &vec![0_u32; need.tiles as usize]);
            work(&stage)
        })
    }
}

/// A scene's view, for stages that write no picture.
fn scene_row(gaussians: &Gaussians, request: &RenderRequest) -> Result<ViewRow> {
    let view = View::new(gaussians.origin(), request)?;
    Ok(ViewRow {
        gaussian_count: narrow("gaussians", gaussians.len())?,
        sh_count: gaussians.sh_count() as u32,
        ..ViewRow::of(&view, request, brightest(gaussians))
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
    fn write<T: Pod>(&self, to: &wgpu::Buffer, values: &[T]) {
        self.on.gpu.queue.write_buffer(to, 0, bytemuck::cast_slice(values));
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
        let copies = parts.map(|(buffer, first, size)| {
            let (to, bytes) = (at, size as u64);
            at += bytes;
            BufferCopy { from: (buffer, first as u64), to: (&staging, to), bytes }
        });
        let (kernels, bindings) = (&*self.on.kernels, &mut Bindings::default());
        let inputs = Inputs::new(kernels, &self.room, self.scene.as_ref(), 1);
        let inputs = Inputs { count: self.row.gaussian_count, ..inputs };
        gpu.scoped("stage", || {
            let mut stages = Recorder::new(gpu, kernels, bindings, inputs, &[], None);
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
