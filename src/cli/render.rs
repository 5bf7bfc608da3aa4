//! `segsplat render`: one view of a scene file, or of a file of Gaussians, as a picture.

use std::path::{Path, PathBuf};

use serde_json::json;

use super::{
    camera::{self, no_camera},
    engine,
    output::Output,
    scene_file,
};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, Result},
    names::named,
    service::{
        CameraFields, Format, PictureKind, PictureOptions, TextOptions, ViewOptions, ViewSpec,
    },
};

#[derive(Clone, Debug, clap::Args)]
#[command(allow_negative_numbers = true)]
pub(super) struct Args {
    #[arg(help = scene_file::scene_help())]
    scene: PathBuf,
    /// Picture to write; its ending (png, jpg, webp, npy, rgb8, rgba8, grey8) is the format
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    camera: CameraFields,
    #[command(flatten)]
    options: ViewOptions,
    #[command(flatten)]
    picture: PictureOptions,
    /// What to draw: color, depth, alpha, semantics, relevancy or mask; a file has no holes
    #[arg(long, default_value = "color", value_parser = named::<PictureKind>)]
    kind: PictureKind,
    #[command(flatten)]
    text: TextOptions,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let spec = ViewSpec {
        camera: camera::spec(&args.camera)?.ok_or_else(no_camera)?,
        kind: args.kind,
        options: args.options.clone(),
        picture: PictureOptions { format: format_of(&args.output)?, ..args.picture.clone() },
        text: args.text.clone(),
    };
    scene_file::has_folder(&args.output)?;
    let opened = scene_file::open(&args.scene, &config.limits)?;
    let service = engine::offline(config, spec.kind.needs_semantics())?;
    let view = service.render(&opened.scene, &spec)?;
    scene_file::write(&args.output, &view.bytes)?;
    let scale = view.depth_scale.map(|scale| format!(", depth = value * {scale:e}"));
    let text = format!(
        "{}: {}x{} px in {:.1} ms on {}{}",
        args.output.display(),
        view.width,
        view.height,
        view.times.render_ms,
        service.renderer().name(),
        scale.unwrap_or_default()
    );
    let value = json!({
        "output": args.output.display().to_string(),
        "width": view.width,
        "height": view.height,
        "kind": view.kind,
        "format": view.format,
        "depth_scale": view.depth_scale,
        "error": view.error,
        "detail": view.detail,
        "camera": view.camera,
        "renderer": service.renderer().name(),
        "render_ms": view.times.render_ms,
        "visible": view.stats.visible,
    });
    out.answer(&text, &value)
}

fn format_of(path: &Path) -> Result<Format> {
    named(&scene_file::ending(path)).map_err(|_| {
        Error::invalid(format!(
            "{}: the ending must be that of a format: png, jpg, webp, npy, rgb8, rgba8 or grey8",
            path.display()
        ))
    })
}
