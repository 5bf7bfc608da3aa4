//! Which folder holds the photos of the cameras: programs put smaller, larger and undistorted
//! copies, masks, depth maps and renders beside them, often under the same names.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BTreeSet},
    io::Cursor,
};

use super::{
    cameras::CameraEntry,
    folder::Folder,
    lens::Sizes,
    names::{self, Ending, Spelling, Tails},
};
use crate::error::{Error, Result};

/// Names of folders with the photos of cameras, where several have photos of these names.
const PHOTO_FOLDERS: [&str; 5] = ["images", "resized_images", "rgb", "input", "blended_images"];
/// What the names of folders begin with that hold other pictures than photos.
const ASIDE: [&str; 16] = [
    "mask", "depth", "normal", "alpha", "seg", "sem", "label", "conf", "flow", "render", "gt",
    "thumb", "preview", "matte", "dynamic", "edge",
];
/// Photos of a place whose sizes are looked at.
const SIZED_MAX: usize = 3;
/// Places whose sizes are looked at.
const PLACES_MAX: usize = 8;
/// Bytes of a photo in which its size must be written.
const HEAD_BYTES_MAX: usize = 256 << 10;

/// Folders that hold the photos of cameras.
#[derive(Debug)]
pub(crate) struct Place {
    /// The folder that names of photos begin at.
    pub(crate) top: String,
    /// The folders that photos lie in.
    pub(crate) dirs: BTreeSet<String>,
    pub(crate) sizes: Sizes,
}

/// A folder, and what lies under it where the cameras look for it.
#[derive(Default)]
struct Votes<'a> {
    /// Camera and path of each photo.
    photos: Vec<(usize, &'a str)>,
    /// Parts in all common tails.
    parts: usize,
}

impl Votes<'_> {
    fn cameras(&self) -> BTreeSet<usize> {
        self.photos.iter().map(|(camera, _)| *camera).collect()
    }

    fn dirs(&self) -> BTreeSet<String> {
        self.photos.iter().map(|(_, path)| names::folder(path).to_owned()).collect()
    }

    /// Whether photos and cameras agree in a folder's name at least.
    fn agree_in_folders(&self) -> bool {
        self.parts >= 2 * self.photos.len()
    }
}

/// The folders under which photos end like the paths of cameras, by that folder.
fn votes<'a>(folder: &'a Folder<'_>, entries: &[CameraEntry]) -> Vec<(String, Votes<'a>)> {
    let mut all: BTreeMap<String, Votes<'a>> = BTreeMap::new();
    for ending in [Ending::Same, Ending::Absent, Ending::Other] {
        if ending == Ending::Other && !all.is_empty() {
            break;
        }
        let parts: Vec<Vec<String>> = entries
            .iter()
            .map(|entry| ending.of_camera(Spelling::Decoded.parts(&entry.file)))
            .collect();
        let wanted = Tails::new(parts.iter().enumerate().map(|(i, parts)| (i, &parts[..])));
        for path in folder.paths().filter(|path| folder.is_photo(path)) {
            let parts = ending.of_photo(Spelling::Decoded.parts(path));
            let (length, Some(camera)) = wanted.longest(&parts) else { continue };
            let before = path.split('/').count().saturating_sub(length);
            let place = path.split('/').take(before).collect::<Vec<_>>().join("/");
            let votes = all.entry(place).or_default();
            votes.photos.push((camera, path));
            votes.parts += length;
        }
    }
    all.into_iter().collect()
}

