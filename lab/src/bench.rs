//! Measures what the page has no rows of this tree for: runs the commands of `benches/tables.toml`,
//! one process after the other, each with a time limit.
//!
//! A command whose rows of this tree are kept already is not run again, so a call that ended early
//! goes on where it was. The rows of a command are kept when it has ended well.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use serde_json::Value;

use crate::{
    error::{Error, Result},
    kept::{Grouped, Tree, file, runs},
    report::RUNS,
    rows::{Record, built_from, day, progress, unix_s},
    tables::{On, Table, Tables},
};

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// Only the tables that need this [default: all]
    on: Option<On>,
    /// Only these tables, separated by commas
    #[arg(long, value_delimiter = ',', value_name = "TABLE")]
    only: Vec<String>,
    /// Print the commands that would be run, and run none
    #[arg(long)]
    list: bool,
    /// Begin no command that might end later than this, seconds from now
    #[arg(long, default_value_t = 86_400)]
    within: u64,
    /// The repository's folder
    #[arg(long, default_value = ".")]
    root: PathBuf,
    /// Folder of the shared data, `DATA` in the commands
    #[arg(long, env = "SEGSPLAT_SHARED_DATA", default_value = "../shared/data")]
    data: PathBuf,
    /// The server's program, `SEGSPLAT` in the commands
    #[arg(long, env = "SEGSPLAT_BIN", default_value = "target/release/segsplat")]
    segsplat: PathBuf,
}

/// A command that is to be run.
#[derive(Debug)]
struct Step<'a> {
    table: &'a Table,
    run: &'a str,
}

/// Runs the commands that are asked for and have no rows of this tree. The rows go into the file of
/// `--out`, else into one of the day in `benches/runs`.
///
/// # Errors
/// `invalid_request` where this program is of another tree, and where a command is left or failed.
pub(crate) fn run(args: &Args, record: &Record) -> Result<()> {
    let tables = Tables::read(&args.root)?;
    let steps = steps(args, &tables)?;
    let tree = Tree::read(&args.root)?;
    current(&steps, &tree)?;
    let of_day = args.root.join(RUNS).join(format!("{}-bench.jsonl", day(unix_s())));
    let out = record.out().map_or(of_day, Path::to_owned);
    let kept = kept(args, &out)?;
    let (done, open): (Vec<Step<'_>>, Vec<_>) =
        steps.into_iter().partition(|step| step.is_done(&kept, &tree));
    progress(&format!("{} commands have rows of this tree, {} have none", done.len(), open.len()));
    if args.list {
        open.iter().for_each(Step::print);
        return Ok(());
    }
    if !record.names_commit() {
        return Err(Error::invalid("--commit must name the commit: there is no git here"));
    }
    let begun = Instant::now();
    let (mut filled, mut left) = (BTreeMap::new(), Vec::new());
    for step in &open {
        let (table, run) = (&step.table.name, step.run);
        if begun.elapsed().as_secs() + step.table.seconds > args.within {
            left.push(format!("{table}: no time for: {run}"));
            continue;
        }
        let since = Instant::now();
        match step.run(args, record, &out) {
            Ok(rows) => {
                let took = since.elapsed().as_secs_f64();
                progress(&format!("{table}: {rows} rows in {took:.0} s: {run}"));
                *filled.entry(table).or_insert(0) += rows;
            }
            Err(error) => {
                progress(&format!("{table}: {error}: {run}"));
                left.push(format!("{table}: {error}: {run}"));
            }
        }
    }
    let filled: Vec<String> = filled.iter().map(|(name, rows)| format!("{name} {rows}")).collect();
    progress(&format!("{}: rows of {}", out.display(), filled.join(", ")));
    match left.is_empty() {
        true => Ok(()),
        false => Err(Error::invalid(format!("commands are left:\n{}", left.join("\n")))),
    }
}

/// The commands of the tables that are asked for.
fn steps<'a>(args: &Args, tables: &'a Tables) -> Result<Vec<Step<'a>>> {
    for name in &args.only {
        tables.named(name)?;
    }
    let asked = |table: &&Table| match args.only.is_empty() {
        true => args.on.is_none_or(|on| table.on == Some(on)),
        false => args.only.contains(&table.name),
    };
    let of = |table: &'a Table| table.runs.iter().map(move |run| Step { table, run });
    Ok(tables.table.iter().filter(asked).flat_map(of).collect())
}

