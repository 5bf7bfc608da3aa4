//! The files of a capture: camera JSON and photo files, or a capture of any known layout, become
//! [`FoundPhoto`]s: files of photos with the lens and the pose of each, not decoded.
//!
//! Only this module knows the axes and units of each layout; poses come out as OpenCV cameras in
//! the world of the upload. Faults in names and numbers are refused before a photo is read.
//!
//! Photos sent beside a camera JSON each need a camera, but the JSON may describe more cameras than
//! photos were sent. A capture (a folder, an archive, or files of a form that describe their
//! cameras themselves) is recognised by its files, and of several cameras the best are taken;
//! cameras without photo and photos without camera are warned of by name. Of more photos than a
//! scene takes, the best are chosen.

mod bytes;
pub(crate) mod cameras;
mod candidates;
mod choose;
pub(crate) mod folder;
mod keys;
pub(crate) mod layout;
mod layouts;
pub(crate) mod lens;
mod masks;
pub(crate) mod names;
mod numbers;
mod once;
mod places;
mod unposed;

use std::{
    collections::{BTreeMap, BTreeSet, HashMap, HashSet},
    path::Path,
};

use glam::DVec3;

pub use self::bytes::FileBytes;
pub use self::layouts::FIND_CAMERAS;
pub use self::lens::{Base, Lens, LensAtSize, Sizes, Terms, same_aspect};
pub use self::masks::FoundMask;
pub use self::names::decoded as decoded_name;
pub use self::unposed::{FoundUnposed, UnposedFile, find_unposed, find_unposed_in_dir};
use self::{
    cameras::{CameraEntry, Cameras},
    candidates::{Best, Candidate, Pair, paired},
    folder::Folder,
    masks::Masks,
};
use crate::{
    error::{Error, Result},
    limits::Limits,
    scene::{
        CameraToWorld, LengthUnit, SentBytes, SentFile, Upload, UploadCameras, UploadFile, Warning,
        WarningCode, photo_label as label,
    },
};

/// Files that one message names.
const NAMED_MAX: usize = 4;
/// Why photos are left out that a camera file keeps for tests.
const KEPT_OUT: &str = "kept for tests, or marked as bad, by the capture; left out";
/// The list of `ScanNet++` of the photos that are kept for tests.
const TEST_LIST: &str = "train_test_lists.json";

/// As [`find`], of a folder on this machine; also the files of cameras that were read.
///
/// # Errors
/// As [`find`]; also `invalid_request` where the folder has no layout that is known.
pub fn find_in_dir<'a>(
    dir: &Path,
    limits: &'a Limits,
) -> Result<(FoundPhotos<'a>, Vec<UploadFile>)> {
    let (found, cameras) = of_folder(&Folder::of_dir(dir, limits)?, limits)?;
    let cameras = cameras.into_iter();
    Ok((found, cameras.map(|(name, bytes)| UploadFile { name, bytes }).collect()))
}

/// The photos of an upload with their cameras, by what it holds. An archive is unpacked
/// a file at a time, under the limits.
///
/// # Errors
/// `invalid_request` for missing, surplus or impossible cameras, `photo_unreadable` for an archive
/// that is damaged, `limit_exceeded`; each names photo, value and bound.
pub fn find<'a>(upload: &'a Upload, limits: &'a Limits) -> Result<FoundPhotos<'a>> {
    let total = upload.size_bytes();
    if total > limits.upload_bytes_max {
        return Err(Error::limit("upload bytes", total, limits.upload_bytes_max));
    }
    match (upload.sent_archive(), &upload.cameras) {
        (Some(_), cameras) if upload.sent().next().is_some() || cameras.is_some() => {
            Err(Error::invalid("send either an archive or camera JSON and photos, not both"))
        }
        (Some(archive), _) => {
            of_folder(&Folder::of_archive(archive, limits)?, limits).map(|(found, _)| found)
        }
        (None, Some(cameras)) => of_form(cameras, upload.sent().collect(), limits),
        (None, None) if upload.sent().all(|file| names::is_photo(file.name)) => {
            Err(Error::invalid(format!(
                "upload: no camera description; send a part named transforms or cameras, the \
                 camera files of a capture, or an archive with them; {}",
                layouts::FIND_CAMERAS
            )))
        }
        (None, None) => {
            let mut folder = Folder::of_form(upload.sent(), false, limits)?;
            if layouts::find(&folder).is_empty() {
                folder = Folder::of_form(upload.sent(), true, limits).unwrap_or(folder);
            }
            of_folder(&folder, limits).map(|(found, _)| found)
        }
    }
}

