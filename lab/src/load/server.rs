//! The servers that are asked: started here on a free port of loopback, or running already.

use std::{
    io::{BufRead as _, BufReader},
    path::PathBuf,
    process::{Child, Command, Stdio},
    time::Duration,
};

use tempfile::TempDir;

use super::{
    door::{Connection, Door, json},
    photos::form,
};
use crate::{
    error::{Error, Result},
    scene::{SceneState, SceneStatus, Upload},
    setup::Setup,
};

/// Longest wait for a scene, its semantics among it.
const WAIT_MS: u64 = 300_000;

/// Looks at whether a server's networks are open, so far apart. A device takes half a minute.
const READY_LOOKS: u32 = 18_000;
const READY_EVERY: Duration = Duration::from_millis(10);

/// A runtime with few threads: the cores belong to the server.
pub(super) fn runtime(threads: Option<usize>) -> Result<tokio::runtime::Runtime> {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(threads.unwrap_or(cores / 4).max(1))
        .enable_all()
        .build()
        .map_err(|e| Error::internal("the async runtime does not start").caused_by(e))
}

/// Which servers.
#[derive(Clone, Debug, clap::Args)]
pub(super) struct Servers {
    /// Program to start and ask, as NAME=PATH or PATH; several run one after the other
    #[arg(long = "server", value_name = "[NAME=]PATH", required_unless_present = "url")]
    programs: Vec<String>,
    /// Address of a server that runs already on this machine: 127.0.0.1:PORT
    #[arg(long, value_name = "HOST:PORT", conflicts_with = "programs")]
    url: Option<String>,
    /// More arguments of `serve`, separated by blanks
    #[arg(long, default_value = "", allow_hyphen_values = true)]
    serve: String,
}

/// A server that answers; one that was started here ends with this value.
#[derive(Debug)]
pub(super) struct Server {
    /// What rows call it.
    pub(super) name: String,
    /// Host and port.
    pub(super) address: String,
    /// What draws its views.
    pub(super) renderer: String,
    started: Option<(Child, TempDir)>,
}

impl Drop for Server {
    fn drop(&mut self) {
        if let Some((child, _)) = &mut self.started {
            // It may have ended already.
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

impl Servers {
    /// All servers, ready to be asked.
    pub(super) async fn start(&self, setup: &Setup) -> Result<Vec<Server>> {
        let mut servers = Vec::new();
        for program in &self.programs {
            servers.push(self.run(program, setup)?);
        }
        if let Some(address) = &self.url {
            let address = address.trim_start_matches("http://").trim_end_matches('/').to_owned();
            let name = "running".to_owned();
            servers.push(Server { name, address, renderer: String::new(), started: None });
        }
        for server in &mut servers {
            server.wait_until_ready().await?;
        }
        Ok(servers)
    }

    /// The programs to start.
    ///
    /// # Errors
    /// `invalid_request` where there is none.
    pub(super) fn programs(&self) -> Result<&[String]> {
        match self.programs.is_empty() {
            true => Err(Error::invalid("--server must name a program to start")),
            false => Ok(&self.programs),
        }
    }

    /// Starts a program; it listens when this returns.
    pub(super) fn run(&self, program: &str, setup: &Setup) -> Result<Server> {
        let (name, path) = match program.split_once('=') {
            Some((name, path)) => (name.to_owned(), PathBuf::from(path)),
            None => ("segsplat".to_owned(), PathBuf::from(program)),
        };
        let fault = |what: &str| Error::invalid(format!("server {name:?} {what}"));
        let folder = tempfile::tempdir()
            .map_err(|e| Error::internal("there is no temporary folder").caused_by(e))?;
        let mut child = Command::new(path)
            .args(["serve", "--listen", "127.0.0.1:0", "--log", "warn", "--data-dir"])
            .arg(folder.path())
            .args(setup.serve_args())
            .args(self.serve.split_whitespace())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|e| fault("does not start").caused_by(e))?;
        let lines = child.stdout.take().map(BufReader::new).into_iter().flat_map(|out| out.lines());
        let address = lines.map_while(|line| line.ok()).find_map(|line| {
            line.strip_prefix("listening on http://").map(|address| address.trim().to_owned())
        });
        let Some(address) = address else {
            let _ = child.kill();
            let _ = child.wait();
            return Err(fault("ended before it listened; its log says why"));
        };
        Ok(Server { name, address, renderer: String::new(), started: Some((child, folder)) })
    }
}

impl Server {
    /// Waits until its networks are open.
    pub(super) async fn wait_until_ready(&mut self) -> Result<()> {
        let connection = Connection::http(&self.address, Door::Http1)?;
        for _ in 0..READY_LOOKS {
            let state = json(connection.get("/readyz")?).await;
            if state.is_ok_and(|state| state["networks"] == "open") {
                let models = json(connection.get("/v1/models")?).await?;
                models["renderer"].as_str().unwrap_or("?").clone_into(&mut self.renderer);
                return Ok(());
            }
            tokio::time::sleep(READY_EVERY).await;
        }
        Err(Error::invalid(format!("server {:?} did not get ready in three minutes", self.name)))
    }

    /// Posts an upload and waits for the scene, and for its semantics where it has them `eager`.
    pub(super) async fn create(&self, upload: &Upload, semantics: &str) -> Result<SceneStatus> {
        let connection = Connection::http(&self.address, Door::Http1)?;
        create(&connection, upload.clone(), semantics).await
    }
}

/// Posts an upload on a connection and waits for the scene.
pub(super) async fn create(
    connection: &Connection,
    upload: Upload,
    semantics: &str,
) -> Result<SceneStatus> {
    let target = format!("/v1/scenes?semantics={semantics}&wait_ms={WAIT_MS}");
    let answer = json(connection.post(&target)?.multipart(form(upload))).await?;
    let unlike = |e| Error::internal("the server's answer is no scene").caused_by(e);
    let status: SceneStatus = serde_json::from_value(answer).map_err(unlike)?;
    if status.state != SceneState::Done {
        return Err(Error::invalid(format!("the scene is {}", status.state)));
    }
    Ok(status)
}
