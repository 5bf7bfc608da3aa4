//! Poisoned Gaussians, seeded: dropped or clamped with counts, never a NaN pixel, never a panic.
//!
//! `FUZZ_SEED`, `FUZZ_SCENES` and `FUZZ_GAUSSIANS` choose others than the default.

use segsplat_core::{
    error::ErrorCode,
    scene::{Gaussians, RawGaussians},
};
use segsplat_render::{
    Background, Frame, Labels, Layer, RenderRequest, Renderer, Source, cpu::CpuRenderer,
};

use crate::common::gpu;
use segsplat_testing::scenes::{Random, camera, checked, cloud, push, request};

/// Numbers that broke renderers before.
const POISON: [f32; 24] = [
    f32::NAN,
    f32::INFINITY,
    f32::NEG_INFINITY,
    f32::MAX,
    f32::MIN_POSITIVE,
    1e-45,
    0.0,
    -0.0,
    -1.0,
    1.0,
    1.0 / 255.0,
    0.999,
    1.0 + f32::EPSILON,
    16.0,
    15.999_999,
    0.01,
    1e-30,
    1e-12,
    1e9,
    1e7,
    -1e7,
    1e30,
    -1e30,
    1e38,
];

pub(crate) fn environment(name: &str, default: u64) -> u64 {
    std::env::var(name).ok().and_then(|v| v.parse().ok()).unwrap_or(default)
}

fn assert_clean(frame: &Frame, what: &str) {
    let color = frame.color.iter().flatten().flatten();
    let numbers = color.chain(frame.depth.iter().flatten()).chain(frame.alpha.iter().flatten());
    for value in numbers {
        assert!(value.is_finite(), "{what}: a pixel holds {value}");
    }
}

/// One number in five is poison.
pub(crate) fn poisoned(random: &mut Random, count: u64, sh_degree: u8) -> RawGaussians {
    let mut raw = RawGaussians { sh_degree, ..RawGaussians::default() };
    for _ in 0..count {
        let mut number = |low: f32, high: f32| match random.bits() % 5 {
            0 => POISON[random.bits() as usize % POISON.len()],
            _ => random.range(low, high),
        };
        let mean = [number(-2.0, 2.0), number(-2.0, 2.0), number(0.1, 6.0)];
        let quat = [(); 4].map(|()| number(-1.0, 1.0));
        let scale = [(); 3].map(|()| number(0.001, 0.5));
        let opacity = number(0.0, 1.0);
        let sh: Vec<[f32; 3]> = (0..(usize::from(sh_degree) + 1).pow(2))
            .map(|_| [(); 3].map(|()| random.range(-1.0, 1.0)))
            .collect();
        push(&mut raw, mean, quat, scale, opacity, &sh);
    }
    raw
}

/// Draws `FUZZ_SCENES` scenes of fewer than `FUZZ_GAUSSIANS` Gaussians each, from odd cameras.
fn fuzz(renderer: &dyn Renderer, iterations: u64) {
    let seed = environment("FUZZ_SEED", 20);
    let most = environment("FUZZ_GAUSSIANS", 40);
    let (mut fuzzed, mut drawn) = (0, 0);
    for iteration in 0..environment("FUZZ_SCENES", iterations) {
        let what = format!("FUZZ_SEED={seed} FUZZ_GAUSSIANS={most} iteration {iteration}");
        let mut random = Random(seed.wrapping_mul(1_000_003) + iteration);
        let sh_degree = (random.bits() % 4) as u8;
        let count = random.bits() % most;
        let raw = poisoned(&mut random, count, sh_degree);
        let (gaussians, report) = Gaussians::sanitize(raw).expect(&what);
        let dropped = report.not_finite
            + report.too_far
            + report.transparent
            + report.zero_quat
            + report.zero_scale;
        assert_eq!(gaussians.len() as u64 + dropped, count, "{what}: dropped without a count");
        let mut camera = camera(1 + random.bits() as u32 % 50, 1 + random.bits() as u32 % 50);
        if iteration % 3 == 0 {
            camera.intrinsics.fx = f64::from(random.range(0.01, 9.0)).exp();
            camera.intrinsics.cx = f64::from(random.range(-1e4, 1e4));
        }
        let near = [1e-30, 0.01, 1.0, 1e30][random.bits() as usize % 4];
        let antialiased = random.bits().is_multiple_of(2);
        let error = [0.0, 2.0][random.bits() as usize % 2];
        let request = RenderRequest { near, antialiased, error, ..request(camera) };
        let frame = renderer.render(&gaussians, &request).expect(&what);
        assert_clean(&frame, &what);
        fuzzed += count;
        drawn += frame.stats.visible;
    }
    println!("{fuzzed} Gaussians, {drawn} of them seen, by {}", renderer.name());
    assert!(drawn > 0, "nothing was seen");
}

#[test]
fn poisoned_gaussians_never_make_a_bad_pixel() {
    fuzz(&CpuRenderer::new(2).expect("two threads"), 300);
}

