//! Views of scene files: cameras and texts as requests give them, and the files of pictures.

use std::sync::Arc;

use glam::DVec3;
use segsplat::{
    error::{Error, ErrorCode, Result},
    jobs::NoSemantics,
    limits::Limits,
    render::{Frame, RenderRequest, Renderer},
    scene::{
        Backdrop, Camera, CameraToWorld, Gaussians, HealthReport, Intrinsics, Provenance,
        RawGaussians, Scene, SceneCamera, SceneId, SceneMeta, SourcePixel,
    },
    service::{
        BackgroundSpec, CameraFields, CameraSpec, Format, LensSpec, OfflineService, PictureKind,
        PictureOptions, PoseSpec, QuerySpec, RenderedView, Rle, TextOptions, ViewOptions, ViewSpec,
    },
};
use segsplat_testing::frames::rounded;

/// Answers every request with one frame.
struct Given(Frame);

impl Renderer for Given {
    fn name(&self) -> String {
        "given".to_owned()
    }

    fn concurrency(&self) -> usize {
        1
    }

    fn render(&self, _: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        Ok(rounded(self.0.clone(), request.samples))
    }
}

fn service(frame: Frame) -> OfflineService {
    OfflineService::new(Arc::new(NoSemantics), Arc::new(Given(frame)), &[], Limits::default())
}

/// One Gaussian before two cameras.
fn scene() -> Arc<Scene> {
    let raw = RawGaussians {
        means: vec![[0.0, 0.0, 2.0]],
        quats: vec![[1.0, 0.0, 0.0, 0.0]],
        scales: vec![[0.1; 3]],
        opacities: vec![0.9],
        sh: vec![[0.0; 3]],
        semantic_index: vec![0],
        source: vec![SourcePixel::default()],
        ..RawGaussians::default()
    };
    let meta = SceneMeta {
        id: SceneId::from_bytes([1; 16]),
        created_ms: 0,
        cameras: inputs(),
        report: HealthReport { median_depth: 2.0, ..HealthReport::default() },
        provenance: Provenance::default(),
    };
    Arc::new(Scene::new(meta, Gaussians::sanitize(raw).unwrap().0, Backdrop::default()))
}

/// A view from the first camera.
fn view(kind: PictureKind) -> ViewSpec {
    ViewSpec {
        camera: between(0.0),
        kind,
        options: ViewOptions::default(),
        picture: PictureOptions::default(),
        text: TextOptions::default(),
    }
}

fn render(frame: Frame, spec: &ViewSpec) -> Result<RenderedView> {
    service(frame).render(&scene(), spec)
}

/// The error of a query: texts that can be read need networks.
fn query(texts: &[&str]) -> Error {
    let texts = texts.iter().map(|text| (*text).to_owned()).collect();
    let spec = QuerySpec { texts, ..QuerySpec::default() };
    service(Frame::default()).query(&scene(), &spec).expect_err("refused")
}

fn inputs() -> Vec<SceneCamera> {
    let at = |x: f64, turn: f64| {
        let eye = DVec3::new(x, 0.0, 0.0);
        let target = eye + DVec3::new(turn.sin(), 0.0, turn.cos());
        let camera_to_world = CameraToWorld::look_at(eye, target, DVec3::NEG_Y, "test").unwrap();
        let intrinsics =
            Intrinsics { fx: 400.0, fy: 410.0, cx: 250.0, cy: 190.0, width: 500, height: 400 };
        SceneCamera {
            file: String::new(),
            camera: Camera { intrinsics, camera_to_world },
            network: None,
        }
    };
    vec![at(0.0, 0.0), at(1.0, 0.5)]
}

fn between(t: f64) -> CameraSpec {
    CameraSpec { pose: PoseSpec::Between { from: 0, to: 1, t }, lens: LensSpec::OfScene }
}

fn sized(width: Option<u32>, height: Option<u32>) -> ViewOptions {
    ViewOptions { width, height, ..ViewOptions::default() }
}

fn resolved(spec: &CameraSpec, options: &ViewOptions) -> Result<Camera> {
    let alpha = Frame { width: 1, height: 1, alpha: Some(vec![0.0]), ..Frame::default() };
    let spec = ViewSpec { camera: *spec, options: options.clone(), ..view(PictureKind::Alpha) };
    Ok(render(alpha, &spec)?.camera)
}

