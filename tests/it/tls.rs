//! TLS: one port, HTTP/1.1, HTTP/2 and gRPC by ALPN; slow handshakes hold nobody up.

use std::path::{Path, PathBuf};

use futures_util::future::join_all;
use reqwest::{Certificate, Version, tls};
use segsplat::{api::Server, keys::key_sha256};
use tokio::net::{TcpListener, TcpStream};

use crate::common::cpu_server::{CpuServer, PlaneNetworks};

struct Files {
    folder: tempfile::TempDir,
    root: Certificate,
}

impl Files {
    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }
}

/// A certificate for `localhost`, signed by itself.
fn files() -> Files {
    let folder = tempfile::tempdir().unwrap();
    let root = write_certificate(folder.path());
    Files { folder, root }
}

/// Writes a new certificate and its key into a folder.
fn write_certificate(folder: &Path) -> Certificate {
    let made = rcgen::generate_simple_self_signed(vec!["localhost".to_owned()]).unwrap();
    std::fs::write(folder.join("cert.pem"), made.cert.pem()).unwrap();
    std::fs::write(folder.join("key.pem"), made.signing_key.serialize_pem()).unwrap();
    Certificate::from_pem(made.cert.pem().as_bytes()).unwrap()
}

async fn stand(files: &Files) -> CpuServer {
    let (cert, key) = (files.path("cert.pem"), files.path("key.pem"));
    CpuServer::with(PlaneNetworks::default(), |config| {
        config.tls_cert = Some(cert);
        config.tls_key = Some(key);
    })
    .await
}

#[tokio::test]
async fn one_port_speaks_http_1_http_2_and_grpc_over_tls() {
    let files = files();
    let stand = stand(&files).await;
    let url = |path: &str| format!("https://localhost:{}{path}", stand.addr.port());
    let trusting = || crate::common::client_builder().tls_certs_only([files.root.clone()]);
    // Nobody speaks on these two; the others are served all the same.
    let silent = [TcpStream::connect(stand.addr).await, TcpStream::connect(stand.addr).await];

    let first = trusting().http1_only().build().unwrap();
    let answer = first.get(url("/readyz")).send().await.unwrap();
    assert_eq!((answer.status().as_u16(), answer.version()), (200, Version::HTTP_11));
    let second = trusting().build().unwrap();
    let answer = second.get(url("/readyz")).send().await.unwrap();
    assert_eq!((answer.status().as_u16(), answer.version()), (200, Version::HTTP_2));

    // An empty ListScenesRequest: not compressed, 0 bytes.
    let call = second.post(url("/segsplat.v1.SceneService/ListScenes")).body(vec![0_u8; 5]);
    let call = call.header("content-type", "application/grpc").header("te", "trailers");
    let answer = call.send().await.unwrap();
    assert_eq!(answer.headers()["content-type"], "application/grpc");
    assert!(answer.headers().get("grpc-status").is_none_or(|status| status == "0"));
    assert_eq!(answer.bytes().await.unwrap()[0], 0, "a message");

    let plain = crate::common::client().get(format!("http://{}/readyz", stand.addr)).send().await;
    assert!(plain.is_err(), "plain HTTP is answered on a TLS port");
    let strange = crate::common::client_builder().tls_certs_only([]).build().unwrap();
    assert!(strange.get(url("/readyz")).send().await.is_err(), "the certificate is not checked");
    drop(silent);
    stand.stop().await;
}

#[tokio::test]
async fn tls_1_2_and_tls_1_3_are_spoken() {
    let files = files();
    let stand = stand(&files).await;
    let url = format!("https://localhost:{}/readyz", stand.addr.port());
    for version in [tls::Version::TLS_1_2, tls::Version::TLS_1_3] {
        let client = crate::common::client_builder().tls_certs_only([files.root.clone()]);
        let client = client.tls_version_min(version).tls_version_max(version).build().unwrap();
        let answer = client.get(&url).send().await;
        assert!(answer.is_ok_and(|answer| answer.status() == 200), "{version:?}");
    }
    stand.stop().await;
}

#[tokio::test]
async fn silent_connections_delay_no_handshake() {
    let files = files();
    let stand = stand(&files).await;
    let silent = join_all((0..300).map(|_| TcpStream::connect(stand.addr))).await;
    let client = crate::common::client_builder().tls_certs_only([files.root.clone()]);
    let url = format!("https://localhost:{}/readyz", stand.addr.port());
    let answer = client.build().unwrap().get(url).send().await.unwrap();
    assert_eq!(answer.status(), 200);
    // It was answered while each of them could still begin its handshake.
    for stream in silent {
        let fault = stream.expect("a connection").try_read(&mut [0]).expect_err("it is open");
        assert_eq!(fault.kind(), std::io::ErrorKind::WouldBlock);
    }
    stand.stop().await;
}

