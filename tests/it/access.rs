//! Who is let in: a table of caller, call and expected code, run through both doors.

use std::path::Path;

use reqwest::{StatusCode, header};
use segsplat::{
    api::{
        Server,
        grpc::{DESCRIPTORS, pb},
        http::routes,
    },
    error::TABLE,
    keys::{Scope, key_sha256},
    limits::Limits,
    sample::{self, SampleOptions},
    scene::Upload,
};

use crate::common::{
    doors::{
        Ask, Door, Fault, Options, adding, both, both_named, both_with, bytes, fault_of, form,
    },
    process::photos_of,
    server::{TestServer, upload},
};

/// Every call, named as the gRPC methods are, and what it needs.
const CALLS: [(&str, Scope); 20] = [
    ("CreateScene", Scope::Write),
    ("ListScenes", Scope::Read),
    ("GetScene", Scope::Read),
    ("WatchScene", Scope::Read),
    ("RefineScene", Scope::Write),
    ("AddPhotos", Scope::Write),
    ("RemovePhoto", Scope::Write),
    ("GetEdits", Scope::Read),
    ("SetEdits", Scope::Write),
    ("GetScale", Scope::Read),
    ("SetScale", Scope::Write),
    ("Measure", Scope::Read),
    ("RenderView", Scope::Read),
    ("RenderViews", Scope::Read),
    ("Query", Scope::Read),
    ("Pick", Scope::Read),
    ("Export", Scope::Read),
    ("Features", Scope::Read),
    ("Models", Scope::Read),
    ("DeleteScene", Scope::Write),
];

/// Those of them that name no scene.
const OF_THE_SERVER: [&str; 3] = ["CreateScene", "ListScenes", "Models"];

/// Callers: name, owner, scope. The key is the name twice.
const KEYS: [(&str, &str, &str); 4] = [
    ("reader", "a", "read"),
    ("writer", "a", "write"),
    ("stranger", "b", "write"),
    ("boss", "boss", "admin"),
];

fn secret(name: &str) -> String {
    format!("{name}-{name}")
}

fn write_keys(path: &Path, rest: &str) {
    let entry = |(name, owner, scope): &(&str, &str, &str)| {
        let sha256 = key_sha256(&secret(name));
        format!(
            "[[key]]\nname = \"{name}\"\nowner = \"{owner}\"\nsha256 = \"{sha256}\"\n\
             scopes = [\"{scope}\"]\n{rest}\n"
        )
    };
    std::fs::write(path, KEYS.iter().map(entry).collect::<String>()).unwrap();
}

/// A server that asks for keys.
async fn guarded(rest: &str) -> (tempfile::TempDir, TestServer) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("keys.toml");
    write_keys(&path, rest);
    let stand = TestServer::with(|config, _| config.keys = Some(path)).await;
    (folder, stand)
}

/// A photo that is none of the scene's.
fn another() -> Upload {
    let options = SampleOptions { photos: 6, width: 64, height: 48, seed: 5 };
    photos_of(&sample::upload(&options).expect("in range"), &[3])
}

