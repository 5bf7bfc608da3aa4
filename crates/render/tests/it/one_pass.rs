//! What the GPU gives beside plain pictures, in the same pass: layers, magnification, backdrops,
//! levels, depth in steps and masks. Pictures in f32 and masks are held to the CPU renderer and the
//! oracle, levels to the pictures in f32.

use std::sync::Arc;

use segsplat_core::scene::{Backdrop, Region, Scene};
use segsplat_render::{
    Background, Frame, Kinds, Labels, Layer, RenderRequest, Renderer, Samples, gpu::GpuRenderer,
    oracle, plan::served,
};
use segsplat_testing::{frames::rounded, labels::table, scenes::request};

use crate::{
    common::{both_kernels, cpu, judge, open},
    compose::{at, scene, without},
    pool::at_once,
};

const ALPHA: Kinds = Kinds { color: false, depth: false, alpha: true };
const DEPTH: Kinds = Kinds { color: false, depth: true, alpha: false };

/// Views of a scene with levels, sizes and parts of all sorts.
fn views(scene: &Scene) -> Vec<RenderRequest> {
    let mut all = Vec::new();
    let crop = Some(Region { x: 5, y: 3, width: 31, height: 18 });
    for crop in [None, crop] {
        for kinds in [Kinds::ALL, Kinds::COLOR, ALPHA, DEPTH] {
            let one = RenderRequest { kinds, crop, ..request(at(0.7)) };
            all.push(one.clone());
            all.push(served(scene, one));
        }
    }
    all
}

fn draw(gpu: &GpuRenderer, scene: &Scene, request: &RenderRequest) -> Frame {
    gpu.render(&scene.gaussians, request).expect("a view of the GPU")
}

#[test]
fn views_of_many_photos_are_those_of_the_cpu() {
    for gpu in both_kernels() {
        for (photos, opacity, coarse) in
            [(3, [0.05, 0.4], 0.1), (7, [0.2, 0.9], 3.0), (2, [0.5, 0.9], 9.0)]
        {
            let scene = scene(photos, opacity, coarse);
            let asked = served(&scene, request(at(1.3)));
            let name = format!("{photos} photos, {coarse} times");
            let frame = judge(gpu, &name, &scene.gaussians, &asked);
            // Each of the three changes the picture.
            let mut other = asked.clone();
            other.background = Background::BLACK;
            assert_ne!(draw(gpu, &scene, &other).color, frame.color, "{name}: backdrop");
            let with = |change: &dyn Fn(&mut segsplat_render::Source)| {
                let mut rows = asked.sources.to_vec();
                rows.iter_mut().for_each(change);
                let other = RenderRequest { sources: rows.into(), ..asked.clone() };
                draw(gpu, &scene, &other).color != frame.color
            };
            assert_eq!(with(&|row| row.layer = Layer::Front), photos > 4, "{name}: layers");
            assert!(with(&|row| row.scale = 0.0), "{name}: size");
            let asked = without(&asked, &[0, usize::from(photos) - 1]);
            judge(gpu, &format!("{name}, two left out"), &scene.gaussians, &asked);
        }
    }
}

/// Levels of one picture and of the other: the largest difference.
fn apart(got: &[u8], want: &[u8]) -> u8 {
    assert_eq!(got.len(), want.len(), "as many levels");
    got.iter().zip(want).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0)
}

/// Holds pictures in levels to those in f32.
fn judge_levels(name: &str, got: &Frame, exact: Frame, samples: Samples) {
    let alpha_too = exact.alpha.clone().unwrap_or_else(|| vec![0.0; exact.color.iter().len()]);
    let exact = Frame { alpha: Some(alpha_too), ..exact };
    let want = rounded(exact, samples).levels;
    let flat = |levels: &segsplat_render::Levels| -> Vec<u8> {
        let rgb = levels.rgb.iter().flatten().flatten();
        rgb.chain(levels.rgba.iter().flatten().flatten()).copied().collect()
    };
    assert!(got.color.is_none() && got.alpha.is_none() && got.depth.is_none(), "{name}: no f32");
    assert!(apart(&flat(&got.levels), &flat(&want)) <= 1, "{name}: colour");
    if let Some(alpha) = &got.levels.alpha {
        assert_eq!(apart(alpha, want.alpha.as_ref().expect("alpha")), 0, "{name}: alpha");
    }
    match (&got.levels.depth, &want.depth) {
        (Some(got), Some(want)) => {
            assert_eq!(got.scale, want.scale, "{name}: size of a step");
            assert_eq!(got.steps.len(), want.steps.len(), "{name}: steps");
            let pairs = got.steps.iter().zip(&want.steps);
            let worst = pairs.map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0);
            assert!(worst <= 1, "{name}: {worst} steps apart");
        }
        (got, want) => assert_eq!(got.is_some(), want.is_some(), "{name}: depth"),
    }
}

