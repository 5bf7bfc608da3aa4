//! Cameras that are hidden and solved again: how many photos get one, and how far it is from the
//! camera of the capture.
//!
//! Rotations are compared after the one turn of the world that makes the median error least; a
//! solution is right where that median is at most [`RIGHT_DEG`].

use std::{collections::HashMap, path::Path, sync::atomic::AtomicBool, time::Instant};

use glam::DMat3;
use segsplat_vision::pipeline::cameras::{JudgedCameras, judged};
use serde_json::{Value, json};

use crate::{
    error::{Error, Result},
    limits::Limits,
    photo_files,
    pipeline::Pipeline,
    rows::{Rows, median, ms, progress},
    scene::{Camera, CamerasMode, PosedPhoto, Upload, UploadFile, Watch},
    scenes::is_posed,
    setup::Inputs,
};

/// Median rotation error, degrees, up to which a solution is right.
const RIGHT_DEG: f64 = 5.0;

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    inputs: Inputs,
    /// Photos that follow each other, from the middle of the capture, in place of photos that are
    /// spread evenly over it
    #[arg(long)]
    neighbours: bool,
}

/// Makes a row for each scene with enough photos.
///
/// # Errors
/// `invalid_request` when there is no scene, else whatever a stage says.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    let engine = Pipeline::open(&args.inputs.setup.networks(1))?;
    let mut outcomes: HashMap<&str, usize> = HashMap::new();
    for (name, dir) in args.inputs.find(is_posed)? {
        let Some(capture) = Capture::read(&dir, args.inputs.photos, args.neighbours)? else {
            progress(&format!("{name}: fewer than {} photos", args.inputs.photos));
            continue;
        };
        let never = AtomicBool::new(false);
        let watch = Watch { progress: &|_, _| (), cancel: &never };
        let read = photo_files::read_unposed(
            &capture.upload,
            CamerasMode::Solve,
            &Limits::default(),
            &never,
        )?;
        let photos = read.map(|read| read.photos).unwrap_or_default();
        let begun = Instant::now();
        let found = judged(&engine, &photos, watch)?;
        let seconds = ms(begun) / 1e3;
        let files: Vec<&str> = photos.iter().map(|photo| &*photo.file).collect();
        let compared = Compared::new(&capture, &files, &found);
        let outcome = compared.outcome(&found);
        *outcomes.entry(outcome).or_default() += 1;
        let Compared { placed, rotation_deg, focal } = compared;
        progress(&format!(
            "{name}: {placed} of {} placed, {rotation_deg:.2} degrees, focal {focal:.3}, \
             confidence {:.2}, {seconds:.1} s -> {outcome}",
            photos.len(),
            found.confidence
        ));
        let row = json!({
            "scene": name, "photos": photos.len(), "neighbours": args.neighbours,
            "placed": placed, "rotation_deg": number(rotation_deg), "focal": number(focal),
            "confidence": found.confidence, "seconds": seconds, "outcome": outcome,
            "refused": found.refused, "evidence": found.evidence,
        });
        rows.push(json!({ "rotation_deg": number(rotation_deg) }), row)?;
    }
    let count = |outcome| outcomes.get(outcome).copied().unwrap_or(0);
    let [right, wrong, refused] = ["right", "wrong", "refused"].map(count);
    progress(&format!("right {right}, wrong {wrong}, refused {refused}"));
    Ok(())
}

fn number(value: f64) -> Value {
    if value.is_finite() { json!(value) } else { Value::Null }
}

/// Some photos of a capture, and their cameras, which are hidden.
struct Capture {
    upload: Upload,
    cameras: HashMap<String, Camera>,
}

impl Capture {
    fn read(dir: &Path, count: usize, neighbours: bool) -> Result<Option<Self>> {
        let (read, upload) =
            photo_files::read_dir_until(dir, &Limits::default(), &AtomicBool::new(false))?;
        let all = read.photos.len();
        if count < 2 {
            return Err(Error::invalid(format!("--photos {count}: two are the fewest")));
        }
        if all < count {
            return Ok(None);
        }
        let at = |i: usize| match neighbours {
            true => (all - count) / 2 + i,
            false => i * (all - 1) / (count - 1),
        };
        let chosen: Vec<(&PosedPhoto, &UploadFile)> =
            (0..count).map(|i| (&read.photos[at(i)], &upload.photos[at(i)])).collect();
        let cameras = chosen.iter().map(|(posed, file)| (file.name.clone(), posed.camera));
        let cameras = cameras.collect();
        let photos = chosen.into_iter().map(|(_, file)| file.clone()).collect();
        Ok(Some(Self { upload: Upload { photos, ..Upload::default() }, cameras }))
    }
}

/// Solved cameras beside those of the capture.
struct Compared {
    placed: usize,
    /// Median error of the rotations; not a number where fewer than two are placed.
    rotation_deg: f64,
    /// Median of the solved focal lengths over those of the capture.
    focal: f64,
}

impl Compared {
    fn new(capture: &Capture, files: &[&str], found: &JudgedCameras) -> Self {
        let mut pairs: Vec<(Camera, Camera)> = Vec::new();
        for (file, camera) in files.iter().zip(found.cameras()) {
            if let (Some(truth), Some(solved)) = (capture.cameras.get(*file), camera) {
                pairs.push((*truth, solved));
            }
        }
        let turns: Vec<DMat3> = pairs
            .iter()
            .map(|(truth, solved)| {
                truth.camera_to_world.rotation() * solved.camera_to_world.rotation().transpose()
            })
            .collect();
        let errors = |of: &DMat3| median(turns.iter().map(|turn| angle_deg(turn, of)).collect());
        let rotation_deg = match turns.len() {
            0 | 1 => f64::NAN,
            _ => turns.iter().map(errors).fold(f64::INFINITY, f64::min),
        };
        // Share of the width: photos as sent and undistorted ones may differ in size.
        let wide = |camera: &Camera| camera.intrinsics.fx / f64::from(camera.intrinsics.width);
        let focal = pairs.iter().map(|(truth, solved)| wide(solved) / wide(truth)).collect();
        let focal = if pairs.is_empty() { f64::NAN } else { median(focal) };
        Self { placed: pairs.len(), rotation_deg, focal }
    }

    fn outcome(&self, found: &JudgedCameras) -> &'static str {
        match &found.refused {
            Some(_) => "refused",
            None if self.rotation_deg <= RIGHT_DEG => "right",
            None => "wrong",
        }
    }
}

fn angle_deg(a: &DMat3, b: &DMat3) -> f64 {
    let turn = *a * b.transpose();
    let trace = turn.x_axis.x + turn.y_axis.y + turn.z_axis.z;
    ((trace - 1.0) / 2.0).clamp(-1.0, 1.0).acos().to_degrees()
}
