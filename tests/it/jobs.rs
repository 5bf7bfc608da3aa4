//! Scenes in the making: nothing acknowledged is lost, panics stay in their job, watchers catch up.

use std::{
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use futures_util::StreamExt;
use segsplat::{
    error::ErrorCode,
    scene::{Event, SceneState, ScoringProfile, Stage},
    service::{
        Background, CameraSpec, CreateScene, ExportFormat, Kind, LensSpec, PageRequest,
        PictureOptions, PoseSpec, TextOptions, ViewOptions, ViewsSpec,
    },
};

use crate::common::server::{PATIENCE, TestServer, WallMaker, first_view, upload};

/// Nothing is asked by text.
const ASK: TextOptions = TextOptions { text: None, profile: ScoringProfile::Default, wait: None };

fn request() -> CreateScene {
    CreateScene { upload: upload(), ..CreateScene::default() }
}

/// A server whose maker is held, and its hold.
async fn held() -> (TestServer, Arc<WallMaker>) {
    let maker = Arc::new(WallMaker::default());
    maker.hold.store(true, Ordering::Release);
    let given = Arc::clone(&maker);
    let server = TestServer::with(|config, parts| {
        parts.maker = given;
        config.limits.queued_jobs_max = 2;
    })
    .await;
    (server, maker)
}

fn first_camera() -> CameraSpec {
    CameraSpec { pose: PoseSpec::Between { from: 0, to: 1, t: 0.0 }, lens: LensSpec::OfScene }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_goes_through_its_states_and_a_late_watcher_sees_where_it_is() {
    let (server, maker) = held().await;
    let id = server.service.create_scene(request()).await.unwrap().status.id;
    let mut early = std::pin::pin!(server.service.watch(&id).await.unwrap());
    while !matches!(early.next().await, Some(Event::Running { stage, .. }) if stage == "geometry") {
    }
    let mut late = std::pin::pin!(server.service.watch(&id).await.unwrap());
    let Some(Event::Running { stage, fraction }) = late.next().await else { panic!("not running") };
    assert_eq!((stage.as_str(), fraction), ("geometry", Stage::Geometry.overall(0.5)));
    maker.hold.store(false, Ordering::Release);
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
    let mut bad = request();
    let last = bad.upload.photos.len() - 1;
    let old = bad.upload.photos[last].name.clone();
    bad.upload.photos[last].name = "panic.png".to_owned();
    let Some(segsplat::scene::UploadCameras::Transforms(json)) = &mut bad.upload.cameras else {
        panic!("the sample sends transforms")
    };
    *json = String::from_utf8(json.clone()).unwrap().replace(&old, "panic.png").into_bytes();
    bad.wait = Some(PATIENCE);
    let status = server.service.create_scene(bad).await.unwrap().status;
    assert_eq!(status.state, SceneState::Failed);
    assert_eq!(status.error.unwrap().code, "internal");
    assert_eq!(server.scene().await.state, SceneState::Done, "the worker lives on");
    assert!(server.service.ready().ready);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_queue_says_when_to_come_back() {
    let (server, maker) = held().await;
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
    maker.hold.store(false, Ordering::Release);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_acknowledged_is_made_after_a_restart() {
    let (server, maker) = held().await;
    let running = server.service.create_scene(request()).await.unwrap().status.id;
    let queued = server.service.create_scene(request()).await.unwrap().status.id;
    let server = server.restart().await;
    for id in [&running, &queued] {
        let state = server.service.get(id).await.unwrap().state;
        assert!(!state.is_final(), "{id} is {state:?}");
    }
    maker.hold.store(false, Ordering::Release);
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
    let (server, maker) = held().await;
    let id = server.service.create_scene(request()).await.unwrap().status.id;
    let mut events = std::pin::pin!(server.service.watch(&id).await.unwrap());
    while !matches!(events.next().await, Some(Event::Running { .. })) {}
    server.service.delete(&id).await.unwrap();
    let rest: Vec<Event> = events.collect().await;
    assert_eq!(rest.last(), Some(&Event::Cancelled));
    assert_eq!(server.service.get(&id).await.unwrap_err().code(), ErrorCode::SceneNotFound);
    assert_eq!(server.service.delete(&id).await.unwrap_err().code(), ErrorCode::SceneNotFound);
    let scenes = server.data_dir().join("scenes");
    assert_eq!(std::fs::read_dir(scenes).map_or(0, Iterator::count), 0, "nothing is kept of it");
    maker.hold.store(false, Ordering::Release);
    assert_eq!(server.scene().await.state, SceneState::Done);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_takes_too_long_fails_with_its_code() {
    let maker = Arc::new(WallMaker::default());
    maker.hold.store(true, Ordering::Release);
    let server = TestServer::with(|config, parts| {
        parts.maker = maker;
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
    assert_eq!(refused.code(), ErrorCode::InvalidRequest, "{refused}");
    server.service.delete(&first.status.id).await.unwrap();
    assert!(!server.service.create_scene(keyed()).await.unwrap().replayed);
}

#[tokio::test(flavor = "multi_thread")]
async fn views_come_camera_by_camera_and_tags_tell_pictures_apart() {
    let server = TestServer::start().await;
    let id = server.scene().await.id;
    let spec = ViewsSpec {
        cameras: vec![first_camera(); 3],
        kinds: vec![Kind::Depth, Kind::Color, Kind::Depth],
        options: ViewOptions::default(),
        picture: PictureOptions::default(),
        text: TextOptions::default(),
    };
    let views: Vec<_> = server.service.render_many(&id, &spec).await.unwrap().collect().await;
    let order: Vec<_> =
        views.iter().map(|v| v.as_ref().unwrap()).map(|v| (v.camera_index, v.kind)).collect();
    assert_eq!(order.len(), 6, "a kind named twice is drawn once");
    assert_eq!(order[..3], [(0, Kind::Depth), (0, Kind::Color), (1, Kind::Depth)]);

    let one = first_view();
    let tag = server.service.view_etag(&id, &one).await.unwrap();
    assert_eq!(server.service.render(&id, one.clone()).await.unwrap().etag, tag.clone().unwrap());
    let mut other = one.clone();
    other.picture.background = Background::Color([0.0, 0.0, 0.5]);
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
    let export = || server.service.export(&id, ExportFormat::Ply, &ASK);
    assert_eq!(export().await.unwrap_err().code(), ErrorCode::SceneCorrupt);
    let status = server.service.get(&id).await.unwrap();
    assert_eq!(
        (status.state, status.error.unwrap().code.as_str()),
        (SceneState::Failed, "scene_corrupt")
    );
    let server = server.restart().await;
    let again = server.service.export(&id, ExportFormat::Ply, &ASK).await.unwrap_err();
    assert_eq!(again.code(), ErrorCode::SceneCorrupt, "also after a restart");
    assert_eq!(server.scene().await.state, SceneState::Done);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_export_has_the_size_it_says() {
    let server = TestServer::start().await;
    let id = server.scene().await.id;
    let mut export = server.service.export(&id, ExportFormat::Ply, &ASK).await.unwrap();
    let (size, mut got) = (export.size_bytes, 0);
    while let Some(chunk) = export.next_chunk().await {
        got += chunk.len() as u64;
    }
    assert_eq!(got, size);
}
