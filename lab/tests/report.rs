//! The page of measurements says what the runs say.

use std::path::Path;

use segsplat_lab::report::page;

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

#[test]
fn the_page_is_what_the_rows_say() {
    let old = std::fs::read_to_string(root().join("docs/benchmarks.md")).unwrap();
    let new = page(root(), &old).unwrap();
    let first = old.lines().zip(new.lines()).find(|(old, new)| old != new);
    assert!(old == new, "docs/benchmarks.md differs; `make report` writes it: {first:?}");
    let changed = old.replacen(" dB", " db", 1).replacen("| 0.", "| 9.", 1);
    assert_ne!(page(root(), &changed).unwrap(), changed, "a changed cell is found");
}
