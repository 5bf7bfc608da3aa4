//! What the threads of all jobs share, and what a kind of job and the other replicas are to them.

use std::{
    collections::HashSet,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
        mpsc::{self, RecvTimeoutError},
    },
    thread::JoinHandle,
    time::Duration,
};

use parking_lot::Mutex;
use tokio::sync::watch;

use super::{
    bell::{Bell, FOREVER},
    job::{Job, Reason, Running},
    kind::{JobKind, Kind},
    networks::{NetworkState, SceneNetworks, SemanticNetworks},
    photos::{Content, ReadUpload, ReadUploads},
    queue::{Full, Queue},
    records::Records,
    refiner::Refiner,
    room::Room,
};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::LiveLimits,
    render::Renderer,
    scene::{Refine, SceneId, SceneOptions, SemanticsMode, SemanticsState, Stage, Watch},
    store::{Record, Store, not_found},
};

/// Starts of one job before it is given up: one that kills the server must not do so forever.
const ATTEMPTS_MAX: u32 = 3;

/// What a kind of job does. `super::KINDS` lists all; threads, queue and metrics take them from
/// there.
pub(super) trait Work: JobKind {
    /// Threads of a server that makes so many scenes at a time.
    fn threads(&self, scenes: usize) -> usize {
        scenes
    }

    /// The span of a job.
    fn span(&self, jobs: &Jobs, id: &SceneId) -> tracing::Span;

    /// Does the whole work.
    fn run(&self, jobs: &Jobs, job: &Job) -> Result<()>;
}

/// How this process shares its scenes with others. Each default is that of a process on its own.
pub(super) trait Replicas: Send + Sync {
    /// Name of this process among those that share the store; `None` where it is alone.
    fn name(&self) -> Option<&str> {
        None
    }

    /// From now on this process makes the scene, and its record here is the right one.
    fn hold(&self, _: &SceneId) {}

    /// From now on this process writes nothing of the scene.
    fn release(&self, _: &SceneId) {}

    /// Whether the store may know more of this scene than the records.
    fn may_be_stale(&self, _: &SceneId) -> bool {
        false
    }

    /// Reads what the store has of a scene.
    fn refresh(&self, _: &Jobs, _: &SceneId) -> Result<()> {
        Ok(())
    }

    /// Reads what the store has of all scenes.
    fn refresh_all(&self, _: &Jobs) -> Result<()> {
        Ok(())
    }

    /// Whether the call that made this scene was acknowledged.
    fn is_acknowledged(&self, _: &Store, _: &SceneId) -> Result<bool> {
        Ok(true)
    }

    /// From now on this process changes the photos of a scene.
    /// Fails with `overloaded` where another one does.
    fn begin_growing(&self, _: &Store, _: &SceneId) -> Result<()> {
        Ok(())
    }

    /// Whether another process changes the photos of a finished scene, or has changed them since
    /// this one read its record: then the scene is not held here any more.
    /// Fails as the store does.
    fn is_lost(&self, _: &Jobs, _: &SceneId) -> Result<bool> {
        Ok(false)
    }

    /// No change of the photos of a scene waits any more.
    fn end_growing(&self, _: &Store, _: &SceneId) -> Result<()> {
        Ok(())
    }

    /// The life of the thread that watches the other replicas.
    fn watch(&self, _: &Jobs) {}
}

/// The parts that jobs need.
pub(crate) struct JobParts {
    pub(crate) store: Arc<Store>,
    pub(crate) scenes: Arc<dyn SceneNetworks>,
    pub(crate) semantics: Arc<dyn SemanticNetworks>,
    /// Caps in force.
    pub(crate) limits: Arc<LiveLimits>,
    /// Scenes made at the same time, and semantics made at the same time.
    pub(crate) workers: usize,
    /// Whether the photos of finished scenes are kept.
    pub(crate) keep_photos: bool,
    /// Whether scenes are refined whose create call does not say.
    pub(crate) refine: Refine,
    /// What draws scenes: it has a new one before its first view.
    pub(crate) renderer: Arc<dyn Renderer>,
    /// What refines them.
    pub(crate) refiner: Refiner,
    /// Has made what the page reads of a scene that is served as another one now.
    pub(crate) foresee: Box<dyn Fn(&SceneId) + Send + Sync>,
    /// How long ago a view was drawn, waited or was encoded; `None`: never.
    pub(crate) since_last_view: Box<dyn Fn() -> Option<Duration> + Send + Sync>,
}

