//! How good scenes are: views against photos that were held out.
//!
//! Every triple (two inputs and a target between them) goes through the product's own stages:
//! undistortion, capture analysis, the geometry network, lifting, the CPU renderer. Beside PSNR
//! and SSIM a row has the *hindsight warp*: the best PSNR that a warp of either input by one
//! constant depth can have, when the depth is chosen by the answer.

use std::{
    path::PathBuf,
    sync::atomic::{AtomicBool, AtomicUsize, Ordering},
    time::Instant,
};

use serde::Serialize;
use serde_json::json;

use crate::{
    error::{Error, Result},
    folders::{Folders, REPORTED, SIDE, is_posed, scene_of, squares, view_request},
    grid,
    metrics::{psnr, ssim, to_unit},
    pipeline::{Pipeline, reconstruct},
    render::{Kinds, ViewPlanner, cpu::CpuRenderer},
    rows::{Rows, mean, ms, progress},
    scene::{Camera, PosedPhoto, SceneOptions},
    setup::Setup,
    triples::{Triple, triples},
    warp::hindsight_warp,
};

/// What to compare.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    folders: Folders,
    /// Photos in: the pair, and the next nearest to the target
    #[arg(long, default_value_t = 2)]
    photos: usize,
    /// Triples at work at the same time
    #[arg(long, default_value_t = 1)]
    at_once: usize,
    /// Take every n-th triple only
    #[arg(long, default_value_t = 1)]
    every: usize,
    /// Folder for picture grids, one a scene
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
    #[command(flatten)]
    setup: Setup,
}

/// One triple.
#[derive(Clone, Debug, Serialize)]
struct Judged {
    target: String,
    psnr: f64,
    ssim: f64,
    warp_psnr: f64,
    gaussians: u64,
    geometry_ms: f64,
    total_ms: f64,
    #[serde(skip)]
    pictures: grid::Row,
}

/// Means over triples, or over scenes.
#[derive(Clone, Debug, Serialize)]
struct Means {
    scene: String,
    /// Whether constants were chosen on it.
    reported: bool,
    photos: usize,
    triples: usize,
    psnr: f64,
    ssim: f64,
    warp_psnr: f64,
    geometry_ms: f64,
    total_ms: f64,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    each: Vec<Judged>,
}

/// Makes a row for each scene, and rows of means over scenes.
///
/// # Errors
/// `invalid_request` when there is no scene or an option is out of range, else whatever a stage of
/// the pipeline says, with scene and triple named.
pub fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    if args.photos < 2 || args.at_once == 0 || args.every == 0 {
        return Err(Error::invalid("photos must be at least 2, at-once and every at least 1"));
    }
    let threads = args.setup.threads();
    let at_once = args.at_once.min(threads);
    let engine = Pipeline::open(&args.setup.networks(at_once))?;
    let renderer = CpuRenderer::new((threads / at_once).max(1))?;
    let mut scenes = Vec::new();
    for (name, dir) in args.folders.find(is_posed)? {
        let squares = squares(&dir)?;
        let cameras: Vec<Camera> = squares.iter().map(|p| p.camera).collect();
        let chosen: Vec<Triple> = triples(&cameras).into_iter().step_by(args.every).collect();
        let judged = each(&chosen, at_once, |triple| {
            judge(&engine, &renderer, &squares, triple, args.photos).map_err(|e| {
                let target = &squares[triple.target].file;
                Error::new(e.code(), format!("{name}, target {target}: {e}")).caused_by(e)
            })
        })?;
        if let Some(out) = &args.pictures {
            let mut order: Vec<&Judged> = judged.iter().collect();
            order.sort_by(|a, b| a.psnr.total_cmp(&b.psnr));
            let pictures: Vec<&grid::Row> = order.iter().map(|j| &j.pictures).collect();
            grid::write(out, &name, &pictures)?;
        }
        let reported = REPORTED.contains(&name.as_str());
        let means = Means::of_triples(name, reported, args.photos, judged);
        means.push(rows)?;
        progress(&format!("{}: {:.2} dB", means.scene, means.psnr));
        scenes.push(means);
    }
    scenes.retain(|scene| scene.triples > 0);
    for (name, reported) in [("mean of reported", true), ("mean of choosing", false)] {
        let of: Vec<&Means> = scenes.iter().filter(|scene| scene.reported == reported).collect();
        if of.len() > 1 {
            Means::of_scenes(name, reported, args.photos, &of).push(rows)?;
        }
    }
    Ok(())
}

