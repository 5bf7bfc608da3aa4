//! The tiled CPU renderer: the stages of the GPU renderer, one file each, named like the shader
//! (`bin` does what `prefix_sum` and `emit_isects` do, and the blend of a tile sorts it).
//!
//! It serves where there is no adapter. A frame is the same to the last bit for any number of
//! threads: each task writes to places that are fixed in advance, and no sum goes across tasks. No
//! stage runs on one thread alone.

pub mod backward;
pub mod bin;
pub mod cell;
pub mod cull;
pub mod footprint;
pub mod lanes;
pub mod paint;
mod pool;
pub mod project;
pub mod rasterize;
pub mod shade;
mod sky;
pub mod store;
pub mod tiles;

use std::{
    borrow::Cow,
    ops::Range,
    sync::{Arc, Weak},
    time::Instant,
};

use parking_lot::Mutex;
use rayon::prelude::*;

use self::{
    backward::{BackwardScratch, Pass, Pictures},
    bin::{Bins, DepthKeys},
    cell::{Tile, TileScratch},
    cull::Shown,
    footprint::Footprint,
    lanes::KernelOptions,
    paint::Paint,
    pool::Pool,
    project::Projected,
    rasterize::rasterize_tile,
    store::{Cut, PictureRows},
    tiles::Grid,
};
use super::{
    Frame, Labels, RenderRequest,
    backward::{FrameGradients, Gradients, backward_request},
    blocks::{BlockCache, Blocks, Frustum, blocks_from},
    budget::Budget,
    constants::{ISECTS_MAX, TILE_SIZE},
    labels::WeightRows,
    renderer::{DeviceTimes, DifferentiableRenderer, DispatchTime, Renderer},
    switches::Switches,
    view::View,
};
use crate::{
    error::{Error, Result},
    scene::Gaussians,
};

/// Scratch of more Gaussians than this is kept once, and as long as the scene lives that it was
/// for.
const SMALL_GAUSSIANS_MAX: usize = 2 << 20;
/// Tasks of the blend for each thread: tiles differ much in their work.
const TASKS_A_THREAD: usize = 16;

/// Renders on the processor with its own threads.
#[derive(Debug)]
pub struct CpuRenderer {
    threads: Arc<rayon::ThreadPool>,
    /// Buffers between frames; one set for each frame drawn at the same time.
    frames: Pool<FrameScratch>,
    /// One set for a large scene.
    large: Mutex<Option<(Weak<()>, FrameScratch)>>,
    tiles: Pool<TileScratch>,
    backwards: Pool<BackwardScratch>,
    blocks: BlockCache,
    isects_max: u64,
    options: KernelOptions,
}

impl CpuRenderer {
    /// A renderer with `threads` threads; 0 takes the cores that the process may use.
    ///
    /// # Errors
    /// `internal` when the threads cannot be started.
    pub fn new(threads: usize) -> Result<Self> {
        Self::with_switches(threads, &Switches::default())
    }

