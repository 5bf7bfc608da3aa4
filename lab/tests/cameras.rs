//! Cameras of rendered captures, with the networks of the product: the short form of
//! `segsplat-lab rendered`.

use std::sync::atomic::AtomicBool;

use segsplat_core::{error::ErrorCode, limits::Limits, scene::CamerasMode};
use segsplat_testing::{opened, ort_library, root};
use segsplat_vision::photos::read_unposed_dir;
use serde_json::Value;

use crate::lab;

/// Rows of these captures; `None` without ONNX Runtime.
fn solved(captures: &str, rest: &[&str]) -> Option<Vec<Value>> {
    let bundle = root().join("models/embedded");
    let mut line = vec!["rendered", "--captures", captures, "--bundle", bundle.to_str().unwrap()];
    let library = ort_library();
    if let Some(library) = &library {
        line.extend(["--ort-library", library.to_str().unwrap()]);
    }
    line.extend(rest);
    match lab(&line) {
        Err(e) if e.code() == ErrorCode::ModelUnavailable => opened(Err(e)),
        rows => Some(rows.unwrap()),
    }
}

/// A room with a photo of another one among twelve, under the bars of the issue, and five photos of
/// a corridor, whose places are twice as hard to tell by photos as small as these.
#[test]
fn rendered_cameras_are_found_and_a_photo_of_another_place_is_left_out() {
    let Some(rows) = solved("18,35", &["--width", "400"]) else { return };
    for (row, (foreign, moved)) in rows.iter().zip([(true, 0.005), (false, 0.01)]) {
        let number = |key: &str| row[key].as_f64().expect(key);
        assert_eq!(row["outcome"], "right", "{row}");
        assert_eq!(row["placed"], row["expected"], "{row}");
        assert_eq!(row["foreign_left_out"], if foreign { true.into() } else { Value::Null });
        assert!(number("confidence") >= 0.5, "{row}");
        assert!(number("rotation_worst_deg") <= 0.3, "{row}");
        assert!(number("position_worst") <= moved, "{row}");
        assert!((number("focal") - 1.0).abs() <= 0.03, "{row}");
    }
}

#[test]
fn captures_are_written_with_their_cameras_and_unknown_ones_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let to = dir.path().to_str().unwrap();
    // What spoils the last one is everything, EXIF and a photo of another place with it.
    let line = ["rendered", "--captures", "36", "--width", "160", "--write", to, "--only-write"];
    lab(&line).unwrap();
    let capture = dir.path().join("36-room-all");
    let told = std::fs::read(capture.join("transforms.json")).unwrap();
    let told: Value = serde_json::from_slice(&told).unwrap();
    let frames = told["frames"].as_array().unwrap();
    assert_eq!(frames.len(), 12);
    assert_eq!(frames.iter().filter(|frame| frame["foreign"] == true).count(), 1);
    let never = AtomicBool::new(false);
    let read = read_unposed_dir(&capture, CamerasMode::Solve, &Limits::default(), &never);
    let photos = read.unwrap().unwrap().0.photos;
    assert_eq!(photos.len(), 12);
    for (photo, frame) in photos.iter().zip(frames) {
        let off = photo.focal.expect("EXIF") / frame["fl_x"].as_f64().unwrap();
        assert!((off / 0.7 - 1.0).abs() < 0.05 || (off / 1.5 - 1.0).abs() < 0.05, "{off}");
    }
    let fault = lab(&["rendered", "--captures", "3,40"]).unwrap_err();
    assert!(fault.message().contains("40: it must be under 40"), "{fault}");
}
