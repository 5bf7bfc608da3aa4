//! A scene as a folder for other programs, in a zip that is written part by part: photos, cameras,
//! points and depth as COLMAP and nerfstudio have them, masks of texts as COCO and `LabelMe` have
//! them.
//!
//! A module for each format. Beside the scene, one photo or one view is in memory.

pub(crate) mod coco;
mod contents;
pub(crate) mod labelme;
pub(crate) mod nerfstudio;
mod outline;
mod photos;
mod points;
mod zipped;

use std::io::Write;

pub use self::contents::{FolderContents, FolderMask, FolderPixels, PhotoFile, PutPhoto};
pub(crate) use self::{
    photos::FolderPhoto,
    points::{FolderPoint, points},
    zipped::ZipFolder,
};
use crate::error::Result;

/// Writes what a folder has beside its photos.
pub(crate) type WriteFolder = fn(
    &FolderContents<'_>,
    &[FolderPhoto],
    &mut dyn FolderPixels,
    &mut ZipFolder<'_>,
) -> Result<()>;

/// A layout of folders.
#[derive(Clone, Copy, Debug)]
pub struct FolderFormat(pub(crate) WriteFolder);

impl FolderFormat {
    /// Writes the zip; gives how many photos are in it.
    ///
    /// # Errors
    /// Those of `pixels`; `deadline_exceeded` and `store_unavailable` as `to` fails.
    pub fn write(
        self,
        of: &FolderContents<'_>,
        pixels: &mut dyn FolderPixels,
        to: &mut dyn Write,
    ) -> Result<usize> {
        let mut zip = ZipFolder::new(to);
        let photos = photos::write(&of.scene.meta.cameras, pixels, &mut zip)?;
        self.0(of, &photos, pixels, &mut zip)?;
        zip.finish()?;
        Ok(photos.iter().filter(|photo| photo.there).count())
    }
}
