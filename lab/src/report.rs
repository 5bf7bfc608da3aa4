//! Writes the tables of `docs/benchmarks.md` and `docs/published.md` from the rows of
//! `benches/runs/*.jsonl`.
//!
//! `benches/tables.toml` describes each table: the columns, each a heading and a template such as
//! `{gaussians:,}` or `{device.total_ms:.3} ms`. A table takes the rows whose `table` is its name,
//! in the order of the files. With `key` and `pivot`, rows of one key become one line, and a
//! template names the row by the value of its pivot: `{2.psnr:.2}`. A page has a table between
//! `<!-- table: NAME -->` and `<!-- end -->`. A table without columns is on none: its rows are for
//! `today`.
//!
//! A row is *older* where a group of files that its table depends on is no longer what it was when
//! the row was measured (`lab/src/sources.rs`). A table shows the rows of this tree; where it has
//! none, it shows the older ones, and says since when and what changed. So a change of a shader
//! changes the page, and a page that does not say it is refused.
//!
//! `today` is made of lines: each has figures of rows of other tables.
//!
//! A table with `ours` is of what others published: its rows are those of
//! `benches/published/paper.jsonl`, each with its source, and ours come below them. With `--beside`
//! these tables are printed with rows of a run that is not on the page.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::Write as _,
    path::{Path, PathBuf},
};

use serde_json::{Map, Value};

use crate::{
    error::{Error, Result},
    kept::{Grouped, Kept, Tree, all, any, published, runs},
    rows::{built_from, progress},
    tables::{Line, Pick, Table, Tables},
};

/// The pages with tables.
const PAGES: [&str; 2] = ["docs/benchmarks.md", "docs/published.md"];
/// What is around a table on a page.
const BEGIN: &str = "<!-- table: ";
const END: &str = "<!-- end -->";
/// The first table of the page, which is made of [`Line`]s.
const TODAY: &str = "today";

/// What to write.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// The repository's folder
    #[arg(long, default_value = ".")]
    root: PathBuf,
    /// Write nothing; name the rows that are older than the tree, and fail where the page differs
    #[arg(long)]
    check: bool,
    /// Move the rows that no table shows to `docs/measurements/runs`
    #[arg(long)]
    retire: bool,
    /// Write nothing; print the hashes that rows of this program have, for programs that measure
    /// beside it
    #[arg(long)]
    hashes: bool,
    /// Write nothing; print this table of published figures with the rows of a file below them
    #[arg(long, value_name = "TABLE=FILE")]
    beside: Vec<String>,
}

/// Writes the page, or checks it.
///
/// # Errors
/// `invalid_request` where a file cannot be read, where a row has no command, commit, machine or
/// error, and with `check` where the page differs.
pub(crate) fn run(args: &Args) -> Result<()> {
    if args.hashes {
        print(&Value::Object(built_from()).to_string());
        return Ok(());
    }
    if !args.beside.is_empty() {
        return args.beside.iter().try_for_each(|asked| {
            print(&beside(&args.root, asked)?);
            Ok(())
        });
    }
    if args.retire {
        retire(&args.root)?;
    }
    if args.check {
        older(&args.root)?.iter().for_each(|row| progress(row));
    }
    let mut wrong = Vec::new();
    for page in pages(&args.root)?.into_iter().filter(|page| page.old != page.new) {
        if args.check {
            wrong.push(format!("{}: {}", page.name, differ(&page.old, &page.new).join(", ")));
        } else {
            fs_err::write(args.root.join(page.name), page.new)
                .map_err(|e| Error::invalid("the page: no write").caused_by(e))?;
        }
    }
    match wrong.is_empty() {
        true => Ok(()),
        false => Err(Error::invalid(format!(
            "tables do not say what rows and tree say: make report ({})",
            wrong.join("; ")
        ))),
    }
}

#[expect(clippy::print_stdout, reason = "it is the answer of the program")]
fn print(text: &str) {
    println!("{text}");
}

