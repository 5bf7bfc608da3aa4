//! What the server says of itself: metrics, times in headers, ids, and the board that shows them.

use std::{
    collections::BTreeSet,
    io::{Read, Write},
    net::TcpListener,
    sync::{Arc, Mutex},
    time::Duration,
};

use segsplat::{keys::key_sha256, scene::Stage, telemetry::meter::stages};
use serde_json::Value;

use crate::common::{
    cpu_server::{CpuServer, PlaneNetworks, upload},
    doors::{Ask, Options, both, both_with, bytes},
    process::{Start, can_serve},
    root,
    server::PATIENCE,
};

async fn metrics(stand: &CpuServer) -> String {
    let answer = crate::common::client().get(stand.url("/metrics")).send().await.unwrap();
    assert_eq!(answer.headers()["content-type"], "text/plain; version=0.0.4; charset=utf-8");
    answer.text().await.unwrap()
}

/// The metrics once `line` has grown by `least` since `before`: a job is counted when it ends,
/// which is after its scene is done for callers.
async fn metrics_with(stand: &CpuServer, before: &str, line: &str, least: f64) -> String {
    for _ in 0..500 {
        let text = metrics(stand).await;
        if value(&text, line) >= value(before, line) + least {
            return text;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    panic!("{line} has not grown by {least}")
}

/// The value of the one line that starts so.
fn value(text: &str, line: &str) -> f64 {
    let found = text.lines().find_map(|l| l.strip_prefix(line)?.strip_prefix(' '));
    found.unwrap_or_else(|| panic!("no {line} in\n{text}")).parse().unwrap()
}

#[tokio::test]
async fn calls_stages_and_jobs_are_counted_over_both_doors() {
    let stand = CpuServer::start().await;
    let before = metrics(&stand).await;
    for door in both(stand.addr).await {
        let (id, _) = door.create(&upload(), &Options::wait()).await.unwrap();
        door.view(&id, &Ask::first()).await.unwrap();
        door.get(&"0".repeat(32)).await.unwrap_err();
    }
    let done = "segsplat_jobs_total{kind=\"scene\",outcome=\"done\"}";
    let after = metrics_with(&stand, &before, done, 2.0).await;
    // Other tests of this process count too.
    let grew = |line: &str, least: f64| {
        let (was, is) = (value(&before, line), value(&after, line));
        assert!(is >= was + least, "{line}: {was} to {is}");
    };
    for door in ["http", "grpc"] {
        for call in ["create_scene", "render_view"] {
            let (call, door) = (format!("{{call=\"{call}\","), format!("door=\"{door}\"}}"));
            grew(&format!("segsplat_requests_total{call}code=\"ok\",{door}"), 1.0);
            grew(&format!("segsplat_request_seconds_count{call}{door}"), 1.0);
        }
        let missing = "segsplat_requests_total{call=\"get_scene\",code=\"scene_not_found\"";
        assert!(value(&after, &format!("{missing},door=\"{door}\"}}")) >= 1.0);
    }
    for stage in ["wait", "queue", "load", "render", "encode"] {
        grew(&format!("segsplat_stage_seconds_count{{stage=\"{stage}\"}}"), 2.0);
    }
    grew("segsplat_upload_bytes_total", 1_000.0);
    assert!(value(&after, "process_resident_memory_bytes") > 1e6);
    assert!(value(&after, "segsplat_ready") == 1.0);
}

#[tokio::test]
async fn metrics_are_the_admins_unless_they_are_opened() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("keys.toml");
    let entry = |name: &str, scope: &str| {
        let sha256 = key_sha256(name);
        format!("[[key]]\nname = \"{name}\"\nsha256 = \"{sha256}\"\nscopes = [\"{scope}\"]\n")
    };
    std::fs::write(&path, entry("boss", "admin") + &entry("other", "write")).unwrap();
    for open in [false, true] {
        let stand = CpuServer::with(PlaneNetworks::default(), |config| {
            config.keys = Some(path.clone());
            config.open_metrics = open;
        })
        .await;
        let ask = |key: Option<&str>| {
            let request = crate::common::client().get(stand.url("/metrics"));
            key.map_or_else(
                || request.try_clone().unwrap(),
                |key| request.try_clone().unwrap().bearer_auth(key),
            )
            .send()
        };
        for (key, closed) in [(None, 401), (Some("other"), 403), (Some("boss"), 200)] {
            let status = ask(key).await.unwrap().status().as_u16();
            assert_eq!(status, if open { 200 } else { closed }, "{key:?}, open: {open}");
        }
        // Names of keys are in no label, nor is anything else that a caller chooses.
        let odd = crate::common::client().get(stand.url("/no/such/path-42")).send().await.unwrap();
        bytes(odd).await.unwrap_err();
        let id = "0123456789abcdef".repeat(2);
        for door in both_with(stand.addr, Some("boss")).await {
            door.get(&id).await.unwrap_err();
        }
        let text = ask(Some("boss")).await.unwrap().text().await.unwrap();
        for odd in ["path-42", "boss", &id] {
            assert!(!text.contains(odd), "{odd} became a label");
        }
    }
}

#[tokio::test]
async fn answers_say_where_their_time_went_over_both_doors() {
    let stand = CpuServer::start().await;
    let doors = both(stand.addr).await;
    let (id, _) = doors[0].create(&upload(), &Options::wait()).await.unwrap();
    let url = stand.url(&format!("/v1/scenes/{id}/view?from=0&width=32&height=24"));
    let answer = crate::common::client().get(url).send().await.unwrap();
    let times: Vec<_> = answer
        .headers()
        .get_all("server-timing")
        .iter()
        .flat_map(|line| line.to_str().unwrap().split(", "))
        .filter_map(|entry| entry.split_once(";dur="))
        .map(|(name, ms)| (name.to_owned(), ms.parse::<f64>().unwrap()))
        .collect();
    let names: Vec<_> = times.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ["queue", "load", "render", "encode", "total"]);
    let stages: f64 = times[..4].iter().map(|(_, ms)| ms).sum();
    assert!(stages <= times[4].1 + 0.04, "{times:?}");
    let mut client = segsplat::api::grpc::pb::scene_service_client::SceneServiceClient::new(
        crate::common::doors::channel(stand.addr).await,
    );
    let view = segsplat::api::grpc::pb::RenderViewRequest {
        scene_id: id.clone(),
        camera: Some(crate::common::doors::Ask::first().camera()),
        ..Default::default()
    };
    let answer = client.render_view(view).await.unwrap();
    let times: Vec<_> = answer.metadata().get_all("server-timing").iter().collect();
    let times: Vec<_> = times.iter().map(|value| value.to_str().unwrap()).collect();
    let words = times.join(", ");
    for stage in ["queue;dur=", "load;dur=", "render;dur=", "encode;dur=", "total;dur="] {
        assert!(words.contains(stage), "{stage} in {words}");
    }
    let request = segsplat::api::grpc::pb::GetSceneRequest { scene_id: id };
    let answer = client.get_scene(request).await.unwrap();
    let time = answer.metadata().get("server-timing").unwrap().to_str().unwrap();
    assert!(time.starts_with("total;dur="), "{time}");
    assert!(answer.metadata().contains_key("x-request-id"));
}

