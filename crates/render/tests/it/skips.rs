//! What renderers leave out changes no pixel: each skip switched off gives the same frame.
//! What each saves is measured by `segsplat-lab skips`, not here.

use segsplat_core::scene::Gaussians;
use segsplat_render::{Frame, Labels, RenderRequest, Renderer, cpu::CpuRenderer, skip::Skip};

use crate::twins::open;
use segsplat_testing::labels::{labelled, table};
use segsplat_testing::scenes::{camera, cloud, look, request, two_views};

/// Scenes and views in which every skip has something to leave out: Gaussians beside the picture
/// and behind the camera, tiles without any, walls, harmonics, labels.
fn cases() -> Vec<(&'static str, Gaussians, RenderRequest)> {
    let (pair, middle) = two_views(64, 3);
    let mut aside = camera(150, 90);
    aside.camera_to_world = look(glam::DVec3::new(2.0, 0.5, 4.0), glam::DVec3::new(9.0, 0.0, 7.0));
    let small = request(camera(70, 50));
    let entered = RenderRequest { labels: Labels::Weights, ..small };
    let blended = RenderRequest { labels: Labels::Blend(table(9, 8)), ..small };
    vec![
        ("a Gaussian a pixel", pair, request(middle)),
        ("few, seen from aside", cloud(300, 0, 4), request(aside)),
        ("harmonics", cloud(2_000, 2, 5), request(camera(97, 61))),
        ("blended labels", labelled(2_000, 8, 7), blended),
        ("weights", labelled(2_000, 8, 8), entered),
    ]
}

/// The same frame; boxes have more tiles than ellipses, and Gaussians in them that no pixel sees.
fn same(skip: Skip, name: &str, mut got: Frame, want: &Frame) {
    if skip == Skip::EllipseTiles {
        let (boxes, ellipses) = (got.stats, want.stats);
        assert!(boxes.intersections >= ellipses.intersections, "{name}: {boxes:?}, {ellipses:?}");
        got.stats = ellipses;
    }
    assert!(got == *want, "without {}: {name} differs", skip.name());
}

#[test]
fn on_the_cpu_no_bit_changes() {
    let draw = |without, gaussians: &Gaussians, request: &RenderRequest| {
        let cpu = CpuRenderer::new(2).expect("two threads").without(without);
        cpu.render(gaussians, request).expect("a frame")
    };
    let mut boxed = 0;
    for (name, gaussians, request) in cases() {
        let want = draw(None, &gaussians, &request);
        for skip in Skip::ALL {
            let got = draw(Some(skip), &gaussians, &request);
            boxed += got.stats.intersections - want.stats.intersections;
            same(skip, name, got, &want);
        }
    }
    assert!(boxed > 1_000, "the switch of tiles does switch: {boxed} pairs more");
}

#[test]
fn on_a_gpu_no_bit_changes() {
    let scenes = cases();
    for serial in [false, true] {
        let Some(gpu) = open(|options| options.serial = Some(serial)) else { return };
        let draw = |(_, gaussians, request): &(_, _, _)| gpu.render(gaussians, request);
        let wanted: Vec<_> = scenes.iter().map(|case| draw(case).expect("a frame")).collect();
        for skip in Skip::ALL {
            let change = |options: &mut segsplat_render::gpu::GpuOptions| {
                (options.serial, options.without) = (Some(serial), Some(skip));
            };
            let Some(gpu) = open(change) else { return };
            for ((name, gaussians, request), want) in scenes.iter().zip(&wanted) {
                same(skip, name, gpu.render(gaussians, request).expect("a frame"), want);
            }
        }
    }
}
