//! Stages 3 and 4: the Gaussians of each tile. Shaders: `shaders/prefix_sum.wgsl`,
//! `shaders/emit_isects.wgsl`
//!
//! Each chunk of Gaussians orders its own pairs by tile. The blend of a tile takes those of all
//! chunks and sorts them by depth: no step waits for another chunk, and what is sorted stays in the
//! cache.

use std::{
    ops::Range,
    sync::atomic::{AtomicU64, Ordering},
};

use rayon::prelude::*;

use super::{
    cull::Shown,
    project::Projected,
    tiles::{Grid, TileSpans},
};
use crate::{
    Layer, Source,
    constants::{BEHIND_BIT, TILE_SIZE},
    scene::Gaussians,
};

/// Fewest Gaussians of a chunk: enough to hide the cost of a task.
const CHUNK_MIN: usize = 2048;
/// Most chunks: enough to balance many cores, few for a tile to collect from.
const CHUNKS_MAX: usize = 512;
/// Most ends of tiles in all chunks together: 16 MiB.
const ENDS_MAX: usize = 1 << 22;
/// Most tiles times chunks may leave too few chunks; this many there are always.
const CHUNKS_MIN: usize = 8;

/// Packs a key and a Gaussian: pairs sort by key, then by number.
#[inline]
pub fn pack(key: u32, id: u32) -> u64 {
    u64::from(key) << 32 | u64::from(id)
}

/// The Gaussian of a pair.
#[inline]
pub fn value(pair: u64) -> u32 {
    pair as u32
}

/// The key of a pair.
#[inline]
fn key(pair: u64) -> u32 {
    (pair >> 32) as u32
}

/// The pairs of a chunk, tile by tile.
#[derive(Debug, Default)]
pub struct Bins {
    /// Where the pairs of each tile end, `[tiles]`.
    ends: Vec<u32>,
    pairs: Vec<u64>,
    /// Tiles, each with a Gaussian, in the order of the scene: from them the others are made.
    emitted: Vec<u64>,
}

impl Bins {
    /// The pairs of a tile, counted from the first of the band, in the order of the scene.
    #[inline]
    pub fn of(&self, tile: usize) -> &[u64] {
        let start = tile.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.pairs[start as usize..self.ends[tile] as usize]
    }
}

/// Depth keys of Gaussians: the bits of t.z, which is over 0, so that they sort like its value.
/// Those of photos behind come after all others.
#[derive(Clone, Copy, Debug)]
pub struct DepthKeys<'a> {
    gaussians: &'a Gaussians,
    /// Empty where no photo is behind.
    sources: &'a [Source],
}

impl<'a> DepthKeys<'a> {
    /// Keys of Gaussians that come from these photos.
    pub fn new(gaussians: &'a Gaussians, sources: &'a [Source]) -> Self {
        let layered = sources.iter().any(|source| source.layer == Layer::Behind);
        Self { gaussians, sources: if layered { sources } else { &[] } }
    }

    #[inline]
    fn pair(&self, depth: f32, id: usize, shown: &Shown) -> u64 {
        let mut key = depth.to_bits();
        if !self.sources.is_empty() {
            let (gaussians, own) = shown.find(self.gaussians, id);
            let view = usize::from(gaussians.source()[own].view);
            if self.sources.get(view).is_some_and(|source| source.layer == Layer::Behind) {
                key |= BEHIND_BIT;
            }
        }
        pack(key, id as u32)
    }
}

