//! Runs the stages of [`Stage`]: photos ▸ cameras ▸ capture ▸ geometry ▸ lift ▸ store.
//!
//! [`Pipeline`] holds what is opened once (library, bundle, sessions). [`read`] makes photos of an
//! upload, [`cameras::posed`] finds their cameras where they have none, [`reconstruct`] makes
//! Gaussians of photos, and the caller stores the scene, which is the stage [`Stage::Store`].
//! [`semantics`] makes the semantics of a scene.

pub mod cameras;
pub mod growth;
pub mod ignored;
mod loader;
pub mod masks;
mod networks;
pub mod refinement;
pub mod semantics;
mod sets;
pub mod words;

pub use self::{
    loader::PipelineLoader,
    sets::{PhotoSet, ReadSet, UnposedSet},
};

use std::{
    path::Path,
    sync::{Arc, atomic::AtomicBool},
    time::Instant,
};

use crate::{
    capture,
    error::{Error, ErrorCode, Result},
    lift::{self, FuseOptions, Fusion, UnionOptions},
    limits::Limits,
    meter,
    models::{
        Bundle, Geometry, GeometryInput, GeometryManifest, Network, NetworkOptions, Provider,
        Runtime,
    },
    photos::{self, ReadPhotos, ReadUnposed},
    refine::split,
    scene::{
        Backdrop, Camera, CamerasMode, CamerasReport, Capture, Density, Gaussians, HealthReport,
        Intrinsics, Method, PosedPhoto, Provenance, Scene, SceneCamera, SceneId, SceneMeta,
        SceneOptions, Stage, StageTime, Upload, ViewGaussians, ViewSet, Watch, unless_cancelled,
    },
};

/// Parts of a bundle that are networks of their own, where it has them, and that callers may run.
pub const NETWORKS: [&str; 7] = [
    "geometry",
    "geometry.many",
    "masks.encoder",
    "masks.decoder",
    "image_text.image",
    "image_text.text",
    "cameras",
];

/// Views that go through the geometry network together, where none are asked for: memory grows with
/// them, and scenes of many sets get no better in the mean (docs/adr/0034-many-photos.md).
const VIEWS_A_RUN: usize = 4;

/// Library, bundle, networks and threads that make scenes. All jobs share one.
#[derive(Debug)]
pub struct Pipeline {
    runtime: Arc<Runtime>,
    bundle: Bundle,
    geometry: Geometry,
    workers: rayon::ThreadPool,
    lazy: networks::LazyNetworks,
}

impl Pipeline {
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
        let geometry = Geometry::open(&runtime, &bundle, options)?;
        let workers = rayon::ThreadPoolBuilder::new()
            .num_threads(options.threads)
            .thread_name(|i| format!("pipeline-{i}"))
            .build()
            .map_err(|e| Error::internal("pipeline: no worker threads").caused_by(e))?;
        let lazy = networks::LazyNetworks::new(options);
        let pipeline = Self { runtime, bundle, geometry, workers, lazy };
        // A device takes seconds for its first run, so that no text should wait for it. It is also
        // where a provider that computes the semantics wrong is refused.
        if pipeline.geometry.provider() != Provider::Cpu
            && pipeline.bundle.lacks_semantics().is_none()
        {
            pipeline.masks()?;
            pipeline.image_text()?;
            if pipeline.bundle.text_masks().is_some() {
                pipeline.text_masks()?;
            }
        }
        Ok(pipeline)
    }

    /// Why a network is not computed where it was to be; `None` where all are.
    #[must_use]
    pub fn remark(&self) -> Option<String> {
        self.geometry.remark().or_else(|| self.lazy.remark())
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

    /// Does `work` with the network of this part of the bundle ([`BundleFile::part`]), which is
    /// opened if it is not yet.
    ///
    /// # Errors
    /// `not_found` where no network has that name, `model_unavailable` where the bundle has none or
    /// it does not open, and those of `work`.
    ///
    /// [`BundleFile::part`]: crate::models::BundleFile::part
    pub fn with_network<T>(
        &self,
        part: &str,
        work: impl FnOnce(&Network) -> Result<T>,
    ) -> Result<T> {
        match part {
            "masks.encoder" => work(self.masks()?.encoder()),
            "masks.decoder" => work(self.masks()?.decoder()),
            "image_text.image" => work(self.image_text()?.image_tower()),
            "image_text.text" => work(self.image_text()?.text_tower()),
            "cameras" => work(self.cameras()?.network()),
            _ => match self.geometry.network(part) {
                Some(network) => work(network),
                None => Err(Error::new(ErrorCode::NotFound, "no network of this name")),
            },
        }
    }

    /// Threads for the stages outside the network.
    #[must_use]
    pub fn workers(&self) -> &rayon::ThreadPool {
        &self.workers
    }

    /// Does `work` on these threads; on those of the caller where it is one of a pool, such as that
    /// of refinements on a processor, before which all else goes.
    fn on_workers<T: Send>(&self, work: impl FnOnce() -> T + Send) -> T {
        on_pool(&self.workers, work)
    }
}