fn check_count(photos: usize, limits: &Limits) -> Result<()> {
    if photos >= limits.photos_min {
        return Ok(());
    }
    let least = limits.photos_min;
    Err(Error::invalid(match photos {
        0 => format!("no photos; a scene needs {least} or more"),
        n => format!("{n} photo; a scene needs at least {least} to see depth"),
    }))
}

/// A camera and its photo, before the pixels are touched.
#[derive(Debug)]
pub struct FoundPhoto<'a> {
    /// The photo as the scene calls it.
    pub name: String,
    /// The photo as the folder calls it.
    pub path: String,
    /// The photo as its camera calls it.
    pub named: String,
    /// Lens as written.
    pub lens: Lens,
    /// Pose, checked.
    pub pose: CameraToWorld,
    /// The file.
    pub bytes: FileBytes<'a>,
    /// Its mask, where it has one.
    pub mask: Option<FoundMask<'a>>,
}

impl FoundPhoto<'_> {
    fn candidate(&self) -> choose::Candidate<'_> {
        let (bytes, kind) = (self.bytes.size(), (&self.lens).into());
        choose::Candidate { pose: &self.pose, bytes, kind }
    }
}

/// The photos that make a scene, not decoded.
#[derive(Debug)]
pub struct FoundPhotos<'a> {
    /// Those that the networks see, in the order of the cameras.
    pub photos: Vec<FoundPhoto<'a>>,
    /// Those that only the steps of a refinement learn, in the same order.
    pub more: Vec<FoundPhoto<'a>>,
    /// What was not used or not there.
    pub warnings: Vec<Warning>,
    /// What a unit of the poses is.
    pub unit: LengthUnit,
}

impl<'a> FoundPhotos<'a> {
    /// All photos of a scene, those parted that the networks see.
    fn of(all: Vec<FoundPhoto<'a>>, mut warnings: Vec<Warning>, limits: &Limits) -> Self {
        let candidates: Vec<_> = all.iter().map(FoundPhoto::candidate).collect();
        let seen: HashSet<usize> =
            choose::best(&candidates, limits.network_photos_max).into_iter().collect();
        let (mut photos, mut more) = (Vec::with_capacity(seen.len()), Vec::new());
        for (i, photo) in all.into_iter().enumerate() {
            if seen.contains(&i) { photos.push(photo) } else { more.push(photo) }
        }
        let why = format!(
            "learnt by the steps of a refinement alone; the networks see {} of these {} photos: \
             those that see most from different places, then the sharpest; `cameras` lists them",
            photos.len(),
            photos.len() + more.len()
        );
        let names = more.iter().map(|photo| &*photo.name);
        warnings.extend(told(WarningCode::PhotosForSteps, more.len(), &why, names));
        Self { photos, more, warnings, unit: LengthUnit::Unknown }
    }
}

