//! The order of the stages: photos ▸ capture ▸ geometry ▸ lift ▸ store.
//!
//! [`Engine`] holds what is opened once (library, bundle, sessions); [`reconstruct`] is the list of
//! stages from photos to Gaussians, [`make`] the same from an upload. The caller stores the scene,
//! under the stage name [`Stage::Store`]. What the scene means comes when somebody asks, or at
//! once: [`semantics`].

mod late;
pub mod masks;
pub mod semantics;

pub use self::late::LateEngine;

use std::{
    fmt,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Instant,
};

use crate::{
    capture,
    error::{Error, ErrorCode, Result},
    lift,
    limits::Limits,
    meter,
    models::{Bundle, Geometry, GeometryInput, NetworkOptions, Runtime},
    photos,
    scene::{
        Backdrop, Camera, Capture, Density, Gaussians, HealthReport, Intrinsics, PosedPhoto,
        SceneCamera, SceneOptions, StageTime, Upload, ViewSet,
    },
};

/// A stage of making a scene, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stage {
    /// The upload becomes undistorted photos with cameras.
    Photos,
    /// Depth ranges, overlap and diagnosis from the photos themselves.
    Capture,
    /// The geometry network.
    Geometry,
    /// One scene of what the network said of each photo.
    Lift,
    /// The scene goes to the store.
    Store,
}

impl Stage {
    /// All stages, in order.
    pub const ALL: [Self; 5] =
        [Self::Photos, Self::Capture, Self::Geometry, Self::Lift, Self::Store];

    /// Name in events and reports.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Photos => "photos",
            Self::Capture => "capture",
            Self::Geometry => "geometry",
            Self::Lift => "lift",
            Self::Store => "store",
        }
    }
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// What every scene is made with; opened once, shared by all jobs.
#[derive(Debug)]
pub struct Engine {
    runtime: Arc<Runtime>,
    bundle: Bundle,
    geometry: Geometry,
    workers: rayon::ThreadPool,
    lazy: semantics::LazyNetworks,
}

impl Engine {
    /// Finds, checks and opens library, bundle and network.
    ///
    /// # Errors
    /// `model_unavailable` when library or bundle is missing or differs from its manifest.
    pub fn open(options: &NetworkOptions) -> Result<Self> {
        Self::open_bundle(&Bundle::named(options)?, options)
    }

    /// The same for a bundle whose manifest was read.
    fn open_bundle(bundle: &Bundle, options: &NetworkOptions) -> Result<Self> {
        // Both are read whole and hashed: side by side they take half as long.
        let (verified, runtime) = rayon::join(|| bundle.verify(), || Runtime::load(options));
        verified?;
        let (bundle, runtime) = (bundle.clone(), runtime?);
        let geometry = Geometry::open(Arc::clone(&runtime), &bundle, options)?;
        let workers = rayon::ThreadPoolBuilder::new()
            .num_threads(options.threads)
            .thread_name(|i| format!("pipeline-{i}"))
            .build()
            .map_err(|e| Error::internal("pipeline: no worker threads").caused_by(e))?;
        let lazy = semantics::LazyNetworks::new(options);
        Ok(Self { runtime, bundle, geometry, workers, lazy })
    }

    /// The library.
    #[must_use]
    pub fn runtime(&self) -> &Runtime {
        &self.runtime
    }

    /// The bundle.
    #[must_use]
    pub fn bundle(&self) -> &Bundle {
        &self.bundle
    }

    /// The geometry network.
    #[must_use]
    pub fn geometry(&self) -> &Geometry {
        &self.geometry
    }

    /// Threads for the stages outside the network.
    #[must_use]
    pub fn workers(&self) -> &rayon::ThreadPool {
        &self.workers
    }
}

/// A scene, made.
#[derive(Clone, Debug)]
pub struct Reconstruction {
    /// The Gaussians, world frame.
    pub gaussians: Gaussians,
    /// The photos' colours by direction, behind everything.
    pub backdrop: Backdrop,
    /// What the scene says of itself.
    pub report: HealthReport,
    /// The photos' files and cameras, undistorted pixels, in the photos' order.
    pub cameras: Vec<SceneCamera>,
}

/// Refuses an upload whose photos or cameras cannot be read, without making anything.
///
/// # Errors
/// `invalid_request`, `photo_unreadable`, `limit_exceeded`; each names photo, value and bound.
pub fn check(upload: &Upload, limits: &Limits) -> Result<()> {
    photos::read(upload, limits).map(drop)
}

/// An upload to Gaussians: reads the photos, then as [`reconstruct`].
///
/// # Errors
/// As [`check`] and [`reconstruct`].
pub fn make(
    engine: &Engine,
    upload: &Upload,
    limits: &Limits,
    options: &SceneOptions,
    progress: &(dyn Fn(Stage, f32) + Sync),
    cancel: &AtomicBool,
) -> Result<Reconstruction> {
    let mut run = Run { progress, cancel, times: Vec::new() };
    let photos =
        run.stage(Stage::Photos, |_| engine.workers.install(|| photos::read(upload, limits)))?;
    finish(engine, &photos, options, run)
}

/// Photos to Gaussians. `progress` gets each stage with its fraction, 0 to 1; `cancel` is looked at
/// between stages and between runs of the network.
///
/// # Errors
/// `invalid_request` when the capture cannot be reconstructed, `cancelled`, or `internal`.
pub fn reconstruct(
    engine: &Engine,
    photos: &[PosedPhoto],
    options: &SceneOptions,
    progress: &(dyn Fn(Stage, f32) + Sync),
    cancel: &AtomicBool,
) -> Result<Reconstruction> {
    finish(engine, photos, options, Run { progress, cancel, times: Vec::new() })
}

