//! The program itself: what it prints, where, and with which exit code.

use std::{
    io::{BufRead, BufReader, ErrorKind},
    path::Path,
    process::{Child, Command, Output, Stdio},
};

use segsplat::{
    error::ErrorCode,
    formats::{
        container::write_scene,
        splats::{PLY, SplatFile},
    },
    models::{NetworkOptions, Runtime},
    scene::{
        Backdrop, Camera, CameraToWorld, Gaussians, HealthReport, Intrinsics, Provenance,
        RawGaussians, Scene, SceneCamera, SceneId, SceneMeta, SourcePixel,
    },
};
use serde_json::{Value, json};

use crate::common::{process::signal, skipped};

fn segsplat(args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_segsplat"));
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("SEGSPLAT_")) {
        command.env_remove(name);
    }
    command.current_dir(crate::common::root()).args(args).output().expect("the program starts")
}

fn ok(args: &[&str]) -> String {
    let output = segsplat(args);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{args:?} exited {:?}: {said}", output.status.code());
    String::from_utf8(output.stdout).expect("answers are UTF-8")
}

fn ok_json(args: &[&str]) -> Value {
    let answer = ok(&[args, &["--json"]].concat());
    serde_json::from_str(&answer).unwrap_or_else(|e| panic!("{args:?}: {e}: {answer}"))
}

/// The exit code is the code's row of the table, and standard error says what was wrong.
fn refused(args: &[&str], code: ErrorCode, want: &str) {
    let output = segsplat(&[args, &["--json"]].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(i32::from(code.row().exit)), "{args:?}: {said}");
    assert!(output.stdout.is_empty(), "{args:?}: an error is no answer");
    let error: Value = serde_json::from_str(said.lines().last().unwrap_or_default())
        .unwrap_or_else(|e| panic!("{args:?}: {e}: {said}"));
    assert_eq!(error["code"], code.name(), "{args:?}: {said}");
    let message = error["message"].as_str().unwrap_or_default();
    assert!(message.contains(want), "{args:?}: {message:?} lacks {want:?}");
}

/// A red plate before a camera at the origin and one a step to its right.
fn scene() -> Scene {
    let mut raw = RawGaussians::default();
    for i in 0..400_u16 {
        let (x, y) = (f32::from(i % 20) / 10.0 - 0.95, f32::from(i / 20) / 10.0 - 0.95);
        raw.means.push([x, y, 2.0]);
        raw.quats.push([1.0, 0.0, 0.0, 0.0]);
        raw.scales.push([0.08; 3]);
        raw.opacities.push(0.95);
        raw.sh.push([1.7, -1.7, -1.7]);
        raw.semantic_index.push(0);
        raw.source.push(SourcePixel::default());
    }
    let camera = |x: f64| {
        let mut pose = [0.0; 16];
        (0..4).for_each(|i| pose[i * 5] = 1.0);
        pose[3] = x;
        let intrinsics =
            Intrinsics { fx: 64.0, fy: 64.0, cx: 32.0, cy: 24.0, width: 64, height: 48 };
        let camera_to_world = CameraToWorld::from_row_major(&pose, "test").unwrap();
        SceneCamera {
            file: format!("{x}.png"),
            camera: Camera { intrinsics, camera_to_world },
            network: None,
        }
    };
    let meta = SceneMeta {
        id: SceneId::from_bytes([3; 16]),
        created_ms: 0,
        cameras: vec![camera(0.0), camera(0.2)],
        report: HealthReport { median_depth: 2.0, ..HealthReport::default() },
        provenance: Provenance::default(),
    };
    Scene::new(meta, Gaussians::sanitize(raw).unwrap().0, Backdrop::default())
}

/// A folder with the plate as `scene.segsplat` and `plate.ply`.
fn files() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let mut file = Vec::new();
    write_scene(&mut file, &scene()).unwrap();
    std::fs::write(folder.path().join("scene.segsplat"), file).unwrap();
    let mut ply = Vec::new();
    SplatFile::new(&PLY, scene().gaussians, None).unwrap().write(&mut ply).unwrap();
    std::fs::write(folder.path().join("plate.ply"), ply).unwrap();
    folder
}

