//! Files of the command line: a scene file, a folder with one, or Gaussians of another program.

use std::{
    io::{self, BufRead, BufReader, Write as _},
    path::{Path, PathBuf},
    sync::Arc,
};

use crate::{
    error::{Error, ErrorCode, Result},
    formats::{
        container::{read_scene, read_semantics},
        splats::{SplatFile, SplatFormat, SplatsRead},
        table::{ExportFormat, read_splats, splat_format_of},
    },
    limits::Limits,
    scene::{Scene, SceneOptions},
};

/// Name of the scene file where a folder is named.
const IN_FOLDER: &str = "scene.segsplat";

/// A scene and where it came from.
#[derive(Debug)]
pub(super) struct Opened {
    pub(super) scene: Arc<Scene>,
    /// `segsplat`, or the name of a format of Gaussians.
    pub(super) format: &'static str,
    /// sha256 of a scene file, hex.
    pub(super) sha256: Option<String>,
}

/// The file of a scene's semantics: beside the scene file, as the server keeps them.
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

/// What a command reads, for its help.
pub(super) fn scene_help() -> String {
    format!("Scene file, a folder with one, or a file of Gaussians ({})", splat_titles())
}

/// The formats of Gaussians, for help.
pub(super) fn splat_titles() -> String {
    ExportFormat::listed(|of| of.is_splats(), |row| row.title)
}

/// The path of a scene file to write, or of a file of Gaussians.
///
/// # Errors
/// `invalid_request` for an ending of something else, or where there is no such folder.
pub(super) fn path_to_write(path: &Path) -> Result<PathBuf> {
    let path = path_of(path);
    let ending = ending(&path);
    if splat_format(&path).is_none() && !["", "segsplat"].contains(&&*ending) {
        let (path, titles) = (path.display(), splat_titles());
        let why = format!("the ending must be segsplat (a scene file) or one of {titles}");
        return Err(Error::invalid(format!("{path}: {why}")));
    }
    has_folder(&path)?;
    Ok(path)
}

/// Checks that the folder of a file to write is there, before the work that the file is for.
///
/// # Errors
/// `invalid_request`.
pub(super) fn has_folder(path: &Path) -> Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    match folder {
        Some(folder) if !folder.is_dir() => {
            let (path, folder) = (path.display(), folder.display());
            Err(Error::invalid(format!("{path}: there is no folder {folder}; make it first")))
        }
        _ => Ok(()),
    }
}

/// The format of Gaussians that the ending of a file says.
pub(super) fn splat_format(path: &Path) -> Option<&'static SplatFormat> {
    splat_format_of(&path.file_name()?.to_string_lossy())
}

/// Writes Gaussians as a file for other programs.
pub(super) fn write_splats(path: &Path, file: &SplatFile) -> Result<()> {
    let write = || -> io::Result<()> {
        let mut to = io::BufWriter::new(fs_err::File::create(path)?);
        file.write(&mut to)?;
        to.flush()?;
        to.get_ref().sync_all()
    };
    write().map_err(|e| unwritable(path, e))
}

/// The error of a file that cannot be read.
pub(super) fn unreadable(path: &Path, cause: io::Error) -> Error {
    Error::invalid(format!("{}: cannot be read: {}", path.display(), cause.kind())).caused_by(cause)
}

/// Writes a file.
pub(super) fn write(path: &Path, file: &[u8]) -> Result<()> {
    fs_err::write(path, file).map_err(|cause| unwritable(path, cause))
}

/// The error of a file that cannot be written.
pub(super) fn unwritable(path: &Path, cause: io::Error) -> Error {
    let what = format!("{}: cannot be written: {}", path.display(), cause.kind());
    Error::new(ErrorCode::StoreUnavailable, what).caused_by(cause)
}

/// The ending of a file's name, in lower case.
pub(super) fn ending(path: &Path) -> String {
    path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase()
}

/// Reads a file of Gaussians of this name, as many as may be: it is the caller's own.
pub(super) fn splats_of(
    from: &mut dyn BufRead,
    path: &Path,
    limits: &Limits,
) -> Result<SplatsRead> {
    let limits = Limits { splats_bytes_max: u64::MAX, ..limits.clone() };
    read_splats(from, &path.to_string_lossy(), &limits)
}

/// Opens a scene with its semantics, where there are some.
pub(super) fn open(path: &Path, limits: &Limits) -> Result<Opened> {
    let path = path_of(path);
    if let Some(format) = splat_format(&path) {
        let file = fs_err::File::open(&path).map_err(|e| unreadable(&path, e))?;
        let read = splats_of(&mut BufReader::new(file), &path, limits)?;
        let scene = Arc::new(read.into_scene(&SceneOptions::default())?);
        return Ok(Opened { scene, format: format.name, sha256: None });
    }
    let file = fs_err::read(&path).map_err(|e| unreadable(&path, e))?;
    let (mut scene, sha256) = read_scene(&file)?;
    let beside = semantics_path(&path);
    match fs_err::read(&beside) {
        Ok(file) => {
            let (semantics, _) = read_semantics(&file, &scene.meta.id)?;
            scene = scene.with_semantics(Arc::new(semantics))?;
        }
        Err(e) if e.kind() == io::ErrorKind::NotFound => {}
        Err(e) => return Err(unreadable(&beside, e)),
    }
    Ok(Opened { scene: Arc::new(scene), format: "segsplat", sha256: Some(sha256) })
}
