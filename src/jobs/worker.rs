//! The one loop of all workers: takes a job, runs it with a time limit, and outlives its panics.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Condvar, Mutex, PoisonError,
        atomic::Ordering,
        mpsc::{self, RecvTimeoutError},
    },
    time::Duration,
};

use super::{
    Networks, Shared,
    job::{Job, Kind, Reason},
    photos::ReadUpload,
    scene::requeue,
};
use crate::{
    error::{Error, Result},
    pipeline,
    scene::{SceneError, SceneId, SceneState, SemanticsState, SemanticsStatus, Stage, Watch},
    store::{self, Record},
    telemetry::{self, meter},
};

/// Between two looks at whether the networks are open.
const NETWORKS_LOOK: Duration = Duration::from_millis(5);

/// Whether the program stops, for threads that pause.
#[derive(Debug, Default)]
pub(super) struct Shutdown {
    begun: Mutex<bool>,
    signal: Condvar,
}

impl Shutdown {
    pub(super) fn begin(&self) {
        *self.begun.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.signal.notify_all();
    }

    /// Pauses for `time`, less when the program stops; whether it does.
    pub(super) fn pause(&self, time: Duration) -> bool {
        let begun = self.begun.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.signal.wait_timeout_while(begun, time, |begun| !*begun);
        *waited.unwrap_or_else(PoisonError::into_inner).0
    }
}

impl Shared {
    /// The life of a worker thread.
    pub(super) fn work(&self, kind: Kind) {
        let open = self.networks_open();
        while open && let Some(id) = self.queue.pop(kind) {
            let job = self.running.begin(kind, id);
            if self.queue.is_closed() {
                job.stop(Reason::Shutdown);
            }
            let _span = self.span(&job).entered();
            // Whatever panics, its half-made values die with it.
            let run = AssertUnwindSafe(|| match kind {
                Kind::Scene => self.make_scene(&job),
                Kind::Semantics => self.make_semantics(&job),
            });
            let outcome = catch_unwind(run).unwrap_or_else(|panic| Err(panicked(&*panic)));
            meter::job(kind.name(), job.outcome(outcome.is_ok()));
            if let Err(error) = outcome {
                self.settle(&job, &error);
            }
            self.running.end(&job);
            let record = self.records.find(&job.scene);
            let follows = record.is_some_and(|record| {
                kind == Kind::Scene && record.status.semantics.state == SemanticsState::Running
            });
            if !follows {
                self.release(&job.scene);
            }
        }
        if kind == Kind::Scene {
            self.workers.fetch_sub(1, Ordering::Relaxed);
        }
    }

    /// Waits until the networks are open; whether they are. It looks again and again, so that a
    /// server that is stopped meanwhile need not wait.
    fn networks_open(&self) -> bool {
        loop {
            match self.parts.maker.networks() {
                Networks::Open(_) => return true,
                Networks::Broken => return false,
                Networks::Opening if self.queue.is_closed() => return false,
                Networks::Opening => std::thread::sleep(NETWORKS_LOOK),
            }
        }
    }

    /// A span of the job, a scene's in the trace of the call that asked for it.
    fn span(&self, job: &Job) -> tracing::Span {
        let id = &job.scene;
        let record = match job.kind {
            Kind::Scene => self.records.find(id),
            Kind::Semantics => return tracing::info_span!("semantics", scene = %id),
        };
        let Some(record) = record else { return tracing::Span::none() };
        let request_id = record.request_id.as_deref();
        let span = tracing::info_span!("scene", scene = %id, request_id);
        if let Some(parent) = &record.traceparent {
            telemetry::follow(&span, parent);
        }
        span
    }

