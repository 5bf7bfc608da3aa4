//! Scenes in the making: a bounded queue, workers, progress that late watchers pick up, cancel.
//!
//! In: an upload, made safe on disk before [`Jobs::submit`] returns. Out: a scene in the store.
//! Invariant: what was acknowledged is made, failed with a code, or cancelled, over any restart.

mod board;
mod keeper;
mod maker;
mod peers;
mod queue;
mod semantics;
mod worker;

use std::{
    collections::{HashMap, HashSet},
    fmt,
    sync::{
        Arc, Condvar, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    thread::JoinHandle,
    time::Instant,
};

use tokio::sync::watch;

pub use self::{
    maker::{PipelineMaker, PipelineSemantics},
    semantics::{NoSemantics, Phrases, SemanticsMaker, SemanticsWork, TextEmbedding},
};

use self::{
    board::Board,
    queue::{Full, Queue},
    worker::Stop,
};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
    scene::{
        Backdrop, Gaussians, HealthReport, PhotoHash, SceneCamera, SceneId, SceneOptions,
        SceneState, SemanticsMode, SemanticsState, SemanticsStatus, Upload,
    },
    store::{self, KeyUse, Record, Store, not_found},
};

/// What a job asks for, and how it tells where it is.
#[derive(Clone, Copy)]
pub struct Work<'a> {
    /// Photos and cameras.
    pub upload: &'a Upload,
    /// Options of the call.
    pub options: &'a SceneOptions,
    /// Tells the stage at work and the share of the whole that is done, 0..1.
    pub progress: &'a (dyn Fn(&str, f32) + Sync),
    /// Turns true when the work is to stop; the answer is then `cancelled`.
    pub cancel: &'a AtomicBool,
}

impl fmt::Debug for Work<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Work").field("options", self.options).finish_non_exhaustive()
    }
}

/// What a job gives.
#[derive(Clone, Debug)]
pub struct Made {
    /// The Gaussians.
    pub gaussians: Gaussians,
    /// The photos' colours by direction.
    pub backdrop: Backdrop,
    /// Health report.
    pub report: HealthReport,
    /// Cameras of the photos.
    pub cameras: Vec<SceneCamera>,
    /// sha256 of the bundle's manifest, hex; empty where no network was used.
    pub bundle_sha256: String,
}

/// Where the networks of a maker stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Networks {
    /// They are being opened; what is queued waits for that.
    Opening,
    /// They are open, on this execution provider; empty: there are none to open.
    Open(&'static str),
    /// They do not open: nothing is taken from the queue, so that nothing in it fails.
    Broken,
}

/// Turns an upload into a scene: the pipeline, or a stand-in of a test.
pub trait SceneMaker: Send + Sync {
    /// What else than upload and options decides the scene: the networks, by their hash.
    fn identity(&self) -> String {
        String::new()
    }

    /// Whether its networks are open.
    fn networks(&self) -> Networks {
        Networks::Open("")
    }

    /// Refuses an upload that cannot be made, before it is acknowledged. On the calling thread.
    ///
    /// # Errors
    /// `invalid_request`, `photo_unreadable`, `limit_exceeded`; each names photo, value and bound.
    fn check(&self, upload: &Upload, limits: &Limits) -> Result<()>;

    /// Does the whole work on the calling thread.
    ///
    /// # Errors
    /// Any code; it becomes the scene's `error`.
    fn make(&self, work: Work<'_>) -> Result<Made>;
}

/// The queue, its workers and the state of every scene.
pub struct Jobs {
    shared: Arc<Shared>,
    workers: Mutex<Vec<JoinHandle<()>>>,
}

struct Shared {
    store: Arc<Store>,
    maker: Arc<dyn SceneMaker>,
    limits: Limits,
    board: Board,
    queue: Queue,
    running: Mutex<HashMap<SceneId, Arc<Stop>>>,
    semantics: Arc<dyn SemanticsMaker>,
    /// Scenes whose semantics were asked for.
    asked: Queue,
    thinking: Mutex<HashMap<SceneId, Arc<Stop>>>,
    workers: AtomicUsize,
    /// Whether the photos of finished scenes are kept.
    keep_photos: bool,
    /// Name of this process among those that share the store.
    replica: String,
    /// Scenes that this process works on, or is to.
    mine: Mutex<HashSet<SceneId>>,
    /// When scenes made elsewhere were last read.
    fresh: Mutex<HashMap<SceneId, Instant>>,
    listed: Mutex<Listed>,
    /// Content hashes being made, and their end.
    making: Mutex<HashSet<String>>,
    made: Condvar,
    /// Milliseconds that the last scenes took, smoothed; 0: none was made yet.
    scene_ms: AtomicU64,
    stopping: Mutex<bool>,
    stopped: Condvar,
}

/// What the store listed last, and when.
#[derive(Debug, Default)]
struct Listed {
    stamps: HashMap<SceneId, String>,
    at: Option<Instant>,
}

/// An unfinished record as it stands before anybody makes it.
fn requeued(record: &mut Record) {
    record.status.state = SceneState::Queued;
    record.status.stage = None;
    record.status.fraction = 0.0;
}

impl fmt::Debug for Jobs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Jobs").field("queue", &self.shared.queue).finish_non_exhaustive()
    }
}

