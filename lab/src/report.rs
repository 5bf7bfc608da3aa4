//! Writes the tables of `docs/benchmarks.md` from the rows of `benches/runs/*.jsonl`.
//!
//! `benches/tables.toml` describes each table: the columns, each a heading and a template such as
//! `{gaussians:,}` or `{device.total_ms:.3} ms`. A table takes the rows whose `table` is its name,
//! in the order of the files. With `key` and `pivot`, rows of one key become one line, and a
//! template names the row by the value of its pivot: `{2.psnr:.2}`. The page has a table between
//! `<!-- table: NAME -->` and `<!-- end -->`.
//!
//! A table with `ours` is of what others published: its rows are those of
//! `benches/published/paper.jsonl`, each with its source, and ours come below them. With `--beside`
//! these tables are printed with rows of a run that is not on the page.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::Write as _,
    path::{Path, PathBuf},
};

use serde::Deserialize;
use serde_json::{Map, Value};

use crate::error::{Error, Result};

/// What to write.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// The repository's folder
    #[arg(long, default_value = ".")]
    root: PathBuf,
    /// Write nothing; fail where the page differs from the rows
    #[arg(long)]
    check: bool,
    /// Write nothing; print this table of published figures with the rows of a file below them
    #[arg(long, value_name = "TABLE=FILE")]
    beside: Vec<String>,
}

/// All tables of the page.
#[derive(Debug, Deserialize)]
struct Tables {
    table: Vec<Table>,
}

/// One table.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Table {
    name: String,
    /// Table that the rows belong to, where it is another.
    rows: Option<String>,
    /// Heading and template of each column.
    columns: Vec<[String; 2]>,
    /// Template of what the rows of one line share.
    key: Option<String>,
    /// Template of what tells the rows of one line apart.
    pivot: Option<String>,
    /// The table is of published figures; how lines of ours come below them.
    ours: Option<Ours>,
}

/// Lines of our rows in a table of published figures.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Ours {
    /// Table of our rows; none on the page without it.
    rows: Option<String>,
    /// As [`Table::key`] and [`Table::pivot`]; a row without one of the key's values is no line.
    key: String,
    pivot: String,
    /// Template of each column of the table.
    columns: Vec<String>,
}

/// Writes the page, or checks it.
///
/// # Errors
/// `invalid_request` where a file cannot be read, where a row has no command, commit, machine or
/// error, and with `check` where the page differs.
pub(crate) fn run(args: &Args) -> Result<()> {
    if !args.beside.is_empty() {
        return args.beside.iter().try_for_each(|asked| {
            print(&beside(&args.root, asked)?);
            Ok(())
        });
    }
    let path = args.root.join("docs/benchmarks.md");
    let old = read(&path)?;
    let new = page(&args.root, &old)?;
    if args.check && new != old {
        return Err(Error::invalid("docs/benchmarks.md differs from benches/runs: make report"));
    }
    if new == old {
        return Ok(());
    }
    fs_err::write(&path, new).map_err(|e| Error::invalid("the page: no write").caused_by(e))
}

#[expect(clippy::print_stdout, reason = "the table is the answer of the program")]
fn print(table: &str) {
    println!("{table}");
}

fn read(path: &Path) -> Result<String> {
    let fault = |e| Error::invalid(format!("{}: cannot be read", path.display())).caused_by(e);
    fs_err::read_to_string(path).map_err(fault)
}

fn tables(root: &Path) -> Result<Vec<Table>> {
    let tables: Tables = toml::from_str(&read(&root.join("benches/tables.toml"))?)
        .map_err(|e| Error::invalid("benches/tables.toml").caused_by(e))?;
    Ok(tables.table)
}

/// The page with its tables made anew from the files under `root`.
///
/// # Errors
/// As `run`.
pub fn page(root: &Path, old: &str) -> Result<String> {
    let tables = tables(root)?;
    let rows = rows(&root.join("benches/runs"))?;
    let published = published(root)?;
    let mut page = old.to_owned();
    for table in &tables {
        let begin = format!("<!-- table: {} -->\n", table.name);
        let of = |rows: &Grouped, name: &String| rows.get(name).cloned().unwrap_or_default();
        let (of_table, ours) = match &table.ours {
            None => (of(&rows, table.rows.as_ref().unwrap_or(&table.name)), Vec::new()),
            Some(ours) => {
                let below = ours.rows.as_ref().map(|name| of(&rows, name));
                (of(&published, &table.name), below.unwrap_or_default())
            }
        };
        let place = page
            .split_once(&begin)
            .and_then(|(before, rest)| Some((before, rest.split_once("<!-- end -->")?.1)));
        let Some((before, after)) = place else {
            return Err(Error::invalid(format!("the page has no table {}", table.name)));
        };
        if of_table.is_empty() {
            return Err(Error::invalid(format!("there are no rows of table {}", table.name)));
        }
        let text = table.write(&of_table, &ours);
        page = format!("{before}{begin}{text}<!-- end -->{after}");
    }
    let placed = page.matches("<!-- table: ").count();
    if placed != tables.len() {
        return Err(Error::invalid(format!("{placed} tables on the page")));
    }
    Ok(page)
}

