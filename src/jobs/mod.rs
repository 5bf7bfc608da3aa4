//! Jobs: a bounded queue, workers, progress for watchers, and a way to stop each job.
//!
//! A job makes a scene of an upload, or the semantics of a scene, or changes its photos, or refines
//! it: `KINDS` lists the kinds, each of which is one file with a `JobKind` and its `Work`. In: an
//! upload, safe in the store before `Jobs::submit` returns. Out: a scene in the store. Invariant:
//! an acknowledged scene is made, fails with a code, or is cancelled, over any restart.

mod background;
mod bell;
mod change;
mod grow;
mod job;
mod kind;
mod networks;
mod photos;
mod queue;
mod records;
mod refine;
mod refiner;
mod replicas;
mod room;
mod scene;
mod semantics;
mod shared;
mod submit;
mod worker;

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    time::Duration,
};

use parking_lot::Mutex;

pub use self::networks::{
    NetworkState, NoSemantics, Phrases, PipelineNetworks, SceneNetworks, SemanticNetworks,
};

pub(crate) use self::{refine::refine_options, refiner::Refiner};

pub(crate) use self::shared::{JobParts, Jobs};

use self::{
    bell::Bell,
    change::{Attempt, Change, forget_semantics_job},
    grow::{GROW, GrowScene},
    job::{Reason, Running},
    photos::ReadUploads,
    queue::Queue,
    records::Records,
    refine::{REFINE, RefineScene},
    room::Room,
    scene::{MakeScene, SCENE},
    semantics::{MakeSemantics, SEMANTICS},
    shared::Work,
};
use crate::{
    error::{Error, Result},
    scene::{SceneState, SemanticsMode},
    store::{self, Record},
    telemetry::meter,
};

/// Every kind of job.
const KINDS: [&dyn Work; 4] = [&MakeScene, &MakeSemantics, &GrowScene, &RefineScene];

/// Names of the kinds of job, as in metrics.
pub fn kinds() -> impl Iterator<Item = &'static str> {
    KINDS.into_iter().map(|kind| kind.name())
}

impl Jobs {
    /// Starts the threads, and queues again what was queued or running when the program last
    /// stopped. The threads live until [`Self::shut_down`].
    /// Fails with `internal` when a thread cannot be started.
    pub(crate) fn start(parts: JobParts, mut records: Vec<Record>) -> Result<Arc<Self>> {
        let (limits, bell) = (parts.limits.get(), Arc::<Bell>::default());
        let jobs = Arc::new(Self {
            kinds: &KINDS,
            records: Records::new(Arc::clone(&parts.store), Arc::clone(&bell)),
            queue: Queue::new(limits.queued_jobs_max),
            running: Running::new(Arc::clone(&bell)),
            uploads: ReadUploads::new(
                limits.read_uploads_bytes_max,
                Duration::from_millis(limits.first_text_photos_ms),
            ),
            room: Room::new(Arc::clone(&bell)),
            replicas: replicas::of(&parts)?,
            workers: AtomicUsize::new(parts.workers),
            locked: Mutex::default(),
            ordering: Mutex::default(),
            bell,
            scene_ms: AtomicU64::new(0),
            freed: AtomicBool::new(false),
            threads: Mutex::default(),
            parts,
        });
        records.sort_by_key(|record| record.status.created_ms);
        for record in records {
            jobs.take_up(record);
        }
        meter::register_jobs(kinds());
        let start = |name: String, life: Box<dyn FnOnce(&Self) + Send>| {
            let shared = Arc::clone(&jobs);
            let thread = std::thread::Builder::new().name(name).spawn(move || life(&shared));
            let thread =
                thread.map_err(|e| Error::internal("no thread can be started").caused_by(e))?;
            jobs.threads.lock().push(thread);
            Ok(())
        };
        let start_all = || {
            for kind in KINDS {
                for i in 0..kind.threads(jobs.parts.workers) {
                    let name = format!("{}-{i}", kind.name());
                    start(name, Box::new(move |jobs| jobs.work(kind)))?;
                }
            }
            start("sweeper".to_owned(), Box::new(Self::sweep))?;
            if jobs.replicas.name().is_some() {
                start("replicas".to_owned(), Box::new(|jobs| jobs.replicas.watch(jobs)))?;
            }
            Ok(())
        };
        start_all().inspect_err(|_| jobs.shut_down())?;
        Ok(jobs)
    }

    /// Whether the queue takes jobs, a worker lives, and the store keeps what it is given.
    pub(crate) fn is_open(&self) -> bool {
        !self.queue.is_closed()
            && self.workers.load(Ordering::Relaxed) > 0
            && self.parts.store.keeps()
    }

    /// Stops taking jobs, asks running ones to stop, waits for them. They are queued again at the
    /// next start.
    pub(crate) fn shut_down(&self) {
        self.queue.close();
        self.running.stop(Reason::Shutdown, |_| true);
        self.bell.ring();
        for thread in self.threads.lock().drain(..) {
            if thread.join().is_err() {
                tracing::error!("a worker had panicked");
            }
        }
    }

    /// Continues a scene that an earlier run of the program left.
    fn take_up(&self, mut record: Record) {
        let (id, owner) = (record.status.id.clone(), record.owner.clone());
        let (queued, ordered) =
            (Change::Requeued(SCENE, Attempt::Counts), Change::SemanticsOrdered);
        let now_ms = store::now_ms();
        let unfinished = !record.status.state.is_final();
        if unfinished {
            tracing::info!(scene = %id, attempts = record.attempts, "queued again");
            queued.apply(&mut record, now_ms);
        }
        forget_semantics_job(&mut record);
        let done = record.status.state == SceneState::Done;
        let eager = done
            && record.options.semantics == SemanticsMode::Eager
            && self.parts.semantics.lacks().is_none()
            && ordered.apply(&mut record, now_ms);
        let refined = done && record.refine.is_some();
        let grows = done && !record.growth.waiting.is_empty();
        self.records.insert(record.clone());
        if refined {
            self.mend(&record);
        }
        let waiting = [(REFINE, refined), (GROW, grows), (SEMANTICS, eager), (SCENE, unfinished)];
        for (kind, waits) in waiting {
            if waits {
                self.replicas.hold(&id);
                self.queue.push(kind, id.clone(), owner.as_deref());
            }
        }
    }
}
