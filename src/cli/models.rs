//! `segsplat models`: what the bundle holds, and a check of bundle and library.

use std::fmt::Write as _;

use clap::Subcommand;
use serde_json::json;

use super::{engine::models_info, output::Output};
use crate::{
    config::{Config, ConfigArgs},
    error::Result,
    models::{Bundle, Runtime},
    pipeline::Pipeline,
    service::ModelsInfo,
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    #[command(subcommand)]
    action: Action,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

#[derive(Clone, Copy, Debug, Subcommand)]
enum Action {
    /// List the networks of the bundle
    List,
    /// Check every file against its sha256, and open the networks
    Verify,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    match args.action {
        Action::List => list(config, out),
        Action::Verify => verify(config, out),
    }
}

fn list(config: &Config, out: &Output) -> Result<()> {
    let bundle = Bundle::find(&config.networks())?;
    let info = models_info(&bundle, "");
    out.answer(&summary(&info), &json!({ "bundle": info.bundle, "models": info.models }))
}

fn summary(info: &ModelsInfo) -> String {
    let mut text = format!("bundle {} ({})\n", info.bundle, info.bundle_sha256);
    for model in &info.models {
        let _ = write!(text, "  {}: {}, {} bytes", model.name, model.file, model.size_bytes);
        // A text tower and a tokenizer take no views.
        if model.views_max > 0 {
            let _ = write!(text, ", up to {} views", model.views_max);
        }
        let _ = writeln!(text, ", {}\n    sha256 {}", model.licence, model.sha256);
    }
    text
}

fn verify(config: &Config, out: &Output) -> Result<()> {
    Bundle::find(&config.networks())?.verify()?;
    let runtime = Runtime::load(&config.networks())?;
    let engine = Pipeline::open(&config.networks())?;
    let provider = engine.geometry().provider().name();
    let info = models_info(engine.bundle(), provider);
    let build = runtime.build().unwrap_or("a library that is not pinned");
    let mut text = summary(&info);
    let _ = writeln!(text, "  every file matches its sha256");
    let _ = writeln!(text, "ONNX Runtime: {build}, sha256 {}", runtime.sha256());
    let _ = writeln!(text, "  the networks open on {provider}");
    let value = json!({
        "bundle": info.bundle,
        "bundle_sha256": info.bundle_sha256,
        "models": info.models,
        "library": runtime.build(),
        "library_sha256": runtime.sha256(),
        "execution_provider": provider,
        "verified": true,
    });
    out.answer(&text, &value)
}
