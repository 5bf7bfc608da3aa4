//! The entry of a Gaussian is that of its source pixel's cell.

use segsplat_core::scene::{Camera, CameraToWorld, IndexMap, Intrinsics, SceneCamera, SourcePixel};
use segsplat_vision::semantics::{from_source, relabel};

fn lens(fx: f64, cx: f64, cy: f64, width: u32, height: u32) -> Intrinsics {
    Intrinsics { fx, fy: fx, cx, cy, width, height }
}

/// The middle 80 x 80 of a 120 x 80 photo, resized to 40 x 40.
fn camera() -> SceneCamera {
    let pose = glam::DMat4::IDENTITY.to_cols_array();
    SceneCamera {
        file: String::new(),
        camera: Camera {
            intrinsics: lens(100.0, 64.0, 38.0, 120, 80),
            camera_to_world: CameraToWorld::from_row_major(&pose, "test").unwrap(),
        },
        network: Some(lens(50.0, 22.0, 19.0, 40, 40)),
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
    let found = from_source(&source, &[camera()], &maps);
    assert_eq!(found, [3, 3, 4, 7, 10]);
}

#[test]
fn rows_follow_their_own_offset() {
    let maps = [IndexMap { width: 1, height: 4, index: vec![1, 2, 3, 4] }];
    let at = |y: u16| SourcePixel { view: 0, x: 3, y };
    let found = from_source(&[0, 9, 10, 39].map(at), &[camera()], &maps);
    assert_eq!(found, [1, 1, 2, 4], "20 rows of the photo a cell, 10 of the network");
}

#[test]
fn what_has_no_picture_or_map_is_background() {
    let maps = [IndexMap { width: 1, height: 1, index: vec![5] }];
    let without = SceneCamera { network: None, ..camera() };
    let source = [
        SourcePixel { view: 0, x: 1, y: 1 },
        SourcePixel { view: 1, x: 1, y: 1 },
        SourcePixel { view: 2, x: 1, y: 1 },
        SourcePixel { view: 0, x: 40, y: 1 },
    ];
    assert_eq!(from_source(&source, &[camera(), without.clone()], &maps), [5, 0, 0, 0]);
    assert_eq!(from_source(&source, &[without], &maps), [0; 4]);
}

#[test]
fn masks_become_rows_of_the_bank() {
    let map = IndexMap { width: 4, height: 1, index: vec![0, 1, 2, 3] };
    assert_eq!(relabel(&map, &[7, 7]).index, [0, 7, 7, 0]);
}
