//! `segsplat models`: what the bundle holds, and a check of bundle and library.

use std::{fmt::Write as _, path::PathBuf};

use clap::Subcommand;
use serde_json::json;

use super::{engine::models_info, output::Output};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, ErrorCode, Result},
    models::{self, Bundle, BundleCheck, Runtime},
    pipeline::Pipeline,
    service::ModelsInfo,
};

#[derive(Clone, Debug, clap::Args)]
#[command(mut_args(|arg| arg.global(true)))]
pub(super) struct Args {
    #[command(subcommand)]
    action: Action,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

#[derive(Clone, Debug, Subcommand)]
enum Action {
    /// List the networks of the bundle
    List,
    /// Check every file against its sha256, and open the networks
    Verify,
    /// Look at everything in a bundle: manifest, hashes, opsets, names and shapes of tensors; run
    /// each network; name all that does not fit
    Check {
        /// Folder of the bundle
        dir: PathBuf,
    },
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    match &args.action {
        Action::List => list(config, out),
        Action::Verify => verify(config, out),
        Action::Check { dir } => {
            let found = models::check(dir, &config.networks())?;
            out.answer(&table(&found), &as_json(&found))?;
            match found.faults.len() {
                0 => Ok(()),
                n => Err(Error::new(
                    ErrorCode::ModelUnavailable,
                    format!("model bundle: {n} of its things do not fit"),
                )),
            }
        }
    }
}

fn list(config: &Config, out: &Output) -> Result<()> {
    let bundle = Bundle::find(&config.networks())?;
    let info = models_info(&bundle, "")?;
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

/// Files, runs and faults of a checked bundle.
fn table(found: &BundleCheck) -> String {
    let mut text = format!("bundle {}\n", found.name);
    for file in &found.files {
        let mib = file.bytes as f64 / f64::from(1 << 20);
        let opset = file.opset.map(|n| format!("opset {n}")).unwrap_or_default();
        let fits = match (file.fits, file.doubles) {
            (false, _) => "WRONG",
            (true, 0) => "ok",
            (true, _) => "ok, but has 64-bit floats: WebGPU does not open it",
        };
        let (part, name) = (file.part, &file.file);
        let _ = writeln!(text, "  {part:20} {name:28} {mib:9.2} MiB  {opset:8}  {fits}");
    }
    for (name, [opened, ran]) in &found.ran {
        let _ =
            writeln!(text, "  {name:20} opened in {opened:.2} s, ran in {ran:.2} s, all finite");
    }
    for fault in &found.faults {
        let _ = writeln!(text, "- {fault}");
    }
    text
}

fn as_json(found: &BundleCheck) -> serde_json::Value {
    let files = found.files.iter().map(|file| {
        json!({
            "part": file.part, "file": file.file, "bytes": file.bytes, "opset": file.opset,
            "doubles": file.doubles, "fits": file.fits,
        })
    });
    let ran = found
        .ran
        .iter()
        .map(|(name, [opened, ran])| json!({ "network": name, "opened_s": opened, "ran_s": ran }));
    json!({
        "bundle": found.name,
        "files": files.collect::<Vec<_>>(),
        "ran": ran.collect::<Vec<_>>(),
        "faults": found.faults,
    })
}

fn verify(config: &Config, out: &Output) -> Result<()> {
    Bundle::find(&config.networks())?.verify()?;
    let runtime = Runtime::load(&config.networks())?;
    let engine = Pipeline::open(&config.networks())?;
    let provider = engine.geometry().provider().name();
    let info = models_info(engine.bundle(), provider)?;
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
