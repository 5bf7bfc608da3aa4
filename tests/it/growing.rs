//! Scenes whose photos change: what joins and leaves is in the next version whole, the one before
//! is served until then, and what was acknowledged lasts.

use std::{
    sync::{Arc, LazyLock, atomic::Ordering},
    time::Duration,
};

use object_store::{ObjectStoreExt, memory::InMemory, path::Path};
use reqwest::StatusCode;
use segsplat::{
    api::grpc::pb::{self, scene_service_client::SceneServiceClient},
    config::Config,
    jobs::{PipelineNetworks, SceneNetworks},
    pipeline::{
        PhotoSet, Pipeline,
        growth::{self, Grown, make_more},
        make_keeping,
    },
    render::cpu::CpuRenderer,
    sample::{self, SampleOptions},
    scene::{
        Gaussians, GrowthState, Provenance, Refine, RefineState, SceneId, SceneOptions,
        SceneStatus, SemanticsMode, Stage, Upload, UploadCameras, Watch,
    },
    service::CreateScene,
    store::StoreLocation,
};
use serde_json::{Value, json};

use crate::{
    common::{
        client,
        doors::{adding, channel, form},
        faults::{FaultStore, Wrong},
        meaning::PhotoMeaning,
        opened,
        process::{eventually, photos_of},
        server::{PATIENCE, TestServer, WallNetworks, first_view},
    },
    refine::LensedNetworks,
};

const ALL: SampleOptions = SampleOptions { photos: 6, width: 64, height: 48, seed: 5 };

/// Some of six posed photos, as a caller sends them.
fn some(photos: &[usize]) -> Upload {
    static MADE: LazyLock<Upload> =
        LazyLock::new(|| sample::upload(&ALL).expect("the options are in range"));
    photos_of(&MADE, photos)
}

async fn made(server: &TestServer, photos: &[usize], options: SceneOptions) -> SceneStatus {
    let (upload, wait) = (some(photos), Some(PATIENCE));
    let request = CreateScene { upload, options, wait, ..CreateScene::default() };
    server.service.create_scene(request).await.expect("a good upload").status
}

/// `POST` of photos: status, whether it was replayed, and the answer.
async fn send(
    server: &TestServer,
    id: &SceneId,
    upload: &Upload,
    wait_ms: u64,
    key: Option<&str>,
) -> (StatusCode, bool, Value) {
    let url = server.url(&format!("/v1/scenes/{id}/photos?wait_ms={wait_ms}"));
    let request = client().post(url).multipart(form(upload));
    let request = key.into_iter().fold(request, |of, key| of.header("idempotency-key", key));
    let answer = request.send().await.unwrap();
    let replayed = answer.headers().contains_key("idempotency-replayed");
    (answer.status(), replayed, answer.json().await.unwrap())
}

async fn add(server: &TestServer, id: &SceneId, photos: &[usize]) -> Value {
    let (status, _, answer) = send(server, id, &some(photos), 60_000, None).await;
    assert_eq!(status, StatusCode::OK, "{answer}");
    answer
}

async fn remove(server: &TestServer, id: &SceneId, name: &str) -> (StatusCode, Value) {
    let url = server.url(&format!("/v1/scenes/{id}/photos/{name}?wait_ms=60000"));
    let answer = client().delete(url).send().await.unwrap();
    (answer.status(), answer.json().await.unwrap())
}

fn files(scene: &Value) -> Vec<&str> {
    let cameras = scene["cameras"].as_array().expect("a list");
    cameras.iter().map(|camera| camera["file"].as_str().expect("a name")).collect()
}

async fn picture(server: &TestServer, id: &SceneId, query: &str) -> (StatusCode, Vec<u8>) {
    let url = server.url(&format!("/v1/scenes/{id}/view?format=npy&{query}"));
    let answer = client().get(url).send().await.unwrap();
    (answer.status(), answer.bytes().await.unwrap().to_vec())
}

async fn gaussians_of(server: &TestServer, id: &SceneId, text: &str) -> u64 {
    let url = server.url(&format!("/v1/scenes/{id}/query"));
    let asked = json!({ "texts": [text], "boxes": "none" });
    let answer: Value = client().post(url).json(&asked).send().await.unwrap().json().await.unwrap();
    answer["results"][0]["gaussians"].as_u64().unwrap_or_else(|| panic!("{answer}"))
}

