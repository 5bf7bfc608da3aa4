//! The layouts of captures, one reader each. A layout is recognised by the names of its files, and
//! by a look into a file where names are not enough.

mod arkit;
mod json;
mod llff;
mod mvs;
mod polycam;
mod realestate;
mod record3d;

use super::{
    folder::Folder,
    layout::{Described, Layout},
};
use crate::{
    colmap::Colmap,
    error::{Error, Result},
};

/// All readers. Cameras of the first three are often made of those of the next, beside them.
static LAYOUTS: [&dyn Layout; 9] = [
    &json::Transforms,
    &Colmap,
    &llff::Llff,
    &json::OurCameras,
    &polycam::Polycam,
    &record3d::Record3d,
    &arkit::ArKitScenes,
    &mvs::MvsNet,
    &realestate::RealEstate,
];
/// The layouts at the head of [`LAYOUTS`] of which one is taken before those after it.
const ONE_OF_ANOTHER: usize = 3;

/// Finds which layout a folder has, and reads its cameras.
///
/// A `transforms.json` is taken before COLMAP's files and these before `poses_bounds.npy`: programs
/// make one of the other and keep both. All other mixtures are refused.
///
/// # Errors
/// `invalid_request` where it has no layout that is known, or several, and as the reader.
pub(super) fn read(folder: &Folder<'_>) -> Result<Described> {
    let mut found: Vec<(&dyn Layout, String)> = Vec::new();
    let mut made_of_another = false;
    for (i, layout) in LAYOUTS.iter().enumerate() {
        if i < ONE_OF_ANOTHER && made_of_another {
            continue;
        }
        let places = layout.find(folder);
        made_of_another |= !places.is_empty();
        found.extend(places.into_iter().map(|at| (*layout, at)));
    }
    let what = folder.what;
    match &found[..] {
        [(layout, at)] => {
            folder.forget_cameras_read();
            layout.read(folder, at)
        }
        [(a, at_a), (b, at_b), ..] => Err(Error::invalid(format!(
            "{what}: two camera files, {at_a:?} ({}) and {at_b:?} ({}); a scene has one",
            a.name(),
            b.name()
        ))),
        [] => {
            let others = LAYOUTS.map(|layout| layout.name()).join(", ");
            Err(Error::invalid(format!(
                "{what}: no transforms.json and no cameras.json in it, nor another layout with \
                 cameras; {} files were looked at, and these layouts are known: {others}",
                folder.paths().count()
            )))
        }
    }
}
