//! Refining a finished scene: its check, and its place in the queue.

use std::sync::Arc;

use super::{shared::Service, tasks::blocking};
use crate::{
    error::{Error, Result},
    limits::Limits,
    scene::{Refine, SceneId, SceneStatus},
};

/// Refuses more time than a refinement may have.
pub(crate) fn check_refine(refine: Refine, limits: &Limits) -> Result<()> {
    let max = limits.refine_ms_max;
    match refine {
        Refine::Ms(ms) if ms == 0 || ms > max => {
            Err(Error::invalid(format!("refine is {ms} ms; it must be 1 to {max}")))
        }
        _ => Ok(()),
    }
}

impl Service {
    /// Refines a finished scene while it is served, or ends its refinement (`off`). Gives its
    /// status at once. A refinement that is on its way goes on as it was asked for.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready`; `invalid_request` for a time out of range, and where
    /// the photos of finished scenes are not kept; `overloaded`, `store_unavailable`.
    pub async fn refine(&self, id: &SceneId, refine: Refine) -> Result<SceneStatus> {
        check_refine(refine, &self.limits())?;
        let scene = self.scene(id).await?.finished()?;
        let file = &scene.record().status.report.as_ref().and_then(|r| r.file_format.as_ref());
        if let (Some(name), false) = (file, refine == Refine::Off) {
            let id = scene.id();
            return Err(Error::invalid(format!(
                "refine: scene {id} is a file of Gaussians ({name}); it has no photos to come \
                 closer to"
            )));
        }
        if refine != Refine::Off && !self.inner.config.keep_photos {
            let why = "this server does not keep the photos of finished scenes (keep_photos)";
            return Err(Error::invalid(format!("refine: {why}")));
        }
        let (inner, id) = (Arc::clone(&self.inner), scene.id().clone());
        blocking(move || inner.jobs.refine(&id, refine)).await??;
        self.get(scene.id()).await
    }
}
