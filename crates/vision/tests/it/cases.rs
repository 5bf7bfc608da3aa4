//! Captures as people have them, one small input a kind (`tests/fixtures/cases`): each is read
//! right, or refused by its name, as files of a form and as a folder.
//!
//! A case is a JSON: `files` by path, each a text, a JSON, or `@NAME` of a file in `photos`; and
//! `right`: `photos`, `fx`, `depth`, `warnings`, `left_out` (share that takes no part), `pixels`
//! (the photos as upright in `photos`), or `refused` with words of the message. `make.py` wrote
//! them.

use std::sync::atomic::AtomicBool;

use segsplat_core::{
    error::Result,
    limits::Limits,
    scene::{PosedPhoto, Upload, UploadFile},
};
use segsplat_testing::root;
use segsplat_vision::{
    capture,
    photos::{self, ReadPhotos},
};
use serde_json::Value;

/// Fewest cases: so many kinds there are.
const CASES: usize = 25;

fn files(case: &Value) -> Vec<UploadFile> {
    let file = |(path, said): (&String, &Value)| {
        let bytes = match said {
            Value::String(text) => match text.strip_prefix('@') {
                Some(name) => read(&format!("photos/{name}")),
                None => text.clone().into_bytes(),
            },
            json => json.to_string().into_bytes(),
        };
        UploadFile { name: path.clone(), bytes }
    };
    case["files"].as_object().unwrap().iter().map(file).collect()
}

fn read(path: &str) -> Vec<u8> {
    std::fs::read(root().join("tests/fixtures/cases").join(path)).unwrap()
}

fn from_form(files: Vec<UploadFile>) -> Result<ReadPhotos> {
    let upload = Upload { photos: files, ..Upload::default() };
    photos::read_until(&upload, &Limits::default(), &AtomicBool::new(false))
}

fn from_folder(files: &[UploadFile]) -> Result<ReadPhotos> {
    let dir = tempfile::tempdir().unwrap();
    for file in files {
        let path = dir.path().join(&file.name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, &file.bytes).unwrap();
    }
    let limits = Limits::default();
    let (read, found) = photos::read_dir_until(dir.path(), &limits, &AtomicBool::new(false))?;
    // What was read of a folder is a capture that reads the same.
    let again = from_form(found.photos).unwrap();
    let valid = |read: &ReadPhotos| -> Vec<_> {
        read.photos.iter().map(|posed| posed.photo.valid.clone()).collect()
    };
    assert_eq!(again.photos.len(), read.photos.len());
    assert!(valid(&again) == valid(&read), "masks go with the files that were read");
    Ok(read)
}

/// Mean difference of a photo and an upright one, of 255.
fn off(posed: &PosedPhoto, upright: &str) -> f64 {
    let upright = image::load_from_memory(&read(&format!("photos/{upright}"))).unwrap().to_rgb8();
    assert_eq!([posed.photo.width, posed.photo.height], [upright.width(), upright.height()]);
    let pairs = posed.photo.rgb.iter().zip(upright.as_raw());
    pairs.map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / posed.photo.rgb.len() as f64
}

fn judge(way: &str, right: &Value, read: Result<ReadPhotos>) {
    if let Some(words) = right["refused"].as_array() {
        let error = read.map(|read| read.photos.len()).expect_err(way);
        let has = |word: &Value| error.message().contains(word.as_str().unwrap());
        return assert!(words.iter().all(has), "{way}: {error}");
    }
    let ReadPhotos { photos, mut warnings, .. } = read.unwrap_or_else(|e| panic!("{way}: {e}"));
    assert_eq!(photos.len() as u64, right["photos"], "{way}");
    let fx = photos[0].camera.intrinsics.fx;
    assert!((fx - right["fx"].as_f64().unwrap()).abs() < 0.01, "{way}: fx {fx}");
    let found = capture::analyse(&photos, &AtomicBool::new(false)).unwrap();
    warnings.extend(found.warnings);
    let codes: Vec<String> = warnings.iter().map(|warning| warning.code.to_string()).collect();
    assert_eq!(Value::from(codes), right["warnings"], "{way}: {warnings:?}");
    if let Some(depth) = right["depth"].as_f64() {
        let got = found.median_depth;
        assert!((got / depth - 1.0).abs() < 0.05, "{way}: depth {got}, not {depth}");
    }
    if let Some(share) = right["left_out"].as_f64() {
        for posed in &photos {
            let valid = posed.photo.valid.as_ref().expect(way);
            let left_out = valid.iter().filter(|valid| !**valid).count();
            let got = left_out as f64 / valid.len() as f64;
            assert!((got - share).abs() < 0.01, "{way}, {}: {got} left out", posed.file);
        }
    }
    for (posed, upright) in photos.iter().zip(right["pixels"].as_array().into_iter().flatten()) {
        let off = off(posed, upright.as_str().unwrap());
        assert!(off < 4.0, "{way}, {}: {off} of 255", posed.file);
    }
}

#[test]
fn each_kind_of_capture_is_read_right_or_refused_by_its_name() {
    let folder = root().join("tests/fixtures/cases");
    let names = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name());
    let names = names.filter_map(|name| name.into_string().ok());
    let mut names: Vec<String> = names.filter(|name| name.ends_with(".json")).collect();
    names.sort();
    assert!(names.len() >= CASES, "{names:?}");
    for name in names {
        let case: Value = serde_json::from_slice(&read(&name)).unwrap();
        let files = files(&case);
        judge(&format!("{name}, folder"), &case["right"], from_folder(&files));
        judge(&format!("{name}, form"), &case["right"], from_form(files));
    }
}
