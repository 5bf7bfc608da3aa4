//! Adapters for the tests of the GPU renderer, and its pictures against those of the CPU renderer.
//!
//! They need an adapter: a hardware one, else lavapipe. Without any the tests say `skipped`;
//! `REQUIRE_GPU=1` (or CI=true) makes that a failure. The device has WebGPU's portable limits.

use std::sync::OnceLock;

use segsplat_core::scene::Gaussians;
use segsplat_render::{
    Frame, PixelWeights, RenderRequest, Renderer, RendererOptions, Switches,
    cpu::CpuRenderer,
    gpu::GpuRenderer,
    oracle::{self, OraclePixel},
};
use segsplat_testing::labels::{Drawn, apart, draw_labels, table};
use segsplat_testing::{
    compare::{Tolerance, compare, samples},
    skipped,
};

/// Opens an adapter with `change` made to the portable options; hardware first.
pub(crate) fn open(change: impl Fn(&mut RendererOptions)) -> Option<GpuRenderer> {
    let mut told = String::new();
    for adapter in [None, Some("llvmpipe".to_owned())] {
        let switches = Switches { portable: true, serial: Some(false), ..Switches::default() };
        let mut options = RendererOptions { adapter, switches, ..RendererOptions::default() };
        change(&mut options);
        match GpuRenderer::open(&options).1 {
            Ok(gpu) => return Some(gpu),
            Err(error) => told = error.to_string(),
        }
    }
    assert!(std::env::var_os("REQUIRE_GPU").is_none(), "REQUIRE_GPU is set: {told}");
    skipped("no adapter");
    None
}

/// The adapter that the tests share.
pub(crate) fn gpu() -> Option<&'static GpuRenderer> {
    static GPU: OnceLock<Option<GpuRenderer>> = OnceLock::new();
    let gpu = GPU.get_or_init(|| open(|_| {})).as_ref();
    match gpu {
        Some(gpu) => println!("adapter: {:?}", gpu.adapter()),
        None => println!("skipped: no adapter"),
    }
    gpu
}

/// The same adapter with the kernels of a GPU, then with those of a software adapter.
pub(crate) fn both_kernels() -> impl Iterator<Item = &'static GpuRenderer> {
    static SERIAL: OnceLock<Option<GpuRenderer>> = OnceLock::new();
    let serial =
        || SERIAL.get_or_init(|| open(|options| options.switches.serial = Some(true))).as_ref();
    gpu().into_iter().chain(serial())
}

pub(crate) fn cpu() -> CpuRenderer {
    CpuRenderer::new(2).expect("two threads")
}

/// Pictures within 1/255; pixels further apart are few and stand at a cliff of the oracle.
pub(crate) fn same(
    name: &str,
    got: &Frame,
    want: &Frame,
    gaussians: &Gaussians,
    request: &RenderRequest,
) {
    let truth =
        |pixels: &[[u32; 2]]| oracle::render_pixels(gaussians, request, pixels).expect("the truth");
    let name = format!("{name}: {} Gaussians", gaussians.len());
    same_by(&name, got, want, request, truth);
}

/// The same, where the oracle's pixels are given by a function of their places.
pub(crate) fn same_by(
    name: &str,
    got: &Frame,
    want: &Frame,
    request: &RenderRequest,
    truth: impl Fn(&[[u32; 2]]) -> Vec<OraclePixel>,
) {
    let (got, want) = (samples(got), samples(want));
    let one = Tolerance { mean: f64::INFINITY, ..Tolerance::GPU };
    let apart = |i: usize| compare(&got[i..=i], &want[i..=i], &[false], one).is_err();
    let far: Vec<usize> = (0..want.len()).filter(|&i| apart(i)).collect();
    let width = request.camera.intrinsics.width;
    let pixels: Vec<[u32; 2]> = far.iter().map(|&i| [i as u32 % width, i as u32 / width]).collect();
    let truth = truth(&pixels);
    let mut cliff = vec![false; want.len()];
    for (&i, truth) in far.iter().zip(&truth) {
        cliff[i] = truth.cliff.any();
    }
    let found = compare(&got, &want, &cliff, Tolerance::GPU)
        .unwrap_or_else(|told| panic!("{name}: {told}"));
    println!(
        "{name}, {} px: max {:.2e}, mean {:.2e}, {} flips",
        found.pixels, found.max, found.mean, found.flips
    );
}

pub(crate) fn judge(
    gpu: &GpuRenderer,
    name: &str,
    gaussians: &Gaussians,
    request: &RenderRequest,
) -> Frame {
    let got = gpu.render(gaussians, request).expect("a picture of the GPU");
    let want = cpu().render(gaussians, request).expect("a picture of the CPU");
    same(name, &got, &want, gaussians, request);
    let (a, b) = (got.stats.visible, want.stats.visible);
    assert!(a.abs_diff(b) * 1_000 <= b.max(1), "{name}: {a} visible, not {b}");
    got
}

/// Dense rows of sparse weights, `[H * W][m]`.
fn dense(weights: &PixelWeights, m: usize) -> Vec<Vec<f64>> {
    let row = |i| {
        let mut row = vec![0.0; m];
        for (index, weight) in weights.pixel(i) {
            row[usize::from(index) - 1] = f64::from(weight);
        }
        row
    };
    (0..weights.pixels()).map(row).collect()
}

/// GPU against CPU: within 1/255, what differs more stands at a cliff of the oracle and is rare.
pub(crate) fn judge_labels(
    gpu: &GpuRenderer,
    name: &str,
    gaussians: &Gaussians,
    request: &RenderRequest,
) -> Drawn {
    let m = gaussians.semantic_index().iter().copied().max().unwrap_or(0);
    let table = table(usize::from(m) + 1, 11);
    let got = draw_labels(gpu, gaussians, request, &table);
    let want = draw_labels(&cpu(), gaussians, request, &table);
    let dense = dense(&want.weights, usize::from(m));
    // A blended number adds up errors of a whole row.
    let (far, worst) = apart(&got, &dense, &table, Tolerance::GPU.interior);
    let width = request.camera.intrinsics.width;
    let pixels: Vec<[u32; 2]> = far.iter().map(|&i| [i as u32 % width, i as u32 / width]).collect();
    let truth = oracle::render_pixels(gaussians, request, &pixels).expect("the truth");
    let fault = truth.iter().position(|pixel| !pixel.cliff.any()).map(|at| far[at]);
    assert!(fault.is_none(), "{name}: pixel {fault:?} is far and at no cliff, of {}", far.len());
    let share = far.len() as f64 / dense.len() as f64;
    assert!(share <= Tolerance::GPU.flips, "{name}: {} pixels flipped", far.len());
    let (px, seen) = (dense.len(), got.weights.entries.len());
    println!("{name}: {px} px, {seen} weights: max {worst:.2e}, {} flips", far.len());
    got
}
