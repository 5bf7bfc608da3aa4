//! A scene's view put together of layers and backdrop, and what is copied for it.

use std::sync::LazyLock;

use glam::DVec3;
use parking_lot::Mutex;
use segsplat_core::{
    error::Result,
    scene::{
        Backdrop, Camera, Gaussians, HealthReport, Provenance, RawGaussians, Scene, SceneCamera,
        SceneId, SceneMeta, SourcePixel,
    },
};
use segsplat_render::{
    Frame, Kinds, Labels, PixelWeights, RenderRequest, Renderer, ViewPlanner, cpu::CpuRenderer,
};

use segsplat_testing::scenes::{Random, camera, checked, look, push, request};

/// One planner for all tests of this file.
fn planner() -> &'static ViewPlanner {
    static PLANNER: LazyLock<ViewPlanner> = LazyLock::new(ViewPlanner::default);
    &PLANNER
}

/// The CPU renderer, which remembers what it was asked for.
struct Watched {
    cpu: CpuRenderer,
    seen: Mutex<Vec<(u64, RenderRequest)>>,
}

impl Watched {
    fn new() -> Self {
        Self { cpu: CpuRenderer::new(2).expect("two threads"), seen: Mutex::default() }
    }

    /// Identities and requests since the last call.
    fn take(&self) -> Vec<(u64, RenderRequest)> {
        std::mem::take(&mut *self.seen.lock())
    }
}

impl Renderer for Watched {
    fn name(&self) -> String {
        "watched".to_owned()
    }

    fn concurrency(&self) -> usize {
        2
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        let mut seen = self.seen.lock();
        seen.push((gaussians.identity(), request.clone()));
        self.cpu.render(gaussians, request)
    }
}

/// A camera of 40 x 30 at `x`, looking along +z.
fn at(x: f64) -> Camera {
    let mut camera = camera(40, 30);
    camera.camera_to_world = look(DVec3::new(x, 0.0, 0.0), DVec3::new(x, 0.0, 4.0));
    camera
}

/// `photos` photos in a row, 0.5 apart, each with 150 Gaussians of its own, indices 1..=4; what
/// they see is so large that no view magnifies it.
fn scene(photos: u16, opacity: [f32; 2]) -> Scene {
    let (mut raw, mut random) = (RawGaussians::default(), Random(5));
    for view in 0..photos {
        for i in 0..150 {
            let z = random.range(3.0, 5.0);
            let x = 0.5 * f32::from(view) + random.range(-1.5, 1.5);
            let mean = [x, random.range(-1.2, 1.2), z];
            let color = [(); 3].map(|()| random.range(-1.5, 1.5));
            let opacity = random.range(opacity[0], opacity[1]);
            push(&mut raw, mean, random.quat(), [0.12, 0.1, 0.02], opacity, &[color]);
            raw.semantic_index[usize::from(view) * 150 + i] = 1 + (random.bits() % 4) as u16;
            raw.source[usize::from(view) * 150 + i] = SourcePixel { view, x: 0, y: 0 };
        }
    }
    let focal = 10.0 * camera(40, 30).intrinsics.fx;
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
    let backdrop = Backdrop::from_cells(vec![[10, 200, 60]; cells]).expect("all cells");
    Scene::new(meta, checked(raw), backdrop)
}

/// Views whose Gaussians are in a layer.
fn views(gaussians: &Gaussians) -> Vec<u16> {
    let mut views: Vec<u16> = gaussians.source().iter().map(|source| source.view).collect();
    views.dedup();
    views
}

#[test]
fn the_four_photos_closest_to_the_camera_are_in_front() {
    for few in 2..=4 {
        assert!(
            planner().layers(&scene(few, [0.2, 0.8]), &at(0.0)).is_none(),
            "{few} photos make every view"
        );
    }
    let all = scene(7, [0.2, 0.8]);
    for (x, front, behind) in [
        (0.0, [0, 1, 2, 3], [4, 5, 6]),
        (3.0, [3, 4, 5, 6], [0, 1, 2]),
        (1.76, [2, 3, 4, 5], [0, 1, 6]),
    ] {
        let layers = planner().layers(&all, &at(x)).expect("seven photos are layered");
        assert_eq!(views(&layers[0]), front, "in front of x = {x}");
        assert_eq!(views(&layers[1]), behind, "behind at x = {x}");
        let total: usize = layers.iter().map(Gaussians::len).sum();
        assert_eq!(total, all.gaussians.len(), "every Gaussian is in one layer");
    }
    // Gaussians keep what belongs to them.
    let layers = planner().layers(&all, &at(3.0)).expect("layers");
    let first = 3 * 150;
    assert_eq!(layers[0].means()[..9], all.gaussians.means()[first..first + 9], "means");
    let index = all.gaussians.semantic_index();
    assert_eq!(layers[0].semantic_index()[..9], index[first..first + 9], "bank indices");

    // A photo taken from the very place that looks away is not close.
    let mut turned = all.clone();
    let pose = look(DVec3::ZERO, DVec3::new(0.0, 0.0, -4.0));
    turned.meta.cameras[0].camera.camera_to_world = pose;
    let layers = planner().layers(&turned, &at(0.0)).expect("layers");
    assert_eq!(views(&layers[0]), [1, 2, 3, 4], "a turn costs");
    // A photo of which nothing is known is never in front.
    let mut unknown = all.clone();
    unknown.meta.report.network_focal_px[1] = 0.0;
    let layers = planner().layers(&unknown, &at(0.0)).expect("layers");
    assert_eq!(views(&layers[0]), [0, 2, 3, 4], "an unused photo");
    let mut flat = all;
    flat.meta.report.median_depth = 0.0;
    assert!(planner().layers(&flat, &at(0.0)).is_none(), "no depth, no measure");
}

