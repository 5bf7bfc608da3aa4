//! Uploads as callers send them: what is read, and what is refused by which words.

use std::{
    io::{Cursor, Write},
    sync::atomic::AtomicBool,
};

use image::{DynamicImage, ImageBuffer, ImageEncoder as _, ImageFormat, Rgb, RgbImage};

use segsplat_core::{
    error::ErrorCode,
    limits::Limits,
    scene::{
        CamerasMode, CamerasReport, PosedPhoto, Upload, UploadCameras, UploadFile, WarningCode,
    },
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

/// What a scene of given cameras knows of them.
fn given(report: &CamerasReport) -> photos::KnownCameras<'_> {
    photos::KnownCameras { mode: CamerasMode::Auto, cameras: &[], report }
}

fn sent() -> (Vec<PosedPhoto>, Vec<UploadFile>) {
    let posed = sample::photos(&options()).unwrap();
    let files = sample::png_files(&posed).unwrap();
    (posed, files)
}

fn upload(cameras: UploadCameras, files: Vec<UploadFile>) -> Upload {
    Upload { cameras: Some(cameras), photos: files, ..Upload::default() }
}

/// `cameras` JSON of the photos: this project's own form, OpenCV camera-to-world.
fn cameras_json(photos: &[PosedPhoto]) -> Vec<u8> {
    let cameras: Vec<_> = photos
        .iter()
        .map(|posed| {
            json!({
                "file": posed.file,
                "intrinsics": posed.camera.intrinsics,
                "camera_to_world": posed.camera.camera_to_world,
            })
        })
        .collect();
    format!("{:#}\n", json!({ "cameras": cameras })).into_bytes()
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
    let opencv = UploadCameras::Cameras(cameras_json(&posed));
    for file in &mut files {
        let name = file.name.rsplit('/').next().unwrap_or_default();
        file.name = format!("elsewhere/{name}");
    }
    same_as_sent(&photos::read(&upload(opencv, files), &limits).unwrap(), &posed);
}

#[test]
fn too_few_photos_are_refused() {
    let (_, files) = sent();
    let json = transforms();
    let invalid = ErrorCode::InvalidRequest;
    refused(&with_transforms(&json, vec![]), invalid, &["no photos"]);
    refused(&with_transforms(&json, files[..1].to_vec()), invalid, &["1 photo", "at least 2"]);
    let none = Upload { photos: files, ..Upload::default() };
    refused(&none, invalid, &["no camera description"]);
}

#[test]
fn impossible_cameras_are_refused_by_photo_and_value() {
    type Spoil = fn(&mut Value);
    let cases: [(Spoil, &[&str]); 23] = [
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
        // The model before the lens that it needs not.
        (
            |f| (without(f, &["fl_x", "fl_y"]), f["camera_model"] = json!("VR180_L")).1,
            &["VR180_L", "OPENCV_FISHEYE"],
        ),
        (|f| f["k1"] = Value::Null, &["k1 is NaN"]),
        (|f| f["fl_x"] = Value::Null, &["fx is NaN"]),
        (|f| f["cx"] = Value::Null, &["cx is NaN"]),
        (|f| f["w"] = json!(0), &["width"]),
        (|f| without(f, &["h"]), &["only one"]),
        (|f| without(f, &["fl_x", "fl_y"]), &["no focal length"]),
        (|f| (without(f, &["fl_x", "fl_y"]), f["camera_angle_x"] = json!(4.0)).1, &["angle"]),
        (|f| f["fl_y"] = json!(0), &["fy is 0"]),
    ];
    for (spoil, words) in cases {
        let mut json = transforms();
        spoil(&mut json["frames"][1]);
        let mut words = words.to_vec();
        words.push("photo 1 (");
        refused(&with_transforms(&json, sent().1), ErrorCode::InvalidRequest, &words);
    }
}