#[test]
fn levels_are_the_rounded_pictures() {
    let scene = scene(6, [0.1, 0.9], 2.0);
    let total = draw_total(&scene);
    let Some(banded) = open(|options| options.switches.isects_max = Some(total * 3 / 4)) else {
        return;
    };
    let mut all: Vec<&GpuRenderer> = both_kernels().collect();
    all.push(&banded);
    for gpu in all {
        for (i, view) in views(&scene).into_iter().enumerate() {
            for samples in [Samples::Levels, Samples::LevelsRgba] {
                // With alpha, so that the fourth channel has what it is held to.
                let mut exact = view.clone();
                exact.kinds.alpha = true;
                let exact = draw(gpu, &scene, &exact);
                let exact = Frame {
                    alpha: exact.alpha.clone().filter(|_| view.kinds.alpha || view.kinds.color),
                    ..exact
                };
                let asked = RenderRequest { samples, ..view.clone() };
                let got = draw(gpu, &scene, &asked);
                assert_eq!(got.levels.alpha.is_some(), view.kinds.alpha, "view {i}: alpha");
                judge_levels(&format!("view {i}, {samples:?}"), &got, exact, samples);
            }
        }
    }
}

/// Pairs of the widest view.
fn draw_total(scene: &Scene) -> u32 {
    let frame = cpu().render(&scene.gaussians, &request(at(0.7))).expect("a view");
    frame.stats.intersections as u32
}

#[test]
fn masks_are_those_of_the_cpu() {
    let scene = scene(6, [0.1, 0.9], 2.0);
    let table: Arc<[[f32; 4]]> =
        table(5, 3).iter().map(|&[_, a, b, c]| [1.0, a + 0.4, b + 0.4, c + 0.4]).collect();
    let total = draw_total(&scene);
    let Some(banded) = open(|options| options.switches.isects_max = Some(total * 3 / 4)) else {
        return;
    };
    let mut all: Vec<&GpuRenderer> = both_kernels().collect();
    all.push(&banded);
    for gpu in all {
        for (i, mut asked) in views(&scene).into_iter().enumerate() {
            let labels = Labels::Mask { table: Arc::clone(&table), coverage_floor: 0.3 };
            asked.labels = labels;
            if i == 0 {
                asked.kinds = Kinds::NONE;
            }
            asked.samples = if i % 3 == 0 { Samples::F32 } else { Samples::Levels };
            let got = draw(gpu, &scene, &asked).mask.expect("a mask");
            let want = cpu().render(&scene.gaussians, &asked).expect("a mask").mask;
            let want = want.expect("a mask");
            let on = want.iter().filter(|&&byte| byte == 255).count();
            assert!(on > 20 && on < want.len() - 20, "{on} of {} pixels are on", want.len());
            let truth = oracle::render(&scene.gaussians, &asked).expect("the truth");
            assert_eq!((got.len(), want.len()), (truth.len(), truth.len()), "a byte a pixel");
            for (at, (got, want)) in got.iter().zip(&want).enumerate() {
                let cliff = truth[at].cliff;
                assert!(got == want || cliff.any(), "view {i}: pixel {at} is {got}, {cliff:?}");
            }
        }
    }
}

#[test]
fn views_of_one_scene_share_a_submission_whatever_lies_behind() {
    let scene = scene(6, [0.1, 0.9], 2.0);
    let cells = Backdrop::WIDTH * Backdrop::HEIGHT;
    let other: Arc<Backdrop> =
        Backdrop::from_cells(vec![[9, 200, 77]; cells]).expect("all cells").into();
    let Some(gpu) = open(|_| {}) else { return };
    let mut wanted = Vec::new();
    for i in 0..16 {
        let mut one = served(&scene, request(at(0.1 * f64::from(i))));
        one.samples = [Samples::F32, Samples::Levels, Samples::LevelsRgba][i as usize % 3];
        match i % 4 {
            0 => one.background = Background::Backdrop(Arc::clone(&other)),
            1 => one.background = Background::Color([0.5, 0.25, 0.125]),
            2 => one.sources = Arc::default(),
            _ => one.crop = Some(Region { x: i, y: 2, width: 20 + i % 5, height: 13 }),
        }
        wanted.push(one);
    }
    let alone: Vec<_> = wanted.iter().map(|one| draw(&gpu, &scene, one)).collect();
    let before = gpu.internals().submissions();
    let got = at_once(&gpu, &scene.gaussians, &wanted);
    for (i, (got, want)) in got.iter().zip(&alone).enumerate() {
        assert!(got == want, "view {i} among others");
    }
    let (submissions, views) = gpu.internals().submissions();
    let (submissions, views) = (submissions - before.0, views - before.1);
    assert!(views == 16 && submissions <= 6, "{views} views in {submissions} submissions");
}
