//! What scenes mean, made once however many ask: a queue of its own, one scene at a time, while
//! the scene itself can be viewed all along.
//!
//! The record's `semantics` says where it stands; watchers of the scene see its stages too.

use std::{
    fmt,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, MutexGuard, PoisonError, atomic::AtomicBool},
};

use super::{
    Jobs, Shared,
    worker::{Stop, panicked},
};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{
        Scene, SceneError, SceneId, SceneState, Semantics, SemanticsMode, SemanticsState,
        SemanticsStatus, Upload,
    },
    store::Record,
    telemetry::meter,
};

/// A scene whose meaning is asked for, and how its making tells where it is.
#[derive(Clone, Copy)]
pub struct SemanticsWork<'a> {
    /// Photos and cameras the scene was made of.
    pub upload: &'a Upload,
    /// The scene.
    pub scene: &'a Scene,
    /// Tells the stage at work and the share of the whole that is done, 0..1.
    pub progress: &'a (dyn Fn(&str, f32) + Sync),
    /// Turns true when the work is to stop; the answer is then `cancelled`.
    pub cancel: &'a AtomicBool,
}

impl fmt::Debug for SemanticsWork<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("SemanticsWork").field("scene", &self.scene.meta.id).finish_non_exhaustive()
    }
}

/// A text as the bundle's text tower sees it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EmbeddedText {
    /// `[D]`, unit length.
    pub row: Vec<f32>,
    /// Tokens that were read.
    pub tokens: usize,
    /// How many of them stand for something that the tokenizer does not know.
    pub unknown: usize,
    /// Whether the text was longer than the network reads, and was cut.
    pub cut: bool,
}

/// What the bundle compares texts with, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct Phrases {
    /// Canonical phrases: what a thing is called when nothing is known of it.
    pub canon: Vec<String>,
    /// Steepness of the comparison.
    pub tau: f32,
    /// Coverage under which a pixel has no semantics, 0..1.
    pub coverage_floor: f32,
}

/// Makes what a scene means: the pipeline, or a stand-in of a test.
pub trait SemanticsMaker: Send + Sync {
    /// What the loaded bundle lacks for it, as in "no mask network"; `None` where nothing.
    fn lacks(&self) -> Option<String>;

    /// What the bundle compares texts with.
    ///
    /// # Errors
    /// `model_unavailable`.
    fn phrases(&self) -> Result<Phrases>;

    /// Embeds texts, one after the other in their order. On the calling thread.
    ///
    /// # Errors
    /// `model_unavailable`, `internal`.
    fn embed_texts(&self, texts: &[String]) -> Result<Vec<EmbeddedText>>;

    /// Does the whole work on the calling thread.
    ///
    /// # Errors
    /// Any code; it becomes the `error` of the scene's semantics.
    fn make(&self, work: SemanticsWork<'_>) -> Result<Semantics>;
}

/// Makes nothing: the bundle has no networks for it.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoSemantics;

impl NoSemantics {
    fn refusal() -> Error {
        Error::new(ErrorCode::ModelUnavailable, "the bundle has no semantic networks")
    }
}

impl SemanticsMaker for NoSemantics {
    fn lacks(&self) -> Option<String> {
        Some("no semantic networks".to_owned())
    }

    fn phrases(&self) -> Result<Phrases> {
        Err(Self::refusal())
    }

    fn embed_texts(&self, _: &[String]) -> Result<Vec<EmbeddedText>> {
        Err(Self::refusal())
    }

    fn make(&self, _: SemanticsWork<'_>) -> Result<Semantics> {
        Err(Self::refusal())
    }
}

/// A record as it stands after a start: what was at work then is at work no more.
pub(super) fn at_start(record: &mut Record) {
    let semantics = &mut record.status.semantics;
    if record.options.semantics == SemanticsMode::Off {
        *semantics = SemanticsStatus::new(SemanticsState::Off);
    } else if semantics.state != SemanticsState::Ready {
        *semantics = SemanticsStatus::default();
    }
}

impl Jobs {
    /// Has the semantics of a finished scene made, unless they are ready or on their way.
    ///
    /// # Errors
    /// `scene_not_found`; `overloaded` when too many scenes wait for theirs, or the server stops.
    pub fn understand(&self, id: &SceneId) -> Result<()> {
        let shared = &self.shared;
        if !wanted(&self.record(id)?) {
            return Ok(());
        }
        let owner = self.record(id)?.owner;
        let place = shared.asked.reserve(owner.as_deref()).map_err(|full| self.overloaded(full))?;
        let mut first = false;
        shared.board.update(id, |record| {
            // Looked at again under the record's lock: of many callers one is the first.
            first = wanted(record);
            if first {
                record.status.semantics = SemanticsStatus::new(SemanticsState::Running);
            }
        });
        if first {
            shared.hold(id);
            place.fill(id.clone());
        }
        Ok(())
    }