/// Names of metrics in a text: `segsplat_…` and `process_…`.
fn named(text: &str) -> BTreeSet<String> {
    let words = text.split(|c: char| !(c.is_ascii_lowercase() || c == '_'));
    let ours = words.filter(|w| w.starts_with("segsplat_") || w.starts_with("process_"));
    ours.map(str::to_owned).collect()
}

/// Names and types of what is served.
fn types(text: &str) -> impl Iterator<Item = (&str, &str)> {
    text.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.split_once(' '))
}

#[tokio::test]
async fn every_metric_is_in_the_manual_and_the_manual_knows_no_other() {
    let stand = CpuServer::start().await;
    let text = metrics(&stand).await;
    let served: BTreeSet<(&str, &str)> = types(&text).collect();
    let manual = std::fs::read_to_string(root().join("docs/operations.md")).unwrap();
    let rows = manual.lines().filter_map(|line| line.strip_prefix("| `")?.split_once("` | "));
    let rows = rows.filter(|(name, _)| name.starts_with("segsplat_") || name.starts_with("proc"));
    let told = rows.map(|(name, rest)| (name, rest.split(' ').next().unwrap()));
    assert_eq!(told.collect::<BTreeSet<_>>(), served);
    let jobs = manual.lines().find(|line| line.contains("`segsplat_jobs_total`")).unwrap();
    for kind in segsplat::jobs::kinds() {
        assert!(jobs.contains(&format!("`{kind}`")), "the manual names {kind}");
        for outcome in ["done", "failed", "cancelled", "requeued"] {
            let line = format!("segsplat_jobs_total{{kind=\"{kind}\",outcome=\"{outcome}\"}}");
            assert!(text.contains(&line), "{line} is served from the start");
        }
    }
}

