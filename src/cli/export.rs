//! `segsplat export`: the Gaussians of a scene as a file for other programs, or of such a file as
//! another.

use std::path::PathBuf;

use serde_json::json;

use super::{output::Output, scene_file};
use crate::{
    config::Config,
    error::{Error, Result},
    store::splats::{SplatFile, endings},
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    /// Scene file, a folder with one, or a file of Gaussians (PLY, compressed PLY, SPZ, SOG, GLB,
    /// .splat)
    scene: PathBuf,
    /// File to write; its ending (ply, compressed.ply, spz, v4.spz, sog, glb, splat) is the format
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let format = scene_file::splat_format(&args.output).ok_or_else(|| {
        let endings = endings();
        let path = args.output.display();
        Error::invalid(format!("{path}: the ending must be that of a format: {endings}"))
    })?;
    let scene = scene_file::open(&args.scene, &config.limits)?.scene;
    let count = scene.gaussians.len();
    let file = SplatFile::new(format, scene.gaussians, scene.semantics.as_deref())?;
    scene_file::write_splats(&args.output, &file)?;
    let path = args.output.display();
    let value = json!({
        "output": path.to_string(), "format": format.name, "gaussians": count,
        "semantics": format.semantics && scene.semantics.is_some(),
    });
    out.answer(&format!("{path}: {count} Gaussians as {}", format.name), &value)
}
