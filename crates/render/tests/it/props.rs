//! Properties of the CPU renderer that hold for any scene.

use glam::{DAffine3, DQuat, DVec3};
use proptest::prelude::*;
use segsplat_core::scene::{CameraToWorld, Gaussians, RawGaussians};
use segsplat_render::{Frame, Kinds, RenderRequest, Renderer, Switches, cpu::CpuRenderer, oracle};

use segsplat_testing::{
    compare::{Tolerance, compare, samples},
    scenes::{BACKGROUND, Random, camera, checked, cloud, push, request, two_views},
};

const WIDTH: u32 = 49;
const HEIGHT: u32 = 37;

fn draw(gaussians: &Gaussians, request: &RenderRequest) -> Frame {
    CpuRenderer::new(2).expect("two threads").render(gaussians, request).expect("a picture")
}

/// Equal but for rounding: pixels flip only where the oracle finds a cliff in the wanted picture.
fn assert_alike(got: &Frame, gaussians: &Gaussians, request: &RenderRequest) {
    let truth = oracle::render(gaussians, request).expect("the truth");
    let cliff: Vec<bool> = truth.iter().map(|pixel| pixel.cliff.any()).collect();
    let want = draw(gaussians, request);
    let tolerance = Tolerance { interior: 2e-4, flips: 2e-3, mean: 2e-5 };
    compare(&samples(got), &samples(&want), &cliff, tolerance).expect("alike");
}

/// Appends Gaussian `i` of `from` to `to`.
fn copy(from: &Gaussians, i: usize, to: &mut RawGaussians) {
    let k = from.sh_count();
    push(
        to,
        from.means()[i],
        from.quats()[i],
        from.scales()[i],
        from.opacities()[i],
        &from.sh()[i * k..(i + 1) * k],
    );
}

fn like(gaussians: &Gaussians) -> RawGaussians {
    RawGaussians {
        origin: gaussians.origin(),
        sh_degree: gaussians.sh_degree(),
        ..RawGaussians::default()
    }
}

/// Checked once more: checking normalises quaternions, which moves their last bit.
fn again(gaussians: &Gaussians) -> Gaussians {
    checked(gaussians.clone().into_raw())
}

/// Whether two scenes give the same picture, to the last bit.
fn same_bits(a: &Gaussians, b: &Gaussians) -> bool {
    let request = request(camera(WIDTH, HEIGHT));
    draw(a, &request) == draw(b, &request)
}