fn text(path: &Path) -> &str {
    path.to_str().expect("temporary paths are UTF-8")
}

const CPU: [&str; 2] = ["--renderer", "cpu"];

#[test]
fn a_scene_is_rendered_from_file_folder_and_ply() {
    let folder = files();
    let at = |name: &str| folder.path().join(name);
    let eye = ["--eye", "0,0,-0.5", "--target", "0,0,2", "--fov", "40", "--width", "32"];
    let sized = ["--height", "24"];
    for (name, camera) in [
        ("scene.segsplat", &["--from", "0", "--to", "1"][..]),
        ("", &["--camera", "1"][..]),
        ("scene.segsplat", &eye[..]),
        ("plate.ply", &eye[..]),
    ] {
        let (scene, picture) = (at(name), at("x.png"));
        let line = [&["render", text(&scene), "-o", text(&picture)], camera, &CPU, &sized].concat();
        let answer = ok_json(&line);
        let png = image::open(&picture).unwrap().to_rgb8();
        assert_eq!((answer["width"].as_u64(), answer["height"].as_u64()), (Some(32), Some(24)));
        assert_eq!(png.dimensions(), (32, 24), "{line:?}");
        let [r, g, b] = png.get_pixel(16, 12).0;
        assert!(r > 200 && g < 60 && b < 60, "{line:?}: the plate is red, not {r},{g},{b}");
    }
}

#[test]
fn depth_is_written_with_its_scale_and_as_numbers() {
    let folder = files();
    let (scene, png) = (folder.path().join("scene.segsplat"), folder.path().join("d.png"));
    let npy = folder.path().join("d.npy");
    let render = |to: &Path| {
        let line = ["render", text(&scene), "--camera", "0", "--kind", "depth", "-o", text(to)];
        ok_json(&[&line[..], &CPU].concat())
    };
    let scale = render(&png)["depth_scale"].as_f64().unwrap();
    let step = image::open(&png).unwrap().to_luma16().get_pixel(32, 24).0[0];
    assert!((f64::from(step) * scale - 2.0).abs() < 0.01, "{step} * {scale}");
    assert!(render(&npy)["depth_scale"].is_null());
    let file = std::fs::read(&npy).unwrap();
    let middle = file.len() - 4 * (64 * 48 - (24 * 64 + 32));
    let depth = f32::from_le_bytes(file[middle..middle + 4].try_into().unwrap());
    assert!((depth - 2.0).abs() < 0.01, "{depth}");
}

#[test]
fn a_scene_is_inspected_for_people_and_for_machines() {
    let folder = files();
    let value = ok_json(&["inspect", text(folder.path())]);
    assert_eq!(
        (value["gaussians"].as_u64(), value["format"].as_str()),
        (Some(400), Some("segsplat"))
    );
    assert_eq!(value["meta"]["cameras"].as_array().unwrap().len(), 2);
    let ply = folder.path().join("plate.ply");
    assert_eq!(ok_json(&["inspect", text(&ply)])["format"], "ply");
    let words = ok(&["inspect", text(folder.path())]);
    assert!(words.contains("400 Gaussians") && words.contains("camera 1: 0.2.png"), "{words}");
}

