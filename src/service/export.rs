//! A scene as a file for other programs, written part by part while it is sent.

use std::{
    io::{self, Write},
    sync::Arc,
    time::Instant,
};

use futures_util::FutureExt;
use tokio::{
    runtime::Handle,
    sync::{OwnedSemaphorePermit, mpsc},
};

use super::{
    access::SceneAccess,
    coarse::{LastCoarse, forms_of},
    features,
    page::write_page,
    query,
    request::{QuerySpec, TextOptions, ViewOptions},
    search::ScoringChoice,
    shared::{Service, Shared},
    tags::{cache_key, etag, semantics_tag, text_key},
    tasks::blocking,
    texts,
    types::{Export, ExportBody, ExportPlace},
    work::Work,
};
use crate::{
    error::{Error, Result},
    formats::{
        packed::{CoarseForms, write_packed},
        splats::{OCTETS, SplatFile, SplatFormat, write_streamed},
        table::{ExportFormat, FormatKind},
    },
    render::{
        coarse::Coarse,
        plan::{default_near, widened},
    },
    scene::{Gaussians, Preset, Scene, SceneId, Semantics},
};

/// Parts that wait for the caller to take them.
const PARTS_MAX: usize = 4;
/// Bytes of a part of a file of arrays.
const PART_BYTES: usize = 256 << 10;

