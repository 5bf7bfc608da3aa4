//! A scene as a folder for other programs, in a zip that is written part by part: photos, cameras,
//! points and depth as COLMAP and nerfstudio have them, masks of texts as COCO and `LabelMe` have
//! them.
//!
//! One table of formats, a module for each. Beside the scene, one photo or one view is in memory.

mod coco;
mod labelme;
mod nerfstudio;
mod outline;
mod photos;
mod points;
mod zipped;

use std::io::Write;

pub(crate) use self::{
    photos::FolderPhoto,
    points::{FolderPoint, points},
    zipped::ZipFolder,
};
use crate::{colmap, error::Result, rle::Rle, scene::Scene};

/// Writes what a folder has beside its photos.
type WriteFolder = fn(
    &FolderContents<'_>,
    &[FolderPhoto],
    &mut dyn FolderPixels,
    &mut ZipFolder<'_>,
) -> Result<()>;

/// A layout of folders.
#[derive(Debug)]
pub struct FolderFormat {
    /// Name in calls.
    pub name: &'static str,
    /// Ending of files, without the first dot.
    pub ending: &'static str,
    /// Whether it shows what texts select; else it takes none.
    pub texts: bool,
    write: WriteFolder,
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

    /// Writes the zip; gives how many photos are in it.
    ///
    /// # Errors
    /// Those of `pixels`; `deadline_exceeded` and `store_unavailable` as `to` fails.
    pub fn write(
        &self,
        of: &FolderContents<'_>,
        pixels: &mut dyn FolderPixels,
        to: &mut dyn Write,
    ) -> Result<usize> {
        let mut zip = ZipFolder::new(to);
        let photos = photos::write(&of.scene.meta.cameras, pixels, &mut zip)?;
        (self.write)(of, &photos, pixels, &mut zip)?;
        zip.finish()?;
        Ok(photos.iter().filter(|photo| photo.there).count())
    }
}

/// What a folder says, beside pixels.
#[derive(Clone, Copy, Debug)]
pub struct FolderContents<'a> {
    /// The scene, with its cameras.
    pub scene: &'a Scene,
    /// The texts of the masks.
    pub texts: &'a [String],
    /// Points that it may have.
    pub points_max: usize,
}

/// The pixels of a folder. Photos have the numbers of the scene's cameras.
pub trait FolderPixels {
    /// Hands on the photos that are there, each once, in their order.
    ///
    /// # Errors
    /// Those of `put`, and `photo_unreadable`.
    fn photos(&mut self, put: &mut PutPhoto<'_>) -> Result<()>;

    /// `[H * W]` depth at the size of the photo, world units, 0 where nothing is.
    ///
    /// # Errors
    /// Where it cannot be drawn.
    fn depth(&mut self, photo: usize) -> Result<Vec<f32>>;

    /// What each text selects in a photo.
    ///
    /// # Errors
    /// Where it cannot be drawn.
    fn masks(&mut self, photo: usize) -> Result<Vec<FolderMask>>;
}

/// Takes the file of a photo.
pub type PutPhoto<'a> = dyn FnMut(usize, PhotoFile<'_>) -> Result<()> + 'a;

/// The file of a photo.
#[derive(Debug)]
pub enum PhotoFile<'a> {
    /// As it was sent.
    Sent(&'a [u8]),
    /// A PNG: the pixels of the scene are others than those that were sent.
    Png(Vec<u8>),
}

/// What a text selects in a photo.
#[derive(Clone, Debug)]
pub struct FolderMask {
    /// Its pixels.
    pub mask: Option<Rle>,
    /// How many there are.
    pub area: u64,
    /// Left, top, width and height, where there is one.
    pub bbox: Option<[u32; 4]>,
}
