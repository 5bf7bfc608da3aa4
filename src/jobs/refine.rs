//! The job that refines a finished scene. The scene is served meanwhile; the better version takes
//! its place in one step.
//!
//! It goes behind everything else: before each step it waits until no scene and no semantics are
//! made and no view was drawn for a moment. Where views never end it has a fourth of the time. It
//! holds no slot and no room. What it still has to do is in the record, so that a start begins it
//! again.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use parking_lot::Mutex;

use super::{
    Jobs,
    job::{Job, Kind, Reason},
};
use crate::{
    error::{Error, Result},
    limits::Limits,
    pipeline::{
        PhotoSet,
        refinement::{refined, reported, version_of},
    },
    refine::{HOLDS_OUT_FROM, RefineBudget, RefineOptions, RefinedVersion},
    render::{DifferentiableRenderer, cpu::CpuRenderer},
    scene::{
        PosedPhoto, Refine, RefineReport, RefineState, RefineStatus, Scene, SceneId, Stage, Watch,
        unless_cancelled,
    },
    store::{self, Record, RefineOrder},
};

/// Starts without a better version before a refinement is given up: one that kills the server must
/// not do so forever.
const ATTEMPTS_MAX: u32 = 3;
/// Processor time that `auto` takes, and the least and most milliseconds of it.
const AUTO_CPU_MS: u64 = 120_000;
const AUTO_MS: [u64; 2] = [10_000, 60_000];
/// Time without views after which it goes on.
const QUIET: Duration = Duration::from_millis(250);
/// Where views never end it goes on after so many times the time that it worked, or so long: a
/// step takes a millisecond of a device, and a tenth of a second of a processor.
const WAITS: u32 = 3;
const PATIENCE: Duration = Duration::from_secs(1);
/// Time between two looks at whether it may go on.
const LOOK: Duration = Duration::from_millis(10);
/// A change of the fraction that watchers are told.
const TOLD: f32 = 0.01;

/// What refines where views are drawn on a device that can, or on none.
///
/// # Errors
/// `internal` when threads cannot be started.
pub(crate) fn refiner(
    device: Option<Arc<dyn DifferentiableRenderer>>,
    threads: usize,
) -> Result<Arc<dyn DifferentiableRenderer>> {
    match device {
        Some(device) => Ok(device),
        // Threads of its own: a view never waits for a step.
        None => Ok(Arc::new(CpuRenderer::new(threads)?)),
    }
}

/// A refinement of so many milliseconds within the limits.
pub(crate) fn refine_options(ms: u64, limits: &Limits) -> RefineOptions {
    let time = Duration::from_millis(ms);
    RefineOptions {
        budget: RefineBudget { steps: limits.refine_steps_max, time },
        gaussians_max: limits.refine_gaussians_max,
        device_bytes_max: limits.refine_device_bytes_max,
        ..RefineOptions::default()
    }
}

/// Milliseconds that a scene of so many photos is to be refined for; `None`: not at all.
pub(crate) fn budget_ms(refine: Refine, photos: usize, threads: usize) -> Option<u64> {
    match refine {
        Refine::Off => None,
        Refine::Ms(ms) => Some(ms),
        // With fewer photos none is held out, and nothing tells whether it helps.
        Refine::Auto if photos < HOLDS_OUT_FROM => None,
        Refine::Auto => Some((AUTO_CPU_MS / threads.max(1) as u64).clamp(AUTO_MS[0], AUTO_MS[1])),
    }
}

/// Forgets a refinement that another process has.
pub(super) fn reset(record: &mut Record) {
    record.refine = None;
    if record.status.is_refined_now() {
        record.status.refinement = RefineStatus::default();
    }
}

impl Jobs {
    /// Queues the refinement of a finished scene, or ends it; one that is on its way stays.
    /// Fails with `scene_not_found`; `overloaded` when too many wait, or the server stops;
    /// `store_unavailable`.
    pub(crate) fn refine(&self, id: &SceneId, how: Refine) -> Result<()> {
        let record = self.record(id)?;
        let photos = record.status.cameras.len();
        let Some(ms) = budget_ms(how, photos, self.parts.threads) else {
            return self.end_refinement(id);
        };
        if record.refine.is_some() {
            return Ok(());
        }
        let reserved = self.queue.reserve(Kind::Refine, record.owner.as_deref());
        let place = reserved.map_err(|full| self.overloaded(full))?;
        if self.order(id, Some(RefineOrder { ms, attempts: 0 }))? {
            self.replicas.hold(id);
            place.fill(id.clone());
        }
        Ok(())
    }

    fn end_refinement(&self, id: &SceneId) -> Result<()> {
        self.queue.remove_kind(Kind::Refine, id);
        self.running.stop_kind(Kind::Refine, id, Reason::Cancelled);
        self.order(id, None).map(drop)
    }

