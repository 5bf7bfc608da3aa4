//! One job: what it makes, of which scene, and how it is stopped.

use std::{
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU8, Ordering},
    },
    time::Duration,
};

use crate::{
    error::{Error, ErrorCode},
    limits::Limits,
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
}

impl Kind {
    /// Name in metrics and spans.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Scene => "scene",
            Self::Semantics => "semantics",
        }
    }

    /// Name in messages.
    pub(super) fn what(self) -> &'static str {
        match self {
            Self::Scene => "the scene",
            Self::Semantics => "the scene's semantics",
        }
    }

    /// Puts the progress of a job into the record of its scene.
    pub(super) fn show(self, record: &mut Record, stage: Stage, fraction: f32) {
        let status = &mut record.status;
        let (shown, done) = match self {
            Self::Scene => (&mut status.stage, &mut status.fraction),
            Self::Semantics => (&mut status.semantics.stage, &mut status.semantics.fraction),
        };
        *shown = Some(stage.name().to_owned());
        *done = stage.overall(fraction);
    }
}

/// Why a job was stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Reason {
    /// The scene is deleted, or another replica makes it.
    Cancelled = 1,
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
    /// 0, or a [`Reason`].
    reason: AtomicU8,
}

impl Job {
    pub(super) fn new(kind: Kind, scene: SceneId) -> Self {
        Self { kind, scene, cancel: AtomicBool::new(false), reason: AtomicU8::new(0) }
    }

    /// Asks the job to stop; the first reason counts.
    pub(super) fn stop(&self, reason: Reason) {
        let _ = self.reason.compare_exchange(0, reason as u8, Ordering::AcqRel, Ordering::Acquire);
        self.cancel.store(true, Ordering::Release);
    }

    /// Why it was asked to stop, `None` where it was not.
    pub(super) fn stopped(&self) -> Option<Reason> {
        let reason = self.reason.load(Ordering::Acquire);
        let all = [Reason::Cancelled, Reason::Timeout, Reason::Shutdown];
        all.into_iter().find(|known| *known as u8 == reason)
    }

    /// The error of a job that was asked to stop; `None` where it was not.
    pub(super) fn stop_error(&self, limits: &Limits) -> Option<Error> {
        let what = self.kind.what();
        Some(match self.stopped()? {
            Reason::Cancelled => Error::new(ErrorCode::Cancelled, format!("{what}: cancelled")),
            Reason::Timeout => {
                let seconds = Duration::from_millis(limits.scene_timeout_ms).as_secs_f64();
                let message = format!("{what} took longer than {seconds} s");
                Error::new(ErrorCode::DeadlineExceeded, message)
            }
            Reason::Shutdown => {
                let message = format!("{what}: the server is stopping");
                Error::new(ErrorCode::Overloaded, message).retry_after_s(10)
            }
        })
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

/// The jobs that workers are at.
#[derive(Debug, Default)]
pub(super) struct Running(Mutex<Vec<Arc<Job>>>);

impl Running {
    pub(super) fn begin(&self, kind: Kind, scene: SceneId) -> Arc<Job> {
        let job = Arc::new(Job::new(kind, scene));
        self.lock().push(Arc::clone(&job));
        job
    }

    pub(super) fn end(&self, job: &Job) {
        self.lock().retain(|other| !std::ptr::eq(&**other, job));
    }

    /// Stops the jobs of a scene, or all; whether there were any.
    pub(super) fn stop(&self, scene: Option<&SceneId>, reason: Reason) -> bool {
        let running = self.lock();
        let its = running.iter().filter(|job| scene.is_none_or(|scene| job.scene == *scene));
        let mut any = false;
        for job in its {
            job.stop(reason);
            any = true;
        }
        any
    }

    /// Scenes that jobs of this kind are at.
    pub(super) fn scenes(&self, kind: Kind) -> Vec<SceneId> {
        let running = self.lock();
        running.iter().filter(|job| job.kind == kind).map(|job| job.scene.clone()).collect()
    }

    fn lock(&self) -> MutexGuard<'_, Vec<Arc<Job>>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