    /// The same with switches, for tests and the laboratory.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn with_switches(threads: usize, switches: &Switches) -> Result<Self> {
        let threads = match threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            n => n,
        };
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("render-{i}"))
            .build()
            .map_err(|error| {
                let why = format!("render: {threads} threads cannot be started");
                Error::internal(why).caused_by(error)
            })?;
        Ok(Self::switched(Arc::new(pool), switches))
    }

    /// A renderer that draws on these threads.
    #[must_use]
    pub fn on(threads: Arc<rayon::ThreadPool>) -> Self {
        Self::switched(threads, &Switches::default())
    }

    fn switched(threads: Arc<rayon::ThreadPool>, switches: &Switches) -> Self {
        Self {
            threads,
            frames: Pool::default(),
            large: Mutex::default(),
            tiles: Pool::default(),
            backwards: Pool::default(),
            blocks: BlockCache::new(blocks_from(switches)),
            isects_max: switches.isects_max().unwrap_or(ISECTS_MAX).into(),
            options: KernelOptions::new(switches),
        }
    }

    /// The frame, and how long each stage took.
    fn draw(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
    ) -> Result<(Frame, Vec<DispatchTime>)> {
        let blocks = self.blocks.get(gaussians, request.detail > 0.0)?;
        let large = self
            .large
            .lock()
            .take_if(|(life, _)| life.strong_count() == 0 || gaussians.len() > SMALL_GAUSSIANS_MAX);
        let mut scratch = match large {
            Some((_, scratch)) if gaussians.len() > SMALL_GAUSSIANS_MAX => scratch,
            _ => self.frames.take(),
        };
        let timed = self.draw_into(gaussians, blocks.as_deref(), request, &mut scratch)?;
        match scratch.projected.footprints.capacity() > SMALL_GAUSSIANS_MAX {
            true => *self.large.lock() = Some((gaussians.life(), scratch)),
            false => self.frames.give(scratch),
        }
        Ok(timed)
    }

    /// The same, with the blocks of the scene where it has some; footprints, and the pairs of the
    /// last band, stay in `scratch`.
    fn draw_into(
        &self,
        gaussians: &Gaussians,
        blocks: Option<&Blocks>,
        request: &RenderRequest,
        scratch: &mut FrameScratch,
    ) -> Result<(Frame, Vec<DispatchTime>)> {
        let mut clock = StageClock::new();
        let view = View::new(gaussians.origin(), request)?;
        let pixels = view.width as usize * view.height as usize;
        let mut frame = Frame::blank([view.width, view.height], request, pixels);
        let options = self.options;
        clock.ended("begin");
        scratch.projected.shown = match blocks {
            Some(blocks) => Shown::of(blocks, &Frustum::new(&view, request)),
            None => Shown::All,
        };
        clock.ended("cull");
        project::project(gaussians, request, &view, options, &mut scratch.projected);
        clock.ended("project");
        let mut brightest = 0.0;
        if request.kinds.color {
            let bounded = Budget::of(request).rays > 0.0;
            brightest = shade::shade(gaussians, &view, options, bounded, &mut scratch.projected);
            clock.ended("shade");
        }
        let seen = scratch.projected.tiles_per_gauss.par_iter().with_min_len(1 << 14);
        frame.stats.visible = seen.filter(|&&tiles| tiles > 0).count() as u64;
        let entries = match request.labels {
            Labels::None => Cow::default(),
            _ => scratch.projected.shown.entries(gaussians),
        };
        let mut band = Band {
            keys: DepthKeys::new(gaussians, &request.sources),
            paint: Paint::new(request, &view, &entries, brightest, options),
            weights: Vec::new(),
        };
        self.draw_band(&Grid::whole(&view, options), &mut band, scratch, &mut frame, &mut clock)?;
        if request.labels == Labels::Weights {
            frame.weights = Some(WeightRows::join(band.weights)?);
        }
        let frame = frame.finish(request.samples);
        clock.ended("end");
        Ok((frame, clock.stages))
    }

    /// Draws the rows of tiles of `grid`; halves them while their pairs are over the budget.
    fn draw_band(
        &self,
        grid: &Grid,
        band: &mut Band<'_>,
        scratch: &mut FrameScratch,
        frame: &mut Frame,
        clock: &mut StageClock,
    ) -> Result<()> {
        let FrameScratch { projected, bins } = scratch;
        let total = bin::bin(projected, band.keys, grid, self.isects_max, bins);
        clock.ended("bin");
        let Range { start, end } = grid.tile_rows;
        if total > self.isects_max {
            if end - start == 1 {
                let what = "render: Gaussian-tile pairs in one row of tiles";
                return Err(Error::limit(what, total, self.isects_max));
            }
            let middle = start.midpoint(end);
            for tile_rows in [start..middle, middle..end] {
                let part = Grid { tile_rows, ..grid.clone() };
                self.draw_band(&part, band, scratch, frame, clock)?;
            }
            return Ok(());
        }
        frame.stats.intersections += total;
        let footprints = &projected.footprints;
        band.weights.extend(rasterize(grid, &band.paint, footprints, bins, &self.tiles, frame));
        clock.ended("rasterize");
        Ok(())
    }
}

/// Blends the tiles of a band. Returns the weights of each row of tiles, where they are asked for.
fn rasterize(
    grid: &Grid,
    paint: &Paint<'_>,
    footprints: &[Footprint],
    bins: &[Bins],
    scratches: &Pool<TileScratch>,
    frame: &mut Frame,
) -> Vec<WeightRows> {
    let tiles_x = grid.tiles_x() as usize;
    // Tiles of a task, all in one row of tiles.
    let tasks = rayon::current_num_threads() * TASKS_A_THREAD;
    let across = (grid.tile_count() as usize / tasks).clamp(1, tiles_x);
    let weighs = *paint.labels == Labels::Weights;
    let side = TILE_SIZE as usize;
    let band = PictureRows::of(frame, grid.tile_rows.start as usize * side);
    let rows = band.split(grid.tile_rows.len(), Cut::Rows(side));
    let rows = rows.into_par_iter().with_max_len(1).enumerate();
    let weights = rows.filter_map(|(row, out)| {
        let y = (grid.tile_rows.start + row as u32) * TILE_SIZE;
        let height = TILE_SIZE.min(grid.height - y);
        let parts = out.split(tiles_x.div_ceil(across), Cut::Columns(across * side));
        let parts = parts.into_par_iter().with_max_len(1).enumerate();
        let across_row = parts.filter_map(|(part, mut out)| {
            let first = part * across;
            let last = tiles_x.min(first + across);
            let columns = (grid.width as usize).min(last * side) - first * side;
            out.weights = weighs.then(|| WeightRows::new(height as usize, columns));
            let mut scratch = scratches.take();
            for tile_x in first..last {
                let x = tile_x as u32 * TILE_SIZE;
                let tile = Tile { x, y, width: TILE_SIZE.min(grid.width - x), height };
                let mut pairs = std::mem::take(&mut scratch.pairs);
                pairs.clear();
                bins.iter().for_each(|bins| pairs.extend(bins.of(row * tiles_x + tile_x)));
                let (column, scratch) = ((tile_x - first) * side, &mut scratch);
                rasterize_tile(footprints, &mut pairs, tile, column, paint, scratch, &mut out);
                scratch.pairs = pairs;
            }
            scratches.give(scratch);
            out.weights
        });
        WeightRows::beside(across_row.collect())
    });
    weights.collect()
}

