//! Photos that join a finished scene, or leave it.

use std::{sync::Arc, time::Duration};

use super::{
    access::SceneAccess, create::check_key, request::AddPhotos, shared::Service, tasks::blocking,
    types::Created,
};
use crate::{
    error::{Error, Result},
    scene::{SceneId, SceneStatus},
};

impl Service {
    /// Takes posed photos, in the frame of a finished scene, makes them safe in the store, and
    /// waits for the version that has them as long as the caller wants. The version before is
    /// served until then.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready`; `invalid_request` also for a scene that has no photos
    /// or does not keep them; `photo_unreadable`, `limit_exceeded`, `idempotency_key_reused`,
    /// `overloaded`, `store_unavailable`. Where it waited, why they did not join.
    pub async fn add_photos(&self, id: &SceneId, request: AddPhotos) -> Result<Created> {
        let AddPhotos { upload, idempotency_key, wait } = request;
        check_key(idempotency_key.as_deref())?;
        let scene = self.scene_of_photos(id).await?;
        self.inner.memory.admit(upload.memory_bytes())?;
        let turn = self.inner.turn_of(idempotency_key.as_deref()).await;
        let inner = Arc::clone(&self.inner);
        let permit = Arc::clone(&inner.reading).acquire_owned().await;
        let permit = permit.map_err(|e| Error::internal("no upload is read now").caused_by(e))?;
        let id = scene.id().clone();
        let replayed = blocking(move || {
            let _until_done = (permit, turn);
            inner.jobs.add_photos(&id, upload, idempotency_key)
        })
        .await??;
        let status = self.changed(scene.id(), wait).await?;
        Ok(Created { status, replayed })
    }

    /// Takes a photo out of a finished scene, and waits for the version without it as long as the
    /// caller wants. Its file stays in the store as long as a photo that came with it is there; of
    /// the create call until the scene is deleted.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready`; `not_found` where the scene has no such photo;
    /// `invalid_request` also where too few would be left; `overloaded`, `store_unavailable`.
    pub async fn remove_photo(
        &self,
        id: &SceneId,
        file: String,
        wait: Option<Duration>,
    ) -> Result<SceneStatus> {
        let scene = self.scene_of_photos(id).await?;
        let (inner, id) = (Arc::clone(&self.inner), scene.id().clone());
        blocking(move || inner.jobs.remove_photo(&id, &file)).await??;
        self.changed(scene.id(), wait).await
    }

    /// A finished scene of photos that are kept.
    async fn scene_of_photos(&self, id: &SceneId) -> Result<SceneAccess> {
        let scene = self.scene(id).await?.unedited()?;
        let report = scene.record().status.report.as_ref();
        if let Some(name) = report.and_then(|report| report.file_format.as_ref()) {
            let why = format!("scene {id} is a file of Gaussians ({name}); it has no photos");
            return Err(Error::invalid(why));
        }
        if !self.inner.config.keep_photos {
            let why = "this server does not keep the photos of finished scenes (keep_photos)";
            return Err(Error::invalid(format!("photos: {why}")));
        }
        Ok(scene)
    }

    /// The status after a change of photos was taken; of a caller who waits, why it was not done.
    async fn changed(&self, id: &SceneId, wait: Option<Duration>) -> Result<SceneStatus> {
        let Some(wait) = wait else { return self.get(id).await };
        let status = self.wait(id, wait).await?;
        match &status.growth.error {
            Some(error) if !status.is_growing() => Err(error.to_error()),
            _ => Ok(status),
        }
    }
}