fn without(frame: &mut Value, keys: &[&str]) {
    let fields = frame.as_object_mut().unwrap();
    keys.iter().for_each(|key| drop(fields.remove(*key)));
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

#[test]
fn a_frame_wins_over_the_top_level_and_angles_give_the_focal_length() {
    let mut json = transforms();
    let frames = json["frames"].as_array_mut().unwrap();
    for frame in frames.iter_mut() {
        without(frame, &["fl_x", "fl_y", "cx", "cy", "w", "h"]);
    }
    frames[0]["fl_x"] = json!(200);
    frames[1]["camera_angle_x"] = json!(2.0 * 0.5_f64.atan());
    (json["fl_x"], json["cx"], json["w"], json["h"]) = (json!(100), json!(5), json!(48), json!(36));
    let got = photos::read(&with_transforms(&json, sent().1), &Limits::default()).unwrap();
    let k: Vec<_> = got.iter().map(|posed| posed.camera.intrinsics).collect();
    assert_eq!((k[0].fx, k[0].fy, k[0].cx, k[0].cy), (200.0, 200.0, 5.0, 18.0));
    assert!((k[1].fx - 48.0).abs() < 1e-9 && (k[1].fy - 48.0).abs() < 1e-9, "{:?}", k[1]);
    assert_eq!((k[2].fx, k[2].cx), (100.0, 5.0));
}

#[test]
fn bare_nan_is_read_outside_of_strings_only() {
    let mut json = transforms();
    let (_, mut files) = sent();
    for (i, file) in files.iter_mut().enumerate() {
        file.name = format!("NaN \" Infinity{i}.png");
        json["frames"][i]["file_path"] = json!(file.name);
    }
    json["frames"][0]["sharpness"] = json!("HERE");
    let text = json.to_string().replace("\"HERE\"", "-Infinity");
    let upload = upload(UploadCameras::Transforms(text.into_bytes()), files);
    same_as_sent(&photos::read(&upload, &Limits::default()).unwrap(), &sent().0);
}

#[test]
fn files_find_their_cameras_by_path_then_by_name_then_without_extension() {
    // Paths of the cameras, names of the files, and the camera of each file in the result.
    type Case<'a> = ([&'a str; 3], &'a [&'a str], Result<&'a [usize], &'a str>);
    let cases: [Case<'_>; 7] = [
        (["a/1.jpg", "b/1.jpg", "c.png"], &["b/1.jpg", "c.png"], Ok(&[1, 2])),
        (["./images/a", "images/b.jpg", "c"], &["b.jpg", "a.png"], Ok(&[0, 1])),
        (["./train/r_0", "c.png", "d.png"], &["train/r_0.png", "c.png"], Ok(&[0, 1])),
        (["images//a.png", "images\\c.png", "d"], &["images/a.png", "images/c.png"], Ok(&[0, 1])),
        (["x/a.jpg", "y/a.jpg", "b"], &["a.jpg", "b.png"], Err("two cameras")),
        (["a.jpg", "./a.jpg", "b"], &["a.jpg", "b.png"], Err("two cameras")),
        (["a.jpg", "b.png", "c"], &["x/a.jpg", "y/a.jpg", "b.png"], Err("two photos")),
    ];
    for (paths, names, want) in cases {
        let mut json = transforms();
        for (i, path) in paths.iter().enumerate() {
            json["frames"][i]["file_path"] = json!(path);
        }
        let (posed, sent) = sent();
        let files = names.iter().map(|n| UploadFile { name: (*n).to_owned(), ..sent[0].clone() });
        let got = photos::read(&with_transforms(&json, files.collect()), &Limits::default());
        match (got, want) {
            (Ok(got), Ok(want)) => {
                let places = got.iter().map(|p| p.camera.camera_to_world.center());
                let want = want.iter().map(|&i| posed[i].camera.camera_to_world.center());
                assert!(places.zip(want).all(|(a, b)| a.distance(b) < 1e-9), "{paths:?}");
                assert_eq!(got.len(), names.len(), "{paths:?}");
            }
            (Err(error), Err(words)) => assert!(error.message().contains(words), "{error}"),
            (got, want) => panic!("{paths:?}: {got:?}, not {want:?}"),
        }
    }
    for bad in ["", "..", "a/../b", "/etc/passwd", "C:\\x.jpg", "\\\\host\\x", "a\0b"] {
        let (_, mut files) = sent();
        files[1].name = bad.to_owned();
        refused(&with_transforms(&transforms(), files), ErrorCode::InvalidRequest, &["relative"]);
    }
}