    /// Runs `work`, which shows its progress in the record and is stopped when its time is over.
    pub(super) fn within_time<T>(
        &self,
        job: &Job,
        work: impl FnOnce(Watch<'_>) -> Result<T>,
    ) -> Result<T> {
        let limit = Duration::from_millis(self.parts.limits.scene_timeout_ms);
        let progress = |stage: Stage, fraction: f32| self.show(job, stage, fraction);
        let watch = Watch { progress: &progress, cancel: &job.cancel };
        let (finished, watchdog) = mpsc::channel::<()>();
        std::thread::scope(|scope| {
            scope.spawn(move || {
                if watchdog.recv_timeout(limit) == Err(RecvTimeoutError::Timeout) {
                    job.stop(Reason::Timeout);
                }
            });
            let done = catch_unwind(AssertUnwindSafe(|| work(watch)));
            drop(finished);
            done.unwrap_or_else(|panic| Err(panicked(&*panic)))
        })
    }

    pub(super) fn show(&self, job: &Job, stage: Stage, fraction: f32) {
        self.records.update(&job.scene, |record| job.kind.show(record, stage, fraction));
    }

    /// The photos of a job: as the create call read them, else read from the store.
    pub(super) fn photos(&self, id: &SceneId, watch: Watch<'_>) -> Result<Arc<ReadUpload>> {
        if let Some(kept) = self.uploads.find(id) {
            return Ok(kept);
        }
        let upload = self.parts.store.upload(id)?;
        let photos = pipeline::read(&upload, &self.parts.limits, watch.cancel)?;
        Ok(Arc::new(ReadUpload { files: store::hashes(&upload), photos }))
    }

    /// What becomes of a job that failed or was stopped.
    fn settle(&self, job: &Job, error: &Error) {
        let id = &job.scene;
        match (job.stopped(), job.kind) {
            // Watchers are told that the scene is deleted.
            (Some(Reason::Cancelled), _) => {
                tracing::info!(scene = %id, "{} cancelled", job.kind.what());
            }
            (Some(Reason::Shutdown), Kind::Scene) => {
                let queued = self.records.update(id, |record| {
                    record.attempts = record.attempts.saturating_sub(1);
                    requeue(record);
                });
                if let Some(record) = queued {
                    self.keep_failed(&record);
                }
            }
            _ => {
                let stopped = job.stop_error(&self.parts.limits);
                self.fail(job.kind, id, stopped.as_ref().unwrap_or(error));
            }
        }
    }

    /// Makes a failure known to watchers; that of a scene also to the store.
    pub(super) fn fail(&self, kind: Kind, id: &SceneId, error: &Error) {
        if matches!(error.code().row().http, 500..) {
            let cause = std::error::Error::source(error).map(ToString::to_string);
            let code = error.code().name();
            tracing::error!(scene = %id, code, %error, cause, "{} failed", kind.what());
        } else {
            let code = error.code().name();
            tracing::info!(scene = %id, code, %error, "{} failed", kind.what());
        }
        let now = store::now_ms();
        let change = |record: &mut Record| match kind {
            Kind::Scene => {
                record.status.state = SceneState::Failed;
                record.status.stage = None;
                record.status.updated_ms = now;
                record.status.error = Some(SceneError::from(error));
            }
            Kind::Semantics => {
                record.status.semantics = SemanticsStatus {
                    error: Some(SceneError::from(error)),
                    ..SemanticsStatus::new(SemanticsState::Failed)
                };
            }
        };
        if let (Kind::Scene, Some(mut failed)) = (kind, self.records.find(id)) {
            change(&mut failed);
            self.keep_failed(&failed);
        }
        self.records.update(id, change);
    }

    fn keep_failed(&self, record: &Record) {
        if let Err(error) = self.parts.store.put_record(record) {
            tracing::error!(scene = %record.status.id, %error, "its status is not kept");
        }
    }

    /// The life of the thread that removes what crashes and deletions left in the store.
    pub(super) fn sweep(&self) {
        let limits = &self.parts.limits;
        // By then no job of a deleted scene can still be at work, on any replica.
        let buried = Duration::from_millis(limits.scene_timeout_ms.saturating_mul(2))
            + Duration::from_millis(limits.replica_lease_ms);
        loop {
            match self.parts.store.sweep(buried) {
                Ok(0) => {}
                Ok(removed) => tracing::info!(removed, "left-overs removed from the store"),
                Err(error) => tracing::warn!(%error, "the store cannot be swept"),
            }
            if self.shutdown.pause(Duration::from_millis(limits.sweep_every_ms.max(1_000))) {
                return;
            }
        }
    }
}

fn panicked(panic: &(dyn Any + Send)) -> Error {
    let text = panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    tracing::error!(panic = text, "a job panicked");
    Error::internal("the scene could not be made: a fault of the server, not of the request")
}
