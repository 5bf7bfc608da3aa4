//! Every bad input over HTTP and gRPC: a fitting code, a message of its own, and a server that goes
//! on. Then what is bad but not wrong: a camera inside a wall, a camera that looks away.

use std::{
    collections::BTreeMap,
    io::{Cursor, Write},
};

use segsplat::scene::{Upload, UploadCameras, UploadFile};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};

use crate::common::{
    cpu_server::{CpuServer, upload},
    doors::{Ask, Door, Options, both},
};

/// The transforms of the sample, to be spoilt.
fn transforms() -> Value {
    match upload().cameras {
        Some(UploadCameras::Transforms(bytes)) => serde_json::from_slice(&bytes).unwrap(),
        other => panic!("the sample has {other:?}"),
    }
}

/// The sample with other transforms.
fn with(transforms: &Value) -> Upload {
    let cameras = Some(UploadCameras::Transforms(transforms.to_string().into_bytes()));
    Upload { cameras, ..upload() }
}

/// The sample with frame 1 changed.
fn spoilt(change: impl FnOnce(&mut Value)) -> Upload {
    let mut transforms = transforms();
    change(&mut transforms["frames"][1]);
    with(&transforms)
}

/// The sample with the rotation of frame 1 multiplied, column by column.
fn turned(columns: [f64; 3]) -> Upload {
    spoilt(|frame| {
        for row in 0..3 {
            for (column, factor) in columns.into_iter().enumerate() {
                let entry = &mut frame["transform_matrix"][row][column];
                *entry = json!(entry.as_f64().unwrap() * factor);
            }
        }
    })
}

/// The sample with photo 1 replaced.
pub(crate) fn photo(bytes: Vec<u8>) -> Upload {
    let mut upload = upload();
    upload.photos[1].bytes = bytes;
    upload
}

/// The sample as JPEG files would be: photo 1 under a `.jpg` name.
fn named_jpg(bytes: Vec<u8>) -> Upload {
    let mut upload = spoilt(|frame| frame["file_path"] = "images/0001.jpg".into());
    upload.photos[1] = UploadFile { name: "images/0001.jpg".to_owned(), bytes };
    upload
}

fn jpeg(bytes_kept: usize) -> Vec<u8> {
    let picture = image::load_from_memory(&upload().photos[1].bytes).unwrap();
    let mut jpeg = Cursor::new(Vec::new());
    picture.to_rgb8().write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
    let mut bytes = jpeg.into_inner();
    bytes.truncate(bytes_kept);
    bytes
}

/// A PNG of 60 bytes whose header claims `side` x `side` pixels.
pub(crate) fn huge_png(side: u32) -> Vec<u8> {
    let mut header = [side.to_be_bytes(), side.to_be_bytes()].concat();
    header.extend([8, 2, 0, 0, 0]);
    let mut png = png(&[(b"IHDR", &header)]);
    png.resize(60, 0);
    png
}

/// A PNG of these chunks.
pub(crate) fn png(chunks: &[(&[u8; 4], &[u8])]) -> Vec<u8> {
    let mut png = b"\x89PNG\r\n\x1a\n".to_vec();
    for (name, data) in chunks {
        let body = [&name[..], data].concat();
        png.extend(u32::try_from(data.len()).unwrap().to_be_bytes());
        png.extend(&body);
        png.extend(crc32(&body).to_be_bytes());
    }
    png
}

/// CRC-32 of PNG, bit by bit.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0_u32, |crc, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |crc, _| {
            (crc >> 1) ^ (0xedb8_8320 & (crc & 1).wrapping_neg())
        })
    })
}

/// A zip of these files, deflated, as an upload.
pub(crate) fn zipped(files: Vec<(&str, Vec<u8>)>) -> Upload {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default();
    for (name, bytes) in files {
        zip.start_file(name, options).unwrap();
        zip.write_all(&bytes).unwrap();
    }
    Upload { archive: Some(zip.finish().unwrap().into_inner()), ..Upload::default() }
}

/// Photos that see nothing in common: noise, another in each.
fn strangers() -> Upload {
    let mut upload = upload();
    let mut state = 1_u32;
    for photo in &mut upload.photos {
        let mut noise = || {
            state ^= state << 13;
            state ^= state >> 17;
            state ^= state << 5;
            state.to_le_bytes()[1]
        };
        let picture = image::RgbImage::from_fn(160, 120, |_, _| image::Rgb([noise(); 3]));
        let mut png = Cursor::new(Vec::new());
        picture.write_to(&mut png, image::ImageFormat::Png).unwrap();
        photo.bytes = png.into_inner();
    }
    upload
}

