//! The one loop of all workers: takes a job, runs it with a time limit, and outlives its panics.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        atomic::Ordering,
        mpsc::{self, RecvTimeoutError},
    },
    time::{Duration, Instant},
};

use super::{
    Jobs, NetworkState,
    job::{Job, Kind, Reason},
    photos::ReadUpload,
    scene::requeue,
};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{
        RefineState, RefineStatus, SceneError, SceneId, SceneState, SemanticsState,
        SemanticsStatus, Stage, Watch,
    },
    store::{self, Record},
    telemetry::{self, meter},
};

/// Time between two checks whether the networks are open.
const NETWORKS_LOOK: Duration = Duration::from_millis(5);
/// Time in which freed memory goes back to the system, after a job and without one. Not at the end
/// of a job: while it goes, allocations wait, and that is when the callers of the job come back.
const GIVE_BACK_AFTER_JOB: Duration = Duration::from_secs(1);
const GIVE_BACK_EVERY: Duration = Duration::from_secs(10);

impl Jobs {
    /// The life of a worker thread.
    pub(super) fn work(&self, kind: Kind) {
        let open = self.networks_open();
        while open && let Some(id) = self.queue.pop(kind) {
            let job = self.running.begin(kind, id);
            if self.queue.is_closed() {
                job.stop(Reason::Shutdown);
            }
            let _span = self.span(&job).entered();
            // After a panic nothing uses the values that it left.
            let run = AssertUnwindSafe(|| match kind {
                Kind::Scene => self.make_scene(&job),
                Kind::Semantics => self.make_semantics(&job),
                Kind::Refine => self.refine_scene(&job),
            });
            let outcome = catch_unwind(run).unwrap_or_else(|panic| Err(panicked(kind, &*panic)));
            meter::job(kind.names().0, job.outcome(outcome.is_ok()));
            if let Err(error) = outcome {
                self.end_failed(&job, &error);
            }
            self.running.end(&job);
            self.leave(&job);
            self.freed.store(true, Ordering::Relaxed);
        }
        if kind == Kind::Scene {
            self.workers.fetch_sub(1, Ordering::Relaxed);
        }
    }

    /// Gives back what an ended job had, except where another of its scene runs, or its semantics
    /// follow or may follow.
    fn leave(&self, job: &Job) {
        if self.running.has(&job.scene) {
            return;
        }
        let record = self.records.find(&job.scene);
        let next = record.filter(|record| record.status.state == SceneState::Done);
        let refined = next.as_ref().is_some_and(|record| record.status.is_refined_now());
        match next.map(|record| record.status.semantics.state) {
            // What follows is queued already, by this job or by a caller.
            Some(SemanticsState::Running) => {}
            Some(_) if refined => {}
            Some(SemanticsState::None) if job.kind == Kind::Scene => {
                self.uploads.renew(&job.scene);
                self.replicas.release(&job.scene);
            }
            _ => self.release(&job.scene),
        }
    }

    /// Waits until the networks are open; whether they are. It ends when the server stops.
    fn networks_open(&self) -> bool {
        loop {
            match self.networks() {
                NetworkState::Open(_) => return true,
                NetworkState::Broken => return false,
                NetworkState::Opening => {
                    if self.queue.pause(NETWORKS_LOOK) {
                        return false;
                    }
                }
            }
        }
    }

    /// A span of the job. That of a scene belongs to the trace of the call that created it.
    fn span(&self, job: &Job) -> tracing::Span {
        let id = &job.scene;
        match job.kind {
            Kind::Scene => {}
            Kind::Semantics => return tracing::info_span!("semantics", scene = %id),
            Kind::Refine => return tracing::info_span!("refine", scene = %id),
        }
        let Some(record) = self.records.find(id) else { return tracing::Span::none() };
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
        std::thread::scope(|scope| {
            // Dropped at the end of the work, also by a panic.
            let (_finished, watchdog) = mpsc::channel::<()>();
            scope.spawn(move || {
                if watchdog.recv_timeout(limit) == Err(RecvTimeoutError::Timeout) {
                    job.stop(Reason::Timeout);
                }
            });
            work(watch)
        })
    }

    pub(super) fn show(&self, job: &Job, stage: Stage, fraction: f32) {
        self.records.update(&job.scene, |record| job.kind.show(record, stage, fraction));
    }

    /// The upload of a job: as the create call read it, else read from the store.
    pub(super) fn upload(&self, id: &SceneId, watch: Watch<'_>) -> Result<Arc<ReadUpload>> {
        if let Some(kept) = self.uploads.find(id) {
            return Ok(kept);
        }
        let upload = self.parts.store.upload(id)?;
        let options = &self.record(id)?.options;
        ReadUpload::of(&upload, options, &self.parts.limits, watch.cancel).map(Arc::new)
    }

