//! Photos in: camera JSON and photo files, or a capture of any known layout, become
//! [`PosedPhoto`]s.
//!
//! Only this module converts conventions: the axes and units of each layout to OpenCV cameras in
//! the world of the upload, photos of a lens to photos of a pinhole camera, intrinsics to the size
//! of the photo. Faults in names, numbers and headers are refused before a pixel is decoded. Pixels
//! are taken as stored: EXIF orientation is ignored, as COLMAP ignores it.
//!
//! Photos sent beside a camera JSON each need a camera, but the JSON may describe more cameras than
//! photos were sent. A capture (a folder, an archive, or files of a form that describe their
//! cameras themselves) is recognised by its files; cameras without photo and photos without camera
//! are warned of by name. Of more photos than a scene takes, the best are chosen.

mod cameras;
mod choose;
mod decode;
mod folder;
mod layouts;
mod lens;
mod names;
pub mod npy;

use std::{
    borrow::Cow,
    collections::{HashMap, HashSet},
    ops::Range,
    path::Path,
    sync::atomic::AtomicBool,
};

use glam::DVec3;
use rayon::prelude::*;

pub use crate::scene::{Upload, UploadCameras, UploadFile};
use crate::{
    error::{Error, Result},
    limits::Limits,
    photo_label as label,
    scene::{Camera, CameraToWorld, Photo, PosedPhoto, Warning, WarningCode, unless_cancelled},
};
use cameras::{CameraEntry, Cameras};
use decode::Header;
use folder::Folder;
use lens::LensAtSize;

/// Photos of the largest size that are decoded at the same time, some 7 bytes a pixel each.
const DECODED_TOGETHER: u64 = 2;
/// Files that one message names.
const NAMED_MAX: usize = 4;
/// Names of folders with the photos of cameras, where several have photos of these names: programs
/// put smaller, larger and cut copies beside them.
const PHOTO_FOLDERS: [&str; 5] = ["images", "resized_images", "rgb", "input", "blended_images"];
/// Why photos are left out that a camera file keeps for tests.
const KEPT_OUT: &str = "kept for tests, or marked as bad, by the capture; left out";
/// The list of `ScanNet++` of the photos that are kept for tests.
const TEST_LIST: &str = "train_test_lists.json";

/// The photos of an upload with their cameras.
#[derive(Clone, Debug)]
pub struct ReadPhotos {
    /// The photos, in the order of the cameras.
    pub photos: Vec<PosedPhoto>,
    /// What of the upload was not used or not there.
    pub warnings: Vec<Warning>,
}

/// Reads an upload into photos with cameras, in the order of the cameras.
///
/// An archive is unpacked in memory under the limits. See the module for what is converted.
///
/// # Errors
/// `invalid_request` for missing, surplus or impossible cameras, `photo_unreadable` for files that
/// are not what they claim, `limit_exceeded`; each names photo, value and bound.
pub fn read(upload: &Upload, limits: &Limits) -> Result<Vec<PosedPhoto>> {
    read_until(upload, limits, &AtomicBool::new(false)).map(|read| read.photos)
}

/// As [`read`], with its warnings; stops before the next photo once `cancel` is true.
///
/// # Errors
/// As [`read`]; `cancelled`.
pub fn read_until(upload: &Upload, limits: &Limits, cancel: &AtomicBool) -> Result<ReadPhotos> {
    let found = found_in(upload, limits)?;
    decoded(&found, limits, cancel)
}

/// The photos of an upload, by what it holds.
fn found_in<'a>(upload: &'a Upload, limits: &'a Limits) -> Result<Found<'a>> {
    let total = upload.size_bytes();
    if total > limits.upload_bytes_max {
        return Err(Error::limit("upload bytes", total, limits.upload_bytes_max));
    }
    match (&upload.archive, &upload.cameras) {
        (Some(_), cameras) if !upload.photos.is_empty() || cameras.is_some() => {
            Err(Error::invalid("send either an archive or camera JSON and photos, not both"))
        }
        (Some(archive), _) => of_folder(&Folder::of_archive(archive, limits)?, limits),
        (None, Some(cameras)) => of_form(cameras, &upload.photos, limits),
        (None, None) if upload.photos.iter().all(|file| names::is_photo(&file.name)) => {
            Err(Error::invalid(
                "upload: no camera description; send a part named transforms or cameras, the \
                 camera files of a capture, or an archive with them",
            ))
        }
        (None, None) => of_folder(&Folder::of_form(&upload.photos, limits)?, limits),
    }
}

