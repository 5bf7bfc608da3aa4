//! Views larger than the network's own pictures: no dot grid, and no change at its own size.

use segsplat::{
    formats::{splats::GLB, table::read_splats},
    limits::Limits,
    render::{
        Frame, Kinds, RenderRequest, Renderer,
        cpu::CpuRenderer,
        plan::{ViewMethod, sources},
    },
    scene::{
        Backdrop, Camera, CameraToWorld, Gaussians, HealthReport, Intrinsics, Provenance,
        RawGaussians, Scene, SceneCamera, SceneId, SceneMeta, SceneOptions, SourcePixel,
    },
    service::scene_splats,
};

const SIDE: u16 = 48;

/// A camera at the origin, `zoom` times larger than the network's picture.
fn camera(zoom: u32) -> Camera {
    let side = f64::from(SIDE) * f64::from(zoom);
    Camera {
        intrinsics: Intrinsics {
            fx: side,
            fy: side,
            cx: side / 2.0,
            cy: side / 2.0,
            width: u32::from(SIDE) * zoom,
            height: u32::from(SIDE) * zoom,
        },
        camera_to_world: CameraToWorld::from_row_major(
            &[1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.],
            "test",
        )
        .expect("the identity is a pose"),
    }
}

/// A wall at depth 4 as a network makes it: one small Gaussian a pixel.
fn wall() -> Scene {
    let mut raw = RawGaussians::default();
    let own = camera(1).intrinsics;
    for i in 0..SIDE * SIDE {
        let (x, y) = (i % SIDE, i / SIDE);
        let mean = own.unproject(f64::from(x) + 0.5, f64::from(y) + 0.5, 4.0);
        raw.means.push(mean.to_array().map(|v| v as f32));
        raw.quats.push([1.0, 0.0, 0.0, 0.0]);
        raw.scales.push([0.3 * 4.0 / f32::from(SIDE); 3]);
        raw.opacities.push(0.9);
        raw.sh.push([1.0, 0.5, 0.0]);
        raw.semantic_index.push(0);
        raw.source.push(SourcePixel { view: 0, x, y });
    }
    let report = HealthReport { network_focal_px: vec![own.fx], ..HealthReport::default() };
    let meta = SceneMeta {
        id: SceneId::from_bytes([1; 16]),
        created_ms: 0,
        cameras: vec![SceneCamera { file: "a.png".to_owned(), camera: camera(1), network: None }],
        report,
        provenance: Provenance::default(),
    };
    let gaussians = Gaussians::sanitize(raw).expect("equal lengths").0;
    Scene::new(meta, gaussians, Backdrop::default())
}

/// Alpha of the scene, magnified or not.
fn drawn(scene: &Scene, camera: Camera, magnified: bool) -> Frame {
    let kinds = Kinds { color: false, depth: false, alpha: true };
    let mut request = RenderRequest::plain(camera, kinds, 0.01);
    if magnified {
        request.sources = sources(scene, &camera, ViewMethod::from(&scene.meta.report.method));
    }
    let frame = CpuRenderer::new(1).and_then(|cpu| cpu.render(&scene.gaussians, &request));
    frame.expect("a wall renders")
}

/// Smallest alpha away from the picture's border.
fn least(frame: Frame) -> f32 {
    let (width, alpha) = (frame.width as usize, frame.alpha.expect("alpha was asked for"));
    let inner = width / 4..3 * width / 4;
    let rows = inner.clone().flat_map(|y| inner.clone().map(move |x| y * width + x));
    rows.fold(1.0, |least, i| least.min(alpha[i]))
}

#[test]
fn the_networks_own_size_is_left_alone() {
    let scene = wall();
    assert_eq!(drawn(&scene, camera(1), true), drawn(&scene, camera(1), false));
}

#[test]
fn a_magnified_wall_has_no_dot_grid() {
    let scene = wall();
    let own = least(drawn(&scene, camera(1), true));
    let gap = least(drawn(&scene, camera(4), false));
    let filled = least(drawn(&scene, camera(4), true));
    assert!(gap < 0.5 * own, "without it the wall has gaps: {gap} against {own}");
    assert!(filled > 0.85 * own, "with it the wall is whole: {filled} against {own}");
}

/// Programs that know nothing of photos show a file as views show the scene, near it too.
#[test]
fn a_file_has_the_blur_of_magnified_views() {
    let scene = wall();
    let mut files = vec![Vec::new(); 2];
    let file = scene_splats(&GLB, &scene, &scene.gaussians, None).expect("a file");
    file.write(&mut files[0]).expect("memory");
    let read = |file: &[u8]| {
        let read = read_splats(&mut &file[..], "a.glb", &Limits::default()).expect("a file");
        read.into_scene(&SceneOptions::default()).expect("a scene")
    };
    let again = read(&files[0]);
    for zoom in [2, 4, 8] {
        let camera = camera(zoom);
        let [view, shown] =
            [drawn(&scene, camera, true), drawn(&again, camera, false)].map(|frame| {
                let pixels = frame.alpha.expect("alpha was asked for");
                (pixels.iter().sum::<f32>() / pixels.len() as f32, pixels)
            });
        assert!((view.0 - shown.0).abs() < 0.05, "{zoom}: {} is not {}", shown.0, view.0);
        let gap = least(drawn(&scene, camera, false));
        let filled = least(drawn(&again, camera, false));
        assert!(filled > 0.8, "{zoom}: {filled}, without the blur {gap}");
    }
    // It is there once: a file of a file is the same.
    let file = scene_splats(&GLB, &again, &again.gaussians, None).expect("a file");
    file.write(&mut files[1]).expect("memory");
    assert!(read(&files[1]).gaussians.scales() == again.gaussians.scales());
}
