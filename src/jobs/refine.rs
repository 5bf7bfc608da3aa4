//! The job that refines a finished scene. The scene is served meanwhile; each better version takes
//! its place in one step.
//!
//! It goes behind everything else: before each step it waits until no other job waits or runs and
//! no view was drawn for a moment. Where views never end it has a fourth of a device's time, and
//! less of a processor's (`refiner.rs`). It holds no slot and no room. Where no device draws it has
//! a share of the threads, of low priority. What it still has to do is in the record, so that a
//! start begins it again.

use std::{
    borrow::Cow,
    sync::Arc,
    time::{Duration, Instant},
};

use parking_lot::Mutex;

use super::{
    bell::FOREVER,
    change::{Change, forget_refinement},
    job::{Job, Reason},
    kind::{JobKind, Kind},
    shared::{Jobs, Work},
};
use crate::{
    error::Result,
    limits::Limits,
    pipeline::{
        PhotoSet,
        refinement::{RefineCalls, refined, reported, spooled, version_of},
    },
    refine::{RefineBudget, RefineOptions, RefinedVersion},
    scene::{
        PosedPhoto, Refine, RefineReport, RefineState, RefineStatus, Scene, SceneError, SceneId,
        SceneStatus, Stage, Watch,
    },
    store::{Record, RefineOrder},
};

/// A change of the fraction that watchers are told.
const TOLD: f32 = 0.01;

/// Refines a finished scene.
pub(super) struct RefineScene;

pub(super) const REFINE: Kind = &RefineScene;

impl JobKind for RefineScene {
    fn name(&self) -> &'static str {
        "refine"
    }

    fn what(&self) -> &'static str {
        "the scene's refinement"
    }

    fn show(&self, status: &mut SceneStatus, stage: Stage, fraction: f32) {
        // The parts of its start are none of a refinement's own time.
        if stage == Stage::Refine {
            status.refinement.fraction = fraction;
        }
    }

    fn attempts<'a>(&self, record: &'a mut Record) -> Option<&'a mut u32> {
        record.refine.as_mut().map(|order| &mut order.attempts)
    }

    fn failed(&self, record: &mut Record, error: SceneError, _now_ms: u64) {
        forget_refinement(record);
        record.status.refinement =
            RefineStatus { error: Some(error), ..RefineStatus::new(RefineState::Failed) };
    }
}

impl Work for RefineScene {
    fn threads(&self, _: usize) -> usize {
        1
    }

    fn span(&self, _: &Jobs, id: &SceneId) -> tracing::Span {
        tracing::info_span!("refine", scene = %id)
    }

    fn run(&self, jobs: &Jobs, job: &Job) -> Result<()> {
        jobs.refine_scene(job)
    }
}

/// A refinement of so many milliseconds within the limits.
pub(crate) fn refine_options(ms: u64, limits: &Limits) -> RefineOptions {
    let time = Duration::from_millis(ms);
    RefineOptions {
        budget: RefineBudget { steps: limits.refine_steps_max, time },
        gaussians_max: limits.refine_gaussians_max,
        side: limits.refine_side_max,
        device_bytes_max: limits.refine_device_bytes_max,
        ..RefineOptions::default()
    }
}

impl Jobs {
    /// Queues the refinement of a finished scene, or ends it; one that is on its way stays.
    /// Fails with `scene_not_found`; `overloaded` when too many wait, or the server stops;
    /// `store_unavailable`.
    pub(crate) fn refine(&self, id: &SceneId, how: Refine) -> Result<()> {
        let record = self.record(id)?;
        let photos = record.status.cameras.len();
        let Some(ms) = self.parts.refiner.budget_ms(how, photos) else {
            return self.end_refinement(id);
        };
        if record.refine.is_some() {
            return Ok(());
        }
        let reserved = self.queue.reserve(REFINE, record.owner.as_deref());
        let place = reserved.map_err(|full| self.overloaded(full))?;
        let order = RefineOrder { ms, attempts: 0 };
        // Of many callers one is the first.
        if self.records.apply(id, &Change::RefineOrdered(order))?.is_any() {
            self.replicas.hold(id);
            place.fill(id.clone());
        }
        Ok(())
    }