/// The stages after the photos.
fn finish(
    engine: &Engine,
    photos: &[PosedPhoto],
    options: &SceneOptions,
    mut run: Run<'_>,
) -> Result<Reconstruction> {
    let cameras: Vec<Camera> = photos.iter().map(|photo| photo.camera).collect();
    let manifest = engine.geometry.manifest();
    let views_max = views_max(options, manifest.views_min, manifest.views_max)?;

    let (capture, sets) = run.stage(Stage::Capture, |_| {
        engine.workers.install(|| {
            let capture = capture::analyse(photos)?;
            let sets = capture::view_sets(&capture, photos, views_max, manifest.neighbors_max);
            Ok((capture, sets))
        })
    })?;
    let views = run.stage(Stage::Geometry, |run| {
        let mut views = Vec::new();
        for (done, set) in sets.iter().enumerate() {
            run.check()?;
            (run.progress)(Stage::Geometry, fraction(done, sets.len()));
            let input = GeometryInput {
                photos,
                views: &set.views,
                near_far: &capture.near_far,
                neighbors: &set.neighbors,
            };
            views.extend(engine.geometry.run(&input)?);
        }
        Ok(views)
    })?;
    let (lifted, backdrop) = run.stage(Stage::Lift, |_| {
        engine.workers.install(|| {
            let thinning = match options.density {
                Density::Thinned => Some(lift::ThinOptions::default()),
                Density::Full => None,
            };
            let fusing = lift::FuseOptions::default();
            let lifted = lift::lift(views, &cameras, &fusing, thinning.as_ref())?;
            Ok((lifted, lift::backdrop(photos)))
        })
    })?;

    let cameras = photos
        .iter()
        .zip(&lifted.lenses)
        .map(|(photo, &network)| SceneCamera {
            file: photo.file.clone(),
            camera: photo.camera,
            network,
        })
        .collect();
    let focal = |lens: &Option<Intrinsics>| lens.map_or(0.0, |lens| lens.fx.min(lens.fy));
    let report = HealthReport {
        photos: count(photos.len()),
        views_used: count(used(&sets, photos.len())),
        gaussians: lifted.gaussians.len() as u64,
        dropped: lifted.dropped,
        depth_range: depth_range(&capture),
        median_depth: lifted.median_depth,
        overlap: mean_best_overlap(&capture),
        network_focal_px: lifted.lenses.iter().map(focal).collect(),
        stages: run.times,
        execution_provider: engine.geometry.provider().name().to_owned(),
        warnings: capture.warnings,
    };
    Ok(Reconstruction { gaussians: lifted.gaussians, backdrop, report, cameras })
}

/// One scene on its way: reports, times and stops it.
struct Run<'a> {
    progress: &'a (dyn Fn(Stage, f32) + Sync),
    cancel: &'a AtomicBool,
    times: Vec<StageTime>,
}

impl Run<'_> {
    fn stage<T>(&mut self, stage: Stage, work: impl FnOnce(&Self) -> Result<T>) -> Result<T> {
        self.check()?;
        let _span = tracing::info_span!("stage", stage = stage.name()).entered();
        (self.progress)(stage, 0.0);
        let start = Instant::now();
        let done = work(self)?;
        let ms = start.elapsed().as_secs_f64() * 1e3;
        meter::stage(stage.name(), ms / 1e3);
        self.times.push(StageTime { stage: stage.name().to_owned(), ms });
        (self.progress)(stage, 1.0);
        Ok(done)
    }

    fn check(&self) -> Result<()> {
        if self.cancel.load(Ordering::Relaxed) {
            return Err(Error::new(ErrorCode::Cancelled, "the scene was cancelled"));
        }
        Ok(())
    }
}

/// Views the network takes at once: the caller's wish, within what the network can.
fn views_max(options: &SceneOptions, least: usize, most: usize) -> Result<usize> {
    match options.max_views {
        None => Ok(most),
        Some(wish) if (least.max(2)..=most).contains(&wish) => Ok(wish),
        Some(wish) => Err(Error::invalid(format!(
            "max_views is {wish}; this network takes {} to {most} views at once",
            least.max(2)
        ))),
    }
}

fn fraction(done: usize, all: usize) -> f32 {
    done as f32 / all.max(1) as f32
}

fn count(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}

/// Photos that are in some set.
fn used(sets: &[ViewSet], photos: usize) -> usize {
    (0..photos).filter(|i| sets.iter().any(|set| set.views.contains(i))).count()
}

/// Smallest near and largest far of all photos.
fn depth_range(capture: &Capture) -> [f64; 2] {
    let start = [f64::INFINITY, 0.0];
    let [near, far] = capture.near_far.iter().fold(start, |[n, f], &[a, b]| [n.min(a), f.max(b)]);
    if near.is_finite() { [near, far] } else { [0.0, 0.0] }
}

/// Mean over photos of the overlap with the best partner.
fn mean_best_overlap(capture: &Capture) -> f64 {
    let best = capture.overlap.iter().enumerate().map(|(i, row)| {
        let others = row.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, &share)| share);
        others.fold(0.0, f64::max)
    });
    let all: Vec<f64> = best.collect();
    if all.is_empty() { 0.0 } else { all.iter().sum::<f64>() / all.len() as f64 }
}