fn zipped(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
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
    Upload { archive: Some(bytes), ..Upload::default() }
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
        // A camera whose photo is missing is left out; without photos there is no scene.
        let without = |names: &[char]| -> Vec<(&str, &[u8])> {
            entries.iter().copied().filter(|e| !e.0.contains(names)).collect()
        };
        let got = photos::read(&archive(zipped(&without(&['1']))), &Limits::default()).unwrap();
        assert_eq!(
            got.iter().map(|p| &*p.file).collect::<Vec<_>>(),
            ["images/0000.png", "images/0002.png"]
        );
        let invalid = ErrorCode::InvalidRequest;
        refused(&archive(zipped(&without(&['1', '2']))), invalid, &["1 photo;", "at least 2"]);
        let words = ["none of the 3 cameras", "images/0000.png"];
        refused(&archive(zipped(&without(&['0', '1', '2']))), invalid, &words);
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
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    zip.add_symlink("a.png", "/etc/passwd", zip::write::SimpleFileOptions::default()).unwrap();
    refused(&archive(zip.finish().unwrap().into_inner()), invalid, &["link"]);
    refused(&archive(zipped(&[("a.png", b"x")])), invalid, &["no transforms.json"]);
    let two: [(&str, &[u8]); 2] = [("transforms.json", b"{}"), ("cameras.json", b"{}")];
    refused(&archive(zipped(&two)), invalid, &["2 camera files", "missing"]);
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
            ["2 camera files", "b/transforms.json"],
        ),
        (
            [("cameras.json", json), ("b/transforms.json", json), ("t", json)],
            ["2 camera files", "b/"],
        ),
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
    let words = ["archive: entries: 100000 is over 16384"];
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
    let error = photos::read(&archive(zip), &limits).unwrap_err();
    assert_eq!(error.code(), ErrorCode::LimitExceeded, "{error}");
    // The same bomb with headers that lie about its size.
    let mut lying = zipped(&[("transforms.json", &bomb)]);
    let claim = (3_u32 << 20).to_le_bytes();
    for i in 0..lying.len() - 4 {
        if lying[i..i + 4] == claim {
            lying[i..i + 4].copy_from_slice(&10_u32.to_le_bytes());
        }
    }
    let error = photos::read(&archive(lying), &limits).unwrap_err();
    let codes = [ErrorCode::LimitExceeded, ErrorCode::PhotoUnreadable];
    assert!(codes.contains(&error.code()), "{error}");
    let few = Limits { archive_entries_max: 9, ..Limits::default() };
    let names: Vec<String> = (0..10).map(|i| format!("{i}.txt")).collect();
    let entries: Vec<(&str, &[u8])> = names.iter().map(|n| (n.as_str(), &b""[..])).collect();
    for bytes in [zipped(&entries), tarred(&entries, tar::EntryType::Regular)] {
        let error = photos::read(&archive(bytes), &few).unwrap_err();
        assert_eq!(error.code(), ErrorCode::LimitExceeded, "{error}");
        assert!(error.message().contains("entries") && error.message().contains('9'), "{error}");
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
    refused(&spoilt(b"just text".to_vec()), unreadable, &["photo 2", "JPEG, PNG, WebP, TIFF"]);
    let heic = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic".to_vec();
    refused(&spoilt(heic), unreadable, &["photo 2", "HEIC", "save it as JPEG", "Most Compatible"]);
    refused(&spoilt(vec![]), unreadable, &["photo 2", "empty"]);
    let half = files[2].bytes[..files[2].bytes.len() / 2].to_vec();
    refused(&spoilt(half), unreadable, &["photo 2", "cut short"]);
    let mut huge = files[2].bytes.clone();
    huge[16..20].copy_from_slice(&100_000_u32.to_be_bytes());
    huge[20..24].copy_from_slice(&100_000_u32.to_be_bytes());
    huge.truncate(60);
    let words = ["photo 2", "100000x100000 px is over 24000000 px"];
    refused(&spoilt(huge), ErrorCode::LimitExceeded, &words);
    let jpeg = encoded(&gradient().into(), ImageFormat::Jpeg);
    refused(&spoilt(jpeg[..jpeg.len() - 40].to_vec()), unreadable, &["photo 2", "cut short"]);
    refused(&spoilt(jpeg[..60].to_vec()), unreadable, &["photo 2", "damaged"]);
}

