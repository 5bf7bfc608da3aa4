//! The command line: arguments to calls of the library, answers to the terminal, errors to exits.
//!
//! Answers go to standard output, one JSON value where `--json` is given; progress, the log and
//! errors go to standard error. The exit code of an error is its row of the error table.

mod bench;
mod camera;
pub mod engine;
mod health;
mod inspect;
mod keys;
mod models;
mod output;
mod query;
mod reconstruct;
mod render;
mod sample;
mod scene_file;
mod serve;

use std::{ffi::OsString, path::PathBuf, process::ExitCode};

use clap::{Parser, Subcommand};

use self::output::Output;
use crate::{
    config::{Config, ConfigArgs},
    error::Result,
    telemetry,
};

/// Posed photos in; a 3D Gaussian scene and views at any pose out.
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
    /// Make a scene of a folder (or archive) of photos and their cameras
    Reconstruct(reconstruct::Args),
    /// Render a view of a scene
    Render(Box<render::Args>),
    /// Ask a scene by text: where is it, in space and in a view
    Query(Box<query::Args>),
    /// Say what is in a scene file
    Inspect(inspect::Args),
    /// The model bundle and ONNX Runtime
    Models(models::Args),
    /// Time a view of a scene, and say how far it is from the exact picture
    Bench(Box<bench::Args>),
    /// Write a small generated photo set with exact cameras
    Sample(sample::Args),
}

impl Command {
    fn config_args(&self) -> ConfigArgs {
        match self {
            Self::Serve(args) => args.config.clone(),
            Self::Health(args) => args.config.clone(),
            Self::Reconstruct(args) => args.config.clone(),
            Self::Render(args) => args.config.clone(),
            Self::Query(args) => args.config.clone(),
            Self::Models(args) => args.config.clone(),
            Self::Bench(args) => args.config.clone(),
            Self::Inspect(_) | Self::Sample(_) | Self::Keys(_) => ConfigArgs::default(),
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
    let cli = match Cli::try_parse_from(args) {
        Ok(cli) => cli,
        // Also `--help` and `--version`, which are no errors; clap knows the stream and the code.
        Err(told) => {
            let code = u8::try_from(told.exit_code()).unwrap_or(2);
            return if told.print().is_ok() { ExitCode::from(code) } else { ExitCode::FAILURE };
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

fn dispatch(cli: &Cli, out: &Output) -> Result<()> {
    let typed = cli.command.config_args();
    let quiet = typed.log.is_none() && !matches!(cli.command, Command::Serve(_));
    let mut config = Config::resolve(cli.config.as_deref(), typed)?;
    if quiet {
        "warn".clone_into(&mut config.log);
    }
    // Answers stand alone on standard output; the spans that are left go out at the end.
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
        Command::Render(args) => render::run(args, &config, out),
        Command::Query(args) => query::run(args, &config, out),
        Command::Inspect(args) => inspect::run(args, &config, out),
        Command::Models(args) => models::run(args, &config, out),
        Command::Bench(args) => bench::run(args, &config, out),
        Command::Sample(args) => sample::run(args, out),
    }
}
