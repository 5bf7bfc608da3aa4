//! Every limit is live, or the configuration says that it waits for the next start: each live one
//! is reloaded, and a call is answered in another way.

use std::{
    collections::BTreeSet,
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use segsplat::{
    limits::{Limits, LiveLimits},
    photos,
    sample::{self, SampleOptions},
    scene::{RefineState, SceneId, Upload, UploadFile},
    service::CreateScene,
};
use segsplat_testing::captures::{self, zipped};
use serde_json::{Value, json};

use crate::common::{
    meaning::PhotoMeaning,
    process, root,
    server::{PATIENCE, TestServer, upload},
};
use crate::{
    refine::{LensedNetworks, upload as six_photos},
    schedule::{HoldingRenderer, LARGE, sized},
};

/// What a row asks.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Ask {
    /// Makes a scene of photos, of an archive with COLMAP's files, of a file of Gaussians.
    Photos,
    Archive,
    Splats,
    /// Makes a scene whose networks never end.
    Endless,
    /// Waits for a scene that is never made.
    Wait,
    Get(&'static str),
    /// Draws a view while a large one is drawn.
    BesideAView,
    Views,
    /// Asks a text, also one of a scene without semantics.
    Text,
    FirstText,
    Refine,
}

/// Limits, a value of each that changes the answer, and what is asked.
const LIVE: [(&str, u64, Ask); 34] = [
    ("photos_max", 2, Ask::Photos),
    ("photos_min", 4, Ask::Photos),
    ("upload_bytes_max", 1_000, Ask::Photos),
    ("json_values_max", 3, Ask::Photos),
    ("photo_pixels_max", 100, Ask::Photos),
    ("photo_side_kept_max", 32, Ask::Photos),
    ("photos_pixels_kept_max", 4_000, Ask::Photos),
    ("archive_entries_max", 2, Ask::Archive),
    ("camera_file_bytes_max", 10, Ask::Archive),
    ("archive_unpacked_bytes_max", 100, Ask::Archive),
    ("file_name_bytes_max", 2, Ask::Photos),
    ("gaussians_max", 1, Ask::Splats),
    ("splats_bytes_max", 10, Ask::Splats),
    ("scene_timeout_ms", 50, Ask::Endless),
    ("wait_ms_max", 0, Ask::Wait),
    ("page_max", 1, Ask::Get("/v1/scenes?limit=2")),
    ("view_side_max", 8, Ask::Get("/v1/scenes/ID/view?from=0&width=16&height=12")),
    ("render_timeout_ms", 0, Ask::Get("/v1/scenes/ID/view?from=0&width=16&height=13")),
    ("queued_renders_max", 0, Ask::Get("/v1/scenes/ID/view?from=0&width=16&height=14")),
    ("queued_pixels_max", 2_000, Ask::BesideAView),
    ("features_bytes_max", 1, Ask::Get("/v1/scenes/ID/features?from=0&kind=features&width=16")),
    ("folder_points_max", 1, Ask::Get("/v1/scenes/ID/export?format=nerfstudio")),
    ("exports_max", 0, Ask::Get("/v1/scenes/ID/export")),
    ("cameras_max", 1, Ask::Views),
    ("kinds_max", 1, Ask::Views),
    ("views_pixels_max", 10, Ask::Views),
    ("views_timeout_ms", 0, Ask::Views),
    ("texts_max", 1, Ask::Text),
    ("text_chars_max", 3, Ask::Text),
    ("parts_max", 0, Ask::Text),
    ("text_wait_ms", 0, Ask::FirstText),
    ("refine_ms_max", 10, Ask::Refine),
    ("refine_steps_max", 1, Ask::Refine),
    ("refine_gaussians_max", 50, Ask::Refine),
];

/// Live as well, and not seen by these calls: those of keys, in `access.rs`, and of answers that
/// are not sent yet, in `answers.rs`; one that counts on a device alone, read with the other limits
/// of refinement; and those of threads, which read them again in each of their rounds.
const ELSEWHERE: [&str; 9] = [
    "answers_bytes_max",
    "exports_bytes_max",
    "key_requests_per_s",
    "key_inflight_max",
    "refine_device_bytes_max",
    "sweep_every_ms",
    "record_fresh_ms",
    "replica_beat_ms",
    "replica_lease_ms",
];

/// So few steps that each refinement is short.
fn base() -> Limits {
    Limits { refine_steps_max: 60, ..Limits::default() }
}

struct Asked {
    server: TestServer,
    networks: Arc<LensedNetworks>,
    renderer: Arc<HoldingRenderer>,
    meaning: Arc<PhotoMeaning>,
    made: SceneId,
}

impl Asked {
    async fn start() -> Self {
        let networks = Arc::new(LensedNetworks::default());
        let renderer = HoldingRenderer { concurrency: 2, ..HoldingRenderer::default() };
        let renderer = Arc::new(renderer);
        let meaning = Arc::new(PhotoMeaning::default());
        let (given, draws) = (Arc::clone(&networks), Arc::clone(&renderer));
        let means = Arc::clone(&meaning);
        let server = TestServer::with(|config, parts| {
            parts.scenes = given;
            parts.renderer = draws;
            parts.semantics = means;
            config.limits = base();
            config.jobs = 2;
        })
        .await;
        // Of photos that no other scene has.
        let options = SampleOptions { photos: 3, width: 64, height: 48, seed: 70 };
        let request =
            CreateScene { upload: sample::upload(&options).unwrap(), ..CreateScene::default() };
        let made = server.service.create_scene(request).await.unwrap().status.id;
        server.finished(&made).await;
        Self { server, networks, renderer, meaning, made }
    }

    /// What a call comes to, without what differs from call to call.
    async fn answer(&self, ask: Ask) -> String {
        let (client, url) = (crate::common::client(), |path: &str| self.server.url(path));
        let id = &self.made;
        match ask {
            Ask::Photos => self.create(&upload(), 60_000).await,
            Ask::Archive => {
                let posed = photos::read(&upload(), &Limits::default()).unwrap();
                let files = captures::write("colmap_bin", &posed, &upload().photos);
                let archive = Some(zipped(&files, ""));
                self.create(&Upload { archive, ..Upload::default() }, 60_000).await
            }
            Ask::Splats => {
                let bytes = std::fs::read(root().join("tests/fixtures/splats/source.ply")).unwrap();
                let splats = Some(UploadFile { name: "source.ply".to_owned(), bytes });
                self.create(&Upload { splats, ..Upload::default() }, 60_000).await
            }
            Ask::Endless => self.create(&upload(), 3_000).await,
            Ask::Wait => {
                let (_, scene) = self.created(&upload(), 0).await;
                let id = scene["id"].as_str().unwrap().parse().unwrap();
                let wait = self.server.service.wait(&id, PATIENCE);
                let answered = tokio::time::timeout(Duration::from_secs(5), wait).await;
                self.server.service.delete(&id).await.unwrap();
                format!("answered: {}", answered.is_ok())
            }
            Ask::Get(path) => {
                let url = url(&path.replace("ID", id.as_str()));
                let answer = client.get(url).send().await.unwrap();
                let (status, bytes) = (answer.status(), answer.bytes().await.unwrap());
                let fault = serde_json::from_slice::<Value>(&bytes).unwrap_or_default();
                format!("{status} {} {}", fault["message"], bytes.len())
            }
            Ask::BesideAView => {
                let (service, other) = (self.server.service.clone(), id.clone());
                let large = tokio::spawn(async move { service.render(&other, sized(LARGE)).await });
                process::eventually("it is drawn", async || {
                    (self.renderer.drawing.load(Ordering::Acquire) > 0).then_some(())
                })
                .await;
                let small = self.server.service.render(id, sized(16)).await;
                self.renderer.go_on.store(true, Ordering::Release);
                large.await.unwrap().expect("it was there first");
                self.renderer.go_on.store(false, Ordering::Release);
                format!("{:?}", small.map(drop))
            }
            Ask::Views => {
                let body = json!({
                    "cameras": [{ "from": 0 }, { "from": 1 }], "kinds": ["color", "alpha"],
                    "width": 16, "height": 12, "container": "zip",
                });
                let url = url(&format!("/v1/scenes/{id}/views"));
                let answer = client.post(url).json(&body).send().await.unwrap();
                let status = answer.status();
                format!("{status} {:?}", answer.bytes().await.map(|bytes| bytes.len()).ok())
            }
            Ask::Text => self.text(id).await,
            Ask::FirstText => {
                let (_, scene) = self.created(&upload(), 60_000).await;
                let id = scene["id"].as_str().unwrap().parse().unwrap();
                self.meaning.hold.store(true, Ordering::Release);
                let answer = tokio::time::timeout(Duration::from_secs(5), self.text(&id)).await;
                self.meaning.hold.store(false, Ordering::Release);
                self.server.service.delete(&id).await.unwrap();
                format!("answered: {}", answer.is_ok())
            }
            Ask::Refine => {
                let (_, scene) = self.created(&six_photos(), 60_000).await;
                let id: SceneId = scene["id"].as_str().unwrap().parse().unwrap();
                let url = url(&format!("/v1/scenes/{id}/refine?refine=600000"));
                let (status, said) = process::post(&client, &url, &json!({})).await.unwrap();
                let done = process::eventually("the refinement", async || {
                    let status = self.server.service.get(&id).await.unwrap();
                    (status.refinement.state != RefineState::Running).then_some(status)
                })
                .await;
                self.server.service.delete(&id).await.unwrap();
                let report = done.report.and_then(|report| report.refinement);
                let figures = report.map(|r| (r.steps, r.gaussians_before));
                format!("{status} {} {figures:?}", said["message"])
            }
        }
    }

    async fn created(&self, upload: &Upload, wait_ms: u64) -> (u16, Value) {
        let client = crate::common::client();
        process::create(&client, &self.server.url(""), upload, wait_ms, None).await.unwrap()
    }

    /// Makes a scene and removes it again, so that the next one is no copy of it.
    async fn create(&self, upload: &Upload, wait_ms: u64) -> String {
        let (status, said) = self.created(upload, wait_ms).await;
        let known = said["id"].as_str().or(said["details"]["scene"].as_str());
        if let Some(id) = known.and_then(|id| id.parse().ok()) {
            self.server.service.delete(&id).await.unwrap();
        }
        let (photos, camera) = (&said["report"]["photos"], &said["cameras"][0]);
        format!("{status} {} {photos} {}", said["message"], camera["intrinsics"]["width"])
    }

    async fn text(&self, id: &SceneId) -> String {
        let body = json!({ "texts": ["photo 0", "photo 1"] });
        let url = self.server.url(&format!("/v1/scenes/{id}/query"));
        let (status, said) = process::post(&crate::common::client(), &url, &body).await.unwrap();
        let parts = said["results"][0]["parts"].as_array().map(Vec::len);
        format!("{status} {} {parts:?}", said["message"])
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn each_live_limit_counts_at_once() {
    let asked = Asked::start().await;
    for (name, value, ask) in LIVE {
        let held = matches!(ask, Ask::Wait | Ask::Endless);
        asked.networks.0.hold.store(held, Ordering::Release);
        let mut limits = serde_json::to_value(base()).unwrap();
        limits[name] = value.into();
        let later = asked.server.service.reload(serde_json::from_value(limits).unwrap());
        assert_eq!(later, [""; 0], "{name} is live");
        let with = asked.answer(ask).await;
        asked.server.service.reload(base());
        let without = asked.answer(ask).await;
        assert_ne!(with, without, "{name} = {value}");
        println!("{name} = {value}: {with} | {without}");
    }
}

#[test]
fn each_limit_is_live_or_waits_for_the_next_start() {
    let all = serde_json::to_value(Limits::default()).unwrap();
    let changed = |value: &Value| (value.as_u64().unwrap() + 1).into();
    let mut waits = BTreeSet::new();
    let mut live = BTreeSet::new();
    for (name, value) in all.as_object().unwrap() {
        let mut new = all.clone();
        new[name] = changed(value);
        let new: Limits = serde_json::from_value(new).unwrap();
        let limits = LiveLimits::new(Limits::default());
        match limits.reload(new.clone())[..] {
            [] => {
                assert_eq!(*limits.get(), new, "{name}");
                live.insert(&**name);
            }
            [later] => {
                assert_eq!((later, &*limits.get()), (&**name, &Limits::default()));
                waits.insert(later);
            }
            _ => panic!("{name} is one limit"),
        }
    }
    let rows = LIVE.iter().map(|(name, ..)| *name).chain(ELSEWHERE);
    assert_eq!(live, rows.collect(), "each live limit has a row here");
    assert!(waits.contains("store_timeout_ms"));
}
