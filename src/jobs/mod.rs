//! Jobs: a bounded queue, workers, progress for watchers, and a way to stop each job.
//!
//! A job makes a scene of an upload, or the semantics of a scene. In: an upload, safe in the store
//! before [`Jobs::submit`] returns. Out: a scene in the store. Invariant: an acknowledged scene is
//! made, fails with a code, or is cancelled, over any restart.

mod job;
mod makers;
mod photos;
mod queue;
mod records;
mod replicas;
mod scene;
mod semantics;
mod worker;

use std::{
    collections::HashSet,
    fmt,
    sync::{
        Arc, Condvar, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    thread::JoinHandle,
};

use tokio::sync::watch;

pub use self::makers::{Networks, NoSemantics, Phrases, PipelineMaker, SceneMaker, SemanticsMaker};

use self::{
    job::{Kind, Reason, Running},
    photos::{ReadUpload, ReadUploads},
    queue::{Full, Queue},
    records::Records,
    replicas::Replicas,
    worker::Shutdown,
};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
    pipeline,
    scene::{
        PhotoHash, SceneId, SceneState, SemanticsMode, SemanticsState, SemanticsStatus, Upload,
    },
    store::{self, KeyUse, Record, Store, not_found},
};

/// What jobs work with.
pub struct JobParts {
    /// Where scenes are kept.
    pub store: Arc<Store>,
    /// Makes scenes.
    pub maker: Arc<dyn SceneMaker>,
    /// Makes semantics.
    pub semantics: Arc<dyn SemanticsMaker>,
    /// Caps; those of jobs stay as they are at the start.
    pub limits: Limits,
    /// Scenes made at the same time.
    pub workers: usize,
    /// Whether the photos of finished scenes are kept.
    pub keep_photos: bool,
}

impl fmt::Debug for JobParts {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("JobParts").field("workers", &self.workers).finish_non_exhaustive()
    }
}

/// The queue, its workers and the state of every scene.
pub struct Jobs {
    shared: Arc<Shared>,
    threads: Mutex<Vec<JoinHandle<()>>>,
}

struct Shared {
    parts: JobParts,
    records: Records,
    queue: Queue,
    running: Running,
    uploads: ReadUploads,
    replicas: Box<dyn Replicas>,
    /// Workers that make scenes and live.
    workers: AtomicUsize,
    /// Content hashes that workers make scenes of, and a signal when one ends.
    contents: Mutex<HashSet<String>>,
    content_made: Condvar,
    /// Milliseconds that the last scenes took, smoothed; 0: none was made yet.
    scene_ms: AtomicU64,
    shutdown: Shutdown,
}

impl fmt::Debug for Jobs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Jobs").field("queue", &self.shared.queue).finish_non_exhaustive()
    }
}

impl Jobs {
    /// Starts the threads, and queues again what was queued or running when the program last
    /// stopped.
    ///
    /// # Errors
    /// `internal` when a thread cannot be started.
    pub fn start(parts: JobParts, mut records: Vec<Record>) -> Result<Self> {
        let shared = Arc::new(Shared {
            records: Records::default(),
            queue: Queue::new(parts.limits.queued_jobs_max),
            running: Running::default(),
            uploads: ReadUploads::new(parts.limits.read_uploads_bytes_max),
            replicas: replicas::of(&parts),
            workers: AtomicUsize::new(parts.workers),
            contents: Mutex::default(),
            content_made: Condvar::new(),
            scene_ms: AtomicU64::new(0),
            shutdown: Shutdown::default(),
            parts,
        });
        records.sort_by_key(|record| record.status.created_ms);
        for record in records {
            shared.take_up(record);
        }
        let start = |name: String, life: Box<dyn FnOnce(&Shared) + Send>| {
            let shared = Arc::clone(&shared);
            std::thread::Builder::new()
                .name(name)
                .spawn(move || life(&shared))
                .map_err(|e| Error::internal("no thread can be started").caused_by(e))
        };
        let mut threads = Vec::new();
        for i in 0..shared.parts.workers {
            let life = Box::new(|shared: &Shared| shared.work(Kind::Scene));
            threads.push(start(format!("scene-{i}"), life)?);
        }
        // One is enough: the semantics of a scene use every core already.
        let life = Box::new(|shared: &Shared| shared.work(Kind::Semantics));
        threads.push(start("semantics".to_owned(), life)?);
        threads.push(start("sweeper".to_owned(), Box::new(Shared::sweep))?);
        if shared.replicas.name().is_some() {
            let life = Box::new(|shared: &Shared| shared.replicas.watch(shared));
            threads.push(start("replicas".to_owned(), life)?);
        }
        Ok(Self { shared, threads: Mutex::new(threads) })
    }