/// The photos of a form whose cameras are one JSON part.
fn of_form<'a>(
    cameras: &UploadCameras,
    files: Vec<SentFile<'a>>,
    limits: &Limits,
) -> Result<FoundPhotos<'a>> {
    let Cameras { entries, held_out, unread } = match cameras {
        UploadCameras::Transforms(json) => {
            limits.check_json("transforms", json)?;
            cameras::transforms(json)?
        }
        UploadCameras::Cameras(json) => {
            limits.check_json("cameras", json)?;
            cameras::cameras(json)?
        }
    };
    names::paths(&files, false, limits)?;
    let masks = Masks::of(files.iter().map(|file| file.name), true);
    let placed: HashSet<&str> = masks.placed().collect();
    let photos: HashSet<String> =
        entries.iter().filter_map(|entry| names::normalise(&entry.file)).collect();
    let named: HashSet<&str> = (entries.iter().filter_map(|entry| entry.mask.as_deref()))
        .filter_map(|name| masks.named(name, |path| photos.contains(path)))
        .collect();
    let is_mask = |file: &SentFile<'_>| placed.contains(file.name) || named.contains(file.name);
    let (masked, files): (Vec<SentFile<'a>>, Vec<SentFile<'a>>) =
        files.into_iter().partition(is_mask);
    check_count(files.len(), limits)?;
    let sent: Vec<&str> = files.iter().map(|file| file.name).collect();
    let (pairs, _) = paired(&entries, &sent)?;
    let used: HashSet<usize> = pairs.iter().map(|(_, file)| *file).collect();
    let held: HashSet<&str> = held_out.iter().map(|file| names::file_name(file)).collect();
    let is_held = |i: &usize| held.contains(names::file_name(sent[*i]));
    let (kept_out, lone): (Vec<usize>, Vec<usize>) =
        (0..files.len()).filter(|i| !used.contains(i)).partition(is_held);
    if let Some(&i) = lone.first() {
        return Err(Error::invalid(format!(
            "{}: no camera has this file; the camera file names {} others",
            label(i, files[i].name),
            entries.len()
        )));
    }
    let size = |file: usize| files[file].bytes.size();
    let mut warnings: Vec<Warning> = told(
        WarningCode::PhotosUnused,
        kept_out.len(),
        KEPT_OUT,
        kept_out.iter().map(|i| sent[*i]),
    )
    .into_iter()
    .collect();
    let (chosen, more) = chosen(&entries, pairs, &sent, size, limits)?;
    warnings.extend(more);
    warnings.extend(unread_keys(&unread));
    let masks_sent: HashMap<&str, SentBytes<'a>> =
        masked.iter().map(|file| (file.name, file.bytes)).collect();
    let taken: Vec<&str> = chosen.iter().map(|(_, file, _)| sent[*file]).collect();
    let (of_each, missing) = masks_of(&masks, &entries, &chosen, &taken);
    warnings.extend(missing);
    let take = |((entry, file, pose), mask): ((usize, usize, CameraToWorld), Option<Mask<'_>>)| {
        let SentFile { name, bytes } = files[file];
        let mask = mask.and_then(|(path, marks_left_out)| {
            let bytes = FileBytes::from(*masks_sent.get(path)?);
            Some(FoundMask { path: path.to_owned(), bytes, marks_left_out })
        });
        FoundPhoto {
            mask,
            ..found(&entries[entry], name.to_owned(), name.to_owned(), pose, bytes.into())
        }
    };
    let all = chosen.into_iter().zip(of_each).map(take).collect();
    Ok(FoundPhotos::of(all, warnings, limits))
}

