//! Where the files that belong to the program are looked for, whatever the working folder is.

use std::path::{Path, PathBuf};

/// How far above its executable the checkout of a cargo build lies at most:
/// `target/TRIPLE/release/deps`.
const ABOVE_MAX: usize = 5;

/// Folders in which `models/` or the library may lie: the executable's, `../share/segsplat` beside
/// it, the checkout that the executable was built in, the working folder.
pub(super) fn folders() -> Vec<PathBuf> {
    let executable = std::env::current_exe().ok();
    let beside = executable.as_deref().map(of_executable).unwrap_or_default();
    beside.into_iter().chain([PathBuf::from(".")]).collect()
}

fn of_executable(executable: &Path) -> Vec<PathBuf> {
    let above: Vec<&Path> = executable.ancestors().skip(1).take(ABOVE_MAX).collect();
    let own = above.first().map(|&folder| folder.to_owned());
    let shared = above.get(1).map(|prefix| prefix.join("share/segsplat"));
    let checkout = above.iter().find(|folder| folder.join("Cargo.toml").is_file());
    own.into_iter().chain(shared).chain(checkout.map(|&folder| folder.to_owned())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_executable_names_its_folder_its_share_and_its_checkout() {
        let checkout = tempfile::tempdir().unwrap();
        fs_err::write(checkout.path().join("Cargo.toml"), "").unwrap();
        for under in ["target/release", "target/debug/deps", "target/triple/release"] {
            let built = checkout.path().join(under).join("segsplat");
            assert_eq!(of_executable(&built).last().unwrap(), checkout.path(), "{under}");
        }
        assert_eq!(
            of_executable(Path::new("/nowhere/bin/segsplat")),
            [Path::new("/nowhere/bin"), Path::new("/nowhere/share/segsplat")]
        );
    }
}
