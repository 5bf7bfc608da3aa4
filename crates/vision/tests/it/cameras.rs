//! The role `cameras`: photos to a guess of their cameras, by a network that says the same of any
//! photos.

use std::sync::atomic::AtomicBool;

use segsplat_core::{
    error::ErrorCode,
    scene::{Camera, Photo, UnposedPhoto, Watch},
};
use segsplat_testing::{opened, root};
use segsplat_vision::{
    models::{Bundle, CameraNetwork, NetworkOptions, Runtime, check},
    pipeline::{Pipeline, cameras},
    sample::{self, SampleOptions},
};
use tempfile::TempDir;

use crate::network_options;

const MANIFEST: &str = "bundle.toml";
/// The hashes of both networks.
const NEAR: &str = "634c6efd8882b68bdccf1d2f08568602408426b309200097f7bef6667d358f02";
const WRONG: &str = "15faa931328402efa6779e4044e1e570d1507d0740f2c3538d9103d588c4d922";

/// The bundle of colours with the networks of keypoints of the product, and the section and both
/// networks of the fixture.
fn bundle() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    let folders = ["models/embedded", "tests/fixtures/colours", "tests/fixtures/cameras"];
    let [product, folders @ ..] = folders.map(|folder| root().join(folder));
    for entry in folders.iter().flat_map(|from| std::fs::read_dir(from).unwrap()) {
        let entry = entry.unwrap();
        std::fs::copy(entry.path(), dir.path().join(entry.file_name())).unwrap();
    }
    for file in ["features.onnx", "matcher.onnx"] {
        std::fs::copy(product.join(file), dir.path().join(file)).unwrap();
    }
    let read = |file: &str| std::fs::read_to_string(dir.path().join(file)).unwrap();
    let of_product = std::fs::read_to_string(product.join(MANIFEST)).unwrap();
    let sections = of_product.split("\n[").filter(|of| is_of_keypoints(of));
    let sections: String = sections.map(|section| format!("\n[{section}\n")).collect();
    let manifest = read(MANIFEST) + &sections + &read("cameras.toml");
    std::fs::write(dir.path().join(MANIFEST), manifest).unwrap();
    dir
}

fn is_of_keypoints(section: &str) -> bool {
    section.starts_with("features]") || section.starts_with("matcher]")
}

fn replace(dir: &TempDir, old: &str, new: &str) {
    let path = dir.path().join(MANIFEST);
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(text.contains(old), "no {old:?} in the manifest");
    std::fs::write(path, text.replace(old, new)).unwrap();
}

fn photo(width: u32, height: u32) -> Photo {
    Photo { width, height, rgb: vec![90; (width * height * 3) as usize], valid: None }
}

fn network(dir: &TempDir) -> Option<CameraNetwork> {
    let runtime = opened(Runtime::load(&network_options()))?;
    let bundle = Bundle::open(dir.path()).unwrap();
    Some(CameraNetwork::open(&runtime, &bundle, &network_options()).unwrap().unwrap())
}