    /// Keeps what is to be refined, in the record and in the store; whether it was otherwise.
    fn order(&self, id: &SceneId, order: Option<RefineOrder>) -> Result<bool> {
        let mut kept = Ok(false);
        self.records.update(id, |record| {
            // Under the record's lock: of many callers one is the first.
            if record.refine.is_some() == order.is_some() {
                return;
            }
            let before = record.clone();
            record.refine = order;
            let state = match (&order, &record.status.report) {
                (Some(_), _) => RefineState::Running,
                (None, Some(report)) if report.refinement.is_some() => RefineState::Done,
                (None, _) => RefineState::None,
            };
            record.status.refinement = RefineStatus::new(state);
            kept = self.parts.store.put_record(record).map(|()| true);
            if kept.is_err() {
                *record = before;
            }
        });
        kept
    }

    /// Keeps a record of the job. A refinement that is ended meanwhile stays ended in the store.
    fn keep_beside_orders(&self, record: &Record) -> Result<()> {
        self.parts.store.put_record(record)?;
        match self.records.find(&record.status.id) {
            Some(now) if now.refine.is_some() != record.refine.is_some() => {
                self.parts.store.put_record(&now)
            }
            _ => Ok(()),
        }
    }

    /// The refinement that a scene is to have once it is done, where its create call or the
    /// configuration asks for one and the queue has room.
    pub(super) fn first_order(&self, done: &Record) -> Option<RefineOrder> {
        let report = done.status.report.as_ref()?;
        if report.refinement.is_some() || report.file_format.is_some() {
            return None; // a copy of a scene that was refined, or one without photos
        }
        let how = done.options.refine.unwrap_or(self.parts.refine);
        let ms = budget_ms(how, done.status.cameras.len(), self.parts.threads)?;
        self.queue.reserve(Kind::Refine, done.owner.as_deref()).ok()?;
        Some(RefineOrder { ms, attempts: 0 })
    }

    /// Where a version was published and its record was not: the record of that version.
    pub(super) fn mend(&self, record: &mut Record) {
        let id = &record.status.id;
        let Ok(scene) = self.parts.store.scene(id) else { return };
        if record.scene_sha256.as_ref() != Some(&scene.sha256) {
            shows(record, &scene);
            self.keep_record(record);
        }
    }

    pub(super) fn refine_scene(&self, job: &Job) -> Result<()> {
        let id = &job.scene;
        let begun = self.records.update(id, |record| {
            if let Some(order) = &mut record.refine {
                order.attempts += 1;
            }
        });
        let Some(record) = begun else { return Ok(()) };
        let Some(order) = record.refine else { return Ok(()) };
        self.keep_beside_orders(&record)?;
        if order.attempts > ATTEMPTS_MAX {
            return Err(Error::internal(format!(
                "given up: the server stopped {ATTEMPTS_MAX} times without a better version"
            )));
        }
        let turns = Turns { jobs: self, job, resumed: Mutex::new(Instant::now()) };
        let progress = |_: Stage, _: f32| drop(turns.give_way());
        let watch = Watch { progress: &progress, cancel: &job.cancel };
        turns.give_way()?;
        let scene = self.parts.store.scene(id)?;
        let upload = self.upload(id, watch)?;
        let PhotoSet { photos, warnings, .. } = upload.photos()?;
        let options = refine_options(order.ms, &self.parts.limits);
        let mut remake = |photos: Vec<PosedPhoto>| {
            let photos = PhotoSet { photos, warnings: warnings.clone(), read_ms: 0.0 };
            self.parts.scenes.make_for_refinement(&photos, &record.options, watch)
        };
        let mut told = 0.0;
        let mut pace = |spent: f32| {
            if spent >= told + TOLD {
                told = spent;
                self.show(job, Stage::Refine, spent);
            }
            turns.give_way()
        };
        let renderer = &*self.parts.refiner;
        let found = refined(renderer, &scene, photos, &options, &mut remake, &mut pace)?;
        if let Some((start, version)) = &found.version {
            self.publish(job, start, version)?;
        }
        self.finish_refinement(job, &found.report)
    }

    /// A better version takes the place of the one that is served.
    fn publish(&self, job: &Job, start: &Scene, version: &RefinedVersion) -> Result<()> {
        let (id, store) = (&job.scene, &self.parts.store);
        // No semantics are made of Gaussians that are replaced meanwhile.
        let _lock = self.lock(id.as_str(), job)?;
        let served = store.scene(id)?;
        let scene = store.put_version(version_of(start, &served, version)?)?;
        let Some(mut record) = self.records.find(id).map(Arc::unwrap_or_clone) else {
            return Ok(());
        };
        let change = |record: &mut Record| {
            shows(record, &scene);
            record.status.version += 1;
            if let Some(order) = &mut record.refine {
                order.attempts = 0;
            }
        };
        change(&mut record);
        store.put_status(&record)?;
        if let Some(shown) = self.records.update(id, change) {
            self.keep_beside_orders(&shown)?;
        }
        let psnr = version.report.psnr_after;
        tracing::info!(scene = %id, version = record.status.version, psnr, "refined");
        Ok(())
    }

