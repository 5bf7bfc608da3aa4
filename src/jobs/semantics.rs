//! The job that makes the semantics of a scene. They are made once, however many callers ask, and
//! the scene can be viewed meanwhile.
//!
//! The record's `semantics` says where the job stands; watchers of the scene see its stages.

use super::{
    Jobs, Shared,
    job::{Job, Kind},
};
use crate::{
    error::{Error, Result},
    scene::{SceneId, SceneState, SemanticsMode, SemanticsState, SemanticsStatus},
    store::Record,
};

/// Forgets a job at work and a failure: only the process that has the job knows of them.
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
    ///
    /// # Errors
    /// `scene_not_found`; `overloaded` when too many scenes wait for theirs, or the server stops.
    pub fn understand(&self, id: &SceneId) -> Result<()> {
        let (shared, record) = (&self.shared, self.record(id)?);
        if !wanted(&record) {
            return Ok(());
        }
        let reserved = shared.queue.reserve(Kind::Semantics, record.owner.as_deref());
        let place = reserved.map_err(|full| self.overloaded(full))?;
        let mut first = false;
        shared.records.update(id, |record| {
            // Looked at again under the record's lock: of many callers one is the first.
            first = wanted(record);
            if first {
                record.status.semantics = SemanticsStatus::new(SemanticsState::Running);
            }
        });
        if first {
            shared.replicas.hold(id);
            place.fill(id.clone());
        }
        Ok(())
    }

    /// Takes back that the semantics of a scene are ready: their file is gone, or networks made
    /// them that are no longer loaded. Blocks on the store.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn lose_semantics(&self, id: &SceneId) -> Result<()> {
        let mut lost = Ok(());
        self.shared.records.update(id, |record| {
            // Under the record's lock, so that no newer ones are lost.
            if record.status.semantics.state == SemanticsState::Ready {
                lost = self.shared.parts.store.drop_semantics(id);
                record.status.semantics = SemanticsStatus::default();
                record.semantics_sha256 = None;
            }
        });
        lost
    }
}

impl Shared {
    pub(super) fn make_semantics(&self, job: &Job) -> Result<()> {
        let (id, store) = (&job.scene, &self.parts.store);
        let named = |e: Error| {
            let message = format!("{}: {}", job.kind.what(), e.message());
            Error::new(e.code(), message).caused_by(e)
        };
        let make = || {
            let mut scene = store.scene(id)?;
            let mut digest = None;
            // A start that lost the status but not the file has nothing to make.
            if scene.semantics.is_none() {
                let made = self.within_time(job, |watch| {
                    let upload = self.photos(id, watch)?;
                    self.parts.semantics.make(&upload.photos.photos, &scene, watch)
                })?;
                let kept = store.put_semantics(id, made)?;
                (scene, digest) = (kept.0, Some(kept.1));
            }
            Ok((scene, digest))
        };
        let (scene, digest) = make().map_err(named)?;
        let report = scene.semantics.as_ref().map(|made| made.report.clone()).unwrap_or_default();
        // In the store first, so that a watcher who sees `ready` may pull the plug.
        let Some(mut ready) = self.records.find(id) else { return Ok(()) };
        ready.status.semantics = SemanticsStatus::ready(report);
        ready.semantics_sha256 = digest.or(ready.semantics_sha256);
        store.put_record(&ready).map_err(named)?;
        let bank_size = ready.status.semantics.bank_size;
        let eager = ready.options.semantics == SemanticsMode::Eager;
        self.records.update(id, |record| *record = ready);
        tracing::info!(scene = %id, bank_size, "semantics ready");
        if eager && !self.parts.keep_photos {
            store.drop_upload(id).map_err(named)?;
        }
        Ok(())
    }
}
