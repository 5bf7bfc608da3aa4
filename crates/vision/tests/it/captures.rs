//! Captures of every layout: the same photos give the same scene, what is missing is said, and
//! files that are damaged or lie are refused.

use std::{
    collections::HashSet,
    fmt::Write as _,
    sync::{LazyLock, atomic::AtomicBool},
};

use segsplat_core::{
    error::{Error, ErrorCode},
    limits::Limits,
    scene::{CamerasMode, LengthUnit, PosedPhoto, Upload, UploadFile, Warning, WarningCode},
};
use segsplat_testing::captures::{self, LAYOUTS, zipped};
use segsplat_vision::{
    photos::{self, ReadPhotos},
    sample::{self, SampleOptions},
};
use serde_json::{Value, json};

/// Three photos and their files, made once.
fn sent() -> (Vec<PosedPhoto>, Vec<UploadFile>) {
    static MADE: LazyLock<(Vec<PosedPhoto>, Vec<UploadFile>)> = LazyLock::new(|| {
        let options = SampleOptions { photos: 3, width: 48, height: 36, seed: 5 };
        let posed = sample::photos(&options).unwrap();
        let files = sample::png_files(&posed).unwrap();
        (posed, files)
    });
    MADE.clone()
}

fn written(layout: &str) -> Vec<UploadFile> {
    let (posed, pngs) = sent();
    captures::write(layout, &posed, &pngs)
}

fn read(files: Vec<UploadFile>) -> Result<ReadPhotos, Error> {
    read_within(files, &Limits::default())
}

fn read_within(files: Vec<UploadFile>, limits: &Limits) -> Result<ReadPhotos, Error> {
    let upload = Upload { photos: files, ..Upload::default() };
    photos::read_until(&upload, limits, &AtomicBool::new(false))
}

fn tarred(files: &[UploadFile]) -> Vec<u8> {
    let mut tar = tar::Builder::new(Vec::new());
    for file in files {
        let mut header = tar::Header::new_gnu();
        header.set_size(file.bytes.len() as u64);
        header.set_mode(0o644);
        tar.append_data(&mut header, &file.name, &file.bytes[..]).unwrap();
    }
    tar.into_inner().unwrap()
}

fn from_archive(bytes: Vec<u8>) -> ReadPhotos {
    let upload = Upload { archive: Some(bytes), ..Upload::default() };
    photos::read_until(&upload, &Limits::default(), &AtomicBool::new(false)).unwrap()
}

fn from_disk(files: &[UploadFile]) -> (ReadPhotos, Upload) {
    let dir = tempfile::tempdir().unwrap();
    for file in files {
        let path = dir.path().join(&file.name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, &file.bytes).unwrap();
    }
    photos::read_dir_until(dir.path(), &Limits::default(), &AtomicBool::new(false)).unwrap()
}

