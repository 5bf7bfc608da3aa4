//! One worker: takes a job, runs it with a time limit, keeps what it gives; outlives its panics.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU8, Ordering},
        mpsc::{self, RecvTimeoutError},
    },
    time::Duration,
};

use super::{Made, Shared, Work};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
    scene::{
        Provenance, Scene, SceneError, SceneId, SceneMeta, SceneState, SemanticsMode,
        SemanticsState, SemanticsStatus,
    },
    store::{self, Record},
    telemetry::meter,
};

/// Starts of one job before it is given up: a scene that kills the server must not do so forever.
const ATTEMPTS_MAX: u32 = 3;

/// Asks a job to stop, and remembers why: the first reason counts.
#[derive(Debug, Default)]
pub(super) struct Stop {
    flag: AtomicBool,
    reason: AtomicU8,
}

const BY_CALLER: u8 = 1;
const BY_TIMEOUT: u8 = 2;
const BY_SHUTDOWN: u8 = 3;

impl Stop {
    fn ask(&self, reason: u8) {
        // Whoever asked first is the reason.
        let _ = self.reason.compare_exchange(0, reason, Ordering::AcqRel, Ordering::Acquire);
        self.flag.store(true, Ordering::Release);
    }

    pub(super) fn by_caller(&self) {
        self.ask(BY_CALLER);
    }

    pub(super) fn by_shutdown(&self) {
        self.ask(BY_SHUTDOWN);
    }

    pub(super) fn flag(&self) -> &AtomicBool {
        &self.flag
    }

    /// The error of work that was stopped, `None` where nobody asked it to; `what` begins it.
    pub(super) fn told(&self, limits: &Limits, what: &str) -> Option<Error> {
        match self.reason() {
            BY_CALLER => Some(Error::new(ErrorCode::Cancelled, format!("{what}: cancelled"))),
            BY_TIMEOUT => {
                let seconds = Duration::from_millis(limits.scene_timeout_ms).as_secs_f64();
                let message = format!("{what} took longer than {seconds} s");
                Some(Error::new(ErrorCode::DeadlineExceeded, message))
            }
            BY_SHUTDOWN => {
                let message = format!("{what}: the server is stopping");
                Some(Error::new(ErrorCode::Overloaded, message).retry_after_s(10))
            }
            _ => None,
        }
    }

    /// How the work ended, for metrics.
    pub(super) fn outcome(&self, done: bool) -> &'static str {
        match (done, self.reason()) {
            (true, _) => "done",
            (false, BY_CALLER) => "cancelled",
            (false, BY_SHUTDOWN) => "requeued",
            (false, _) => "failed",
        }
    }

    fn reason(&self) -> u8 {
        self.reason.load(Ordering::Acquire)
    }
}

impl Shared {
    pub(super) fn lock_running(
        &self,
    ) -> MutexGuard<'_, std::collections::HashMap<SceneId, Arc<Stop>>> {
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The life of a worker thread.
    pub(super) fn work(&self) {
        while let Some(id) = self.queue.pop() {
            let stop = Arc::new(Stop::default());
            self.lock_running().insert(id.clone(), Arc::clone(&stop));
            if self.queue.is_closed() {
                stop.by_shutdown();
            }
            // Whatever `make` panics with, its half-made values die with it.
            let outcome = catch_unwind(AssertUnwindSafe(|| self.run(&id, &stop)))
                .unwrap_or_else(|panic| Err(panicked(&*panic)));
            meter::job("scene", stop.outcome(outcome.is_ok()));
            if let Err(error) = outcome {
                self.settle(&id, &stop, &error);
            }
            self.lock_running().remove(&id);
        }
        self.workers.fetch_sub(1, Ordering::Relaxed);
    }

    fn run(&self, id: &SceneId, stop: &Stop) -> Result<()> {
        let Some(record) = self.board.update(id, |record| {
            record.attempts += 1;
            record.status.state = SceneState::Running;
            record.status.updated_ms = store::now_ms();
        }) else {
            return Ok(());
        };
        let waited_ms = record.status.updated_ms.saturating_sub(record.status.created_ms);
        meter::stage("wait", Duration::from_millis(waited_ms).as_secs_f64());
        if record.attempts > ATTEMPTS_MAX {
            return Err(Error::internal(format!(
                "given up: the server stopped {ATTEMPTS_MAX} times while making this scene"
            )));
        }
        self.store.put_record(&record)?;
        let upload = self.store.upload(id)?;
        let progress = |stage: &str, fraction: f32| {
            self.board.update(id, |record| {
                record.status.stage = Some(stage.to_owned());
                record.status.fraction = fraction.clamp(0.0, 1.0);
            });
        };
        let made = self.within_time(stop, || {
            self.maker.make(Work {
                upload: &upload,
                options: &record.options,
                progress: &progress,
                cancel: &stop.flag,
            })
        })?;
        progress("store", 0.99);
        self.keep(&record, store::hashes(&upload), made)
    }

