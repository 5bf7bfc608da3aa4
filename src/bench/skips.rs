//! What each skip saves: frames with and without it, in turn, of scenes that differ in what there
//! is to leave out.

use std::sync::Arc;

use glam::DVec3;
use serde::Serialize;

use super::{BenchArgs, compared::differences, device_times, times};
use crate::{
    config::Config,
    error::Result,
    render::{RenderRequest, Renderer, gpu::GpuOptions, select::select_with, skip::Skip},
    scene::{Camera, CameraToWorld, Gaussians, RawGaussians},
};

/// Rounds in which both are timed.
const ROUNDS: usize = 5;
/// Walls of the scene of layers.
const LAYERS: usize = 8;

/// One skip of one scene.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct SkipTimes {
    /// What is left out.
    pub skip: Skip,
    /// What is seen.
    pub scene: &'static str,
    /// Whose time: `device` where it has a clock, else `call`.
    pub clock: &'static str,
    /// Median frame as it is.
    pub with_ms: f64,
    /// Median frame without the skip.
    pub without_ms: f64,
    /// Pixels of which any bit differs.
    pub apart: usize,
    /// Largest difference.
    pub max: f32,
}

/// The bench's own scene; the same of long thin Gaussians; as walls behind each other; seen by a
/// camera that looks past most of it; and from far away, an island in an empty picture.
fn scenes(
    gaussians: &Gaussians,
    request: &RenderRequest,
) -> Result<Vec<(&'static str, Gaussians, RenderRequest)>> {
    let seen_from = |eye: DVec3, target: DVec3| -> Result<RenderRequest> {
        let camera_to_world = CameraToWorld::look_at(eye, target, DVec3::NEG_Y, "bench")?;
        let camera = Camera { camera_to_world, ..request.camera };
        Ok(RenderRequest { camera, ..request.clone() })
    };
    let changed = |change: &dyn Fn(&mut RawGaussians)| -> Result<Gaussians> {
        let mut raw = gaussians.as_raw().clone();
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
    Ok(vec![
        ("photos", gaussians.clone(), request.clone()),
        ("slivers", slivers, request.clone()),
        ("layers", layers, request.clone()),
        ("aside", gaussians.clone(), seen_from(eye, eye + DVec3::new(0.8, 0.0, 1.0))?),
        ("island", gaussians.clone(), seen_from(eye - 16.0 * DVec3::Z, eye)?),
    ])
}

/// Times all skips of the renderer that `config` asks for, over the scene of the bench and four
/// made of it.
///
/// # Errors
/// Those of [`select_with`] and of the renderers.
pub(super) fn run(
    gaussians: &Gaussians,
    request: &RenderRequest,
    args: &BenchArgs,
    config: &Config,
) -> Result<Vec<SkipTimes>> {
    let open = |without| -> Result<Arc<dyn Renderer>> {
        let shaders = args.shaders.clone();
        Ok(select_with(
            &config.renderer(),
            GpuOptions { without, shaders, ..GpuOptions::default() },
        )?
        .0)
    };
    let product = open(None)?;
    let scenes = scenes(gaussians, request)?;
    let mut found = Vec::new();
    for skip in Skip::ALL {
        let plain = open(Some(skip))?;
        for (scene, gaussians, request) in &scenes {
            let want = product.render(gaussians, request)?;
            let apart = differences(&plain.render(gaussians, request)?, &want);
            let mut rounds = [[0.0; ROUNDS]; 2];
            let mut clock = "";
            for round in 0..ROUNDS {
                for (renderer, times) in [&product, &plain].into_iter().zip(&mut rounds) {
                    let frames = args.frames.div_ceil(ROUNDS);
                    (clock, times[round]) = median(&**renderer, gaussians, request, frames)?;
                }
            }
            let [with_ms, without_ms] = rounds.map(|mut times| {
                times.sort_by(f64::total_cmp);
                times[ROUNDS / 2]
            });
            found.push(SkipTimes {
                skip,
                scene,
                clock,
                with_ms,
                without_ms,
                apart: apart.iter().filter(|&&d| d > 0.0).count(),
                max: apart.into_iter().fold(0.0, f32::max),
            });
        }
    }
    Ok(found)
}

/// Whose clock, and the median of `frames` frames by it.
fn median(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    frames: usize,
) -> Result<(&'static str, f64)> {
    match device_times(renderer, gaussians, request, frames)? {
        Some(times) => Ok(("device", times.total_ms)),
        None => Ok(("call", times(renderer, gaussians, request, frames)?[frames / 2])),
    }
}
