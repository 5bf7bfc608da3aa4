//! A scene as a file for other programs, written part by part while it is sent.

use std::sync::Arc;

use tokio::sync::mpsc;

use super::{
    Service,
    create::blocking,
    request::{ExportFormat, TextOptions},
    search::SceneTexts,
    texts,
    types::Export,
    view::{hash, text_words},
};
use crate::{
    error::Result,
    scene::{Gaussians, SceneId},
    store::ply::{PlyWriter, ply_size_bytes},
};

/// Parts that wait for the caller to take them.
const PARTS_MAX: usize = 4;

impl Service {
    /// The scene, or what a text selects of it, as a file for other programs.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready`, `scene_corrupt`; with a text also what
    /// [`Service::query`] says.
    pub async fn export(
        &self,
        id: &SceneId,
        format: ExportFormat,
        ask: &TextOptions,
    ) -> Result<Export> {
        let access = self.scene(id).await?;
        let ExportFormat::Ply = format;
        let inner = Arc::clone(&self.inner);
        let Some(text) = &ask.text else {
            let access = access.finished()?;
            let digest = access.record().scene_sha256.clone().unwrap_or_default();
            let scene = blocking(move || inner.load(&access)).await??;
            let etag = digest.get(..32).unwrap_or(id.as_str());
            let size_bytes = ply_size_bytes(&scene.gaussians);
            let chunks = chunks(move |to| send(&scene.gaussians, to));
            let (file_name, etag) = (format!("{id}.ply"), format!("{etag}-ply"));
            return Ok(Export { file_name, size_bytes, etag, chunks });
        };
        inner.can_understand("text")?;
        let text = texts::checked(text, "text", &self.limits())?;
        let understood = inner.understood(&access.finished()?, "text", ask.wait).await?;
        let etag = hash(&text_words(understood.subject().tag, Some(&text), ask.profile)?);
        let profile = ask.profile;
        let chosen = blocking(move || {
            let texts = SceneTexts::new(&inner.backend, understood.subject(), profile, &[text]);
            texts.map(|texts| texts.gaussians())
        })
        .await??;
        let size_bytes = ply_size_bytes(&chosen);
        let chunks = chunks(move |to| send(&chosen, to));
        let (file_name, etag) = (format!("{id}-part.ply"), format!("{etag}-ply"));
        Ok(Export { file_name, size_bytes, etag, chunks })
    }
}

/// The parts of a file that `send` writes on a blocking thread.
fn chunks(send: impl FnOnce(&mpsc::Sender<Vec<u8>>) + Send + 'static) -> mpsc::Receiver<Vec<u8>> {
    let (to, chunks) = mpsc::channel(PARTS_MAX);
    tokio::task::spawn_blocking(move || send(&to));
    chunks
}

fn send(gaussians: &Gaussians, to: &mpsc::Sender<Vec<u8>>) {
    for part in PlyWriter::new(gaussians) {
        // The caller stopped listening and wants no more.
        if to.blocking_send(part).is_err() {
            return;
        }
    }
}