/// What is wrong, the upload, the code, and words that the message must have.
pub(crate) fn uploads() -> Vec<(&'static str, Upload, &'static str, Vec<&'static str>)> {
    let one = || Upload { photos: upload().photos[..1].to_vec(), ..upload() };
    let cameras_only = Upload { photos: Vec::new(), ..upload() };
    let photos_only = Upload { cameras: None, ..upload() };
    let nan = transforms().to_string().replacen("\"transform_matrix\":[[", "\u{1}", 2);
    let nan = nan.replacen('\u{1}', "\"transform_matrix\":[[", 1);
    let cut = nan.find('\u{1}').unwrap();
    let comma = cut + nan[cut..].find(',').unwrap();
    let nan = format!("{}\"transform_matrix\":[[NaN{}", &nan[..cut], &nan[comma..]);
    let nan = Upload { cameras: Some(UploadCameras::Transforms(nan.into_bytes())), ..upload() };
    let same_place = {
        let mut transforms = transforms();
        for i in 1..3 {
            for row in 0..3 {
                transforms["frames"][i]["transform_matrix"][row][3] =
                    transforms["frames"][0]["transform_matrix"][row][3].clone();
            }
        }
        with(&transforms)
    };
    let two_at_one = {
        let mut whole = same_place.clone();
        whole.photos.truncate(2);
        whole
    };
    let bomb = zipped(vec![("transforms.json", vec![b' '; 600 << 20])]);
    let escape = zipped(vec![("../../etc/passwd", b"x".to_vec())]);
    let matrix = "transform_matrix";
    vec![
        ("no photos", cameras_only, "invalid_request", vec!["0 photos", "2"]),
        ("nothing at all", Upload::default(), "invalid_request", vec!["upload"]),
        ("no cameras", photos_only, "model_unavailable", vec!["no network finds the cameras"]),
        ("one photo", one(), "invalid_request", vec!["1 photo;", "2"]),
        ("text named .jpg", named_jpg(b"hello".repeat(9)), "photo_unreadable", vec!["0001.jpg"]),
        ("truncated JPEG", named_jpg(jpeg(900)), "photo_unreadable", vec!["cut short"]),
        ("empty photo", photo(Vec::new()), "photo_unreadable", vec!["0001.png", "empty"]),
        ("huge PNG", photo(huge_png(100_000)), "limit_exceeded", vec!["100000x100000", "24000000"]),
        ("zip bomb", bomb, "limit_exceeded", vec!["unpacked"]),
        ("zip with ../", escape, "invalid_request", vec!["../../etc/passwd"]),
        (
            "missing pose",
            spoilt(|frame| drop(frame.as_object_mut().unwrap().remove(matrix))),
            "invalid_request",
            vec!["0001.png", matrix],
        ),
        ("NaN pose", nan, "invalid_request", vec!["0001.png", "NaN"]),
        ("not orthonormal", turned([1.0, 1.1, 1.0]), "invalid_request", vec!["not orthonormal"]),
        ("mirrored", turned([-1.0, 1.0, 1.0]), "invalid_request", vec!["0001.png", "mirrored"]),
        ("singular", turned([0.0, 1.0, 1.0]), "invalid_request", vec!["0001.png", "singular"]),
        (
            "focal 0",
            spoilt(|frame| frame["fl_x"] = 0.into()),
            "invalid_request",
            vec!["0001.png", "fx is 0;"],
        ),
        (
            "focal negative",
            spoilt(|frame| frame["fl_y"] = (-140).into()),
            "invalid_request",
            vec!["0001.png", "fy is -140;"],
        ),
        (
            "intrinsics of another shape",
            spoilt(|frame| frame["w"] = 999.into()),
            "invalid_request",
            vec!["999x120", "160x120"],
        ),
        ("all at one place", same_place, "invalid_request", vec!["one place", "3 cameras"]),
        ("two at one place", two_at_one, "invalid_request", vec!["one place", "2 cameras"]),
        ("nothing in common", strangers(), "invalid_request", vec!["share nothing"]),
        (
            "JSON that is none",
            Upload { cameras: Some(UploadCameras::Transforms(b"{".to_vec())), ..upload() },
            "invalid_request",
            vec!["transforms", "not valid JSON"],
        ),
        (
            "200 MB of JSON",
            Upload { cameras: Some(UploadCameras::Transforms(vec![b' '; 200 << 20])), ..upload() },
            "limit_exceeded",
            vec!["over"],
        ),
    ]
}