fn gradient() -> RgbImage {
    RgbImage::from_fn(40, 30, |x, y| Rgb([(x * 6) as u8, (y * 8) as u8, 90]))
}

fn encoded(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    image.write_to(&mut out, format).unwrap();
    out.into_inner()
}

/// The last photo of an upload, with these changes of its frame.
fn read_last(bytes: Vec<u8>, change: &Value, limits: &Limits) -> PosedPhoto {
    let mut json = transforms();
    without(&mut json["frames"][2], &["cx", "cy", "w", "h"]);
    for (key, value) in change.as_object().unwrap() {
        json["frames"][2][key] = value.clone();
    }
    let (_, mut files) = sent();
    files[2].bytes = bytes;
    photos::read(&with_transforms(&json, files), limits).unwrap().remove(2)
}

#[test]
fn the_formats_and_all_depths_are_read() {
    let decoded = |image: &DynamicImage, format| {
        read_last(encoded(image, format), &json!({}), &Limits::default()).photo
    };
    let rgb = DynamicImage::from(gradient());
    for format in [ImageFormat::Png, ImageFormat::WebP, ImageFormat::Tiff, ImageFormat::Bmp] {
        assert_eq!(decoded(&rgb, format).rgb, gradient().into_raw(), "{format:?}");
    }
    let photo = decoded(&rgb, ImageFormat::Jpeg);
    assert_eq!((photo.width, photo.height), (40, 30));
    let grey16 = ImageBuffer::from_fn(4, 4, |x, _| image::Luma([(x * 0x4040) as u16]));
    assert_eq!(decoded(&grey16.into(), ImageFormat::Png).rgb[3..6], [0x40; 3]);
    let alpha = |x: u32| [127, 128, 0, 255][x as usize];
    let alpha = ImageBuffer::from_fn(4, 4, |x, _| image::Rgba([9_u8, 9, 9, alpha(x)]));
    let photo = decoded(&alpha.into(), ImageFormat::Png);
    // Half a pixel's alpha is enough, and its colour is the stored one.
    assert_eq!(photo.valid.unwrap()[..4], [false, true, false, true]);
    assert_eq!(photo.rgb[3..6], [9; 3]);
}

#[test]
fn large_photos_are_kept_smaller_with_their_camera() {
    let limits = Limits { photo_side_kept_max: 20, ..Limits::default() };
    let lens = json!({"fl_x": 50, "fl_y": 52, "cx": 21, "cy": 14});
    let png = encoded(&gradient().into(), ImageFormat::Png);
    let PosedPhoto { photo, camera, .. } = read_last(png, &lens, &limits);
    let k = camera.intrinsics;
    assert_eq!((photo.width, photo.height, photo.rgb.len()), (20, 15, 900));
    assert_eq!((k.fx, k.fy, k.cx, k.cy), (25.0, 26.0, 10.5, 7.0));
    // The mean of pixels 2 and 3 of a ramp of 6 a pixel.
    assert!(photo.rgb[3].abs_diff(15) <= 1, "{}", photo.rgb[3]);
}

