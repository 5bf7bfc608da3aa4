//! `segsplat reconstruct`: a folder or archive of photos and cameras, or a file of Gaussians,
//! becomes a scene file, or a file of Gaussians for other programs.

use std::{
    borrow::Cow,
    fmt::Write as _,
    path::{Path, PathBuf},
    sync::{Arc, atomic::AtomicBool},
    time::Instant,
};

use parking_lot::Mutex;
use serde_json::json;
use sha2::{Digest, Sha256};

use super::{
    engine,
    output::Output,
    scene_file::{
        path_to_write, semantics_path, splat_format, splat_titles, splats_of, unreadable,
        unwritable, write_splats,
    },
    video,
};
use crate::{
    config::{Config, ConfigArgs},
    error::{Error, ErrorCode, Result},
    formats::table::ExportFormat,
    jobs::{Refiner, refine_options},
    limits::Limits,
    names::named,
    pipeline::{
        self, PhotoSet, Pipeline, ReadSet, Seen, cameras, ignored, make_for_refinement,
        refinement::{RefineCalls, refined, reported, spooled, version_of},
        semantics::{SemanticsInput, understand},
    },
    refine::{RefineOptions, RefinedVersion},
    scene::{
        CamerasMode, Density, PhotoHash, PosedPhoto, Preset, Provenance, Refine, RefineReport,
        Scene, SceneId, SceneMeta, SceneOptions, SemanticsMode, Stage, Upload, Watch,
        unless_cancelled,
    },
    service::{check_refine, checked_words, scene_splats},
    store::{self, write_scene_file, write_semantics_file},
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    #[arg(help = format!("Folder of a capture (docs/captures.md has the layouts), a zip or tar of \
        one, a video where ffmpeg is installed, or a file of Gaussians ({}), which keeps its \
        semantics", splat_titles()))]
    photos: PathBuf,
    #[arg(short, long, value_name = "FILE")]
    #[arg(help = format!("Scene file to write; with an ending of these that format: {}",
        ExportFormat::listed(|of| of.is_splats(), |row| row.ending)))]
    output: PathBuf,
    /// `solve` computes the cameras from the photos also where some are there
    #[arg(long, value_parser = named::<CamerasMode>, default_value = "auto")]
    cameras: CamerasMode,
    /// Views that the network takes at once [default: 4]
    #[arg(long)]
    max_views: Option<usize>,
    /// `eager` also makes the semantics, in a file beside the scene's; `off` makes none
    #[arg(long, value_parser = semantics, default_value = "off")]
    semantics: SemanticsMode,
    /// Bring the scene closer to its photos: for so many milliseconds, or `auto`, which takes 10 to
    /// 60 s where there are five photos and more
    #[arg(long, value_name = "off|auto|MILLISECONDS", default_value = "off")]
    refine: Refine,
    /// Leave what this word names out of the scene, as `person`; may be given several times
    #[arg(long, value_name = "WORD")]
    ignore: Vec<String>,
    /// Gaussians kept: `thinned`, one for up to 16 neighbours where the photos are flat, or `full`
    #[arg(long, value_parser = named::<Density>)]
    density: Option<Density>,
    /// How the scene is made and understood: `default`, or `paper`
    #[arg(long, value_parser = named::<Preset>, default_value = "default")]
    preset: Preset,
    /// A change of the method: `--method lambda=0.8 --method votes=false`; docs/method.md has all
    #[arg(long, value_name = "NAME=VALUE")]
    method: Vec<String>,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let options = SceneOptions {
        max_views: args.max_views,
        cameras: args.cameras,
        semantics: args.semantics,
        preset: args.preset,
        density: args.density,
        refine: Some(args.refine),
        ignore: checked_words(&args.ignore, &config.limits)?,
        ..SceneOptions::default()
    };
    let options = options.with(&args.method)?;
    options.method().check()?;
    check_refine(args.refine, &config.limits)?;
    let path = path_to_write(&args.output)?;
    if !args.photos.is_dir() && splat_format(&args.photos).is_some() {
        return import(args, &path, config, &options, out);
    }
    let engine = Pipeline::open(&config.networks())?;
    let eager = args.semantics == SemanticsMode::Eager;
    let needs = match eager {
        true => Some("--semantics eager"),
        false => (!options.ignore.is_empty()).then_some("--ignore"),
    };
    if let (Some(what), Some(lack)) = (needs, engine.bundle().lacks_semantics()) {
        let message = format!("{what}: the bundle has {lack}");
        return Err(Error::new(ErrorCode::ModelUnavailable, message));
    }
    let begun = Instant::now();
    let progress =
        |stage: Stage, fraction: f32| out.progress(stage.name(), stage.overall(fraction));
    let watch = Watch { progress: &progress, cancel: &AtomicBool::new(false) };
    progress(Stage::Photos, 0.0);
    let (read, upload) = read(&args.photos, args.cameras, config, watch.cancel)?;
    let photos = match read {
        ReadSet::Posed(photos) => photos,
        ReadSet::Unposed(photos) => cameras::posed(&engine, photos, watch)?,
    };
    let method = options.method();
    let photos = ignored::without_words(&engine, photos, &options.ignore, &method, watch)?;
    let refiner = match args.refine {
        Refine::Off => None,
        _ => {
            let device = engine::renderer(config)?.differentiable();
            // Nobody else waits for the processor.
            let limits = Limits { refine_threads_percent: 100, ..config.limits.clone() };
            let refiner = Refiner::new(device, config.threads, &limits)?;
            let ms = refiner.budget_ms(args.refine, photos.photos.len());
            ms.map(|ms| (refiner, refine_options(ms, &config.limits)))
        }
    };
    let (made, seen) = match refiner {
        None => (pipeline::make(&engine, &photos, &options, watch)?, None),
        Some(_) => {
            let (made, seen) = pipeline::make_keeping(&engine, &photos, &options, watch)?;
            (made, Some(seen))
        }
    };
    let provenance = store::provenance(store::hashes(&upload), &options, engine.bundle().sha256());
    let id = id_of(&provenance);
    let made = made.into_scene(id, store::now_ms(), provenance);
    let mut scene = match (&refiner, &seen) {
        (Some(refiner), Some(seen)) => {
            let sent = Sent { photos: &photos, upload: &upload, limits: &config.limits };
            refine(&engine, refiner, made, sent, seen, &options, watch)?
        }
        _ => made,
    };
    let for_others = splat_format(&path).is_some();
    write(&path, &scene)?;
    if eager {
        let (cameras, gaussians) = (&scene.meta.cameras[..], &scene.gaussians);
        let parts = SemanticsInput { photos: &photos.photos, cameras, gaussians };
        let made = understand(&engine, &parts, &scene.meta.report.method, watch)?;
        let semantics = Arc::new(made);
        if !for_others {
            write_semantics_file(&semantics_path(&path), &scene.meta.id, &semantics)?;
        }
        scene = scene.with_semantics(semantics)?;
        if for_others {
            write(&path, &scene)?;
        }
    } else if !for_others {
        remove(&semantics_path(&path))?;
    }
    let total_ms = begun.elapsed().as_secs_f64() * 1e3;
    out.progress("done", 1.0);
    describe(&path, &scene, total_ms, out)
}

