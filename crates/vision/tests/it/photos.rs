//! Uploads as callers send them: what is read, and what is refused by which words.

use std::{io::Write, sync::atomic::AtomicBool};

use segsplat_core::{
    error::ErrorCode,
    limits::Limits,
    scene::{PosedPhoto, Upload, UploadCameras, UploadFile},
};
use segsplat_vision::{
    photos,
    sample::{self, SampleOptions},
};
use serde_json::{Value, json};

use segsplat_testing::shared_scene;

use crate::room;

fn options() -> SampleOptions {
    SampleOptions { photos: 3, width: 48, height: 36, seed: 5 }
}

fn sent() -> (Vec<PosedPhoto>, Vec<UploadFile>) {
    let posed = sample::photos(&options()).unwrap();
    let files = sample::png_files(&posed).unwrap();
    (posed, files)
}

fn upload(cameras: UploadCameras, files: Vec<UploadFile>) -> Upload {
    Upload { cameras: Some(cameras), photos: files, archive: None }
}

fn transforms() -> Value {
    serde_json::from_slice(&sample::transforms_json(&sent().0)).unwrap()
}

fn with_transforms(value: &Value, files: Vec<UploadFile>) -> Upload {
    upload(UploadCameras::Transforms(value.to_string().into_bytes()), files)
}

#[track_caller]
fn refused(upload: &Upload, code: ErrorCode, words: &[&str]) {
    let error = photos::read(upload, &Limits::default()).expect_err("must be refused");
    for word in words {
        assert!(error.message().contains(word), "no {word:?} in: {error}");
    }
    assert_eq!(error.code(), code, "{error}");
}

#[track_caller]
fn same_as_sent(got: &[PosedPhoto], want: &[PosedPhoto]) {
    assert_eq!(got.len(), want.len());
    for (got, want) in got.iter().zip(want) {
        assert_eq!(got.photo.rgb, want.photo.rgb);
        assert_eq!((&got.photo.valid, got.intrinsics_made_for), (&None, None));
        assert_eq!(got.camera.intrinsics, want.camera.intrinsics);
        let (a, b) = (&got.camera.camera_to_world, &want.camera.camera_to_world);
        let off = (a.matrix() - b.matrix()).to_cols_array();
        assert!(off.iter().all(|v| v.abs() < 1e-9), "{off:?}");
    }
}

#[test]
fn a_cancelled_reading_ends_before_the_next_photo() {
    let opengl = UploadCameras::Transforms(sample::transforms_json(&sent().0));
    let upload = upload(opengl, sent().1);
    let read = photos::read_until(&upload, &Limits::default(), &AtomicBool::new(true));
    assert_eq!(read.unwrap_err().code(), ErrorCode::Cancelled);
}

#[test]
fn both_camera_files_give_the_same_photos_in_their_order() {
    let (posed, mut files) = sent();
    files.reverse();
    let limits = Limits::default();
    let opengl = UploadCameras::Transforms(sample::transforms_json(&posed));
    same_as_sent(&photos::read(&upload(opengl, files.clone()), &limits).unwrap(), &posed);
    let opencv = UploadCameras::Cameras(sample::cameras_json(&posed));
    for file in &mut files {
        let name = file.name.rsplit('/').next().unwrap_or_default();
        file.name = format!("elsewhere/{name}");
    }
    same_as_sent(&photos::read(&upload(opencv, files), &limits).unwrap(), &posed);
}

#[test]
fn the_number_of_photos_is_bounded_on_both_sides() {
    let (_, files) = sent();
    let json = transforms();
    let invalid = ErrorCode::InvalidRequest;
    refused(&with_transforms(&json, vec![]), invalid, &["no photos"]);
    refused(&with_transforms(&json, files[..1].to_vec()), invalid, &["1 photo", "at least 2"]);
    let many = (0..65)
        .map(|i| UploadFile { name: format!("{i}.png"), bytes: files[0].bytes.clone() })
        .collect();
    refused(&with_transforms(&json, many), ErrorCode::LimitExceeded, &["photos", "65", "64"]);
    let none = Upload { cameras: None, photos: files, archive: None };
    refused(&none, invalid, &["no cameras"]);
}

