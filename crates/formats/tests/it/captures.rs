//! Captures as programs and people leave them: which cameras and which photos of a folder are
//! taken, and what is said of the others.

use std::{fmt::Write as _, io::Cursor};

use segsplat_core::{
    error::Result,
    limits::Limits,
    scene::{Upload, UploadFile, WarningCode},
};
use segsplat_formats::captures::find;

/// Files by path.
type Files = Vec<(String, Vec<u8>)>;

/// What was found: for each photo its path, focal length and centre; code and text of each warning.
struct Found {
    photos: Vec<(String, f64, [f64; 3])>,
    warnings: Vec<(WarningCode, String)>,
}

impl Found {
    fn paths(&self) -> Vec<&str> {
        self.photos.iter().map(|photo| photo.0.as_str()).collect()
    }

    fn said(&self, code: WarningCode) -> &str {
        let found = self.warnings.iter().find(|warning| warning.0 == code);
        found.map_or("", |warning| warning.1.as_str())
    }
}

fn read(files: &Files) -> Result<Found> {
    let files =
        files.iter().map(|(name, bytes)| UploadFile { name: name.clone(), bytes: bytes.clone() });
    let upload = Upload { photos: files.collect(), ..Upload::default() };
    let limits = Limits::default();
    let found = find(&upload, &limits)?;
    let photo = |photo: &segsplat_formats::captures::FoundPhoto<'_>| {
        let bytes = photo.bytes.read().unwrap();
        let size = image::ImageReader::new(Cursor::new(&bytes[..]));
        let (width, height) = size.with_guessed_format().unwrap().into_dimensions().unwrap();
        let lens = photo.lens.at_size(width, height, "test").unwrap();
        (photo.path.clone(), lens.intrinsics.fx, photo.pose.center().to_array())
    };
    Ok(Found {
        photos: found.photos.iter().map(photo).collect(),
        warnings: found.warnings.iter().map(|w| (w.code, w.message.clone())).collect(),
    })
}

fn refused(files: &Files, words: &[&str]) {
    let Err(error) = read(files) else { panic!("read, not refused with {words:?}") };
    let message = error.message();
    assert!(words.iter().all(|word| message.contains(word)), "{words:?}: {message}");
    assert!(message.len() < 800, "{message}");
}

fn png([width, height]: [u32; 2]) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    let image = image::RgbImage::from_pixel(width, height, image::Rgb([9, 90, 200]));
    image.write_to(&mut out, image::ImageFormat::Png).unwrap();
    out.into_inner()
}

/// Photos of this size.
fn photos(dir: &str, size: [u32; 2], names: &[&str]) -> Files {
    names.iter().map(|name| (format!("{dir}{name}"), png(size))).collect()
}

/// A model of COLMAP as text in a folder: camera 1 of this line, images one unit apart.
fn colmap(dir: &str, camera: &str, names: &[&str]) -> Files {
    let mut images = String::new();
    for (i, name) in names.iter().enumerate() {
        writeln!(images, "{} 1 0 0 0 -{i} 0 0 1 {name}\n1.5 2.5 -1 3 4 7", i + 1).unwrap();
    }
    vec![
        (format!("{dir}cameras.txt"), format!("1 {camera}\n").into()),
        (format!("{dir}images.txt"), images.into()),
    ]
}

/// A `transforms.json` of cameras one unit apart.
fn transforms(path: &str, size: [u32; 2], focal: f64, names: &[&str]) -> Files {
    let frames: Vec<String> = names
        .iter()
        .enumerate()
        .map(|(i, name)| {
            let name = name.replace('\\', "\\\\");
            let rows = format!("[[1,0,0,{i}],[0,1,0,0],[0,0,1,0],[0,0,0,1]]");
            format!("{{\"file_path\":\"{name}\",\"transform_matrix\":{rows}}}")
        })
        .collect();
    let [w, h] = size;
    let frames = frames.join(",");
    let json = format!("{{\"fl_x\":{focal},\"w\":{w},\"h\":{h},\"frames\":[{frames}]}}");
    vec![(path.to_owned(), json.into())]
}

