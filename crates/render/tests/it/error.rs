//! The knob of time against error: no picture is farther from the exact one than was asked, on
//! either renderer, whatever the scene.

use std::sync::Arc;

use segsplat_core::scene::{Backdrop, Gaussians, RawGaussians};
use segsplat_render::{
    Background, Frame, Kinds, Labels, Layer, RenderRequest, Renderer, Samples, Source,
    budget::{ERROR_MAX, brightest},
    compare::differences,
    cpu::shade,
    oracle,
};
use segsplat_testing::{
    labels::table,
    scenes::{Random, camera, checked, cloud, needles, request, sheets, two_views},
};

use crate::common::{both_kernels, cpu};

/// Errors that are asked for, levels of 255.
const ERRORS: [f32; 8] = [0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0];
/// Rounding of f32 sums, as a share of what is summed.
const ROUNDING: f32 = 1e-5;

fn each(check: impl Fn(&dyn Renderer)) {
    check(&cpu());
    both_kernels().for_each(|gpu| check(gpu));
}

/// A view of `gaussians` without depth.
fn colors(gaussians: Gaussians, width: u32, height: u32) -> (Gaussians, RenderRequest) {
    let kinds = Kinds { depth: false, ..Kinds::ALL };
    (gaussians, RenderRequest { kinds, ..request(camera(width, height)) })
}

fn with(
    (gaussians, request): (Gaussians, RenderRequest),
    change: impl Fn(&mut RenderRequest),
) -> (Gaussians, RenderRequest) {
    let mut changed = request;
    change(&mut changed);
    (gaussians, changed)
}

/// Gaussians whose colours reach far over 1.
fn bright(gaussians: &Gaussians) -> Gaussians {
    let mut raw = gaussians.clone().into_raw();
    raw.sh.iter_mut().for_each(|sh| *sh = sh.map(|v| 4.0 * v));
    checked(raw)
}

/// Half of the Gaussians are of a photo that is behind.
fn layered((gaussians, request): (Gaussians, RenderRequest)) -> (Gaussians, RenderRequest) {
    let mut raw = gaussians.into_raw();
    raw.source.iter_mut().step_by(2).for_each(|source| source.view = 1);
    let source = |layer| Source { center: [0.0; 3], axis: [0.0, 0.0, 1.0], scale: 0.01, layer };
    (
        checked(raw),
        RenderRequest { sources: [source(Layer::Front), source(Layer::Behind)].into(), ..request },
    )
}

fn walls() -> Gaussians {
    let mut raw: RawGaussians = sheets(6, 12, 1.0, 4).into_raw();
    raw.scales.iter_mut().for_each(|scale| scale[2] = 1e-4);
    checked(raw)
}

fn scenes() -> Vec<(&'static str, (Gaussians, RenderRequest))> {
    let (photos, middle) = two_views(40, 5);
    let backdrop = (0..Backdrop::WIDTH * Backdrop::HEIGHT).map(|i| [(i % 256) as u8, 255, 0]);
    let backdrop = Arc::new(Backdrop::from_cells(backdrop.collect()).expect("all cells"));
    let photos = with(colors(photos, 40, 40), |request| request.camera = middle);
    let fog = || colors(sheets(80, 8, 0.12, 2), 50, 38);
    vec![
        ("two photos", photos.clone()),
        ("photos behind others", layered(photos)),
        ("cloud", colors(cloud(3_000, 0, 6), 64, 48)),
        ("harmonics", colors(cloud(3_000, 3, 7), 64, 48)),
        ("bright harmonics", colors(bright(&cloud(3_000, 3, 8)), 64, 48)),
        ("needles", colors(needles(2_000, 9), 64, 48)),
        ("walls", colors(walls(), 50, 38)),
        ("sheets", colors(sheets(40, 8, 0.35, 1), 50, 38)),
        ("fog", fog()),
        (
            "fog before a backdrop",
            with(fog(), |request| {
                request.background = Background::Backdrop(Arc::clone(&backdrop));
            }),
        ),
        (
            "fog before a colour under 0",
            with(fog(), |request| {
                request.background = Background::Color([-1.0, 0.5, 3.0]);
            }),
        ),
        (
            "antialiased",
            with(colors(cloud(4_000, 1, 11), 64, 48), |request| {
                request.antialiased = true;
            }),
        ),
    ]
}

fn draw(renderer: &dyn Renderer, scene: &Gaussians, request: &RenderRequest, error: f32) -> Frame {
    let request = RenderRequest { error, ..request.clone() };
    renderer.render(scene, &request).expect("a frame")
}

