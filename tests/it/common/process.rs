//! The program itself as a process of its own, with the small fixture bundle: to be killed, starved
//! and put behind a load balancer.

use std::{
    io::{BufRead, BufReader},
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use segsplat::{
    models::{NetworkOptions, Runtime},
    scene::{Upload, UploadCameras},
};
use serde_json::Value;

use super::{doors::form, root, skipped};

/// A child that does not outlive its test.
pub(crate) struct Process {
    child: Child,
    /// `http://…`, without a slash at the end.
    pub(crate) url: String,
    /// From the start to the line that says where it listens.
    pub(crate) started_in: Duration,
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
    }
}

/// Whether processes can make scenes here; says so where not.
pub(crate) fn can_serve() -> bool {
    let found = Runtime::load(&NetworkOptions::default()).is_ok();
    if !found {
        skipped("no ONNX Runtime (scripts/setup gets it)");
    }
    found
}

/// What a server is started with, beside the CPU renderer and a free port.
#[derive(Clone, Debug)]
pub(crate) struct Start {
    bundle: &'static str,
    /// A program that ends by running its last arguments, and its first ones.
    within: Vec<String>,
    args: Vec<String>,
    env: Vec<(String, String)>,
    log: Option<PathBuf>,
}

impl Start {
    /// A server on this data folder, with the fixture bundle `plane`.
    pub(crate) fn on(data: &Path) -> Self {
        let (within, args, env, log) = Default::default();
        let start = Self { bundle: "plane", within, args, env, log };
        start.arg("--data-dir").arg(&data.display().to_string())
    }

    /// With another of the fixture bundles.
    pub(crate) fn bundle(self, bundle: &'static str) -> Self {
        Self { bundle, ..self }
    }

    /// Started by another program, whose process it becomes.
    pub(crate) fn within(self, words: &[&str]) -> Self {
        Self { within: words.iter().map(|&word| word.to_owned()).collect(), ..self }
    }

    pub(crate) fn arg(mut self, arg: &str) -> Self {
        self.args.push(arg.to_owned());
        self
    }

    pub(crate) fn env(mut self, name: &str, value: &str) -> Self {
        self.env.push((name.to_owned(), value.to_owned()));
        self
    }

    /// With its log in this file.
    pub(crate) fn log(self, file: PathBuf) -> Self {
        Self { log: Some(file), ..self }
    }

    /// Starts it and waits until it listens; its log goes to `$SEGSPLAT_TEST_LOG`, else nowhere.
    /// `$SEGSPLAT_TEST_BINARY` is started in place of the program built with the tests.
    pub(crate) fn start(&self) -> Process {
        let program = std::env::var_os("SEGSPLAT_TEST_BINARY");
        let built = || env!("CARGO_BIN_EXE_segsplat").into();
        let words = self.within.iter().map(Into::into);
        let mut words = words.chain([program.unwrap_or_else(built)]);
        let mut command = Command::new(words.next().expect("the program at least"));
        command.args(words);
        for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("SEGSPLAT_")) {
            command.env_remove(name);
        }
        let bundle = root().join("tests/fixtures").join(self.bundle);
        let log = std::env::var_os("SEGSPLAT_TEST_LOG").map(PathBuf::from);
        let log = self.log.clone().or(log).map_or_else(Stdio::null, |path| {
            let file = std::fs::OpenOptions::new().create(true).append(true).open(path);
            file.expect("the log can be written").into()
        });
        let begun = Instant::now();
        let mut child = command
            .current_dir(root())
            .args(["serve", "--listen", "127.0.0.1:0", "--json", "--renderer", "cpu", "--bundle"])
            .arg(bundle)
            .args(&self.args)
            // Versions of scenes come where a test asks for them.
            .env("SEGSPLAT_REFINE", "off")
            .envs(self.env.iter().map(|(name, value)| (name, value)))
            .stdout(Stdio::piped())
            .stderr(log)
            .spawn()
            .expect("the program starts");
        let mut line = String::new();
        let stdout = child.stdout.take().expect("piped");
        BufReader::new(stdout).read_line(&mut line).expect("the server speaks");
        let said: Value = serde_json::from_str(&line)
            .unwrap_or_else(|e| panic!("no server with {:?}: {e}: {line:?}", self.args));
        let url = said["listening"].as_str().expect("an address").to_owned();
        Process { child, url, started_in: begun.elapsed() }
    }
}

/// Sends a signal to a process; whether it was there. By the shell's own `kill`: a bare Debian has
/// no other.
pub(crate) fn signal(pid: u32, name: &str) -> bool {
    let sent = Command::new("sh").args(["-c", &format!("kill -{name} {pid}")]).status();
    sent.is_ok_and(|status| status.success())
}

