//! Views of scenes of many photos as they are served: layers, magnification, backdrop, levels and
//! masks, each against the oracle.

use std::{ops::RangeInclusive, sync::Arc};

use glam::DVec3;
use segsplat_core::scene::{
    Backdrop, Camera, HealthReport, Provenance, RawGaussians, Scene, SceneCamera, SceneId,
    SceneMeta, SourcePixel,
};
use segsplat_render::{
    Background, Frame, Kinds, Labels, Layer, RenderRequest, Renderer, Samples,
    oracle::{self, OraclePixel},
    plan::{ViewMethod, served, sources},
};
use segsplat_testing::{
    compare::{Tolerance, compare, oracle_samples, samples},
    frames::rounded,
    labels::table,
    scenes::{Random, camera, checked, look, push, request},
};

use crate::common::cpu;

/// A camera of 41 x 30 at `x`, looking along +z.
pub(crate) fn at(x: f64) -> Camera {
    let mut camera = camera(41, 30);
    camera.camera_to_world = look(DVec3::new(x, 0.0, 0.0), DVec3::new(x, 0.0, 4.0));
    camera
}

/// `photos` photos in a row, 0.5 apart, each with 150 Gaussians of its own, entries 1..=4, and a
/// backdrop of random colours. The photos' pixels are `coarse` times larger than those of [`at`].
pub(crate) fn scene(photos: u16, opacity: [f32; 2], coarse: f64) -> Scene {
    let (mut raw, mut random) = (RawGaussians::default(), Random(5));
    raw.origin = DVec3::new(0.25, -0.5, 0.125);
    for view in 0..photos {
        for i in 0..150 {
            let z = random.range(3.0, 5.0);
            let x = 0.5 * f32::from(view) + random.range(-1.5, 1.5) - 0.25;
            let mean = [x, random.range(-1.2, 1.2) + 0.5, z - 0.125];
            let color = [(); 3].map(|()| random.range(-1.5, 1.5));
            let opacity = random.range(opacity[0], opacity[1]);
            push(&mut raw, mean, random.quat(), [0.12, 0.1, 0.02], opacity, &[color]);
            raw.semantic_index[usize::from(view) * 150 + i] = 1 + (random.bits() % 4) as u16;
            raw.source[usize::from(view) * 150 + i] = SourcePixel { view, x: 0, y: 0 };
        }
    }
    let focal = camera(41, 30).intrinsics.fx / coarse;
    let report = HealthReport {
        network_focal_px: vec![focal; usize::from(photos)],
        median_depth: 4.0,
        ..HealthReport::default()
    };
    let photo =
        |i| SceneCamera { file: format!("{i}.png"), camera: at(0.5 * f64::from(i)), network: None };
    let meta = SceneMeta {
        id: SceneId::from_bytes([7; 16]),
        created_ms: 0,
        cameras: (0..photos).map(photo).collect(),
        report,
        provenance: Provenance::default(),
    };
    let cells = Backdrop::WIDTH * Backdrop::HEIGHT;
    let cells = (0..cells).map(|_| [(); 3].map(|()| random.bits() as u8)).collect();
    Scene::new(meta, checked(raw), Backdrop::from_cells(cells).expect("all cells"))
}

/// Photos in front of and behind a view.
fn layers(scene: &Scene, x: f64) -> [Vec<usize>; 2] {
    let rows = sources(scene, &at(x), ViewMethod::from(&scene.meta.report.method));
    let of = |layer| (0..rows.len()).filter(|&i| rows[i].layer == layer).collect();
    [of(Layer::Front), of(Layer::Behind)]
}

#[test]
fn the_four_photos_closest_to_the_camera_are_in_front() {
    for few in 2..=4 {
        let [_, behind] = layers(&scene(few, [0.2, 0.8], 0.1), 0.0);
        assert!(behind.is_empty(), "{few} photos make every view");
    }
    let all = scene(7, [0.2, 0.8], 0.1);
    for (x, front, behind) in [
        (0.0, [0, 1, 2, 3], [4, 5, 6]),
        (3.0, [3, 4, 5, 6], [0, 1, 2]),
        (1.76, [2, 3, 4, 5], [0, 1, 6]),
    ] {
        assert_eq!(layers(&all, x), [front.to_vec(), behind.to_vec()], "at x = {x}");
    }

    // A photo taken from the very place that looks away is not close.
    let mut turned = all.clone();
    let pose = look(DVec3::ZERO, DVec3::new(0.0, 0.0, -4.0));
    turned.meta.cameras[0].camera.camera_to_world = pose;
    assert_eq!(layers(&turned, 0.0)[0], [1, 2, 3, 4], "a turn costs");
    // A photo of which nothing is known is never in front.
    let mut unknown = all.clone();
    unknown.meta.report.network_focal_px[1] = 0.0;
    assert_eq!(layers(&unknown, 0.0)[0], [0, 2, 3, 4], "an unused photo");
    let mut flat = all;
    flat.meta.report.median_depth = 0.0;
    assert!(layers(&flat, 0.0)[1].is_empty(), "no depth, no measure");
}

