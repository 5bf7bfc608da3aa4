//! Picture grids: what the figures do not show.

use std::path::Path;

use image::{RgbImage, imageops};

use crate::{
    error::{Error, ErrorCode, Result},
    eval::{Judged, SIDE},
    scene::PosedPhoto,
};

/// Rows of a grid.
const ROWS: usize = 8;
/// Pixels between pictures.
const GAP: u32 = 4;

/// Writes `out/scene.png`: rows from the worst triple to the best (at most eight, evenly spaced by
/// PSNR); columns are the inputs, the target, the render and its depth (near is bright).
pub(super) fn write(
    out: &Path,
    scene: &str,
    squares: &[PosedPhoto],
    judged: &[Judged],
) -> Result<()> {
    let mut order: Vec<&Judged> = judged.iter().collect();
    order.sort_by(|a, b| a.report.psnr.total_cmp(&b.report.psnr));
    let rows = ROWS.min(order.len());
    let Some(first) = order.first() else { return Ok(()) };
    let columns = first.inputs.len() + 3;
    let side = |n: usize| n as u32 * (SIDE + GAP);
    let mut grid = RgbImage::from_pixel(side(columns), side(rows), image::Rgb([255; 3]));
    for row in 0..rows {
        let one = order[if rows == 1 { 0 } else { row * (order.len() - 1) / (rows - 1) }];
        let mut cells: Vec<Vec<u8>> =
            one.inputs.iter().map(|&i| squares[i].photo.rgb.clone()).collect();
        cells.push(squares[one.target].photo.rgb.clone());
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..255")]
        cells.push(one.color.iter().flatten().map(|v| (v * 255.0).round() as u8).collect());
        cells.push(shade(&one.depth));
        for (column, cell) in cells.into_iter().enumerate() {
            if let Some(picture) = RgbImage::from_raw(SIDE, SIDE, cell) {
                let at = |n: usize| i64::from(side(n));
                imageops::replace(&mut grid, &picture, at(column), at(row));
            }
        }
    }
    let failed = |e: &dyn std::fmt::Display| {
        Error::new(ErrorCode::StoreUnavailable, format!("eval: pictures of {scene}: {e}"))
    };
    fs_err::create_dir_all(out).map_err(|e| failed(&e.kind()))?;
    grid.save(out.join(format!("{scene}.png"))).map_err(|e| failed(&e))
}

/// Inverse depth as grey, the 2nd to 98th percentile of the seen pixels from dark to bright.
fn shade(depth: &[f32]) -> Vec<u8> {
    let mut seen: Vec<f32> = depth.iter().filter(|d| **d > 0.0).map(|d| 1.0 / d).collect();
    seen.sort_by(f32::total_cmp);
    let at = |share: f32| -> f32 {
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "an index")]
        let i = (share * (seen.len().saturating_sub(1)) as f32) as usize;
        seen.get(i).copied().unwrap_or(0.0)
    };
    let (low, high) = (at(0.02), at(0.98));
    let range = (high - low).max(1e-12);
    depth
        .iter()
        .flat_map(|&d| {
            let bright = if d > 0.0 { (1.0 / d - low) / range } else { 0.0 };
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..255")]
            let value = (bright.clamp(0.0, 1.0) * 255.0) as u8;
            [value; 3]
        })
        .collect()
}