/// Refuses a program that was built from other files than are here: its rows would be older at
/// once.
fn current(steps: &[Step<'_>], tree: &Tree) -> Result<()> {
    let built = Value::Object(built_from());
    let groups: BTreeSet<String> = steps.iter().flat_map(|step| step.table.of.clone()).collect();
    let changed = tree.changed(&built, &groups.into_iter().collect::<Vec<_>>());
    match changed.is_empty() {
        true => Ok(()),
        false => Err(Error::invalid(format!(
            "this program was built from another tree ({} differ): build it again",
            changed.join(", ")
        ))),
    }
}

fn kept(args: &Args, out: &Path) -> Result<Grouped> {
    let folder = args.root.join(RUNS);
    let mut kept = runs(&folder)?;
    if out.is_file() && out.parent() != Some(&folder) {
        file(out, &mut kept)?;
    }
    Ok(kept)
}

impl Step<'_> {
    fn command(&self) -> String {
        format!("segsplat-lab {}", self.run)
    }

    #[expect(clippy::print_stdout, reason = "the commands are the answer of the program")]
    fn print(&self) {
        let Table { name, seconds, .. } = self.table;
        println!("{name} (at most {seconds} s): {}", self.command());
    }

    fn is_done(&self, kept: &Grouped, tree: &Tree) -> bool {
        let mut rows = kept.get(self.table.rows_of()).into_iter().flatten();
        let command = self.command();
        rows.any(|kept| {
            kept.text("command") == command && kept.older(&self.table.of, tree).is_none()
        })
    }

    /// Runs it and adds its rows to `out`; their number.
    fn run(&self, args: &Args, record: &Record, out: &Path) -> Result<usize> {
        let fault = |what: &str| Error::internal(what.to_owned());
        let folder = tempfile::tempdir().map_err(|e| fault("no temporary folder").caused_by(e))?;
        let rows = folder.path().join("rows.jsonl");
        let program = std::env::current_exe().map_err(|e| fault("no program").caused_by(e))?;
        let word = |word: &str| -> String {
            let (data, segsplat) = (args.data.to_string_lossy(), args.segsplat.to_string_lossy());
            match word.strip_prefix("DATA/") {
                Some(rest) => format!("{data}/{rest}"),
                None => word.replace("SEGSPLAT", &segsplat),
            }
        };
        let mut command = Command::new(program);
        command.args(self.run.split_whitespace().map(word));
        command.args(record.arguments(&rows, self.table.rows_of(), &self.command()));
        command.current_dir(&args.root).stdout(Stdio::null());
        wait(command, Duration::from_secs(self.table.seconds))?;
        let written = fs_err::read_to_string(&rows).map_err(|e| fault("no rows").caused_by(e))?;
        let open = fs_err::OpenOptions::new().create(true).append(true).open(out);
        let add = |mut file: fs_err::File| std::io::Write::write_all(&mut file, written.as_bytes());
        open.and_then(add).map_err(|e| fault("--out: cannot be written").caused_by(e))?;
        match written.lines().count() {
            0 => Err(fault("it wrote no row")),
            count => Ok(count),
        }
    }
}

/// Runs a command to its end, or ends it, with what it started, when its time is over.
fn wait(mut command: Command, limit: Duration) -> Result<()> {
    let fault = |what: &str| Error::internal(what.to_owned());
    let mut child = in_its_own_group(&mut command)
        .spawn()
        .map_err(|e| fault("it does not start").caused_by(e))?;
    let begun = Instant::now();
    loop {
        let ended = child.try_wait().map_err(|e| fault("it cannot be watched").caused_by(e))?;
        match ended {
            Some(status) if status.success() => return Ok(()),
            Some(status) => return Err(fault(&format!("it failed ({status})"))),
            None if begun.elapsed() > limit => {
                end(&mut child);
                return Err(fault(&format!("it took more than {} s", limit.as_secs())));
            }
            None => std::thread::sleep(Duration::from_millis(50)),
        }
    }
}

#[cfg(unix)]
fn in_its_own_group(command: &mut Command) -> &mut Command {
    std::os::unix::process::CommandExt::process_group(command, 0)
}

#[cfg(not(unix))]
fn in_its_own_group(command: &mut Command) -> &mut Command {
    command
}

/// Ends a child, and on Unix the servers that it started.
fn end(child: &mut Child) {
    if cfg!(unix) {
        let group = format!("kill -KILL -{}", child.id());
        // It may have ended meanwhile.
        let _ = Command::new("sh").args(["-c", &group]).stderr(Stdio::null()).status();
    }
    let _ = child.kill();
    let _ = child.wait();
}