/// Makes one call; the code of the refusal, or `ok`.
async fn call(door: &Door, name: &str, id: &str) -> Result<(), Fault> {
    let view = Ask::first();
    match (name, door) {
        ("CreateScene", _) => door.create(&upload(), &Options::wait()).await.map(drop),
        ("GetScene", _) => door.get(id).await.map(drop),
        ("DeleteScene", _) => door.delete(id).await,
        ("RenderView", _) => door.view(id, &view).await.map(drop),
        ("Export", _) => door.export(id).await.map(drop),
        ("Features", _) => door.features(id, &view).await.map(drop),
        ("Query", _) => door.query(id, &["box"], None, None).await.map(drop),
        (_, Door::Http { base, client }) => {
            let request = match name {
                "ListScenes" => client.get(format!("{base}/v1/scenes")),
                "Models" => client.get(format!("{base}/v1/models")),
                "WatchScene" => client.get(format!("{base}/v1/scenes/{id}/events")),
                "Pick" => client.get(format!("{base}/v1/scenes/{id}/pick?from=0&x=9&y=9")),
                "RenderViews" => client
                    .post(format!("{base}/v1/scenes/{id}/views"))
                    .body("{\"cameras\":[{\"from\":0}],\"width\":32,\"height\":24}"),
                "GetEdits" => client.get(format!("{base}/v1/scenes/{id}/edits")),
                "SetEdits" => {
                    client.put(format!("{base}/v1/scenes/{id}/edits")).body("{\"edits\":[]}")
                }
                "GetScale" => client.get(format!("{base}/v1/scenes/{id}/scale")),
                "SetScale" => client.put(format!("{base}/v1/scenes/{id}/scale")).body("{}"),
                "Measure" => client
                    .post(format!("{base}/v1/scenes/{id}/measure"))
                    .body("{\"points\":[[0,0,1]]}"),
                "AddPhotos" => client
                    .post(format!("{base}/v1/scenes/{id}/photos?wait_ms=60000"))
                    .multipart(form(&another())),
                "RemovePhoto" => {
                    let name = another().photos[0].name.replace('/', "%2F");
                    client.delete(format!("{base}/v1/scenes/{id}/photos/{name}?wait_ms=60000"))
                }
                "RefineScene" => client.post(format!("{base}/v1/scenes/{id}/refine?refine=off")),
                other => panic!("{other} is not a call"),
            };
            bytes(request.send().await.unwrap()).await.map(drop)
        }
        (_, Door::Grpc { client }) => {
            let (mut client, scene_id) = (client.clone(), id.to_owned());
            let camera = view.camera();
            let answer = match name {
                "ListScenes" => {
                    client.list_scenes(pb::ListScenesRequest::default()).await.map(drop)
                }
                "Models" => client.models(pb::ModelsRequest {}).await.map(drop),
                "WatchScene" => {
                    let request =
                        pb::WatchSceneRequest { scene_id, semantics: false, edits: false };
                    client.watch_scene(request).await.map(drop)
                }
                "Pick" => {
                    let camera = Some(camera);
                    let at =
                        pb::PickRequest { scene_id, camera, x: 9.0, y: 9.0, ..Default::default() };
                    client.pick(at).await.map(drop)
                }
                "RefineScene" => {
                    let off = pb::RefineSceneRequest { scene_id, refine: "off".to_owned() };
                    client.refine_scene(off).await.map(drop)
                }
                "AddPhotos" => {
                    let messages = tokio_stream::iter(adding(&another(), id, ""));
                    client.add_photos(messages).await.map(drop)
                }
                "RemovePhoto" => {
                    let (name, wait_ms) = (another().photos[0].name.clone(), Some(60_000));
                    let request = pb::RemovePhotoRequest { scene_id, name, wait_ms };
                    client.remove_photo(request).await.map(drop)
                }
                "GetEdits" => client.get_edits(pb::GetEditsRequest { scene_id }).await.map(drop),
                "SetEdits" => {
                    let edits_json = "[]".into();
                    let none = pb::SetEditsRequest { scene_id, edits_json, ..Default::default() };
                    client.set_edits(none).await.map(drop)
                }
                "GetScale" => client.get_scale(pb::GetScaleRequest { scene_id }).await.map(drop),
                "SetScale" => {
                    let none = pb::SetScaleRequest { scene_id, ..Default::default() };
                    client.set_scale(none).await.map(drop)
                }
                "Measure" => {
                    let points = vec![0.0, 0.0, 1.0];
                    client.measure(pb::MeasureRequest { scene_id, points }).await.map(drop)
                }
                "RenderViews" => {
                    let cameras = vec![camera];
                    let many = pb::RenderViewsRequest { scene_id, cameras, ..Default::default() };
                    client.render_views(many).await.map(drop)
                }
                other => panic!("{other} is not a call"),
            };
            answer.map_err(fault_of)
        }
    }
}

fn code(answer: &Result<(), Fault>) -> &str {
    answer.as_ref().map_or_else(|fault| fault.code.as_str(), |()| "ok")
}

