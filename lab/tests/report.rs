//! The page of measurements says what the runs say.

use std::{fs, path::Path};

use segsplat_lab::report::{Page, beside, older, pages, retire};
use segsplat_testing::root;
use serde_json::{Value, json};

#[test]
fn the_pages_are_what_the_rows_and_the_tree_say() {
    let pages = pages(root()).unwrap();
    assert_eq!(pages.len(), 2);
    for Page { name, old, new } in pages {
        let first = old.lines().zip(new.lines()).find(|(old, new)| old != new);
        assert!(old == new, "{name} differs; `make report` writes it: {first:?}");
    }
}

/// A repository of one table.
fn repository(columns: &str, rows: &[Value]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    fs::create_dir_all(dir.path().join("benches/runs")).unwrap();
    let table = format!("[[table]]\nname = \"t\"\nof = ['kernels']\n{columns}\n");
    fs::write(dir.path().join("benches/tables.toml"), table).unwrap();
    let rows: Vec<String> = rows.iter().map(Value::to_string).collect();
    fs::write(dir.path().join("benches/runs/1.jsonl"), rows.join("\n")).unwrap();
    dir
}

/// A row of the tree of [`repository`], where no file of the kernels is, of 2026-02-28.
fn row(values: &Value) -> Value {
    let mut row = json!({
        "table": "t", "command": "run", "commit": "c", "machine": "m", "error": 0,
        "unix_s": 1_772_323_199, "hashes": { "kernels": "cbf29ce484222325" },
    });
    row.as_object_mut().unwrap().extend(values.as_object().unwrap().clone());
    row
}

/// The page of this repository that had this text.
fn page(root: &Path, old: &str) -> Result<String, String> {
    fs::create_dir_all(root.join("docs")).unwrap();
    fs::write(root.join("docs/benchmarks.md"), old).unwrap();
    Ok(pages(root).map_err(|e| e.to_string())?.remove(0).new)
}

/// The table on the page of this repository.
fn table(root: &Path) -> Result<String, String> {
    let (before, after) = ("# Page\n<!-- table: t -->\n", "<!-- end -->\n");
    let page = page(root, &format!("{before}old{after}"))?;
    Ok(page.strip_prefix(before).unwrap().strip_suffix(after).unwrap().to_owned())
}

#[test]
fn each_table_is_on_one_page() {
    let dir = repository("columns = [['n', '{n}']]", &[row(&json!({ "n": 1 }))]);
    let fault = |old: &str| page(dir.path(), old).unwrap_err();
    let one = "<!-- table: t -->\n<!-- end -->\n";
    assert_eq!(fault("# Page"), "no page has the table t");
    assert_eq!(fault(&one.repeat(2)), "docs/benchmarks.md: there is no table t, or two");
    assert_eq!(fault("<!-- table: t -->\n"), "docs/benchmarks.md: a table has no end");
    assert!(page(dir.path(), one).unwrap().contains("| 1 |"));
}

#[test]
fn templates_take_values_as_they_say() {
    let columns = "columns = [['all', '{s}: {n:,}, {n}, {a.b.0:%}, {a.b.1:e}, {a.b.0:.2} ms'], \
                   ['none', '{none} ms'], ['no path', '{a.c:.1} ms']]";
    let values = json!({ "n": 1_234_567, "a": { "b": [0.5, 2.0e-4] }, "s": "x", "none": null });
    let dir = repository(columns, &[row(&values)]);
    let wanted = "| all | none | no path |\n| --- | --- | --- |\n\
                  | x: 1,234,567, 1234567, 50.0 %, 2.0e-4, 0.50 ms |  |  |\n\n\
                  Commit c; m; 2026-02-28.\n";
    assert_eq!(table(dir.path()).unwrap(), wanted, "where a value is missing the cell is empty");
}

#[test]
fn rows_of_one_key_are_one_line() {
    let columns = "key = '{scene}'\npivot = '{photos}'\n\
                   columns = [['scene', '{key}'], ['2', '{2.db:.1}'], ['4', '{4.db:.1}']]";
    let of = |scene, photos, db| row(&json!({ "scene": scene, "photos": photos, "db": db }));
    let dir = repository(columns, &[of("a", 2, 1.0), of("b", 2, 2.0), of("a", 4, 3.0)]);
    let wanted = "| scene | 2 | 4 |\n| --- | --- | --- |\n| a | 1.0 | 3.0 |\n\
                  | b | 2.0 |  |\n\nCommit c; m; 2026-02-28.\n";
    assert_eq!(table(dir.path()).unwrap(), wanted);
}

