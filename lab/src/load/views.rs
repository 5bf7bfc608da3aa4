//! Views of one scene, a new one each time.

use std::{
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use serde_json::{Value, json};

use super::{
    ask::Ask,
    door::{Connection, Door},
    library::{Bounds, Library},
    path::Path,
    photos::Photos,
    server::{Server, Servers, runtime},
    tally::Tally,
};
use crate::{
    error::{Error, Result},
    render::{Kinds, Samples},
    rows::{Rows, progress},
    scene::SceneStatus,
    setup::Setup,
};

/// Format that stands for asking again for a picture that the caller has: answered with 304.
const KNOWN: &str = "known";
/// Most callers, and most views of a row.
const CALLERS_MAX: u32 = 1024;
const VIEWS_MAX: u64 = 1_000_000;
/// Views of each row that are compared with the library's.
const COMPARED: u64 = 3;

/// What to ask for: a row for each combination of the lists.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// Scene folder whose photos make the scene
    photos_dir: PathBuf,
    /// Photos of the scene
    #[arg(long, default_value_t = 2)]
    photos: usize,
    #[command(flatten)]
    servers: Servers,
    /// Ways in
    #[arg(long, value_delimiter = ',', default_value = "http1")]
    doors: Vec<Door>,
    /// Kinds of pictures
    #[arg(long, value_delimiter = ',', default_value = "color")]
    kinds: Vec<String>,
    /// Formats; `known` asks for a PNG that the caller has, which is answered with 304
    #[arg(long, value_delimiter = ',', default_value = "png")]
    formats: Vec<String>,
    /// Callers at once
    #[arg(long, value_delimiter = ',', default_value = "1")]
    #[arg(value_parser = clap::value_parser!(u32).range(1..=i64::from(CALLERS_MAX)))]
    callers: Vec<u32>,
    /// Views a second, asked for by a clock and not when the last one has come; late answers count
    /// from when they were due
    #[arg(long)]
    rate: Option<f64>,
    /// Width in pixels
    #[arg(long, default_value_t = 256)]
    width: u32,
    /// Height in pixels
    #[arg(long, default_value_t = 256)]
    height: u32,
    /// Text of masks and relevancies
    #[arg(long, default_value = "fox")]
    text: String,
    /// Views of one call: over 1 by `POST /v1/scenes/{id}/views`, or `RenderViews` of gRPC
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=64))]
    together: u64,
    /// More parameters of each view over HTTP: `&error=2`
    #[arg(long, default_value = "")]
    more: String,
    /// Most views of a row
    #[arg(long, default_value_t = 2000)]
    #[arg(value_parser = clap::value_parser!(u64).range(1..=VIEWS_MAX))]
    views: u64,
    /// Longest time of a row, seconds
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// Number of the first view
    #[arg(long, default_value_t = 0)]
    first: u64,
    /// Threads of the load generator [default: a quarter of the cores]
    #[arg(long)]
    load_threads: Option<usize>,
    /// Leave the library's rate and the comparison with its pictures out
    #[arg(long)]
    no_library: bool,
    #[command(flatten)]
    setup: Setup,
}

