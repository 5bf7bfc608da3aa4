//! Triples of photos, and the photos nearest to a target.

use glam::DVec3;
use segsplat_core::scene::{Camera, CameraToWorld, Intrinsics, PosedPhoto};
use segsplat_lab::{
    scenes::nearest,
    triples::{Triple, median_nearest, triples},
};

use crate::posed;

/// A photo from a place on the x axis, along z.
fn at(x: f64) -> PosedPhoto {
    let intrinsics = Intrinsics { fx: 9., fy: 9., cx: 4., cy: 4., width: 8, height: 8 };
    let eye = DVec3::X * x;
    let camera_to_world = CameraToWorld::look_at(eye, eye + DVec3::Z, DVec3::NEG_Y, "t").unwrap();
    posed(Camera { intrinsics, camera_to_world }, vec![0; 192])
}

/// Photos in a row, in uneven steps: no target is as near to a middle as another.
fn line(count: u32, step: f64) -> Vec<PosedPhoto> {
    let place = |i: u32| f64::from(i) + 0.01 * f64::from(i * i) - 0.01 * f64::from(i);
    (0..count).map(|i| at(place(i) * step)).collect()
}

#[test]
fn triples_do_not_depend_on_the_unit_of_length() {
    let pairs =
        |step| -> Vec<_> { triples(&line(9, step)).iter().map(|t| (t.pair, t.target)).collect() };
    assert_eq!(pairs(0.3), pairs(40.0), "scaled");
    assert!(!pairs(0.3).is_empty(), "some");
    // 1.3 / 0.3 steps at most: no pair is five apart.
    assert!(pairs(0.3).iter().all(|(p, _)| p[1] - p[0] <= 4), "{:?}", pairs(0.3));
    // Neighbours have nobody within 0.45 of a step from their middle.
    assert!(pairs(0.3).iter().all(|(p, _)| p[1] - p[0] >= 2), "{:?}", pairs(0.3));
}

#[test]
fn more_inputs_are_the_nearest_and_never_the_target() {
    let photos = line(9, 0.3);
    let triple = Triple { pair: [2, 6], target: 4, baseline: 1.2 };
    assert_eq!(triple.inputs(&photos, 2), [2, 6], "the pair");
    let mut four = triple.inputs(&photos, 4);
    four.sort_unstable();
    assert_eq!(four, [2, 3, 5, 6], "and the two beside the target");
}

#[test]
fn the_median_of_an_even_count_is_the_mean_of_two() {
    let mut photos = line(2, 1.0);
    photos.extend(line(2, 3.0).into_iter().map(|mut photo| {
        let mut m = photo.camera.camera_to_world.to_row_major();
        m[3] += 100.0;
        photo.camera.camera_to_world = CameraToWorld::from_row_major(&m, "t").unwrap();
        photo
    }));
    assert_eq!(median_nearest(&photos), Some(2.0), "1, 1, 3, 3");
}

#[test]
fn the_nearest_other_photos_are_the_input() {
    let photos: Vec<PosedPhoto> = [5.0, 0.0, 1.0, -2.0].map(at).into();
    assert_eq!(nearest(&photos, 1, 2), [2, 3]);
    assert_eq!(nearest(&photos, 0, 2), [2, 1]);
    assert_eq!(nearest(&photos, 0, 9).len(), 3);
}
