//! `segsplat eval` and `segsplat sample`: arguments to the modules that do the work.

use std::path::PathBuf;

use serde_json::json;

use super::output::Output;
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, Result},
    eval::{self, EvalOptions, EvalReport},
    sample::{self, SampleOptions},
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct EvalArgs {
    /// A scene folder (with transforms.json), or a folder of scene folders
    dir: PathBuf,
    /// Only these scenes, by name, separated by commas [default: all]
    #[arg(long, value_delimiter = ',')]
    scenes: Vec<String>,
    /// Photos in: 2 (the pair) or 4 (the pair and the next two nearest to the target)
    #[arg(long, default_value_t = 2)]
    photos: usize,
    /// Triples at work at the same time
    #[arg(long, default_value_t = 1)]
    at_once: usize,
    /// Take every n-th triple only
    #[arg(long, default_value_t = 1)]
    every: usize,
    /// Folder for picture grids, one a scene
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

pub(super) fn eval(args: &EvalArgs, config: &Config, out: &Output) -> Result<()> {
    let options = EvalOptions {
        dir: args.dir.clone(),
        scenes: args.scenes.clone(),
        photos: args.photos,
        at_once: args.at_once,
        every: args.every,
        pictures: args.pictures.clone(),
    };
    out.line(&EvalReport::heading());
    let report = eval::run(config, &options, &|scene| out.line(&scene.to_string()))?;
    out.answer(&report.to_string(), &report)
}

#[derive(Clone, Debug, clap::Args)]
pub(super) struct SampleArgs {
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

pub(super) fn sample(args: &SampleArgs, out: &Output) -> Result<()> {
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
