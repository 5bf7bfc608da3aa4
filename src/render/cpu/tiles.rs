//! The one predicate "which tiles does this Gaussian touch", for the count and for the emission.
//! Partner: `shaders/common/tiles.wgsl`

use std::ops::Range;

use super::project::Footprint;
use crate::render::constants::TILE_SIZE;

/// The part of the picture that is drawn: all columns, some rows of tiles.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Grid {
    /// Picture width, pixels.
    pub width: u32,
    /// Picture height, pixels.
    pub height: u32,
    /// Rows of tiles in question.
    pub tile_rows: Range<u32>,
}

impl Grid {
    /// Tiles in a row of tiles.
    #[must_use]
    pub fn tiles_x(&self) -> u32 {
        self.width.div_ceil(TILE_SIZE)
    }

    /// Tiles of the whole band.
    #[must_use]
    pub fn tile_count(&self) -> u32 {
        self.tiles_x() * (self.tile_rows.end - self.tile_rows.start)
    }
}

/// The answer of [`touched_tiles`] for a footprint of at most two rows of tiles, as most are.
///
/// Emission replays it: in depth order these 12 bytes stay in the cache and footprints do not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TileSpans {
    /// First row of tiles touched.
    first_row: u16,
    /// Rows touched; more than two are not kept.
    rows: u16,
    /// First tile and one past the last, for each row.
    spans: [[u16; 2]; 2],
}

impl TileSpans {
    /// Asks [`touched_tiles`] once; the spans and the number of tiles.
    #[inline]
    #[must_use]
    pub fn of(footprint: &Footprint, grid: &Grid) -> (Self, u32) {
        let mut kept = Self::default();
        let mut count = 0;
        touched_tiles(footprint, grid, |tile_y, tiles| {
            count += tiles.end - tiles.start;
            if kept.rows == 0 {
                kept.first_row = tile_y as u16;
            }
            // The ellipse may miss the pixels of a row between two that it meets.
            let row = usize::from(tile_y as u16 - kept.first_row);
            if let Some(span) = kept.spans.get_mut(row) {
                *span = [tiles.start as u16, tiles.end as u16];
            }
            kept.rows = row as u16 + 1;
        });
        (kept, count)
    }

    /// Calls `touch` as [`touched_tiles`] would.
    #[inline]
    pub fn replay(
        &self,
        footprint: &Footprint,
        grid: &Grid,
        mut touch: impl FnMut(u32, Range<u32>),
    ) {
        if usize::from(self.rows) > self.spans.len() {
            return touched_tiles(footprint, grid, touch);
        }
        for (tile_y, span) in (u32::from(self.first_row)..).zip(&self.spans) {
            if span[0] < span[1] && grid.tile_rows.contains(&tile_y) {
                touch(tile_y, u32::from(span[0])..u32::from(span[1]));
            }
        }
    }

    /// Number of tiles touched in `grid`, which may be a band of the grid that was asked.
    #[must_use]
    pub fn count(&self, footprint: &Footprint, grid: &Grid) -> u32 {
        let mut count = 0;
        self.replay(footprint, grid, |_, tiles| count += tiles.end - tiles.start);
        count
    }
}

/// Calls `touch(tile_y, tiles)` for every row of tiles of `grid` with the span of tiles touched.
///
/// A tile is touched where the ellipse "alpha may reach 1/255" meets the rectangle of the tile's
/// pixel centres. The ellipse is convex, so a row of tiles sees one span: between the leftmost and
/// the rightmost point of the ellipse inside the row's band.
#[inline]
pub fn touched_tiles(footprint: &Footprint, grid: &Grid, mut touch: impl FnMut(u32, Range<u32>)) {
    let [mean_x, mean_y] = footprint.mean;
    let reach = f64::from(footprint.reach).sqrt();
    let tall = reach / f64::from(footprint.inv_sy);
    let first_row = i64::from(grid.tile_rows.start * TILE_SIZE);
    let last_row = i64::from((grid.tile_rows.end * TILE_SIZE).min(grid.height)) - 1;
    let top = ceil(mean_y - tall - 0.5).max(first_row);
    let bottom = floor(mean_y + tall - 0.5).min(last_row);
    if top > bottom {
        return;
    }
    let across = reach / f64::from(footprint.inv_sx);
    let lean = footprint.slope * tall;
    // Height, over `tall`, of the rightmost point of the ellipse; the leftmost is at -peak.
    let peak = lean / (across * across + lean * lean).sqrt();
    let half_width = |share: f64| (1.0 - share * share).max(0.0).sqrt() * across;
    let per_tall = f64::from(footprint.inv_sy) / reach;
    let last_column = i64::from(grid.width) - 1;
    let tile = i64::from(TILE_SIZE);
    for tile_y in top / tile..=bottom / tile {
        // The band of pixel centres, over `tall`.
        let low = ((tile_y * tile).max(top) as f64 + 0.5 - mean_y) * per_tall;
        let high = ((tile_y * tile + tile - 1).min(bottom) as f64 + 0.5 - mean_y) * per_tall;
        let at_right = peak.max(low).min(high);
        let at_left = (-peak).max(low).min(high);
        let right = mean_x + lean * at_right + half_width(at_right);
        let left = mean_x + lean * at_left - half_width(at_left);
        let first = ceil(left - 0.5).max(0);
        let last = floor(right - 0.5).min(last_column);
        if first <= last {
            touch(tile_y as u32, (first / tile) as u32..(last / tile) as u32 + 1);
        }
    }
}

