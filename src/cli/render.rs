//! `segsplat render`: one view of a scene file or PLY as a picture.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use serde_json::json;

use super::{
    camera::{CameraArgs, no_camera, numbers},
    engine,
    output::Output,
    scene_file,
};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, ErrorCode, Result},
    scene::{Region, ScoringProfile},
    service::{Ask, Format, Kind, OfflineService, ViewOptions, ViewSpec},
};

#[derive(Clone, Debug, clap::Args)]
#[command(allow_negative_numbers = true)]
pub(super) struct Args {
    /// Scene file, a folder with one, or a 3DGS PLY
    scene: PathBuf,
    /// Picture to write; its ending (png, jpg, webp, npy) is the format
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    camera: CameraArgs,
    /// What to draw: color, depth, alpha, semantics, relevancy or mask
    #[arg(long, default_value = "color", value_parser = kind)]
    kind: Kind,
    /// What to look for, for relevancy and mask
    #[arg(long)]
    text: Option<String>,
    /// Score the text as the paper does
    #[arg(long)]
    paper: bool,
    /// Background colour, each 0 to 1 [default: the scene's backdrop]
    #[arg(long, value_name = "R,G,B", value_delimiter = ',')]
    background: Option<Vec<f32>>,
    /// Draw only this part of the picture, pixels
    #[arg(long, value_name = "X,Y,WIDTH,HEIGHT", value_delimiter = ',')]
    crop: Option<Vec<u32>>,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let spec = spec(args)?;
    let opened = scene_file::open(&args.scene, &config.limits)?;
    let renderer = engine::renderer(config)?;
    let semantics = engine::semantics(config, spec.kind.needs_semantics())?;
    let service = OfflineService::new(semantics, Arc::clone(&renderer), config.limits.clone());
    let view = service.render(&opened.scene, &spec)?;
    fs_err::write(&args.output, &view.bytes).map_err(|e| {
        let what = format!("{}: cannot be written: {}", args.output.display(), e.kind());
        Error::new(ErrorCode::StoreUnavailable, what).caused_by(e)
    })?;
    let scale =
        view.depth_scale.map_or_else(String::new, |scale| format!(", depth = value * {scale:e}"));
    let text = format!(
        "{}: {}x{} px in {:.1} ms on {}{scale}",
        args.output.display(),
        view.width,
        view.height,
        view.render_ms,
        renderer.name()
    );
    let value = json!({
        "output": args.output.display().to_string(),
        "width": view.width,
        "height": view.height,
        "kind": view.kind,
        "format": view.format,
        "depth_scale": view.depth_scale,
        "camera": view.camera,
        "renderer": renderer.name(),
        "render_ms": view.render_ms,
        "visible": view.stats.visible,
    });
    out.answer(&text, &value)
}

fn spec(args: &Args) -> Result<ViewSpec> {
    let background = match &args.background {
        Some(background) => Some(numbers(background, "--background")?),
        None => None,
    };
    let crop = match &args.crop {
        Some(crop) => {
            let [x, y, width, height] = numbers(crop, "--crop")?;
            Some(Region { x, y, width, height })
        }
        None => None,
    };
    let profile = if args.paper { ScoringProfile::Paper } else { ScoringProfile::Default };
    Ok(ViewSpec {
        camera: args.camera.spec()?.ok_or_else(no_camera)?,
        kind: args.kind,
        options: ViewOptions {
            format: format_of(&args.output)?,
            background,
            crop,
            ..args.camera.options()
        },
        ask: Ask { text: args.text.clone(), profile, wait: None },
    })
}

fn kind(name: &str) -> Result<Kind, String> {
    let known = Kind::ALL.into_iter().find(|kind| kind.name() == name);
    known.ok_or_else(|| Kind::ALL.map(Kind::name).join(", "))
}

fn format_of(path: &Path) -> Result<Format> {
    let end = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    match end.as_str() {
        "png" => Ok(Format::Png),
        "jpg" | "jpeg" => Ok(Format::Jpeg),
        "webp" => Ok(Format::Webp),
        "npy" => Ok(Format::Npy),
        _ => Err(Error::invalid(format!(
            "{}: the ending says the format: png, jpg, webp or npy",
            path.display()
        ))),
    }
}
