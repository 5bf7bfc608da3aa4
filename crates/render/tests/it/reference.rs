//! The stages of the shaders that the CPU renderer does otherwise (`cpu::bin`), plain and on one
//! thread.

pub(crate) mod radix_sort {
    pub(crate) fn pack(key: u32, value: u32) -> u64 {
        u64::from(key) << 32 | u64::from(value)
    }

    pub(crate) fn value(pair: u64) -> u32 {
        pair as u32
    }

    pub(crate) fn key(pair: u64) -> u32 {
        (pair >> 32) as u32
    }

    /// Sorts pairs by the lowest `key_bits` bits of their keys, stable.
    pub(crate) fn radix_sort(pairs: &mut [u64], _spare: &mut Vec<u64>, key_bits: u32) {
        pairs.sort_by_key(|&pair| key(pair) & u32::MAX >> (32 - key_bits));
    }
}

pub(crate) mod prefix_sum {
    /// Writes the exclusive sums of `counts` into `offsets` (one longer). Returns the total.
    pub(crate) fn prefix_sum(counts: impl Iterator<Item = u32>, offsets: &mut Vec<u64>) -> u64 {
        offsets.clear();
        let mut total = 0;
        offsets.push(total);
        for count in counts {
            total += u64::from(count);
            offsets.push(total);
        }
        total
    }
}

pub(crate) mod emit_isects {
    use segsplat_render::cpu::{project::Projected, tiles::Grid};

    use super::radix_sort::{pack, value};

    /// Writes the pairs of the Gaussian at place i of the depth order to
    /// `isects[isect_offsets[i]..isect_offsets[i + 1]]`. Keys are tile ids counted from the first
    /// tile of the band; values are indices of Gaussians.
    pub(crate) fn emit_isects(
        projected: &Projected,
        sorted: &[u64],
        grid: &Grid,
        isect_offsets: &[u64],
        isects: &mut Vec<u64>,
    ) {
        isects.clear();
        for &pair in sorted {
            let id = value(pair);
            let footprint = &projected.footprints[id as usize];
            projected.tile_spans[id as usize].replay(footprint, grid, |tile_y, tiles| {
                let row = (tile_y - grid.tile_rows.start) * grid.tiles_x();
                isects.extend(tiles.map(|tile_x| pack(row + tile_x, id)));
            });
        }
        let total = isects.len() as u64;
        assert_eq!(isect_offsets.last(), Some(&total), "count and emission disagree");
    }
}

pub(crate) mod tile_ranges {
    use super::radix_sort::key;

    /// `ranges[tile]..ranges[tile + 1]` are the pairs of a tile, in `isects` sorted by tile.
    pub(crate) fn tile_ranges(isects: &[u64], tile_count: u32, ranges: &mut Vec<u32>) {
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
}
