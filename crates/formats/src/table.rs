//! The table of formats: what scenes are exported in, and which files of Gaussians are read.
//!
//! The calls over HTTP and gRPC, their documents, the command line, the page and the Python client
//! take names, endings, media types and help from here.

use std::{io::BufRead, ops::Deref};

use serde::{Deserialize, Serialize};
use utoipa::{
    PartialSchema, ToSchema,
    openapi::{ObjectBuilder, RefOr, Schema, schema::Type},
};

use crate::{
    colmap,
    error::{Error, Result},
    folders::{FolderFormat, coco, labelme, nerfstudio},
    limits::Limits,
    names::display_names,
    splats::{
        COMPRESSED_PLY, GLB, OCTETS, PLY, SOG, SPLAT, SPZ, SPZ4, SplatFormat, SplatsRead,
        unreadable,
    },
};
use FormatKind::{Arrays, Folder, Packed, Page, Splats, Streamed};

macro_rules! formats {
    ($($(#[doc = $help:literal])+ $format:ident = $number:literal: $name:expr, $title:literal,
        $ending:expr, $media_type:expr, $lines:literal, $kind:expr;)+) => {
        /// A format that scenes are exported in; its number is that of gRPC.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(rename_all = "snake_case")]
        pub enum ExportFormat {
            #[default]
            $($(#[doc = $help])+ $format = $number,)+
        }

        impl ExportFormat {
            /// All formats, the default first.
            pub fn all() -> impl Iterator<Item = Self> {
                [$(Self::$format),+].into_iter()
            }

            fn row(self) -> &'static FormatRow {
                match self {
                    $(Self::$format => {
                        static ROW: FormatRow = FormatRow {
                            name: $name,
                            title: $title,
                            ending: $ending,
                            media_type: $media_type,
                            help: concat!($($help),+),
                            lines: $lines,
                            kind: $kind,
                        };
                        &ROW
                    })+
                }
            }
        }
    };
}

// Format and its number over gRPC, which never changes: name, title, ending, media type, whether
// each line of a text is one, what writes it. The first is the default. Those of Gaussians have
// columns in their own files.
formats! {
    /// Standard 3DGS PLY with `semantic_index` as an extra attribute and, after the vertices, the
    /// semantics where they are made.
    Ply = 1: PLY.name, "PLY", PLY.ending, PLY.media_type, false, Splats(&PLY);
    /// The compressed PLY of `PlayCanvas` and `SuperSplat`: 16 bytes a Gaussian.
    CompressedPly = 5: COMPRESSED_PLY.name, "compressed PLY", COMPRESSED_PLY.ending,
        COMPRESSED_PLY.media_type, false, Splats(&COMPRESSED_PLY);
    /// SPZ, version 3: under 16 bytes a Gaussian.
    Spz = 6: SPZ.name, "SPZ", SPZ.ending, SPZ.media_type, false, Splats(&SPZ);
    /// SPZ, version 4, which fewer programs read.
    Spz4 = 9: SPZ4.name, "SPZ 4", SPZ4.ending, SPZ4.media_type, false, Splats(&SPZ4);
    /// SOG, the bundle of pictures of `PlayCanvas`, without harmonics over degree 0.
    Sog = 10: SOG.name, "SOG", SOG.ending, SOG.media_type, false, Splats(&SOG);
    /// Binary glTF with `KHR_gaussian_splatting`, the entries of the bank and the semantics.
    Glb = 7: GLB.name, "GLB", GLB.ending, GLB.media_type, false, Splats(&GLB);
    /// `.splat`: 32 bytes a Gaussian.
    Splat = 8: SPLAT.name, ".splat", SPLAT.ending, SPLAT.media_type, false, Splats(&SPLAT);
    /// The semantics as `NumPy` arrays: the bank, the row of each mask, the entry of each Gaussian
    /// and of each cell of the photos.
    Npz = 2: "npz", "semantics (npz)", "npz", OCTETS, false, Arrays;
    /// The scene as the page draws it: 32 bytes a Gaussian, those that cover most first.
    Packed = 3: "packed", "packed", "segsplat", OCTETS, false, Packed;
    /// The page with the scene in it, as one file for a disk. It shows the texts of `text`, one a
    /// line, and needs no server.
    Html = 4: "html", "one HTML file", "html", OCTETS, true, Page;
    /// Streamed SOG, the levels of detail of `PlayCanvas`, in a zip: `lod-meta.json` and SOG
    /// bundles by place and level, which a program loads as it looks at them.
    SogLod = 15: "sog_lod", "streamed SOG (zip)", "sog.zip", ZIP, false, Streamed;
    /// A folder as COLMAP has it, in a zip: photos, cameras, points and depth maps.
    Colmap = 11: "colmap", "COLMAP (zip)", "colmap.zip", ZIP, false,
        Folder(FolderFormat(colmap::write));
    /// The same as nerfstudio has it.
    Nerfstudio = 12: "nerfstudio", "nerfstudio (zip)", "nerfstudio.zip", ZIP, false,
        Folder(FolderFormat(nerfstudio::write));
    /// What each line of `text` selects in each photo as COCO's annotations, in a zip.
    Coco = 13: "coco", "COCO (zip)", "coco.zip", ZIP, true, Folder(FolderFormat(coco::write));
    /// The same as a JSON with polygons for `LabelMe` beside each photo.
    Labelme = 14: "labelme", "LabelMe (zip)", "labelme.zip", ZIP, true,
        Folder(FolderFormat(labelme::write));
}

display_names!(ExportFormat);

/// A row of the table.
#[derive(Clone, Copy, Debug)]
pub struct FormatRow {
    /// Name in calls.
    pub name: &'static str,
    /// Name for people.
    pub title: &'static str,
    /// Ending of files, without the first dot.
    pub ending: &'static str,
    /// Media type.
    pub media_type: &'static str,
    /// What it is and what it keeps, in Markdown.
    pub help: &'static str,
    /// Whether each line of the text of a call is a text that the file shows.
    pub lines: bool,
    /// What writes it.
    pub kind: FormatKind,
}

/// What writes a format.
#[derive(Clone, Copy, Debug)]
pub enum FormatKind {
    /// Gaussians for other programs, which are read too.
    Splats(&'static SplatFormat),
    /// A folder in a zip.
    Folder(FolderFormat),
    /// The semantics as arrays.
    Arrays,
    /// The scene as the page draws it.
    Packed,
    /// The page with the scene in it.
    Page,
    /// Levels of detail of the scene in a zip.
    Streamed,
}

const ZIP: &str = "application/zip";

impl Deref for ExportFormat {
    type Target = FormatRow;

    fn deref(&self) -> &FormatRow {
        self.row()
    }
}

impl ExportFormat {
    /// The format of this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::all().find(|format| format.name == name)
    }

    /// The format that the ending of a file's name says: of several the longest.
    pub fn of_file(name: &str) -> Option<Self> {
        let name = name.to_ascii_lowercase();
        let ends = |format: &Self| {
            name.strip_suffix(format.ending).is_some_and(|stem| stem.ends_with('.'))
        };
        Self::all().filter(ends).max_by_key(|format| format.ending.len())
    }

    /// Whether it is one of Gaussians.
    pub fn is_splats(self) -> bool {
        matches!(self.kind, Splats(_))
    }

    /// Names for people, or endings, of some formats, for messages.
    pub fn listed(some: impl Fn(&Self) -> bool, of: fn(&FormatRow) -> &str) -> String {
        let some = Self::all().filter(some).map(|format| of(format.row()));
        some.collect::<Vec<_>>().join(", ")
    }
}

impl PartialSchema for ExportFormat {
    fn schema() -> RefOr<Schema> {
        let each = Self::all().map(|of| format!("\n- `{of}`: {}", of.help.trim()));
        let schema = ObjectBuilder::new()
            .schema_type(Type::String)
            .enum_values(Some(Self::all().map(|of| of.row().name)))
            .description(Some(format!("File format of an export.\n{}", each.collect::<String>())));
        schema.into()
    }
}

impl ToSchema for ExportFormat {}

/// The formats of Gaussians.
pub fn splat_formats() -> impl Iterator<Item = &'static SplatFormat> {
    ExportFormat::all().filter_map(|format| match format.kind {
        Splats(format) => Some(format),
        _ => None,
    })
}

/// The format of Gaussians that the ending of a file's name says.
pub fn splat_format_of(name: &str) -> Option<&'static SplatFormat> {
    match ExportFormat::of_file(name)?.kind {
        Splats(format) => Some(format),
        _ => None,
    }
}