    /// Takes back that the semantics of a scene are ready: their file is gone, or they were made by
    /// networks that are no longer loaded. Blocks on the disk.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn lose_semantics(&self, id: &SceneId) -> Result<()> {
        let mut lost = Ok(());
        self.shared.board.update(id, |record| {
            // Under the record's lock, so that no newer ones are lost.
            if record.status.semantics.state == SemanticsState::Ready {
                lost = self.shared.store.drop_semantics(id);
                record.status.semantics = SemanticsStatus::default();
                record.semantics_sha256 = None;
            }
        });
        lost
    }
}

fn wanted(record: &Record) -> bool {
    let open =
        matches!(record.status.semantics.state, SemanticsState::None | SemanticsState::Failed);
    record.status.state == SceneState::Done && open
}

impl Shared {
    pub(super) fn lock_thinking(
        &self,
    ) -> MutexGuard<'_, std::collections::HashMap<SceneId, Arc<Stop>>> {
        self.thinking.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The life of the thread that makes semantics.
    pub(super) fn think(&self) {
        let open = self.networks_open();
        while open && let Some(id) = self.asked.pop() {
            let _span = tracing::info_span!("semantics", scene = %id).entered();
            let stop = Arc::new(Stop::default());
            self.lock_thinking().insert(id.clone(), Arc::clone(&stop));
            if self.asked.is_closed() {
                stop.by_shutdown();
            }
            let outcome = catch_unwind(AssertUnwindSafe(|| self.understand(&id, &stop)))
                .unwrap_or_else(|panic| Err(panicked(&*panic)));
            meter::job("semantics", stop.outcome(outcome.is_ok()));
            if let Err(error) = outcome {
                self.give_up(&id, &stop, &error);
            }
            self.lock_thinking().remove(&id);
            self.done_with(&id);
        }
    }

    fn understand(&self, id: &SceneId, stop: &Stop) -> Result<()> {
        let scene = self.store.scene(id)?;
        // A start that lost the status but not the file has nothing to make.
        let (scene, digest) = if scene.semantics.is_some() {
            (scene, None)
        } else {
            let upload = self.store.upload(id)?;
            let progress = |stage: &str, fraction: f32| {
                self.board.update(id, |record| {
                    record.status.semantics.stage = Some(stage.to_owned());
                    record.status.semantics.fraction = fraction.clamp(0.0, 1.0);
                });
            };
            let made = self.within_time(stop, || {
                self.semantics.make(SemanticsWork {
                    upload: &upload,
                    scene: &scene,
                    progress: &progress,
                    cancel: stop.flag(),
                })
            })?;
            let (scene, digest) = self.store.put_semantics(id, made)?;
            (scene, Some(digest))
        };
        let report = scene.semantics.as_ref().map(|made| made.report.clone()).unwrap_or_default();
        // On disk first, so that a watcher who sees `ready` may pull the plug.
        let Some(mut ready) = self.board.find(id) else { return Ok(()) };
        ready.status.semantics = SemanticsStatus::ready(report);
        ready.semantics_sha256 = digest.or(ready.semantics_sha256);
        self.store.put_record(&ready)?;
        let bank_size = ready.status.semantics.bank_size;
        let eager = ready.options.semantics == SemanticsMode::Eager;
        self.board.update(id, |record| *record = ready);
        tracing::info!(scene = %id, bank_size, "semantics ready");
        if eager && !self.keep_photos {
            self.store.drop_upload(id)?;
        }
        Ok(())
    }

    fn give_up(&self, id: &SceneId, stop: &Stop, error: &Error) {
        if stop.is_by_caller() {
            // The scene is being deleted: who waits is told that, not that its semantics failed.
            tracing::info!(scene = %id, "its semantics are cancelled");
            return;
        }
        let error = stop.told(&self.limits, "the scene's semantics").unwrap_or_else(|| {
            Error::new(error.code(), format!("the scene's semantics: {}", error.message()))
        });
        tracing::error!(scene = %id, code = error.code().name(), %error, "no semantics");
        self.board.update(id, |record| {
            record.status.semantics = SemanticsStatus {
                error: Some(SceneError::from(&error)),
                ..SemanticsStatus::new(SemanticsState::Failed)
            };
        });
    }
}
