//! Rows of measurements: one JSON object a line. Every row says what was run, of which commit, on
//! which machine, and how large the error of the measured thing is.

use std::{
    io::Write as _,
    path::PathBuf,
    process::Command,
    time::{Instant, SystemTime, UNIX_EPOCH},
};

use serde::Serialize;
use serde_json::Value;

use crate::error::{Error, Result};

/// What is written into every row beside the measurement.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Record {
    /// File to append the rows to (JSON lines)
    #[arg(long, global = true, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Table of docs/benchmarks.md that the rows belong to
    #[arg(long, global = true, default_value = "")]
    table: String,
    /// Commit of the measured code [default: that of the working tree]
    #[arg(long, global = true, env = "SEGSPLAT_COMMIT")]
    commit: Option<String>,
    /// The machine, in words [default: its processor and cores]
    #[arg(long, global = true, env = "SEGSPLAT_MACHINE")]
    machine: Option<String>,
}

/// Options of [`Record`], which are no part of the command that a row names.
const OWN_OPTIONS: [&str; 4] = ["--out", "--table", "--commit", "--machine"];

/// Writes rows.
#[derive(Debug, Default)]
pub struct Rows {
    table: String,
    command: String,
    commit: String,
    machine: String,
    file: Option<fs_err::File>,
}

/// One line of a file of rows.
#[derive(Serialize)]
struct Row<'a, T> {
    table: &'a str,
    command: &'a str,
    commit: &'a str,
    machine: &'a str,
    unix_s: u64,
    error: Value,
    #[serde(flatten)]
    values: &'a T,
}

impl Rows {
    /// Rows of this process's command, as `record` says.
    ///
    /// # Errors
    /// `invalid_request` where the file cannot be opened.
    pub fn open(record: &Record) -> Result<Self> {
        let file = match &record.out {
            Some(path) => {
                let opened = fs_err::OpenOptions::new().create(true).append(true).open(path);
                Some(opened.map_err(|e| Error::invalid("--out: cannot be opened").caused_by(e))?)
            }
            None => None,
        };
        Ok(Self {
            table: record.table.clone(),
            command: command(std::env::args().skip(1)),
            commit: record.commit.clone().unwrap_or_else(commit),
            machine: record.machine.clone().unwrap_or_else(machine),
            file,
        })
    }

    /// Writes a row of `values` whose error is `error`: a number of dB, a difference, a share.
    ///
    /// # Errors
    /// `internal` where the values are no JSON object or the file cannot be written.
    #[expect(clippy::print_stdout, reason = "the rows are the answer of the program")]
    pub fn push(&mut self, error: impl Serialize, values: &impl Serialize) -> Result<()> {
        let fault = |e: serde_json::Error| Error::internal("a row is no JSON").caused_by(e);
        let since = SystemTime::now().duration_since(UNIX_EPOCH);
        let row = Row {
            table: &self.table,
            command: &self.command,
            commit: &self.commit,
            machine: &self.machine,
            unix_s: since.map_or(0, |since| since.as_secs()),
            error: serde_json::to_value(error).map_err(fault)?,
            values,
        };
        let line = serde_json::to_string(&row).map_err(fault)?;
        println!("{line}");
        if let Some(file) = &mut self.file {
            writeln!(file, "{line}")
                .map_err(|e| Error::internal("--out: cannot be written").caused_by(e))?;
        }
        Ok(())
    }
}

/// Says where the work is.
#[expect(clippy::print_stderr, reason = "a program says where it is")]
pub(crate) fn progress(what: &str) {
    eprintln!("{what}");
}

/// Milliseconds since `begun`.
pub(crate) fn ms(begun: Instant) -> f64 {
    begun.elapsed().as_secs_f64() * 1e3
}

/// The middle value, the larger one of two; 0 of none.
pub(crate) fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or_default()
}

/// Mean; NaN of nothing.
pub(crate) fn mean(values: impl IntoIterator<Item = f64>) -> f64 {
    let (sum, count) = values.into_iter().fold((0.0, 0.0), |(sum, n), v| (sum + v, n + 1.0));
    sum / count
}

/// The command line without [`OWN_OPTIONS`].
fn command(arguments: impl Iterator<Item = String>) -> String {
    let (mut words, mut skip) = (vec!["segsplat-lab".to_owned()], false);
    for word in arguments {
        let own = OWN_OPTIONS.iter().any(|option| word.starts_with(option));
        if !skip && !own {
            words.push(word.clone());
        }
        skip = own && !word.contains('=');
    }
    words.join(" ")
}

fn commit() -> String {
    let git = |arguments: &[&str]| -> String {
        let done = Command::new("git").args(arguments).output();
        done.map_or_else(
            |_| String::new(),
            |done| String::from_utf8_lossy(&done.stdout).trim().into(),
        )
    };
    let changed = git(&["status", "--porcelain", "--untracked-files=no"]);
    let mark = if changed.is_empty() { "" } else { " with changes" };
    format!("{}{mark}", git(&["rev-parse", "--short", "HEAD"]))
}

fn machine() -> String {
    let text = fs_err::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = text.lines().find_map(|line| line.strip_prefix("model name"));
    let name = name.map_or("unknown", |name| name.trim_start_matches(['\t', ' ', ':']));
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    format!("{cores} cores of {name}")
}
