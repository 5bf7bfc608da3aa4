//! An answer is its caller's until the last byte of it is taken: it holds the key's permit, its
//! bytes and its place, the server waits for it at its end, and not for ever.

use std::time::Duration;

use reqwest::{Client, RequestBuilder, Response};
use segsplat::{
    config::Config,
    keys::key_sha256,
    limits::Limits,
    scene::{SceneId, Upload, UploadFile},
};
use tempfile::TempDir;
use tokio::time::{sleep, timeout};

use crate::common::{
    doors::{Fault, Options, bytes, http},
    process::eventually,
    root,
    server::{PATIENCE, TestServer},
};

/// Sides of a picture whose f32 no buffer of a socket takes whole: 48 MiB.
const LARGE: &str = "width=2048&height=2048&format=npy";
/// The same, 3 MiB.
const MIDDLE: &str = "width=512&height=512&format=npy";

/// A client of HTTP/1.1, and one of HTTP/2 that takes little that it does not read.
fn clients() -> [Client; 2] {
    let http2 = crate::common::client_builder()
        .http2_prior_knowledge()
        .http2_initial_stream_window_size(1 << 10)
        .http2_initial_connection_window_size(1 << 10);
    [crate::common::client_builder().http1_only(), http2].map(|client| client.build().unwrap())
}

/// A server whose one key may have one call open.
async fn one_at_a_time(change: impl FnOnce(&mut Config)) -> (TempDir, TestServer, SceneId) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("keys.toml");
    let key = format!(
        "[[key]]\nname = \"k\"\nsha256 = \"{}\"\nscopes = [\"admin\"]\ninflight_max = 1",
        key_sha256("secret")
    );
    std::fs::write(&path, key).unwrap();
    let server = TestServer::with(|config, _| {
        change(config);
        config.keys = Some(path);
    });
    let server = server.await;
    let id = server.scene().await.id;
    (folder, server, id)
}

fn view(client: &Client, server: &TestServer, id: &SceneId, how: &str) -> RequestBuilder {
    client.get(server.url(&format!("/v1/scenes/{id}/view?from=0&{how}"))).bearer_auth("secret")
}

/// A message of `RenderView`: the scene, the first camera, and the size as f32.
fn rpc_view(client: &Client, server: &TestServer, id: &SceneId, side: u32) -> RequestBuilder {
    use prost::Message;
    use segsplat::api::grpc::pb;
    let between = pb::camera_spec::Pose::Between(pb::Between { from: 0, to: 0, t: 0.0 });
    let request = pb::RenderViewRequest {
        scene_id: id.to_string(),
        camera: Some(pb::CameraSpec { pose: Some(between), lens: None }),
        options: Some(pb::ViewOptions {
            width: Some(side),
            height: Some(side),
            format: pb::Format::Npy.into(),
            ..Default::default()
        }),
        ..Default::default()
    };
    let message = request.encode_to_vec();
    let length = u32::try_from(message.len()).unwrap().to_be_bytes();
    client
        .post(server.url("/segsplat.v1.SceneService/RenderView"))
        .bearer_auth("secret")
        .header("content-type", "application/grpc")
        .header("te", "trailers")
        .body([&[0][..], &length, &message].concat())
}

/// The head of an answer whose body nobody reads, as soon as the call is let in.
async fn unread(what: &str, request: RequestBuilder) -> Response {
    eventually(what, async || {
        let request = request.try_clone().expect("a plain body");
        let answer = request.send().await.expect("an answer");
        (answer.status() == 200).then_some(answer)
    })
    .await
}

async fn refused(request: RequestBuilder) -> Fault {
    bytes(request.send().await.expect("an answer")).await.expect_err("a refusal")
}