/// One photo after another: the file where its pixels are those that all at once give, else these.
#[test]
fn each_photo_is_its_file_or_the_pixels_that_a_scene_has() {
    let mut bent = transforms();
    bent["k1"] = 0.05.into();
    let small = Limits { photo_side_kept_max: 20, ..Limits::default() };
    for (what, cameras, limits, as_sent) in [
        ("as sent", transforms(), Limits::default(), true),
        ("reduced", transforms(), small, false),
        ("undistorted", bent, Limits::default(), false),
    ] {
        let upload = with_transforms(&cameras, sent().1);
        let all = photos::read(&upload, &limits).unwrap();
        let mut rest = all.iter();
        photos::each(&upload, given(&CamerasReport::default()), &limits, |one| {
            let posed = rest.next().expect("no more than all");
            assert_eq!((one.file, one.camera), (&*posed.file, posed.camera), "{what}");
            let rgb = match one.pixels {
                photos::SentPixels::File(file) => {
                    assert!(as_sent, "{what}: the file");
                    image::load_from_memory(file).unwrap().to_rgb8().into_raw()
                }
                photos::SentPixels::Made(photo) => {
                    assert!(!as_sent, "{what}: other pixels");
                    photo.rgb
                }
            };
            assert!(rgb == posed.photo.rgb, "{what}: {}", one.file);
            Ok(())
        })
        .unwrap();
        assert!(rest.next().is_none(), "{what}: all of them");
    }
}

/// Where a lens draws the ray (x, y, 1): OpenCV's two models. `k`: `k1 k2 k3 k4`, `p`: `p1 p2`.
fn distorted([x, y]: [f64; 2], fisheye: bool, k: [f64; 4], p: [f64; 2]) -> [f64; 2] {
    let r = x.hypot(y);
    let angle = if fisheye { r.atan() } else { r };
    let powers = (1..).map(|n| angle.powi(2 * n));
    let radial = 1.0 + k.iter().zip(powers).map(|(k, power)| k * power).sum::<f64>();
    if fisheye {
        return [x, y].map(|v| if r > 0.0 { v * angle * radial / r } else { v });
    }
    let (xy, r2) = (2.0 * x * y, r * r);
    [
        x * radial + p[0] * xy + p[1] * (r2 + 2.0 * x * x),
        y * radial + p[1] * xy + p[0] * (r2 + 2.0 * y * y),
    ]
}

/// Draws a smooth pattern through a lens and reads the photo. The result must be what a pinhole
/// camera sees. Largest difference, and how many pixels have a source.
fn through_lens(model: &str, k: [f64; 4], p: [f64; 2]) -> (f64, usize) {
    let fisheye = model == "OPENCV_FISHEYE";
    let pattern = |[x, y]: [f64; 2]| 128.0 + 100.0 * (6.0 * x).sin() * (5.0 * y).cos();
    let ray =
        |x: u32, y: u32| [(x, 60.0), (y, 45.0)].map(|(v, c)| (f64::from(v) + 0.5 - c) / 100.0);
    let image = RgbImage::from_fn(120, 90, |x, y| {
        // The ray that the lens draws at this pixel, by fixed-point steps.
        let want = ray(x, y);
        let mut at = want;
        for _ in 0..50 {
            let found = distorted(at, fisheye, k, p);
            at = [0, 1].map(|axis| at[axis] + want[axis] - found[axis]);
        }
        Rgb([pattern(at).round().clamp(0.0, 255.0) as u8; 3])
    });
    let lens = json!({
        "camera_model": model, "fl_x": 100, "fl_y": 100, "w": 120, "h": 90,
        "k1": k[0], "k2": k[1], "k3": k[2], "k4": k[3], "p1": p[0], "p2": p[1],
    });
    let png = encoded(&image.into(), ImageFormat::Png);
    let photo = read_last(png, &lens, &Limits::default()).photo;
    let (mut worst, mut count) = (0.0_f64, 0);
    for (i, value) in photo.rgb.iter().step_by(3).enumerate() {
        if photo.valid.as_ref().is_none_or(|valid| valid[i]) {
            let want = pattern(ray(i as u32 % 120, i as u32 / 120));
            worst = worst.max((f64::from(*value) - want).abs());
            count += 1;
        }
    }
    (worst, count)
}