    /// What becomes of a job that failed or was stopped.
    fn end_failed(&self, job: &Job, error: &Error) {
        let (id, (_, what)) = (&job.scene, job.kind.names());
        let stopped = match (job.stopped(), job.kind) {
            (None, _) => None,
            (Some(Reason::Cancelled), _) => {
                // Watchers are told that the scene is deleted.
                tracing::info!(scene = %id, "{what} cancelled");
                return;
            }
            (Some(Reason::Timeout), _) => {
                let limit = Duration::from_millis(self.parts.limits.scene_timeout_ms);
                let message = format!("{what} took longer than {} s", limit.as_secs_f64());
                Some(Error::new(ErrorCode::DeadlineExceeded, message))
            }
            (Some(Reason::Shutdown), Kind::Refine) => {
                // The next start goes on; this one was no failure.
                let queued = self.records.update(id, |record| {
                    if let Some(order) = &mut record.refine {
                        order.attempts = order.attempts.saturating_sub(1);
                    }
                });
                if let Some(record) = queued {
                    self.keep_record(&record);
                }
                return;
            }
            (Some(Reason::Shutdown), Kind::Semantics) => {
                let message = format!("{what}: the server is stopping");
                Some(Error::new(ErrorCode::Overloaded, message).retry_after_s(10))
            }
            (Some(Reason::Shutdown), Kind::Scene) => {
                let queued = self.records.update(id, |record| {
                    record.attempts = record.attempts.saturating_sub(1);
                    requeue(record);
                });
                if let Some(record) = queued {
                    self.keep_record(&record);
                }
                return;
            }
        };
        self.fail(job.kind, id, stopped.as_ref().unwrap_or(error));
    }

    /// Makes a failure known to watchers; that of a scene or a refinement also to the store.
    pub(super) fn fail(&self, kind: Kind, id: &SceneId, error: &Error) {
        let (code, (_, what)) = (error.code().name(), kind.names());
        if error.code().row().http >= 500 {
            let cause = std::error::Error::source(error).map(ToString::to_string);
            tracing::error!(scene = %id, code, %error, cause, "{what} failed");
        } else {
            tracing::info!(scene = %id, code, %error, "{what} failed");
        }
        let now = store::now_ms();
        let change = |record: &mut Record| match kind {
            Kind::Scene => {
                record.status.state = SceneState::Failed;
                record.status.stage = None;
                record.status.updated_ms = now;
                record.status.error = Some(SceneError::from(error));
            }
            Kind::Refine => {
                record.refine = None;
                record.status.refinement = RefineStatus {
                    error: Some(SceneError::from(error)),
                    ..RefineStatus::new(RefineState::Failed)
                };
            }
            Kind::Semantics => {
                record.status.semantics = SemanticsStatus {
                    error: Some(SceneError::from(error)),
                    ..SemanticsStatus::new(SemanticsState::Failed)
                };
            }
        };
        if let (Kind::Scene | Kind::Refine, Some(mut failed)) = (kind, self.records.find(id)) {
            change(Arc::make_mut(&mut failed));
            self.keep_record(&failed);
        }
        self.records.update(id, change);
        if kind == Kind::Scene {
            // Those that began early are wanted no more.
            self.running.stop_kind(Kind::Semantics, id, Reason::Cancelled);
        }
    }

    pub(super) fn keep_record(&self, record: &Record) {
        if let Err(error) = self.parts.store.put_record(record) {
            tracing::error!(scene = %record.status.id, %error, "its status is not kept");
        }
    }

    /// The life of the thread that removes what crashes and deletions left in the store, and photos
    /// in memory that no text asked for.
    pub(super) fn sweep(&self) {
        let limits = &self.parts.limits;
        // By then no job of a deleted scene can still run, on any replica.
        let buried = Duration::from_millis(limits.scene_timeout_ms.saturating_mul(2))
            + Duration::from_millis(limits.replica_lease_ms);
        let every = Duration::from_millis(limits.sweep_every_ms.max(1_000));
        let look = Duration::from_millis(limits.first_text_photos_ms.max(1_000)).min(every);
        let look = look.min(GIVE_BACK_AFTER_JOB);
        let (mut next, mut give_back) = (Instant::now(), Instant::now());
        loop {
            let now = Instant::now();
            self.uploads.forget_old(now);
            // What jobs freed, what was deleted, or left the caches.
            if self.freed.swap(false, Ordering::Relaxed) || now >= give_back {
                give_back = now + GIVE_BACK_EVERY;
                give_memory_back();
            }
            if now >= next {
                next = now + every;
                match self.parts.store.sweep(buried) {
                    Ok(0) => {}
                    Ok(removed) => tracing::info!(removed, "left-overs removed from the store"),
                    Err(error) => tracing::warn!(%error, "the store cannot be swept"),
                }
            }
            if self.queue.pause(look) {
                return;
            }
        }
    }
}

/// Gives what is free in the heaps back to the system. The allocator keeps it otherwise.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn give_memory_back() {
    #[expect(unsafe_code, reason = "a call into the C library")]
    // SAFETY: any thread may call it at any time.
    let _released = unsafe { libc::malloc_trim(0) };
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn give_memory_back() {}

fn panicked(kind: Kind, panic: &(dyn Any + Send)) -> Error {
    let text = panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str));
    tracing::error!(panic = text, "a job panicked");
    let what = kind.names().1;
    Error::internal(format!("{what} could not be made: a fault of the server, not of the request"))
}