/// The rows of the page that are older than the tree at `root`, a line each.
///
/// # Errors
/// As `run`.
pub fn older(root: &Path) -> Result<Vec<String>> {
    let (tables, tree, rows) = (Tables::read(root)?, Tree::read(root)?, runs(&root.join(RUNS))?);
    let mut lines = Vec::new();
    for table in tables.table.iter().filter(|table| table.rows.is_none()) {
        for kept in rows.get(table.rows_of()).into_iter().flatten() {
            if let Some(why) = kept.older(&table.of, &tree) {
                let (place, date, commit) = (&kept.place, &kept.date, kept.text("commit"));
                let name = &table.name;
                lines.push(format!("older: {name}: {place}, {commit} of {date}: {why}"));
            }
        }
    }
    Ok(lines)
}

/// The hash of each group of files of the tree at `root`, as rows of that tree have them.
///
/// # Errors
/// `invalid_request` where a file cannot be read.
pub fn hashes(root: &Path) -> Result<Value> {
    Ok(Tree::read(root)?.hashes())
}

/// Moves the rows that no table shows to the older measurements.
///
/// # Errors
/// As `run`, and where a file cannot be written.
pub fn retire(root: &Path) -> Result<()> {
    let (tables, tree, rows) = (Tables::read(root)?, Tree::read(root)?, runs(&root.join(RUNS))?);
    let of_table = |table: &Table| match &table.ours {
        None => table.shown(&rows, &tree),
        Some(ours) => newest(ours.rows.as_ref().and_then(|name| rows.get(name)), table, &tree),
    };
    let shown: BTreeSet<String> =
        tables.table.iter().flat_map(of_table).map(|kept| kept.place).collect();
    let files: BTreeSet<&str> =
        rows.values().flatten().filter_map(|kept| Some(kept.place.split_once(',')?.0)).collect();
    let fault = |e: std::io::Error| Error::internal("rows cannot be moved").caused_by(e);
    for name in files {
        let (from, to) = (root.join(RUNS).join(name), root.join(RETIRED).join(name));
        let text = fs_err::read_to_string(&from).map_err(fault)?;
        let lines = text.lines().enumerate();
        let (stay, go): (Vec<_>, Vec<_>) =
            lines.partition(|(i, _)| shown.contains(&format!("{name}, row {}", i + 1)));
        let joined = |lines: &[(usize, &str)]| -> String {
            lines.iter().flat_map(|(_, line)| [*line, "\n"]).collect()
        };
        if !go.is_empty() {
            let there = if to.is_file() { fs_err::read_to_string(&to) } else { Ok(String::new()) };
            fs_err::write(&to, there.map_err(fault)? + &joined(&go)).map_err(fault)?;
            match stay.is_empty() {
                true => fs_err::remove_file(&from).map_err(fault)?,
                false => fs_err::write(&from, joined(&stay)).map_err(fault)?,
            }
        }
    }
    Ok(())
}

/// Where the rows are.
pub(crate) const RUNS: &str = "benches/runs";
/// Where those are that no table shows any more.
const RETIRED: &str = "docs/measurements/runs";

/// Names of the tables that two pages have with different texts.
fn differ(old: &str, new: &str) -> Vec<String> {
    let blocks = |page: &str| -> BTreeMap<String, String> {
        let blocks = page.split(BEGIN).skip(1);
        let pair = |block: &str| {
            let (name, rest) = block.split_once(" -->")?;
            Some((name.to_owned(), rest.split(END).next()?.to_owned()))
        };
        blocks.filter_map(pair).collect()
    };
    let (old, new) = (blocks(old), blocks(new));
    new.into_iter().filter(|(name, text)| old.get(name) != Some(text)).map(|(n, _)| n).collect()
}