#[test]
fn distortion_is_undone_and_pixels_without_source_are_invalid() {
    let (worst, count) = through_lens("OPENCV", [-0.12, 0.02, 0.004, -0.001], [0.004, -0.003]);
    assert!(worst < 3.0, "off by {worst} of 255");
    assert!(count > 120 * 90 * 9 / 10, "{count} valid");
    let (worst, count) = through_lens("OPENCV", [0.15, 0.0, 0.0, 0.0], [0.0; 2]);
    assert!(worst < 3.0, "off by {worst} of 255");
    assert!(count < 120 * 90, "corners must have no source");
    let (worst, _) = through_lens("OPENCV_FISHEYE", [0.03, -0.01, 0.0, 0.0], [0.0; 2]);
    assert!(worst < 3.0, "off by {worst} of 255");
}

#[test]
fn the_fold_of_a_strong_lens_makes_no_pixels() {
    let lens = json!({"fl_x": 100, "fl_y": 100, "w": 120, "h": 90, "k1": -0.9});
    let png = encoded(&RgbImage::new(120, 90).into(), ImageFormat::Png);
    let valid = read_last(png, &lens, &Limits::default()).photo.valid.unwrap();
    // r (1 - 0.9 r²) turns at r = 1 / sqrt(2.7).
    for (i, valid) in valid.into_iter().enumerate() {
        let (x, y) = ((i % 120) as f64 - 59.5, (i / 120) as f64 - 44.5);
        let off = x.hypot(y) / 100.0 - 1.0 / 2.7_f64.sqrt();
        assert!(off.abs() < 2e-3 || valid == (off < 0.0), "pixel {i}, {off} from the fold");
    }
}

#[test]
fn a_lens_that_leaves_little_of_a_photo_is_said_to() {
    for (k1, left) in [(50.0, Some(0.15)), (-50.0, Some(0.02)), (0.15, None), (-0.12, None)] {
        let mut told = transforms();
        let frame = &mut told["frames"][1];
        frame["k1"] = json!(k1);
        let upload = with_transforms(&told, sent().1);
        let read = photos::read_until(&upload, &Limits::default(), &AtomicBool::new(false));
        let warnings = read.unwrap().warnings;
        let Some(left) = left else {
            assert!(warnings.is_empty(), "{k1}: {warnings:?}");
            continue;
        };
        let [warning] = &warnings[..] else { panic!("{k1}: {warnings:?}") };
        assert_eq!(warning.code, WarningCode::LensDoubtful);
        assert!(warning.message.starts_with("photo 1 ("), "{k1}: {}", warning.message);
        assert!((1.0 - warning.value - left).abs() < 0.02, "{k1}: {}", warning.value);
    }
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

/// A JPEG whose EXIF says how it is to be turned.
fn with_orientation(image: &DynamicImage, orientation: u8) -> Vec<u8> {
    let mut jpeg = Vec::new();
    let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 97);
    let tiff = [
        &b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0"[..],
        &[orientation, 0, 0, 0, 0, 0, 0, 0],
    ];
    encoder.set_exif_metadata(tiff.concat()).unwrap();
    encoder.encode_image(image).unwrap();
    jpeg
}

/// Mean difference of the pixels of two photos, of 255.
fn off(a: &[u8], b: &[u8]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / a.len() as f64
}

