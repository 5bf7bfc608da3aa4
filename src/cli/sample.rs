//! `segsplat sample`: a generated photo set, for a first try.

use std::path::PathBuf;

use serde_json::json;

use super::output::Output;
use crate::{
    error::{Error, Result},
    sample::{self, SampleOptions},
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    /// Folder to write; made where missing
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Photos, 2 to 64
    #[arg(long, default_value_t = SampleOptions::default().photos)]
    photos: usize,
    /// Size of each photo in pixels
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value = "320x240", value_parser = size)]
    size: (u32, u32),
    /// Seed of the room
    #[arg(long, default_value_t = SampleOptions::default().seed)]
    seed: u64,
}

fn size(text: &str) -> Result<(u32, u32)> {
    let sides = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    sides.ok_or_else(|| Error::invalid(format!("{text:?} is no size like 320x240")))
}

pub(super) fn run(args: &Args, out: &Output) -> Result<()> {
    let (width, height) = args.size;
    let options = SampleOptions { photos: args.photos, width, height, seed: args.seed };
    sample::run(&args.output, &options)?;
    let text = format!("{}: {} photos of {width}x{height} px", args.output.display(), args.photos);
    let value = json!({
        "output": args.output.display().to_string(),
        "photos": args.photos,
        "width": width,
        "height": height,
        "seed": args.seed,
    });
    out.answer(&text, &value)
}
