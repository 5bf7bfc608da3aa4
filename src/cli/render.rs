//! `segsplat render`: one view of a scene file or PLY as a picture.

use std::path::{Path, PathBuf};

use clap::ValueEnum;
use serde_json::json;

use super::{engine, output::Output, scene_file};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, ErrorCode, Result},
    service::{CameraSpec, Format, Kind, LensSpec, PoseSpec, ViewOptions, ViewSpec, render_scene},
};

#[derive(Clone, Copy, Debug, ValueEnum)]
enum KindArg {
    Color,
    Depth,
    Alpha,
}

#[derive(Clone, Debug, clap::Args)]
#[command(allow_negative_numbers = true)]
pub(super) struct Args {
    /// Scene file, a folder with one, or a 3DGS PLY
    scene: PathBuf,
    /// Picture to write; its ending (png, jpg, webp, npy) is the format
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Stand where this input camera stood (its index)
    #[arg(long, value_name = "INDEX", group = "pose")]
    camera: Option<usize>,
    /// Stand between this input camera ...
    #[arg(long, value_name = "INDEX", group = "pose")]
    from: Option<usize>,
    /// ... and this one
    #[arg(long, value_name = "INDEX", requires = "from")]
    to: Option<usize>,
    /// 0 at `from`, 1 at `to`
    #[arg(long, default_value_t = 0.5)]
    t: f64,
    /// Stand here: x,y,z in the world of the photos
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', group = "pose", requires = "target")]
    eye: Option<Vec<f64>>,
    /// Look at this point
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', requires = "eye")]
    target: Option<Vec<f64>>,
    /// Up in the picture [default: as in the photos]
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', requires = "eye")]
    up: Option<Vec<f64>>,
    /// 16 numbers, row-major, OpenCV camera-to-world
    #[arg(long, value_name = "M00,...,M33", value_delimiter = ',', group = "pose")]
    camera_to_world: Option<Vec<f64>>,
    /// Vertical field of view in degrees [default: the photos' lens]
    #[arg(long, conflicts_with = "fx")]
    fov: Option<f64>,
    /// Focal length along x in pixels of the picture
    #[arg(long)]
    fx: Option<f64>,
    /// Focal length along y [default: fx]
    #[arg(long, requires = "fx")]
    fy: Option<f64>,
    /// Principal point x [default: the middle]
    #[arg(long, requires = "fx")]
    cx: Option<f64>,
    /// Principal point y [default: the middle]
    #[arg(long, requires = "fx")]
    cy: Option<f64>,
    /// Width in pixels [default: the photos' shape, longer side at most 384]
    #[arg(long)]
    width: Option<u32>,
    /// Height in pixels [default: the photos' shape]
    #[arg(long)]
    height: Option<u32>,
    /// What to draw
    #[arg(long, value_enum, default_value = "color")]
    kind: KindArg,
    /// Background colour, each 0 to 1 [default: the scene's backdrop]
    #[arg(long, value_name = "R,G,B", value_delimiter = ',')]
    background: Option<Vec<f32>>,
    /// Antialiased: opacity compensated for the blur of small Gaussians
    #[arg(long)]
    antialiased: bool,
    /// Near plane in world units [default: 0.01 of the scene's median depth]
    #[arg(long)]
    near: Option<f32>,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let spec = spec(args)?;
    let opened = scene_file::open(&args.scene, &config.limits)?;
    let renderer = engine::renderer(config)?;
    let view = render_scene(&*renderer, &opened.scene, &spec, &config.limits)?;
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
    let pose = if let Some(index) = args.camera {
        PoseSpec::Between { from: index, to: index, t: 0.0 }
    } else if let Some(from) = args.from {
        PoseSpec::Between { from, to: args.to.unwrap_or(from), t: args.t }
    } else if let (Some(eye), Some(target)) = (&args.eye, &args.target) {
        PoseSpec::LookAt {
            eye: numbers(eye, "--eye")?,
            target: numbers(target, "--target")?,
            up: args.up.as_ref().map(|up| numbers(up, "--up")).transpose()?,
        }
    } else if let Some(matrix) = &args.camera_to_world {
        PoseSpec::CameraToWorld(numbers(matrix, "--camera-to-world")?)
    } else {
        return Err(Error::invalid(
            "no camera: give --camera, --from and --to, --eye and --target, or --camera-to-world",
        ));
    };
    let lens = match (args.fx, args.fov) {
        (Some(fx), _) => LensSpec::Focal { fx, fy: args.fy, cx: args.cx, cy: args.cy },
        (None, Some(fov)) => LensSpec::Fov(fov),
        (None, None) => LensSpec::OfScene,
    };
    let background = match &args.background {
        Some(background) => Some(numbers(background, "--background")?),
        None => None,
    };
    Ok(ViewSpec {
        camera: CameraSpec { pose, lens },
        kind: match args.kind {
            KindArg::Color => Kind::Color,
            KindArg::Depth => Kind::Depth,
            KindArg::Alpha => Kind::Alpha,
        },
        options: ViewOptions {
            width: args.width,
            height: args.height,
            format: format_of(&args.output)?,
            background,
            antialiased: args.antialiased,
            near: args.near,
            deadline: None,
        },
    })
}

fn numbers<T: Copy, const N: usize>(given: &[T], name: &str) -> Result<[T; N]> {
    <[T; N]>::try_from(given)
        .map_err(|_count| Error::invalid(format!("{name} has {} numbers, not {N}", given.len())))
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
