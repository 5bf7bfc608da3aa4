//! Jobs: no acknowledged scene is lost, a panic ends its own job alone, late watchers see the
//! state.

use std::{
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use futures_util::StreamExt;
use segsplat::{
    error::ErrorCode,
    keys::Caller,
    limits::Limits,
    sample::{self, SampleOptions},
    scene::{Density, Event, SceneId, SceneOptions, SceneState, SceneStatus, SemanticsMode, Stage},
    service::{
        BackgroundSpec, CameraSpec, CreateScene, ExportFormat, LensSpec, PageRequest, PictureKind,
        PictureOptions, PoseSpec, Service, TextOptions, ViewOptions, ViewsSpec,
    },
    store::{self, Record, Store, StoreLocation},
};
use serde_json::json;
use sha2::{Digest, Sha256};

use crate::common::{
    process::eventually,
    server::{PATIENCE, TestServer, WallNetworks, first_view, panicking_upload, upload},
};

/// No text.
fn ask() -> TextOptions {
    TextOptions::default()
}

fn request() -> CreateScene {
    CreateScene { upload: upload(), ..CreateScene::default() }
}

/// A server whose networks wait, and the networks.
async fn on_hold() -> (TestServer, Arc<WallNetworks>) {
    let networks = Arc::new(WallNetworks::default());
    networks.hold.store(true, Ordering::Release);
    let given = Arc::clone(&networks);
    let server = TestServer::with(|config, parts| {
        parts.scenes = given;
        config.limits.queued_jobs_max = 2;
    })
    .await;
    (server, networks)
}

fn first_camera() -> CameraSpec {
    CameraSpec { pose: PoseSpec::Between { from: 0, to: 1, t: 0.0 }, lens: LensSpec::OfScene }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_goes_through_its_states_and_a_late_watcher_sees_where_it_is() {
    let (server, networks) = on_hold().await;
    let id = server.service.create_scene(request()).await.unwrap().status.id;
    let mut early = std::pin::pin!(server.service.watch(&id).await.unwrap());
    while !matches!(early.next().await, Some(Event::Running { stage, .. }) if stage == "geometry") {
    }
    let mut late = std::pin::pin!(server.service.watch(&id).await.unwrap());
    let Some(Event::Running { stage, fraction }) = late.next().await else { panic!("not running") };
    assert_eq!((stage.as_str(), fraction), ("geometry", Stage::Geometry.overall(0.5)));
    networks.hold.store(false, Ordering::Release);
    let rest: Vec<Event> = late.collect().await;
    assert_eq!(rest.last(), Some(&Event::Done));
    let status = server.service.get(&id).await.unwrap();
    assert_eq!((status.state, status.cameras.len()), (SceneState::Done, 3));
    let after: Vec<Event> = server.service.watch(&id).await.unwrap().collect().await;
    assert_eq!(after, [Event::Done], "who comes after the end sees the end");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_panicking_job_fails_alone() {
    let server = TestServer::start().await;
    let bad = CreateScene { upload: panicking_upload(), wait: Some(PATIENCE), ..request() };
    let status = server.service.create_scene(bad).await.unwrap().status;
    assert_eq!(status.state, SceneState::Failed);
    assert_eq!(status.error.unwrap().code, "internal");
    assert_eq!(server.scene().await.state, SceneState::Done, "the worker lives on");
    assert!(server.service.ready().ready);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_queue_says_when_to_come_back() {
    let (server, networks) = on_hold().await;
    let running = server.service.create_scene(request()).await.unwrap().status.id;
    let mut events = std::pin::pin!(server.service.watch(&running).await.unwrap());
    while !matches!(events.next().await, Some(Event::Running { .. })) {}
    for _ in 0..2 {
        server.service.create_scene(request()).await.unwrap();
    }
    let refused = server.service.create_scene(request()).await.unwrap_err();
    assert_eq!(refused.code(), ErrorCode::Overloaded);
    assert!(refused.retry_after().is_some() && refused.message().contains("2 scenes wait"));
    assert_eq!(server.service.list(&PageRequest::default()).await.unwrap().scenes.len(), 3);
    // No photo of what is refused is decoded; one with a key may be a call that was answered.
    let mut broken = request();
    broken.upload.photos[0].bytes.truncate(100);
    let refused = server.service.create_scene(broken.clone()).await.unwrap_err();
    assert_eq!(refused.code(), ErrorCode::Overloaded, "{refused}");
    broken.idempotency_key = Some("k".to_owned());
    let refused = server.service.create_scene(broken).await.unwrap_err();
    assert_eq!(refused.code(), ErrorCode::PhotoUnreadable, "{refused}");
    networks.hold.store(false, Ordering::Release);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_acknowledged_is_made_after_a_restart() {
    let (server, networks) = on_hold().await;
    let running = server.service.create_scene(request()).await.unwrap().status.id;
    let queued = server.service.create_scene(request()).await.unwrap().status.id;
    let server = server.restart().await;
    for id in [&running, &queued] {
        let state = server.service.get(id).await.unwrap().state;
        assert!(!state.is_final(), "{id} is {state:?}");
    }
    networks.hold.store(false, Ordering::Release);
    for id in [&running, &queued] {
        assert_eq!(server.finished(id).await.state, SceneState::Done);
    }
    let view = first_view();
    let before = server.service.render(&running, view.clone()).await.unwrap();
    let server = server.restart().await;
    let after = server.service.render(&running, view).await.unwrap();
    assert_eq!((before.bytes, before.etag), (after.bytes, after.etag), "scenes are kept");
}

#[tokio::test(flavor = "multi_thread")]
async fn deleting_stops_the_job_and_tells_its_watchers() {
    let (server, networks) = on_hold().await;
    let id = server.service.create_scene(request()).await.unwrap().status.id;
    let mut events = std::pin::pin!(server.service.watch(&id).await.unwrap());
    while !matches!(events.next().await, Some(Event::Running { .. })) {}
    server.service.delete(&id).await.unwrap();
    let rest: Vec<Event> = events.collect().await;
    assert_eq!(rest.last(), Some(&Event::Cancelled));
    assert_eq!(server.service.get(&id).await.unwrap_err().code(), ErrorCode::SceneNotFound);
    assert_eq!(server.service.delete(&id).await.unwrap_err().code(), ErrorCode::SceneNotFound);
    // The record of the job's start may be on its way to the disk; it is taken back.
    let scenes = server.data_dir().join("scenes");
    eventually("nothing is kept of it", async || {
        (std::fs::read_dir(&scenes).map_or(0, Iterator::count) == 0).then_some(())
    })
    .await;
    networks.hold.store(false, Ordering::Release);
    assert_eq!(server.scene().await.state, SceneState::Done);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_takes_too_long_fails_with_its_code() {
    let networks = Arc::new(WallNetworks::default());
    networks.hold.store(true, Ordering::Release);
    let server = TestServer::with(|config, parts| {
        parts.scenes = networks;
        config.limits.scene_timeout_ms = 50;
    })
    .await;
    let status = server.scene().await;
    assert_eq!(status.error.unwrap().code, "deadline_exceeded");
}

#[tokio::test(flavor = "multi_thread")]
async fn one_key_makes_one_scene_also_after_a_restart() {
    let server = TestServer::start().await;
    let keyed = || CreateScene { idempotency_key: Some("k1".to_owned()), ..request() };
    let first = server.service.create_scene(keyed()).await.unwrap();
    let server = server.restart().await;
    let again = server.service.create_scene(keyed()).await.unwrap();
    assert!(!first.replayed && again.replayed);
    assert_eq!(first.status.id, again.status.id);
    let mut other = keyed();
    other.options.max_views = Some(2);
    let refused = server.service.create_scene(other).await.unwrap_err();
    assert_eq!(refused.code(), ErrorCode::IdempotencyKeyReused, "{refused}");
    server.service.delete(&first.status.id).await.unwrap();
    assert!(!server.service.create_scene(keyed()).await.unwrap().replayed);
}

/// The upload of another scene.
fn other_request(seed: u64) -> CreateScene {
    let options = SampleOptions { photos: 2, width: 48, height: 32, seed };
    CreateScene { upload: sample::upload(&options).unwrap(), ..CreateScene::default() }
}

#[tokio::test(flavor = "multi_thread")]
async fn photos_of_a_waiting_job_are_read_once_where_they_fit() {
    let networks = Arc::new(WallNetworks::default());
    networks.hold.store(true, Ordering::Release);
    let given = Arc::clone(&networks);
    // One upload fits: two photos of 48 x 32 pixels, three bytes each.
    let server = TestServer::with(|config, parts| {
        parts.scenes = given;
        config.jobs = 1;
        config.limits.read_uploads_bytes_max = 2 * 48 * 32 * 3;
    })
    .await;
    let running = server.service.create_scene(other_request(1)).await.unwrap().status.id;
    let mut events = std::pin::pin!(server.service.watch(&running).await.unwrap());
    while !matches!(events.next().await, Some(Event::Running { stage, .. }) if stage == "geometry")
    {
    }
    let fits = server.service.create_scene(other_request(2)).await.unwrap().status.id;
    let too_large = server.service.create_scene(other_request(3)).await.unwrap().status.id;
    for id in [&fits, &too_large] {
        let folder = server.data_dir().join("scenes").join(id.as_str());
        std::fs::remove_file(folder.join("upload.segsplat")).unwrap();
    }
    networks.hold.store(false, Ordering::Release);
    assert_eq!(server.finished(&running).await.state, SceneState::Done);
    assert_eq!(server.finished(&fits).await.state, SceneState::Done, "its photos are in memory");
    let error = server.finished(&too_large).await.error.expect("its photos are in the store alone");
    assert_eq!(error.code, "scene_not_found");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_that_stops_waiting_for_the_same_content_lets_no_other_make_it() {
    let networks = Arc::new(WallNetworks::default());
    networks.hold.store(true, Ordering::Release);
    let given = Arc::clone(&networks);
    let server = TestServer::with(|config, parts| {
        parts.scenes = given;
        config.jobs = 3;
    })
    .await;
    let running = async || {
        let id = server.service.create_scene(request()).await.unwrap().status.id;
        let mut events = std::pin::pin!(server.service.watch(&id).await.unwrap());
        while !matches!(events.next().await, Some(Event::Running { .. })) {}
        id
    };
    let first = running().await;
    let waits = running().await;
    // By then it waits for the first.
    tokio::time::sleep(Duration::from_millis(200)).await;
    server.service.delete(&waits).await.unwrap();
    while server.service.ready().jobs_running > 1 {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let next = running().await;
    tokio::time::sleep(Duration::from_millis(100)).await;
    assert_eq!(networks.calls.load(Ordering::Acquire), 1, "the first makes it");
    networks.hold.store(false, Ordering::Release);
    for id in [first, next] {
        assert_eq!(server.finished(&id).await.state, SceneState::Done);
    }
    assert_eq!(networks.calls.load(Ordering::Acquire), 1, "the other is a copy");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_key_that_an_earlier_program_kept_still_answers_for_its_scene() {
    let server = TestServer::start().await;
    let set = SceneOptions {
        max_views: Some(2),
        semantics: SemanticsMode::Off,
        density: Some(Density::Full),
        ..SceneOptions::default()
    };
    // That program hashed the Rust text of the options.
    let cases = [
        (SceneOptions::default(), "max_views: None, semantics: Lazy, density: Thinned"),
        (set, "max_views: Some(2), semantics: Off, density: Full"),
    ];
    for (i, (options, text)) in cases.into_iter().enumerate() {
        let keyed = || CreateScene {
            idempotency_key: Some(format!("k{i}")),
            options: options.clone(),
            ..request()
        };
        let first = server.service.create_scene(keyed()).await.unwrap().status;
        let mut hash = Sha256::new();
        for file in store::hashes(&upload()) {
            hash.update((file.file.len() as u64).to_le_bytes());
            hash.update(&file.file);
            hash.update(&file.sha256);
        }
        hash.update(format!("SceneOptions {{ {text} }}"));
        let old: String = hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        let keys = std::fs::read_dir(server.data_dir().join("keys")).unwrap();
        let mut keys = keys.map(|key| key.unwrap().path());
        let id = first.id.as_str();
        let key = keys.find(|key| std::fs::read_to_string(key).unwrap().contains(id)).unwrap();
        let of = |sha256: &str| json!({ "id": id, "request_sha256": sha256 }).to_string();
        std::fs::write(&key, of(&old)).unwrap();
        let again = server.service.create_scene(keyed()).await.unwrap();
        assert_eq!((again.replayed, &again.status.id), (true, &first.id), "{text}");
        std::fs::write(&key, of(&"ab".repeat(32))).unwrap();
        let refused = server.service.create_scene(keyed()).await.unwrap_err();
        assert_eq!(refused.code(), ErrorCode::IdempotencyKeyReused, "{text}: {refused}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_go_from_the_newest_and_miss_none_when_scenes_come_and_go() {
    let folder = tempfile::tempdir().unwrap();
    let place = StoreLocation::Folder(folder.path().to_owned());
    let keep = |byte: u8, created_ms: u64| {
        let id = SceneId::from_bytes([byte; 16]);
        let owner = byte.is_multiple_of(2).then(|| "even".to_owned());
        let status = SceneStatus::new(id, SceneState::Done, created_ms);
        let (store, _) = Store::open(&place, &Limits::default()).unwrap();
        store.put_record(&Record { owner, ..Record::new(status) }).unwrap();
    };
    for (byte, created_ms) in [(1, 10), (2, 30), (3, 20), (4, 20)] {
        keep(byte, created_ms);
    }
    let page = async |service: &Service, limit: usize, after: Option<String>| {
        let found = service.list(&PageRequest { limit: Some(limit), after }).await.unwrap();
        let byte = |scene: &SceneStatus| u8::from_str_radix(&scene.id.as_str()[..2], 16).unwrap();
        (found.scenes.iter().map(byte).collect::<Vec<_>>(), found.next)
    };
    let server = TestServer::at(&place, |_, _| {}).await;
    let (first, next) = page(&server.service, 2, None).await;
    assert_eq!((first, next.is_some()), (vec![2, 3], true));
    server.service.delete(&SceneId::from_bytes([3; 16])).await.unwrap();
    server.stop().await;
    keep(9, 99);
    let server = TestServer::at(&place, |_, _| {}).await;
    assert_eq!(page(&server.service, 2, next).await, (vec![4, 1], None));
    let even = server.service.for_caller(Caller::Owner("even".into()));
    let (own, next) = page(&even, 1, None).await;
    assert_eq!((own, next.is_some()), (vec![2], true), "more of one's own");
    assert_eq!(page(&even, 1, next).await, (vec![4], None), "others' scenes are no more");
}

#[tokio::test(flavor = "multi_thread")]
async fn views_come_camera_by_camera_and_tags_tell_pictures_apart() {
    let server = TestServer::start().await;
    let id = server.scene().await.id;
    let spec = ViewsSpec {
        cameras: vec![first_camera(); 3],
        kinds: vec![PictureKind::Depth, PictureKind::Color, PictureKind::Depth],
        options: ViewOptions::default(),
        picture: PictureOptions::default(),
        text: TextOptions::default(),
    };
    let views: Vec<_> = server.service.render_many(&id, &spec).await.unwrap().collect().await;
    let order: Vec<_> =
        views.iter().map(|v| v.as_ref().unwrap()).map(|v| (v.camera_index, v.kind)).collect();
    assert_eq!(order.len(), 6, "a kind named twice is drawn once");
    assert_eq!(
        order[..3],
        [(0, PictureKind::Depth), (0, PictureKind::Color), (1, PictureKind::Depth)]
    );

    let one = first_view();
    let tag = server.service.view_etag(&id, &one).await.unwrap();
    assert_eq!(server.service.render(&id, one.clone()).await.unwrap().etag, tag.clone().unwrap());
    let mut other = one.clone();
    other.picture.background = BackgroundSpec::Color([0.0, 0.0, 0.5]);
    assert_ne!(server.service.view_etag(&id, &other).await.unwrap(), tag);
    let mut late = one;
    late.options.deadline = Some(Duration::ZERO);
    let error = server.service.render(&id, late).await.unwrap_err();
    assert_eq!(error.code(), ErrorCode::DeadlineExceeded);

    let too_many = ViewsSpec { cameras: vec![first_camera(); 65], ..spec };
    let error = server.service.render_many(&id, &too_many).await.map(|_| ()).unwrap_err();
    assert_eq!(error.message(), "cameras: 65 is over 64");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_spoiled_on_disk_says_so_and_the_server_lives() {
    let server = TestServer::start().await;
    let id = server.scene().await.id;
    let server = server.restart().await;
    let path = server.data_dir().join("scenes").join(id.as_str()).join("scene.segsplat");
    let mut file = std::fs::read(&path).unwrap();
    let middle = file.len() / 2;
    file[middle] ^= 1;
    std::fs::write(&path, file).unwrap();
    let ask = ask();
    let export = || server.service.export(&id, ExportFormat::Ply, None, &ask);
    assert_eq!(export().await.unwrap_err().code(), ErrorCode::SceneCorrupt);
    let status = server.service.get(&id).await.unwrap();
    assert_eq!(
        (status.state, status.error.unwrap().code.as_str()),
        (SceneState::Failed, "scene_corrupt")
    );
    let server = server.restart().await;
    let again = server.service.export(&id, ExportFormat::Ply, None, &ask).await.unwrap_err();
    assert_eq!(again.code(), ErrorCode::SceneCorrupt, "also after a restart");
    assert_eq!(server.scene().await.state, SceneState::Done);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_export_has_the_size_it_says() {
    let server = TestServer::start().await;
    let id = server.scene().await.id;
    let export = server.service.export(&id, ExportFormat::Ply, None, &ask()).await.unwrap();
    let export = export.begin().await.unwrap();
    let size = export.size_bytes;
    let file = export.into_stream().map(Result::unwrap).concat().await;
    assert_eq!(size, Some(file.len() as u64));
}