impl Jobs {
    /// Starts `workers` threads and queues again what was queued or running when the program
    /// last stopped. `keep_photos`: whether the photos of finished scenes are kept.
    ///
    /// # Errors
    /// `internal` when a thread cannot be started.
    pub fn start(
        store: Arc<Store>,
        maker: Arc<dyn SceneMaker>,
        semantics: Arc<dyn SemanticsMaker>,
        mut records: Vec<Record>,
        limits: &Limits,
        (workers, keep_photos): (usize, bool),
    ) -> Result<Self> {
        let shared = Arc::new(Shared {
            store,
            maker,
            limits: limits.clone(),
            board: Board::default(),
            queue: Queue::new(limits.queued_jobs_max),
            running: Mutex::default(),
            semantics,
            asked: Queue::new(limits.queued_jobs_max),
            thinking: Mutex::default(),
            workers: AtomicUsize::new(workers),
            keep_photos,
            replica: replica_name(),
            mine: Mutex::default(),
            fresh: Mutex::default(),
            listed: Mutex::default(),
            making: Mutex::default(),
            made: Condvar::new(),
            scene_ms: AtomicU64::new(0),
            stopping: Mutex::default(),
            stopped: Condvar::new(),
        });
        records.sort_by_key(|record| record.status.created_ms);
        for mut record in records {
            let id = record.status.id.clone();
            let unfinished = !record.status.state.is_final();
            if unfinished {
                tracing::info!(scene = %id, attempts = record.attempts, "queued again");
                requeued(&mut record);
            }
            semantics::at_start(&mut record);
            let eager = !unfinished
                && record.options.semantics == SemanticsMode::Eager
                && record.status.state == SceneState::Done
                && record.status.semantics.state == SemanticsState::None
                && shared.semantics.lacks().is_none();
            if eager {
                record.status.semantics.state = SemanticsState::Running;
            }
            let owner = record.owner.clone();
            shared.board.insert(record);
            if eager || unfinished {
                shared.hold(&id);
            }
            if eager {
                shared.asked.push(id, owner.as_deref());
            } else if unfinished {
                shared.queue.push(id, owner.as_deref());
            }
        }
        let start = |name: String, life: fn(&Shared)| {
            let shared = Arc::clone(&shared);
            std::thread::Builder::new()
                .name(name)
                .spawn(move || life(&shared))
                .map_err(|e| Error::internal("no thread can be started").caused_by(e))
        };
        let mut threads = (0..workers)
            .map(|i| start(format!("scene-{i}"), Shared::work))
            .collect::<Result<Vec<_>>>()?;
        // One is enough: a scene's semantics use every core already.
        threads.push(start("semantics".to_owned(), Shared::think)?);
        threads.push(start("housekeeper".to_owned(), Shared::keep_house)?);
        if shared.store.is_shared() {
            threads.push(start("peers".to_owned(), Shared::live_with_peers)?);
        }
        Ok(Self { shared, workers: Mutex::new(threads) })
    }

    /// Makes an upload safe on disk and queues it; gives its id, or that of the scene which an
    /// earlier call with the same idempotency key made. Blocks on the store.
    ///
    /// # Errors
    /// `invalid_request` when the key was used for another upload, `overloaded` when the queue is
    /// full or the server stops, `store_unavailable`.
    pub fn submit(
        &self,
        upload: &Upload,
        files: &[PhotoHash],
        mut record: Record,
    ) -> Result<SceneId> {
        // First, so that a full queue still answers for what it holds.
        if let Some(earlier) = self.earlier(files, &record)? {
            return Ok(earlier);
        }
        let shared = &self.shared;
        let place =
            shared.queue.reserve(record.owner.as_deref()).map_err(|full| self.overloaded(full))?;
        if shared.store.is_shared() {
            record.replica = Some(shared.replica.clone());
        }
        let id = record.status.id.clone();
        shared.hold(&id);
        let kept = || -> Result<Option<SceneId>> {
            if let Some(other) = self.use_key(files, &record)? {
                return Ok(Some(other));
            }
            shared.store.put_upload(upload, &record).inspect_err(|_| {
                if let Some(key) = &record.idempotency_key {
                    // One that stays leads to no scene, and is looked through.
                    let _ = shared.store.forget_key(record.owner.as_deref(), key);
                }
            })?;
            Ok(None)
        };
        if let Some(other) = kept().inspect_err(|_| shared.done_with(&id))? {
            shared.done_with(&id);
            return Ok(other);
        }
        shared.board.insert(record);
        place.fill(id.clone());
        Ok(id)
    }

    /// The scene that an earlier call with this record's idempotency key made.
    fn earlier(&self, files: &[PhotoHash], record: &Record) -> Result<Option<SceneId>> {
        let Some(key) = &record.idempotency_key else { return Ok(None) };
        let owner = record.owner.as_deref();
        let Some(used) = self.shared.store.key_use(owner, key)? else { return Ok(None) };
        self.refresh(&used.id)?;
        if self.shared.board.find(&used.id).is_none() {
            // Deleted, or never acknowledged.
            self.shared.store.forget_key(owner, key)?;
            return Ok(None);
        }
        self.replayed(files, record, used).map(Some)
    }

