//! One job: what it makes, of which scene, and how it is stopped.

use std::sync::{
    Arc, OnceLock,
    atomic::{AtomicBool, Ordering},
};

use parking_lot::Mutex;

use crate::{
    scene::{SceneId, Stage},
    store::Record,
};

/// What a job makes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Kind {
    /// A scene of an upload.
    Scene,
    /// The semantics of a finished scene.
    Semantics,
    /// Better versions of a finished scene.
    Refine,
}

impl Kind {
    /// Name in metrics, and name in messages.
    pub(super) fn names(self) -> (&'static str, &'static str) {
        match self {
            Self::Scene => ("scene", "the scene"),
            Self::Semantics => ("semantics", "the scene's semantics"),
            Self::Refine => ("refine", "the scene's refinement"),
        }
    }

    /// Puts the progress of a job into the record of its scene.
    pub(super) fn show(self, record: &mut Record, stage: Stage, fraction: f32) {
        let status = &mut record.status;
        let (shown, done) = match self {
            // The parts of its start are none of a refinement's own time.
            Self::Refine if stage != Stage::Refine => return,
            Self::Refine => {
                status.refinement.fraction = fraction;
                return;
            }
            Self::Scene => (&mut status.stage, &mut status.fraction),
            Self::Semantics => (&mut status.semantics.stage, &mut status.semantics.fraction),
        };
        *shown = Some(stage.name().to_owned());
        *done = stage.overall(fraction);
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
}

impl Job {
    /// Asks the job to stop; the first reason counts.
    pub(super) fn stop(&self, reason: Reason) {
        let _ = self.reason.set(reason);
        self.cancel.store(true, Ordering::Release);
    }

    /// Why it was asked to stop, `None` where it was not.
    pub(super) fn stopped(&self) -> Option<Reason> {
        self.reason.get().copied()
    }

    /// How it ended, for metrics.
    pub(super) fn outcome(&self, done: bool) -> &'static str {
        match (done, self.stopped()) {
            (true, _) => "done",
            (false, Some(Reason::Cancelled)) => "cancelled",
            (false, Some(Reason::Shutdown)) => "requeued",
            (false, _) => "failed",
        }
    }
}

/// The jobs that workers run.
#[derive(Debug, Default)]
pub(super) struct Running(Mutex<Vec<Arc<Job>>>);

impl Running {
    pub(super) fn begin(&self, kind: Kind, scene: SceneId) -> Arc<Job> {
        let cancel = AtomicBool::new(false);
        let job = Arc::new(Job { kind, scene, cancel, reason: OnceLock::new() });
        self.0.lock().push(Arc::clone(&job));
        job
    }

    pub(super) fn end(&self, job: &Arc<Job>) {
        self.0.lock().retain(|other| !Arc::ptr_eq(other, job));
    }

    /// Stops the jobs of a scene, or all.
    pub(super) fn stop(&self, scene: Option<&SceneId>, reason: Reason) {
        let running = self.0.lock();
        let jobs = running.iter().filter(|job| scene.is_none_or(|scene| job.scene == *scene));
        jobs.for_each(|job| job.stop(reason));
    }

    /// Whether a job of this scene runs.
    pub(super) fn has(&self, scene: &SceneId) -> bool {
        self.0.lock().iter().any(|job| job.scene == *scene)
    }

    /// Stops the jobs of a kind that a scene has.
    pub(super) fn stop_kind(&self, kind: Kind, scene: &SceneId, reason: Reason) {
        let running = self.0.lock();
        let jobs = running.iter().filter(|job| job.kind == kind && job.scene == *scene);
        jobs.for_each(|job| job.stop(reason));
    }

    /// Scenes of the running jobs of a kind.
    pub(super) fn scenes(&self, kind: Kind) -> Vec<SceneId> {
        let running = self.0.lock();
        running.iter().filter(|job| job.kind == kind).map(|job| job.scene.clone()).collect()
    }
}
