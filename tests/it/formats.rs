//! The table of formats is what each door has: gRPC, the page, the Python client, the docs.

use std::{fmt::Write as _, fs};

use segsplat::{
    api::grpc::pb,
    formats::table::{ExportFormat, splat_formats},
    service::VIEWER,
};

use crate::common::root;

#[test]
fn grpc_the_page_and_the_docs_have_every_format() {
    let docs = fs::read_to_string(root().join("docs/formats.md")).unwrap();
    for format in ExportFormat::all() {
        let name = format!("EXPORT_FORMAT_{}", format.name.to_ascii_uppercase());
        assert!(pb::ExportFormat::from_str_name(&name).is_some(), "the proto has no {name}");
        let option = format!("<option value=\"{}\"", format.name);
        assert!(VIEWER.html.contains(&option), "the page has no {}", format.name);
        let for_others = format.is_splats() || format.ending.ends_with(".zip");
        let row = format!("| `{}` |", format.name);
        assert!(!for_others || docs.contains(&row), "docs/formats.md has no row {row}");
    }
    let theirs = (1..).map_while(|number| pb::ExportFormat::try_from(number).ok());
    assert_eq!(theirs.count(), ExportFormat::all().count(), "the proto has others");
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
