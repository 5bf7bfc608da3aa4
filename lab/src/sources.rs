//! What a measurement depends on: named groups of files of the repository, each with a hash.
//!
//! A row has the hashes of the tree that the laboratory was built from (`build.rs` takes them), and
//! `report` compares them with those of the tree that it stands in. A table names the groups that
//! it depends on. Lines that are empty or a comment alone do not count.

use std::{
    fs, io,
    path::{Path, PathBuf},
};

/// Each group, and its files and folders.
pub(crate) const GROUPS: [(&str, &[&str]); 9] = [
    // What a picture is. The renderers are held to it, so errors of pictures depend on it alone.
    (
        "model",
        &[
            "crates/render/src/oracle.rs",
            "crates/render/src/constants.rs",
            "crates/render/src/plan.rs",
        ],
    ),
    // Not what is made of Gaussians beside pictures (`coarse.rs`, `surface.rs`).
    (
        "kernels",
        &[
            "crates/render/src/backward",
            "crates/render/src/blocks.rs",
            "crates/render/src/budget.rs",
            "crates/render/src/constants.rs",
            "crates/render/src/cpu",
            "crates/render/src/gpu",
            "crates/render/src/labels.rs",
            "crates/render/src/levels.rs",
            "crates/render/src/lib.rs",
            "crates/render/src/merged.rs",
            "crates/render/src/options.rs",
            "crates/render/src/oracle.rs",
            "crates/render/src/plan.rs",
            "crates/render/src/places.rs",
            "crates/render/src/renderer.rs",
            "crates/render/src/select.rs",
            "crates/render/src/switches.rs",
            "crates/render/src/train",
            "crates/render/src/view.rs",
            "shaders",
        ],
    ),
    ("networks", &["models/embedded"]),
    // Photos to Gaussians.
    (
        "geometry",
        &[
            "crates/vision/src/photos",
            "crates/vision/src/capture",
            "crates/vision/src/models",
            "crates/vision/src/lift",
            "crates/vision/src/pipeline/mod.rs",
        ],
    ),
    (
        "semantics",
        &[
            "crates/vision/src/segment",
            "crates/vision/src/semantics",
            "crates/vision/src/pipeline/masks.rs",
            "crates/vision/src/pipeline/semantics.rs",
        ],
    ),
    ("refinement", &["crates/vision/src/refine", "crates/vision/src/pipeline/refinement.rs"]),
    ("defaults", &["crates/core/src/scene/method.rs"]),
    ("formats", &["crates/formats/src"]),
    ("service", &["src"]),
];

/// The hash of each group in the repository `root`, in the order of [`GROUPS`].
///
/// # Errors
/// Where a file cannot be read.
pub(crate) fn hashes(root: &Path) -> io::Result<Vec<(&'static str, String)>> {
    let hash = |(name, places): &(&'static str, &[&str])| {
        let mut files = Vec::new();
        for place in *places {
            list(&root.join(place), &mut files)?;
        }
        files.sort();
        let mut hash = Fnv::default();
        for file in files {
            let name = file.strip_prefix(root).unwrap_or(&file).to_string_lossy().into_owned();
            hash.add(name.as_bytes());
            hash.add(&meant(&name, fs::read(&file)?));
        }
        Ok((*name, format!("{:016x}", hash.0)))
    };
    GROUPS.iter().map(hash).collect()
}

fn list(place: &Path, files: &mut Vec<PathBuf>) -> io::Result<()> {
    if place.is_file() {
        files.push(place.to_owned());
        return Ok(());
    }
    if !place.exists() {
        return Ok(());
    }
    for entry in fs::read_dir(place)? {
        list(&entry?.path(), files)?;
    }
    Ok(())
}

/// What counts of a file: of source its lines without indents, empty ones and comments.
fn meant(name: &str, bytes: Vec<u8>) -> Vec<u8> {
    let comment = match name.rsplit('.').next() {
        Some("rs" | "wgsl") => "//",
        Some("toml") => "#",
        _ => return bytes,
    };
    let text = String::from_utf8_lossy(&bytes);
    let lines = text.lines().map(str::trim);
    let lines: Vec<&str> = lines.filter(|v| !v.is_empty() && !v.starts_with(comment)).collect();
    lines.join("\n").into_bytes()
}

/// FNV-1a, 64 bits: it tells trees apart, and nobody gains by a collision.
struct Fnv(u64);

impl Default for Fnv {
    fn default() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }
}

impl Fnv {
    /// Adds a piece and its end.
    fn add(&mut self, bytes: &[u8]) {
        let length = (bytes.len() as u64).to_le_bytes();
        for byte in bytes.iter().chain(&length) {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn root() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
    }

    #[test]
    fn every_place_of_a_group_is_there() {
        for (group, places) in GROUPS {
            for place in places {
                assert!(root().join(place).exists(), "{group}: {place}");
            }
        }
    }

    #[test]
    fn code_and_names_count_and_comments_do_not() {
        let dir = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| {
            let path = dir.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
            let all = hashes(dir.path()).unwrap();
            all.into_iter().find(|(group, _)| *group == "kernels").unwrap().1
        };
        let first = write("shaders/a.wgsl", "// one\n\nlet a = 1;\n");
        assert_eq!(write("shaders/a.wgsl", "  // two\n  let a = 1;"), first);
        assert_ne!(write("shaders/a.wgsl", "let a = 2;"), first);
        assert_eq!(write("shaders/a.wgsl", "let a = 1;"), first);
        assert_ne!(write("shaders/b.wgsl", ""), first, "another file");
    }
}
