//! The generated photos and their cameras.

use segsplat_core::scene::CameraToWorld;
use segsplat_vision::sample::{Room, SampleOptions, cameras, photos, transforms_json};

const SMALL: SampleOptions = SampleOptions { photos: 3, width: 48, height: 36, seed: 7 };

#[test]
fn the_same_seed_gives_the_same_photos_and_another_does_not() {
    let first = photos(&SMALL).unwrap();
    let again = photos(&SMALL).unwrap();
    let other = photos(&SampleOptions { seed: 8, ..SMALL }).unwrap();
    assert_eq!(first.len(), 3, "photos asked for");
    assert_eq!(first[1].photo.rgb, again[1].photo.rgb, "same seed, other pixels");
    assert_ne!(first[1].photo.rgb, other[1].photo.rgb, "the seed changes nothing");
}

#[test]
fn depth_and_cameras_agree_between_two_views() {
    let room = Room::new(SMALL.seed);
    let cameras = cameras(&SMALL).unwrap();
    let [a, b] = [room.view(&cameras[0]), room.view(&cameras[1])];
    let (mut close, mut inside) = (0, 0);
    for (i, &depth) in a.depth.iter().enumerate() {
        let (u, v) = ((i % 48) as f64 + 0.5, (i / 48) as f64 + 0.5);
        let at = cameras[0].intrinsics.unproject(u, v, f64::from(depth));
        let world = cameras[0].camera_to_world.matrix().transform_point3(at);
        let there = cameras[1].camera_to_world.viewmat().transform_point3(world);
        let (x, y) = cameras[1].intrinsics.project(there);
        if x >= 0.0 && y >= 0.0 && x < 48.0 && y < 36.0 {
            inside += 1;
            let other = f64::from(b.depth[y as usize * 48 + x as usize]);
            close += usize::from((other - there.z).abs() < 0.05 * there.z);
        }
    }
    assert!(inside > 1200, "only {inside} pixels of the first view land in the second");
    assert!(close * 10 > inside * 9, "only {close} of {inside} depths agree");
}

#[test]
fn transforms_are_opengl_and_options_are_checked() {
    let posed = photos(&SMALL).unwrap();
    let value: serde_json::Value = serde_json::from_slice(&transforms_json(&posed)).unwrap();
    let rows = value["frames"][2]["transform_matrix"].as_array().unwrap();
    let flat: Vec<f64> =
        rows.iter().flat_map(|r| r.as_array().unwrap()).map(|v| v.as_f64().unwrap()).collect();
    let back = CameraToWorld::from_opengl_row_major(&flat.try_into().unwrap(), "frame 2").unwrap();
    let off = (back.center() - posed[2].camera.camera_to_world.center()).length();
    assert!(off < 1e-9, "the pose moved by {off}");
    assert!((back.axis() - posed[2].camera.camera_to_world.axis()).length() < 1e-9);
    for bad in [SampleOptions { photos: 1, ..SMALL }, SampleOptions { width: 5000, ..SMALL }] {
        assert!(photos(&bad).unwrap_err().message().contains("must be"), "{bad:?} passed");
    }
}