/// A page, as it is and as the rows and the tree have it.
#[derive(Debug)]
pub struct Page {
    /// Its path in the repository.
    pub name: &'static str,
    /// Its text.
    pub old: String,
    /// Its text with the tables made anew.
    pub new: String,
}

/// The pages with their tables made anew from the files under `root`: each table is on one.
///
/// # Errors
/// As `run`.
pub fn pages(root: &Path) -> Result<Vec<Page>> {
    let mut blocks = blocks(root)?;
    let mut pages = Vec::new();
    for name in PAGES.into_iter().filter(|name| root.join(name).is_file()) {
        let fault = |e| Error::invalid(format!("{name}: cannot be read")).caused_by(e);
        let old = fs_err::read_to_string(root.join(name)).map_err(fault)?;
        let mut new = String::new();
        let mut rest = old.as_str();
        while let Some((before, after)) = rest.split_once(BEGIN) {
            let wrong = |what: &str| Error::invalid(format!("{name}: {what}"));
            let (table, after) =
                after.split_once(" -->\n").ok_or_else(|| wrong("a table has no name"))?;
            let text = blocks.remove(table);
            let text = text.ok_or_else(|| wrong(&format!("there is no table {table}, or two")))?;
            let (_, after) = after.split_once(END).ok_or_else(|| wrong("a table has no end"))?;
            new.extend([before, BEGIN, table, " -->\n", &text, END]);
            rest = after;
        }
        new.push_str(rest);
        pages.push(Page { name, old, new });
    }
    match blocks.keys().next() {
        None => Ok(pages),
        Some(table) => Err(Error::invalid(format!("no page has the table {table}"))),
    }
}

/// The text of each table by its name.
fn blocks(root: &Path) -> Result<BTreeMap<String, String>> {
    let (tables, tree) = (Tables::read(root)?, Tree::read(root)?);
    let (rows, published) = (runs(&root.join(RUNS))?, published(root)?);
    let mut blocks = BTreeMap::new();
    if !tables.line.is_empty() {
        blocks.insert(TODAY.to_owned(), today(&tables, &rows, &tree)?);
    }
    for table in tables.table.iter().filter(|table| !table.columns.is_empty()) {
        let text = match &table.ours {
            None => {
                let rows = table.shown(&rows, &tree);
                table.mark(&rows, &tree) + &table.write(&rows, &[])
            }
            Some(ours) => {
                let ours = ours.rows.as_ref().map(|name| newest(rows.get(name), table, &tree));
                let ours = ours.unwrap_or_default();
                let theirs = published.get(&table.name).cloned().unwrap_or_default();
                if theirs.is_empty() {
                    let name = &table.name;
                    return Err(Error::invalid(format!("there are no rows of table {name}")));
                }
                table.mark(&ours, &tree) + &table.write(&theirs, &ours)
            }
        };
        blocks.insert(table.name.clone(), text);
    }
    Ok(blocks)
}

/// The table of published figures that `TABLE=FILE` names, with the file's rows below them.
///
/// # Errors
/// `invalid_request` where there is no such table or file, or no row of the file fits.
pub fn beside(root: &Path, asked: &str) -> Result<String> {
    let tables = Tables::read(root)?.table;
    let known: Vec<&str> =
        tables.iter().filter(|t| t.ours.is_some()).map(|t| t.name.as_str()).collect();
    let wrong = || format!("--beside {asked:?} must be TABLE=FILE; tables: {}", known.join(", "));
    let named = asked.split_once('=').filter(|(name, _)| known.contains(name));
    let (name, file) = named.ok_or_else(|| Error::invalid(wrong()))?;
    let rows = any(Path::new(file))?;
    let published = published(root)?.remove(name).unwrap_or_default();
    let table = tables.iter().find(|table| table.name == name);
    match table.filter(|table| !table.below(&rows).is_empty()) {
        Some(table) => Ok(table.write(&published, &rows)),
        None => Err(Error::invalid(format!("{file}: no row fits the table {name}"))),
    }
}