#[tokio::test]
async fn each_caller_may_make_each_call_or_not_over_both_doors() {
    let (_folder, stand) = guarded("").await;
    let callers: [(&str, Option<String>); 6] = [
        ("nobody", None),
        ("a liar", Some("segsplat_0000".to_owned())),
        ("reader", Some(secret("reader"))),
        ("writer", Some(secret("writer"))),
        ("stranger", Some(secret("stranger"))),
        ("boss", Some(secret("boss"))),
    ];
    let makers = both_with(stand.addr, Some(&secret("writer"))).await;
    for (caller, key) in callers {
        for (i, door) in both_with(stand.addr, key.as_deref()).await.iter().enumerate() {
            let (id, _) = makers[i].create(&upload(), &Options::wait()).await.unwrap();
            for (name, scope) in CALLS {
                let what = format!("{caller} calls {name} over {}", door.name());
                let answer = call(door, name, &id).await;
                let of_scene = !OF_THE_SERVER.contains(&name);
                let want = match caller {
                    "nobody" | "a liar" => "unauthenticated",
                    "reader" if scope == Scope::Write => "permission_denied",
                    "stranger" if of_scene => "scene_not_found",
                    // This server's maker knows no texts; the caller was let in.
                    _ if ["Query", "Features"].contains(&name) => "model_unavailable",
                    _ => "ok",
                };
                assert_eq!(code(&answer), want, "{what}: {answer:?}");
                if let Err(fault) = answer {
                    let row = TABLE.iter().find(|row| row.name == want).unwrap();
                    assert_eq!(fault.number, door.number_of(row), "{what}");
                    assert!(key.as_ref().is_none_or(|key| !fault.message.contains(key)), "{what}");
                }
            }
        }
    }
}

#[tokio::test]
async fn anothers_scene_is_as_one_that_does_not_exist() {
    let (_folder, stand) = guarded("").await;
    let own = both_with(stand.addr, Some(&secret("writer"))).await;
    let (id, _) = own[0].create(&upload(), &Options::wait()).await.unwrap();
    let unknown = "0123456789abcdef".repeat(2);
    let strangers = both_with(stand.addr, Some(&secret("stranger"))).await;
    for door in &strangers {
        for (name, _) in CALLS.iter().filter(|(name, _)| !OF_THE_SERVER.contains(name)) {
            let there = call(door, name, &id).await.expect_err(name);
            let absent = call(door, name, &unknown).await.expect_err(name);
            let message = absent.message.replace(&unknown, &id);
            let same = Fault { message, request_id: there.request_id.clone(), ..absent };
            assert_eq!(there, same, "{name} over {}", door.name());
        }
    }
    // Lists, and keys that make a call be made once, are each owner's own.
    let http = |name: &str| {
        let request = crate::common::client().get(stand.url("/v1/scenes"));
        request.bearer_auth(secret(name)).send()
    };
    for (name, count) in [("reader", 1), ("writer", 1), ("stranger", 0), ("boss", 1)] {
        let page: serde_json::Value = http(name).await.unwrap().json().await.unwrap();
        assert_eq!(page["scenes"].as_array().unwrap().len(), count, "{name}: {page}");
    }
    let once = Options { idempotency_key: Some("k".to_owned()), ..Options::wait() };
    let (first, _) = own[0].create(&upload(), &once).await.unwrap();
    let (again, _) = own[1].create(&upload(), &once).await.unwrap();
    let (other, _) = strangers[0].create(&upload(), &once).await.unwrap();
    assert_eq!(first, again);
    assert_ne!(first, other, "a key of another owner gave away a scene");
}

#[tokio::test]
async fn a_method_without_a_row_needs_an_admin_and_health_no_key() {
    let (_folder, stand) = guarded("").await;
    let client = crate::common::client_builder().http2_prior_knowledge().build().unwrap();
    for (name, path, want) in [
        ("writer", "/segsplat.v1.SceneService/Nothing", "permission_denied"),
        ("writer", "/inference.GRPCInferenceService/Nothing", "permission_denied"),
        ("boss", "/segsplat.v1.SceneService/Nothing", "not_found"),
        ("writer", "/grpc.health.v1.Health/Nothing", "not_found"),
    ] {
        let request = client.post(stand.url(path)).bearer_auth(secret(name));
        let answer = request.header("content-type", "application/grpc").send().await.unwrap();
        assert_eq!(answer.headers()["segsplat-code"], want, "{name} calls {path}");
    }
}

