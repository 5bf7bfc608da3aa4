//! The end of a server's life: not ready first, then nobody new, those inside finish.

use std::{
    sync::{Arc, atomic::Ordering},
    time::{Duration, Instant},
};

use reqwest::Client;

use crate::common::server::{TestServer, WallMaker, upload};

/// A server whose one scene is held back until the test lets go.
async fn held(change: impl FnOnce(&mut segsplat::config::Config)) -> (Arc<WallMaker>, TestServer) {
    let maker = Arc::new(WallMaker::default());
    maker.hold.store(true, Ordering::Release);
    let of_server = Arc::clone(&maker);
    let server = TestServer::with(|config, parts| {
        parts.maker = of_server;
        change(config);
    });
    (maker, server.await)
}

async fn until(what: &str, mut check: impl AsyncFnMut() -> bool) {
    let begun = Instant::now();
    while !check().await {
        assert!(begun.elapsed() < crate::common::server::PATIENCE, "never: {what}");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
}

#[tokio::test]
async fn a_drain_is_unready_first_then_refuses_new_calls_and_finishes_those_inside() {
    let (maker, server) = held(|config| {
        config.drain_notice_ms = 1_500;
        config.drain_ms = 60_000;
    })
    .await;
    let url = |path: &str| server.url(path);
    let (client, form) = (Client::new(), crate::common::doors::form(&upload()));
    let making = client.post(url("/v1/scenes?wait_ms=60000")).multipart(form).send();
    let making = tokio::spawn(making);
    until("one scene at work", async || server.service.ready().jobs_running == 1).await;
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
    maker.hold.store(false, Ordering::Release);
    let made = making.await.unwrap().unwrap();
    assert_eq!(made.status(), 201, "what was inside is finished");
    made.bytes().await.unwrap();
    stopping.await.unwrap();
}

#[tokio::test]
async fn a_drain_ends_when_its_time_is_over() {
    let (_maker, server) = held(|config| config.drain_ms = 100).await;
    let form = crate::common::doors::form(&upload());
    let making = Client::new().post(server.url("/v1/scenes?wait_ms=60000")).multipart(form).send();
    let making = tokio::spawn(making);
    until("one scene at work", async || server.service.ready().jobs_running == 1).await;
    let begun = Instant::now();
    server.stop().await;
    assert!(begun.elapsed() < Duration::from_secs(20), "{:?}", begun.elapsed());
    // The process would end now; here the caller's connection lives on.
    making.abort();
}

#[tokio::test]
async fn an_idle_server_ends_at_once() {
    let server = TestServer::start().await;
    // An open connection without a call holds nobody up.
    let client = Client::new();
    assert_eq!(client.get(server.url("/readyz")).send().await.unwrap().status(), 200);
    let begun = Instant::now();
    server.stop().await;
    assert!(begun.elapsed() < Duration::from_secs(5), "{:?}", begun.elapsed());
}
