//! Photos without cameras: all pictures of an upload or a folder but masks, and but those that are
//! copies of others at another size.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, HashSet},
    path::Path,
};

use super::{
    FileBytes, FoundMask, check_count, folder::Folder, layouts, masks::Masks, names, not_read, told,
};
use crate::{
    error::{Error, Result},
    limits::Limits,
    scene::{CamerasMode, Upload, Warning, WarningCode},
};

/// The file of a photo that has no camera.
#[derive(Debug)]
pub struct UnposedFile<'a> {
    /// Its path.
    pub name: String,
    /// The file.
    pub bytes: FileBytes<'a>,
    /// Its mask, where it has one.
    pub mask: Option<FoundMask<'a>>,
}

/// Photos without cameras, not decoded.
#[derive(Debug)]
pub struct FoundUnposed<'a> {
    /// In the order of their paths.
    pub photos: Vec<UnposedFile<'a>>,
    /// What was not used.
    pub warnings: Vec<Warning>,
}

/// The photos of an upload that has no cameras, or whose cameras are not to be used; `None` where
/// its cameras are.
///
/// # Errors
/// `invalid_request` for fewer photos than a scene needs, `photo_unreadable` for an archive that is
/// damaged, `limit_exceeded`.
pub fn find_unposed<'a>(
    upload: &'a Upload,
    mode: CamerasMode,
    limits: &'a Limits,
) -> Result<Option<FoundUnposed<'a>>> {
    if upload.sent_splats().is_some() || upload.cameras.is_some() && mode == CamerasMode::Auto {
        return Ok(None);
    }
    let total = upload.size_bytes();
    if total > limits.upload_bytes_max {
        return Err(Error::limit("upload bytes", total, limits.upload_bytes_max));
    }
    let archive = upload.sent_archive();
    let folder = match archive {
        Some(archive) => Folder::of_archive(archive, limits)?,
        None => Folder::of_form(upload.sent(), false, limits)?,
    };
    if is_described(&folder, mode) {
        return Ok(None);
    }
    if archive.is_none() && mode == CamerasMode::Auto {
        // Paths of cameras may be encoded.
        let decoded = Folder::of_form(upload.sent(), true, limits);
        if decoded.is_ok_and(|folder| is_described(&folder, mode)) {
            return Ok(None);
        }
    }
    of_folder(&folder).map(Some)
}

/// As [`find_unposed`], of a folder on this machine.
///
/// # Errors
/// As there.
pub fn find_unposed_in_dir<'a>(
    dir: &Path,
    mode: CamerasMode,
    limits: &'a Limits,
) -> Result<Option<FoundUnposed<'a>>> {
    let folder = Folder::of_dir(dir, limits)?;
    if is_described(&folder, mode) { Ok(None) } else { of_folder(&folder).map(Some) }
}

/// Whether cameras are there and count. Cameras that are not read count too: whoever sent them
/// means them, and is told.
fn is_described(folder: &Folder<'_>, mode: CamerasMode) -> bool {
    let has = || !layouts::find(folder).is_empty() || layouts::not_read(folder).is_some();
    mode == CamerasMode::Auto && has()
}

fn of_folder<'a>(folder: &Folder<'a>) -> Result<FoundUnposed<'a>> {
    let masks = Masks::of(folder.paths(), true);
    let aside: HashSet<&str> = masks.placed().collect();
    let is_taken = |path: &&str| folder.is_photo(path) && !aside.contains(path);
    let all: Vec<&str> = folder.paths().filter(is_taken).collect();
    if all.is_empty() {
        let others = not_read(folder);
        let what = &folder.what;
        return Err(Error::invalid(format!("{what}: no photos and no cameras in it{others}")));
    }
    let photos = without_copies(&all);
    check_count(photos.len(), folder.limits)?;
    let (copies, used) = (all.len() - photos.len(), photos.iter().copied().collect::<HashSet<_>>());
    let unused = all.iter().copied().filter(|path| !used.contains(path));
    let why = "pictures of the same names as the photos; left out";
    let mut warnings: Vec<Warning> =
        told(WarningCode::PhotosUnused, copies, why, unused).into_iter().collect();
    let others = not_read(folder);
    if !others.is_empty() {
        let message = others.trim_start_matches("; ").to_owned();
        warnings.push(Warning { code: WarningCode::PhotosUnused, message, value: 1.0 });
    }
    // The network that finds cameras sees them all.
    let most = folder.limits.network_photos_max.min(folder.limits.photos_max);
    let (chosen, left_out) = spread(&photos, most);
    let why = format!(
        "left out; without cameras {} of these {} photos are taken, spread evenly in the order of \
         their names",
        most,
        photos.len()
    );
    let count = left_out.len();
    warnings.extend(told(WarningCode::PhotosUnused, count, &why, left_out.into_iter()));
    let take = |path: &str| {
        let mask = match masks.of_photo(path) {
            Some((mask, marks_left_out)) => {
                let bytes = folder.later(mask)?;
                Some(FoundMask { path: mask.to_owned(), bytes, marks_left_out })
            }
            None => None,
        };
        Ok(UnposedFile { name: path.to_owned(), bytes: folder.later(path)?, mask })
    };
    let photos = chosen.into_iter().map(take).collect::<Result<_>>()?;
    Ok(FoundUnposed { photos, warnings })
}

