//! Photos without cameras, over HTTP, with the networks of the product: generated photos have exact
//! cameras, which are hidden.

use std::{
    path::Path,
    sync::LazyLock,
    time::{Duration, Instant},
};

use glam::DMat3;
use segsplat::{
    sample::{self, SampleOptions},
    scene::{Camera, Upload, UploadCameras, UploadFile},
};
use serde_json::{Value, json};

use crate::common::{
    client,
    doors::form,
    process::{self, Process, Start, can_serve, eventually},
};

/// Most by which the turn between any two solved cameras may differ, degrees: the arc is short, so
/// that without EXIF its photos tell the focal length to a per cent or two.
const TURNED_DEG: f64 = 1.0;
/// How long a scene may take on a busy machine.
const WAIT_MS: u64 = 300_000;

fn server(data: &Path) -> Process {
    Start::on(data).bundle("../../models/embedded").start()
}

type Room = (Vec<UploadFile>, Vec<Camera>);

fn generated(photos: usize, seed: u64) -> Room {
    let options = SampleOptions { photos, width: 360, height: 270, seed };
    let files = sample::upload(&options).unwrap().photos;
    (files, sample::cameras(&options).unwrap())
}

/// Five photos of a generated room, and their cameras: drawn once, which takes seconds.
fn room() -> Room {
    static ROOM: LazyLock<Room> = LazyLock::new(|| generated(5, 1));
    ROOM.clone()
}

/// A photo of another room.
fn stranger(name: &str) -> UploadFile {
    static STRANGER: LazyLock<Room> = LazyLock::new(|| generated(2, 40));
    UploadFile { name: name.to_owned(), ..STRANGER.0[0].clone() }
}

fn upload(photos: Vec<UploadFile>) -> Upload {
    Upload { photos, ..Upload::default() }
}

async fn made(server: &Process, photos: Vec<UploadFile>) -> Value {
    let base = server.url("");
    let answer = process::create(&client(), &base, &upload(photos), WAIT_MS, None).await;
    answer.expect("an answer").1
}

/// The cameras of a status, by the files of their photos.
fn cameras(status: &Value) -> Vec<(String, Camera)> {
    let camera = |one: &Value| {
        let file = one["file"].as_str().expect("a file").to_owned();
        (file, serde_json::from_value(one.clone()).expect("a camera"))
    };
    status["cameras"].as_array().expect("cameras").iter().map(camera).collect()
}

