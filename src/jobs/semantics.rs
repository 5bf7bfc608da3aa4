//! The job that makes the semantics of a scene. It runs once, however many callers wait for it, and
//! the scene can be viewed meanwhile. Where its networks run on a device and need no Gaussians, it
//! begins while the scene is made.
//!
//! The record's `semantics` is the state of the job; watchers of the scene see its stages.

use std::sync::{Arc, atomic::AtomicBool};

use super::{
    bell::FOREVER,
    change::Change,
    job::Job,
    kind::{JobKind, Kind},
    shared::{Jobs, Work},
};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{
        Scene, SceneError, SceneId, SceneState, SceneStatus, SemanticsState, SemanticsStatus,
        Stage, Watch,
    },
    store::{Record, side_by_side},
};

/// Makes the semantics of a scene.
pub(super) struct MakeSemantics;

pub(super) const SEMANTICS: Kind = &MakeSemantics;

impl JobKind for MakeSemantics {
    fn name(&self) -> &'static str {
        "semantics"
    }

    fn what(&self) -> &'static str {
        "the scene's semantics"
    }

    fn show(&self, status: &mut SceneStatus, stage: Stage, fraction: f32) {
        if status.semantics.state == SemanticsState::Running {
            status.semantics.stage = Some(stage.name().to_owned());
            status.semantics.fraction = stage.overall(fraction);
        }
    }

    /// The next text orders them again.
    fn lasts(&self) -> bool {
        false
    }

    fn failed(&self, record: &mut Record, error: SceneError, _now_ms: u64) {
        record.status.semantics =
            SemanticsStatus { error: Some(error), ..SemanticsStatus::new(SemanticsState::Failed) };
    }
}

impl Work for MakeSemantics {
    fn span(&self, _: &Jobs, id: &SceneId) -> tracing::Span {
        tracing::info_span!("semantics", scene = %id)
    }

    fn run(&self, jobs: &Jobs, job: &Job) -> Result<()> {
        // A scene that failed, or fails meanwhile, never has any.
        let has_failed = || {
            let record = jobs.records.find(&job.scene);
            record.is_some_and(|record| record.status.state == SceneState::Failed)
        };
        if has_failed() {
            return Ok(());
        }
        let made = jobs.make_semantics(job);
        made.or_else(|error| if has_failed() { Ok(()) } else { Err(error) })
    }
}

impl Jobs {
    /// Queues the semantics of a finished scene, unless they are ready or on their way.
    /// Fails with `scene_not_found`; `overloaded` when too many scenes wait for theirs, or the
    /// server stops.
    pub(crate) fn understand(&self, id: &SceneId) -> Result<()> {
        let record = self.record(id)?;
        let open = [SemanticsState::None, SemanticsState::Failed];
        if record.status.state != SceneState::Done || !open.contains(&record.status.semantics.state)
        {
            return Ok(());
        }
        let reserved = self.queue.reserve(SEMANTICS, record.owner.as_deref());
        let place = reserved.map_err(|full| self.overloaded(full))?;
        // Of many callers one is the first.
        if self.records.apply(id, &Change::SemanticsOrdered)?.is_any() {
            self.replicas.hold(id);
            place.fill(id.clone());
        }
        Ok(())
    }

    /// Queues the semantics of a scene that is being made.
    pub(super) fn understand_early(&self, id: &SceneId) -> Result<()> {
        let ordered = self.records.apply(id, &Change::SemanticsOrdered)?;
        if ordered.is_any() {
            self.queue.push(SEMANTICS, id.clone(), ordered.after.owner.as_deref());
        }
        Ok(())
    }

    /// Marks the semantics of a scene as not made: their file is gone, or the networks that made
    /// them are no longer loaded. Blocks on the store.
    /// Fails with `scene_not_found`, `store_unavailable`.
    pub(crate) fn lose_semantics(&self, id: &SceneId) -> Result<()> {
        let lost = self.records.apply_with(id, &Change::SemanticsLost, |record| {
            self.parts.store.drop_semantics(id)?;
            self.parts.store.put_record(record)
        });
        lost.map(drop)
    }

