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

/// Calls `touch(tile_y, tiles)` for every row of tiles with the span of tiles touched in it.
///
/// A tile is touched where the ellipse "alpha may reach 1/255" meets the rectangle of the tile's
/// pixel centres. The ellipse is convex, so a row of tiles sees one span: between the leftmost and
/// the rightmost point of the ellipse inside the row's band.
#[inline]
pub fn touched_tiles(footprint: &Footprint, grid: &Grid, mut touch: impl FnMut(u32, Range<u32>)) {
    let [mean_x, mean_y] = footprint.mean;
    let (root, wide, tall) = footprint.extent();
    let first_row = i64::from(grid.tile_rows.start * TILE_SIZE);
    let last_row = i64::from((grid.tile_rows.end * TILE_SIZE).min(grid.height)) - 1;
    let top = ((mean_y - tall - 0.5).ceil() as i64).max(first_row);
    let bottom = ((mean_y + tall - 0.5).floor() as i64).min(last_row);
    if top > bottom {
        return;
    }
    let tile = i64::from(TILE_SIZE);
    // Height, relative to the mean, of the ellipse's rightmost point; the leftmost is at -peak.
    let peak = footprint.slope * tall * tall / wide;
    let half_width = |dy: f64| {
        let across = dy / tall;
        (1.0 - across * across).max(0.0).sqrt() * root / f64::from(footprint.inv_sx)
    };
    for tile_y in top / tile..=bottom / tile {
        let low = ((tile_y * tile).max(top) as f64 + 0.5 - mean_y).max(-tall);
        let high = ((tile_y * tile + tile - 1).min(bottom) as f64 + 0.5 - mean_y).min(tall);
        if low > high {
            continue;
        }
        let (at_right, at_left) = (peak.clamp(low, high), (-peak).clamp(low, high));
        let right = mean_x + footprint.slope * at_right + half_width(at_right);
        let left = mean_x + footprint.slope * at_left - half_width(at_left);
        let first = ((left - 0.5).ceil() as i64).max(0);
        let last = ((right - 0.5).floor() as i64).min(i64::from(grid.width) - 1);
        if first <= last {
            touch(tile_y as u32, (first / tile) as u32..(last / tile) as u32 + 1);
        }
    }
}

/// Number of tiles touched in `grid`.
#[must_use]
pub fn count_tiles(footprint: &Footprint, grid: &Grid) -> u32 {
    let mut count = 0;
    touched_tiles(footprint, grid, |_, tiles| count += tiles.end - tiles.start);
    count
}