#[test]
fn every_call_of_both_doors_has_its_scope_in_the_table() {
    let text: String = DESCRIPTORS.iter().map(|&b| char::from(b)).collect();
    for (name, _) in CALLS {
        assert!(text.contains(name), "{name} is no method");
    }
    let proto =
        std::fs::read_to_string(crate::common::root().join("proto/segsplat/v1/scene.proto"));
    let proto = proto.unwrap();
    let rpcs = proto.lines().filter(|line| line.trim().starts_with("rpc ")).count();
    assert_eq!(rpcs, CALLS.len(), "a method is missing from this table");
    let open: Vec<_> =
        routes().iter().filter(|r| r.scope.is_none()).map(|route| route.path).collect();
    let health = ["/v2/health/live", "/v2/health/ready", "/healthz", "/readyz"];
    let want = [&health[..], &["/openapi.json", "/"]].concat();
    assert_eq!(open, want, "routes without a key");
    let writes: Vec<_> = routes()
        .iter()
        .filter(|route| route.scope == Some(Scope::Write))
        .map(|route| format!("{} {}", route.method, route.path))
        .collect();
    let want = [
        "POST /v1/scenes",
        "DELETE /v1/scenes/{id}",
        "POST /v1/scenes/{id}/refine",
        "POST /v1/scenes/{id}/photos",
        "DELETE /v1/scenes/{id}/photos/{name}",
        "PUT /v1/scenes/{id}/edits",
        "PUT /v1/scenes/{id}/scale",
        "POST /v2/models/{name}/infer",
    ];
    assert_eq!(writes, want);
}

#[tokio::test]
async fn a_key_gets_its_share_and_others_theirs() {
    let (_folder, stand) = guarded("requests_per_s = 2").await;
    let reader = both_with(stand.addr, Some(&secret("reader"))).await;
    let mut refused = 0;
    for door in reader.iter().cycle().take(8) {
        if let Err(fault) = call(door, "ListScenes", "").await {
            assert_eq!(fault.code, "overloaded", "{fault:?}");
            assert!(fault.retry_after.is_some_and(|s| s.parse::<u32>().unwrap() >= 1));
            refused += 1;
        }
    }
    assert!(refused > 0, "eight calls at once at two a second");
    let boss = both_with(stand.addr, Some(&secret("boss"))).await;
    assert_eq!(code(&call(&boss[0], "ListScenes", "").await), "ok", "another key's share");
}

#[tokio::test]
async fn a_bearer_key_of_wide_enough_scope_is_allowed() {
    let (_folder, stand) = guarded("inflight_max = 1").await;
    let ok = StatusCode::OK;
    let (unknown, denied) = (StatusCode::UNAUTHORIZED, StatusCode::FORBIDDEN);
    let reader = secret("reader");
    for (shown, path, want) in [
        ("", "/v1/scenes", unknown),
        (&*reader, "/v1/scenes", unknown),
        ("Basic reader-reader", "/v1/scenes", unknown),
        ("Bearer reader-reade", "/v1/scenes", unknown),
        ("Bearer ", "/v1/scenes", unknown),
        ("Bearer reader-reader", "/v1/scenes", ok),
        ("bearer writer-writer", "/v1/scenes", ok),
        // Its only permit has returned with the first answer.
        ("Bearer reader-reader", "/v1/scenes", ok),
        ("Bearer reader-reader", "/metrics", denied),
    ] {
        let request = crate::common::client().get(stand.url(path)).header("authorization", shown);
        let answer = request.send().await.unwrap();
        assert_eq!(answer.status(), want, "{shown:?} for {path}");
        assert!(answer.content_length().is_some(), "{shown:?}: the length is known");
        let body = answer.text().await.unwrap();
        assert!(!body.contains("reader-reader"), "{body}");
    }
}

