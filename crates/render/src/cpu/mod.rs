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
pub mod tile_ranges;
pub mod tiles;

use std::ops::Range;

use parking_lot::Mutex;
use rayon::prelude::*;

use self::{
    lanes::Width,
    paint::Paint,
    project::{Projected, Projection},
    radix_sort::{key, pack, value},
    rasterize::{RowOut, Tile, TileScratch},
    tiles::Grid,
};
use super::{
    Frame, FrameStats, Labels, RenderRequest, Renderer,
    constants::{ISECTS_MAX, TILE_SIZE},
    labels::WeightRows,
    skip::Skip,
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
    width: Width,
    /// Work that is done although it could be skipped.
    without: Option<Skip>,
}

impl CpuRenderer {
    /// A renderer with `threads` threads; 0 takes the cores that the process may use.
    ///
    /// # Errors
    /// `internal` when the threads cannot be started.
    pub fn new(threads: usize) -> Result<Self> {
        let threads = match threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            n => n,
        };
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("render-{i}"))
            .build()
            .map_err(|error| {
                Error::internal(format!("render: {threads} threads cannot be started"))
                    .caused_by(error)
            })?;
        Ok(Self {
            threads: pool,
            frames: Pool::default(),
            tiles: Pool::default(),
            isects_max: ISECTS_MAX,
            width: Width::widest(),
            without: None,
        })
    }

    /// The same renderer with kernels of another width, if the processor has it.
    #[must_use]
    pub fn with_width(mut self, width: Width) -> Self {
        self.width = width;
        self
    }

    /// The same renderer without one of the skips, for tests and benchmarks.
    #[must_use]
    pub fn without(mut self, without: Option<Skip>) -> Self {
        self.without = without;
        self
    }

    /// The same renderer with another budget of Gaussian-tile pairs, for tests of the bands.
    #[must_use]
    pub fn with_isects_max(mut self, isects_max: u64) -> Self {
        self.isects_max = isects_max;
        self
    }

    fn draw(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        let view = View::new(gaussians.origin(), request)?;
        let mut frame = blank(&view, request);
        let mut scratch = self.frames.take();
        let FrameScratch { projected, sorted, spare, .. } = &mut scratch;
        let (width, without) = (self.width, self.without);
        let how = Projection { antialiased: request.antialiased, width, without };
        project::project(gaussians, &view, how, projected);
        let all = without == Some(Skip::Unseen);
        let kept = |&(_, &tiles): &(u32, &u32)| tiles > 0 || all;
        let kept = (0_u32..).zip(&projected.tiles_per_gauss).filter(kept);
        sorted.clear();
        // t.z is over 0, so its bits sort like its value.
        sorted.extend(kept.map(|(i, _)| pack(projected.footprints[i as usize].depth.to_bits(), i)));
        radix_sort::radix_sort(sorted, spare, u32::BITS);
        if request.kinds.color {
            shade::shade(gaussians, &view, without, projected);
        }
        let visible = projected.tiles_per_gauss.iter().filter(|&&tiles| tiles > 0);
        frame.stats.visible = visible.count() as u64;
        let grid = Grid::whole(&view, without);
        let paint = Paint::new(request, gaussians.semantic_index());
        let paint = paint.with_width(width).without(without);
        let mut band = Band { paint, weights: Vec::new() };
        self.draw_band(&grid, &mut band, &mut scratch, &mut frame)?;
        if request.labels == Labels::Weights {
            frame.weights = Some(WeightRows::join(band.weights)?);
        }
        if gaussians.len() <= KEPT_GAUSSIANS_MAX {
            self.frames.give(scratch);
        }
        Ok(frame)
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
                return Err(Error::limit(
                    "render: Gaussian-tile pairs in one row of tiles",
                    total,
                    self.isects_max,
                ));
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
        let tiles_x = grid.tiles_x();
        let paint = band.paint;
        let rows = band_rows(frame, grid, *paint.labels() == Labels::Weights);
        let drawn = rows.into_par_iter().with_max_len(1).enumerate().map(|(row, mut out)| {
            let mut tile_scratch = self.tiles.take();
            let y = (grid.tile_rows.start + row as u32) * TILE_SIZE;
            for tile_x in 0..tiles_x {
                let x = tile_x * TILE_SIZE;
                let tile = Tile {
                    x,
                    y,
                    width: TILE_SIZE.min(grid.width - x),
                    height: TILE_SIZE.min(grid.height - y),
                };
                let id = row * tiles_x as usize + tile_x as usize;
                let range = scratch.ranges[id] as usize..scratch.ranges[id + 1] as usize;
                let isects = &scratch.isects[range];
                debug_assert!(isects.iter().all(|&isect| key(isect) as usize == id));
                rasterize::rasterize_tile(
                    &scratch.projected.footprints,
                    isects,
                    tile,
                    &paint,
                    grid.width,
                    &mut tile_scratch,
                    &mut out,
                );
            }
            self.tiles.give(tile_scratch);
            out.weights
        });
        let drawn: Vec<Option<WeightRows>> = drawn.collect();
        band.weights.extend(drawn.into_iter().flatten());
    }
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

/// A frame of the right size; every pixel is written by a tile.
fn blank(view: &View, request: &RenderRequest) -> Frame {
    let pixels = view.width as usize * view.height as usize;
    Frame {
        width: view.width,
        height: view.height,
        color: request.kinds.color.then(|| vec![[0.0; 3]; pixels]),
        depth: request.kinds.depth.then(|| vec![0.0; pixels]),
        alpha: request.kinds.alpha.then(|| vec![0.0; pixels]),
        blend: matches!(request.labels, Labels::Blend(_)).then(|| vec![[0.0; 4]; pixels]),
        weights: None,
        stats: FrameStats::default(),
    }
}

/// The pictures of a band, cut into rows of tiles.
fn band_rows<'a>(frame: &'a mut Frame, grid: &Grid, weights: bool) -> Vec<RowOut<'a>> {
    let stride = frame.width as usize * TILE_SIZE as usize;
    let first = grid.tile_rows.start as usize;
    let mut color = frame.color.as_mut().map(|all| all.chunks_mut(stride).skip(first));
    let mut depth = frame.depth.as_mut().map(|all| all.chunks_mut(stride).skip(first));
    let mut alpha = frame.alpha.as_mut().map(|all| all.chunks_mut(stride).skip(first));
    let mut blend = frame.blend.as_mut().map(|all| all.chunks_mut(stride).skip(first));
    let width = grid.width as usize;
    grid.tile_rows
        .clone()
        .map(|tile_row| RowOut {
            color: color.as_mut().and_then(Iterator::next),
            depth: depth.as_mut().and_then(Iterator::next),
            alpha: alpha.as_mut().and_then(Iterator::next),
            blend: blend.as_mut().and_then(Iterator::next),
            weights: weights.then(|| {
                let rows = TILE_SIZE.min(grid.height - tile_row * TILE_SIZE);
                WeightRows::new(rows as usize, width)
            }),
        })
        .collect()
}