const FOUR: [&str; 4] = ["0.png", "1.png", "2.png", "3.png"];
const IN_IMAGES: [&str; 4] = ["images/0.png", "images/1.png", "images/2.png", "images/3.png"];

#[test]
fn of_the_models_that_an_undistortion_leaves_that_of_the_photos_is_read() {
    for undistorted in [[33, 25], [31, 23]] {
        let [w, h] = undistorted;
        let pinhole = format!("PINHOLE {w} {h} 30 30 {} {}", w / 2, h / 2);
        let mut files = [
            photos("input/", [32, 24], &FOUR),
            photos("images/", undistorted, &FOUR),
            colmap("distorted/sparse/0/", "SIMPLE_RADIAL 32 24 40 16 12 -0.1", &FOUR),
            colmap("sparse/0/", &pinhole, &FOUR),
        ]
        .concat();
        let found = read(&files).unwrap();
        assert_eq!(found.paths(), IN_IMAGES);
        assert_eq!(found.photos[0].1, 30.0);
        let said = found.said(WarningCode::CamerasChosen);
        assert!(said.contains("cameras from \"sparse/0\""), "{said}");
        assert!(said.contains("also seen: \"distorted/sparse/0\""), "{said}");
        // Without the distorted photos the other model fits nothing.
        files.drain(..4);
        assert_eq!(read(&files).unwrap().paths(), IN_IMAGES);
    }
}

#[test]
fn a_workspace_in_a_capture_is_no_second_capture() {
    let model = |dir: &str| colmap(dir, "PINHOLE 32 24 30 30 16 12", &FOUR);
    let files = [
        photos("images/", [16, 12], &FOUR),
        model("sparse/0/"),
        photos("dense/images/", [32, 24], &FOUR),
        model("dense/sparse/"),
    ];
    let found = read(&files.concat()).unwrap();
    assert!(found.paths()[0].starts_with("dense/images/"), "{:?}", found.paths());
    assert!(found.said(WarningCode::CamerasChosen).contains("sparse/0"));
}

#[test]
fn what_trainings_and_converters_leave_beside_a_capture_is_not_taken() {
    let list: Vec<String> = FOUR
        .iter()
        .map(|name| {
            let rotation = "[[1,0,0],[0,1,0],[0,0,1]]";
            let name = name.trim_end_matches(".png");
            format!(
                "{{\"id\":0,\"img_name\":\"{name}\",\"width\":32,\"height\":24,\
                 \"position\":[{name},0,0],\"rotation\":{rotation},\"fy\":50.0,\"fx\":50.0}}"
            )
        })
        .collect();
    let of_training = (("output/cameras.json").to_owned(), format!("[{}]", list.join(",")).into());
    let capture = [
        photos("images/", [32, 24], &FOUR),
        photos("output/train/ours_30000/renders/", [32, 24], &FOUR),
        photos("masks/", [32, 24], &FOUR),
        photos("depth/", [32, 24], &["0.png", "1.png", "2.png", "3.png", "4.png"]),
        vec![of_training],
    ]
    .concat();
    // Alone it is read itself.
    let alone = read(&capture).unwrap();
    assert_eq!((alone.paths(), alone.photos[2].1), (IN_IMAGES.to_vec(), 50.0));
    assert_eq!(alone.photos[2].2, [2.0, 0.0, 0.0]);
    let model = colmap("sparse/0/", "PINHOLE 32 24 30 30 16 12", &FOUR);
    let both = read(&[capture.clone(), model.clone()].concat()).unwrap();
    assert_eq!((both.paths(), both.photos[0].1), (IN_IMAGES.to_vec(), 30.0));
    assert!(both.said(WarningCode::CamerasChosen).contains("output/cameras.json"));
    // The highest of two of one kind, whatever is wrong with the other.
    let json = transforms("transforms.json", [32, 24], 20.0, &IN_IMAGES);
    for other in [json[0].1.clone(), b"{".to_vec()] {
        let other = vec![("arkit_transforms/transforms.json".to_owned(), other)];
        let found = read(&[capture.clone(), model.clone(), json.clone(), other].concat()).unwrap();
        assert_eq!((found.paths(), found.photos[0].1), (IN_IMAGES.to_vec(), 20.0));
        let said = found.said(WarningCode::CamerasChosen);
        assert!(said.contains("cameras from \"transforms.json\" (nerfstudio, 4 photos)"), "{said}");
        assert!(said.contains("arkit_transforms"), "{said}");
    }
}