/// The photos of the folder that has most of them, and of each other folder unless most of its
/// pictures have names of these: copies at another size, depth maps.
fn without_copies<'a>(all: &[&'a str]) -> Vec<&'a str> {
    let mut folders: BTreeMap<&str, Vec<&'a str>> = BTreeMap::new();
    for path in all {
        folders.entry(names::folder(path)).or_default().push(path);
    }
    let mut folders: Vec<(&str, Vec<&'a str>)> = folders.into_iter().collect();
    let depth = |folder: &str| folder.split('/').count();
    folders.sort_by_key(|(folder, photos)| (Reverse(photos.len()), depth(folder)));
    let stem = |path: &str| {
        let name = names::file_name(path).to_lowercase();
        names::stem(&name).unwrap_or(&name).to_owned()
    };
    let (mut taken, mut stems) = (Vec::new(), HashSet::new());
    for (_, photos) in folders {
        let known = photos.iter().filter(|path| stems.contains(&stem(path))).count();
        if 2 * known <= photos.len() {
            stems.extend(photos.iter().map(|path| stem(path)));
            taken.extend(photos);
        }
    }
    taken.sort_unstable();
    taken
}

/// At most so many of all, spread evenly, and the others.
fn spread<'a>(all: &[&'a str], most: usize) -> (Vec<&'a str>, Vec<&'a str>) {
    if all.len() <= most {
        return (all.to_vec(), Vec::new());
    }
    let at = |i: usize| i * (all.len() - 1) / (most - 1).max(1);
    let kept: HashSet<usize> = (0..most).map(at).collect();
    let (mut chosen, mut left_out) = (Vec::new(), Vec::new());
    for (i, path) in all.iter().enumerate() {
        if kept.contains(&i) { chosen.push(*path) } else { left_out.push(*path) }
    }
    (chosen, left_out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::UploadFile;

    fn found(paths: &[&str], limits: &Limits) -> Result<Vec<String>> {
        let photos = paths.iter().map(|path| UploadFile { name: (*path).into(), bytes: vec![1] });
        let upload = Upload { photos: photos.collect(), ..Upload::default() };
        let found = find_unposed(&upload, CamerasMode::Auto, limits)?.expect("no cameras");
        Ok(found.photos.into_iter().map(|photo| photo.name).collect())
    }

    #[test]
    fn copies_and_masks_are_no_photos() {
        let limits = Limits::default();
        let all = ["images/b.jpg", "images/a.jpg", "images_2/a.jpg", "images_2/b.jpg"];
        assert_eq!(found(&all, &limits).unwrap(), ["images/a.jpg", "images/b.jpg"]);
        let two = ["left/a.jpg", "left/b.jpg", "right/c.jpg", "masks/left/a.png"];
        assert_eq!(found(&two, &limits).unwrap(), two[..3]);
    }

    #[test]
    fn too_many_are_spread_evenly() {
        let limits = Limits { photos_max: 3, ..Limits::default() };
        let all = ["0.jpg", "1.jpg", "2.jpg", "3.jpg", "4.jpg", "5.jpg", "6.jpg"];
        assert_eq!(found(&all, &limits).unwrap(), ["0.jpg", "3.jpg", "6.jpg"]);
    }

    #[test]
    fn cameras_that_are_there_count_unless_they_are_to_be_solved() {
        let file = |name: &str| UploadFile { name: name.into(), bytes: b"{}".to_vec() };
        let photos = ["a.jpg", "b.jpg", "transforms.json"].map(file).into();
        let upload = Upload { photos, ..Upload::default() };
        let limits = Limits::default();
        let found = |mode| find_unposed(&upload, mode, &limits).unwrap();
        assert!(found(CamerasMode::Auto).is_none());
        assert_eq!(found(CamerasMode::Solve).unwrap().photos.len(), 2);
    }
}
