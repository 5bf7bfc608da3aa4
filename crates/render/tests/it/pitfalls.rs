//! What other rasterisers got wrong, a test each, on the CPU and the GPU renderer alike.
//!
//! Elsewhere: needles, giants, specks and cameras far from zero (`oracle`), principal points and
//! compensation of the blur (`oracle`), centres outside, mirrored splats, the half pixel, thread
//! counts (`props`), zero quaternions and poison (`fuzz`), sums over 32 bits and slots that no
//! kernel wrote (`twins`), no Gaussians (`props`, `twins`).

use std::f32::consts::TAU;

use glam::DVec3;
use segsplat_core::scene::{Gaussians, RawGaussians};
use segsplat_render::{
    Background, Frame, RenderRequest, Renderer, constants::ALPHA_MAX, cpu::CpuRenderer,
};

use crate::common::{gpu, open};
use segsplat_testing::{
    compare::{Sample, Tolerance, compare, samples},
    scenes::{BACKGROUND, camera, checked, cloud, look, push, request},
};

/// No rotation.
const UPRIGHT: [f32; 4] = [1.0, 0.0, 0.0, 0.0];
/// Harmonics of pure colours over black.
const RED: [[f32; 3]; 1] = [[1.772_453_9, -1.772_453_9, -1.772_453_9]];
const BLUE: [[f32; 3]; 1] = [[-1.772_453_9, -1.772_453_9, 1.772_453_9]];

/// Draws on every renderer that there is and gives each picture to `look`.
fn each(gaussians: &Gaussians, request: &RenderRequest, look: impl Fn(&str, &Frame)) {
    let cpu = CpuRenderer::new(2).expect("two threads");
    look("cpu", &cpu.render(gaussians, request).expect("a picture"));
    if let Some(gpu) = gpu() {
        look("gpu", &gpu.render(gaussians, request).expect("a picture"));
    }
}

/// Mean, scales, opacity and harmonics.
type Splat<'a> = ([f32; 3], [f32; 3], f32, &'a [[f32; 3]]);