#[test]
fn of_copies_of_the_photos_those_of_the_cameras_size_are_taken() {
    let json = transforms("transforms.json", [32, 24], 20.0, &IN_IMAGES);
    let small = [photos("images_2/", [16, 12], &FOUR), photos("images_4/", [8, 6], &FOUR)].concat();
    // Of smaller ones alone the larger.
    let found = read(&[json, small.clone()].concat()).unwrap();
    assert!(found.paths()[0].starts_with("images_2/"), "{:?}", found.paths());
    assert_eq!(found.photos[0].1, 10.0);
    let model = colmap("sparse/", "PINHOLE 32 24 30 30 16 12", &FOUR);
    let own = photos("photos/", [32, 24], &FOUR);
    let found = read(&[model, small, own].concat()).unwrap();
    assert!(found.paths()[0].starts_with("photos/"), "{:?}", found.paths());
    // Two that nothing tells apart.
    let alike = [photos("left/", [32, 24], &FOUR), photos("right/", [32, 24], &FOUR)].concat();
    let model = colmap("sparse/", "PINHOLE 32 24 30 30 16 12", &FOUR);
    refused(&[model, alike].concat(), &["\"left\"", "\"right\""]);
}

#[test]
fn a_rig_keeps_the_folders_of_its_cameras() {
    let names = ["/data/a/cam0/0.png", "/data/a/cam0/1.png", "D:\\b\\cam1\\0.png", "cam1/1.png"];
    let json = transforms("x/transforms.json", [32, 24], 20.0, &names);
    for [left, right] in [["cam0/", "cam1/"], ["a/cam0/", "b/cam1/"]] {
        let both = ["0.png", "1.png"];
        let pictures = [photos(left, [32, 24], &both), photos(right, [32, 24], &both)].concat();
        let found = read(&[json.clone(), pictures].concat()).unwrap();
        let want = [(left, 0), (left, 1), (right, 0), (right, 1)];
        let want: Vec<String> = want.iter().map(|(dir, i)| format!("{dir}{i}.png")).collect();
        assert_eq!(found.paths(), want);
        assert_eq!(found.photos.iter().map(|p| p.2[0]).collect::<Vec<_>>(), [0.0, 1.0, 2.0, 3.0]);
    }
}

#[test]
fn two_captures_are_refused() {
    let one = |dir: &str, names: &[&str]| {
        let model = transforms(&format!("{dir}transforms.json"), [32, 24], 20.0, names);
        [model, photos(dir, [32, 24], names)].concat()
    };
    let two = [one("a/", &FOUR), one("b/", &FOUR[..3])].concat();
    refused(&two, &["two captures", "\"a/transforms.json\"", "\"b/transforms.json\""]);
    // Models of one capture are no two captures.
    let model = |at: &str, names: &[&str]| colmap(at, "PINHOLE 32 24 30 30 16 12", names);
    let parts = [
        photos("images/", [32, 24], &FOUR),
        model("sparse/0/", &FOUR[..2]),
        model("sparse/1/", &FOUR[1..]),
    ]
    .concat();
    assert_eq!(read(&parts).unwrap().paths(), IN_IMAGES[1..]);
}

