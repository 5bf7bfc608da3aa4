//! Cameras that are hidden and solved again: how many photos get one, and how far it is from the
//! camera of the capture. A solution is right where the median error of its rotations is at most
//! five degrees.

mod captures;
mod compared;
mod hidden;
pub(crate) mod rendered;

use std::{collections::HashMap, path::Path, sync::atomic::AtomicBool};

use serde_json::json;

use self::{
    compared::{Compared, number},
    hidden::{Guess, Solved},
};
use crate::{
    error::{Error, Result},
    limits::Limits,
    photo_files,
    pipeline::Pipeline,
    rows::{Rows, progress},
    scene::{Camera, PosedPhoto, Upload, UploadFile},
    scenes::is_posed,
    setup::Inputs,
};

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    inputs: Inputs,
    /// Photos that follow each other, from the middle of the capture, in place of photos that are
    /// spread evenly over it
    #[arg(long)]
    neighbours: bool,
    #[command(flatten)]
    guess: Guess,
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
        let solved = Solved::new(&engine, &capture.upload, &capture.cameras, &args.guess)?;
        let (outcome, confidence) = (solved.outcome(), solved.found.confidence);
        *outcomes.entry(outcome).or_default() += 1;
        let Compared { placed, rotation_deg, focal, .. } = solved.compared;
        let (rotation_deg, photos) = (rotation_deg.median, solved.files.len());
        progress(&format!(
            "{name}: {placed} of {photos} placed, {rotation_deg:.2} degrees, focal {focal:.3}, \
             confidence {confidence:.2}, {:.1} s -> {outcome}",
            solved.seconds
        ));
        let row = json!({ "scene": name, "photos": photos, "neighbours": args.neighbours });
        rows.push(json!({ "rotation_deg": number(rotation_deg) }), solved.row(row))?;
    }
    let count = |outcome| outcomes.get(outcome).copied().unwrap_or(0);
    let [right, wrong, refused] = ["right", "wrong", "refused"].map(count);
    progress(&format!("right {right}, wrong {wrong}, refused {refused}"));
    Ok(())
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