/// Reads a folder with a capture of any known layout.
///
/// # Errors
/// As [`read`]; also `invalid_request` where the folder has no layout that is known.
pub fn read_dir(dir: &Path, limits: &Limits) -> Result<Vec<PosedPhoto>> {
    read_dir_until(dir, limits, &AtomicBool::new(false)).map(|(read, _)| read.photos)
}

/// As [`read_dir`], with its warnings, and the files that were read as an upload: the photos in
/// their order, then the files of cameras.
///
/// # Errors
/// As [`read_dir`]; `cancelled`.
pub fn read_dir_until(
    dir: &Path,
    limits: &Limits,
    cancel: &AtomicBool,
) -> Result<(ReadPhotos, Upload)> {
    let folder = Folder::of_dir(dir, limits)?;
    let found = of_folder(&folder, limits)?;
    let read = decoded(&found, limits, cancel)?;
    let photos = found.taken.into_iter().map(|taken| (taken.path, taken.bytes.into_owned()));
    let files = photos.chain(folder.into_cameras_read());
    let photos = files.map(|(name, bytes)| UploadFile { name, bytes }).collect();
    Ok((read, Upload { photos, ..Upload::default() }))
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
struct Taken<'a> {
    /// The photo as the scene calls it.
    name: String,
    /// The photo as the folder calls it.
    path: String,
    entry: CameraEntry,
    pose: CameraToWorld,
    bytes: Cow<'a, [u8]>,
}

/// The photos that make the scene, not decoded.
struct Found<'a> {
    taken: Vec<Taken<'a>>,
    warnings: Vec<Warning>,
}

/// The photos of a form whose cameras are one JSON part.
fn of_form<'a>(
    cameras: &UploadCameras,
    files: &'a [UploadFile],
    limits: &Limits,
) -> Result<Found<'a>> {
    check_count(files.len(), limits)?;
    let Cameras { entries, held_out } = match cameras {
        UploadCameras::Transforms(json) => {
            limits.check_json("transforms", json)?;
            cameras::transforms(json)?
        }
        UploadCameras::Cameras(json) => {
            limits.check_json("cameras", json)?;
            cameras::cameras(json)?
        }
    };
    names::paths(files, limits)?;
    let sent: Vec<&str> = files.iter().map(|file| file.name.as_str()).collect();
    let (pairs, _) = paired(&entries, &sent)?;
    let used: HashSet<usize> = pairs.iter().map(|(_, file)| *file).collect();
    let held: HashSet<&str> = held_out.iter().map(|file| names::file_name(file)).collect();
    let is_held = |i: &usize| held.contains(names::file_name(sent[*i]));
    let (kept_out, lone): (Vec<usize>, Vec<usize>) =
        (0..files.len()).filter(|i| !used.contains(i)).partition(is_held);
    if let Some(&i) = lone.first() {
        return Err(Error::invalid(format!(
            "{}: no camera has this file; the camera file names {} others",
            label(i, &files[i].name),
            entries.len()
        )));
    }
    let size = |file: usize| files[file].bytes.len() as u64;
    let mut warnings: Vec<Warning> = told(
        WarningCode::PhotosUnused,
        kept_out.len(),
        KEPT_OUT,
        kept_out.iter().map(|i| sent[*i]),
    )
    .into_iter()
    .collect();
    let (chosen, warning) = chosen(&entries, pairs, &sent, size, limits)?;
    warnings.extend(warning);
    let taken = chosen.into_iter().map(|(entry, file, pose)| {
        let UploadFile { name, bytes } = &files[file];
        let entry = entries[entry].clone();
        Taken { name: name.clone(), path: name.clone(), entry, pose, bytes: bytes.into() }
    });
    Ok(Found { taken: taken.collect(), warnings })
}

