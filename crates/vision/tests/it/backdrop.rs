//! The colours of the photos by direction.

use glam::DVec3;
use segsplat_core::scene::{Backdrop, Camera, CameraToWorld, Intrinsics, Photo, PosedPhoto};
use segsplat_vision::lift::backdrop;

fn photo(target: DVec3, rgb: [u8; 3]) -> PosedPhoto {
    let pose = CameraToWorld::look_at(DVec3::ZERO, target, -DVec3::Y, "photo").unwrap();
    PosedPhoto {
        file: "a.png".to_owned(),
        photo: Photo { width: 64, height: 64, rgb: rgb.repeat(64 * 64), valid: None },
        camera: Camera {
            intrinsics: Intrinsics {
                fx: 64.0,
                fy: 64.0,
                cx: 32.0,
                cy: 32.0,
                width: 64,
                height: 64,
            },
            camera_to_world: pose,
        },
        intrinsics_made_for: None,
    }
}

#[test]
fn each_side_keeps_its_colour_and_every_hole_is_filled() {
    let result = backdrop(&[photo(DVec3::X, [200, 0, 0]), photo(-DVec3::X, [0, 0, 200])]);
    assert_eq!(result.color(DVec3::X), [200.0 / 255.0, 0.0, 0.0]);
    assert_eq!(result.color(-DVec3::X), [0.0, 0.0, 200.0 / 255.0]);
    let near = result.color(DVec3::new(1.0, 0.0, 0.7));
    assert!(near[0] > near[2], "just outside the red photo it is red: {near:?}");
    assert!(result.cells().iter().all(|c| c[0] > 0 || c[2] > 0), "no cell is left black");
}

#[test]
fn no_photos_are_black() {
    assert_eq!(backdrop(&[]), Backdrop::default());
}
