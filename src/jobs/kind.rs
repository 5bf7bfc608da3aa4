//! What a record says of a kind of job.

use std::{
    fmt,
    hash::{Hash, Hasher},
};

use crate::{
    scene::{SceneError, SceneStatus, Stage},
    store::Record,
};

/// A kind of job, as far as records and queues know it. What it does is its `Work`; both are in one
/// file of each kind.
pub(super) trait JobKind: Send + Sync {
    /// Name in metrics, spans and names of threads.
    fn name(&self) -> &'static str;

    /// What it makes, in messages.
    fn what(&self) -> &'static str;

    /// Puts the progress of a job into the status of its scene; `fraction` is that of the stage.
    fn show(&self, status: &mut SceneStatus, stage: Stage, fraction: f32);

    /// Whether the store keeps that the job is to be done. Such a job goes on after a stop of the
    /// server and when the store works again, and its end is kept.
    fn lasts(&self) -> bool {
        true
    }

    /// How often the job was begun without a result, where it lasts.
    fn attempts<'a>(&self, _: &'a mut Record) -> Option<&'a mut u32> {
        None
    }

    /// A worker begins: one attempt is counted already.
    fn started(&self, _: &mut Record, _now_ms: u64) {}

    /// The job waits again, from its start.
    fn requeued(&self, _: &mut Record) {}

    /// The job has failed.
    fn failed(&self, record: &mut Record, error: SceneError, now_ms: u64);
}

/// A kind of job that is listed.
pub(super) type Kind = &'static dyn JobKind;

impl PartialEq for dyn JobKind {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl Eq for dyn JobKind {}

impl Hash for dyn JobKind {
    fn hash<H: Hasher>(&self, to: &mut H) {
        self.name().hash(to);
    }
}

impl fmt::Debug for dyn JobKind {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        to.write_str(self.name())
    }
}