/// The photos of a capture.
fn of_folder<'a>(folder: &Folder<'a>, limits: &Limits) -> Result<Found<'a>> {
    let described = layouts::read(folder)?;
    let Cameras { mut entries, mut held_out } = described.cameras;
    let listed = test_list(folder)?;
    entries.retain(|entry| {
        let kept = !listed.contains(names::file_name(&entry.file));
        if !kept {
            held_out.push(entry.file.clone());
        }
        kept
    });
    if entries.len() > limits.archive_entries_max {
        let what = format!("{}: cameras", folder.what);
        return Err(Error::limit(what, entries.len(), limits.archive_entries_max));
    }
    let place = photo_folder(folder, &described.root, &entries)?;
    let inside = |path: &'_ str| -> Option<String> {
        let rest =
            if place.is_empty() { path } else { path.strip_prefix(&place)?.strip_prefix('/')? };
        names::is_photo(rest).then(|| rest.to_owned())
    };
    let sent: Vec<String> = folder.paths().filter_map(inside).collect();
    let sent: Vec<&str> = sent.iter().map(String::as_str).collect();
    let (pairs, missing) = paired(&entries, &sent)?;
    if pairs.is_empty() {
        let first = entries.first().map_or("", |entry| entry.file.as_str());
        return Err(Error::invalid(format!(
            "{}: none of the {} cameras has its photo; the first is {first:?}",
            folder.what,
            entries.len()
        )));
    }
    check_count(pairs.len(), limits)?;
    let mut warnings = Vec::new();
    let unused = without_camera(&sent, &pairs, &held_out);
    warnings.extend(told(
        WarningCode::PhotosMissing,
        missing.len(),
        "a camera, but no such photo; left out",
        missing.iter().map(|i| entries[*i].file.as_str()),
    ));
    warnings.extend(told(
        WarningCode::PhotosUnused,
        unused.len(),
        "no camera; left out",
        unused.iter().copied(),
    ));
    warnings.extend(told(
        WarningCode::PhotosUnused,
        held_out.len(),
        KEPT_OUT,
        held_out.iter().map(String::as_str),
    ));
    let size = |file: usize| folder.size(&names::join(&place, sent[file]));
    let (chosen, warning) = chosen(&entries, pairs, &sent, size, limits)?;
    warnings.extend(warning);
    let take = |(entry, file, pose): (usize, usize, CameraToWorld)| {
        let (name, path) = (sent[file].to_owned(), names::join(&place, sent[file]));
        let bytes = folder.read(&path)?;
        Ok(Taken { name, path, entry: entries[entry].clone(), pose, bytes })
    };
    let taken = chosen.into_iter().map(take).collect::<Result<_>>()?;
    Ok(Found { taken, warnings })
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

