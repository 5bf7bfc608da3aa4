//! Stage 5: one (tile, Gaussian) pair for each tile that a Gaussian touches, in depth order.
//! Shader: `shaders/emit_isects.wgsl`

use rayon::prelude::*;

use super::{
    project::Projected,
    radix_sort::{pack, value},
    tiles::{Grid, TileSpans},
};

/// Gaussians of a task.
const CHUNK: usize = 1024;
/// Gaussians whose spans are fetched together.
const FETCH: usize = 64;

/// Writes the pairs of the Gaussian at place i of the depth order to
/// `isects[isect_offsets[i]..isect_offsets[i + 1]]`. Keys are tile ids counted from the first tile
/// of the band; values are indices of Gaussians. The caller has checked that the total fits
/// [`crate::constants::ISECTS_MAX`].
pub fn emit_isects(
    projected: &Projected,
    sorted: &[u64],
    grid: &Grid,
    isect_offsets: &[u64],
    isects: &mut Vec<u64>,
) {
    let total = isect_offsets.last().copied().unwrap_or(0) as usize;
    isects.resize(total, 0);
    // Disjoint slices, one for each task, cut at the offsets.
    let mut tasks = Vec::with_capacity(sorted.len().div_ceil(CHUNK));
    let mut rest = isects.as_mut_slice();
    for (chunk, sorted) in sorted.chunks(CHUNK).enumerate() {
        let first = chunk * CHUNK;
        let size = isect_offsets[first + sorted.len()] - isect_offsets[first];
        let (slice, tail) = rest.split_at_mut(size as usize);
        tasks.push((sorted, slice));
        rest = tail;
    }
    tasks.into_par_iter().for_each(|(sorted, slice)| {
        let mut slots = slice.iter_mut();
        let mut fetched = [TileSpans::default(); FETCH];
        for sorted in sorted.chunks(FETCH) {
            // In depth order spans lie anywhere. A loop of its own fetches many at the same time.
            for (spans, &pair) in fetched.iter_mut().zip(sorted) {
                *spans = projected.tile_spans[value(pair) as usize];
            }
            for (spans, &pair) in fetched.iter().zip(sorted) {
                let id = value(pair);
                let footprint = &projected.footprints[id as usize];
                spans.replay(footprint, grid, |tile_y, tiles| {
                    let row = (tile_y - grid.tile_rows.start) * grid.tiles_x();
                    for (tile_x, slot) in tiles.zip(&mut slots) {
                        *slot = pack(row + tile_x, id);
                    }
                });
            }
        }
        debug_assert!(slots.next().is_none(), "count and emission disagree; this is a bug");
    });
}