#[test]
fn poisoned_gaussians_never_make_a_bad_pixel_on_the_gpu() {
    let Some(gpu) = gpu() else { return };
    fuzz(gpu, 60);
}

#[test]
fn each_poison_in_each_place_is_counted_and_harmless() {
    let cpu = CpuRenderer::new(1).expect("a thread");
    let request = request(camera(40, 40));
    for poison in POISON {
        for place in 0..14 {
            let mut numbers =
                [0.1, 0.1, 2.0, 0.9, 0.1, 0.2, 0.1, 0.1, 0.1, 0.1, 0.5, 0.1, 0.1, 0.1];
            numbers[place] = poison;
            let [x, y, z, qw, qx, qy, qz, sx, sy, sz, opacity, r, g, b] = numbers;
            let mut raw = RawGaussians::default();
            let good = [1.0, 0.0, 0.0, 0.0];
            push(&mut raw, [0.0, 0.0, 3.0], good, [0.1; 3], 0.5, &[[0.2; 3]]);
            push(&mut raw, [x, y, z], [qw, qx, qy, qz], [sx, sy, sz], opacity, &[[r, g, b]]);
            let what = format!("{poison:e} at place {place}");
            let (gaussians, report) = Gaussians::sanitize(raw).expect(&what);
            let counted: u64 = report.counts().iter().map(|(_, count)| count).sum();
            assert!(gaussians.len() == 2 || counted > 0, "{what}: dropped without a count");
            assert_clean(&cpu.render(&gaussians, &request).expect(&what), &what);
        }
    }
}

#[test]
fn a_hundred_thousand_gaussians_on_one_pixel_are_drawn() {
    let cpu = CpuRenderer::new(2).expect("two threads");
    for opacity in [1.2 / 255.0, 0.9] {
        let mut raw = RawGaussians::default();
        for _ in 0..100_000 {
            push(&mut raw, [0.0, 0.0, 3.0], [1.0, 0.0, 0.0, 0.0], [1e-4; 3], opacity, &[[1.0; 3]]);
        }
        let frame = cpu.render(&checked(raw), &request(camera(17, 17))).expect("a picture");
        assert_clean(&frame, "one pixel");
        let alpha = frame.alpha.expect("alpha")[8 * 17 + 8];
        assert!(alpha > 0.98 && alpha <= 1.0, "alpha {alpha} at opacity {opacity}");
    }
}

#[test]
fn a_request_that_cannot_be_drawn_is_refused_by_name() {
    let cpu = CpuRenderer::new(1).expect("a thread");
    let gaussians = cloud(10, 0, 1);
    let good = request(camera(20, 20));
    let with = |change: &dyn Fn(&mut RenderRequest)| {
        let mut request = good.clone();
        change(&mut request);
        cpu.render(&gaussians, &request).expect_err("a request that cannot be drawn")
    };
    let invalid = [
        (with(&|r| r.near = 0.0), "near"),
        (with(&|r| r.near = f32::NAN), "near"),
        (with(&|r| r.near = -1.0), "near"),
        (with(&|r| r.camera.intrinsics.width = 0), "0x20"),
        (with(&|r| r.camera.intrinsics.fx = 0.0), "fx"),
        (with(&|r| r.camera.intrinsics.cy = f64::NAN), "cy"),
        (with(&|r| r.background = Background::Color([0.0, f32::INFINITY, 0.0])), "background"),
        (
            with(&|r| {
                let (center, axis) = ([0.0, f32::NAN, 0.0], [0.0, 0.0, 1.0]);
                r.sources = [Source { center, axis, scale: 0.0, layer: Layer::Front }].into();
            }),
            "source 0",
        ),
        (with(&|r| r.labels = Labels::Blend([[0.0, f32::NAN, 0.0, 0.0]].into())), "labels"),
    ];
    for (error, named) in invalid {
        assert_eq!(error.code(), ErrorCode::InvalidRequest, "{error}");
        assert!(error.message().contains(named), "{error} does not name {named}");
    }
    let large = with(&|r| {
        (r.camera.intrinsics.width, r.camera.intrinsics.height) = (100_000, 100_000);
    });
    assert_eq!(large.code(), ErrorCode::LimitExceeded, "{large}");
}

#[test]
fn absurd_lenses_give_clean_pictures() {
    let cpu = CpuRenderer::new(1).expect("a thread");
    let gaussians = cloud(200, 1, 2);
    for focal in [1e-300, 1e-9, 1e9, 1e200, 1e308] {
        for center in [-1e300, 0.0, 1e300] {
            let mut camera = camera(20, 20);
            camera.intrinsics.fx = focal;
            camera.intrinsics.cx = center;
            let what = format!("fx {focal:e}, cx {center:e}");
            assert_clean(&cpu.render(&gaussians, &request(camera)).expect(&what), &what);
        }
    }
}
