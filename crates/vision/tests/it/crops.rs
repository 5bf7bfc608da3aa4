//! Masks are cut out of their photos.

use segsplat_core::scene::{Crop, CropShape, IndexMap, MaskInfo, Photo, PhotoMasks};
use segsplat_vision::semantics::Cutter;

/// 6 x 4 photo whose red is the column + 1 and green the row + 1.
fn photo() -> Photo {
    let rgb = (0..4_u8).flat_map(|y| (0..6_u8).flat_map(move |x| [x + 1, y + 1, 9])).collect();
    Photo { width: 6, height: 4, rgb, valid: None }
}

/// Masks on a grid of 3 x 2 cells of 2 x 2 pixels.
fn masks(index: &[u16], count: usize) -> PhotoMasks {
    PhotoMasks {
        wholes: Vec::new(),
        map: IndexMap { width: 3, height: 2, index: index.to_vec() },
        masks: vec![MaskInfo::default(); count],
    }
}

fn pixel(crop: &Crop, x: usize, y: usize) -> [u8; 3] {
    let at = (y * crop.width as usize + x) * 3;
    [crop.rgb[at], crop.rgb[at + 1], crop.rgb[at + 2]]
}

#[test]
fn outside_the_mask_is_black_and_the_rest_is_padded_to_a_square() {
    let (photo, masks) = (photo(), masks(&[1, 1, 2, 2, 1, 0], 2));
    let cutter = Cutter::new(&photo, &masks);
    let crop = cutter.cut(0, 0.0, CropShape::Square).unwrap();
    assert_eq!(crop.width, 4, "the box is columns 0..4, rows 0..4");
    assert_eq!(pixel(&crop, 0, 0), [1, 1, 9]);
    assert_eq!(pixel(&crop, 3, 3), [4, 4, 9]);
    assert_eq!(pixel(&crop, 0, 2), [0; 3], "another mask's pixel");
    let wide = cutter.cut(1, 0.0, CropShape::Square).unwrap();
    assert_eq!([wide.width, wide.height], [6; 2], "mask 2 spans all columns");
    assert_eq!(pixel(&wide, 4, 1), [5, 1, 9], "one row of padding above, one below");
    assert_eq!(pixel(&wide, 4, 0), [0; 3]);
    assert_eq!(pixel(&wide, 4, 5), [0; 3]);
}

#[test]
fn a_stretched_crop_is_the_box_alone() {
    let (photo, masks) = (photo(), masks(&[1, 1, 2, 2, 1, 0], 2));
    let wide = Cutter::new(&photo, &masks).cut(1, 0.0, CropShape::Stretched).unwrap();
    assert_eq!([wide.width, wide.height], [6, 4], "the photo's columns and rows of mask 2");
    assert_eq!(pixel(&wide, 4, 0), [5, 1, 9], "no padding above");
    assert_eq!(pixel(&wide, 0, 0), [0; 3], "mask 1 is black");
    let bordered = Cutter::new(&photo, &masks).cut(1, 0.5, CropShape::Stretched).unwrap();
    assert_eq!([bordered.width, bordered.height], [12, 10], "3 pixels on each side");
}

#[test]
fn a_margin_adds_black_around_even_beyond_the_photo() {
    let (photo, masks) = (photo(), masks(&[1, 0, 0, 0, 0, 0], 1));
    let crop = Cutter::new(&photo, &masks).cut(0, 0.5, CropShape::Square).unwrap();
    assert_eq!(crop.width, 4, "2 pixels and 1 on each side");
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
    assert!(
        cutter.cut(1, 0.0, CropShape::Square).is_none()
            && cutter.cut(7, 0.0, CropShape::Square).is_none()
    );
    let crop = cutter.cut(0, 0.0, CropShape::Square).unwrap();
    assert_eq!(pixel(&crop, 0, 1), [0; 3], "undistortion found no source there");
    assert_eq!(pixel(&crop, 1, 1), [2, 1, 9]);
}

#[test]
fn cells_follow_the_centres_of_pixels_for_any_ratio() {
    for (pixels, cells) in [(6, 3), (3, 6), (7, 5), (640, 128), (5, 5), (1, 9)] {
        // One row of pixels. Red and green say which column it is, counted from 1.
        let rgb = (1..=pixels).flat_map(|x| [(x % 256) as u8, (x / 256) as u8, 0]).collect();
        let photo = Photo { width: pixels, height: 1, rgb, valid: None };
        let map = IndexMap { width: cells, height: 1, index: (1..).take(cells as usize).collect() };
        let masks = PhotoMasks {
            wholes: Vec::new(),
            masks: vec![MaskInfo::default(); cells as usize],
            map,
        };
        let cutter = Cutter::new(&photo, &masks);
        let mut found = vec![0; pixels as usize];
        for mask in 0..cells as usize {
            let Some(crop) = cutter.cut(mask, 0.0, CropShape::Square) else { continue };
            for rgb in crop.rgb.chunks_exact(3) {
                let column = usize::from(rgb[0]) + 256 * usize::from(rgb[1]);
                if column > 0 {
                    found[column - 1] = mask + 1;
                }
            }
        }
        for (i, entry) in found.into_iter().enumerate() {
            let share = (i as f64 + 0.5) / f64::from(pixels);
            assert_eq!(entry, usize::from(masks.map.at(share, 0.5)), "{i} of {pixels} in {cells}");
        }
    }
}