#[tokio::test]
async fn a_key_has_its_permit_until_the_last_byte_of_an_answer_is_taken() {
    let (_folder, server, id) = one_at_a_time(|_| {}).await;
    let list = || crate::common::client().get(server.url("/v1/scenes")).bearer_auth("secret");
    let [http1, http2] = clients();
    for (what, request) in [
        ("HTTP/1.1", view(&http1, &server, &id, LARGE)),
        ("HTTP/2", view(&http2, &server, &id, MIDDLE)),
        ("gRPC", rpc_view(&http2, &server, &id, 512)),
    ] {
        let answer = unread(what, request).await;
        let fault = refused(list()).await;
        assert_eq!((fault.code.as_str(), fault.number), ("overloaded", 429), "{what}: {fault:?}");
        assert!(fault.message.contains("1 calls open"), "{what}: {fault:?}");
        let whole = timeout(PATIENCE, answer.bytes()).await.expect(what).expect(what);
        assert!(whole.len() > 512 * 512 * 12, "{what}: {} bytes", whole.len());
        unread(what, list()).await;
        // And until its caller is gone.
        let answer = unread(what, view(&http2, &server, &id, MIDDLE)).await;
        assert_eq!(refused(list()).await.code, "overloaded", "{what}");
        drop(answer);
        unread(what, list()).await;
    }
}

#[tokio::test]
async fn a_caller_who_takes_nothing_loses_the_connection() {
    let (_folder, server, id) =
        one_at_a_time(|config| config.limits.answer_window_ms = 1_000).await;
    let list = || crate::common::client().get(server.url("/v1/scenes")).bearer_auth("secret");
    let [http1, http2] = clients();
    for (what, request) in [
        ("HTTP/1.1", view(&http1, &server, &id, LARGE)),
        ("HTTP/2", view(&http2, &server, &id, MIDDLE)),
        ("gRPC", rpc_view(&http2, &server, &id, 512)),
    ] {
        let answer = unread(what, request).await;
        unread(what, list()).await;
        let rest = timeout(PATIENCE, answer.bytes()).await.expect(what);
        assert!(rest.is_err(), "{what}: the answer came whole");
    }
    // Who takes what there is, however long it takes until there is more, keeps it.
    let events = http1.get(server.url(&format!("/v1/scenes/{id}/events"))).bearer_auth("secret");
    assert!(unread("events", events).await.text().await.unwrap().contains("done"));
}

#[tokio::test]
async fn a_server_that_stops_waits_until_its_answers_are_taken() {
    let server = TestServer::with(|config, _| config.drain_ms = 3_600_000).await;
    let id = server.scene().await.id;
    let [http1, http2] = clients();
    let answers = [
        unread("HTTP/1.1", view(&http1, &server, &id, LARGE)).await,
        unread("HTTP/2", view(&http2, &server, &id, MIDDLE)).await,
    ];
    let url = server.url("/v1/scenes");
    let stopping = tokio::spawn(server.stop());
    eventually("new calls are refused", async || {
        let status = http1.get(&url).send().await.map(|answer| answer.status().as_u16());
        (status.is_err() || status.is_ok_and(|status| status == 503)).then_some(())
    })
    .await;
    // Long enough for a server that waits for nobody; this one waits for as long as it takes.
    sleep(Duration::from_secs(1)).await;
    assert!(!stopping.is_finished(), "two answers are not taken");
    for (answer, least) in answers.into_iter().zip([2048 * 2048 * 12, 512 * 512 * 12]) {
        let whole = timeout(PATIENCE, answer.bytes()).await.expect("an end").expect("all of it");
        assert!(whole.len() > least, "{} bytes", whole.len());
    }
    timeout(PATIENCE, stopping).await.expect("then it ends").unwrap();
}

#[tokio::test]
async fn answers_that_nobody_takes_are_bounded_in_bytes() {
    let server = TestServer::start().await;
    let id = server.scene().await.id;
    // The limit is live.
    server.service.reload(Limits { answers_bytes_max: 5 << 20, ..Limits::default() });
    let [_, http2] = clients();
    // Each on a connection of its own.
    let other = || clients()[1].clone();
    for (what, held) in [
        ("HTTP/2", view(&http2, &server, &id, MIDDLE)),
        ("gRPC", rpc_view(&other(), &server, &id, 512)),
    ] {
        let held = unread(what, held).await;
        for request in [view(&other(), &server, &id, MIDDLE), rpc_view(&other(), &server, &id, 512)]
        {
            let answer = request.send().await.unwrap();
            let code = answer.headers().get("segsplat-code").cloned();
            let code = match code {
                Some(code) => code.to_str().unwrap().to_owned(),
                None => bytes(answer).await.expect_err(what).code,
            };
            assert_eq!(code, "overloaded", "beside {what}");
        }
        // Small ones have room.
        let small = view(&other(), &server, &id, "width=64&height=48");
        assert_eq!(small.send().await.unwrap().status(), 200, "beside {what}");
        drop(held);
        unread(what, view(&other(), &server, &id, MIDDLE)).await;
    }
}

