//! A scene as a file for other programs, written part by part while it is sent.

use std::{
    io::{self, Write},
    sync::Arc,
    time::Instant,
};

use tokio::{runtime::Handle, sync::mpsc};

use super::{
    Service,
    create::blocking,
    features,
    page::write_page,
    query,
    request::{ExportFormat, QuerySpec, TextOptions, ViewOptions},
    search::ScoringChoice,
    tags::{etag, semantics_tag},
    texts,
    types::Export,
    work::Work,
};
use crate::{
    error::{Error, Result},
    formats::{
        folders::FolderFormat,
        packed::write_packed,
        splats::{SplatFile, SplatFormat},
    },
    render::plan::{default_near, widened},
    scene::{Gaussians, Preset, Scene, SceneId, Semantics},
};

/// Parts that wait for the caller to take them.
const PARTS_MAX: usize = 4;
/// Bytes of a part of a file of arrays.
const PART_BYTES: usize = 256 << 10;

impl Service {
    /// The scene, or what a text selects of it, as a file for other programs; as `npz` its
    /// semantics, which are made where they are not there; as `packed` and `html` what the page
    /// draws; as a folder in a zip what [`FolderFormat`] says. For `html`, `coco` and `labelme`
    /// each line of the text is a text.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready`, `scene_corrupt`; `invalid_request` for a scene that
    /// the format cannot hold; with a text, and for `npz`, also what [`Service::query`] says.
    pub async fn export(
        &self,
        id: &SceneId,
        format: ExportFormat,
        preset: Option<Preset>,
        ask: &TextOptions,
    ) -> Result<Export> {
        // How texts are scored is checked also where no text is asked.
        texts::check_scoring(&ask.scoring, &self.limits())?;
        if let Some(format) = FolderFormat::named(&format.to_string()) {
            return self.folder(id, format, preset, ask).await;
        }
        let access = self.scene(id).await?;
        let inner = Arc::clone(&self.inner);
        if format == ExportFormat::Npz {
            if ask.text.is_some() {
                return Err(texts::not_with("npz"));
            }
            let of = inner.semantic_scene(&access.finished()?, "npz", ask.wait).await?;
            let etag = format!("{}-npz", etag(&of.tag));
            let write = move |to: &mut dyn Write| features::write_semantics(&of.semantics, to);
            let file_name = format!("{id}.npz");
            return Ok(Export::new(file_name, etag, stream(write)));
        }
        if format == ExportFormat::Html {
            return self.page(id, preset, ask).await;
        }
        if format == ExportFormat::Packed && ask.text.is_some() {
            return Err(texts::not_with("packed"));
        }
        let Some(text) = &ask.text else {
            let access = access.finished()?;
            let scene = blocking(move || inner.load(&access)).await??;
            let digest = etag(&semantics_tag(&scene));
            if format == ExportFormat::Packed {
                let (file_name, etag) = (format!("{id}.segsplat"), format!("{digest}-packed"));
                let chunks = stream(move |to: &mut dyn Write| {
                    write_packed(&scene, default_near(scene.meta.report.median_depth), to)
                });
                return Ok(Export::new(file_name, etag, chunks));
            }
            let splats = splats(format)?;
            let write = move || {
                let semantics = scene.semantics.as_deref();
                scene_splats(splats, &scene, &scene.gaussians, semantics)
            };
            return Ok(gaussians(&id.to_string(), &digest, blocking(write).await??));
        };
        inner.can_understand("text")?;
        let text = texts::checked(text, "text", &self.limits())?;
        let splats = splats(format)?;
        let of = inner.semantic_scene(&access.finished()?, "text", ask.wait).await?;
        let how = ScoringChoice { preset, changes: ask.scoring.clone() };
        let deadline = inner.deadline(&ViewOptions::default());
        let texts = inner.score(of, how, vec![text], deadline).await?;
        let etag = etag(&texts.key()?);
        let file = blocking(move || {
            part(splats, &texts.of.scene, &texts.gaussians(), &texts.of.semantics)
        })
        .await??;
        Ok(gaussians(&format!("{id}-part"), &etag, file))
    }
}

