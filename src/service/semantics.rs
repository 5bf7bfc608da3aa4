//! What a text needs before it is answered: networks for texts, a scene that allows texts, and the
//! semantics of the scene.
//!
//! The first text starts the job that makes the semantics. They are made once, however many callers
//! wait for them.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use super::{
    access::SceneAccess,
    search::{SceneTexts, ScoringChoice, SemanticScene},
    shared::{Service, Shared},
    tasks::blocking,
    times::{ms, staged},
    work::Work,
};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{Scene, SceneId, SceneStatus, SemanticsMode, SemanticsState},
    store::{Record, not_found},
};

/// When to ask again for semantics that are being made, seconds.
const RETRY_AFTER_S: u32 = 2;

impl Shared {
    /// Refuses `what` where the loaded bundle cannot do it.
    pub(super) fn can_understand(&self, what: &str) -> Result<()> {
        let Some(lack) = self.backend.lacks() else { return Ok(()) };
        let why = self.lacking(&lack);
        Err(Error::new(ErrorCode::ModelUnavailable, format!("{what}: {why}")))
    }

    fn lacking(&self, lack: &str) -> String {
        let bundle = &self.models.bundle;
        format!("bundle {bundle:?} has {lack}; colour, depth and alpha are available")
    }

    /// Refuses a scene that was made without semantics.
    pub(super) fn may_be_asked(record: &Record, what: &str) -> Result<()> {
        if record.options.semantics != SemanticsMode::Off {
            return Ok(());
        }
        let (id, why) = (&record.status.id, why_off(&record.status));
        Err(Error::new(ErrorCode::SemanticsOff, format!("{what}: scene {id} {why}")))
    }

    /// Why the semantics that a file of Gaussians brought cannot be used: other networks made them,
    /// and there are no photos to make them again.
    fn why_foreign(&self, format: Option<&String>, made_by: &str) -> Option<String> {
        let ours = &self.models.bundle_sha256;
        let format = format.filter(|_| !is_of(made_by, ours))?;
        Some(format!(
            "is a file of Gaussians ({format}) with semantics of the bundle {}; this server has \
             {:?} ({}), which cannot be compared with it",
            start(made_by),
            self.models.bundle,
            start(ours)
        ))
    }

    /// The scene after its edits: what is drawn, asked and exported. Blocks on the store.
    pub(super) fn load(&self, access: &SceneAccess) -> Result<Arc<Scene>> {
        self.edited(access, self.load_unedited(access)?)
    }

    /// The scene as it was made. It is marked as failed when its file is bad. Blocks on the store.
    pub(super) fn load_unedited(&self, access: &SceneAccess) -> Result<Arc<Scene>> {
        let (scene, _ms) = staged("load", || self.store.scene(access.id()));
        scene.inspect_err(|error| {
            if error.code() == ErrorCode::SceneCorrupt {
                self.jobs.spoil(access.id(), error);
            }
        })
    }

    /// The scene with its semantics; `None` where they must be made again: their file was put
    /// aside, or other networks made them, whose embeddings cannot be compared with texts of these.
    fn load_semantics(&self, access: &SceneAccess) -> Result<Option<SemanticScene>> {
        let scene = self.load_unedited(access)?;
        let found = self.semantics_of(Arc::clone(&scene));
        let Some(found) = found else {
            if let Some(semantics) = &scene.semantics
                && let Some(why) = self.why_foreign(
                    scene.meta.report.file_format.as_ref(),
                    &semantics.report.bundle_sha256,
                )
            {
                let message = format!("scene {} {why}", access.id());
                return Err(Error::new(ErrorCode::ModelUnavailable, message));
            }
            self.store.check_semantics(access.id())?;
            tracing::info!(scene = %access.id(), "no semantics of this bundle: made again");
            self.jobs.lose_semantics(access.id())?;
            return Ok(None);
        };
        Ok(SemanticScene::new(self.edited(access, found.scene)?))
    }

    /// A scene and its semantics, where the loaded bundle made them.
    fn semantics_of(&self, scene: Arc<Scene>) -> Option<SemanticScene> {
        let ours = &self.models.bundle_sha256;
        SemanticScene::new(scene).filter(|of| is_of(&of.semantics.report.bundle_sha256, ours))
    }

    /// The scene with its semantics, which are made now where they were not before.
    ///
    /// `wait` bounds how long; after that the error says how far the job is.
    pub(super) async fn semantic_scene(
        self: &Arc<Self>,
        access: &SceneAccess,
        what: &str,
        wait: Option<Duration>,
    ) -> Result<SemanticScene> {
        let begun = Instant::now();
        self.can_understand(what)?;
        Self::may_be_asked(access.record(), what)?;
        let id = access.id();
        let limits = &self.limits();
        let wait = wait.unwrap_or(Duration::from_millis(limits.text_wait_ms));
        let until =
            tokio::time::Instant::now() + wait.min(Duration::from_millis(limits.wait_ms_max));
        let mut watcher = self.jobs.watch(id)?;
        loop {
            self.jobs.understand(id)?;
            let ended = tokio::time::timeout_at(
                until,
                watcher.wait_for(|r| r.status.semantics.state != SemanticsState::Running),
            )
            .await
            .map(|ended| ended.map(|record| Arc::clone(&record)));
            let record = match ended {
                Ok(Ok(record)) => record,
                Ok(Err(_closed)) => return Err(not_found(id)),
                Err(_late) => return Err(not_yet(&watcher.borrow().status, what)),
            };
            match (&record.status.semantics.state, &record.status.semantics.error) {
                (SemanticsState::Ready, _) => {}
                (SemanticsState::Failed, Some(error)) => return Err(error.to_error()),
                _ => return Err(not_yet(&record.status, what)),
            }
            let kept = self.store.scene_in_memory(id).and_then(|scene| self.semantics_of(scene));
            let kept = kept.and_then(|of| self.edited_in_memory(access, of.scene));
            let kept = kept.and_then(SemanticScene::new);
            let found = match kept {
                Some(kept) => Some(kept),
                None => {
                    let (inner, access) = (Arc::clone(self), access.clone());
                    blocking(move || inner.load_semantics(&access)).await??
                }
            };
            if let Some(found) = found {
                return Ok(SemanticScene { load_ms: ms(begun), ..found });
            }
        }
    }