    /// Of each text the score at each Gaussian of a finished scene, as the network of text masks
    /// finds it in the scene's photos; `None` where there is no such network or no photos. Blocks.
    /// Fails as the network and the store do.
    pub(crate) fn find_words(
        &self,
        scene: &Scene,
        texts: &[String],
    ) -> Result<Option<Vec<Vec<u16>>>> {
        let (networks, report) = (&self.parts.semantics, &scene.meta.report);
        if !networks.masks_texts() || !self.parts.keep_photos || report.file_format.is_some() {
            return Ok(None);
        }
        let cancel = &AtomicBool::new(false);
        let upload = self.upload(&scene.meta.id, Watch { progress: &|_, _| {}, cancel })?;
        let photos = &upload.photos()?.photos;
        let _room =
            self.room.take(photos.len(), self.parts.limits.get().network_photos_max, cancel)?;
        networks.find_words(photos, scene, texts, cancel).map(Some)
    }

    /// The scene of a job, once it is made.
    /// Fails with `scene_not_found`, `cancelled`, and as the store does.
    fn made_scene(&self, job: &Job) -> Result<Arc<Scene>> {
        self.bell.wait_in_job(&job.cancel, || match self.record(&job.scene) {
            Err(gone) => Ok(Err(gone)),
            Ok(record) => match record.status.state {
                SceneState::Done => Ok(Ok(())),
                SceneState::Queued | SceneState::Running => Err(FOREVER),
                SceneState::Failed | SceneState::Cancelled => {
                    Ok(Err(Error::new(ErrorCode::Cancelled, "the scene was not made")))
                }
            },
        })??;
        self.parts.store.scene(&job.scene)
    }

    fn make_semantics(&self, job: &Job) -> Result<()> {
        let id = &job.scene;
        // No version is published while they are made of the one before.
        let _lock = self.lock(id.as_str(), job)?;
        let named = |e: Error| {
            let message = format!("{}: {}", job.kind.what(), e.message());
            Error::new(e.code(), message).caused_by(e)
        };
        self.find_or_make_semantics(job).map_err(named)?;
        let bank_size = self.record(id)?.status.semantics.bank_size;
        tracing::info!(scene = %id, bank_size, "semantics ready");
        self.drop_upload_unless_needed(id);
        Ok(())
    }

    fn find_or_make_semantics(&self, job: &Job) -> Result<()> {
        let (id, store) = (&job.scene, &self.parts.store);
        let record = self.record(id)?;
        let report = record.status.report.as_ref();
        let method = report.map_or_else(|| record.options.method(), |of| of.method.clone());
        // A start that lost the status but not the file has nothing to make.
        if record.status.state == SceneState::Done {
            let scene = store.scene(id)?;
            if let Some(semantics) = &scene.semantics {
                let found = Change::SemanticsReady(&semantics.report, &scene.semantics_sha256);
                return self.records.apply(id, &found).map(drop);
            }
        }
        let semantics = self.within_time(job, |watch| {
            let upload = self.upload(id, watch)?;
            let photos = &upload.photos()?.photos;
            let photos_max = self.parts.limits.get().network_photos_max;
            let _room = self.room.take(photos.len(), photos_max, watch.cancel)?;
            let made = || self.made_scene(job);
            let made = self.parts.semantics.make_more(photos, None, &method, &made, watch)?;
            let (semantics, labelled) = made;
            labelled.into_iter().for_each(|labelled| self.uploads.keep_labelled(id, labelled));
            Ok(semantics)
        })?;
        if record.status.state == SceneState::Done {
            self.unless_lost(job)?;
        }
        let (report, packed) = (semantics.report.clone(), store.pack_semantics(id, semantics)?);
        let sha256 = packed.file_sha256().to_owned();
        // A record without the file counts as no semantics, so both are kept at the same time.
        self.records.apply_with(id, &Change::SemanticsReady(&report, &sha256), |record| {
            let put = || store.put_semantics(packed).map(drop);
            let (put, kept) = side_by_side(put, || store.put_record(record));
            put.and(kept)
        })?;
        Ok(())
    }
}