/// The folders that hold the photos of the cameras, which are looked for from `root`.
///
/// The best folder is that whose pictures are photos by its name, whose sizes fit the cameras, in
/// which most cameras find their photo, by the longest tails; then the nearest to `root`. Folders
/// beside it are taken too where the cameras name them and where they hold photos of others.
///
/// # Errors
/// `invalid_request` where two folders are equally good.
pub(crate) fn find(folder: &Folder<'_>, root: &str, entries: &[CameraEntry]) -> Result<Place> {
    let mut found = votes(folder, entries);
    let root_parts: Vec<&str> = root.split('/').collect();
    let near = |place: &str| place.split('/').zip(&root_parts).take_while(|(a, b)| a == *b).count();
    let known = |place: &str| {
        let at = PHOTO_FOLDERS.iter().position(|name| *name == names::file_name(place));
        Reverse(at.unwrap_or(PHOTO_FOLDERS.len()))
    };
    let depth = |place: &str| Reverse(place.split('/').count());
    let by_name = |(place, votes): &(String, Votes<'_>)| {
        (!is_aside(place), votes.cameras().len(), votes.parts, place == root, near(place))
    };
    found.sort_by_cached_key(|found| (Reverse(by_name(found)), found.0.clone()));
    found.truncate(PLACES_MAX);
    let most = found.first().map_or(0, |(_, votes)| votes.cameras().len());
    let first_aside = found.first().is_some_and(|(place, _)| is_aside(place));
    found.retain(|(place, votes)| {
        2 * votes.cameras().len() >= most && is_aside(place) == first_aside
            || votes.agree_in_folders()
    });
    let many = found.len() > 1;
    let mut ranked: Vec<_> = found
        .iter()
        .map(|found| {
            let (place, votes) = found;
            let (sizes, pixels) =
                if many { sizes(folder, entries, votes) } else { (Sizes::Fit, 0) };
            let enough = 2 * votes.cameras().len() >= most;
            let rank = (enough, sizes, by_name(found), known(place), depth(place), pixels);
            (rank, place, votes)
        })
        .collect();
    ranked.sort_by(|a, b| b.0.cmp(&a.0).then_with(|| a.1.cmp(b.1)));
    let Some((rank, top, votes)) = ranked.first() else {
        return Ok(Place { top: root.to_owned(), dirs: BTreeSet::new(), sizes: Sizes::Unknown });
    };
    let (mut cameras, mut dirs, mut top) = (votes.cameras(), votes.dirs(), (*top).clone());
    let first = top.clone();
    for (other, place, votes) in &ranked[1..] {
        let new = votes.cameras();
        if new.is_disjoint(&cameras) && votes.agree_in_folders() {
            cameras.extend(new);
            dirs.extend(votes.dirs());
            top = common(&top, place);
        } else if other == rank {
            return Err(Error::invalid(format!(
                "{}: the cameras have photos in {first:?} and in {place:?}; send one of them",
                folder.what
            )));
        }
    }
    let sizes = if many { rank.1 } else { sizes(folder, entries, votes).0 };
    Ok(Place { top, dirs, sizes })
}

/// Whether the folder holds other pictures than photos, by its name.
fn is_aside(place: &str) -> bool {
    let name = names::file_name(place).to_lowercase();
    ASIDE.iter().any(|start| name.starts_with(start))
}

/// The folder that both are in.
fn common(a: &str, b: &str) -> String {
    let parts = a.split('/').zip(b.split('/')).take_while(|(a, b)| a == b).map(|(a, _)| a);
    parts.collect::<Vec<_>>().join("/")
}

/// How the first photos fit their cameras, the worst of them, and the pixels of the largest.
fn sizes(folder: &Folder<'_>, entries: &[CameraEntry], votes: &Votes<'_>) -> (Sizes, u64) {
    let mut worst = (Sizes::Fit, 0);
    for (camera, path) in votes.photos.iter().take(SIZED_MAX) {
        let head = folder.head(path, HEAD_BYTES_MAX).ok();
        let reader = head.map(|head| image::ImageReader::new(Cursor::new(head)));
        let size = reader
            .and_then(|reader| reader.with_guessed_format().ok())
            .and_then(|reader| reader.into_dimensions().ok());
        let fit = size.map_or(Sizes::Unknown, |(width, height)| {
            worst.1 = worst.1.max(u64::from(width) * u64::from(height));
            entries[*camera].lens.sizes([width, height])
        });
        worst.0 = worst.0.min(fit);
    }
    worst
}
