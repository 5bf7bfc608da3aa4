//! Photos in: what `formats` finds in an upload or a folder is decoded into [`PosedPhoto`]s.
//!
//! Photos of a lens become photos of a pinhole camera, intrinsics those of the size of the photo.
//! Faults in headers are refused before a pixel is decoded. Pixels are taken as stored: EXIF
//! orientation is ignored, as COLMAP ignores it.

mod decode;
mod undistort;

use std::{ops::Range, path::Path, sync::atomic::AtomicBool};

use rayon::prelude::*;

use self::decode::Header;
pub use crate::scene::{Upload, UploadCameras, UploadFile};
use crate::{
    error::Result,
    formats::captures::{FoundPhoto, FoundPhotos, LensAtSize, find, find_in_dir},
    limits::Limits,
    photo_label as label,
    scene::{Camera, Photo, PosedPhoto, Warning, WarningCode, unless_cancelled},
};

/// Photos of the largest size that are decoded at the same time, some 7 bytes a pixel each.
const DECODED_TOGETHER: u64 = 2;

/// Share of its pixels that a photo keeps when the distortion of a real lens is removed, 0 to 1.
const LENS_LEAVES_MIN: f64 = 0.5;

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
    decoded(&find(upload, limits)?, limits, cancel)
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
    let (found, cameras) = find_in_dir(dir, limits)?;
    let read = decoded(&found, limits, cancel)?;
    let file = |of: FoundPhoto<'_>| UploadFile { name: of.path, bytes: of.bytes.into_owned() };
    let photos = found.photos.into_iter().map(file).chain(cameras).collect();
    Ok((read, Upload { photos, ..Upload::default() }))
}

/// The photos of a scene whose headers are read, and whose pixels are not.
struct Undecoded<'f, 'a> {
    found: &'f [FoundPhoto<'a>],
    /// Name in messages, header and lens of each.
    headers: Vec<(String, Header, LensAtSize)>,
    /// Longer side at which they are kept.
    side_max: u32,
}

impl<'f, 'a> Undecoded<'f, 'a> {
    fn new(found: &'f FoundPhotos<'a>, limits: &Limits) -> Result<Self> {
        let found = &found.photos[..];
        let header = |(i, photo): (usize, &FoundPhoto<'_>)| {
            let label = label(i, &photo.named);
            let header = decode::header(&photo.bytes, &label, limits)?;
            let lens = photo.lens.at_size(header.width, header.height, &label)?;
            Ok((label, header, lens))
        };
        let headers: Vec<_> = found.iter().enumerate().map(header).collect::<Result<_>>()?;
        let sizes: Vec<[u32; 2]> = headers.iter().map(|(_, header, _)| header.size()).collect();
        Ok(Self { found, side_max: side_kept(&sizes, limits), headers })
    }

    fn sizes(&self) -> Vec<[u32; 2]> {
        self.headers.iter().map(|(_, header, _)| header.size()).collect()
    }

    /// A photo, reduced and without the distortion of its lens, and the share of its pixels that
    /// the lens left, 0 to 1.
    fn read(&self, i: usize, limits: &Limits) -> Result<(PosedPhoto, f64)> {
        let (found, (label, header, lens)) = (&self.found[i], &self.headers[i]);
        let photo = decode::pixels(&found.bytes, header, label, limits)?;
        // The lens after the size: its terms are of rays, not of pixels.
        let (photo, intrinsics) = decode::at_most(photo, lens.intrinsics, self.side_max);
        let before = valid_pixels(&photo).max(1);
        let photo = undistort::undistort(photo, lens, intrinsics);
        let left = valid_pixels(&photo) as f64 / before as f64;
        let photo = PosedPhoto {
            file: found.name.clone(),
            photo,
            camera: Camera { intrinsics, camera_to_world: found.pose },
            intrinsics_made_for: lens.made_for,
        };
        Ok((photo, left))
    }

    /// Whether [`Self::read`] gives the pixels of the file as they are.
    fn is_as_sent(&self, i: usize) -> bool {
        let (_, header, lens) = &self.headers[i];
        header.width.max(header.height) <= self.side_max && lens.terms.is_none()
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
    let found = find(upload, limits)?;
    let photos = Undecoded::new(&found, limits)?;
    for (i, photo) in found.photos.iter().enumerate() {
        let (file, camera_to_world) = (photo.name.as_str(), photo.pose);
        if photos.is_as_sent(i) {
            let camera = Camera { intrinsics: photos.headers[i].2.intrinsics, camera_to_world };
            see(SentPhoto { file, camera, pixels: SentPixels::File(&photo.bytes) })?;
        } else {
            let (PosedPhoto { photo, camera, .. }, _) = photos.read(i, limits)?;
            see(SentPhoto { file, camera, pixels: SentPixels::Made(photo) })?;
        }
    }
    Ok(())
}

/// Decodes the photos, a few at a time, and removes the distortion of their lenses.
fn decoded(found: &FoundPhotos<'_>, limits: &Limits, cancel: &AtomicBool) -> Result<ReadPhotos> {
    let undecoded = Undecoded::new(found, limits)?;
    let read = |i: usize| {
        unless_cancelled(cancel)?;
        undecoded.read(i, limits)
    };
    let mut photos = Vec::with_capacity(found.photos.len());
    let mut left = Vec::with_capacity(found.photos.len());
    for together in decoded_together(&undecoded.sizes(), limits.photo_pixels_max) {
        let some: Vec<Result<(PosedPhoto, f64)>> = together.into_par_iter().map(read).collect();
        for photo in some {
            let (photo, share) = photo?;
            photos.push(photo);
            left.push(share);
        }
    }
    let warnings = found.warnings.iter().cloned().chain(little_left(&photos, &left)).collect();
    Ok(ReadPhotos { photos, warnings })
}

fn valid_pixels(photo: &Photo) -> usize {
    match &photo.valid {
        Some(valid) => valid.iter().filter(|valid| **valid).count(),
        None => photo.rgb.len() / 3,
    }
}

/// The warning of photos of which their lens leaves less than [`LENS_LEAVES_MIN`].
fn little_left(photos: &[PosedPhoto], left: &[f64]) -> Option<Warning> {
    let little = || (0..left.len()).filter(|&i| left[i] < LENS_LEAVES_MIN);
    let worst = little().min_by(|&a, &b| left[a].total_cmp(&left[b]))?;
    let (percent, least) = (left[worst] * 100.0, LENS_LEAVES_MIN * 100.0);
    let others = match little().count() - 1 {
        0 => String::new(),
        n => format!(", of {n} more photos also less than {least} %"),
    };
    let message = format!(
        "{}: the distortion of its lens leaves {percent:.0} % of the pixels{others}; check k1 to \
         k6, p1 and p2",
        label(worst, &photos[worst].file)
    );
    Some(Warning { code: WarningCode::LensLeavesLittle, message, value: left[worst] })
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