#[test]
fn a_scene_is_written_as_a_folder_with_the_photos_that_are_named() {
    let folder = files();
    let at = |name: &str| folder.path().join(name);
    let (scene, zip) = (at("scene.segsplat"), at("plate.colmap.zip"));
    let line = ["export", text(&scene), "-o", text(&zip)];
    let answer = ok_json(&[&line[..], &CPU].concat());
    assert_eq!((answer["format"].as_str(), &answer["photos"]), (Some("colmap"), &0.into()));
    assert_eq!(answer["size_bytes"].as_u64(), Some(std::fs::metadata(&zip).unwrap().len()));
    let mut read = zip::ZipArchive::new(std::fs::File::open(&zip).unwrap()).unwrap();
    let mut map = Vec::new();
    let mut file = read.by_name("stereo/depth_maps/0.2.png.geometric.bin").unwrap();
    std::io::Read::read_to_end(&mut file, &mut map).unwrap();
    let middle = map.len() - 4 * (64 * 48 - (24 * 64 + 32));
    let depth = f32::from_le_bytes(map[middle..middle + 4].try_into().unwrap());
    assert!((depth - 2.0).abs() < 0.01, "{depth}");
    let refuse = |output: &str, rest: &[&str], code, want: &str| {
        let output = at(output);
        refused(&[&["export", text(&scene), "-o", text(&output)], rest].concat(), code, want);
        let names = std::fs::read_dir(folder.path()).unwrap();
        let names = names.map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let left = names.filter(|name| name.starts_with("x.")).collect::<Vec<_>>();
        assert!(left.is_empty(), "nothing is written, not {left:?}");
    };
    let invalid = ErrorCode::InvalidRequest;
    refuse(
        "x.zip",
        &[],
        invalid,
        "splat, sog.zip, colmap.zip, nerfstudio.zip, coco.zip, labelme.zip",
    );
    refuse("x.ply", &["--text", "a"], invalid, "--photos and --text go with folders, not with ply");
    refuse("x.colmap.zip", &["--text", "a", CPU[0], CPU[1]], invalid, "not with colmap");
    refuse("x.colmap.zip", &["--photos", "none"], invalid, "cannot be read");
}

#[test]
fn errors_name_what_is_wrong_and_exit_by_the_table() {
    let folder = files();
    let at = |name: &str| folder.path().join(name);
    let (good, bad, picture) = (at("scene.segsplat"), at("bad.segsplat"), at("x.png"));
    let mut file = std::fs::read(&good).unwrap();
    file[100] ^= 1;
    std::fs::write(&bad, file).unwrap();
    std::fs::write(at("bad.ply"), "ply\nformat ascii 1.0\n").unwrap();
    refused(&["inspect", text(&bad)], ErrorCode::SceneCorrupt, "checksum");
    refused(&["inspect", text(&at("bad.ply"))], ErrorCode::InvalidRequest, "only binary");
    refused(&["inspect", text(&at("none"))], ErrorCode::InvalidRequest, "cannot be read");
    let render = |rest: &[&str], code, want: &str| {
        let line = [&["render", text(&good), "-o", text(&picture)], rest, &CPU].concat();
        refused(&line, code, want);
    };
    render(&[], ErrorCode::InvalidRequest, "no camera");
    render(&["--camera", "7"], ErrorCode::InvalidRequest, "the scene has 2 cameras");
    render(&["--camera", "0", "--width", "0"], ErrorCode::InvalidRequest, "width is 0 px");
    render(&["--camera", "0", "--width", "100000"], ErrorCode::LimitExceeded, "over 4096 px");
    render(&["--eye", "0,0", "--target", "0,0,1"], ErrorCode::InvalidRequest, "2 numbers, not 3");
    render(&["--from", "0", "--quality", "best"], ErrorCode::InvalidRequest, "exact or fast");
    render(&["--from", "0", "--error", "40"], ErrorCode::InvalidRequest, "error is 40; it must be");
    render(&["--from", "7"], ErrorCode::InvalidRequest, "from is 7");
    render(&["--eye", "0,0,-1", "--target", "0,0,-1"], ErrorCode::InvalidRequest, "same point");
    let line = ["render", text(&good), "--camera", "0", "-o", text(&good), "--renderer", "cpu"];
    refused(&line, ErrorCode::InvalidRequest, "png, jpg, webp, npy, rgb8, rgba8 or grey8");
    assert!(!picture.exists(), "nothing was written");
    assert_eq!(segsplat(&["render"]).status.code(), Some(2), "usage");
    assert_eq!(segsplat(&["--help"]).status.code(), Some(0));
}

