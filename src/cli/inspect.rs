//! `segsplat inspect`: what is in a scene file, every byte of it checked.

use std::{fmt::Write as _, path::PathBuf};

use glam::DVec3;
use serde_json::json;

use super::{output::Output, scene_file};
use crate::{config::Config, error::Result, scene::Gaussians};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    #[arg(help = scene_file::scene_help())]
    scene: PathBuf,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let opened = scene_file::open(&args.scene, &config.limits)?;
    let (meta, gaussians) = (&opened.scene.meta, &opened.scene.gaussians);
    let bounds = bounds(gaussians);
    let value = json!({
        "format": opened.format,
        "sha256": opened.sha256,
        "gaussians": gaussians.len(),
        "sh_degree": gaussians.sh_degree(),
        "size_bytes": gaussians.size_bytes(),
        "bounds": bounds,
        "meta": (opened.format == "segsplat").then_some(meta),
        "dropped": meta.report.dropped,
    });
    let mut text = format!(
        "{}: {} of {} Gaussians, SH degree {}\n",
        args.scene.display(),
        opened.format,
        gaussians.len(),
        gaussians.sh_degree()
    );
    if let Some([low, high]) = bounds {
        let _ = writeln!(text, "  from {low:.3?} to {high:.3?}");
    }
    for count in &meta.report.dropped {
        let _ = writeln!(text, "  {}: {}", count.reason, count.count);
    }
    if let Some(sha256) = &opened.sha256 {
        let report = &meta.report;
        let _ = writeln!(text, "  id {}, sha256 {sha256}", meta.id);
        let _ = writeln!(
            text,
            "  {} cameras, median depth {:.3}, overlap {:.2}, {}",
            meta.cameras.len(),
            report.median_depth,
            report.overlap,
            report.execution_provider
        );
        for (i, camera) in meta.cameras.iter().enumerate() {
            let lens = camera.camera.intrinsics;
            let at = camera.camera.camera_to_world.center();
            let _ = writeln!(
                text,
                "  camera {i}: {} {}x{} fx {:.1} at {at:.3}",
                camera.file, lens.width, lens.height, lens.fx
            );
        }
        for warning in &report.warnings {
            let _ = writeln!(text, "  warning: {}", warning.message);
        }
    }
    out.answer(&text, &value)
}

/// Smallest and largest coordinates of the centres, world frame.
fn bounds(gaussians: &Gaussians) -> Option<[[f64; 3]; 2]> {
    let origin = gaussians.origin();
    let worlds = gaussians.means().iter().map(|m| origin + DVec3::from_array(m.map(f64::from)));
    worlds
        .map(|at| (at, at))
        .reduce(|(low, high), (at, _)| (low.min(at), high.max(at)))
        .map(|(low, high)| [low.to_array(), high.to_array()])
}