/// A call that must still work after a bad one.
async fn lives(door: &Door, after: &str) {
    let unknown = door.get(&"0".repeat(32)).await.expect_err("no such scene");
    assert_eq!(unknown.code, "scene_not_found", "{} is dead after {after}", door.name());
}

#[tokio::test]
async fn bad_uploads_are_refused_by_name_and_the_server_lives() {
    let stand = CpuServer::start().await;
    let cases = uploads();
    for door in both(stand.addr).await {
        let mut messages = BTreeMap::new();
        for (case, upload, code, words) in &cases {
            let fault = door.create(upload, &Options::wait()).await.expect_err(case);
            let case = format!("{case} by {}", door.name());
            assert_eq!(&fault.code, code, "{case}: {}", fault.message);
            for word in words {
                assert!(fault.message.contains(word), "{case}: {:?} lacks {word:?}", fault.message);
            }
            if let Some(other) = messages.insert(fault.message.clone(), case.clone()) {
                panic!("{case} and {other} say the same: {}", fault.message);
            }
            lives(&door, &case).await;
        }
        let (id, state) = door.create(&upload(), &Options::wait()).await.expect("a good upload");
        assert_eq!(state, "done", "{id} after all the bad ones");
    }
}

/// Sends `head` and `body` over a bare socket and reads what is answered while it stays open.
pub(super) async fn raw(stand: &CpuServer, head: &str, body: &[u8]) -> String {
    let mut socket = tokio::net::TcpStream::connect(stand.addr).await.unwrap();
    socket.write_all(head.as_bytes()).await.unwrap();
    socket.write_all(body).await.unwrap();
    let mut answer = vec![0; 4096];
    let read = socket.read(&mut answer).await.unwrap();
    String::from_utf8_lossy(&answer[..read]).into_owned()
}

#[tokio::test]
async fn what_is_too_big_is_refused_before_the_rest_arrives() {
    let stand = CpuServer::start().await;
    let post = "POST /v1/scenes HTTP/1.1\r\nhost: localhost\r\n\
                content-type: multipart/form-data; boundary=b\r\n";
    // The head alone tells that it is too long; nothing of the body is sent.
    let head = format!("{post}content-length: 9000000000\r\n\r\n");
    let answer = raw(&stand, &head, b"").await;
    assert!(answer.starts_with("HTTP/1.1 413"), "{answer}");
    assert!(answer.contains("limit_exceeded") && answer.contains("9000000000"), "{answer}");
    // Of 200 MB of JSON the first 9 MiB are sent, and no more ever.
    let head = format!("{post}content-length: 209715200\r\n\r\n");
    let mut body = b"--b\r\ncontent-disposition: form-data; name=\"transforms\"\r\n\r\n".to_vec();
    body.resize(9 << 20, b' ');
    let answer = raw(&stand, &head, &body).await;
    assert!(answer.starts_with("HTTP/1.1 413"), "{answer}");
    assert!(answer.contains("transforms") && answer.contains("8388608"), "{answer}");
    let [http, _] = both(stand.addr).await;
    lives(&http, "uploads that never end").await;
}

