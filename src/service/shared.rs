//! What every call of the service works with: [`Service`], its parts, its start and its end.

use std::{fmt, sync::Arc};

use tokio::sync::{OwnedSemaphorePermit, Semaphore, watch};

use super::{
    coarse::{Foresight, LastCoarse},
    edits::Edits,
    memory::{Memory, Share},
    schedule::Scheduler,
    search::Backend,
    types::{ModelsInfo, Readiness},
};
use crate::{
    config::Config,
    error::{Error, ErrorCode, Result},
    jobs::{JobParts, Jobs, NetworkState, Refiner, SceneNetworks, SemanticNetworks},
    keys::Caller,
    limits::{Limits, LiveLimits},
    render::{Renderer, blocks::BLOCKS_MIN},
    scene::{SceneId, SceneState},
    store::{Record, Store, StoreLocation},
};

/// Uploads decoded at the same time: each may hold `limits.network_photos_max` photos in memory.
const UPLOADS_READ_MAX: usize = 2;
/// When to ask again where too many are told edits, seconds.
const WATCH_AGAIN_S: u32 = 30;
/// Locks that calls with one idempotency key share with few others.
pub(super) const KEY_LOCKS: usize = 16;

/// The use cases, for one caller. Cloning shares everything.
///
/// A scene that the caller may not see is in no way different from one that does not exist.
#[derive(Clone, Debug)]
pub struct Service {
    pub(super) inner: Arc<Shared>,
    pub(super) caller: Caller,
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

/// What all clones of a [`Service`] share.
pub(super) struct Shared {
    pub(super) config: Config,
    /// Caps in force: those of the configuration, or newer ones. The jobs have the same.
    pub(super) limits: Arc<LiveLimits>,
    pub(super) store: Arc<Store>,
    pub(super) edits: Edits,
    pub(super) jobs: Arc<Jobs>,
    /// Networks that run by themselves; the jobs have the same.
    pub(super) networks: Arc<dyn SceneNetworks>,
    pub(super) backend: Arc<Backend>,
    pub(super) models: ModelsInfo,
    pub(super) scheduler: Arc<Scheduler>,
    /// Permits to decode uploads.
    pub(super) reading: Arc<Semaphore>,
    /// Permits to write folders.
    pub(super) folders: Arc<Semaphore>,
    /// Permits to be told edits.
    pub(super) watchers: Arc<Semaphore>,
    /// Permits to run networks.
    pub(super) inferences: Arc<Semaphore>,
    pub(super) key_locks: [Arc<tokio::sync::Mutex<()>>; KEY_LOCKS],
    pub(super) memory: Arc<Memory>,
    /// Of the scene whose packed form was read last.
    pub(super) coarse: Arc<LastCoarse>,
    /// What makes them before they are read.
    pub(super) foresight: Arc<Foresight>,
    /// Whether callers who wait for what is being made are answered at once.
    pub(super) stopping: watch::Sender<bool>,
}

impl fmt::Debug for Shared {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Shared").field("config", &self.config).finish_non_exhaustive()
    }
}

impl Shared {
    pub(super) fn limits(&self) -> Arc<Limits> {
        self.limits.get()
    }

    /// One of the places of those who are told edits.
    pub(super) fn place_to_watch(&self) -> Result<OwnedSemaphorePermit> {
        Arc::clone(&self.watchers).try_acquire_owned().map_err(|_| {
            let max = self.config.limits.watchers_max;
            let why = format!("{max} callers are told edits already, the most that may");
            Error::new(ErrorCode::Overloaded, why).retry_after_s(WATCH_AGAIN_S)
        })
    }

    /// Resolves when nobody waits any more for what is being made.
    pub(super) async fn stopped_waiting(&self) {
        // The sender lives as long as `self`.
        let _ = self.stopping.subscribe().wait_for(|&stopping| stopping).await;
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        self.foresight.close();
        self.jobs.shut_down();
    }
}

