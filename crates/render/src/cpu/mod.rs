//! The tiled CPU renderer: the stages of the GPU renderer, one file each, named like the shader.
//!
//! It serves where there is no adapter. A frame is the same to the last bit for any number of
//! threads: each task writes to places that are fixed in advance, and no sum goes across tasks.

pub mod emit_isects;
pub mod footprint;
pub mod lanes;
pub mod paint;
pub mod prefix_sum;
pub mod project;
pub mod radix_sort;
pub mod rasterize;
pub mod shade;
mod sky;
pub mod store;
pub mod tile_ranges;
pub mod tiles;

use std::ops::Range;

use parking_lot::Mutex;
use rayon::prelude::*;

use self::{
    lanes::KernelOptions,
    paint::Paint,
    project::Projected,
    radix_sort::{key, pack, value},
    rasterize::{Tile, TileScratch},
    store::RowOut,
    tiles::Grid,
};
use super::{
    Frame, Labels, RenderRequest, Renderer,
    constants::{BEHIND_BIT, ISECTS_MAX, TILE_SIZE},
    labels::WeightRows,
    switches::{Skip, Switches},
    view::View,
};
use crate::{
    error::{Error, Result},
    scene::Gaussians,
};

/// Scratch with more Gaussians than this is freed after the frame instead of kept.
const KEPT_GAUSSIANS_MAX: usize = 2 << 20;

/// Renders on the processor with its own threads.
#[derive(Debug)]
pub struct CpuRenderer {
    threads: rayon::ThreadPool,
    /// Buffers between frames; one set for each frame drawn at the same time.
    frames: Pool<FrameScratch>,
    tiles: Pool<TileScratch>,
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
        Ok(Self {
            threads: pool,
            frames: Pool::default(),
            tiles: Pool::default(),
            isects_max: switches.isects_max.unwrap_or(ISECTS_MAX).into(),
            options: KernelOptions::new(switches),
        })
    }

    fn draw(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        let view = View::new(gaussians.origin(), request)?;
        let pixels = view.width as usize * view.height as usize;
        let mut frame = Frame::blank([view.width, view.height], request, pixels);
        let mut scratch = self.frames.take();
        let FrameScratch { projected, sorted, spare, .. } = &mut scratch;
        let options = self.options;
        project::project(gaussians, request, &view, options, projected);
        let all = !options.skips(Skip::Unseen);
        let kept = |&(_, &tiles): &(u32, &u32)| tiles > 0 || all;
        let kept = (0_u32..).zip(&projected.tiles_per_gauss).filter(kept);
        sorted.clear();
        sorted.extend(kept.map(|(i, _)| {
            let view = usize::from(gaussians.source()[i as usize].view);
            let behind = request.sources.get(view).is_some_and(|source| source.behind);
            // t.z is over 0, so its bits sort like its value.
            let depth = projected.footprints[i as usize].depth.to_bits();
            pack(if behind { depth | BEHIND_BIT } else { depth }, i)
        }));
        radix_sort::radix_sort(sorted, spare, u32::BITS);
        if request.kinds.color {
            shade::shade(gaussians, &view, options, projected);
        }
        let visible = projected.tiles_per_gauss.iter().filter(|&&tiles| tiles > 0);
        frame.stats.visible = visible.count() as u64;
        let grid = Grid::whole(&view, options);
        let paint = Paint::new(request, &view, gaussians.semantic_index(), options);
        let mut band = Band { paint, weights: Vec::new() };
        self.draw_band(&grid, &mut band, &mut scratch, &mut frame)?;
        if request.labels == Labels::Weights {
            frame.weights = Some(WeightRows::join(band.weights)?);
        }
        if gaussians.len() <= KEPT_GAUSSIANS_MAX {
            self.frames.give(scratch);
        }
        Ok(frame.finish(request.samples))
    }

    /// Draws the rows of tiles of `grid`; halves them while their pairs are over the budget.
    fn draw_band(
        &self,
        grid: &Grid,
        band: &mut Band<'_>,
        scratch: &mut FrameScratch,
        frame: &mut Frame,
    ) -> Result<()> {
        let FrameScratch { projected, sorted, spare, isect_offsets, .. } = scratch;
        let whole = grid.tile_rows == (0..grid.height.div_ceil(TILE_SIZE));
        let counts = sorted.iter().map(|&pair| {
            let id = value(pair) as usize;
            match whole {
                true => projected.tiles_per_gauss[id],
                false => projected.tile_spans[id].count(&projected.footprints[id], grid),
            }
        });
        let total = prefix_sum::prefix_sum(counts, isect_offsets);
        let Range { start, end } = grid.tile_rows;
        if total > self.isects_max {
            if end - start == 1 {
                let what = "render: Gaussian-tile pairs in one row of tiles";
                return Err(Error::limit(what, total, self.isects_max));
            }
            let middle = start.midpoint(end);
            for tile_rows in [start..middle, middle..end] {
                self.draw_band(&Grid { tile_rows, ..grid.clone() }, band, scratch, frame)?;
            }
            return Ok(());
        }
        frame.stats.intersections += total;
        emit_isects::emit_isects(projected, sorted, grid, isect_offsets, &mut scratch.isects);
        let tile_bits = u32::BITS - (grid.tile_count() - 1).leading_zeros();
        radix_sort::radix_sort(&mut scratch.isects, spare, tile_bits);
        tile_ranges::tile_ranges(&scratch.isects, grid.tile_count(), &mut scratch.ranges);
        self.rasterize(grid, band, scratch, frame);
        Ok(())
    }

    /// Blends the tiles of a band, one task a row of tiles.
    fn rasterize(
        &self,
        grid: &Grid,
        band: &mut Band<'_>,
        scratch: &FrameScratch,
        frame: &mut Frame,
    ) {
        let tiles_x = grid.tiles_x() as usize;
        let paint = band.paint;
        let rows = band_rows(frame, grid, *paint.labels == Labels::Weights);
        let drawn = rows.into_par_iter().with_max_len(1).enumerate().map(|(row, mut out)| {
            let mut tile_scratch = self.tiles.take();
            let y = (grid.tile_rows.start + row as u32) * TILE_SIZE;
            for (tile_x, tile) in row_tiles(grid, y).enumerate() {
                let id = row * tiles_x + tile_x;
                let range = scratch.ranges[id] as usize..scratch.ranges[id + 1] as usize;
                let isects = &scratch.isects[range];
                debug_assert!(isects.iter().all(|&isect| key(isect) as usize == id));
                let footprints = &scratch.projected.footprints;
                let tools = (&paint, &mut tile_scratch);
                rasterize::rasterize_tile(footprints, isects, tile, tools, grid.width, &mut out);
            }
            self.tiles.give(tile_scratch);
            out.weights
        });
        let drawn: Vec<Option<WeightRows>> = drawn.collect();
        band.weights.extend(drawn.into_iter().flatten());
    }
}