/// What a scene is made of.
#[derive(Clone, Copy)]
struct Sent<'a> {
    photos: &'a PhotoSet,
    upload: &'a Upload,
    limits: &'a Limits,
}

/// The scene after its refinement; as it was where none was better.
fn refine(
    engine: &Pipeline,
    (refiner, how): &(Refiner, RefineOptions),
    scene: Scene,
    sent: Sent<'_>,
    seen: &Seen,
    options: &SceneOptions,
    watch: Watch<'_>,
) -> Result<Scene> {
    let silent = Watch { progress: &|_, _| (), cancel: watch.cancel };
    let photos = &sent.photos.photos;
    // With the cameras that the photos have now.
    let made_of = Mutex::new((Cow::Borrowed(&photos[..]), Cow::Borrowed(seen)));
    let mut remake = |held: &[usize]| {
        let (photos, seen) = &*made_of.lock();
        make_for_refinement(engine, photos, held, seen, silent)
    };
    let mut recast = || {
        let Some((found, seen)) = pipeline::cameras::recast(engine, photos, options, silent)?
        else {
            return Ok(None);
        };
        let poses = found.iter().map(|posed| posed.camera.camera_to_world).collect();
        *made_of.lock() = (Cow::Owned(found), Cow::Owned(seen));
        Ok(Some(poses))
    };
    let mut more = |side: u32| {
        let Sent { photos, upload, limits } = sent;
        if !photos.has_more() {
            return Ok(None);
        }
        let mut ready = |photo: &mut PosedPhoto| {
            unless_cancelled(watch.cancel)?;
            let (words, one) = (&options.ignore, std::slice::from_mut(photo));
            ignored::leave_out_words(engine, one, words, &options.method(), silent).map(drop)
        };
        spooled(upload, options.cameras, side, limits, None, &mut ready).map(Some)
    };
    let mut pace = |spent: f32| {
        (watch.progress)(Stage::Refine, spent);
        Ok(())
    };
    let mut best = None;
    let mut publish = |start: &Scene, version: &RefinedVersion| {
        best = Some(version_of(start, &scene, version)?);
        Ok(())
    };
    let found = refiner.run(|renderer| {
        let calls = RefineCalls {
            remake: &mut remake,
            recast: &mut recast,
            more: &mut more,
            pace: &mut pace,
            publish: &mut publish,
        };
        refined(renderer, &scene, photos, how, calls)
    })?;
    Ok(best.unwrap_or_else(|| {
        let mut scene = scene;
        scene.meta.report.refinement = Some(reported(photos.len(), &found.report));
        scene
    }))
}