#[test]
fn photos_are_turned_where_their_cameras_are_those_of_the_upright_ones() {
    type Turn = fn(&DynamicImage) -> DynamicImage;
    let upright: Turn = DynamicImage::clone;
    let cases: [([u32; 2], u8, Turn, bool, bool); 6] = [
        // The sizes of the cameras tell.
        ([160, 120], 6, DynamicImage::rotate270, true, true),
        ([160, 120], 8, DynamicImage::rotate90, true, true),
        // Only the pixels tell.
        ([160, 120], 3, DynamicImage::rotate180, true, true),
        ([144, 144], 6, DynamicImage::rotate270, true, true),
        // Cameras of the stored pixels.
        ([160, 120], 3, upright, false, false),
        ([160, 120], 6, upright, false, false),
    ];
    for ([width, height], orientation, turn, is_turned, is_told) in cases {
        let posed = sample::photos(&SampleOptions { photos: 3, width, height, seed: 5 }).unwrap();
        let mut files = sample::png_files(&posed).unwrap();
        for (file, posed) in files.iter_mut().zip(&posed) {
            let image = RgbImage::from_raw(width, height, posed.photo.rgb.clone()).unwrap();
            file.bytes = with_orientation(&turn(&image.into()), orientation);
        }
        let json = UploadCameras::Transforms(sample::transforms_json(&posed));
        let upload = upload(json, files);
        let what = format!("{width}x{height}, {orientation}, {is_turned}");
        let read =
            photos::read_until(&upload, &Limits::default(), &AtomicBool::new(false)).unwrap();
        let codes: Vec<WarningCode> = read.warnings.iter().map(|w| w.code).collect();
        let told = if is_told { vec![WarningCode::PhotosTurned] } else { vec![] };
        assert_eq!(codes, told, "{what}");
        for (got, want) in read.photos.iter().zip(&posed) {
            assert_eq!(got.camera.intrinsics, want.camera.intrinsics, "{what}");
            let off = off(&got.photo.rgb, &want.photo.rgb);
            assert!(off < 3.0, "{what}: {off} of 255");
        }
        // One at a time they are the same.
        let report = CamerasReport::default();
        photos::each(&upload, given(&report), &Limits::default(), |one| {
            let is_file = matches!(one.pixels, photos::SentPixels::File(_));
            assert_eq!(is_file, !is_turned, "{what}");
            Ok(())
        })
        .unwrap();
    }
}

#[test]
fn what_a_mask_leaves_out_is_not_valid() {
    let (posed, files) = sent();
    let mut json = transforms();
    json["frames"][1]["mask_path"] = json!("C:\\masks\\second.png");
    // Half of the size: the left third, the right third, and a single row.
    let mask = |kept: fn(u32, u32) -> bool| {
        image::GrayImage::from_fn(24, 18, |x, y| image::Luma([u8::from(kept(x, y))])).into()
    };
    let png = |kept| encoded(&mask(kept), ImageFormat::Png);
    let stem = |i: usize| files[i].name.trim_end_matches(".png").replace("images/", "");
    let masks = [
        (format!("masks/{}.png", stem(0)), png(|x, _| x >= 8)),
        ("other/masks/second.png".to_owned(), png(|x, _| x < 16)),
        (format!("images/dynamic_mask_{}.png", stem(2)), png(|_, y| y == 0)),
    ];
    let masks = masks.map(|(name, bytes)| UploadFile { name, bytes });
    let is_left_out: [fn(u32, u32) -> bool; 3] = [|x, _| x < 16, |x, _| x >= 32, |_, y| y < 2];
    let whole = with_transforms(&json, files.iter().chain(&masks).cloned().collect());
    let transforms = UploadFile { name: "transforms.json".into(), bytes: json.to_string().into() };
    let as_files = files.iter().chain(&masks).chain([&transforms]).cloned().collect();
    let as_files = Upload { photos: as_files, ..Upload::default() };
    for upload in [whole, as_files] {
        let read =
            photos::read_until(&upload, &Limits::default(), &AtomicBool::new(false)).unwrap();
        let [warning] = &read.warnings[..] else { panic!("{:?}", read.warnings) };
        assert_eq!(warning.code, WarningCode::MasksUsed);
        let share = (1.0 / 3.0 + 1.0 / 3.0 + 2.0 / 36.0) / 3.0;
        assert!((warning.value - share).abs() < 1e-9, "{warning:?}");
        assert_eq!(read.photos.len(), 3);
        for ((got, want), is_left_out) in read.photos.iter().zip(&posed).zip(is_left_out) {
            assert_eq!(got.photo.rgb, want.photo.rgb);
            let valid = got.photo.valid.as_ref().unwrap();
            for (i, valid) in (0..).zip(valid) {
                assert_eq!(*valid, !is_left_out(i % 48, i / 48), "{} pixel {i}", got.file);
            }
        }
    }
    let bytes = encoded(&RgbImage::new(30, 30).into(), ImageFormat::Png);
    let square = UploadFile { bytes, ..masks[0].clone() };
    let files = files.iter().chain([&square]).cloned().collect();
    let words = ["photo 0", "masks/", "30x30", "48x36", "aspect"];
    refused(&with_transforms(&self::transforms(), files), ErrorCode::InvalidRequest, &words);
}

