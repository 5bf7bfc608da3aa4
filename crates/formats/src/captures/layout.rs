//! What all readers of layouts share: how a layout is recognised and read, and cameras as they are
//! written.

pub(crate) use super::{
    cameras::{self, CameraEntry, Fields, PoseAxes, json, number, object},
    folder::Folder,
    lens::{Base, Lens, Terms},
    names,
    numbers::{
        Decimals, inverse, inverse_of_rows, number_of, numbers, numbers_of, pinhole, pose,
        rotation, text,
    },
};
use crate::{
    error::{Error, Result},
    scene::LengthUnit,
};

/// A layout of captures: how it is recognised by its files, and how its cameras are read.
pub(crate) trait Layout: Sync {
    /// Its name in messages.
    fn name(&self) -> &'static str;

    /// Whether a folder `masks` beside the photos holds their masks.
    fn has_mask_folder(&self) -> bool {
        false
    }

    /// What a unit of its poses is.
    fn unit(&self) -> LengthUnit {
        LengthUnit::Unknown
    }

    /// Where each capture of this layout begins: a camera file, or the folder of several.
    fn find(&self, folder: &Folder<'_>) -> Vec<String>;

    /// The cameras of the capture at a place of [`Self::find`].
    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described>;
}

/// What a capture says of its cameras.
pub(crate) struct Described {
    /// The folder that the files of the cameras are looked for from.
    pub(crate) root: String,
    pub(crate) cameras: cameras::Cameras,
}

impl Described {
    pub(crate) fn new(root: &str, entries: Vec<CameraEntry>) -> Self {
        let cameras = cameras::Cameras { entries, ..cameras::Cameras::default() };
        Self { root: root.to_owned(), cameras }
    }
}

/// The files of this name, in any case.
pub(crate) fn called(folder: &Folder<'_>, name: &str) -> Vec<String> {
    let is_called = |path: &&str| names::file_name(path).eq_ignore_ascii_case(name);
    folder.paths().filter(is_called).map(str::to_owned).collect()
}

/// Refuses one entry more of a file than the limit, before memory is taken for it.
pub(crate) fn count(entries: usize, max: usize, path: &str) -> Result<()> {
    if entries < max {
        return Ok(());
    }
    Err(Error::limit(format!("{path}: entries"), format!("more than {max}"), max))
}