#[tokio::test]
async fn pictures_of_one_call_wait_for_room_and_come_all() {
    let server = TestServer::with(|config, _| config.limits.answers_bytes_max = 4 << 20).await;
    let id = server.scene().await.id;
    let cameras = vec![serde_json::json!({ "from": 0 }); 12];
    for container in ["multipart", "zip"] {
        let body = serde_json::json!({
            "cameras": cameras, "width": 512, "height": 512, "format": "npy",
            "container": container,
        });
        let request = crate::common::client()
            .post(server.url(&format!("/v1/scenes/{id}/views")))
            .body(body.to_string());
        let whole =
            timeout(PATIENCE, unread(container, request).await.bytes()).await.expect("an end");
        let whole = whole.expect("all of it");
        assert!(whole.len() > 12 * 512 * 512 * 12, "{container}: {} bytes", whole.len());
    }
}

/// A server with a scene of a file of Gaussians: its exports are larger than a window.
async fn of_splats(change: impl FnOnce(&mut Config)) -> (TestServer, SceneId) {
    let server = TestServer::with(|config, _| change(config)).await;
    let bytes = std::fs::read(root().join("tests/fixtures/splats/source.ply")).unwrap();
    let splats = UploadFile { name: "source.ply".to_owned(), bytes };
    let upload = Upload { splats: Some(splats), ..Upload::default() };
    let (id, _) = http(server.addr).create(&upload, &Options::wait()).await.unwrap();
    (server, id.parse().unwrap())
}

#[tokio::test]
async fn exports_hold_their_places_until_they_are_taken() {
    let (server, id) = of_splats(|config| config.limits.exports_max = 2).await;
    let export = |format: &str| {
        let url = server.url(&format!("/v1/scenes/{id}/export?format={format}"));
        clients()[1].clone().get(url)
    };
    for format in ["ply", "sog", "packed", "html", "glb"] {
        let first = unread(format, export(format)).await;
        let second = unread(format, export("ply")).await;
        let answer = export(format).send().await.unwrap();
        assert!(answer.headers().contains_key("retry-after"), "{format}: {answer:?}");
        let fault = bytes(answer).await.expect_err(format);
        assert_eq!((fault.code.as_str(), fault.number), ("overloaded", 429), "{format}");
        // Who has the file is told so without a place, and before the file is made.
        let etag = first.headers()["etag"].clone();
        let known = export(format).header("if-none-match", etag).send().await.unwrap();
        assert_eq!(known.status(), 304, "{format}");
        assert_eq!(known.headers()["cache-control"], "private, no-cache");
        // A view is not kept waiting.
        let view = view(&crate::common::client(), &server, &id, "width=64&height=48");
        assert_eq!(view.send().await.unwrap().status(), 200, "beside {format}");
        let whole = timeout(PATIENCE, first.bytes()).await.expect(format).expect(format);
        assert!(whole.len() > 1 << 10, "{format}: {} bytes", whole.len());
        unread(format, export(format)).await;
        drop(second);
    }
}

#[tokio::test]
async fn exports_that_nobody_takes_are_bounded_in_bytes() {
    let (server, id) = of_splats(|_| {}).await;
    let url = server.url(&format!("/v1/scenes/{id}/export?format=sog"));
    let export = || clients()[1].clone().get(&url);
    let first = unread("the first", export()).await;
    let second = unread("the second", export()).await;
    // The limit is live.
    server.service.reload(Limits { exports_bytes_max: 100, ..Limits::default() });
    let fault = refused(export()).await;
    assert_eq!((fault.code.as_str(), fault.number), ("overloaded", 429), "{fault:?}");
    drop((first, second));
    unread("alone", export()).await;
}

#[tokio::test]
async fn exports_over_grpc_have_the_same_places() {
    let (server, id) = of_splats(|config| config.limits.exports_max = 1).await;
    let held = clients()[1].get(server.url(&format!("/v1/scenes/{id}/export"))).send().await;
    let held = held.unwrap();
    let door = crate::common::doors::grpc(server.addr).await;
    assert_eq!(door.export(&id.to_string()).await.unwrap_err().code, "overloaded");
    drop(held);
    eventually("the place is free", async || door.export(&id.to_string()).await.ok()).await;
}
