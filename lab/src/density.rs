//! What thinning costs and saves.
//!
//! The middle triple of each scene is made into a scene twice, with all Gaussians and thinned, and
//! both are drawn from the inputs, from between them and from the photo that was held out.

use std::{sync::atomic::AtomicBool, time::Instant};

use serde::Serialize;
use serde_json::json;

use crate::{
    error::Result,
    folders::{Folders, REPORTED, is_posed, scene_of, squares, view_request},
    metrics::{psnr, to_unit},
    photos::clamped,
    pipeline::{Pipeline, reconstruct},
    render::{Kinds, ViewPlanner, cpu::CpuRenderer},
    rows::{Rows, median, ms},
    scene::{Camera, CameraToWorld, Density, PosedPhoto, Scene, SceneOptions},
    setup::Setup,
    triples::{Triple, triples},
};

/// Times that each view is drawn.
const RUNS: usize = 5;

/// What to compare.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    folders: Folders,
    /// Photos in: the pair, and the next nearest to the target
    #[arg(long, default_value_t = 2)]
    photos: usize,
    #[command(flatten)]
    setup: Setup,
}

/// One scene: `full` with all Gaussians, `thinned` with those left.
#[derive(Clone, Debug, Serialize)]
struct Compared {
    scene: String,
    reported: bool,
    full: u64,
    thinned: u64,
    fewer: f64,
    /// Median time of a colour view, ms.
    full_ms: f64,
    thinned_ms: f64,
    /// PSNR to the photo that was held out, dB.
    full_psnr: f64,
    thinned_psnr: f64,
    /// Smallest PSNR of a view of the thinned scene to the same view of the full one, dB.
    psnr_min: f64,
    /// Largest difference of any channel of any pixel of those views, of 255.
    difference_max: f32,
}

/// Makes a row for each scene.
///
/// # Errors
/// `invalid_request` when there is no scene, else whatever a stage of the pipeline says.
pub fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    let engine = Pipeline::open(&args.setup.networks(1))?;
    let renderer = CpuRenderer::new(args.setup.threads())?;
    for (name, dir) in args.folders.find(is_posed)? {
        let squares = squares(&dir)?;
        let cameras: Vec<Camera> = squares.iter().map(|p| p.camera).collect();
        let all = triples(&cameras);
        let Some(triple) = all.get(all.len() / 2) else { continue };
        let found = compare(name, &engine, &renderer, &squares, triple, args.photos)?;
        rows.push(json!({ "psnr_db": found.psnr_min }), &found)?;
    }
    Ok(())
}

fn compare(
    scene: String,
    engine: &Pipeline,
    renderer: &CpuRenderer,
    squares: &[PosedPhoto],
    triple: &Triple,
    photos: usize,
) -> Result<Compared> {
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
    let planner = ViewPlanner::default();
    let mut times = [Vec::new(), Vec::new()];
    let mut views = [Vec::new(), Vec::new()];
    for camera in [target.camera, a, b].into_iter().chain(between) {
        for run in 0..RUNS {
            for (i, scene) in scenes.iter().enumerate() {
                let begun = Instant::now();
                let request = view_request(camera, Kinds::COLOR, scene.meta.report.median_depth);
                let frame = planner.render(renderer, scene, &request, true)?;
                times[i].push(ms(begun));
                if run == 0 {
                    views[i].push(clamped(frame.color));
                }
            }
        }
    }
    let (truth, valid) = (to_unit(&target.photo), target.photo.valid.as_deref());
    let pairs = || views[0].iter().zip(&views[1]);
    let differences = pairs().flat_map(|(a, b)| a.iter().flatten().zip(b.iter().flatten()));
    let [full, thinned] = [0, 1].map(|i| scenes[i].gaussians.len() as u64);
    let [full_ms, thinned_ms] = times.map(median);
    let [full_psnr, thinned_psnr] = [0, 1].map(|i| psnr(&views[i][0], &truth, valid));
    Ok(Compared {
        reported: REPORTED.contains(&scene.as_str()),
        scene,
        full,
        thinned,
        fewer: full as f64 / thinned.max(1) as f64,
        full_ms,
        thinned_ms,
        full_psnr,
        thinned_psnr,
        psnr_min: pairs().map(|(a, b)| psnr(b, a, None)).fold(f64::INFINITY, f64::min),
        difference_max: differences.map(|(a, b)| (a - b).abs() * 255.0).fold(0.0, f32::max),
    })
}
