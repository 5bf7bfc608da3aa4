//! The rules of the repository as tests: layers, circles of files, confined crates, links, paths,
//! generated pages.
//!
//! The tables of layers are read from the first pages of `src/lib.rs` and
//! `crates/vision/src/lib.rs`, so that page and code cannot differ.

mod circles;

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt::Write as _,
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use segsplat::error::TABLE;

use crate::common::root;

/// Folders and files that this crate's authors write by hand, with limits on length.
const OURS: [&str; 11] = [
    "src/",
    "crates/",
    "lab/",
    "tests/",
    "benches/",
    "shaders/",
    "proto/segsplat/",
    "scripts/",
    "clients/",
    "packaging/",
    "web/",
];
/// Folders at the top of the repository, which a path in backticks can name.
const TOPS: [&str; 15] = [
    "src/",
    "crates/",
    "lab/",
    "tests/",
    "benches/",
    "shaders/",
    "proto/",
    "scripts/",
    "docs/",
    "docker/",
    "models/",
    "web/",
    "clients/",
    "packaging/",
    "third_party/",
];
const LINE_CHARS_MAX: usize = 100;
const GOLDEN_BYTES_MAX: u64 = 64 << 10;
const TREE_BYTES_MAX: u64 = 52 << 20;

/// A crate's name and where it may be named.
const CONFINED: [(&str, &[&str]); 16] = [
    ("axum", &["src/api/http"]),
    ("tower_http", &["src/api/http"]),
    (
        "utoipa",
        &[
            "src/api/http",
            "src/service",
            "crates/core/src/scene",
            "crates/formats/src/rle.rs",
            "crates/formats/src/table.rs",
            "crates/render/src/lib.rs",
        ],
    ),
    ("tonic", &["src/api/grpc", "lab/src/load"]),
    ("tonic_health", &["src/api/grpc"]),
    ("tonic_reflection", &["src/api/grpc"]),
    ("prost", &["src/api/grpc"]),
    ("ort", &["crates/vision/src/models"]),
    ("wgpu", &["crates/render/src/gpu"]),
    ("object_store", &["src/store"]),
    ("safetensors", &["crates/formats/src/container", "lab/src/frames"]),
    ("flate2", &["crates/formats/src", "src/api/http/gzip.rs"]),
    ("ruzstd", &["crates/formats/src"]),
    ("tar", &["crates/formats/src/captures", "lab/src/words"]),
    ("opentelemetry", &["src/telemetry"]),
    ("clap", &["src/cli", "src/config.rs", "src/main.rs", "src/service/request.rs", "lab/src"]),
];

/// Tracked files (new ones too), relative to the root; all files where there is no git.
fn files() -> Vec<String> {
    let listed = Command::new("git")
        .args(["ls-files", "-z", "--cached", "--others", "--exclude-standard"])
        .current_dir(root())
        .output();
    if let Ok(output) = listed
        && output.status.success()
    {
        let names = String::from_utf8(output.stdout).expect("file names are UTF-8");
        let names = names.split('\0').filter(|name| !name.is_empty()).map(str::to_owned);
        return names.filter(|name| root().join(name).is_file()).collect();
    }
    let mut found = Vec::new();
    walk(root(), &mut found);
    found
}

fn walk(folder: &Path, found: &mut Vec<String>) {
    for entry in fs::read_dir(folder).expect("a readable folder") {
        let path = entry.expect("a readable entry").path();
        let name =
            path.strip_prefix(root()).expect("below the root").to_string_lossy().into_owned();
        if path.is_dir() {
            if !["target", "data", ".git", ".venv"].contains(&name.as_str()) {
                walk(&path, found);
            }
        } else {
            found.push(name);
        }
    }
}

fn read(name: &str) -> String {
    fs::read_to_string(root().join(name)).unwrap_or_else(|e| panic!("{name}: {e}"))
}

/// Files of ours with this ending, and their text.
fn ours(ending: &str) -> Vec<(String, String)> {
    let own = |name: &String| OURS.iter().any(|top| name.starts_with(top));
    let named = files().into_iter().filter(own).filter(|name| name.ends_with(ending));
    named.map(|name| (name.clone(), read(&name))).collect()
}