async fn held_server() -> (TestServer, Arc<WallNetworks>) {
    let networks = Arc::new(WallNetworks::default());
    let given = Arc::clone(&networks);
    let server = TestServer::with(|config, parts| {
        // The photos that join go to the store as they come.
        config.limits.upload_memory_bytes_max = 1_000;
        parts.scenes = given;
        parts.semantics = Arc::new(PhotoMeaning::default());
    });
    (server.await, networks)
}

#[tokio::test(flavor = "multi_thread")]
async fn photos_join_a_scene_that_is_served_meanwhile_and_are_there_after_a_restart() {
    let (server, networks) = held_server().await;
    let id = made(&server, &[0, 1, 2, 3], SceneOptions::default()).await.id;
    let before = picture(&server, &id, "from=0").await;
    networks.hold.store(true, Ordering::Release);
    let (status, _, taken) = send(&server, &id, &some(&[4, 5]), 0, None).await;
    assert_eq!(status, StatusCode::ACCEPTED, "{taken}");
    assert_eq!((&taken["state"], &taken["version"]), (&json!("done"), &json!(1)));
    assert_eq!(taken["growth"]["state"], "running");
    assert_eq!(taken["growth"]["waiting"], 1);
    assert_eq!(picture(&server, &id, "from=0").await, before, "the old one is served");
    assert_eq!(picture(&server, &id, "from=5").await.0, StatusCode::BAD_REQUEST);
    // Acknowledged photos outlive the process, as far as it is killed or ends.
    let server = server.restart().await;
    assert_eq!(server.service.get(&id).await.unwrap().growth.state, GrowthState::Running);
    networks.hold.store(false, Ordering::Release);
    let grown = server.finished(&id).await;
    assert_eq!((grown.version, grown.growth.state), (2, GrowthState::Done), "{grown:?}");
    let names: Vec<&str> = grown.cameras.iter().map(|camera| &*camera.file).collect();
    assert_eq!(names.len(), 6);
    let report = grown.report.as_ref().expect("a report");
    assert_eq!(report.photos, 6);
    let (status, new) = picture(&server, &id, "from=5").await;
    assert_eq!(status, StatusCode::OK);
    assert_ne!(picture(&server, &id, "from=0").await, before, "another version");
    let server = server.restart().await;
    let kept = server.service.get(&id).await.unwrap();
    assert_eq!((kept.version, &kept.growth, kept.cameras.len()), (2, &grown.growth, 6));
    assert_eq!(picture(&server, &id, "from=5").await.1, new);
    // Jobs that come read all photos again.
    assert!(gaussians_of(&server, &id, "photo 5").await > 0);
    assert!(gaussians_of(&server, &id, "photo 0").await > 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_grew_is_what_a_scene_of_all_photos_is() {
    let server = TestServer::start().await;
    let all = made(&server, &[0, 1, 2, 3, 4, 5], SceneOptions::default()).await.id;
    let id = made(&server, &[0, 1], SceneOptions::default()).await.id;
    add(&server, &id, &[2]).await;
    let grown = add(&server, &id, &[3, 4, 5]).await;
    assert_eq!(grown["version"], 3);
    let whole = server.service.get(&all).await.unwrap();
    let expected: Vec<&str> = whole.cameras.iter().map(|camera| &*camera.file).collect();
    assert_eq!(files(&grown), expected);
    for photo in 0..6 {
        let from = format!("from={photo}");
        assert_eq!(picture(&server, &id, &from).await, picture(&server, &all, &from).await);
    }
    // The same upload is another content now: nobody is given what grew.
    let again = made(&server, &[0, 1], SceneOptions::default()).await;
    assert_eq!((again.cameras.len(), again.version), (2, 1));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_photo_leaves_a_scene_and_may_come_back() {
    let server = TestServer::start().await;
    let two = made(&server, &[0, 2], SceneOptions::default()).await;
    let id = made(&server, &[0, 1, 2], SceneOptions::default()).await.id;
    let name = server.service.get(&id).await.unwrap().cameras[1].file.clone();
    let name = name.replace('/', "%2F");
    let (status, left) = remove(&server, &id, &name).await;
    assert_eq!(status, StatusCode::OK, "{left}");
    let expected: Vec<&str> = two.cameras.iter().map(|camera| &*camera.file).collect();
    assert_eq!((files(&left), &left["version"]), (expected, &json!(2)));
    assert_eq!(picture(&server, &id, "from=1").await, picture(&server, &two.id, "from=1").await);
    let (status, told) = remove(&server, &id, &name).await;
    assert_eq!((status, &told["code"]), (StatusCode::NOT_FOUND, &json!("not_found")));
    let other = two.cameras[0].file.replace('/', "%2F");
    let (status, told) = remove(&server, &id, &other).await;
    assert_eq!(status, StatusCode::BAD_REQUEST, "{told}");
    assert!(told["message"].as_str().unwrap().contains("has 2 photos and needs 2"), "{told}");
    let back = add(&server, &id, &[1]).await;
    assert_eq!((files(&back).len(), &back["version"]), (3, &json!(3)));
    let server = server.restart().await;
    assert_eq!(picture(&server, &id, "from=2").await.0, StatusCode::OK);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_call_with_a_key_adds_its_photos_once() {
    let server = TestServer::start().await;
    let id = made(&server, &[0, 1, 2], SceneOptions::default()).await.id;
    let (status, replayed, _) = send(&server, &id, &some(&[3]), 60_000, Some("k")).await;
    assert_eq!((status, replayed), (StatusCode::OK, false));
    let server = server.restart().await;
    let (status, replayed, again) = send(&server, &id, &some(&[3]), 60_000, Some("k")).await;
    assert_eq!((status, replayed), (StatusCode::OK, true), "{again}");
    assert_eq!((files(&again).len(), &again["version"]), (4, &json!(2)));
    let (status, _, told) = send(&server, &id, &some(&[4]), 60_000, Some("k")).await;
    assert_eq!(status, StatusCode::UNPROCESSABLE_ENTITY, "{told}");
    assert_eq!(told["code"], "idempotency_key_reused");
}

/// Names of the uploads that are kept beside a scene.
fn added(server: &TestServer, id: &SceneId) -> Vec<String> {
    let objects = std::fs::read_dir(server.data_dir().join(format!("scenes/{id}"))).unwrap();
    let names = objects.map(|object| object.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<String> = names.filter(|name| name.starts_with("added")).collect();
    names.sort();
    names
}

/// Waits until so many uploads are kept: they go after the version without them is there.
async fn until_added(server: &TestServer, id: &SceneId, count: usize) -> Vec<String> {
    eventually("uploads are dropped", async || {
        Some(added(server, id)).filter(|names| names.len() == count)
    })
    .await
}

#[tokio::test(flavor = "multi_thread")]
async fn uploads_of_photos_that_left_are_dropped_and_their_calls_are_still_known() {
    let server = TestServer::start().await;
    let id = made(&server, &[0, 1, 2], SceneOptions::default()).await.id;
    let (status, ..) = send(&server, &id, &some(&[3, 4]), 60_000, Some("two")).await;
    assert_eq!(status, StatusCode::OK);
    let (status, ..) = send(&server, &id, &some(&[5]), 60_000, Some("one")).await;
    assert_eq!(status, StatusCode::OK);
    let both = added(&server, &id);
    let name = |photo: usize| some(&[photo]).photos[0].name.replace('/', "%2F");
    assert_eq!(remove(&server, &id, &name(3)).await.0, StatusCode::OK);
    assert_eq!(remove(&server, &id, &name(5)).await.0, StatusCode::OK);
    assert_eq!(until_added(&server, &id, 1).await, both[..1], "one of two is still there");
    // The photos are read again, and of the first upload the one that is there.
    let server = server.restart().await;
    let grown = add(&server, &id, &[3]).await;
    assert_eq!((files(&grown).len(), added(&server, &id).len()), (5, 2));
    assert_eq!(remove(&server, &id, &name(4)).await.0, StatusCode::OK);
    until_added(&server, &id, 1).await;
    let server = server.restart().await;
    for (photos, key) in [(&[3, 4][..], "two"), (&[5][..], "one")] {
        let (status, replayed, told) = send(&server, &id, &some(photos), 60_000, Some(key)).await;
        assert_eq!((status, replayed), (StatusCode::OK, true), "{told}");
        assert_eq!(files(&told).len(), 4, "nothing joined again");
    }
    let back = add(&server, &id, &[5]).await;
    assert_eq!(files(&back).len(), 5);
}

#[tokio::test(flavor = "multi_thread")]
async fn photos_that_cannot_join_are_refused_and_change_nothing() {
    let server = TestServer::with(|config, _| config.limits.network_photos_max = 4).await;
    let id = made(&server, &[0, 1, 2], SceneOptions::default()).await.id;
    let unposed = Upload { cameras: None, ..some(&[3]) };
    let mut broken = some(&[3]);
    broken.photos[0].bytes.truncate(40);
    for (upload, code, word) in [
        (some(&[2, 3]), "invalid_request", "already"),
        (some(&[3, 4]), "limit_exceeded", "photos of the scene"),
        (unposed, "invalid_request", "camera"),
        (broken, "photo_unreadable", "photo"),
    ] {
        let (status, _, told) = send(&server, &id, &upload, 0, None).await;
        assert!(status.is_client_error(), "{told}");
        assert_eq!(told["code"], code, "{told}");
        assert!(told["message"].as_str().unwrap().contains(word), "{told}");
    }
    let absent: SceneId = "0".repeat(32).parse().unwrap();
    let (status, _, _) = send(&server, &absent, &some(&[3]), 0, None).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    let kept = server.service.get(&id).await.unwrap();
    assert_eq!((kept.version, kept.growth.state), (1, GrowthState::None));
    assert_eq!(added(&server, &id), [""; 0], "nothing is kept of them");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_change_that_fails_says_why_and_those_after_it_go_on() {
    let (server, networks) = held_server().await;
    let id = made(&server, &[0, 1, 2], SceneOptions::default()).await.id;
    networks.hold.store(true, Ordering::Release);
    let mut bad = some(&[3]);
    let old = std::mem::replace(&mut bad.photos[0].name, "panic.png".to_owned());
    let Some(UploadCameras::Transforms(json)) = &mut bad.cameras else { panic!("transforms") };
    *json = String::from_utf8(json.clone()).unwrap().replace(&old, "panic.png").into_bytes();
    let (status, _, _) = send(&server, &id, &bad, 0, None).await;
    assert_eq!(status, StatusCode::ACCEPTED);
    let (_, _, second) = send(&server, &id, &some(&[4]), 0, None).await;
    assert_eq!(second["growth"]["waiting"], 2);
    networks.hold.store(false, Ordering::Release);
    let grown = server.finished(&id).await;
    assert_eq!((grown.version, grown.cameras.len()), (2, 4), "{grown:?}");
    assert_eq!((grown.growth.state, grown.growth.waiting), (GrowthState::Done, 0));
    let (status, _, told) = send(&server, &id, &bad, 60_000, None).await;
    assert_eq!(status, StatusCode::INTERNAL_SERVER_ERROR, "{told}");
    let failed = server.service.get(&id).await.unwrap();
    assert_eq!((failed.version, failed.growth.state), (2, GrowthState::Failed));
    assert_eq!(failed.growth.error.expect("a reason").code, "internal");
    let folder = server.data_dir().join(format!("scenes/{id}"));
    eventually("the photos of a change that failed are gone", async || {
        let objects = std::fs::read_dir(&folder).unwrap();
        let names = objects.map(|object| object.unwrap().file_name().into_string().unwrap());
        // The list and the photo of the other one.
        (names.filter(|name| name.starts_with("added")).count() == 2).then_some(())
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_grows_keeps_its_semantics_and_its_edits() {
    let (server, _) = held_server().await;
    let options = SceneOptions { semantics: SemanticsMode::Eager, ..SceneOptions::default() };
    let id = made(&server, &[0, 1, 2, 3], options).await.id;
    let url = server.url(&format!("/v1/scenes/{id}/edits"));
    let edits = json!([
        { "op": "delete", "select": { "text": "photo 1" } },
        { "op": "delete", "select": { "box":
            { "center": [0.0, 0.0, 0.0], "size": [1e-6, 1e-6, 1e-6] } } },
    ]);
    let put = client().put(&url).json(&json!({ "edits": edits })).send().await.unwrap();
    assert_eq!(put.status(), StatusCode::OK);
    let one = gaussians_of(&server, &id, "photo 0").await;
    assert_eq!(gaussians_of(&server, &id, "photo 4").await, 0);
    let grown = add(&server, &id, &[4, 5]).await;
    assert_eq!(grown["semantics"]["state"], "ready", "the new version has them at once");
    assert_eq!(grown["semantics"]["bank_size"], 6);
    assert_eq!(gaussians_of(&server, &id, "photo 4").await, one);
    assert_eq!(gaussians_of(&server, &id, "photo 1").await, 0, "it stays deleted");
    let kept: Value = client().get(&url).send().await.unwrap().json().await.unwrap();
    assert_eq!((&kept["edits"], &kept["counts"]), (&edits, &json!([one, 0])));
    assert_eq!(kept["gaussians"], json!(5 * one));
    let server = server.restart().await;
    assert_eq!(gaussians_of(&server, &id, "photo 5").await, one);
    assert_eq!(gaussians_of(&server, &id, "photo 1").await, 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_was_refined_keeps_its_gaussians_and_is_refined_again() {
    let networks = Arc::new(LensedNetworks::default());
    let server = TestServer::with(|config, parts| {
        parts.scenes = networks;
        config.limits.refine_steps_max = 60;
    });
    let server = server.await;
    let id = made(&server, &[0, 1, 2, 3, 4], SceneOptions::default()).await.id;
    server.service.refine(&id, Refine::Ms(600_000)).await.unwrap();
    let over = async |server: &TestServer, id: &SceneId| {
        eventually("the refinement", async || {
            let status = server.service.get(id).await.unwrap();
            (!status.is_refined_now()).then_some(status)
        })
        .await
    };
    let refined = over(&server, &id).await;
    assert!(refined.version > 1, "{refined:?}");
    let before = refined.report.unwrap();
    let shown = server.service.render(&id, first_view()).await.unwrap();
    let grown = add(&server, &id, &[5]).await;
    let version = grown["version"].as_u64().unwrap();
    assert!(version > u64::from(refined.version));
    let report = &grown["report"];
    assert_eq!(report["method"]["front_photos"], 0, "one set, as it was");
    let steps = before.refinement.expect("a report").steps;
    assert!(report["refinement"]["steps"].as_u64().unwrap() >= u64::from(steps), "{report}");
    assert!(report["gaussians"].as_u64().unwrap() >= before.gaussians, "none of them is lost");
    assert!(report["photos"] == 6 && !shown.bytes.is_empty());
    let again = over(&server, &id).await;
    assert_eq!(again.refinement.state, RefineState::Done, "it was ordered again: {again:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn photos_join_and_leave_over_grpc() {
    let server = TestServer::start().await;
    let id = made(&server, &[0, 1, 2], SceneOptions::default()).await.id;
    let mut client = SceneServiceClient::new(channel(server.addr).await);
    let sent = |photo: usize| tokio_stream::iter(adding(&some(&[photo]), id.as_str(), "k"));
    for _ in 0..2 {
        let grown = client.add_photos(sent(3)).await.expect("they join").into_inner();
        assert_eq!((grown.version, grown.cameras.len()), (2, 4), "once, with one key");
        let growth = grown.growth.expect("it is told");
        assert_eq!((growth.state(), growth.waiting), (pb::GrowthState::Done, 0));
    }
    let reused = client.add_photos(sent(4)).await.expect_err("another photo under that key");
    assert_eq!(reused.metadata().get("segsplat-code").unwrap(), "idempotency_key_reused");
    let name = server.service.get(&id).await.unwrap().cameras[0].file.clone();
    let request = pb::RemovePhotoRequest { scene_id: id.to_string(), name, wait_ms: Some(60_000) };
    let left = client.remove_photo(request.clone()).await.expect("it leaves").into_inner();
    assert_eq!((left.version, left.cameras.len()), (3, 3));
    let gone = client.remove_photo(request).await.expect_err("it is gone");
    assert_eq!(gone.metadata().get("segsplat-code").unwrap(), "not_found");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_command_line_adds_the_photos_of_a_folder() {
    let server = TestServer::start().await;
    let id = made(&server, &[0, 1, 2], SceneOptions::default()).await.id.to_string();
    let folder = tempfile::tempdir().unwrap();
    let upload = some(&[3, 4]);
    let Some(UploadCameras::Transforms(json)) = &upload.cameras else { panic!("transforms") };
    std::fs::write(folder.path().join("transforms.json"), json).unwrap();
    for photo in &upload.photos {
        let path = folder.path().join(&photo.name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, &photo.bytes).unwrap();
    }
    let add = |scene: &str| {
        let mut program = std::process::Command::new(env!("CARGO_BIN_EXE_segsplat"));
        let program = program.args(["--json", "add", scene]).arg(folder.path());
        program.args(["--server", &server.url("")]).output().expect("it starts")
    };
    let output = add(&id);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let told: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((files(&told).len(), &told["version"]), (5, &json!(2)));
    let again = add(&id);
    let why = String::from_utf8_lossy(&again.stderr).into_owned();
    assert!(!again.status.success() && why.contains("already"), "{why}");
    let absent = add(&"0".repeat(32));
    let why = String::from_utf8_lossy(&absent.stderr).into_owned();
    assert!(!absent.status.success() && why.contains("scene_not_found"), "{why}");
}

/// The stages with a stand-in for the geometry network.
fn engine() -> Option<Pipeline> {
    let mut config = Config::default();
    config.bundle = Some(std::path::Path::new("tests/fixtures/plane").to_owned());
    config.threads = 2;
    opened(Pipeline::open(&config.networks()))
}

#[test]
fn only_sets_with_new_photos_go_through_the_network_and_the_others_stay_as_they_were() {
    let Some(engine) = engine() else { return };
    let photos = sample::photos(&ALL).expect("the options are in range");
    let set = |count: usize| PhotoSet::given(photos[..count].to_vec(), Vec::new(), 0.0);
    let (options, stop) = (SceneOptions::default(), std::sync::atomic::AtomicBool::new(false));
    let runs = std::sync::atomic::AtomicUsize::new(0);
    let progress = |stage: Stage, _: f32| {
        if stage == Stage::Geometry {
            runs.fetch_add(1, Ordering::AcqRel);
        }
    };
    let watch = Watch { progress: &progress, cancel: &stop };
    // The stage begins and ends with a word of its own.
    let ran = || runs.swap(0, Ordering::AcqRel) - 2;
    let (_, known) = make_keeping(&engine, &set(5), &options, watch).expect("made");
    let before = ran();
    let grown =
        make_more(&engine, &set(6), 5, Some(known.clone()), &options, watch).expect("grown");
    assert_eq!((before, ran()), (2, 1), "one set for one photo");
    assert_eq!(grown.made.cameras.len(), 6);
    assert!(grown.made.cameras.iter().all(|camera| camera.network.is_some()), "all are used");
    let views = |of: &Gaussians| of.source().iter().map(|pixel| pixel.view).max();
    assert_eq!((views(&grown.made.gaussians), views(&grown.of_new)), (Some(5), Some(5)));
    assert!(grown.of_new.source().iter().all(|pixel| pixel.view == 5), "those of the new alone");
    let seen = grown.seen.expect("it is kept");
    assert_eq!((seen.photos(), known.photos()), (6, 5));
    // What was said of the first five is what it was.
    let back = seen.only(&[0, 1, 2, 3, 4]);
    let again = make_more(&engine, &set(5), 5, Some(back), &options, watch).expect("united");
    let first = make_more(&engine, &set(5), 5, Some(known), &options, watch).expect("united");
    assert!(again.made.gaussians.means() == first.made.gaussians.means(), "bit for bit");
    assert!(again.of_new.is_empty());
    // Without it the network runs for all.
    runs.store(0, Ordering::Release);
    make_more(&engine, &set(6), 5, None, &options, watch).expect("made");
    assert_eq!(ran(), 2);
}

#[test]
fn what_is_kept_of_photos_that_come_and_leave_does_not_grow() {
    let Some(engine) = engine() else { return };
    let photos = sample::photos(&ALL).expect("the options are in range");
    let set = |of: &[usize]| {
        let photos = of.iter().map(|&i| photos[i].clone()).collect();
        PhotoSet::given(photos, Vec::new(), 0.0)
    };
    let (options, stop) = (SceneOptions::default(), std::sync::atomic::AtomicBool::new(false));
    let watch = Watch { progress: &|_, _| (), cancel: &stop };
    let (mut made, mut seen) = make_keeping(&engine, &set(&[0, 1, 2, 3]), &options, watch).unwrap();
    let mut sizes = Vec::new();
    for photo in [4, 5, 4, 5, 4, 5] {
        let grown = make_more(&engine, &set(&[0, 1, 2, 3, photo]), 4, Some(seen), &options, watch);
        let grown = grown.expect("grown");
        (made, seen) = (grown.made, grown.seen.expect("it is kept").only(&[0, 1, 2, 3]));
        // All that it has, as text.
        sizes.push(format!("{seen:?}").len());
    }
    assert_eq!((seen.photos(), made.report.views_used), (4, 5), "all were used");
    assert!(sizes.iter().all(|size| *size == sizes[0]), "{sizes:?}");
}

#[test]
fn a_scene_that_would_be_worse_at_its_old_photos_keeps_what_it_has() {
    let Some(engine) = engine() else { return };
    let photos = sample::photos(&ALL).expect("the options are in range");
    let set = |count: usize| PhotoSet::given(photos[..count].to_vec(), Vec::new(), 0.0);
    let (options, stop) = (SceneOptions::default(), std::sync::atomic::AtomicBool::new(false));
    let watch = Watch { progress: &|_, _| (), cancel: &stop };
    let (made, known) = make_keeping(&engine, &set(5), &options, watch).expect("made");
    let served = made.into_scene(SceneId::from_bytes([7; 16]), 0, Provenance::default());
    let mut grown = make_more(&engine, &set(6), 5, Some(known), &options, watch).expect("grown");
    let renderer = CpuRenderer::new(2).expect("a renderer");
    let version = |grown: &Grown| {
        growth::version(&renderer, &served, &[0, 1, 2, 3, 4], grown, &photos).expect("a version")
    };
    // What the old photos show is what they showed before.
    grown.made.gaussians = served.gaussians.joined(&grown.of_new.only(|i| i == 0)).unwrap();
    let good = version(&grown);
    assert!(good.gaussians.means() == grown.made.gaussians.means(), "the union, made again");
    assert!(good.report.network_focal_px[5] > 0.0, "the new photo may be in front");
    // All of it is black.
    let mut raw = grown.made.gaussians.clone().into_raw();
    raw.sh.fill([-2.0; 3]);
    grown.made.gaussians = Gaussians::restore(raw).expect("Gaussians");
    let kept = version(&grown);
    let before = served.gaussians.sh();
    assert!(kept.gaussians.sh()[..before.len()] == *before, "all that it had, in its place");
    assert_eq!(kept.cameras.len(), 6);
    assert_eq!(kept.report.network_focal_px[..5], served.meta.report.network_focal_px[..]);
    assert!(kept.report.network_focal_px[5] <= 0.0, "the new photo never is in front");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_networks_run_for_what_is_new_alone() {
    let Some(engine) = engine() else { return };
    let loader: Arc<dyn SceneNetworks> = Arc::new(PipelineNetworks(Arc::new(engine.into())));
    let server = TestServer::with(|_, parts| parts.scenes = loader).await;
    let id = made(&server, &[0, 1, 2, 3, 4], SceneOptions::default()).await.id;
    let grown = add(&server, &id, &[5]).await;
    assert_eq!((files(&grown).len(), &grown["version"]), (6, &json!(2)));
    let ms = |scene: &Value, stage: &str| {
        let stages = scene["report"]["stages"].as_array().unwrap().clone();
        let found = stages.into_iter().find(|of| of["stage"] == stage);
        found.and_then(|of| of["ms"].as_f64())
    };
    assert!(ms(&grown, "geometry").is_some() && ms(&grown, "lift").is_some(), "{grown}");
    let (status, _) = picture(&server, &id, "from=5").await;
    assert_eq!(status, StatusCode::OK);
    let name = files(&grown)[0].replace('/', "%2F");
    let (status, left) = remove(&server, &id, &name).await;
    assert_eq!(status, StatusCode::OK, "{left}");
    assert_eq!(ms(&left, "geometry"), None, "no network runs for a photo that leaves");
}

/// Two servers on one store; the networks of the first wait while they are told to.
async fn replicas(place: [StoreLocation; 2]) -> (TestServer, TestServer, Arc<WallNetworks>) {
    let networks = Arc::new(WallNetworks::default());
    let given = Arc::clone(&networks);
    let one = TestServer::at(&place[0], |config, parts| {
        config.limits.record_fresh_ms = 0;
        parts.scenes = given;
    });
    let other = TestServer::at(&place[1], |config, _| config.limits.record_fresh_ms = 0);
    (one.await, other.await, networks)
}

#[tokio::test(flavor = "multi_thread")]
async fn photos_that_joined_at_another_replica_outlive_a_refinement_here() {
    for is_ended in [true, false] {
        let place = StoreLocation::Shared(Arc::new(InMemory::new()));
        let (one, other, networks) = replicas([place.clone(), place]).await;
        let id = made(&one, &[0, 1, 2, 3], SceneOptions::default()).await.id;
        networks.hold.store(true, Ordering::Release);
        let before = networks.calls.load(Ordering::Acquire);
        one.service.refine(&id, Refine::Ms(600_000)).await.unwrap();
        let is_held = async || (networks.calls.load(Ordering::Acquire) > before).then_some(());
        eventually("its refinement has begun", is_held).await;
        assert_eq!(files(&add(&other, &id, &[4]).await).len(), 5);
        if is_ended {
            one.service.refine(&id, Refine::Off).await.unwrap();
        }
        networks.hold.store(false, Ordering::Release);
        let is_over = async || {
            let state = one.service.get(&id).await.unwrap().refinement.state;
            matches!(state, RefineState::None | RefineState::Done).then_some(())
        };
        eventually("its refinement is over", is_over).await;
        for server in [&one, &other] {
            let scene = server.service.get(&id).await.unwrap();
            assert_eq!(scene.cameras.len(), 5, "ended {is_ended}: {scene:?}");
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_change_of_photos_is_claimed_where_another_has_just_ended() {
    let objects = Arc::new(InMemory::new());
    let faults = Arc::new(FaultStore::new(Arc::clone(&objects) as _, Duration::from_millis(500)));
    let place = [Arc::clone(&faults) as _, Arc::clone(&objects) as _].map(StoreLocation::Shared);
    let (one, _other, networks) = replicas(place).await;
    let id = made(&one, &[0, 1, 2, 3], SceneOptions::default()).await.id;
    let claim = Path::from(format!("growing/{id}"));
    objects.put(&claim, "another".into()).await.unwrap();
    networks.hold.store(true, Ordering::Release);
    let path = claim.clone();
    faults.plan(move |what, at| (what == "get" && *at == path).then_some(Wrong::Stalls));
    let ends = async {
        let reads = async || (faults.wrongs.load(Ordering::Acquire) > 0).then_some(());
        eventually("the claim is being read", reads).await;
        objects.delete(&claim).await.unwrap();
    };
    let photos = some(&[4]);
    let ((status, _, answer), ()) = tokio::join!(send(&one, &id, &photos, 0, None), ends);
    assert_eq!(status, StatusCode::ACCEPTED, "{answer}");
    assert!(objects.head(&claim).await.is_ok(), "nobody else may change its photos now");
    networks.hold.store(false, Ordering::Release);
}

#[tokio::test(flavor = "multi_thread")]
async fn semantics_that_came_before_their_version_stay() {
    let (server, _) = held_server().await;
    let options = SceneOptions { semantics: SemanticsMode::Eager, ..SceneOptions::default() };
    let id = made(&server, &[0, 1, 2, 3], options).await.id;
    let folder = server.data_dir().join("scenes").join(id.as_str());
    let before = std::fs::read(folder.join("scene.segsplat")).unwrap();
    add(&server, &id, &[4]).await;
    let kept = std::fs::read(folder.join("semantics.segsplat")).unwrap();
    // As a reader finds them that comes between the two.
    std::fs::write(folder.join("scene.segsplat"), before).unwrap();
    let server = server.restart().await;
    assert_eq!(picture(&server, &id, "from=0").await.0, StatusCode::OK);
    assert_eq!(std::fs::read(folder.join("semantics.segsplat")).unwrap(), kept);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_claim_on_photos_is_followed_from_heir_to_heir() {
    let objects = Arc::new(InMemory::new());
    let place = StoreLocation::Shared(Arc::clone(&objects) as _);
    let server = TestServer::at(&place, |config, _| {
        (config.limits.replica_beat_ms, config.limits.replica_lease_ms) = (50, 200);
    });
    let server = server.await;
    let id = made(&server, &[0, 1, 2], SceneOptions::default()).await.id;
    // The scene's own last record drops the claims on it.
    tokio::time::sleep(Duration::from_millis(500)).await;
    // Neither the one that changed its photos nor its heir is there any more.
    let [growing, claim] = [format!("growing/{id}"), format!("claims/{id}.first")].map(Path::from);
    objects.put(&claim, "second".into()).await.unwrap();
    objects.put(&growing, "first".into()).await.unwrap();
    let ended = async || objects.head(&growing).await.is_err().then_some(());
    eventually("nobody changes its photos", ended).await;
    assert_eq!(files(&add(&server, &id, &[3]).await).len(), 4);
}
