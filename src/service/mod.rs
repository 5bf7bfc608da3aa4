//! The use cases: create, look up, list, delete, watch, render, export. No transport's words.
//!
//! [`Service`] is a cheap clone; its calls are async and never do heavy work on the async threads.

mod access;
mod camera;
mod create;
mod encode;
mod export;
mod features;
mod folder;
mod infer;
mod memory;
mod offline;
mod page;
mod pick;
mod query;
mod refine;
mod request;
mod schedule;
mod search;
mod semantics;
mod tags;
mod tasks;
mod texts;
mod times;
mod types;
mod view;
mod work;

use std::{fmt, sync::Arc};

use futures_util::{Stream, stream};
use tokio::sync::{Semaphore, watch};

pub use self::export::scene_splats;
pub use self::infer::InferSpec;
pub use self::memory::Share;
pub use self::page::{VIEWER, ViewerPage};
pub(crate) use self::refine::check_refine;
use self::{memory::Memory, schedule::Scheduler, search::Backend};
pub use self::{
    offline::OfflineService,
    request::{
        BackgroundSpec, Boxes, CameraFields, CameraSpec, CreateScene, FeatureKind, FeaturesSpec,
        Format, Kind, LensSpec, MaskFormat, PageRequest, PickSpec, PictureOptions, PoseSpec,
        QuerySpec, ScoringOptions, TextOptions, ViewOptions, ViewSpec, ViewsSpec,
    },
    times::ViewTimes,
    types::{
        CallerLimits, Created, Export, ExportBody, ExportPlace, InstanceBox, KnownWord, Label,
        ModelInfo, ModelsInfo, Page, Peak, Picked, QueryAnswer, Readiness, RenderedView,
        TextResult, TextView, TextWarning, Trust,
    },
};
pub use crate::formats::{rle::Rle, table::ExportFormat};
pub use crate::render::{Quality, plan::default_near};
pub use crate::scene::{
    Density, Event, MaskLevel, Method, Preset, SceneCamera, SceneError, SceneOptions, SceneState,
    SceneStatus, SemanticsMode, SemanticsState, SemanticsStatus, Upload, UploadCameras, UploadFile,
};
use crate::{
    config::Config,
    error::{Error, ErrorCode, Result},
    jobs::{JobParts, Jobs, NetworkState, SceneNetworks, SemanticNetworks, refiner},
    keys::Caller,
    limits::{Limits, LiveLimits},
    render::Renderer,
    scene::{Refine, SceneId, Stage},
    store::{Place, Record, Store},
};

/// Uploads decoded at the same time: each may hold `limits.photos_max` photos in memory.
const UPLOADS_READ_MAX: usize = 2;

/// The use cases, for one caller. Cloning shares everything.
///
/// A scene that the caller may not see is in no way different from one that does not exist.
#[derive(Clone, Debug)]
pub struct Service {
    inner: Arc<Inner>,
    caller: Caller,
}

/// What the service works with.
#[derive(Clone)]
pub struct Parts {
    /// Make scenes of photos.
    pub scenes: Arc<dyn SceneNetworks>,
    /// Make semantics of scenes, and embeddings of texts.
    pub semantics: Arc<dyn SemanticNetworks>,
    /// Draws views of scenes.
    pub renderer: Arc<dyn Renderer>,
    /// What `/v1/models` says; the renderer and the version are filled in.
    pub models: ModelsInfo,
}

impl fmt::Debug for Parts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Parts").field("renderer", &self.renderer.name()).finish_non_exhaustive()
    }
}

struct Inner {
    config: Config,
    /// Caps in force: those of the configuration, or newer ones. The jobs have the same.
    limits: Arc<LiveLimits>,
    store: Arc<Store>,
    jobs: Arc<Jobs>,
    /// Networks that run by themselves; the jobs have the same.
    networks: Arc<dyn SceneNetworks>,
    backend: Arc<Backend>,
    models: ModelsInfo,
    scheduler: Arc<Scheduler>,
    /// Permits to decode uploads.
    reading: Arc<Semaphore>,
    /// Permits to write folders.
    folders: Arc<Semaphore>,
    /// Permits to run networks.
    inferences: Arc<Semaphore>,
    key_locks: [tokio::sync::Mutex<()>; create::KEY_LOCKS],
    memory: Memory,
    /// Whether callers who wait for what is being made are answered at once.
    stopping: watch::Sender<bool>,
}

impl fmt::Debug for Inner {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Inner").field("config", &self.config).finish_non_exhaustive()
    }
}

impl Inner {
    fn limits(&self) -> Arc<Limits> {
        self.limits.get()
    }

    /// Resolves when nobody waits any more for what is being made.
    async fn stopped_waiting(&self) {
        // The sender lives as long as `self`.
        let _ = self.stopping.subscribe().wait_for(|&stopping| stopping).await;
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        self.jobs.shut_down();
    }
}