/// Makes a row for each way in, kind, format and number of callers, and each server. Its error is
/// the share of calls that failed, and how far the pictures are from the library's.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    if !args.seconds.is_finite() || args.rate.is_some_and(|rate| !(rate > 0.0 && rate < 1e6)) {
        return Err(Error::invalid("seconds must be finite, and rate over 0 and under 1e6"));
    }
    if args.together > 1 && (!args.more.is_empty() || args.formats.iter().any(|f| f == KNOWN)) {
        return Err(Error::invalid("more and the format `known` are of single views"));
    }
    let upload = Photos::read(&args.photos_dir)?.upload(0, args.photos)?;
    let runtime = runtime(args.load_threads)?;
    let servers = runtime.block_on(args.servers.start(&args.setup))?;
    let eager = args.kinds.iter().any(|kind| pixels(kind).is_none());
    let semantics = if eager { "eager" } else { "off" };
    let mut scenes = Vec::new();
    for server in &servers {
        scenes.push(runtime.block_on(server.create(&upload, semantics))?);
    }
    let library = match args.no_library {
        true => None,
        false => Some(Library::open(&args.setup, &upload)?),
    };
    let bounds = Bounds { views: args.views, seconds: args.seconds };
    let mut first = args.first;
    for (kind, format) in args.kinds.iter().flat_map(|k| args.formats.iter().map(move |f| (k, f))) {
        for &callers in &args.callers {
            let callers = callers as usize;
            let path = path(&scenes[0], [args.width, args.height])?;
            let library_per_s = match (&library, pixels(kind)) {
                (Some(library), Some(kinds)) if format != KNOWN => {
                    Some(library.rate(&path, kinds, callers, first, bounds)?)
                }
                _ => None,
            };
            for &door in &args.doors {
                for (server, scene) in servers.iter().zip(&scenes) {
                    let ask = Ask {
                        scene: scene.id.to_string(),
                        kind: kind.clone(),
                        format: if format == KNOWN { "png".to_owned() } else { format.clone() },
                        text: args.text.clone(),
                        more: args.more.clone(),
                    };
                    progress(&format!("{} {} {kind} {format} {callers}", server.name, door.name()));
                    let (path, rate, together) = (path.clone(), args.rate, args.together);
                    let load = Load { ask, path, rate, together, first, bounds };
                    let known = format == KNOWN;
                    let asked = runtime.block_on(load.ask(server, door, callers, known));
                    let mut row = json!({
                        "load": "views",
                        "server": server.name,
                        "renderer": server.renderer,
                        "door": door.name(),
                        "kind": kind,
                        "format": format,
                        "width": args.width,
                        "height": args.height,
                        "callers": callers,
                        "together": args.together,
                        "rate": args.rate,
                        "library_per_s": library_per_s,
                    });
                    let error = match asked {
                        Ok((tally, per_s)) => {
                            merge(&mut row, tally.row());
                            row["views_per_s"] = json!(per_s);
                            row["of_library"] = json!(library_per_s.map(|library| per_s / library));
                            let compared = match &library {
                                Some(library) if !known => {
                                    runtime.block_on(load.compare(server, door, library))?
                                }
                                _ => Value::Null,
                            };
                            json!({ "failed": tally.failed_share(), "picture": compared })
                        }
                        Err(refused) => {
                            row["refused"] = json!(refused.message());
                            json!({ "failed": 1.0, "picture": null })
                        }
                    };
                    rows.push(error, row)?;
                }
                first += args.views + bounds.warm_up(callers);
            }
        }
    }
    Ok(())
}

fn merge(row: &mut Value, more: Value) {
    if let (Value::Object(row), Value::Object(more)) = (row, more) {
        row.extend(more);
    }
}

/// The way through the cameras of a scene.
fn path(scene: &SceneStatus, size: [u32; 2]) -> Result<Path> {
    let depth = scene.report.as_ref().map_or(0.0, |report| report.median_depth);
    Path::new(scene.cameras.iter().map(|camera| camera.camera).collect(), depth, size)
}

/// The library's pictures of a kind; none for those that need semantics.
fn pixels(kind: &str) -> Option<Kinds> {
    match kind {
        "color" => Some(Kinds::COLOR),
        "depth" => Some(Kinds { depth: true, ..Kinds::NONE }),
        "alpha" => Some(Kinds { alpha: true, ..Kinds::NONE }),
        _ => None,
    }
}

/// The views of one row.
#[derive(Clone, Debug)]
struct Load {
    ask: Ask,
    path: Path,
    rate: Option<f64>,
    /// Views of one call.
    together: u64,
    first: u64,
    bounds: Bounds,
}

impl Load {
    /// Asks with so many callers; what they got, and views a second. An error is the refusal of
    /// the first view.
    async fn ask(
        &self,
        server: &Server,
        door: Door,
        callers: usize,
        known: bool,
    ) -> Result<(Tally, f64)> {
        let mut connections = door.connect(&server.address, callers).await?;
        let first = self.path.camera(self.first)?;
        let answer = self.ask.view(&mut connections[0], &first, None).await?;
        let etag = answer.etag.filter(|_| known);
        let warm_up = Bounds { views: self.bounds.warm_up(callers), ..self.bounds };
        let (connections, _, _) =
            self.drive(connections, warm_up, self.first, etag.clone()).await?;
        let first = self.first + warm_up.views;
        let (_, tally, per_s) = self.drive(connections, self.bounds, first, etag).await?;
        Ok((tally, per_s))
    }