#[tokio::test]
async fn keys_read_again_count_at_once_and_a_bad_file_changes_nothing() {
    let (folder, stand) = guarded("").await;
    let path = folder.path().join("keys.toml");
    let server = Server::new(stand.service.clone()).unwrap();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}/v1/scenes", listener.local_addr().unwrap());
    tokio::spawn(server.clone().serve(listener, std::future::pending()));
    let status = async || {
        let request = crate::common::client().get(&url).bearer_auth(secret("reader"));
        request.send().await.unwrap().status()
    };
    let mut config = stand.service.config().clone();
    assert_eq!(status().await, StatusCode::OK);
    std::fs::write(&path, "rubbish").unwrap();
    assert!(server.reload(&config).is_err());
    assert_eq!(status().await, StatusCode::OK, "the old keys stay");
    let other = key_sha256("other");
    let text = format!("[[key]]\nname = \"b\"\nsha256 = \"{other}\"\nscopes = [\"read\"]");
    std::fs::write(&path, text).unwrap();
    server.reload(&config).unwrap();
    assert_eq!(status().await, StatusCode::UNAUTHORIZED);
    // The limits of keys that say none of their own come with the keys.
    let other = async || {
        let request = crate::common::client().get(&url).bearer_auth("other");
        request.send().await.unwrap().status()
    };
    assert_eq!(other().await, StatusCode::OK);
    config.limits.key_inflight_max = 0;
    server.reload(&config).unwrap();
    assert_eq!(other().await, StatusCode::TOO_MANY_REQUESTS);
    config.limits = Limits { key_requests_per_s: 1, ..Limits::default() };
    server.reload(&config).unwrap();
    let many = futures_util::future::join_all((0..20).map(|_| other())).await;
    assert!(many.contains(&StatusCode::OK) && many.contains(&StatusCode::TOO_MANY_REQUESTS));
    config.keys = None;
    server.reload(&config).unwrap();
    assert_eq!(status().await, StatusCode::OK, "callers need no key any more");
}

#[tokio::test]
async fn without_keys_a_call_names_loopback_the_address_or_an_allowed_host() {
    let keys = tempfile::tempdir().unwrap();
    let path = keys.path().join("keys.toml");
    write_keys(&path, "");
    for (listen, named, keys, allowed, refused) in [
        (
            "127.0.0.1",
            &["gpu.example"][..],
            None,
            &[
                "localhost:1",
                "LocalHost.",
                "127.0.0.1:8080",
                "127.8.9.1",
                "[::1]:80",
                "GPU.example:443",
            ][..],
            &[
                "evil.example:8080",
                "localhost.evil.example",
                "10.0.0.7",
                "0.0.0.0:8080",
                "a b",
                "evil.example@",
                "127.0.0.1.evil.example",
                "[::2]",
                "x@[::2]",
            ][..],
        ),
        ("10.0.0.7", &[], None, &["10.0.0.7:8080"], &["10.0.0.8:8080"]),
        // Who listens on every address has that of the caller; a rebound name is never an address.
        ("0.0.0.0", &[], None, &["10.0.0.8:8080"], &["evil.example"]),
        ("0.0.0.0", &[], Some(&path), &["any.example"], &[]),
        ("127.0.0.1", &["*"], None, &["any.example"], &[]),
        ("0.0.0.0", &["gpu.example"], Some(&path), &["gpu.example"], &["any.example"]),
    ] {
        let server = TestServer::with(|config, _| {
            config.listen = format!("{listen}:8080").parse().unwrap();
            config.allowed_hosts = named.iter().map(|&name| name.to_owned()).collect();
            config.keys = keys.cloned();
        })
        .await;
        let hosts = allowed.iter().map(|host| (host, 200)).chain(refused.iter().map(|h| (h, 403)));
        for (host, want) in hosts {
            let request = crate::common::client().get(server.url("/healthz")).header("host", *host);
            let answer = request.send().await.unwrap();
            assert_eq!(answer.status(), want, "{host} at {listen}, allowed {named:?}");
            if want == 403 {
                let fault = bytes(answer).await.unwrap_err();
                assert!(fault.message.contains(host), "{fault:?} lacks {host}");
            }
        }
    }
}

#[test]
fn origins_are_a_scheme_and_a_host_and_nothing_more() {
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let usable = |origin: &str| {
        let origins = vec![origin.to_owned()];
        let server = runtime.block_on(TestServer::with(|config, _| config.cors_origins = origins));
        let _inside = runtime.enter();
        Server::new(server.service).is_ok()
    };
    for good in ["https://a.example", "http://localhost:3000", "http://[::1]:80"] {
        assert!(usable(good), "{good}");
    }
    for odd in ["", "a.example", "https://", "https://a/", "https://a/b", "https://*.a"] {
        assert!(!usable(odd), "{odd}");
    }
}