/// A view without Gaussians.
pub(super) fn background(view: &View, request: &RenderRequest) -> Result<Frame> {
    let pixels = view.width as usize * view.height as usize;
    let mut frame = Frame::blank([view.width, view.height], request, pixels);
    let options = KernelOptions::default();
    let grid = Grid::whole(view, options);
    let paint = Paint::new(request, view, &[], 0.0, options);
    let weights = rasterize(&grid, &paint, &[], &[], &Pool::default(), &mut frame);
    if request.labels == Labels::Weights {
        frame.weights = Some(WeightRows::join(weights)?);
    }
    Ok(frame.finish(request.samples))
}

/// How long stages take.
struct StageClock {
    begun: Instant,
    stages: Vec<DispatchTime>,
}

impl StageClock {
    fn new() -> Self {
        Self { begun: Instant::now(), stages: Vec::new() }
    }

    fn ended(&mut self, stage: &'static str) {
        let now = Instant::now();
        let ms = now.duration_since(self.begun).as_secs_f64() * 1e3;
        self.stages.push(DispatchTime { stage, ms });
        self.begun = now;
    }
}

impl Renderer for CpuRenderer {
    fn name(&self) -> String {
        "cpu".to_owned()
    }

    /// A view uses every thread; a second one fills the gaps of the first.
    fn concurrency(&self) -> usize {
        (self.threads.current_num_threads() / 2).clamp(2, 8)
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        self.threads.install(|| self.draw(gaussians, request)).map(|(frame, _)| frame)
    }

    fn prepare(&self, gaussians: &Gaussians) -> Result<()> {
        self.threads.install(|| self.blocks.get(gaussians, false))?;
        Ok(())
    }

    fn near(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        at: [f64; 2],
        by: f64,
    ) -> Result<Option<Vec<u32>>> {
        let frustum = Frustum::around(&View::new(gaussians.origin(), request)?, request, at, by);
        let blocks = self.threads.install(|| self.blocks.get(gaussians, false))?;
        Ok(blocks.map(|blocks| blocks.near(&frustum)))
    }

    fn device_times(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
    ) -> Result<Option<DeviceTimes>> {
        let (_, stages) = self.threads.install(|| self.draw(gaussians, request))?;
        let total_ms = stages.iter().map(|stage| stage.ms).sum();
        Ok(Some(DeviceTimes { total_ms, stages }))
    }
}

impl DifferentiableRenderer for CpuRenderer {
    fn backward(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        loss: &mut dyn FnMut(&Frame) -> Result<FrameGradients>,
        gradients: &mut Gradients,
    ) -> Result<Frame> {
        let request = backward_request(request);
        let mut scratch = self.frames.take();
        let (frame, _) =
            self.threads.install(|| self.draw_into(gaussians, None, &request, &mut scratch))?;
        if frame.stats.intersections > self.isects_max {
            let what = "backward: Gaussian-tile pairs of a view";
            return Err(Error::limit(what, frame.stats.intersections, self.isects_max));
        }
        let by_frame = loss(&frame)?;
        by_frame.check_of(&frame)?;
        gradients.clear(gaussians.len(), gaussians.sh_count());
        self.threads.install(|| {
            let view = View::new(gaussians.origin(), &request)?;
            let behind = background(&view, &request)?;
            let pass = Pass {
                options: self.options,
                scratches: &self.backwards,
                gaussians,
                request: &request,
                view: &view,
                grid: Grid::whole(&view, self.options),
                projected: &scratch.projected,
                bins: &scratch.bins,
                pictures: Pictures { frame: &frame, behind: &behind, by: &by_frame },
            };
            pass.run(gradients);
            Ok::<_, Error>(())
        })?;
        self.frames.give(scratch);
        Ok(frame)
    }
}

/// Data that the bands of a frame share, and their weights from top to bottom.
struct Band<'a> {
    keys: DepthKeys<'a>,
    paint: Paint<'a>,
    weights: Vec<WeightRows>,
}

/// Buffers of a frame, named as the stages name them.
#[derive(Debug, Default)]
struct FrameScratch {
    projected: Projected,
    bins: Vec<Bins>,
}