fn on_pool<T: Send>(workers: &rayon::ThreadPool, work: impl FnOnce() -> T + Send) -> T {
    match rayon::current_thread_index() {
        Some(_) => work(),
        None => workers.install(work),
    }
}

/// What the stages make of photos. With an id and a provenance it is a [`Scene`].
#[derive(Clone, Debug)]
pub struct Reconstruction {
    /// The Gaussians, world frame.
    pub gaussians: Gaussians,
    /// The photos' colours by direction, behind everything.
    pub backdrop: Backdrop,
    /// Counts, times and warnings.
    pub report: HealthReport,
    /// The photos' files and cameras, undistorted pixels, in the photos' order.
    pub cameras: Vec<SceneCamera>,
}

impl Reconstruction {
    /// The scene of this id, created at `created_ms` (milliseconds since 1970).
    #[must_use]
    pub fn into_scene(self, id: SceneId, created_ms: u64, provenance: Provenance) -> Scene {
        let Self { gaussians, backdrop, report, cameras } = self;
        Scene::new(SceneMeta { id, created_ms, cameras, report, provenance }, gaussians, backdrop)
    }
}

/// Reads an upload: the stage [`Stage::Photos`].
///
/// # Errors
/// `invalid_request`, `photo_unreadable`, `limit_exceeded`, each names photo, value and bound;
/// `cancelled`.
pub fn read(
    upload: &Upload,
    mode: CamerasMode,
    limits: &Limits,
    cancel: &AtomicBool,
) -> Result<ReadSet> {
    let begun = Instant::now();
    let set = match photos::read_unposed(upload, mode, limits, cancel)? {
        Some(read) => unposed(read, begun),
        None => given(photos::read_until(upload, limits, cancel)?, begun),
    };
    Ok(set)
}

/// Reads a folder: as [`read`], and the files that were read as an upload.
///
/// # Errors
/// As [`read`].
pub fn read_dir(
    dir: &Path,
    mode: CamerasMode,
    limits: &Limits,
    cancel: &AtomicBool,
) -> Result<(ReadSet, Upload)> {
    let begun = Instant::now();
    if let Some((read, upload)) = photos::read_unposed_dir(dir, mode, limits, cancel)? {
        return Ok((unposed(read, begun), upload));
    }
    let (read, upload) = photos::read_dir_until(dir, limits, cancel)?;
    Ok((given(read, begun), upload))
}

fn given(read: ReadPhotos, begun: Instant) -> ReadSet {
    let ReadPhotos { photos, warnings, unit } = read;
    let mut set = PhotoSet::given(photos, warnings, took_to_read(begun));
    set.cameras.unit = unit;
    ReadSet::Posed(set)
}