/// Pictures of the CPU renderer in f32, held to the oracle; and what the oracle says.
fn judged(name: &str, scene: &Scene, request: &RenderRequest) -> (Frame, Vec<OraclePixel>) {
    let got = cpu().render(&scene.gaussians, request).expect("a view");
    let truth = oracle::render(&scene.gaussians, request).expect("the truth");
    let cliff: Vec<bool> = truth.iter().map(|pixel| pixel.cliff.any()).collect();
    let want = oracle_samples(&truth);
    let found = compare(&samples(&got), &want, &cliff, Tolerance::ORACLE);
    let found = found.unwrap_or_else(|told| panic!("{name}: {told}"));
    println!("{name}: max {:.2e}, mean {:.2e}, {} flips", found.max, found.mean, found.flips);
    (got, truth)
}

/// How coarse photos are whose Gaussians a view shows at their own size.
const OWN_SIZES: RangeInclusive<f64> = 0.8..=1.25;

#[test]
fn views_of_many_photos_are_those_of_the_oracle() {
    // Photos, opacities, and how coarse the photos are: seen smaller, at their own size, magnified.
    for (photos, opacity, coarse) in
        [(3, [0.05, 0.4], 0.1), (6, [0.05, 0.4], 1.0), (7, [0.2, 0.9], 3.0), (2, [0.5, 0.9], 9.0)]
    {
        let scene = scene(photos, opacity, coarse);
        for x in [0.2, 1.3] {
            let name = format!("{photos} photos, {coarse} times, at {x}");
            let plain = request(at(x));
            let request = served(&scene, plain.clone());
            let (frame, _) = judged(&name, &scene, &request);
            // Each of the three changes the picture.
            let without = |change: &dyn Fn(&mut RenderRequest)| {
                let mut other = request.clone();
                change(&mut other);
                cpu().render(&scene.gaussians, &other).expect("a view").color != frame.color
            };
            assert!(without(&|r| r.background = plain.background.clone()), "{name}: backdrop");
            let flat = |r: &mut RenderRequest, change: &dyn Fn(&mut segsplat_render::Source)| {
                let mut rows = r.sources.to_vec();
                rows.iter_mut().for_each(change);
                r.sources = rows.into();
            };
            let layers = without(&|r| flat(r, &|row| row.layer = Layer::Front));
            assert_eq!(layers, photos > 4, "{name}: layers");
            let scaled = without(&|r| flat(r, &|row| row.scale = 0.0));
            assert_eq!(scaled, !OWN_SIZES.contains(&coarse), "{name}: size");
        }
    }
}

/// A view of a scene in which what these photos gave is left out.
pub(crate) fn without(request: &RenderRequest, photos: &[usize]) -> RenderRequest {
    let mut request = request.clone();
    let rows = Arc::make_mut(&mut request.sources);
    photos.iter().for_each(|&photo| rows[photo].layer = Layer::LeftOut);
    request
}

#[test]
fn what_a_photo_gave_can_be_left_out() {
    // Seen smaller, magnified, and as the antialiased mode has it.
    for (coarse, antialiased) in [(0.1, false), (3.0, false), (1.0, true)] {
        let scene = scene(6, [0.2, 0.9], coarse);
        let name = format!("{coarse} times, antialiased: {antialiased}");
        let asked = RenderRequest { antialiased, ..served(&scene, request(at(1.1))) };
        for left_out in [&[2][..], &[0, 5], &[0, 1, 2, 3, 4, 5]] {
            let asked = without(&asked, left_out);
            let (frame, _) = judged(&name, &scene, &asked);
            let source = scene.gaussians.source();
            let copy = scene.gaussians.only(|i| !left_out.contains(&source[i].view.into()));
            let of_copy = cpu().render(&copy, &asked).expect("a view");
            assert_eq!(frame, of_copy, "{name}: no bit is another one without {left_out:?}");
        }
    }
}

