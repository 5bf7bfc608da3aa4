//! A scene as a file for other programs, made piece by piece while it is sent.

use std::sync::Arc;

use tokio::sync::mpsc;

use super::{
    Service,
    types::{Export, ExportFormat},
};
use crate::{
    error::{Error, Result},
    scene::SceneId,
    store::ply::{PlyWriter, ply_size_bytes},
};

/// Pieces that wait for the caller to take them.
const PIECES_MAX: usize = 4;

impl Service {
    /// The scene as a file for other programs.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready`, `scene_corrupt`.
    pub async fn export(&self, id: &SceneId, format: ExportFormat) -> Result<Export> {
        let inner = Arc::clone(&self.inner);
        let record = inner.finished(id)?;
        let scene = tokio::task::spawn_blocking({
            let id = id.clone();
            move || inner.load(&id)
        })
        .await
        .map_err(|e| Error::internal("reading the scene was broken off").caused_by(e))??;
        let ExportFormat::Ply = format;
        let size_bytes = ply_size_bytes(&scene.gaussians);
        let (to, chunks) = mpsc::channel(PIECES_MAX);
        tokio::task::spawn_blocking(move || {
            for piece in PlyWriter::new(&scene.gaussians) {
                // Whoever stopped listening wants no more.
                if to.blocking_send(piece).is_err() {
                    return;
                }
            }
        });
        let digest = record.scene_sha256.unwrap_or_default();
        let etag = format!("{}-ply", digest.get(..32).unwrap_or(id.as_str()));
        Ok(Export { file_name: format!("{id}.ply"), size_bytes, etag, chunks })
    }
}
