//! Gives the laboratory the hashes of the tree that it is built from.

#[path = "src/sources.rs"]
mod sources;

use std::path::Path;

fn main() -> std::io::Result<()> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    for place in sources::GROUPS.iter().flat_map(|(_, places)| *places) {
        println!("cargo::rerun-if-changed=../{place}");
    }
    let pairs = sources::hashes(&root)?.into_iter().map(|(name, hash)| format!("{name}={hash}"));
    println!("cargo::rustc-env=SEGSPLAT_SOURCES={}", pairs.collect::<Vec<_>>().join(" "));
    Ok(())
}