    /// Reads an upload, makes it safe in the store and queues it. Gives its id, or that of the
    /// scene which an earlier call with the same idempotency key made. Blocks.
    ///
    /// # Errors
    /// `invalid_request`, `photo_unreadable`, `limit_exceeded` where the upload cannot be a scene;
    /// `invalid_request` when the key was used for another upload, `overloaded` when the queue is
    /// full or the server stops, `store_unavailable`.
    pub fn submit(&self, upload: Upload, mut record: Record, limits: &Limits) -> Result<SceneId> {
        let shared = &self.shared;
        let photos = pipeline::read(&upload, limits, &AtomicBool::new(false))?;
        let files = store::hashes(&upload);
        record.request_sha256 = store::request_sha256(&files, &record.options);
        // First, so that a full queue still answers for what it holds.
        if let Some(earlier) = self.earlier(&files, &record)? {
            return Ok(earlier);
        }
        let reserved = shared.queue.reserve(Kind::Scene, record.owner.as_deref());
        let place = reserved.map_err(|full| self.overloaded(full))?;
        record.replica = shared.replicas.name().map(str::to_owned);
        let id = record.status.id.clone();
        shared.replicas.hold(&id);
        let kept = || -> Result<Option<SceneId>> {
            if let Some(other) = self.use_key(&files, &record)? {
                return Ok(Some(other));
            }
            shared.parts.store.put_upload(upload, &record).inspect_err(|_| {
                if let Some(key) = &record.idempotency_key {
                    // A key that stays leads to no scene and counts as unused.
                    let _ = shared.parts.store.forget_key(record.owner.as_deref(), key);
                }
            })?;
            Ok(None)
        };
        if let Some(other) = kept().inspect_err(|_| shared.release(&id))? {
            shared.release(&id);
            return Ok(other);
        }
        shared.uploads.keep(&id, Arc::new(ReadUpload { files, photos }));
        shared.records.insert(record);
        place.fill(id.clone());
        Ok(id)
    }

    /// The scene that an earlier call with this record's idempotency key made.
    fn earlier(&self, files: &[PhotoHash], record: &Record) -> Result<Option<SceneId>> {
        let Some(key) = &record.idempotency_key else { return Ok(None) };
        let owner = record.owner.as_deref();
        let Some(used) = self.shared.parts.store.key_use(owner, key)? else { return Ok(None) };
        self.refresh(&used.id)?;
        if self.shared.records.find(&used.id).is_none() {
            // Deleted, or never acknowledged.
            self.shared.parts.store.forget_key(owner, key)?;
            return Ok(None);
        }
        self.replayed(files, record, used).map(Some)
    }

    /// Notes the use of the record's key; gives the scene of a call that was faster.
    fn use_key(&self, files: &[PhotoHash], record: &Record) -> Result<Option<SceneId>> {
        let Some(key) = &record.idempotency_key else { return Ok(None) };
        let store = &self.shared.parts.store;
        let id = record.status.id.clone();
        let new = KeyUse { id: id.clone(), request_sha256: record.request_sha256.clone() };
        // The scene is announced before the key leads to it.
        store.announce(record)?;
        match store.use_key(record.owner.as_deref(), key, &new) {
            Ok(None) => Ok(None),
            Ok(Some(used)) => {
                store.drop_pending(&id)?;
                self.replayed(files, record, used).map(Some)
            }
            Err(error) => {
                let _ = store.drop_pending(&id);
                Err(error)
            }
        }
    }

    /// The scene of an earlier use of a key, if it was for the same request.
    fn replayed(&self, files: &[PhotoHash], record: &Record, used: KeyUse) -> Result<SceneId> {
        let (shared, id) = (&self.shared, used.id);
        if !store::is_of_request(&used.request_sha256, files, &record.options) {
            return Err(Error::invalid(format!(
                "the idempotency key was used for another upload (scene {id})"
            )));
        }
        let known = shared.records.find(&id);
        let over = known.is_some_and(|known| known.status.state.is_final());
        if !over && !shared.replicas.is_acknowledged(&shared.parts.store, &id)? {
            // Another replica still writes it and may fail: nothing is acknowledged for it.
            let message = format!("the first call with this idempotency key (scene {id}) is open");
            return Err(Error::new(ErrorCode::Overloaded, message).retry_after_s(1));
        }
        Ok(id)
    }

    /// Refuses where another scene of this owner would not be queued now.
    ///
    /// # Errors
    /// `overloaded` when the queue is full or the server stops.
    pub fn has_room(&self, owner: Option<&str>) -> Result<()> {
        let reserved = self.shared.queue.reserve(Kind::Scene, owner);
        reserved.map(drop).map_err(|full| self.overloaded(full))
    }

    fn overloaded(&self, full: Full) -> Error {
        let (message, seconds) = match full {
            Full::Closed => ("the server is stopping".to_owned(), 10),
            Full::All(max) => {
                (format!("{max} scenes wait already, the most that may"), self.next_place_s())
            }
            Full::Share(max) => {
                let message = format!("{max} scenes of this key wait already, the most that may");
                (message, self.next_place_s())
            }
        };
        Error::new(ErrorCode::Overloaded, message).retry_after_s(seconds)
    }