#[test]
fn an_output_that_cannot_be_written_is_refused_before_any_work() {
    let folder = files();
    let at = |name: &str| folder.path().join(name);
    let (scene, invalid) = (at("scene.segsplat"), ErrorCode::InvalidRequest);
    let nowhere = |name: &str| at("none").join(name).to_str().unwrap().to_owned();
    // The input is not there either, and is not looked at.
    let input = at("no-photos");
    let reconstruct = |output: &str, want: &str| {
        refused(&["reconstruct", text(&input), "-o", output], invalid, want);
    };
    reconstruct(text(&at("x.jpg")), "x.jpg: the ending must be segsplat");
    let lacks = format!("there is no folder {}; make it first", at("none").display());
    reconstruct(&nowhere("x.segsplat"), &lacks);
    let view = ["--camera", "0", CPU[0], CPU[1]];
    for line in [
        &[&["render", text(&input), "-o", &nowhere("x.png")], &view[..]].concat()[..],
        &[&["query", text(&input), "box", "-o", &nowhere("x.png")], &view[..]].concat(),
        &["features", text(&input), "-o", &nowhere("x.npz")],
        &["export", text(&input), "-o", &nowhere("x.ply")],
        &["export", text(&input), "-o", &nowhere("x.colmap.zip")],
    ] {
        refused(line, invalid, &lacks);
    }
    // A name without an ending, and a folder, are scene files as before.
    for output in [at("plain"), folder.path().to_owned()] {
        ok(&["reconstruct", text(&at("plate.ply")), "-o", text(&output)]);
    }
    assert!(at("plain").is_file() && scene.is_file());
}

#[test]
fn bench_says_the_time_of_a_view_and_its_error() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("scene.segsplat");
    ok(&["reconstruct", "tests/fixtures/splats/source.ply", "-o", text(&scene)]);
    let line = ["bench", text(&scene), "--frames", "3", "--width", "64", "--height", "48"];
    let told = ok_json(&[&line[..], &CPU].concat());
    let number = |place: &str| told.pointer(place).and_then(Value::as_f64).expect(place);
    assert_eq!([number("/width"), number("/height"), number("/frames")], [64.0, 48.0, 3.0]);
    assert!(number("/gaussians") > 0.0 && number("/visible") > 0.0, "{told}");
    assert!(number("/min_ms") > 0.0 && number("/min_ms") <= number("/median_ms"), "{told}");
    // Held to the oracle, not to itself: some rounding, and no fault.
    assert!(number("/error/max") > 0.0 && number("/error/max") < 1e-3, "{told}");
    assert_eq!(number("/error/faults"), 0.0);
    assert_eq!(told["renderer"], "cpu");
}

#[cfg(unix)]
#[test]
fn a_video_becomes_photos_where_ffmpeg_is_there() {
    use std::os::unix::fs::PermissionsExt;
    if !with_network() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (film, programs) = (folder.path().join("Film.MP4"), folder.path().join("bin"));
    std::fs::write(&film, "").unwrap();
    std::fs::create_dir(&programs).unwrap();
    let asked = || {
        let mut command = Command::new(env!("CARGO_BIN_EXE_segsplat"));
        command.current_dir(crate::common::root()).env("PATH", &programs);
        let output = command.args(["cameras", text(&film)]).output().unwrap();
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let exit = |code: ErrorCode| Some(i32::from(code.row().exit));
    let (code, said) = asked();
    assert_eq!(code, exit(ErrorCode::InvalidRequest), "{said}");
    assert!(said.contains("Film.MP4: it is a video, and there is no ffmpeg; install"), "{said}");
    // Stands for the program: three seconds that do not move, then the frames that are asked for,
    // of which the first is a picture.
    image::RgbImage::new(32, 32).save(programs.join("0.jpg")).unwrap();
    let program = programs.join("ffmpeg");
    let script = r#"#!/bin/sh
        case "$*" in
        *rawvideo*) /usr/bin/head -c $((320 * 240 * 30)) /dev/zero;;
        *"eq(n\,0)+eq(n\,2)+"*)
            /bin/cat "${0%/*}/0.jpg"
            for i in 1 2 3 4 5 6 7 8 9 a b c d e f; do printf '\377\330\377\331'; done;;
        esac
    "#;
    std::fs::write(&program, script).unwrap();
    std::fs::set_permissions(&program, PermissionsExt::from_mode(0o755)).unwrap();
    let (code, said) = loop {
        match asked() {
            // A child that another test starts meanwhile holds the program open.
            (_, said) if said.contains("does not start") => std::thread::yield_now(),
            other => break other,
        }
    };
    // They came as photos, named by their times; pictures they are not, but for the first.
    assert_eq!(code, exit(ErrorCode::PhotoUnreadable), "{said}");
    assert!(said.contains("photo 1 (\"00000.20s.jpg\")"), "{said}");
}

