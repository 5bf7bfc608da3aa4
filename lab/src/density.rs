//! What thinning costs and saves.
//!
//! The middle triple of each scene is made into a scene twice, with all Gaussians and thinned, and
//! both are drawn from the inputs, from between them and from the photo that was held out.

use std::time::Instant;

use serde_json::{Value, json};

use crate::{
    error::Result,
    metrics::{clamped, psnr},
    pipeline::Pipeline,
    render::{Kinds, Renderer, cpu::CpuRenderer, plan::served, train::unit},
    rows::{Rows, median, ms},
    scene::{Camera, CameraToWorld, Density, PosedPhoto, Scene, SceneOptions},
    scenes::{SIDE, is_posed, make, scene_of, squares, use_of, view_request},
    setup::Inputs,
    triples::{Triple, triples},
};

/// Times that each view is drawn.
const RUNS: usize = 5;

/// Makes a row for each scene; its error is the least PSNR between both scenes.
///
/// # Errors
/// `invalid_request` when there is no scene, else whatever a stage of the pipeline says.
pub(crate) fn run(inputs: &Inputs, rows: &mut Rows) -> Result<()> {
    let engine = Pipeline::open(&inputs.setup.networks(1))?;
    let renderer = CpuRenderer::new(inputs.setup.threads())?;
    for (name, dir) in inputs.find(is_posed)? {
        let squares = squares(&dir, SIDE)?;
        let all = triples(&squares);
        let Some(triple) = all.get(all.len() / 2) else { continue };
        let mut row = compare(&engine, &renderer, &squares, triple, inputs.photos)?;
        row["use"] = json!(use_of(&name));
        row["scene"] = json!(name);
        rows.push(json!({ "psnr_db": row["psnr_min"] }), row)?;
    }
    Ok(())
}

/// One triple: `full` with all Gaussians, `thinned` with those left; times are those of a colour
/// view, PSNR is to the photo that was held out. `psnr_min` is the least of a view of the thinned
/// scene to the same view of the full one, `difference_max` the largest of any channel, of 255.
fn compare(
    engine: &Pipeline,
    renderer: &CpuRenderer,
    squares: &[PosedPhoto],
    triple: &Triple,
    photos: usize,
) -> Result<Value> {
    let inputs = triple.inputs(squares, photos);
    let given: Vec<PosedPhoto> = inputs.iter().map(|&i| squares[i].clone()).collect();
    let scene = |density| -> Result<Scene> {
        let options = SceneOptions { density: Some(density), ..SceneOptions::default() };
        Ok(scene_of(make(engine, &given, &options)?))
    };
    let scenes = [scene(Density::Full)?, scene(Density::Thinned)?];
    let target = &squares[triple.target];
    let [a, b] = triple.pair.map(|i| squares[i].camera);
    let between = [0.25, 0.5, 0.75].map(|t| Camera {
        camera_to_world: CameraToWorld::between(&a.camera_to_world, &b.camera_to_world, t),
        ..a
    });
    let mut times = [Vec::new(), Vec::new()];
    let mut views = [Vec::new(), Vec::new()];
    for camera in [target.camera, a, b].into_iter().chain(between) {
        for run in 0..RUNS {
            for (i, scene) in scenes.iter().enumerate() {
                let begun = Instant::now();
                let request = view_request(camera, Kinds::COLOR, scene.meta.report.median_depth);
                let frame = renderer.render(&scene.gaussians, &served(scene, request))?;
                times[i].push(ms(begun));
                if run == 0 {
                    views[i].push(clamped(frame.color));
                }
            }
        }
    }
    let (truth, valid) = (unit(&target.photo), target.photo.valid.as_deref());
    let pairs = || views[0].iter().zip(&views[1]);
    let differences = pairs().flat_map(|(a, b)| a.iter().flatten().zip(b.iter().flatten()));
    let [full, thinned] = [0, 1].map(|i| scenes[i].gaussians.len());
    let [full_ms, thinned_ms] = times.map(median);
    let [full_psnr, thinned_psnr] = [0, 1].map(|i| psnr(&views[i][0], &truth, valid));
    Ok(json!({
        "full": full,
        "thinned": thinned,
        "fewer": full as f64 / thinned.max(1) as f64,
        "full_ms": full_ms,
        "thinned_ms": thinned_ms,
        "full_psnr": full_psnr,
        "thinned_psnr": thinned_psnr,
        "psnr_min": pairs().map(|(a, b)| psnr(b, a, None)).fold(f64::INFINITY, f64::min),
        "difference_max": differences.map(|(a, b)| (a - b).abs() * 255.0).fold(0.0, f32::max),
    }))
}
