//! A block that a view leaves out holds no Gaussian that the view would draw: on the CPU against
//! the projection of every Gaussian, on a device against pictures without blocks.

use std::sync::Arc;

use glam::{DVec2, DVec3};
use proptest::prelude::*;
use segsplat_core::scene::{Camera, Gaussians, Intrinsics, RawGaussians, Region, SourcePixel};
use segsplat_render::{
    Frame, Labels, Layer, RenderRequest, Renderer, Source, Switches,
    blocks::{BLOCK, Blocks, Frustum},
    constants::{ALPHA_MIN, TRANSMITTANCE_MIN},
    cpu::{
        CpuRenderer,
        cull::Shown,
        lanes::KernelOptions,
        project::{Projected, project},
    },
    oracle::{self, Contribution, Splat},
    surface,
    view::View,
};
use segsplat_testing::{
    labels::labelled,
    scenes::{Random, camera, checked, cloud, look, push, request, two_views},
};

use crate::common::open;

/// Gaussians of all sizes in all places: needles, giants, specks, far and near, of three photos.
fn scattered(count: usize, seed: u64) -> Gaussians {
    let (mut raw, mut random) = (RawGaussians::default(), Random(seed));
    for i in 0..count {
        let far = [1.0, 1.0, 1.0, 30.0, 1e5][(random.bits() % 5) as usize];
        let mean = [(); 3].map(|()| random.range(-4.0, 4.0) * far);
        let scale = match random.bits() % 40 {
            0 => [random.range(1.0, 50.0), 1e-3, 1e-4],
            1 => [random.range(0.5, 9.0); 3],
            2..20 => [random.range(0.001, 0.2), 0.01, 0.003],
            _ => [random.range(1e-6, 1e-2); 3],
        };
        push(&mut raw, mean, random.quat(), scale, random.range(0.004, 1.0), &[[0.5; 3]]);
        raw.source[i] = SourcePixel { view: (random.bits() % 4) as u16, x: 0, y: 0 };
    }
    checked(raw)
}

