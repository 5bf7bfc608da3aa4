//! A store that fails, tears writes, stalls, fills up and flips bits: an acknowledged scene stays
//! as it was, or is reported as bad.

use std::{
    collections::{BTreeMap, HashSet},
    ops::Range,
    path::Path,
    sync::{Arc, atomic::Ordering},
    time::{Duration, Instant},
};

use futures_util::StreamExt;
use object_store::{ObjectStore, local::LocalFileSystem, memory::InMemory};
use segsplat::{
    error::ErrorCode,
    sample::{self, SampleOptions},
    scene::{Refine, RefineState, SceneId, SceneOptions, SceneState, SemanticsMode, Upload},
    service::{CreateScene, ExportFormat, PageRequest, QuerySpec, Service, TextOptions},
    store::StoreLocation,
};

use crate::common::{
    doors::form,
    faults::{FaultStore, Wrong},
    meaning::PhotoMeaning,
    process::{eventually, long},
    server::{PATIENCE, TestServer, WallNetworks},
};

/// No text.
fn ask() -> TextOptions {
    TextOptions::default()
}

/// Reproducible numbers.
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % n
    }
}

fn upload(seed: u64) -> Upload {
    let options = SampleOptions { photos: 2, width: 48, height: 32, seed };
    sample::upload(&options).expect("in range")
}

fn request(seed: u64) -> CreateScene {
    CreateScene { upload: upload(seed), wait: Some(PATIENCE), ..CreateScene::default() }
}

async fn export(service: &Service, id: &SceneId) -> Result<Vec<u8>, ErrorCode> {
    let export = service.export(id, ExportFormat::Ply, None, &ask()).await;
    let body = export.map_err(|error| error.code())?.begin().await;
    Ok(body.map_err(|error| error.code())?.into_stream().map(Result::unwrap).concat().await)
}

/// The same of a store that works: a loaded machine may be late, so it is asked again.
async fn found(service: &Service, id: &SceneId) -> Result<Vec<u8>, ErrorCode> {
    let begun = Instant::now();
    loop {
        match export(service, id).await {
            Err(ErrorCode::StoreUnavailable) if begun.elapsed() < PATIENCE => {}
            answer => return answer,
        }
    }
}

/// Ids of all scenes that the server lists.
async fn listed(service: &Service) -> HashSet<SceneId> {
    let (mut ids, mut page) = (HashSet::new(), PageRequest::default());
    loop {
        let found = service.list(&page).await.unwrap();
        ids.extend(found.scenes.into_iter().map(|scene| scene.id));
        match found.next {
            Some(next) => page.after = Some(next),
            None => return ids,
        }
    }
}

/// Ids of the scenes to which names and pointers under a folder belong. A pointer that cannot be
/// read belongs to none and is listed under its own name.
fn kept(data: &Path) -> HashSet<String> {
    let files = |prefix: &str| std::fs::read_dir(data.join(prefix)).into_iter().flatten();
    let name = |file: std::fs::DirEntry| file.file_name().to_string_lossy().into_owned();
    let mut ids = HashSet::new();
    for file in ["scenes", "pending"].into_iter().flat_map(files) {
        ids.extend(name(file.unwrap()).parse().map(|id: SceneId| id.to_string()));
    }
    for file in files("contents") {
        let file = file.unwrap();
        // The sweep may remove it meanwhile.
        let Ok(bytes) = std::fs::read(file.path()) else { continue };
        let json: serde_json::Value = serde_json::from_slice(&bytes).unwrap_or_default();
        ids.insert(json["id"].as_str().map_or_else(|| name(file), str::to_owned));
    }
    ids
}

/// Stores that are called beside each other in the test below: most of their time is waiting.
const STORES: u64 = 4;

#[tokio::test(flavor = "multi_thread")]
async fn a_store_that_fails_tears_and_stalls_loses_nothing_it_acknowledged() {
    let steps = if long() { 3_000 } else { 120 } / STORES;
    let stores = (0..STORES).map(|i| a_bad_store(i * steps..(i + 1) * steps));
    futures_util::future::join_all(stores).await;
}

