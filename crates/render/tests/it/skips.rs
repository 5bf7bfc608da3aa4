//! Work that renderers leave out changes no pixel: each skip switched off gives the same frame.
//! Other tests show that each switch does something. `segsplat-lab skips` measures what each saves.

use segsplat_core::scene::{Gaussians, RawGaussians};
use segsplat_render::{
    Background, Frame, Kinds, Labels, RenderRequest, Renderer, Skip, Switches,
    cpu::{
        CpuRenderer,
        cell::{Tile, TileScratch},
        footprint::Footprint,
        lanes::KernelOptions,
        paint::Paint,
        rasterize::rasterize_tile,
        store::PictureRows,
    },
    gpu::internals::SHADERS,
    view::View,
};

use crate::common::open;
use segsplat_testing::labels::{labelled, table};
use segsplat_testing::scenes::{camera, checked, cloud, look, push, request, two_views};

/// Scenes and views in which every skip has something to leave out: Gaussians beside the picture
/// and behind the camera, tiles without any, walls, harmonics, labels.
fn cases() -> Vec<(&'static str, Gaussians, RenderRequest)> {
    let (pair, middle) = two_views(64, 3);
    let mut aside = camera(150, 90);
    aside.camera_to_world = look(glam::DVec3::new(2.0, 0.5, 4.0), glam::DVec3::new(9.0, 0.0, 7.0));
    let small = request(camera(70, 50));
    let entered = RenderRequest { labels: Labels::Weights, ..small.clone() };
    let blended = RenderRequest { labels: Labels::Blend(table(9, 8)), ..small };
    vec![
        ("a Gaussian a pixel", pair, request(middle)),
        ("few, seen from aside", cloud(300, 0, 4), request(aside)),
        ("harmonics", cloud(2_000, 2, 5), request(camera(97, 61))),
        ("blended labels", labelled(2_000, 8, 7), blended),
        ("weights", labelled(2_000, 8, 8), entered),
    ]
}

/// The same frame. Boxes have more tiles than ellipses; returns how many pairs more.
fn same(skip: Skip, name: &str, mut got: Frame, want: &Frame) -> u64 {
    let more = got.stats.intersections - want.stats.intersections;
    assert!(more == 0 || skip == Skip::EllipseTiles, "{skip:?}: {name} has {more} pairs more");
    if skip == Skip::EllipseTiles {
        got.stats = want.stats;
    }
    assert!(got == *want, "without {skip:?}: {name} differs");
    more
}

#[test]
fn on_the_cpu_no_bit_changes() {
    let draw = |without, gaussians: &Gaussians, request: &RenderRequest| {
        let switches = Switches { without, blocks_min: Some(1), ..Switches::default() };
        let cpu = CpuRenderer::with_switches(2, &switches);
        cpu.expect("two threads").render(gaussians, request).expect("a frame")
    };
    let mut boxed = 0;
    for (name, gaussians, request) in cases() {
        let want = draw(None, &gaussians, &request);
        for skip in Skip::ALL {
            boxed += same(skip, name, draw(Some(skip), &gaussians, &request), &want);
        }
    }
    assert!(boxed > 1_000, "the switch of tiles does switch: {boxed} pairs more");
}

#[test]
fn on_a_gpu_no_bit_changes() {
    let scenes = cases();
    for serial in [false, true] {
        let Some(gpu) = open(|options| {
            options.switches.serial = Some(serial);
            options.switches.blocks_min = Some(1);
        }) else {
            return;
        };
        let draw = |(_, gaussians, request): &(_, _, _)| gpu.render(gaussians, request);
        let wanted: Vec<_> = scenes.iter().map(|case| draw(case).expect("a frame")).collect();
        let mut boxed = 0;
        for skip in Skip::ALL {
            let Some(gpu) = open(|options| {
                options.switches.serial = Some(serial);
                options.switches.blocks_min = Some(1);
                options.switches.without = Some(skip);
            }) else {
                return;
            };
            for ((name, gaussians, request), want) in scenes.iter().zip(&wanted) {
                boxed += same(skip, name, gpu.render(gaussians, request).expect("a frame"), want);
            }
        }
        assert!(boxed > 1_000, "the switch of tiles does switch: {boxed} pairs more");
    }
}

