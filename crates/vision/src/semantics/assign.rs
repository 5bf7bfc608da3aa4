//! Gives each Gaussian of a photo the entry of its source pixel's cell.

use rayon::prelude::*;

use crate::scene::{IndexMap, Intrinsics, SourcePixel};

/// Where the network's picture lies on its photo: two lenses of one pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NetworkPicture {
    /// Lens of the network's picture. `SourcePixel` counts its pixels.
    pub network: Intrinsics,
    /// Lens of the undistorted photo.
    pub photo: Intrinsics,
}

impl NetworkPicture {
    /// Shares 0..1 of the photo's width, one for each column of the network's picture.
    fn columns(&self) -> Vec<f64> {
        let (n, p) = (&self.network, &self.photo);
        let share =
            |x: u32| ((f64::from(x) + 0.5 - n.cx) / n.fx * p.fx + p.cx) / f64::from(p.width.max(1));
        (0..n.width).map(share).collect()
    }

    /// Shares 0..1 of the photo's height, one for each row of the network's picture.
    fn rows(&self) -> Vec<f64> {
        let (n, p) = (&self.network, &self.photo);
        let share = |y: u32| {
            ((f64::from(y) + 0.5 - n.cy) / n.fy * p.fy + p.cy) / f64::from(p.height.max(1))
        };
        (0..n.height).map(share).collect()
    }
}

/// Replaces mask numbers by entries: mask k becomes `becomes[k - 1]`; 0 stays 0.
#[must_use]
pub fn relabel(map: &IndexMap, becomes: &[u16]) -> IndexMap {
    let label = |index: &u16| {
        usize::from(*index).checked_sub(1).and_then(|k| becomes.get(k)).copied().unwrap_or(0)
    };
    IndexMap { index: map.index.iter().map(label).collect(), ..*map }
}

/// `[N]` entry of each Gaussian, from its source pixel; 0 if its photo has no picture or no map.
#[must_use]
pub fn from_source(
    source: &[SourcePixel],
    pictures: &[Option<NetworkPicture>],
    maps: &[IndexMap],
) -> Vec<u16> {
    let shares: Vec<Option<(Vec<f64>, Vec<f64>)>> =
        pictures.iter().map(|p| p.map(|p| (p.columns(), p.rows()))).collect();
    source
        .par_iter()
        .map(|pixel| {
            let view = usize::from(pixel.view);
            let (Some(Some((columns, rows))), Some(map)) = (shares.get(view), maps.get(view))
            else {
                return 0;
            };
            match (columns.get(usize::from(pixel.x)), rows.get(usize::from(pixel.y))) {
                (Some(&x), Some(&y)) => map.at(x, y),
                _ => 0,
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lens(fx: f64, cx: f64, cy: f64, width: u32, height: u32) -> Intrinsics {
        Intrinsics { fx, fy: fx, cx, cy, width, height }
    }

    /// The middle 80 x 80 of a 120 x 80 photo, resized to 40 x 40.
    fn picture() -> NetworkPicture {
        NetworkPicture {
            network: lens(50.0, 22.0, 19.0, 40, 40),
            photo: lens(100.0, 64.0, 38.0, 120, 80),
        }
    }

    #[test]
    fn a_gaussian_takes_the_index_of_its_pixel_through_crop_and_size() {
        // Columns of the photo in cells of 10 pixels: cell c has index c + 1.
        let index = (0..8).flat_map(|_| 1..=12).collect();
        let maps = [IndexMap { width: 12, height: 8, index }];
        let at = |x: u16| SourcePixel { view: 0, x, y: 7 };
        let source: Vec<SourcePixel> = [0, 4, 5, 20, 39].map(at).to_vec();
        // Column x of the network is column 2 x + 20 of the photo.
        let found = from_source(&source, &[Some(picture())], &maps);
        assert_eq!(found, [3, 3, 4, 7, 10]);
    }

    #[test]
    fn rows_follow_their_own_offset() {
        let maps = [IndexMap { width: 1, height: 4, index: vec![1, 2, 3, 4] }];
        let at = |y: u16| SourcePixel { view: 0, x: 3, y };
        let found = from_source(&[0, 9, 10, 39].map(at), &[Some(picture())], &maps);
        assert_eq!(found, [1, 1, 2, 4], "20 rows of the photo a cell, 10 of the network");
    }

    #[test]
    fn what_has_no_picture_or_map_is_background() {
        let maps = [IndexMap { width: 1, height: 1, index: vec![5] }];
        let source = [
            SourcePixel { view: 0, x: 1, y: 1 },
            SourcePixel { view: 1, x: 1, y: 1 },
            SourcePixel { view: 2, x: 1, y: 1 },
            SourcePixel { view: 0, x: 40, y: 1 },
        ];
        assert_eq!(from_source(&source, &[Some(picture()), None], &maps), [5, 0, 0, 0]);
        assert_eq!(from_source(&source, &[None], &maps), [0; 4]);
    }

    #[test]
    fn masks_become_rows_of_the_bank() {
        let map = IndexMap { width: 4, height: 1, index: vec![0, 1, 2, 3] };
        assert_eq!(relabel(&map, &[7, 7]).index, [0, 7, 7, 0]);
    }
}