    fn end_refinement(&self, id: &SceneId) -> Result<()> {
        self.queue.remove(id, Some(REFINE));
        self.running.stop(Reason::Cancelled, |job| job.kind == REFINE && job.scene == *id);
        if self.replicas.is_lost(self, id)? {
            return Ok(());
        }
        self.records.apply(id, &Change::RefineEnded(None)).map(drop)
    }

    /// The refinement that a scene is to have once it is done, where its create call or the
    /// configuration asks for one and the queue has room.
    pub(super) fn first_order(&self, record: &Record, scene: &Scene) -> Option<RefineOrder> {
        let report = &scene.meta.report;
        if report.refinement.is_some() || report.file_format.is_some() {
            return None; // a copy of a scene that was refined, or one without photos
        }
        let ms = self.first_budget_ms(record, scene.meta.cameras.len())?;
        self.queue.reserve(REFINE, record.owner.as_deref()).ok()?;
        Some(RefineOrder { ms, attempts: 0 })
    }

    /// Whether a scene of so many photos that is being made is to be refined.
    pub(super) fn is_refined_next(&self, record: &Record, photos: usize) -> bool {
        self.first_budget_ms(record, photos).is_some()
    }

    fn first_budget_ms(&self, record: &Record, photos: usize) -> Option<u64> {
        let how = record.options.refine.unwrap_or(self.parts.refine);
        self.parts.refiner.budget_ms(how, photos)
    }

    /// Where a version was published and its record was not: the record of that version.
    pub(super) fn mend(&self, record: &Record) {
        let id = &record.status.id;
        // Of photos that join the job that adds them tells.
        let grows = !record.growth.waiting.is_empty();
        let Ok(scene) = self.parts.store.scene(id) else { return };
        if !grows
            && record.scene_sha256.as_ref() != Some(&scene.sha256)
            && let Err(error) = self.records.apply(id, &Change::Published(&scene))
        {
            tracing::error!(scene = %id, %error, "its status is not kept");
        }
    }

    fn refine_scene(&self, job: &Job) -> Result<()> {
        let id = &job.scene;
        let record = self.record(id)?;
        let Some(order) = record.refine else { return Ok(()) };
        self.check_attempts(job.kind, &record)?;
        self.records.apply(id, &Change::Started(job.kind))?;
        self.mend(&record);
        let turns = GivesWay { jobs: self, job, resumed: Mutex::new(Instant::now()) };
        let progress = |_: Stage, _: f32| drop(turns.give_way());
        let watch = Watch { progress: &progress, cancel: &job.cancel };
        turns.give_way()?;
        let scene = self.parts.store.scene(id)?;
        let upload = self.upload(id, watch)?;
        let photos = upload.photos()?;
        let options = refine_options(order.ms, &self.parts.limits.get());
        let scenes = &self.parts.scenes;
        // The networks run again where what they said is not here any more.
        let seen = self.uploads.find_seen(id);
        let seen = match seen.filter(|seen| seen.photos() == photos.photos.len()) {
            Some(seen) => Some(seen),
            None => scenes.make_keeping(photos, &record.options, watch)?.1.map(Arc::new),
        };
        // With the cameras that the photos have now.
        let made_of = Mutex::new((Cow::Borrowed(photos), seen));
        let mut remake = |held: &[usize]| {
            let (photos, seen) = &mut *made_of.lock();
            // Nothing needs it after all photos.
            let seen = if held.is_empty() { seen.take() } else { seen.clone() };
            scenes.make_for_refinement(photos, held, seen.as_deref(), &record.options, watch)
        };
        let mut recast = || {
            let found = scenes.recast(&photos.photos, &record.options, watch)?;
            let Some((found, seen)) = found else { return Ok(None) };
            let poses = found.iter().map(|posed| posed.camera.camera_to_world).collect();
            let photos = PhotoSet { photos: found, ..photos.clone() };
            *made_of.lock() = (Cow::Owned(photos), Some(Arc::new(seen)));
            Ok(Some(poses))
        };
        let mut more = |side: u32| {
            if !photos.has_more() {
                return Ok(None);
            }
            let (upload, limits) = (self.parts.store.upload(id)?, self.parts.limits.get());
            let (dir, mode) = (self.parts.store.folder(), record.options.cameras);
            let method = record.options.method();
            let mut ready = |photo: &mut PosedPhoto| {
                turns.give_way()?;
                if record.options.ignore.is_empty() {
                    return Ok(());
                }
                let one = PhotoSet::given(vec![photo.clone()], Vec::new(), 0.0);
                let words = &record.options.ignore;
                let one = self.parts.semantics.without_words(one, words, &method, watch)?;
                one.photos.into_iter().for_each(|one| *photo = one);
                Ok(())
            };
            spooled(&upload, mode, side, &limits, dir, &mut ready).map(Some)
        };
        let mut told = 0.0;
        let mut pace = |spent: f32| {
            if spent >= told + TOLD {
                told = spent;
                self.show(job, Stage::Refine, spent);
            }
            turns.give_way()
        };
        let mut publish =
            |start: &Scene, version: &RefinedVersion| self.publish(job, start, version);
        let found = self.parts.refiner.run(|renderer| {
            let calls = RefineCalls {
                remake: &mut remake,
                recast: &mut recast,
                more: &mut more,
                pace: &mut pace,
                publish: &mut publish,
            };
            refined(renderer, &scene, &photos.photos, &options, calls)
        })?;
        self.finish_refinement(job, &found.report)
    }