fn scene(parts: &[Splat<'_>]) -> Gaussians {
    let mut raw = RawGaussians::default();
    for &(mean, scale, opacity, sh) in parts {
        push(&mut raw, mean, UPRIGHT, scale, opacity, sh);
    }
    checked(raw)
}

fn alpha_at(frame: &Frame, x: u32, y: u32) -> f32 {
    frame.alpha.as_ref().expect("alpha")[(y * frame.width + x) as usize]
}

fn color_at(frame: &Frame, x: u32, y: u32) -> [f32; 3] {
    frame.color.as_ref().expect("colour")[(y * frame.width + x) as usize]
}

#[test]
fn axis_aligned_gaussians_with_nothing_off_the_diagonal_are_discs() {
    let round = scene(&[([0.0, 0.0, 4.0], [0.2; 3], 0.8, &RED)]);
    each(&round, &request(camera(65, 65)), |name, frame| {
        let (middle, right, down) =
            (alpha_at(frame, 32, 32), alpha_at(frame, 36, 32), alpha_at(frame, 32, 36));
        assert!((middle - 0.8).abs() < 1e-4, "{name}: {middle} at the centre");
        assert!((right - down).abs() < 1e-5 && right > 0.1, "{name}: {right}, {down} are no disc");
        // Variance in pixels and the blur: exp(-4² / 2 σ²).
        let variance = (0.2 * 65.0 * 0.5 / 30_f32.to_radians().tan() / 4.0).powi(2) + 0.3;
        let want = 0.8 * (-8.0 / variance).exp();
        assert!((right - want).abs() < 1e-4, "{name}: {right}, not {want}");
    });
}

#[test]
fn flat_gaussians_seen_from_the_side_and_the_front_are_drawn() {
    let shapes = [([0.3, 0.3, 0.0], "front"), ([0.0, 0.3, 0.3], "side"), ([0.0; 3], "dot")];
    for (scale, name) in shapes {
        let mut raw = RawGaussians::default();
        push(&mut raw, [0.0, 0.0, 4.0], UPRIGHT, scale, 0.9, &RED);
        let (gaussians, report) = Gaussians::sanitize(raw).expect("arrays of equal length");
        let counted: u64 = report.counts().iter().map(|count| count.1).sum();
        assert!(gaussians.len() == 1 || counted == 1, "{name}: gone without a count");
        each(&gaussians, &request(camera(33, 33)), |renderer, frame| {
            let alpha = alpha_at(frame, 16, 16);
            let want = if gaussians.is_empty() { 0.0 } else { 0.5 };
            assert!(alpha.is_finite() && alpha >= want, "{renderer}, {name}: alpha {alpha}");
        });
    }
}

#[test]
fn quaternions_of_any_length_turn_alike() {
    let turned = |length: f32| {
        let mut raw = RawGaussians::default();
        let quat = [0.8, 0.2, -0.4, 0.4].map(|q: f32| q * length);
        push(&mut raw, [0.1, 0.0, 3.0], quat, [0.5, 0.1, 0.02], 0.9, &RED);
        checked(raw)
    };
    let cpu = CpuRenderer::new(1).expect("a thread");
    let request = request(camera(48, 48));
    let want = cpu.render(&turned(1.0), &request).expect("a picture").alpha.expect("alpha");
    for length in [1e-3, 7.0, 1e6] {
        each(&turned(length), &request, |name, frame| {
            let alpha = frame.alpha.as_ref().expect("alpha");
            for (got, want) in alpha.iter().zip(&want) {
                assert!((got - want).abs() < 1e-4, "{name}: {got}, not {want}, at {length:e}");
            }
        });
    }
}

#[test]
fn nothing_behind_the_camera_shows_however_large() {
    let parts = [
        ([0.0, 0.0, -2.0], [5.0; 3], 1.0, &RED[..]),
        ([0.0, 0.0, -0.01], [50.0, 50.0, 0.001], 1.0, &RED[..]),
        ([3.0, 0.0, -1.0], [9.0, 0.1, 0.1], 1.0, &RED[..]),
    ];
    each(&scene(&parts), &request(camera(40, 40)), |name, frame| {
        assert!(frame.alpha.iter().flatten().all(|&alpha| alpha == 0.0), "{name}: a ghost");
        assert_eq!(frame.stats.visible, 0, "{name}");
    });
}

#[test]
fn a_scene_a_millionth_as_large_is_the_same_picture() {
    let shrink = |by: f32| {
        let mut raw = cloud(400, 0, 71).into_raw();
        raw.origin = DVec3::ZERO;
        raw.means.iter_mut().flatten().for_each(|x| *x *= by);
        raw.scales.iter_mut().flatten().for_each(|x| *x *= by);
        checked(raw)
    };
    let at = |near: f32| RenderRequest { near, ..request(camera(60, 40)) };
    let cpu = CpuRenderer::new(2).expect("two threads");
    let want = samples(&cpu.render(&shrink(1.0), &at(0.05)).expect("a picture"));
    // Powers of two, so that the numbers are the same but for their exponent.
    for by in [2.0_f32.powi(-20), 2.0_f32.powi(12)] {
        each(&shrink(by), &at(0.05 * by), |name, frame| {
            let depth = |sample: Sample| Sample { depth: sample.depth / f64::from(by), ..sample };
            let got: Vec<Sample> = samples(frame).into_iter().map(depth).collect();
            let none = vec![false; want.len()];
            let same = Tolerance { interior: 2e-3, flips: 0.0, mean: 1e-4 };
            compare(&got, &want, &none, same)
                .unwrap_or_else(|told| panic!("{name}, {by:e} as large: {told}"));
        });
    }
}

#[test]
fn the_last_of_many_tiles_is_as_good_as_the_first() {
    // 129 x 129 tiles take two digits of the tile sort.
    let side = 2_064;
    let mut wide = camera(side, side);
    wide.intrinsics.fx = 100.0;
    wide.intrinsics.fy = 100.0;
    let reach = f64::from(side / 2 - 4) / 100.0;
    let corners = [[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [0.0, 0.0]];
    let parts: Vec<_> = corners
        .iter()
        .map(|at| {
            let mean = [(at[0] * reach) as f32, (at[1] * reach) as f32, 1.0];
            (mean, [1e-3; 3], 0.9, &RED[..])
        })
        .collect();
    each(&scene(&parts), &request(wide), |name, frame| {
        for at in corners {
            let middle = f64::from(side / 2);
            let [x, y] = at.map(|side| (middle + side * (middle - 4.0)) as u32);
            let near = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(i, j)| alpha_at(frame, x - i, y - j));
            let best = near.into_iter().fold(0.0, f32::max);
            assert!(best > 0.3, "{name}: {best} at {x}, {y}");
        }
        let seen = frame.alpha.iter().flatten().filter(|&&alpha| alpha > 0.0).count();
        assert!(seen < 5 * 64, "{name}: {seen} pixels");
    });
}

#[test]
fn pixels_that_nobody_touches_hold_nothing_of_the_frame_before() {
    let Some(gpu) = open(|_| {}) else { return };
    let full = request(camera(160, 120));
    gpu.render(&cloud(5_000, 0, 72), &full).expect("a picture");
    let one = scene(&[([0.0, 0.0, 4.0], [0.01; 3], 0.9, &RED)]);
    let frame = gpu.render(&one, &full).expect("a picture");
    let touched = frame.alpha.iter().flatten().filter(|&&alpha| alpha > 0.0).count();
    assert!((1..100).contains(&touched), "{touched} pixels");
    for (i, &alpha) in frame.alpha.iter().flatten().enumerate() {
        let (x, y) = (i as u32 % 160, i as u32 / 160);
        if alpha == 0.0 {
            assert_eq!(color_at(&frame, x, y), BACKGROUND, "pixel {x}, {y}");
            assert_eq!(frame.depth.as_ref().expect("depth")[i], 0.0, "pixel {x}, {y}");
        }
    }
}

#[test]
fn opacities_at_and_under_the_threshold_are_dropped_or_harmless() {
    let least = Gaussians::OPACITY_MIN;
    let parts = [([0.0, 0.0, 4.0], [0.2; 3], least, &RED[..])];
    for antialiased in [false, true] {
        // Tiny and antialiased: the compensation takes it under the threshold.
        let tiny = [([0.0, 0.0, 4.0], [1e-6; 3], 0.02, &RED[..])];
        for parts in [&parts, &tiny] {
            let request = RenderRequest { antialiased, ..request(camera(33, 33)) };
            each(&scene(parts), &request, |name, frame| {
                for &alpha in frame.alpha.iter().flatten() {
                    assert!((0.0..0.03).contains(&alpha), "{name}: alpha {alpha}");
                }
                if antialiased && parts[0].2 > least {
                    assert_eq!(alpha_at(frame, 16, 16), 0.0, "{name}: under the threshold");
                }
            });
        }
    }
    let mut raw = RawGaussians::default();
    push(&mut raw, [0.0, 0.0, 4.0], UPRIGHT, [0.2; 3], least * 0.999, &RED);
    let (gaussians, report) = Gaussians::sanitize(raw).expect("arrays of equal length");
    assert_eq!((gaussians.len(), report.transparent), (0, 1), "dropped with a count");
}

#[test]
fn depths_one_bit_apart_are_told_apart() {
    let (near, far) = (4.0_f32, 4.0_f32.next_up());
    for (first, second) in [(near, far), (far, near)] {
        let parts = [
            ([0.0, 0.0, first], [0.3; 3], 0.99, &RED[..]),
            ([0.0, 0.0, second], [0.3; 3], 0.99, &BLUE[..]),
        ];
        each(&scene(&parts), &request(camera(33, 33)), |name, frame| {
            let [red, _, blue] = color_at(frame, 16, 16);
            assert_eq!(red > blue, first < second, "{name}: red {red}, blue {blue}");
        });
    }
}

#[test]
fn depth_along_the_axis_decides_and_not_the_distance() {
    // Towards the corner: the red one is nearer along z, the blue one nearer to the camera.
    let parts =
        [([3.0, 3.0, 3.0], [0.4; 3], 0.99, &RED[..]), ([2.4, 2.4, 3.2], [0.4; 3], 0.99, &BLUE[..])];
    let mut wide = camera(64, 64);
    wide.intrinsics.fx = 30.0;
    wide.intrinsics.fy = 30.0;
    each(&scene(&parts), &request(wide), |name, frame| {
        let [red, _, blue] = color_at(frame, 59, 59);
        assert!(red > blue + 0.1, "{name}: red {red}, blue {blue}");
    });
}

#[test]
fn the_largest_alpha_is_the_stated_one() {
    let one = scene(&[([0.0, 0.0, 4.0], [0.5; 3], 1.0, &RED)]);
    each(&one, &request(camera(33, 33)), |name, frame| {
        let alpha = alpha_at(frame, 16, 16);
        assert!((alpha - ALPHA_MAX).abs() < 1e-6, "{name}: {alpha}, not {ALPHA_MAX}");
    });
}

#[test]
fn a_giant_covers_as_much_at_any_resolution() {
    let giant = scene(&[([0.5, 0.0, 2.0], [1.5, 0.4, 0.4], 0.9, &RED)]);
    let covered = |frame: &Frame| {
        let seen = frame.alpha.iter().flatten().filter(|&&alpha| alpha > 0.1).count();
        seen as f32 / frame.alpha.iter().flatten().count() as f32
    };
    let cpu = CpuRenderer::new(2).expect("two threads");
    let want = covered(&cpu.render(&giant, &request(camera(900, 900))).expect("a picture"));
    for side in [60, 300] {
        each(&giant, &request(camera(side, side)), |name, frame| {
            let share = covered(frame);
            assert!((share - want).abs() < 0.02, "{name}: {share} of {side} px, {want} of 900");
        });
    }
}

#[test]
fn colours_under_nothing_are_nothing() {
    let dark = scene(&[([0.0, 0.0, 4.0], [0.5; 3], 1.0, &[[-9.0, -9.0, 2.0]])]);
    let black = RenderRequest { background: Background::BLACK, ..request(camera(33, 33)) };
    each(&dark, &black, |name, frame| {
        let [red, green, blue] = color_at(frame, 16, 16);
        assert!(red == 0.0 && green == 0.0 && blue > 0.5, "{name}: {red} {green} {blue}");
    });
}

#[test]
fn splats_off_the_frustum_hardly_fan_into_it() {
    // A long one beside the picture, turned toward the camera: the affine map would smear it over
    // the whole picture were it taken at its own slope. A little of that is left.
    let mut raw = RawGaussians::default();
    let half = TAU / 16.0;
    let turn = [half.cos(), 0.0, half.sin(), 0.0];
    push(&mut raw, [6.0, 0.0, 1.0], turn, [2.0, 0.02, 0.02], 1.0, &RED);
    each(&checked(raw), &request(camera(64, 64)), |name, frame| {
        let left = (0..64).flat_map(|y| (0..32).map(move |x| (x, y)));
        let worst = left.map(|(x, y)| alpha_at(frame, x, y)).fold(0.0, f32::max);
        assert!(worst < 0.1, "{name}: {worst} on the far side");
    });
}

#[test]
fn poison_that_was_let_in_makes_no_bad_pixel_on_the_gpu() {
    let Some(gpu) = gpu() else { return };
    let values = [1e-30, 1e-12, 1.0 / 255.0, 0.999, 15.999_999, 1e7, -1e7, 1e9, 1e30, f32::NAN];
    let far = look(DVec3::new(0.0, 0.0, -3e6), DVec3::ZERO);
    for place in 0..11 {
        let mut raw = RawGaussians::default();
        for value in values {
            let mut numbers = [0.1, 0.1, 2.0, 0.9, 0.1, 0.2, 0.1, 0.1, 0.1, 0.1, 0.5];
            numbers[place] = value;
            let [x, y, z, qw, qx, qy, qz, sx, sy, sz, opacity] = numbers;
            push(&mut raw, [x, y, z], [qw, qx, qy, qz], [sx, sy, sz], opacity, &RED);
        }
        let (gaussians, _) = Gaussians::sanitize(raw).expect("arrays of equal length");
        for pose in [camera(40, 40).camera_to_world, far] {
            let mut view = camera(40, 40);
            view.camera_to_world = pose;
            for antialiased in [false, true] {
                let request = RenderRequest { antialiased, ..request(view) };
                let frame = gpu.render(&gaussians, &request).expect("a picture");
                let colors = frame.color.iter().flatten().flatten();
                let numbers = colors.chain(frame.depth.iter().flatten());
                let finite = numbers.chain(frame.alpha.iter().flatten()).all(|v| v.is_finite());
                assert!(finite, "place {place}: a pixel that is no number");
            }
        }
    }
}
