//! Before a text is answered: does the bundle know texts, may the scene be asked, is it understood?
//!
//! The first text has the semantics made; however many ask meanwhile, they are made once.

use std::{sync::Arc, time::Duration};

use super::{
    Inner, Service, access::SceneAccess, create::blocking, search::Subject, view::scene_tag,
};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{Scene, SceneId, SceneStatus, Semantics, SemanticsMode, SemanticsState},
    store::{Record, not_found},
};

/// When to ask again for semantics that are being made, seconds.
const RETRY_AFTER_S: u32 = 2;

/// A scene that can be asked by text.
#[derive(Clone, Debug)]
pub(super) struct Understood {
    pub(super) access: SceneAccess,
    pub(super) scene: Arc<Scene>,
    pub(super) semantics: Arc<Semantics>,
}

impl Understood {
    /// The scene as texts are asked of it; `tag` is [`Self::tag`].
    pub(super) fn subject<'a>(&'a self, tag: &'a str) -> Subject<'a> {
        Subject { scene: &self.scene, semantics: &self.semantics, tag }
    }

    /// Tells scene and semantics from any others.
    pub(super) fn tag(&self) -> String {
        meaning_tag(self.access.record())
    }
}

/// Tells a scene and its semantics from any others.
pub(super) fn meaning_tag(record: &Record) -> String {
    let semantics = record.semantics_sha256.as_deref().unwrap_or_default();
    format!("{} {semantics}", scene_tag(record))
}

impl Inner {
    /// Refuses what the loaded bundle cannot do; `what` was asked.
    pub(super) fn can_understand(&self, what: &str) -> Result<()> {
        let Some(lack) = self.backend.search.lacks() else { return Ok(()) };
        Err(Error::new(
            ErrorCode::ModelUnavailable,
            format!(
                "{what}: bundle {:?} has {lack}; colour, depth and alpha are available",
                self.models.bundle
            ),
        ))
    }

    /// Refuses a scene that was made to be asked nothing.
    pub(super) fn may_be_asked(record: &Record, what: &str) -> Result<()> {
        if record.options.semantics != SemanticsMode::Off {
            return Ok(());
        }
        Err(Error::new(
            ErrorCode::SemanticsOff,
            format!(
                "{what}: scene {} was made with semantics=off; make it again with lazy or eager",
                record.status.id
            ),
        ))
    }

    /// The scene with what it means; `None` where that must be made again: its file was put aside,
    /// or other networks made it, whose embeddings no text of these can be compared with.
    fn loaded_semantics(
        &self,
        access: &SceneAccess,
    ) -> Result<Option<(Arc<Scene>, Arc<Semantics>)>> {
        let scene = self.load(access)?;
        let loaded = &self.models.bundle_sha256;
        if let Some(semantics) = scene.semantics.clone() {
            let made_by = &semantics.report.bundle_sha256;
            if made_by == loaded || made_by.is_empty() {
                return Ok(Some((scene, semantics)));
            }
            tracing::info!(scene = %access.id(), made_by, "another bundle: semantics again");
        }
        self.jobs.lose_semantics(access.id())?;
        Ok(None)
    }

    /// The scene with what it means, which is made now where it was not before.
    ///
    /// `wait` bounds how long; who waits no longer is told where the making stands.
    pub(super) async fn understood(
        self: &Arc<Self>,
        scene: &SceneAccess,
        what: &str,
        wait: Option<Duration>,
    ) -> Result<Understood> {
        self.can_understand(what)?;
        Self::may_be_asked(scene.record(), what)?;
        let id = scene.id();
        let limits = &self.limits();
        let wait = wait.unwrap_or(Duration::from_millis(limits.text_wait_ms));
        let until =
            tokio::time::Instant::now() + wait.min(Duration::from_millis(limits.wait_ms_max));
        let mut watcher = self.jobs.watch(id)?;
        loop {
            self.jobs.understand(id)?;
            let settled = tokio::time::timeout_at(
                until,
                watcher.wait_for(|r| r.status.semantics.state != SemanticsState::Running),
            )
            .await
            .map(|settled| settled.map(|record| record.clone()));
            let record = match settled {
                Ok(Ok(record)) => record,
                Ok(Err(_closed)) => return Err(not_found(id)),
                Err(_late) => return Err(not_yet(&watcher.borrow().status, what)),
            };
            match (&record.status.semantics.state, &record.status.semantics.error) {
                (SemanticsState::Ready, _) => {}
                (SemanticsState::Failed, Some(error)) => return Err(error.to_error()),
                _ => return Err(not_yet(&record.status, what)),
            }
            let access = scene.renewed(record);
            let (inner, asked) = (Arc::clone(self), access.clone());
            let found = blocking(move || inner.loaded_semantics(&asked)).await??;
            if let Some((scene, semantics)) = found {
                return Ok(Understood { access, scene, semantics });
            }
        }
    }
}

/// The semantics are on their way; says how far.
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
    /// Has a scene's semantics made, unless they are there, and waits for them: at most `wait`,
    /// or as long as a text would.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready` also when they are still being made after that time,
    /// `semantics_off`, `model_unavailable`, `overloaded`, and whatever their making failed with.
    pub async fn understand(&self, id: &SceneId, wait: Option<Duration>) -> Result<SceneStatus> {
        let scene = self.scene(id).await?.finished()?;
        let understood = self.inner.understood(&scene, "semantics", wait).await?;
        Ok(self.shown(understood.access.record().status.clone()))
    }

    /// A status with what can be asked of the scene by text now.
    pub(super) fn shown(&self, mut status: SceneStatus) -> SceneStatus {
        let lack = self.inner.backend.search.lacks();
        let bundle = &self.inner.models.bundle;
        let reason = match (status.semantics.state, lack) {
            (SemanticsState::Off, _) => Some("the scene was made with semantics=off".to_owned()),
            (_, Some(lack)) => {
                Some(format!("bundle {bundle:?} has {lack}; colour, depth and alpha are available"))
            }
            (_, None) => None,
        };
        status.semantics.available = reason.is_none();
        status.semantics.reason = reason;
        status
    }
}