impl Service {
    /// Opens the store at `place`, queues unfinished jobs again and starts the workers. Blocks on
    /// the store.
    ///
    /// # Errors
    /// `store_unavailable` when the store cannot be used.
    pub fn open(place: &Place, config: Config, parts: Parts) -> Result<Self> {
        let (store, records) = Store::open(place, &config.limits)?;
        let store = Arc::new(store);
        let scheduler = Scheduler::new(parts.renderer.concurrency(), &config.limits);
        let views = Arc::clone(&scheduler);
        let device = Arc::clone(&parts.renderer).differentiable();
        let refine = match config.refine {
            // It takes all processors for a minute after each scene, so it is for calls that ask.
            Refine::Auto if device.is_none() => Refine::Off,
            how => how,
        };
        let refiner = refiner(device, config.threads)?;
        let networks = Arc::clone(&parts.scenes);
        let limits = Arc::new(LiveLimits::new(config.limits.clone()));
        let job_parts = JobParts {
            store: Arc::clone(&store),
            scenes: parts.scenes,
            semantics: Arc::clone(&parts.semantics),
            limits: Arc::clone(&limits),
            workers: config.workers(),
            keep_photos: config.keep_photos,
            refine,
            renderer: Arc::clone(&parts.renderer),
            refiner,
            threads: config.threads,
            drawn: Box::new(move || views.idle()),
        };
        let jobs = Jobs::start(job_parts, records)?;
        let models = ModelsInfo {
            renderer: parts.renderer.name(),
            server_version: env!("CARGO_PKG_VERSION").to_owned(),
            ..parts.models
        };
        let inner = Inner {
            store,
            jobs,
            networks,
            scheduler,
            backend: Arc::new(Backend::new(parts.renderer, parts.semantics, &config.limits)),
            models,
            reading: Arc::new(Semaphore::new(UPLOADS_READ_MAX)),
            folders: Arc::new(Semaphore::new(config.limits.folder_exports_max)),
            inferences: Arc::new(Semaphore::new(config.limits.inferences_max)),
            key_locks: Default::default(),
            memory: Memory::new(config.limits.memory_bytes_max),
            stopping: watch::Sender::default(),
            limits,
            config,
        };
        Ok(Self { inner: Arc::new(inner), caller: Caller::All })
    }

    /// The same service for another caller.
    pub fn for_caller(&self, caller: Caller) -> Self {
        Self { inner: Arc::clone(&self.inner), caller }
    }

    /// The caps in force.
    pub fn limits(&self) -> Arc<Limits> {
        self.inner.limits()
    }

    /// The configuration of the start.
    pub fn config(&self) -> &Config {
        &self.inner.config
    }

