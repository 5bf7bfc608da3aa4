//! A scene as a folder for other programs: its photos and its views, drawn one after another, for
//! [`crate::formats::folders`], which writes them.

mod calls;

pub use self::calls::FolderSpec;

use std::{io::Write, sync::Arc, time::Instant};

use tokio::runtime::Handle;

use super::{
    encode::{Layer, encode},
    query,
    request::{
        Boxes, CameraSpec, Format, LensSpec, MaskFormat, PictureKind, PictureOptions, PoseSpec,
        QuerySpec, TextOptions, ViewOptions, ViewSpec,
    },
    schedule::Demand,
    search::{Backend, SceneTexts},
    shared::Shared,
    texts,
    types::{TextResult, TextView},
    view::{Inputs, Resolved, resolve_one},
    work::Work,
};
use crate::{
    error::{Error, Result},
    formats::{
        folders::{FolderContents, FolderFormat, FolderMask, FolderPixels, PhotoFile, PutPhoto},
        table::ExportFormat,
    },
    keys::Caller,
    limits::Limits,
    photos::{KnownCameras, SentPixels, each},
    render::Kinds,
    scene::{Photo, Preset, Scene, SceneCamera, Upload},
};

/// The texts of a call, checked: at least one where the format shows them, else none.
fn checked_texts(format: ExportFormat, asked: &[String], limits: &Limits) -> Result<Vec<String>> {
    match (format.lines, asked.is_empty()) {
        (true, _) => texts::all_checked(asked, "text", limits),
        (false, true) => Ok(Vec::new()),
        (false, false) => Err(texts::not_with(format.name)),
    }
}

/// The photos of an upload and the views of a scene, by the number of the photo.
struct Pixels<'a> {
    scene: Arc<Scene>,
    backend: Arc<Backend>,
    limits: Arc<Limits>,
    caller: Caller,
    /// The view of each photo's camera, at the size of the photo.
    views: Vec<Resolved>,
    /// Photos as sent; none where they are not kept.
    upload: Option<&'a Upload>,
    /// The texts of the masks, where there are some.
    scored: Option<Arc<SceneTexts>>,
    /// Where views wait for those of others; absent: they are drawn at once.
    turns: Option<Turns>,
}

/// When the views of a server are drawn: each waits for its turn with all others.
struct Turns {
    inner: Arc<Shared>,
    runtime: Handle,
    until: Instant,
}

impl Pixels<'_> {
    /// Writes the zip; how many photos are in it.
    fn write(
        &mut self,
        folder: FolderFormat,
        texts: &[String],
        to: &mut dyn Write,
    ) -> Result<usize> {
        let (scene, points_max) = (&*Arc::clone(&self.scene), self.limits.folder_points_max);
        folder.write(&FolderContents { scene, texts, points_max }, self, to)
    }

    /// Does the work of a view, which scores so many texts, when it is its turn. Blocks.
    fn draw<T: Send + 'static>(
        &self,
        view: &Resolved,
        texts: usize,
        work: impl FnOnce(&mut Work) -> Result<T> + Send + 'static,
    ) -> Result<T> {
        let Some(Turns { inner, runtime, until }) = &self.turns else {
            return work(&mut Work::default());
        };
        let demand = Demand::view(&self.caller, view.pixels()).with_texts(texts, 0);
        let deadline = (*until).min(inner.deadline(&ViewOptions::default()));
        runtime.block_on(inner.scheduled(demand, deadline, "a view of the folder", work))
    }
}

