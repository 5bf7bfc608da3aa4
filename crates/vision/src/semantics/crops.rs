//! Cuts a mask out of its photo: its box with a margin, as a square, black outside the mask.

use crate::scene::{Crop, Photo, PhotoMasks};

/// First and last column and row of a mask, pixels of the photo.
#[derive(Clone, Copy)]
struct Bounds {
    x: [u32; 2],
    y: [u32; 2],
}

/// A photo with its masks. It gives one crop at a time, so that few are in memory.
pub struct Cutter<'a> {
    photo: &'a Photo,
    masks: &'a PhotoMasks,
    /// Cell column of each pixel column.
    columns: Vec<usize>,
    /// Start of the cell row of each pixel row.
    rows: Vec<usize>,
    bounds: Vec<Option<Bounds>>,
}

impl std::fmt::Debug for Cutter<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Cutter").field("masks", &self.bounds.len()).finish_non_exhaustive()
    }
}

/// The cell of each pixel's centre along one axis.
fn cells_of(pixels: u32, cells: u32) -> Vec<usize> {
    let (pixels_u64, cells) = (u64::from(pixels.max(1)), u64::from(cells));
    // (i + 1/2) / pixels * cells, rounded down, in integers.
    let cell = |i: u64| ((2 * i + 1) * cells / (2 * pixels_u64)) as usize;
    (0..u64::from(pixels)).map(cell).collect()
}

impl<'a> Cutter<'a> {
    /// Finds the box of every mask.
    #[must_use]
    pub fn new(photo: &'a Photo, masks: &'a PhotoMasks) -> Self {
        let map = &masks.map;
        let columns = cells_of(photo.width, map.width);
        let rows: Vec<usize> = cells_of(photo.height, map.height)
            .into_iter()
            .map(|row| row * map.width as usize)
            .collect();
        let mut bounds: Vec<Option<Bounds>> = vec![None; masks.masks.len()];
        for (y, row) in (0..).zip(&rows) {
            for (x, column) in (0..).zip(&columns) {
                let index = map.index.get(row + column).copied().unwrap_or(0);
                let Some(of) = usize::from(index).checked_sub(1) else { continue };
                let Some(found) = bounds.get_mut(of) else { continue };
                match found {
                    None => *found = Some(Bounds { x: [x, x], y: [y, y] }),
                    Some(b) => {
                        b.x = [b.x[0].min(x), b.x[1].max(x)];
                        b.y[1] = y;
                    }
                }
            }
        }
        Self { photo, masks, columns, rows, bounds }
    }