/// Reads a file of Gaussians. Its first bytes say which format it is; `.splat` has none, so `name`
/// must say it. `gaussians_max` and `splats_bytes_max` of `limits` bound what it may claim.
///
/// # Errors
/// `invalid_request` when it is none of these or is damaged, naming what is wrong;
/// `limit_exceeded`; `store_unavailable` when reading fails. Poisoned Gaussians are no error: they
/// are dropped or clamped and counted.
pub fn read_splats(from: &mut dyn BufRead, name: &str, limits: &Limits) -> Result<SplatsRead> {
    let start = from.fill_buf().map_err(unreadable)?;
    // What begins as one format is not read as another, whatever its name says.
    let begins = |of: &&SplatFormat| !of.begins.is_empty() && start.starts_with(of.begins);
    let by_name = || splat_format_of(name).filter(|format| format.begins.is_empty());
    if let Some(format) = splat_formats().find(begins).or_else(by_name) {
        return (format.read)(from, limits);
    }
    let titles = |by_name: bool| {
        let some = |of: &ExportFormat| match of.kind {
            Splats(of) => of.begins.is_empty() == by_name,
            _ => false,
        };
        ExportFormat::listed(some, |row| row.title)
    };
    Err(Error::invalid(format!(
        "the file is none of Gaussians: it begins with {:?}; {} are known by their first bytes, {} \
         by the ending of its name",
        String::from_utf8_lossy(start.get(..4).unwrap_or(start)),
        titles(false),
        titles(true)
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_format_is_known_by_name_and_by_the_ending_of_a_file() {
        for format in ExportFormat::all() {
            assert_eq!(ExportFormat::named(&format.to_string()), Some(format));
            let file = format!("a.{}", format.ending.to_ascii_uppercase());
            assert_eq!(ExportFormat::of_file(&file), Some(format));
        }
        assert_eq!([ExportFormat::of_file("splat"), ExportFormat::of_file("a.zip")], [None; 2]);
    }
}
