//! Picture grids: what figures do not show.

use std::path::Path;

use image::{Rgb, RgbImage, imageops};

use crate::{
    error::{Error, ErrorCode, Result},
    scene::Photo,
};

/// Most rows of a grid.
const ROWS_MAX: usize = 8;
/// Pixels between pictures.
const GAP: u32 = 4;

/// Pictures side by side.
pub(crate) type Row = Vec<RgbImage>;

/// A photo as it is.
pub(crate) fn photo(photo: &Photo) -> RgbImage {
    RgbImage::from_raw(photo.width, photo.height, photo.rgb.clone()).unwrap_or_default()
}

/// Colours of 0 to 1 in rows of `width`.
pub(crate) fn color(color: &[[f32; 3]], width: u32) -> RgbImage {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..255")]
    let bytes = color.iter().flatten().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    RgbImage::from_raw(width, (color.len() / width.max(1) as usize) as u32, bytes)
        .unwrap_or_default()
}

/// Inverse depth as grey: near is bright, from the 2nd to the 98th percentile.
pub(crate) fn depth(depth: &[f32], width: u32) -> RgbImage {
    let inverse = |d: f32| if d > 0.0 { 1.0 / d } else { 0.0 };
    let mut seen: Vec<f32> = depth.iter().filter(|d| **d > 0.0).map(|d| inverse(*d)).collect();
    seen.sort_by(f32::total_cmp);
    let at = |percent: usize| seen.get(seen.len() * percent / 100).copied().unwrap_or(0.0);
    let (low, range) = (at(2), (at(98) - at(2)).max(1e-12));
    let grey: Vec<[f32; 3]> = depth.iter().map(|d| [(inverse(*d) - low) / range; 3]).collect();
    color(&grey, width)
}

/// Writes `out/scene.png`: at most [`ROWS_MAX`] of the rows, evenly spread.
pub(crate) fn write(out: &Path, scene: &str, all: &[&Row]) -> Result<()> {
    let count = ROWS_MAX.min(all.len());
    let spread = |i: usize| i * all.len().saturating_sub(1) / count.saturating_sub(1).max(1);
    let rows: Vec<&Row> = (0..count).map(|i| all[spread(i)]).collect();
    let most = |side: fn(&RgbImage) -> u32| {
        rows.iter().flat_map(|row| row.iter()).map(side).max().unwrap_or(1) + GAP
    };
    let (width, height) = (most(RgbImage::width), most(RgbImage::height));
    let columns = rows.iter().map(|row| row.len()).max().unwrap_or(1);
    let size = [width * columns as u32, height * count.max(1) as u32];
    let mut grid = RgbImage::from_pixel(size[0], size[1], Rgb([255; 3]));
    for (y, row) in (0_i64..).zip(&rows) {
        for (x, picture) in (0_i64..).zip(*row) {
            imageops::replace(&mut grid, picture, x * i64::from(width), y * i64::from(height));
        }
    }
    let failed = |e: &dyn std::fmt::Display| {
        Error::new(ErrorCode::StoreUnavailable, format!("pictures of {scene}: {e}"))
    };
    fs_err::create_dir_all(out).map_err(|e| failed(&e.kind()))?;
    grid.save(out.join(format!("{scene}.png"))).map_err(|e| failed(&e))
}