impl Service {
    /// The scene, or what a text selects of it, as a file for other programs. Semantics are made
    /// where the format needs them and they are not there. For `html`, `coco` and `labelme` each
    /// line of the text is a text. Nothing is written before [`Export::begin`].
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
        // How texts are scored is checked also where no text is asked.
        texts::check_scoring(&ask.scoring, &self.limits())?;
        let access = self.scene(id).await?;
        let is_part = format.is_splats() && ask.text.is_some();
        if ask.text.is_some() && !is_part && !format.lines {
            return Err(texts::not_with(format.name));
        }
        let export = match format.kind {
            FormatKind::Folder(folder) => self.folder(id, format, folder, preset, ask).await?,
            FormatKind::Arrays => self.arrays(&access.finished()?, format, ask).await?,
            FormatKind::Packed => self.packed(access.finished()?).await?,
            FormatKind::Streamed => self.levels(access.finished()?).await?,
            FormatKind::Page => self.page(access.finished()?, preset, ask).await?,
            FormatKind::Splats(splats) => self.splats(access, splats, preset, ask).await?,
        };
        let part = if is_part { "-part" } else { "" };
        Ok(Export {
            file_name: format!("{id}{part}.{}", format.ending),
            media_type: format.media_type,
            etag: format!("{}-{format}", export.etag),
            ..export
        })
    }

    /// The semantics as arrays.
    async fn arrays(
        &self,
        access: &SceneAccess,
        format: ExportFormat,
        ask: &TextOptions,
    ) -> Result<Export> {
        let of = self.inner.semantic_scene(access, format.name, ask.wait).await?;
        let tag = etag(&of.tag);
        let write = move |to: &mut dyn Write| features::write_semantics(&of.semantics, to);
        Ok(Export::streamed(tag, write).placed(&self.inner, 0, None))
    }

    /// The scene as the page draws it.
    async fn packed(&self, access: SceneAccess) -> Result<Export> {
        let inner = Arc::clone(&self.inner);
        let scene = blocking(move || inner.load(&access)).await??;
        let etag = etag(&semantics_tag(&scene));
        let near = default_near(scene.meta.report.median_depth);
        let work_bytes = LastCoarse::bytes(&scene.gaussians);
        let inner = Arc::clone(&self.inner);
        let write = move |to: &mut dyn Write| {
            let Some(coarse) = inner.coarse.of(&scene)? else {
                return write_packed(&scene, near, None, to);
            };
            let entries = coarse.entries(&scene.gaussians);
            write_packed(&scene, near, Some(forms_of(&coarse, &entries)), to)
        };
        Ok(Export::streamed(etag, write).placed(&self.inner, work_bytes, None))
    }

    /// Levels of detail of the scene.
    async fn levels(&self, access: SceneAccess) -> Result<Export> {
        let inner = Arc::clone(&self.inner);
        let scene = blocking(move || inner.load(&access)).await??;
        let etag = etag(&semantics_tag(&scene));
        // The forms, a wider copy of them and of the scene.
        let count = scene.gaussians.len();
        let copies = Gaussians::bytes_of(2 * count, scene.gaussians.sh_degree());
        let work_bytes = LastCoarse::bytes(&scene.gaussians) + copies;
        let inner = Arc::clone(&self.inner);
        let write = move |to: &mut dyn Write| {
            let coarse = inner.coarse.of(&scene)?;
            write_levels(&scene, coarse.as_deref(), to).map(drop)
        };
        Ok(Export::streamed(etag, write).placed(&self.inner, work_bytes, None))
    }

    /// The page with the scene in it.
    async fn page(
        &self,
        access: SceneAccess,
        preset: Option<Preset>,
        ask: &TextOptions,
    ) -> Result<Export> {
        let (inner, limits) = (Arc::clone(&self.inner), self.limits());
        let lines = texts::lines(ask);
        let how = cache_key(&(&lines, preset, &ask.scoring, env!("CARGO_PKG_VERSION")))?;
        let tag = move |scene: &Scene| etag(&(semantics_tag(scene) + &how));
        if lines.is_empty() {
            let scene = blocking(move || inner.load(&access)).await??;
            let (tag, work_bytes) = (tag(&scene), order_bytes(&scene.gaussians));
            let write = move |to: &mut dyn Write| write_page(&scene, None, to);
            return Ok(Export::streamed(tag, write).placed(&self.inner, work_bytes, None));
        }
        inner.can_understand("text")?;
        let texts = texts::all_checked(&lines, "text", &limits)?;
        let of = inner.semantic_scene(&access, "text", ask.wait).await?;
        let (how, tag) = (ScoringChoice { preset, changes: ask.scoring.clone() }, tag(&of.scene));
        let work_bytes = order_bytes(&of.scene.gaussians);
        let export = Export::new(tag, async move {
            let deadline = inner.deadline(&ViewOptions::default());
            let texts = inner.score(of, how, texts, deadline).await?;
            let chunks = stream(move |to: &mut dyn Write| {
                let (spec, work) = (QuerySpec::default(), &mut Work::default());
                let answer = query::answer(&texts, &limits, &spec, None, work)?;
                write_page(&texts.of.scene, Some(&answer), to)
            });
            Ok(ExportBody { size_bytes: None, place: None, chunks })
        });
        Ok(export.placed(&self.inner, work_bytes, None))
    }

    /// Gaussians: all of them, or those that a text selects.
    async fn splats(
        &self,
        access: SceneAccess,
        format: &'static SplatFormat,
        preset: Option<Preset>,
        ask: &TextOptions,
    ) -> Result<Export> {
        let inner = Arc::clone(&self.inner);
        let Some(text) = &ask.text else {
            let access = access.finished()?;
            let scene = blocking(move || inner.load(&access)).await??;
            let tag = etag(&semantics_tag(&scene));
            let work_bytes = work_bytes(format, &scene.gaussians);
            let write =
                move || scene_splats(format, &scene, &scene.gaussians, scene.semantics.as_deref());
            let export = Export::splats(tag, async { blocking(write).await? });
            return Ok(export.placed(&self.inner, work_bytes, None));
        };
        inner.can_understand("text")?;
        let text = texts::checked(text, "text", &self.limits())?;
        let of = inner.semantic_scene(&access.finished()?, "text", ask.wait).await?;
        let named = preset.unwrap_or(of.scene.meta.report.method.preset);
        let tag = etag(&text_key(&of.tag, Some(&text), named, &ask.scoring)?);
        let how = ScoringChoice { preset, changes: ask.scoring.clone() };
        let work_bytes = work_bytes(format, &of.scene.gaussians);
        let export = Export::splats(tag, async move {
            let deadline = inner.deadline(&ViewOptions::default());
            let texts = inner.score(of, how, vec![text], deadline).await?;
            let write = move || {
                let gaussians = texts.gaussians();
                let index = gaussians.semantic_index().to_vec();
                let semantics = Semantics { index, ..(*texts.stored.semantics).clone() };
                scene_splats(format, &texts.stored.scene, &gaussians, Some(&semantics))
            };
            blocking(write).await?
        });
        Ok(export.placed(&self.inner, work_bytes, None))
    }
}

