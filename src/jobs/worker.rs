//! One worker: takes a job, runs it with a time limit, keeps what it gives; outlives its panics.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, MutexGuard, PoisonError,
        atomic::{AtomicBool, AtomicU8, Ordering},
        mpsc::{self, RecvTimeoutError},
    },
    time::{Duration, Instant},
};

use super::{Made, Networks, Shared, Work};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
    scene::{
        PhotoHash, Provenance, Scene, SceneError, SceneId, SceneMeta, SceneState, SemanticsMode,
        SemanticsReport, SemanticsState, SemanticsStatus,
    },
    store::{self, Record},
    telemetry::{self, meter},
};

/// Starts of one job before it is given up: a scene that kills the server must not do so forever.
const ATTEMPTS_MAX: u32 = 3;

/// Between two looks at whether the networks are open.
const NETWORKS_LOOK: Duration = Duration::from_millis(5);

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

    pub(super) fn is_by_caller(&self) -> bool {
        self.reason() == BY_CALLER
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

/// A scene that is kept, and what its record is to say.
struct Finished {
    meta: SceneMeta,
    digest: String,
    semantics: Option<(String, SemanticsReport)>,
}

/// Leave to make some content; ends when dropped.
struct Turn<'a> {
    shared: &'a Shared,
    content: String,
}

impl Drop for Turn<'_> {
    fn drop(&mut self) {
        let mut making = self.shared.making.lock().unwrap_or_else(PoisonError::into_inner);
        making.remove(&self.content);
        drop(making);
        self.shared.made.notify_all();
    }
}

impl Shared {
    pub(super) fn lock_running(
        &self,
    ) -> MutexGuard<'_, std::collections::HashMap<SceneId, Arc<Stop>>> {
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until the networks are open; whether they are. Not for long, so it looks again and
    /// again: a server that is stopped meanwhile waits for nothing.
    pub(super) fn networks_open(&self) -> bool {
        loop {
            match self.maker.networks() {
                Networks::Open(_) => return true,
                Networks::Broken => return false,
                Networks::Opening if self.queue.is_closed() => return false,
                Networks::Opening => std::thread::sleep(NETWORKS_LOOK),
            }
        }
    }

    /// The life of a worker thread.
    pub(super) fn work(&self) {
        let open = self.networks_open();
        while open && let Some(id) = self.queue.pop() {
            let stop = Arc::new(Stop::default());
            self.lock_running().insert(id.clone(), Arc::clone(&stop));
            if self.queue.is_closed() {
                stop.by_shutdown();
            }
            let _span = self.span(&id).entered();
            // Whatever `make` panics with, its half-made values die with it.
            let outcome = catch_unwind(AssertUnwindSafe(|| self.run(&id, &stop)))
                .unwrap_or_else(|panic| Err(panicked(&*panic)));
            meter::job("scene", stop.outcome(outcome.is_ok()));
            if let Err(error) = outcome {
                self.settle(&id, &stop, &error);
            }
            self.lock_running().remove(&id);
            let semantics = self.board.find(&id).map(|record| record.status.semantics.state);
            if semantics != Some(SemanticsState::Running) {
                self.done_with(&id);
            }
        }
        self.workers.fetch_sub(1, Ordering::Relaxed);
    }

    /// A span of the job, in the trace of the call that asked for the scene.
    fn span(&self, id: &SceneId) -> tracing::Span {
        let Some(record) = self.board.find(id) else { return tracing::Span::none() };
        let request_id = record.request_id.as_deref();
        let span = tracing::info_span!("scene", scene = %id, request_id);
        if let Some(parent) = &record.traceparent {
            telemetry::follow(&span, parent);
        }
        span
    }