/// A file of Gaussians becomes a scene file. No network is needed.
fn import(
    args: &Args,
    path: &Path,
    config: &Config,
    options: &SceneOptions,
    out: &Output,
) -> Result<()> {
    let begun = Instant::now();
    let file = fs_err::read(&args.photos).map_err(|e| unreadable(&args.photos, e))?;
    let sha256 = store::sha256(&file);
    // What the file has is kept.
    let options = SceneOptions { semantics: SemanticsMode::Lazy, ..options.clone() };
    let scene = splats_of(&mut &file[..], &args.photos, &config.limits)?.into_scene(&options)?;
    drop(file);
    let name = args.photos.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let provenance = store::provenance(vec![PhotoHash { file: name, sha256 }], &options, "");
    let (id, created_ms) = (id_of(&provenance), store::now_ms());
    let scene = Scene { meta: SceneMeta { id, created_ms, provenance, ..scene.meta }, ..scene };
    write(path, &scene)?;
    match &scene.semantics {
        _ if splat_format(path).is_some() => {}
        Some(made) => write_semantics_file(&semantics_path(path), &scene.meta.id, made)?,
        None => remove(&semantics_path(path))?,
    }
    describe(path, &scene, begun.elapsed().as_secs_f64() * 1e3, out)
}

/// The same files have the same id.
fn id_of(provenance: &Provenance) -> SceneId {
    let mut hash = Sha256::new();
    for file in &provenance.files {
        hash.update(format!("{} {}\n", file.sha256, file.file));
    }
    let mut id = [0; 16];
    id.copy_from_slice(&hash.finalize()[..16]);
    SceneId::from_bytes(id)
}

