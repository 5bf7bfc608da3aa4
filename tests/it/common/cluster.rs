//! Three replicas, an S3-compatible server and HAProxy, each a process of its own, on loopback.

use std::{
    io::{BufRead, BufReader, Read},
    net::TcpListener,
    path::PathBuf,
    process::{Child, ChildStdout, Command, Stdio},
};

use axum::{body::Body, extract::Request, response::IntoResponse};
use s3s::{auth::SimpleAuth, service::S3ServiceBuilder};

use super::{
    process::{Process, Start, eventually},
    root, skipped,
};

const BUCKET: &str = "scenes";
/// Both the key and its secret.
const KEY: &str = "only-for-tests";
/// The test that is the S3 server when it is told so by this variable.
const SERVER: &str = "common::cluster::s3_server";
const IS_SERVER: &str = "SEGSPLAT_TEST_S3_SERVER";
const LISTENS: &str = "S3 at ";

/// A child that does not outlive its test.
struct Helper(Child);

impl Drop for Helper {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// An S3-compatible server with one empty bucket, which checks signatures.
pub(crate) struct S3 {
    _server: Helper,
    /// Held open: the harness of the server's test writes there after a minute, and ends where
    /// nobody could read it.
    _said: BufReader<ChildStdout>,
    pub(crate) url: String,
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "the S3 server of other tests, which start it as a process"]
async fn s3_server() {
    if std::env::var_os(IS_SERVER).is_none() {
        return;
    }
    // It ends with the test that holds the other end, however that ends.
    std::thread::spawn(|| {
        let _ = std::io::stdin().read(&mut [0]);
        std::process::exit(0);
    });
    let folder = tempfile::tempdir().expect("a temporary folder");
    std::fs::create_dir(folder.path().join(BUCKET)).expect("a bucket");
    let files = s3s_fs::FileSystem::new(folder.path()).expect("a store of files");
    let mut s3 = S3ServiceBuilder::new(files);
    s3.set_auth(SimpleAuth::from_single(KEY, KEY));
    let s3 = s3.build();
    let app = axum::Router::new().fallback(async move |request: Request| {
        match s3.call(request.map(s3s::Body::http_body_unsync)).await {
            Ok(answer) => answer.map(Body::new),
            Err(error) => format!("{error:?}").into_response(),
        }
    });
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a free port");
    println!("{LISTENS}http://{}", listener.local_addr().expect("an address"));
    axum::serve(listener, app).await.expect("it serves");
}

fn target() -> PathBuf {
    std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| root().join("target"), PathBuf::from)
}

/// A port that was free a moment ago.
fn free_port() -> u16 {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
    listener.local_addr().expect("an address").port()
}

fn haproxy() -> Option<PathBuf> {
    let unpacked = target().join("tools/haproxy");
    let places = [unpacked, "/usr/sbin/haproxy".into(), "/usr/local/sbin/haproxy".into()];
    places.into_iter().find(|path| path.is_file())
}

impl S3 {
    /// Starts it.
    pub(crate) fn start() -> Self {
        let mut server = Command::new(std::env::current_exe().expect("this binary"))
            .args([SERVER, "--exact", "--ignored", "--nocapture"])
            .env(IS_SERVER, "1")
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("this binary starts");
        let mut said = BufReader::new(server.stdout.take().expect("piped"));
        let mut lines = said.by_ref().lines().map_while(Result::ok);
        let url = lines
            .find_map(|line| line.split_once(LISTENS).map(|(_, url)| url.to_owned()))
            .expect("the S3 server says where it listens");
        Self { _server: Helper(server), _said: said, url }
    }

    /// A replica with its scenes there.
    pub(crate) fn replica(&self, data: &std::path::Path, config: &std::path::Path) -> Start {
        Start::on(data)
            .arg("--config")
            .arg(&config.display().to_string())
            .arg("--store")
            .arg(&format!("s3://{BUCKET}/one"))
            .arg("--s3-endpoint")
            .arg(&self.url)
            .arg("--s3-allow-http")
            .env("AWS_ACCESS_KEY_ID", KEY)
            .env("AWS_SECRET_ACCESS_KEY", KEY)
            .env("AWS_REGION", "us-east-1")
    }
}

/// HAProxy before some replicas, as `docker/haproxy.cfg` sets it up.
pub(crate) struct Balancer {
    _proxy: Helper,
    pub(crate) url: String,
    _folder: tempfile::TempDir,
}

impl Balancer {
    /// Starts it; `None` (said on standard output) where it is not installed.
    pub(crate) async fn start(replicas: &[&Process]) -> Option<Self> {
        let Some(program) = haproxy() else {
            skipped("no haproxy (scripts/setup --ci gets it)");
            return None;
        };
        let folder = tempfile::tempdir().expect("a temporary folder");
        let port = free_port();
        // The product's own file, with the addresses of this test in place of those of compose.
        let text = std::fs::read_to_string(root().join("docker/haproxy.cfg")).expect("it is there");
        let mut text = text.replace("bind :8080", &format!("bind 127.0.0.1:{port}"));
        for (i, replica) in replicas.iter().enumerate() {
            let name = format!("replica{}:8080", i + 1);
            assert!(text.contains(&name), "docker/haproxy.cfg names {name}");
            text = text.replace(&name, replica.address());
        }
        let config = folder.path().join("haproxy.cfg");
        std::fs::write(&config, text).expect("written");
        let log = std::fs::File::create(folder.path().join("log")).expect("a log");
        let proxy = Command::new(program)
            .arg("-db")
            .arg("-f")
            .arg(&config)
            .stdout(Stdio::null())
            .stderr(log)
            .spawn()
            .expect("haproxy starts");
        let balancer = Self {
            _proxy: Helper(proxy),
            url: format!("http://127.0.0.1:{port}"),
            _folder: folder,
        };
        let (client, ready) = (crate::common::client(), format!("{}/readyz", balancer.url));
        eventually("the load balancer", async || {
            client.get(&ready).send().await.ok().filter(|answer| answer.status().is_success())
        })
        .await;
        Some(balancer)
    }
}
