//! Rows that are kept, in `benches/runs/*.jsonl`, and which of them are of this tree.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
};

use serde_json::Value;

use crate::{
    error::{Error, Result},
    rows::day,
    sources::hashes,
};

/// The hash of each group of files of a tree.
#[derive(Clone, Debug)]
pub(crate) struct Tree(BTreeMap<String, String>);

impl Tree {
    /// The tree at `root`, as it is now.
    ///
    /// # Errors
    /// `invalid_request` where a file cannot be read.
    pub(crate) fn read(root: &Path) -> Result<Self> {
        let fault = |e| Error::invalid("the files that rows depend on").caused_by(e);
        let hashes = hashes(root).map_err(fault)?;
        Ok(Self(hashes.into_iter().map(|(name, hash)| (name.to_owned(), hash)).collect()))
    }

    /// As rows of this tree have them.
    pub(crate) fn hashes(&self) -> Value {
        self.0.iter().map(|(group, hash)| (group.clone(), Value::from(hash.as_str()))).collect()
    }

    /// Those of `groups` of which a row with these hashes, or none, has another than this tree.
    pub(crate) fn changed(&self, hashes: &Value, groups: &[String]) -> Vec<String> {
        let same = |group: &&String| {
            self.0.get(*group).is_some_and(|hash| hashes[*group].as_str() == Some(hash))
        };
        groups.iter().filter(|group| !same(group)).cloned().collect()
    }
}

/// A row, and where it is kept.
#[derive(Clone, Debug)]
pub(crate) struct Kept {
    /// File and number of the line.
    pub(crate) place: String,
    /// Day of the measurement.
    pub(crate) date: String,
    pub(crate) row: Value,
}

impl Kept {
    /// A text of the row.
    pub(crate) fn text(&self, key: &str) -> &str {
        self.row[key].as_str().unwrap_or_default()
    }

    /// Why it is older than the tree: which groups of `of` have changed since it was measured, or
    /// that it has no hashes. `None` where it is of this tree.
    pub(crate) fn older(&self, of: &[String], tree: &Tree) -> Option<String> {
        let changed = tree.changed(&self.row["hashes"], of);
        match (changed.is_empty(), self.row["hashes"].is_object()) {
            (true, _) => None,
            (false, true) => Some(format!("{} changed", changed.join(", "))),
            (false, false) => Some("it has no hashes".to_owned()),
        }
    }
}

/// Rows by table, in the order of the files' names and lines.
pub(crate) type Grouped = BTreeMap<String, Vec<Kept>>;

/// All rows of a folder of runs.
///
/// # Errors
/// `invalid_request` where a row has no table, command, commit, machine or error.
pub(crate) fn runs(folder: &Path) -> Result<Grouped> {
    let fault = |e: std::io::Error| Error::invalid("benches/runs: no folder").caused_by(e);
    let listed = fs_err::read_dir(folder).map_err(fault)?;
    let mut paths: Vec<PathBuf> = listed.flatten().map(|entry| entry.path()).collect();
    paths.retain(|path| path.extension().is_some_and(|end| end == "jsonl"));
    paths.sort();
    let mut rows = Grouped::new();
    for path in paths {
        file(&path, &mut rows)?;
    }
    Ok(rows)
}

/// Adds the rows of a file.
///
/// # Errors
/// As [`runs`].
pub(crate) fn file(path: &Path, rows: &mut Grouped) -> Result<()> {
    each(path, &["table", "command", "commit", "machine"], |kept, wrong| {
        if kept.row["error"].is_null() {
            return Err(wrong("no error"));
        }
        group(rows, kept);
        Ok(())
    })
}

/// What others published: rows of tables, each with its source; none where there is no file.
///
/// # Errors
/// `invalid_request` where a row has no table, source or method.
pub(crate) fn published(root: &Path) -> Result<Grouped> {
    let path = root.join("benches/published/paper.jsonl");
    let mut rows = Grouped::new();
    if path.is_file() {
        each(&path, &["table", "source", "method"], |kept, _| {
            group(&mut rows, kept);
            Ok(())
        })?;
    }
    Ok(rows)
}

/// All rows of a file, of whatever kind.
///
/// # Errors
/// `invalid_request` where a line is no JSON.
pub(crate) fn any(path: &Path) -> Result<Vec<Kept>> {
    let mut rows = Vec::new();
    each(path, &[], |kept, _| {
        rows.push(kept);
        Ok(())
    })?;
    Ok(rows)
}

fn group(rows: &mut Grouped, kept: Kept) {
    rows.entry(kept.text("table").to_owned()).or_default().push(kept);
}

/// Gives `take` each row of a file with these texts, and what makes an error of that row.
fn each(
    path: &Path,
    named: &[&str],
    mut take: impl FnMut(Kept, &dyn Fn(&str) -> Error) -> Result<()>,
) -> Result<()> {
    let fault = |e| Error::invalid(format!("{}: cannot be read", path.display())).caused_by(e);
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    for (i, line) in fs_err::read_to_string(path).map_err(fault)?.lines().enumerate() {
        let place = format!("{name}, row {}", i + 1);
        let wrong = |what: &str| Error::invalid(format!("{place}: {what}"));
        let row: Value = serde_json::from_str(line).map_err(|_e| wrong("no JSON"))?;
        if let Some(key) = named.iter().find(|key| row[**key].as_str().is_none_or(str::is_empty)) {
            return Err(wrong(&format!("no {key}")));
        }
        // Files are named by the day.
        let of_file = || name.chars().take(10).collect();
        let date = row["unix_s"].as_u64().map_or_else(of_file, day);
        take(Kept { place: place.clone(), date, row }, &wrong)?;
    }
    Ok(())
}

/// The different texts of all rows, in order.
pub(crate) fn all<'a>(rows: &'a [Kept], text: impl Fn(&'a Kept) -> &'a str) -> String {
    let texts: BTreeSet<&str> = rows.iter().map(text).filter(|text| !text.is_empty()).collect();
    texts.into_iter().collect::<Vec<_>>().join(", ")
}