#[tokio::test]
async fn without_a_key_http_says_how_to_show_one_and_health_asks_none() {
    let (_folder, stand) = guarded("").await;
    let client = crate::common::client();
    let answer = client.get(stand.url("/v1/scenes")).send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::UNAUTHORIZED);
    assert!(answer.headers()[header::WWW_AUTHENTICATE].to_str().unwrap().starts_with("Bearer"));
    for path in ["/healthz", "/readyz", "/openapi.json", "/"] {
        assert_eq!(client.get(stand.url(path)).send().await.unwrap().status(), 200, "{path}");
    }
    // The whole upload is not read first.
    let never = tokio_stream::pending::<Result<Vec<u8>, std::io::Error>>();
    let request = client.post(stand.url("/v1/scenes")).body(reqwest::Body::wrap_stream(never));
    let request = request.header("content-type", "multipart/form-data; boundary=x");
    assert_eq!(request.send().await.unwrap().status(), StatusCode::UNAUTHORIZED);
}

#[tokio::test]
async fn only_named_origins_may_call_from_a_page() {
    let stand = TestServer::with(|config, _| {
        config.cors_origins = vec!["https://ours.example".to_owned()];
    })
    .await;
    let client = crate::common::client();
    let ask =
        |origin: &'static str| client.get(stand.url("/v1/scenes")).header("origin", origin).send();
    let ours = ask("https://ours.example").await.unwrap();
    assert_eq!(ours.status(), 200);
    assert_eq!(ours.headers()["access-control-allow-origin"], "https://ours.example");
    let exposed = ours.headers()["access-control-expose-headers"].to_str().unwrap();
    assert!(exposed.contains("x-depth-scale"), "{exposed}");
    let theirs = ask("https://theirs.example").await.unwrap();
    assert!(theirs.headers().get("access-control-allow-origin").is_none());
    assert_eq!(bytes(theirs).await.unwrap_err().code, "permission_denied");
    let preflight = client
        .request(reqwest::Method::OPTIONS, stand.url("/v1/scenes"))
        .header("origin", "https://ours.example")
        .header("access-control-request-method", "POST")
        .header("access-control-request-headers", "authorization");
    let preflight = preflight.send().await.unwrap();
    assert!(preflight.status().is_success(), "{preflight:?}");
    let own = format!("http://{}", stand.addr);
    let own = client.get(stand.url("/v1/scenes")).header("origin", own).send().await.unwrap();
    assert_eq!(own.status(), 200, "the server's own page");
    let page = client.get(stand.url("/")).send().await.unwrap();
    let policy = page.headers()["content-security-policy"].to_str().unwrap();
    assert!(policy.ends_with("; frame-ancestors https://ours.example"), "{policy}");
    for door in both(stand.addr).await {
        assert_eq!(code(&call(&door, "ListScenes", "").await), "ok");
    }
}

#[tokio::test]
async fn a_page_that_rebinds_its_name_to_this_machine_calls_nothing() {
    let stand = TestServer::start().await;
    let (id, _) = both(stand.addr).await[0].create(&upload(), &Options::wait()).await.unwrap();
    for door in both_named(stand.addr, &format!("evil.example:{}", stand.addr.port())).await {
        for (name, _) in CALLS {
            let what = format!("{name} over {}", door.name());
            let fault = call(&door, name, &id).await.expect_err(&what);
            assert_eq!(fault.code, "permission_denied", "{what}: {fault:?}");
            assert!(fault.message.contains("evil.example"), "{what}: {fault:?}");
        }
    }
    for door in both_named(stand.addr, &format!("localhost:{}", stand.addr.port())).await {
        assert_eq!(code(&call(&door, "GetScene", &id).await), "ok", "{}", door.name());
    }
}

/// Content types that a page may send without asking first, and gRPC-Web, which is not served.
const NOT_GRPC: [Option<&str>; 6] = [
    None,
    Some("text/plain"),
    Some("text/plain;application/grpc"),
    Some("application/x-www-form-urlencoded"),
    Some("multipart/form-data; boundary=b"),
    Some("application/grpc-web+proto"),
];

