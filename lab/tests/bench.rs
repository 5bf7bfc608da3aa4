//! `bench` runs what has no rows of this tree, once, and keeps no rows of what failed.

use std::{fs, path::Path, process::Command};

use segsplat_testing::root;

/// Runs `bench` in `dir`; whether it went well, and what it said.
fn bench(dir: &Path, more: &[&str]) -> (bool, String) {
    let done = Command::new(env!("CARGO_BIN_EXE_segsplat-lab"))
        .args(["--commit", "c", "--machine", "m", "bench", "--root"])
        .arg(dir)
        .args(more)
        .output()
        .unwrap();
    let said = [done.stdout, done.stderr].map(|text| String::from_utf8(text).unwrap()).concat();
    (done.status.success(), said)
}

fn rows(dir: &Path) -> Vec<serde_json::Value> {
    let files = fs::read_dir(dir.join("benches/runs")).unwrap();
    let texts = files.map(|entry| fs::read_to_string(entry.unwrap().path()).unwrap());
    let text: String = texts.collect();
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn a_command_runs_until_it_has_rows_of_this_tree() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    fs::create_dir_all(dir.join("benches/runs")).unwrap();
    let run = "frames --renderer cpu --threads 1 --gaussians 200 --size 16 --frames 2";
    let tables = format!(
        "[[table]]\nname = 'a'\nof = ['defaults']\non = 'cpu'\nseconds = 60\ncolumns = []\n\
         runs = ['{run}', 'frames --gaussians 1']\n\
         [[table]]\nname = 'b'\nof = []\non = 'gpu'\nseconds = 60\ncolumns = []\nruns = ['{run}']\n"
    );
    fs::write(dir.join("benches/tables.toml"), tables).unwrap();
    // This program was built from another `defaults` than none.
    let (well, said) = bench(dir, &["cpu"]);
    assert!(!well && said.contains("built from another tree (defaults"), "{said}");
    let place = "crates/core/src/scene/method.rs";
    fs::create_dir_all(dir.join(place).parent().unwrap()).unwrap();
    fs::copy(root().join(place), dir.join(place)).unwrap();
    let (well, said) = bench(dir, &["cpu", "--list"]);
    assert!(well && said.contains(&format!("a (at most 60 s): segsplat-lab {run}")), "{said}");
    assert!(!said.contains("\nb (") && rows(dir).is_empty(), "{said}");
    // No time, then the first of two commands, and then nothing new.
    let (well, said) = bench(dir, &["cpu", "--within", "1"]);
    assert!(!well && said.contains("no time for") && rows(dir).is_empty(), "{said}");
    for _ in 0..2 {
        let (well, said) = bench(dir, &["cpu"]);
        assert!(!well && said.contains("a: it failed"), "{said}");
        let rows = rows(dir);
        assert_eq!(rows.len(), 1, "{said}");
        assert_eq!(rows[0]["command"], format!("segsplat-lab {run}"));
        assert_eq!((&rows[0]["table"], &rows[0]["commit"]), (&"a".into(), &"c".into()));
    }
    let (well, said) = bench(dir, &["--only", "b"]);
    assert!(well && said.contains("b: 1 rows") && rows(dir).len() == 2, "{said}");
}
