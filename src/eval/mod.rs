//! How good the scenes are on posed photographs: `segsplat eval DIR`; what thinning costs them:
//! [`density`]; what texts select in them: [`semantics`]; whether images find their names:
//! [`words`].
//!
//! Every triple (two inputs, a target between them) goes through the product's own road:
//! undistortion, capture analysis, the shipped network, lifting, the CPU renderer. Beside PSNR and
//! SSIM stands the *hindsight warp*: the best PSNR that a constant-depth warp of either input
//! reaches when the depth is chosen knowing the answer.

pub mod density;
pub mod masks;
mod metrics;
mod pictures;
mod report;
pub mod semantics;
mod triples;
mod warp;
pub mod words;

use std::{
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, AtomicUsize, Ordering},
    time::Instant,
};

use rayon::prelude::*;

use crate::{
    config::Config,
    error::{Error, Result},
    limits::Limits,
    models::fit,
    photos,
    pipeline::{Engine, Reconstruction, reconstruct},
    render::{Kinds, RenderRequest, Renderer, ViewPlanner, cpu::CpuRenderer, plan::default_near},
    scene::{Camera, Photo, PosedPhoto, Provenance, Scene, SceneId, SceneMeta, SceneOptions},
};

pub use metrics::{psnr, ssim};
pub use report::{EvalReport, SceneReport, TripleReport};
pub use triples::{Triple, triples};
pub use warp::hindsight_warp;

/// Side of the evaluated pictures, pixels.
pub const SIDE: u32 = 256;

/// What to evaluate.
#[derive(Clone, Debug)]
pub struct EvalOptions {
    /// A scene folder (with `transforms.json`), or a folder of scene folders.
    pub dir: PathBuf,
    /// Names of the scenes to take; empty: all.
    pub scenes: Vec<String>,
    /// Photos in: 2 (the pair) or 4 (the pair and the next two nearest to the target).
    pub photos: usize,
    /// Triples at work at the same time; each has its share of the configured threads.
    pub at_once: usize,
    /// Take every n-th triple only, for a quick look; 1: all.
    pub every: usize,
    /// Folder for picture grids, one a scene.
    pub pictures: Option<PathBuf>,
}

/// Evaluates; `done` hears of each scene as it finishes.
///
/// # Errors
/// `invalid_request` when there is no scene or an option is out of range, else whatever a stage of
/// the pipeline says, with scene and triple named.
pub fn run(
    config: &Config,
    options: &EvalOptions,
    done: &dyn Fn(&SceneReport),
) -> Result<EvalReport> {
    if options.photos < 2 || options.at_once == 0 || options.every == 0 {
        return Err(Error::invalid(format!(
            "eval: {} photos, {} at once, every {}: it must be at least 2, 1 and 1",
            options.photos, options.at_once, options.every
        )));
    }
    let at_once = options.at_once.min(config.threads);
    let config = Config { jobs: at_once, ..config.clone() };
    let engine = Engine::open(&config.networks())?;
    let renderer = CpuRenderer::new((config.threads / at_once).max(1))?;
    let mut scenes = Vec::new();
    for dir in scene_dirs(&options.dir, &options.scenes)? {
        let name = dir.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let squares = squares(&dir, &config.limits)?;
        let cameras: Vec<Camera> = squares.iter().map(|p| p.camera).collect();
        let chosen: Vec<Triple> = triples(&cameras).into_iter().step_by(options.every).collect();
        let judged = each(&chosen, at_once, |triple| {
            judge(&engine, &renderer, &squares, triple, options.photos).map_err(|e| {
                let target = &squares[triple.target].file;
                Error::new(e.code(), format!("{name}, target {target}: {e}")).caused_by(e)
            })
        })?;
        if let Some(out) = &options.pictures {
            pictures::write(out, &name, &squares, &judged)?;
        }
        let report = SceneReport::new(name, judged.into_iter().map(|j| j.report).collect());
        done(&report);
        scenes.push(report);
    }
    Ok(EvalReport::new(
        scenes,
        options.photos,
        engine.geometry().provider().name(),
        &renderer.name(),
    ))
}

/// `work` of each item, `at_once` at a time, in the items' order.
///
/// Threads of its own: a rayon worker that waits for another pool takes up the next item, and
/// then one item's time would hold another's.
fn each<T: Sync, U: Send>(
    items: &[T],
    at_once: usize,
    work: impl Fn(&T) -> Result<U> + Sync,
) -> Result<Vec<U>> {
    let next = AtomicUsize::new(0);
    let found = std::thread::scope(|scope| -> Result<Vec<(usize, U)>> {
        let one = || -> Result<Vec<(usize, U)>> {
            let mut mine = Vec::new();
            while let Some((i, item)) =
                Some(next.fetch_add(1, Ordering::Relaxed)).and_then(|i| Some((i, items.get(i)?)))
            {
                mine.push((i, work(item)?));
            }
            Ok(mine)
        };
        let workers: Vec<_> = (0..at_once).map(|_| scope.spawn(one)).collect();
        let mut all = Vec::new();
        for worker in workers {
            all.extend(worker.join().map_err(|_| Error::internal("eval: a worker panicked"))??);
        }
        Ok(all)
    });
    let mut found = found?;
    found.sort_by_key(|(i, _)| *i);
    Ok(found.into_iter().map(|(_, made)| made).collect())
}