/// A view without Gaussians.
pub(super) fn background(view: &View, request: &RenderRequest) -> Result<Frame> {
    let pixels = view.width as usize * view.height as usize;
    let mut frame = Frame::blank([view.width, view.height], request, pixels);
    let options = KernelOptions::default();
    let grid = Grid::whole(view, options);
    let paint = Paint::new(request, view, &[], options);
    let rows = band_rows(&mut frame, &grid, request.labels == Labels::Weights);
    let drawn = rows.into_par_iter().enumerate().map(|(row, mut out)| {
        let mut scratch = TileScratch::default();
        for tile in row_tiles(&grid, row as u32 * TILE_SIZE) {
            let tools = (&paint, &mut scratch);
            rasterize::rasterize_tile(&[], &[], tile, tools, grid.width, &mut out);
        }
        out.weights
    });
    let drawn: Vec<Option<WeightRows>> = drawn.collect();
    if request.labels == Labels::Weights {
        frame.weights = Some(WeightRows::join(drawn.into_iter().flatten().collect())?);
    }
    Ok(frame.finish(request.samples))
}

/// The tiles of the row of tiles that starts at pixel row `y`.
fn row_tiles(grid: &Grid, y: u32) -> impl Iterator<Item = Tile> {
    let [across, down] = [grid.width, grid.height];
    (0..across.div_ceil(TILE_SIZE)).map(move |tile_x| {
        let x = tile_x * TILE_SIZE;
        let [width, height] = [across - x, down - y].map(|side| TILE_SIZE.min(side));
        Tile { x, y, width, height }
    })
}

impl Renderer for CpuRenderer {
    fn name(&self) -> String {
        "cpu".to_owned()
    }

    /// A view uses every thread; a second one fills the gaps of the first.
    fn concurrency(&self) -> usize {
        (self.threads.current_num_threads() / 2).clamp(1, 8)
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        self.threads.install(|| self.draw(gaussians, request))
    }
}

/// Data that the bands of a frame share, and their weights from top to bottom.
struct Band<'a> {
    paint: Paint<'a>,
    weights: Vec<WeightRows>,
}

/// Buffers of a frame, named as the stages name them.
#[derive(Debug, Default)]
struct FrameScratch {
    projected: Projected,
    sorted: Vec<u64>,
    spare: Vec<u64>,
    isect_offsets: Vec<u64>,
    isects: Vec<u64>,
    ranges: Vec<u32>,
}

/// Values that are used again.
#[derive(Debug, Default)]
struct Pool<T>(Mutex<Vec<T>>);

impl<T: Default> Pool<T> {
    fn take(&self) -> T {
        self.0.lock().pop().unwrap_or_default()
    }

    fn give(&self, thing: T) {
        self.0.lock().push(thing);
    }
}

/// The pictures of a band, cut into rows of tiles.
fn band_rows<'a>(frame: &'a mut Frame, grid: &Grid, weights: bool) -> Vec<RowOut<'a>> {
    /// Rows of tiles of a picture from the first of the band on.
    fn cut<'a, T>(
        all: &'a mut Option<Vec<T>>,
        (stride, first): (usize, usize),
    ) -> impl FnMut() -> Option<&'a mut [T]> {
        let mut rows = all.as_mut().map(|all| all.chunks_mut(stride).skip(first));
        move || rows.as_mut().and_then(Iterator::next)
    }
    let stride = frame.width as usize * TILE_SIZE as usize;
    let place = (stride, grid.tile_rows.start as usize);
    let mut color = cut(&mut frame.color, place);
    let mut depth = cut(&mut frame.depth, place);
    let mut alpha = cut(&mut frame.alpha, place);
    let mut rgb = cut(&mut frame.levels.rgb, place);
    let mut rgba = cut(&mut frame.levels.rgba, place);
    let mut alpha_levels = cut(&mut frame.levels.alpha, place);
    let mut blend = cut(&mut frame.blend, place);
    let mut mask = cut(&mut frame.mask, place);
    let width = grid.width as usize;
    let row = |tile_row: u32| RowOut {
        color: color(),
        depth: depth(),
        alpha: alpha(),
        rgb: rgb(),
        rgba: rgba(),
        alpha_levels: alpha_levels(),
        blend: blend(),
        mask: mask(),
        weights: weights.then(|| {
            let rows = TILE_SIZE.min(grid.height - tile_row * TILE_SIZE);
            WeightRows::new(rows as usize, width)
        }),
    };
    grid.tile_rows.clone().map(row).collect()
}