/// The folder under which most cameras have their photos, by path with or without its extension.
///
/// # Errors
/// `invalid_request` where two folders are equally good.
fn photo_folder(folder: &Folder<'_>, root: &str, entries: &[CameraEntry]) -> Result<String> {
    let wanted: HashSet<String> = entries.iter().map(|entry| names::tail(&entry.file)).collect();
    let mut counts: HashMap<&str, usize> = HashMap::new();
    for path in folder.paths() {
        let Some(stem) = names::stem(path) else { continue };
        let starts = path.match_indices('/').map(|(at, _)| at + 1);
        for start in std::iter::once(0).chain(starts) {
            if wanted.contains(&path[start..])
                || stem.get(start..).is_some_and(|s| wanted.contains(s))
            {
                *counts.entry(path[..start].trim_end_matches('/')).or_default() += 1;
            }
        }
    }
    let near = |place: &str| {
        let parts = |path: &str| path.split('/').map(str::to_owned).collect::<Vec<_>>();
        parts(place).iter().zip(parts(root)).take_while(|(a, b)| *a == b).count()
    };
    let known = |place: &str| {
        let last = names::file_name(place);
        PHOTO_FOLDERS.len()
            - PHOTO_FOLDERS.iter().position(|p| *p == last).unwrap_or(PHOTO_FOLDERS.len())
    };
    let rank = |place: &str, count: usize| (count, place == root, near(place), known(place));
    let mut ranked: Vec<_> = counts.iter().map(|(p, count)| (rank(p, *count), *p)).collect();
    ranked.sort_unstable_by(|a, b| b.cmp(a));
    match ranked[..] {
        [] => Ok(root.to_owned()),
        [(first, a), (second, b), ..] if first == second => Err(Error::invalid(format!(
            "{}: the cameras have photos in {a:?} and in {b:?}; send one of them",
            folder.what
        ))),
        [(_, place), ..] => Ok(place.to_owned()),
    }
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

/// The places of a camera and of its photo.
type Pair = (usize, usize);

/// Cameras with the photo of each, and cameras without one.
fn paired(entries: &[CameraEntry], sent: &[&str]) -> Result<(Vec<Pair>, Vec<usize>)> {
    let wanted: Vec<&str> = entries.iter().map(|entry| entry.file.as_str()).collect();
    let files = names::matched(&wanted, sent)?;
    let pairs = files.iter().enumerate().filter_map(|(i, file)| Some((i, (*file)?))).collect();
    let missing = (0..files.len()).filter(|i| files[*i].is_none()).collect();
    Ok((pairs, missing))
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
) -> Result<(Chosen, Option<Warning>)> {
    let pose =
        |(i, (entry, _)): (usize, &Pair)| entries[*entry].pose(&label(i, &entries[*entry].file));
    let poses: Vec<CameraToWorld> = pairs.iter().enumerate().map(pose).collect::<Result<_>>()?;
    check_places(&poses)?;
    let all = pairs.into_iter().zip(&poses).map(|((entry, file), pose)| (entry, file, *pose));
    if poses.len() <= limits.photos_max {
        return Ok((all.collect(), None));
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
    let warning = told(WarningCode::PhotosUnused, left_out.len(), &why, names);
    Ok((kept.into_iter().map(|i| all[i]).collect(), warning))
}

/// The photos of a scene whose headers are read, and whose pixels are not.
struct Undecoded<'f, 'a> {
    taken: &'f [Taken<'a>],
    /// Name in messages, header and lens of each.
    headers: Vec<(String, Header, LensAtSize)>,
    /// Longer side at which they are kept.
    side_max: u32,
}

impl<'f, 'a> Undecoded<'f, 'a> {
    fn new(found: &'f Found<'a>, limits: &Limits) -> Result<Self> {
        let taken = &found.taken[..];
        let header = |(i, taken): (usize, &Taken<'_>)| {
            let label = label(i, &taken.entry.file);
            let header = decode::header(&taken.bytes, &label, limits)?;
            let lens = taken.entry.lens.at_size(header.width, header.height, &label)?;
            Ok((label, header, lens))
        };
        let headers: Vec<_> = taken.iter().enumerate().map(header).collect::<Result<_>>()?;
        let sizes: Vec<[u32; 2]> = headers.iter().map(|(_, header, _)| header.size()).collect();
        Ok(Self { taken, side_max: side_kept(&sizes, limits), headers })
    }

    fn sizes(&self) -> Vec<[u32; 2]> {
        self.headers.iter().map(|(_, header, _)| header.size()).collect()
    }

    /// A photo, reduced and without the distortion of its lens.
    fn read(&self, i: usize, limits: &Limits) -> Result<PosedPhoto> {
        let (taken, (label, header, lens)) = (&self.taken[i], &self.headers[i]);
        let photo = decode::pixels(&taken.bytes, header, label, limits)?;
        // The lens after the size: its terms are of rays, not of pixels.
        let (photo, intrinsics) = decode::at_most(photo, lens.intrinsics, self.side_max);
        let photo = lens::undistort(photo, &lens.of_smaller(intrinsics));
        Ok(PosedPhoto {
            file: taken.name.clone(),
            photo,
            camera: Camera { intrinsics, camera_to_world: taken.pose },
            intrinsics_made_for: lens.made_for,
        })
    }

    /// Whether [`Self::read`] gives the pixels of the file as they are.
    fn is_as_sent(&self, i: usize) -> bool {
        let (_, header, lens) = &self.headers[i];
        header.width.max(header.height) <= self.side_max && !lens.is_bent()
    }
}

/// A photo of an upload as its scene has it.
#[derive(Debug)]
pub struct SentPhoto<'a> {
    /// File name as uploaded.
    pub file: &'a str,
    /// Camera of the pixels.
    pub camera: Camera,
    /// The pixels.
    pub pixels: SentPixels<'a>,
}

/// The pixels of a photo of an upload.
#[derive(Debug)]
pub enum SentPixels<'a> {
    /// The file: its pixels are those of the scene.
    File(&'a [u8]),
    /// Reduced, or without the distortion of the lens.
    Made(Photo),
}

