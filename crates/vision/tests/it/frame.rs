//! The model frame.

use glam::{DMat4, DVec3};
use segsplat_core::scene::CameraToWorld;
use segsplat_vision::models::{ModelFrame, Translation};

fn cameras() -> Vec<CameraToWorld> {
    [DVec3::new(1e5, 2.0, 3.0), DVec3::new(1e5 + 2.0, 2.5, 3.0), DVec3::new(1e5, -1.0, 3.3)]
        .iter()
        .map(|&eye| {
            let target = DVec3::new(1e5, 1.0, 9.0);
            CameraToWorld::look_at(eye, target, DVec3::NEG_Y, "test").unwrap()
        })
        .collect()
}

#[test]
fn the_first_camera_is_the_identity_and_the_largest_baseline_one() {
    let cameras = cameras();
    let frame = ModelFrame::new(&cameras, Translation::LargestBaseline, 2.0, 6.0).unwrap();
    let model: Vec<DMat4> = cameras.iter().map(|c| frame.camera(c)).collect();
    assert!(model[0].abs_diff_eq(DMat4::IDENTITY, 1e-9), "{:?}", model[0]);
    let center = |m: &DMat4| m.w_axis.truncate();
    let far = center(&model[1]).distance(center(&model[2]));
    assert!((far - 1.0).abs() < 1e-9, "largest baseline {far}");
}

#[test]
fn measured_depths_say_the_unit() {
    let cameras = cameras();
    let unit = |rule| ModelFrame::new(&cameras, rule, 2.0, 6.0).unwrap().unit();
    assert!((unit(Translation::Near(0.5)) - 4.0).abs() < 1e-12, "2 world units are half a unit");
    assert!((unit(Translation::MedianDepth(3.0)) - 2.0).abs() < 1e-12, "6 world units are 3");
    assert!((unit(Translation::World) - 1.0).abs() < 1e-12, "none");
}

#[test]
fn model_points_come_back_to_the_world() {
    let cameras = cameras();
    let frame = ModelFrame::new(&cameras, Translation::LargestBaseline, 2.0, 6.0).unwrap();
    let world = DVec3::new(1e5 + 0.3, 1.2, 7.0);
    for camera in &cameras {
        let seen = camera.viewmat().transform_point3(world);
        let in_model = frame.camera(camera).transform_point3(seen / frame.unit());
        let back = frame.pose().matrix().transform_point3(in_model * frame.unit());
        assert!(back.distance(world) < 1e-6, "{back} is not {world}");
    }
}

#[test]
fn cameras_at_one_place_are_refused() {
    let one = cameras()[0];
    assert!(
        ModelFrame::new(&[one, one], Translation::LargestBaseline, 2.0, 6.0).is_err(),
        "no baseline"
    );
    assert!(
        ModelFrame::new(&[one, one], Translation::World, 2.0, 6.0).is_ok(),
        "world units need none"
    );
}