fn unposed(read: ReadUnposed, begun: Instant) -> ReadSet {
    let ReadUnposed { photos, warnings } = read;
    ReadSet::Unposed(UnposedSet { photos, warnings, read_ms: took_to_read(begun) })
}

fn took_to_read(begun: Instant) -> f64 {
    let ms = begun.elapsed().as_secs_f64() * 1e3;
    meter::stage(Stage::Photos.name(), ms / 1e3);
    ms
}

/// The stages from posed photos to Gaussians, the times of those before in the report.
///
/// # Errors
/// As [`reconstruct`].
pub fn make(
    pipeline: &Pipeline,
    photos: &PhotoSet,
    options: &SceneOptions,
    watch: Watch<'_>,
) -> Result<Reconstruction> {
    let made = reconstruct(pipeline, &photos.photos, options, watch.progress, watch.cancel)?;
    Ok(with_reading(made, photos))
}

/// A reconstruction whose report has the stages before it, and where the cameras come from.
fn with_reading(mut made: Reconstruction, photos: &PhotoSet) -> Reconstruction {
    made.report.stages.splice(0..0, photos.stages.iter().cloned());
    made.report.cameras = photos.cameras.clone();
    made.report.warnings.splice(0..0, photos.warnings.iter().cloned());
    made
}

/// What the network said of photos: Gaussians are united of it again, without some of the photos
/// or as one set, and it need not run for that.
#[derive(Clone, Debug)]
pub struct Seen {
    views: Vec<ViewGaussians>,
    capture: Capture,
    sets: Vec<ViewSet>,
    method: Method,
    stages: Vec<StageTime>,
}

impl Seen {
    /// Bytes of its Gaussians.
    #[must_use]
    pub fn size_bytes(&self) -> u64 {
        let of = |view: &ViewGaussians| {
            let valid = view.valid.as_ref().map_or(0, Vec::len);
            // Mean, scales, quaternion, opacity and confidence.
            view.len() * 4 * (3 + 3 + 4 + 1 + 1) + 12 * view.sh.len() + valid
        };
        self.views.iter().map(|view| of(view) as u64).sum()
    }
}

/// As [`make`], and what the network said of the photos.
///
/// # Errors
/// As [`reconstruct`].
pub fn make_keeping(
    pipeline: &Pipeline,
    photos: &PhotoSet,
    options: &SceneOptions,
    watch: Watch<'_>,
) -> Result<(Reconstruction, Seen)> {
    let seen = see(pipeline, &photos.photos, options, watch)?;
    let made = united(pipeline, &photos.photos, seen.clone(), watch)?;
    Ok((with_reading(made, photos), seen))
}

/// The scene of `photos` less those of the numbers `held`, and the same as one set that agrees
/// (`front_photos` = 0), with which refinement begins; `seen` is what the network said of them all.
///
/// # Errors
/// As [`reconstruct`].
pub fn make_for_refinement(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    held: &[usize],
    seen: &Seen,
    watch: Watch<'_>,
) -> Result<(Reconstruction, Gaussians)> {
    let (kept, _) = split(photos, held);
    let mut seen = seen.clone();
    seen.views.retain(|view| !held.contains(&usize::from(view.photo)));
    for view in &mut seen.views {
        let before = held.iter().filter(|&&i| i < usize::from(view.photo)).count();
        view.photo -= u16::try_from(before).unwrap_or_default();
    }
    let layered = matches!(fusing(&seen.method), Fusion::Layers(_));
    let views = if layered { seen.views.clone() } else { Vec::new() };
    let made = united(pipeline, &kept, seen, watch)?;
    let one_set = match layered {
        true => {
            let fusion = Fusion::OneSet(UnionOptions::default());
            lifted(pipeline, &kept, views, &made.report.method, &fusion, watch)?.gaussians
        }
        false => made.gaussians.clone(),
    };
    Ok((made, one_set))
}

