//! Callers that are slow on purpose: half a head, a silent socket, a body that trickles.

use std::{net::SocketAddr, time::Duration};

use futures_util::{StreamExt, future::join_all, stream};
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    net::TcpStream,
    time::timeout,
};

use crate::common::server::{PATIENCE, TestServer};

/// A server that waits for heads and bodies as long as this.
async fn impatient(ms: u64) -> TestServer {
    TestServer::with(|config, _| {
        config.limits.head_timeout_ms = ms;
        config.limits.body_window_ms = ms;
        config.limits.body_bytes_min = 1_024;
    })
    .await
}

/// Sends `bytes`, then nothing; what the server says until it closes.
async fn say(addr: SocketAddr, bytes: &[u8]) -> Option<Vec<u8>> {
    let mut socket = TcpStream::connect(addr).await.unwrap();
    socket.write_all(bytes).await.unwrap();
    let mut answer = Vec::new();
    // A connection that is reset is closed too.
    timeout(PATIENCE / 4, socket.read_to_end(&mut answer)).await.ok().map(|_| answer)
}

#[tokio::test]
async fn a_head_that_does_not_come_whole_in_time_ends_its_connection() {
    let server = impatient(300).await;
    let http1 = b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n";
    let preface = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
    // A frame of headers that says that more of them follow.
    let headers = [&preface[..], &[0, 0, 0, 4, 0, 0, 0, 0, 0], &[0, 0, 1, 1, 0, 0, 0, 0, 1, 0x82]];
    for (what, bytes) in [
        ("a silent socket", &b""[..]),
        ("a first byte", &http1[..1]),
        ("half a head", http1),
        ("half a preface of HTTP/2", &preface[..10]),
        ("half a head of HTTP/2", &headers.concat()),
    ] {
        let answer = say(server.addr, bytes).await;
        let answer = answer.unwrap_or_else(|| panic!("{what} is still open"));
        assert!(!String::from_utf8_lossy(&answer).contains("200 OK"), "{what}");
    }
    // A head that is whole is answered, and the next one on its connection has the same limit.
    let mut calls = http1.to_vec();
    calls.extend(b"\r\nGET /healthz HTTP/1.1\r\nho");
    let answer = say(server.addr, &calls).await.expect("half a second head is still open");
    assert_eq!(String::from_utf8_lossy(&answer).matches("200 OK").count(), 1);
}

/// A body of one byte after another, long after each other, without end.
fn trickle(start: &'static [u8]) -> reqwest::Body {
    let rest = stream::repeat(b" ").then(|byte: &'static [u8; 1]| async move {
        tokio::time::sleep(Duration::from_millis(50)).await;
        Ok::<_, std::io::Error>(&byte[..])
    });
    reqwest::Body::wrap_stream(stream::iter([Ok(start)]).chain(rest))
}

#[tokio::test]
async fn bodies_that_trickle_are_refused_and_others_are_served_meanwhile() {
    let server = impatient(2_000).await;
    let client = reqwest::Client::new();
    let form = b"--b\r\ncontent-disposition: form-data; name=\"a.png\"\r\n\r\n";
    let uploads = join_all((0..50).map(|_| async {
        let request = client.post(server.url("/v1/scenes")).body(trickle(form));
        let request = request.header("content-type", "multipart/form-data; boundary=b");
        let answer = timeout(PATIENCE, request.send()).await.expect("an upload is still open");
        let answer = answer.expect("the refusal is sent");
        (answer.status().as_u16(), answer.text().await.unwrap())
    }));
    // All of them wait for the rest of their bodies while this is answered.
    let meanwhile = async {
        tokio::time::sleep(Duration::from_millis(500)).await;
        client.get(server.url("/healthz")).send().await.unwrap().status()
    };
    tokio::pin!(uploads, meanwhile);
    let healthy = tokio::select! {
        _ = &mut uploads => panic!("the uploads ended before /healthz was answered"),
        status = &mut meanwhile => status,
    };
    assert_eq!(healthy, 200);
    for (status, body) in uploads.await {
        assert_eq!(status, 504, "{body}");
        assert!(body.contains("deadline_exceeded") && body.contains("too slowly"), "{body}");
    }
}

#[tokio::test]
async fn json_and_grpc_that_trickle_are_refused_too() {
    let server = impatient(500).await;
    let id = server.scene().await.id;
    let query = server.url(&format!("/v1/scenes/{id}/query"));
    let request = reqwest::Client::new().post(query).body(trickle(b"{"));
    let answer = timeout(PATIENCE, request.send()).await.expect("an answer").unwrap();
    assert_eq!(answer.status(), 504, "{}", answer.text().await.unwrap());
    let h2 = reqwest::Client::builder().http2_prior_knowledge().build().unwrap();
    let request = h2.post(server.url("/segsplat.v1.SceneService/CreateScene"));
    let request = request.header("content-type", "application/grpc").header("te", "trailers");
    // The frame of a message of 64 KiB, of which almost nothing comes.
    let request = request.body(trickle(&[0, 0, 1, 0, 0]));
    let answer = timeout(PATIENCE, request.send()).await.expect("an answer").unwrap();
    assert_eq!(answer.headers()["segsplat-code"], "deadline_exceeded");
}
