//! The table of formats is what the docs and the Python client have. `doors_agree.rs` has the
//! other doors.

use std::{fmt::Write as _, fs};

use segsplat::formats::table::{ExportFormat, splat_formats};

use crate::common::root;

#[test]
fn the_docs_have_every_format_for_other_programs() {
    let docs = fs::read_to_string(root().join("docs/formats.md")).unwrap();
    for format in ExportFormat::all() {
        let for_others = format.is_splats() || format.ending.ends_with(".zip");
        let row = format!("| `{format}` |");
        assert!(!for_others || docs.contains(&row), "docs/formats.md has no row {row}");
    }
}

/// The module of the Python client.
fn python() -> String {
    let mut text = String::from(
        "\"\"\"Formats of exports, from the server's table: `UPDATE_DOCS=1 cargo test --test it \
         formats` writes\nit.\n\n",
    );
    for format in ExportFormat::all() {
        let words = format.help.trim().split(' ');
        let (mut line, mut width) = (format!("{}:", format.name), format.name.len() + 1);
        for word in words {
            let fits = width + 1 + word.len() <= 100;
            let (gap, start) = if fits { (" ", width + 1) } else { ("\n    ", 4) };
            write!(line, "{gap}{word}").unwrap();
            width = start + word.len();
        }
        writeln!(text, "{line}").unwrap();
    }
    text += "\"\"\"\n\nfrom typing import Literal, TypeAlias\n\n";
    text += "#: Formats of `export`.\nExportFormat: TypeAlias = Literal[\n";
    ExportFormat::all().for_each(|format| writeln!(text, "    \"{format}\",").unwrap());
    text += "]\n#: Their endings, without the first dot.\nENDINGS: dict[ExportFormat, str] = {\n";
    for format in ExportFormat::all() {
        writeln!(text, "    \"{format}\": \"{}\",", format.ending).unwrap();
    }
    text += "}\n#: Last parts of the names of files of Gaussians.\nSPLATS = (\n";
    let mut ends: Vec<&str> =
        splat_formats().map(|format| format.ending.rsplit('.').next().unwrap()).collect();
    ends.sort_unstable();
    ends.dedup();
    ends.iter().for_each(|end| writeln!(text, "    \".{end}\",").unwrap());
    text + ")\n"
}

#[test]
fn the_python_client_has_the_table() {
    let path = root().join("clients/python/src/segsplat/formats.py");
    let text = python();
    if std::env::var_os("UPDATE_DOCS").is_some() {
        fs::write(&path, &text).unwrap();
    }
    let written = fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(written, text, "{} differs: UPDATE_DOCS=1 writes it", path.display());
}