impl Service {
    /// The page with the scene in it.
    async fn page(
        &self,
        id: &SceneId,
        preset: Option<Preset>,
        ask: &TextOptions,
    ) -> Result<Export> {
        let (inner, limits) = (Arc::clone(&self.inner), self.limits());
        let access = self.scene(id).await?.finished()?;
        let lines = texts::lines(ask);
        let how = format!("{lines:?} {preset:?} {:?} {}", ask.scoring, env!("CARGO_PKG_VERSION"));
        let tag = move |scene: &Scene| format!("{}-html", etag(&(semantics_tag(scene) + &how)));
        let file_name = format!("{id}.html");
        if lines.is_empty() {
            let scene = blocking(move || inner.load(&access)).await??;
            let etag = tag(&scene);
            let chunks = stream(move |to: &mut dyn Write| write_page(&scene, None, to));
            return Ok(Export::new(file_name, etag, chunks));
        }
        inner.can_understand("text")?;
        let texts = texts::all_checked(&lines, "text", &limits)?;
        let of = inner.semantic_scene(&access, "text", ask.wait).await?;
        let (how, etag) = (ScoringChoice { preset, changes: ask.scoring.clone() }, tag(&of.scene));
        let deadline = inner.deadline(&ViewOptions::default());
        let texts = inner.score(of, how, texts, deadline).await?;
        let chunks = stream(move |to: &mut dyn Write| {
            let (spec, work) = (QuerySpec::default(), &mut Work::default());
            let answer = query::answer(&texts, &limits, &spec, None, work)?;
            write_page(&texts.of.scene, Some(&answer), to)
        });
        Ok(Export::new(file_name, etag, chunks))
    }
}

impl Export {
    /// A file of octets whose size is known when it is written.
    pub(super) fn new(
        file_name: String,
        etag: String,
        chunks: mpsc::Receiver<io::Result<Vec<u8>>>,
    ) -> Self {
        Self { file_name, media_type: "application/octet-stream", size_bytes: None, etag, chunks }
    }
}

/// The format of files with Gaussians.
fn splats(format: ExportFormat) -> Result<&'static SplatFormat> {
    SplatFormat::named(&format.to_string())
        .ok_or_else(|| Error::internal(format!("{format} is no format of Gaussians")))
}

/// Some Gaussians of a scene with its bank.
fn part(
    splats: &'static SplatFormat,
    scene: &Scene,
    gaussians: &Gaussians,
    of: &Semantics,
) -> Result<SplatFile> {
    let semantics = Semantics { index: gaussians.semantic_index().to_vec(), ..of.clone() };
    scene_splats(splats, scene, gaussians, Some(&semantics))
}

/// Some Gaussians of a scene as a file that other programs draw: with the blur that the scene's own
/// views add to what they magnify.
///
/// # Errors
/// As [`SplatFile::new`].
pub fn scene_splats(
    format: &'static SplatFormat,
    scene: &Scene,
    gaussians: &Gaussians,
    semantics: Option<&Semantics>,
) -> Result<SplatFile> {
    let file = SplatFile::new(format, widened(scene, gaussians, None)?, semantics)?;
    Ok(file.antialiased(scene.meta.report.antialiased))
}

/// A file with Gaussians; `stem` is its name without the ending.
fn gaussians(stem: &str, digest: &str, file: SplatFile) -> Export {
    let &SplatFormat { name, ending, media_type, .. } = file.format();
    let size_bytes = file.size_bytes();
    let unwritten = |cause| Error::internal("the file is not whole").caused_by(cause);
    let chunks = stream(move |to: &mut dyn Write| file.write(to).map_err(unwritten));
    let (file_name, etag) = (format!("{stem}.{ending}"), format!("{digest}-{name}"));
    Export { media_type, size_bytes, ..Export::new(file_name, etag, chunks) }
}

