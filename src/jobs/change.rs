//! Every change of a scene's record after its creation, by name.

use super::kind::Kind;
use crate::{
    error::Error,
    scene::{
        GrowthStatus, Refine, RefineReport, RefineState, RefineStatus, Scene, SceneError,
        SceneState, SemanticsMode, SemanticsReport, SemanticsState, SemanticsStatus,
    },
    store::{PhotoChange, Record, RefineOrder},
};

/// A change of the record of a scene.
#[derive(Debug)]
pub(super) enum Change<'a> {
    /// A worker begins a job.
    Started(Kind),
    /// The scene is in the store, with its semantics where it has some; it is to be refined where
    /// there is an order. Eager semantics that are not on their way are ordered with it.
    Made(&'a Scene, Option<RefineOrder>),
    /// The semantics are to be made, unless they are made or on their way.
    SemanticsOrdered,
    /// The semantics are in the store, in a file of this sha256, hex.
    SemanticsReady(&'a SemanticsReport, &'a str),
    /// The semantics are gone.
    SemanticsLost,
    /// A better version is in the store.
    Published(&'a Scene),
    /// The scene is to be refined, unless it is already.
    RefineOrdered(RefineOrder),
    /// The refinement is over with this result, or it was called off.
    RefineEnded(Option<&'a RefineReport>),
    /// Photos are to join the scene, or to leave it. A refinement that waits or is at work begins
    /// again after that.
    PhotosOrdered(&'a PhotoChange),
    /// The version in which the first change of photos is done is in the store; it is to be refined
    /// where there is an order.
    Grown(&'a Scene, Option<RefineOrder>),
    /// A job has failed.
    Failed(Kind, &'a Error),
    /// A job needs what another version of the program wrote: it is shown as failed, and the store
    /// keeps that it is to be done.
    Left(Kind, &'a Error),
    /// A job waits again from its start. The attempt counts where the job itself may be the reason.
    Requeued(Kind, Attempt),
    /// All jobs of the scene are stopped: it was to be deleted.
    Stopped,
}

/// Whether a job that waits again has used up one of its attempts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Attempt {
    Counts,
    IsForgotten,
}

/// How the store and the watchers learn of a change.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kept {
    /// The store keeps it first. Where it does not, nobody sees the change and the call fails.
    First,
    /// The store is asked first. Where it does not keep it, the change is shown all the same: what
    /// the store has leads a start to the same end.
    Tried,
    /// It is shown at once and not kept: it ends with the process.
    No,
}

impl Change<'_> {
    pub(super) fn kept(&self) -> Kept {
        match self {
            Self::SemanticsOrdered | Self::Stopped | Self::Left(..) => Kept::No,
            Self::Failed(kind, _) | Self::Requeued(kind, _) if kind.lasts() => Kept::Tried,
            Self::Failed(..) | Self::Requeued(..) => Kept::No,
            _ => Kept::First,
        }
    }

    /// Changes a record at this time; whether there was something to change.
    pub(super) fn apply(&self, record: &mut Record, now_ms: u64) -> bool {
        let semantics = record.status.semantics.state;
        match self {
            Self::Started(kind) => {
                if let Some(attempts) = kind.attempts(record) {
                    *attempts += 1;
                }
                kind.started(record, now_ms);
            }
            Self::Made(scene, order) => {
                made(record, scene, *order);
                record.status.updated_ms = now_ms;
            }
            Self::SemanticsOrdered => {
                let state = record.status.state;
                if matches!(state, SceneState::Failed | SceneState::Cancelled)
                    || !matches!(semantics, SemanticsState::None | SemanticsState::Failed)
                {
                    return false;
                }
                record.status.semantics = SemanticsStatus::new(SemanticsState::Running);
            }
            Self::SemanticsReady(report, sha256) => {
                record.status.semantics = SemanticsStatus::ready((*report).clone());
                record.semantics_sha256 = Some((*sha256).to_owned());
            }
            Self::SemanticsLost => {
                if semantics != SemanticsState::Ready {
                    return false;
                }
                record.status.semantics = SemanticsStatus::default();
                record.semantics_sha256 = None;
            }
            Self::Published(scene) => {
                shows(record, scene);
                record.status.updated_ms = now_ms;
                record.status.version += 1;
                if let Some(order) = &mut record.refine {
                    order.attempts = 0;
                }
            }
            Self::RefineOrdered(order) => {
                if record.refine.is_some() {
                    return false;
                }
                refine(record, Some(*order));
            }
            Self::RefineEnded(report) => {
                if record.refine.is_none() {
                    return false;
                }
                refine_ended(record, *report);
            }
            Self::PhotosOrdered(change) => return ordered(record, change),
            Self::Grown(scene, order) => {
                grown(record, scene, *order);
                record.status.updated_ms = now_ms;
            }
            Self::Failed(kind, error) | Self::Left(kind, error) => {
                kind.failed(record, SceneError::from(*error), now_ms);
            }
            Self::Requeued(kind, attempt) => {
                if let (Attempt::IsForgotten, Some(attempts)) = (attempt, kind.attempts(record)) {
                    *attempts = attempts.saturating_sub(1);
                }
                kind.requeued(record);
            }
            Self::Stopped => stopped(record),
        }
        true
    }
}

fn made(record: &mut Record, scene: &Scene, order: Option<RefineOrder>) {
    shows(record, scene);
    let content = &scene.meta.provenance.content_sha256;
    record.content_sha256 = Some(content.clone()).filter(|hash| !hash.is_empty());
    record.replica = None;
    record.status.state = SceneState::Done;
    record.status.stage = None;
    record.status.fraction = 1.0;
    record.status.version = 1;
    if order.is_some() {
        refine(record, order);
    }
    if let Some(semantics) = &scene.semantics {
        record.semantics_sha256 = Some(scene.semantics_sha256.clone());
        record.status.semantics = SemanticsStatus::ready(semantics.report.clone());
    } else if record.options.semantics == SemanticsMode::Eager
        && record.status.semantics.state == SemanticsState::None
    {
        record.status.semantics = SemanticsStatus::new(SemanticsState::Running);
    }
}

/// Whether the change can be done after those that wait: it names no photo that is there already,
/// or none that is not.
fn ordered(record: &mut Record, change: &PhotoChange) -> bool {
    let there = record.photos_to_be();
    let fits = match change {
        PhotoChange::Add(added) => !added.files.iter().any(|file| there.contains(&&**file)),
        PhotoChange::Remove(file) => there.contains(&&**file),
    };
    if record.status.state != SceneState::Done || !fits {
        return false;
    }
    if let Some(order) = record.refine {
        record.growth.refine = Some(Refine::Ms(order.ms));
        forget_refinement(record);
    }
    record.growth.waiting.push_back(change.clone());
    let before = std::mem::take(&mut record.status.growth);
    record.status.growth =
        GrowthStatus { stage: before.stage, fraction: before.fraction, ..record.growth.status() };
    true
}

fn grown(record: &mut Record, scene: &Scene, order: Option<RefineOrder>) {
    shows(record, scene);
    record.content_sha256 = Some(scene.meta.provenance.content_sha256.clone());
    record.status.version += 1;
    record.growth.attempts = 0;
    let change = record.growth.waiting.pop_front();
    record.growth.done(change, &scene.meta.cameras);
    record.status.growth = GrowthStatus::of(waiting(record));
    if record.growth.waiting.is_empty() {
        record.growth.refine = None;
        record.status.growth.fraction = 1.0;
    }
    if let Some(semantics) = &scene.semantics {
        record.semantics_sha256 = Some(scene.semantics_sha256.clone());
        record.status.semantics = SemanticsStatus::ready(semantics.report.clone());
    }
    if order.is_some() && record.refine.is_none() {
        refine(record, order);
    }
}

/// Changes of the photos that wait.
pub(super) fn waiting(record: &Record) -> u32 {
    u32::try_from(record.growth.waiting.len()).unwrap_or(u32::MAX)
}

/// The record says what the scene says of itself.
fn shows(record: &mut Record, scene: &Scene) {
    record.scene_sha256 = Some(scene.sha256.clone());
    record.status.report = Some(scene.meta.report.clone());
    record.status.cameras.clone_from(&scene.meta.cameras);
}

fn refine(record: &mut Record, order: Option<RefineOrder>) {
    record.refine = order;
    record.status.refinement = RefineStatus::new(RefineState::Running);
}

fn refine_ended(record: &mut Record, found: Option<&RefineReport>) {
    record.refine = None;
    let report = record.status.report.as_mut();
    // Where no version was better, the record alone says what came out.
    if let (Some(found), Some(report)) = (found, report) {
        report.refinement.get_or_insert_with(|| found.clone());
    }
    let report = record.status.report.as_ref();
    let refined = report.is_some_and(|report| report.refinement.is_some());
    let state = if refined || found.is_some() { RefineState::Done } else { RefineState::None };
    let fraction = if found.is_some() { 1.0 } else { 0.0 };
    record.status.refinement = RefineStatus { fraction, ..RefineStatus::new(state) };
}

fn stopped(record: &mut Record) {
    cancel(record);
    if record.status.semantics.state == SemanticsState::Running {
        record.status.semantics = SemanticsStatus::default();
    }
    forget_refinement(record);
}

/// Marks an unfinished scene as cancelled.
pub(super) fn cancel(record: &mut Record) {
    if !record.status.state.is_final() {
        record.status.state = SceneState::Cancelled;
        record.status.stage = None;
    }
}

/// Forgets what only the process that has the jobs of a scene knows: that its semantics are on
/// their way, or failed.
pub(super) fn forget_semantics_job(record: &mut Record) {
    let semantics = &mut record.status.semantics;
    if record.options.semantics == SemanticsMode::Off {
        *semantics = SemanticsStatus::new(SemanticsState::Off);
    } else if semantics.state != SemanticsState::Ready {
        *semantics = SemanticsStatus::default();
    }
}

/// Forgets a refinement that another process has.
pub(super) fn forget_refinement(record: &mut Record) {
    record.refine = None;
    if record.status.is_refined_now() {
        record.status.refinement = RefineStatus::default();
    }
}