impl Process {
    /// `kill -9`, and waits until it is gone.
    pub(crate) fn kill(&mut self) {
        // One that is gone already is as dead.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// `kill -9` of a server that others still call.
    pub(crate) fn kill_now(&self) {
        signal(self.child.id(), "KILL");
    }

    /// SIGTERM, and waits for the end; whether it ended well.
    pub(crate) fn stop(mut self) -> bool {
        signal(self.child.id(), "TERM") && self.child.wait().is_ok_and(|end| end.success())
    }

    pub(crate) fn url(&self, path: &str) -> String {
        format!("{}{path}", self.url)
    }

    pub(crate) fn id(&self) -> u32 {
        self.child.id()
    }

    /// Host and port.
    pub(crate) fn address(&self) -> &str {
        self.url.trim_start_matches("http://")
    }

    /// Resident bytes.
    pub(crate) fn resident(&self) -> u64 {
        self.memory("VmRSS:")
    }

    /// The most bytes that were ever resident.
    pub(crate) fn peak(&self) -> u64 {
        self.memory("VmHWM:")
    }

    fn memory(&self, name: &str) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id()));
        let status = status.expect("the process lives");
        let line = status.lines().find(|line| line.starts_with(name)).expect("the line");
        let kib: u64 = line.split_whitespace().nth(1).and_then(|n| n.parse().ok()).expect("kB");
        kib << 10
    }
}

/// What a call answered: status and JSON, or why there was no answer.
pub(crate) type Answer = Result<(u16, Value), reqwest::Error>;

/// `POST /v1/scenes`, waiting at most so long for the scene.
pub(crate) async fn create(
    client: &reqwest::Client,
    base: &str,
    upload: &Upload,
    wait_ms: u64,
    key: Option<&str>,
) -> Answer {
    let mut request = client.post(format!("{base}/v1/scenes?wait_ms={wait_ms}"));
    if let Some(key) = key {
        request = request.header("idempotency-key", key);
    }
    answer(request.multipart(form(upload))).await
}

/// Some photos of an upload with a `transforms.json`, and their cameras.
pub(crate) fn photos_of(upload: &Upload, photos: &[usize]) -> Upload {
    let Some(UploadCameras::Transforms(json)) = &upload.cameras else { panic!("no transforms") };
    let mut transforms: Value = serde_json::from_slice(json).expect("JSON");
    let frames = transforms["frames"].as_array().expect("a list").clone();
    transforms["frames"] = photos.iter().map(|&i| frames[i].clone()).collect();
    Upload {
        cameras: Some(UploadCameras::Transforms(transforms.to_string().into_bytes())),
        photos: photos.iter().map(|&i| upload.photos[i].clone()).collect(),
        ..Upload::default()
    }
}

/// `POST` of JSON.
pub(crate) async fn post(client: &reqwest::Client, url: &str, body: &Value) -> Answer {
    answer(client.post(url).json(body)).await
}

/// `GET` of JSON.
pub(crate) async fn get(client: &reqwest::Client, url: &str) -> Answer {
    answer(client.get(url)).await
}

/// `DELETE`; the status.
pub(crate) async fn delete(client: &reqwest::Client, url: &str) -> Result<u16, reqwest::Error> {
    Ok(client.delete(url).send().await?.status().as_u16())
}

/// The bytes of a 200, else its status.
pub(crate) async fn bytes(
    client: &reqwest::Client,
    url: &str,
) -> Result<Result<Vec<u8>, u16>, reqwest::Error> {
    let answer = client.get(url).send().await?;
    let status = answer.status();
    let body = answer.bytes().await?;
    Ok(if status.is_success() { Ok(body.to_vec()) } else { Err(status.as_u16()) })
}

async fn answer(request: reqwest::RequestBuilder) -> Answer {
    let answer = request.send().await?;
    let status = answer.status().as_u16();
    let body = answer.bytes().await?;
    Ok((status, serde_json::from_slice(&body).unwrap_or(Value::Null)))
}

/// Waits until `what` gives something, or fails after a minute.
pub(crate) async fn eventually<T>(why: &str, mut what: impl AsyncFnMut() -> Option<T>) -> T {
    let begun = Instant::now();
    loop {
        if let Some(found) = what().await {
            return found;
        }
        assert!(begun.elapsed() < Duration::from_secs(60), "{why}: not within a minute");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

/// Long forms run with `RUN_SLOW_TESTS=1`.
pub(crate) fn long() -> bool {
    std::env::var("RUN_SLOW_TESTS").is_ok_and(|v| v == "1")
}