    /// A better version takes the place of the one that is served.
    fn publish(&self, job: &Job, start: &Scene, version: &RefinedVersion) -> Result<()> {
        let (id, store) = (&job.scene, &self.parts.store);
        // No semantics are made of Gaussians that are replaced meanwhile.
        let _lock = self.lock(id.as_str(), job)?;
        self.unless_lost(job)?;
        let served = store.scene(id)?;
        let scene = store.put_version(version_of(start, &served, version)?)?;
        let published = self.records.apply(id, &Change::Published(&scene))?.after;
        let psnr = version.report.psnr_after;
        tracing::info!(scene = %id, version = published.status.version, psnr, "refined");
        (self.parts.foresee)(id);
        Ok(())
    }

    fn finish_refinement(&self, job: &Job, found: &RefineReport) -> Result<()> {
        let id = &job.scene;
        let _lock = self.lock(id.as_str(), job)?;
        self.unless_lost(job)?;
        let found = reported(self.record(id)?.status.cameras.len(), found);
        self.records.apply(id, &Change::RefineEnded(Some(&found)))?;
        tracing::info!(scene = %id, steps = found.steps, "refinement is over");
        self.drop_upload_unless_needed(id);
        Ok(())
    }
}

/// When a refinement works and when it waits.
struct GivesWay<'a> {
    jobs: &'a Jobs,
    job: &'a Job,
    /// The end of its last wait.
    resumed: Mutex<Instant>,
}

impl GivesWay<'_> {
    /// Waits until nothing else is to be done, or nothing but views and those for long enough.
    /// Fails with `cancelled`.
    fn give_way(&self) -> Result<()> {
        let Self { jobs, job, resumed } = self;
        let mut resumed = resumed.lock();
        let (worked, begun) = (resumed.elapsed(), Instant::now());
        let is_made = |kind: Kind| {
            let makes = jobs.queue.len(kind) > 0 || !jobs.running.scenes(kind).is_empty();
            makes && kind != job.kind
        };
        jobs.bell.wait_in_job(&job.cancel, || {
            let left = jobs.parts.refiner.manners().views_go_first(
                (jobs.parts.since_last_view)(),
                worked,
                begun.elapsed(),
            );
            match left.is_zero() {
                false => Err(left),
                true if jobs.kinds.iter().any(|kind| is_made(*kind)) => Err(FOREVER),
                true => Ok(()),
            }
        })?;
        *resumed = Instant::now();
        Ok(())
    }
}