/// The photos of a capture, and the files of cameras that were read from a disk.
fn of_folder<'a>(
    folder: &Folder<'a>,
    limits: &Limits,
) -> Result<(FoundPhotos<'a>, BTreeMap<String, Vec<u8>>)> {
    let tests = test_list(folder)?;
    let mut files = folder.take_cameras_read();
    let Best { candidate, warning } = candidates::best(folder, &tests)?;
    let unit = candidate.unit();
    let masks = Masks::of(folder.paths(), candidate.has_mask_folder() || folder.is_form());
    files.extend(candidate.files);
    let Candidate { entries, held_out, unread, place, sent, pairs, missing, .. } = candidate;
    let (place, what) = (place.top, &folder.what);
    let sent: Vec<&str> = sent.iter().map(String::as_str).collect();
    if pairs.is_empty() {
        return Err(Error::invalid(no_photos(folder, &entries)));
    }
    check_count(pairs.len(), limits)?;
    let are_masks: HashSet<&str> = masks.placed().collect();
    let mut unused = without_camera(&sent, &pairs, &held_out);
    unused.retain(|path| !are_masks.contains(&*names::join(&place, path)));
    let (cameras, photos) = (entries.len(), pairs.len() + unused.len());
    // A capture may be sent in part, and COLMAP leaves photos out: one side may be left over, but
    // where most of both are, their names do not fit.
    if 2 * pairs.len() < cameras.min(photos) {
        return Err(Error::invalid(format!(
            "{what}: only {} of {cameras} cameras have their photo, and {} of {photos} photos have \
             no camera: their names do not fit, as {:?} of a camera and the photo {:?}",
            pairs.len(),
            unused.len(),
            entries[missing[0]].file,
            unused[0]
        )));
    }
    let mut warnings: Vec<Warning> = warning.into_iter().collect();
    warnings.extend(told(
        WarningCode::PhotosMissing,
        missing.len(),
        &format!(
            "{} of {cameras} cameras have no such photo; left out{}",
            missing.len(),
            not_read(folder)
        ),
        missing.iter().map(|i| entries[*i].file.as_str()),
    ));
    warnings.extend(told(
        WarningCode::PhotosUnused,
        unused.len(),
        &format!("{} of {photos} photos have no camera; left out", unused.len()),
        unused.iter().copied(),
    ));
    warnings.extend(told(
        WarningCode::PhotosUnused,
        held_out.len(),
        KEPT_OUT,
        held_out.iter().map(String::as_str),
    ));
    let size = |file: usize| folder.size(&names::join(&place, sent[file]));
    let (chosen, more) = chosen(&entries, pairs, &sent, size, limits)?;
    warnings.extend(more);
    warnings.extend(unread_keys(&unread));
    let taken: Vec<String> =
        chosen.iter().map(|(_, file, _)| names::join(&place, sent[*file])).collect();
    let taken: Vec<&str> = taken.iter().map(String::as_str).collect();
    let (of_each, no_mask) = masks_of(&masks, &entries, &chosen, &taken);
    warnings.extend(no_mask);
    let take = |((entry, file, pose), mask): ((usize, usize, CameraToWorld), Option<Mask<'_>>)| {
        let (name, path) = (sent[file].to_owned(), names::join(&place, sent[file]));
        let bytes = folder.later(&path)?;
        let mask = match mask {
            Some((path, marks_left_out)) => {
                let bytes = folder.later(path)?;
                Some(FoundMask { path: path.to_owned(), bytes, marks_left_out })
            }
            None => None,
        };
        Ok(FoundPhoto { mask, ..found(&entries[entry], name, path, pose, bytes) })
    };
    let all = chosen.into_iter().zip(of_each).map(take).collect::<Result<_>>()?;
    Ok((FoundPhotos { unit, ..FoundPhotos::of(all, warnings, limits) }, files))
}

/// The message where no camera has its photo.
fn no_photos(folder: &Folder<'_>, entries: &[CameraEntry]) -> String {
    let (what, cameras) = (&folder.what, entries.len());
    let first = entries.first().map_or("", |entry| entry.file.as_str());
    let mut photos = folder.paths().filter(|path| folder.is_photo(path));
    let photos = match photos.next() {
        Some(photo) => format!("{photo:?} is one of {} photos", 1 + photos.count()),
        None => "no file has the name of a photo (.jpg, .png, .webp, .tif, .bmp)".to_owned(),
    };
    let others = not_read(folder);
    format!(
        "{what}: none of the {cameras} cameras has its photo; the first is {first:?}; \
         {photos}{others}"
    )
}