    /// Every connection is a caller: it takes the next views until a bound is met.
    async fn drive(
        &self,
        connections: Vec<Connection>,
        bounds: Bounds,
        first: u64,
        etag: Option<String>,
    ) -> Result<(Vec<Connection>, Tally, f64)> {
        let next = Arc::new(AtomicU64::new(0));
        let begun = Instant::now();
        let callers = connections.into_iter().map(|mut connection| {
            let (load, next, etag) = (self.clone(), Arc::clone(&next), etag.clone());
            tokio::spawn(async move {
                let mut tally = Tally::default();
                loop {
                    let n = next.fetch_add(load.together, Ordering::Relaxed);
                    let mut due = Instant::now();
                    if let Some(rate) = load.rate {
                        let clock = begun + Duration::from_secs_f64(n as f64 / rate);
                        if clock > due {
                            // The timer's own lateness is not the server's.
                            tokio::time::sleep_until(clock.into()).await;
                            due = Instant::now();
                        } else {
                            due = clock;
                        }
                    }
                    if n >= bounds.views || begun.elapsed().as_secs_f64() > bounds.seconds {
                        return Ok::<_, Error>((connection, tally));
                    }
                    let view = if etag.is_some() { load.first } else { first + n };
                    let cameras = view..view + load.together;
                    let cameras: Vec<_> =
                        cameras.map(|n| load.path.camera(n)).collect::<Result<_>>()?;
                    let answer = match &cameras[..] {
                        [camera] => load.ask.view(&mut connection, camera, etag.clone()).await,
                        cameras => load.ask.views(&mut connection, cameras).await,
                    };
                    match answer {
                        Ok(answer) => {
                            let timing = answer.timing.iter().map(String::as_str);
                            let bytes = answer.len() / cameras.len();
                            tally.answered(due.elapsed(), bytes, timing);
                        }
                        Err(error) => tally.failed(error.message().to_owned()),
                    }
                }
            })
        });
        let callers: Vec<_> = callers.collect();
        let (mut connections, mut all) = (Vec::new(), Tally::default());
        for caller in callers {
            let lost = |e| Error::internal("a caller panicked").caused_by(e);
            let (connection, tally) = caller.await.map_err(lost)??;
            connections.push(connection);
            all.add(tally);
        }
        let views = all.count() as f64 * self.together as f64;
        Ok((connections, all, views / begun.elapsed().as_secs_f64()))
    }

    /// How far some pictures are from the library's, levels of 8 bits; none for what is no picture
    /// of colour or alpha.
    async fn compare(&self, server: &Server, door: Door, library: &Library) -> Result<Value> {
        let kinds = match self.ask.kind.as_str() {
            kind @ ("color" | "alpha") => pixels(kind),
            _ => None,
        };
        let Some(kinds) = kinds else { return Ok(Value::Null) };
        let mut connections = door.connect(&server.address, 1).await?;
        let (mut most, mut squares, mut samples) = (0.0_f64, 0.0, 0.0);
        for n in 0..COMPARED {
            let camera = self.path.camera(self.first + n)?;
            let answer = self.ask.view(&mut connections[0], &camera, None).await?;
            let frame = library.draw(camera, kinds, Samples::F32)?;
            let want = match (&frame.color, &frame.alpha) {
                (Some(color), _) if kinds.color => color.as_flattened().to_vec(),
                (_, alpha) => alpha.clone().unwrap_or_default(),
            };
            let channels = if kinds.color { 3 } else { 1 };
            let got = samples_of(&self.ask.format, &answer.body(), channels)?;
            if got.len() != want.len() {
                let (got, want) = (got.len(), want.len());
                return Err(Error::invalid(format!("the picture has {got} samples, not {want}")));
            }
            for (got, want) in got.iter().zip(&want) {
                let apart = (f64::from(*got) - f64::from(want.clamp(0.0, 1.0)) * 255.0).abs();
                most = most.max(apart);
                squares += apart * apart;
                samples += 1.0;
            }
        }
        let psnr_db = 10.0 * (255.0 * 255.0 / (squares / samples).max(1e-12)).log10();
        Ok(json!({ "levels_max": most, "psnr_db": psnr_db }))
    }
}

/// The samples of a picture, 0..255.
fn samples_of(format: &str, file: &[u8], channels: usize) -> Result<Vec<f32>> {
    let unlike = |e| Error::invalid(format!("the {format} cannot be read")).caused_by(e);
    Ok(match format {
        "npy" => {
            let header = 10
                + usize::from(u16::from_le_bytes([
                    file.get(8).copied().unwrap_or_default(),
                    file.get(9).copied().unwrap_or_default(),
                ]));
            let data = file.get(header..).unwrap_or_default().as_chunks::<4>().0;
            data.iter().map(|v| f32::from_le_bytes(*v).clamp(0.0, 1.0) * 255.0).collect()
        }
        "rgb8" | "grey8" => file.iter().map(|v| f32::from(*v)).collect(),
        "rgba8" => {
            file.as_chunks::<4>().0.iter().flat_map(|p| [p[0], p[1], p[2]]).map(f32::from).collect()
        }
        _ => {
            let picture = image::load_from_memory(file).map_err(unlike)?;
            match channels {
                1 => picture.to_luma8().into_raw(),
                _ => picture.to_rgb8().into_raw(),
            }
            .into_iter()
            .map(f32::from)
            .collect()
        }
    })
}