    /// Puts other caps in force; names those that only the next start can follow.
    pub fn reload(&self, limits: Limits) -> Vec<&'static str> {
        self.inner.limits.reload(limits)
    }

    /// The status of a scene, with its report and cameras once done.
    ///
    /// # Errors
    /// `scene_not_found`.
    pub async fn get(&self, id: &SceneId) -> Result<SceneStatus> {
        Ok(self.shown(self.scene(id).await?.record().status.clone()))
    }

    /// A page of scenes, newest first, without cameras.
    ///
    /// # Errors
    /// `invalid_request` when `limit` is out of range or `after` not a `next` of an earlier page.
    pub async fn list(&self, page: &PageRequest) -> Result<Page> {
        let max = self.limits().page_max;
        let limit = match page.limit {
            Some(limit) if !(1..=max).contains(&limit) => {
                return Err(Error::invalid(format!("limit is {limit}; it must be 1 to {max}")));
            }
            Some(limit) => limit,
            None => max,
        };
        let after = page.after.as_deref().map(parse_cursor).transpose()?;
        let inner = Arc::clone(&self.inner);
        if inner.store.is_shared() {
            tasks::blocking(move || inner.jobs.refresh_all()).await??;
        }
        let (records, more) = self
            .inner
            .jobs
            .records
            .page(after, limit, |record| self.caller.sees(record.owner.as_deref()));
        let next = records.last().filter(|_| more).map(|last| cursor(last));
        let without_cameras = |record: &Arc<Record>| {
            self.shown(SceneStatus { cameras: Vec::new(), ..record.status.clone() })
        };
        Ok(Page { scenes: records.iter().map(without_cameras).collect(), next })
    }

    /// Stops the scene's job if it has one and removes everything kept of it.
    ///
    /// # Errors
    /// `scene_not_found`, `store_unavailable`.
    pub async fn delete(&self, id: &SceneId) -> Result<()> {
        let scene = self.scene(id).await?;
        let (inner, gone) = (Arc::clone(&self.inner), scene.id().clone());
        tasks::blocking(move || inner.jobs.delete(&gone)).await?
    }

    /// What happens to a scene, from its present state to the last event, or until the server
    /// stops.
    ///
    /// # Errors
    /// `scene_not_found`.
    pub async fn watch(&self, id: &SceneId) -> Result<impl Stream<Item = Event> + Send + use<>> {
        let watcher = self.inner.jobs.watch(self.scene(id).await?.id())?;
        let service = self.clone();
        let first = Some((service, watcher, None));
        Ok(stream::unfold(first, async |state| {
            let (service, mut watcher, before) = state?;
            loop {
                if before.is_some() {
                    tokio::select! {
                        changed = watcher.changed() => changed.ok()?,
                        () = service.inner.stopped_waiting() => return None,
                    }
                }
                let status = watcher.borrow_and_update().status.clone();
                let event = match service.event(&status) {
                    Event::Done if before.as_ref().is_some_and(is_version) => {
                        let fraction = status.refinement.fraction;
                        Event::Version { version: status.version, fraction }
                    }
                    event => event,
                };
                // How far a refinement is, is told with the next version, or with its end.
                let goes_on = status.is_refined_now();
                if goes_on && before.as_ref().is_some_and(|before| same_version(before, &event)) {
                    continue;
                }
                let last = event.is_last() || is_version(&event);
                let next = (!last || goes_on).then(|| (service, watcher, Some(event.clone())));
                return Some((event, next));
            }
        }))
    }

    /// From now on nobody waits for what is being made: calls that do are answered with what there
    /// is.
    pub fn stop_waiting(&self) {
        self.inner.stopping.send_replace(true);
    }

    fn event(&self, status: &SceneStatus) -> Event {
        let semantics = &status.semantics;
        match status.state {
            SceneState::Done if semantics.state == SemanticsState::Running => Event::Running {
                stage: semantics
                    .stage
                    .clone()
                    .unwrap_or_else(|| Stage::SEMANTICS[0].name().to_owned()),
                fraction: semantics.fraction,
            },
            SceneState::Queued => {
                Event::Queued { ahead: self.inner.jobs.ahead(&status.id).unwrap_or(0) }
            }
            SceneState::Running => Event::Running {
                stage: status.stage.clone().unwrap_or_else(|| Stage::SCENE[0].name().to_owned()),
                fraction: status.fraction,
            },
            SceneState::Done => Event::Done,
            SceneState::Cancelled => Event::Cancelled,
            SceneState::Failed => Event::Failed(status.error.clone().unwrap_or(SceneError {
                code: ErrorCode::Internal.name().to_owned(),
                message: "the reason was not kept".to_owned(),
            })),
        }
    }

    /// Name of the bundle.
    pub fn bundle(&self) -> &str {
        &self.inner.models.bundle
    }

    /// What makes and renders the scenes.
    pub fn models(&self) -> ModelsInfo {
        let mut models =
            ModelsInfo { limits: (&*self.limits()).into(), ..self.inner.models.clone() };
        match self.inner.jobs.networks() {
            NetworkState::Open("") => {}
            NetworkState::Open(provider) => provider.clone_into(&mut models.execution_provider),
            state => state.name().clone_into(&mut models.execution_provider),
        }
        if let Some(remark) = self.inner.jobs.remark() {
            let provider = &mut models.execution_provider;
            *provider = format!("{provider} ({remark})");
        }
        models
    }

    /// Whether new jobs are taken, and how many there are.
    pub fn ready(&self) -> Readiness {
        let (jobs_queued, jobs_running) = self.inner.jobs.counts();
        Readiness {
            ready: self.inner.jobs.is_open(),
            networks: self.inner.jobs.networks().name(),
            jobs_queued,
            jobs_running,
            renders: self.inner.scheduler.len(),
        }
    }

    /// Bytes of scenes in memory.
    pub fn cached_bytes(&self) -> u64 {
        self.inner.store.cached_bytes()
    }

    /// Bytes of photos in memory, for jobs and for first texts.
    pub fn photos_bytes(&self) -> u64 {
        self.inner.jobs.photos_bytes()
    }

    /// Takes no more jobs and stops the running ones; the next start continues them. Blocks.
    pub fn shut_down(&self) {
        self.inner.jobs.shut_down();
    }
}

/// Whether it says what is served of a scene that is done.
fn is_version(event: &Event) -> bool {
    matches!(event, Event::Done | Event::Version { .. })
}

fn same_version(one: &Event, other: &Event) -> bool {
    match (one, other) {
        (Event::Version { version: a, .. }, Event::Version { version: b, .. }) => a == b,
        // A scene is done as its first version.
        (Event::Done, Event::Version { version, .. }) => *version == 1,
        _ => false,
    }
}

/// Where the next page starts: creation time and id of the last scene of this one.
fn cursor(last: &Record) -> String {
    format!("{}-{}", last.status.created_ms, last.status.id)
}

fn parse_cursor(text: &str) -> Result<(u64, SceneId)> {
    let parts = text
        .split_once('-')
        .and_then(|(created, id)| Some((created.parse().ok()?, id.parse::<SceneId>().ok()?)));
    parts.ok_or_else(|| {
        let shown: String = text.chars().take(60).collect();
        Error::invalid(format!("after is {shown:?}, not the `next` of an earlier page"))
    })
}
