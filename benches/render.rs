//! The CPU renderer: whole frames with their error against the f64 oracle beside the time, then
//! each stage alone, and labels.
//!
//! Back of an envelope for 131,072 Gaussians at 256x256: each meets about 4 cells of 16 pixels,
//! 480,000 blends of about 30 vector instructions: 15 million, 6 ms of one core with AVX-512, and
//! as much again to project, sort and bin. `render/cpu/pair_131072` says what it is.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use segsplat::{
    render::{
        DifferentiableRenderer as _, Kinds, Labels, RenderRequest, Renderer,
        backward::{FrameGradients, Gradients},
        cpu::{
            CpuRenderer,
            bin::{Bins, DepthKeys, bin},
            cell::{Tile, TileScratch},
            lanes::KernelOptions,
            paint::Paint,
            project::{Projected, project},
            rasterize::rasterize_tile,
            shade,
            store::PictureRows,
            tiles::Grid,
        },
        oracle,
        switches::Width,
        view::View,
    },
    scene::Gaussians,
};
use segsplat_testing::{compare, scenes};

const SIDE: u32 = 256;
const TILE: u32 = 16;

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
    let truth = oracle::render_pixels(gaussians, request, &pixels).expect("the truth");
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

/// A frame of 256 x 256 stage by stage, on one thread: what a stage costs, not how it scales.
struct Stages {
    gaussians: Gaussians,
    request: RenderRequest,
    view: View,
    grid: Grid,
    projected: Projected,
    bins: Vec<Bins>,
}

impl Stages {
    fn new() -> Self {
        let (gaussians, camera) = scenes::two_views(SIDE, 1);
        let request = scenes::request(camera);
        let view = View::new(gaussians.origin(), &request).expect("a view");
        let grid = Grid::whole(&view, KernelOptions::default());
        Self { gaussians, request, view, grid, projected: Projected::default(), bins: Vec::new() }
    }

    fn project(&mut self, width: Width) {
        let options = KernelOptions { width, ..KernelOptions::default() };
        let Self { gaussians, request, view, projected, .. } = self;
        project(gaussians, request, view, options, projected);
    }

    fn shade(&mut self) {
        let options = KernelOptions::default();
        shade::shade(&self.gaussians, &self.view, options, false, &mut self.projected);
    }

    fn bin(&mut self) {
        let keys = DepthKeys::new(&self.gaussians, &[]);
        bin(&self.projected, keys, &self.grid, u64::MAX, &mut self.bins);
    }

    /// All tiles into pictures that every request has.
    fn rasterize(&self, request: &RenderRequest, width: Width, scratch: &mut TileScratch) {
        let options = KernelOptions { width, ..KernelOptions::default() };
        let paint = Paint::new(request, &self.view, self.gaussians.semantic_index(), 0.0, options);
        let stride = (SIDE * TILE) as usize;
        let (mut color, mut depth) = (vec![[0.0; 3]; stride], vec![0.0; stride]);
        let mut blend = vec![[0.0; 4]; stride];
        let width_of = SIDE as usize;
        let mut pairs = Vec::new();
        for tile_y in 0..SIDE / TILE {
            let blends = matches!(request.labels, Labels::Blend(_));
            let mut out = PictureRows {
                color: request.kinds.color.then(|| color.chunks_mut(width_of).collect()),
                depth: request.kinds.depth.then(|| depth.chunks_mut(width_of).collect()),
                blend: blends.then(|| blend.chunks_mut(width_of).collect()),
                ..PictureRows::default()
            };
            for tile_x in 0..SIDE / TILE {
                let id = (tile_y * SIDE / TILE + tile_x) as usize;
                let tile = Tile { x: tile_x * TILE, y: tile_y * TILE, width: TILE, height: TILE };
                pairs.clear();
                self.bins.iter().for_each(|bins| pairs.extend(bins.of(id)));
                let (column, footprints) = ((tile_x * TILE) as usize, &self.projected.footprints);
                rasterize_tile(footprints, &mut pairs, tile, column, &paint, scratch, &mut out);
            }
        }
        black_box((color, depth, blend));
    }
}

fn stages(criterion: &mut Criterion) {
    let mut stages = Stages::new();
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread");
    let mut scratch = TileScratch::default();
    let widths = Width::ALL.into_iter().filter(|width| width.available());
    for width in widths.clone() {
        criterion.bench_function(&format!("stage/project/{width:?}"), |b| {
            b.iter(|| one.install(|| stages.project(width)));
        });
    }
    criterion.bench_function("stage/shade", |b| b.iter(|| one.install(|| stages.shade())));
    criterion.bench_function("stage/bin", |b| b.iter(|| one.install(|| stages.bin())));
    let table: Labels = Labels::Blend(vec![[0.5; 4]; 25].into());
    let count = stages.gaussians.len() as u32;
    let index = (0..count).map(|i| (i / 700 % 25) as u16).collect();
    let gaussians = std::mem::replace(&mut stages.gaussians, scenes::cloud(1, 0, 1));
    stages.gaussians = gaussians.with_semantic_index(index).expect("an index a Gaussian");
    let (color, all) = (Kinds::COLOR, Kinds::ALL);
    for (name, kinds, labels) in [
        ("color", color, Labels::None),
        ("color_depth", all, Labels::None),
        ("mask", Kinds::NONE, table.clone()),
        ("color_depth_mask", all, table),
    ] {
        let request = RenderRequest { kinds, labels, ..stages.request.clone() };
        for width in widths.clone() {
            criterion.bench_function(&format!("stage/rasterize/{name}/{width:?}"), |b| {
                b.iter(|| stages.rasterize(&request, width, &mut scratch));
            });
        }
    }
    // Weights are joined from rows of tiles, which the renderer does: whole frames.
    let cpu = CpuRenderer::new(1).expect("a thread");
    for (name, kinds) in [("weights", Kinds::NONE), ("color_depth_weights", all)] {
        let request = RenderRequest { kinds, labels: Labels::Weights, ..stages.request.clone() };
        criterion.bench_function(&format!("labels/{name}/1_threads"), |b| {
            b.iter(|| cpu.render(&stages.gaussians, &request).expect("weights"));
        });
    }
}

/// A frame, and a frame with its backward pass, of 100,000 Gaussians at 256 x 256.
fn backward(criterion: &mut Criterion) {
    let gaussians = scenes::cloud(100_000, 0, 2);
    let request = scenes::request(scenes::camera(SIDE, SIDE));
    let pixels = (SIDE * SIDE) as usize;
    let loss = FrameGradients { color: Some(vec![[0.1, -0.2, 0.3]; pixels]), ..Default::default() };
    for threads in [1, 2] {
        let cpu = CpuRenderer::new(threads).expect("threads");
        let name = format!("cloud_100000/256x256/{threads}_threads");
        criterion.bench_function(&format!("backward/forward_alone/{name}"), |b| {
            b.iter(|| cpu.render(black_box(&gaussians), &request).expect("a picture"));
        });
        let mut gradients = Gradients::default();
        criterion.bench_function(&format!("backward/both/{name}"), |b| {
            let mut loss = |_: &_| Ok(loss.clone());
            b.iter(|| {
                cpu.backward(black_box(&gaussians), &request, &mut loss, &mut gradients)
                    .expect("gradients")
            });
        });
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(20);
    targets = render, stages, backward
}
criterion_main!(benches);
