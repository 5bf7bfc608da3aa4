//! Cameras that are a little wrong.

use glam::{DMat3, DVec3};
use segsplat_cameras::{PairMatches, PhotoKeypoints, mend};
use segsplat_core::scene::{Camera, CameraToWorld};

use crate::generated::{Plan, arc, cameras, photos, room};

fn plan(wrong: f64) -> Plan {
    let (points, cameras) = (room(600, 2.0, 5), arc(9, 70.0, 3.0));
    Plan { points, cameras, focal: 520.0, k1: 0.0, noise: 0.5, wrong, seed: 7 }
}

fn mended(cameras: &[Camera], plan: &Plan) -> Option<Vec<CameraToWorld>> {
    let (photos, matches): (Vec<PhotoKeypoints>, Vec<PairMatches>) = photos(plan);
    mend(cameras, &photos, &matches).expect("matches of these photos")
}

/// Largest angle between what two cameras are apart and what they should be, degrees, and largest
/// error of the centres' distances, world units.
fn off(poses: &[CameraToWorld], plan: &Plan) -> (f64, f64) {
    let right: Vec<Camera> = cameras(plan, 0.0, 0.0);
    let right: Vec<CameraToWorld> = right.iter().map(|camera| camera.camera_to_world).collect();
    let between = |of: &[CameraToWorld], i: usize, j: usize| {
        let turn = of[i].rotation().transpose() * of[j].rotation();
        (CameraToWorld::from_rotation(turn, DVec3::ZERO), of[i].center().distance(of[j].center()))
    };
    let mut most = (0.0_f64, 0.0_f64);
    for i in 0..poses.len() {
        for j in 0..i {
            let ((a, far), (b, truly)) = (between(poses, i, j), between(&right, i, j));
            most = (most.0.max(a.turn_to(&b).to_degrees()), most.1.max((far - truly).abs()));
        }
    }
    most
}

#[test]
fn cameras_that_are_a_little_wrong_are_mended() {
    for wrong in [0.0, 0.3] {
        let plan = plan(wrong);
        let given = cameras(&plan, 0.7, 0.03);
        let poses: Vec<CameraToWorld> = given.iter().map(|it| it.camera_to_world).collect();
        let (before, after) = (off(&poses, &plan), off(&mended(&given, &plan).unwrap(), &plan));
        println!("{wrong} wrong: {before:?} before, {after:?} after");
        assert!(before.0 > 0.8 && before.1 > 0.03, "{before:?}");
        assert!(after.0 < 0.2 * before.0 && after.1 < 0.5 * before.1, "{after:?}");
    }
    // All together stay where they were given.
    let plan = plan(0.0);
    let given = cameras(&plan, 0.7, 0.03);
    let now = mended(&given, &plan).unwrap();
    let ways = now.iter().zip(&given).map(|(a, b)| a.center() - b.camera_to_world.center());
    assert!(ways.sum::<DVec3>().length() < 1e-6);
}

#[test]
fn a_camera_that_keypoints_do_not_hold_stays() {
    let plan = plan(0.0);
    let mut given = cameras(&plan, 0.5, 0.02);
    // It looks elsewhere: no match is near its line.
    let turn = DMat3::from_rotation_y(0.6);
    let pose = &mut given[4].camera_to_world;
    *pose = CameraToWorld::from_rotation(pose.rotation() * turn, pose.center());
    let now = mended(&given, &plan).unwrap();
    assert!(now[4].turn_to(&given[4].camera_to_world) < 1e-9);
    assert!(now[3].turn_to(&given[3].camera_to_world) > 1e-3, "the others move");
}

#[test]
fn few_matches_tell_nothing_and_those_of_other_photos_are_refused() {
    let plan = plan(0.0);
    let given = cameras(&plan, 0.5, 0.02);
    let (photos, matches) = photos(&plan);
    let few = |of: &PairMatches| PairMatches { pairs: of.pairs[..3].to_vec(), ..of.clone() };
    let few: Vec<PairMatches> = matches.iter().filter(|of| of.pairs.len() > 3).map(few).collect();
    assert!(mend(&given, &photos, &few).unwrap().is_none());
    assert!(mend(&given[1..], &photos, &matches).is_err());
}
