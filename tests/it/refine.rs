//! Refinement as a job: the scene is served meanwhile, better versions take its place whole, and it
//! ends with its scene.

use std::{
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::Duration,
};

use futures_util::StreamExt;
use segsplat::{
    config::Config,
    error::{ErrorCode, Result},
    jobs::{PipelineNetworks, SceneNetworks},
    pipeline::{PhotoSet, Pipeline, Reconstruction, Seen, make_for_refinement, make_keeping},
    sample::{self, SampleOptions},
    scene::{
        Event, Gaussians, Refine, RefineState, SceneId, SceneOptions, SceneState, SceneStatus,
        SemanticsMode, Upload, Watch,
    },
    service::{CreateScene, QuerySpec},
};

use crate::common::{
    doors::bytes,
    meaning::PhotoMeaning,
    opened,
    process::eventually,
    server::{PATIENCE, TestServer, WallNetworks, first_view},
};

/// The stand-in, whose pictures are the photos themselves: Gaussians know their pixels.
#[derive(Debug, Default)]
pub(crate) struct LensedNetworks(pub(crate) WallNetworks);

impl SceneNetworks for LensedNetworks {
    fn identity(&self) -> String {
        self.0.identity()
    }

    fn make(
        &self,
        photos: &PhotoSet,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<Reconstruction> {
        let mut made = self.0.make(photos, options, watch)?;
        for camera in &mut made.cameras {
            camera.network = Some(camera.camera.intrinsics);
        }
        Ok(made)
    }
}

/// So long that steps end it, or a test does.
const LONG: Refine = Refine::Ms(600_000);

pub(crate) fn upload() -> Upload {
    let options = SampleOptions { photos: 6, width: 64, height: 48, seed: 5 };
    sample::upload(&options).expect("the options are in range")
}

/// A server whose refinements take at most so many steps, and its networks.
async fn server(steps: u32) -> (TestServer, Arc<LensedNetworks>) {
    let networks = Arc::new(LensedNetworks::default());
    let given = Arc::clone(&networks);
    let server = TestServer::with(|config, parts| {
        parts.scenes = given;
        parts.semantics = Arc::new(PhotoMeaning::default());
        config.limits.refine_steps_max = steps;
    });
    (server.await, networks)
}

async fn scene(server: &TestServer, options: SceneOptions) -> SceneStatus {
    let wait = Some(PATIENCE);
    let request = CreateScene { upload: upload(), options, wait, ..CreateScene::default() };
    server.service.create_scene(request).await.expect("a good upload").status
}

async fn until(
    server: &TestServer,
    id: &SceneId,
    is: impl Fn(&SceneStatus) -> bool,
) -> SceneStatus {
    eventually("the refinement", async || Some(server.service.get(id).await.unwrap()).filter(&is))
        .await
}

async fn texts(server: &TestServer, id: &SceneId) -> u64 {
    let spec = QuerySpec {
        texts: vec!["photo 0".to_owned()],
        wait: Some(PATIENCE),
        ..QuerySpec::default()
    };
    server.service.query(id, spec).await.expect("texts are answered").results[0].gaussians
}

/// The stages with a stand-in for the geometry network.
fn engine() -> Option<Pipeline> {
    let mut config = Config::default();
    config.bundle = Some(Path::new("tests/fixtures/plane").to_owned());
    config.threads = 2;
    opened(Pipeline::open(&config.networks()))
}

/// Longer than it takes until photos that no job needs go from memory, where they stay no time.
const SLOW: Duration = Duration::from_millis(1_500);

/// The networks of a bundle, which are slow, and how often they ran.
struct Counted(PipelineNetworks, AtomicUsize);

impl SceneNetworks for Counted {
    fn make(
        &self,
        photos: &PhotoSet,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<Reconstruction> {
        self.1.fetch_add(1, Ordering::AcqRel);
        SceneNetworks::make(&self.0, photos, options, watch)
    }

    fn make_keeping(
        &self,
        photos: &PhotoSet,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<(Reconstruction, Option<Seen>)> {
        self.1.fetch_add(1, Ordering::AcqRel);
        std::thread::sleep(SLOW);
        self.0.make_keeping(photos, options, watch)
    }

    fn make_for_refinement(
        &self,
        photos: &PhotoSet,
        held: &[usize],
        seen: Option<&Seen>,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<(Reconstruction, Gaussians)> {
        self.0.make_for_refinement(photos, held, seen, options, watch)
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_networks_run_once_for_a_scene_and_its_refinement_and_again_after_a_restart() {
    let Some(engine) = engine() else { return };
    let loader = PipelineNetworks(Arc::new(engine.into()));
    let networks = Arc::new(Counted(loader, AtomicUsize::new(0)));
    let given = Arc::clone(&networks);
    let server = TestServer::with(|config, parts| {
        parts.scenes = given;
        config.limits.refine_steps_max = 8;
        config.limits.first_text_photos_ms = 0;
    });
    let server = server.await;
    let refined = async |server: &TestServer, id: &SceneId| {
        let over = until(server, id, |status| !status.is_refined_now()).await;
        assert_eq!(over.refinement.state, RefineState::Done, "{over:?}");
    };
    for semantics in [SemanticsMode::Lazy, SemanticsMode::Off] {
        let before = networks.1.load(Ordering::Acquire);
        let options = SceneOptions { refine: Some(LONG), semantics, ..SceneOptions::default() };
        // Another content each time: a known one is copied.
        let options = match semantics {
            SemanticsMode::Off => SceneOptions { max_views: Some(2), ..options },
            _ => options,
        };
        let made = scene(&server, options).await;
        refined(&server, &made.id).await;
        assert_eq!(networks.1.load(Ordering::Acquire) - before, 1, "{semantics:?}");
    }
    let made = scene(&server, SceneOptions { votes: Some(false), ..Default::default() }).await;
    let server = server.restart().await;
    let before = networks.1.load(Ordering::Acquire);
    server.service.refine(&made.id, LONG).await.unwrap();
    refined(&server, &made.id).await;
    assert_eq!(networks.1.load(Ordering::Acquire) - before, 1, "what they said is gone");
}

#[tokio::test(flavor = "multi_thread")]
async fn photos_that_the_networks_do_not_see_are_learnt_also_after_a_restart() {
    let networks = Arc::new(LensedNetworks::default());
    let server = TestServer::with(|config, parts| {
        parts.scenes = networks;
        config.limits.refine_steps_max = 8;
        config.limits.network_photos_max = 4;
    });
    let mut server = server.await;
    let made = scene(&server, SceneOptions { refine: Some(LONG), ..Default::default() }).await;
    assert_eq!(made.cameras.len(), 4);
    let mut version = 0;
    for _ in 0..2 {
        let over =
            until(&server, &made.id, |status| !status.is_refined_now() && status.version > version);
        let over = over.await;
        assert_eq!(over.refinement.state, RefineState::Done, "{over:?}");
        let report = over.report.expect("a report");
        let refined = report.refinement.expect("a refinement");
        assert_eq!((refined.more_photos, refined.left_out.len()), (2, 0), "{refined:?}");
        assert_eq!(over.cameras.len(), 4, "a scene's cameras stay those of its Gaussians");
        version = over.version;
        server = server.restart().await;
        server.service.refine(&made.id, LONG).await.unwrap();
    }
}

#[test]
fn what_the_network_said_is_united_again_without_some_photos() {
    let Some(engine) = engine() else { return };
    let options = SampleOptions { photos: 6, width: 64, height: 48, seed: 5 };
    let photos = sample::photos(&options).expect("the options are in range");
    let set = PhotoSet::given(photos.clone(), Vec::new(), 0.0);
    let stop = AtomicBool::new(false);
    let watch = Watch { progress: &|_, _| (), cancel: &stop };
    let (made, seen) = make_keeping(&engine, &set, &SceneOptions::default(), watch).expect("made");
    assert!(seen.size_bytes() > 60 * made.report.gaussians, "{} bytes", seen.size_bytes());
    let again =
        |held: &[usize]| make_for_refinement(&engine, &photos, held, &seen, watch).expect("united");
    let (all, one_set) = again(&[]);
    let numbers = [&all, &made].map(|it| (it.gaussians.means(), it.gaussians.scales()));
    assert!(numbers[0] == numbers[1] && all.backdrop == made.backdrop, "the same scene");
    assert!(one_set.means() != all.gaussians.means(), "one set is made in another way");
    let (without, one_set) = again(&[1, 4]);
    let files: Vec<&str> = without.cameras.iter().map(|camera| &*camera.file).collect();
    let kept = [0, 2, 3, 5].map(|i: usize| &*photos[i].file);
    assert_eq!(files, kept);
    assert!(without.cameras.iter().all(|camera| camera.network.is_some()), "all have Gaussians");
    for gaussians in [&without.gaussians, &one_set] {
        let views: Vec<u16> = gaussians.source().iter().map(|pixel| pixel.view).collect();
        assert!((0..4).all(|view| views.contains(&view)) && !views.contains(&4), "their numbers");
        assert!(gaussians.len() < all.gaussians.len());
    }
    assert!(without.backdrop != all.backdrop, "nor their colours behind");
}

#[tokio::test(flavor = "multi_thread")]
async fn views_without_end_do_not_stop_a_refinement() {
    let (server, _) = server(6).await;
    let id = scene(&server, SceneOptions::default()).await.id;
    server.service.refine(&id, LONG).await.unwrap();
    // Far more often than a refinement waits for views to end, and no load beside it.
    let looks = async {
        loop {
            server.service.render(&id, first_view()).await.expect("a view");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    let done = until(&server, &id, |status| status.refinement.state == RefineState::Done);
    tokio::select! {
        () = looks => {}
        status = done => assert!(status.refinement.error.is_none(), "{status:?}"),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn better_versions_take_the_place_of_a_scene_and_its_watchers_are_told() {
    let (server, networks) = server(60).await;
    let service = &server.service;
    let made = scene(&server, SceneOptions::default()).await;
    assert_eq!((made.version, made.refinement.state), (1, RefineState::None), "nobody asked");
    let first = service.render(&made.id, first_view()).await.unwrap();
    networks.0.hold.store(true, Ordering::Release);
    let taken = service.refine(&made.id, LONG).await.unwrap();
    assert_eq!((taken.state, taken.refinement.state), (SceneState::Done, RefineState::Running));
    let events = service.watch(&made.id).await.unwrap();
    networks.0.hold.store(false, Ordering::Release);
    let events: Vec<Event> = events.collect().await;
    let done = service.get(&made.id).await.unwrap();
    let versions: Vec<u32> = events[1..]
        .iter()
        .map(|event| match event {
            Event::Version { version, .. } => *version,
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(events[0], Event::Done, "it is done all the time");
    assert!(versions.is_sorted() && versions.last() == Some(&done.version), "{versions:?}");
    assert!(done.version > 1 && done.refinement.state == RefineState::Done, "{done:?}");
    let report = done.report.unwrap();
    let refined = report.refinement.expect("a report");
    assert!(refined.psnr_after > refined.psnr_before && refined.steps > 0, "{refined:?}");
    assert_eq!((refined.held_out, refined.gaussians_after), (vec![3], report.gaussians));
    assert_eq!((report.method.front_photos, report.method.magnify), (0, false), "one set");
    let now = service.render(&made.id, first_view()).await.unwrap();
    assert!(now.etag != first.etag && now.bytes != first.bytes, "another picture, another tag");
    assert_eq!(service.view_etag(&made.id, &first_view()).await.unwrap(), Some(now.etag.clone()));
    let url = server.url(&format!("/v1/scenes/{}/export", made.id));
    let sent = crate::common::client().get(url).send().await.unwrap();
    let ply = bytes(sent).await.unwrap();
    let head = String::from_utf8_lossy(&ply[..200]).into_owned();
    assert!(head.contains(&format!("element vertex {}\n", report.gaussians)), "{head}");
    let id = made.id.clone();
    let server = server.restart().await;
    let again = server.service.render(&id, first_view()).await.unwrap();
    assert!(again.bytes == now.bytes, "the last version is kept");
    let kept = server.service.view_etag(&id, &first_view()).await.unwrap();
    assert_eq!(kept, Some(again.etag), "the record and the scene are of one version");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_refinement_goes_on_after_a_restart_until_it_is_ended_and_a_version_stays() {
    let (server, networks) = server(60).await;
    let made = scene(&server, SceneOptions::default()).await;
    networks.0.hold.store(true, Ordering::Release);
    server.service.refine(&made.id, LONG).await.unwrap();
    let server = server.restart().await;
    let found = server.service.get(&made.id).await.unwrap();
    assert!(found.version == 1 && found.is_refined_now(), "{found:?}");
    server.service.render(&made.id, first_view()).await.unwrap();
    let ended = server.service.refine(&made.id, Refine::Off).await.unwrap();
    assert_eq!(ended.refinement.state, RefineState::None, "it was not refined");
    let server = server.restart().await;
    assert!(!server.service.get(&made.id).await.unwrap().is_refined_now(), "it stays ended");
    networks.0.hold.store(false, Ordering::Release);
    server.service.refine(&made.id, LONG).await.unwrap();
    let better = until(&server, &made.id, |status| !status.is_refined_now()).await;
    assert_eq!((better.version, better.refinement.state), (2, RefineState::Done));
    // Another refinement takes its place only where it is better on the held-out photos.
    server.service.refine(&made.id, LONG).await.unwrap();
    let again = until(&server, &made.id, |status| !status.is_refined_now()).await;
    let psnr = |status: &SceneStatus| {
        status.report.as_ref().and_then(|report| report.refinement.as_ref()?.psnr_after)
    };
    assert_eq!(again.version > 2, psnr(&again) > psnr(&better), "{again:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_is_deleted_while_it_is_refined_is_gone() {
    let (server, networks) = server(20_000).await;
    let made = scene(&server, SceneOptions::default()).await;
    networks.0.hold.store(true, Ordering::Release);
    let calls = networks.0.calls.load(Ordering::Acquire);
    server.service.refine(&made.id, LONG).await.unwrap();
    eventually("its start", async || {
        (networks.0.calls.load(Ordering::Acquire) > calls).then_some(())
    })
    .await;
    server.service.delete(&made.id).await.unwrap();
    let told = server.service.get(&made.id).await.unwrap_err();
    assert_eq!(told.code(), ErrorCode::SceneNotFound);
    // The same again, in the middle of the steps.
    networks.0.hold.store(false, Ordering::Release);
    let options = SceneOptions { refine: Some(LONG), ..SceneOptions::default() };
    let second = scene(&server, options).await;
    until(&server, &second.id, |status| status.refinement.fraction > 0.0).await;
    server.service.delete(&second.id).await.unwrap();
    let folder = server.data_dir().join("scenes");
    eventually("the files", async || {
        let left = std::fs::read_dir(&folder).into_iter().flatten().flatten();
        let files = left.filter_map(|scene| std::fs::read_dir(scene.path()).ok()).flatten();
        (files.count() == 0).then_some(())
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn texts_are_answered_before_while_and_after_a_scene_is_refined() {
    let (server, networks) = server(60).await;
    let options = SceneOptions { semantics: SemanticsMode::Eager, ..SceneOptions::default() };
    let id = scene(&server, options).await.id;
    let before = texts(&server, &id).await;
    networks.0.hold.store(true, Ordering::Release);
    server.service.refine(&id, LONG).await.unwrap();
    assert_eq!(texts(&server, &id).await, before, "while it waits");
    networks.0.hold.store(false, Ordering::Release);
    let done = until(&server, &id, |status| !status.is_refined_now()).await;
    let all = done.report.unwrap().gaussians;
    let after = texts(&server, &id).await;
    assert!(done.version > 1 && 0 < after && after < all, "{after} of {all}, {before} before");
    // The entries of the refined Gaussians are in the scene's own file.
    let server = server.restart().await;
    assert_eq!(texts(&server, &id).await, after, "after a restart");
    let later =
        scene(&server, SceneOptions { max_views: Some(2), ..SceneOptions::default() }).await;
    server.service.refine(&later.id, LONG).await.unwrap();
    until(&server, &later.id, |status| !status.is_refined_now()).await;
    assert!(texts(&server, &later.id).await > 0, "semantics of refined Gaussians");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_refined_is_refused_with_its_bound() {
    let server = TestServer::with(|config, _| config.keep_photos = false).await;
    let id = server.scene().await.id;
    let client = crate::common::client();
    for (value, want) in [
        ("0", "refine is 0 ms; it must be 1 to 600000"),
        ("600001", "refine is 600001 ms; it must be 1 to 600000"),
        ("on", "refine is \"on\"; it must be auto, off or a whole number of milliseconds"),
        ("500", "refine: this server does not keep the photos of finished scenes (keep_photos)"),
    ] {
        let url = server.url(&format!("/v1/scenes/{id}/refine?refine={value}"));
        let told = bytes(client.post(url).send().await.unwrap()).await.unwrap_err();
        assert_eq!(told.message, want);
    }
    let options = SceneOptions { refine: Some(Refine::Ms(600_001)), ..SceneOptions::default() };
    let request = CreateScene { upload: upload(), options, ..CreateScene::default() };
    let told = server.service.create_scene(request).await.unwrap_err();
    assert!(told.message().ends_with("it must be 1 to 600000"), "{told}");
    let absent = SceneId::from_bytes([7; 16]);
    let told = server.service.refine(&absent, Refine::Auto).await.unwrap_err();
    assert_eq!(told.code(), ErrorCode::SceneNotFound);
}