/// The table of published figures that `TABLE=FILE` names, with the file's rows below them.
///
/// # Errors
/// `invalid_request` where there is no such table or file, or no row of the file fits.
pub fn beside(root: &Path, asked: &str) -> Result<String> {
    let tables = tables(root)?;
    let known: Vec<&str> =
        tables.iter().filter(|t| t.ours.is_some()).map(|t| t.name.as_str()).collect();
    let wrong = || format!("--beside {asked:?} must be TABLE=FILE; tables: {}", known.join(", "));
    let named = asked.split_once('=').filter(|(name, _)| known.contains(name));
    let (name, file) = named.ok_or_else(|| Error::invalid(wrong()))?;
    let mut rows = Vec::new();
    each_row(Path::new(file), |row, _| {
        rows.push(row);
        Ok(())
    })?;
    let published = published(root)?.remove(name).unwrap_or_default();
    let table = tables.iter().find(|table| table.name == name);
    match table.filter(|table| !table.below(&rows).is_empty()) {
        Some(table) => Ok(table.write(&published, &rows)),
        None => Err(Error::invalid(format!("{file}: no row fits the table {name}"))),
    }
}

/// Rows by table.
type Grouped = BTreeMap<String, Vec<Value>>;

/// What others published, each row with its source.
fn published(root: &Path) -> Result<Grouped> {
    let path = root.join("benches/published/paper.jsonl");
    let mut rows = Grouped::new();
    if path.is_file() {
        each_row(&path, |row, wrong| {
            named(&row, &["table", "source", "method"], wrong)?;
            group(&mut rows, row);
            Ok(())
        })?;
    }
    Ok(rows)
}

fn group(rows: &mut Grouped, row: Value) {
    let table = row["table"].as_str().unwrap_or_default().to_owned();
    rows.entry(table).or_default().push(row);
}

/// Refuses a row where one of the texts is missing or empty.
fn named(row: &Value, keys: &[&str], wrong: &dyn Fn(&str) -> Error) -> Result<()> {
    match keys.iter().find(|key| row[**key].as_str().is_none_or(str::is_empty)) {
        Some(key) => Err(wrong(&format!("no {key}"))),
        None => Ok(()),
    }
}

/// Gives `take` each row of a file, and what makes an error of that row.
fn each_row(
    path: &Path,
    mut take: impl FnMut(Value, &dyn Fn(&str) -> Error) -> Result<()>,
) -> Result<()> {
    for (i, line) in read(path)?.lines().enumerate() {
        let wrong = |what: &str| {
            let name = path.file_name().unwrap_or_default().display();
            Error::invalid(format!("{name}, row {}: {what}", i + 1))
        };
        take(serde_json::from_str(line).map_err(|_e| wrong("no JSON"))?, &wrong)?;
    }
    Ok(())
}

/// All rows by table, in the order of the files' names and lines.
fn rows(folder: &Path) -> Result<Grouped> {
    let fault = |e: std::io::Error| Error::invalid("benches/runs: no folder").caused_by(e);
    let listed = fs_err::read_dir(folder).map_err(fault)?;
    let mut paths: Vec<PathBuf> = listed.flatten().map(|entry| entry.path()).collect();
    paths.retain(|path| path.extension().is_some_and(|end| end == "jsonl"));
    paths.sort();
    let mut rows = Grouped::new();
    for path in paths {
        each_row(&path, |row, wrong| {
            named(&row, &["table", "command", "commit", "machine"], wrong)?;
            if row["error"].is_null() {
                return Err(wrong("no error"));
            }
            group(&mut rows, row);
            Ok(())
        })?;
    }
    Ok(rows)
}

impl Table {
    fn write(&self, rows: &[Value], ours: &[Value]) -> String {
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
        let all = |rows: &[Value], key: &str| -> String {
            let values: BTreeSet<&str> = rows.iter().filter_map(|row| row[key].as_str()).collect();
            values.into_iter().collect::<Vec<_>>().join(", ")
        };
        let made = |rows: &[Value]| format!("{}; {}.", all(rows, "commit"), all(rows, "machine"));
        let source = all(rows, "source");
        let _ = match (&self.ours, ours) {
            (None, _) => writeln!(text, "\nCommit {}", made(rows)),
            (Some(_), []) => writeln!(text, "\nPublished: {source}."),
            (Some(_), _) => writeln!(text, "\nPublished: {source}. Ours: commit {}", made(ours)),
        };
        text
    }

    /// Lines of our rows in a table of published figures.
    fn below(&self, rows: &[Value]) -> Vec<Value> {
        let lines = self.ours.as_ref().map(|ours| lines(rows, Some(&ours.key), Some(&ours.pivot)));
        let mut lines = lines.unwrap_or_default();
        lines.retain(|line| line["key"] != "");
        lines
    }
}

/// The rows as lines of a table.
fn lines(rows: &[Value], key: Option<&String>, pivot: Option<&String>) -> Vec<Value> {
    let (Some(key), Some(pivot)) = (key, pivot) else { return rows.to_vec() };
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

/// The template with its values; empty where one is missing.
fn fill(template: &str, row: &Value) -> String {
    let mut text = String::new();
    let mut rest = template;
    while let Some((before, after)) = rest.split_once('{') {
        let Some((named, after)) = after.split_once('}') else { break };
        let (path, format) = named.split_once(':').unwrap_or((named, ""));
        let value = path.split('.').try_fold(row, |value, part| match value {
            Value::Array(all) => all.get(part.parse::<usize>().ok()?),
            value => value.get(part),
        });
        let Some(value) = value.and_then(|value| cell(value, format)) else {
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
