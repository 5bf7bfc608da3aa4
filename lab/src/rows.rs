//! Rows of measurements: one JSON object a line. Every row says what was run, of which commit, on
//! which machine, and how large the error of the measured thing is.

use std::{
    io::Write as _,
    path::PathBuf,
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
}

/// Options of [`Record`], which are no part of the command that a row names.
const OWN_OPTIONS: [&str; 4] = ["--out", "--table", "--commit", "--machine"];

/// Writes rows, and keeps them.
#[derive(Debug)]
pub(crate) struct Rows {
    /// Table, command, commit and machine.
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
            ("command", text(command(std::env::args().skip(1)))),
            ("commit", text(record.commit.clone().unwrap_or_else(commit))),
            ("machine", text(record.machine.clone().unwrap_or_else(machine))),
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
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let mut row = self.source.clone();
        row.insert("unix_s".to_owned(), since.as_secs().into());
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