/// The queue, its workers and the state of every scene. The calls block on the store and fail
/// with `store_unavailable` where it does.
pub(crate) struct Jobs {
    /// Every kind of job.
    pub(super) kinds: &'static [&'static dyn Work],
    pub(super) parts: JobParts,
    pub(crate) records: Records,
    pub(super) queue: Queue,
    pub(super) running: Running,
    pub(super) uploads: ReadUploads,
    pub(super) room: Room,
    pub(super) replicas: Box<dyn Replicas>,
    /// Workers that make scenes and live.
    pub(super) workers: AtomicUsize,
    /// Content hashes that workers make scenes of, and ids of scenes that they change.
    pub(super) locked: Mutex<HashSet<String>>,
    /// Held while a change of photos is ordered, or the last one is over.
    pub(super) ordering: Mutex<()>,
    /// Wakes threads that wait for a record, a lock, room or the end of a job.
    pub(super) bell: Arc<Bell>,
    /// Milliseconds that the last scenes took, smoothed; 0 before the first.
    pub(super) scene_ms: AtomicU64,
    /// Whether a job ended since freed memory last went back to the system.
    pub(super) freed: AtomicBool,
    pub(super) threads: Mutex<Vec<JoinHandle<()>>>,
}

/// Keeps other workers from making a scene of the same content, or from changing the same scene,
/// until it is dropped.
pub(super) struct WorkLock<'a> {
    jobs: &'a Jobs,
    name: String,
}

impl Drop for WorkLock<'_> {
    fn drop(&mut self) {
        self.jobs.locked.lock().remove(&self.name);
        self.jobs.bell.ring();
    }
}

impl Jobs {
    pub(super) fn overloaded(&self, full: Full) -> Error {
        let (who, max) = match full {
            Full::Closed => {
                let message = "the server is stopping";
                return Error::new(ErrorCode::Overloaded, message).retry_after_s(10);
            }
            Full::All(max) => ("scenes", max),
            Full::Share(max) => ("scenes of this key", max),
        };
        let message = format!("{max} {who} wait already, the most that may");
        Error::new(ErrorCode::Overloaded, message).retry_after_s(self.next_place_s())
    }

    /// Seconds until a place is likely to be free: the time of one scene, over all workers.
    fn next_place_s(&self) -> u32 {
        let ms = self.scene_ms.load(Ordering::Relaxed);
        let workers = self.workers.load(Ordering::Relaxed).max(1) as u64;
        let seconds = if ms == 0 { 15 } else { (ms / workers).div_ceil(1_000) };
        u32::try_from(seconds.clamp(1, 60)).unwrap_or(60)
    }

    /// The newest record of a scene.
    /// Fails with `scene_not_found`.
    pub(crate) fn record(&self, id: &SceneId) -> Result<Arc<Record>> {
        self.records.find(id).ok_or_else(|| not_found(id))
    }

    /// A channel that holds the newest record; it closes when the scene is deleted.
    /// Fails with `scene_not_found`.
    pub(crate) fn watch(&self, id: &SceneId) -> Result<watch::Receiver<Arc<Record>>> {
        self.records.watch(id).ok_or_else(|| not_found(id))
    }

    /// Whether the store may know more of this scene than this process.
    pub(crate) fn may_be_stale(&self, id: &SceneId) -> bool {
        self.replicas.may_be_stale(id)
    }

    /// Reads what the store has of a scene that another replica makes.
    pub(crate) fn refresh(&self, id: &SceneId) -> Result<()> {
        if self.may_be_stale(id) { self.replicas.refresh(self, id) } else { Ok(()) }
    }

    /// Reads what the store has of all scenes.
    pub(crate) fn refresh_all(&self) -> Result<()> {
        self.replicas.refresh_all(self)
    }

    /// Bytes of photos in memory, for jobs and for first texts.
    pub(crate) fn photos_bytes(&self) -> u64 {
        self.uploads.size_bytes()
    }

    /// Whether the networks are open.
    pub(crate) fn networks(&self) -> NetworkState {
        self.parts.scenes.state()
    }

    /// Why a network is not computed where it was to be; `None` where all are.
    pub(crate) fn remark(&self) -> Option<String> {
        self.parts.scenes.remark()
    }