#[test]
fn a_part_of_a_capture_is_read_and_names_that_do_not_fit_are_refused() {
    let many: Vec<String> = (0..40).map(|i| format!("{i}.png")).collect();
    let many: Vec<&str> = many.iter().map(String::as_str).collect();
    let all = transforms("transforms.json", [32, 24], 20.0, &many);
    let found = read(&[all.clone(), photos("", [32, 24], &many[..8])].concat()).unwrap();
    assert_eq!(found.photos.len(), 8);
    let said = found.said(WarningCode::PhotosMissing);
    assert!(said.contains("32 of 40 cameras") && said.contains("\"8.png\""), "{said}");
    let few = transforms("transforms.json", [32, 24], 20.0, &many[..8]);
    let found = read(&[few, photos("", [32, 24], &many)].concat()).unwrap();
    let said = found.said(WarningCode::PhotosUnused);
    assert!(said.contains("32 of 40 photos"), "{said}");
    let other = ["0.png", "1.png", "x2.png", "x3.png", "x4.png", "x5.png"];
    let files = [all, photos("", [32, 24], &other)].concat();
    refused(&files, &["only 2 of 40 cameras", "4 of 6 photos", "\"2.png\"", "\"x2.png\""]);
}

#[test]
fn names_of_a_form_are_decoded_where_they_hold_the_folders() {
    let model = colmap("sparse%2F0%2F", "PINHOLE 32 24 30 30 16 12", &["a b.png", "ü.png"]);
    let photos = photos("images%2F", [32, 24], &["a%20b.png", "%C3%BC.png"]);
    assert_eq!(read(&[model, photos].concat()).unwrap().photos.len(), 2);
}

#[test]
fn text_of_colmap_is_read_as_programs_write_it() {
    let cameras = "# Camera list\n1\tPINHOLE 32 24 30,5 30,5 16 12\r\n\r\n";
    let line = |i: usize| format!("{} 1 0 0 0 -{i} 0 0 1 {i}.png", i + 1);
    let lines = |between: &str| (0..4).map(|i| line(i) + between).collect::<String>();
    let utf16 = |text: &str| -> Vec<u8> {
        [vec![0xFF, 0xFE], text.encode_utf16().flat_map(u16::to_le_bytes).collect()].concat()
    };
    let cases: Vec<(&str, Vec<u8>)> = vec![
        ("one line each", lines("\n").into()),
        ("no points", lines("\n\n").into()),
        ("points", lines("\n1.5 2.5 -1 3 4 7\n").into()),
        ("blank lines between", lines("\r\n\r\n1.5 2.5 -1\r\n\r\n\r\n").into()),
        ("comments", lines("\n# 2 points\n\n#\n").into()),
        (
            "some with points",
            (line(0) + "\n1 2 -1\n" + &line(1) + "\n" + &line(2) + "\n\n" + &line(3)).into(),
        ),
        ("commas for points", lines("\n1,5 2,5 -1\n").replace("1 0 0 0 -", "1,0 0,0 0 0 -").into()),
        ("tabs and hard spaces", lines("\n\n").replace(" 0 0 1 ", "\t0\u{a0}0  1\t").into()),
        ("a mark", format!("\u{feff}{}", lines("\n\n")).into()),
        ("UTF-16", utf16(&lines("\r\n\r\n"))),
    ];
    for (what, images) in cases {
        let files = [
            photos("images/", [32, 24], &FOUR),
            vec![
                ("sparse/0/cameras.txt".to_owned(), cameras.into()),
                ("sparse/0/images.txt".to_owned(), images),
            ],
        ]
        .concat();
        let found = read(&files).unwrap_or_else(|error| panic!("{what}: {error}"));
        assert_eq!(found.paths(), IN_IMAGES, "{what}");
        assert_eq!(found.photos[3].1, 30.5, "{what}");
        assert_eq!(found.photos.iter().map(|p| p.2[0]).collect::<Vec<_>>(), [0.0, 1.0, 2.0, 3.0]);
    }
    for (what, text) in [
        ("a name is missing", "1 1 0 0 0 0 0 0 1\n\n"),
        ("points twice", "1 1 0 0 0 0 0 0 1 0.png\n1 2 -1\n1 2 -1\n"),
        ("points first", "1 2 -1\n1 1 0 0 0 0 0 0 1 0.png\n"),
        ("two marks in a line", "1 1 0 0 0 0,5 1.5 0 1 0.png\n\n"),
        ("two marks", "1 1 0 0 0 0.5 0 0 1 0.png\n\n2 1 0 0 0 1,5 0 0 1 1.png\n"),
    ] {
        let mut files = colmap("", "PINHOLE 32 24 30 30 16 12", &FOUR);
        files[1].1 = text.into();
        files.extend(photos("", [32, 24], &FOUR));
        println!("{what}");
        refused(&files, &["images.txt: line"]);
    }
}