/// Hands on the photos of an upload in the order of the cameras, one at a time. What need not be
/// decoded is not.
///
/// # Errors
/// As [`read`], and those of `see`.
pub fn each(
    upload: &Upload,
    limits: &Limits,
    mut see: impl FnMut(SentPhoto<'_>) -> Result<()>,
) -> Result<()> {
    let found = found_in(upload, limits)?;
    let photos = Undecoded::new(&found, limits)?;
    for (i, taken) in found.taken.iter().enumerate() {
        let (file, camera_to_world) = (taken.name.as_str(), taken.pose);
        if photos.is_as_sent(i) {
            let camera = Camera { intrinsics: photos.headers[i].2.intrinsics, camera_to_world };
            see(SentPhoto { file, camera, pixels: SentPixels::File(&taken.bytes) })?;
        } else {
            let PosedPhoto { photo, camera, .. } = photos.read(i, limits)?;
            see(SentPhoto { file, camera, pixels: SentPixels::Made(photo) })?;
        }
    }
    Ok(())
}

/// Decodes the photos, a few at a time, and removes the distortion of their lenses.
fn decoded(found: &Found<'_>, limits: &Limits, cancel: &AtomicBool) -> Result<ReadPhotos> {
    let undecoded = Undecoded::new(found, limits)?;
    let read = |i: usize| {
        unless_cancelled(cancel)?;
        undecoded.read(i, limits)
    };
    let mut photos = Vec::with_capacity(found.taken.len());
    for together in decoded_together(&undecoded.sizes(), limits.photo_pixels_max) {
        let some: Vec<Result<PosedPhoto>> = together.into_par_iter().map(read).collect();
        for photo in some {
            photos.push(photo?);
        }
    }
    Ok(ReadPhotos { photos, warnings: found.warnings.clone() })
}

/// Longer side at which the photos of a scene are kept, so that all of them fit the limits.
fn side_kept(sizes: &[[u32; 2]], limits: &Limits) -> u32 {
    let side_max = f64::from(limits.photo_side_kept_max);
    let pixels = |side: f64| -> f64 {
        let of = |&[w, h]: &[u32; 2]| {
            let share = (side / f64::from(w.max(h))).min(1.0);
            f64::from(w) * f64::from(h) * share * share
        };
        sizes.iter().map(of).sum()
    };
    let most = limits.photos_pixels_kept_max as f64;
    let (mut fits, mut over) = (1.0, side_max);
    if pixels(side_max) <= most {
        return limits.photo_side_kept_max;
    }
    // Photos of one scene may differ in size, so no formula gives it.
    while over - fits >= 1.0 {
        let middle = 0.5 * (fits + over);
        if pixels(middle) <= most { fits = middle } else { over = middle }
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "1 to a u32")]
    let side = fits as u32;
    side
}

/// Photos one after another in groups that are decoded side by side: the pixels of a group are at
/// most [`DECODED_TOGETHER`] of the largest photos that may come.
fn decoded_together(sizes: &[[u32; 2]], photo_pixels_max: u64) -> Vec<Range<usize>> {
    let (mut groups, mut begun, mut pixels): (Vec<Range<usize>>, usize, u64) = (Vec::new(), 0, 0);
    for (i, [w, h]) in sizes.iter().enumerate() {
        let own = u64::from(*w) * u64::from(*h);
        if i > begun && pixels + own > DECODED_TOGETHER.saturating_mul(photo_pixels_max) {
            groups.push(begun..i);
            (begun, pixels) = (i, 0);
        }
        pixels += own;
    }
    groups.push(begun..sizes.len());
    groups
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photos_of_a_scene_are_reduced_alike_until_they_fit() {
        let limits = Limits::default();
        let kept = |sizes: &[[u32; 2]]| side_kept(sizes, &limits);
        assert_eq!(kept(&[[6_000, 4_000]; 16]), 2_048, "sixteen fit");
        assert_eq!(kept(&[[640, 480]; 64]), 2_048, "and small ones stay as they are");
        for sizes in
            [vec![[6_000, 4_000]; 64], [vec![[4_000, 6_000]; 60], vec![[9, 9]; 4]].concat()]
        {
            let side = f64::from(kept(&sizes));
            let pixels = |side: f64| -> f64 {
                let share = |[w, h]: &[u32; 2]| (side / f64::from(*w.max(h))).min(1.0);
                sizes.iter().map(|s| f64::from(s[0] * s[1]) * share(s).powi(2)).sum()
            };
            let most = limits.photos_pixels_kept_max as f64;
            assert!(pixels(side) <= most && pixels(side + 2.0) > most, "{side}");
        }
        let tight = Limits { photos_pixels_kept_max: 0, ..limits };
        assert_eq!(side_kept(&[[600, 400]; 3], &tight), 1, "never 0");
    }

    #[test]
    fn no_more_than_two_of_the_largest_photos_are_decoded_together() {
        let groups = |sizes: &[[u32; 2]]| decoded_together(sizes, 100);
        assert_eq!(groups(&[[10, 10]; 5]), [0..2, 2..4, 4..5]);
        assert_eq!(groups(&[[5, 5]; 9]), [0..8, 8..9], "small ones side by side");
        assert_eq!(groups(&[[30, 30], [1, 1]]), [0..1, 1..2], "one over the bound goes alone");
    }
}