    /// Notes the use of the record's key; gives the scene of a call that was faster.
    fn use_key(&self, files: &[PhotoHash], record: &Record) -> Result<Option<SceneId>> {
        let Some(key) = &record.idempotency_key else { return Ok(None) };
        let store = &self.shared.store;
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
        let id = used.id;
        if !store::is_of_request(&used.request_sha256, files, &record.options) {
            return Err(Error::invalid(format!(
                "the idempotency key was used for another upload (scene {id})"
            )));
        }
        let known = self.shared.board.find(&id);
        let over = known.is_some_and(|known| known.status.state.is_final());
        if !over && self.shared.store.is_shared() && !self.shared.store.was_acknowledged(&id)? {
            // Another replica is writing it, and may fail yet: nothing is acknowledged for it.
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
        self.shared.queue.reserve(owner).map(drop).map_err(|full| self.overloaded(full))
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
        self.shared.board.find(id).ok_or_else(|| not_found(id))
    }

    /// A channel that holds the newest record; it closes when the scene is deleted.
    ///
    /// # Errors
    /// `scene_not_found`.
    pub fn watch(&self, id: &SceneId) -> Result<watch::Receiver<Record>> {
        self.shared.board.watch(id).ok_or_else(|| not_found(id))
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
        self.shared.board.page(after, limit, show)
    }

    /// Jobs that go before a waiting one, 0 for any other.
    #[must_use]
    pub fn ahead(&self, id: &SceneId) -> usize {
        self.shared.queue.ahead(id).unwrap_or(0)
    }

    /// Stops the scene's job if it has one and removes all that is kept. Blocks on the disk.
    ///
    /// # Errors
    /// `scene_not_found`, `store_unavailable`.
    pub fn delete(&self, id: &SceneId) -> Result<()> {
        let shared = &self.shared;
        let record = self.record(id)?;
        shared.queue.remove(id);
        shared.asked.remove(id);
        let mut at_work = false;
        for working in [shared.lock_running(), shared.lock_thinking()] {
            if let Some(stop) = working.get(id) {
                stop.by_caller();
                at_work = true;
            }
        }
        // A job that was about to end may have removed its own objects first: gone is gone.
        let removed = match shared.store.remove(&record) {
            Err(error) if error.code() == ErrorCode::SceneNotFound => Ok(()),
            removed => removed,
        };
        if let Err(error) = removed {
            // It is there still, but nobody makes it any more.
            shared.board.update(id, |record| {
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
            shared.done_with(id);
        }
        if shared.board.remove(id) { Ok(()) } else { Err(not_found(id)) }
    }

    /// Watchers of a scene, callers who wait for it among them.
    #[must_use]
    pub fn watchers(&self, id: &SceneId) -> usize {
        self.shared.board.watchers(id)
    }

    /// Marks a finished scene as failed: its file turned out to be bad.
    pub fn spoil(&self, id: &SceneId, error: &Error) {
        self.shared.fail(id, error);
    }

    /// Jobs that wait and jobs at work.
    #[must_use]
    pub fn counts(&self) -> (usize, usize) {
        (self.shared.queue.len(), self.shared.lock_running().len())
    }

    /// Where the networks stand.
    #[must_use]
    pub fn networks(&self) -> Networks {
        self.shared.maker.networks()
    }

    /// Whether the queue takes jobs and every worker lives.
    #[must_use]
    pub fn is_open(&self) -> bool {
        !self.shared.queue.is_closed() && self.shared.workers.load(Ordering::Relaxed) > 0
    }

    /// Stops taking jobs, asks those at work to stop, waits for them. They are queued again at
    /// the next start.
    pub fn shut_down(&self) {
        self.shared.queue.close();
        self.shared.asked.close();
        self.shared.end_rest();
        for at_work in [self.shared.lock_running(), self.shared.lock_thinking()] {
            for stop in at_work.values() {
                stop.by_shutdown();
            }
        }
        let mut workers = self.workers.lock().unwrap_or_else(PoisonError::into_inner);
        for worker in workers.drain(..) {
            if worker.join().is_err() {
                tracing::error!("a worker had panicked");
            }
        }
    }
}

impl Shared {
    /// From now on this process works on the scene, and its board is the truth about it.
    fn hold(&self, id: &SceneId) {
        self.mine.lock().unwrap_or_else(PoisonError::into_inner).insert(id.clone());
    }

    /// This process writes nothing of the scene any more.
    fn done_with(&self, id: &SceneId) {
        self.mine.lock().unwrap_or_else(PoisonError::into_inner).remove(id);
    }
}

/// Tells this process from every other that uses the store.
fn replica_name() -> String {
    use std::hash::BuildHasher;
    let random = || std::hash::RandomState::new().hash_one(std::process::id());
    format!("{:016x}{:016x}", random(), random())
}

impl Drop for Jobs {
    fn drop(&mut self) {
        self.shut_down();
    }
}