/// A changed shader makes rows older, and the page that does not say so is another one.
#[test]
fn rows_of_another_tree_are_named_and_marked() {
    let dir = repository("columns = [['n', '{n}']]", &[row(&json!({ "n": 1 }))]);
    let plain = "| n |\n| --- |\n| 1 |\n\nCommit c; m; 2026-02-28.\n";
    let said = || (table(dir.path()).unwrap(), older(dir.path()).unwrap());
    assert_eq!(said(), (plain.to_owned(), vec![]));
    let shader = dir.path().join("shaders/a.wgsl");
    fs::create_dir(dir.path().join("shaders")).unwrap();
    fs::write(&shader, "let a = 1;\n").unwrap();
    let mark = "***Older***: c of 2026-02-28 (kernels changed).\n\n";
    let named = "older: t: 1.jsonl, row 1, c of 2026-02-28: kernels changed".to_owned();
    assert_eq!(said(), (format!("{mark}{plain}"), vec![named]));
    // A table shows rows of this tree alone, where it has some; the others are moved away.
    let hash = segsplat_lab::report::hashes(dir.path()).unwrap()["kernels"].clone();
    let new = row(&json!({ "n": 2, "hashes": { "kernels": hash } }));
    fs::write(dir.path().join("benches/runs/2.jsonl"), new.to_string()).unwrap();
    let plain = plain.replace("| 1 |", "| 2 |");
    assert_eq!((said().0, said().1.len()), (plain.clone(), 1));
    fs::create_dir_all(dir.path().join("docs/measurements/runs")).unwrap();
    retire(dir.path()).unwrap();
    assert_eq!(said(), (plain, vec![]));
    let moved = fs::read_to_string(dir.path().join("docs/measurements/runs/1.jsonl")).unwrap();
    assert_eq!(moved.trim(), row(&json!({ "n": 1 })).to_string());
    assert!(!dir.path().join("benches/runs/1.jsonl").exists());
    // A comment changes nothing.
    fs::write(&shader, "// why\nlet a = 1;\n").unwrap();
    assert_eq!(said().1, Vec::<String>::new());
}

#[test]
fn the_first_table_has_figures_of_others() {
    let line = |task, is: &str| {
        format!(
            "[[line]]\ntask = '{task}'\ntime = {{ table = 't', is = {is}, \
             show = '{{ms:.1}} ms' }}\n\
             error = {{ table = 't', show = '{{db}} dB' }}\n"
        )
    };
    let columns = format!(
        "columns = [['n', '{{n}}']]\n{}{}",
        line("one", "{ n = 1 }"),
        line("three", "{ n = 3 }")
    );
    let old = json!({ "n": 2, "db": 7, "commit": "b", "hashes": {} });
    let rows = [row(&json!({ "n": 1.0, "ms": 2.25, "db": 6 })), row(&old)];
    let first = |rows: &[Value]| {
        let dir = repository(&columns, rows);
        let old = "<!-- table: today -->\n<!-- end -->\n<!-- table: t -->\n<!-- end -->\n";
        let page = page(dir.path(), old).unwrap();
        let lines =
            page.lines().filter(|line| line.starts_with("| one") || line.starts_with("| three"));
        lines.map(str::to_owned).collect::<Vec<_>>()
    };
    let wanted = [
        "| one | 2.2 ms | 6 dB | m | c of 2026-02-28 |",
        "| three | not measured | 6 dB |  | c of 2026-02-28 |",
    ];
    assert_eq!(first(&rows), wanted, "rows of this tree alone");
    let marked = "| one | not measured | 7 dB |  | b of 2026-02-28, ***older*** |";
    assert_eq!(first(&rows[1..])[0], marked);
}

#[test]
fn a_row_without_its_source_or_error_is_refused() {
    let columns = "columns = [['n', '{n}']]";
    for (key, value) in [("command", json!("")), ("commit", json!(null)), ("error", json!(null))] {
        let dir = repository(columns, &[row(&json!({ "n": 1, key: value }))]);
        assert_eq!(table(dir.path()).unwrap_err(), format!("1.jsonl, row 1: no {key}"));
    }
}

/// As [`repository`], with a table of published figures and a row of it.
fn published(source: &Value) -> tempfile::TempDir {
    let columns = "columns = [['method', '{method}'], ['iou', '{iou:%}']]\n\
                   [table.ours]\nrows = 'mine'\nkey = '{networks}'\npivot = '{scene}'\n\
                   columns = ['ours, {key}', '{bed.iou:%}']";
    let ours =
        |scene, iou| json!({ "table": "mine", "networks": "small", "scene": scene, "iou": iou });
    let dir = repository(columns, &[row(&ours("bed", 0.25)), row(&json!({ "table": "mine" }))]);
    let folder = dir.path().join("benches/published");
    fs::create_dir(&folder).unwrap();
    let theirs = json!({ "table": "t", "source": source, "method": "theirs", "iou": 0.5 });
    fs::write(folder.join("paper.jsonl"), theirs.to_string()).unwrap();
    fs::write(dir.path().join("run.jsonl"), ours("bed", 0.75).to_string()).unwrap();
    dir
}

#[test]
fn published_rows_stand_with_their_source_and_ours_below_them() {
    let dir = published(&json!("a paper, table 1"));
    let theirs = "| method | iou |\n| --- | --- |\n| theirs | 50.0 % |\n";
    // A row without networks is no line.
    let wanted = format!(
        "{theirs}| ours, small | 25.0 % |\n\nPublished: a paper, table 1. \
         Ours: commit c; m; 2026-02-28.\n"
    );
    assert_eq!(table(dir.path()).unwrap(), wanted);
    let file = dir.path().join("run.jsonl");
    let asked = format!("t={}", file.display());
    let wanted = format!("{theirs}| ours, small | 75.0 % |\n");
    assert!(beside(dir.path(), &asked).unwrap().starts_with(&wanted));
    for asked in ["t", "x=run.jsonl"] {
        let fault = beside(dir.path(), asked).unwrap_err().to_string();
        assert!(fault.contains("must be TABLE=FILE; tables: t"), "{fault}");
    }
    fs::write(&file, "{}").unwrap();
    let fault = beside(dir.path(), &asked).unwrap_err().to_string();
    assert!(fault.contains("no row fits the table t"), "{fault}");
    let without = table(published(&json!("")).path()).unwrap_err();
    assert_eq!(without, "paper.jsonl, row 1: no source");
}