#[test]
fn the_ends_of_a_way_are_the_input_cameras_themselves() {
    let inputs = inputs();
    for (t, input) in [(0.0, &inputs[0]), (1.0, &inputs[1])] {
        let camera = resolved(&between(t), &sized(Some(500), Some(400))).unwrap();
        let a = camera.camera_to_world.matrix();
        let b = input.camera.camera_to_world.matrix();
        assert!(a.abs_diff_eq(b, 1e-12), "t = {t}: {a} is not {b}");
        assert_eq!(camera.intrinsics, input.camera.intrinsics);
    }
}

#[test]
fn halfway_is_half_the_way_and_half_the_turn() {
    let camera = resolved(&between(0.5), &sized(None, None)).unwrap();
    let pose = camera.camera_to_world;
    assert!((pose.center() - DVec3::new(0.5, 0.0, 0.0)).length() < 1e-12);
    assert!((pose.axis() - DVec3::new(0.25_f64.sin(), 0.0, 0.25_f64.cos())).length() < 1e-9);
}

#[test]
fn a_lens_fitted_to_another_shape_keeps_square_pixels_and_the_middle() {
    let camera = resolved(&between(0.0), &sized(Some(1000), Some(400))).unwrap();
    let Intrinsics { fx, fy, cx, cy, .. } = camera.intrinsics;
    assert_eq!((fx, fy), (800.0, 820.0), "twice the size");
    assert_eq!((cx, cy), (500.0, 380.0 - 200.0), "rows cut above and below alike");
}

#[test]
fn a_missing_side_follows_the_shape_of_the_photos() {
    for (options, want) in [
        (sized(Some(250), None), (250, 200)),
        (sized(None, Some(800)), (1000, 800)),
        (sized(None, None), (384, 307)),
    ] {
        let lens = resolved(&between(0.0), &options).unwrap().intrinsics;
        assert_eq!((lens.width, lens.height), want);
    }
}

#[test]
fn look_at_without_up_stands_as_the_photos_stand() {
    let pose = PoseSpec::LookAt { eye: [0.0, 0.0, -2.0], target: [0.0; 3], up: None };
    let spec = CameraSpec { pose, lens: LensSpec::Fov(90.0) };
    let camera = resolved(&spec, &sized(Some(300), Some(200))).unwrap();
    assert!((camera.camera_to_world.rotation().y_axis - DVec3::Y).length() < 1e-12);
    assert!((camera.intrinsics.fy - 100.0).abs() < 1e-9, "90 degrees: half the height");
}

#[test]
fn what_cannot_be_is_refused_with_name_value_and_bound() {
    let eye = |eye| PoseSpec::LookAt { eye, target: [0.0; 3], up: None };
    let focal = |fx| LensSpec::Focal { fx, fy: None, cx: None, cy: None };
    let fine = eye([0.0, 0.0, -1.0]);
    let spec = |pose, lens| CameraSpec { pose, lens };
    let cases = [
        (between(1.5), sized(None, None), "t is 1.5"),
        (between(f64::NAN), sized(None, None), "t is NaN"),
        (
            spec(PoseSpec::Between { from: 0, to: 7, t: 0.0 }, LensSpec::OfScene),
            sized(None, None),
            "to is 7; the scene has 2 cameras",
        ),
        (between(0.0), sized(Some(0), None), "width is 0 px"),
        (between(0.0), sized(None, Some(100_000)), "height: 100000 px is over 4096 px"),
        (spec(fine, focal(0.0)), sized(None, None), "fx is 0"),
        (spec(fine, focal(-3.0)), sized(None, None), "fx is -3"),
        (spec(fine, focal(f64::INFINITY)), sized(None, None), "not a finite number"),
        (spec(fine, focal(1e9)), sized(None, None), "fx is 1000000000 px"),
        (spec(fine, LensSpec::Fov(180.0)), sized(None, None), "fov is 180"),
        (spec(eye([0.0; 3]), LensSpec::OfScene), sized(None, None), "the same point"),
        (spec(eye([1e30, 0.0, 0.0]), LensSpec::OfScene), sized(None, None), "1e30"),
    ];
    for (spec, options, want) in cases {
        let error = resolved(&spec, &options).expect_err(want);
        assert!(error.message().contains(want), "{:?} lacks {want:?}", error.message());
    }
}

