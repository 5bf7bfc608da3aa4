//! `segsplat add`: photos of a folder or an archive join a scene of a running server.

use std::{borrow::Cow, collections::BTreeMap, path::PathBuf, time::Duration};

use reqwest::{Client, RequestBuilder, Url, header};
use serde_json::Value;

use super::{output::Output, scene_file::unreadable};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, ErrorCode, Result},
    formats::captures::find_in_dir,
    limits::Limits,
    scene::{GrowthState, SceneError, SceneId, SceneStatus},
    store::sha256,
};

/// Time between two looks whether the photos have joined.
const LOOK: Duration = Duration::from_millis(300);

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    /// Id of the scene
    scene: SceneId,
    /// Folder of a capture whose poses are in the frame of the scene, or a zip or tar of one
    photos: PathBuf,
    /// Address of the server
    #[arg(long, env = "SEGSPLAT_URL", default_value = "http://127.0.0.1:8080", value_name = "URL")]
    server: String,
    /// Key of the server, where it asks for one
    #[arg(long, env = "SEGSPLAT_API_KEY", hide_env_values = true, value_name = "KEY")]
    api_key: Option<String>,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

/// The body of the call.
struct Body {
    kind: String,
    bytes: Vec<u8>,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let body = match args.photos.is_dir() {
        true => form(args, &config.limits)?,
        false => {
            let bytes = fs_err::read(&args.photos).map_err(|e| unreadable(&args.photos, e))?;
            Body { kind: "application/octet-stream".to_owned(), bytes }
        }
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(|e| Error::internal("no thread for the call").caused_by(e))?;
    let status = runtime.block_on(added(args, body, out))?;
    let (version, photos) = (status.version, status.cameras.len());
    out.answer(&format!("scene {}, version {version}: {photos} photos", status.id), &status)
}

/// The photos of a folder, their masks and its files of cameras, as a form.
fn form(args: &Args, limits: &Limits) -> Result<Body> {
    let limits = Limits { photos_min: 1, ..limits.clone() };
    let (found, cameras) = find_in_dir(&args.photos, &limits)?;
    let mut files = BTreeMap::new();
    for photo in &found.photos {
        files.insert(&*photo.path, photo.bytes.read()?);
        // Several photos may have one mask.
        if let Some(mask) = &photo.mask {
            files.insert(&*mask.path, mask.bytes.read()?);
        }
    }
    files.extend(cameras.iter().map(|file| (&*file.name, Cow::from(&file.bytes))));
    let all: Vec<u8> = files.values().flat_map(|bytes| sha256(bytes).into_bytes()).collect();
    // No file holds the hash of all of them.
    let boundary = sha256(&all);
    let mut bytes = Vec::new();
    for (name, file) in files {
        let name = name.replace('"', "%22").replace(['\r', '\n'], " ");
        let head = format!(
            "--{boundary}\r\ncontent-disposition: form-data; name=\"photo\"; \
             filename=\"{name}\"\r\n\r\n"
        );
        bytes.extend(head.into_bytes());
        bytes.extend_from_slice(&file);
        bytes.extend(b"\r\n");
    }
    bytes.extend(format!("--{boundary}--\r\n").into_bytes());
    Ok(Body { kind: format!("multipart/form-data; boundary={boundary}"), bytes })
}

/// Sends the photos and waits until they have joined the scene.
async fn added(args: &Args, body: Body, out: &Output) -> Result<SceneStatus> {
    let scene = format!("v1/scenes/{}", args.scene);
    let url = |path: &str| {
        let whole = format!("{}/{path}", args.server.trim_end_matches('/'));
        whole.parse::<Url>().map_err(|e| Error::invalid(format!("--server: {e}")))
    };
    let client = Client::new();
    let sent = client.post(url(&format!("{scene}/photos"))?);
    let sent = sent.header(header::CONTENT_TYPE, body.kind).body(body.bytes);
    let mut status = answer(args, sent).await?;
    while status.is_growing() {
        let stage = status.growth.stage.as_deref().unwrap_or("waiting");
        out.progress(stage, status.growth.fraction);
        tokio::time::sleep(LOOK).await;
        status = answer(args, client.get(url(&scene)?)).await?;
    }
    match (&status.growth.state, &status.growth.error) {
        (GrowthState::Failed, Some(error)) => Err(error.to_error()),
        _ => Ok(status),
    }
}

/// The scene that a call answers, or its error.
async fn answer(args: &Args, request: RequestBuilder) -> Result<SceneStatus> {
    let keyed = args.api_key.iter().fold(request, |request, key| request.bearer_auth(key));
    let unreachable = |e: reqwest::Error| {
        let why = format!("no answer from {}: {}", args.server, e.without_url());
        Error::new(ErrorCode::Stopping, why)
    };
    let answer = keyed.send().await.map_err(unreachable)?;
    let code = answer.status();
    let body = answer.bytes().await.map_err(unreachable)?;
    let told: Value = serde_json::from_slice(&body).unwrap_or_default();
    if code.is_success() {
        let foreign =
            |e| Error::internal(format!("{} is no such server", args.server)).caused_by(e);
        return serde_json::from_value(told).map_err(foreign);
    }
    match serde_json::from_value::<SceneError>(told) {
        Ok(error) => Err(error.to_error()),
        Err(_) => Err(Error::internal(format!("{} answers {code}", args.server))),
    }
}