/// A case draws two pictures; a failure prints its seed, so no file is kept.
fn few_cases() -> ProptestConfig {
    ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(few_cases())]

    /// Moving scene and camera together changes nothing. Harmonics of degree 0: higher ones would
    /// have to be turned too.
    #[test]
    fn a_rigid_motion_of_scene_and_camera_changes_nothing(
        seed in 0_u64..1000,
        turn in prop::array::uniform3(-3.0_f64..3.0),
        shift in prop::array::uniform3(-50.0_f64..50.0),
    ) {
        let gaussians = cloud(300, 0, seed);
        let before = request(camera(WIDTH, HEIGHT));
        let rotation = DQuat::from_scaled_axis(turn.into());
        let motion = DAffine3::from_rotation_translation(rotation, shift.into());
        let mut moved = like(&gaussians);
        moved.origin = motion.transform_point3(gaussians.origin());
        for i in 0..gaussians.len() {
            copy(&gaussians, i, &mut moved);
            let mean = rotation * DVec3::from(gaussians.means()[i].map(f64::from));
            moved.means[i] = mean.as_vec3().into();
            let [w, x, y, z] = gaussians.quats()[i].map(f64::from);
            let q = rotation * DQuat::from_xyzw(x, y, z, w);
            moved.quats[i] = [q.w, q.x, q.y, q.z].map(|v| v as f32);
        }
        let mut after = before.clone();
        let pose = glam::DMat4::from(motion) * before.camera.camera_to_world.matrix();
        after.camera.camera_to_world =
            CameraToWorld::from_row_major(&pose.transpose().to_cols_array(), "moved").unwrap();
        assert_alike(&draw(&checked(moved), &after), &gaussians, &before);
    }

    /// The order in which Gaussians are stored does not show (depths of a cloud are distinct).
    #[test]
    fn a_permutation_changes_nothing(seed in 0_u64..1000) {
        let gaussians = cloud(300, 2, seed);
        let mut random = Random(seed + 1);
        let mut order: Vec<usize> = (0..gaussians.len()).collect();
        order.sort_by_cached_key(|_| random.bits());
        let mut shuffled = like(&gaussians);
        for i in order {
            copy(&gaussians, i, &mut shuffled);
        }
        prop_assert!(same_bits(&checked(shuffled), &again(&gaussians)), "the order shows");
    }

    /// What can never be seen changes no bit: opacity 0, behind the camera, in front of near.
    #[test]
    fn unseen_gaussians_change_nothing(seed in 0_u64..1000) {
        let gaussians = cloud(200, 1, seed);
        let mut more = gaussians.clone().into_raw();
        let mut random = Random(seed + 2);
        for i in 0..60 {
            let z = match i % 3 {
                0 => random.range(1.0, 5.0),
                1 => -random.range(0.2, 5.0),
                _ => 0.04,
            };
            let opacity = if i % 3 == 0 { 0.0 } else { 0.9 };
            let origin = gaussians.origin().as_vec3();
            let mean = [-origin.x, -origin.y, z - origin.z];
            let scale = [random.range(0.01, 2.0); 3];
            push(&mut more, mean, random.quat(), scale, opacity, &[[0.7; 3]; 4]);
        }
        let (more, report) = Gaussians::sanitize(more).unwrap();
        prop_assert_eq!(report.transparent, 20, "opacity 0 is dropped and counted");
        prop_assert!(same_bits(&more, &again(&gaussians)), "what is unseen shows");
    }

    /// Alpha is in 0..=1, colours are finite, and depth lies between the nearest and the farthest.
    #[test]
    fn pictures_stay_in_range(seed in 0_u64..1000, antialiased in any::<bool>()) {
        let gaussians = cloud(300, 3, seed);
        let request = RenderRequest { antialiased, ..request(camera(WIDTH, HEIGHT)) };
        let frame = draw(&gaussians, &request);
        for sample in samples(&frame) {
            prop_assert!((0.0..=1.0).contains(&sample.alpha), "alpha {}", sample.alpha);
            prop_assert!(sample.color.iter().all(|v| v.is_finite() && *v >= -1e-6));
            prop_assert_eq!(sample.depth == 0.0, sample.alpha == 0.0, "depth without alpha");
            prop_assert!(sample.depth == 0.0 || (0.2..10.0).contains(&sample.depth));
        }
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let (pair, camera_of_pair) = two_views(128, 9);
    let cloud = cloud(5_000, 3, 8);
    for (gaussians, camera) in [(&pair, camera_of_pair), (&cloud, camera(301, 203))] {
        let request = request(camera);
        let render = |threads| {
            let cpu = CpuRenderer::new(threads).expect("threads");
            // Twice: the second frame meets the scratch of the first.
            cpu.render(gaussians, &request).expect("a picture");
            cpu.render(gaussians, &request).expect("a picture")
        };
        let one = render(1);
        for threads in [2, 3, 8] {
            assert!(render(threads) == one, "{threads} threads differ from one");
        }
    }
}

#[test]
fn scratch_of_a_larger_frame_does_not_show() {
    let cpu = CpuRenderer::new(2).expect("two threads");
    let small = (cloud(50, 0, 1), request(camera(40, 30)));
    let fresh = cpu.render(&small.0, &small.1).expect("a picture");
    cpu.render(&cloud(4_000, 0, 2), &request(camera(200, 200))).expect("a picture");
    let again = cpu.render(&small.0, &small.1).expect("a picture");
    assert_eq!(again, fresh, "a frame depends on the one before it");
}

#[test]
fn bands_of_a_small_budget_draw_the_same_picture() {
    let gaussians = cloud(3_000, 1, 5);
    let request = request(camera(130, 150));
    let whole = draw(&gaussians, &request);
    let with = |isects_max| {
        let switches = Switches { isects_max: Some(isects_max), ..Switches::default() };
        CpuRenderer::with_switches(2, &switches).expect("two threads")
    };
    let cpu = with(whole.stats.intersections as u32 / 3);
    let banded = cpu.render(&gaussians, &request).expect("a picture in bands");
    assert_eq!(banded, whole, "bands show");

    let error = with(10).render(&gaussians, &request).expect_err("a row of tiles over the budget");
    assert_eq!(error.code(), segsplat_core::error::ErrorCode::LimitExceeded, "{error}");
}