/// How far the turn from the first camera to another is from the true one, degrees.
fn off(found: &[Camera], truth: &[Camera], other: usize) -> f64 {
    let between = |of: &[Camera]| {
        let [first, second] = [0, other].map(|at| of[at].camera_to_world);
        first.rotation().transpose() * second.rotation()
    };
    let off = between(found) * between(truth).transpose();
    let trace = off.x_axis.x + off.y_axis.y + off.z_axis.z;
    ((trace - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees()
}

#[test]
fn the_cameras_of_photos_of_one_shape_come_in_their_pixels() {
    let Some(network) = network(&bundle()) else { return };
    let options = SampleOptions { photos: 8, width: 480, height: 360, seed: 1 };
    let truth = sample::cameras(&options).unwrap();
    let (across, upright) = (photo(480, 360), photo(360, 480));
    let mut photos = vec![&across; 8];
    photos.insert(2, &upright);
    let mut found = network.find(&photos).unwrap();
    assert!(found.remove(2).is_none(), "of the shape that few have nothing is said");
    let found: Vec<_> = found.into_iter().map(|camera| camera.unwrap()).collect();
    for (i, (camera, own)) in found.iter().zip(&truth).enumerate() {
        let lens = camera.intrinsics;
        assert!((lens.fx - 1.08 * 480.0).abs() < 0.1, "{lens:?}");
        assert_eq!([lens.cx, lens.cy].map(f64::round), [240.0, 180.0]);
        // Each is turned by three degrees from where it was, all of them together by more.
        let off = off(&found, &truth, i);
        assert!(off < 6.1 && (i == 0 || off > 0.1), "photo {i}: {off} degrees");
        let turn = camera.camera_to_world.turn_to(&own.camera_to_world).to_degrees();
        assert!(turn > 30.0, "the network's own world: {turn} degrees");
    }
    // Of more photos than it takes some are shown, the first and the last with them.
    let many = network.find(&[&across; 15]).unwrap();
    let said: Vec<usize> = (0..15).filter(|&i| many[i].is_some()).collect();
    assert_eq!(said, [0, 2, 4, 6, 8, 10, 12, 14]);
    assert_eq!(many[14].unwrap().camera_to_world, found[7].camera_to_world);
    let one = network.find(&[&across, &upright]).unwrap();
    assert!(one.iter().all(Option::is_none), "one photo has no place: {one:?}");
}

#[test]
fn the_section_is_checked_and_what_does_not_fit_is_named() {
    let dir = bundle();
    let Some(runtime) = opened(Runtime::load(&network_options())) else { return };
    // What `models check` says, too, where it runs all networks.
    let faults = |dir: &TempDir| {
        let bundle = Bundle::open(dir.path()).unwrap();
        let opened = CameraNetwork::open(&runtime, &bundle, &network_options());
        opened.err().map_or(String::new(), |error| error.message().to_owned())
    };
    let found = check(dir.path(), &network_options()).unwrap();
    assert_eq!(found.faults, Vec::<String>::new(), "{found:?}");
    assert!(found.ran.iter().any(|(name, _)| *name == "cameras"), "{:?}", found.ran);
    let bundle_of = |dir: &TempDir| Bundle::open(dir.path());
    let files = bundle_of(&dir).unwrap();
    let files = files.files();
    assert!(files.iter().any(|of| of.part == "cameras" && of.file == "near.onnx"), "{files:?}");

    replace(&dir, "world_to_camera = \"world_to_camera\"", "world_to_camera = \"poses\"");
    assert!(faults(&dir).contains("near.onnx has no output \"poses\""), "{}", faults(&dir));
    replace(&dir, "world_to_camera = \"poses\"", "world_to_camera = \"intrinsics\"");
    let said = faults(&dir);
    assert!(
        said.contains("output \"intrinsics\" is f32 [-1, 3, 3], not f32 [2..8, 3, 4]"),
        "{said}"
    );
    replace(&dir, "world_to_camera = \"intrinsics\"", "world_to_camera = \"world_to_camera\"");
    replace(&dir, "views_max = 8", "views_max = 1");
    let error = bundle_of(&dir).unwrap_err();
    assert_eq!(error.code(), ErrorCode::ModelUnavailable);
    assert!(error.message().contains("cameras.views_max is 1; it must be 2 to 64"), "{error}");
    replace(&dir, "views_max = 1", "views_max = 12");
    // It says no more than eight.
    let said = faults(&dir);
    assert!(said.is_empty(), "{said}");
    let network = network(&dir).unwrap();
    let error = network.find(&[&photo(80, 60); 12]).unwrap_err();
    assert_eq!(error.code(), ErrorCode::Internal);
    assert!(error.message().contains("are [8, 3, 4] and [12, 3, 3], not [12, 3, 4]"), "{error}");
    replace(&dir, "\ncell = 14", "\nwidth = 14");
    assert!(bundle_of(&dir).unwrap_err().message().contains("unknown field `width`"));
}

#[test]
fn a_bundle_with_it_needs_the_network_of_keypoints() {
    let dir = bundle();
    let path = dir.path().join(MANIFEST);
    let text = std::fs::read_to_string(&path).unwrap();
    let sections = text.split("\n[").filter(|section| !is_of_keypoints(section));
    std::fs::write(&path, sections.collect::<Vec<_>>().join("\n[")).unwrap();
    let error = Bundle::open(dir.path()).unwrap_err();
    assert!(error.message().contains("have the section [features] beside it"), "{error}");
}

#[test]
fn the_stage_adjusts_what_is_nearly_right_and_ignores_what_is_wrong() {
    let sample = SampleOptions { photos: 8, width: 480, height: 360, seed: 1 };
    let truth = sample::cameras(&sample).unwrap();
    let unposed = |posed: segsplat_core::scene::PosedPhoto| {
        let file_size = [posed.photo.width, posed.photo.height];
        UnposedPhoto { file: posed.file, photo: posed.photo, file_size, focal: None }
    };
    let photos: Vec<_> = sample::photos(&sample).unwrap().into_iter().map(unposed).collect();
    let never = AtomicBool::new(false);
    for network in ["near", "wrong"] {
        let dir = bundle();
        if network == "wrong" {
            replace(&dir, "near.onnx", "wrong.onnx");
            replace(&dir, NEAR, WRONG);
        }
        let options = NetworkOptions { bundle: Some(dir.path().into()), ..network_options() };
        let Some(pipeline) = opened(Pipeline::open(&options)) else { return };
        let guesses = cameras::guessed(&pipeline, &photos).unwrap();
        let said: Vec<Camera> = guesses.iter().map(|guess| guess.unwrap()).collect();
        let worst = |of: &[Camera]| (1..8).map(|other| off(of, &truth, other)).fold(0.0, f64::max);
        let limit = if network == "near" { 1.0..6.1 } else { 10.0..180.0 };
        assert!(limit.contains(&worst(&said)), "{network}: {} degrees", worst(&said));
        let watch = Watch { progress: &|_, _| (), cancel: &never };
        let found = cameras::judged(&pipeline, &photos, &guesses, watch).unwrap();
        assert_eq!(found.refused, None, "{network}");
        let solved: Vec<Camera> = found.cameras().flatten().collect();
        assert_eq!(solved.len(), 8, "{network}");
        assert!(worst(&solved) < 1.0, "{network}: {} degrees", worst(&solved));
    }
}