    /// Seconds until a place is likely to be free: what one scene took of late, over all workers.
    fn next_place_s(&self) -> u32 {
        let ms = self.shared.scene_ms.load(Ordering::Relaxed);
        let workers = self.shared.workers.load(Ordering::Relaxed).max(1) as u64;
        let seconds = if ms == 0 { 15 } else { (ms / workers).div_ceil(1_000) };
        u32::try_from(seconds.clamp(1, 60)).unwrap_or(60)
    }

    /// The newest record of a scene.
    ///
    /// # Errors
    /// `scene_not_found`.
    pub fn record(&self, id: &SceneId) -> Result<Record> {
        self.shared.records.find(id).ok_or_else(|| not_found(id))
    }

    /// A channel that holds the newest record; it closes when the scene is deleted.
    ///
    /// # Errors
    /// `scene_not_found`.
    pub fn watch(&self, id: &SceneId) -> Result<watch::Receiver<Record>> {
        self.shared.records.watch(id).ok_or_else(|| not_found(id))
    }

    /// Up to `limit` records of those to `show`, newest first, after the scene of that creation
    /// time and id; and whether more follow.
    #[must_use]
    pub fn page(
        &self,
        after: Option<(u64, SceneId)>,
        limit: usize,
        show: impl Fn(&Record) -> bool,
    ) -> (Vec<Record>, bool) {
        self.shared.records.page(after, limit, show)
    }

    /// Jobs that go before a waiting scene, 0 for any other.
    #[must_use]
    pub fn ahead(&self, id: &SceneId) -> usize {
        self.shared.queue.ahead(id).unwrap_or(0)
    }

    /// Whether the store may know more of this scene than this process.
    #[must_use]
    pub fn may_be_stale(&self, id: &SceneId) -> bool {
        self.shared.replicas.may_be_stale(id)
    }

    /// Reads what the store has of a scene that another replica makes. Blocks on the store.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn refresh(&self, id: &SceneId) -> Result<()> {
        let replicas = &self.shared.replicas;
        if replicas.may_be_stale(id) { replicas.refresh(&self.shared, id) } else { Ok(()) }
    }

    /// Reads what the store has of all scenes. Blocks on the store.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn refresh_all(&self) -> Result<()> {
        self.shared.replicas.refresh_all(&self.shared)
    }

    /// Stops the scene's jobs and removes everything that is kept of it. Blocks on the store.
    ///
    /// # Errors
    /// `scene_not_found`, `store_unavailable`.
    pub fn delete(&self, id: &SceneId) -> Result<()> {
        let shared = &self.shared;
        let record = self.record(id)?;
        shared.queue.remove(id);
        let at_work = shared.running.stop(Some(id), Reason::Cancelled);
        // A job that was about to end may have removed its own objects first: gone is gone.
        let removed = match shared.parts.store.remove(&record) {
            Err(error) if error.code() == ErrorCode::SceneNotFound => Ok(()),
            removed => removed,
        };
        if let Err(error) = removed {
            // It is there still, but nobody makes it any more.
            shared.records.update(id, |record| {
                if !record.status.state.is_final() {
                    record.status.state = SceneState::Cancelled;
                    record.status.stage = None;
                }
                if record.status.semantics.state == SemanticsState::Running {
                    record.status.semantics = SemanticsStatus::default();
                }
            });
            return Err(error);
        }
        if !at_work {
            shared.release(id);
        }
        if shared.records.remove(id) { Ok(()) } else { Err(not_found(id)) }
    }

    /// Watchers of a scene, callers who wait for it among them.
    #[must_use]
    pub fn watchers(&self, id: &SceneId) -> usize {
        self.shared.records.watchers(id)
    }

    /// Marks a finished scene as failed: its file turned out to be bad.
    pub fn spoil(&self, id: &SceneId, error: &Error) {
        self.shared.fail(Kind::Scene, id, error);
    }

    /// Scenes that wait for a worker, and scenes that a worker is at.
    #[must_use]
    pub fn counts(&self) -> (usize, usize) {
        let shared = &self.shared;
        (shared.queue.len(Kind::Scene), shared.running.scenes(Kind::Scene).len())
    }

    /// Where the networks stand.
    #[must_use]
    pub fn networks(&self) -> Networks {
        self.shared.parts.maker.networks()
    }

    /// Whether the queue takes jobs and a worker lives.
    #[must_use]
    pub fn is_open(&self) -> bool {
        !self.shared.queue.is_closed() && self.shared.workers.load(Ordering::Relaxed) > 0
    }

    /// Stops taking jobs, asks those at work to stop, waits for them. They are queued again at
    /// the next start.
    pub fn shut_down(&self) {
        self.shared.queue.close();
        self.shared.shutdown.begin();
        self.shared.running.stop(None, Reason::Shutdown);
        let mut threads = self.threads.lock().unwrap_or_else(PoisonError::into_inner);
        for thread in threads.drain(..) {
            if thread.join().is_err() {
                tracing::error!("a worker had panicked");
            }
        }
    }
}

impl Drop for Jobs {
    fn drop(&mut self) {
        self.shut_down();
    }
}

impl Shared {
    /// Takes up a scene that an earlier run of the program left.
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
        self.records.insert(record);
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
