//! `segsplat eval` and `segsplat sample`: arguments to the modules that do the work.

use std::path::PathBuf;

use serde_json::json;

use super::{
    masks::{self, MasksArgs},
    output::Output,
};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, Result},
    eval::{self, EvalOptions, EvalReport, density, semantics, words},
    sample::{self, SampleOptions},
};

#[derive(Clone, Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub(super) struct EvalArgs {
    #[command(subcommand)]
    what: Option<EvalWhat>,
    /// A scene folder (with transforms.json), or a folder of scene folders
    #[arg(required = true)]
    dir: Option<PathBuf>,
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
    config: ConfigArgs,
}

/// What is scored other than colours.
#[derive(Clone, Debug, clap::Subcommand)]
enum EvalWhat {
    /// Score what texts select in views of labelled scenes
    Semantics(SemanticsArgs),
    /// Score whether labelled images find their names
    Words(WordsArgs),
    /// Say what thinning costs and saves
    Density(DensityArgs),
    /// Say what each skip of the mask stage changes in masks and time
    Masks(MasksArgs),
}

impl EvalArgs {
    pub(super) fn config(&self) -> &ConfigArgs {
        match &self.what {
            None => &self.config,
            Some(EvalWhat::Semantics(args)) => &args.config,
            Some(EvalWhat::Words(args)) => &args.config,
            Some(EvalWhat::Density(args)) => &args.config,
            Some(EvalWhat::Masks(args)) => &args.config,
        }
    }
}

#[derive(Clone, Debug, clap::Args)]
struct SemanticsArgs {
    /// A labelled scene folder (masks/classes.json or segmentations/), or a folder of them
    dir: PathBuf,
    /// Only these scenes, by name, separated by commas [default: all]
    #[arg(long, value_delimiter = ',')]
    scenes: Vec<String>,
    /// Photos in: those nearest to the labelled photo
    #[arg(long, default_value_t = 2)]
    photos: usize,
    /// Labelled photos of a scene to score, evenly spread; 0: all of them
    #[arg(long, default_value_t = 0)]
    targets: usize,
    /// Words for what is in no scene, separated by commas
    #[arg(long, value_delimiter = ',', default_value = semantics::ABSENT)]
    absent: Vec<String>,
    /// Ask a photo first where masks of earlier photos reappear
    #[arg(long, default_value_t = semantics::understanding().seeds, action = clap::ArgAction::Set)]
    seeds: bool,
    /// Let all photos that show a Gaussian vote for its index
    #[arg(long, default_value_t = semantics::understanding().votes, action = clap::ArgAction::Set)]
    votes: bool,
    /// Join bank entries that are one thing, at least this alike (cosine); 0: none
    #[arg(long, value_name = "COSINE")]
    merge: Option<f64>,
    /// Folder for picture grids, one a scene
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
    #[command(flatten)]
    config: ConfigArgs,
}

#[derive(Clone, Debug, clap::Args)]
struct WordsArgs {
    /// Labelled sets: .npz of photographs, .tar of photographs with segments.json
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// What is asked of each name, {} in the name's place
    #[arg(long, default_value = "{}")]
    template: String,
    /// At most so many images of a set, evenly spread; 0: all that are held out
    #[arg(long, default_value_t = 0)]
    images: usize,
    #[command(flatten)]
    config: ConfigArgs,
}

#[derive(Clone, Debug, clap::Args)]
struct DensityArgs {
    /// A scene folder (with transforms.json), or a folder of scene folders
    dir: PathBuf,
    /// Only these scenes, by name, separated by commas [default: all]
    #[arg(long, value_delimiter = ',')]
    scenes: Vec<String>,
    /// Photos in: 2 (the pair) or 4 (the pair and the next two nearest to the target)
    #[arg(long, default_value_t = 2)]
    photos: usize,
    #[command(flatten)]
    config: ConfigArgs,
}

fn compare_densities(args: &DensityArgs, config: &Config, out: &Output) -> Result<()> {
    let options = density::DensityEval {
        dir: args.dir.clone(),
        scenes: args.scenes.clone(),
        photos: args.photos,
    };
    out.line(&density::DensityReport::heading());
    let reports = density::run(config, &options, &|scene| out.line(&scene.to_string()))?;
    out.answer("", &reports)
}

fn score_semantics(args: &SemanticsArgs, config: &Config, out: &Output) -> Result<()> {
    let mut understanding = semantics::understanding();
    understanding.seeds = args.seeds;
    understanding.votes = args.votes;
    if let Some(cosine) = args.merge {
        understanding.merge = (cosine > 0.0).then_some(cosine);
    }
    let options = semantics::SemanticsEval {
        dir: args.dir.clone(),
        scenes: args.scenes.clone(),
        photos: args.photos,
        targets: args.targets,
        absent: args.absent.clone(),
        understanding,
        pictures: args.pictures.clone(),
    };
    out.line(&semantics::SemanticsEvalReport::heading());
    let report = semantics::run(config, &options, &|scene| out.line(&scene.to_string()))?;
    out.answer(&report.to_string(), &report)
}

fn score_words(args: &WordsArgs, config: &Config, out: &Output) -> Result<()> {
    let options = words::WordsOptions {
        files: args.files.clone(),
        template: args.template.clone(),
        images_max: args.images,
    };
    let told = |set: &str, images| out.progress(&format!("{set}: {images} images"), 1.0);
    let report = words::run(config, &options, &told)?;
    out.answer(&report.to_string(), &report)
}

pub(super) fn eval(args: &EvalArgs, config: &Config, out: &Output) -> Result<()> {
    let dir = match (&args.what, &args.dir) {
        (Some(EvalWhat::Semantics(args)), _) => return score_semantics(args, config, out),
        (Some(EvalWhat::Words(args)), _) => return score_words(args, config, out),
        (Some(EvalWhat::Density(args)), _) => return compare_densities(args, config, out),
        (Some(EvalWhat::Masks(args)), _) => return masks::run(args, config, out),
        (None, Some(dir)) => dir.clone(),
        (None, None) => return Err(Error::invalid("eval: it takes a folder")),
    };
    let options = EvalOptions {
        dir,
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