fn largest(got: &Frame, want: &Frame) -> f32 {
    differences(got, want).into_iter().fold(0.0, f32::max)
}

/// Of the same renderer: rounding decides alike in both, so every pixel counts.
#[test]
fn no_pixel_is_farther_from_the_exact_picture_than_was_asked() {
    each(|renderer| {
        let mut spent = 0;
        for (name, (gaussians, request)) in scenes() {
            let exact = draw(renderer, &gaussians, &request, 0.0);
            for error in ERRORS {
                let found = largest(&draw(renderer, &gaussians, &request, error), &exact);
                let what = format!("{name}, error {error}, {}", renderer.name());
                println!("{what}: {:.3} levels", found * 255.0);
                assert!(found <= error / 255.0 + ROUNDING, "{what}: {:.4}", found * 255.0);
                spent += u32::from(found > 0.25 * error / 255.0 && error > 0.0);
            }
        }
        assert!(spent > 20, "{spent} pictures spend a quarter of what they may");
    });
}

/// The oracle knows nothing of the knob.
#[test]
fn no_pixel_is_farther_from_the_oracle_than_was_asked() {
    let truths: Vec<_> = scenes()
        .into_iter()
        .map(|(name, (gaussians, request))| {
            let truth = oracle::render(&gaussians, &request).expect("the truth");
            (name, gaussians, request, truth)
        })
        .collect();
    each(|renderer| {
        for (name, gaussians, request, truth) in &truths {
            for error in ERRORS {
                let frame = draw(renderer, gaussians, request, error);
                let color = frame.color.as_ref().expect("colour");
                let alpha = frame.alpha.as_ref().expect("alpha");
                for (i, truth) in truth.iter().enumerate().filter(|(_, t)| !t.cliff.any()) {
                    let apart = (0..3).map(|k| f64::from(color[i][k]) - truth.color[k]);
                    let apart = apart.chain([f64::from(alpha[i]) - truth.alpha]);
                    let found = apart.fold(0.0, |most: f64, d| most.max(d.abs()));
                    // GPUs are within a level of the oracle.
                    let bound = f64::from(error + 1.0) / 255.0;
                    let what = format!("{name}, error {error}, {}", renderer.name());
                    assert!(found <= bound, "{what}: pixel {i} is {found:.5} off");
                }
            }
        }
    });
}

#[test]
fn scenes_made_at_random_keep_to_what_was_asked() {
    let mut random = Random(38);
    for round in 0..40 {
        let degree = (random.bits() % 4) as u8;
        let mut raw = cloud(600, degree, random.bits()).into_raw();
        let (opacity, size) = (random.range(0.02, 1.0), random.range(0.5, 6.0));
        raw.opacities.iter_mut().for_each(|o| *o = (*o * 2.0 * opacity).clamp(0.01, 1.0));
        raw.scales.iter_mut().for_each(|scale| *scale = scale.map(|s| s * size));
        let scene = colors(checked(raw), 33, 27);
        let error = random.range(0.0, ERROR_MAX);
        each(|renderer| {
            let exact = draw(renderer, &scene.0, &scene.1, 0.0);
            let found = largest(&draw(renderer, &scene.0, &scene.1, error), &exact);
            let what = format!("round {round}, error {error}, {}", renderer.name());
            assert!(found <= error / 255.0 + ROUNDING, "{what}: {:.4}", found * 255.0);
        });
    }
}

/// A whole number of levels is kept in levels too, any other is rounded up.
#[test]
fn levels_of_8_bits_are_as_far_apart_as_was_asked() {
    let (gaussians, request) = colors(sheets(80, 8, 0.12, 2), 50, 38);
    each(|renderer| {
        for samples in [Samples::Levels, Samples::LevelsRgba] {
            let request = RenderRequest { samples, ..request.clone() };
            let bytes = |error| {
                let levels = draw(renderer, &gaussians, &request, error).levels;
                let rgb = levels.rgb.into_iter().flatten().flatten();
                let rgba = levels.rgba.into_iter().flatten().flatten();
                let all = rgb.chain(rgba).chain(levels.alpha.into_iter().flatten());
                all.collect::<Vec<u8>>()
            };
            let exact = bytes(0.0);
            for error in ERRORS {
                let found = exact.iter().zip(bytes(error)).map(|(a, b)| a.abs_diff(b)).max();
                let found = found.expect("pixels");
                assert!(f32::from(found) <= error.ceil(), "{found} levels where {error} is asked");
            }
        }
    });
}

