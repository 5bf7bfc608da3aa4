//! The committed list of scenes and views (views.csv) drawn by every renderer, against the f64
//! oracle: errors of each are printed and held to the bounds of docs/conventions.md.
//!
//! The scenes are generated from the numbers of the row: `cloud` of a degree,
//! `pair` (a Gaussian a pixel of two photos of side `count`), `giants` and `specks` (clouds of
//! scales times 12 and 0.02); `stretch` lengthens one axis of each Gaussian, `shift` moves scene
//! and camera away from the origin, metres.

use std::sync::OnceLock;

use glam::DVec3;
use segsplat_core::scene::Gaussians;
use segsplat_render::{
    RenderRequest, Renderer,
    cpu::CpuRenderer,
    oracle::{self, OraclePixel},
};

use crate::common::both_kernels;
use segsplat_testing::{
    compare::{Tolerance, compare, oracle_samples, samples},
    scenes::{Random, camera, checked, cloud, look, request, two_views},
};

/// Most pixels of a view that the oracle is asked for.
const PIXELS_MAX: usize = 4096;

/// A row of the list with its truth.
struct View {
    name: String,
    gaussians: Gaussians,
    request: RenderRequest,
    /// Places of `truth`, row-major.
    places: Vec<usize>,
    truth: Vec<OraclePixel>,
}

impl View {
    fn of(row: &str) -> Self {
        let mut cells = row.split(',');
        let name = cells.next().expect("a name").to_owned();
        let kind = cells.next().expect("a scene");
        let numbers: Vec<f64> = cells
            .map(|cell| cell.parse().unwrap_or_else(|e| panic!("{name}: {cell}: {e}")))
            .collect();
        let [count, degree, seed, stretch, shift, width, height, focal, view @ ..] = &numbers[..]
        else {
            panic!("{name}: {} numbers", numbers.len())
        };
        let &[eye_x, eye_y, eye_z, to_x, to_y, to_z, smooth] = view else {
            panic!("{name}: a view of {} numbers", view.len())
        };
        let (count, seed) = (*count as usize, *seed as u64);
        let scales = match kind {
            "giants" => 12.0,
            "specks" => 0.02,
            _ => 1.0,
        };
        let gaussians = match kind {
            "pair" => two_views(count as u32, seed).0,
            _ => cloud(count, *degree as u8, seed),
        };
        let mut raw = gaussians.into_raw();
        let away = DVec3::new(*shift, -0.5 * shift, 0.25 * shift);
        raw.origin += away;
        for scale in &mut raw.scales {
            *scale = scale.map(|s| s * scales);
            scale[0] *= *stretch as f32;
        }
        let mut camera = camera(*width as u32, *height as u32);
        camera.intrinsics.fx *= focal;
        camera.intrinsics.fy *= focal;
        let eye = away + DVec3::new(eye_x, eye_y, eye_z);
        camera.camera_to_world = look(eye, away + DVec3::new(to_x, to_y, to_z));
        let request = RenderRequest { antialiased: smooth != 0.0, ..request(camera) };
        let gaussians = checked(raw);
        let all = camera.intrinsics.width as usize * camera.intrinsics.height as usize;
        let mut random = Random(seed);
        let mut places: Vec<usize> = match all <= PIXELS_MAX {
            true => (0..all).collect(),
            false => (0..PIXELS_MAX).map(|_| random.bits() as usize % all).collect(),
        };
        places.sort_unstable();
        places.dedup();
        let wide = camera.intrinsics.width;
        let pixels: Vec<_> =
            places.iter().map(|&at| [at as u32 % wide, at as u32 / wide]).collect();
        let truth = oracle::render_pixels(&gaussians, &request, &pixels).expect("the truth");
        Self { name, gaussians, request, places, truth }
    }
}

/// The list; the truth of it is computed once.
fn views() -> &'static [View] {
    static VIEWS: OnceLock<Vec<View>> = OnceLock::new();
    VIEWS.get_or_init(|| {
        let rows: Vec<_> = include_str!("views.csv").lines().skip(1).collect();
        assert_eq!(rows.len(), 50, "rows of the list");
        rows.into_iter().map(View::of).collect()
    })
}

/// Draws the list and holds each view to `tolerance` where no cliff is, as `cliff` tells.
fn judge(renderer: &dyn Renderer, tolerance: Tolerance, cliff: fn(&OraclePixel) -> bool) {
    let (mut worst, mut flips, mut pixels) = (0.0_f64, 0, 0);
    for view in views() {
        let frame = renderer.render(&view.gaussians, &view.request).expect("a picture");
        let all = samples(&frame);
        let got: Vec<_> = view.places.iter().map(|&at| all[at]).collect();
        let cliffs: Vec<_> = view.truth.iter().map(cliff).collect();
        let found = compare(&got, &oracle_samples(&view.truth), &cliffs, tolerance)
            .unwrap_or_else(|told| panic!("{}: {}: {told}", renderer.name(), view.name));
        println!(
            "{}: {} px, max {:.1e}, mean {:.1e}, {} flips",
            view.name, found.pixels, found.max, found.mean, found.flips
        );
        worst = worst.max(found.max);
        flips += found.flips;
        pixels += found.pixels;
    }
    println!("{}: 50 views, {pixels} px, max {worst:.2e}, {flips} flips", renderer.name());
}

#[test]
fn the_cpu_keeps_to_the_oracle() {
    let cpu = CpuRenderer::new(2).expect("two threads");
    judge(&cpu, Tolerance::ORACLE, |pixel| pixel.cliff.same_order());
}

#[test]
fn a_gpu_keeps_to_the_oracle() {
    for gpu in both_kernels() {
        judge(gpu, Tolerance::GPU, |pixel| pixel.cliff.any());
    }
}