/// One triple, judged, with what the picture grid shows.
struct Judged {
    inputs: Vec<usize>,
    target: usize,
    color: Vec<[f32; 3]>,
    depth: Vec<f32>,
    report: TripleReport,
}

fn judge(
    engine: &Engine,
    renderer: &CpuRenderer,
    squares: &[PosedPhoto],
    triple: &Triple,
    photos: usize,
) -> Result<Judged> {
    let inputs = triple.inputs(squares, photos);
    let given: Vec<PosedPhoto> = inputs.iter().map(|&i| squares[i].clone()).collect();
    let start = Instant::now();
    let made =
        reconstruct(engine, &given, &SceneOptions::default(), &|_, _| (), &AtomicBool::new(false))?;
    let ms = start.elapsed().as_secs_f64() * 1e3;
    let target = &squares[triple.target];
    let request = RenderRequest {
        kinds: Kinds { color: true, depth: true, alpha: false },
        ..view_request(target.camera, made.report.median_depth)
    };
    let scene = scene_of(made);
    let frame = ViewPlanner::default().render(renderer, &scene, &request, true)?;
    let report = scene.meta.report;
    let mut color = frame.color.unwrap_or_default();
    color.iter_mut().flatten().for_each(|v| *v = v.clamp(0.0, 1.0));
    let truth = metrics::to_unit(&target.photo);
    let valid = target.photo.valid.as_deref();
    let (warp, _) = hindsight_warp(
        target,
        &[&squares[triple.pair[0]], &squares[triple.pair[1]]],
        triple.baseline,
    );
    let judged = TripleReport {
        inputs: inputs.iter().map(|&i| squares[i].file.clone()).collect(),
        target: target.file.clone(),
        baseline: triple.baseline,
        psnr: psnr(&color, &truth, valid),
        ssim: ssim(&color, &truth, SIDE as usize, valid),
        warp_psnr: warp,
        gaussians: report.gaussians,
        dropped: report.dropped,
        overlap: report.overlap,
        depth_range: report.depth_range,
        warnings: report.warnings,
        stages: report.stages,
        total_ms: ms,
    };
    Ok(Judged {
        inputs,
        target: triple.target,
        color,
        depth: frame.depth.unwrap_or_default(),
        report: judged,
    })
}

/// A colour view as the service draws it; `median_depth` is the scene's.
fn view_request(camera: Camera, median_depth: f64) -> RenderRequest {
    RenderRequest::plain(camera, Kinds::COLOR, default_near(median_depth))
}

/// A scene of a reconstruction that nobody stores.
fn scene_of(made: Reconstruction) -> Scene {
    let meta = SceneMeta {
        id: SceneId::from_bytes([0; 16]),
        created_ms: 0,
        cameras: made.cameras,
        report: made.report,
        provenance: Provenance::default(),
    };
    Scene::new(meta, made.gaussians, made.backdrop)
}

/// The photos of a scene folder, undistorted, cropped to their short side, [`SIDE`] pixels square.
fn squares(dir: &Path, limits: &Limits) -> Result<Vec<PosedPhoto>> {
    let photos = photos::read_dir(dir, limits)?;
    Ok(photos
        .par_iter()
        .map(|posed| {
            let fitted = fit(&posed.photo, &posed.camera, [SIDE, SIDE]);
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..255")]
            let rgb = fitted.rgb.iter().map(|v| (v * 255.0).round() as u8).collect();
            let photo = Photo { width: SIDE, height: SIDE, rgb, valid: fitted.valid };
            PosedPhoto {
                file: posed.file.clone(),
                photo,
                camera: fitted.camera,
                intrinsics_made_for: None,
            }
        })
        .collect())
}

/// The scene folders under `dir` (or `dir` itself), sorted by name.
fn scene_dirs(dir: &Path, wanted: &[String]) -> Result<Vec<PathBuf>> {
    let is_scene = |dir: &Path| dir.join("transforms.json").is_file();
    let read = |e: std::io::Error| Error::invalid(format!("eval: the folder: {}", e.kind()));
    let mut found = Vec::new();
    if is_scene(dir) {
        found.push(dir.to_owned());
    } else {
        for entry in fs_err::read_dir(dir).map_err(read)? {
            let path = entry.map_err(read)?.path();
            if is_scene(&path) {
                found.push(path);
            }
        }
    }
    found.sort();
    only_named(found, wanted, "scene folder with a transforms.json")
}

/// The folders of these names; all of them where none is named.
fn only_named(mut found: Vec<PathBuf>, wanted: &[String], what: &str) -> Result<Vec<PathBuf>> {
    let named = |path: &PathBuf, name: &String| path.file_name().is_some_and(|n| *n == **name);
    if let Some(missing) = wanted.iter().find(|name| !found.iter().any(|path| named(path, name))) {
        return Err(Error::invalid(format!("eval: no {what} is called {missing:?}")));
    }
    if !wanted.is_empty() {
        found.retain(|path| wanted.iter().any(|name| named(path, name)));
    }
    if found.is_empty() {
        return Err(Error::invalid(format!("eval: no {what} there")));
    }
    Ok(found)
}
