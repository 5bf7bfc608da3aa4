//! Stage 3: the Gaussians of each tile. The shaders sort all Gaussians by depth, write their pairs
//! of tile and Gaussian in that order and sort those by tile. Here each chunk of Gaussians sorts
//! its own pairs by tile, and the blend of a tile takes those of all chunks and sorts them by depth:
//! no step waits for another chunk, and what is sorted stays in the cache.

use std::{
    ops::Range,
    sync::atomic::{AtomicU64, Ordering},
};

use rayon::prelude::*;

use super::{project::Projected, tiles::Grid};
use crate::{Source, constants::BEHIND_BIT, scene::Gaussians};

/// Fewest Gaussians of a chunk: enough to hide the cost of a task.
const CHUNK_MIN: usize = 2048;
/// Most chunks: enough to balance many cores, few for a tile to collect from.
const CHUNKS_MAX: usize = 512;
/// Most ends of tiles in all chunks together: 16 MiB.
const ENDS_MAX: usize = 1 << 22;
/// Most tiles times chunks may leave too few chunks; this many there are always.
const CHUNKS_MIN: usize = 8;

/// Packs a depth key and a Gaussian: pairs sort by depth, then by number.
#[inline]
pub fn pack(key: u32, id: u32) -> u64 {
    u64::from(key) << 32 | u64::from(id)
}

/// The Gaussian of a pair.
#[inline]
pub fn value(pair: u64) -> u32 {
    pair as u32
}

/// The pairs of a chunk, tile by tile.
#[derive(Debug, Default)]
pub struct Bins {
    /// Where the pairs of each tile end, `[tiles]`.
    ends: Vec<u32>,
    pairs: Vec<u64>,
}

impl Bins {
    /// The pairs of a tile, counted from the first of the band, in the order of the scene.
    #[inline]
    pub fn of(&self, tile: usize) -> &[u64] {
        let start = tile.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.pairs[start as usize..self.ends[tile] as usize]
    }
}

/// Depth keys of Gaussians: the bits of t.z, which is over 0, so that they sort like its value. Those
/// of photos behind come after all others.
#[derive(Clone, Copy, Debug)]
pub struct Keys<'a> {
    gaussians: &'a Gaussians,
    /// Empty where no photo is behind.
    sources: &'a [Source],
}

impl<'a> Keys<'a> {
    /// Keys of Gaussians that come from these photos.
    pub fn new(gaussians: &'a Gaussians, sources: &'a [Source]) -> Self {
        let layered = sources.iter().any(|source| source.behind);
        Self { gaussians, sources: if layered { sources } else { &[] } }
    }

    #[inline]
    fn pair(&self, depth: f32, id: usize) -> u64 {
        let mut key = depth.to_bits();
        if !self.sources.is_empty() {
            let view = usize::from(self.gaussians.source()[id].view);
            if self.sources.get(view).is_some_and(|source| source.behind) {
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
    keys: Keys<'_>,
    grid: &Grid,
    isects_max: u64,
    bins: &mut Vec<Bins>,
) -> u64 {
    let tiles = grid.tile_count() as usize;
    let chunks_max = (ENDS_MAX / tiles.max(1)).clamp(CHUNKS_MIN, CHUNKS_MAX);
    let count = projected.tiles_per_gauss.len();
    let chunk = count.div_ceil(chunks_max).max(CHUNK_MIN);
    bins.resize_with(count.div_ceil(chunk), Bins::default);
    let total = AtomicU64::new(0);
    bins.par_iter_mut().enumerate().with_max_len(1).for_each(|(at, bins)| {
        let first = at * chunk;
        let ids = first..count.min(first + chunk);
        bins.ends.clear();
        bins.ends.resize(tiles, 0);
        walk(projected, ids.clone(), grid, |_, tile| bins.ends[tile as usize] += 1);
        let mut end = 0;
        for count in &mut bins.ends {
            // For now where the pairs of the tile start.
            end += std::mem::replace(count, end);
        }
        let before = total.fetch_add(end.into(), Ordering::Relaxed);
        bins.pairs.clear();
        if before + u64::from(end) > isects_max {
            return;
        }
        bins.pairs.resize(end as usize, 0);
        walk(projected, ids, grid, |id, tile| {
            let place = &mut bins.ends[tile as usize];
            bins.pairs[*place as usize] = keys.pair(projected.footprints[id].depth, id);
            *place += 1;
        });
    });
    total.into_inner()
}

/// Calls `touch` with each of the Gaussians `ids` and each tile of `grid` that it touches, counted
/// from the first of the grid.
#[inline(always)]
fn walk(projected: &Projected, ids: Range<usize>, grid: &Grid, mut touch: impl FnMut(usize, u32)) {
    let spans = &projected.tile_spans[ids.clone()];
    let tiles = &projected.tiles_per_gauss[ids.clone()];
    for ((id, spans), _) in ids.zip(spans).zip(tiles).filter(|(_, tiles)| **tiles > 0) {
        spans.replay(&projected.footprints[id], grid, |tile_y, tiles| {
            let row = (tile_y - grid.tile_rows.start) * grid.tiles_x();
            tiles.for_each(|tile_x| touch(id, row + tile_x));
        });
    }
}
