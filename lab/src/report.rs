//! Writes the tables of `docs/benchmarks.md` from the rows of `benches/runs/*.jsonl`.
//!
//! `benches/tables.toml` describes each table: the columns, each a heading and a template such as
//! `{gaussians:,}` or `{device.total_ms:.3} ms`. A table takes the rows whose `table` is its name,
//! in the order of the files. With `key` and `pivot`, rows of one key become one line, and a
//! template names the row by the value of its pivot: `{2.psnr:.2}`. The page has a table between
//! `<!-- table: NAME -->` and `<!-- end -->`.

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
}

/// Writes the page, or checks it.
///
/// # Errors
/// `invalid_request` where a file cannot be read, where a row has no command, commit, machine or
/// error, and with `check` where the page differs.
pub(crate) fn run(args: &Args) -> Result<()> {
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

fn read(path: &Path) -> Result<String> {
    let fault = |e| Error::invalid(format!("{}: cannot be read", path.display())).caused_by(e);
    fs_err::read_to_string(path).map_err(fault)
}

/// The page with its tables made anew from the files under `root`.
///
/// # Errors
/// As `run`.
pub fn page(root: &Path, old: &str) -> Result<String> {
    let tables: Tables = toml::from_str(&read(&root.join("benches/tables.toml"))?)
        .map_err(|e| Error::invalid("benches/tables.toml").caused_by(e))?;
    let rows = rows(&root.join("benches/runs"))?;
    let mut page = old.to_owned();
    for table in &tables.table {
        let begin = format!("<!-- table: {} -->\n", table.name);
        let of_table = rows
            .get(table.rows.as_ref().unwrap_or(&table.name))
            .map(Vec::as_slice)
            .unwrap_or_default();
        let place = page
            .split_once(&begin)
            .and_then(|(before, rest)| Some((before, rest.split_once("<!-- end -->")?.1)));
        let Some((before, after)) = place else {
            return Err(Error::invalid(format!("the page has no table {}", table.name)));
        };
        if of_table.is_empty() {
            return Err(Error::invalid(format!("there are no rows of table {}", table.name)));
        }
        page = format!("{before}{begin}{}<!-- end -->{after}", table.write(of_table));
    }
    let placed = page.matches("<!-- table: ").count();
    if placed != tables.table.len() {
        return Err(Error::invalid(format!("{placed} tables on the page")));
    }
    Ok(page)
}

/// All rows by table, in the order of the files' names and lines.
fn rows(folder: &Path) -> Result<BTreeMap<String, Vec<Value>>> {
    let fault = |e: std::io::Error| Error::invalid("benches/runs: no folder").caused_by(e);
    let listed = fs_err::read_dir(folder).map_err(fault)?;
    let mut paths: Vec<PathBuf> = listed.flatten().map(|entry| entry.path()).collect();
    paths.retain(|path| path.extension().is_some_and(|end| end == "jsonl"));
    paths.sort();
    let mut rows: BTreeMap<String, Vec<Value>> = BTreeMap::new();
    for path in paths {
        for (i, line) in read(&path)?.lines().enumerate() {
            let wrong = |what: &str| {
                let name = path.file_name().unwrap_or_default().display();
                Error::invalid(format!("{name}, row {}: {what}", i + 1))
            };
            let row: Value = serde_json::from_str(line).map_err(|_e| wrong("no JSON"))?;
            for key in ["table", "command", "commit", "machine"] {
                if row[key].as_str().is_none_or(str::is_empty) {
                    return Err(wrong(&format!("no {key}")));
                }
            }
            if row["error"].is_null() {
                return Err(wrong("no error"));
            }
            let table = row["table"].as_str().unwrap_or_default().to_owned();
            rows.entry(table).or_default().push(row);
        }
    }
    Ok(rows)
}

impl Table {
    fn write(&self, rows: &[Value]) -> String {
        let mut text = String::new();
        let line = |text: &mut String, cells: &mut dyn Iterator<Item = String>| {
            let cells: Vec<String> = cells.collect();
            let _ = writeln!(text, "| {} |", cells.join(" | "));
        };
        line(&mut text, &mut self.columns.iter().map(|[heading, _]| heading.clone()));
        line(&mut text, &mut self.columns.iter().map(|_| "---".to_owned()));
        for row in self.lines(rows) {
            line(&mut text, &mut self.columns.iter().map(|[_, template]| fill(template, &row)));
        }
        let all = |key: &str| -> String {
            let values: BTreeSet<&str> = rows.iter().filter_map(|row| row[key].as_str()).collect();
            values.into_iter().collect::<Vec<_>>().join(", ")
        };
        let _ = writeln!(text, "\nCommit {}; {}.", all("commit"), all("machine"));
        text
    }

    /// The rows as lines of the table.
    fn lines(&self, rows: &[Value]) -> Vec<Value> {
        let (Some(key), Some(pivot)) = (&self.key, &self.pivot) else { return rows.to_vec() };
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
