//! Jobs: a bounded queue, workers, progress for watchers, and a way to stop each job.
//!
//! A job makes a scene of an upload, or the semantics of a scene, or refines it. In: an upload,
//! safe in the store before `Jobs::submit` returns. Out: a scene in the store. Invariant: an
//! acknowledged scene is made, fails with a code, or is cancelled, over any restart.

mod job;
mod networks;
mod photos;
mod queue;
mod records;
mod refine;
mod replicas;
mod room;
mod scene;
mod semantics;
mod worker;

use std::{
    collections::HashSet,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use parking_lot::{Condvar, Mutex};
use tokio::sync::watch;

pub use self::networks::{
    NetworkState, NoSemantics, Phrases, PipelineNetworks, SceneNetworks, SemanticNetworks,
};

pub(crate) use self::refine::{budget_ms, refine_options, refiner};

use self::{
    job::{Kind, Reason, Running},
    photos::{ReadUpload, ReadUploads},
    queue::{Full, Queue},
    records::Records,
    replicas::Replicas,
    room::Room,
};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
    render::{DifferentiableRenderer, Renderer},
    scene::{PhotoHash, Refine, SceneId, SceneState, SemanticsMode, SemanticsState, Upload},
    store::{self, KeyUse, Record, Store, not_found},
};

/// The parts that jobs need.
pub(crate) struct JobParts {
    pub(crate) store: Arc<Store>,
    pub(crate) scenes: Arc<dyn SceneNetworks>,
    pub(crate) semantics: Arc<dyn SemanticNetworks>,
    /// Caps; those of jobs stay as they are at the start.
    pub(crate) limits: Limits,
    /// Scenes made at the same time, and semantics made at the same time.
    pub(crate) workers: usize,
    /// Whether the photos of finished scenes are kept.
    pub(crate) keep_photos: bool,
    /// Whether scenes are refined whose create call does not say.
    pub(crate) refine: Refine,
    /// What draws scenes: it has a new one before its first view.
    pub(crate) renderer: Arc<dyn Renderer>,
    /// What refines them, with so many threads of the processor.
    pub(crate) refiner: Arc<dyn DifferentiableRenderer>,
    pub(crate) threads: usize,
    /// How long ago a view was drawn, waited or was encoded; `None`: never.
    pub(crate) drawn: Box<dyn Fn() -> Option<Duration> + Send + Sync>,
}

/// The queue, its workers and the state of every scene. The calls block on the store and fail
/// with `store_unavailable` where it does.
pub(crate) struct Jobs {
    parts: JobParts,
    pub(crate) records: Records,
    pub(crate) queue: Queue,
    running: Running,
    uploads: ReadUploads,
    room: Room,
    replicas: Box<dyn Replicas>,
    /// Workers that make scenes and live.
    workers: AtomicUsize,
    /// Content hashes that workers make scenes of, ids of scenes that they change, and a
    /// signal when one ends.
    contents: Mutex<HashSet<String>>,
    content_free: Condvar,
    /// Milliseconds that the last scenes took, smoothed; 0 before the first.
    scene_ms: AtomicU64,
    /// Whether a job ended since freed memory last went back to the system.
    freed: AtomicBool,
    threads: Mutex<Vec<JoinHandle<()>>>,
}

impl Jobs {
    /// Starts the threads, and queues again what was queued or running when the program last
    /// stopped. The threads live until [`Self::shut_down`].
    /// Fails with `internal` when a thread cannot be started.
    pub(crate) fn start(parts: JobParts, mut records: Vec<Record>) -> Result<Arc<Self>> {
        let jobs = Arc::new(Self {
            records: Records::default(),
            queue: Queue::new(parts.limits.queued_jobs_max),
            running: Running::default(),
            uploads: ReadUploads::new(
                parts.limits.read_uploads_bytes_max,
                Duration::from_millis(parts.limits.first_text_photos_ms),
            ),
            room: Room::new(parts.limits.photos_max),
            replicas: replicas::of(&parts)?,
            workers: AtomicUsize::new(parts.workers),
            contents: Mutex::default(),
            content_free: Condvar::new(),
            scene_ms: AtomicU64::new(0),
            freed: AtomicBool::new(false),
            threads: Mutex::default(),
            parts,
        });
        records.sort_by_key(|record| record.status.created_ms);
        for record in records {
            jobs.take_up(record);
        }
        let start = |name: String, life: fn(&Self)| {
            let shared = Arc::clone(&jobs);
            let thread = std::thread::Builder::new().name(name).spawn(move || life(&shared));
            let thread =
                thread.map_err(|e| Error::internal("no thread can be started").caused_by(e))?;
            jobs.threads.lock().push(thread);
            Ok(())
        };
        let start_all = || {
            for i in 0..jobs.parts.workers {
                start(format!("scene-{i}"), |jobs| jobs.work(Kind::Scene))?;
                start(format!("semantics-{i}"), |jobs| jobs.work(Kind::Semantics))?;
            }
            start("refine".to_owned(), |jobs| jobs.work(Kind::Refine))?;
            start("sweeper".to_owned(), Self::sweep)?;
            if jobs.replicas.name().is_some() {
                start("replicas".to_owned(), |jobs| jobs.replicas.watch(jobs))?;
            }
            Ok(())
        };
        start_all().inspect_err(|_| jobs.shut_down())?;
        Ok(jobs)
    }