impl FolderPixels for Pixels<'_> {
    fn photos(&mut self, put: &mut PutPhoto<'_>) -> Result<()> {
        let Some(upload) = self.upload.filter(|upload| upload.sent_splats().is_none()) else {
            return Ok(());
        };
        let meta = &self.scene.meta;
        let known = KnownCameras {
            mode: meta.provenance.options.cameras,
            cameras: &meta.cameras,
            report: &meta.report.cameras,
        };
        each(upload, known, &self.limits, |sent| {
            let [w, h] = [sent.camera.intrinsics.width, sent.camera.intrinsics.height];
            // Under other limits than those of its time a scene has other photos, and some may
            // have left it.
            let same = |of: &SceneCamera| {
                let k = of.camera.intrinsics;
                of.file == sent.file && [k.width, k.height] == [w, h]
            };
            let Some(i) = self.scene.meta.cameras.iter().position(same) else { return Ok(()) };
            match sent.pixels {
                SentPixels::File(bytes) => put(i, PhotoFile::Sent(bytes)),
                SentPixels::Made(pixels) => put(i, PhotoFile::Png(png(pixels)?)),
            }
        })
    }

    fn depth(&mut self, photo: usize) -> Result<Vec<f32>> {
        let view = self.views[photo].clone();
        let (backend, scene) = (Arc::clone(&self.backend), Arc::clone(&self.scene));
        let kinds = Kinds { depth: true, ..Kinds::NONE };
        self.draw(&self.views[photo], 0, move |work| {
            let frame = backend.renderer.render(&scene.gaussians, &view.request(&scene, kinds))?;
            work.leave_renderer();
            frame.depth.ok_or_else(|| Error::internal("the renderer gave no depth"))
        })
    }

    fn masks(&mut self, photo: usize) -> Result<Vec<FolderMask>> {
        let Some(texts) = self.scored.clone() else { return Ok(Vec::new()) };
        let (limits, view) = (Arc::clone(&self.limits), self.views[photo].clone());
        self.draw(&self.views[photo], texts.texts.len(), move |work| {
            masks_of(&texts, &limits, &view, work)
        })
    }
}

fn png(photo: Photo) -> Result<Vec<u8>> {
    let Photo { width, height, rgb, .. } = photo;
    let (pixels, rest) = rgb.as_chunks::<3>();
    if !rest.is_empty() {
        return Err(Error::internal("a photo has a part of a pixel"));
    }
    Ok(encode(Layer::Rgb(pixels.to_vec()), width, height, Format::Png)?.bytes)
}

/// The views of all photos' cameras at the sizes of the photos.
/// Fails with `limit_exceeded` for more pixels than views may have: of all masks together, or of
/// all depth maps.
fn photo_views<'a>(
    limits: &Limits,
    cameras: &[SceneCamera],
    inputs: impl Into<Inputs<'a>>,
    preset: Option<Preset>,
    texts: usize,
) -> Result<Vec<Resolved>> {
    let inputs = inputs.into();
    let picture = PictureOptions { format: Format::Npy, ..PictureOptions::default() };
    let view = |of: &SceneCamera| {
        let k = of.camera.intrinsics;
        let camera = CameraSpec {
            pose: PoseSpec::CameraToWorld(of.camera.camera_to_world.to_row_major()),
            lens: LensSpec::Focal { fx: k.fx, fy: Some(k.fy), cx: Some(k.cx), cy: Some(k.cy) },
        };
        let (width, height) = (Some(k.width), Some(k.height));
        let options = ViewOptions { width, height, preset, ..ViewOptions::default() };
        let (picture, text) = (picture.clone(), TextOptions::default());
        resolve_one(
            limits,
            inputs,
            &ViewSpec { camera, kind: PictureKind::Depth, options, picture, text },
        )
    };
    let views: Vec<Resolved> = cameras.iter().map(view).collect::<Result<_>>()?;
    let pixels = views.iter().map(Resolved::pixels).sum::<u64>() * texts.max(1) as u64;
    let max = limits.views_pixels_max;
    if pixels > max {
        let what = match texts {
            0 => format!("{} depth maps", views.len()),
            texts => format!("masks of {texts} texts in {} photos", views.len()),
        };
        return Err(Error::limit(what, format!("{pixels} px"), format!("{max} px")));
    }
    Ok(views)
}

/// What each text finds in a view, as a query says it.
fn masks_of(
    texts: &SceneTexts,
    limits: &Limits,
    view: &Resolved,
    work: &mut Work,
) -> Result<Vec<FolderMask>> {
    let spec = QuerySpec { boxes: Boxes::None, mask: MaskFormat::Rle, ..QuerySpec::default() };
    let answer = query::answer(texts, limits, &spec, Some(view), work)?;
    let mask = |found: TextResult| {
        let lost = || Error::internal("a text has no answer in the view");
        let TextView { mask_rle, area, bbox, .. } = found.view.ok_or_else(lost)?;
        Ok(FolderMask { mask: mask_rle, area, bbox })
    };
    answer.results.into_iter().map(mask).collect()
}