/// Rust text without comments and without the unit tests at its end.
fn code_of(text: &str) -> String {
    let code = text.split("#[cfg(test)]\nmod tests").next().unwrap_or_default();
    let lines = code.lines().filter(|line| !line.trim_start().starts_with("//"));
    lines.collect::<Vec<_>>().join("\n")
}

fn fail_with(faults: &[String], rule: &str) {
    assert!(faults.is_empty(), "{rule}:\n  {}", faults.join("\n  "));
}

/// The names after each `word::` in `code`, the first of each path in `{…}` too.
fn paths_from(code: &str, word: &str) -> BTreeSet<String> {
    let start = format!("{word}::");
    let mut names = BTreeSet::new();
    for (at, _) in code.match_indices(&start) {
        let before = code[..at].chars().next_back().unwrap_or(' ');
        if before.is_alphanumeric() || before == '_' || before == ':' || before == '$' {
            continue;
        }
        let rest = &code[at + start.len()..];
        let ident = |s: &str| -> String {
            s.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect()
        };
        let Some(list) = rest.strip_prefix('{') else {
            names.insert(ident(rest));
            continue;
        };
        let (mut depth, mut item) = (0, String::new());
        for c in list.chars() {
            match c {
                '{' => depth += 1,
                '}' if depth == 0 => break,
                '}' => depth -= 1,
                ',' if depth == 0 => drop(names.insert(ident(std::mem::take(&mut item).trim()))),
                _ if depth == 0 => item.push(c),
                _ => {}
            }
        }
        names.insert(ident(item.trim()));
    }
    names.remove("");
    names
}

/// For each module the modules that it may use, from the table on a crate's first page.
fn layers(page: &str) -> BTreeMap<String, BTreeSet<String>> {
    let quoted = |cell: &str| -> BTreeSet<String> {
        cell.split('`').skip(1).step_by(2).map(str::to_owned).collect()
    };
    let mut rows = Vec::new();
    for line in page.lines().filter(|line| line.starts_with("//! | L")) {
        let cells: Vec<&str> = line.split('|').map(str::trim).collect();
        let level = cells[1].split(' ').next().expect("a level").to_owned();
        rows.push((level, quoted(cells[2]), cells[3].to_owned()));
    }
    assert!(rows.len() >= 2, "the table of layers is gone");
    let of_level = |level: &str| -> BTreeSet<String> {
        rows.iter().filter(|row| row.0 == level).flat_map(|row| row.1.clone()).collect()
    };
    let everything: BTreeSet<String> = rows.iter().flat_map(|row| row.1.clone()).collect();
    let mut allowed = BTreeMap::new();
    for (level, modules, may) in &rows {
        for module in modules {
            let mut uses = of_level("L0");
            if may.contains("everything") {
                uses = everything.clone();
            } else if level != "L0" {
                uses.extend(quoted(may));
                (0..7).map(|i| format!("L{i}")).filter(|l| may.contains(l)).for_each(|l| {
                    uses.extend(of_level(&l));
                });
            }
            uses.insert(module.clone());
            allowed.insert(module.clone(), uses);
        }
    }
    allowed
}

#[test]
fn modules_use_only_the_layers_below() {
    let mut faults = Vec::new();
    for folder in ["src/", "crates/vision/src/"] {
        let page = read(&format!("{folder}lib.rs"));
        let layers = layers(&page);
        for (name, text) in ours(".rs").iter().filter(|(name, _)| name.starts_with(folder)) {
            let parts: Vec<&str> =
                name[folder.len()..].trim_end_matches(".rs").split('/').collect();
            let module = parts[0];
            if module == "lib" || parts.last() == Some(&"tests") {
                continue;
            }
            let code = code_of(text);
            let Some(allowed) = layers.get(module) else {
                faults.push(format!("{name}: module {module} has no row in {folder}lib.rs"));
                continue;
            };
            let mut used = paths_from(&code, "crate");
            if module == "main" {
                used = paths_from(&code, "segsplat");
            } else if parts.len() == 1 || parts[1..] == ["mod"] {
                let all: BTreeSet<&String> = layers.keys().collect();
                used.extend(paths_from(&code, "super").into_iter().filter(|n| all.contains(n)));
            }
            for other in used.iter().filter(|other| layers.contains_key(*other)) {
                if !allowed.contains(other) {
                    faults.push(format!("{name}: {module} uses {other}, which is not below it"));
                }
            }
        }
        for line in page.lines() {
            if let Some(module) = line.strip_prefix("pub mod ").and_then(|l| l.strip_suffix(';'))
                && !layers.contains_key(module)
            {
                faults.push(format!("{folder}lib.rs: module {module} has no row in the table"));
            }
        }
    }
    fail_with(&faults, "layers (the tables of src/lib.rs and crates/vision/src/lib.rs)");
}