#[tokio::test]
async fn a_certificate_that_cannot_be_used_is_named_and_its_key_is_not_shown() {
    let files = files();
    for (name, text, want) in [
        ("cert.pem", "rubbish", "tls_cert"),
        ("key.pem", "-----BEGIN PRIVATE KEY-----\nSECRET\n-----END PRIVATE KEY-----", "tls_key"),
    ] {
        let good = std::fs::read(files.path(name)).unwrap();
        std::fs::write(files.path(name), text).unwrap();
        let mut config = segsplat::config::Config::default();
        config.data_dir = files.path("data");
        config.tls_cert = Some(files.path("cert.pem"));
        config.tls_key = Some(files.path("key.pem"));
        let parts = segsplat::service::Parts {
            scenes: std::sync::Arc::new(PlaneNetworks::default()),
            semantics: std::sync::Arc::new(segsplat::jobs::NoSemantics),
            renderer: std::sync::Arc::new(crate::common::server::PointRenderer),
            models: segsplat::service::ModelsInfo::default(),
        };
        let place = segsplat::store::StoreLocation::of(&config).unwrap();
        let service = segsplat::service::Service::open(&place, config, parts).unwrap();
        let error = segsplat::api::Server::new(service).expect_err("refused");
        assert!(error.message().contains(want), "{error}");
        assert!(!error.message().contains("SECRET"), "{error}");
        std::fs::write(files.path(name), good).unwrap();
    }
}

/// A file with one key of this secret.
fn write_key(path: &Path, secret: &str) {
    let sha256 = key_sha256(secret);
    let text = format!("[[key]]\nname = \"a\"\nsha256 = \"{sha256}\"\nscopes = [\"read\"]\n");
    std::fs::write(path, text).unwrap();
}

#[tokio::test]
async fn keys_limits_and_certificate_change_together_or_not_at_all() {
    let files = files();
    let keys = files.path("keys.toml");
    write_key(&keys, "old");
    let (cert, key) = (files.path("cert.pem"), files.path("key.pem"));
    let stand = CpuServer::with(PlaneNetworks::default(), |config| {
        (config.tls_cert, config.tls_key) = (Some(cert), Some(key));
        config.keys = Some(keys.clone());
    })
    .await;
    let server = Server::new(stand.service.clone()).unwrap();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = listener.local_addr().unwrap().port();
    tokio::spawn(server.clone().serve(listener, std::future::pending()));
    // What a new connection that trusts this certificate is told with this key; `None`: it meets
    // another certificate.
    let status = async |root: &Certificate, secret: &str| {
        let client = crate::common::client_builder().tls_certs_only([root.clone()]);
        let url = format!("https://localhost:{port}/v1/scenes");
        let answer = client.build().unwrap().get(url).bearer_auth(secret).send().await;
        answer.ok().map(|answer| answer.status().as_u16())
    };
    let page_max = || stand.service.limits().page_max;
    let mut config = stand.service.config().clone();
    let old_page = page_max();
    assert_eq!(status(&files.root, "old").await, Some(200));
    config.limits.page_max = 7;
    for bad in ["keys.toml", "cert.pem", "key.pem"] {
        // All are new, and one of them cannot be used.
        let new_root = write_certificate(files.folder.path());
        write_key(&keys, "new");
        std::fs::write(files.path(bad), "rubbish").unwrap();
        server.reload(&config).expect_err(bad);
        assert_eq!(status(&files.root, "old").await, Some(200), "{bad}");
        assert_eq!(status(&files.root, "new").await, Some(401), "{bad}");
        assert_eq!(status(&new_root, "old").await, None, "{bad}");
        assert_eq!(page_max(), old_page, "{bad}");
    }
    let new_root = write_certificate(files.folder.path());
    write_key(&keys, "new");
    server.reload(&config).unwrap();
    assert_eq!(status(&new_root, "new").await, Some(200));
    assert_eq!(status(&new_root, "old").await, Some(401));
    assert_eq!(status(&files.root, "new").await, None, "new connections get the new certificate");
    assert_eq!(page_max(), 7);
}
