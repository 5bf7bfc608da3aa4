//! Which tiles a Gaussian touches: one function for the count and for the emission.
//! Shader: `shaders/common/tiles.wgsl`

use std::ops::Range;

use super::{
    footprint::Footprint,
    lanes::{KernelOptions, Lanes, Row, Wide},
};
use crate::{constants::TILE_SIZE, switches::Skip, view::View};

/// Places are clamped to this, pixels. Pictures are smaller, and f64 holds integers of this size
/// exactly.
const FAR: f64 = 1_099_511_627_776.0;

/// The part of the picture that is drawn: all columns, some rows of tiles.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Grid {
    /// Picture width, pixels.
    pub width: u32,
    /// Picture height, pixels.
    pub height: u32,
    /// Rows of tiles to draw.
    pub tile_rows: Range<u32>,
    /// Whether a footprint touches the tiles of its ellipse, or those of the box around it:
    /// [`Skip::EllipseTiles`].
    pub by_ellipse: bool,
}

impl Grid {
    /// All tiles of a picture.
    pub fn whole(view: &View, options: KernelOptions) -> Self {
        Self {
            width: view.width,
            height: view.height,
            tile_rows: 0..view.tiles_y(),
            by_ellipse: options.skips(Skip::EllipseTiles),
        }
    }

    /// Tiles in a row of tiles.
    pub fn tiles_x(&self) -> u32 {
        self.width.div_ceil(TILE_SIZE)
    }

    /// Tiles of the whole band.
    pub fn tile_count(&self) -> u32 {
        self.tiles_x() * (self.tile_rows.end - self.tile_rows.start)
    }
}

/// The result of [`touched_tiles`] for a footprint of at most two rows of tiles, which most are,
/// and its depth: all that a pair of a tile and a Gaussian needs, in 16 bytes instead of 64.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TileSpans {
    /// Depth of the footprint.
    pub(super) depth: f32,
    /// First row of tiles touched.
    first_row: u16,
    /// Rows touched; more than two are not kept.
    rows: u16,
    /// First tile and one past the last, for each row.
    spans: [[u16; 2]; 2],
}