/// The photos of a folder or an archive, and the files that were read.
pub(super) fn read(
    path: &Path,
    mode: CamerasMode,
    config: &Config,
    cancel: &AtomicBool,
) -> Result<(ReadSet, Upload)> {
    if path.is_dir() {
        return pipeline::read_dir(path, mode, &config.limits, cancel);
    }
    let upload = file(path, config)?;
    Ok((pipeline::read(&upload, mode, &config.limits, cancel)?, upload))
}

/// The files of a folder or an archive that a scene is made of.
pub(super) fn upload(path: &Path, mode: CamerasMode, config: &Config) -> Result<Upload> {
    match path.is_dir() {
        true => read(path, mode, config, &AtomicBool::new(false)).map(|(_, upload)| upload),
        false => file(path, config),
    }
}

/// A video as photos, else an archive.
fn file(path: &Path, config: &Config) -> Result<Upload> {
    if video::is_video(path) {
        return video::photos(path);
    }
    let size = fs_err::metadata(path).map_err(|e| unreadable(path, e))?.len();
    let max = config.limits.upload_bytes_max;
    if size > max as u64 {
        return Err(Error::limit("upload bytes", size, max));
    }
    let archive = fs_err::read(path).map_err(|e| unreadable(path, e))?;
    Ok(Upload { archive: Some(archive), ..Upload::default() })
}

/// Removes the semantics of a scene that was replaced.
fn remove(path: &Path) -> Result<()> {
    match fs_err::remove_file(path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(unwritable(path, e)),
        _ => Ok(()),
    }
}

fn semantics(name: &str) -> Result<SemanticsMode, String> {
    match named(name) {
        Ok(SemanticsMode::Lazy) | Err(_) => Err("it must be eager or off".to_owned()),
        mode => mode,
    }
}

fn write(path: &Path, scene: &Scene) -> Result<()> {
    let Some(format) = splat_format(path) else { return write_scene_file(path, scene) };
    let semantics = scene.semantics.as_deref();
    write_splats(path, &scene_splats(format, scene, &scene.gaussians, semantics)?)
}

fn describe(path: &Path, scene: &Scene, total_ms: f64, out: &Output) -> Result<()> {
    let report = &scene.meta.report;
    let mut text = format!(
        "{}: {} Gaussians of {} in {total_ms:.0} ms\n",
        path.display(),
        report.gaussians,
        match &report.file_format {
            Some(format) => format!("a file ({format})"),
            None => format!("{} photos", report.views_used),
        }
    );
    let semantics = scene.semantics.as_ref().map(|semantics| &semantics.report);
    let of_semantics = semantics.iter().flat_map(|semantics| &semantics.stages);
    for stage in report.stages.iter().chain(of_semantics) {
        let _ = writeln!(text, "  {:<10}{:>9.1} ms", stage.stage, stage.ms);
    }
    if let Some(semantics) = semantics {
        let _ = writeln!(
            text,
            "  semantics: {} entries, {} Gaussians have one",
            semantics.bank_size, semantics.labelled
        );
    }
    if let Some(RefineReport { psnr_before, psnr_after, steps, .. }) = &report.refinement {
        let of =
            |psnr: &Option<f64>| psnr.map_or("unknown".to_owned(), |psnr| format!("{psnr:.2} dB"));
        let (before, after) = (of(psnr_before), of(psnr_after));
        let _ = writeln!(text, "  refined: {steps} steps, held-out photos {before} to {after}");
    }
    if let Some(confidence) = report.cameras.confidence {
        let placed = report.cameras.placed.len();
        let _ = writeln!(text, "  cameras: {placed} solved, confidence {confidence:.2}");
    }
    for warning in &report.warnings {
        let _ = writeln!(text, "  warning: {}", warning.message);
    }
    let value = json!({
        "output": path.display().to_string(),
        "id": scene.meta.id,
        "total_ms": total_ms,
        "report": report,
        "semantics": semantics,
        "cameras": scene.meta.cameras,
    });
    out.answer(&text, &value)
}
