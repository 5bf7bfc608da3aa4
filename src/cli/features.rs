//! `segsplat features`: the bank of a scene file, or the pixels of a view over it, as an npz file.

use std::path::PathBuf;

use serde_json::json;

use super::{camera, engine, output::Output, scene_file};
use crate::{
    config::{Config, ConfigArgs},
    error::Result,
    names::named,
    service::{CameraFields, FeatureKind, FeaturesSpec, ScoringOptions, ViewOptions},
};

#[derive(Clone, Debug, clap::Args)]
#[command(allow_negative_numbers = true)]
pub(super) struct Args {
    /// Scene file with semantics, or a folder with one
    scene: PathBuf,
    /// File to write (.npz). Without a camera: the bank, the row of each mask, the entry of each
    /// Gaussian and of each cell of the photos
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// With a camera: weights (E, sparse) or features (F, dense)
    #[arg(long, default_value = "weights", value_parser = named::<FeatureKind>)]
    kind: FeatureKind,
    #[command(flatten)]
    camera: CameraFields,
    #[command(flatten)]
    options: ViewOptions,
    #[command(flatten)]
    scoring: ScoringOptions,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let spec = camera::spec(&args.camera)?.map(|camera| FeaturesSpec {
        camera,
        options: args.options.clone(),
        kind: args.kind,
        scoring: args.scoring.clone(),
        wait: None,
    });
    scene_file::has_folder(&args.output)?;
    let opened = scene_file::open(&args.scene, &config.limits)?;
    let service = engine::offline(config, true)?;
    let unwritable = |e| scene_file::unwritable(&args.output, e);
    let mut file = fs_err::File::create(&args.output).map_err(unwritable)?;
    service.arrays(&opened.scene, spec.as_ref(), &mut file)?;
    let size_bytes = file.metadata().map_err(unwritable)?.len();
    let text = format!("{}: {size_bytes} bytes\n", args.output.display());
    let output = args.output.display().to_string();
    out.answer(&text, &json!({ "output": output, "size_bytes": size_bytes }))
}
