//! `segsplat eval masks`: arguments to the comparison of roads through the mask stage.

use std::path::PathBuf;

use super::output::Output;
use crate::{
    config::{Config, ConfigArgs},
    error::Result,
    eval::masks::{self, MasksEval},
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct MasksArgs {
    /// A scene folder (with transforms.json), or a folder of scene folders
    dir: PathBuf,
    /// Only these scenes, by name, separated by commas [default: all]
    #[arg(long, value_delimiter = ',')]
    scenes: Vec<String>,
    /// Neighbouring photos of each scene
    #[arg(long, default_value_t = 3)]
    photos: usize,
    /// Only the road that skips nothing and the product's
    #[arg(long)]
    short: bool,
    /// Folder for the photos and their masks before one a pixel is left
    #[arg(long, value_name = "DIR")]
    dump: Option<PathBuf>,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

pub(super) fn run(args: &MasksArgs, config: &Config, out: &Output) -> Result<()> {
    let options = MasksEval {
        dir: args.dir.clone(),
        scenes: args.scenes.clone(),
        photos: args.photos,
        short: args.short,
        dump: args.dump.clone(),
    };
    let report = masks::run(config, &options, &|line| out.line(line))?;
    out.answer(&report.to_string(), &report)
}