/// Makes a bundle of the stand-in `plane` and of what finds and matches keypoints in the product.
fn with_features(folder: &Path) {
    let root = crate::common::root();
    let at = |bundle: &str| root.join(bundle);
    let (plane, product) = (at("tests/fixtures/plane"), at("models/embedded"));
    let manifest = |of: &Path| std::fs::read_to_string(of.join("bundle.toml")).unwrap();
    let all = manifest(&product);
    let features = &all[all.find("[features]").expect("the product has them")..];
    std::fs::create_dir(folder).unwrap();
    std::fs::write(folder.join("bundle.toml"), manifest(&plane) + "\n" + features).unwrap();
    let product = ["features.onnx", "matcher.onnx"].map(|file| (&product, file));
    for (from, file) in [(&plane, "plane.onnx")].into_iter().chain(product) {
        std::fs::copy(from.join(file), folder.join(file)).unwrap();
    }
}

#[test]
fn photos_without_cameras_get_them_and_a_file_of_them() {
    if !with_network() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let photos = folder.path().join("only photos");
    std::fs::create_dir_all(photos.join("images")).unwrap();
    for name in ["0001.jpg", "0002.jpg", "0003.jpg", "0004.jpg"] {
        let from = crate::common::root().join("tests/fixtures/room/images").join(name);
        std::fs::copy(from, photos.join("images").join(name)).unwrap();
    }
    let file = photos.join("transforms.json");
    let bundle = folder.path().join("bundle");
    with_features(&bundle);
    let bundle = ["--bundle", text(&bundle)];
    let line = ["cameras", text(&photos), "-o", text(&file)];
    let told = ok_json(&[&line[..], &bundle].concat());
    assert_eq!(told["cameras"]["placed"].as_array().unwrap().len(), 4, "{told}");
    let written: Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    let frames = written["frames"].as_array().unwrap();
    assert_eq!(frames.len(), 4);
    assert_eq!(
        (&frames[0]["w"], &frames[0]["file_path"]),
        (&json!(320), &json!("images/0001.jpg"))
    );
    // The file is read as any other, and the photos alone give the same cameras.
    let scene = folder.path().join("x.segsplat");
    let line = [&["reconstruct", text(&photos), "-o", text(&scene)][..], &bundle].concat();
    let given = ok_json(&line);
    assert_eq!(given["report"]["cameras"]["source"], "given");
    std::fs::remove_file(&file).unwrap();
    let solved = ok_json(&line);
    assert_eq!(solved["report"]["cameras"]["source"], "solved");
    let poses = |of: &Value| -> Vec<f64> {
        let cameras = of["cameras"].as_array().unwrap().iter();
        let poses = cameras.flat_map(|one| one["camera_to_world"].as_array().unwrap());
        poses.map(|number| number.as_f64().unwrap()).collect()
    };
    let apart = poses(&given).into_iter().zip(poses(&solved)).map(|(a, b)| (a - b).abs());
    assert!(apart.fold(0.0, f64::max) < 1e-9, "{given}\n{solved}");
    // Too few of them.
    std::fs::remove_dir_all(photos.join("images")).unwrap();
    refused(&line, ErrorCode::InvalidRequest, "no photos and no cameras");
}

