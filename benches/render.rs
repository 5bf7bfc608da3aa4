//! Whole frames on the CPU: time, and beside it the error against the f64 oracle.
//!
//! Back of an envelope for 131,072 Gaussians at 256x256: each touches about 7 rows and 12 cells of
//! 8 pixels, 1.6 million cell entries of about 40 vector instructions: 60 million, 8 ms on 2 cores.
//! Rays end early, so less.

#[path = "../tests/it/common/compare.rs"]
mod compare;
#[path = "../tests/it/common/scenes.rs"]
mod scenes;

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use segsplat::{
    render::{RenderRequest, Renderer, cpu::CpuRenderer, oracle},
    scene::Gaussians,
};

/// Prints the error of one frame, on sampled pixels.
#[expect(clippy::print_stdout, reason = "no time without its error beside it")]
fn print_error(name: &str, gaussians: &Gaussians, request: &RenderRequest) {
    let cpu = CpuRenderer::new(0).expect("threads");
    let frame = cpu.render(gaussians, request).expect("a picture");
    let all = compare::samples(&frame);
    let lens = request.camera.intrinsics;
    let mut random = scenes::Random(5);
    let pixels: Vec<[u32; 2]> = (0..4_096)
        .map(|_| [random.bits() as u32 % lens.width, random.bits() as u32 % lens.height])
        .collect();
    let truth = oracle::render_pixels(gaussians, request, oracle::DepthKey::F32, &pixels)
        .expect("the truth");
    let got: Vec<_> = pixels.iter().map(|&[x, y]| all[(y * lens.width + x) as usize]).collect();
    let cliff: Vec<bool> = truth.iter().map(|p| p.cliff.same_order()).collect();
    let want = compare::oracle_samples(&truth);
    match compare::compare(&got, &want, &cliff, compare::Tolerance::ORACLE) {
        Ok(found) => println!(
            "{name}: {} Gaussians ({} visible, {} pairs), error against the oracle on {} px: \
             max {:.2e}, mean {:.2e}, {} flips",
            gaussians.len(),
            frame.stats.visible,
            frame.stats.intersections,
            found.pixels,
            found.max,
            found.mean,
            found.flips
        ),
        Err(told) => println!("{name}: WRONG: {told}"),
    }
}

fn render(criterion: &mut Criterion) {
    let (pair, pair_camera) = scenes::two_views(256, 1);
    let cloud = scenes::cloud(100_000, 3, 2);
    let cases = [
        ("pair_131072/256x256", &pair, pair_camera),
        ("cloud_100000_sh3/640x480", &cloud, scenes::camera(640, 480)),
    ];
    for (name, gaussians, camera) in cases {
        let request = scenes::request(camera);
        print_error(name, gaussians, &request);
        for threads in [1, 2] {
            let cpu = CpuRenderer::new(threads).expect("threads");
            criterion.bench_function(&format!("render/cpu/{name}/{threads}_threads"), |b| {
                b.iter(|| cpu.render(black_box(gaussians), &request).expect("a picture"));
            });
        }
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(20);
    targets = render
}
criterion_main!(benches);