#[tokio::test]
async fn what_is_no_http_does_not_end_the_server() {
    let stand = CpuServer::start().await;
    for (head, body) in [
        ("\u{1}\u{2}\u{3} what\r\n\r\n", &b""[..]),
        ("GET /v1/scenes HTTP/9.9\r\n\r\n", b""),
        ("POST /v1/scenes HTTP/1.1\r\ncontent-length: -5\r\n\r\n", b"x"),
        ("POST /v1/scenes HTTP/1.1\r\ntransfer-encoding: chunked\r\n\r\n", b"zz\r\n"),
        ("PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"\xff\xff\xff\xff\xff\xff\xff\xff\xff"),
    ] {
        let answer = raw(&stand, head, body).await;
        assert!(!answer.starts_with("HTTP/1.1 2"), "{head:?} was taken: {answer}");
        for door in both(stand.addr).await {
            lives(&door, head).await;
        }
    }
}

#[tokio::test]
async fn bad_views_are_refused_by_name_and_the_server_lives() {
    let stand = CpuServer::start().await;
    let doors = both(stand.addr).await;
    let (id, _) = doors[0].create(&upload(), &Options::wait()).await.unwrap();
    let eye = |ask: Ask, target: [f64; 3]| {
        ask.with_numbers("eye", &[0.0, 0.0, 0.0]).with_numbers("target", &target)
    };
    let size = || Ask::default().with("width", 8).with("height", 8);
    let mut singular = [0.0; 16];
    singular[15] = 1.0;
    let nan = [f64::NAN; 16];
    let cases: Vec<(&str, Ask, &str, &str)> = vec![
        ("width 0", Ask::first().with("width", 0), "invalid_request", "width is 0"),
        ("width 100,000", Ask::first().with("width", 100_000), "limit_exceeded", "100000 px"),
        ("height 0", Ask::first().with("height", 0), "invalid_request", "height is 0"),
        ("no pose", size(), "invalid_request", "no pose"),
        ("no such camera", Ask::first().with("from", 9), "invalid_request", "3 cameras"),
        ("t outside", Ask::first().with("t", 1.5), "invalid_request", "t is 1.5"),
        ("fov 0", Ask::first().with("fov", 0), "invalid_request", "fov"),
        ("focal negative", Ask::first().with("fx", -5), "invalid_request", "fx"),
        ("NaN near", Ask::first().with("near", "NaN"), "invalid_request", "near is NaN"),
        ("background 7", Ask::first().with("background", "7,0,0"), "invalid_request", "7"),
        ("eye in target", eye(size(), [0.0; 3]), "invalid_request", "same point"),
        (
            "far eye",
            eye(size(), [0.0; 3]).with_numbers("eye", &[1e308, 0.0, 0.0]),
            "invalid_request",
            "eye has 1e308; coordinates reach at most 1e9",
        ),
        ("wide fov", Ask::first().with("fov", 1e308), "invalid_request", "fov is 1e308 degrees"),
        (
            "singular",
            size().with_numbers("camera_to_world", &singular),
            "invalid_request",
            "singular",
        ),
        (
            "NaN matrix",
            size().with_numbers("camera_to_world", &nan),
            "invalid_request",
            "not a finite number",
        ),
        (
            "12 numbers",
            size().with_numbers("camera_to_world", &[1.0; 12]),
            "invalid_request",
            "12 numbers",
        ),
        ("mask", Ask::first().with("kind", "mask"), "model_unavailable", "kind=mask"),
        (
            "relevancy",
            Ask::first().with("kind", "relevancy").with("text", "a cup"),
            "model_unavailable",
            "kind=relevancy",
        ),
        (
            "depth as JPEG",
            Ask::first().with("kind", "depth").with("format", "jpeg"),
            "invalid_request",
            "8 bits",
        ),
    ];
    for door in &doors {
        let mut messages = BTreeMap::new();
        for (case, ask, code, word) in &cases {
            let fault = door.view(&id, ask).await.expect_err(case);
            let case = format!("{case} by {}", door.name());
            assert_eq!(&fault.code, code, "{case}: {}", fault.message);
            let message = fault.message.to_lowercase();
            assert!(message.contains(&word.to_lowercase()), "{case}: {message:?} lacks {word:?}");
            if let Some(other) = messages.insert(fault.message.clone(), case.clone()) {
                panic!("{case} and {other} say the same: {}", fault.message);
            }
            lives(door, &case).await;
        }
        door.view(&id, &Ask::first()).await.expect("a good view after all the bad ones");
    }
}

#[tokio::test]
async fn words_for_numbers_are_refused_by_name() {
    let stand = CpuServer::start().await;
    let id = "0".repeat(32);
    for (query, word) in [
        ("from=0&width=wide", "wide"),
        ("from=0&width=-3", "-3"),
        ("from=0&width=1e3", "1e3"),
        ("from=first", "first"),
        ("from=0&fx=long", "long"),
        ("eye=a,b,c&target=0,0,1", "\"a\""),
        ("from=0&antialiased=maybe", "maybe"),
        ("from=0&kind=smell", "smell"),
        ("from=0&format=bmp", "bmp"),
        ("from=0&background=sky", "sky"),
    ] {
        let answer = crate::common::client()
            .get(stand.url(&format!("/v1/scenes/{id}/view?{query}")))
            .send()
            .await;
        let fault = crate::common::doors::bytes(answer.unwrap()).await.expect_err(query);
        assert_eq!(fault.code, "invalid_request", "{query}: {}", fault.message);
        assert!(fault.message.contains(word), "{query}: {}", fault.message);
    }
}

#[tokio::test]
async fn unknown_ids_and_ids_that_climb_are_not_found() {
    let stand = CpuServer::start().await;
    for door in both(stand.addr).await {
        let unknown = "f".repeat(32);
        for id in [unknown.as_str(), "..%2f..%2fetc%2fpasswd", "%2e%2e%2f", "A", "é"] {
            // gRPC has no percent encoding: there the id really climbs.
            let climbs = id.replace("%2f", "/").replace("%2e", ".");
            let id = if door.name() == "grpc" { climbs.as_str() } else { id };
            let case = format!("{id} by {}", door.name());
            for fault in [
                door.get(id).await.expect_err(&case),
                door.view(id, &Ask::first()).await.expect_err(&case),
                door.delete(id).await.expect_err(&case),
                door.export(id).await.expect_err(&case),
            ] {
                assert_eq!(fault.code, "scene_not_found", "{case}: {}", fault.message);
            }
        }
        lives(&door, "odd ids").await;
    }
}

#[tokio::test]
async fn what_the_bundle_cannot_do_is_refused_by_name() {
    let stand = CpuServer::start().await;
    for door in both(stand.addr).await {
        let options = Options { semantics: Some("eager"), ..Options::wait() };
        let fault = door.create(&upload(), &options).await.unwrap_err();
        assert_eq!(fault.code, "model_unavailable", "{}", fault.message);
        assert!(fault.message.contains("\"plane\""), "{} names no bundle", fault.message);
        let options = Options { ignore: vec!["person"], ..Options::wait() };
        let fault = door.create(&upload(), &options).await.unwrap_err();
        assert_eq!(fault.code, "model_unavailable", "{}", fault.message);
        assert!(fault.message.starts_with("ignore"), "{}", fault.message);
        let options = Options { bundle: Some("other"), ..Options::wait() };
        let fault = door.create(&upload(), &options).await.unwrap_err();
        assert!(fault.message.contains("\"other\""), "{}", fault.message);
        for semantics in ["lazy", "off"] {
            let options =
                Options { semantics: Some(semantics), bundle: Some("plane"), ..Options::wait() };
            let (_, state) = door.create(&upload(), &options).await.unwrap();
            assert_eq!(state, "done", "semantics={semantics} by {}", door.name());
        }
    }
}

/// The f32 values of an NPY file.
fn npy(file: &[u8]) -> Vec<f32> {
    let header = usize::from(u16::from_le_bytes([file[8], file[9]]));
    let (values, rest) = file[10 + header..].as_chunks::<4>();
    assert!(rest.is_empty(), "an NPY file of odd length");
    values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

#[tokio::test]
async fn a_camera_in_a_wall_or_looking_away_sees_a_valid_picture() {
    let stand = CpuServer::start().await;
    for door in both(stand.addr).await {
        let (id, _) = door.create(&upload(), &Options::wait()).await.unwrap();
        let photos = segsplat::photos::read(&upload(), &segsplat::limits::Limits::default());
        let pose = photos.unwrap()[0].camera.camera_to_world;
        let (eye, axis) = (pose.center(), pose.axis());
        let board = segsplat::capture::analyse(
            &segsplat::photos::read(&upload(), &segsplat::limits::Limits::default()).unwrap(),
            &std::sync::atomic::AtomicBool::new(false),
        )
        .unwrap()
        .median_depth;
        let ask = |from: glam::DVec3, to: glam::DVec3, kind: &str| {
            Ask::default()
                .with_numbers("eye", &from.to_array())
                .with_numbers("target", &to.to_array())
                .with_numbers("up", &[0.0, -1.0, 0.0])
                .with("fov", 60)
                .with("width", 32)
                .with("height", 24)
                .with("kind", kind)
                .with("format", "npy")
        };
        let away = door.view(&id, &ask(eye, eye - axis, "alpha")).await.unwrap();
        assert!(npy(&away).iter().all(|alpha| *alpha == 0.0), "something behind the camera");
        assert_eq!(npy(&away).len(), 32 * 24);
        let towards = door.view(&id, &ask(eye, eye + axis, "alpha")).await.unwrap();
        assert!(npy(&towards).iter().any(|alpha| *alpha > 0.5), "nothing before the camera");
        let wall = eye + axis * board;
        for kind in ["color", "alpha", "depth"] {
            let inside = door.view(&id, &ask(wall, wall + axis, kind)).await.unwrap();
            let sound = npy(&inside).iter().all(|v| v.is_finite() && *v >= 0.0);
            assert!(sound, "{kind} from inside the wall by {}", door.name());
        }
    }
}