    /// The crop of mask `k`, counted from 0, with a margin of `margin` times the longer side of its
    /// box. `None` if the mask has no pixel of the photo.
    #[must_use]
    pub fn cut(&self, k: usize, margin: f64) -> Option<Crop> {
        let bounds = (*self.bounds.get(k)?)?;
        let longer = (bounds.x[1] - bounds.x[0]).max(bounds.y[1] - bounds.y[0]) + 1;
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a margin is a small share of a photo's side"
        )]
        let border = (margin.max(0.0) * f64::from(longer)).round().min(f64::from(longer)) as u32;
        let side = longer + 2 * border;
        // The box is in the middle. An odd pixel goes to the right and to the bottom.
        let start =
            |[first, last]: [u32; 2]| i64::from(first) - i64::from(side - (last - first + 1)) / 2;
        let (left, top) = (start(bounds.x), start(bounds.y));
        let mut rgb = vec![0; side as usize * side as usize * 3];
        let wanted = k + 1;
        for y in bounds.y[0]..=bounds.y[1] {
            let into = (i64::from(y) - top) as usize * side as usize;
            for x in bounds.x[0]..=bounds.x[1] {
                let cell = self.rows[y as usize] + self.columns[x as usize];
                let index = self.masks.map.index.get(cell).copied().unwrap_or(0);
                let from = y as usize * self.photo.width as usize + x as usize;
                let sourced = self.photo.valid.as_ref().is_none_or(|valid| valid[from]);
                if usize::from(index) == wanted && sourced {
                    let to = (into + (i64::from(x) - left) as usize) * 3;
                    rgb[to..to + 3].copy_from_slice(&self.photo.rgb[from * 3..from * 3 + 3]);
                }
            }
        }
        Some(Crop { side, rgb })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{IndexMap, MaskInfo};

    /// 6 x 4 photo whose red is the column + 1 and green the row + 1.
    fn photo() -> Photo {
        let rgb = (0..4_u8).flat_map(|y| (0..6_u8).flat_map(move |x| [x + 1, y + 1, 9])).collect();
        Photo { width: 6, height: 4, rgb, valid: None }
    }

    /// Masks on a grid of 3 x 2 cells of 2 x 2 pixels.
    fn masks(index: &[u16], count: usize) -> PhotoMasks {
        PhotoMasks {
            map: IndexMap { width: 3, height: 2, index: index.to_vec() },
            masks: vec![MaskInfo::default(); count],
        }
    }

    fn pixel(crop: &Crop, x: usize, y: usize) -> [u8; 3] {
        let at = (y * crop.side as usize + x) * 3;
        [crop.rgb[at], crop.rgb[at + 1], crop.rgb[at + 2]]
    }

    #[test]
    fn outside_the_mask_is_black_and_the_rest_is_padded_to_a_square() {
        let (photo, masks) = (photo(), masks(&[1, 1, 2, 2, 1, 0], 2));
        let cutter = Cutter::new(&photo, &masks);
        let crop = cutter.cut(0, 0.0).unwrap();
        assert_eq!(crop.side, 4, "the box is columns 0..4, rows 0..4");
        assert_eq!(pixel(&crop, 0, 0), [1, 1, 9]);
        assert_eq!(pixel(&crop, 3, 3), [4, 4, 9]);
        assert_eq!(pixel(&crop, 0, 2), [0; 3], "another mask's pixel");
        let wide = cutter.cut(1, 0.0).unwrap();
        assert_eq!(wide.side, 6, "mask 2 spans all columns");
        assert_eq!(pixel(&wide, 4, 1), [5, 1, 9], "one row of padding above, one below");
        assert_eq!(pixel(&wide, 4, 0), [0; 3]);
        assert_eq!(pixel(&wide, 4, 5), [0; 3]);
    }

    #[test]
    fn a_margin_adds_black_around_even_beyond_the_photo() {
        let (photo, masks) = (photo(), masks(&[1, 0, 0, 0, 0, 0], 1));
        let crop = Cutter::new(&photo, &masks).cut(0, 0.5).unwrap();
        assert_eq!(crop.side, 4, "2 pixels and 1 on each side");
        assert_eq!(pixel(&crop, 1, 1), [1, 1, 9]);
        assert_eq!(crop.rgb.iter().filter(|&&v| v > 0).count(), 12, "4 pixels are not black");
    }

    #[test]
    fn a_mask_without_pixels_gives_no_cut_and_unsourced_pixels_stay_black() {
        let (mut photo, masks) = (photo(), masks(&[1, 1, 0, 0, 0, 0], 2));
        let mut valid = vec![true; 24];
        valid[0] = false;
        photo.valid = Some(valid);
        let cutter = Cutter::new(&photo, &masks);
        assert!(cutter.cut(1, 0.0).is_none() && cutter.cut(7, 0.0).is_none());
        let crop = cutter.cut(0, 0.0).unwrap();
        assert_eq!(pixel(&crop, 0, 1), [0; 3], "undistortion found no source there");
        assert_eq!(pixel(&crop, 1, 1), [2, 1, 9]);
    }

    #[test]
    fn cells_follow_the_centres_of_pixels_for_any_ratio() {
        for (pixels, cells) in [(6, 3), (3, 6), (7, 5), (640, 128), (5, 5), (1, 9)] {
            let map =
                IndexMap { width: cells, height: 1, index: (0..).take(cells as usize).collect() };
            for (i, cell) in cells_of(pixels, cells).into_iter().enumerate() {
                let share = (i as f64 + 0.5) / f64::from(pixels);
                assert_eq!(cell, usize::from(map.at(share, 0.5)), "{i} of {pixels} in {cells}");
            }
        }
    }
}