/// What is behind a ray may be at any depth.
#[test]
fn views_with_depth_are_exact() {
    let (gaussians, request) = colors(sheets(80, 8, 0.12, 2), 50, 38);
    each(|renderer| {
        let request = RenderRequest { kinds: Kinds::ALL, ..request.clone() };
        let [exact, loose] = [0.0, 32.0].map(|error| draw(renderer, &gaussians, &request, error));
        assert!(loose == exact, "{}", renderer.name());
    });
}

/// Weights of entries change by at most the error, and so does their sum; blended rows by that
/// times the largest number of the table; a mask only where a sum is so near to its bound.
#[test]
fn labels_keep_to_what_was_asked() {
    let (gaussians, request) = colors(sheets(80, 8, 0.12, 2), 50, 38);
    let entries = (0..gaussians.len()).map(|i| (i * 7 % 6) as u16).collect();
    let gaussians = gaussians.with_semantic_index(entries).expect("an entry each");
    let table = table(6, 3);
    let most = table.iter().flatten().fold(0.0_f32, |most, v| most.max(v.abs()));
    each(|renderer| {
        for kinds in [Kinds::NONE, Kinds::COLOR] {
            let with = |labels| RenderRequest { kinds, labels, ..request.clone() };
            let weights = with(Labels::Weights);
            let blend = with(Labels::Blend(Arc::clone(&table)));
            let mask = with(Labels::Mask { table: Arc::clone(&table), coverage_floor: 0.4 });
            let exact = [&weights, &blend, &mask].map(|r| draw(renderer, &gaussians, r, 0.0));
            let mut flipped = 0;
            for error in ERRORS {
                let bound = error / 255.0;
                let got = [&weights, &blend, &mask].map(|r| draw(renderer, &gaussians, r, error));
                let what = format!("error {error}, {}", renderer.name());
                let [a, b] = [&got[0], &exact[0]].map(|f| f.weights.as_ref().expect("weights"));
                for i in 0..a.pixels() {
                    let sum = |of: &segsplat_render::PixelWeights, m| -> f32 {
                        of.pixel(i).filter(|(entry, _)| *entry == m).map(|(_, w)| w).sum()
                    };
                    let apart = (1..6).map(|m| (sum(a, m) - sum(b, m)).abs()).sum::<f32>();
                    assert!(apart <= bound + ROUNDING, "{what}: weights of {i}: {apart}");
                }
                let [a, b] = [&got[1], &exact[1]].map(|f| f.blend.as_ref().expect("rows"));
                let [m, n] = [&got[2], &exact[2]].map(|f| f.mask.as_ref().expect("a mask"));
                for i in 0..a.len() {
                    let apart = (0..4).map(|k| (a[i][k] - b[i][k]).abs()).fold(0.0, f32::max);
                    assert!(apart <= bound * most + ROUNDING, "{what}: row {i}: {apart}");
                    let near = (b[i][0] - 0.4)
                        .abs()
                        .min(b[i][1..].iter().fold(f32::INFINITY, |least, v| least.min(v.abs())));
                    let flips = m[i] != n[i];
                    assert!(!flips || near <= bound * most + ROUNDING, "{what}: mask at {i}");
                    flipped += u32::from(flips);
                }
            }
            println!("{}: {flipped} pixels of masks", renderer.name());
        }
    });
}

#[test]
fn errors_out_of_range_are_refused_with_value_and_bound() {
    let (gaussians, request) = colors(cloud(10, 0, 1), 16, 16);
    each(|renderer| {
        for error in [-0.5, 32.5, f32::NAN, f32::INFINITY] {
            let request = RenderRequest { error, ..request.clone() };
            let refused = renderer.render(&gaussians, &request).expect_err("out of range");
            let told = refused.to_string();
            assert!(told.contains(&format!("error is {error}")), "{told}");
            assert!(told.contains("0 to 32 levels of 255"), "{told}");
        }
    });
}

/// From any side no colour is over the bound, and the bound is no wild guess.
#[test]
fn no_colour_is_brighter_than_the_bound() {
    let mut random = Random(3);
    for degree in 0..=3 {
        let gaussians = cloud(200, degree, 20 + u64::from(degree));
        let bound = brightest(&gaussians);
        let mut most = 0.0_f32;
        for _ in 0..2_000 {
            let toward = [(); 3].map(|()| random.range(-1.0, 1.0));
            let toward = glam::Vec3::from(toward).as_dvec3();
            let colors = gaussians.sh().chunks(gaussians.sh_count());
            for color in colors.map(|sh| shade::color(sh, toward)) {
                most = color.into_iter().fold(most, f32::max);
            }
        }
        assert!(most <= bound + ROUNDING, "degree {degree}: {most} over {bound}");
        assert!(most > 0.5 * bound, "degree {degree}: {most} far under {bound}");
    }
}