impl Service {
    /// Opens the store at `place`, queues unfinished jobs again and starts the workers. Blocks on
    /// the store.
    ///
    /// # Errors
    /// `store_unavailable` when the store cannot be used.
    pub fn open(place: &StoreLocation, config: Config, parts: Parts) -> Result<Self> {
        let (store, records) = Store::open(place, &config.limits)?;
        let store = Arc::new(store);
        let scheduler = Scheduler::new(parts.renderer.concurrency(), &config.limits);
        let views = Arc::clone(&scheduler);
        let device = Arc::clone(&parts.renderer).differentiable();
        let refiner = Refiner::new(device, config.threads, &config.limits)?;
        let networks = Arc::clone(&parts.scenes);
        let limits = Arc::new(LiveLimits::new(config.limits.clone()));
        let memory = Arc::new(Memory::new(config.limits.memory_bytes_max));
        let (coarse, foresight) = (Arc::<LastCoarse>::default(), Arc::<Foresight>::default());
        let job_parts = JobParts {
            store: Arc::clone(&store),
            scenes: parts.scenes,
            semantics: Arc::clone(&parts.semantics),
            limits: Arc::clone(&limits),
            workers: config.workers(),
            keep_photos: config.keep_photos,
            refine: config.refine,
            renderer: Arc::clone(&parts.renderer),
            refiner,
            foresee: {
                let foresight = Arc::clone(&foresight);
                Box::new(move |id| foresight.want(id))
            },
            since_last_view: Box::new(move || views.idle()),
        };
        let jobs = Jobs::start(job_parts, records)?;
        let models = ModelsInfo {
            renderer: parts.renderer.name(),
            server_version: env!("CARGO_PKG_VERSION").to_owned(),
            ..parts.models
        };
        let (renderer, semantics) = (parts.renderer, parts.semantics);
        let backend = Backend::new(renderer, semantics, &models.words, &config.limits);
        let inner = Shared {
            edits: Edits::new(&config.limits),
            store,
            jobs,
            networks,
            scheduler,
            backend: Arc::new(backend),
            models,
            reading: Arc::new(Semaphore::new(UPLOADS_READ_MAX)),
            folders: Arc::new(Semaphore::new(config.limits.folder_exports_max)),
            watchers: Arc::new(Semaphore::new(config.limits.watchers_max)),
            inferences: Arc::new(Semaphore::new(config.limits.inferences_max)),
            key_locks: Default::default(),
            memory,
            coarse,
            foresight,
            stopping: watch::Sender::default(),
            limits,
            config,
        };
        let inner = Arc::new(inner);
        let served = Arc::downgrade(&inner);
        // Who stops the service waits for no more than this.
        let load = move |id: &SceneId| match served.upgrade().map(|inner| inner.load_as_served(id))
        {
            Some(Err(error)) if error.code() == ErrorCode::SceneNotFound => Ok(None),
            scene => scene.transpose(),
        };
        inner.foresight.start(Arc::clone(&inner.coarse), Arc::clone(&inner.memory), load)?;
        // Who comes back after a restart opens the scene that was made last.
        let is_large = |record: &Record| {
            let report = record.status.report.as_ref();
            record.status.state == SceneState::Done
                && report.is_some_and(|report| report.gaussians >= BLOCKS_MIN as u64)
        };
        if let Some(last) = inner.jobs.records.page(None, 1, is_large).0.first() {
            inner.foresight.want(&last.status.id);
        }
        Ok(Self { inner, caller: Caller::All })
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

    /// From now on nobody waits for what is being made: calls that do are answered with what there
    /// is.
    pub fn stop_waiting(&self) {
        self.inner.stopping.send_replace(true);
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

    /// Bytes of a whole answer, which are taken until it is sent.
    ///
    /// # Errors
    /// `overloaded` where too many bytes wait for their callers already.
    pub fn answer_bytes(&self, bytes: u64) -> Result<Share> {
        self.inner.memory.answer(bytes, &self.inner.limits())
    }

    /// Bytes of scenes in memory.
    pub fn cached_bytes(&self) -> u64 {
        self.inner.store.cached_bytes() + self.inner.edits.cached_bytes()
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