/// A camera anywhere, of any field of view, with a part of its picture and with photos or without.
pub(crate) fn any_request(random: &mut Random) -> RenderRequest {
    let degrees = [0.1, 3.0, 40.0, 90.0, 140.0, 170.0][(random.bits() % 6) as usize];
    let (width, height) = (20 + (random.bits() % 90) as u32, 20 + (random.bits() % 70) as u32);
    let focal = 0.5 * f64::from(width) / f64::to_radians(0.5 * degrees).tan();
    let mut place = |by: f32| DVec3::from([(); 3].map(|()| f64::from(random.range(-by, by))));
    let (eye, target) = (place(6.0), place(9.0) + DVec3::splat(0.01));
    let mut off = || f64::from(random.range(-0.7, 1.7));
    let intrinsics = Intrinsics {
        fx: focal,
        fy: focal * (1.0 + 0.4 * off().abs()),
        cx: f64::from(width) * off(),
        cy: f64::from(height) * off(),
        width,
        height,
    };
    let camera = Camera { intrinsics, camera_to_world: look(eye, target) };
    let source = |k: u32| Source {
        center: [k as f32 - 1.0, 0.3, -2.0],
        axis: [0.0, 0.0, 1.0],
        scale: [0.0, 0.002, 0.03][k as usize],
        layer: Layer::behind_if(k == 1),
    };
    let photos = random.bits().is_multiple_of(2);
    RenderRequest {
        near: [1e-3, 0.05, 3.0][(random.bits() % 3) as usize],
        antialiased: random.bits().is_multiple_of(3),
        crop: random.bits().is_multiple_of(3).then_some(Region {
            x: 3,
            y: 5,
            width: width - 9,
            height: height - 11,
        }),
        sources: if photos { (0..3).map(source).collect() } else { Arc::default() },
        ..request(camera)
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 48,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    #[test]
    fn no_block_that_is_left_out_holds_a_gaussian_that_is_drawn(seed in 0_u64..1_000_000) {
        let gaussians = scattered(5_000, seed);
        let blocks = Blocks::of(&gaussians);
        let mut random = Random(seed);
        for _ in 0..8 {
            let request = any_request(&mut random);
            let view = View::new(gaussians.origin(), &request).expect("a view");
            let frustum = Frustum::new(&view, &request);
            let mut projected = Projected::default();
            project(&gaussians, &request, &view, KernelOptions::default(), &mut projected);
            for (at, bounds) in blocks.bounds.iter().enumerate() {
                if !frustum.may_show(bounds) {
                    for &id in blocks.ids(at) {
                        let tiles = projected.tiles_per_gauss[id as usize];
                        prop_assert_eq!(tiles, 0, "block {} leaves out {}", at, id);
                    }
                }
            }
        }
    }
}

#[test]
fn blocks_hold_every_gaussian_once_and_bound_it() {
    for count in [1, BLOCK, BLOCK + 1, 5_000] {
        let gaussians = scattered(count, 3);
        let blocks = Blocks::of(&gaussians);
        let mut seen: Vec<u32> = (0..blocks.own).flat_map(|at| blocks.ids(at).to_vec()).collect();
        seen.sort_unstable();
        assert!(seen.into_iter().eq(0..count as u32), "{count}: each once");
        for (at, bounds) in blocks.bounds.iter().enumerate() {
            assert!(blocks.ids(at).is_sorted(), "{count}: block {at} ascends");
            for &id in blocks.ids(at) {
                let mean = gaussians.means()[id as usize];
                let inside = mean.iter().zip(bounds.center).zip(bounds.half);
                for ((mean, center), half) in inside {
                    assert!((mean - center).abs() <= half, "{count}: {id} is outside of {at}");
                }
                let scales = gaussians.scales()[id as usize];
                assert!(scales.iter().all(|&scale| scale <= bounds.reach), "{count}: {id}");
            }
        }
    }
}

/// Of a surface, most blocks beside the picture are left out, and all behind the camera.
#[test]
fn a_view_projects_little_more_than_it_shows() {
    let (gaussians, middle) = two_views(160, 3);
    let blocks = Blocks::of(&gaussians);
    let shown = |camera_to_world| {
        let request = request(Camera { camera_to_world, ..middle });
        let view = View::new(gaussians.origin(), &request).expect("a view");
        match Shown::of(&blocks, &Frustum::new(&view, &request)) {
            Shown::All => gaussians.len(),
            Shown::Some { ids, .. } => {
                assert!(ids.is_sorted(), "the order of the scene");
                ids.len()
            }
        }
    };
    assert_eq!(shown(middle.camera_to_world), gaussians.len(), "all are in the picture");
    assert_eq!(shown(look(DVec3::ZERO, DVec3::NEG_Z)), 0, "all are behind");
    let aside = shown(look(DVec3::ZERO, DVec3::new(4.0, 0.0, 4.0)));
    let share = aside as f64 / gaussians.len() as f64;
    assert!((0.2..0.65).contains(&share), "half of them is beside the picture: {share}");
}

/// Scenes and views of which blocks are left out, with equal depths and labels.
fn cases() -> Vec<(String, Gaussians, RenderRequest)> {
    let mut cases = Vec::new();
    let mut random = Random(7);
    for i in 0..12 {
        cases.push((format!("view {i}"), scattered(6_000, i), any_request(&mut random)));
    }
    let aside =
        Camera { camera_to_world: look(DVec3::ZERO, DVec3::new(3.0, 1.0, 2.0)), ..camera(90, 70) };
    // Walls of equal depth, in an order that is not that of the blocks.
    let mut raw = cloud(4_000, 2, 8).into_raw();
    for mean in &mut raw.means {
        mean[2] = mean[2].round();
    }
    let straight = camera(90, 70);
    cases.push((
        "equal depths".to_owned(),
        checked(raw),
        request(Camera { intrinsics: Intrinsics { cx: 150.0, ..straight.intrinsics }, ..straight }),
    ));
    let labels = RenderRequest { labels: Labels::Weights, ..request(aside) };
    cases.push(("labels".to_owned(), labelled(5_000, 8, 7), labels));
    cases
}

fn with_blocks(from: usize) -> Switches {
    Switches { blocks_min: Some(from), ..Switches::default() }
}

#[test]
fn pictures_of_the_cpu_with_blocks_have_the_same_bits() {
    let draw = |from: usize, gaussians: &Gaussians, request: &RenderRequest| -> Frame {
        let cpu = CpuRenderer::with_switches(2, &with_blocks(from)).expect("two threads");
        cpu.render(gaussians, request).expect("a frame")
    };
    for (name, gaussians, request) in cases() {
        let [got, want] = [1, usize::MAX].map(|from| draw(from, &gaussians, &request));
        assert!(got == want, "{name}: blocks show");
    }
}

#[test]
fn pictures_of_a_gpu_with_blocks_have_the_same_bits() {
    for serial in [false, true] {
        let gpu = |from: usize| {
            open(|options| {
                options.switches.serial = Some(serial);
                options.switches.blocks_min = Some(from);
            })
        };
        let (Some(with), Some(without)) = (gpu(1), gpu(usize::MAX)) else { return };
        for (name, gaussians, request) in cases() {
            let draw = |gpu: &dyn Renderer| gpu.render(&gaussians, &request).expect("a frame");
            assert!(draw(&with) == draw(&without), "{name}: blocks show");
        }
    }
}

/// Who asks for the surface at a pixel finds what all Gaussians say, of those of a few blocks.
#[test]
fn a_pixel_and_its_surface_need_a_few_blocks_alone() {
    let (mut pixels, mut surfaces, mut asked, mut there) = (0, 0, 0, 0);
    for seed in 0..12 {
        let mut random = Random(seed);
        // Small ones of a surface, which hardly reach a pixel beside them; or any, everywhere.
        let (gaussians, request) = if seed % 2 == 0 {
            let (gaussians, camera) = two_views(256, seed);
            let mut raw = gaussians.into_raw();
            raw.scales.as_flattened_mut().iter_mut().for_each(|scale| *scale *= 0.1);
            (checked(raw), request(camera))
        } else {
            let request = RenderRequest { crop: None, ..any_request(&mut random) };
            (scattered(30 * BLOCK, seed), request)
        };
        let lens = request.camera.intrinsics;
        let view = View::new(gaussians.origin(), &request).expect("a view");
        let blocks = Blocks::of(&gaussians);
        for _ in 0..10 {
            let pixel =
                [lens.width, lens.height].map(|side| (random.bits() % u64::from(side)) as u32);
            let at = pixel.map(|at| f64::from(at) + 0.5);
            let near = blocks.near(&Frustum::around(&view, &request, at, surface::reach(&lens)));
            let [all, few] = [None, Some(&near[..])].map(|among| {
                let found = oracle::contributions(&gaussians, &request, pixel, among);
                let found: Vec<_> = found
                    .expect("a pixel")
                    .iter()
                    .map(|one| (one.gaussian, one.depth, one.weight))
                    .collect();
                let depth = |&(_, depth, _): &(usize, f64, f64)| {
                    surface::depth(&gaussians, &request, at.into(), depth, among).expect("a pixel")
                };
                let depth = found.first().and_then(depth);
                (found, depth)
            });
            assert_eq!(few, all, "seed {seed}, {pixel:?}");
            surfaces += usize::from(all.1.is_some());
            (pixels, asked) = (pixels + usize::from(!all.0.is_empty()), asked + near.len());
            there += gaussians.len();
        }
    }
    assert!(pixels > 50 && surfaces > 30, "{pixels} pixels, {surfaces} surfaces");
    assert!(2 * asked < there, "{asked} of {there}");
}

/// Who asks for one pixel need not project every Gaussian, and finds what all of them give.
#[test]
fn what_adds_to_a_pixel_is_found_without_projecting_all() {
    let (mut pixels, mut adding) = (0, 0);
    for seed in 0..40 {
        let mut random = Random(seed);
        let (gaussians, request) = (scattered(400, seed), any_request(&mut random));
        let lens = request.camera.intrinsics;
        for _ in 0..25 {
            let pixel =
                [lens.width, lens.height].map(|side| (random.bits() % u64::from(side)) as u32);
            let at = DVec2::from(pixel.map(|at| f64::from(at) + 0.5));
            let adds = |i: usize| {
                let splat = oracle::splat(&gaussians, i, &request, &lens)?;
                (splat.alpha(at) >= f64::from(ALPHA_MIN)).then_some((i, splat))
            };
            let mut all: Vec<(usize, Splat)> = (0..gaussians.len()).filter_map(adds).collect();
            all.sort_by(|a, b| a.1.order(&b.1));
            let (mut left, mut wanted) = (1.0, Vec::new());
            for (gaussian, splat) in &all {
                let weight = left * splat.alpha(at);
                left *= 1.0 - splat.alpha(at);
                if left <= f64::from(TRANSMITTANCE_MIN) {
                    break;
                }
                wanted.push(Contribution { gaussian: *gaussian, depth: splat.depth, weight });
            }
            let found = oracle::contributions(&gaussians, &request, pixel, None).expect("a pixel");
            assert_eq!(found.len(), wanted.len(), "seed {seed}, {pixel:?}");
            for (found, wanted) in found.iter().zip(&wanted) {
                assert_eq!((found.gaussian, found.depth), (wanted.gaussian, wanted.depth));
                assert!((found.weight - wanted.weight).abs() < 1e-12, "{found:?}, not {wanted:?}");
            }
            (pixels, adding) = (pixels + usize::from(!all.is_empty()), adding + all.len());
        }
    }
    assert!(pixels > 300 && adding > 1_000, "{pixels} pixels, {adding} Gaussians");
}
