//! Photos in: camera JSON, photo files or an archive become [`PosedPhoto`]s.
//!
//! Only this module converts conventions: OpenGL poses to OpenCV, photos of a lens to photos of a
//! pinhole camera, intrinsics to the size of the photo. Faults in names, numbers and headers are
//! refused before a pixel is decoded. Pixels are taken as stored: EXIF orientation is ignored, as
//! COLMAP ignores it.
//!
//! Photos sent one by one each need a camera, but the JSON may describe more cameras than photos
//! were sent. In a folder or an archive every camera needs its photo, and files that no camera
//! names (masks, depth maps) are left alone.

mod archive;
mod cameras;
mod decode;
mod lens;
mod names;

use std::{collections::HashSet, ops::Range, path::Path, sync::atomic::AtomicBool};

use glam::DVec3;
use rayon::prelude::*;

pub use crate::scene::{Upload, UploadCameras, UploadFile};
use crate::{
    error::{Error, Result},
    limits::Limits,
    photo_label as label,
    scene::{Camera, CameraToWorld, PosedPhoto, unless_cancelled},
};
use cameras::{CameraEntry, PoseAxes};

/// Names under which a folder or archive may hold its cameras.
pub const CAMERA_FILES: [&str; 2] = ["transforms.json", "cameras.json"];

/// Photos of the largest size that are decoded at the same time, some 7 bytes a pixel each.
const DECODED_TOGETHER: u64 = 2;

/// Reads an upload into photos with cameras, in the order of the cameras.
///
/// An archive is unpacked in memory under the limits. See the module for what is converted.
///
/// # Errors
/// `invalid_request` for missing, surplus or impossible cameras, `photo_unreadable` for files that
/// are not what they claim, `limit_exceeded`; each names photo, value and bound.
pub fn read(upload: &Upload, limits: &Limits) -> Result<Vec<PosedPhoto>> {
    read_until(upload, limits, &AtomicBool::new(false))
}

/// As [`read`]; stops before the next photo once `cancel` is true.
///
/// # Errors
/// As [`read`]; `cancelled`.
pub fn read_until(
    upload: &Upload,
    limits: &Limits,
    cancel: &AtomicBool,
) -> Result<Vec<PosedPhoto>> {
    let total = upload.size_bytes();
    if total > limits.upload_bytes_max {
        return Err(Error::limit("upload bytes", total, limits.upload_bytes_max));
    }
    match &upload.archive {
        Some(archive) => {
            if !upload.photos.is_empty() || upload.cameras.is_some() {
                return Err(Error::invalid(
                    "send either an archive or camera JSON and photos, not both",
                ));
            }
            let unpacked = archive::unpack(archive, limits)?;
            read_parts(&unpacked, limits, Every::Camera, cancel)
        }
        None => read_parts(upload, limits, Every::Photo, cancel),
    }
}

/// Reads a folder with `transforms.json` or `cameras.json` and the photos it names.
///
/// # Errors
/// As [`read`]; also `invalid_request` where the folder has no camera file.
pub fn read_dir(dir: &Path, limits: &Limits) -> Result<Vec<PosedPhoto>> {
    let never = AtomicBool::new(false);
    read_parts(&upload_of_dir(dir, limits)?, limits, Every::Camera, &never)
}

/// The camera file of a folder and the photos it names, as an upload.
///
/// # Errors
/// `invalid_request` when there is no camera file, or a photo it names is missing or outside the
/// folder.
pub fn upload_of_dir(dir: &Path, limits: &Limits) -> Result<Upload> {
    let cameras = camera_file_of_dir(dir, limits)?;
    let entries = cameras::parse(&cameras, limits)?;
    check_count(entries.len(), limits)?;
    let mut photos = Vec::with_capacity(entries.len());
    for (i, entry) in entries.iter().enumerate() {
        let relative = names::normalise(&entry.file)
            .ok_or_else(|| Error::invalid(outside(&label(i, &entry.file))))?;
        let found = names::with_extensions(&relative).find(|name| dir.join(name).is_file());
        let name = found.ok_or_else(|| {
            Error::invalid(format!("{}: no such file in the folder", label(i, &entry.file)))
        })?;
        let bytes = fs_err::read(dir.join(&name)).map_err(|e| {
            Error::photo(format!("{}: cannot be read", label(i, &entry.file))).caused_by(e)
        })?;
        photos.push(UploadFile { name, bytes });
    }
    Ok(Upload { cameras: Some(cameras), photos, ..Upload::default() })
}

fn camera_file_of_dir(dir: &Path, limits: &Limits) -> Result<UploadCameras> {
    for name in CAMERA_FILES {
        let path = dir.join(name);
        let Ok(meta) = fs_err::metadata(&path) else { continue };
        let (size, max) = (meta.len(), limits.json_bytes_max);
        if size > max as u64 {
            return Err(Error::limit(format!("{name}: bytes"), size, max));
        }
        let bytes = fs_err::read(&path)
            .map_err(|e| Error::invalid(format!("{name}: cannot be read")).caused_by(e))?;
        return Ok(cameras_named(name, bytes));
    }
    Err(Error::invalid("the folder has no transforms.json and no cameras.json"))
}

fn cameras_named(name: &str, bytes: Vec<u8>) -> UploadCameras {
    if name == CAMERA_FILES[0] {
        UploadCameras::Transforms(bytes)
    } else {
        UploadCameras::Cameras(bytes)
    }
}

