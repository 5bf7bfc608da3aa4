//! `segsplat cameras`: finds the cameras of photos and writes them as a `transforms.json`.

use std::{
    collections::HashMap,
    fmt::Write as _,
    path::{Path, PathBuf},
    sync::atomic::AtomicBool,
};

use serde_json::{Value, json};

use super::{output::Output, reconstruct, scene_file::unwritable};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, Result},
    pipeline::{PhotoSet, Pipeline, ReadSet, cameras},
    scene::{CamerasMode, PosedPhoto, Stage, Watch},
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    /// Folder of photos, a zip or tar of one, or a video where ffmpeg is installed; cameras in it
    /// are not looked at
    photos: PathBuf,
    /// File to write, as nerfstudio has it
    #[arg(short, long, value_name = "FILE", default_value = "transforms.json")]
    output: PathBuf,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let progress =
        |stage: Stage, fraction: f32| out.progress(stage.name(), stage.overall(fraction));
    let watch = Watch { progress: &progress, cancel: &AtomicBool::new(false) };
    let engine = Pipeline::open(&config.networks())?;
    let (read, _) = reconstruct::read(&args.photos, CamerasMode::Solve, config, watch.cancel)?;
    let ReadSet::Unposed(photos) = read else {
        return Err(Error::internal("cameras that are to be solved were read"));
    };
    let sizes: HashMap<String, [u32; 2]> =
        photos.photos.iter().map(|photo| (photo.file.clone(), photo.file_size)).collect();
    let found = cameras::posed(&engine, photos, watch)?;
    let top = path_between(&args.output, &args.photos);
    let frames: Vec<Value> = found
        .photos
        .iter()
        .zip(&found.cameras.placed)
        .map(|(photo, placed)| frame(photo, placed.k1, sizes.get(&photo.file), &top))
        .collect();
    let text = format!("{:#}\n", json!({ "camera_model": "OPENCV", "frames": frames }));
    fs_err::write(&args.output, text).map_err(|e| unwritable(&args.output, e))?;
    out.progress("done", 1.0);
    describe(&args.output, &found, out)
}

/// The folder of photos as a `transforms.json` at `output` names it; empty where it lies elsewhere.
fn path_between(output: &Path, photos: &Path) -> PathBuf {
    let top = output.parent().unwrap_or(Path::new(""));
    match photos.strip_prefix(top) {
        Ok(rest) if photos.is_dir() => rest.to_owned(),
        _ => PathBuf::new(),
    }
}

/// A frame of `transforms.json`, of the size that the photo has in its file.
fn frame(photo: &PosedPhoto, k1: f64, size: Option<&[u32; 2]>, top: &Path) -> Value {
    let k = photo.camera.intrinsics;
    let [width, height] = size.copied().unwrap_or([k.width, k.height]);
    let k = k.resized(width, height);
    json!({
        "file_path": top.join(&photo.file).display().to_string(),
        "w": k.width, "h": k.height,
        "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "k1": k1,
        "transform_matrix": photo.camera.camera_to_world.to_opengl_rows(),
    })
}

fn describe(path: &Path, found: &PhotoSet, out: &Output) -> Result<()> {
    let (report, count) = (&found.cameras, found.photos.len());
    let confidence = report.confidence.unwrap_or_default();
    let mut text = format!("{}: {count} cameras, confidence {confidence:.2}\n", path.display());
    for left_out in &report.left_out {
        let _ = writeln!(text, "  left out: {}: {}", left_out.file, left_out.reason);
    }
    for stage in &found.stages {
        let _ = writeln!(text, "  {:<10}{:>9.1} ms", stage.stage, stage.ms);
    }
    for warning in &found.warnings {
        let _ = writeln!(text, "  warning: {}", warning.message);
    }
    let value = json!({
        "output": path.display().to_string(),
        "cameras": report,
        "stages": found.stages,
        "warnings": found.warnings,
    });
    out.answer(&text, &value)
}