#[test]
fn layers_are_front_over_behind_in_every_picture_and_label() {
    let scene = scene(6, [0.05, 0.4]);
    let cpu = CpuRenderer::new(2).expect("two threads");
    let layers = planner().layers(&scene, &at(0.2)).expect("layers");
    let table = [[0.0; 4], [1.0, 2.0, -1.0, 0.5], [0.25; 4], [-3.0, 0.0, 1.0, 2.0]];
    for labels in [Labels::None, Labels::Blend(table.into()), Labels::Weights] {
        let asked = RenderRequest { labels, ..request(at(0.2)) };
        let bare = RenderRequest { background: [0.0; 3], ..asked.clone() };
        let [front, behind] = [0, 1].map(|k| cpu.render(&layers[k], &bare).expect("a layer"));
        let got = planner().render(&cpu, &scene, &asked, false).expect("a view");
        let (fa, ba) = (front.alpha.as_ref().unwrap(), behind.alpha.as_ref().unwrap());
        let close = |a: f32, b: f32, what: &str, i: usize| {
            assert!((a - b).abs() < 1e-5 * b.abs().max(1.0), "{what} of pixel {i}: {a}, not {b}");
        };
        let mut open = 0;
        for i in 0..fa.len() {
            let room = 1.0 - fa[i];
            open += usize::from(room > 0.05 && ba[i] > 0.05);
            let alpha = fa[i] + room * ba[i];
            close(got.alpha.as_ref().unwrap()[i], alpha, "alpha", i);
            for c in 0..3 {
                let over = |frame: &Frame| frame.color.as_ref().unwrap()[i][c];
                let want =
                    over(&front) + room * over(&behind) + (1.0 - alpha) * asked.background[c];
                close(over(&got), want, "colour", i);
            }
            let depth = |frame: &Frame| frame.depth.as_ref().unwrap()[i];
            let both = fa[i] * depth(&front) + room * ba[i] * depth(&behind);
            close(depth(&got), if alpha > 0.0 { both / alpha } else { 0.0 }, "depth", i);
            if let (Some(got), Some(front), Some(behind)) =
                (&got.blend, &front.blend, &behind.blend)
            {
                for c in 0..4 {
                    close(got[i][c], front[i][c] + room * behind[i][c], "blend", i);
                }
            }
            if let (Some(got), Some(front), Some(behind)) =
                (&got.weights, &front.weights, &behind.weights)
            {
                for m in 1..=4 {
                    let of = |weights: &PixelWeights| {
                        weights.pixel(i).find(|entry| entry.0 == m).map_or(0.0, |entry| entry.1)
                    };
                    close(of(got), of(front) + room * of(behind), "entry", i);
                }
            }
        }
        assert!(open > 100, "only {open} pixels show both layers");
        assert_eq!(got.blend.is_some(), matches!(asked.labels, Labels::Blend(_)), "blend");
        assert_eq!(got.weights.is_some(), asked.labels == Labels::Weights, "weights");
        let stats = [front, behind].map(|frame| frame.stats.visible);
        assert_eq!(got.stats.visible, stats[0] + stats[1], "counts of both layers");
    }
}

#[test]
fn the_backdrop_fills_colour_alone_and_a_mask_pays_for_no_picture() {
    let scene = scene(3, [0.05, 0.4]);
    let watched = Watched::new();
    let plain = RenderRequest { background: [0.0; 3], ..request(at(0.3)) };
    let bare = watched.cpu.render(&scene.gaussians, &plain).expect("a picture");
    let color_only = RenderRequest { kinds: Kinds::COLOR, ..plain.clone() };
    let filled = planner().render(&watched, &scene, &color_only, true).expect("a view");
    assert_eq!((filled.alpha, filled.depth), (None, None), "pictures not asked for");
    let (color, alpha) = (bare.color.expect("colour"), bare.alpha.expect("alpha"));
    let behind = [10.0, 200.0, 60.0].map(|v: f32| v / 255.0);
    for (i, got) in filled.color.expect("colour").iter().enumerate() {
        for c in 0..3 {
            let want = color[i][c] + (1.0 - alpha[i]) * behind[c];
            assert!((got[c] - want).abs() < 1e-5, "pixel {i}: {got:?}, not {want} at {c}");
        }
    }
    watched.take();

    // Labels are the same with and without it, and cost one pass without alpha.
    for labels in [Labels::Weights, Labels::Blend([[1.0; 4]; 5].into())] {
        let mask = RenderRequest { kinds: Kinds::NONE, labels, ..plain.clone() };
        let with = planner().render(&watched, &scene, &mask, true).expect("a mask");
        let seen = watched.take();
        assert_eq!(seen.len(), 1, "one pass");
        assert_eq!(seen[0].1.kinds, Kinds::NONE, "no picture");
        let without = planner().render(&watched, &scene, &mask, false).expect("a mask");
        assert_eq!(with, without, "the backdrop adds nothing to labels");
        let all = RenderRequest { kinds: Kinds::ALL, ..mask };
        let all = planner().render(&watched, &scene, &all, true).expect("everything");
        assert_eq!((all.blend, all.weights), (with.blend, with.weights), "beside pictures");
        watched.take();
    }
}