#[test]
fn a_mask_that_is_named_and_not_there_is_told() {
    let mut json = transforms();
    json["frames"][1]["mask_path"] = json!("masks/lost.png");
    let upload = with_transforms(&json, sent().1);
    let read = photos::read_until(&upload, &Limits::default(), &AtomicBool::new(false)).unwrap();
    let [warning] = &read.warnings[..] else { panic!("{:?}", read.warnings) };
    assert_eq!((warning.code, warning.value), (WarningCode::MasksUsed, 1.0));
    assert!(warning.message.contains("masks/lost.png"), "{warning:?}");
    assert!(read.photos.iter().all(|posed| posed.photo.valid.is_none()));
}

#[test]
fn a_jpeg_over_the_limit_is_read_at_a_part_of_its_size() {
    let limits = Limits { photo_pixels_max: 48 * 36, ..Limits::default() };
    for (times, part, told) in [(1, 1, 0), (2, 2, 1), (4, 4, 1), (5, 0, 0)] {
        let (posed, mut files) = sent();
        let image = RgbImage::from_raw(48, 36, posed[2].photo.rgb.clone()).unwrap();
        let filter = image::imageops::FilterType::CatmullRom;
        let large = DynamicImage::from(image).resize_exact(48 * times, 36 * times, filter);
        files[2].bytes = encoded(&large, ImageFormat::Jpeg);
        let upload = with_transforms(&transforms(), files);
        let read = photos::read_until(&upload, &limits, &AtomicBool::new(false));
        if part == 0 {
            let error = read.unwrap_err();
            assert_eq!(error.code(), ErrorCode::LimitExceeded);
            let bound = format!("{} px of a JPEG", 16 * 48 * 36);
            assert!(error.message().contains(&bound), "{error}");
            continue;
        }
        let read = read.unwrap();
        let codes: Vec<WarningCode> = read.warnings.iter().map(|w| w.code).collect();
        assert_eq!(codes, vec![WarningCode::PhotosReduced; told], "{times}");
        let got = &read.photos[2];
        assert_eq!([got.photo.width, got.photo.height], [48 * times / part, 36 * times / part]);
        assert_eq!(got.camera.intrinsics.fx, posed[2].camera.intrinsics.fx);
        let off = off(&got.photo.rgb, &posed[2].photo.rgb);
        assert!(off < 9.0, "{times}: {off} of 255");
    }
    // Of other formats what takes no more memory: 3 bytes a pixel of 8.
    for (times, is_read) in [(1.6, true), (1.7, false)] {
        let (width, height) = ((48.0 * times) as u32, (36.0 * times) as u32);
        let (_, mut files) = sent();
        files[2].bytes = encoded(&RgbImage::new(width, height).into(), ImageFormat::Png);
        let mut json = transforms();
        without(&mut json["frames"][2], &["w", "h"]);
        let read = photos::read(&with_transforms(&json, files), &limits);
        assert_eq!(read.is_ok(), is_read, "{width}x{height}: {:?}", read.err());
    }
}
