//! The one loop of all workers: takes a job, runs it with a time limit, and outlives its panics.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, atomic::Ordering},
    time::{Duration, Instant},
};

use super::{
    change::{Attempt, Change},
    job::{Job, Reason},
    kind::Kind,
    networks::NetworkState,
    scene::SCENE,
    shared::{Jobs, Work, is_used_up},
};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{SceneId, SceneState, unless_cancelled},
    store::Record,
    telemetry::meter,
};

/// Time in which freed memory goes back to the system, after a job and without one. Not at the end
/// of a job: while it goes, allocations wait, and that is when the callers of the job come back.
const GIVE_BACK_AFTER_JOB: Duration = Duration::from_secs(1);
const GIVE_BACK_EVERY: Duration = Duration::from_secs(10);
/// Time between two looks whether the store keeps things again.
const STORE_LOOK: Duration = Duration::from_secs(1);

impl Jobs {
    /// The life of a worker thread.
    pub(super) fn work(&self, kind: &'static dyn Work) {
        let open = matches!(self.parts.scenes.opened(), NetworkState::Open(_));
        while open && let Some(id) = self.next(kind) {
            let job = self.running.begin(kind, id);
            if self.queue.is_closed() {
                job.stop(Reason::Shutdown);
            }
            let _span = kind.span(self, &job.scene).entered();
            // After a panic nothing uses the values that it left.
            let run = AssertUnwindSafe(|| kind.run(self, &job));
            let result = catch_unwind(run).unwrap_or_else(|panic| Err(panicked(kind, &*panic)));
            meter::job(kind.name(), self.end(&job, result));
            self.running.end(&job);
            self.leave(&job);
            self.freed.store(true, Ordering::Relaxed);
        }
        if kind.name() == SCENE.name() {
            self.workers.fetch_sub(1, Ordering::Relaxed);
        }
    }

    /// The next job of a kind; waits for one, and for a store that keeps what it makes. `None` once
    /// the queue is closed.
    fn next(&self, kind: Kind) -> Option<SceneId> {
        self.bell.wait(|| {
            let ready = !kind.lasts() || self.parts.store.keeps() || self.queue.is_closed();
            if ready { Ok(()) } else { Err(STORE_LOOK) }
        });
        self.queue.pop(kind)
    }

    /// Whether a job of this scene runs, waits or follows.
    fn is_at_work(&self, id: &SceneId) -> bool {
        let record = self.records.find(id);
        self.running.has(id) || record.is_some_and(|record| has_next(&record))
    }

    /// Gives back what an ended job had, except where another of its scene runs, waits or may
    /// follow.
    fn leave(&self, job: &Job) {
        let id = &job.scene;
        self.go_on_growing(job);
        let record = self.records.find(id);
        match record {
            // What follows is queued already, by this job or by a caller.
            _ if self.running.has(id) => (),
            Some(record) if has_next(&record) => (),
            // Its first text, or photos that join it, need not read its photos.
            Some(record) if record.status.state == SceneState::Done && self.parts.keep_photos => {
                self.uploads.renew(id);
                self.replicas.release(id);
            }
            _ => self.release(id),
        }
    }

    /// Ends a job on a finished scene whose photos another replica changes or has changed: what it
    /// would keep is of the scene before.
    /// Fails with `cancelled`, and as the store does.
    pub(super) fn unless_lost(&self, job: &Job) -> Result<()> {
        if self.replicas.is_lost(self, &job.scene)? {
            job.stop(Reason::Cancelled);
        }
        unless_cancelled(&job.cancel)
    }