    /// Reads an upload, makes it safe in the store and queues it. Gives its id, or that of the
    /// scene of an earlier call with the same idempotency key.
    ///
    /// # Errors
    /// `invalid_request`, `photo_unreadable`, `limit_exceeded` where the upload cannot be a scene;
    /// `idempotency_key_reused` when the key was used with others; `overloaded` when the queue is
    /// full or the server stops.
    pub(crate) fn submit(
        &self,
        upload: Upload,
        mut record: Record,
        limits: &Limits,
    ) -> Result<SceneId> {
        let read = ReadUpload::of(&upload, &record.options, limits, &AtomicBool::new(false))?;
        record.options.semantics = read.semantics(record.options.semantics);
        if record.options.semantics == SemanticsMode::Off {
            record.status.semantics.state = SemanticsState::Off;
        }
        let files = &read.files;
        record.request_sha256 = store::request_sha256(files, &record.options);
        // First, so that a full queue still answers for scenes that it holds.
        if let Some(earlier) = self.earlier(files, &record)? {
            return Ok(earlier);
        }
        let reserved = self.queue.reserve(Kind::Scene, record.owner.as_deref());
        let place = reserved.map_err(|full| self.overloaded(full))?;
        record.replica = self.replicas.name().map(str::to_owned);
        let id = record.status.id.clone();
        self.replicas.hold(&id);
        let kept = || -> Result<Option<SceneId>> {
            if let Some(other) = self.use_key(files, &record)? {
                return Ok(Some(other));
            }
            self.parts.store.put_upload(upload, &record).inspect_err(|_| {
                if let Some(key) = &record.idempotency_key {
                    // A key that stays leads to no scene and counts as unused.
                    let _ = self.parts.store.forget_key(record.owner.as_deref(), key);
                }
            })?;
            Ok(None)
        };
        if let Some(other) = kept().inspect_err(|_| self.release(&id))? {
            self.release(&id);
            return Ok(other);
        }
        self.uploads.keep(&id, Arc::new(read));
        self.records.insert(record);
        place.fill(id.clone());
        Ok(id)
    }

    /// The scene of an earlier call with this record's idempotency key.
    fn earlier(&self, files: &[PhotoHash], record: &Record) -> Result<Option<SceneId>> {
        let Some(key) = &record.idempotency_key else { return Ok(None) };
        let owner = record.owner.as_deref();
        let Some(used) = self.parts.store.key_use(owner, key)? else { return Ok(None) };
        self.refresh(&used.id)?;
        if self.records.find(&used.id).is_none() {
            // Deleted, or never acknowledged.
            self.parts.store.forget_key(owner, key)?;
            return Ok(None);
        }
        self.replayed(files, record, used).map(Some)
    }

    /// Notes the use of the record's key; gives the scene of a call that was faster.
    fn use_key(&self, files: &[PhotoHash], record: &Record) -> Result<Option<SceneId>> {
        let Some(key) = &record.idempotency_key else { return Ok(None) };
        let (store, id) = (&self.parts.store, &record.status.id);
        let new = KeyUse { id: id.clone(), request_sha256: record.request_sha256.clone() };
        // The scene is announced before the key leads to it.
        store.announce(record)?;
        match store.use_key(record.owner.as_deref(), key, &new) {
            Ok(None) => Ok(None),
            Ok(Some(used)) => {
                store.drop_pending(id)?;
                self.replayed(files, record, used).map(Some)
            }
            Err(error) => {
                let _ = store.drop_pending(id);
                Err(error)
            }
        }
    }

    /// The scene of an earlier use of a key, if it was for the same request.
    fn replayed(&self, files: &[PhotoHash], record: &Record, used: KeyUse) -> Result<SceneId> {
        let id = used.id;
        if !store::is_of_request(&used.request_sha256, files, &record.options) {
            let message = "the idempotency key was used with other photos or options";
            let message = format!("{message} (scene {id})");
            return Err(Error::new(ErrorCode::IdempotencyKeyReused, message));
        }
        let over = self.records.find(&id).is_some_and(|known| known.status.state.is_final());
        if !over && !self.replicas.is_acknowledged(&self.parts.store, &id)? {
            // Another replica still writes it and may fail: nothing is acknowledged for it.
            let message = format!("the first call with this idempotency key (scene {id}) is open");
            return Err(Error::new(ErrorCode::Overloaded, message).retry_after_s(1));
        }
        Ok(id)
    }