/// The largest difference of two poses or lenses.
fn apart(a: &PosedPhoto, b: &PosedPhoto) -> f64 {
    let numbers = |posed: &PosedPhoto| {
        let k = posed.camera.intrinsics;
        let pose = posed.camera.camera_to_world.to_row_major();
        pose.into_iter().chain([k.fx, k.fy, k.cx, k.cy]).collect::<Vec<f64>>()
    };
    numbers(a).iter().zip(numbers(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Layouts of programs that measure in metres.
const METRES: [&str; 5] = ["polycam", "polycam_corrected", "record3d", "r3d", "arkitscenes"];

#[test]
fn every_layout_gives_the_same_photos_however_it_is_sent() {
    let (posed, _) = sent();
    let reference = read(written("cameras")).unwrap().photos;
    assert!(reference.iter().zip(&posed).all(|(a, b)| apart(a, b) < 1e-12));
    for (layout, same_numbers) in LAYOUTS {
        let files = written(layout);
        let (disk, found) = from_disk(&files);
        let ways = [
            ("form", read(files.clone()).unwrap()),
            ("zip", from_archive(zipped(&files, "my scan/"))),
            ("tar", from_archive(tarred(&files))),
            ("disk", disk),
            // What a folder's provenance names is a capture of its own.
            ("found", read(found.photos).unwrap()),
        ];
        for (way, ReadPhotos { photos, warnings, unit }) in ways {
            assert_eq!(warnings, [], "{layout} {way}");
            let metres = METRES.contains(&layout);
            assert_eq!(unit == LengthUnit::Metre, metres, "{layout} {way}");
            assert_eq!(photos.len(), 3, "{layout} {way}");
            for (got, want) in photos.iter().zip(&reference) {
                assert_eq!(got.photo.rgb, want.photo.rgb, "{layout} {way} {}", got.file);
                assert_eq!(got.photo.valid, None, "{layout} {way}");
                // The same digits are the same number. Reading JSON, quaternions, axes with angles,
                // inverses and shares of a width cost a rounding.
                let most = if same_numbers { 0.0 } else { 1e-13 };
                let off = apart(got, want);
                assert!(off <= most, "{layout} {way}: {off:e}");
            }
        }
    }
}

/// Files of two captures in one folder.
fn both(a: &str, b: &str) -> Vec<UploadFile> {
    let mut all = written(a);
    all.extend(written(b).into_iter().filter(|new| written(a).iter().all(|f| f.name != new.name)));
    all
}

#[test]
fn of_cameras_made_of_one_another_the_first_are_read_and_mixtures_are_refused() {
    for (a, b) in [("transforms", "colmap_bin"), ("transforms", "llff"), ("colmap_txt", "llff")] {
        let mut files = both(a, b);
        // Whatever is wrong with the other's cameras.
        let other = captures::described_by(b);
        files.iter_mut().find(|file| file.name == other).unwrap().bytes.truncate(30);
        assert_eq!(read(files).unwrap().photos.len(), 3, "{a} and {b}");
    }
    // Cameras of the same photos: the better layout, with a word on the other.
    for (a, b, first) in
        [("transforms", "cameras", "transforms.json"), ("cameras", "colmap_bin", "sparse/0")]
    {
        let read = read(both(a, b)).unwrap();
        let [warning] = &read.warnings[..] else { panic!("{a} and {b}: {:?}", read.warnings) };
        assert_eq!((warning.code, warning.value), (WarningCode::CamerasChosen, 1.0));
        let taken = format!("cameras from {first:?}");
        assert!(warning.message.contains(&taken), "{}", warning.message);
    }
    for (a, b, words) in [
        ("polycam", "record3d", ["Polycam", "Record3D"]),
        ("mvsnet", "arkitscenes", ["MVSNet", "ARKitScenes"]),
        ("llff", "realestate", ["LLFF", "RealEstate10K"]),
    ] {
        let error = read(both(a, b)).unwrap_err();
        let message = error.message();
        assert_eq!(error.code(), ErrorCode::InvalidRequest, "{message}");
        assert!(message.contains("two captures"), "{message}");
        assert!(words.iter().all(|word| message.contains(word)), "{message}");
    }
    let nothing = vec![UploadFile { name: "notes.txt".to_owned(), bytes: b"hello".to_vec() }];
    let error = read(nothing).unwrap_err();
    assert!(error.message().contains("COLMAP, LLFF"), "{error}");
}

#[test]
fn of_several_models_of_colmap_the_largest_is_read() {
    let (posed, pngs) = sent();
    let mut files = captures::write("colmap_bin", &posed, &pngs);
    for mut file in captures::write("colmap_txt", &posed[..2], &pngs[..2]) {
        if let Some(name) = file.name.strip_prefix("sparse/0/") {
            file.name = format!("sparse/1/{name}");
            files.push(file);
        }
    }
    // Pictures of these names at other sizes.
    for folder in ["images_2", "images_4"] {
        let copies: Vec<_> = files.iter().filter(|f| f.name.starts_with("images/")).collect();
        let copies = copies.into_iter().map(|f| UploadFile {
            name: f.name.replacen("images", folder, 1),
            bytes: b"smaller".to_vec(),
        });
        files.extend(copies.collect::<Vec<_>>());
    }
    files.push(UploadFile { name: "sparse/0/rigs.bin".to_owned(), bytes: vec![1; 9] });
    let got = read(files.clone()).unwrap();
    assert_eq!(got.photos.len(), 3);
    // Two folders of which nothing says which is meant.
    for file in &mut files {
        file.name = file.name.replacen("images/", "left/", 1).replacen("images_2/", "right/", 1);
        if file.name.starts_with("right/") {
            file.bytes.clone_from(&pngs[0].bytes);
        }
    }
    files.retain(|file| !file.name.starts_with("images_4"));
    let error = read(files).unwrap_err();
    assert!(error.message().contains("in \"left\" and in \"right\""), "{error}");
}

/// Code, value and message of all warnings.
fn warnings(files: Vec<UploadFile>) -> Vec<(WarningCode, f64, String)> {
    let read = read(files).unwrap();
    assert_eq!(read.photos.len(), 2);
    read.warnings.into_iter().map(|w| (w.code, w.value, w.message)).collect()
}

#[test]
fn what_is_missing_alone_or_kept_for_tests_is_said() {
    for layout in ["transforms", "scannetpp", "colmap_bin", "polycam", "mvsnet", "realestate"] {
        let mut files = written(layout);
        let at = files.iter().rposition(|file| file.name.ends_with(".png")).unwrap();
        let gone = files.remove(at).name;
        let folder = gone.rsplit_once('/').unwrap().0;
        let lone = UploadFile { name: format!("{folder}/lone.png"), bytes: b"?".to_vec() };
        let first = files.iter().find(|file| file.name.ends_with(".png")).unwrap();
        let mask = first.name.replace(".png", "_mask.png");
        files.extend([lone, UploadFile { name: mask, bytes: b"?".to_vec() }]);
        let said = warnings(files);
        let [(missing, 1.0, one), (unused, 1.0, two)] = &said[..] else {
            panic!("{layout}: {said:?}")
        };
        assert_eq!([*missing, *unused], [WarningCode::PhotosMissing, WarningCode::PhotosUnused]);
        let stem = gone.rsplit_once('/').unwrap().1.trim_end_matches(".png");
        assert!(one.contains(stem) && two.contains("lone.png"), "{layout}: {said:?}");
    }
    // ARKitScenes' photos without a pose have no camera.
    let mut files = written("arkitscenes");
    let traj = files.iter_mut().find(|file| file.name.ends_with(".traj")).unwrap();
    let text = String::from_utf8(traj.bytes.clone()).unwrap();
    traj.bytes = text
        .lines()
        .take(2)
        .fold(String::new(), |mut all, line| {
            let _ = writeln!(all, "{line}");
            all
        })
        .into_bytes();
    let said = warnings(files);
    assert!(matches!(&said[..], [(WarningCode::PhotosUnused, 1.0, _)]), "{said:?}");
    // What is kept for tests, in each way to say it.
    type Change = fn(&mut Value);
    let ways: [Change; 3] = [
        |json| json["frames"][1]["is_bad"] = json!(true),
        |json| json["test_filenames"] = json!([json["frames"][1]["file_path"]]),
        |json| {
            let frame = json["frames"].as_array_mut().unwrap().remove(1);
            json["test_frames"] = json!([frame]);
        },
    ];
    for (i, change) in ways.into_iter().enumerate() {
        let mut files = written("transforms");
        let mut json: Value = serde_json::from_slice(&files[0].bytes).unwrap();
        change(&mut json);
        files[0].bytes = json.to_string().into_bytes();
        let said = warnings(files);
        let [(WarningCode::PhotosUnused, 1.0, message)] = &said[..] else {
            panic!("way {i}: {said:?}")
        };
        assert!(message.contains("images/0001.png") && message.contains("tests"), "{message}");
    }
    let mut files = written("colmap_txt");
    let list = json!({"train": ["0000.png", "0002.png"], "test": ["0001.png"]}).to_string();
    files.push(UploadFile { name: "train_test_lists.json".to_owned(), bytes: list.into() });
    let said = warnings(files);
    assert!(matches!(&said[..], [(WarningCode::PhotosUnused, 1.0, _)]), "{said:?}");
}

#[test]
fn of_too_many_photos_the_best_are_taken_and_named() {
    let (posed, pngs) = sent();
    let one = |i: usize| {
        let mut photo = posed[0].clone();
        let turn = i as f64 / 70.0 * std::f64::consts::TAU;
        let eye = glam::DVec3::new(turn.cos(), 0.0, turn.sin());
        photo.camera.camera_to_world = segsplat_core::scene::CameraToWorld::look_at(
            eye,
            glam::DVec3::ZERO,
            glam::DVec3::Y,
            "test",
        )
        .unwrap();
        photo
    };
    let many: Vec<PosedPhoto> = (0..70).map(one).collect();
    let mut jpeg = std::io::Cursor::new(Vec::new());
    image::load_from_memory(&pngs[0].bytes)
        .and_then(|it| it.write_to(&mut jpeg, image::ImageFormat::Jpeg))
        .unwrap();
    let jpeg = UploadFile { bytes: jpeg.into_inner(), ..pngs[0].clone() };
    let never = AtomicBool::new(false);
    let limits = Limits { photos_max: 68, ..Limits::default() };
    // Photos for the steps alone need not be decoded whole: counted, for no clock says it.
    let (whole, half) = (4 * 48 * 36, 4 * 24 * 18);
    for (layout, file, pixels) in [
        ("transforms", &pngs[0], whole),
        ("colmap_bin", &pngs[0], whole),
        ("transforms", &jpeg, half),
    ] {
        let files = vec![file.clone(); 70];
        let archive = Some(zipped(&captures::write(layout, &many, &files), ""));
        let upload = Upload { archive, ..Upload::default() };
        let got = photos::read_until(&upload, &limits, &never).unwrap();
        assert_eq!(got.photos.len(), 64, "{layout}");
        let [unused, more] = &got.warnings[..] else { panic!("{layout}: {:?}", got.warnings) };
        assert_eq!((unused.code, unused.value), (WarningCode::PhotosUnused, 2.0));
        assert!(unused.message.contains("68 of these 70 photos"), "{}", unused.message);
        assert_eq!((more.code, more.value), (WarningCode::PhotosForSteps, 4.0));
        assert!(more.message.contains("64 of these 68 photos"), "{}", more.message);
        let named = |warning: &Warning| -> Vec<String> {
            warning.message.split('"').skip(1).step_by(2).map(str::to_owned).collect()
        };
        let (left_out, for_steps) = (named(unused), named(more));
        assert_eq!([left_out.len(), for_steps.len()], [2, 4]);
        let mut all: Vec<String> = got.photos.iter().map(|photo| photo.file.clone()).collect();
        assert!(all.is_sorted(), "in the cameras' order");
        all.extend([left_out, for_steps.clone()].concat());
        all.sort();
        all.dedup();
        assert_eq!(all.len(), 70, "{layout}: each photo is in one place");
        let (mut read, auto) = (Vec::new(), CamerasMode::Auto);
        let decoded = photos::more(&upload, auto, 24, &limits, &never, |photo| {
            let stem = photo.file.trim_end_matches(".png");
            let number: usize = stem[stem.len() - 4..].parse().unwrap();
            let [got, want] = [&photo, &many[number]].map(|it| it.camera.camera_to_world);
            assert!(got.center().distance(want.center()) < 1e-5, "{layout}: {}", photo.file);
            assert!(got.turn_to(&want) < 1e-5, "{layout}: {}", photo.file);
            assert_eq!((photo.photo.width, photo.photo.height), (24, 18), "{layout}");
            let focal = photo.camera.intrinsics.fx / posed[0].camera.intrinsics.fx;
            assert!((focal - 0.5).abs() < 1e-9, "{layout}: the lens is of the size");
            read.push(photo.file.clone());
            Ok(())
        })
        .unwrap();
        assert_eq!(read, for_steps, "{layout}");
        assert_eq!(decoded, pixels, "{layout}");
    }
}

/// Reads the capture with each of the other contents of one file: all must be refused, and the
/// message names the file, or the photo.
fn refused(layout: &str, file: &str, cases: Vec<(String, Vec<u8>)>) {
    let files: HashSet<&[u8]> = cases.iter().map(|(_, bytes)| &bytes[..]).collect();
    assert!(files.len() >= 20, "{layout} {file}: {} files", files.len());
    println!("{layout} {file}: {} damaged files", files.len());
    let name = file.rsplit('/').next().unwrap_or(file);
    // All of one kind of JSON are called by it.
    let kind = if layout == "blender" { "transforms" } else { name };
    let names = [name, name.trim_end_matches(".json"), kind, "photo ", ".png"];
    for (what, bytes) in cases {
        let mut files = written(layout);
        files.iter_mut().find(|f| f.name == file).unwrap().bytes = bytes;
        let limits = Limits { camera_file_bytes_max: 1 << 20, ..Limits::default() };
        let Err(error) = read_within(files, &limits) else { panic!("{layout} {file}: {what}") };
        let message = error.message();
        let codes =
            [ErrorCode::InvalidRequest, ErrorCode::PhotoUnreadable, ErrorCode::LimitExceeded];
        assert!(codes.contains(&error.code()), "{layout} {what}: {error}");
        assert!(names.iter().any(|name| message.contains(name)), "{layout} {what}: {message}");
        assert!(message.len() < 400, "{layout} {what}: {message}");
    }
}

fn content(layout: &str, file: &str) -> Vec<u8> {
    written(layout).into_iter().find(|f| f.name == file).unwrap().bytes
}

/// A JSON file spoilt as a whole, and numbers of it by their places.
fn spoilt_json(bytes: &[u8], pose: &str, focal: &str, width: &str) -> Vec<(String, Vec<u8>)> {
    let whole: [(&str, Vec<u8>); 10] = [
        ("cut to half", bytes[..bytes.len() / 2].to_vec()),
        ("its last byte cut", bytes[..bytes.len() - 1].to_vec()),
        ("two of it", [bytes, bytes].concat()),
        ("a list", b"[]".to_vec()),
        ("null", b"null".to_vec()),
        ("nothing known in it", b"{\"t_00\":1}".to_vec()),
        ("no UTF-8", [b"\xff\"t_00\"", bytes].concat()),
        ("deep", [b"{\"t_00\":".to_vec(), b"[".repeat(100_000)].concat()),
        ("too many values", format!("{{\"t_00\":[{}0]}}", "0,".repeat(250_000)).into()),
        ("too large", [bytes, &vec![b' '; 8 << 20]].concat()),
    ];
    let mut cases: Vec<_> = whole.map(|(what, bytes)| (what.to_owned(), bytes)).into();
    let values = [
        (pose, vec![json!(null), json!("text"), json!({}), json!(1e300)]),
        (focal, vec![json!(null), json!("wide"), json!([1]), json!(0), json!(-5), json!(1e300)]),
        (width, vec![json!(null), json!("wide"), json!(0), json!(-1), json!(1.5), json!(1e12)]),
    ];
    for (place, values) in values {
        for value in values {
            let mut json: Value = serde_json::from_slice(bytes).unwrap();
            *json.pointer_mut(place).unwrap() = value.clone();
            cases.push((format!("{place} is {value}"), json.to_string().into_bytes()));
        }
        let text = serde_json::from_slice::<Value>(bytes).unwrap();
        let mut marked = text.clone();
        *marked.pointer_mut(place).unwrap() = json!("HERE");
        for number in ["NaN", "-Infinity", "1e999"] {
            let text = marked.to_string().replace("\"HERE\"", number);
            cases.push((format!("{place} is {number}"), text.into_bytes()));
        }
    }
    cases
}

#[test]
fn damaged_camera_jsons_are_refused() {
    for (layout, pose, focal, width) in [
        ("transforms", "/frames/0/transform_matrix/0/0", "/frames/0/fl_x", "/frames/0/w"),
        ("scannetpp", "/frames/0/transform_matrix/1/3", "/frames/0/fl_y", "/frames/0/h"),
        (
            "cameras",
            "/cameras/0/camera_to_world/0/0",
            "/cameras/0/intrinsics/fx",
            "/cameras/0/intrinsics/width",
        ),
        ("polycam", "/t_00", "/fx", "/width"),
        ("polycam_corrected", "/t_12", "/fy", "/height"),
        ("record3d", "/poses/0/0", "/perFrameIntrinsicCoeffs/0/0", "/w"),
        ("r3d", "/poses/0/6", "/perFrameIntrinsicCoeffs/0/1", "/h"),
        (
            "blender",
            "/frames/0/transform_matrix/2/3",
            "/camera_angle_x",
            "/frames/0/transform_matrix/0/0",
        ),
    ] {
        let file = captures::described_by(layout);
        let mut cases = spoilt_json(&content(layout, file), pose, focal, width);
        // Where a translation may be large, or a quaternion has any length.
        cases.retain(|(what, _)| {
            let any_size = ["scannetpp", "record3d", "r3d", "blender"].contains(&layout)
                && what.starts_with(pose);
            !(any_size && what.contains("300"))
        });
        refused(layout, file, cases);
    }
}

#[test]
fn damaged_models_of_colmap_are_refused() {
    let patch = |bytes: &[u8], at: usize, new: &[u8]| {
        let mut bytes = bytes.to_vec();
        bytes[at..at + new.len()].copy_from_slice(new);
        bytes
    };
    let images = content("colmap_bin", "sparse/0/images.bin");
    let lenses = content("colmap_bin", "sparse/0/cameras.bin");
    let cut = |bytes: &[u8], at: usize| (format!("cut at {at}"), bytes[..at].to_vec());
    let mut cases: Vec<(String, Vec<u8>)> =
        [0, 4, 7, 8, 11, 12, 43, 68, 75, 80, 90, images.len() - 25, images.len() - 1]
            .map(|at| cut(&images, at))
            .into();
    for count in [0, 1, 2, 4, 1 << 40, u64::MAX] {
        cases.push((format!("count {count}"), patch(&images, 0, &count.to_le_bytes())));
    }
    for at in [12, 44] {
        for number in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            let bytes = patch(&images, at, &number.to_le_bytes());
            cases.push((format!("{number} at {at}"), bytes));
        }
    }
    cases.push(("a turn of 0".to_owned(), patch(&images, 12, &[0; 32])));
    cases.push(("an unknown camera".to_owned(), patch(&images, 68, &[9, 0, 0, 0])));
    cases.push(("a name without end".to_owned(), patch(&images, 80, b"x")));
    cases.push(("a name that is no text".to_owned(), patch(&images, 72, b"\xff\xfe")));
    for points in [u64::MAX, u64::MAX / 24, 1 << 60, 2] {
        cases.push((format!("{points} points"), patch(&images, 81, &points.to_le_bytes())));
    }
    cases.push(("bytes after its end".to_owned(), [&images[..], &[0]].concat()));
    cases.push(("too large".to_owned(), vec![0; (1 << 20) + 1]));
    refused("colmap_bin", "sparse/0/images.bin", cases);

    let mut cases: Vec<(String, Vec<u8>)> =
        [0, 5, 8, 12, 16, 24, 31, 32, 63, lenses.len() - 1].map(|at| cut(&lenses, at)).into();
    for count in [0, 2, 4, u64::MAX] {
        cases.push((format!("count {count}"), patch(&lenses, 0, &count.to_le_bytes())));
    }
    for model in [0, 17, 18, 99, u32::MAX] {
        cases.push((format!("model {model}"), patch(&lenses, 12, &model.to_le_bytes())));
    }
    for size in [0, 7, u64::MAX] {
        cases.push((format!("width {size}"), patch(&lenses, 16, &size.to_le_bytes())));
    }
    for focal in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e300] {
        cases.push((format!("focal {focal}"), patch(&lenses, 32, &focal.to_le_bytes())));
    }
    cases.push(("the same number twice".to_owned(), patch(&lenses, 8, &[2, 0, 0, 0])));
    refused("colmap_bin", "sparse/0/cameras.bin", cases);

    let text = String::from_utf8(content("colmap_txt", "sparse/0/images.txt")).unwrap();
    let line = text.lines().nth(1).unwrap().to_owned();
    let words: Vec<&str> = line.split(' ').collect();
    let mut lines: Vec<String> =
        (0..10).map(|count| words[..count].join(" ")).filter(|line| !line.is_empty()).collect();
    for at in 1..9 {
        for word in ["nan", "inf", "x", "1,5,0"] {
            let mut words = words.clone();
            words[at] = word;
            lines.push(words.join(" "));
        }
    }
    let mut zero = words.clone();
    zero[1..5].fill("0");
    lines.extend([zero.join(" "), line.replace(" 1 0000.png", " 77 0000.png")]);
    let case = |new: &String| (new.clone(), text.replacen(&line, new, 1).into_bytes());
    let mut cases: Vec<_> = lines.iter().map(case).collect();
    cases.push(("no UTF-8".to_owned(), [text.as_bytes(), b"\xff"].concat()));
    refused("colmap_txt", "sparse/0/images.txt", cases);

    let text = String::from_utf8(content("colmap_txt", "sparse/0/cameras.txt")).unwrap();
    let line = text.lines().nth(1).unwrap().to_owned();
    let words: Vec<&str> = line.split(' ').collect();
    let mut lines: Vec<String> = (1..words.len()).map(|count| words[..count].join(" ")).collect();
    for at in 0..words.len() {
        for word in ["nan", "-1", "x"] {
            let mut words = words.clone();
            words[at] = word;
            // A principal point may lie outside.
            if !(at > 5 && word == "-1") {
                lines.push(words.join(" "));
            }
        }
    }
    lines.extend([format!("{line} 1"), line.replace("PINHOLE", "EQUIRECTANGULAR")]);
    let case = |new: &String| (new.clone(), text.replacen(&line, new, 1).into_bytes());
    refused("colmap_txt", "sparse/0/cameras.txt", lines.iter().map(case).collect());
}

#[test]
fn damaged_arrays_of_llff_are_refused() {
    let file = "poses_bounds.npy";
    let bytes = content("llff", file);
    let start = bytes.len() - 3 * 17 * 8;
    let mut cases: Vec<(String, Vec<u8>)> = [0, 5, 6, 9, 12, 40, start - 1, start, start + 8]
        .map(|at| (format!("cut at {at}"), bytes[..at].to_vec()))
        .into();
    cases.push(("a number short".to_owned(), bytes[..bytes.len() - 8].to_vec()));
    cases.push(("a number more".to_owned(), [&bytes[..], &[0; 8]].concat()));
    for (from, to) in [
        ("(3, 17)", "(4, 17)"),
        ("(3, 17)", "(9999999999999999, 17)"),
        ("(3, 17)", "(3, 18)"),
        ("(3, 17)", "(51,)"),
        ("(3, 17)", "(1, 3, 17)"),
        ("(3, 17)", "(-3, 17)"),
        ("<f8", "<f4"),
        ("<f8", ">f8"),
        ("<f8", "|O"),
        ("False", "True"),
        ("NUMPY", "NUMBY"),
    ] {
        let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
        let new = [&bytes[..at], to.as_bytes(), &bytes[at + from.len()..]].concat();
        cases.push((format!("{to} for {from}"), new));
    }
    let length = bytes[8];
    for new in [0, length - 1, 255] {
        let mut lying = bytes.clone();
        lying[8] = new;
        cases.push((format!("a header of {new} bytes"), lying));
    }
    // Row by row: axes, centre, and height, width, focal length.
    for at in [0, 1, 2, 3, 4, 9, 14] {
        for number in [f64::NAN, f64::INFINITY] {
            let mut bytes = bytes.clone();
            bytes[start + at * 8..start + at * 8 + 8].copy_from_slice(&number.to_le_bytes());
            cases.push((format!("{number} at {at}"), bytes));
        }
    }
    refused("llff", file, cases);
}

/// The text with each of its words from the `first` on replaced by what is no number.
fn spoilt_text(text: &str, skipped: usize) -> Vec<(String, Vec<u8>)> {
    let mut cases: Vec<(String, Vec<u8>)> = Vec::new();
    let words: Vec<(usize, &str)> = text
        .split_ascii_whitespace()
        .map(|word| (word.as_ptr() as usize - text.as_ptr() as usize, word))
        .collect();
    for (at, word) in words.into_iter().skip(skipped) {
        for new in ["nan", "inf", "x", "", "1 1"] {
            let text = format!("{}{new}{}", &text[..at], &text[at + word.len()..]);
            cases.push((format!("{new:?} for {word} at {at}"), text.into_bytes()));
        }
    }
    cases.push(("no UTF-8".to_owned(), [text.as_bytes(), b"\xff"].concat()));
    cases.push(("too large".to_owned(), [text.as_bytes(), &vec![b' '; 1 << 20]].concat()));
    cases
}

#[test]
fn damaged_texts_with_cameras_are_refused() {
    let text = |layout: &str, file: &str| String::from_utf8(content(layout, file)).unwrap();
    let cam = "cams/00000000_cam.txt";
    let whole = text("mvsnet", cam);
    // The range of depths is not looked at.
    let (read, rest) = whole.split_at(whole.find("2.5 0.1").unwrap());
    let mut cases = spoilt_text(read, 0);
    cases.iter_mut().for_each(|(_, bytes)| bytes.extend(rest.bytes()));
    // Of K three numbers are looked at, and "1 1" moves those after it.
    let k = read.find("intrinsic\n").unwrap();
    let looked_at = |what: &str| {
        let at = what.rsplit(' ').next().and_then(|at| at.parse::<usize>().ok());
        at.is_none_or(|at| at < k)
    };
    cases.retain(|(what, _)| looked_at(what));
    refused("mvsnet", cam, cases);

    let pincam = "41069021/lowres_wide_intrinsics/41069021_305.377.pincam";
    refused("arkitscenes", pincam, spoilt_text(&text("arkitscenes", pincam), 0));
    let traj = "41069021/lowres_wide.traj";
    let whole = text("arkitscenes", traj);
    let first = whole.lines().next().unwrap();
    let rest = whole[first.len()..].to_owned();
    let mut cases = spoilt_text(first, 1);
    cases.iter_mut().for_each(|(_, bytes)| bytes.extend(rest.bytes()));
    refused("arkitscenes", traj, cases);

    let whole = text("realestate", "clip.txt");
    let first = whole.lines().nth(1).unwrap().to_owned();
    let mut cases = spoilt_text(&first, 1);
    // One that is too large is not even looked into.
    cases.retain(|(what, _)| what != "too large");
    // Without 19 words in its first line it is none of these.
    let head = whole.lines().next().unwrap();
    let sound = whole.lines().nth(2).unwrap();
    for (_, bytes) in &mut cases {
        *bytes = [head.as_bytes(), b"\n", sound.as_bytes(), b"\n", bytes].concat();
    }
    refused("realestate", "clip.txt", cases);
}
