//! The table of formats is what the docs, the proto and the Python client have. `doors_agree.rs`
//! has the other doors.

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

/// A paragraph whose lines have at most 100 columns, each after the first behind `indent`.
fn paragraph(start: &str, text: &str, indent: &str) -> String {
    let (mut lines, mut line) = (String::new(), start.to_owned());
    for word in text.split_whitespace() {
        if line.len() + 1 + word.len() > 100 {
            writeln!(lines, "{line}").unwrap();
            line = indent.to_owned();
        }
        let gap = if line.ends_with(' ') { "" } else { " " };
        write!(line, "{gap}{word}").unwrap();
    }
    lines + &line + "\n"
}

/// Writes a file where docs are updated; whether it has this text.
fn kept(path: &str, text: &str) {
    let path = root().join(path);
    if std::env::var_os("UPDATE_DOCS").is_some() {
        fs::write(&path, text).unwrap();
    }
    let written = fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(written, text, "{} differs: UPDATE_DOCS=1 writes it", path.display());
}

#[test]
fn the_proto_has_the_table() {
    let path = "proto/segsplat/v1/scene.proto";
    let proto = fs::read_to_string(root().join(path)).unwrap();
    let (before, rest) = proto.split_once("enum ExportFormat {\n").expect("the enum");
    let (_, after) = rest.split_once("}\n").expect("its end");
    let mut formats: Vec<ExportFormat> = ExportFormat::all().collect();
    formats.sort_by_key(|format| *format as i32);
    let mut text = "  // As EXPORT_FORMAT_PLY.\n  EXPORT_FORMAT_UNSPECIFIED = 0;\n".to_owned();
    for format in formats {
        text += &paragraph("  //", format.help, "  // ");
        let name = format.name.to_ascii_uppercase();
        writeln!(text, "  EXPORT_FORMAT_{name} = {};", format as i32).unwrap();
    }
    kept(path, &format!("{before}enum ExportFormat {{\n{text}}}\n{after}"));
}

/// The module of the Python client.
fn python() -> String {
    let mut text = String::from(
        "\"\"\"Formats of exports, from the server's table: `UPDATE_DOCS=1 cargo test --test it \
         formats` writes\nit.\n\n",
    );
    for format in ExportFormat::all() {
        text += &paragraph(&format!("{format}:"), format.help, "    ");
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
    kept("clients/python/src/segsplat/formats.py", &python());
}