#[test]
fn impossible_cameras_are_refused_by_photo_and_value() {
    type Spoil = fn(&mut Value);
    let cases: [(Spoil, &[&str]); 15] = [
        (|f| f["transform_matrix"] = Value::Null, &["transform_matrix", "4 rows of 4"]),
        (|f| drop(f.as_object_mut().unwrap().remove("transform_matrix")), &["missing"]),
        (|f| f["transform_matrix"][0] = json!([1, 2, 3]), &["4 rows of 4"]),
        (|f| f["transform_matrix"][1][3] = Value::Null, &["[1][3]", "NaN", "finite"]),
        (|f| f["transform_matrix"][0][0] = json!(2.5), &["not orthonormal", "1e-3"]),
        (|f| f["transform_matrix"] = mirrored(f), &["mirrored", "determinant -1"]),
        (|f| (0..3).for_each(|r| f["transform_matrix"][r][0] = json!(0)), &["singular"]),
        (|f| f["fl_x"] = json!(0), &["fx is 0", "over 0"]),
        (|f| f["fl_y"] = json!(-20), &["fy is -20"]),
        (|f| f["fl_x"] = json!("wide"), &["fl_x is a text"]),
        (|f| f["w"] = json!(36), &["36x36", "48x36", "aspect"]),
        (|f| (f["w"], f["h"]) = (json!(36), json!(48)), &["36x48", "EXIF"]),
        (|f| f["w"] = json!(-48), &["width", "-48"]),
        (|f| f["camera_model"] = json!("EQUIRECTANGULAR"), &["EQUIRECTANGULAR", "OPENCV_FISHEYE"]),
        (|f| f["k1"] = Value::Null, &["k1 is NaN"]),
    ];
    for (spoil, words) in cases {
        let mut json = transforms();
        spoil(&mut json["frames"][1]);
        let mut words = words.to_vec();
        words.push("photo 1 (");
        refused(&with_transforms(&json, sent().1), ErrorCode::InvalidRequest, &words);
    }
}

fn mirrored(frame: &Value) -> Value {
    let mut m = frame["transform_matrix"].clone();
    for row in 0..3 {
        m[row][0] = json!(-m[row][0].as_f64().unwrap());
    }
    m
}

#[test]
fn a_bare_nan_as_python_writes_it_names_its_photo() {
    let mut json = transforms();
    json["frames"][2]["transform_matrix"][0][3] = json!("HERE");
    let text = json.to_string().replace("\"HERE\"", "NaN");
    let upload = upload(UploadCameras::Transforms(text.into_bytes()), sent().1);
    refused(&upload, ErrorCode::InvalidRequest, &["photo 2", "[0][3]", "NaN"]);
}

#[test]
fn cameras_at_one_place_are_refused() {
    let mut json = transforms();
    let first = json["frames"][0]["transform_matrix"].clone();
    for i in 0..3 {
        for row in 0..3 {
            json["frames"][i]["transform_matrix"][row][3] = first[row][3].clone();
        }
    }
    let upload = with_transforms(&json, sent().1);
    refused(&upload, ErrorCode::InvalidRequest, &["all 3 cameras", "one place"]);
}

#[test]
fn photos_and_cameras_must_fit_each_other() {
    let (_, mut files) = sent();
    let mut json = transforms();
    // More cameras than photos is fine: a caller may send a part of a capture.
    let part = photos::read(&with_transforms(&json, files[1..].to_vec()), &Limits::default());
    assert_eq!(part.unwrap().len(), 2);
    files[1].name = "other.png".to_owned();
    let invalid = ErrorCode::InvalidRequest;
    refused(&with_transforms(&json, files.clone()), invalid, &["other.png", "no camera"]);
    let twin = files[0].name.clone();
    files[1].name = twin;
    refused(&with_transforms(&json, files.clone()), invalid, &["two photos"]);
    files[1].name = "../up.png".to_owned();
    refused(&with_transforms(&json, files), invalid, &["relative"]);
    json["frames"][1]["file_path"] = json["frames"][0]["file_path"].clone();
    refused(&with_transforms(&json, sent().1[..1].to_vec()), invalid, &["1 photo"]);
    refused(&with_transforms(&json, sent().1[..2].to_vec()), invalid, &["two cameras"]);
    refused(&with_transforms(&json!({"frames": 3}), sent().1), invalid, &["frames", "a number"]);
    refused(&with_transforms(&json!({}), sent().1), invalid, &["frames", "missing"]);
    let broken = UploadCameras::Cameras(b"{\"cameras\": [".to_vec());
    refused(&upload(broken, sent().1), invalid, &["not valid JSON", "line 1"]);
    let huge = UploadCameras::Transforms(vec![b' '; (8 << 20) + 1]);
    refused(&upload(huge, sent().1), ErrorCode::LimitExceeded, &["transforms", "8388608"]);
}