#[test]
fn the_shaders_know_their_switches() {
    for skip in Skip::ALL.into_iter().filter(|skip| *skip != Skip::Blocks) {
        let name = skip.constant();
        // Declared, and asked for at least once.
        let used = SHADERS.iter().any(|shader| shader.source.matches(&name).count() > 1);
        assert!(used, "{name}");
    }
}

/// A Gaussian of degree 0.
fn one() -> Gaussians {
    let mut raw = RawGaussians::default();
    push(&mut raw, [0.0, 0.0, 3.0], [1.0, 0.0, 0.0, 0.0], [0.1; 3], 0.9, &[[0.5; 3]]);
    checked(raw)
}

/// The kernels that a device runs for one Gaussian.
fn dispatches(without: Option<Skip>) -> Option<Vec<&'static str>> {
    let gpu = open(|options| options.switches.without = without)?;
    let times = gpu.device_times(&one(), &request(camera(64, 48))).expect("times");
    Some(times?.stages.iter().map(|time| time.stage).collect())
}

#[test]
fn a_gpu_runs_one_more_kernel_without_the_skip_of_the_host() {
    let Some(want) = dispatches(None) else { return };
    let count = |all: &[&str], name| all.iter().filter(|&&one| one == name).count();
    assert_eq!(count(&want, "shade"), 0, "{want:?}");
    let shaded = dispatches(Some(Skip::FlatColor)).expect("the same adapter");
    assert_eq!(count(&shaded, "shade"), 1, "{shaded:?}");
}

/// Pixels of a tile, blended from footprints that no stage gives, so that a skip shows.
fn tile(footprints: &[Footprint], without: Option<Skip>) -> Vec<[f32; 3]> {
    let request = RenderRequest {
        kinds: Kinds::COLOR,
        background: Background::BLACK,
        ..request(camera(16, 16))
    };
    let entries = vec![0; footprints.len()];
    let options = KernelOptions { without, ..KernelOptions::default() };
    let view = View::new(glam::DVec3::ZERO, &request).expect("a view");
    let paint = Paint::new(&request, &view, &entries, 0.0, options);
    let mut pairs: Vec<u64> = (0..footprints.len() as u64).collect();
    let mut color = vec![[9.0; 3]; 256];
    let mut out =
        PictureRows { color: Some(color.chunks_mut(16).collect()), ..PictureRows::default() };
    let place = Tile { x: 0, y: 0, width: 16, height: 16 };
    let mut scratch = TileScratch::default();
    rasterize_tile(footprints, &mut pairs, place, 0, &paint, &mut scratch, &mut out);
    color
}

/// Of the other switches of the CPU, pairs show that of the tiles, and nothing but the time shows
/// that of flat colours.
#[test]
fn every_switch_of_the_blend_on_the_cpu_does_switch() {
    let wall = Footprint {
        mean: [8.0; 2],
        conic_x: 1e-3,
        conic_y: 1e-3,
        power_max: 6.0,
        opacity: 0.999,
        depth: 1.0,
        color: [0.5; 3],
        ..Footprint::default()
    };
    // It says that it ends beside its centre, where no pixel is.
    let short = Footprint { power_max: -1.0, ..wall };
    assert_eq!(tile(&[short], None), [[0.0; 3]; 256], "no part is touched");
    assert_ne!(tile(&[short], Some(Skip::EllipseParts)), [[0.0; 3]; 256], "all parts are");
    // Four walls end every ray. What is behind them has weight 0, and 0 times NaN is NaN.
    let bad = Footprint { color: [f32::NAN; 3], ..wall };
    let behind = [wall, wall, wall, wall, bad];
    let has_nan = |pixels: &[[f32; 3]]| pixels.iter().flatten().any(|value| value.is_nan());
    assert!(!has_nan(&tile(&behind, None)), "ended rays see nothing");
    assert!(has_nan(&tile(&behind, Some(Skip::EndedRays))), "ended rays are blended on");
}
