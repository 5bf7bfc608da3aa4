//! The laboratory of SegSplat Server: it measures quality and time, and writes the tables of
//! `docs/benchmarks.md`. It is not published and the server does not use it.
//!
//! Each command prints one JSON row for each thing that it measures, and appends the rows to the
//! file that `--out` names. A row holds its command, its commit, its machine, its error and the
//! hashes of what was measured ([`rows`]). `bench` runs the commands of the tables that have no row
//! of this tree, and `report` makes the tables of the page from the rows ([`report`]).

mod bench;
mod cameras;
mod density;
mod frames;
mod grid;
mod kept;
mod load;
mod many;
mod masks;
pub mod metrics;
mod networks;
mod pairs;
mod photos;
mod refinements;
pub mod report;
pub mod rows;
pub mod scenes;
pub mod semantics;
mod setup;
mod sources;
mod tables;
pub mod triples;
pub mod warp;
pub mod words;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use segsplat_core::{error, limits, scene};
use segsplat_formats::npy;
use segsplat_render as render;
use segsplat_vision::{models, photos as photo_files, pipeline, refine, sample, segment};

use self::rows::{Record, Rows};
use crate::error::Result;

/// Measures SegSplat Server.
#[derive(Debug, Parser)]
#[command(name = "segsplat-lab", version)]
pub struct Cli {
    #[command(flatten)]
    record: Record,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Compare views of scenes with photos that were held out
    Photos(photos::Args),
    /// Compare scenes of many photos with photos that were held out, refined or not
    Many(many::Args),
    /// Hide the cameras of captures, solve them, and compare them
    Cameras(cameras::Args),
    /// Solve the cameras of rendered captures, and compare them with the true ones
    Rendered(cameras::rendered::Args),
    /// Compare thinned scenes with scenes of all Gaussians
    Density(setup::Inputs),
    /// Compare views that show scenes smaller than their photos with those of their own size
    Afar(setup::Inputs),
    /// Compare files of Gaussians with the Gaussians that went in
    Exports(setup::Inputs),
    /// Compare what texts select with labels
    Semantics(semantics::Args),
    /// Compare the shortcuts of the mask stage
    Masks(masks::Args),
    /// Ask labelled images for their names
    Words(words::Args),
    /// Time the networks on a provider and hold them to the CPU
    Networks(networks::Args),
    /// Time frames of a generated scene
    Frames(frames::Args),
    /// Time frames with their backward passes
    Backward(frames::Args),
    /// Time frames without each kind of skipped work
    Skips(frames::Args),
    /// What views cost that show little of a scene, with and without blocks
    Aims(frames::Args),
    /// Time frames that may differ from the exact ones by so much
    Frontier(frames::frontier::FrontierArgs),
    /// What a view from afar costs that may have merged Gaussians
    Detail(frames::detail::DetailArgs),
    /// Ask a server for views and scenes, as its callers do
    #[command(subcommand)]
    Load(load::Command),
    /// Measure what docs/benchmarks.md has no rows of this tree for
    Bench(bench::Args),
    /// Write the tables of docs/benchmarks.md from the rows
    Report(report::Args),
}

/// Runs the program with this process's arguments.
#[must_use]
pub fn main() -> ExitCode {
    let cli = Cli::parse();
    match run(&cli) {
        Ok(_rows) => ExitCode::SUCCESS,
        Err(error) => {
            let mut source = std::error::Error::source(&error);
            rows::progress(&format!("error: {error}"));
            while let Some(cause) = source {
                rows::progress(&format!("  because: {cause}"));
                source = cause.source();
            }
            ExitCode::from(error.code().row().exit)
        }
    }
}

/// Runs a command; its rows, which it also prints.
///
/// # Errors
/// Those of the command.
pub fn run(cli: &Cli) -> Result<Vec<serde_json::Value>> {
    let mut rows = Rows::open(&cli.record)?;
    match &cli.command {
        Command::Photos(args) => photos::run(args, &mut rows)?,
        Command::Many(args) => many::run(args, &mut rows)?,
        Command::Cameras(args) => cameras::run(args, &mut rows)?,
        Command::Rendered(args) => cameras::rendered::run(args, &mut rows)?,
        Command::Density(args) => density::run(args, &mut rows)?,
        Command::Afar(inputs) => pairs::afar(inputs, &mut rows)?,
        Command::Exports(inputs) => pairs::exports(inputs, &mut rows)?,
        Command::Semantics(args) => semantics::run(args, &mut rows)?,
        Command::Masks(args) => masks::run(args, &mut rows)?,
        Command::Words(args) => words::run(args, &mut rows)?,
        Command::Networks(args) => networks::run(args, &mut rows)?,
        Command::Frames(args) => frames::run(args, &mut rows)?,
        Command::Backward(args) => frames::backward::run(args, &mut rows)?,
        Command::Skips(args) => frames::skips::run(args, &mut rows)?,
        Command::Aims(args) => frames::aims::run(args, &mut rows)?,
        Command::Frontier(args) => frames::frontier::run(args, &mut rows)?,
        Command::Detail(args) => frames::detail::run(args, &mut rows)?,
        Command::Load(command) => load::run(command, &mut rows)?,
        Command::Bench(args) => bench::run(args, &cli.record)?,
        Command::Report(args) => report::run(args)?,
    }
    Ok(rows.into_all())
}