/// Bytes of an order of all Gaussians.
fn order_bytes(gaussians: &Gaussians) -> u64 {
    size_of::<usize>() as u64 * gaussians.len() as u64
}

/// Bytes that a file of these Gaussians takes in memory while it is written, at most: a copy of
/// them, wider ones, and what the format makes of them.
fn work_bytes(format: &SplatFormat, gaussians: &Gaussians) -> u64 {
    // SOG: five pictures, the tables of their values, an order.
    let of_one = if format.name == "sog" { 80 } else { 16 };
    Gaussians::bytes_of(gaussians.len(), gaussians.sh_degree()) + of_one * gaussians.len() as u64
}

impl Export {
    /// A file of octets without a name, which `write` writes.
    pub(super) fn streamed(
        etag: String,
        write: impl FnOnce(&mut dyn Write) -> Result<()> + Send + 'static,
    ) -> Self {
        Self::new(etag, async move {
            Ok(ExportBody { size_bytes: None, place: None, chunks: stream(write) })
        })
    }

    /// A file of octets without a name.
    pub(super) fn new(
        etag: String,
        begin: impl Future<Output = Result<ExportBody>> + Send + 'static,
    ) -> Self {
        Self { file_name: String::new(), media_type: OCTETS, etag, begin: begin.boxed() }
    }

    /// The same, which takes a place among the exports when it begins: of so many bytes in memory
    /// while it is written, beside the scene, and that of a folder.
    pub(super) fn placed(
        self,
        inner: &Arc<Shared>,
        work_bytes: u64,
        folder: Option<OwnedSemaphorePermit>,
    ) -> Self {
        let (inner, begin) = (Arc::clone(inner), self.begin);
        let begin = async move {
            let shares = inner.memory.export(work_bytes, &inner.limits())?;
            let place = ExportPlace { _shares: shares, _folder: folder };
            Ok(ExportBody { place: Some(Arc::new(place)), ..begin.await? })
        };
        Self { begin: begin.boxed(), ..self }
    }

    /// A file of Gaussians.
    fn splats(
        etag: String,
        file: impl Future<Output = Result<SplatFile>> + Send + 'static,
    ) -> Self {
        Self::new(etag, async move {
            let file = file.await?;
            let unwritten = |cause| Error::internal("the file is not whole").caused_by(cause);
            let size_bytes = file.size_bytes();
            let chunks = stream(move |to: &mut dyn Write| file.write(to).map_err(unwritten));
            Ok(ExportBody { size_bytes, place: None, chunks })
        })
    }
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

/// Levels of detail of a scene as a zip that other programs stream, Gaussians as in
/// [`scene_splats`]. Gives their number.
///
/// # Errors
/// As [`write_streamed`].
pub fn scene_levels(scene: &Scene, to: &mut dyn Write) -> Result<usize> {
    let first = scene.meta.cameras.first();
    let coarse = first.map(|first| Coarse::of(&scene.gaussians, &first.camera)).transpose()?;
    write_levels(scene, coarse.flatten().as_ref(), to)
}

/// The same, where the coarser forms are there.
fn write_levels(scene: &Scene, coarse: Option<&Coarse>, to: &mut dyn Write) -> Result<usize> {
    let own = widened(scene, &scene.gaussians, None)?;
    let wide = coarse.map(|coarse| widened(scene, &coarse.gaussians, None)).transpose()?;
    let forms = coarse.zip(wide.as_ref());
    let forms = forms.map(|(coarse, gaussians)| CoarseForms { gaussians, ..forms_of(coarse, &[]) });
    write_streamed(&own, forms, scene.meta.report.antialiased, to)?;
    Ok(1 + coarse.map_or(0, |coarse| coarse.ends.len()))
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