#[test]
fn a_sample_is_written_as_asked() {
    let folder = tempfile::tempdir().unwrap();
    let line = ["sample", "-o", text(folder.path()), "--photos", "3", "--size", "40x30"];
    assert_eq!(ok_json(&line)["photos"], 3);
    assert_eq!(std::fs::read_dir(folder.path().join("images")).unwrap().count(), 3);
    let line = ["sample", "-o", text(folder.path()), "--photos", "65"];
    refused(&line, ErrorCode::InvalidRequest, "65 photos");
}

/// Whether the network can run here; says `skipped` where it cannot.
fn with_network() -> bool {
    match Runtime::load(&NetworkOptions::default()) {
        Ok(_) => true,
        Err(error) => {
            skipped(&format!("no ONNX Runtime: {error}"));
            false
        }
    }
}

#[test]
fn photos_become_a_scene_that_can_be_looked_at() {
    if !with_network() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (photos, scene) = (folder.path().join("photos"), folder.path().join("made.segsplat"));
    ok(&["sample", "-o", text(&photos), "--photos", "2", "--size", "256x256"]);
    let made = ok_json(&["reconstruct", text(&photos), "-o", text(&scene)]);
    assert!(made["report"]["gaussians"].as_u64() > Some(10_000), "{made}");
    let names: Vec<&str> = made["report"]["stages"]
        .as_array()
        .unwrap()
        .iter()
        .filter_map(|stage| stage["stage"].as_str())
        .collect();
    assert_eq!(names, ["photos", "capture", "geometry", "lift"]);
    let picture = folder.path().join("x.png");
    let line = ["render", text(&scene), "--camera", "0", "-o", text(&picture)];
    ok(&[&line[..], &CPU].concat());
    let made = image::open(&picture).unwrap().to_rgb8();
    let images = std::fs::read_dir(photos.join("images")).unwrap();
    let first = images.map(|entry| entry.unwrap().path()).min().unwrap();
    let truth = image::open(first).unwrap().to_rgb8();
    let total: u64 = made.iter().zip(truth.iter()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    let mean = total as f64 / truth.len() as f64;
    assert!(mean < 12.0, "an input camera sees its own photo, not {mean} levels off");
    let verified = ok_json(&["models", "verify"]);
    assert_eq!(verified["verified"], true);
}

#[test]
fn a_scene_is_refined_for_as_long_as_asked() {
    if !with_network() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (photos, scene) = (folder.path().join("photos"), folder.path().join("made.segsplat"));
    ok(&["sample", "-o", text(&photos), "--photos", "6", "--size", "120x80"]);
    let line = ["reconstruct", text(&photos), "-o", text(&scene), "--refine"];
    refused(&[&line[..], &["0"]].concat(), ErrorCode::InvalidRequest, "refine is 0 ms");
    // Networks that know nothing of rooms: a few steps make their scene better.
    let rest = ["2000", "--semantics", "eager", "--bundle", "tests/fixtures/colours"];
    let made = ok_json(&[&line[..], &rest, &CPU].concat());
    let found = &made["report"]["refinement"];
    let [before, after] = ["psnr_before", "psnr_after"].map(|name| found[name].as_f64().unwrap());
    assert!(found["steps"].as_u64() > Some(0) && after > before, "{found}");
    assert_eq!(found["held_out"], json!([3]));
    let kept = ok_json(&["inspect", text(&scene)]);
    assert_eq!(&kept["meta"]["report"]["refinement"], found, "the file has the refined scene");
    assert!(made["semantics"]["labelled"].as_u64() > Some(0), "its semantics follow it");
}

#[test]
fn the_bank_and_the_features_of_a_view_are_written_as_arrays() {
    if !with_network() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (photos, scene, file) = (at("photos"), at("made.segsplat"), at("x.npz"));
    ok(&["sample", "-o", &photos, "--photos", "2", "--size", "120x80"]);
    let bundle = ["--bundle", "tests/fixtures/colours"];
    let made = ["reconstruct", &photos, "-o", &scene, "--preset", "paper"];
    ok(&[&made[..], &bundle].concat());
    let write =
        |rest: &[&'static str]| [&["features", &scene, "-o", &file], rest, &bundle, &CPU].concat();
    refused(&write(&[]), ErrorCode::SemanticsOff, "semantics");
    ok(&[&made[..], &["--semantics", "eager"], &bundle].concat());
    let arrays = || -> Vec<String> {
        let mut zip = zip::ZipArchive::new(std::fs::File::open(&file).unwrap()).unwrap();
        (0..zip.len()).map(|i| zip.by_index(i).unwrap().name().unwrap().into_owned()).collect()
    };
    let view = ["--camera", "0", "--width", "24", "--height", "16"];
    let dense = [&view[..], &["--kind", "features"]].concat();
    for (rest, first) in [(&[][..], "bank.npy"), (&view, "size.npy"), (&dense, "features.npy")] {
        let said = ok_json(&write(rest));
        let bytes = std::fs::metadata(&file).unwrap().len();
        assert_eq!((&said["output"], said["size_bytes"].as_u64()), (&(&*file).into(), Some(bytes)));
        assert_eq!(arrays()[0], first, "{rest:?}");
    }
    refused(&write(&["--camera", "7"]), ErrorCode::InvalidRequest, "from is 7");
}

#[test]
fn models_say_their_licences_and_views_only_where_they_take_some() {
    let listed = ok(&["models", "list"]);
    assert!(
        listed.contains("geometry: geometry.onnx") && listed.contains("up to 8 views"),
        "{listed}"
    );
    assert!(!listed.contains("up to 0 views"), "{listed}");
    // The bundle is named before the action or after it.
    let bundle = ["--bundle", "tests/fixtures/plane"];
    let before = ok(&[&["models"], &bundle[..], &["list"]].concat());
    assert_eq!(before, ok(&[&["models", "list"], &bundle[..]].concat()));
    assert!(before.contains("plane.onnx"), "{before}");
    for model in ok_json(&["models", "list"])["models"].as_array().unwrap() {
        let licence = model["licence"].as_str().unwrap();
        if model["name"] == "features" || model["name"] == "matcher" {
            // Another project's, as it is.
            assert_eq!(licence, "Apache-2.0");
            continue;
        }
        for said in ["research", "CamVid CC BY-NC", "COCO", "models/cards/"] {
            assert!(licence.contains(said), "{}: {licence:?} lacks {said:?}", model["name"]);
        }
    }
}

#[test]
fn a_bundle_is_checked_and_its_faults_are_counted_by_the_exit_code() {
    if Runtime::load(&NetworkOptions::default()).is_err() {
        return skipped("no ONNX Runtime (scripts/setup gets it)");
    }
    let from = crate::common::root().join("tests/fixtures/plane");
    let whole = ok(&["models", "check", text(&from)]);
    assert!(whole.contains("plane.onnx") && whole.contains("opset 17"), "{whole}");
    assert!(whole.contains("geometry") && whole.contains("all finite"), "{whole}");
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let manifest = std::fs::read_to_string(from.join("bundle.toml")).unwrap();
    std::fs::write(at("bundle.toml"), manifest.replace("sh_degree = 0", "sh_degree = 9")).unwrap();
    std::fs::copy(from.join("plane.onnx"), at("other.onnx")).unwrap();
    let output = segsplat(&["models", "check", text(folder.path()), "--json"]);
    let exit = ErrorCode::ModelUnavailable.row().exit;
    assert_eq!(output.status.code(), Some(i32::from(exit)), "{output:?}");
    let answer: Value = serde_json::from_slice(&output.stdout).unwrap();
    let faults: Vec<&str> =
        answer["faults"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    assert_eq!(faults.len(), 2, "{faults:?}");
    assert!(faults[0].contains("geometry.sh_degree is 9"), "{faults:?}");
    assert!(faults[1].contains("plane.onnx cannot be read"), "{faults:?}");
    assert!(faults[1].contains(text(folder.path())) && !faults[1].contains("git"), "{faults:?}");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(said.contains("2 of its things do not fit"), "{said}");
}

/// The program as a package installs it, and as cargo builds it in a checkout: called from a folder
/// that holds neither bundle nor library.
#[cfg(unix)]
#[test]
fn bundle_and_library_are_found_from_any_folder() {
    use std::os::unix::fs::symlink;
    let Ok(runtime) = Runtime::load(&NetworkOptions::default()) else {
        return skipped("no ONNX Runtime (scripts/setup gets it)");
    };
    let elsewhere = tempfile::tempdir().unwrap();
    for (program, bundle, library) in [
        ("bin/segsplat", "share/segsplat/models/embedded", "share/segsplat/libonnxruntime.so"),
        ("target/release/segsplat", "models/embedded", "target/ort/libonnxruntime.so"),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let at = |path: &str| {
            let path = folder.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            path
        };
        if program.starts_with("target") {
            std::fs::write(at("Cargo.toml"), "").unwrap();
        }
        std::fs::copy(env!("CARGO_BIN_EXE_segsplat"), at(program)).unwrap();
        symlink(crate::common::root().join("tests/fixtures/plane"), at(bundle)).unwrap();
        symlink(runtime.path(), at(library)).unwrap();
        let mut verify = Command::new(folder.path().join(program));
        verify.current_dir(elsewhere.path()).env_clear().args(["models", "verify", "--json"]);
        // A child that another test starts meanwhile holds the copy open until it is a program.
        let verified = loop {
            match verify.output() {
                Err(e) if e.kind() == ErrorKind::ExecutableFileBusy => std::thread::yield_now(),
                other => break other.unwrap(),
            }
        };
        let said = String::from_utf8_lossy(&verified.stderr);
        assert!(verified.status.success(), "{program}: {said}");
        let said: Value = serde_json::from_slice(&verified.stdout).unwrap();
        assert_eq!(said["verified"], true, "{program}");
    }
}

/// A child that does not outlive its test.
struct Served(Child);

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[cfg(unix)]
#[test]
fn serve_says_where_it_listens_and_ends_at_sigterm() {
    if !with_network() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let mut child = Served(
        Command::new(env!("CARGO_BIN_EXE_segsplat"))
            .current_dir(crate::common::root())
            .args(["serve", "--listen", "127.0.0.1:0", "--json", "--data-dir"])
            .args([text(folder.path()), "--renderer", "cpu"])
            .args(["--bundle", "tests/fixtures/plane"])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("the program starts"),
    );
    let mut line = String::new();
    let stdout = child.0.stdout.take().expect("piped");
    BufReader::new(stdout).read_line(&mut line).expect("the server speaks");
    let said: Value = serde_json::from_str(&line).unwrap_or_else(|e| panic!("{e}: {line}"));
    let url = said["listening"].as_str().unwrap();
    assert!(url.starts_with("http://127.0.0.1:") && !url.ends_with(":0"), "{url}");
    assert_eq!(said["renderer"], "cpu");
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let ready = runtime
        .block_on(crate::common::client().get(format!("{url}/readyz")).send())
        .expect("it answers");
    assert!(ready.status().is_success(), "{}", ready.status());
    let data = text(folder.path());
    let line = ["serve", "--listen", "127.0.0.1:0", "--data-dir", data, CPU[0], CPU[1]];
    let line = [&line[..], &["--bundle", "tests/fixtures/plane"]].concat();
    let used = format!("another process uses the data folder {data}");
    refused(&line, ErrorCode::StoreUnavailable, &used);
    assert!(signal(child.0.id(), "TERM"));
    assert!(child.0.wait().unwrap().success(), "a stop that was asked for is no failure");
}
