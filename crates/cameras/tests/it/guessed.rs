//! Cameras that begin with what a network says of the photos.

use std::sync::atomic::AtomicBool;

use glam::{DMat3, DVec3};
use segsplat_cameras::{
    CONFIDENCE_MIN, PairMatches, PhotoKeypoints, Placing, Solution, SolveOptions, solve,
};
use segsplat_core::{
    error::ErrorCode,
    scene::{Camera, CameraToWorld},
};

use crate::generated::{Draw, Plan, SIZE, arc, cameras, cloud, off, photos};

fn solved(photos: &[PhotoKeypoints], pairs: &[PairMatches]) -> Solution {
    let never = AtomicBool::new(false);
    solve(photos, pairs, &[], &SolveOptions::default(), &never, &|_| ()).expect("an answer")
}

fn plan() -> Plan {
    Plan {
        points: cloud(600, 1.0, 11),
        cameras: arc(8, 90.0, 4.0),
        focal: 560.0,
        k1: 0.0,
        noise: 0.5,
        wrong: 0.2,
        seed: 5,
    }
}

/// Gives the photos these guesses, in a world of their own: turned, moved, of another scale and of
/// another focal length.
fn guess(photos: &mut [PhotoKeypoints], cameras: &[Camera], focal: f64) {
    let turn = DMat3::from_rotation_x(0.7) * DMat3::from_rotation_y(-1.9);
    for (photo, camera) in photos.iter_mut().zip(cameras) {
        let pose = camera.camera_to_world;
        let center = turn * pose.center() * 0.21 + DVec3::new(4.0, -9.0, 2.0);
        let mut camera = *camera;
        camera.camera_to_world = CameraToWorld::from_rotation(turn * pose.rotation(), center);
        camera.intrinsics.fx *= focal;
        camera.intrinsics.fy *= focal;
        photo.guess = Some(camera);
    }
}

/// The largest turn between the cameras of two solutions from camera to camera, degrees.
fn apart(a: &Solution, b: &Solution) -> f64 {
    let cameras = |of: &Solution| -> Vec<DMat3> {
        let placed = of.photos.iter().filter_map(|placing| match placing {
            Placing::Placed(placed) => Some(placed.camera.camera_to_world.rotation()),
            Placing::LeftOut(_) => None,
        });
        placed.collect()
    };
    let (a, b) = (cameras(a), cameras(b));
    assert_eq!(a.len(), b.len(), "photos with a camera");
    let turn = |i: usize| {
        let off = (a[0].transpose() * a[i]) * (b[0].transpose() * b[i]).transpose();
        let trace = off.x_axis.x + off.y_axis.y + off.z_axis.z;
        ((trace - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees()
    };
    (0..a.len()).map(turn).fold(0.0, f64::max)
}

#[test]
fn guesses_that_are_wrong_are_ignored() {
    let plan = plan();
    let (mut photos, pairs) = photos(&plan);
    let without = solved(&photos, &pairs);
    let truth = cameras(&plan, 0.0, 0.0);
    let others: Vec<Camera> = (0..8).map(|i| truth[i * 3 % 8]).collect();
    let one_place = vec![truth[0]; 8];
    for (name, wrong) in [
        ("turned by 40 degrees", cameras(&plan, 40.0, 1.0)),
        ("those of other photos", others),
        ("one place", one_place),
    ] {
        guess(&mut photos, &wrong, 0.6);
        let with = solved(&photos, &pairs);
        assert!(apart(&without, &with) < 0.1, "{name}: {} degrees", apart(&without, &with));
        assert!(off(&with, &plan).degrees < 0.5, "{name}");
        assert!((with.confidence - without.confidence).abs() < 0.02, "{name}: {}", with.confidence);
    }
}

#[test]
fn guesses_that_no_matches_confirm_are_refused() {
    let plan = plan();
    let (mut photos, mut pairs) = photos(&plan);
    guess(&mut photos, &cameras(&plan, 0.0, 0.0), 1.0);
    let mut draw = Draw(7);
    for pair in pairs.iter_mut().flat_map(|pair| &mut pair.pairs) {
        pair[1] = draw.between(0.0, 100.0) as u32;
    }
    for pair in &mut pairs {
        let mut seen = std::collections::HashSet::new();
        pair.pairs.retain(|[_, second]| seen.insert(*second));
    }
    let solution = solved(&photos, &pairs);
    assert!(solution.confidence < CONFIDENCE_MIN, "{:?}", solution.evidence);
}

#[test]
fn a_photo_of_another_place_is_left_out_whatever_is_guessed_of_it() {
    let plan = plan();
    let (mut photos, mut pairs) = photos(&plan);
    guess(&mut photos, &cameras(&plan, 1.0, 0.05), 1.02);
    let mut draw = Draw(99);
    let [width, height] = SIZE.map(f64::from);
    let place = |_| [draw.between(0.0, width) as f32, draw.between(0.0, height) as f32];
    photos[3].keypoints = (0..600).map(place).collect();
    for pair in pairs.iter_mut().filter(|pair| pair.photos.contains(&3)) {
        pair.pairs.truncate(150);
        for (k, ends) in pair.pairs.iter_mut().enumerate() {
            ends[usize::from(pair.photos[1] == 3)] = k as u32;
        }
    }
    let solution = solved(&photos, &pairs);
    let off = off(&solution, &plan);
    assert_eq!(off.placed, 7);
    assert!(off.degrees < 0.5, "{} degrees", off.degrees);
    assert!(matches!(&solution.photos[3], Placing::LeftOut(why) if !why.is_empty()));
}

#[test]
fn a_guess_that_is_no_lens_is_refused_by_name() {
    let plan = plan();
    let (mut photos, pairs) = photos(&plan);
    guess(&mut photos, &cameras(&plan, 0.0, 0.0), -1.0);
    let never = AtomicBool::new(false);
    let options = SolveOptions::default();
    let error = solve(&photos, &pairs, &[], &options, &never, &|_| ()).expect_err("no lens");
    assert_eq!(error.code(), ErrorCode::InvalidRequest);
    assert!(error.message().contains("photo 0: guess: fx is -560"), "{error}");
}