#[test]
fn what_is_hidden_is_not_drawn() {
    let mut walled = scene(6, [0.2, 0.8]);
    let mut raw: RawGaussians = walled.gaussians.as_raw().clone();
    for k in 0..3_u8 {
        push(
            &mut raw,
            [0.2, 0.0, 2.0 + f32::from(k)],
            [1.0, 0.0, 0.0, 0.0],
            [50.0; 3],
            1.0,
            &[[0.5; 3]],
        );
    }
    walled.gaussians = checked(raw);
    let watched = Watched::new();
    planner().render(&watched, &walled, &request(at(0.2)), true).expect("a view");
    assert_eq!(watched.take().len(), 1, "a wall in front hides the layer behind");
    let open = scene(6, [0.05, 0.4]);
    planner().render(&watched, &open, &request(at(0.2)), true).expect("a view");
    assert_eq!(watched.take().len(), 2, "both layers");
}

#[test]
fn a_repeated_camera_set_copies_nothing() {
    let watched = Watched::new();
    // Seen larger than the network saw it, so that layers are magnified too.
    let mut scene = scene(7, [0.05, 0.4]);
    scene.meta.report.network_focal_px = vec![10.0; 7];
    let cameras = [0.0, 1.1, 3.0].map(at);
    let mut first = Vec::new();
    for round in 0..3 {
        for camera in cameras {
            planner().render(&watched, &scene, &request(camera), true).expect("a view");
        }
        let mut identities: Vec<u64> = watched.take().iter().map(|seen| seen.0).collect();
        if round == 0 {
            first.clone_from(&identities);
            let layered = planner().layers(&scene, &cameras[0]).expect("layers");
            let magnified =
                planner().magnified(&scene, &layered[0], &cameras[0]).expect("magnified");
            assert_eq!(identities[0], magnified.identity(), "the front layer, magnified");
        }
        assert_eq!(identities, first, "round {round} draws other Gaussians");
        identities.sort_unstable();
        identities.dedup();
        assert_eq!(identities.len(), 6, "two layers for each of three cameras");
    }
    // Another photo's focal length is another answer.
    scene.meta.report.network_focal_px[0] = 11.0;
    planner().render(&watched, &scene, &request(cameras[0]), true).expect("a view");
    assert_ne!(watched.take()[0].0, first[0], "made for another network picture");
    // Other Gaussians are too.
    let index = vec![2; scene.gaussians.len()];
    scene.gaussians = scene.gaussians.with_semantic_index(index).expect("an index a Gaussian");
    let frame = planner().render(
        &watched,
        &scene,
        &RenderRequest { labels: Labels::Weights, ..request(cameras[0]) },
        true,
    );
    let weights = frame.expect("a view").weights.expect("weights");
    assert!(weights.entries.iter().all(|&m| m == 2) && !weights.entries.is_empty(), "old indices");
}

/// A renderer whose pixels are a quarter of white, of alternating opacity.
struct Checkered;

impl Renderer for Checkered {
    fn name(&self) -> String {
        "checkered".to_owned()
    }

    fn concurrency(&self) -> usize {
        1
    }

    fn render(&self, _: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        let lens = request.lens();
        let pixels = (lens.width * lens.height) as usize;
        Ok(Frame {
            width: lens.width,
            height: lens.height,
            color: Some(vec![[0.25; 3]; pixels]),
            alpha: Some((0..pixels).map(|i| if i % 2 == 0 { 1.0 } else { 0.25 }).collect()),
            ..Frame::default()
        })
    }
}

#[test]
fn the_backdrop_shows_only_where_alpha_leaves_room() {
    let mut scene = scene(3, [0.2, 0.8]);
    let cells = Backdrop::WIDTH * Backdrop::HEIGHT;
    scene.backdrop = Backdrop::from_cells(vec![[255; 3]; cells]).expect("all cells");
    let asked = RenderRequest { kinds: Kinds::COLOR, ..request(at(0.3)) };
    let frame = planner().render(&Checkered, &scene, &asked, true).expect("a view");
    for (i, color) in frame.color.expect("colour").into_iter().enumerate() {
        assert_eq!(color, if i % 2 == 0 { [0.25; 3] } else { [1.0; 3] }, "pixel {i}");
    }
}