    /// Waits until no other worker here has the lock of this content, or of this scene.
    /// Fails with `cancelled`.
    pub(super) fn lock(&self, name: &str, job: &Job) -> Result<WorkLock<'_>> {
        self.bell.wait_in_job(&job.cancel, || {
            if self.locked.lock().insert(name.to_owned()) { Ok(()) } else { Err(FOREVER) }
        })?;
        Ok(WorkLock { jobs: self, name: name.to_owned() })
    }

    /// Runs `work`, which shows its progress in the record and is stopped when its time is over.
    pub(super) fn within_time<T>(
        &self,
        job: &Job,
        work: impl FnOnce(Watch<'_>) -> Result<T>,
    ) -> Result<T> {
        let limit = self.job_time();
        let progress = |stage: Stage, fraction: f32| self.show(job, stage, fraction);
        let watch = Watch { progress: &progress, cancel: &job.cancel };
        std::thread::scope(|scope| {
            // Dropped at the end of the work, also by a panic.
            let (_finished, watchdog) = mpsc::channel::<()>();
            scope.spawn(move || {
                if watchdog.recv_timeout(limit) == Err(RecvTimeoutError::Timeout) {
                    job.stop(Reason::Timeout);
                }
            });
            work(watch)
        })
    }

    pub(super) fn job_time(&self) -> Duration {
        Duration::from_millis(self.parts.limits.get().scene_timeout_ms)
    }

    pub(super) fn show(&self, job: &Job, stage: Stage, fraction: f32) {
        self.records.show_progress(&job.scene, |status| job.kind.show(status, stage, fraction));
    }

    /// The upload of a job: as the create call read it, else read from the store.
    pub(super) fn upload(&self, id: &SceneId, watch: Watch<'_>) -> Result<Arc<ReadUpload>> {
        let record = self.record(id)?;
        if let Some(kept) = self.uploads.find(id).filter(|kept| kept.fits(&record.status)) {
            return self.without_words(kept, &record.options, watch);
        }
        let upload = self.parts.store.upload(id)?;
        let limits = self.parts.limits.get();
        let read = ReadUpload::of(&upload, &record.options, &limits, watch.cancel)?;
        let read = Arc::new(read.of_scene(&record.status));
        let read = Arc::unwrap_or_clone(self.without_words(read, &record.options, watch)?);
        self.with_joined(read, &record, watch).map(Arc::new)
    }

    /// An upload whose photos are without what the words of its scene name, once they have cameras.
    pub(super) fn without_words(
        &self,
        upload: Arc<ReadUpload>,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<Arc<ReadUpload>> {
        let Content::Photos(photos) = &upload.content else { return Ok(upload) };
        if options.ignore.is_empty() || photos.is_without_words {
            return Ok(upload);
        }
        let (photos, method) = (photos.clone(), options.method());
        let photos = self.parts.semantics.without_words(photos, &options.ignore, &method, watch)?;
        Ok(Arc::new(upload.with_photos(photos)))
    }

    /// Forgets the photos of a finished scene where they are not kept, and no job that may come
    /// needs them.
    pub(super) fn drop_upload_unless_needed(&self, id: &SceneId) {
        let Some(record) = self.records.find(id) else { return };
        let eager = record.options.semantics == SemanticsMode::Eager;
        let lacks = eager && record.status.semantics.state != SemanticsState::Ready;
        if !self.parts.keep_photos
            && !lacks
            && record.refine.is_none()
            && let Err(error) = self.parts.store.drop_upload(id)
        {
            tracing::warn!(scene = %id, %error, "photos that nothing needs are still kept");
        }
    }

    /// Gives up a job that was begun too often.
    pub(super) fn check_attempts(&self, kind: Kind, record: &Record) -> Result<()> {
        if !is_used_up(kind, record) {
            return Ok(());
        }
        let what = kind.what();
        let message = format!("given up: {what} was begun {ATTEMPTS_MAX} times and not made");
        Err(Error::internal(message))
    }

    /// This process writes nothing of the scene any more.
    pub(super) fn release(&self, id: &SceneId) {
        self.uploads.forget(id);
        self.replicas.release(id);
    }
}

/// Whether a job was begun so often without a result that it is given up.
pub(super) fn is_used_up(kind: Kind, record: &Record) -> bool {
    kind.attempts(&mut record.clone()).is_some_and(|attempts| *attempts >= ATTEMPTS_MAX)
}