/// Number of tiles touched in `grid`.
#[inline]
#[must_use]
pub fn count_tiles(footprint: &Footprint, grid: &Grid) -> u32 {
    TileSpans::of(footprint, grid).1
}

/// `v.floor()`, saturating: processors without SSE 4.1 would call a function for it.
#[inline]
fn floor(v: f64) -> i64 {
    let whole = v as i64;
    whole.saturating_sub(i64::from(whole as f64 > v))
}

/// `v.ceil()`, saturating.
#[inline]
fn ceil(v: f64) -> i64 {
    let whole = v as i64;
    whole.saturating_add(i64::from((whole as f64) < v))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floor_and_ceil_equal_the_standard_ones_and_saturate() {
        for v in [-2.5, -2.0, -0.1, 0.0, 0.1, 2.0, 2.5, 1e15, -1e15] {
            assert_eq!((floor(v), ceil(v)), (v.floor() as i64, v.ceil() as i64), "{v}");
        }
        for v in [f64::INFINITY, 1e300] {
            assert_eq!((floor(v), ceil(-v)), (i64::MAX, i64::MIN), "{v} saturates");
        }
    }

    /// Every pixel centre inside the ellipse lies in a touched tile, and every tile touched comes
    /// near the ellipse.
    #[test]
    fn touched_tiles_hold_every_pixel_of_the_ellipse() {
        let grid = Grid { width: 203, height: 150, tile_rows: 0..10 };
        let mut touched_total = 0;
        for i in 0..2_000_u32 {
            let turn = |k: u32| f64::from((i.wrapping_mul(2_654_435_761) >> k) & 0xff) / 255.0;
            let footprint = Footprint {
                mean: [turn(3) * 300.0 - 50.0, turn(9) * 250.0 - 50.0],
                slope: turn(12) * 8.0 - 4.0,
                inv_sx: (0.01 + turn(17)) as f32,
                inv_sy: (0.02 + turn(21) * turn(2)) as f32,
                reach: (turn(6) * 5.5) as f32,
                ..Footprint::default()
            };
            let mut touched = vec![false; grid.tile_count() as usize];
            touched_tiles(&footprint, &grid, |tile_y, tiles| {
                for tile_x in tiles {
                    touched[(tile_y * grid.tiles_x() + tile_x) as usize] = true;
                    touched_total += 1;
                }
            });
            let (spans, count) = TileSpans::of(&footprint, &grid);
            let mut replayed = vec![false; touched.len()];
            spans.replay(&footprint, &grid, |tile_y, tiles| {
                for tile_x in tiles {
                    replayed[(tile_y * grid.tiles_x() + tile_x) as usize] = true;
                }
            });
            assert_eq!(replayed, touched, "count and emission of {footprint:?}");
            let told = touched.iter().filter(|&&t| t).count();
            assert_eq!(count as usize, told, "count of {footprint:?}");
            let band = Grid { tile_rows: 3..5, ..grid.clone() };
            let in_band = touched[3 * 13..5 * 13].iter().filter(|&&t| t).count();
            assert_eq!(spans.count(&footprint, &band) as usize, in_band, "band of {footprint:?}");
            let power = |x: f64, y: f64| {
                let (dx, dy) = (x - footprint.mean[0], y - footprint.mean[1]);
                (f64::from(footprint.inv_sx) * (dx - footprint.slope * dy)).powi(2)
                    + (f64::from(footprint.inv_sy) * dy).powi(2)
            };
            for y in 0..grid.height {
                for x in 0..grid.width {
                    let inside =
                        power(f64::from(x) + 0.5, f64::from(y) + 0.5) < footprint.reach.into();
                    let tile = y / TILE_SIZE * grid.tiles_x() + x / TILE_SIZE;
                    assert!(
                        !inside || touched[tile as usize],
                        "pixel {x},{y} of {footprint:?} is left out"
                    );
                }
            }
            // No tile more than half a pixel away from the ellipse: a fine search over the tile.
            for (tile, _) in touched.iter().enumerate().filter(|(_, t)| **t) {
                let (tx, ty) = (tile as u32 % grid.tiles_x(), tile as u32 / grid.tiles_x());
                let near = (0..=32).any(|j| {
                    (0..=32).any(|k| {
                        let x = f64::from(tx * TILE_SIZE) + f64::from(k) * 0.5;
                        let y = f64::from(ty * TILE_SIZE) + f64::from(j) * 0.5;
                        power(x, y) < f64::from(footprint.reach) * 1.05 + 1.5
                    })
                });
                assert!(near, "tile {tx},{ty} is far from {footprint:?}");
            }
        }
        assert!(touched_total > 1_000, "the test saw {touched_total} tiles only");
    }
}
