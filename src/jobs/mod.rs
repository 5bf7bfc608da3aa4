//! Scenes in the making: a bounded queue, workers, progress that late watchers pick up, cancel.
//!
//! In: an upload, made safe on disk before [`Jobs::submit`] returns. Out: a scene in the store.
//! Invariant: what was acknowledged is made, failed with a code, or cancelled, over any restart.

mod board;
mod maker;
mod queue;
mod semantics;
mod worker;

use std::{
    collections::HashMap,
    fmt,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread::JoinHandle,
};

use tokio::sync::watch;

pub use self::{
    maker::{PipelineMaker, PipelineSemantics},
    semantics::{NoSemantics, Phrases, SemanticsMaker, SemanticsWork, TextEmbedding},
};

use self::{board::Board, queue::Queue, worker::Stop};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
    scene::{
        Backdrop, Gaussians, HealthReport, SceneCamera, SceneId, SceneOptions, SceneState,
        SemanticsMode, SemanticsState, Upload,
    },
    store::{Record, Store, not_found},
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

/// Turns an upload into a scene: the pipeline, or a stand-in of a test.
pub trait SceneMaker: Send + Sync {
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
}

impl fmt::Debug for Jobs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Jobs").field("queue", &self.shared.queue).finish_non_exhaustive()
    }
}

impl Jobs {
    /// Starts `workers` threads and queues again what was queued or running when the program
    /// last stopped.
    ///
    /// # Errors
    /// `internal` when a thread cannot be started.
    pub fn start(
        store: Arc<Store>,
        maker: Arc<dyn SceneMaker>,
        semantics: Arc<dyn SemanticsMaker>,
        mut records: Vec<Record>,
        limits: &Limits,
        workers: usize,
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
        });
        records.sort_by_key(|record| record.status.created_ms);
        for mut record in records {
            let id = record.status.id.clone();
            let unfinished = !record.status.state.is_final();
            if unfinished {
                tracing::info!(scene = %id, attempts = record.attempts, "queued again");
                record.status.state = SceneState::Queued;
                record.status.stage = None;
                record.status.fraction = 0.0;
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
            shared.board.insert(record);
            if eager {
                shared.asked.push(id);
            } else if unfinished {
                shared.queue.push(id);
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
        Ok(Self { shared, workers: Mutex::new(threads) })
    }

    /// Makes an upload safe on disk and queues it. Blocks on the disk.
    ///
    /// # Errors
    /// `overloaded` when the queue is full or the server stops, `store_unavailable`.
    pub fn submit(&self, upload: &Upload, record: Record) -> Result<()> {
        let place = self.shared.queue.reserve().ok_or_else(|| self.overloaded())?;
        self.shared.store.put_upload(upload, &record)?;
        let id = record.status.id.clone();
        self.shared.board.insert(record);
        place.fill(id);
        Ok(())
    }

    fn overloaded(&self) -> Error {
        if self.shared.queue.is_closed() {
            return Error::new(ErrorCode::Overloaded, "the server is stopping").retry_after_s(10);
        }
        let max = self.shared.limits.queued_jobs_max;
        Error::new(ErrorCode::Overloaded, format!("{max} scenes wait already, the most that may"))
            .retry_after_s(15)
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
        if !self.shared.board.remove(id) {
            return Err(not_found(id));
        }
        self.shared.queue.remove(id);
        self.shared.asked.remove(id);
        for at_work in [self.shared.lock_running(), self.shared.lock_thinking()] {
            if let Some(stop) = at_work.get(id) {
                stop.by_caller();
            }
        }
        self.shared.store.remove(id)
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

impl Drop for Jobs {
    fn drop(&mut self) {
        self.shut_down();
    }
}
