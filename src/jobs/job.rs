//! One job: what kind it is, of which scene, and how it is stopped.

use std::{
    fmt,
    hash::{Hash, Hasher},
    sync::{
        Arc, OnceLock,
        atomic::{AtomicBool, Ordering},
    },
};

use parking_lot::Mutex;

use super::{Jobs, bell::Bell};
use crate::{
    error::Result,
    scene::{SceneError, SceneId, SceneStatus, Stage},
    store::Record,
};

/// A kind of job. `super::KINDS` lists all; queue, workers, records and metrics take them from
/// there.
pub(super) trait JobKind: Send + Sync {
    /// Name in metrics, spans and names of threads.
    fn name(&self) -> &'static str;

    /// What it makes, in messages.
    fn what(&self) -> &'static str;

    /// Threads of a server that makes so many scenes at a time.
    fn threads(&self, scenes: usize) -> usize {
        scenes
    }

    /// The span of a job.
    fn span(&self, jobs: &Jobs, id: &SceneId) -> tracing::Span;

    /// Does the whole work.
    fn run(&self, jobs: &Jobs, job: &Job) -> Result<()>;

    /// Puts the progress of a job into the status of its scene; `fraction` is that of the stage.
    fn show(&self, status: &mut SceneStatus, stage: Stage, fraction: f32);

    /// Whether the store keeps that the job is to be done. Such a job goes on after a stop of the
    /// server and when the store works again, and its end is kept.
    fn lasts(&self) -> bool {
        true
    }

    /// How often the job was begun without a result, where it lasts.
    fn attempts<'a>(&self, _: &'a mut Record) -> Option<&'a mut u32> {
        None
    }

    /// A worker begins: one attempt is counted already.
    fn started(&self, _: &mut Record, _now_ms: u64) {}

    /// The job waits again, from its start.
    fn requeued(&self, _: &mut Record) {}

    /// The job has failed.
    fn failed(&self, record: &mut Record, error: SceneError, now_ms: u64);

    /// What else ends when a job has failed.
    fn after_failure(&self, _: &Jobs, _: &SceneId) {}
}

/// One of `super::KINDS`.
pub(super) type Kind = &'static dyn JobKind;

impl PartialEq for dyn JobKind {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl Eq for dyn JobKind {}

impl Hash for dyn JobKind {
    fn hash<H: Hasher>(&self, to: &mut H) {
        self.name().hash(to);
    }
}

impl fmt::Debug for dyn JobKind {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        to.write_str(self.name())
    }
}

/// Why a job was stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Reason {
    /// The scene is deleted, or another replica makes it.
    Cancelled,
    /// It took too long.
    Timeout,
    /// The server stops.
    Shutdown,
}

/// A job that a worker has taken.
#[derive(Debug)]
pub(super) struct Job {
    pub(super) kind: Kind,
    pub(super) scene: SceneId,
    pub(super) cancel: AtomicBool,
    reason: OnceLock<Reason>,
    bell: Arc<Bell>,
}

impl Job {
    /// Asks the job to stop; the first reason counts.
    pub(super) fn stop(&self, reason: Reason) {
        let _ = self.reason.set(reason);
        self.cancel.store(true, Ordering::Release);
        self.bell.ring();
    }

    /// Why it was asked to stop, `None` where it was not.
    pub(super) fn stopped(&self) -> Option<Reason> {
        self.reason.get().copied()
    }
}

/// The jobs that workers run.
#[derive(Debug)]
pub(super) struct Running {
    jobs: Mutex<Vec<Arc<Job>>>,
    bell: Arc<Bell>,
}

impl Running {
    pub(super) fn new(bell: Arc<Bell>) -> Self {
        Self { jobs: Mutex::default(), bell }
    }

    pub(super) fn begin(&self, kind: Kind, scene: SceneId) -> Arc<Job> {
        let (cancel, reason, bell) = (AtomicBool::new(false), OnceLock::new(), &self.bell);
        let job = Arc::new(Job { kind, scene, cancel, reason, bell: Arc::clone(bell) });
        self.jobs.lock().push(Arc::clone(&job));
        job
    }

    pub(super) fn end(&self, job: &Arc<Job>) {
        self.jobs.lock().retain(|other| !Arc::ptr_eq(other, job));
        self.bell.ring();
    }

    /// Stops the jobs for which `is` holds.
    pub(super) fn stop(&self, reason: Reason, is: impl Fn(&Job) -> bool) {
        self.jobs.lock().iter().filter(|job| is(job)).for_each(|job| job.stop(reason));
    }

    /// Whether a job of this scene runs.
    pub(super) fn has(&self, scene: &SceneId) -> bool {
        self.jobs.lock().iter().any(|job| job.scene == *scene)
    }

    /// Scenes of the running jobs of a kind.
    pub(super) fn scenes(&self, kind: Kind) -> Vec<SceneId> {
        let jobs = self.jobs.lock();
        jobs.iter().filter(|job| job.kind == kind).map(|job| job.scene.clone()).collect()
    }
}