    /// Scores checked texts for a scene, before its views wait for the renderer: no view may wait
    /// for a network there. Where a network masks texts they are found in the scene's photos; that
    /// goes on when its caller has gone, so that it is there when the caller asks again.
    pub(super) async fn score(
        self: &Arc<Self>,
        of: SemanticScene,
        how: ScoringChoice,
        texts: Vec<String>,
        deadline: Instant,
    ) -> Result<Arc<SceneTexts>> {
        if self.backend.masks_texts() {
            return self.found_in_photos(of, how, texts, deadline).await;
        }
        self.score_bank(of, how, texts, deadline).await
    }

    /// Scores checked texts by the bank of a scene.
    pub(super) async fn score_bank(
        &self,
        of: SemanticScene,
        how: ScoringChoice,
        texts: Vec<String>,
        deadline: Instant,
    ) -> Result<Arc<SceneTexts>> {
        let backend = Arc::clone(&self.backend);
        let score =
            move |_: &mut Work| SceneTexts::new(&backend, of, &how, &texts, None).map(Arc::new);
        self.in_time(deadline, "the text", score).await
    }

    async fn found_in_photos(
        self: &Arc<Self>,
        of: SemanticScene,
        how: ScoringChoice,
        texts: Vec<String>,
        deadline: Instant,
    ) -> Result<Arc<SceneTexts>> {
        let (inner, id) = (Arc::clone(self), of.scene.meta.id.clone());
        let found = blocking(move || {
            let find = |scene: &Scene, texts: &[String]| inner.jobs.find_words(scene, texts);
            SceneTexts::new(&inner.backend, of, &how, &texts, Some(&find)).map(Arc::new)
        });
        tokio::time::timeout_at(deadline.into(), found).await.unwrap_or_else(|_late| {
            let message = format!("scene {id}: its photos are searched for the text; ask again");
            Err(Error::new(ErrorCode::SceneNotReady, message).retry_after_s(RETRY_AFTER_S))
        })?
    }
}

/// Whether a bundle made semantics that name theirs; those of the first programs name none.
fn is_of(made_by: &str, bundle_sha256: &str) -> bool {
    made_by == bundle_sha256 || made_by.is_empty()
}

/// The start of a hash, for a message.
fn start(sha256: &str) -> String {
    sha256.chars().take(12).collect()
}

/// Why a scene has no semantics.
fn why_off(status: &SceneStatus) -> String {
    match status.report.as_ref().and_then(|report| report.file_format.as_ref()) {
        Some(format) => format!(
            "is a file of Gaussians ({format}) without semantics, and has no photos to make them \
             of; a ply or glb that this program wrote of a scene with semantics has them"
        ),
        None => "was made with semantics=off; make it again with lazy or eager".to_owned(),
    }
}

/// The semantics are being made; says how far the job is.
fn not_yet(status: &SceneStatus, what: &str) -> Error {
    let semantics = &status.semantics;
    let message = format!(
        "{what}: the semantics of scene {} are being made ({}, {:.0} %); ask again",
        status.id,
        semantics.stage.as_deref().unwrap_or("waiting"),
        100.0 * semantics.fraction
    );
    Error::new(ErrorCode::SceneNotReady, message).retry_after_s(RETRY_AFTER_S)
}

impl Service {
    /// Makes the semantics of a scene, unless they are ready, and waits for them: at most `wait`,
    /// or as long as a text would.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready` also when they are still being made after that time,
    /// `semantics_off`, `model_unavailable`, `overloaded`, and the error of the job that makes
    /// them.
    pub async fn understand(&self, id: &SceneId, wait: Option<Duration>) -> Result<SceneStatus> {
        let scene = self.scene(id).await?.finished()?;
        self.inner.semantic_scene(&scene, "semantics", wait).await?;
        self.get(scene.id()).await
    }

    /// A status that says whether texts can be answered for the scene now.
    pub(super) fn shown(&self, mut status: SceneStatus) -> SceneStatus {
        let file = status.report.as_ref().and_then(|report| report.file_format.as_ref());
        let made_by = status.semantics.report.as_ref().map(|report| &report.bundle_sha256);
        let foreign = made_by.and_then(|made_by| self.inner.why_foreign(file, made_by));
        let reason = match (status.semantics.state, foreign) {
            (SemanticsState::Off, _) => Some(format!("the scene {}", why_off(&status))),
            (_, Some(foreign)) => Some(format!("the scene {foreign}")),
            _ => self.inner.backend.lacks().map(|lack| self.inner.lacking(&lack)),
        };
        status.semantics.available = reason.is_none();
        status.semantics.reason = reason;
        status
    }
}