#[test]
fn levels_are_the_rounded_pictures() {
    let scene = scene(6, [0.1, 0.9], 2.0);
    for background in [Background::BLACK, Background::Backdrop(Arc::clone(&scene.backdrop))] {
        let exact = RenderRequest { background, ..served(&scene, request(at(0.7))) };
        let frame = cpu().render(&scene.gaussians, &exact).expect("a view");
        for samples in [Samples::Levels, Samples::LevelsRgba] {
            let asked = RenderRequest { samples, ..exact.clone() };
            let got = cpu().render(&scene.gaussians, &asked).expect("a view");
            let want = rounded(frame.clone(), samples);
            assert_eq!(got.levels.depth, want.levels.depth, "depth");
            assert_eq!(got.levels.alpha, want.levels.alpha, "alpha");
            let flat = |frame: &Frame| -> Vec<u8> {
                let rgb = frame.levels.rgb.iter().flatten().flatten();
                rgb.chain(frame.levels.rgba.iter().flatten().flatten()).copied().collect()
            };
            let (got, want) = (flat(&got), flat(&want));
            assert_eq!(got.len(), want.len(), "{samples:?}");
            // Half a level of the backdrop may be missing where hardly any light passes.
            let apart = got.iter().zip(&want).filter(|(a, b)| a != b);
            let far = apart.clone().filter(|(a, b)| a.abs_diff(**b) > 1).count();
            assert_eq!(far, 0, "levels over one apart");
            assert!(apart.count() * 50 < got.len(), "many levels are apart");
        }
    }
}

#[test]
fn masks_are_those_of_the_oracle_and_of_the_blend() {
    let scene = scene(6, [0.1, 0.9], 2.0);
    let table: Arc<[[f32; 4]]> =
        table(5, 3).iter().map(|&[_, a, b, c]| [1.0, a + 0.4, b + 0.4, c + 0.4]).collect();
    let labels = Labels::Mask { table: Arc::clone(&table), coverage_floor: 0.3 };
    for kinds in [Kinds::NONE, Kinds::ALL] {
        let asked =
            served(&scene, RenderRequest { kinds, labels: labels.clone(), ..request(at(0.7)) });
        let got = cpu().render(&scene.gaussians, &asked).expect("a mask").mask.expect("a mask");
        let truth = oracle::render(&scene.gaussians, &asked).expect("the truth");
        let on = truth.iter().filter(|pixel| pixel.mask).count();
        assert!(on > 100 && on < truth.len() - 100, "{on} of {} pixels are on", truth.len());
        for (i, (got, want)) in got.iter().zip(&truth).enumerate() {
            let same = *got == if want.mask { 255 } else { 0 };
            assert!(same || want.cliff.any(), "{kinds:?}: pixel {i} is {got}, not {want:?}");
        }
    }
}

#[test]
fn what_no_light_passes_shows_no_backdrop() {
    let mut scene = scene(3, [0.99, 1.0], 1.0);
    let cells = Backdrop::WIDTH * Backdrop::HEIGHT;
    scene.backdrop = Backdrop::from_cells(vec![[255; 3]; cells]).expect("all cells").into();
    let request = RenderRequest { samples: Samples::Levels, ..request(at(0.3)) };
    let draw =
        |request: &RenderRequest| cpu().render(&scene.gaussians, request).expect("a view").levels;
    let asked = served(&scene, request);
    let black = draw(&RenderRequest { background: Background::BLACK, ..asked.clone() });
    let white = draw(&asked);
    let alpha = white.alpha.expect("alpha");
    let pairs = black.rgb.iter().flatten().zip(white.rgb.iter().flatten()).zip(alpha);
    let (mut opaque, mut open) = (0, 0);
    for ((black, white), alpha) in pairs {
        if alpha == 255 {
            opaque += 1;
            assert_eq!(black, white, "an opaque pixel");
        } else if alpha < 250 && black.iter().all(|&level| level < 250) {
            open += 1;
            assert!((0..3).all(|c| white[c] > black[c]), "{white:?} of alpha {alpha}");
        }
    }
    assert!(opaque > 20 && open > 20, "{opaque} opaque pixels, {open} open ones");
}
