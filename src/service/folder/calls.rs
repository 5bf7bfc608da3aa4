//! The calls that write folders: of a server, where each view waits for its turn with all others,
//! and of the command line.

use std::{
    io::Write,
    sync::Arc,
    time::{Duration, Instant},
};

use tokio::{runtime::Handle, sync::OwnedSemaphorePermit};

use super::{Pixels, Turns, checked_texts, photo_views};
use crate::{
    error::{Error, ErrorCode, Result},
    formats::{folders::FolderFormat, table::ExportFormat},
    keys::Caller,
    scene::{Preset, Scene, SceneId, Upload},
    service::{
        OfflineService,
        export::stream_until,
        request::{ScoringOptions, TextOptions, ViewOptions},
        search::ScoringChoice,
        shared::{Service, Shared},
        tags::{cache_key, etag, semantics_tag},
        tasks::blocking,
        texts,
        types::{Export, ExportBody},
    },
};

/// When to ask again where folders are being written, seconds.
const RETRY_AFTER_S: u32 = 5;

impl Shared {
    /// A permit to write a folder.
    fn folder_permit(&self) -> Result<OwnedSemaphorePermit> {
        Arc::clone(&self.folders).try_acquire_owned().map_err(|_| {
            let max = self.config.limits.folder_exports_max;
            let why = format!("{max} folders are being written already, the most that may");
            Error::new(ErrorCode::Overloaded, why).retry_after_s(RETRY_AFTER_S)
        })
    }

    /// The upload of a scene; none where it is not kept. Blocks on the store.
    fn kept_upload(&self, id: &SceneId) -> Result<Option<Upload>> {
        // It goes a moment after the scene is done.
        if !self.config.keep_photos {
            return Ok(None);
        }
        match self.store.upload(id) {
            Ok(upload) => Ok(Some(upload)),
            Err(e) if e.code() == ErrorCode::SceneNotFound => Ok(None),
            Err(error) => Err(error),
        }
    }
}

impl Service {
    /// The scene as a folder in a zip. It must be taken in `limits.views_timeout_ms`.
    ///
    /// # Errors
    /// As [`Service::export`]; `overloaded` where too many folders are being written.
    pub(in crate::service) async fn folder(
        &self,
        id: &SceneId,
        format: ExportFormat,
        folder: FolderFormat,
        preset: Option<Preset>,
        ask: &TextOptions,
    ) -> Result<Export> {
        let (inner, limits) = (Arc::clone(&self.inner), self.limits());
        let texts = checked_texts(format, &texts::lines(ask), &limits)?;
        let access = self.scene(id).await?.finished()?;
        let record = access.record();
        let views = photo_views(&limits, &record.status.cameras, record, preset, texts.len())?;
        let (scene, scored) = if texts.is_empty() {
            let (inner, access) = (Arc::clone(&inner), access.clone());
            (blocking(move || inner.load(&access)).await??, None)
        } else {
            let of = inner.semantic_scene(&access, "text", ask.wait).await?;
            let how = ScoringChoice { preset, changes: ask.scoring.clone() };
            let deadline = inner.deadline(&ViewOptions::default());
            let scored = inner.score(of, how, texts.clone(), deadline).await?;
            (Arc::clone(&scored.of.scene), Some(scored))
        };
        // Not before: semantics can take minutes.
        let permit = inner.folder_permit()?;
        let until = Instant::now() + Duration::from_millis(limits.views_timeout_ms);
        let upload = {
            let (inner, id) = (Arc::clone(&inner), id.clone());
            blocking(move || inner.kept_upload(&id)).await??
        };
        let asked = scored.as_ref().map(|_| (&texts, &ask.scoring));
        let how = (semantics_tag(&scene), inner.backend.renderer.name(), preset, asked);
        let key = cache_key(&(how, upload.is_some(), env!("CARGO_PKG_VERSION")))?;
        let (runtime, caller) = (Handle::current(), self.caller.clone());
        let write = move |to: &mut dyn Write| {
            let mut pixels = Pixels {
                scene,
                backend: Arc::clone(&inner.backend),
                limits,
                caller,
                views,
                upload: upload.as_ref(),
                scored,
                turns: Some(Turns { inner, runtime, until }),
            };
            pixels.write(folder, &texts, to).map(drop)
        };
        let export = Export::new(etag(&key), async move {
            let chunks = stream_until(Some(until), write);
            Ok(ExportBody { size_bytes: None, place: None, chunks })
        });
        Ok(export.placed(&self.inner, 0, Some(permit)))
    }
}

/// A folder of a scene in a file.
#[derive(Clone, Copy, Debug)]
pub struct FolderSpec<'a> {
    /// Its row in the table of formats.
    pub format: ExportFormat,
    /// The folder of that row.
    pub folder: FolderFormat,
    /// Texts whose masks are to be in it.
    pub texts: &'a [String],
    /// How views are drawn and texts are scored; absent: as the scene was made.
    pub preset: Option<Preset>,
    /// Changes of the scoring.
    pub scoring: &'a ScoringOptions,
    /// What the scene was made of, where its photos are to be in it.
    pub upload: Option<&'a Upload>,
}

impl OfflineService {
    /// As [`Service::export`] of a folder, written to `to`. Gives how many photos are in it.
    ///
    /// # Errors
    /// As there; `semantics_off` for texts of a scene without semantics.
    pub fn folder(
        &self,
        scene: &Arc<Scene>,
        spec: &FolderSpec<'_>,
        to: &mut dyn Write,
    ) -> Result<usize> {
        let (limits, &FolderSpec { format, folder, texts, preset, scoring, upload }) =
            (&self.limits, spec);
        texts::check_scoring(scoring, limits)?;
        let asked = checked_texts(format, texts, limits)?;
        let views = photo_views(limits, &scene.meta.cameras, &**scene, preset, asked.len())?;
        let scored = match asked[..] {
            [] => None,
            _ => Some(Arc::new(self.score(scene, "text", preset, scoring, &asked)?)),
        };
        let mut pixels = Pixels {
            scene: Arc::clone(scene),
            backend: Arc::clone(&self.backend),
            limits: Arc::new(limits.clone()),
            caller: Caller::All,
            views,
            upload,
            scored,
            turns: None,
        };
        pixels.write(folder, &asked, to)
    }
}