#[test]
fn every_stage_has_its_time() {
    for stage in Stage::SCENE.into_iter().chain(Stage::SEMANTICS) {
        assert!(stages().any(|name| name == stage.name()), "{stage:?} would not be counted");
    }
}

/// Takes what one exporter posts and answers 200 until nobody calls for a while.
fn collect(listener: &TcpListener) -> Vec<u8> {
    let (mut socket, _) = listener.accept().expect("the exporter calls");
    socket.set_read_timeout(Some(Duration::from_secs(10))).unwrap();
    let mut got = Vec::new();
    let mut piece = [0; 4096];
    let find = |got: &[u8], what: &[u8]| got.windows(what.len()).position(|w| w == what);
    loop {
        let read = socket.read(&mut piece).expect("the exporter goes on");
        got.extend_from_slice(&piece[..read]);
        let Some(end) = find(&got, b"\r\n\r\n") else { continue };
        let head = String::from_utf8_lossy(&got[..end]).to_lowercase();
        let length = head.split("content-length: ").nth(1).expect("a length");
        let length: usize = length.split("\r\n").next().unwrap().parse().unwrap();
        if got.len() >= end + 4 + length {
            break;
        }
    }
    socket.write_all(b"HTTP/1.1 200 OK\r\ncontent-length: 0\r\n\r\n").unwrap();
    got
}

#[tokio::test]
async fn spans_go_to_the_collector_as_a_part_of_the_callers_trace() {
    if !can_serve() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let keys = folder.path().join("keys.toml");
    let entry = "[[key]]\nname = \"boss\"\nscopes = [\"admin\"]\nsha256 = ";
    std::fs::write(&keys, format!("{entry}\"{}\"\n", key_sha256("very secret"))).unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let collector = format!("http://{}", listener.local_addr().unwrap());
    let collected = tokio::task::spawn_blocking(move || collect(&listener));
    let start = Start::on(&folder.path().join("data")).arg("--otlp").arg(&collector);
    let server = start.arg("--keys").arg(keys.to_str().unwrap()).start();
    let call = crate::common::client()
        .get(server.url("/v1/scenes"))
        .bearer_auth("very secret")
        .header("traceparent", "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01")
        .header("x-request-id", "asked-by-a-test");
    assert_eq!(call.send().await.unwrap().status(), 200);
    assert!(tokio::task::spawn_blocking(|| server.stop()).await.unwrap(), "it ends well");
    let got = collected.await.unwrap();
    let has = |what: &[u8]| got.windows(what.len()).any(|w| w == what);
    assert!(got.starts_with(b"POST /v1/traces HTTP/1.1\r\n"));
    assert!(has(b"asked-by-a-test") && has(b"/v1/scenes") && has(b"segsplat") && has(b"boss"));
    // Trace and parent of the caller, as protobuf has them.
    assert!(has(&0x0af7_6519_16cd_43dd_8448_eb21_1c80_319c_u128.to_be_bytes()));
    assert!(has(&0xb7ad_6b71_6920_3331_u64.to_be_bytes()));
    assert!(!has(b"very secret"), "a key went out");
}

#[tokio::test]
async fn a_collector_that_never_answers_takes_nothing_from_callers_and_the_server_ends() {
    if !can_serve() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    // The system takes its connections; nobody reads them.
    let silent = TcpListener::bind("127.0.0.1:0").unwrap();
    let collector = format!("http://{}", silent.local_addr().unwrap());
    let server = Start::on(&folder.path().join("data")).arg("--otlp").arg(&collector).start();
    let client = crate::common::client();
    let form = crate::common::doors::form(&upload());
    let call = client.post(server.url("/v1/scenes?wait_ms=60000")).multipart(form);
    assert_eq!(call.send().await.unwrap().status(), 201);
    // More spans than the exporter holds.
    let calls = async {
        for _ in 0..3_000 {
            assert_eq!(client.get(server.url("/healthz")).send().await.unwrap().status(), 200);
        }
    };
    tokio::time::timeout(5 * PATIENCE, calls).await.expect("callers wait for the collector");
    let ended = tokio::task::spawn_blocking(|| server.stop());
    assert!(tokio::time::timeout(PATIENCE, ended).await.expect("it ends").unwrap(), "it ends well");
    drop(silent);
}