/// The parts of a file that `write` writes on a blocking thread. A fault ends them.
pub(super) fn stream(
    write: impl FnOnce(&mut dyn Write) -> Result<()> + Send + 'static,
) -> mpsc::Receiver<io::Result<Vec<u8>>> {
    stream_until(None, write)
}

/// As [`stream`]; a caller who has not taken a part at a given time gets no more.
pub(super) fn stream_until(
    until: Option<Instant>,
    write: impl FnOnce(&mut dyn Write) -> Result<()> + Send + 'static,
) -> mpsc::Receiver<io::Result<Vec<u8>>> {
    let (to, chunks) = mpsc::channel(PARTS_MAX);
    let runtime = Handle::current();
    tokio::task::spawn_blocking(move || {
        let parts = Parts { to: to.clone(), runtime: runtime.clone(), until };
        let mut parts = io::BufWriter::with_capacity(PART_BYTES, parts);
        let written = write(&mut parts).and_then(|()| {
            parts.flush().map_err(|e| Error::internal("the file is not whole").caused_by(e))
        });
        // What is left of a file that broke off is not sent.
        drop(parts.into_parts());
        if let Err(error) = written {
            // No thread waits for a caller who takes nothing.
            runtime.spawn(async move { to.send(Err(io::Error::other(error))).await });
        }
    });
    chunks
}

/// Sends what is written to it.
struct Parts {
    to: mpsc::Sender<io::Result<Vec<u8>>>,
    runtime: Handle,
    until: Option<Instant>,
}

impl Write for Parts {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        // A view that is written at once would be one message.
        let bytes = &bytes[..bytes.len().min(PART_BYTES)];
        let send = self.to.send(Ok(bytes.to_vec()));
        let sent = match self.until {
            None => self.runtime.block_on(send),
            Some(until) => {
                let taken = async { tokio::time::timeout_at(until.into(), send).await };
                self.runtime.block_on(taken).map_err(|_| io::ErrorKind::TimedOut)?
            }
        };
        sent.map_err(|_| io::ErrorKind::BrokenPipe)?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[tokio::test]
    async fn what_is_written_at_once_comes_in_parts() {
        let sent: Vec<u8> = (0..3 * PART_BYTES + 9).map(|i| (i % 251) as u8).collect();
        let written = sent.clone();
        let mut chunks = stream(move |to: &mut dyn Write| {
            to.write_all(&written).map_err(|e| Error::internal("broken off").caused_by(e))
        });
        let mut taken = Vec::new();
        while let Some(part) = chunks.recv().await {
            let part = part.unwrap();
            assert!(part.len() <= PART_BYTES, "{} bytes", part.len());
            taken.extend(part);
        }
        assert!(taken == sent);
    }

    #[tokio::test]
    async fn a_caller_who_takes_nothing_frees_the_thread_that_writes() {
        let (ended, end) = tokio::sync::oneshot::channel();
        let until = Instant::now() + Duration::from_millis(50);
        let mut chunks = stream_until(Some(until), move |to: &mut dyn Write| {
            let written = (0..100).try_for_each(|_| to.write_all(&[0; PART_BYTES]));
            let _ = ended.send(written.as_ref().map_err(io::Error::kind).copied());
            written.map_err(|e| Error::internal("late").caused_by(e))
        });
        let written = tokio::time::timeout(Duration::from_secs(20), end).await.unwrap().unwrap();
        assert_eq!(written, Err(io::ErrorKind::TimedOut));
        let mut parts = 0;
        while let Some(Ok(_)) = chunks.recv().await {
            parts += 1;
        }
        assert_eq!(parts, PARTS_MAX, "then the fault, and not an end that looks whole");
    }
}