#[test]
fn an_empty_scene_is_a_clean_background() {
    let request = request(camera(33, 18));
    let frame = draw(&checked(RawGaussians::default()), &request);
    assert_eq!(frame.color, Some(vec![BACKGROUND; 33 * 18]), "background");
    assert_eq!(frame.depth, Some(vec![0.0; 33 * 18]), "depth");
    assert_eq!(frame.alpha, Some(vec![0.0; 33 * 18]), "alpha");
    assert_eq!(frame.stats, Default::default(), "counts");
}

#[test]
fn only_the_kinds_asked_for_are_made_and_they_are_the_same() {
    let gaussians = cloud(300, 0, 4);
    let all = request(camera(WIDTH, HEIGHT));
    let full = draw(&gaussians, &all);
    for bits in 0..8 {
        let kinds = Kinds { color: bits & 1 > 0, depth: bits & 2 > 0, alpha: bits & 4 > 0 };
        let frame = draw(&gaussians, &RenderRequest { kinds, ..all.clone() });
        assert_eq!(frame.color, full.color.clone().filter(|_| kinds.color), "{kinds:?}");
        assert_eq!(frame.depth, full.depth.clone().filter(|_| kinds.depth), "{kinds:?}");
        assert_eq!(frame.alpha, full.alpha.clone().filter(|_| kinds.alpha), "{kinds:?}");
    }
}

/// One Gaussian, tilted: its long axis runs from upper left to lower right (+y is down).
#[test]
fn a_tilted_gaussian_is_not_mirrored() {
    let mut raw = RawGaussians::default();
    let eighth = std::f32::consts::FRAC_PI_8;
    let quat = [eighth.cos(), 0.0, 0.0, eighth.sin()];
    push(&mut raw, [0.0, 0.0, 4.0], quat, [0.6, 0.06, 0.06], 0.9, &[[1.0; 3]]);
    let frame = draw(&checked(raw), &request(camera(64, 64)));
    let alpha = frame.alpha.expect("alpha");
    let at = |x: usize, y: usize| alpha[y * 64 + x];
    assert!(at(26, 26) > 0.5 && at(37, 37) > 0.5, "upper left and lower right are covered");
    assert!(at(37, 26) < 0.01 && at(26, 37) < 0.01, "the other diagonal is not");
    assert!((at(31, 31) - at(32, 32)).abs() < 1e-6, "centred between the four middle pixels");
}

/// The centre of a Gaussian projects where the intrinsics say, pixel centres at +0.5.
#[test]
fn a_gaussian_lands_on_the_pixel_of_its_projection() {
    let mut camera = camera(64, 48);
    camera.intrinsics.cx = 20.5;
    camera.intrinsics.cy = 30.5;
    let mut raw = RawGaussians::default();
    push(&mut raw, [0.0, 0.0, 2.0], [1.0, 0.0, 0.0, 0.0], [1e-4; 3], 0.9, &[[1.0; 3]]);
    let alpha = draw(&checked(raw), &request(camera)).alpha.expect("alpha");
    let brightest = (0..alpha.len()).max_by(|&a, &b| alpha[a].total_cmp(&alpha[b]));
    assert_eq!(brightest, Some(30 * 64 + 20), "pixel (20, 30)");
    let symmetric = (alpha[30 * 64 + 19] - alpha[30 * 64 + 21]).abs();
    assert!(symmetric < 1e-6, "its neighbours are equal");
}

/// A large Gaussian whose centre lies outside the picture still covers its border.
#[test]
fn a_gaussian_centred_outside_still_covers_the_border() {
    let mut raw = RawGaussians::default();
    push(&mut raw, [-2.0, 0.0, 3.0], [1.0, 0.0, 0.0, 0.0], [0.5; 3], 0.9, &[[1.0; 3]]);
    let frame = draw(&checked(raw), &request(camera(64, 64)));
    assert!(frame.alpha.expect("alpha")[32 * 64] > 0.05, "the left border is covered");
}
