//! Picture grids: a row a target, with what every asked text selects.

use std::path::Path;

use image::{RgbImage, imageops};

use super::{
    labels::{LabelledFrame, LabelledScene, NOT_SEEN},
    tally::TextMap,
};
use crate::{
    error::{Error, ErrorCode, Result},
    semantics,
};

/// Rows of a grid.
const ROWS: usize = 6;
/// Pixels between pictures.
const GAP: u32 = 4;
/// Width to which a picture is reduced.
const WIDTH: u32 = 320;

/// One target's pictures: photo, view, labels, then for each profile the scene's and the flat
/// road's best selecting text.
pub(super) struct Shown {
    cells: Vec<RgbImage>,
}

impl Shown {
    pub(super) fn new(
        scene: &LabelledScene,
        frame: &LabelledFrame,
        color: &[[f32; 3]],
        maps: &[Vec<TextMap>],
    ) -> Self {
        let photo = &scene.photos[frame.photo].photo;
        let asked: Vec<usize> =
            (0..scene.classes.len()).filter(|c| scene.classes[*c].asked).collect();
        let picture = |of: &dyn Fn(usize) -> [u8; 3]| {
            let whole = RgbImage::from_fn(photo.width, photo.height, |x, y| {
                image::Rgb(of(y as usize * photo.width as usize + x as usize))
            });
            let height = photo.height * WIDTH / photo.width.max(1);
            imageops::thumbnail(&whole, WIDTH, height.max(1))
        };
        let grey = |p: usize| (u16::from(photo.rgb[p * 3]) + u16::from(photo.rgb[p * 3 + 1])) / 6;
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..255")]
        let bytes = |rgb: [f32; 3]| rgb.map(|v| (v.clamp(0.0, 1.0) * 255.0) as u8);
        let tint = |p: usize, class: Option<usize>| match class {
            Some(c) => bytes(semantics::colour(u16::try_from(c + 1).unwrap_or(u16::MAX))),
            None => [grey(p) as u8; 3],
        };
        let mut cells = vec![
            picture(&|p| [0, 1, 2].map(|c| photo.rgb[p * 3 + c])),
            picture(&|p| bytes(color.get(p).copied().unwrap_or_default())),
            picture(&|p| {
                let label = frame.label[p];
                let class = usize::from(label).checked_sub(1).filter(|_| label != NOT_SEEN);
                tint(p, class.and_then(|class| asked.iter().position(|a| *a == class)))
            }),
        ];
        for maps in maps {
            let classes = &maps[..asked.len().min(maps.len())];
            cells.push(picture(&|p| tint(p, super::tally::best_selected(classes, p))));
        }
        Self { cells }
    }
}

/// Writes `out/scene.png`, at most [`ROWS`] targets.
pub(super) fn write(out: &Path, scene: &str, shown: &[Shown]) -> Result<()> {
    let rows = ROWS.min(shown.len());
    let Some(first) = shown.first() else { return Ok(()) };
    let height = first.cells.iter().map(RgbImage::height).max().unwrap_or(1) + GAP;
    let count = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    let width = (WIDTH + GAP) * count(first.cells.len());
    let mut grid = RgbImage::from_pixel(width, height * count(rows), image::Rgb([255; 3]));
    for row in 0..rows {
        let one = &shown[if rows == 1 { 0 } else { row * (shown.len() - 1) / (rows - 1) }];
        for (column, cell) in one.cells.iter().enumerate() {
            let x = i64::from((WIDTH + GAP) * count(column));
            imageops::replace(&mut grid, cell, x, i64::from(height * count(row)));
        }
    }
    let failed = |e: &dyn std::fmt::Display| {
        Error::new(ErrorCode::StoreUnavailable, format!("eval: pictures of {scene}: {e}"))
    };
    fs_err::create_dir_all(out).map_err(|e| failed(&e.kind()))?;
    grid.save(out.join(format!("{scene}.png"))).map_err(|e| failed(&e))
}