impl TileSpans {
    /// Calls [`touched_tiles`] once. Returns the spans and the number of tiles.
    #[inline]
    pub fn of(footprint: &Footprint, grid: &Grid) -> (Self, u32) {
        let mut kept = Self { depth: footprint.depth, ..Self::default() };
        let mut count = 0;
        touched_tiles(footprint, grid, |tile_y, tiles| {
            count += tiles.end - tiles.start;
            if kept.rows == 0 {
                kept.first_row = tile_y as u16;
            }
            // The ellipse may miss the pixels of a row between two that it touches.
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

    /// Most tiles of [`Self::few`].
    pub(super) const FEW: usize = 4;

    /// Where a footprint touches at most two tiles in each of at most two rows: four tiles counted
    /// from the first of `grid`, and which of them are touched.
    #[inline(always)]
    pub(super) fn few(&self, grid: &Grid) -> Option<[(u32, bool); Self::FEW]> {
        let [[a, a_end], [b, b_end]] = self.spans.map(|span| span.map(u32::from));
        if self.rows > 2 || a_end > a + 2 || b_end > b + 2 {
            return None;
        }
        let Range { start, end } = grid.tile_rows;
        let first = u32::from(self.first_row);
        let inside = |row: u32| (start..end).contains(&row);
        let (top, low) = (inside(first), inside(first + 1));
        let row = |row: u32| row.wrapping_sub(start).wrapping_mul(grid.tiles_x());
        let (top_row, low_row) = (row(first), row(first + 1));
        Some([
            (top_row.wrapping_add(a), top & (a < a_end)),
            (top_row.wrapping_add(a + 1), top & (a + 1 < a_end)),
            (low_row.wrapping_add(b), low & (b < b_end)),
            (low_row.wrapping_add(b + 1), low & (b + 1 < b_end)),
        ])
    }

    /// Number of tiles touched in `grid`, which may be a band of the first grid.
    pub fn count(&self, footprint: &Footprint, grid: &Grid) -> u32 {
        let mut count = 0;
        self.replay(footprint, grid, |_, tiles| count += tiles.end - tiles.start);
        count
    }
}

/// Ellipses of a block.
pub(super) const BLOCK: usize = 16;

/// [`touched_tiles`] for a block of ellipses, as far as [`TileSpans`] stores the result.
#[derive(Default)]
pub(super) struct Ellipses {
    mean: [Row; 2],
    conic_shear: Row,
    conic_x: Row,
    conic_y: Row,
    power_max: Row,
    /// First row of tiles and one past the last; no row if they are equal.
    rows: [Row; 2],
    /// For the first two rows of tiles: the first tile and one past the last.
    spans: [[Row; 2]; 2],
}

impl Ellipses {
    /// Sets ellipse `k` to that of `footprint`.
    #[inline(always)]
    pub(super) fn set(&mut self, k: usize, footprint: &Footprint) {
        [self.mean[0][k], self.mean[1][k]] = footprint.mean;
        self.conic_shear[k] = footprint.conic_shear;
        self.conic_x[k] = f64::from(footprint.conic_x);
        self.conic_y[k] = f64::from(footprint.conic_y);
        self.power_max[k] = f64::from(footprint.power_max);
    }

    /// Computes the spans of all, with the same statements as [`touched_tiles`].
    #[inline(always)]
    pub(super) fn touch<S: Lanes>(&mut self, simd: S, grid: &Grid) {
        let number = |value: f64| Wide::of(simd, value);
        let (zero, half, one) = (number(0.0), number(0.5), number(1.0));
        let (tile, per_tile) = (number(f64::from(TILE_SIZE)), number(1.0 / f64::from(TILE_SIZE)));
        let (far, last_row) = (number(FAR), number(f64::from(grid.height) - 1.0));
        let last_column = number(f64::from(grid.width) - 1.0);
        for i in 0..BLOCK / S::F64_LANES {
            let at = |row: &Row| Wide::at(simd, row, i);
            let (mean_x, mean_y, shear) =
                (at(&self.mean[0]), at(&self.mean[1]), at(&self.conic_shear));
            let (conic_x, conic_y) = (at(&self.conic_x), at(&self.conic_y));
            let radius = at(&self.power_max).sqrt();
            let tall = radius / conic_y;
            let bounded = |value: Wide<S>| value.max(zero - far).min(far);
            let top = bounded(mean_y - tall - half).ceil().max(zero);
            let bottom = bounded(mean_y + tall - half).floor().min(last_row);
            let across = radius / conic_x;
            let lean = shear * tall;
            let peak = lean / (across * across + lean * lean).sqrt();
            let per_tall = conic_y / radius;
            let first_row = (top * per_tile).floor();
            let end_row = ((bottom * per_tile).floor() + one).only(bottom.at_least(top));
            first_row.put(&mut self.rows[0], i);
            end_row.put(&mut self.rows[1], i);
            for (k, [first, end]) in self.spans.iter_mut().enumerate() {
                let tile_y = first_row + number(k as f64);
                let corner = tile_y * tile;
                let low = (corner.max(top) + half - mean_y) * per_tall;
                let high = ((corner + tile - one).min(bottom) + half - mean_y) * per_tall;
                let (low, high) = if grid.by_ellipse { (low, high) } else { (zero - one, one) };
                let at_right = peak.max(low).min(high);
                let at_left = (zero - peak).max(low).min(high);
                let half_width = |share: Wide<S>| (one - share * share).max(zero).sqrt() * across;
                let right = lean * at_right + half_width(at_right);
                let left = lean * at_left - half_width(at_left);
                let left = bounded(mean_x + left - half).ceil().max(zero);
                let right = bounded(mean_x + right - half).floor().min(last_column);
                let meets = right.at_least(left);
                (left * per_tile).floor().only(meets).put(first, i);
                ((right * per_tile).floor() + one).only(meets).put(end, i);
            }
        }
    }

    /// Spans and number of tiles of ellipse `k`, which is that of `footprint`.
    #[inline(always)]
    pub(super) fn spans(&self, k: usize, footprint: &Footprint, grid: &Grid) -> (TileSpans, u32) {
        let (first, end) = (self.rows[0][k], self.rows[1][k]);
        if end - first > 2.0 {
            return TileSpans::of(footprint, grid);
        }
        let mut kept = TileSpans { depth: footprint.depth, ..TileSpans::default() };
        if end <= first {
            return (kept, 0);
        }
        let mut count = 0;
        kept.first_row = first as u16;
        kept.rows = (end - first) as u16;
        for (span, row) in kept.spans.iter_mut().zip(&self.spans).take(usize::from(kept.rows)) {
            *span = [row[0][k] as u16, row[1][k] as u16];
            count += u32::from(span[1] - span[0]);
        }
        (kept, count)
    }
}

/// Calls `touch(tile_y, tiles)` for every row of tiles of `grid` with the span of tiles touched. A
/// tile is touched if the ellipse of alpha 1/255 meets the rectangle of the tile's pixel centres.
/// The ellipse is convex, so it touches one span in a row of tiles: from its leftmost to its
/// rightmost point inside the row.
#[inline]
pub fn touched_tiles(footprint: &Footprint, grid: &Grid, mut touch: impl FnMut(u32, Range<u32>)) {
    let [mean_x, mean_y] = footprint.mean;
    let radius = f64::from(footprint.power_max).sqrt();
    let tall = radius / f64::from(footprint.conic_y);
    let first_row = i64::from(grid.tile_rows.start * TILE_SIZE);
    let last_row = i64::from((grid.tile_rows.end * TILE_SIZE).min(grid.height)) - 1;
    let top = ceil(mean_y - tall - 0.5).max(first_row);
    let bottom = floor(mean_y + tall - 0.5).min(last_row);
    if top > bottom {
        return;
    }
    let across = radius / f64::from(footprint.conic_x);
    let lean = footprint.conic_shear * tall;
    // Height, over `tall`, of the rightmost point of the ellipse; the leftmost is at -peak.
    let peak = lean / (across * across + lean * lean).sqrt();
    let half_width = |share: f64| (1.0 - share * share).max(0.0).sqrt() * across;
    let per_tall = f64::from(footprint.conic_y) / radius;
    let last_column = i64::from(grid.width) - 1;
    let tile = i64::from(TILE_SIZE);
    for tile_y in top / tile..=bottom / tile {
        // The band of pixel centres, over `tall`.
        let low = ((tile_y * tile).max(top) as f64 + 0.5 - mean_y) * per_tall;
        let high = ((tile_y * tile + tile - 1).min(bottom) as f64 + 0.5 - mean_y) * per_tall;
        let (low, high) = if grid.by_ellipse { (low, high) } else { (-1.0, 1.0) };
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

/// `v.floor()`, saturating. The standard one is a function call without SSE 4.1.
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
}