#[test]
fn no_files_take_from_each_other() {
    let files: Vec<(String, String)> =
        ours(".rs").into_iter().map(|(name, text)| (name, code_of(&text))).collect();
    let crates = files.iter().filter_map(|(name, _)| name.strip_suffix("lib.rs"));
    let mut faults = Vec::new();
    for folder in crates {
        let imports = circles::imports(folder, &files);
        for circle in circles::circles(&imports) {
            faults.push(format!("{}:", circle.join(", ")));
            for from in &circle {
                for (to, names) in imports[from].iter().filter(|(to, _)| circle.contains(to)) {
                    let names: Vec<&str> = names.iter().map(String::as_str).collect();
                    faults.push(format!("  {from} takes {} from {to}", names.join(", ")));
                }
            }
        }
    }
    fail_with(&faults, "circles of files (tests/it/tidy/circles.rs says what an import is)");
}

#[test]
fn circles_are_found_where_they_are() {
    let circles_of = |files: &[(&str, &str)]| {
        let owned = |&(name, code): &(&str, &str)| (format!("src/{name}.rs"), code.to_owned());
        let files: Vec<_> = files.iter().map(owned).collect();
        circles::circles(&circles::imports("src/", &files))
    };
    let two = vec![vec!["src/a/b.rs".to_owned(), "src/a/mod.rs".to_owned()]];
    let parent = "mod b;\nuse self::b::Child;\npub struct Parent(Child);";
    for child in [
        "use super::Parent;\npub struct Child;\nfn f(_: Parent) {}",
        "pub struct Child;\nfn f(_: crate::a::Parent) {}",
        "use crate::{a::{Parent as Other}};\npub struct Child;\nfn f(_: Other) {}",
        "use crate::a;\npub struct Child;\nfn f(_: a::Parent) {}",
        "use crate::Parent;\npub struct Child;\nfn f(_: Parent) {}",
    ] {
        let lib = ("lib", "mod a;\npub use a::Parent;");
        assert_eq!(circles_of(&[lib, ("a/mod", parent), ("a/b", child)]), two, "{child}");
    }
    // What a module only passes on is no import of it, and leads on to where it is defined.
    let passed = "mod b;\nmod c;\npub use self::{b::Child, c::Other};\npub struct Parent;";
    let child = "use super::{Other, Parent};\npub struct Child;\nfn f(_: Other, _: Parent) {}";
    let open = [("lib", "mod a;"), ("a/mod", passed), ("a/b", child), ("a/c", "pub struct Other;")];
    assert_eq!(circles_of(&open), Vec::<Vec<String>>::new());
    let back = "use super::Child;\npub struct Other;\nfn f(_: Child) {}";
    let closed = [("lib", "mod a;"), ("a/mod", passed), ("a/b", child), ("a/c", back)];
    assert_eq!(circles_of(&closed), vec![vec!["src/a/b.rs".to_owned(), "src/a/c.rs".to_owned()]]);
}

#[test]
fn crates_stay_where_they_belong() {
    let mut faults = Vec::new();
    let product = |name: &str| !name.contains("tests/") && !name.starts_with("benches/");
    for (name, text) in ours(".rs").iter().filter(|(name, _)| product(name)) {
        let code = code_of(text);
        for (confined, homes) in CONFINED {
            let at_home = homes.iter().any(|home| name.starts_with(home));
            if !at_home && !paths_from(&code, confined).is_empty() {
                faults
                    .push(format!("{name} names {confined}, whose place is {}", homes.join(", ")));
            }
        }
    }
    fail_with(&faults, "confined crates");
}

