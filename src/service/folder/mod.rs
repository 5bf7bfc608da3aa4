//! A scene as a folder for other programs: its photos and its views, drawn one after another, for
//! [`crate::formats::folders`], which writes them.

mod calls;

pub use self::calls::FolderSpec;

use std::io::Write;

use super::{
    encode::{Layer, encode},
    query,
    request::{
        Boxes, CameraSpec, Format, LensSpec, MaskFormat, PictureKind, PictureOptions, PoseSpec,
        QuerySpec, TextOptions, ViewOptions, ViewSpec,
    },
    search::{Backend, SceneTexts},
    texts,
    types::TextView,
    view::{Inputs, Resolved, resolve_one},
    work::Work,
};
use crate::{
    error::{Error, Result},
    formats::{
        folders::{FolderContents, FolderFormat, FolderMask, FolderPixels, PhotoFile, PutPhoto},
        table::ExportFormat,
    },
    limits::Limits,
    photos::{SentPixels, each},
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

/// What a folder is made of.
struct Contents<'a> {
    scene: &'a Scene,
    /// The view of each photo's camera, at the size of the photo.
    views: Vec<Resolved>,
    /// Photos as sent; none where they are not kept.
    upload: Option<&'a Upload>,
    texts: &'a [String],
    limits: &'a Limits,
}

/// What draws the views of a folder, one after another.
trait Views {
    /// `[H * W]` depth, world units, 0 where nothing is.
    fn depth(&mut self, view: &Resolved) -> Result<Vec<f32>>;

    /// What each text finds, its mask as run lengths.
    fn masks(&mut self, view: &Resolved) -> Result<Vec<TextView>>;
}

/// Writes the zip; how many photos are in it.
fn write(
    folder: FolderFormat,
    of: &Contents<'_>,
    views: &mut dyn Views,
    to: &mut dyn Write,
) -> Result<usize> {
    let points_max = of.limits.folder_points_max;
    let contents = FolderContents { scene: of.scene, texts: of.texts, points_max };
    folder.write(&contents, &mut Pixels { of, views }, to)
}

/// The photos of an upload and the views of a scene, by the number of the photo.
struct Pixels<'a> {
    of: &'a Contents<'a>,
    views: &'a mut dyn Views,
}

impl FolderPixels for Pixels<'_> {
    fn photos(&mut self, put: &mut PutPhoto<'_>) -> Result<()> {
        let Some(upload) = self.of.upload.filter(|upload| upload.splats.is_none()) else {
            return Ok(());
        };
        let mut numbers = 0..;
        each(upload, self.of.limits, |sent| {
            let Some(i) = numbers.next() else { return Ok(()) };
            let [w, h] = [sent.camera.intrinsics.width, sent.camera.intrinsics.height];
            // Under other limits than those of its time a scene has other photos.
            let same = |of: &&SceneCamera| {
                let k = of.camera.intrinsics;
                of.file == sent.file && [k.width, k.height] == [w, h]
            };
            let Some(_) = self.of.scene.meta.cameras.get(i).filter(same) else { return Ok(()) };
            match sent.pixels {
                SentPixels::File(bytes) => put(i, PhotoFile::Sent(bytes)),
                SentPixels::Made(pixels) => put(i, PhotoFile::Png(png(pixels)?)),
            }
        })
    }

    fn depth(&mut self, photo: usize) -> Result<Vec<f32>> {
        self.views.depth(&self.of.views[photo])
    }

    fn masks(&mut self, photo: usize) -> Result<Vec<FolderMask>> {
        let mask =
            |TextView { mask_rle, area, bbox, .. }| FolderMask { mask: mask_rle, area, bbox };
        Ok(self.views.masks(&self.of.views[photo])?.into_iter().map(mask).collect())
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

/// The depth of a view.
fn depth_of(backend: &Backend, scene: &Scene, view: &Resolved) -> Result<Vec<f32>> {
    let kinds = Kinds { depth: true, ..Kinds::NONE };
    let frame = backend.renderer.render(&scene.gaussians, &view.request(scene, kinds))?;
    frame.depth.ok_or_else(|| Error::internal("the renderer gave no depth"))
}

/// What each text finds in a view, as a query says it.
fn masks_of(
    texts: &SceneTexts,
    limits: &Limits,
    view: &Resolved,
    work: &mut Work,
) -> Result<Vec<TextView>> {
    let spec = QuerySpec { boxes: Boxes::None, mask: MaskFormat::Rle, ..QuerySpec::default() };
    let answer = query::answer(texts, limits, &spec, Some(view), work)?;
    let lost = || Error::internal("a text has no answer in the view");
    answer.results.into_iter().map(|found| found.view.ok_or_else(lost)).collect()
}