#[test]
fn bundler_and_opensfm_are_read_and_others_are_named() {
    let pictures = photos("images/", [32, 24], &FOUR);
    let mut out = "# Bundle file v0.3\n4 1\n".to_owned();
    let mut shots = Vec::new();
    for (i, name) in FOUR.iter().enumerate() {
        // A quarter turn about y.
        writeln!(out, "{} 0.01 0\n0 0 -1\n0 1 0\n1 0 0\n0 0 -{i}", if i == 1 { 0 } else { 25 })
            .unwrap();
        let turn = "\"rotation\":[0,-1.5707963267948966,0]";
        shots.push(format!("\"{name}\":{{\"camera\":\"c\",{turn},\"translation\":[0,0,-{i}]}}"));
    }
    let list = "images/0.png 0 25\nimages/1.png\nimages/2.png\nimages/3.png\n";
    let mut bundler = pictures.clone();
    bundler.push(("bundle/bundle.out".to_owned(), out.into()));
    bundler.push(("list.txt".to_owned(), list.into()));
    let found = read(&bundler).unwrap();
    assert_eq!(found.paths(), ["images/0.png", "images/2.png", "images/3.png"]);
    let camera = "\"projection_type\":\"brown\",\"width\":32,\"height\":24,\"focal_x\":0.5";
    let json =
        format!("[{{\"cameras\":{{\"c\":{{{camera}}}}},\"shots\":{{{}}}}}]", shots.join(","));
    let mut opensfm = pictures.clone();
    opensfm.push(("opensfm/reconstruction.json".to_owned(), json.into()));
    let sfm = read(&opensfm).unwrap();
    assert_eq!(sfm.paths(), IN_IMAGES);
    assert_eq!((sfm.photos[0].1, found.photos[0].1), (16.0, 25.0));
    for (i, x) in [(0, 0.0), (2, 2.0), (3, 3.0)] {
        // The centre is -R^T t.
        let at = sfm.photos[i].2;
        assert!((at[0] - x).abs() < 1e-12 && at[2].abs() < 1e-12, "{at:?}");
    }
    assert!(found.photos.iter().zip([0.0, 2.0, 3.0]).all(|(p, x)| (p.2[0] - x).abs() < 1e-12));
    for name in ["RealityCapture.csv", "cameras.xml", "groundtruth.txt", "database.db"] {
        let mut files = pictures.clone();
        files.push((name.to_owned(), b"?".to_vec()));
        refused(&files, &["no transforms.json", name, "not read"]);
    }
}

/// A `transforms.json` of four cameras with something said beside, at the top or of the second.
fn with_words(top: &str, frame: &str) -> Files {
    let mut files = transforms("transforms.json", [32, 24], 20.0, &IN_IMAGES);
    let json = String::from_utf8(files[0].1.clone()).unwrap();
    let json = json.replacen("{\"fl_x\"", &format!("{{{top}\"fl_x\""), 1);
    let second = "{\"file_path\":\"images/1.png\",";
    files[0].1 = json.replace(second, &format!("{second}{frame}")).into();
    files.extend(photos("images/", [32, 24], &FOUR));
    files
}