/// Names photos of formats that are not read, with what to do; empty where there are none.
fn not_read(folder: &Folder<'_>) -> String {
    let is_other = |path: &&str| names::is_other_photo(path) && !folder.is_photo(path);
    let mut others = folder.paths().filter(is_other);
    let Some(first) = others.next() else { return String::new() };
    format!(
        "; {} files are photos of formats that are not read, as {first:?}: save them as JPEG \
         (iPhone: Settings > Camera > Formats > Most Compatible)",
        1 + others.count()
    )
}

fn found<'a>(
    entry: &CameraEntry,
    name: String,
    path: String,
    pose: CameraToWorld,
    bytes: FileBytes<'a>,
) -> FoundPhoto<'a> {
    let (named, lens) = (entry.file.clone(), entry.lens.clone());
    FoundPhoto { name, path, named, lens, pose, bytes, mask: None }
}

/// A mask by its path, and whether it marks what is left out.
type Mask<'a> = (&'a str, bool);

/// The mask of each photo that is taken: that which its camera names, else that which lies where
/// masks lie. A warning names those that are not there.
fn masks_of<'a>(
    masks: &Masks<'a>,
    entries: &[CameraEntry],
    chosen: &Chosen,
    taken: &[&str],
) -> (Vec<Option<Mask<'a>>>, Option<Warning>) {
    let photos: HashSet<&str> = taken.iter().copied().collect();
    let (mut of_each, mut missing) = (Vec::new(), Vec::new());
    for ((entry, ..), photo) in chosen.iter().zip(taken) {
        let name = entries[*entry].mask.as_deref();
        let named = name.and_then(|name| masks.named(name, |path| photos.contains(path)));
        let mask = named.map(|path| (path, false)).or_else(|| masks.of_photo(photo));
        if let (Some(name), None) = (name, mask) {
            missing.push(name);
        }
        of_each.push(mask);
    }
    let why = format!(
        "{} of {} photos have no such mask; they are used whole",
        missing.len(),
        taken.len()
    );
    (of_each, told(WarningCode::MasksUsed, missing.len(), &why, missing.into_iter()))
}

/// Names keys of camera files that are not read.
fn unread_keys(keys: &BTreeSet<String>) -> Option<Warning> {
    let why = "keys of the camera file that are not read, though they say what is meant by others";
    told(WarningCode::KeysUnread, keys.len(), why, keys.iter().map(String::as_str))
}

/// A warning that names files.
fn told<'a>(
    code: WarningCode,
    count: usize,
    why: &str,
    files: impl Iterator<Item = &'a str>,
) -> Option<Warning> {
    let named: Vec<String> = files.take(NAMED_MAX).map(|file| format!("{file:?}")).collect();
    if count == 0 {
        return None;
    }
    let more = count - named.len();
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    let message = format!("{}{more}: {why}", named.join(", "));
    Some(Warning { code, message, value: count as f64 })
}

/// File names of the photos that `ScanNet++` keeps for tests.
fn test_list(folder: &Folder<'_>) -> Result<HashSet<String>> {
    let Some(path) = folder.paths().find(|path| names::file_name(path) == TEST_LIST) else {
        return Ok(HashSet::new());
    };
    let lists = cameras::object(&folder.read_json(path)?, path)?;
    let tests = lists.get("test").and_then(|list| list.as_array()).into_iter().flatten();
    Ok(tests.filter_map(|file| file.as_str()).map(str::to_owned).collect())
}

