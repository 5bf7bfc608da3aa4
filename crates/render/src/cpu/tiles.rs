//! Which tiles a Gaussian touches: one function for the count and for the emission.
//! Shader: `shaders/common/tiles.wgsl`

use std::ops::Range;

use super::{
    footprint::Footprint,
    lanes::{Lanes, Row, Wide},
};
use crate::{constants::TILE_SIZE, skip::Skip, view::View};

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
    #[must_use]
    pub fn whole(view: &View, without: Option<Skip>) -> Self {
        Self {
            width: view.width,
            height: view.height,
            tile_rows: 0..view.tiles_y(),
            by_ellipse: without != Some(Skip::EllipseTiles),
        }
    }

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

/// The result of [`touched_tiles`] for a footprint of at most two rows of tiles. Most are.
///
/// The emission reads it: in depth order these 12 bytes stay in the cache, footprints do not.
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
    /// Calls [`touched_tiles`] once. Returns the spans and the number of tiles.
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

    /// Number of tiles touched in `grid`, which may be a band of the first grid.
    #[must_use]
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
        let mut kept = TileSpans::default();
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

/// Calls `touch(tile_y, tiles)` for every row of tiles of `grid` with the span of tiles touched.
///
/// A tile is touched if the ellipse of alpha 1/255 meets the rectangle of the tile's pixel centres.
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

/// Number of tiles touched in `grid`.
#[inline]
#[must_use]
pub fn count_tiles(footprint: &Footprint, grid: &Grid) -> u32 {
    TileSpans::of(footprint, grid).1
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
    use super::{
        super::lanes::{LaneKernel, Width},
        *,
    };

    #[test]
    fn floor_and_ceil_equal_the_standard_ones_and_saturate() {
        for v in [-2.5, -2.0, -0.1, 0.0, 0.1, 2.0, 2.5, 1e15, -1e15] {
            assert_eq!((floor(v), ceil(v)), (v.floor() as i64, v.ceil() as i64), "{v}");
        }
        for v in [f64::INFINITY, 1e300] {
            assert_eq!((floor(v), ceil(-v)), (i64::MAX, i64::MIN), "{v} saturates");
        }
    }

    struct Asked<'a>(&'a [Footprint], &'a Grid, &'a mut Vec<(TileSpans, u32)>);

    impl LaneKernel for Asked<'_> {
        #[inline(always)]
        fn run<S: Lanes>(self, simd: S) {
            let Self(footprints, grid, answers) = self;
            for block in footprints.chunks(BLOCK) {
                let mut ellipses = Ellipses::default();
                for (k, footprint) in block.iter().enumerate() {
                    ellipses.set(k, footprint);
                }
                ellipses.touch(simd, grid);
                let spans = block.iter().enumerate();
                answers.extend(spans.map(|(k, footprint)| ellipses.spans(k, footprint, grid)));
            }
        }
    }

    #[test]
    fn ellipses_in_lanes_touch_the_tiles_that_one_alone_touches() {
        let grid = Grid { width: 203, height: 150, tile_rows: 0..10, by_ellipse: true };
        let footprints: Vec<Footprint> = (0..4_000_u32)
            .map(|i| {
                let turn = |k: u32| f64::from((i.wrapping_mul(2_654_435_761) >> k) & 0xff) / 255.0;
                // Some far away, some of no height, some that cover the picture.
                let far = if i % 97 == 0 { 1e12 } else { 1.0 };
                Footprint {
                    mean: [(turn(3) * 300.0 - 50.0) * far, turn(9) * 250.0 - 50.0],
                    conic_shear: turn(12) * 8.0 - 4.0,
                    conic_x: (0.002 + turn(17)) as f32,
                    conic_y: (0.004 + turn(21) * turn(2)) as f32,
                    power_max: (turn(6) * 5.5) as f32,
                    ..Footprint::default()
                }
            })
            .collect();
        let alone = footprints.iter().map(|f| TileSpans::of(f, &grid));
        let want: Vec<_> = alone.collect();
        assert!(want.iter().any(|(spans, _)| spans.rows > 2), "tall ones too");
        for width in Width::ALL.into_iter().filter(|width| width.available()) {
            let mut got = Vec::new();
            width.run(Asked(&footprints, &grid, &mut got));
            for (i, (got, want)) in got.iter().zip(&want).enumerate() {
                // What a span tells counts, not how an empty one is written.
                let tiles = |spans: &TileSpans| {
                    let mut tiles = Vec::new();
                    spans.replay(&footprints[i], &grid, |y, xs| tiles.push((y, xs)));
                    tiles
                };
                assert_eq!(got.1, want.1, "{width:?}, count of {:?}", footprints[i]);
                assert_eq!(tiles(&got.0), tiles(&want.0), "{width:?}, {:?}", footprints[i]);
            }
        }
    }

    /// Every pixel centre inside the ellipse lies in a touched tile, and every tile touched comes
    /// near the ellipse.
    #[test]
    fn touched_tiles_hold_every_pixel_of_the_ellipse() {
        let grid = Grid { width: 203, height: 150, tile_rows: 0..10, by_ellipse: true };
        let mut touched_total = 0;
        for i in 0..2_000_u32 {
            let turn = |k: u32| f64::from((i.wrapping_mul(2_654_435_761) >> k) & 0xff) / 255.0;
            let footprint = Footprint {
                mean: [turn(3) * 300.0 - 50.0, turn(9) * 250.0 - 50.0],
                conic_shear: turn(12) * 8.0 - 4.0,
                conic_x: (0.01 + turn(17)) as f32,
                conic_y: (0.02 + turn(21) * turn(2)) as f32,
                power_max: (turn(6) * 5.5) as f32,
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
                (f64::from(footprint.conic_x) * (dx - footprint.conic_shear * dy)).powi(2)
                    + (f64::from(footprint.conic_y) * dy).powi(2)
            };
            for y in 0..grid.height {
                for x in 0..grid.width {
                    let inside =
                        power(f64::from(x) + 0.5, f64::from(y) + 0.5) < footprint.power_max.into();
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
                        power(x, y) < f64::from(footprint.power_max) * 1.05 + 1.5
                    })
                });
                assert!(near, "tile {tx},{ty} is far from {footprint:?}");
            }
        }
        assert!(touched_total > 1_000, "the test saw {touched_total} tiles only");
    }
}
