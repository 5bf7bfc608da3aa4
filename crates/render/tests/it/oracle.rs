//! The CPU renderer against the f64 oracle: strict inside, flips counted at cliffs.

use segsplat_core::scene::{Gaussians, RawGaussians};
use segsplat_render::{RenderRequest, Renderer, constants, cpu::CpuRenderer, oracle};

use segsplat_testing::{
    compare::{Difference, Sample, Tolerance, compare, oracle_samples, samples},
    scenes::{Random, camera, checked, cloud, look, push, request, two_views},
};

fn cpu() -> CpuRenderer {
    CpuRenderer::new(2).expect("two threads")
}

/// Whole pictures, CPU against oracle.
fn judge(name: &str, gaussians: &Gaussians, request: &RenderRequest) -> Difference {
    let frame = cpu().render(gaussians, request).expect("a picture");
    let truth = oracle::render(gaussians, request).expect("the truth");
    let cliff: Vec<bool> = truth.iter().map(|p| p.cliff.same_order()).collect();
    let found = compare(&samples(&frame), &oracle_samples(&truth), &cliff, Tolerance::ORACLE)
        .unwrap_or_else(|told| panic!("{name}: {told}"));
    let at_cliff = cliff.iter().filter(|&&c| c).count();
    println!(
        "{name}: {} Gaussians, {} px: max {:.2e}, mean {:.2e}, {} flips ({at_cliff} px at a cliff)",
        gaussians.len(),
        found.pixels,
        found.max,
        found.mean,
        found.flips
    );
    found
}

#[test]
fn two_photos_of_256_agree_on_every_pixel() {
    let (gaussians, camera) = two_views(256, 1);
    assert_eq!(gaussians.len(), 131_072, "a Gaussian a pixel of two photos");
    judge("two_views 256", &gaussians, &request(camera));
}

/// Far from the picture's corner f32 knows a Gaussian's place less well than f64 does: whether its
/// alpha passes 1/255 is then no renderer's fault that keeps places in f32.
#[test]
fn a_place_that_f32_rounds_is_a_cliff_for_those_who_keep_it_in_f32() {
    for (column, steady) in [(3, true), (1_203, false)] {
        let mut camera = camera(1_206, 8);
        (camera.intrinsics.fx, camera.intrinsics.fy) = (1e3, 1e3);
        (camera.intrinsics.cx, camera.intrinsics.cy) = (0.0, 0.0);
        // A footprint of 0.55 px, 1.8 px from the pixel: 0.00392 more than 1/255 by 2e-4.
        let x = f64::from(column) + 0.5 + 1.8;
        let mean = [(x / 1e3 * 4.0) as f32, 0.002, 4.0];
        let placed = 1e3 * f64::from(mean[0]) / 4.0;
        let dy = 0.5 - 1e3 * f64::from(mean[1]) / 4.0;
        let d = placed - (f64::from(column) + 0.5);
        let power = (d * d + dy * dy) / (2.0 * f64::from(constants::BLUR_PX2));
        let opacity = (power.exp() / 255.0 * (1.0 + 2e-4)) as f32;
        let mut raw = RawGaussians::default();
        push(&mut raw, mean, [1.0, 0.0, 0.0, 0.0], [1e-7; 3], opacity, &[[0.5; 3]]);
        let at = [[column, 0]];
        let seen = oracle::render_pixels(&checked(raw), &request(camera), &at);
        let cliff = seen.expect("the truth")[0].cliff;
        assert!(!cliff.same_order(), "column {column}: {cliff:?}");
        assert_eq!(cliff.any(), !steady, "column {column}: {cliff:?}");
    }
}

#[test]
fn every_harmonic_degree_agrees() {
    for degree in 0..=3 {
        let gaussians = cloud(3_000, degree, 10 + u64::from(degree));
        judge(&format!("degree {degree}"), &gaussians, &request(camera(160, 120)));
    }
}

#[test]
fn off_centre_principal_points_and_uneven_focal_lengths_agree() {
    let gaussians = cloud(4_000, 1, 21);
    for (fx, fy, cx, cy) in [
        (140.0, 90.0, 20.0, 100.0),
        (60.0, 200.0, 150.0, -10.0),
        (500.0, 480.0, 300.0, 60.0),
        (30.0, 30.0, 80.0, 60.0),
    ] {
        let mut camera = camera(161, 119);
        let lens = &mut camera.intrinsics;
        (lens.fx, lens.fy, lens.cx, lens.cy) = (fx, fy, cx, cy);
        judge(&format!("fx {fx} fy {fy} cx {cx} cy {cy}"), &gaussians, &request(camera));
    }
}

#[test]
fn a_turned_and_moved_camera_agrees() {
    let gaussians = cloud(4_000, 2, 31);
    let mut camera = camera(128, 128);
    camera.camera_to_world = look([1.0, -0.7, 1.5].into(), [-0.5, 0.4, 5.0].into());
    judge("turned", &gaussians, &request(camera));
}

