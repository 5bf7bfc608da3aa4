//! `segsplat edit`: a scene file after a list of edits.

use std::path::PathBuf;

use serde::Deserialize;
use serde_json::json;

use super::{engine, output::Output, scene_file};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, Result},
    scene::Scene,
    service::{EditSpec, SceneEdits, scene_splats},
    store::{write_scene_file, write_semantics_file},
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    #[arg(help = scene_file::scene_help())]
    scene: PathBuf,
    /// File with the list: what `GET /v1/scenes/{id}/edits` answers, or `{"edits": [...]}`
    #[arg(long, value_name = "FILE")]
    edits: PathBuf,
    /// File to write: a scene file (.segsplat), whose semantics lie beside it, or a file of
    /// Gaussians
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

/// The file of a list. What an answer says besides is left.
#[derive(Deserialize)]
struct EditsFile {
    edits: Vec<EditSpec>,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let path = scene_file::path_to_write(&args.output)?;
    let file = fs_err::read(&args.edits).map_err(|e| scene_file::unreadable(&args.edits, e))?;
    config.limits.check_json("edits", &file)?;
    let EditsFile { edits } = serde_json::from_slice(&file)
        .map_err(|e| Error::invalid(format!("{}: {e}", args.edits.display())).caused_by(e))?;
    let opened = scene_file::open(&args.scene, &config.limits)?;
    let texts = edits.iter().any(|edit| edit.select.text.is_some());
    let service = engine::offline(config, texts)?;
    let (scene, took) = service.edit(&opened.scene, &edits)?;
    if let Some(format) = scene_file::splat_format(&path) {
        let semantics = scene.semantics.as_deref();
        let file = scene_splats(format, &scene, &scene.gaussians, semantics)?;
        scene_file::write_splats(&path, &file)?;
    } else {
        // The entries of its Gaussians are in the file of the semantics.
        let none = vec![0; scene.gaussians.len()];
        let gaussians = scene.gaussians.with_semantic_index(none)?;
        let semantics_sha256 = String::new();
        write_scene_file(&path, &Scene { gaussians, semantics_sha256, ..scene.clone() })?;
        let beside = scene_file::semantics_path(&path);
        match &scene.semantics {
            Some(semantics) => write_semantics_file(&beside, &scene.meta.id, semantics)?,
            // Those of another scene would not fit.
            None if beside.exists() => {
                fs_err::remove_file(&beside).map_err(|e| scene_file::unwritable(&beside, e))?;
            }
            None => {}
        }
    }
    let (path, count) = (path.display(), took.gaussians);
    let SceneEdits { counts, uncovered, .. } = took;
    let value = json!({ "output": path.to_string(), "gaussians": count, "counts": counts,
        "uncovered": uncovered });
    let hole = 100.0 * uncovered;
    let says = format!("the edits took {counts:?}; {hole:.1} % of the photos show nothing now");
    out.answer(&format!("{path}: {count} Gaussians; {says}"), &value)
}
