//! `segsplat export`: the Gaussians of a scene as a file for other programs, or of such a file as
//! another; or the scene as a zip of a folder with photos, cameras and depth, or masks of texts.

use std::path::{Path, PathBuf};

use fs_err::File;
use serde_json::json;

use super::{engine, output::Output, reconstruct, scene_file};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, Result},
    formats::{
        folders::FolderFormat,
        splats::SplatFormat,
        table::{ExportFormat, FormatKind},
    },
    names::named,
    scene::Preset,
    service::{FolderSpec, ScoringOptions, scene_levels, scene_splats},
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    #[arg(help = scene_file::scene_help())]
    scene: PathBuf,
    #[arg(short, long, value_name = "FILE", help = output_help())]
    output: PathBuf,
    /// What the scene was made of, a folder or an archive, for a folder with its photos
    #[arg(long, value_name = "PATH")]
    photos: Option<PathBuf>,
    /// What to look for, for a folder with masks; may be given many times
    #[arg(long = "text", value_name = "TEXT")]
    texts: Vec<String>,
    /// How it is drawn and texts are scored: default or paper; by default as the scene was made
    #[arg(long, value_parser = named::<Preset>)]
    preset: Option<Preset>,
    #[command(flatten)]
    scoring: ScoringOptions,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    scene_file::has_folder(&args.output)?;
    let name = args.output.file_name().unwrap_or_default().to_string_lossy();
    let format = ExportFormat::of_file(&name);
    let splats = match format.map(|format| (format, format.kind)) {
        Some((format, FormatKind::Folder(write))) => {
            return folder(args, format, write, config, out);
        }
        Some((format, FormatKind::Streamed)) => {
            has_no_photos(args, format.name)?;
            return levels(args, format.name, config, out);
        }
        Some((_, FormatKind::Splats(splats))) => splats,
        _ => {
            let (gaussians, folders) = endings();
            let path = args.output.display();
            let why = format!("the ending must be that of a format: {gaussians}, {folders}");
            return Err(Error::invalid(format!("{path}: {why}")));
        }
    };
    has_no_photos(args, splats.name)?;
    gaussians(args, splats, config, out)
}

/// Refuses what is said of a folder.
fn has_no_photos(args: &Args, name: &str) -> Result<()> {
    if args.photos.is_none() && args.texts.is_empty() {
        return Ok(());
    }
    let why = format!("--photos and --text go with folders, not with {name}");
    Err(Error::invalid(why))
}

/// Endings of files of Gaussians, and of folders.
fn endings() -> (String, String) {
    let of = |some: fn(&ExportFormat) -> bool| ExportFormat::listed(some, |row| row.ending);
    let zips = |of: &ExportFormat| matches!(of.kind, FormatKind::Folder(_) | FormatKind::Streamed);
    (of(|of| of.is_splats()), of(zips))
}

fn output_help() -> String {
    let (gaussians, folders) = endings();
    format!("File to write; its ending is the format: {gaussians}; of a folder {folders}")
}

fn gaussians(
    args: &Args,
    format: &'static SplatFormat,
    config: &Config,
    out: &Output,
) -> Result<()> {
    let scene = scene_file::open(&args.scene, &config.limits)?.scene;
    let count = scene.gaussians.len();
    let semantics = scene.semantics.as_deref();
    let file = scene_splats(format, &scene, &scene.gaussians, semantics)?;
    scene_file::write_splats(&args.output, &file)?;
    let path = args.output.display();
    let value = json!({
        "output": path.to_string(), "format": format.name, "gaussians": count,
        "semantics": format.semantics && scene.semantics.is_some(),
    });
    out.answer(&format!("{path}: {count} Gaussians as {}", format.name), &value)
}

fn folder(
    args: &Args,
    format: ExportFormat,
    folder: FolderFormat,
    config: &Config,
    out: &Output,
) -> Result<()> {
    let scene = scene_file::open(&args.scene, &config.limits)?.scene;
    let photos = args.photos.as_deref();
    let mode = scene.meta.provenance.options.cameras;
    let upload = photos.map(|path| reconstruct::upload(path, mode, config)).transpose()?;
    let service = engine::offline(config, format.lines)?;
    let (texts, preset, scoring) = (&args.texts[..], args.preset, &args.scoring);
    let spec = FolderSpec { format, folder, texts, preset, scoring, upload: upload.as_ref() };
    let (photos, size_bytes) = whole(&args.output, |to| service.folder(&scene, &spec, to))?;
    let (path, name, views) = (args.output.display(), format.name, scene.meta.cameras.len());
    let value = json!({
        "output": path.to_string(), "format": name, "views": views, "photos": photos,
        "size_bytes": size_bytes,
    });
    let text = format!("{path}: {views} views as {name}, {photos} photos, {size_bytes} bytes");
    out.answer(&text, &value)
}

fn levels(args: &Args, format: &str, config: &Config, out: &Output) -> Result<()> {
    let scene = scene_file::open(&args.scene, &config.limits)?.scene;
    let (levels, size_bytes) = whole(&args.output, |to| scene_levels(&scene, to))?;
    let (path, count) = (args.output.display(), scene.gaussians.len());
    let value = json!({
        "output": path.to_string(), "format": format, "gaussians": count, "levels": levels,
        "size_bytes": size_bytes,
    });
    let text = format!("{path}: {count} Gaussians in {levels} levels, {size_bytes} bytes");
    out.answer(&text, &value)
}

/// Writes a whole zip, or nothing; gives its bytes, too. Half a zip is of no use, and what was
/// there before stays until there is a whole one.
fn whole<T>(path: &Path, write: impl FnOnce(&mut File) -> Result<T>) -> Result<(T, u64)> {
    let unwritable = |e| scene_file::unwritable(path, e);
    let part = path.with_added_extension("part");
    let mut file = File::create(&part).map_err(unwritable)?;
    let done = write(&mut file).and_then(|written| {
        let size_bytes = file.metadata().map_err(unwritable)?.len();
        fs_err::rename(&part, path).map_err(unwritable)?;
        Ok((written, size_bytes))
    });
    done.inspect_err(|_| drop(fs_err::remove_file(&part)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_left_of_a_zip_that_cannot_take_its_place() {
        let dir = tempfile::tempdir().unwrap();
        let to = dir.path().join("folder");
        fs_err::create_dir_all(to.join("full")).unwrap();
        assert!(whole(&to, |_| Ok(())).is_err(), "a folder is there");
        let names: Vec<_> = fs_err::read_dir(dir.path()).unwrap().flatten().collect();
        assert_eq!(names.len(), 1, "{names:?}");
    }
}