#[test]
fn the_antialiased_mode_agrees_and_differs_from_the_plain_one() {
    let gaussians = cloud(4_000, 0, 41);
    let plain = request(camera(96, 96));
    let smooth = RenderRequest { antialiased: true, ..plain.clone() };
    judge("antialiased", &gaussians, &smooth);
    let pictures = [plain, smooth].map(|r| cpu().render(&gaussians, &r).expect("a picture").color);
    assert_ne!(pictures[0], pictures[1], "antialiased must change the picture");
}

/// Needles, giants, specks, opaque walls and faint fog, at the edges of tiles and picture.
fn extremes() -> Gaussians {
    let mut random = Random(51);
    let mut raw = RawGaussians::default();
    for i in 0..400 {
        let z = random.range(1.0, 6.0);
        let mean = [random.range(-0.7, 0.7) * z, random.range(-0.7, 0.7) * z, z];
        let scale = match i % 5 {
            0 => [random.range(0.5, 60.0), 1e-4, 1e-5],
            1 => [random.range(1.0, 300.0); 3],
            2 => [1e-7; 3],
            3 => [random.range(0.01, 0.1), 1e-12, random.range(0.01, 0.1)],
            _ => [random.range(0.001, 0.05); 3],
        };
        let opacity = match i % 3 {
            0 => 1.0,
            1 => 1.0001 / 255.0,
            _ => random.range(0.02, 0.6),
        };
        let color = [(); 3].map(|()| random.range(-3.0, 3.0));
        push(&mut raw, mean, random.quat(), scale, opacity, &[color]);
    }
    checked(raw)
}

#[test]
fn needles_giants_and_specks_agree() {
    for (width, height) in [(1, 1), (15, 17), (130, 70), (257, 31)] {
        let request = request(camera(width, height));
        let found = judge(&format!("extremes {width}x{height}"), &extremes(), &request);
        assert_eq!(found.pixels as u32, width * height, "every pixel is judged");
    }
}

#[test]
fn a_large_picture_agrees_on_sampled_pixels() {
    let gaussians = cloud(20_000, 1, 61);
    let request = request(camera(2_048, 1_536));
    let mut random = Random(62);
    let pixels: Vec<[u32; 2]> =
        (0..8_192).map(|_| [random.bits() as u32 % 2_048, random.bits() as u32 % 1_536]).collect();
    let truth = oracle::render_pixels(&gaussians, &request, &pixels).expect("the truth");
    let frame = samples(&cpu().render(&gaussians, &request).expect("a picture"));
    let got: Vec<Sample> = pixels.iter().map(|&[x, y]| frame[(y * 2_048 + x) as usize]).collect();
    let cliff: Vec<bool> = truth.iter().map(|p| p.cliff.same_order()).collect();
    let found = compare(&got, &oracle_samples(&truth), &cliff, Tolerance::ORACLE)
        .unwrap_or_else(|told| panic!("2048x1536: {told}"));
    println!("2048x1536, 8,192 px: max {:.2e}, {} flips", found.max, found.flips);
}

#[test]
fn coordinates_far_from_zero_agree_with_the_scene_at_zero() {
    let near = cloud(2_000, 1, 71);
    let far_off = glam::DVec3::new(1e7, -2e7, 3e7);
    let mut raw = near.clone().into_raw();
    raw.origin += far_off;
    let far = checked(raw);
    let here = request(camera(96, 64));
    let mut there = here.clone();
    let mut pose = here.camera.camera_to_world.to_row_major();
    for axis in 0..3 {
        pose[4 * axis + 3] += far_off[axis];
    }
    there.camera.camera_to_world =
        segsplat_core::scene::CameraToWorld::from_row_major(&pose, "far").expect("a pose");
    judge("far", &far, &there);
    let a = cpu().render(&near, &here).expect("a picture");
    let b = cpu().render(&far, &there).expect("a picture");
    let none = vec![false; 96 * 64];
    compare(&samples(&b), &samples(&a), &none, Tolerance::ORACLE).expect("the same picture");
}

#[test]
fn a_wrong_renderer_is_caught() {
    let (gaussians, camera) = two_views(64, 3);
    let right = request(camera);
    let mut wrong = right.clone();
    wrong.camera.intrinsics.cx += 0.01;
    let frame = cpu().render(&gaussians, &wrong).expect("a picture");
    let truth = oracle::render(&gaussians, &right).expect("the truth");
    let cliff: Vec<bool> = truth.iter().map(|p| p.cliff.any()).collect();
    compare(&samples(&frame), &oracle_samples(&truth), &cliff, Tolerance::ORACLE)
        .expect_err("a hundredth of a pixel must show");
}