fn angle_deg(turn: &DMat3) -> f64 {
    let trace = turn.x_axis.x + turn.y_axis.y + turn.z_axis.z;
    ((trace - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees()
}

/// The largest differences between two lists of cameras up to a similarity: of turns from camera to
/// camera, degrees; of the ways between centres, as shares of the longest; of focal lengths.
fn differences(found: &[Camera], truth: &[Camera]) -> [f64; 3] {
    let between = |of: &[Camera], i: usize, j: usize| {
        let [a, b] = [i, j].map(|at| of[at].camera_to_world);
        let turn = a.rotation().transpose() * b.rotation();
        (turn, a.rotation().transpose() * (b.center() - a.center()))
    };
    let pairs = (0..truth.len()).flat_map(|i| (i + 1..truth.len()).map(move |j| [i, j]));
    let pairs: Vec<[usize; 2]> = pairs.collect();
    let longest = |of: &[Camera]| {
        pairs.iter().map(|&[i, j]| between(of, i, j).1.length()).fold(0.0, f64::max)
    };
    let units = [longest(found), longest(truth)];
    let mut worst = [0.0_f64; 3];
    for &[i, j] in &pairs {
        let ((turn, way), (true_turn, true_way)) = (between(found, i, j), between(truth, i, j));
        worst[0] = worst[0].max(angle_deg(&(turn * true_turn.transpose())));
        worst[1] = worst[1].max((way / units[0] - true_way / units[1]).length());
    }
    for (found, truth) in found.iter().zip(truth) {
        worst[2] = worst[2].max((found.intrinsics.fx / truth.intrinsics.fx - 1.0).abs());
    }
    worst
}

#[tokio::test]
async fn photos_alone_become_a_scene_and_a_photo_of_another_place_is_named() {
    if !can_serve() {
        return;
    }
    let data = tempfile::tempdir().unwrap();
    let server = server(data.path());
    let (mut photos, truth) = room();
    photos.push(stranger("images/stranger.png"));
    let status = made(&server, photos).await;
    assert_eq!(status["state"], "done", "{status}");
    let report = &status["report"]["cameras"];
    assert_eq!(report["source"], "solved");
    assert!(report["confidence"].as_f64().unwrap() >= 0.5, "{report}");
    let left_out = report["left_out"].as_array().unwrap();
    assert_eq!(left_out.len(), 1, "{report}");
    assert_eq!(left_out[0]["file"], "images/stranger.png");
    assert!(left_out[0]["reason"].as_str().is_some_and(|why| why.len() > 10), "{report}");
    let warnings = status["report"]["warnings"].to_string();
    assert!(warnings.contains("photos_unused") && warnings.contains("stranger.png"), "{warnings}");
    let stages = status["report"]["stages"].to_string();
    assert!(stages.contains("\"cameras\""), "{stages}");
    let found = cameras(&status);
    assert_eq!(found.len(), truth.len());
    let placed = report["placed"].as_array().unwrap();
    assert!(found.iter().zip(placed).all(|((file, _), of)| of["file"] == **file), "{report}");
    let found: Vec<Camera> = found.into_iter().map(|(_, camera)| camera).collect();
    let [turned, moved, focal] = differences(&found, &truth);
    println!("turned {turned:.3} degrees, moved {moved:.4}, focal {focal:.4}");
    assert!(turned <= TURNED_DEG && moved <= 0.02 && focal <= 0.03, "{turned} {moved} {focal}");
    // The cameras come out with the photos.
    let id = status["id"].as_str().unwrap();
    let url = server.url(&format!("/v1/scenes/{id}/export?format=nerfstudio"));
    let zip = process::bytes(&client(), &url).await.unwrap().unwrap();
    let mut zip = zip::ZipArchive::new(std::io::Cursor::new(zip)).unwrap();
    let told: Value = serde_json::from_reader(zip.by_name("transforms.json").unwrap()).unwrap();
    assert_eq!(told["frames"].as_array().unwrap().len(), truth.len());
    let names = (0..zip.len()).map(|i| zip.by_index(i).unwrap().name().unwrap().into_owned());
    let pictures: Vec<String> = names.filter(|name| name.starts_with("images/")).collect();
    assert_eq!(pictures.len(), truth.len(), "the photo that was left out is none of them");
}

#[tokio::test]
async fn photos_that_cannot_be_solved_are_refused_with_what_to_do() {
    if !can_serve() {
        return;
    }
    let data = tempfile::tempdir().unwrap();
    let server = server(data.path());
    let (photos, _) = room();
    let one = made(&server, photos[..1].to_vec()).await;
    assert_eq!(one["code"], "invalid_request", "{one}");
    assert!(one["message"].as_str().unwrap().contains("1 photo"), "{one}");
    // Plain walls.
    let mut plain = Vec::new();
    let picture = image::RgbImage::from_pixel(320, 240, image::Rgb([120, 130, 140]));
    picture.write_to(&mut std::io::Cursor::new(&mut plain), image::ImageFormat::Png).unwrap();
    let plain = (0..4).map(|i| UploadFile { name: format!("{i}.png"), bytes: plain.clone() });
    // Two places.
    let strangers = [photos[0].clone(), stranger("other.png")];
    for (photos, named) in
        [(plain.collect::<Vec<_>>(), "0.png"), (strangers.into(), "nothing confirms their cameras")]
    {
        let status = made(&server, photos).await;
        assert_eq!(status["code"], "cameras_unsolved", "{status}");
        let message = status["message"].as_str().unwrap();
        for said in [named, "Take more photos", "pycolmap.incremental_mapping("] {
            assert!(message.contains(said), "{said:?} in {message}");
        }
    }
}

#[tokio::test]
async fn cameras_that_are_wrong_are_solved_where_that_is_asked() {
    if !can_serve() {
        return;
    }
    let data = tempfile::tempdir().unwrap();
    let server = server(data.path());
    let (photos, truth) = room();
    // Each photo has the camera of another.
    let wrong = truth.iter().rev().zip(&photos).map(|(camera, file)| {
        json!({
            "file": file.name,
            "intrinsics": camera.intrinsics,
            "camera_to_world": camera.camera_to_world.to_row_major(),
        })
    });
    let wrong = json!({ "cameras": wrong.collect::<Vec<_>>() }).to_string().into_bytes();
    let sent = Upload { cameras: Some(UploadCameras::Cameras(wrong)), ..upload(photos.clone()) };
    let base = server.url("/v1/scenes?wait_ms=300000");
    // The option in the query, beside the part of the same name; and as a part alone.
    let both = [
        client().post(format!("{base}&cameras=solve")).multipart(form(&sent)),
        client().post(&base).multipart(form(&upload(photos)).text("cameras", "solve")),
    ];
    for request in both {
        let answer = request.send().await.unwrap().bytes().await.unwrap();
        let status: Value = serde_json::from_slice(&answer).unwrap();
        assert_eq!(status["report"]["cameras"]["source"], "solved", "{status}");
        let found: Vec<Camera> = cameras(&status).into_iter().map(|(_, camera)| camera).collect();
        let [turned, ..] = differences(&found, &truth);
        assert!(turned <= TURNED_DEG, "{turned}");
    }
}

#[tokio::test]
async fn a_job_that_finds_cameras_is_resumed_after_a_kill_and_can_be_cancelled() {
    if !can_serve() {
        return;
    }
    let data = tempfile::tempdir().unwrap();
    let mut server = server(data.path());
    let photos = room().0;
    let client = client();
    let begin = async |server: &Process| {
        let base = server.url("");
        let sent = upload(photos.clone());
        let (_, status) = process::create(&client, &base, &sent, 0, None).await.unwrap();
        let id = status["id"].as_str().expect("an id").to_owned();
        let url = server.url(&format!("/v1/scenes/{id}"));
        let stage = async || {
            let (_, status) = process::get(&client, &url).await.unwrap();
            (status["stage"] == "cameras").then_some(())
        };
        eventually("the stage of cameras", stage).await;
        id
    };
    let cancelled = begin(&server).await;
    let url = server.url(&format!("/v1/scenes/{cancelled}"));
    assert_eq!(process::delete(&client, &url).await.unwrap(), 204);
    assert_eq!(process::get(&client, &url).await.unwrap().0, 404);
    let id = begin(&server).await;
    server.kill();
    let server = self::server(data.path());
    let url = server.url(&format!("/v1/scenes/{id}"));
    let begun = Instant::now();
    let status = loop {
        let (_, status) = process::get(&client, &url).await.unwrap();
        if status["state"] == "done" {
            break status;
        }
        assert!(begun.elapsed().as_millis() < u128::from(WAIT_MS), "{status}");
        tokio::time::sleep(Duration::from_millis(200)).await;
    };
    assert_eq!(status["report"]["cameras"]["source"], "solved");
    assert_eq!(cameras(&status).len(), photos.len());
    let gone = server.url(&format!("/v1/scenes/{cancelled}"));
    assert_eq!(process::get(&client, &gone).await.unwrap().0, 404);
}