/// So many calls of a server to a store that fails, each with faults of its own.
async fn a_bad_store(steps: Range<u64>) {
    let folder = tempfile::tempdir().unwrap();
    let local = LocalFileSystem::new_with_prefix(folder.path()).unwrap();
    let local: Arc<dyn ObjectStore> = Arc::new(local.with_automatic_cleanup(true));
    let faults = Arc::new(FaultStore::new(local, Duration::from_millis(700)));
    let place = StoreLocation::Own(Arc::clone(&faults) as Arc<dyn ObjectStore>);
    let mut server = TestServer::at(&place, |config, _| {
        config.limits.store_timeout_ms = 500;
        config.limits.cache_bytes_max = 100_000;
    })
    .await;

    let mut random = Random(5 + steps.start);
    let mut whole: BTreeMap<SceneId, Vec<u8>> = BTreeMap::new();
    let (mut gone, mut doomed) = (HashSet::new(), HashSet::new());
    let mut refused = 0;
    for step in steps.clone() {
        let mut dice = Random(step);
        faults.plan(move |what, _| match (dice.below(100), what) {
            (0..=5, _) => Some(Wrong::Fails),
            (6..=8, _) => Some(Wrong::Lost),
            (9..=11, "put") => Some(Wrong::Tears),
            (12, _) => Some(Wrong::Stalls),
            _ => None,
        });
        let ids: Vec<SceneId> = whole.keys().cloned().collect();
        match (random.below(10), ids.get(random.below(ids.len().max(1)))) {
            (0..=4, _) | (_, None) => match server.service.create_scene(request(step)).await {
                Ok(created) if created.status.state == SceneState::Done => {
                    let id = created.status.id;
                    faults.plan(|_, _| None);
                    let file = found(&server.service, &id).await.expect("it was made");
                    whole.insert(id, file);
                }
                Ok(created) => {
                    let code = created.status.error.expect("why it failed").code;
                    assert!(["store_unavailable", "scene_corrupt"].contains(&&*code), "{code}");
                    refused += 1;
                }
                Err(error) => {
                    assert_eq!(error.code(), ErrorCode::StoreUnavailable, "{error}");
                    refused += 1;
                }
            },
            (5..=7, Some(id)) => match export(&server.service, id).await {
                Ok(file) => assert!(file == whole[id], "{id} changed"),
                Err(code) => assert_eq!(code, ErrorCode::StoreUnavailable, "{id}"),
            },
            (_, Some(id)) => {
                whole.remove(id);
                match server.service.delete(id).await {
                    Ok(()) => drop(gone.insert(id.clone())),
                    Err(error) => {
                        assert_eq!(error.code(), ErrorCode::StoreUnavailable, "{error}");
                        doomed.insert(id.clone());
                    }
                }
            }
        }
        if step % 20 == 19 {
            faults.plan(|_, _| None);
            server = server.restart().await;
        }
    }
    faults.plan(|_, _| None);
    // Beyond the longest stall: what was late has come.
    tokio::time::sleep(Duration::from_secs(1)).await;
    let server = server.restart().await;
    for (id, file) in &whole {
        let now = found(&server.service, id).await;
        assert!(now.as_ref() == Ok(file), "{id} is lost or changed: {:?}", now.map(|f| f.len()));
    }
    for id in &gone {
        let now = found(&server.service, id).await.map(|file| file.len());
        assert_eq!(now, Err(ErrorCode::SceneNotFound), "{id}");
    }
    let there = listed(&server.service).await;
    let there: HashSet<String> = there.iter().map(SceneId::to_string).collect();
    let begun = Instant::now();
    while !kept(folder.path()).is_subset(&there) && begun.elapsed() < PATIENCE {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let left: Vec<String> = kept(folder.path()).difference(&there).cloned().collect();
    assert_eq!(left, [""; 0], "left over after a sweep");
    println!(
        "{} calls, {} faults: {refused} creates refused, {} scenes whole, {} gone, {} whose \
         deletion failed",
        steps.end - steps.start,
        faults.wrongs.load(Ordering::Relaxed),
        whole.len(),
        gone.len(),
        doomed.len(),
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_store_refuses_uploads_serves_what_it_has_and_recovers_by_deleting() {
    let folder = tempfile::tempdir().unwrap();
    let local = LocalFileSystem::new_with_prefix(folder.path()).unwrap();
    let local: Arc<dyn ObjectStore> = Arc::new(local.with_automatic_cleanup(true));
    let faults = Arc::new(FaultStore::new(local, Duration::ZERO));
    let place = StoreLocation::Own(Arc::clone(&faults) as Arc<dyn ObjectStore>);
    let server = TestServer::at(&place, |_, _| {}).await;
    let mut whole = Vec::new();
    for seed in 0..3 {
        let id = server.service.create_scene(request(seed)).await.unwrap().status.id;
        let file = export(&server.service, &id).await.unwrap();
        whole.push((id, file));
    }
    faults.plan(|what, _| (what == "put").then_some(Wrong::Full));
    let refused = server.service.create_scene(request(9)).await.unwrap_err();
    assert_eq!(refused.code(), ErrorCode::StoreUnavailable, "{refused}");
    assert!(refused.message().contains("no storage space"), "{refused}");
    assert!(refused.retry_after().is_some(), "an overload code says when to come back");
    for (id, file) in &whole {
        assert!(export(&server.service, id).await.as_ref() == Ok(file), "{id}");
    }
    let (id, _) = whole.remove(0);
    server.service.delete(&id).await.expect("deleting makes room, so it needs none");
    faults.plan(|_, _| None);
    let server = server.restart().await;
    assert_eq!(
        server.service.create_scene(request(9)).await.unwrap().status.state,
        SceneState::Done
    );
    for (id, file) in &whole {
        assert!(export(&server.service, id).await.as_ref() == Ok(file), "{id}");
    }
    assert_eq!(export(&server.service, &id).await, Err(ErrorCode::SceneNotFound));
}

/// A server on a store that a plan holds, and its folder.
async fn on_faults(
    folder: &Path,
    change: impl FnOnce(&mut segsplat::config::Config, &mut segsplat::service::Parts),
) -> (Arc<FaultStore>, TestServer) {
    let local = LocalFileSystem::new_with_prefix(folder).unwrap();
    let local: Arc<dyn ObjectStore> = Arc::new(local.with_automatic_cleanup(true));
    let faults = Arc::new(FaultStore::new(local, Duration::ZERO));
    let place = StoreLocation::Own(Arc::clone(&faults) as Arc<dyn ObjectStore>);
    let server = TestServer::at(&place, change).await;
    (faults, server)
}

/// Asks for what needs no call to the store that is held; each call is answered meanwhile.
async fn all_answer(server: &TestServer, faults: &FaultStore, ids: [&SceneId; 2]) {
    eventually("a call to the store is held", async || {
        (faults.held.load(Ordering::Acquire) > 0).then_some(())
    })
    .await;
    let client = crate::common::client();
    let paths = ids.map(|id| format!("/v1/scenes/{id}"));
    let paths = ["/healthz", "/readyz", "/v1/scenes"].into_iter().chain(paths.iter().map(|p| &**p));
    let asked = paths.map(|path| client.get(server.url(path)).send());
    let created = client.post(server.url("/v1/scenes")).multipart(form(&upload(77))).send();
    let (answers, created) = tokio::join!(futures_util::future::join_all(asked), created);
    for answer in answers {
        let answer = answer.unwrap();
        assert_eq!(answer.status(), 200, "{}", answer.url());
    }
    assert!(created.unwrap().status().is_success());
    assert!(faults.held.load(Ordering::Acquire) > 0, "all were answered while it was held");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn nobody_waits_while_the_store_keeps_the_order_of_a_refinement() {
    let folder = tempfile::tempdir().unwrap();
    // Where a reader waits, it waits so long, and the test fails.
    let (faults, server) =
        on_faults(folder.path(), |config, _| config.limits.store_timeout_ms = 20_000).await;
    let id = server.service.create_scene(request(1)).await.unwrap().status.id;
    let other = server.service.create_scene(request(2)).await.unwrap().status.id;
    let status = format!("scenes/{id}/status.json");
    faults
        .plan(move |what, path| (what == "put" && path.as_ref() == status).then_some(Wrong::Held));
    let (service, asked) = (server.service.clone(), id.clone());
    let order = tokio::spawn(async move { service.refine(&asked, Refine::Ms(600_000)).await });
    all_answer(&server, &faults, [&id, &other]).await;
    let shown = server.service.get(&id).await.unwrap().refinement.state;
    assert_eq!(shown, RefineState::None, "what is not kept is not shown");
    faults.let_go();
    assert_eq!(order.await.unwrap().unwrap().refinement.state, RefineState::Running);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn nobody_waits_while_the_store_forgets_semantics() {
    let folder = tempfile::tempdir().unwrap();
    let (faults, server) = on_faults(folder.path(), |config, parts| {
        config.limits.store_timeout_ms = 20_000;
        parts.semantics = Arc::new(PhotoMeaning::default());
    })
    .await;
    let options = SceneOptions { semantics: SemanticsMode::Eager, ..SceneOptions::default() };
    let eager = CreateScene { options, ..request(1) };
    let id = server.service.create_scene(eager).await.unwrap().status.id;
    let other = server.service.create_scene(request(2)).await.unwrap().status.id;
    let server = server.restart().await;
    let file = folder.path().join("scenes").join(id.as_str()).join("semantics.segsplat");
    std::fs::remove_file(file).expect("they are made");
    faults.plan(|what, _| (what == "delete").then_some(Wrong::Held));
    let (service, asked) = (server.service.clone(), id.clone());
    let spec = QuerySpec { texts: vec!["photo 0".to_owned()], ..QuerySpec::default() };
    let text = tokio::spawn(async move { service.query(&asked, spec).await });
    all_answer(&server, &faults, [&id, &other]).await;
    faults.let_go();
    assert!(text.await.unwrap().unwrap().results[0].gaussians > 0, "they are made again");
}

#[tokio::test(flavor = "multi_thread")]
async fn scenes_that_wait_for_room_come_before_new_ones() {
    let (folder, networks) = (tempfile::tempdir().unwrap(), Arc::new(WallNetworks::default()));
    networks.hold.store(true, Ordering::Release);
    let given = Arc::clone(&networks);
    let (faults, server) = on_faults(folder.path(), |_, parts| parts.scenes = given).await;
    let create = |seed| CreateScene { wait: None, ..request(seed) };
    faults.plan(|what, path| {
        (what == "put" && path.as_ref().ends_with("upload.segsplat")).then_some(Wrong::Full)
    });
    let refused = server.service.create_scene(create(1)).await.unwrap_err();
    assert_eq!(refused.code(), ErrorCode::StoreUnavailable, "{refused}");
    let ready = crate::common::client().get(server.url("/readyz")).send().await.unwrap();
    assert_eq!(ready.status(), 200, "one upload too many says nothing of others");
    // Room for an upload, none for a scene.
    faults.plan(|what, path| {
        let large =
            path.as_ref().ends_with("scene.segsplat") || path.as_ref().starts_with("probe/");
        (what == "put" && large).then_some(Wrong::Full)
    });
    let id = server.service.create_scene(create(2)).await.unwrap().status.id;
    networks.hold.store(false, Ordering::Release);
    eventually("the scene waits for room, and others are refused", async || {
        let other = server.service.create_scene(create(3)).await;
        match other.map_err(|error| error.code()) {
            Err(code) => {
                assert_eq!(code, ErrorCode::StoreUnavailable);
                Some(())
            }
            Ok(other) => {
                server.service.delete(&other.status.id).await.expect("it is there");
                None
            }
        }
    })
    .await;
    assert_eq!(server.service.get(&id).await.unwrap().state, SceneState::Queued);
    server.service.delete(&id).await.expect("it is there");
    faults.plan(|_, _| None);
    let last = server.service.create_scene(create(4)).await.expect("nothing waits any more");
    assert_eq!(server.finished(&last.status.id).await.state, SceneState::Done);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_was_taken_waits_while_the_disk_is_full_and_is_made_after() {
    let (folder, networks) = (tempfile::tempdir().unwrap(), Arc::new(WallNetworks::default()));
    networks.hold.store(true, Ordering::Release);
    let given = Arc::clone(&networks);
    let (faults, server) = on_faults(folder.path(), |_, parts| parts.scenes = given).await;
    let taken = CreateScene { wait: None, ..request(1) };
    let id = server.service.create_scene(taken).await.unwrap().status.id;
    eventually("it is being made", async || {
        (networks.calls.load(Ordering::Acquire) > 0).then_some(())
    })
    .await;
    let client = crate::common::client();
    let ready = async || {
        let answer = client.get(server.url("/readyz")).send().await.unwrap();
        answer.status() == 200
    };
    assert!(ready().await);
    faults.plan(|what, _| (what == "put").then_some(Wrong::Full));
    networks.hold.store(false, Ordering::Release);
    eventually("not ready, and the scene waits", async || {
        let status = server.service.get(&id).await.unwrap();
        assert!(status.error.is_none(), "{status:?}");
        (!ready().await && status.state == SceneState::Queued).then_some(())
    })
    .await;
    // It is tried again and again, and none of that counts as an attempt.
    let before = faults.wrongs.load(Ordering::Relaxed);
    eventually("it is tried again", async || {
        (faults.wrongs.load(Ordering::Relaxed) > before + 2).then_some(())
    })
    .await;
    let status = server.service.get(&id).await.unwrap();
    assert_eq!((status.state, ready().await), (SceneState::Queued, false), "{status:?}");
    faults.plan(|_, _| None);
    assert_eq!(server.finished(&id).await.state, SceneState::Done);
    eventually("ready again", async || ready().await.then_some(())).await;
    let server = server.restart().await;
    assert_eq!(server.service.get(&id).await.unwrap().state, SceneState::Done, "it is kept");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_a_working_store_never_keeps_fails_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let (faults, server) = on_faults(folder.path(), |_, _| {}).await;
    let refuse = |path: &object_store::path::Path| path.as_ref().ends_with("scene.segsplat");
    faults.plan(move |what, path| (what == "put" && refuse(path)).then_some(Wrong::Fails));
    let made = server.service.create_scene(request(1)).await.unwrap().status;
    assert_eq!(made.state, SceneState::Failed);
    assert_eq!(made.error.unwrap().code, "store_unavailable");
    assert!(server.service.ready().ready, "it keeps other things");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deletion_counts_where_the_job_removed_its_own_record_first() {
    let folder = tempfile::tempdir().unwrap();
    let local = LocalFileSystem::new_with_prefix(folder.path()).unwrap();
    let local: Arc<dyn ObjectStore> = Arc::new(local.with_automatic_cleanup(true));
    let faults = Arc::new(FaultStore::new(local, Duration::ZERO));
    let place = StoreLocation::Own(Arc::clone(&faults) as Arc<dyn ObjectStore>);
    let networks = Arc::new(WallNetworks::default());
    networks.hold.store(true, Ordering::Release);
    let given = Arc::clone(&networks);
    let server = TestServer::at(&place, |_, parts| parts.scenes = given).await;
    let held = CreateScene { wait: None, ..request(1) };
    let id = server.service.create_scene(held).await.unwrap().status.id;
    // A job that ends now sees that its scene is deleted, and removes what it wrote. It does so
    // between the two objects that the deletion removes.
    let pending = folder.path().join("pending").join(id.as_str());
    assert!(pending.exists(), "the scene is being made");
    faults.plan(move |what, _| {
        if what == "delete" {
            let _ = std::fs::remove_file(&pending);
        }
        None
    });
    server.service.delete(&id).await.expect("it is deleted");
    let after = server.service.get(&id).await.map(|status| status.state);
    assert_eq!(after.map_err(|error| error.code()), Err(ErrorCode::SceneNotFound));
    assert_eq!(listed(&server.service).await, HashSet::new(), "no ghost is listed");
    let again = server.service.delete(&id).await.unwrap_err();
    assert_eq!(again.code(), ErrorCode::SceneNotFound);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_deleted_does_not_come_back_by_a_call_that_was_given_up() {
    let folder = tempfile::tempdir().unwrap();
    let local = LocalFileSystem::new_with_prefix(folder.path()).unwrap();
    let local: Arc<dyn ObjectStore> = Arc::new(local.with_automatic_cleanup(true));
    let stall = Duration::from_secs(1);
    let faults = Arc::new(FaultStore::new(local, stall));
    let place = StoreLocation::Own(Arc::clone(&faults) as Arc<dyn ObjectStore>);
    let server = TestServer::at(&place, |config, _| config.limits.store_timeout_ms = 200).await;
    let id = server.service.create_scene(request(1)).await.unwrap().status.id;
    let status = format!("scenes/{id}/status.json");
    let mut stalls = true;
    faults.plan(move |what, path| {
        let is_first = what == "put" && path.as_ref() == status && std::mem::take(&mut stalls);
        is_first.then_some(Wrong::Stalls)
    });
    let given_up = server.service.refine(&id, Refine::Ms(600_000)).await.unwrap_err();
    assert_eq!(given_up.code(), ErrorCode::StoreUnavailable, "{given_up}");
    let deleted = server.service.delete(&id).await;
    // What was late has come.
    tokio::time::sleep(stall).await;
    if deleted.is_err() {
        server.service.delete(&id).await.expect("nothing is late any more");
    }
    let server = server.restart().await;
    let after = server.service.get(&id).await.map(|status| status.state);
    assert_eq!(after.map_err(|error| error.code()), Err(ErrorCode::SceneNotFound));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_caller_that_goes_and_comes_back_with_its_key_has_one_scene() {
    let faults = Arc::new(FaultStore::new(Arc::new(InMemory::new()), Duration::ZERO));
    let place = StoreLocation::Own(Arc::clone(&faults) as Arc<dyn ObjectStore>);
    let server = TestServer::at(&place, |_, _| {}).await;
    faults.plan(|what, path| {
        (what == "put" && path.as_ref().ends_with("upload.segsplat")).then_some(Wrong::Held)
    });
    let create = || {
        let (service, key) = (server.service.clone(), Some("one".to_owned()));
        let request = CreateScene { upload: upload(1), idempotency_key: key, ..request(1) };
        tokio::spawn(async move { service.create_scene(request).await })
    };
    let first = create();
    let is_held = async || (faults.held.load(Ordering::Acquire) > 0).then_some(());
    eventually("its photos are being kept", is_held).await;
    first.abort();
    let _ = first.await;
    let second = create();
    // Enough for a second call that does not wait for the work of the first.
    tokio::time::sleep(Duration::from_millis(300)).await;
    faults.let_go();
    let second = second.await.unwrap().unwrap();
    assert!(second.replayed, "it is the scene of the first call");
    assert_eq!(listed(&server.service).await, HashSet::from([second.status.id]));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_ends_while_another_replica_reads_it_is_found() {
    let objects = Arc::new(InMemory::new());
    let networks = Arc::new(WallNetworks::default());
    networks.hold.store(true, Ordering::Release);
    let given = Arc::clone(&networks);
    let place = StoreLocation::Shared(Arc::clone(&objects) as Arc<dyn ObjectStore>);
    let one = TestServer::at(&place, |_, parts| parts.scenes = given).await;
    let faults = Arc::new(FaultStore::new(objects, Duration::from_millis(500)));
    let place = StoreLocation::Shared(Arc::clone(&faults) as Arc<dyn ObjectStore>);
    let other = TestServer::at(&place, |config, _| config.limits.record_fresh_ms = 0).await;
    let request = CreateScene { wait: None, ..request(1) };
    let id = one.service.create_scene(request).await.unwrap().status.id;
    faults.plan(|what, path| {
        (what == "get" && path.as_ref().starts_with("pending/")).then_some(Wrong::Stalls)
    });
    let reader = {
        let (service, id) = (other.service.clone(), id.clone());
        tokio::spawn(async move { service.get(&id).await })
    };
    let reads = async || (faults.wrongs.load(Ordering::Acquire) > 0).then_some(());
    eventually("it is being read", reads).await;
    networks.hold.store(false, Ordering::Release);
    one.finished(&id).await;
    let found = reader.await.unwrap();
    assert_eq!(found.unwrap().state, SceneState::Done);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_flipped_bit_is_reported_or_repaired_and_harms_no_neighbour() {
    let mut server = TestServer::with(|_, _| {}).await;
    let scenes = if long() { 60 } else { 8 };
    let mut whole = Vec::new();
    for seed in 0..scenes {
        let id = server.service.create_scene(request(seed)).await.unwrap().status.id;
        let file = export(&server.service, &id).await.unwrap();
        whole.push((id, file));
    }
    let mut random = Random(11);
    let (mut reported, mut repaired) = (0, 0);
    for round in 0..scenes as usize / 2 {
        let hurt = whole[2 * round].0.clone();
        let folder = server.data_dir().join("scenes").join(hurt.as_str());
        let name = ["scene.segsplat", "status.json", "upload.segsplat"][round % 3];
        let mut file = std::fs::read(folder.join(name)).unwrap();
        let at = random.below(file.len());
        file[at] ^= 1 << random.below(8);
        std::fs::write(folder.join(name), file).unwrap();
        server = server.restart().await;
        for (id, file) in &whole {
            match export(&server.service, id).await {
                Ok(now) => {
                    assert!(now == *file, "{id} changed");
                    repaired += usize::from(*id == hurt);
                }
                Err(code) => {
                    assert_eq!(code, ErrorCode::SceneCorrupt, "{id}");
                    let earlier = whole.iter().take(2 * round + 1).any(|(hurt, _)| hurt == id);
                    assert!(earlier, "{id} was not touched");
                    reported += usize::from(*id == hurt);
                }
            }
        }
    }
    assert!(reported > 0 && repaired > 0, "{reported} reported, {repaired} repaired");
    println!("{} bits flipped: {reported} reported, {repaired} without harm", reported + repaired);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_same_content_is_computed_once_for_an_owner() {
    let networks = Arc::new(WallNetworks::default());
    let given = Arc::clone(&networks);
    let server = TestServer::with(|config, parts| {
        parts.scenes = given;
        config.jobs = 3;
    })
    .await;
    let both = [request(1), request(1), request(2)].map(|r| server.service.create_scene(r));
    let made = futures_util::future::try_join_all(both).await.unwrap();
    assert_eq!(networks.calls.load(Ordering::Acquire), 2, "two contents, three scenes");
    let files = futures_util::future::join_all(
        made.iter().map(|created| export(&server.service, &created.status.id)),
    )
    .await;
    assert!(files[0] == files[1] && files[0] != files[2]);
    server.service.delete(&made[0].status.id).await.unwrap();
    assert!(export(&server.service, &made[1].status.id).await == files[1], "the copy is its own");

    let ann = server.service.for_caller(segsplat::keys::Caller::Owner("ann".into()));
    ann.create_scene(request(2)).await.unwrap();
    assert_eq!(networks.calls.load(Ordering::Acquire), 3, "nobody else's scene answers for it");
    ann.create_scene(request(2)).await.unwrap();
    assert_eq!(networks.calls.load(Ordering::Acquire), 3);
}

#[tokio::test(flavor = "multi_thread")]
async fn work_is_dropped_when_its_only_caller_goes_away() {
    let networks = Arc::new(WallNetworks::default());
    networks.hold.store(true, Ordering::Release);
    let given = Arc::clone(&networks);
    let server = TestServer::with(|_, parts| parts.scenes = given).await;
    let client = crate::common::client();
    let call = client
        .post(server.url("/v1/scenes?wait_ms=60000"))
        .multipart(crate::common::doors::form(&upload(1)))
        .timeout(Duration::from_millis(700));
    assert!(call.send().await.is_err(), "the caller gives up");
    let begun = Instant::now();
    while !listed(&server.service).await.is_empty() && begun.elapsed() < PATIENCE {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert_eq!(listed(&server.service).await, HashSet::new(), "nobody wants it");
    let known = CreateScene { wait: None, ..request(2) };
    let id = server.service.create_scene(known).await.unwrap().status.id;
    let waiting = server.service.wait(&id, Duration::from_millis(50)).await.unwrap();
    assert!(!waiting.state.is_final(), "who has the id may come back");
    networks.hold.store(false, Ordering::Release);
    assert_eq!(server.finished(&id).await.state, SceneState::Done);
}