/// Photos to Gaussians. `progress` gets each stage with its fraction, 0 to 1; the loops of each
/// stage look at `cancel`.
///
/// # Errors
/// `invalid_request` when the capture cannot be reconstructed, `cancelled`, or `internal`.
pub fn reconstruct(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    options: &SceneOptions,
    progress: &(dyn Fn(Stage, f32) + Sync),
    cancel: &AtomicBool,
) -> Result<Reconstruction> {
    let watch = Watch { progress, cancel };
    united(pipeline, photos, see(pipeline, photos, options, watch)?, watch)
}

/// The stages from photos to what the network says of them.
fn see(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    options: &SceneOptions,
    watch: Watch<'_>,
) -> Result<Seen> {
    let mut stages = Stages::new(watch);
    let manifest = pipeline.geometry.manifest();
    let views = views_of(manifest, options, photos.len())?;
    let method = options.method();
    method.check()?;
    if photos.len() < manifest.views_min {
        return Err(Error::invalid(format!(
            "{} photos; the geometry network of this bundle takes at least {}",
            photos.len(),
            manifest.views_min
        )));
    }
    let (capture, sets) = stages.run(Stage::Capture, || {
        pipeline.on_workers(|| {
            let capture = capture::analyse(photos, watch.cancel)?;
            let sets = capture::view_sets(&capture, photos, views, manifest.neighbors_max);
            Ok((capture, sets))
        })
    })?;
    let views =
        stages.run(Stage::Geometry, || of_sets(pipeline, photos, &capture, &sets, watch))?;
    Ok(Seen { views, capture, sets, method, stages: stages.times })
}

/// What the network says of sets of photos, one set after the other.
fn of_sets(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    capture: &Capture,
    sets: &[ViewSet],
    watch: Watch<'_>,
) -> Result<Vec<ViewGaussians>> {
    let mut views = Vec::new();
    for (done, set) in sets.iter().enumerate() {
        unless_cancelled(watch.cancel)?;
        (watch.progress)(Stage::Geometry, fraction(done, sets.len()));
        let input = GeometryInput {
            photos,
            views: &set.views,
            near_far: &capture.near_far,
            median_depth: capture.median_depth,
            neighbors: &set.neighbors,
        };
        views.extend(pipeline.geometry.run(&input)?);
    }
    Ok(views)
}

/// One scene of what the network said of its photos.
fn united(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    seen: Seen,
    watch: Watch<'_>,
) -> Result<Reconstruction> {
    let Seen { views, capture, sets, method, stages: before } = seen;
    let mut stages = Stages { watch, times: before };
    let (lifted, backdrop) = stages.run(Stage::Lift, || {
        let fusion = fusing(&method);
        let backdrop = || match method.backdrop {
            true => lift::backdrop(photos),
            false => Backdrop::default(),
        };
        let lift = || lifted(pipeline, photos, views, &method, &fusion, watch);
        let (lifted, backdrop) = pipeline.on_workers(|| rayon::join(lift, backdrop));
        Ok((lifted?, backdrop))
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
        file_format: None,
        antialiased: false,
        method,
        cameras: CamerasReport::default(),
        views_used: count(used(&sets, photos.len())),
        gaussians: lifted.gaussians.len() as u64,
        dropped: lifted.dropped,
        depth_range: depth_range(&capture),
        median_depth: lifted.median_depth,
        overlap: mean_best_overlap(&capture),
        network_focal_px: lifted.lenses.iter().map(focal).collect(),
        stages: stages.times,
        execution_provider: pipeline.geometry.provider().name().to_owned(),
        refinement: None,
        warnings: capture.warnings,
    };
    Ok(Reconstruction { gaussians: lifted.gaussians, backdrop, report, cameras })
}

/// The Gaussians of what the network said of photos.
fn lifted(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    views: Vec<ViewGaussians>,
    method: &Method,
    fusion: &Fusion,
    watch: Watch<'_>,
) -> Result<lift::Lifted> {
    let thinning = match method.density {
        Density::Thinned => Some(lift::ThinOptions::default()),
        Density::Full => None,
    };
    let cameras: Vec<Camera> = photos.iter().map(|photo| photo.camera).collect();
    pipeline.on_workers(|| {
        lift::lift(views, &cameras, method.prune, fusion, thinning.as_ref(), watch.cancel)
    })
}

/// The stages of one job. Each is reported and timed. None begins after the job is cancelled.
struct Stages<'a> {
    watch: Watch<'a>,
    times: Vec<StageTime>,
}