#[tokio::test]
async fn a_page_of_another_origin_writes_through_no_door() {
    let stand = TestServer::start().await;
    let own = format!("http://{}", stand.addr);
    let id = stand.scene().await.id.to_string();
    let framed = |message: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = Vec::new();
        message(&mut bytes);
        [&[0][..], &u32::try_from(bytes.len()).unwrap().to_be_bytes(), &bytes].concat()
    };
    // Field 1, text: the id of a scene. CreateScene: a header, then a file of Gaussians.
    let named = framed(&|to| to.extend([&[10, 32], id.as_bytes()].concat()));
    let header = framed(&|to| to.extend([10, 0]));
    let calls = [
        ("POST", "/v1/scenes".to_owned(), Vec::new()),
        ("POST", format!("/v1/scenes/{id}/refine"), Vec::new()),
        ("DELETE", format!("/v1/scenes/{id}"), Vec::new()),
        ("POST", "/segsplat.v1.SceneService/CreateScene".to_owned(), header),
        ("POST", "/segsplat.v1.SceneService/RefineScene".to_owned(), named.clone()),
        ("POST", "/segsplat.v1.SceneService/DeleteScene".to_owned(), named),
    ];
    let http1 = crate::common::client_builder().http1_only().build().unwrap();
    let http2 = crate::common::client_builder().http2_prior_knowledge().build().unwrap();
    for client in [&http1, &http2] {
        for (method, path, body) in &calls {
            let rpc = path.contains("Service");
            for kind in NOT_GRPC.into_iter().chain([Some("application/grpc")]) {
                for origin in [Some("http://evil.example"), Some("null"), Some(&own), None] {
                    let what = format!("{method} {path} as {kind:?} of {origin:?}");
                    let ours = origin.is_none_or(|origin| origin == own);
                    if ours && (!rpc || kind == Some("application/grpc")) {
                        continue;
                    }
                    let request = client.request(method.parse().unwrap(), stand.url(path));
                    let request = request.body(body.clone());
                    let request = origin.iter().fold(request, |r, o| r.header("origin", *o));
                    let request = kind.iter().fold(request, |r, k| r.header("content-type", *k));
                    let answer = request.send().await.unwrap();
                    if rpc && kind == Some("application/grpc") {
                        assert_eq!(answer.headers()["grpc-status"], "7", "{what}");
                        assert_eq!(answer.headers()["segsplat-code"], "permission_denied");
                        continue;
                    }
                    let want = if ours { 415 } else { 403 };
                    let fault = bytes(answer).await.expect_err(&what);
                    assert_eq!(fault.number, want, "{what}: {fault:?}");
                }
            }
        }
    }
    let page = crate::common::client().get(stand.url("/v1/scenes")).send().await.unwrap();
    let page: serde_json::Value = page.json().await.unwrap();
    assert_eq!(page["scenes"].as_array().unwrap().len(), 1, "{page}");
    assert_eq!(page["scenes"][0]["id"], *id, "{page}");
    for kind in ["application/grpc", "application/grpc+proto", "Application/gRPC; x=1"] {
        let request = http2.post(stand.url("/segsplat.v1.SceneService/Models"));
        let request = request.header("content-type", kind).body(framed(&|_| {}));
        let answer = request.send().await.unwrap();
        assert_eq!(answer.headers()["content-type"], "application/grpc", "{kind}");
        assert!(!answer.headers().contains_key("segsplat-code"), "{kind}: {answer:?}");
    }
}

#[tokio::test]
async fn health_and_reflection_take_grpc_alone_too() {
    let stand = TestServer::start().await;
    let client = crate::common::client();
    for service in ["grpc.health.v1.Health/Check", "inference.GRPCInferenceService/ServerLive"] {
        for kind in NOT_GRPC.into_iter().flatten() {
            let request = client.post(stand.url(&format!("/{service}")));
            let answer = request.header("content-type", kind).send().await.unwrap();
            let fault = bytes(answer).await.unwrap_err();
            assert_eq!((fault.code.as_str(), fault.number), ("unsupported_media_type", 415));
            assert!(fault.message.contains("application/grpc"), "{service} as {kind}: {fault:?}");
        }
    }
}

#[tokio::test]
async fn hosts_that_are_named_may_be_called_and_with_keys_any() {
    let named = TestServer::with(|config, _| {
        config.allowed_hosts = vec!["gpu.example".to_owned()];
    })
    .await;
    for (host, want) in [("gpu.example", "ok"), ("evil.example", "permission_denied")] {
        for door in both_named(named.addr, host).await {
            assert_eq!(code(&call(&door, "ListScenes", "").await), want, "{host} {}", door.name());
        }
    }
    let (_folder, guarded) = guarded("").await;
    for door in both_named(guarded.addr, "any.example").await {
        let answer = call(&door, "ListScenes", "").await;
        assert_eq!(code(&answer), "unauthenticated", "{}: a key is asked for", door.name());
    }
}
