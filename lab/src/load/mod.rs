//! What callers get from a server: views and scenes, asked for over HTTP/1.1, HTTP/2 and gRPC.
//!
//! `load views` asks for a new view each time, in a closed loop (each caller asks again when it has
//! its answer) or in an open one (a rate), and beside it the library draws the same views for as
//! many callers. `load scenes` posts photos. The servers are given by path and run on loopback,
//! several of them in turn, so that one run compares them.

mod ask;
mod door;
mod library;
mod path;
mod photos;
mod scenes;
mod server;
mod start;
mod tally;
mod views;

use clap::Subcommand;

use crate::{error::Result, rows::Rows};

/// What to ask for.
#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Views of one scene, a new one each time
    Views(views::Args),
    /// Scenes of two photos, and the mask of a text in each
    Scenes(scenes::Args),
    /// Starts of a server, until it listens and until its networks are open
    Start(start::Args),
}

/// Makes the rows of the command.
///
/// # Errors
/// Those of the command.
pub(crate) fn run(command: &Command, rows: &mut Rows) -> Result<()> {
    match command {
        Command::Views(args) => views::run(args, rows),
        Command::Scenes(args) => scenes::run(args, rows),
        Command::Start(args) => start::run(args, rows),
    }
}
