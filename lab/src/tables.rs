//! `benches/tables.toml`: the tables of `docs/benchmarks.md`, what each depends on, and the
//! commands that measure it.

use std::{collections::BTreeMap, path::Path};

use serde::Deserialize;
use serde_json::Value;

use crate::{
    error::{Error, Result},
    sources::GROUPS,
};

/// Values that a row must have to be taken, by their paths.
pub(crate) type Wanted = BTreeMap<String, Value>;

/// The whole file.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Tables {
    pub(crate) table: Vec<Table>,
    /// Lines of the first table.
    #[serde(default)]
    pub(crate) line: Vec<Line>,
}

/// One table.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Table {
    pub(crate) name: String,
    /// Groups of files that its figures depend on, of [`GROUPS`].
    pub(crate) of: Vec<String>,
    /// What its commands need.
    pub(crate) on: Option<On>,
    /// Longest time of one of its commands, seconds.
    #[serde(default)]
    pub(crate) seconds: u64,
    /// Commands that measure it: `DATA` stands for the shared data, `SEGSPLAT` for the program.
    #[serde(default)]
    pub(crate) runs: Vec<String>,
    /// Table that the rows belong to, where it is another.
    pub(crate) rows: Option<String>,
    /// Rows that it takes.
    #[serde(default)]
    pub(crate) only: Wanted,
    /// Heading and template of each column.
    pub(crate) columns: Vec<[String; 2]>,
    /// Template of what the rows of one line share.
    pub(crate) key: Option<String>,
    /// Template of what tells the rows of one line apart.
    pub(crate) pivot: Option<String>,
    /// The table is of published figures; how lines of ours come below them.
    pub(crate) ours: Option<Ours>,
}

/// What the commands of a table need.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub(crate) enum On {
    /// Processor cores alone
    Cpu,
    /// A GPU
    Gpu,
}

/// Lines of our rows in a table of published figures.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Ours {
    /// Table of our rows; none on the page without it.
    pub(crate) rows: Option<String>,
    /// As [`Table::key`] and [`Table::pivot`]; a row without one of the key's values is no line.
    pub(crate) key: String,
    pub(crate) pivot: String,
    /// Template of each column of the table.
    pub(crate) columns: Vec<String>,
}

/// A line of the first table: a task, and the rows of other tables that have its figures.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Line {
    pub(crate) task: String,
    pub(crate) time: Pick,
    pub(crate) error: Pick,
}

/// A figure: the last row of a table that has these values, and a template of it.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Pick {
    pub(crate) table: String,
    #[serde(default)]
    pub(crate) is: Wanted,
    pub(crate) show: String,
}

impl Tables {
    /// Reads the file of the repository `root`.
    ///
    /// # Errors
    /// `invalid_request` where it cannot be read, or names a group or a table that is not there.
    pub(crate) fn read(root: &Path) -> Result<Self> {
        let path = root.join("benches/tables.toml");
        let fault = |e| Error::invalid(format!("{}: cannot be read", path.display())).caused_by(e);
        let text = fs_err::read_to_string(&path).map_err(fault)?;
        let tables: Self = toml::from_str(&text)
            .map_err(|e| Error::invalid("benches/tables.toml").caused_by(e))?;
        for table in &tables.table {
            let known = |group: &&String| GROUPS.iter().any(|(name, _)| name == *group);
            if let Some(group) = table.of.iter().find(|group| !known(group)) {
                let name = &table.name;
                return Err(Error::invalid(format!("table {name}: there is no group {group:?}")));
            }
        }
        for pick in tables.line.iter().flat_map(|line| [&line.time, &line.error]) {
            tables.named(&pick.table)?;
        }
        Ok(tables)
    }

    /// The table of this name.
    ///
    /// # Errors
    /// `invalid_request` where there is none.
    pub(crate) fn named(&self, name: &str) -> Result<&Table> {
        let found = self.table.iter().find(|table| table.name == name);
        found.ok_or_else(|| Error::invalid(format!("there is no table {name:?}")))
    }
}

impl Table {
    /// Name of the table that its rows belong to.
    pub(crate) fn rows_of(&self) -> &str {
        self.rows.as_ref().unwrap_or(&self.name)
    }
}
