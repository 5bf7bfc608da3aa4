//! The generated photo set through the real network and the product's renderer, against its truth.

use std::sync::{Arc, atomic::AtomicBool};

use segsplat::{
    limits::Limits,
    models::NetworkOptions,
    photos,
    pipeline::{self, Pipeline, Reconstruction},
    render::{Background, Kinds, RenderRequest, Renderer, compare::psnr, cpu::CpuRenderer},
    sample::{self, Room, SampleOptions},
    scene::{Density, RawGaussians, SceneOptions, Upload},
};
use segsplat_testing::captures;

use crate::common::opened;

/// Measured 36.8 dB with the embedded network: the room is of a kind that it was trained on.
const PSNR_MIN: f64 = 33.0;
/// Measured 52.2 dB: a thinned scene is drawn as the full one is (docs/adr/0016).
const THINNED_PSNR_MIN: f64 = 47.0;
/// Measured 0.9 %.
const DEPTH_ERROR_MAX: f64 = 0.03;

const SAMPLE: SampleOptions = SampleOptions { photos: 2, width: 256, height: 256, seed: 1 };

fn engine() -> Option<Pipeline> {
    opened(Pipeline::open(&NetworkOptions::default()))
}

fn reconstruct(engine: &Pipeline, options: &SceneOptions) -> Reconstruction {
    let photos = sample::photos(&SAMPLE).unwrap();
    let go_on = AtomicBool::new(false);
    pipeline::reconstruct(engine, &photos, options, &|_, _| {}, &go_on).unwrap()
}

/// The view half-way between the photos, over the backdrop, as it is served.
fn request(made: &Reconstruction, kinds: Kinds) -> RenderRequest {
    let near = 0.01 * made.report.median_depth as f32;
    let background = Background::Backdrop(Arc::new(made.backdrop.clone()));
    let camera = sample::camera_at(&SAMPLE, 0.0).unwrap();
    RenderRequest { background, ..RenderRequest::plain(camera, kinds, near) }
}

#[test]
fn the_sample_is_reconstructed_close_to_its_truth() {
    let Some(engine) = engine() else { return };
    let made = reconstruct(&engine, &SceneOptions::default());
    assert!(made.report.warnings.is_empty(), "{:?}", made.report.warnings);

    let request = request(&made, Kinds::ALL);
    let truth = Room::new(SAMPLE.seed).view(&request.camera);
    let frame = CpuRenderer::new(0).unwrap().render(&made.gaussians, &request).unwrap();
    let true_color: Vec<[f32; 3]> = truth
        .photo
        .rgb
        .chunks(3)
        .map(|p| [p[0], p[1], p[2]].map(|v| f32::from(v) / 255.0))
        .collect();
    let fidelity = psnr(&frame.color.unwrap(), &true_color, None);

    let seen = frame.alpha.unwrap().into_iter().zip(frame.depth.unwrap()).zip(&truth.depth);
    let mut errors: Vec<f64> = seen
        .filter(|((alpha, _), _)| *alpha > 0.5)
        .map(|((_, depth), truth)| f64::from((depth - truth).abs() / truth))
        .collect();
    errors.sort_by(f64::total_cmp);
    let median = errors[errors.len() / 2];
    println!("sample: {fidelity:.2} dB, median depth error {:.2} %", 100.0 * median);
    assert!(errors.len() * 10 > truth.depth.len() * 9, "{} pixels are covered", errors.len());
    assert!(fidelity > PSNR_MIN, "{fidelity:.2} dB between the photos");
    assert!(median < DEPTH_ERROR_MAX, "median depth error {:.2} %", 100.0 * median);
}

#[test]
fn a_thinned_sample_is_drawn_as_the_full_one_by_fewer_gaussians() {
    let Some(engine) = engine() else { return };
    let renderer = CpuRenderer::new(0).unwrap();
    let [(full, all, none), (thinned, left, merged)] =
        [Density::Full, Density::Thinned].map(|density| {
            let options = SceneOptions { density: Some(density), ..SceneOptions::default() };
            let made = reconstruct(&engine, &options);
            let request = request(&made, Kinds { color: true, depth: false, alpha: false });
            let merged = made.report.dropped.iter().find(|d| d.reason == "merged").map(|d| d.count);
            let frame = renderer.render(&made.gaussians, &request).unwrap();
            (frame.color.unwrap(), made.gaussians.len() as u64, merged)
        });
    let fidelity = psnr(&thinned, &full, None);
    println!("sample: {all} Gaussians thinned to {left}, {fidelity:.2} dB");
    assert_eq!((none, merged), (None, Some(all - left)), "every Gaussian is kept or counted");
    assert!(left * 10 < all * 8, "{left} of {all} left");
    assert!(fidelity > THINNED_PSNR_MIN, "{fidelity:.2} dB");
}

/// The same photos as each layout of captures: where a layout holds the numbers of a pose
/// themselves the scene is the same to the bit. Others cost a rounding of the poses (1e-13 at most,
/// as a test of the readers has it), and so the last digits of its numbers.
#[test]
fn the_same_photos_as_each_layout_of_captures_are_the_same_scene() {
    let Some(engine) = engine() else { return };
    let go_on = AtomicBool::new(false);
    let posed = sample::photos(&SAMPLE).unwrap();
    let pngs = sample::png_files(&posed).unwrap();
    let made = |layout: &str| {
        let photos = captures::write(layout, &posed, &pngs);
        let upload = Upload { photos, ..Upload::default() };
        let photos = photos::read(&upload, &Limits::default()).unwrap();
        let options = SceneOptions::default();
        pipeline::reconstruct(&engine, &photos, &options, &|_, _| {}, &go_on).unwrap()
    };
    let reference = made("cameras");
    let want = reference.gaussians.clone().into_raw();
    for (layout, same_numbers) in captures::LAYOUTS {
        let made = made(layout);
        let raw = made.gaussians.clone().into_raw();
        let off = furthest(&raw, &want);
        let moved = (raw.origin - want.origin).abs().max_element();
        let same = bits(&made) == bits(&reference);
        let count = raw.means.len();
        println!("{layout}: {count} Gaussians, all bits: {same}; {off:e}, origin {moved:e}");
        assert!(same || !same_numbers, "{layout}: {off:e}");
        assert_eq!(count, want.means.len(), "{layout}");
        assert!(off < 1e-6 && moved < 1e-12, "{layout}: {off:e}, origin {moved:e}");
    }
}

/// All numbers of Gaussians and backdrop.
fn bits(made: &Reconstruction) -> Vec<u8> {
    let raw = made.gaussians.clone().into_raw();
    let origin = raw.origin.to_array();
    let numbers: [&[u8]; 7] = [
        bytemuck::cast_slice(&origin),
        bytemuck::cast_slice(&raw.means),
        bytemuck::cast_slice(&raw.quats),
        bytemuck::cast_slice(&raw.scales),
        bytemuck::cast_slice(&raw.opacities),
        bytemuck::cast_slice(&raw.sh),
        bytemuck::cast_slice(made.backdrop.cells()),
    ];
    numbers.concat()
}

/// The largest difference of two numbers of 32 bits.
fn furthest(a: &RawGaussians, b: &RawGaussians) -> f32 {
    let all = |raw: &RawGaussians| -> Vec<f32> {
        let rows: [&[f32]; 4] = [
            bytemuck::cast_slice(&raw.means),
            bytemuck::cast_slice(&raw.quats),
            bytemuck::cast_slice(&raw.scales),
            bytemuck::cast_slice(&raw.sh),
        ];
        [&rows.concat()[..], &raw.opacities].concat()
    };
    all(a).iter().zip(all(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}
