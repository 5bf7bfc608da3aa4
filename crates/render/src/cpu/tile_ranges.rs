//! Stage 7: where the pairs of each tile start and end. Shader: `shaders/tile_ranges.wgsl`

use super::radix_sort::key;

/// `ranges[tile]..ranges[tile + 1]` are the pairs of a tile, in `isects` sorted by tile.
pub fn tile_ranges(isects: &[u64], tile_count: u32, ranges: &mut Vec<u32>) {
    ranges.clear();
    ranges.resize(tile_count as usize + 1, 0);
    for &isect in isects {
        ranges[key(isect) as usize + 1] += 1;
    }
    let mut end = 0;
    for range in ranges {
        end += *range;
        *range = end;
    }
}