#[test]
fn keys_that_change_what_is_meant_are_refused_or_told() {
    for (top, frame, words) in [
        ("\"latlong\":true,", "", ["latlong", "not flat"]),
        ("", "\"equirectangular\":true,", ["equirectangular", "frames[1]"]),
        ("\"ftheta_p0\":1.5,", "", ["ftheta_p0", "not flat"]),
        ("\"camera_type\":\"Equirectangular\",", "", ["camera_type", "not flat"]),
        ("\"from_mitsuba\":true,", "", ["from_mitsuba", "axes"]),
        ("\"fl_x\":21.0,", "", ["fl_x", "two values"]),
        ("", "\"file_path\":\"images/0.png\",", ["file_path", "two values"]),
    ] {
        refused(&with_words(top, frame), &words);
    }
    let harmless = "\"latlong\":false,\"fl_x\":20.0,\"aabb_scale\":16,";
    let found = read(&with_words(harmless, "\"sharpness\":3,")).unwrap();
    assert_eq!((found.photos.len(), found.warnings.len()), (4, 0), "{:?}", found.warnings);
    let found = read(&with_words("\"fisheye_crop_radius\":9,", "\"k5\":0.1,")).unwrap();
    let said = found.said(WarningCode::KeysUnread);
    assert!(said.contains("fisheye_crop_radius") && said.contains("k5"), "{said}");
}

#[test]
fn a_scale_is_taken_out_of_rotations_and_nothing_else() {
    let spoilt = |rows: &str| {
        let mut files = with_words("", "");
        let json = String::from_utf8(files[0].1.clone()).unwrap();
        let (old, json) = ("[[1,0,0,1],[0,1,0,0],[0,0,1,0],", json);
        files[0].1 = json.replace(old, rows).into();
        files
    };
    let found = read(&spoilt("[[1.25,0,0,1],[0,0,-1.25,0],[0,1.25,0,0],")).unwrap();
    assert_eq!(found.photos[1].2, [1.0, 0.0, 0.0]);
    let said = found.said(WarningCode::PosesScaled);
    assert!(said.contains("images/1.png") && said.contains("1.25"), "{said}");
    assert_eq!(found.warnings.len(), 1);
    for rows in ["[[1.25,0,0,1],[0,1,0,0],[0,0,1,0],", "[[1,0.5,0,1],[0,1,0,0],[0,0,1,0],"] {
        refused(&spoilt(rows), &["images/1.png", "not orthonormal"]);
    }
    refused(&spoilt("[[-2,0,0,1],[0,2,0,0],[0,0,2,0],"), &["mirrored"]);
    // World-to-camera, times two: the centre is that of the matrix.
    let camera = |i: u32| {
        let text = format!(
            "extrinsic\n2 0 0 -{i}\n0 2 0 0\n0 0 2 0\n0 0 0 1\n\nintrinsic\n30 0 16\n0 30 12\n\
             0 0 1\n\n1 0.1\n"
        );
        (format!("cams/{i:08}_cam.txt"), text.into_bytes())
    };
    let names = ["00000000.png", "00000001.png", "00000002.png"];
    let mut files = photos("images/", [32, 24], &names);
    files.extend((0..3).map(camera));
    let found = read(&files).unwrap();
    assert_eq!(found.photos[2].2, [1.0, 0.0, 0.0]);
    assert!(!found.said(WarningCode::PosesScaled).is_empty());
}

#[test]
fn masks_go_with_their_photos() {
    let model = colmap("sparse/0/", "PINHOLE 32 24 30 30 16 12", &FOUR);
    let masks = photos("masks/", [32, 24], &["0.png.png", "1.png", "2.png.png"]);
    let files = [photos("images/", [32, 24], &FOUR), model, masks].concat();
    let files: Vec<UploadFile> =
        files.into_iter().map(|(name, bytes)| UploadFile { name, bytes }).collect();
    let upload = Upload { photos: files, ..Upload::default() };
    let limits = Limits::default();
    let found = find(&upload, &limits).unwrap();
    let of_each = |photo: &segsplat_formats::captures::FoundPhoto<'_>| {
        photo.mask.as_ref().map(|mask| mask.path.clone())
    };
    let masks: Vec<Option<String>> = found.photos.iter().map(of_each).collect();
    let want = [Some("masks/0.png.png"), Some("masks/1.png"), Some("masks/2.png.png"), None];
    assert_eq!(masks, want.map(|path| path.map(str::to_owned)));
}