/// The first table: each task with its time, its error, the machine, and the commits of both.
fn today(tables: &Tables, rows: &Grouped, tree: &Tree) -> Result<String> {
    let mut text = "| task | time | error | machine | commit and day |\n".to_owned();
    text.push_str("| --- | --- | --- | --- | --- |\n");
    for Line { task, time, error } in &tables.line {
        let mut of: Vec<String> = Vec::new();
        let mut figure = |pick: &Pick| -> Result<(String, String)> {
            let table = tables.named(&pick.table)?;
            let shown = table.shown(rows, tree);
            let fits =
                |kept: &&Kept| pick.is.iter().all(|(path, value)| has(&kept.row, path, value));
            let Some(kept) = shown.iter().rfind(fits) else {
                return Ok(("not measured".to_owned(), String::new()));
            };
            let mark = if kept.older(&table.of, tree).is_none() { "" } else { ", ***older***" };
            let made = format!("{} of {}{mark}", kept.text("commit"), kept.date);
            of.extend((!of.contains(&made)).then_some(made));
            Ok((fill(&pick.show, &kept.row), kept.text("machine").to_owned()))
        };
        let ((time, machine), (error, _)) = (figure(time)?, figure(error)?);
        let of = of.join("; ");
        let _ = writeln!(text, "| {task} | {time} | {error} | {machine} | {of} |");
    }
    Ok(text)
}

/// Whether the value at a path of the row is this one.
fn has(row: &Value, path: &str, value: &Value) -> bool {
    let same = |found: &Value| match (found.as_f64(), value.as_f64()) {
        (Some(found), Some(value)) => found == value,
        _ => found == value,
    };
    at(row, path).is_some_and(same)
}

/// The rows of this tree; all of them where none is.
fn newest(rows: Option<&Vec<Kept>>, table: &Table, tree: &Tree) -> Vec<Kept> {
    let fits = |kept: &&Kept| table.only.iter().all(|(path, value)| has(&kept.row, path, value));
    let rows: Vec<Kept> = rows.into_iter().flatten().filter(fits).cloned().collect();
    let fresh = rows.iter().filter(|kept| kept.older(&table.of, tree).is_none());
    let fresh: Vec<Kept> = fresh.cloned().collect();
    if fresh.is_empty() { rows } else { fresh }
}

impl Table {
    /// The rows that it shows.
    fn shown(&self, rows: &Grouped, tree: &Tree) -> Vec<Kept> {
        newest(rows.get(self.rows_of()), self, tree)
    }

    fn write(&self, rows: &[Kept], ours: &[Kept]) -> String {
        if rows.is_empty() {
            return "Not measured.\n".to_owned();
        }
        let mut text = String::new();
        let line = |text: &mut String, cells: &mut dyn Iterator<Item = String>| {
            let cells: Vec<String> = cells.collect();
            let _ = writeln!(text, "| {} |", cells.join(" | "));
        };
        line(&mut text, &mut self.columns.iter().map(|[heading, _]| heading.clone()));
        line(&mut text, &mut self.columns.iter().map(|_| "---".to_owned()));
        for row in lines(rows, self.key.as_ref(), self.pivot.as_ref()) {
            line(&mut text, &mut self.columns.iter().map(|[_, template]| fill(template, &row)));
        }
        for row in self.below(ours) {
            let columns = self.ours.iter().flat_map(|ours| &ours.columns);
            line(&mut text, &mut columns.map(|template| fill(template, &row)));
        }
        let made = |rows: &[Kept]| {
            let of = |key: &'static str| all(rows, |kept| kept.text(key));
            format!("{}; {}; {}.", of("commit"), of("machine"), all(rows, |kept| &kept.date))
        };
        let source = all(rows, |kept| kept.text("source"));
        let _ = match (&self.ours, ours) {
            (None, _) => writeln!(text, "\nCommit {}", made(rows)),
            (Some(_), []) => writeln!(text, "\nPublished: {source}."),
            (Some(_), _) => writeln!(text, "\nPublished: {source}. Ours: commit {}", made(ours)),
        };
        text
    }

