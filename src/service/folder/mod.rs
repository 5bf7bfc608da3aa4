//! A scene as a folder for other programs, in a zip that is written while it is sent: photos,
//! cameras, points and depth as COLMAP and nerfstudio have them, masks of texts as COCO and
//! `LabelMe` have them.
//!
//! One table of formats, a module for each. Beside the scene and its upload, one photo or one view
//! is in memory.

mod calls;
mod coco;
mod colmap;
mod labelme;
mod nerfstudio;
mod outline;
mod photos;
mod points;
mod zipped;

use std::io::Write;

use self::{photos::FolderPhoto, zipped::ZipFolder};
use super::{
    query,
    request::{
        Boxes, CameraSpec, Format, Kind, LensSpec, MaskFormat, PictureOptions, PoseSpec, QuerySpec,
        TextOptions, ViewOptions, ViewSpec,
    },
    search::{Backend, SceneTexts},
    texts,
    types::TextView,
    view::{Inputs, Resolved, resolve_one},
    work::Work,
};
use crate::{
    error::{Error, Result},
    limits::Limits,
    render::Kinds,
    scene::{Preset, Scene, SceneCamera, Upload},
};

/// A layout of folders.
#[derive(Debug)]
pub struct FolderFormat {
    /// Name in calls.
    pub name: &'static str,
    /// Ending of files, without the first dot.
    pub ending: &'static str,
    /// Whether it shows what texts select; else it takes none.
    pub texts: bool,
    write: fn(&Contents<'_>, &[FolderPhoto], &mut dyn Views, &mut ZipFolder<'_>) -> Result<()>,
}

/// Photos, cameras, points and depth maps in the layout of COLMAP.
static COLMAP: FolderFormat =
    FolderFormat { name: "colmap", ending: "colmap.zip", texts: false, write: colmap::write };
/// Photos, cameras, points and depth maps in the layout of nerfstudio.
static NERFSTUDIO: FolderFormat = FolderFormat {
    name: "nerfstudio",
    ending: "nerfstudio.zip",
    texts: false,
    write: nerfstudio::write,
};
/// What texts select in each photo, as COCO's annotations.
static COCO: FolderFormat =
    FolderFormat { name: "coco", ending: "coco.zip", texts: true, write: coco::write };
/// What texts select in each photo, as a JSON of `LabelMe` beside each.
static LABELME: FolderFormat =
    FolderFormat { name: "labelme", ending: "labelme.zip", texts: true, write: labelme::write };
/// All layouts.
pub static FOLDER_FORMATS: [&FolderFormat; 4] = [&COLMAP, &NERFSTUDIO, &COCO, &LABELME];

impl FolderFormat {
    /// The format of this name.
    pub fn named(name: &str) -> Option<&'static Self> {
        FOLDER_FORMATS.into_iter().find(|format| format.name == name)
    }

    /// The format that the ending of a file's name says.
    pub fn of_file(name: &str) -> Option<&'static Self> {
        let name = name.to_ascii_lowercase();
        FOLDER_FORMATS.into_iter().find(|format| name.ends_with(&format!(".{}", format.ending)))
    }

    /// The texts of a call, checked: at least one where the format shows them, else none.
    fn checked(&self, asked: &[String], limits: &Limits) -> Result<Vec<String>> {
        match (self.texts, asked.is_empty()) {
            (true, _) => texts::all_checked(asked, "text", limits),
            (false, true) => Ok(Vec::new()),
            (false, false) => Err(texts::not_with(self.name)),
        }
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
    format: &FolderFormat,
    of: &Contents<'_>,
    views: &mut dyn Views,
    to: &mut dyn Write,
) -> Result<usize> {
    let mut zip = ZipFolder::new(to);
    let photos = photos::write(of, &mut zip)?;
    (format.write)(of, &photos, views, &mut zip)?;
    zip.finish()?;
    Ok(photos.iter().filter(|photo| photo.there).count())
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
        resolve_one(limits, inputs, &ViewSpec { camera, kind: Kind::Depth, options, picture, text })
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
