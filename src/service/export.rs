//! A scene as a file for other programs, made piece by piece while it is sent.

use std::sync::Arc;

use tokio::sync::mpsc;

use super::{
    Service,
    create::blocking,
    request::{ExportFormat, TextOptions},
    search::SceneTexts,
    texts,
    types::Export,
    view::{asked_words, hash},
};
use crate::{
    error::Result,
    scene::{Gaussians, SceneId},
    store::ply::{PlyWriter, ply_size_bytes},
};

/// Pieces that wait for the caller to take them.
const PIECES_MAX: usize = 4;

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
            let etag = format!("{}-ply", digest.get(..32).unwrap_or(id.as_str()));
            let size_bytes = ply_size_bytes(&scene.gaussians);
            let (to, chunks) = mpsc::channel(PIECES_MAX);
            tokio::task::spawn_blocking(move || send(&scene.gaussians, &to));
            return Ok(Export { file_name: format!("{id}.ply"), size_bytes, etag, chunks });
        };
        inner.can_understand("text")?;
        let text = texts::checked(text, "text", &self.limits())?;
        let understood = inner.understood(&access.finished()?, "text", ask.wait).await?;
        let tag = understood.tag();
        let etag =
            hash(&asked_words(&tag, &TextOptions { text: Some(text.clone()), ..ask.clone() })?);
        let profile = ask.profile;
        let chosen = blocking(move || {
            let subject = understood.subject(&tag);
            Ok(SceneTexts::new(&inner.backend, subject, profile, &[text])?.gaussians())
        })
        .await??;
        let size_bytes = ply_size_bytes(&chosen);
        let (to, chunks) = mpsc::channel(PIECES_MAX);
        tokio::task::spawn_blocking(move || send(&chosen, &to));
        let etag = format!("{etag}-ply");
        Ok(Export { file_name: format!("{id}-part.ply"), size_bytes, etag, chunks })
    }
}

fn send(gaussians: &Gaussians, to: &mpsc::Sender<Vec<u8>>) {
    for piece in PlyWriter::new(gaussians) {
        // Whoever stopped listening wants no more.
        if to.blocking_send(piece).is_err() {
            return;
        }
    }
}