impl<'a> Stages<'a> {
    fn new(watch: Watch<'a>) -> Self {
        Self { watch, times: Vec::new() }
    }

    fn run<T>(&mut self, stage: Stage, work: impl FnOnce() -> Result<T>) -> Result<T> {
        unless_cancelled(self.watch.cancel)?;
        let _span = tracing::info_span!("stage", stage = stage.name()).entered();
        (self.watch.progress)(stage, 0.0);
        let start = Instant::now();
        let done = work()?;
        let ms = start.elapsed().as_secs_f64() * 1e3;
        meter::stage(stage.name(), ms / 1e3);
        self.times.push(StageTime { stage: stage.name().to_owned(), ms });
        (self.watch.progress)(stage, 1.0);
        Ok(done)
    }
}

/// The fewest and the most views of a set of a scene of so many photos.
fn views_of(
    manifest: &GeometryManifest,
    options: &SceneOptions,
    photos: usize,
) -> Result<[usize; 2]> {
    let range = [manifest.views_min.max(2), manifest.views_max];
    let one_set = manifest.many.is_some() && photos <= manifest.views_max;
    Ok([manifest.views_min, views_max(options.max_views, range, one_set)?])
}

/// Views the network takes at once: the caller's wish, within what the network can. Where there is
/// none, a scene may be `one_set` if the network has weights for as many views as it has photos.
fn views_max(wish: Option<usize>, [least, most]: [usize; 2], one_set: bool) -> Result<usize> {
    match wish {
        None if one_set => Ok(most),
        None => Ok(most.min(VIEWS_A_RUN.max(least))),
        Some(wish) if (least..=most).contains(&wish) => Ok(wish),
        Some(wish) => Err(Error::invalid(format!(
            "max_views is {wish}; this network takes {least} to {most} views at once"
        ))),
    }
}

/// Where views put no photos in front, the Gaussians of all photos are one set that agrees.
fn fusing(method: &Method) -> Fusion {
    match (method.fuse_layers as usize, method.front_photos) {
        (0, _) => Fusion::Layers(FuseOptions { layers: usize::MAX, ..FuseOptions::default() }),
        (_, 0) => Fusion::OneSet(UnionOptions::default()),
        (layers, _) => Fusion::Layers(FuseOptions { layers, ..FuseOptions::default() }),
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

#[cfg(test)]
mod tests {
    use super::{on_pool, views_max};

    #[test]
    fn a_caller_of_a_pool_keeps_its_threads() {
        let pool = |threads| rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let (workers, own) = (pool(3), pool(2));
        let threads = || on_pool(&workers, rayon::current_num_threads);
        assert_eq!([threads(), own.install(threads)], [3, 2]);
    }

    #[test]
    fn views_at_once_are_a_wish_or_the_whole_scene_or_four() {
        let of = |wish, range, one_set| views_max(wish, range, one_set).ok();
        assert_eq!(of(None, [2, 8], false), Some(4));
        assert_eq!(of(None, [2, 8], true), Some(8));
        assert_eq!(of(None, [2, 3], false), Some(3));
        assert_eq!(of(None, [6, 6], false), Some(6));
        assert_eq!(of(Some(5), [2, 8], true), Some(5));
        assert_eq!((of(Some(1), [2, 8], false), of(Some(9), [2, 8], true)), (None, None));
    }
}