    /// Refuses where another scene of this owner would not be queued now.
    /// Fails with `overloaded` when the queue is full or the server stops.
    pub(crate) fn has_room(&self, owner: Option<&str>) -> Result<()> {
        let reserved = self.queue.reserve(Kind::Scene, owner);
        reserved.map(drop).map_err(|full| self.overloaded(full))
    }

    fn overloaded(&self, full: Full) -> Error {
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

    /// Stops the scene's jobs and removes everything that is kept of it.
    /// Fails with `scene_not_found`.
    pub(crate) fn delete(&self, id: &SceneId) -> Result<()> {
        let record = self.record(id)?;
        self.queue.remove(id);
        self.running.stop(Some(id), Reason::Cancelled);
        let removed = self.parts.store.remove(&record);
        let removed_here = removed.is_ok();
        match removed {
            // A job that was about to end may have removed its own objects first.
            Err(error) if error.code() != ErrorCode::SceneNotFound => {
                // It still exists, but no job makes it any more.
                self.records.update(id, |record| {
                    records::cancel(record);
                    if record.status.semantics.state == SemanticsState::Running {
                        record.status.semantics = Default::default();
                    }
                });
                return Err(error);
            }
            _ => {}
        }
        // What watches the other replicas may have seen first that it is gone.
        let existed = self.records.remove(id) || removed_here;
        // Only now: a job that ends meanwhile either is seen here, or sees there that its scene is
        // gone.
        if !self.running.has(id) {
            self.release(id);
        }
        if existed { Ok(()) } else { Err(not_found(id)) }
    }

    /// Marks a finished scene as failed: its file turned out to be bad.
    pub(crate) fn spoil(&self, id: &SceneId, error: &Error) {
        self.fail(Kind::Scene, id, error);
    }

    /// Bytes of photos in memory, for jobs and for first texts.
    pub(crate) fn photos_bytes(&self) -> u64 {
        self.uploads.size_bytes()
    }

    /// Scenes that wait for a worker, and scenes that a worker makes.
    pub(crate) fn counts(&self) -> (usize, usize) {
        (self.queue.len(Kind::Scene), self.running.scenes(Kind::Scene).len())
    }

    /// Whether the networks are open.
    pub(crate) fn networks(&self) -> NetworkState {
        self.parts.scenes.state()
    }

    /// Why a network is not computed where it was to be; `None` where all are.
    pub(crate) fn remark(&self) -> Option<String> {
        self.parts.scenes.remark()
    }

    /// Whether the queue takes jobs and a worker lives.
    pub(crate) fn is_open(&self) -> bool {
        !self.queue.is_closed() && self.workers.load(Ordering::Relaxed) > 0
    }

    /// Stops taking jobs, asks running ones to stop, waits for them. They are queued again at the
    /// next start.
    pub(crate) fn shut_down(&self) {
        self.queue.close();
        self.running.stop(None, Reason::Shutdown);
        for thread in self.threads.lock().drain(..) {
            if thread.join().is_err() {
                tracing::error!("a worker had panicked");
            }
        }
    }

    /// Continues a scene that an earlier run of the program left.
    fn take_up(&self, mut record: Record) {
        let (id, owner) = (record.status.id.clone(), record.owner.clone());
        let unfinished = !record.status.state.is_final();
        if unfinished {
            tracing::info!(scene = %id, attempts = record.attempts, "queued again");
            scene::requeue(&mut record);
        }
        semantics::reset(&mut record);
        let eager = record.options.semantics == SemanticsMode::Eager
            && record.status.state == SceneState::Done
            && record.status.semantics.state == SemanticsState::None
            && self.parts.semantics.lacks().is_none();
        if eager {
            record.status.semantics.state = SemanticsState::Running;
        }
        let refined = record.refine.is_some() && record.status.state == SceneState::Done;
        if refined {
            self.mend(&mut record);
        }
        self.records.insert(record);
        if refined {
            self.replicas.hold(&id);
            self.queue.push(Kind::Refine, id.clone(), owner.as_deref());
        }
        if eager || unfinished {
            let kind = if eager { Kind::Semantics } else { Kind::Scene };
            self.replicas.hold(&id);
            self.queue.push(kind, id, owner.as_deref());
        }
    }

    /// This process writes nothing of the scene any more.
    fn release(&self, id: &SceneId) {
        self.uploads.forget(id);
        self.replicas.release(id);
    }
}