fn check_count(photos: usize, limits: &Limits) -> Result<()> {
    match photos {
        0 => Err(Error::invalid(format!(
            "no photos; a scene needs {} to {}",
            limits.photos_min, limits.photos_max
        ))),
        n if n < limits.photos_min => Err(Error::invalid(format!(
            "{n} photo; a scene needs at least {} to see depth",
            limits.photos_min
        ))),
        n if n > limits.photos_max => Err(Error::limit("photos", n, limits.photos_max)),
        _ => Ok(()),
    }
}

fn outside(what: &str) -> String {
    format!("{what}: the path must be relative and stay inside the folder")
}

/// What must find its partner: loose photos their camera, cameras of a folder their photo.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Every {
    Photo,
    Camera,
}

/// A camera and the file it belongs to, before the pixels are touched.
struct Paired<'a> {
    entry: &'a CameraEntry,
    file: &'a UploadFile,
    label: String,
}

fn read_parts(
    upload: &Upload,
    limits: &Limits,
    every: Every,
    cancel: &AtomicBool,
) -> Result<Vec<PosedPhoto>> {
    if every == Every::Photo {
        check_count(upload.photos.len(), limits)?;
    }
    let cameras = upload.cameras.as_ref().ok_or_else(|| {
        Error::invalid("no cameras: send a `transforms` or `cameras` part, or an archive with one")
    })?;
    let entries = cameras::parse(cameras, limits)?;
    let paired = pair(&entries, &upload.photos, limits, every)?;
    check_count(paired.len(), limits)?;
    let poses: Vec<CameraToWorld> = paired
        .iter()
        .map(|p| match p.entry.axes {
            PoseAxes::OpenGl => CameraToWorld::from_opengl_row_major(&p.entry.pose()?, &p.label),
            PoseAxes::OpenCv => CameraToWorld::from_row_major(&p.entry.pose()?, &p.label),
        })
        .collect::<Result<_>>()?;
    check_places(&poses)?;
    let mut headers = Vec::with_capacity(paired.len());
    for p in &paired {
        let header = decode::header(&p.file.bytes, &p.label, limits)?;
        let lens = p.entry.lens.at_size(header.width, header.height, &p.label)?;
        headers.push((header, lens));
    }
    let sizes: Vec<[u32; 2]> = headers.iter().map(|(header, _)| header.size()).collect();
    let side_max = side_kept(&sizes, limits);
    let read = |i: usize| {
        unless_cancelled(cancel)?;
        let (p, (header, lens)) = (&paired[i], &headers[i]);
        let photo = decode::pixels(&p.file.bytes, header, &p.label, limits)?;
        // The lens after the size: its terms are of rays, not of pixels.
        let (photo, intrinsics) = decode::at_most(photo, lens.intrinsics, side_max);
        let photo = lens::undistort(photo, &lens.of_smaller(intrinsics));
        Ok(PosedPhoto {
            file: p.file.name.clone(),
            photo,
            camera: Camera { intrinsics, camera_to_world: poses[i] },
            intrinsics_made_for: lens.made_for,
        })
    };
    let mut photos = Vec::with_capacity(paired.len());
    for together in decoded_together(&sizes, limits.photo_pixels_max) {
        let some: Vec<Result<PosedPhoto>> = together.into_par_iter().map(read).collect();
        for photo in some {
            photos.push(photo?);
        }
    }
    Ok(photos)
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

fn pair<'a>(
    entries: &'a [CameraEntry],
    files: &'a [UploadFile],
    limits: &Limits,
    every: Every,
) -> Result<Vec<Paired<'a>>> {
    let mut seen = HashSet::new();
    for (i, file) in files.iter().enumerate() {
        if file.name.len() > limits.file_name_bytes_max {
            let what = format!("{}: bytes of the file name", label(i, &file.name));
            return Err(Error::limit(what, file.name.len(), limits.file_name_bytes_max));
        }
        if names::normalise(&file.name).is_none() {
            return Err(Error::invalid(outside(&label(i, &file.name))));
        }
        if !seen.insert(file.name.as_str()) {
            return Err(Error::invalid(format!(
                "{}: two photos have this name; send paths as in the camera file",
                label(i, &file.name)
            )));
        }
    }
    let wanted: Vec<&str> = entries.iter().map(|e| e.file.as_str()).collect();
    let sent: Vec<&str> = files.iter().map(|f| f.name.as_str()).collect();
    let file_of_entry = names::matched(&wanted, &sent)?;
    if every == Every::Photo {
        let used: HashSet<usize> = file_of_entry.iter().flatten().copied().collect();
        if let Some(i) = (0..files.len()).find(|i| !used.contains(i)) {
            return Err(Error::invalid(format!(
                "{}: no camera has this file; the camera file names {} others",
                label(i, &files[i].name),
                entries.len()
            )));
        }
    }
    let mut paired = Vec::with_capacity(files.len());
    for (i, (entry, found)) in entries.iter().zip(file_of_entry).enumerate() {
        match found {
            Some(at) => {
                let label = label(paired.len(), &entry.file);
                paired.push(Paired { entry, file: &files[at], label });
            }
            None if every == Every::Camera => {
                let what = label(i, &entry.file);
                return Err(Error::invalid(format!("{what}: a camera, but no such photo")));
            }
            None => {}
        }
    }
    Ok(paired)
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
