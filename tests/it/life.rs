//! Start and end of a server: it takes scenes before its networks are open; when it stops, it says
//! so first, takes no new calls, and finishes the open ones.

use std::{
    path::{Path, PathBuf},
    process::Command,
    sync::{
        Arc,
        atomic::{AtomicU8, Ordering},
    },
    time::{Duration, Instant},
};

use futures_util::{StreamExt, stream};
use segsplat::{
    api::grpc::pb,
    error::Result,
    jobs::{NetworkState, SceneNetworks},
    pipeline::{PhotoSet, Reconstruction},
    scene::{SceneOptions, Watch},
};
use serde_json::Value;
use tokio::{sync::oneshot, task::JoinHandle};

use crate::common::{
    doors::{Door, Options, both, fault_of},
    process::{Start, can_serve, eventually, long, signal},
    root,
    server::{TestServer, WallNetworks, upload},
};

/// A server whose one scene is held back until the test lets go.
async fn on_hold(
    change: impl FnOnce(&mut segsplat::config::Config),
) -> (Arc<WallNetworks>, TestServer) {
    let networks = Arc::new(WallNetworks::default());
    networks.hold.store(true, Ordering::Release);
    let of_server = Arc::clone(&networks);
    let server = TestServer::with(|config, parts| {
        parts.scenes = of_server;
        change(config);
    });
    (networks, server.await)
}