#[test]
fn photos_are_known_by_what_they_hold() {
    let names = ["0.png", "1.heic", "2", "3.jpg"];
    let model = colmap("sparse/0/", "PINHOLE 32 24 30 30 16 12", &names);
    let files = [photos("images/", [32, 24], &names), model].concat();
    let found = read(&files).unwrap();
    assert_eq!(found.paths(), ["images/0.png", "images/1.heic", "images/2", "images/3.jpg"]);
    assert_eq!(found.warnings, []);
    // A camera of another extension finds it, too.
    let others = ["0.png", "1.JPG", "2.tif", "3.jpg"];
    let model = colmap("sparse/0/", "PINHOLE 32 24 30 30 16 12", &others);
    let names = ["0.png", "1.heic", "2.tif", "3.jpg"];
    let found = read(&[photos("images/", [32, 24], &names), model].concat()).unwrap();
    assert_eq!(found.paths()[1..3], ["images/1.heic", "images/2.tif"]);
    // One that is what its name says is named, with what to do.
    let heic = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic".to_vec();
    let model = colmap("sparse/0/", "PINHOLE 32 24 30 30 16 12", &["0.png", "1.heic", "3.jpg"]);
    let mut files = [photos("images/", [32, 24], &["0.png", "3.jpg"]), model].concat();
    files.push(("images/1.heic".to_owned(), heic.clone()));
    let found = read(&files).unwrap();
    let said = found.said(WarningCode::PhotosMissing);
    assert!(said.contains("images/1.heic") && said.contains("Most Compatible"), "{said}");
    let model = colmap("sparse/0/", "PINHOLE 32 24 30 30 16 12", &["0.heic", "1.heic"]);
    let heics = ["0.heic", "1.heic"].map(|name| (format!("images/{name}"), heic.clone()));
    refused(&[heics.to_vec(), model].concat(), &["0.heic", "save them as JPEG"]);
}

#[test]
fn cameras_of_metashape_are_read_in_the_world_of_their_component() {
    let camera = |i: usize, label: &str| {
        format!(
            "<camera id=\"{i}\" sensor_id=\"0\" component_id=\"0\" label=\"{label}\">\
             <transform>1 0 0 {i} 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera>"
        )
    };
    let cameras = [camera(0, "0"), camera(1, "1"), camera(2, "2.png"), camera(3, "3")].concat();
    let calibration = "<resolution width=\"32\" height=\"24\"/><f>30</f><cx>1</cx><cy>-1</cy>\
                       <k1>0.01</k1><p1>0.002</p1><b1>0.5</b1>";
    let component = "<component id=\"0\"><transform><rotation>0 -1 0 1 0 0 0 0 1</rotation>\
                     <translation>5 0 0</translation><scale>2</scale></transform></component>";
    let xml = |sensor: &str, more: &str| {
        let text = format!(
            "<?xml version=\"1.0\"?>\n<document version=\"2.0.0\"><chunk label=\"a\"><sensors>\
             <sensor id=\"0\" label=\"L\" type=\"{sensor}\"><resolution width=\"1\" height=\"1\"/>\
             <calibration class=\"initial\"/><calibration class=\"adjusted\">{calibration}{more}\
             </calibration></sensor></sensors><components>{component}</components><cameras>\
             <group>{cameras}</group><camera id=\"9\" label=\"9\" sensor_id=\"0\"/></cameras>\
             </chunk></document>"
        );
        let mut files = photos("images/", [32, 24], &FOUR);
        files.push(("cameras.xml".to_owned(), text.into_bytes()));
        files
    };
    let found = read(&xml("frame", "")).unwrap();
    assert_eq!((found.paths(), found.photos[0].1), (IN_IMAGES.to_vec(), 30.5));
    // Twice as large, turned by a quarter about z, and moved.
    assert_eq!(found.photos[3].2, [5.0, 6.0, 0.0]);
    assert_eq!(found.warnings, []);
    let said = read(&xml("frame", "<b2>0.7</b2>")).unwrap();
    assert!(said.said(WarningCode::KeysUnread).contains("b2"));
    refused(&xml("spherical", ""), &["spherical", "not read"]);
    refused(&xml("frame", "<p2>x</p2>"), &["p2", "not a number"]);
    refused(&xml("frame", "<f>"), &["cameras.xml", "XML"]);
}
