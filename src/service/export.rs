//! A scene as a file for other programs, written part by part while it is sent.

use std::{
    io::{self, Write},
    sync::Arc,
};

use tokio::sync::mpsc;

use super::{
    Service,
    create::blocking,
    features,
    request::{ExportFormat, TextOptions},
    search::{SceneTexts, check_scoring},
    semantics::meaning_tag,
    texts,
    types::Export,
    view::{hash, text_words},
};
use crate::{
    error::{Error, Result},
    scene::{Gaussians, Preset, SceneId, Semantics},
    store::ply::{PlyFile, PlyWriter},
};

/// Parts that wait for the caller to take them.
const PARTS_MAX: usize = 4;
/// Bytes of a part of a file of arrays.
const PART_BYTES: usize = 256 << 10;

impl Service {
    /// The scene, or what a text selects of it, as a file for other programs; as `npz` its
    /// semantics, which are made where they are not there.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready`, `scene_corrupt`; with a text, and for `npz`, also what
    /// [`Service::query`] says.
    pub async fn export(
        &self,
        id: &SceneId,
        format: ExportFormat,
        preset: Option<Preset>,
        ask: &TextOptions,
    ) -> Result<Export> {
        let access = self.scene(id).await?;
        let inner = Arc::clone(&self.inner);
        if format == ExportFormat::Npz {
            if ask.text.is_some() {
                return Err(Error::invalid("text goes with format=ply, not with npz"));
            }
            let understood = inner.understood(&access.finished()?, "npz", ask.wait).await?;
            let etag = format!("{}-npz", hash(understood.subject().tag));
            let write =
                move |to: &mut dyn Write| features::write_semantics(understood.subject(), to);
            let file_name = format!("{id}.npz");
            return Ok(Export { file_name, size_bytes: None, etag, chunks: stream(write) });
        }
        let Some(text) = &ask.text else {
            let access = access.finished()?;
            let scene = blocking(move || inner.load(&access)).await??;
            let digest = hash(&meaning_tag(&scene));
            let file = PlyFile::new(scene.gaussians.clone(), scene.semantics.as_deref())?;
            return Ok(ply(format!("{id}.ply"), format!("{digest}-ply"), file));
        };
        inner.can_understand("text")?;
        let text = texts::checked(text, "text", &self.limits())?;
        check_scoring(&ask.scoring, &self.limits())?;
        let understood = inner.understood(&access.finished()?, "text", ask.wait).await?;
        let of = understood.subject();
        let named = preset.unwrap_or(of.scene.meta.report.method.preset);
        let etag = hash(&text_words(of.tag, Some(&text), (named, &ask.scoring))?);
        let scoring = ask.scoring.clone();
        let file = blocking(move || {
            let of = understood.subject();
            let texts = SceneTexts::new(&inner.backend, of, (preset, &scoring), &[text])?;
            part(texts.gaussians(), of.semantics)
        })
        .await??;
        Ok(ply(format!("{id}-part.ply"), format!("{etag}-ply"), file))
    }
}

/// Some Gaussians of a scene with its bank.
fn part(gaussians: Gaussians, of: &Semantics) -> Result<PlyFile> {
    let semantics = Semantics { index: gaussians.semantic_index().to_vec(), ..of.clone() };
    PlyFile::new(gaussians, Some(&semantics))
}

fn ply(file_name: String, etag: String, file: PlyFile) -> Export {
    let size_bytes = Some(file.size_bytes());
    let (to, chunks) = mpsc::channel(PARTS_MAX);
    tokio::task::spawn_blocking(move || {
        for part in PlyWriter::new(&file) {
            // The caller stopped listening and wants no more.
            if to.blocking_send(Ok(part)).is_err() {
                return;
            }
        }
    });
    Export { file_name, size_bytes, etag, chunks }
}

/// The parts of a file that `write` writes on a blocking thread. A fault ends them.
pub(super) fn stream(
    write: impl FnOnce(&mut dyn Write) -> Result<()> + Send + 'static,
) -> mpsc::Receiver<io::Result<Vec<u8>>> {
    let (to, chunks) = mpsc::channel(PARTS_MAX);
    tokio::task::spawn_blocking(move || {
        let mut parts = io::BufWriter::with_capacity(PART_BYTES, Parts(to.clone()));
        let written = write(&mut parts).and_then(|()| {
            parts.flush().map_err(|e| Error::internal("the file is not whole").caused_by(e))
        });
        if let Err(error) = written {
            let _ = to.blocking_send(Err(io::Error::other(error)));
        }
    });
    chunks
}

/// Sends what is written to it.
struct Parts(mpsc::Sender<io::Result<Vec<u8>>>);

impl Write for Parts {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let gone = |_| io::Error::from(io::ErrorKind::BrokenPipe);
        self.0.blocking_send(Ok(bytes.to_vec())).map_err(gone)?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