async fn until(what: &str, mut check: impl AsyncFnMut() -> bool) {
    let begun = Instant::now();
    while !check().await {
        assert!(begun.elapsed() < crate::common::server::PATIENCE, "never: {what}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

/// A call that is open until the sender is used: the end of its upload.
async fn open_call(server: &TestServer) -> (oneshot::Sender<()>, JoinHandle<reqwest::Response>) {
    let (end, ended) = oneshot::channel::<()>();
    let rest = stream::once(async move {
        ended.await.map_err(std::io::Error::other)?;
        Ok::<_, std::io::Error>(b"--b--\r\n".to_vec())
    });
    let (begun, begins) = oneshot::channel();
    let first = stream::once(async move {
        let _ = begun.send(());
        Ok(b"--b\r\ncontent-disposition: form-data; name=\"density\"\r\n\r\nfull\r\n".to_vec())
    });
    let request = crate::common::client()
        .post(server.url("/v1/scenes"))
        .header("content-type", "multipart/form-data; boundary=b")
        .body(reqwest::Body::wrap_stream(first.chain(rest)));
    let call = tokio::spawn(async move { request.send().await.expect("an answer") });
    begins.await.expect("the body is asked for");
    (end, call)
}

#[tokio::test]
async fn a_drain_is_unready_first_then_refuses_new_calls_and_finishes_those_inside() {
    let server = TestServer::with(|config, _| {
        config.drain_notice_ms = 4_000;
        config.drain_ms = 60_000;
    })
    .await;
    let url = |path: &str| server.url(path);
    let client = crate::common::client();
    let (end, call) = open_call(&server).await;
    let (ready, list) = (url("/readyz"), url("/v1/scenes"));
    // HTTP/1.1: each client keeps its connections, which a listener that closes does not end.
    assert_eq!(client.get(&ready).send().await.unwrap().status(), 200);
    let stopping = tokio::spawn(server.stop());
    until("not ready", async || client.get(&ready).send().await.unwrap().status() == 503).await;
    assert_eq!(client.get(&list).send().await.unwrap().status(), 200, "served while it is noticed");
    assert_eq!(client.get(ready.replace("ready", "health")).send().await.unwrap().status(), 200);
    let refused = async || {
        let answer = client.get(&list).send().await.unwrap();
        if answer.status() == 200 {
            return false;
        }
        assert_eq!(answer.status(), 503);
        assert!(answer.headers().contains_key("retry-after"));
        let fault = crate::common::doors::bytes(answer).await.unwrap_err();
        assert_eq!(fault.code, "stopping", "{fault:?}");
        true
    };
    until("nobody new is let in", refused).await;
    assert!(!stopping.is_finished(), "one is inside");
    end.send(()).unwrap();
    let answer = call.await.unwrap();
    assert_eq!(answer.status(), 400, "what was inside is answered: it sent no photos");
    answer.bytes().await.unwrap();
    stopping.await.unwrap();
}

#[tokio::test]
async fn a_drain_ends_when_its_time_is_over() {
    let server = TestServer::with(|config, _| config.drain_ms = 100).await;
    let (_end, call) = open_call(&server).await;
    let begun = Instant::now();
    server.stop().await;
    assert!(begun.elapsed() < Duration::from_secs(20), "{:?}", begun.elapsed());
    // The process would end now; here the caller's connection lives on.
    call.abort();
}

#[tokio::test]
async fn who_waits_for_what_is_being_made_is_answered_at_once_when_the_server_stops() {
    let (_networks, server) = on_hold(|config| config.drain_ms = 3_600_000).await;
    let [http, grpc] = both(server.addr).await;
    let (Door::Http { client, .. }, Door::Grpc { client: rpc }) = (http, grpc) else { panic!() };
    let form = crate::common::doors::form(&upload());
    let making = client.post(server.url("/v1/scenes?wait_ms=600000")).multipart(form).send();
    let making = tokio::spawn(making);
    until("one scene at work", async || server.service.ready().jobs_running == 1).await;
    let list = client.get(server.url("/v1/scenes")).send().await.unwrap();
    let list: Value = list.json().await.unwrap();
    let scene_id = list["scenes"][0]["id"].as_str().unwrap().to_owned();
    let events = server.url(&format!("/v1/scenes/{scene_id}/events"));
    let events = client.get(events).send().await.unwrap();
    let request =
        pb::WatchSceneRequest { scene_id: scene_id.clone(), semantics: false, edits: false };
    let mut watch = rpc.clone().watch_scene(request).await.unwrap().into_inner();
    let second = Options { wait_ms: Some(600_000), ..Options::default() };
    let second =
        tokio::spawn(async move { Door::Grpc { client: rpc }.create(&upload(), &second).await });
    until("a second scene", async || server.service.ready().jobs_queued == 1).await;
    let stopping = tokio::spawn(server.stop());
    let answered = async {
        let made = making.await.unwrap().unwrap();
        assert_eq!(made.status(), 202, "taken, and not made yet");
        let location = made.headers()["location"].to_str().unwrap().to_owned();
        assert_eq!(location, format!("/v1/scenes/{scene_id}"));
        let (_, state) = second.await.unwrap().expect("an answer over gRPC");
        assert_eq!(state, "queued");
        let events = events.text().await.expect("the events end in order");
        assert!(events.contains("running") && !events.contains("done"), "{events}");
        let end = loop {
            match watch.message().await {
                Ok(Some(_)) => {}
                end => break end,
            }
        };
        let fault = fault_of(end.expect_err("it is not the last event"));
        assert_eq!(fault.code, "stopping", "{fault:?}");
        stopping.await.unwrap();
    };
    tokio::time::timeout(crate::common::server::PATIENCE, answered).await.expect("at once");
}

#[tokio::test]
async fn an_idle_server_ends_at_once() {
    let server = TestServer::with(|config, _| config.drain_ms = 3_600_000).await;
    // An open connection without a call does not delay the end.
    let client = crate::common::client();
    assert_eq!(client.get(server.url("/readyz")).send().await.unwrap().status(), 200);
    let begun = Instant::now();
    server.stop().await;
    assert!(begun.elapsed() < crate::common::server::PATIENCE, "{:?}", begun.elapsed());
}

/// Networks in the state that the test sets.
#[derive(Debug, Default)]
struct Late {
    walls: WallNetworks,
    state: AtomicU8,
}

impl SceneNetworks for Late {
    fn state(&self) -> NetworkState {
        let all = [NetworkState::Opening, NetworkState::Open("somewhere"), NetworkState::Broken];
        all[usize::from(self.state.load(Ordering::Acquire))]
    }

    fn opened(&self) -> NetworkState {
        let begun = Instant::now();
        while self.state() == NetworkState::Opening {
            assert!(begun.elapsed() < crate::common::server::PATIENCE, "nobody opens them");
            std::thread::sleep(Duration::from_millis(2));
        }
        self.state()
    }

    fn make(
        &self,
        photos: &PhotoSet,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<Reconstruction> {
        assert_eq!(self.state.load(Ordering::Acquire), 1, "too early");
        self.walls.make(photos, options, watch)
    }
}

async fn late() -> (Arc<Late>, TestServer) {
    let networks = Arc::new(Late::default());
    let of_server = Arc::clone(&networks);
    (networks, TestServer::with(|_, parts| parts.scenes = of_server).await)
}

/// What `path` says; whether it is a 200.
async fn says(server: &TestServer, path: &str) -> (bool, Value) {
    let answer = crate::common::client().get(server.url(path)).send().await.unwrap();
    (answer.status() == 200, answer.json().await.unwrap())
}

#[tokio::test]
async fn scenes_are_taken_while_the_networks_are_opened_and_wait_for_them() {
    let (networks, server) = late().await;
    let (ready, said) = says(&server, "/readyz").await;
    assert!(ready && said["networks"] == "opening", "{said}");
    let (_, models) = says(&server, "/v1/models").await;
    assert_eq!(models["execution_provider"], "opening");
    let create = server.url("/v1/scenes?wait_ms=60000");
    let form = crate::common::doors::form(&upload());
    let made = tokio::spawn(crate::common::client().post(create).multipart(form).send());
    until("one scene waits", async || server.service.ready().jobs_queued == 1).await;
    tokio::time::sleep(Duration::from_millis(50)).await;
    assert_eq!(server.service.ready().jobs_running, 0, "nothing to make it with");
    networks.state.store(1, Ordering::Release);
    assert_eq!(made.await.unwrap().unwrap().status(), 201);
    let (ready, said) = says(&server, "/readyz").await;
    assert!(ready && said["networks"] == "open", "{said}");
    assert_eq!(says(&server, "/v1/models").await.1["execution_provider"], "somewhere");
}

#[tokio::test]
async fn what_is_queued_stays_queued_where_the_networks_do_not_open() {
    let (networks, server) = late().await;
    let form = crate::common::doors::form(&upload());
    let made = crate::common::client()
        .post(server.url("/v1/scenes"))
        .multipart(form)
        .send()
        .await
        .unwrap();
    let id = made.json::<Value>().await.unwrap()["id"].as_str().unwrap().to_owned();
    networks.state.store(2, Ordering::Release);
    until("not ready", async || !says(&server, "/readyz").await.0).await;
    assert_eq!(says(&server, "/readyz").await.1["networks"], "broken");
    let (_, scene) = says(&server, &format!("/v1/scenes/{id}")).await;
    assert_eq!(scene["state"], "queued", "another start may make it");
}

/// `plane` with another byte in its network.
fn spoilt(folder: &Path) -> PathBuf {
    for entry in std::fs::read_dir(root().join("tests/fixtures/plane")).unwrap() {
        let path = entry.unwrap().path();
        let mut bytes = std::fs::read(&path).unwrap();
        if path.extension().is_some_and(|end| end == "onnx") {
            bytes[100] ^= 1;
        }
        std::fs::write(folder.join(path.file_name().unwrap()), bytes).unwrap();
    }
    folder.to_owned()
}

#[test]
fn a_server_whose_networks_do_not_open_ends_and_says_why() {
    if !can_serve() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let ended = Command::new(env!("CARGO_BIN_EXE_segsplat"))
        .current_dir(root())
        .args(["serve", "--listen", "127.0.0.1:0", "--renderer", "cpu", "--anonymous"])
        .arg("--bundle")
        .arg(spoilt(folder.path()))
        .arg("--data-dir")
        .arg(folder.path().join("data"))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&ended.stderr);
    assert_eq!(ended.status.code(), Some(6), "{said}");
    assert!(said.contains("is not the file of bundle.toml: sha256"), "{said}");
}

/// The time to ready against that to open networks, which a server once waited for. A release build
/// on a quiet machine (`RUN_SLOW_TESTS=1`) holds the bars: ready in a second, idle end in 0.3 s.
#[tokio::test]
async fn ready_comes_long_before_the_networks_are_open() {
    if !can_serve() {
        return;
    }
    let client = crate::common::client();
    // A loaded machine may look at a server only after its networks are open; at three, hardly.
    let mut early = None;
    for _ in 0..3 {
        let folder = tempfile::tempdir().unwrap();
        let begun = Instant::now();
        let server = Start::on(folder.path()).bundle("../../models/embedded").start();
        let first = client.get(server.url("/readyz")).send().await.unwrap().text().await.unwrap();
        assert!(first.contains("\"ready\":true"), "{first}");
        if first.contains("opening") {
            early = Some((begun, begun.elapsed(), server, folder));
            break;
        }
    }
    let (begun, ready, server, _folder) = early.expect("ready before the networks are open");
    let url = server.url("/readyz");
    let ask = async || client.get(&url).send().await.unwrap().text().await.unwrap();
    let mut now = ask().await;
    while now.contains("opening") {
        assert!(begun.elapsed() < Duration::from_secs(120), "{now}");
        tokio::time::sleep(Duration::from_millis(10)).await;
        now = ask().await;
    }
    let open = begun.elapsed();
    assert!(now.contains("\"networks\":\"open\""), "{now}");
    let begun = Instant::now();
    assert!(server.stop(), "it ends well");
    let end = begun.elapsed();
    println!("ready after {ready:?}, networks open after {open:?}, idle end in {end:?}");
    if long() {
        assert!(ready < open.mul_f64(0.7), "{ready:?} of {open:?}");
        assert!(ready < Duration::from_secs(1), "ready after {ready:?}");
        assert!(end < Duration::from_millis(300), "idle end in {end:?}");
    }
}

/// What a server says to `GET /v1/scenes?limit=2` with each of these keys.
async fn statuses(url: &str, keys: [&str; 2]) -> [u16; 2] {
    let client = crate::common::client();
    let mut found = [0; 2];
    for (status, key) in found.iter_mut().zip(keys) {
        let call = client.get(format!("{url}/v1/scenes?limit=2")).bearer_auth(key);
        *status = call.send().await.expect("an answer").status().as_u16();
    }
    found
}

#[tokio::test]
async fn a_hangup_with_a_bad_file_changes_nothing_and_with_good_files_everything() {
    if !can_serve() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let write = |name: &str, text: &str| std::fs::write(path(name), text).unwrap();
    let key = |secret: &str| {
        let sha256 = segsplat::keys::key_sha256(secret);
        format!("[[key]]\nname = \"a\"\nsha256 = \"{sha256}\"\nscopes = [\"read\"]\n")
    };
    let config = |page_max: u32| {
        let keys = path("keys.toml");
        format!("keys = {:?}\n[limits]\npage_max = {page_max}\n", keys.display().to_string())
    };
    write("keys.toml", &key("old"));
    write("config.toml", &config(2));
    let start = Start::on(&path("data")).log(path("log"));
    let start = start.arg("--config").arg(&path("config.toml").display().to_string());
    let server = start.start();
    // How often it was said that nothing is changed, and that something is.
    let said = |what: &str| std::fs::read_to_string(path("log")).unwrap().matches(what).count();
    let (refused, changed) = ("are not changed", "are read again");
    let hangup = async |what: &str| {
        let before = said(what);
        assert!(signal(server.id(), "HUP"));
        eventually(what, async || (said(what) > before).then_some(())).await;
    };
    assert_eq!(statuses(&server.url, ["old", "new"]).await, [200, 401]);
    // Keys and limits are new, and the page is too short for the call: only all of it could count.
    let good = config(1);
    for (keys, config) in [
        (key("new"), "rubbish".to_owned()),
        (key("new"), format!("{good}page_min = 1\n")),
        (key("new"), format!("{good}photos_min = 1\n")),
        (key("new"), format!("tls_cert = \"cert.pem\"\n{good}")),
        ("rubbish".to_owned(), good.clone()),
    ] {
        write("keys.toml", &keys);
        write("config.toml", &config);
        hangup(refused).await;
        assert_eq!(statuses(&server.url, ["old", "new"]).await, [200, 401], "{config} {keys}");
    }
    write("keys.toml", &key("new"));
    write("config.toml", &good);
    hangup(changed).await;
    assert_eq!(statuses(&server.url, ["old", "new"]).await, [401, 400], "all of it counts");
    assert!(server.stop());
}
