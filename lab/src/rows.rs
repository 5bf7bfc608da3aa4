//! Rows of measurements: one JSON object a line. Every row says what was run, of which commit, on
//! which machine, and how large the error of the measured thing is, and has the hashes of what the
//! measured code was built from (`lab/src/sources.rs`).

use std::{
    io::Write as _,
    path::{Path, PathBuf},
    process::Command,
    time::{Instant, SystemTime, UNIX_EPOCH},
};

use serde_json::{Map, Value, json};

use crate::error::{Error, Result};

/// What is written into every row beside the measurement.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Record {
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
    /// The command as the rows name it [default: this process's arguments]
    #[arg(long, global = true, hide = true)]
    command: Option<String>,
}

impl Record {
    /// Of a process that measures a part of it: `table`, into `out`, by `command`.
    pub(crate) fn arguments(&self, out: &Path, table: &str, command: &str) -> Vec<String> {
        let path = out.to_string_lossy().into_owned();
        let pairs = [
            ("--out", Some(path)),
            ("--table", Some(table.to_owned())),
            ("--command", Some(command.to_owned())),
            ("--commit", self.commit.clone()),
            ("--machine", self.machine.clone()),
        ];
        let pairs = pairs.into_iter().filter_map(|(name, value)| Some((name, value?)));
        pairs.flat_map(|(name, value)| [name.to_owned(), value]).collect()
    }

    /// Whether it is known which commit is measured.
    pub(crate) fn names_commit(&self) -> bool {
        self.commit.as_ref().is_some_and(|name| !name.is_empty()) || !commit().is_empty()
    }

    /// The file of `--out`.
    pub(crate) fn out(&self) -> Option<&Path> {
        self.out.as_deref()
    }
}

/// Options of [`Record`], which are no part of the command that a row names.
const OWN_OPTIONS: [&str; 5] = ["--out", "--table", "--commit", "--machine", "--command"];

/// The hashes of what this program was built from, by group.
pub(crate) fn built_from() -> Map<String, Value> {
    let pairs = env!("SEGSPLAT_SOURCES").split(' ').filter_map(|pair| pair.split_once('='));
    pairs.map(|(group, hash)| (group.to_owned(), json!(hash))).collect()
}

/// Writes rows, and keeps them.
#[derive(Debug)]
pub(crate) struct Rows {
    /// Table, command, commit, machine and hashes.
    source: Map<String, Value>,
    file: Option<fs_err::File>,
    rows: Vec<Value>,
}

impl Rows {
    /// Rows of this process's command, as `record` says.
    ///
    /// # Errors
    /// `invalid_request` where the file cannot be opened.
    pub(crate) fn open(record: &Record) -> Result<Self> {
        let open = |path| fs_err::OpenOptions::new().create(true).append(true).open(path);
        let file = record.out.as_ref().map(open).transpose();
        let text = |text: String| Value::String(text);
        let source = [
            ("table", text(record.table.clone())),
            ("command", text(record.command.clone().unwrap_or_else(of_this_process))),
            ("commit", text(record.commit.clone().unwrap_or_else(commit))),
            ("machine", text(record.machine.clone().unwrap_or_else(machine))),
            ("hashes", Value::Object(built_from())),
        ];
        Ok(Self {
            source: source.into_iter().map(|(key, value)| (key.to_owned(), value)).collect(),
            file: file.map_err(|e| Error::invalid("--out: cannot be opened").caused_by(e))?,
            rows: Vec::new(),
        })
    }

    /// Writes a row of the object `values` whose error is `error`: a number of dB, a difference, a
    /// share.
    ///
    /// # Errors
    /// `internal` where the file cannot be written.
    #[expect(clippy::print_stdout, reason = "the rows are the answer of the program")]
    pub(crate) fn push(&mut self, error: Value, values: Value) -> Result<()> {
        let mut row = self.source.clone();
        row.insert("unix_s".to_owned(), unix_s().into());
        row.insert("error".to_owned(), error);
        if let Value::Object(values) = values {
            row.extend(values);
        }
        let row = Value::Object(row);
        println!("{row}");
        if let Some(file) = &mut self.file {
            writeln!(file, "{row}")
                .map_err(|e| Error::internal("--out: cannot be written").caused_by(e))?;
        }
        self.rows.push(row);
        Ok(())
    }

    /// All rows.
    pub(crate) fn into_all(self) -> Vec<Value> {
        self.rows
    }
}

/// Objects of one shape as one object: the mean of each number, also of numbers in objects. What is
/// no number in each of them is left out.
#[must_use]
pub fn means<'a>(rows: impl IntoIterator<Item = &'a Value>) -> Value {
    let rows: Vec<&Value> = rows.into_iter().collect();
    let mut means = Map::new();
    for (key, value) in rows.first().and_then(|first| first.as_object()).into_iter().flatten() {
        let of_key: Vec<&Value> = rows.iter().map(|row| &row[key]).collect();
        if value.is_object() {
            means.insert(key.clone(), self::means(of_key));
        } else if let Some(numbers) = of_key.iter().map(|v| v.as_f64()).collect::<Option<Vec<_>>>()
        {
            means.insert(key.clone(), json!(mean(numbers)));
        }
    }
    Value::Object(means)
}

/// Says where the work is.
#[expect(clippy::print_stderr, reason = "a program says where it is")]
pub(crate) fn progress(what: &str) {
    eprintln!("{what}");
}

/// Seconds since 1970.
pub(crate) fn unix_s() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}

/// The day of a time in UTC: `2026-11-25`.
pub(crate) fn day(unix_s: u64) -> String {
    // Days are counted in 400 years from 1 March 0000, where the leap day is a year's last.
    let days = unix_s / 86_400 + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1_460 + day / 36_524 - day / 146_096) / 365;
    let of_year = day - (365 * year + year / 4 - year / 100);
    let month = (5 * of_year + 2) / 153;
    let of_month = of_year - (153 * month + 2) / 5 + 1;
    let (next, month) = if month < 10 { (0, month + 3) } else { (1, month - 9) };
    format!("{}-{month:02}-{of_month:02}", era * 400 + year + next)
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

/// `work` of 0 to `count`, `at_once` at a time, in order.
///
/// Threads of its own: a rayon worker that waits for another pool takes the next item, and then the
/// time of one item would hold that of another.
pub(crate) fn each<T: Send>(
    count: usize,
    at_once: usize,
    work: impl Fn(usize) -> Result<T> + Sync,
) -> Result<Vec<T>> {
    let share = |first: usize| -> Result<Vec<(usize, T)>> {
        (first..count).step_by(at_once).map(|i| Ok((i, work(i)?))).collect()
    };
    let mut found = std::thread::scope(|scope| -> Result<Vec<(usize, T)>> {
        let share = &share;
        let threads: Vec<_> = (0..at_once).map(|first| scope.spawn(move || share(first))).collect();
        let mut found = Vec::new();
        for thread in threads {
            found.extend(thread.join().map_err(|_| Error::internal("a thread panicked"))??);
        }
        Ok(found)
    })?;
    found.sort_by_key(|(i, _)| *i);
    Ok(found.into_iter().map(|(_, one)| one).collect())
}

/// This process's command line without [`OWN_OPTIONS`].
fn of_this_process() -> String {
    let (mut words, mut skip) = (vec!["segsplat-lab".to_owned()], false);
    for word in std::env::args().skip(1) {
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
        let text = done.map(|done| String::from_utf8_lossy(&done.stdout).trim().to_owned());
        text.unwrap_or_default()
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
