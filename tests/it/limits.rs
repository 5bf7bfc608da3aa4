//! Every limit is live, or the configuration says that it waits for the next start: each live one
//! is reloaded, and a call is answered in another way.

use std::{
    collections::BTreeSet,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use futures_util::TryStreamExt as _;
use object_store::{ObjectStore as _, ObjectStoreExt as _, memory::InMemory, path::Path as Name};
use segsplat::{
    error::{Error, Result},
    limits::{Limits, LiveLimits},
    photos,
    render::{
        DifferentiableRenderer, Frame, RenderRequest, Renderer,
        backward::{FrameGradients, Gradients},
        train::{Trainer, TrainingSet},
    },
    sample::{self, SampleOptions},
    scene::{
        Gaussians, Refine, RefineState, SceneId, SceneState, SemanticsState, Upload, UploadFile,
    },
    service::{CreateScene, QuerySpec},
    store::StoreLocation,
};
use segsplat_testing::captures::{self, zipped};
use serde_json::{Value, json};

use crate::common::{
    meaning::PhotoMeaning,
    process, root,
    server::{PATIENCE, PointRenderer, TestServer, WallNetworks, upload},
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
    /// Sends two edits.
    Edits,
}

/// Limits, a value of each that changes the answer, and what is asked.
const LIVE: [(&str, u64, Ask); 38] = [
    ("photos_max", 2, Ask::Photos),
    ("network_photos_max", 2, Ask::Photos),
    ("photos_min", 4, Ask::Photos),
    ("upload_bytes_max", 1_000, Ask::Photos),
    ("upload_file_bytes_max", 1_000, Ask::Photos),
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
    ("edits_max", 1, Ask::Edits),
    ("texts_max", 1, Ask::Text),
    ("text_chars_max", 3, Ask::Text),
    ("parts_max", 0, Ask::Text),
    ("text_wait_ms", 0, Ask::FirstText),
    ("refine_ms_max", 10, Ask::Refine),
    ("refine_steps_max", 1, Ask::Refine),
    ("refine_gaussians_max", 50, Ask::Refine),
    ("refine_side_max", 20, Ask::Refine),
];

/// Live as well, and not seen by these calls: those of keys, in `access.rs`, of answers that are
/// not sent yet, in `answers.rs`, and of memory, in `received.rs`; one that counts on a device
/// alone, and those of threads and of replicas, by tests of their own below.
const ELSEWHERE: [&str; 10] = [
    "upload_memory_bytes_max",
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

    /// What a call comes to, without what differs from call to call. What does not come within
    /// `patience` is no answer.
    async fn answer(&self, ask: Ask, patience: Duration) -> String {
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
            Ask::Endless => self.create(&upload(), patience.as_millis() as u64).await,
            Ask::Wait => {
                let (_, scene) = self.created(&upload(), 0).await;
                let id = scene["id"].as_str().unwrap().parse().unwrap();
                let wait = self.server.service.wait(&id, PATIENCE);
                let answered = tokio::time::timeout(patience, wait).await;
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
                let answer = tokio::time::timeout(patience, self.text(&id)).await;
                self.meaning.hold.store(false, Ordering::Release);
                self.server.service.delete(&id).await.unwrap();
                format!("answered: {}", answer.is_ok())
            }
            Ask::Edits => {
                let ball = json!({ "center": [1e6, 0, 0], "radius": 1 });
                let edit = json!({ "op": "delete", "select": { "sphere": ball } });
                let request = client.put(url(&format!("/v1/scenes/{id}/edits")));
                let request = request.json(&json!({ "edits": [edit, edit] }));
                request.send().await.unwrap().status().to_string()
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
                let figures = report.map(|r| (r.steps, r.gaussians_before, r.psnr_before));
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
        let with = asked.answer(ask, PATIENCE).await;
        asked.server.service.reload(base());
        // What the limit ends has no end without it, so that this need not be long.
        let without = asked.answer(ask, Duration::from_millis(300)).await;
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

/// A device that takes no photos to learn, and keeps what it was told to use at most.
#[derive(Debug, Default)]
struct Device {
    bytes_max: AtomicU64,
}

impl Renderer for Device {
    fn name(&self) -> String {
        PointRenderer.name()
    }

    fn concurrency(&self) -> usize {
        1
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        PointRenderer.render(gaussians, request)
    }

    fn differentiable(self: Arc<Self>) -> Option<Arc<dyn DifferentiableRenderer>> {
        Some(self)
    }
}

impl DifferentiableRenderer for Device {
    fn backward(
        &self,
        _: &Gaussians,
        _: &RenderRequest,
        _: &mut dyn FnMut(&Frame) -> Result<FrameGradients>,
        _: &mut Gradients,
    ) -> Result<Frame> {
        Err(Error::internal("no backward pass"))
    }

    fn trainer<'a>(
        &'a self,
        _: &TrainingSet<'a>,
        bytes_max: u64,
    ) -> Result<Option<Box<dyn Trainer + 'a>>> {
        self.bytes_max.store(bytes_max, Ordering::Release);
        Err(Error::internal("no trainer"))
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_device_is_told_the_bytes_of_now() {
    let device = Arc::new(Device::default());
    let given = Arc::clone(&device);
    let server = TestServer::with(|config, parts| {
        parts.scenes = Arc::new(LensedNetworks::default());
        parts.renderer = given;
        config.limits = base();
    })
    .await;
    let request =
        CreateScene { upload: six_photos(), wait: Some(PATIENCE), ..CreateScene::default() };
    let id = server.service.create_scene(request).await.unwrap().status.id;
    for bytes in [70_001, 70_002] {
        server.service.reload(Limits { refine_device_bytes_max: bytes, ..base() });
        server.service.refine(&id, Refine::Ms(600_000)).await.unwrap();
        process::eventually("the refinement ends", async || {
            let state = server.service.get(&id).await.unwrap().refinement.state;
            (state != RefineState::Running).then_some(())
        })
        .await;
        assert_eq!(device.bytes_max.load(Ordering::Acquire), bytes);
    }
}

/// Longer than any test.
const DAY_MS: u64 = 86_400_000;

/// Limits of a replica that looks at the others once, at its start.
fn unhurried() -> Limits {
    let (beat, lease, fresh) = (DAY_MS, DAY_MS, DAY_MS);
    Limits {
        replica_beat_ms: beat,
        replica_lease_ms: lease,
        record_fresh_ms: fresh,
        ..Limits::default()
    }
}

/// A store in memory, for replicas.
fn shared() -> (Arc<InMemory>, StoreLocation) {
    let objects = Arc::new(InMemory::new());
    (Arc::clone(&objects), StoreLocation::Shared(objects))
}

#[tokio::test(flavor = "multi_thread")]
async fn a_record_of_another_replica_is_read_again_when_the_limit_says_so() {
    let (_objects, place) = shared();
    let meaning = || Arc::new(PhotoMeaning::default());
    let one = TestServer::at(&place, |_, parts| parts.semantics = meaning()).await;
    let other = TestServer::at(&place, |config, parts| {
        parts.semantics = meaning();
        config.limits = unhurried();
    })
    .await;
    let id = one.scene().await.id;
    let seen = async || other.service.get(&id).await.unwrap().semantics.state;
    assert_eq!(seen().await, SemanticsState::None);
    let texts = vec!["photo 0".to_owned()];
    let spec = QuerySpec { texts, wait: Some(PATIENCE), ..QuerySpec::default() };
    one.service.query(&id, spec).await.unwrap();
    assert_eq!(seen().await, SemanticsState::None, "what was read counts for a day");
    other.service.reload(Limits { record_fresh_ms: 0, ..unhurried() });
    assert_eq!(seen().await, SemanticsState::Ready);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_replica_looks_at_the_others_when_the_limit_says_so() {
    let (_objects, place) = shared();
    let one = TestServer::at(&place, |_, _| {}).await;
    let other = TestServer::at(&place, |config, _| config.limits = unhurried()).await;
    let id = one.scene().await.id;
    other.service.get(&id).await.unwrap();
    one.service.delete(&id).await.unwrap();
    other.service.reload(Limits { replica_beat_ms: 10, ..unhurried() });
    process::eventually("the scene is gone", async || other.service.get(&id).await.err()).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_silent_replica_is_replaced_when_the_limit_says_so() {
    let (objects, place) = shared();
    let networks = Arc::new(WallNetworks::default());
    networks.hold.store(true, Ordering::Release);
    let given = Arc::clone(&networks);
    let silent = TestServer::at(&place, |config, parts| {
        parts.scenes = given;
        config.limits = unhurried();
    })
    .await;
    let patient = Limits { replica_beat_ms: 10, ..unhurried() };
    let heir = TestServer::at(&place, |config, _| config.limits = patient.clone()).await;
    let request = CreateScene { upload: upload(), ..CreateScene::default() };
    let id = silent.service.create_scene(request).await.unwrap().status.id;
    // The larger count of heartbeats is that of the heir.
    let beats = async || {
        let names: Vec<Name> = objects
            .list(Some(&Name::from("replicas")))
            .map_ok(|object| object.location)
            .try_collect()
            .await
            .unwrap();
        let mut most = 0_u64;
        for name in names {
            let count = objects.get(&name).await.unwrap().bytes().await.unwrap();
            most = most.max(std::str::from_utf8(&count).unwrap().parse().unwrap());
        }
        most
    };
    let before = beats().await;
    process::eventually("beats", async || (beats().await > before + 3).then_some(())).await;
    let state = async || heir.service.get(&id).await.unwrap().state;
    assert_ne!(state().await, SceneState::Done, "a replica may be silent for a day");
    heir.service.reload(Limits { replica_lease_ms: 1, ..patient.clone() });
    process::eventually("the heir makes it", async || {
        (state().await == SceneState::Done).then_some(())
    })
    .await;
    networks.hold.store(false, Ordering::Release);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_belongs_to_no_scene_goes_when_the_limit_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let left = |byte: u8| {
        let id = SceneId::from_bytes([byte; 16]);
        let path = folder.path().join("scenes").join(id.as_str());
        std::fs::create_dir_all(&path).unwrap();
        std::fs::write(path.join("left"), "x").unwrap();
        path.join("left")
    };
    let gone = async |path: std::path::PathBuf| {
        process::eventually("it is swept", async || (!path.exists()).then_some(())).await;
    };
    let rare = Limits { sweep_every_ms: DAY_MS, ..Limits::default() };
    let first = left(1);
    let place = StoreLocation::Folder(folder.path().to_owned());
    let server = TestServer::at(&place, |config, _| config.limits = rare.clone()).await;
    gone(first).await;
    // The sweep of the start has listed what there was before this one.
    let second = left(2);
    server.service.reload(Limits { sweep_every_ms: 0, ..rare });
    gone(second).await;
}