    /// Runs `make`, and asks it to stop when the time of a scene is over.
    pub(super) fn within_time<T>(
        &self,
        stop: &Stop,
        make: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        let limit = Duration::from_millis(self.limits.scene_timeout_ms);
        let (finished, watchdog) = mpsc::channel::<()>();
        std::thread::scope(|scope| {
            scope.spawn(move || {
                if watchdog.recv_timeout(limit) == Err(RecvTimeoutError::Timeout) {
                    stop.ask(BY_TIMEOUT);
                }
            });
            let made = catch_unwind(AssertUnwindSafe(make));
            drop(finished);
            made.unwrap_or_else(|panic| Err(panicked(&*panic)))
        })
    }

    fn keep(&self, record: &Record, files: Vec<crate::scene::PhotoHash>, made: Made) -> Result<()> {
        let id = &record.status.id;
        let meta = SceneMeta {
            id: id.clone(),
            created_ms: record.status.created_ms,
            cameras: made.cameras,
            report: made.report,
            provenance: Provenance {
                files,
                bundle_sha256: made.bundle_sha256,
                options: record.options.clone(),
                program_version: env!("CARGO_PKG_VERSION").to_owned(),
            },
        };
        let (report, cameras) = (meta.report.clone(), meta.cameras.clone());
        let scene = Scene::new(meta, made.gaussians, made.backdrop);
        let digest = self.store.put_scene(scene)?;
        // On disk first, so that a watcher who sees `done` may pull the plug.
        let Some(mut done) = self.board.find(id) else { return Ok(()) };
        done.scene_sha256 = Some(digest);
        done.status.state = SceneState::Done;
        done.status.stage = None;
        done.status.fraction = 1.0;
        done.status.updated_ms = store::now_ms();
        done.status.report = Some(report);
        done.status.cameras = cameras;
        self.store.put_record(&done)?;
        // In one change, so that no watcher takes `done` for the end.
        let eager = done.options.semantics == SemanticsMode::Eager;
        if eager {
            done.status.semantics = SemanticsStatus::new(SemanticsState::Running);
        }
        self.board.update(id, |record| *record = done);
        tracing::info!(scene = %id, "done");
        if eager {
            self.asked.push(id.clone());
        }
        Ok(())
    }

    /// What becomes of a job that gave no scene.
    fn settle(&self, id: &SceneId, stop: &Stop, error: &Error) {
        match stop.reason() {
            BY_SHUTDOWN => {
                let queued = self.board.update(id, |record| {
                    record.attempts = record.attempts.saturating_sub(1);
                    record.status.state = SceneState::Queued;
                    record.status.stage = None;
                    record.status.fraction = 0.0;
                });
                if let Some(Err(error)) = queued.map(|record| self.store.put_record(&record)) {
                    tracing::error!(scene = %id, %error, "its status is not kept");
                }
            }
            BY_CALLER => tracing::info!(scene = %id, "cancelled"),
            _ => self.fail(id, stop.told(&self.limits, "the scene").as_ref().unwrap_or(error)),
        }
    }

    pub(super) fn fail(&self, id: &SceneId, error: &Error) {
        if matches!(error.code().row().http, 500..) {
            let cause = std::error::Error::source(error).map(ToString::to_string);
            tracing::error!(scene = %id, code = error.code().name(), %error, cause, "failed");
        } else {
            tracing::info!(scene = %id, code = error.code().name(), %error, "failed");
        }
        let failed = self.board.find(id).map(|mut record| {
            record.status.state = SceneState::Failed;
            record.status.stage = None;
            record.status.updated_ms = store::now_ms();
            record.status.error = Some(SceneError::from(error));
            record
        });
        let Some(failed) = failed else { return };
        if let Err(error) = self.store.put_record(&failed) {
            tracing::error!(scene = %id, %error, "its status is not kept");
        }
        self.board.update(id, |record| *record = failed);
    }
}

pub(super) fn panicked(panic: &(dyn std::any::Any + Send)) -> Error {
    let text = panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    tracing::error!(panic = text, "a job panicked");
    Error::internal("the scene could not be made: a fault of the server, not of the request")
}
