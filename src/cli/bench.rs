//! `segsplat bench`: the time of a view of a scene, and its error against the f64 oracle.

use std::{path::PathBuf, time::Instant};

use serde_json::json;

use super::{camera, engine, output::Output, scene_file};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, Result},
    render::{Kinds, RenderRequest, compare::compare_oracle, plan::default_near},
    service::{CameraFields, CameraSpec, LensSpec, PictureKind, PoseSpec, ViewOptions, ViewSpec},
};

#[derive(Clone, Debug, clap::Args)]
#[command(allow_negative_numbers = true)]
pub(super) struct Args {
    /// Scene file, a folder with one, or a 3DGS PLY
    scene: PathBuf,
    /// Frames after the first
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    frames: u32,
    #[command(flatten)]
    camera: CameraFields,
    #[command(flatten)]
    options: ViewOptions,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

/// Where the scene's first photo was taken.
const FIRST: CameraSpec =
    CameraSpec { pose: PoseSpec::Between { from: 0, to: 0, t: 0.0 }, lens: LensSpec::OfScene };

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let scene = scene_file::open(&args.scene, &config.limits)?.scene;
    let service = engine::offline(config, false)?;
    let renderer = service.renderer();
    // The first view checks the camera as the server does, and warms up.
    let options = &args.options;
    let camera = camera::spec(&args.camera)?.unwrap_or(FIRST);
    let spec = ViewSpec::new(camera, PictureKind::Color, options.clone());
    let first = service.render(&scene, &spec)?;
    let near = options.near.unwrap_or_else(|| default_near(scene.meta.report.median_depth));
    let request = RenderRequest {
        antialiased: options.antialiased.unwrap_or(scene.meta.report.antialiased),
        error: options.error.0,
        detail: options.detail,
        ..RenderRequest::plain(first.camera, Kinds { depth: false, ..Kinds::ALL }, near)
    };
    let mut times = Vec::new();
    for _ in 0..args.frames {
        let begun = Instant::now();
        renderer.render(&scene.gaussians, &request)?;
        times.push(begun.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_by(f64::total_cmp);
    let (least, median) = match times.as_slice() {
        [] => return Err(Error::invalid("--frames must be at least 1")),
        all => (all[0], all[all.len() / 2]),
    };
    let frame = renderer.render(&scene.gaussians, &request)?;
    let error = compare_oracle(&frame, &scene.gaussians, &request)?;
    let text = format!(
        "{} Gaussians at {}x{} px on {}: median {median:.3} ms, fastest {least:.3} ms, first \
         {:.3} ms\nerror against the oracle on {} px: at most {:.1e}, mean {:.1e}, {} flips, {} \
         faults",
        scene.gaussians.len(),
        first.width,
        first.height,
        renderer.name(),
        first.times.render_ms,
        error.pixels,
        error.max,
        error.mean,
        error.flips,
        error.faults
    );
    let value = json!({
        "gaussians": scene.gaussians.len(),
        "width": first.width,
        "height": first.height,
        "renderer": renderer.name(),
        "frames": args.frames,
        "median_ms": median,
        "min_ms": least,
        "first_ms": first.times.render_ms,
        "visible": frame.stats.visible,
        "error": error,
    });
    out.answer(&text, &value)
}