#[test]
fn fields_that_do_not_go_together_are_refused_by_name() {
    let eye = Some([0.0, 0.0, -1.0]);
    let of = CameraFields::default;
    let cases = [
        (of(), "no pose given"),
        (CameraFields { eye, ..of() }, "eye and target go together"),
        (CameraFields { t: Some(0.5), ..of() }, "need from"),
        (CameraFields { eye, from: Some(0), ..of() }, "not several"),
        (CameraFields { from: Some(0), cx: Some(1.0), ..of() }, "need fx"),
        (CameraFields { from: Some(0), fx: Some(1.0), fov: Some(50.0), ..of() }, "not both"),
    ];
    for (fields, part) in cases {
        let error = CameraSpec::try_from(fields).expect_err("refused");
        assert!(error.message().contains(part), "{} lacks {part}", error.message());
    }
    let spec = CameraSpec::try_from(CameraFields { from: Some(2), ..of() }).unwrap();
    assert_eq!(spec.pose, PoseSpec::Between { from: 2, to: 2, t: 0.0 });
    assert_eq!(spec.lens, LensSpec::OfScene);
}

#[test]
fn backgrounds_are_names_hex_or_numbers() {
    let color = |text: &str| text.parse::<BackgroundSpec>().map(BackgroundSpec::color);
    assert_eq!(color("backdrop").unwrap(), None);
    assert_eq!(color("white").unwrap(), Some([1.0; 3]));
    assert_eq!(color("#ff0000").unwrap(), Some([1.0, 0.0, 0.0]));
    assert_eq!(color("0, 0.5,1").unwrap(), Some([0.0, 0.5, 1.0]));
    for odd in ["", "#ff00", "#ggffff", "1,2", "a,b,c", "#+fffff"] {
        assert!(color(odd).unwrap_err().contains("#rrggbb"), "{odd} was taken");
    }
}

#[test]
fn a_text_is_refused_for_what_is_wrong_with_it() {
    let refused = |text: &str| {
        let error = query(&["a", "b", "c", text]);
        assert!(error.message().starts_with("texts[3]"), "{error}");
        (error.code(), error.message().to_owned())
    };
    assert!(refused("").1.contains("empty"));
    assert!(refused(" \u{a0} ").1.contains("empty"), "blanks alone");
    let (code, message) = refused(&"x".repeat(10_000));
    assert_eq!(code, ErrorCode::LimitExceeded);
    assert!(message.contains("10000 characters") && message.contains("256"), "{message}");
    assert!(refused("a\u{7}b").1.contains("U+0007 at 1"));
    assert!(refused("line\n").1.contains("U+000A at 4"));
    for good in ["chair", "🦊", "кресло", "a red  chair", &"é".repeat(256)] {
        assert_eq!(query(&[good]).code(), ErrorCode::ModelUnavailable, "{good} is read");
    }
}

#[test]
fn there_are_1_to_128_texts() {
    let refused = |count: usize| query(&vec!["chair"; count]).code();
    assert_eq!(refused(0), ErrorCode::InvalidRequest);
    assert_eq!(refused(128), ErrorCode::ModelUnavailable, "they are read");
    assert_eq!(refused(129), ErrorCode::LimitExceeded);
}

fn frame() -> Frame {
    Frame {
        width: 3,
        height: 1,
        color: Some(vec![[-1.0, 0.0, 0.5], [1.0, 7.0, f32::NAN], [0.2, 0.25, 0.999]]),
        depth: Some(vec![0.0, 2.0, 4.0]),
        alpha: Some(vec![0.0, 0.5, 1.0]),
        ..Frame::default()
    }
}

fn encode(frame: Frame, kind: PictureKind, format: Format) -> Result<RenderedView> {
    let background = BackgroundSpec::Color([0.0; 3]);
    let picture = PictureOptions { format, background, ..PictureOptions::default() };
    render(frame, &ViewSpec { picture, ..view(kind) })
}

