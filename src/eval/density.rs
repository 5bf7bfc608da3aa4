//! What thinning costs and saves: `segsplat eval density DIR`.
//!
//! The middle triple of each scene is made into a scene twice, with all Gaussians and thinned, and
//! both are drawn from the inputs, from between them and from the photo that was held out.

use std::{fmt, path::PathBuf, sync::atomic::AtomicBool, time::Instant};

use serde::Serialize;

use super::{Triple, metrics, psnr, scene_dirs, scene_of, squares, triples, view_request};
use crate::{
    config::Config,
    error::Result,
    pipeline::{Engine, reconstruct},
    render::{Renderer, ViewPlanner, cpu::CpuRenderer},
    scene::{Camera, CameraToWorld, Density, PosedPhoto, Scene, SceneOptions},
};

/// Times that each view is drawn.
const RUNS: usize = 5;

/// What to compare.
#[derive(Clone, Debug)]
pub struct DensityEval {
    /// A scene folder (with `transforms.json`), or a folder of scene folders.
    pub dir: PathBuf,
    /// Names of the scenes to take; empty: all.
    pub scenes: Vec<String>,
    /// Photos in: 2 (the pair) or 4 (the pair and the next two nearest to the target).
    pub photos: usize,
}

/// One scene: of two numbers the first is of all Gaussians, the second of those left.
#[derive(Clone, Debug, Serialize)]
pub struct DensityReport {
    /// Its folder's name.
    pub scene: String,
    /// Gaussians.
    pub gaussians: [u64; 2],
    /// Median time of a colour view, ms.
    pub view_ms: [f64; 2],
    /// PSNR to the photo that was held out, dB.
    pub target_psnr: [f64; 2],
    /// Smallest PSNR of a view of the thinned scene to the same view of the full one, dB.
    pub psnr_min: f64,
    /// Largest difference of any channel of any pixel of those views, of 255.
    pub difference_max: f32,
}

impl DensityReport {
    /// The columns' names.
    #[must_use]
    pub fn heading() -> String {
        "scene                  full     thinned  fewer  view ms (full)   target dB (full)  \
         least dB  most of 255"
            .to_owned()
    }
}

impl fmt::Display for DensityReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { gaussians: [full, thin], view_ms: ms, target_psnr: target, .. } = self;
        let fewer = *full as f64 / (*thin).max(1) as f64;
        write!(f, "{:20} {full:8} {thin:8}  {fewer:5.2}", self.scene)?;
        write!(f, "  {:6.1} ({:6.1})  {:7.2} ({:5.2})", ms[1], ms[0], target[1], target[0])?;
        write!(f, "  {:9.1}  {:6.1}", self.psnr_min, self.difference_max)
    }
}

/// Compares; `done` hears of each scene as it finishes.
///
/// # Errors
/// `invalid_request` when there is no scene, else whatever a stage of the pipeline says.
pub fn run(
    config: &Config,
    options: &DensityEval,
    done: &dyn Fn(&DensityReport),
) -> Result<Vec<DensityReport>> {
    let engine = Engine::open(&config.networks())?;
    let renderer = CpuRenderer::new(config.threads)?;
    let mut reports = Vec::new();
    for dir in scene_dirs(&options.dir, &options.scenes)? {
        let name = dir.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let squares = squares(&dir, &config.limits)?;
        let cameras: Vec<Camera> = squares.iter().map(|p| p.camera).collect();
        let all = triples(&cameras);
        let Some(triple) = all.get(all.len() / 2) else { continue };
        let report = compare(name, &engine, &renderer, &squares, triple, options.photos)?;
        done(&report);
        reports.push(report);
    }
    Ok(reports)
}

fn compare(
    scene: String,
    engine: &Engine,
    renderer: &CpuRenderer,
    squares: &[PosedPhoto],
    triple: &Triple,
    photos: usize,
) -> Result<DensityReport> {
    let inputs = triple.inputs(squares, photos);
    let given: Vec<PosedPhoto> = inputs.iter().map(|&i| squares[i].clone()).collect();
    let make = |density| -> Result<Scene> {
        let options = SceneOptions { density, ..SceneOptions::default() };
        reconstruct(engine, &given, &options, &|_, _| (), &AtomicBool::new(false)).map(scene_of)
    };
    let scenes = [make(Density::Full)?, make(Density::Thinned)?];
    let target = &squares[triple.target];
    let [a, b] = triple.pair.map(|i| squares[i].camera);
    let between = [0.25, 0.5, 0.75].map(|t| Camera {
        camera_to_world: CameraToWorld::between(&a.camera_to_world, &b.camera_to_world, t),
        ..a
    });
    let cameras: Vec<Camera> = [target.camera, a, b].into_iter().chain(between).collect();
    let planner = ViewPlanner::default();
    let mut ms = [Vec::new(), Vec::new()];
    let mut views = [Vec::new(), Vec::new()];
    for camera in &cameras {
        for run in 0..RUNS {
            for (i, scene) in scenes.iter().enumerate() {
                let start = Instant::now();
                let request = view_request(*camera, scene.meta.report.median_depth);
                let frame = planner.render(renderer as &dyn Renderer, scene, &request, true)?;
                ms[i].push(start.elapsed().as_secs_f64() * 1e3);
                if run == 0 {
                    let mut color = frame.color.unwrap_or_default();
                    color.iter_mut().flatten().for_each(|v| *v = v.clamp(0.0, 1.0));
                    views[i].push(color);
                }
            }
        }
    }
    let truth = metrics::to_unit(&target.photo);
    let valid = target.photo.valid.as_deref();
    let pairs = || views[0].iter().zip(&views[1]);
    let differences = pairs().flat_map(|(a, b)| a.iter().flatten().zip(b.iter().flatten()));
    Ok(DensityReport {
        scene,
        gaussians: [0, 1].map(|i| scenes[i].gaussians.len() as u64),
        view_ms: ms.map(median),
        target_psnr: [0, 1].map(|i| psnr(&views[i][0], &truth, valid)),
        psnr_min: pairs().map(|(a, b)| psnr(b, a, None)).fold(f64::INFINITY, f64::min),
        difference_max: differences.map(|(a, b)| (a - b).abs() * 255.0).fold(0.0, f32::max),
    })
}

fn median(mut times: Vec<f64>) -> f64 {
    times.sort_by(f64::total_cmp);
    times.get(times.len() / 2).copied().unwrap_or_default()
}