    /// What becomes of a job: its name in metrics.
    fn end(&self, job: &Job, result: Result<()>) -> &'static str {
        let Err(error) = result else { return "done" };
        let (id, kind, what) = (&job.scene, job.kind, job.kind.what());
        let stopped = match job.stopped() {
            None if kind.lasts() && error.code() == ErrorCode::StoreUnavailable => {
                // A scene that was acknowledged waits for room on the disk.
                let attempt = match self.parts.store.probe() {
                    Ok(()) => Attempt::Counts,
                    Err(_) => Attempt::IsForgotten,
                };
                let may_go_on = |record: &Arc<Record>| {
                    attempt == Attempt::IsForgotten || !is_used_up(kind, record)
                };
                if self.records.find(id).as_ref().is_some_and(may_go_on) {
                    tracing::warn!(scene = %id, %error, "{what} waits for the store");
                    return self.requeue(job, attempt);
                }
                None
            }
            None if kind.lasts() && error.code() == ErrorCode::OtherVersion => {
                tracing::error!(scene = %id, %error, "{what} waits for that version");
                return self.leave_to_another_version(job, &error);
            }
            None => None,
            Some(Reason::Cancelled) => {
                // Watchers are told that the scene is deleted.
                tracing::info!(scene = %id, "{what} cancelled");
                return "cancelled";
            }
            Some(Reason::Timeout) => {
                let limit = self.job_time().as_secs_f64();
                let message = format!("{what} took longer than {limit} s");
                Some(Error::new(ErrorCode::DeadlineExceeded, message))
            }
            // The next start goes on; this one was no failure.
            Some(Reason::Shutdown) if kind.lasts() => {
                return self.requeue(job, Attempt::IsForgotten);
            }
            Some(Reason::Shutdown) => {
                let message = format!("{what}: the server is stopping");
                Some(Error::new(ErrorCode::Overloaded, message).retry_after_s(10))
            }
        };
        self.fail(kind, id, stopped.as_ref().unwrap_or(&error));
        "failed"
    }

    /// The job waits again; a closed queue gives it to the next start.
    fn requeue(&self, job: &Job, attempt: Attempt) -> &'static str {
        let (kind, id) = (job.kind, &job.scene);
        // A scene that is deleted meanwhile needs nothing.
        if let Ok(queued) = self.records.apply(id, &Change::Requeued(kind, attempt)) {
            self.queue.push(kind, id.clone(), queued.after.owner.as_deref());
        }
        "requeued"
    }

    /// The store keeps the job as it was before it began, for a program that reads what it needs;
    /// watchers here are told the failure.
    fn leave_to_another_version(&self, job: &Job, error: &Error) -> &'static str {
        let (kind, id) = (job.kind, &job.scene);
        let before = Change::Requeued(kind, Attempt::IsForgotten);
        for change in [before, Change::Left(kind, error)] {
            // A scene that is deleted meanwhile needs nothing.
            let _ = self.records.apply(id, &change);
        }
        "failed"
    }

    /// Makes a failure known to watchers; that of a job that lasts also to the store.
    pub(super) fn fail(&self, kind: Kind, id: &SceneId, error: &Error) {
        let (code, what) = (error.code().name(), kind.what());
        if error.code().row().http >= 500 {
            let cause = std::error::Error::source(error).map(ToString::to_string);
            tracing::error!(scene = %id, code, %error, cause, "{what} failed");
        } else {
            tracing::info!(scene = %id, code, %error, "{what} failed");
        }
        // One that is deleted meanwhile has no watchers.
        let Ok(failed) = self.records.apply(id, &Change::Failed(kind, error)) else { return };
        self.drop_given_up(&failed);
        if failed.after.status.state == SceneState::Failed {
            // Those that began early are wanted no more.
            self.running.stop(Reason::Cancelled, |job| job.scene == *id && !job.kind.lasts());
        }
    }

    /// The life of the thread that removes what crashes and deletions left in the store, and photos
    /// in memory that no text asked for. It also looks whether a store that kept nothing does so
    /// again.
    pub(super) fn sweep(&self) {
        let (mut swept, mut give_back) = (None::<Instant>, Instant::now());
        loop {
            let (limits, now) = (self.parts.limits.get(), Instant::now());
            let every = Duration::from_millis(limits.sweep_every_ms.max(1_000));
            let old = self.uploads.old(now);
            // A scene that takes long to make is refined with what the networks said of it.
            old.iter().filter(|id| !self.is_at_work(id)).for_each(|id| self.uploads.forget(id));
            // What jobs freed, what was deleted, or left the caches.
            if self.freed.swap(false, Ordering::Relaxed) || now >= give_back {
                give_back = now + GIVE_BACK_EVERY;
                give_memory_back();
            }
            if !self.parts.store.keeps() && self.parts.store.probe().is_ok() {
                tracing::info!("the store keeps what it is given again");
            }
            if swept.is_none_or(|at| now.duration_since(at) >= every) {
                swept = Some(now);
                // By then no job of a deleted scene can still run, on any replica.
                let buried = self.job_time() * 2 + Duration::from_millis(limits.replica_lease_ms);
                match self.parts.store.sweep(buried) {
                    Ok(0) => {}
                    Ok(removed) => tracing::info!(removed, "left-overs removed from the store"),
                    Err(error) => tracing::warn!(%error, "the store cannot be swept"),
                }
            }
            let look = Duration::from_millis(limits.first_text_photos_ms.max(1_000)).min(every);
            if self.queue.pause(look.min(GIVE_BACK_AFTER_JOB)) {
                return;
            }
        }
    }
}

/// Whether a job of its scene waits or follows.
fn has_next(record: &Record) -> bool {
    !record.status.is_settled() || record.status.is_refined_now()
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
    let what = kind.what();
    Error::internal(format!("{what} could not be made: a fault of the server, not of the request"))
}