#[test]
fn every_shader_has_its_twin_and_names_it() {
    let inside = |name: &String| {
        name.ends_with(".wgsl") && Path::new(name).parent() == Some(Path::new("shaders"))
    };
    let named = |file: &str, partner: &str| read(file).lines().take(3).any(|l| l.contains(partner));
    let mut faults = Vec::new();
    for shader in files().into_iter().filter(inside) {
        let twins = files().into_iter().filter(|name| name.starts_with("crates/render/src/"));
        let Some(twin) = twins.into_iter().find(|twin| named(&shader, twin)) else {
            faults.push(format!("{shader}: the first lines name no twin"));
            continue;
        };
        if !named(&twin, &shader) {
            faults.push(format!("{twin}: the first lines do not name {shader}"));
        }
    }
    fail_with(&faults, "shaders and their CPU twins");
}

#[test]
fn files_say_what_they_are() {
    let mut faults = Vec::new();
    for (name, text) in
        ["rs", "wgsl", "proto", "py", "js", "css", "scripts/setup"].map(ours).concat()
    {
        for (i, line) in text.lines().enumerate() {
            let chars = line.chars().count();
            if chars > LINE_CHARS_MAX && !line.starts_with("//! |") {
                faults.push(format!("{name}:{}: {chars} columns", i + 1));
            }
        }
        if name.ends_with(".rs") && !text.starts_with("//!") {
            faults.push(format!("{name}: the first line does not say what the file is (//!)"));
        }
    }
    fail_with(&faults, "columns and first line of files");
}

#[test]
fn no_unfinished_work_and_no_path_of_a_machine() {
    let unfinished = [concat!("to", "do!("), concat!("unimple", "mented!("), concat!("FIX", "ME")];
    let words = [unfinished.as_slice(), &[concat!("extrin", "sics")]].concat();
    let paths = [concat!("/wo", "rk/"), concat!("/ro", "ot/")];
    let mut faults = Vec::new();
    for name in files() {
        let Ok(text) = fs::read_to_string(root().join(&name)) else { continue };
        let code = OURS.iter().any(|top| name.starts_with(top));
        for (i, line) in text.lines().enumerate() {
            // A path of a machine begins there; `$root/...` and `usr/...` are parts of others.
            let begins = |path: &str| {
                line.match_indices(path).any(|(at, _)| {
                    let before = line[..at].chars().next_back().unwrap_or(' ');
                    !(before.is_alphanumeric() || "\"'}._-".contains(before))
                })
            };
            let banned = words.iter().filter(|w| code && line.contains(**w));
            let banned = banned.chain(paths.iter().filter(|path| begins(path))).next();
            if let Some(word) = banned {
                faults.push(format!("{name}:{}: {word}", i + 1));
            }
        }
    }
    fail_with(&faults, "banned words and machine paths");
}

#[test]
fn the_tree_stays_small() {
    let size = |name: &String| fs::metadata(root().join(name)).map_or(0, |m| m.len());
    let all = files();
    let golden =
        |name: &&String| name.starts_with("tests/golden/") && size(name) > GOLDEN_BYTES_MAX;
    let faults: Vec<String> = all.iter().filter(golden).cloned().collect();
    fail_with(&faults, "golden files over 64 KiB");
    let total: u64 = all.iter().map(size).sum();
    assert!(total <= TREE_BYTES_MAX, "the tracked tree is {total} bytes, over {TREE_BYTES_MAX}");
}

#[test]
fn links_between_pages_lead_somewhere() {
    let mut faults = Vec::new();
    for name in files().into_iter().filter(|name| name.ends_with(".md")) {
        let folder = root().join(&name).parent().map(PathBuf::from).expect("a folder");
        for (_, rest) in read(&name).match_indices("](").map(|(at, m)| (at, at + m.len())) {
            let link = read(&name)[rest..].split(')').next().unwrap_or_default().to_owned();
            let target = link.split('#').next().unwrap_or_default();
            if !target.is_empty() && !target.contains(':') && !folder.join(target).exists() {
                faults.push(format!("{name}: {link}"));
            }
        }
    }
    fail_with(&faults, "links that lead nowhere");
}