    fn run(&self, id: &SceneId, stop: &Stop) -> Result<()> {
        let begun = Instant::now();
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
        if record.attempts > 1
            && let Some(made) = self.made_before(id)?
        {
            return self.finish(&record, made);
        }
        let upload = self.store.upload(id)?;
        let files = store::hashes(&upload);
        let content = store::content_sha256(&files, &record.options, &self.maker.identity());
        let _turn = self.turn(&content, stop);
        if let Some(known) = self.made_of(&content, &record)? {
            tracing::info!(scene = %id, of = %known.meta.id, "made before of the same content");
            return self.copy(&record, &known);
        }
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
        drop(upload);
        progress("store", 0.99);
        let took = u64::try_from(begun.elapsed().as_millis()).unwrap_or(u64::MAX);
        let before = self.scene_ms.load(Ordering::Relaxed);
        let smoothed = if before == 0 { took } else { (3 * before + took) / 4 };
        self.scene_ms.store(smoothed.max(1), Ordering::Relaxed);
        self.keep(&record, files, content, made)
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

    fn keep(
        &self,
        record: &Record,
        files: Vec<PhotoHash>,
        content_sha256: String,
        made: Made,
    ) -> Result<()> {
        let meta = SceneMeta {
            id: record.status.id.clone(),
            created_ms: record.status.created_ms,
            cameras: made.cameras,
            report: made.report,
            provenance: Provenance {
                files,
                bundle_sha256: made.bundle_sha256,
                options: record.options.clone(),
                content_sha256,
                program_version: env!("CARGO_PKG_VERSION").to_owned(),
            },
        };
        let scene = Scene::new(meta.clone(), made.gaussians, made.backdrop);
        let digest = self.store.put_scene(scene)?;
        self.finish(record, Finished { meta, digest, semantics: None })
    }

    /// Keeps under this record what was made of the same content before.
    fn copy(&self, record: &Record, known: &Scene) -> Result<()> {
        let id = &record.status.id;
        let meta = SceneMeta {
            id: id.clone(),
            created_ms: record.status.created_ms,
            ..known.meta.clone()
        };
        let semantics = known.semantics.clone();
        let mut scene = known.clone();
        scene.meta = meta.clone();
        let digest = self.store.put_scene(scene)?;
        let semantics = match semantics {
            Some(semantics) => {
                let report = semantics.report.clone();
                Some((self.store.put_semantics(id, (*semantics).clone())?.1, report))
            }
            None => None,
        };
        self.finish(record, Finished { meta, digest, semantics })
    }

    /// What an earlier attempt had made and kept, before it was cut off.
    fn made_before(&self, id: &SceneId) -> Result<Option<Finished>> {
        match self.store.scene(id) {
            Ok(scene) => {
                let digest = self.store.scene_digest(id)?;
                Ok(digest.map(|digest| Finished {
                    meta: scene.meta.clone(),
                    digest,
                    semantics: None,
                }))
            }
            Err(e) if matches!(e.code(), ErrorCode::SceneNotFound | ErrorCode::SceneCorrupt) => {
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    /// The finished scene of this content and owner, where there is one and it is sound.
    fn made_of(&self, content: &str, record: &Record) -> Result<Option<Arc<Scene>>> {
        let owner = record.owner.as_deref();
        let Some(id) = self.store.scene_of_content(owner, content)? else { return Ok(None) };
        if id == record.status.id {
            return Ok(None);
        }
        // Whatever is wrong with it, this one can be made.
        let scene = self.store.scene(&id).ok();
        Ok(scene.filter(|scene| scene.meta.provenance.content_sha256 == content))
    }

    /// Waits until no other worker here makes the same content.
    fn turn(&self, content: &str, stop: &Stop) -> Turn<'_> {
        let mut making = self.making.lock().unwrap_or_else(PoisonError::into_inner);
        while making.contains(content) && !stop.flag.load(Ordering::Acquire) {
            let waited = self.made.wait_timeout(making, Duration::from_millis(50));
            making = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        making.insert(content.to_owned());
        Turn { shared: self, content: content.to_owned() }
    }

    /// The scene is kept: its record is, then its watchers are told.
    fn finish(&self, record: &Record, finished: Finished) -> Result<()> {
        let id = &record.status.id;
        let Finished { meta, digest, semantics } = finished;
        // On disk first, so that a watcher who sees `done` may pull the plug.
        let Some(mut done) = self.board.find(id) else { return Ok(()) };
        done.scene_sha256 = Some(digest);
        let content = meta.provenance.content_sha256;
        done.content_sha256 = Some(content.clone()).filter(|hash| !hash.is_empty());
        done.replica = None;
        done.status.state = SceneState::Done;
        done.status.stage = None;
        done.status.fraction = 1.0;
        done.status.updated_ms = store::now_ms();
        done.status.report = Some(meta.report);
        done.status.cameras = meta.cameras;
        if let Some((digest, report)) = semantics {
            done.semantics_sha256 = Some(digest);
            done.status.semantics = SemanticsStatus::ready(report);
        }
        self.store.put_record(&done)?;
        if !content.is_empty() {
            self.store.put_content(done.owner.as_deref(), &content, id)?;
        }
        // In one change, so that no watcher takes `done` for the end.
        let ready = done.status.semantics.state == SemanticsState::Ready;
        let eager = done.options.semantics == SemanticsMode::Eager && !ready;
        if eager {
            done.status.semantics = SemanticsStatus::new(SemanticsState::Running);
        }
        let owner = done.owner.clone();
        self.board.update(id, |record| *record = done);
        tracing::info!(scene = %id, "done");
        if eager {
            self.asked.push(id.clone(), owner.as_deref());
        } else if !self.keep_photos {
            self.store.drop_upload(id)?;
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
