//! One job: what kind it is, of which scene, and how it is stopped.

use std::sync::{
    Arc, OnceLock,
    atomic::{AtomicBool, Ordering},
};

use parking_lot::Mutex;

use super::{bell::Bell, kind::Kind};
use crate::scene::SceneId;

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