/// Photos without camera that lie where photos with cameras lie. A picture that is called after a
/// photo, as `a_mask.png` is after `a.jpg`, belongs to it.
fn without_camera<'a>(sent: &[&'a str], pairs: &[Pair], held_out: &[String]) -> Vec<&'a str> {
    let used: HashSet<usize> = pairs.iter().map(|(_, file)| *file).collect();
    let stems: HashSet<&str> = used.iter().filter_map(|i| names::stem(sent[*i])).collect();
    let folders: HashSet<&str> = used.iter().map(|i| names::folder(sent[*i])).collect();
    let held: HashSet<&str> = held_out.iter().map(|file| names::file_name(file)).collect();
    let belongs = |stem: &str| {
        let mut ends = stem.match_indices(['_', '.', '-']).map(|(at, _)| at).chain([stem.len()]);
        ends.any(|end| stems.contains(&stem[..end]))
    };
    let lone = |(i, path): (usize, &&'a str)| {
        let stem = names::stem(path)?;
        let is_lone = !used.contains(&i)
            && folders.contains(names::folder(path))
            && !held.contains(names::file_name(path))
            && !held.contains(names::file_name(stem))
            && !belongs(stem);
        is_lone.then_some(*path)
    };
    sent.iter().enumerate().filter_map(lone).collect()
}

/// Camera, photo and pose of the photos that a scene takes.
type Chosen = Vec<(usize, usize, CameraToWorld)>;

/// Checks all poses, and chooses the photos of the scene where there are too many.
fn chosen(
    entries: &[CameraEntry],
    pairs: Vec<Pair>,
    sent: &[&str],
    size: impl Fn(usize) -> u64,
    limits: &Limits,
) -> Result<(Chosen, Vec<Warning>)> {
    let pose =
        |(i, (entry, _)): (usize, &Pair)| entries[*entry].pose(&label(i, &entries[*entry].file));
    let poses: Vec<CameraToWorld> = pairs.iter().enumerate().map(pose).collect::<Result<_>>()?;
    // Photos that join others may stand anywhere.
    if limits.photos_min > 1 {
        check_places(&poses)?;
    }
    let scaled: Vec<&CameraEntry> =
        pairs.iter().map(|(entry, _)| &entries[*entry]).filter(|e| e.scale().is_some()).collect();
    let scale = scaled.first().and_then(|entry| entry.scale()).unwrap_or(1.0);
    let why = format!("rotations times a number, as {scale:.4}, which was taken out");
    let files = scaled.iter().map(|entry| entry.file.as_str());
    let mut warnings: Vec<Warning> =
        told(WarningCode::PosesScaled, scaled.len(), &why, files).into_iter().collect();
    let all = pairs.into_iter().zip(&poses).map(|((entry, file), pose)| (entry, file, *pose));
    if poses.len() <= limits.photos_max {
        return Ok((all.collect(), warnings));
    }
    let all: Chosen = all.collect();
    let candidates: Vec<choose::Candidate<'_>> = all
        .iter()
        .map(|(entry, file, pose)| {
            let size = size(*file);
            choose::Candidate { pose, bytes: size, kind: (&entries[*entry].lens).into() }
        })
        .collect();
    let kept = choose::best(&candidates, limits.photos_max);
    let left_out: Vec<&str> =
        (0..all.len()).filter(|i| !kept.contains(i)).map(|i| sent[all[i].1]).collect();
    let why = format!(
        "left out; a scene takes {} of these {} photos: those that see most from different places, \
         then the sharpest; `cameras` lists them",
        limits.photos_max,
        all.len()
    );
    let names = left_out.iter().copied();
    warnings.extend(told(WarningCode::PhotosUnused, left_out.len(), &why, names));
    Ok((kept.into_iter().map(|i| all[i]).collect(), warnings))
}

/// Refuses cameras that all stand at one place: they see no depth.
fn check_places(poses: &[CameraToWorld]) -> Result<()> {
    let first = poses[0].center();
    let spread = poses.iter().map(|p| p.center().distance(first)).fold(0.0, f64::max);
    let reach = poses.iter().map(|p| p.center().length()).fold(0.0, f64::max);
    // Twelve digits is what a pose in JSON carries beside an origin that far away.
    let bound = (reach * 1e-12).max(f64::MIN_POSITIVE);
    if spread <= bound {
        let DVec3 { x, y, z } = first;
        return Err(Error::invalid(format!(
            "all {} cameras stand at one place ({x}, {y}, {z}); depth needs a baseline over 0",
            poses.len()
        )));
    }
    Ok(())
}
