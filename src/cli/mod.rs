//! The command line: arguments to calls of the library, answers to the terminal, errors to exit
//! codes.
//!
//! Answers go to standard output, as one JSON value with `--json`. Progress, the log and errors go
//! to standard error. The error table has the exit code of each error.

mod add;
mod bench;
mod camera;
mod cameras;
mod edit;
pub mod engine;
mod export;
mod features;
mod health;
mod inspect;
mod keys;
mod measure;
mod models;
mod output;
mod query;
mod reconstruct;
mod render;
mod sample;
mod scene_file;
mod serve;
mod video;

use std::{ffi::OsString, path::PathBuf, process::ExitCode};

use clap::{
    Parser, Subcommand,
    error::{ContextKind, ErrorKind},
};

use self::output::Output;
use crate::{
    config::{AllArgs, Config, ConfigArgs},
    error::{Error, Result},
    telemetry,
};

/// Photos in; a 3D Gaussian scene and views at any pose out.
#[derive(Debug, Parser)]
#[command(name = "segsplat", version, propagate_version = true)]
struct Cli {
    /// Answers as JSON on standard output, errors as JSON on standard error
    #[arg(long, global = true)]
    json: bool,
    /// Configuration file (TOML)
    #[arg(long, global = true, env = "SEGSPLAT_CONFIG", value_name = "FILE")]
    config: Option<PathBuf>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Serve HTTP and gRPC on one port
    Serve(Box<serve::Args>),
    /// Make API keys and hash them
    Keys(keys::Args),
    /// Ask a running server whether it is ready
    Health(Box<health::Args>),
    /// Make a scene of a folder (or archive) of photos, with their cameras or without
    Reconstruct(reconstruct::Args),
    /// Add posed photos to a scene of a running server
    Add(add::Args),
    /// Find the cameras of photos, and write them as a transforms.json
    Cameras(cameras::Args),
    /// Render a view of a scene
    Render(Box<render::Args>),
    /// Search a scene by text, in 3D and in a view
    Query(Box<query::Args>),
    /// Write a scene after a list of edits: delete, keep, move, copy, recolour
    Edit(edit::Args),
    /// Measure a scene: metres, up, ground, distances, areas and heights
    Measure(measure::Args),
    /// Write the bank of a scene, or the pixels of a view over it, as an npz file
    Features(Box<features::Args>),
    /// Write a scene for other programs: Gaussians, or a folder with photos and depth or masks
    Export(Box<export::Args>),
    /// Show what is in a scene file
    Inspect(inspect::Args),
    /// The model bundle and ONNX Runtime
    Models(models::Args),
    /// Measure the time of a view of a scene and its difference from the exact picture
    Bench(Box<bench::Args>),
    /// Write a small generated photo set with exact cameras
    Sample(sample::Args),
}

impl Command {
    fn config_args(&self) -> AllArgs {
        let common = |config: &ConfigArgs| AllArgs { config: config.clone(), ..AllArgs::default() };
        match self {
            Self::Serve(args) => args.config.clone(),
            Self::Health(args) => AllArgs { listen: args.listen.clone(), ..AllArgs::default() },
            Self::Reconstruct(args) => common(&args.config),
            Self::Add(args) => common(&args.config),
            Self::Cameras(args) => common(&args.config),
            Self::Render(args) => common(&args.config),
            Self::Query(args) => common(&args.config),
            Self::Edit(args) => common(&args.config),
            Self::Measure(args) => common(&args.config),
            Self::Features(args) => common(&args.config),
            Self::Models(args) => common(&args.config),
            Self::Bench(args) => common(&args.config),
            Self::Export(args) => common(&args.config),
            Self::Inspect(_) | Self::Sample(_) | Self::Keys(_) => AllArgs::default(),
        }
    }
}

/// Runs the program with this process's arguments.
#[must_use]
pub fn main() -> ExitCode {
    crate::crypto::install();
    run(std::env::args_os())
}

fn run(args: impl IntoIterator<Item = OsString>) -> ExitCode {
    let args: Vec<OsString> = args.into_iter().collect();
    let cli = match Cli::try_parse_from(&args) {
        Ok(cli) => cli,
        // A wrong value is an error like any other, also as JSON.
        Err(wrong) if wrong.kind() == ErrorKind::ValueValidation => {
            let error = Error::invalid(about(&wrong));
            Output::new(args.iter().any(|arg| arg == "--json")).error(&error);
            return ExitCode::from(error.code().row().exit);
        }
        // Also `--help` and `--version`, which are no errors; clap knows the stream and the code.
        Err(other) => {
            let code = u8::try_from(other.exit_code()).unwrap_or(2);
            return if other.print().is_ok() { ExitCode::from(code) } else { ExitCode::FAILURE };
        }
    };
    let out = Output::new(cli.json);
    match dispatch(&cli, &out) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            out.error(&error);
            ExitCode::from(error.code().row().exit)
        }
    }
}

/// The flag, the value given and what it must be.
fn about(wrong: &clap::Error) -> String {
    let text = |kind| wrong.get(kind).map(ToString::to_string).unwrap_or_default();
    let why = std::error::Error::source(wrong).map(ToString::to_string).unwrap_or_default();
    let (flag, value) = (text(ContextKind::InvalidArg), text(ContextKind::InvalidValue));
    format!("{flag}: {value:?}: {why}")
}

fn dispatch(cli: &Cli, out: &Output) -> Result<()> {
    let typed = cli.command.config_args();
    let quiet = typed.config.log.is_none() && !matches!(cli.command, Command::Serve(_));
    let mut config = Config::resolve(cli.config.as_deref(), typed)?;
    if quiet {
        "warn".clone_into(&mut config.log);
    }
    // Dropped at the end, which sends the last spans.
    let _spans = telemetry::start(&config)?;
    match &cli.command {
        Command::Serve(args) => {
            let (file, typed) = (cli.config.clone(), args.config.clone());
            let read_again = move || Config::resolve(file.as_deref(), typed.clone());
            serve::run(args, config, read_again, out)
        }
        Command::Keys(args) => keys::run(args, out),
        Command::Health(args) => health::run(args, &config, out),
        Command::Reconstruct(args) => reconstruct::run(args, &config, out),
        Command::Add(args) => add::run(args, &config, out),
        Command::Cameras(args) => cameras::run(args, &config, out),
        Command::Render(args) => render::run(args, &config, out),
        Command::Query(args) => query::run(args, &config, out),
        Command::Edit(args) => edit::run(args, &config, out),
        Command::Measure(args) => measure::run(args, &config, out),
        Command::Features(args) => features::run(args, &config, out),
        Command::Export(args) => export::run(args, &config, out),
        Command::Inspect(args) => inspect::run(args, &config, out),
        Command::Models(args) => models::run(args, &config, out),
        Command::Bench(args) => bench::run(args, &config, out),
        Command::Sample(args) => sample::run(args, out),
    }
}
