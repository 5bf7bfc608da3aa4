//! The layouts of captures, one reader each. A layout is recognised by the names of its files, and
//! by a look into a file where names are not enough.

mod arkit;
mod bundler;
mod json;
mod llff;
mod metashape;
mod mvs;
mod opensfm;
mod polycam;
mod realestate;
mod record3d;

use super::{folder::Folder, layout::Layout, names};
use crate::colmap::Colmap;

/// A file of cameras in a folder, or the folder of several.
#[derive(Clone)]
pub(super) struct Seen {
    pub(super) layout: &'static dyn Layout,
    /// Where the cameras are.
    pub(super) at: String,
    /// How late it comes of equally good ones: programs make cameras of the first three of one
    /// another and keep both; a training writes the last.
    pub(super) class: usize,
}

impl Seen {
    /// Folders around it.
    pub(super) fn depth(&self) -> usize {
        if self.at.is_empty() { 0 } else { self.at.split('/').count() }
    }
}

/// All readers with their classes.
static LAYOUTS: [(&dyn Layout, usize); 12] = [
    (&json::Transforms, 0),
    (&Colmap, 1),
    (&llff::Llff, 2),
    (&polycam::Polycam, 3),
    (&record3d::Record3d, 3),
    (&arkit::ArKitScenes, 3),
    (&mvs::MvsNet, 3),
    (&realestate::RealEstate, 3),
    (&opensfm::OpenSfm, 3),
    (&bundler::Bundler, 3),
    (&metashape::Metashape, 3),
    (&json::CamerasJson, 4),
];

/// What captures are made of that are not read: a piece of a file's name, and the program with what
/// to do.
const NOT_READ: [(&str, &str); 7] = [
    (".rcproj", "RealityCapture's project"),
    (".csv", "a table, as RealityCapture exports cameras"),
    (".xml", "XML, and not the cameras that Metashape exports"),
    (".psx", "Metashape's project"),
    (".db", "COLMAP's database, which holds no poses"),
    ("groundtruth.txt", "TUM's trajectory"),
    (".mvs", "OpenMVS's scene"),
];

/// All cameras in the folder, those of better classes and then of less deep folders first.
pub(super) fn find(folder: &Folder<'_>) -> Vec<Seen> {
    let mut all: Vec<Seen> = Vec::new();
    for (layout, class) in LAYOUTS {
        all.extend(layout.find(folder).into_iter().map(|at| Seen { layout, at, class }));
    }
    all.sort_by_key(|seen| (seen.class, seen.depth()));
    all
}

/// What finds the cameras of photos alone; README and docs/captures.md have the same lines.
pub const FIND_CAMERAS: &str = r#"photos alone: these find cameras (pip install pycolmap):
pycolmap.extract_features("photos/database.db", "photos/images")
pycolmap.match_exhaustive("photos/database.db")
pycolmap.incremental_mapping("photos/database.db", "photos/images", "photos/sparse")
Then send the folder "photos". docs/captures.md says more"#;

/// A file of cameras that are not read, and what it is.
pub(super) fn not_read<'f>(folder: &'f Folder<'_>) -> Option<(&'f str, &'static str)> {
    folder.paths().find_map(|path| {
        let name = names::file_name(path).to_lowercase();
        NOT_READ.iter().find(|(ending, _)| name.ends_with(ending)).map(|(_, of)| (path, *of))
    })
}

/// The message where no cameras were found.
pub(super) fn none(folder: &Folder<'_>) -> String {
    let known = LAYOUTS.map(|(layout, _)| layout.name()).join(", ");
    let not_read = not_read(folder).map_or_else(String::new, |(path, of)| {
        format!(
            "; {path:?} is {of}, which is not read: export the cameras as COLMAP's text, or have \
             them solved from the photos (cameras=solve)"
        )
    });
    format!(
        "{}: no transforms.json and no cameras.json in it, nor another layout with cameras; {} \
         files were looked at, and these layouts are known: {known}{not_read}; {FIND_CAMERAS}",
        folder.what,
        folder.paths().count()
    )
}