    /// Which of the rows are older than the tree, and why; empty where none is.
    fn mark(&self, rows: &[Kept], tree: &Tree) -> String {
        let said = |kept: &Kept| {
            let why = kept.older(&self.of, tree)?;
            Some(format!("{} of {} ({why})", kept.text("commit"), kept.date))
        };
        let older: BTreeSet<String> = rows.iter().filter_map(said).collect();
        match older.is_empty() {
            true => String::new(),
            false => {
                let older = older.into_iter().collect::<Vec<_>>().join("; ");
                format!("***Older***: {older}.\n\n")
            }
        }
    }

    /// Lines of our rows in a table of published figures.
    fn below(&self, rows: &[Kept]) -> Vec<Value> {
        let lines = self.ours.as_ref().map(|ours| lines(rows, Some(&ours.key), Some(&ours.pivot)));
        let mut lines = lines.unwrap_or_default();
        lines.retain(|line| line["key"] != "");
        lines
    }
}

/// The rows as lines of a table.
fn lines(rows: &[Kept], key: Option<&String>, pivot: Option<&String>) -> Vec<Value> {
    let rows = rows.iter().map(|kept| &kept.row);
    let (Some(key), Some(pivot)) = (key, pivot) else { return rows.cloned().collect() };
    let mut lines: Vec<(String, Map<String, Value>)> = Vec::new();
    for row in rows {
        let (key, pivot) = (fill(key, row), fill(pivot, row));
        match lines.iter_mut().find(|(of, _)| *of == key) {
            Some((_, line)) => drop(line.insert(pivot, row.clone())),
            None => {
                let line = [(pivot, row.clone()), ("key".to_owned(), key.clone().into())];
                lines.push((key, line.into_iter().collect()));
            }
        }
    }
    lines.into_iter().map(|(_, line)| Value::Object(line)).collect()
}

/// The value at a path: `{2.psnr}` without its braces.
fn at<'a>(row: &'a Value, path: &str) -> Option<&'a Value> {
    path.split('.').try_fold(row, |value, part| match value {
        Value::Array(all) => all.get(part.parse::<usize>().ok()?),
        value => value.get(part),
    })
}

/// The template with its values; empty where one is missing.
fn fill(template: &str, row: &Value) -> String {
    let mut text = String::new();
    let mut rest = template;
    while let Some((before, after)) = rest.split_once('{') {
        let Some((named, after)) = after.split_once('}') else { break };
        let (path, format) = named.split_once(':').unwrap_or((named, ""));
        let Some(value) = at(row, path).and_then(|value| cell(value, format)) else {
            return String::new();
        };
        text.push_str(before);
        text.push_str(&value);
        rest = after;
    }
    text + rest
}

/// A value as its format says: `,` groups digits, `e` one digit and a power of ten, `%` a share,
/// `.N` N digits after the point.
fn cell(value: &Value, format: &str) -> Option<String> {
    if let Some(text) = value.as_str() {
        return Some(text.to_owned());
    }
    if format.is_empty() {
        return (!value.is_null()).then(|| value.to_string());
    }
    let number = value.as_f64()?;
    Some(match format {
        "," => {
            let digits = format!("{number:.0}");
            let group = |(i, c): (usize, char)| {
                let comma = i > 0 && (digits.len() - i).is_multiple_of(3);
                [comma.then_some(','), Some(c)].into_iter().flatten()
            };
            digits.chars().enumerate().flat_map(group).collect()
        }
        "e" => format!("{number:.1e}"),
        "%" => format!("{:.1} %", 100.0 * number),
        digits => format!("{number:.*}", digits.trim_start_matches('.').parse().ok()?),
    })
}
