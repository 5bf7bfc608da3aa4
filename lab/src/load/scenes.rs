//! Scenes of two photos, posted by callers at once, and the mask of a text in each.

use std::{
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Instant,
};

use serde_json::json;

use super::{
    ask::Ask,
    door::{Connection, Door},
    photos::Photos,
    server::{Server, Servers, create, runtime},
    tally::Tally,
};
use crate::{
    error::{Error, Result},
    rows::{Rows, progress},
    scene::Upload,
    setup::Setup,
};

/// What to post: a row for each number of callers, and each server.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// Scene folder whose photos make the scenes
    photos_dir: PathBuf,
    /// Photos of a scene
    #[arg(long, default_value_t = 2)]
    photos: usize,
    #[command(flatten)]
    servers: Servers,
    /// Callers at once
    #[arg(long, value_delimiter = ',', default_value = "1")]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=256))]
    callers: Vec<u32>,
    /// When semantics are made: eager (with the scene), lazy (by the text) or off (no text)
    #[arg(long, default_value = "lazy", value_parser = ["eager", "lazy", "off"])]
    semantics: String,
    /// Text whose mask is asked for
    #[arg(long, default_value = "fox")]
    text: String,
    /// Most scenes of a row
    #[arg(long, default_value_t = 32, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    scenes: u32,
    /// Longest time of a row, seconds
    #[arg(long, default_value_t = 20.0)]
    seconds: f64,
    /// Scenes before the measured ones, of each caller
    #[arg(long, default_value_t = 1)]
    warm_up: usize,
    /// Threads of the load generator [default: a quarter of the cores]
    #[arg(long)]
    load_threads: Option<usize>,
    #[command(flatten)]
    setup: Setup,
}

/// Times of one row: to the scene, and to the mask of its first text.
#[derive(Debug, Default)]
struct Times {
    done: Tally,
    mask: Tally,
}

/// Makes the rows. Their error is the share of scenes and masks that failed.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    if !args.seconds.is_finite() {
        return Err(Error::invalid("seconds must be finite"));
    }
    let photos = Arc::new(Photos::read(&args.photos_dir)?);
    let runtime = runtime(args.load_threads)?;
    let servers = runtime.block_on(args.servers.start(&args.setup))?;
    let mut first = 0;
    for &callers in &args.callers {
        for server in &servers {
            progress(&format!("{} scenes {callers}", server.name));
            let callers = callers as usize;
            let warm_up = (callers * args.warm_up, f64::INFINITY);
            runtime.block_on(post(args, server, &photos, callers, first, warm_up))?;
            let next = first + warm_up.0 + callers;
            let bounds = (args.scenes as usize, args.seconds);
            let begun = Instant::now();
            let times = runtime.block_on(post(args, server, &photos, callers, next, bounds))?;
            let per_s = times.done.count() as f64 / begun.elapsed().as_secs_f64();
            let row = json!({
                "load": "scenes",
                "server": server.name,
                "renderer": server.renderer,
                "photos": args.photos,
                "semantics": args.semantics,
                "callers": callers,
                "scenes_per_s": per_s,
                "done": times.done.row(),
                "mask": times.mask.row(),
            });
            let error = json!({
                "failed": times.done.failed_share(),
                "masks_failed": times.mask.failed_share(),
            });
            rows.push(error, row)?;
        }
        first += (callers as usize) * (args.warm_up + 2) + args.scenes as usize;
    }
    Ok(())
}

/// Every caller posts scenes, from number `first` on, until a bound is met: their number, or
/// seconds.
async fn post(
    args: &Args,
    server: &Server,
    photos: &Arc<Photos>,
    callers: usize,
    first: usize,
    (scenes_max, seconds): (usize, f64),
) -> Result<Times> {
    let (next, begun) = (Arc::new(AtomicUsize::new(0)), Instant::now());
    let mut tasks = Vec::new();
    for _ in 0..callers {
        let mut connection = Connection::http(&server.address, Door::Http1)?;
        let (args, photos, next) = (args.clone(), Arc::clone(photos), Arc::clone(&next));
        tasks.push(tokio::spawn(async move {
            let mut times = Times::default();
            loop {
                let n = next.fetch_add(1, Ordering::Relaxed);
                if n >= scenes_max || begun.elapsed().as_secs_f64() > seconds {
                    return Ok::<_, Error>(times);
                }
                let upload = photos.upload(first + n, args.photos)?;
                one(&args, &mut connection, upload, &mut times).await;
            }
        }));
    }
    let mut all = Times::default();
    for task in tasks {
        let lost = |e| Error::internal("a caller panicked").caused_by(e);
        let times = task.await.map_err(lost)??;
        all.done.add(times.done);
        all.mask.add(times.mask);
    }
    Ok(all)
}

/// One scene, and the mask of its first text from the first camera.
async fn one(args: &Args, connection: &mut Connection, upload: Upload, times: &mut Times) {
    let (begun, bytes) = (Instant::now(), upload.size_bytes());
    let scene = match create(connection, upload, &args.semantics).await {
        Ok(scene) => scene,
        Err(error) => return times.done.failed(error.message().to_owned()),
    };
    let stages = scene.report.iter().flat_map(|report| &report.stages);
    let stages: Vec<String> = stages.map(|s| format!("{};dur={}", s.stage, s.ms)).collect();
    times.done.answered(begun.elapsed(), bytes, stages.iter().map(String::as_str));
    let Some(camera) = scene.cameras.first().filter(|_| args.semantics != "off") else { return };
    let ask = Ask {
        scene: scene.id.to_string(),
        kind: "mask".to_owned(),
        format: "png".to_owned(),
        text: args.text.clone(),
        more: "&wait_ms=60000".to_owned(),
    };
    match ask.view(connection, &camera.camera, None).await {
        Ok(answer) => {
            let timing = answer.timing.iter().map(String::as_str);
            times.mask.answered(begun.elapsed(), answer.len(), timing);
        }
        Err(error) => times.mask.failed(error.message().to_owned()),
    }
}