impl Means {
    fn of_triples(scene: String, reported: bool, photos: usize, each: Vec<Judged>) -> Self {
        let over = |of: fn(&Judged) -> f64| mean(each.iter().map(of));
        Self {
            scene,
            reported,
            photos,
            triples: each.len(),
            psnr: over(|t| t.psnr),
            ssim: over(|t| t.ssim),
            warp_psnr: over(|t| t.warp_psnr),
            geometry_ms: over(|t| t.geometry_ms),
            total_ms: over(|t| t.total_ms),
            each,
        }
    }

    fn of_scenes(name: &str, reported: bool, photos: usize, scenes: &[&Self]) -> Self {
        let over = |of: fn(&Self) -> f64| mean(scenes.iter().map(|scene| of(scene)));
        Self {
            scene: name.to_owned(),
            reported,
            photos,
            triples: scenes.iter().map(|s| s.triples).sum(),
            psnr: over(|s| s.psnr),
            ssim: over(|s| s.ssim),
            warp_psnr: over(|s| s.warp_psnr),
            geometry_ms: over(|s| s.geometry_ms),
            total_ms: over(|s| s.total_ms),
            each: Vec::new(),
        }
    }

    fn push(&self, rows: &mut Rows) -> Result<()> {
        rows.push(json!({ "psnr_db": self.psnr, "ssim": self.ssim }), self)
    }
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
    let one = || -> Result<Vec<(usize, U)>> {
        let mut mine = Vec::new();
        loop {
            let i = next.fetch_add(1, Ordering::Relaxed);
            let Some(item) = items.get(i) else { return Ok(mine) };
            mine.push((i, work(item)?));
        }
    };
    let mut found = std::thread::scope(|scope| -> Result<Vec<(usize, U)>> {
        let workers: Vec<_> = (0..at_once).map(|_| scope.spawn(one)).collect();
        let mut all = Vec::new();
        for worker in workers {
            all.extend(worker.join().map_err(|_| Error::internal("a worker panicked"))??);
        }
        Ok(all)
    })?;
    found.sort_by_key(|(i, _)| *i);
    Ok(found.into_iter().map(|(_, made)| made).collect())
}

fn judge(
    engine: &Pipeline,
    renderer: &CpuRenderer,
    squares: &[PosedPhoto],
    triple: &Triple,
    photos: usize,
) -> Result<Judged> {
    let inputs = triple.inputs(squares, photos);
    let given: Vec<PosedPhoto> = inputs.iter().map(|&i| squares[i].clone()).collect();
    let begun = Instant::now();
    let made =
        reconstruct(engine, &given, &SceneOptions::default(), &|_, _| (), &AtomicBool::new(false))?;
    let total_ms = ms(begun);
    let target = &squares[triple.target];
    let kinds = Kinds { color: true, depth: true, alpha: false };
    let request = view_request(target.camera, kinds, made.report.median_depth);
    let scene = scene_of(made);
    let frame = ViewPlanner::default().render(renderer, &scene, &request, true)?;
    let color = clamped(frame.color);
    let (truth, valid) = (to_unit(&target.photo), target.photo.valid.as_deref());
    let pair = triple.pair.map(|i| &squares[i]);
    let geometry = scene.meta.report.stages.iter().filter(|s| s.stage == "geometry");
    let mut pictures: grid::Row = inputs.iter().map(|&i| grid::photo(&squares[i].photo)).collect();
    pictures.push(grid::photo(&target.photo));
    pictures.push(grid::color(&color, SIDE));
    pictures.push(grid::depth(&frame.depth.unwrap_or_default(), SIDE));
    Ok(Judged {
        target: target.file.clone(),
        psnr: psnr(&color, &truth, valid),
        ssim: ssim(&color, &truth, SIDE as usize, valid),
        warp_psnr: hindsight_warp(target, &pair, triple.baseline),
        gaussians: scene.meta.report.gaussians,
        geometry_ms: geometry.map(|s| s.ms).sum(),
        total_ms,
        pictures,
    })
}

/// Colours as a picture of 8 bits holds them: within 0 and 1.
pub(crate) fn clamped(color: Option<Vec<[f32; 3]>>) -> Vec<[f32; 3]> {
    let mut color = color.unwrap_or_default();
    color.iter_mut().flatten().for_each(|v| *v = v.clamp(0.0, 1.0));
    color
}
