//! A scene named on the command line: a scene file, a folder that holds one, or a PLY.

use std::{
    io::BufReader,
    path::{Path, PathBuf},
    sync::Arc,
};

use crate::{
    error::{Error, Result},
    limits::Limits,
    scene::{Backdrop, DropCount, HealthReport, Provenance, Scene, SceneId, SceneMeta},
    store::{ply::read_ply, read_scene, read_semantics},
};

/// Name of the scene file where a folder is named.
const IN_FOLDER: &str = "scene.segsplat";

/// A scene and where it came from.
#[derive(Debug)]
pub(super) struct Opened {
    pub(super) scene: Scene,
    /// `segsplat` or `ply`.
    pub(super) format: &'static str,
    /// sha256 of a scene file, hex.
    pub(super) sha256: Option<String>,
}

/// Where the semantics of a scene file lie: beside it, as the server keeps them.
pub(super) fn semantics_path(scene: &Path) -> PathBuf {
    if scene.file_name().is_some_and(|name| name == IN_FOLDER) {
        return scene.with_file_name("semantics.segsplat");
    }
    scene.with_extension("semantics.segsplat")
}

/// The path of the scene file: itself, or the one in the folder.
pub(super) fn path_of(path: &Path) -> PathBuf {
    if path.is_dir() { path.join(IN_FOLDER) } else { path.to_owned() }
}

pub(super) fn is_ply(path: &Path) -> bool {
    path.extension().is_some_and(|end| end.eq_ignore_ascii_case("ply"))
}

pub(super) fn open(path: &Path, limits: &Limits) -> Result<Opened> {
    let path = path_of(path);
    let unreadable = |e: std::io::Error| {
        Error::invalid(format!("{}: cannot be read: {}", path.display(), e.kind())).caused_by(e)
    };
    if is_ply(&path) {
        let file = fs_err::File::open(&path).map_err(unreadable)?;
        let (gaussians, counts) = read_ply(BufReader::new(file), limits.gaussians_max)?;
        let dropped = counts
            .counts()
            .into_iter()
            .filter(|(_, count)| *count > 0)
            .map(|(reason, count)| DropCount { reason: reason.to_owned(), count });
        let report = HealthReport {
            gaussians: gaussians.len() as u64,
            dropped: dropped.collect(),
            ..HealthReport::default()
        };
        let meta = SceneMeta {
            id: SceneId::from_bytes([0; 16]),
            created_ms: 0,
            cameras: Vec::new(),
            report,
            provenance: Provenance::default(),
        };
        let scene = Scene::new(meta, gaussians, Backdrop::default());
        return Ok(Opened { scene, format: "ply", sha256: None });
    }
    let file = fs_err::read(&path).map_err(unreadable)?;
    let (mut scene, sha256) = read_scene(&file)?;
    let beside = semantics_path(&path);
    match fs_err::read(&beside) {
        Ok(file) => {
            let (semantics, _) = read_semantics(&file, &scene.meta.id)?;
            scene = scene.with_semantics(Arc::new(semantics))?;
        }
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => {}
        Err(e) => {
            let what = format!("{}: cannot be read: {}", beside.display(), e.kind());
            return Err(Error::invalid(what).caused_by(e));
        }
    }
    Ok(Opened { scene, format: "segsplat", sha256: Some(sha256) })
}