/// Writes the pairs of each chunk of Gaussians into `bins` and returns the number of all. Where
/// that is over `isects_max`, the bins are not complete.
pub fn bin(
    projected: &Projected,
    keys: DepthKeys<'_>,
    grid: &Grid,
    isects_max: u64,
    bins: &mut Vec<Bins>,
) -> u64 {
    let tiles = grid.tile_count() as usize;
    let count = projected.tiles_per_gauss.len();
    let chunk = chunk_of(count, grid);
    bins.resize_with(count.div_ceil(chunk), Bins::default);
    let total = AtomicU64::new(0);
    bins.par_iter_mut().enumerate().with_max_len(1).for_each(|(at, bins)| {
        let first = at * chunk;
        let ids = first..count.min(first + chunk);
        let mine = pairs_of(projected, ids.clone(), grid);
        let before = total.fetch_add(mine, Ordering::Relaxed);
        bins.ends.clear();
        bins.ends.resize(tiles, 0);
        bins.pairs.clear();
        if before + mine <= isects_max {
            emit(projected, ids, grid, &mut bins.emitted, mine as usize);
            bins.sort(projected, keys);
        }
    });
    total.into_inner()
}

/// Gaussians of a chunk, of `count` in all.
pub(super) fn chunk_of(count: usize, grid: &Grid) -> usize {
    let tiles = grid.tile_count() as usize;
    let chunks_max = (ENDS_MAX / tiles.max(1)).clamp(CHUNKS_MIN, CHUNKS_MAX);
    count.div_ceil(chunks_max).max(CHUNK_MIN)
}

impl Bins {
    /// Orders what was emitted by tile, stable, and puts depth keys in the place of tiles.
    fn sort(&mut self, projected: &Projected, keys: DepthKeys<'_>) {
        let Self { ends, pairs, emitted } = self;
        for &tile in &*emitted {
            ends[key(tile) as usize] += 1;
        }
        let mut end = 0;
        for count in ends.iter_mut() {
            // For now where the pairs of the tile start.
            end += std::mem::replace(count, end);
        }
        pairs.resize(emitted.len(), 0);
        for &tile in &*emitted {
            let (place, id) = (&mut ends[key(tile) as usize], value(tile) as usize);
            pairs[*place as usize] =
                keys.pair(projected.tile_spans[id].depth, id, &projected.shown);
            *place += 1;
        }
    }
}

/// Number of pairs of the Gaussians `ids` in `grid`.
fn pairs_of(projected: &Projected, ids: Range<usize>, grid: &Grid) -> u64 {
    let tiles = &projected.tiles_per_gauss[ids.clone()];
    if grid.tile_rows == (0..grid.height.div_ceil(TILE_SIZE)) {
        return tiles.iter().map(|&tiles| u64::from(tiles)).sum();
    }
    let seen = ids.zip(tiles).filter(|(_, tiles)| **tiles > 0);
    let count = |id: usize| projected.tile_spans[id].count(&projected.footprints[id], grid);
    seen.map(|(id, _)| u64::from(count(id))).sum()
}

/// Writes the tiles of the Gaussians `ids`, counted from the first of the grid, each with its
/// Gaussian: `count` of them.
fn emit(projected: &Projected, ids: Range<usize>, grid: &Grid, to: &mut Vec<u64>, count: usize) {
    let spans = &projected.tile_spans[ids.clone()];
    let tiles = &projected.tiles_per_gauss[ids.clone()];
    // Room for what is written and not kept.
    to.resize(count + TileSpans::FEW, 0);
    let mut end = 0;
    for ((id, spans), _) in ids.zip(spans).zip(tiles).filter(|(_, tiles)| **tiles > 0) {
        if let Some(few) = spans.few(grid) {
            // Most Gaussians touch one to four tiles. All four are written and some kept: a branch
            // for each would be guessed wrong every other time.
            for (tile, kept) in few {
                to[end] = pack(tile, id as u32);
                end += usize::from(kept);
            }
            continue;
        }
        spans.replay(&projected.footprints[id], grid, |tile_y, tiles| {
            let row = (tile_y - grid.tile_rows.start) * grid.tiles_x();
            for tile_x in tiles {
                to[end] = pack(row + tile_x, id as u32);
                end += 1;
            }
        });
    }
    debug_assert_eq!(end, count, "count and emission disagree; this is a bug");
    to.truncate(end);
}