fn decoded(kind: PictureKind, format: Format) -> image::DynamicImage {
    image::load_from_memory(&encode(frame(), kind, format).unwrap().bytes).unwrap()
}

#[test]
fn colour_is_clamped_and_rounded_and_nan_is_black() {
    let want = [0, 0, 128, 255, 255, 0, 51, 64, 255];
    for format in [Format::Png, Format::Webp] {
        assert_eq!(decoded(PictureKind::Color, format).to_rgb8().as_raw()[..], want, "{format:?}");
    }
}

#[test]
fn depth_png_times_its_scale_is_the_depth() {
    let scale = encode(frame(), PictureKind::Depth, Format::Png).unwrap().depth_scale.unwrap();
    let steps = decoded(PictureKind::Depth, Format::Png).to_luma16();
    let depths: Vec<f64> = steps.as_raw().iter().map(|&v| f64::from(v) * scale).collect();
    for (got, want) in depths.iter().zip([0.0, 2.0, 4.0]) {
        assert!((got - want).abs() <= scale / 2.0, "{got} is not {want}");
    }
    let of = |depth: [f32; 3]| {
        encode(Frame { depth: Some(depth.to_vec()), ..frame() }, PictureKind::Depth, Format::Png)
            .unwrap()
    };
    let near = image::load_from_memory(&of([1e-9, 1.0, 1.0]).bytes).unwrap().to_luma16();
    assert_eq!(near.as_raw()[0], 1, "there, though near");
    assert_eq!(of([0.0; 3]).depth_scale, Some(1.0), "an empty picture has a scale too");
}

#[test]
fn npy_holds_every_bit() {
    let file = encode(frame(), PictureKind::Color, Format::Npy).unwrap().bytes;
    assert_eq!(file.len() % 4, 0);
    let header_end = file.iter().position(|&b| b == b'\n').unwrap() + 1;
    assert_eq!(header_end % 64, 0);
    let header = String::from_utf8_lossy(&file[10..header_end]);
    assert!(header.contains("'shape': (1, 3, 3)") && header.contains("'<f4'"), "{header}");
    let bits: Vec<[u8; 4]> = file[header_end..].chunks(4).map(|b| b.try_into().unwrap()).collect();
    let want = frame().color.unwrap().into_iter().flatten().map(f32::to_le_bytes);
    assert!(bits.into_iter().eq(want));
}

#[test]
fn depth_is_not_squeezed_into_8_bits() {
    for format in [Format::Jpeg, Format::Webp] {
        let error = encode(frame(), PictureKind::Depth, format).unwrap_err();
        assert!(error.message().contains("npy"), "{error}");
    }
    assert_eq!(decoded(PictureKind::Alpha, Format::Png).to_luma8().as_raw()[..], [0, 128, 255]);
}

fn mask(rows: &[&str]) -> (Vec<bool>, u32, u32) {
    let pixels = rows.iter().flat_map(|row| row.bytes().map(|b| b == b'#')).collect();
    (pixels, rows[0].len() as u32, rows.len() as u32)
}

fn counts(rows: &[&str]) -> String {
    let (pixels, width, height) = mask(rows);
    Rle::encode(&pixels, width, height).counts
}

#[test]
fn counts_are_those_of_pycocotools() {
    // Written by pycocotools 2.0.11.
    assert_eq!(counts(&["....", "...."]), "8");
    assert_eq!(counts(&["####", "####"]), "08");
    assert_eq!(counts(&["#...", "..#.", ".##."]), "0140M12");
    assert_eq!(counts(&[".#.#.#", "#.#.#.", ".....#"]), "111020N020N000");
    assert_eq!(counts(&["..#...", "..#..#"]), "425O");
    let (width, height) = (97_i64, 61_i64);
    let at = |i: i64| (i % width - 40).pow(2) + (i / width - 30).pow(2) < 500;
    let disc: Vec<bool> = (0..width * height).map(at).collect();
    let disc = Rle::encode(&disc, 97, 61);
    assert_eq!(disc.size, [61, 97]);
    assert_eq!(
        disc.counts,
        "US17b18J4L4L4M2N2N2N2N2O0O2O0O2O0O2O00000O2O000000000001N1000001N101N101N101N2N2N\
         2N2N3L4L4L6HSP2"
    );
}