#[test]
fn intrinsics_of_another_size_are_scaled_and_remembered() {
    let mut json = transforms();
    for frame in json["frames"].as_array_mut().unwrap() {
        for key in ["fl_x", "fl_y", "cx", "cy", "w", "h"] {
            frame[key] = json!(frame[key].as_f64().unwrap() * 4.0);
        }
    }
    let got = photos::read(&with_transforms(&json, sent().1), &Limits::default()).unwrap();
    assert_eq!(got[0].intrinsics_made_for, Some([192, 144]));
    assert_eq!(got[0].camera.intrinsics, sent().0[0].camera.intrinsics);
}

fn zipped(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for (name, bytes) in entries {
        zip.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

fn tarred(entries: &[(&str, &[u8])], kind: tar::EntryType) -> Vec<u8> {
    let mut tar = tar::Builder::new(Vec::new());
    for (name, bytes) in entries {
        let mut header = tar::Header::new_ustar();
        header.set_size(bytes.len() as u64);
        header.set_entry_type(kind);
        // Written by hand: the crate refuses to write the names that must be refused.
        let field = &mut header.as_old_mut().name;
        field[..name.len()].copy_from_slice(name.as_bytes());
        header.set_cksum();
        tar.append(&header, *bytes).unwrap();
    }
    tar.into_inner().unwrap()
}

fn archive(bytes: Vec<u8>) -> Upload {
    Upload { cameras: None, photos: vec![], archive: Some(bytes) }
}

fn folder_of(root: &str) -> Vec<(String, Vec<u8>)> {
    let (posed, files) = sent();
    let mut entries = vec![(format!("{root}transforms.json"), sample::transforms_json(&posed))];
    entries.extend(files.into_iter().map(|f| (format!("{root}{}", f.name), f.bytes)));
    entries.push((format!("{root}masks/not_a_photo.png"), b"junk".to_vec()));
    entries.push(("__MACOSX/._x".to_owned(), b"junk".to_vec()));
    entries
}

#[test]
fn zip_and_tar_of_a_folder_are_read() {
    for root in ["", "capture/"] {
        let entries = folder_of(root);
        let entries: Vec<(&str, &[u8])> =
            entries.iter().map(|(n, b)| (n.as_str(), b.as_slice())).collect();
        for bytes in [zipped(&entries), tarred(&entries, tar::EntryType::Regular)] {
            let got = photos::read(&archive(bytes), &Limits::default()).unwrap();
            same_as_sent(&got, &sent().0);
        }
        let without: Vec<_> = entries.iter().copied().filter(|e| !e.0.contains('1')).collect();
        let words = ["a camera, but no such photo", "photo 1"];
        refused(&archive(zipped(&without)), ErrorCode::InvalidRequest, &words);
    }
}

#[test]
fn hostile_archives_are_refused() {
    let invalid = ErrorCode::InvalidRequest;
    for name in ["../evil.png", "a/../../evil.png", "/etc/evil.png", "C:\\evil.png"] {
        let entries: [(&str, &[u8]); 1] = [(name, b"x")];
        refused(&archive(zipped(&entries)), invalid, &["relative path"]);
        let tar = tarred(&entries, tar::EntryType::Regular);
        refused(&archive(tar), invalid, &["relative path"]);
    }
    for kind in [tar::EntryType::Symlink, tar::EntryType::Link, tar::EntryType::Char] {
        refused(&archive(tarred(&[("a", b"")], kind)), invalid, &["link"]);
    }
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    zip.add_symlink("a.png", "/etc/passwd", zip::write::SimpleFileOptions::default()).unwrap();
    refused(&archive(zip.finish().unwrap().into_inner()), invalid, &["link"]);
    refused(&archive(zipped(&[("a.png", b"x")])), invalid, &["no transforms.json"]);
    let two: [(&str, &[u8]); 2] = [("transforms.json", b"{}"), ("cameras.json", b"{}")];
    refused(&archive(zipped(&two)), invalid, &["two camera files"]);
    let unreadable = ErrorCode::PhotoUnreadable;
    refused(&archive(b"hello".to_vec()), unreadable, &["neither a zip nor a tar"]);
    for (bytes, name) in
        [(&[0x1F, 0x8B, 8, 0][..], "gzip"), (b"BZh91AY&SY", "bzip2"), (b"\xFD7zXZ\0", "xz")]
    {
        refused(&archive(bytes.to_vec()), unreadable, &[name, "send a zip or a plain tar"]);
    }
    let cut = zipped(&[("a.png", &[7; 4000])]);
    refused(&archive(cut[..cut.len() / 2].to_vec()), unreadable, &["damaged"]);
}

#[test]
fn zip_and_tar_refuse_names_and_camera_files_that_come_twice() {
    let json: &[u8] = b"{}";
    for (entries, words) in [
        ([("a/x.png", json), ("a/y.png", json), ("t", json)], ["two entries", "a/x.png"]),
        (
            [("transforms.json", json), ("b/transforms.json", json), ("t", json)],
            ["two camera files", "b/transforms.json"],
        ),
        ([("cameras.json", json), ("b/transforms.json", json), ("t", json)], ["two camera", "b/"]),
    ] {
        let twice =
            entries.map(|(name, bytes)| (if name == "a/y.png" { "a/x.png" } else { name }, bytes));
        // The zip writer refuses to write a name twice.
        let mut zip = zipped(&entries);
        for at in 0..zip.len() - 7 {
            if &zip[at..at + 7] == b"a/y.png" {
                zip[at + 2] = b'x';
            }
        }
        for bytes in [zip, tarred(&twice, tar::EntryType::Regular)] {
            refused(&archive(bytes), ErrorCode::InvalidRequest, &words);
        }
    }
}

/// A ZIP64 file whose records are all zero, and whose old end record tells of one entry.
fn zip64_claiming(entries: u64) -> Vec<u8> {
    let mut zip = b"PK\x03\x04".to_vec();
    let directory = zip.len() as u64;
    zip.resize(zip.len() + 46 * entries as usize, 0);
    let end = zip.len() as u64;
    zip.extend(b"PK\x06\x06");
    zip.extend(44_u64.to_le_bytes());
    zip.extend([45, 0, 45, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    for value in [entries, entries, end - directory, directory] {
        zip.extend(value.to_le_bytes());
    }
    zip.extend(b"PK\x06\x07\0\0\0\0");
    zip.extend(end.to_le_bytes());
    zip.extend([1, 0, 0, 0]);
    zip.extend(b"PK\x05\x06\0\0\0\0\x01\0\x01\0");
    zip.extend([0xFF; 8]);
    zip.extend([0, 0]);
    zip
}

#[test]
fn the_entries_of_a_zip64_are_counted_before_a_record_is_read() {
    let words = ["archive: entries: 100000 is over 1024"];
    refused(&archive(zip64_claiming(100_000)), ErrorCode::LimitExceeded, &words);
    // Few enough to be read, which these records are not.
    refused(&archive(zip64_claiming(1_000)), ErrorCode::PhotoUnreadable, &["damaged"]);
}

#[test]
fn bombs_meet_the_unpacked_bound() {
    let bomb = vec![0_u8; 3 << 20];
    let zip = zipped(&[("transforms.json", b"{}"), ("bomb.png", &bomb)]);
    assert!(zip.len() < 20_000, "the bomb must be small: {}", zip.len());
    let limits = Limits { archive_unpacked_bytes_max: 1 << 20, ..Limits::default() };
    let error = photos::read(&archive(zip.clone()), &limits).unwrap_err();
    assert_eq!(error.code(), ErrorCode::LimitExceeded, "{error}");
    // The same bomb with headers that lie about its size.
    let mut lying = zip;
    let claim = (3_u32 << 20).to_le_bytes();
    for i in 0..lying.len() - 4 {
        if lying[i..i + 4] == claim {
            lying[i..i + 4].copy_from_slice(&10_u32.to_le_bytes());
        }
    }
    let error = photos::read(&archive(lying), &limits).unwrap_err();
    let codes = [ErrorCode::LimitExceeded, ErrorCode::PhotoUnreadable];
    assert!(codes.contains(&error.code()), "{error}");
    let names: Vec<String> = (0..1025).map(|i| format!("{i}.txt")).collect();
    let entries: Vec<(&str, &[u8])> = names.iter().map(|n| (n.as_str(), &b""[..])).collect();
    for bytes in [zipped(&entries), tarred(&entries, tar::EntryType::Regular)] {
        refused(&archive(bytes), ErrorCode::LimitExceeded, &["entries", "1024"]);
    }
}

#[test]
fn damaged_photos_are_named() {
    let (_, files) = sent();
    let spoilt = |bytes: Vec<u8>| {
        let mut files = files.clone();
        files[2].bytes = bytes;
        with_transforms(&transforms(), files)
    };
    let unreadable = ErrorCode::PhotoUnreadable;
    refused(&spoilt(b"just text".to_vec()), unreadable, &["photo 2", "not a JPEG, PNG or WebP"]);
    refused(&spoilt(vec![]), unreadable, &["photo 2", "empty"]);
    let half = files[2].bytes[..files[2].bytes.len() / 2].to_vec();
    refused(&spoilt(half), unreadable, &["photo 2", "cut short"]);
    let mut huge = files[2].bytes.clone();
    huge[16..20].copy_from_slice(&100_000_u32.to_be_bytes());
    huge[20..24].copy_from_slice(&100_000_u32.to_be_bytes());
    huge.truncate(60);
    let words = ["photo 2", "100000x100000 px", "24000000"];
    refused(&spoilt(huge), ErrorCode::LimitExceeded, &words);
}

#[test]
fn a_folder_is_read_with_the_distortion_of_its_lens_undone() {
    let got = photos::read_dir(&room::folder(), &Limits::default()).unwrap();
    assert_eq!(got.len(), room::PHOTOS);
    for posed in &got {
        let truth = room::room().view(&posed.camera).photo.rgb;
        assert!(posed.photo.valid.is_none(), "this lens sees all that a pinhole camera would see");
        assert_eq!(posed.photo.rgb.len(), truth.len());
        let off = posed.photo.rgb.iter().zip(&truth).map(|(a, b)| f64::from(a.abs_diff(*b)));
        let off = off.sum::<f64>() / truth.len() as f64;
        assert!(off < 4.0, "{}: {off} levels off the truth", posed.file);
    }
}

#[test]
fn real_scenes_are_read_with_their_distortion_undone() {
    for (scene, count, distorted) in [("fox", 50, true), ("computer_mouse", 24, false)] {
        let Some(folder) = shared_scene(scene) else { return };
        let got = photos::read_dir(&folder, &Limits::default()).unwrap();
        assert_eq!(got.len(), count, "{scene}");
        for posed in &got {
            let k = posed.camera.intrinsics;
            assert_eq!((k.width, k.height), (posed.photo.width, posed.photo.height));
            let pixels = (k.width * k.height) as usize;
            assert_eq!(posed.photo.rgb.len(), 3 * pixels);
            if let Some(valid) = &posed.photo.valid {
                assert!(distorted, "{scene} has no distortion");
                let share = valid.iter().filter(|v| **v).count() as f64 / pixels as f64;
                assert!(share > 0.95, "{scene}: {share} of the pixels have a source");
            }
        }
    }
}