/// Paths in backticks on the pages lead somewhere: a folder or a file of this repository.
#[test]
fn paths_in_backticks_lead_somewhere() {
    let mut faults = Vec::new();
    let said = |name: &String| name.ends_with(".md") && !name.starts_with("docs/measurements/");
    let is_path = |text: &str| {
        TOPS.iter().any(|top| text.starts_with(top))
            && text.chars().all(|c| c.is_alphanumeric() || "/._-".contains(c))
    };
    for name in files().into_iter().filter(said).filter(|name| name != "CHANGELOG.md") {
        let text = read(&name);
        for quoted in text.split('`').skip(1).step_by(2).filter(|text| is_path(text)) {
            if !root().join(quoted).exists() {
                faults.push(format!("{name}: `{quoted}`"));
            }
        }
    }
    fail_with(&faults, "paths in backticks that lead nowhere");
}

/// Names of the public types at the top level of a file, and where each stands.
fn public_types() -> BTreeMap<String, Vec<String>> {
    let mut found: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for (name, text) in ours(".rs") {
        if !(name.starts_with("src/") || (name.starts_with("crates/") && name.contains("/src/"))) {
            continue;
        }
        for line in code_of(&text).lines() {
            let kinds = ["struct", "enum", "trait", "type", "union"];
            let Some(rest) = line.strip_prefix("pub ") else { continue };
            let Some((kind, rest)) = rest.split_once(' ') else { continue };
            if kinds.contains(&kind) {
                let ident = rest.split(|c: char| !c.is_alphanumeric() && c != '_').next();
                found.entry(ident.unwrap_or_default().to_owned()).or_default().push(name.clone());
            }
        }
    }
    found
}

#[test]
fn no_two_public_types_share_a_name() {
    let types = public_types();
    assert!(types.len() > 100, "only {} public types were found", types.len());
    let faults: Vec<String> = types
        .iter()
        .filter(|(_, places)| places.len() > 1)
        .map(|(name, places)| format!("{name}: {}", places.join(", ")))
        .collect();
    fail_with(&faults, "names of public types");
}

/// The page of error codes, from the table and the comments in `crates/core/src/error.rs`.
fn errors_page() -> String {
    let mut page = String::from(
        "# Errors\n\nMade from the table in \
         [`crates/core/src/error.rs`](../crates/core/src/error.rs) by \
         `UPDATE_DOCS=1 cargo test --test it tidy`; a test holds the two together.\n\n\
         The name is the truth for clients: HTTP answers it as `code` of the JSON body, also of\n\
         `application/problem+json` (RFC 9457) where `Accept` names it; gRPC as the metadata\n\
         entry `segsplat-code`; the command line on standard error. gRPC numbers are those of\n\
         `google.rpc.Code`.\n\n\
         | code | HTTP | gRPC | exit | same call may succeed later | meaning |\n\
         |---|---|---|---|---|---|\n",
    );
    let source = read("crates/core/src/error.rs");
    for row in &TABLE {
        let variant = format!("    {:?}: ", row.code);
        let at = source.find(&variant).expect("each code stands in the table");
        let mut said: Vec<&str> = Vec::new();
        for line in source[..at].lines().rev().skip_while(|line| line.trim().is_empty()) {
            let Some(comment) = line.trim().strip_prefix("/// ") else { break };
            said.insert(0, comment);
        }
        let retry = if row.retry { "yes" } else { "no" };
        let (name, http, grpc, exit) = (row.name, row.http, row.grpc, row.exit);
        let meaning = said.join(" ");
        writeln!(page, "| `{name}` | {http} | {grpc} | {exit} | {retry} | {meaning} |")
            .expect("a string takes everything");
    }
    page
}

#[test]
fn the_page_of_errors_is_the_table() {
    let path = root().join("docs/errors.md");
    let page = errors_page();
    if std::env::var_os("UPDATE_DOCS").is_some() {
        fs::write(&path, &page).expect("docs/errors.md can be written");
    }
    let written = fs::read_to_string(&path).unwrap_or_default();
    assert_eq!(written, page, "docs/errors.md differs: UPDATE_DOCS=1 writes it");
}
