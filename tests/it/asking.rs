//! Texts for a scene: when its semantics are made, how often, what watchers see meanwhile, and what
//! is refused.

use std::{
    pin::Pin,
    sync::{Arc, Mutex, atomic::Ordering},
    time::Duration,
};

use futures_util::{Stream, StreamExt, future::join_all, stream};
use segsplat::{
    api::grpc::pb,
    error::{Error, ErrorCode, Result},
    limits::Limits,
    photos,
    render::{Frame, RenderRequest, Renderer},
    sample::{self, SampleOptions},
    scene::{
        Event, Gaussians, SceneId, SceneOptions, SceneState, SceneStatus, SemanticsMode,
        SemanticsState, Stage, Upload,
    },
    service::{CreateScene, EditSpec, WatchUntil},
};
use serde_json::{Value, json};

use crate::common::{
    doors::{self, Door},
    meaning::PhotoMeaning,
    process::eventually,
    server::{
        PATIENCE, PointRenderer, TestServer, WallNetworks, first_view, panicking_upload, upload,
    },
};

/// A server with the stand-in for the semantic networks, and the stand-in.
async fn server() -> (TestServer, Arc<PhotoMeaning>) {
    let meaning = Arc::new(PhotoMeaning::default());
    let given = Arc::clone(&meaning);
    let server = TestServer::with(|_, parts| parts.semantics = given).await;
    (server, meaning)
}

async fn scene(server: &TestServer, semantics: SemanticsMode) -> SceneStatus {
    let options = SceneOptions { semantics, ..SceneOptions::default() };
    let request =
        CreateScene { upload: upload(), options, wait: Some(PATIENCE), ..CreateScene::default() };
    server.service.create_scene(request).await.expect("a good upload").status
}

async fn semantics_state(server: &TestServer, id: &SceneId) -> SemanticsState {
    server.service.get(id).await.unwrap().semantics.state
}