    fn finish_refinement(&self, job: &Job, found: &RefineReport) -> Result<()> {
        let (id, store) = (&job.scene, &self.parts.store);
        let _lock = self.lock(id.as_str(), job)?;
        let Some(mut record) = self.records.find(id).map(Arc::unwrap_or_clone) else {
            return Ok(());
        };
        let found = reported(record.status.cameras.len(), found);
        let change = |record: &mut Record| {
            record.refine = None;
            record.status.refinement =
                RefineStatus { fraction: 1.0, ..RefineStatus::new(RefineState::Done) };
            // Where no version was better, the record alone says what came out.
            if let Some(report) = &mut record.status.report {
                report.refinement.get_or_insert_with(|| found.clone());
            }
        };
        change(&mut record);
        store.put_status(&record)?;
        self.records.update(id, change);
        tracing::info!(scene = %id, steps = found.steps, "refinement is over");
        if !self.parts.keep_photos && record.status.is_settled() {
            store.drop_upload(id)?;
        }
        Ok(())
    }
}

/// When a refinement works and when it waits.
struct Turns<'a> {
    jobs: &'a Jobs,
    job: &'a Job,
    /// The end of its last wait.
    resumed: Mutex<Instant>,
}

impl Turns<'_> {
    /// Waits until nothing else is to be done, or nothing but views and those for long enough.
    /// Fails with `cancelled`.
    fn give_way(&self) -> Result<()> {
        let Self { jobs, job, resumed } = self;
        let mut resumed = resumed.lock();
        let (worked, begun) = (resumed.elapsed(), Instant::now());
        loop {
            unless_cancelled(&job.cancel)?;
            let made = [Kind::Scene, Kind::Semantics];
            let makes = |kind| jobs.queue.len(kind) > 0 || !jobs.running.scenes(kind).is_empty();
            let left = views_go_first((jobs.parts.drawn)(), worked, begun.elapsed());
            if left.is_zero() && !made.into_iter().any(makes) {
                *resumed = Instant::now();
                return Ok(());
            }
            std::thread::sleep(if left.is_zero() { LOOK } else { left.min(LOOK) });
        }
    }
}

/// How much longer views go first: the last was drawn some time ago, and the refinement waits since
/// it `worked` so long.
fn views_go_first(drawn: Option<Duration>, worked: Duration, waited: Duration) -> Duration {
    let quiet = drawn.map_or(Duration::ZERO, |ago| QUIET.saturating_sub(ago));
    quiet.min((worked * WAITS).min(PATIENCE).saturating_sub(waited))
}

/// The record says what the scene says of itself.
fn shows(record: &mut Record, scene: &Scene) {
    record.scene_sha256 = Some(scene.sha256.clone());
    record.status.report = Some(scene.meta.report.clone());
    record.status.cameras.clone_from(&scene.meta.cameras);
    record.status.updated_ms = store::now_ms();
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn auto_takes_what_the_machine_has_and_leaves_few_photos_alone() {
        let auto = |photos, threads| budget_ms(Refine::Auto, photos, threads);
        assert_eq!([auto(4, 2), auto(5, 2), auto(5, 1)], [None, Some(60_000), Some(60_000)]);
        assert_eq!([auto(64, 8), auto(64, 64)], [Some(15_000), Some(10_000)]);
        assert_eq!(budget_ms(Refine::Off, 9, 2), None);
        assert_eq!(budget_ms(Refine::Ms(7), 2, 2), Some(7));
    }

    #[test]
    fn views_without_end_leave_a_fourth_of_the_time() {
        let ms = Duration::from_millis;
        let left = |drawn: Option<u64>, worked, waited| {
            views_go_first(drawn.map(ms), ms(worked), ms(waited)).as_millis()
        };
        assert_eq!(left(None, 100, 0), 0, "nobody looks");
        assert_eq!([left(Some(250), 100, 0), left(Some(240), 100, 0)], [0, 10], "a quiet moment");
        assert_eq!([left(Some(0), 1, 0), left(Some(0), 1, 2), left(Some(0), 1, 3)], [3, 1, 0]);
        assert_eq!([left(Some(0), 5_000, 900), left(Some(0), 5_000, 1_000)], [100, 0]);
    }
}
