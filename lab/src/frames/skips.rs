//! What each kind of skipped work saves: frames with and without the skip, in turn, of scenes that
//! differ in how much there is to skip.

use std::sync::Arc;

use glam::DVec3;
use serde_json::json;

use super::{Args, Drawing};
use crate::{
    error::Result,
    render::{RenderRequest, Renderer, Skip, Switches, compare::differences},
    rows::{Rows, median},
    scene::{Camera, CameraToWorld, Gaussians, RawGaussians},
};

/// Rounds in which both are timed.
const ROUNDS: usize = 5;
/// Walls of the scene of layers.
const LAYERS: usize = 8;

/// The generated scene; the same of long thin Gaussians; as walls behind each other; seen by a
/// camera that looks past most of it; and from far away, an island in an empty picture.
fn scenes(
    gaussians: Gaussians,
    request: &RenderRequest,
) -> Result<[(&'static str, Gaussians, RenderRequest); 5]> {
    let seen_from = |eye: DVec3, target: DVec3| -> Result<RenderRequest> {
        let camera_to_world = CameraToWorld::look_at(eye, target, DVec3::NEG_Y, "bench")?;
        let camera = Camera { camera_to_world, ..request.camera };
        Ok(RenderRequest { camera, ..request.clone() })
    };
    let changed = |change: &dyn Fn(&mut RawGaussians)| -> Result<Gaussians> {
        let mut raw = gaussians.clone().into_raw();
        change(&mut raw);
        Ok(Gaussians::sanitize(raw)?.0)
    };
    let slivers = changed(&|raw| {
        for scale in &mut raw.scales {
            *scale = [scale[0] * 16.0, scale[1] * 0.7, scale[2]];
        }
    })?;
    let layers = changed(&|raw| {
        raw.opacities.fill(0.98);
        for (i, (mean, scale)) in raw.means.iter_mut().zip(&mut raw.scales).enumerate() {
            let away = 1.0 + 0.1 * (i % LAYERS) as f32;
            *mean = mean.map(|v| v * away);
            // An eighth of the Gaussians make a wall.
            *scale = scale.map(|s| s * away * (LAYERS as f32).sqrt());
        }
    })?;
    let eye = request.camera.camera_to_world.center();
    Ok([
        ("photos", gaussians.clone(), request.clone()),
        ("slivers", slivers, request.clone()),
        ("layers", layers, request.clone()),
        ("aside", gaussians.clone(), seen_from(eye, eye + DVec3::new(0.8, 0.0, 1.0))?),
        ("island", gaussians, seen_from(eye - 16.0 * DVec3::Z, eye)?),
    ])
}

/// Makes a row for each skip and scene; its error is the difference between the frames. Times are
/// medians, of the device where it has a clock, else of a call; `ratio` is that without the skip
/// over that with it.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    args.check()?;
    let (gaussians, request) = args.scene()?;
    let open = |without| -> Result<Arc<dyn Renderer>> {
        Ok(args.setup.renderer(Switches { without, ..args.switches() })?.0)
    };
    let product = open(None)?;
    let scenes = scenes(gaussians, &request)?;
    for skip in Skip::ALL {
        let plain = open(Some(skip))?;
        for (scene, gaussians, request) in &scenes {
            let want = product.render(gaussians, request)?;
            let apart = differences(&plain.render(gaussians, request)?, &want);
            let mut rounds = [const { Vec::new() }; 2];
            let mut clock = "";
            for _ in 0..ROUNDS {
                for (renderer, times) in [&product, &plain].into_iter().zip(&mut rounds) {
                    let drawing = Drawing { renderer: &**renderer, gaussians, request };
                    let frames = args.frames.div_ceil(ROUNDS);
                    let device = drawing.device_times(frames)?;
                    clock = if device.is_some() { "device" } else { "call" };
                    times.push(match device {
                        Some(device) => device.total_ms,
                        None => median(drawing.times(frames)?),
                    });
                }
            }
            let [with_ms, without_ms] = rounds.map(median);
            let row = json!({
                "skip": skip,
                "scene": scene,
                "clock": clock,
                "with_ms": with_ms,
                "without_ms": without_ms,
                "ratio": without_ms / with_ms,
            });
            let error = json!({
                "pixels": apart.iter().filter(|&&d| d > 0.0).count(),
                "max": apart.into_iter().fold(0.0, f32::max),
            });
            rows.push(error, row)?;
        }
    }
    Ok(())
}
