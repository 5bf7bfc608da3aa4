//! The job that makes the semantics of a scene. It runs once, however many callers wait for it, and
//! the scene can be viewed meanwhile. Where its networks run on a device and need no Gaussians, it
//! begins while the scene is made.
//!
//! The record's `semantics` is the state of the job; watchers of the scene see its stages.

use std::{sync::Arc, time::Duration};

use super::{
    Jobs,
    job::{Job, Kind},
};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{
        Scene, SceneId, SceneState, SemanticsMode, SemanticsReport, SemanticsState,
        SemanticsStatus, unless_cancelled,
    },
    store::Record,
};

/// Time between two looks at whether a scene is made.
const SCENE_LOOK: Duration = Duration::from_millis(2);

/// Forgets a running job and a failure: only the process that has the job knows of them.
pub(super) fn reset(record: &mut Record) {
    let semantics = &mut record.status.semantics;
    if record.options.semantics == SemanticsMode::Off {
        *semantics = SemanticsStatus::new(SemanticsState::Off);
    } else if semantics.state != SemanticsState::Ready {
        *semantics = SemanticsStatus::default();
    }
}

fn wanted(record: &Record) -> bool {
    let open =
        matches!(record.status.semantics.state, SemanticsState::None | SemanticsState::Failed);
    record.status.state == SceneState::Done && open
}

impl Jobs {
    /// Queues the semantics of a finished scene, unless they are ready or on their way.
    /// Fails with `scene_not_found`; `overloaded` when too many scenes wait for theirs, or the
    /// server stops.
    pub(crate) fn understand(&self, id: &SceneId) -> Result<()> {
        let record = self.record(id)?;
        if !wanted(&record) {
            return Ok(());
        }
        let reserved = self.queue.reserve(Kind::Semantics, record.owner.as_deref());
        let place = reserved.map_err(|full| self.overloaded(full))?;
        let mut first = false;
        self.records.update(id, |record| {
            // Looked at again under the record's lock: of many callers one is the first.
            first = wanted(record);
            if first {
                record.status.semantics = SemanticsStatus::new(SemanticsState::Running);
            }
        });
        if first {
            self.replicas.hold(id);
            place.fill(id.clone());
        }
        Ok(())
    }

    /// Marks the semantics of a scene as not made: their file is gone, or the networks that made
    /// them are no longer loaded. Blocks on the store.
    /// Fails with `store_unavailable`.
    pub(crate) fn lose_semantics(&self, id: &SceneId) -> Result<()> {
        let mut lost = Ok(());
        self.records.update(id, |record| {
            // Under the record's lock, so that no newer ones are lost.
            if record.status.semantics.state == SemanticsState::Ready {
                lost = self.parts.store.drop_semantics(id);
                record.status.semantics = SemanticsStatus::default();
                record.semantics_sha256 = None;
            }
        });
        lost
    }

    /// Queues the semantics of a scene whose making begins, where they are best begun early.
    pub(super) fn understand_early(&self, record: &Record) {
        let options = &record.options;
        let eager = options.semantics == SemanticsMode::Eager;
        if eager && self.parts.semantics.begin_early(&options.method()) {
            let id = &record.status.id;
            self.records.update(id, |record| {
                record.status.semantics = SemanticsStatus::new(SemanticsState::Running);
            });
            self.queue.push(Kind::Semantics, id.clone(), record.owner.as_deref());
        }
    }

    /// The scene of a job, once it is made.
    /// Fails with `scene_not_found`, `cancelled`, and as the store does.
    fn made_scene(&self, job: &Job) -> Result<Arc<Scene>> {
        loop {
            let state = self.record(&job.scene)?.status.state;
            match state {
                SceneState::Done => return self.parts.store.scene(&job.scene),
                SceneState::Queued | SceneState::Running => unless_cancelled(&job.cancel)?,
                SceneState::Failed | SceneState::Cancelled => {
                    return Err(Error::new(ErrorCode::Cancelled, "the scene was not made"));
                }
            }
            self.queue.pause(SCENE_LOOK);
        }
    }

    /// Whether the scene failed while its semantics were made: then it never has any.
    fn failed_before(&self, id: &SceneId) -> bool {
        let shown = self.records.update(id, |record| {
            if record.status.state == SceneState::Failed {
                record.status.semantics = SemanticsStatus::default();
            }
        });
        shown.is_some_and(|record| record.status.state == SceneState::Failed)
    }

    pub(super) fn make_semantics(&self, job: &Job) -> Result<()> {
        let (id, store) = (&job.scene, &self.parts.store);
        if self.failed_before(id) {
            return Ok(());
        }
        // No version is published while they are made of the one before.
        let _lock = self.lock(id.as_str(), job)?;
        let named = |e: Error| {
            let message = format!("{}: {}", job.kind.names().1, e.message());
            Error::new(e.code(), message).caused_by(e)
        };
        // In the store first: a watcher who sees `ready` may stop the machine. A record without the
        // file counts as no semantics, so both are kept at the same time.
        let keep = |report: SemanticsReport, digest: Option<&str>| -> Result<Option<Record>> {
            let found = self.records.find(id).map(Arc::unwrap_or_clone);
            let Some(mut ready) = found else { return Ok(None) };
            ready.status.semantics = SemanticsStatus::ready(report);
            ready.semantics_sha256 = digest.map(str::to_owned).or(ready.semantics_sha256);
            store.put_record(&ready)?;
            Ok(Some(ready))
        };
        let make = || {
            let record = self.record(id)?;
            let report = record.status.report.as_ref();
            let method = report.map_or_else(|| record.options.method(), |of| of.method.clone());
            // A start that lost the status but not the file has nothing to make.
            if record.status.state == SceneState::Done
                && let Some(semantics) = &store.scene(id)?.semantics
            {
                return keep(semantics.report.clone(), None);
            }
            let semantics = self.within_time(job, |watch| {
                let upload = self.upload(id, watch)?;
                let photos = &upload.photos()?.photos;
                let _room = self.room.take(photos.len(), watch.cancel)?;
                self.parts.semantics.make(photos, &method, &|| self.made_scene(job), watch)
            })?;
            let report = semantics.report.clone();
            Ok(store.put_semantics(id, semantics, |digest| keep(report, Some(digest)))?.2)
        };
        let made = make();
        if made.is_err() && self.failed_before(id) {
            return Ok(());
        }
        let Some(ready) = made.map_err(named)? else { return Ok(()) };
        let bank_size = ready.status.semantics.bank_size;
        let eager = ready.options.semantics == SemanticsMode::Eager;
        let (status, digest) = (ready.status.semantics.clone(), ready.semantics_sha256.clone());
        let refine = ready.refine;
        let shown = self.records.update(id, |record| {
            record.status.semantics = status;
            record.semantics_sha256 = digest;
        });
        // Where a refinement was asked for just now, the record that is kept must say so too.
        if let Some(shown) = shown.filter(|shown| shown.refine != refine) {
            store.put_record(&shown)?;
        }
        tracing::info!(scene = %id, bank_size, "semantics ready");
        if eager && refine.is_none() && !self.parts.keep_photos {
            store.drop_upload(id).map_err(named)?;
        }
        Ok(())
    }
}