#[tokio::test(flavor = "multi_thread")]
async fn lazy_semantics_are_made_by_the_first_who_asks_and_once_however_many_ask() {
    let (server, meaning) = server().await;
    let status = scene(&server, SemanticsMode::Lazy).await;
    assert_eq!((status.state, status.semantics.state), (SceneState::Done, SemanticsState::None));
    assert!(status.semantics.available);
    assert_eq!(meaning.calls.load(Ordering::Acquire), 0, "nobody has asked");
    meaning.hold.store(true, Ordering::Release);
    let id = &status.id;
    let ask = || server.service.understand(id, Some(PATIENCE));
    let all = join_all((0..20).map(|_| ask()));
    let let_go = async {
        while semantics_state(&server, id).await != SemanticsState::Running {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
        meaning.hold.store(false, Ordering::Release);
    };
    let (answers, ()) = tokio::join!(all, let_go);
    for answer in answers {
        let semantics = answer.unwrap().semantics;
        assert_eq!((semantics.state, semantics.bank_size), (SemanticsState::Ready, Some(3)));
    }
    ask().await.unwrap();
    assert_eq!(meaning.calls.load(Ordering::Acquire), 1, "20 callers at once, and one later");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_scene_stays_done_while_its_semantics_run_and_watchers_see_their_stages() {
    let (server, meaning) = server().await;
    let id = scene(&server, SemanticsMode::Lazy).await.id;
    meaning.hold.store(true, Ordering::Release);
    let late = server.service.understand(&id, Some(Duration::ZERO)).await.unwrap_err();
    assert_eq!((late.code(), late.retry_after()), (ErrorCode::SceneNotReady, Some(2)));
    assert!(late.message().contains("are being made"), "{late}");
    let mut events = std::pin::pin!(server.service.watch(&id).await.unwrap());
    let masks = Event::Running {
        stage: "masks".to_owned(),
        fraction: Stage::Masks.overall(PhotoMeaning::HELD_AT),
    };
    let seen = tokio::time::timeout(PATIENCE, async {
        while events.next().await.expect("it is held") != masks {}
    });
    seen.await.expect("a watcher sees the share of the job, not of the stage");
    let status = server.service.get(&id).await.unwrap();
    assert_eq!((status.state, status.semantics.state), (SceneState::Done, SemanticsState::Running));
    assert_eq!(status.semantics.stage.as_deref(), Some("masks"));
    let view = server.service.view_etag(&id, &first_view()).await;
    assert!(view.is_ok(), "it can be viewed meanwhile");
    meaning.hold.store(false, Ordering::Release);
    let rest: Vec<Event> = events.collect().await;
    assert_eq!(rest.last(), Some(&Event::Done));
    let status = server.service.get(&id).await.unwrap();
    assert_eq!(status.semantics.state, SemanticsState::Ready);
    assert_eq!(status.semantics.report.unwrap().masks, [1, 1, 1]);
}

/// What a door tells of a scene until its semantics are there: `done`, or `STAGE FRACTION`.
async fn told(door: &mut Door, id: &SceneId) -> Pin<Box<dyn Stream<Item = String> + Send>> {
    told_until(door, id, WatchUntil { semantics: true, edits: false }).await.expect("a stream")
}

/// The same for as long as is asked, with `edited COUNT`; or the code of what is refused.
async fn told_until(
    door: &mut Door,
    id: &SceneId,
    WatchUntil { semantics, edits }: WatchUntil,
) -> std::result::Result<Pin<Box<dyn Stream<Item = String> + Send>>, String> {
    Ok(match door {
        Door::Http { base, client } => {
            let asked = format!("semantics={semantics}&edits={edits}");
            let events = client.get(format!("{base}/v1/scenes/{id}/events?{asked}"));
            let answer = events.send().await.unwrap();
            if !answer.status().is_success() {
                let fault: Value = answer.json().await.unwrap();
                return Err(fault["code"].as_str().unwrap().to_owned());
            }
            Box::pin(stream::unfold((answer, String::new()), async |(mut answer, mut text)| {
                loop {
                    while let Some((event, rest)) = text.split_once("\n\n") {
                        let data = event.lines().find_map(|line| line.strip_prefix("data: "));
                        let data: Option<Value> = data.map(|v| serde_json::from_str(v).unwrap());
                        text = rest.to_owned();
                        // Else it keeps the connection alive.
                        if let Some(data) = data {
                            return Some((told_by(&data), (answer, text)));
                        }
                    }
                    text += std::str::from_utf8(&answer.chunk().await.unwrap()?).unwrap();
                }
            }))
        }
        Door::Grpc { client } => {
            let request = pb::WatchSceneRequest { scene_id: id.to_string(), semantics, edits };
            let events = match client.watch_scene(request).await {
                Ok(events) => events.into_inner(),
                Err(status) => return Err(doors::fault_of(status).code),
            };
            Box::pin(events.map(|event| {
                let event = event.unwrap();
                match event.state() {
                    _ if event.edits.is_some() => format!("edited {}", event.edits()),
                    pb::SceneState::Cancelled => "cancelled".to_owned(),
                    pb::SceneState::Running => format!("{} {}", event.stage, event.fraction),
                    pb::SceneState::Done => "done".to_owned(),
                    other => other.as_str_name().to_owned(),
                }
            }))
        }
    })
}

fn told_by(data: &Value) -> String {
    let text = |name: &str| data[name].as_str().unwrap_or_default();
    match text("event") {
        "running" => {
            format!("{} {}", text("stage"), data["fraction"].as_f64().unwrap() as f32)
        }
        "edited" => format!("edited {}", data["edits"]),
        other => other.to_owned(),
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn events_that_wait_for_semantics_tell_every_stage_of_a_question_that_comes_later() {
    let (server, meaning) = server().await;
    for mut door in doors::both(server.addr).await {
        let id = scene(&server, SemanticsMode::Lazy).await.id;
        let mut events = told(&mut door, &id).await;
        let mut next = async || {
            let next = tokio::time::timeout(PATIENCE, events.next()).await;
            next.expect("something is told in time")
        };
        assert_eq!(next().await.as_deref(), Some("done"), "the scene, which nobody has asked");
        meaning.hold.store(true, Ordering::Release);
        server.service.understand(&id, Some(Duration::ZERO)).await.unwrap_err();
        let at = Stage::Masks.overall(PhotoMeaning::HELD_AT);
        let masks = format!("masks {at}");
        let mut told = next().await.expect("the question follows");
        while told != masks {
            assert!(told.starts_with("masks "), "{told}");
            told = next().await.expect("it is held");
        }
        meaning.hold.store(false, Ordering::Release);
        let mut rest = Vec::new();
        while let Some(told) = next().await {
            rest.push(told);
        }
        assert_eq!(rest.pop().as_deref(), Some("done"), "the semantics: {rest:?}");
        assert!(rest.iter().all(|told| told.starts_with("assign ")), "{rest:?}");
        assert_eq!(told_of(&mut door, &id).await, ["done"], "they are there");
        // Else the next scene of these photos is a copy of it.
        server.service.delete(&id).await.unwrap();
    }
    let off = scene(&server, SemanticsMode::Off).await.id;
    let [mut http, _] = doors::both(server.addr).await;
    assert_eq!(told_of(&mut http, &off).await, ["done"], "it will never have any");
    server.service.delete(&off).await.unwrap();
    // Those that fail are the end, too.
    *meaning.fails.lock().unwrap() = Some(ErrorCode::Internal);
    let id = scene(&server, SemanticsMode::Lazy).await.id;
    let mut events = told(&mut http, &id).await;
    assert_eq!(events.next().await.as_deref(), Some("done"));
    server.service.understand(&id, Some(PATIENCE)).await.unwrap_err();
    let all = tokio::time::timeout(PATIENCE, events.collect::<Vec<_>>()).await.unwrap();
    assert_eq!(all.last().map(String::as_str), Some("done"), "{all:?}");
}

/// An edit of so many Gaussians as are around the origin.
fn delete_within(radius: f64) -> EditSpec {
    let sphere = json!({ "center": [0, 0, 0], "radius": radius });
    serde_json::from_value(json!({ "op": "delete", "select": { "sphere": sphere } })).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn who_asks_for_edits_is_told_each_change_until_the_scene_goes() {
    let server = TestServer::with(|_, _| {}).await;
    let until = WatchUntil { semantics: false, edits: true };
    for mut door in doors::both(server.addr).await {
        let id = scene(&server, SemanticsMode::Off).await.id;
        let other = scene(&server, SemanticsMode::Off).await.id;
        let mut events = told_until(&mut door, &id, until).await.expect("a stream");
        let mut next = async || {
            let next = tokio::time::timeout(PATIENCE, events.next()).await;
            next.expect("something is told in time")
        };
        let edit = async |id: &SceneId, edits: &[EditSpec]| {
            server.service.set_edits(id, edits.to_vec(), None).await.map(drop).unwrap();
        };
        assert_eq!(next().await.as_deref(), Some("done"));
        assert_eq!(next().await.as_deref(), Some("edited 0"), "the list as it is");
        let [small, large] = [0.01, 0.02].map(delete_within);
        edit(&id, std::slice::from_ref(&small)).await;
        assert_eq!(next().await.as_deref(), Some("edited 1"));
        // The same list, and that of another scene, are nothing new.
        edit(&id, std::slice::from_ref(&small)).await;
        edit(&other, &[small.clone(), large.clone()]).await;
        edit(&id, &[large]).await;
        assert_eq!(next().await.as_deref(), Some("edited 1"), "another list of one");
        edit(&id, &[]).await;
        assert_eq!(next().await.as_deref(), Some("edited 0"));
        server.service.delete(&id).await.unwrap();
        assert_eq!(next().await.as_deref(), Some("cancelled"));
        assert_eq!(next().await, None);
        server.service.delete(&other).await.unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn so_many_are_told_edits_and_no_more_at_a_time() {
    let server = TestServer::with(|config, _| config.limits.watchers_max = 1).await;
    let id = scene(&server, SemanticsMode::Off).await.id;
    let until = WatchUntil { semantics: false, edits: true };
    let place = async |door: &Door| {
        let told = async || told_until(&mut door.clone(), &id, until).await.ok();
        eventually("a place", told).await
    };
    for mut door in doors::both(server.addr).await {
        let mut first = place(&door).await;
        assert_eq!(first.next().await.as_deref(), Some("done"));
        let refused = told_until(&mut door, &id, until).await.map(drop).unwrap_err();
        assert_eq!(refused, "overloaded");
        let plain = told_until(&mut door, &id, WatchUntil::default()).await.map(drop);
        plain.expect("who asks for no edits has a stream");
        drop(first);
        // Whoever left makes room.
        drop(place(&door).await);
    }
}

async fn told_of(door: &mut Door, id: &SceneId) -> Vec<String> {
    let events = told(door, id).await;
    tokio::time::timeout(PATIENCE, events.collect()).await.expect("it ends")
}

#[tokio::test(flavor = "multi_thread")]
async fn eager_semantics_come_with_the_scene_and_watchers_do_not_leave_before() {
    let (server, meaning) = server().await;
    meaning.hold.store(true, Ordering::Release);
    let options = SceneOptions { semantics: SemanticsMode::Eager, ..SceneOptions::default() };
    let request = CreateScene { upload: upload(), options, ..CreateScene::default() };
    let id = server.service.create_scene(request).await.unwrap().status.id;
    let mut events = std::pin::pin!(server.service.watch(&id).await.unwrap());
    loop {
        match events.next().await {
            Some(Event::Running { stage, .. }) if stage == "masks" => break,
            Some(Event::Done) | None => panic!("the end came before the semantics"),
            _ => {}
        }
    }
    assert_eq!(server.service.get(&id).await.unwrap().state, SceneState::Done, "it can be viewed");
    meaning.hold.store(false, Ordering::Release);
    let rest: Vec<Event> = events.collect().await;
    assert_eq!(rest.last(), Some(&Event::Done));
    let other = scene(&server, SemanticsMode::Eager).await;
    assert_eq!(other.semantics.state, SemanticsState::Ready, "who waits waits for both");
}

/// A server whose semantics begin early, with both stand-ins on hold.
async fn early_server() -> (TestServer, Arc<WallNetworks>, Arc<PhotoMeaning>) {
    let networks = Arc::new(WallNetworks { hold: true.into(), ..WallNetworks::default() });
    let meaning =
        Arc::new(PhotoMeaning { early: true, hold: true.into(), ..PhotoMeaning::default() });
    let given = (Arc::clone(&networks), Arc::clone(&meaning));
    let server = TestServer::with(|_, parts| (parts.scenes, parts.semantics) = given).await;
    (server, networks, meaning)
}

/// Creates a scene with eager semantics and waits until both of its jobs run.
async fn both_run(server: &TestServer, meaning: &PhotoMeaning, upload: Upload) -> SceneId {
    let options = SceneOptions { semantics: SemanticsMode::Eager, ..SceneOptions::default() };
    let request = CreateScene { upload, options, ..CreateScene::default() };
    let before = meaning.calls.load(Ordering::Acquire);
    let id = server.service.create_scene(request).await.unwrap().status.id;
    let shown = until(server, &id, |_| meaning.calls.load(Ordering::Acquire) > before).await;
    assert_eq!(shown.state, SceneState::Running);
    assert_eq!(shown.semantics.state, SemanticsState::Running);
    id
}

/// The status of a scene as soon as it `is` so.
async fn until(
    server: &TestServer,
    id: &SceneId,
    is: impl Fn(&SceneStatus) -> bool,
) -> SceneStatus {
    let looks = async {
        loop {
            let status = server.service.get(id).await.unwrap();
            if is(&status) {
                return status;
            }
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    };
    tokio::time::timeout(PATIENCE, looks).await.expect("it comes to that")
}

#[tokio::test(flavor = "multi_thread")]
async fn early_semantics_are_made_once_beside_the_scene_which_does_not_wait_for_them() {
    let (server, networks, meaning) = early_server().await;
    let id = both_run(&server, &meaning, upload()).await;
    networks.hold.store(false, Ordering::Release);
    let done = until(&server, &id, |status| status.state == SceneState::Done).await;
    assert_eq!(done.semantics.state, SemanticsState::Running);
    let view = server.service.view_etag(&id, &first_view()).await;
    assert!(view.is_ok(), "it can be viewed meanwhile");
    meaning.hold.store(false, Ordering::Release);
    let ready = until(&server, &id, |s| s.semantics.state == SemanticsState::Ready).await;
    assert_eq!(ready.semantics.bank_size, Some(3));
    assert_eq!(meaning.calls.load(Ordering::Acquire), 1);
    let copy = scene(&server, SemanticsMode::Eager).await;
    assert_eq!(copy.semantics.state, SemanticsState::Ready, "of the same content");
    // The other way round: the scene is made last.
    networks.hold.store(true, Ordering::Release);
    let other = sample::upload(&SampleOptions { photos: 3, width: 64, height: 48, seed: 6 });
    let before = meaning.calls.load(Ordering::Acquire);
    let id = both_run(&server, &meaning, other.unwrap()).await;
    networks.hold.store(false, Ordering::Release);
    until(&server, &id, |s| s.semantics.state == SemanticsState::Ready).await;
    assert_eq!(meaning.calls.load(Ordering::Acquire), before + 1);
    let server = server.restart().await;
    assert_eq!(semantics_state(&server, &id).await, SemanticsState::Ready, "it is kept");
}

#[tokio::test(flavor = "multi_thread")]
async fn early_semantics_of_a_scene_that_fails_or_is_deleted_end_with_it() {
    let (server, networks, meaning) = early_server().await;
    let id = both_run(&server, &meaning, panicking_upload()).await;
    networks.hold.store(false, Ordering::Release);
    until(&server, &id, |status| status.state == SceneState::Failed).await;
    // They are stopped where they are.
    let failed = until(&server, &id, |s| s.semantics.state == SemanticsState::None).await;
    assert_eq!(failed.error.unwrap().code, "internal");
    assert!(failed.semantics.error.is_none(), "they did not fail: {:?}", failed.semantics);
    networks.hold.store(true, Ordering::Release);
    let id = both_run(&server, &meaning, upload()).await;
    server.service.delete(&id).await.unwrap();
    networks.hold.store(false, Ordering::Release);
    meaning.hold.store(false, Ordering::Release);
    let next = scene(&server, SemanticsMode::Eager).await;
    assert_eq!(next.semantics.state, SemanticsState::Ready, "both workers are free");
}

/// Draws as [`PointRenderer`]; scenes are put there as `how` says.
struct Placing {
    how: fn() -> Result<()>,
    /// Gaussians of the scenes that were to be put there.
    put: Mutex<Vec<usize>>,
}

impl Renderer for Placing {
    fn name(&self) -> String {
        PointRenderer.name()
    }

    fn concurrency(&self) -> usize {
        PointRenderer.concurrency()
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        PointRenderer.render(gaussians, request)
    }

    fn prepare(&self, gaussians: &Gaussians) -> Result<()> {
        self.put.lock().unwrap().push(gaussians.len());
        (self.how)()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_new_scene_is_put_where_it_is_drawn_and_is_whole_where_that_fails() {
    let full = || Err(Error::limit("bytes of Gaussians", 2, 1));
    let how: [fn() -> Result<()>; 3] = [|| Ok(()), full, || panic!("on purpose")];
    for how in how {
        let meaning =
            Arc::new(PhotoMeaning { early: true, hold: true.into(), ..PhotoMeaning::default() });
        let renderer = Arc::new(Placing { how, put: Mutex::default() });
        let given = (Arc::clone(&meaning), Arc::clone(&renderer));
        let server = TestServer::with(|_, parts| (parts.semantics, parts.renderer) = given).await;
        let options = SceneOptions { semantics: SemanticsMode::Eager, ..SceneOptions::default() };
        let request = CreateScene { upload: upload(), options, ..CreateScene::default() };
        let id = server.service.create_scene(request).await.unwrap().status.id;
        let put = || renderer.put.lock().unwrap().clone();
        let over = || !put().is_empty() && server.service.ready().jobs_running == 0;
        let done = until(&server, &id, |_| over()).await;
        assert_eq!((done.state, done.semantics.state), (SceneState::Done, SemanticsState::Running));
        meaning.hold.store(false, Ordering::Release);
        let ready = until(&server, &id, |s| s.semantics.state != SemanticsState::Running).await;
        assert_eq!((ready.state, ready.semantics.state), (SceneState::Done, SemanticsState::Ready));
        assert_eq!(put(), [ready.report.unwrap().gaussians as usize], "once");
        assert!(server.service.render(&id, first_view()).await.is_ok());
        let server = server.restart().await;
        let kept = server.service.get(&id).await.unwrap();
        assert_eq!((kept.state, kept.semantics.state), (SceneState::Done, SemanticsState::Ready));
        assert_eq!(put().len(), 1, "not what a start finds");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn early_semantics_that_fail_leave_the_scene_and_the_next_text_tries_again() {
    let (server, networks, meaning) = early_server().await;
    *meaning.fails.lock().unwrap() = Some(ErrorCode::LimitExceeded);
    let id = both_run(&server, &meaning, upload()).await;
    meaning.hold.store(false, Ordering::Release);
    until(&server, &id, |s| s.semantics.state == SemanticsState::Failed).await;
    networks.hold.store(false, Ordering::Release);
    let done = until(&server, &id, |status| status.state == SceneState::Done).await;
    assert_eq!(done.semantics.state, SemanticsState::Failed);
    assert_eq!(done.semantics.error.unwrap().code, "limit_exceeded");
    *meaning.fails.lock().unwrap() = None;
    let status = server.service.understand(&id, Some(PATIENCE)).await.unwrap();
    assert_eq!(status.semantics.state, SemanticsState::Ready);
    assert_eq!(meaning.calls.load(Ordering::Acquire), 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn off_and_a_bundle_without_networks_are_refused_each_with_its_code() {
    let (server, meaning) = server().await;
    let off = scene(&server, SemanticsMode::Off).await;
    assert_eq!((off.semantics.state, off.semantics.available), (SemanticsState::Off, false));
    let error = server.service.understand(&off.id, None).await.unwrap_err();
    assert_eq!(error.code(), ErrorCode::SemanticsOff);
    assert!(error.message().contains("semantics=off"), "{error}");
    assert_eq!(meaning.calls.load(Ordering::Acquire), 0);

    let lacking = PhotoMeaning { lack: Some("no text tower"), ..PhotoMeaning::default() };
    let server = TestServer::with(|_, parts| parts.semantics = Arc::new(lacking)).await;
    let lazy = scene(&server, SemanticsMode::Lazy).await;
    assert!(!lazy.semantics.available);
    assert!(lazy.semantics.reason.unwrap().contains("no text tower"));
    let error = server.service.understand(&lazy.id, None).await.unwrap_err();
    assert_eq!(error.code(), ErrorCode::ModelUnavailable);
    let options = SceneOptions { semantics: SemanticsMode::Eager, ..SceneOptions::default() };
    let request = CreateScene { upload: upload(), options, ..CreateScene::default() };
    let error = server.service.create_scene(request).await.unwrap_err();
    assert_eq!(error.code(), ErrorCode::ModelUnavailable, "eager is refused at the door");
}

#[tokio::test(flavor = "multi_thread")]
async fn semantics_that_fail_say_why_and_the_next_text_tries_again() {
    let (server, meaning) = server().await;
    let id = scene(&server, SemanticsMode::Lazy).await.id;
    *meaning.fails.lock().unwrap() = Some(ErrorCode::LimitExceeded);
    let error = server.service.understand(&id, None).await.unwrap_err();
    assert_eq!(error.code(), ErrorCode::LimitExceeded);
    let status = server.service.get(&id).await.unwrap();
    assert_eq!((status.state, status.semantics.state), (SceneState::Done, SemanticsState::Failed));
    assert_eq!(status.semantics.error.unwrap().code, "limit_exceeded");
    *meaning.fails.lock().unwrap() = None;
    let status = server.service.understand(&id, None).await.unwrap();
    assert_eq!(status.semantics.state, SemanticsState::Ready);
    assert_eq!(meaning.calls.load(Ordering::Acquire), 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn semantics_are_kept_over_a_restart_and_made_again_when_their_file_is_bad() {
    let (server, meaning) = server().await;
    let id = scene(&server, SemanticsMode::Lazy).await.id;
    server.service.understand(&id, None).await.unwrap();
    let server = server.restart().await;
    assert_eq!(semantics_state(&server, &id).await, SemanticsState::Ready);
    server.service.understand(&id, None).await.unwrap();
    assert_eq!(meaning.calls.load(Ordering::Acquire), 1, "read from their file");
    let server = server.restart().await;
    let folder = server.data_dir().join("scenes").join(id.as_str());
    let mut file = std::fs::read(folder.join("semantics.segsplat")).unwrap();
    let middle = file.len() / 2;
    file[middle] ^= 1;
    std::fs::write(folder.join("semantics.segsplat"), file).unwrap();
    let status = server.service.understand(&id, None).await.unwrap();
    assert_eq!(status.semantics.state, SemanticsState::Ready);
    assert_eq!(meaning.calls.load(Ordering::Acquire), 2, "made again");
    assert!(folder.join("semantics.quarantined").exists(), "the bad file is put aside");
    assert!(folder.join("semantics.segsplat").exists(), "the new one is kept");
    // What a bad status said is found again in the files.
    let server = server.restart().await;
    std::fs::write(folder.join("status.json"), b"rubbish").unwrap();
    let server = server.restart().await;
    server.service.understand(&id, None).await.unwrap();
    assert_eq!(meaning.calls.load(Ordering::Acquire), 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn deleting_a_scene_stops_its_semantics_and_tells_who_waits() {
    let (server, meaning) = server().await;
    let id = scene(&server, SemanticsMode::Lazy).await.id;
    meaning.hold.store(true, Ordering::Release);
    let waits = server.service.understand(&id, Some(PATIENCE));
    let deletes = async {
        while semantics_state(&server, &id).await != SemanticsState::Running {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
        server.service.delete(&id).await.unwrap();
    };
    let (told, ()) = tokio::join!(waits, deletes);
    assert_eq!(told.unwrap_err().code(), ErrorCode::SceneNotFound);
    meaning.hold.store(false, Ordering::Release);
    let other = scene(&server, SemanticsMode::Eager).await;
    assert_eq!(other.semantics.state, SemanticsState::Ready, "the next scene has its turn");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_first_text_takes_the_photos_from_memory_or_reads_the_same_ones() {
    for (kept_ms, kept) in [(PATIENCE.as_millis() as u64, true), (0, false)] {
        let meaning = Arc::new(PhotoMeaning::default());
        let given = Arc::clone(&meaning);
        let server = TestServer::with(|config, parts| {
            parts.semantics = given;
            config.limits.first_text_photos_ms = kept_ms;
        })
        .await;
        let [first, second] = [
            scene(&server, SemanticsMode::Lazy).await.id,
            scene(&server, SemanticsMode::Lazy).await.id,
        ];
        server.service.understand(&first, Some(PATIENCE)).await.expect("semantics");
        let photos = photos::read(&upload(), &Limits::default()).unwrap();
        let pixels: Vec<u8> = photos.into_iter().flat_map(|posed| posed.photo.rgb).collect();
        assert_eq!(*meaning.pixels.lock().unwrap(), pixels, "kept: {kept}");
        let folder = server.data_dir().join("scenes").join(second.as_str());
        std::fs::remove_file(folder.join("upload.segsplat")).unwrap();
        let answer = server.service.understand(&second, Some(PATIENCE)).await;
        assert_eq!(answer.is_ok(), kept, "without the store: {:?}", answer.err());
    }
}
