//! Rendered captures, whose cameras are known exactly, through the stage that users get.

use std::{collections::HashMap, path::PathBuf};

use segsplat_vision::pipeline::cameras::JudgedCameras;
use serde_json::json;

use super::{
    captures::{CAPTURES, Exif, Rendered},
    compared::number,
    hidden::{Guess, RIGHT_DEG, Solved},
};
use crate::{
    error::{Error, Result},
    pipeline::Pipeline,
    rows::{Rows, progress},
    setup::Setup,
};

/// The bars: degrees, a share of the longest way between two cameras, a share of the focal length.
const ROTATION_DEG: f64 = 0.3;
const POSITION: f64 = 0.005;
const FOCAL: f64 = 0.03;

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// Only these captures, 0 to 39, separated by commas [default: all]
    #[arg(long, value_delimiter = ',')]
    captures: Vec<usize>,
    /// Width of the photos, pixels
    #[arg(long, default_value_t = 640, value_parser = clap::value_parser!(u32).range(160..=4096))]
    width: u32,
    /// Also write each capture with its true cameras to a folder of this one
    #[arg(long, value_name = "DIR")]
    write: Option<PathBuf>,
    /// Write the captures and solve none
    #[arg(long, requires = "write")]
    only_write: bool,
    #[command(flatten)]
    guess: Guess,
    #[command(flatten)]
    setup: Setup,
}

/// How many captures meet each bar.
#[derive(Default)]
struct Tally {
    captures: usize,
    /// All photos of the place placed and accepted, no other one.
    placed: usize,
    /// Those with all cameras within the bars; those with the median one.
    within: usize,
    within_median: usize,
    refused: usize,
    wrong: usize,
    /// Photos of another place that were left out, of how many.
    foreign: [usize; 2],
    /// Accepted solutions without EXIF whose focal length is within the bar, of how many.
    focal: [usize; 2],
}

/// Makes a row for each capture.
///
/// # Errors
/// `invalid_request` for a capture that there is not, else whatever a stage says.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    if let Some(index) = args.captures.iter().find(|index| **index >= CAPTURES) {
        return Err(Error::invalid(format!("--captures {index}: it must be under {CAPTURES}")));
    }
    let all: Vec<usize> = match args.captures.is_empty() {
        true => (0..CAPTURES).collect(),
        false => args.captures.clone(),
    };
    let engine = match args.only_write {
        true => None,
        false => Some(Pipeline::open(&args.setup.networks(1))?),
    };
    let mut tally = Tally::default();
    for index in all {
        let capture = Rendered::new(index, args.width)?;
        if let Some(dir) = &args.write {
            capture.write(dir)?;
        }
        if let Some(engine) = &engine {
            measure(engine, &capture, &args.guess, &mut tally, rows)?;
        }
    }
    let Tally { captures, placed, within, within_median, refused, wrong, foreign, focal } = tally;
    progress(&format!(
        "{captures} captures: {placed} whole, {within} within the bars ({within_median} by the \
         median camera), {refused} refused, {wrong} wrong and accepted; another place left out in \
         {} of {}, focal length without EXIF within 3 % in {} of {}",
        foreign[0], foreign[1], focal[0], focal[1]
    ));
    Ok(())
}

fn measure(
    engine: &Pipeline,
    capture: &Rendered,
    guess: &Guess,
    tally: &mut Tally,
    rows: &mut Rows,
) -> Result<()> {
    let foreign = capture.foreign.as_ref();
    let cameras = capture.cameras.iter().filter(|(file, _)| Some(file) != foreign);
    let cameras: HashMap<_, _> = cameras.cloned().collect();
    let expected = cameras.len();
    let solved = Solved::new(engine, &capture.upload, &cameras, guess)?;
    let named = foreign.map(|file| is_left_out(&solved.found, &solved.files, file));
    let compared = solved.compared;
    let (outcome, accepted) = (solved.outcome(), solved.found.refused.is_none());
    let whole = accepted && compared.placed == expected && named != Some(false);
    let is_within = |turned: f64, moved: f64| whole && turned <= ROTATION_DEG && moved <= POSITION;
    let [turned, moved] = [compared.rotation_deg, compared.position];
    let within = is_within(turned.worst, moved.worst);
    let within_median = is_within(turned.median, moved.median);
    let focal_within = (compared.focal - 1.0).abs() <= FOCAL;
    tally.captures += 1;
    tally.placed += usize::from(whole);
    tally.within += usize::from(within);
    tally.within_median += usize::from(within_median);
    tally.refused += usize::from(!accepted);
    // A camera that users get although it is wrong, or of a photo that is none of the place's.
    let is_wrong = accepted && (turned.worst > RIGHT_DEG || named == Some(false));
    tally.wrong += usize::from(is_wrong);
    if let Some(named) = named {
        tally.foreign[0] += usize::from(named);
        tally.foreign[1] += 1;
    }
    if capture.exif == Exif::Absent && accepted {
        tally.focal[0] += usize::from(focal_within);
        tally.focal[1] += 1;
    }
    progress(&format!(
        "{}: {} of {expected} placed, {:.3} degrees (worst {:.3}), {:.2} % (worst {:.2}), focal \
         {:.3}, confidence {:.2}, {:.1} s -> {outcome}{}{}",
        capture.name,
        compared.placed,
        turned.median,
        turned.worst,
        100.0 * moved.median,
        100.0 * moved.worst,
        compared.focal,
        solved.found.confidence,
        solved.seconds,
        if within { ", within" } else { "" },
        named.map_or("", |named| if named { ", other place left out" } else { ", OTHER PLACE IN" }),
    ));
    let row = solved.row(json!({
        "scene": capture.name, "place": capture.place.name(), "photos": solved.files.len(),
        "expected": expected, "exif": capture.exif.name(), "foreign_left_out": named,
        "wrongly_accepted": is_wrong, "within": within, "within_median": within_median,
        "focal_within": focal_within,
    }));
    let error = json!({
        "rotation_worst_deg": number(turned.worst), "position_worst": number(moved.worst),
    });
    rows.push(error, row)
}

/// Whether a file has no camera, and is told why.
fn is_left_out(found: &JudgedCameras, files: &[String], file: &str) -> bool {
    let cameras = files.iter().zip(found.cameras());
    cameras.filter(|(name, _)| *name == file).all(|(_, camera)| camera.is_none())
}