/// The trace, span and parent of the span of this name, as protobuf has them one after the other.
fn span_of<'a>(got: &'a [u8], name: &str) -> Option<[&'a [u8]; 3]> {
    let named = [b"\x2a", &[name.len() as u8][..], name.as_bytes()].concat();
    let at = got.windows(named.len()).position(|w| w == named)?;
    let (parent, span, trace) = (at - 10, at - 20, at - 38);
    let heads = [&got[trace..trace + 2], &got[span..span + 2], &got[parent..parent + 2]];
    assert_eq!(heads, [b"\x0a\x10", b"\x12\x08", b"\x22\x08"], "{name}");
    Some([&got[trace + 2..span], &got[span + 2..parent], &got[parent + 2..at]])
}

#[tokio::test]
async fn a_scenes_job_has_a_span_in_the_trace_of_the_call_that_asked_for_it() {
    if !can_serve() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let collector = format!("http://{}", listener.local_addr().unwrap());
    let got = Arc::<Mutex<Vec<u8>>>::default();
    let so_far = Arc::clone(&got);
    // Until the test ends: nobody can say in how many pieces the spans come.
    std::thread::spawn(move || {
        loop {
            let piece = collect(&listener);
            so_far.lock().unwrap().extend(piece);
        }
    });
    let server = Start::on(&folder.path().join("data")).arg("--otlp").arg(&collector).start();
    let call = crate::common::client()
        .post(server.url("/v1/scenes?wait_ms=60000"))
        .header("traceparent", "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01")
        .header("x-request-id", "asked-by-a-test")
        .multipart(crate::common::doors::form(&upload()));
    assert_eq!(call.send().await.unwrap().status(), 201);
    assert!(tokio::task::spawn_blocking(|| server.stop()).await.unwrap(), "it ends well");
    let got = got.lock().unwrap().clone();
    let [[trace, call, _], [of_scene, scene, above], [of_stage, _, over]] =
        ["http", "scene", "stage"].map(|name| span_of(&got, name).expect(name));
    let callers = 0x0af7_6519_16cd_43dd_8448_eb21_1c80_319c_u128.to_be_bytes();
    assert_eq!([trace, of_scene, of_stage], [&callers[..]; 3]);
    assert_eq!((above, over), (call, scene), "a stage is in the scene, the scene in the call");
    let ids = got.windows(15).filter(|w| w == b"asked-by-a-test").count();
    assert!(ids >= 2, "call and job carry the request's id");
}

#[tokio::test]
async fn every_metric_of_the_board_is_served() {
    let stand = CpuServer::start().await;
    let text = metrics(&stand).await;
    let served: BTreeSet<String> = types(&text)
        .flat_map(|(name, kind)| {
            let histogram = kind == "histogram";
            let ends = if histogram { &["", "_bucket", "_sum", "_count"][..] } else { &[""][..] };
            ends.iter().map(move |end| format!("{name}{end}"))
        })
        .collect();
    let board = std::fs::read_to_string(root().join("docker/grafana/boards/segsplat.json"));
    let board = board.unwrap();
    let parsed: Value = serde_json::from_str(&board).unwrap();
    let panels = parsed["panels"].as_array().unwrap();
    assert!(panels.len() >= 10);
    for panel in panels {
        for target in panel["targets"].as_array().unwrap() {
            let expression = target["expr"].as_str().unwrap();
            let names = named(expression);
            assert!(!names.is_empty(), "{expression}");
            let absent: Vec<_> = names.difference(&served).collect();
            assert!(absent.is_empty(), "{}: {absent:?} is not served", panel["title"]);
        }
    }
    for (name, kind) in types(&text) {
        let counter = kind == "counter";
        assert_eq!(name.ends_with("_total"), counter, "{name}: counters alone end in _total");
    }
}
