//! Photos in: what `formats` finds in an upload or a folder is decoded into [`PosedPhoto`]s.
//!
//! Photos of a lens become photos of a pinhole camera, intrinsics those of the size of the photo.
//! Faults in headers are refused before a pixel is decoded. Pixels are taken as stored, as COLMAP
//! takes them, but where the cameras are those of the photos that EXIF turns (`turns`). What a
//! mask leaves out is not valid.

mod decode;
mod exif;
mod kinds;
mod mask;
mod room;
mod turns;
mod undistort;
mod unposed;

use std::{
    borrow::Cow,
    collections::BTreeMap,
    path::Path,
    sync::atomic::{AtomicBool, AtomicU64, Ordering},
};

use image::metadata::Orientation;
use rayon::prelude::*;

pub use self::unposed::{ReadUnposed, posed};
use self::{
    decode::Header,
    room::{decoded_together, side_kept},
    turns::{SIDE_COMPARED, Way},
};
pub use crate::scene::{Upload, UploadCameras, UploadFile};
use crate::{
    error::{Result, short},
    formats::captures::{
        FoundMask, FoundPhoto, FoundPhotos, FoundUnposed, LensAtSize, find, find_in_dir,
        find_unposed, find_unposed_in_dir,
    },
    limits::Limits,
    photo_label as label,
    scene::{
        Camera, CamerasMode, CamerasReport, LengthUnit, Photo, PosedPhoto, SceneCamera,
        SolvedCamera, Warning, WarningCode, unless_cancelled,
    },
};

/// Share of a photo that undoing a lens may leave without source.
const LENS_TAKES_MAX: f64 = 0.5;

/// The photos of an upload with their cameras.
#[derive(Clone, Debug)]
pub struct ReadPhotos {
    /// The photos, in the order of the cameras.
    pub photos: Vec<PosedPhoto>,
    /// What of the upload was not used or not there.
    pub warnings: Vec<Warning>,
    /// What a unit of the cameras is.
    pub unit: LengthUnit,
}

/// Reads an upload into photos with cameras, in the order of the cameras.
///
/// An archive is unpacked a file at a time under the limits. See the module for what is converted.
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
    let (mut photos, mut masks) = (Vec::new(), BTreeMap::new());
    for of in found.photos.into_iter().chain(found.more) {
        photos.push(UploadFile { name: of.path, bytes: of.bytes.read()?.into_owned() });
        // Several photos may have one mask.
        put_mask(&mut masks, of.mask)?;
    }
    let masks = masks.into_iter().map(|(name, bytes)| UploadFile { name, bytes });
    photos.extend(cameras.into_iter().chain(masks));
    Ok((read, Upload { photos, ..Upload::default() }))
}

fn put_mask(masks: &mut BTreeMap<String, Vec<u8>>, mask: Option<FoundMask<'_>>) -> Result<()> {
    if let Some(mask) = mask {
        masks.insert(mask.path, mask.bytes.read()?.into_owned());
    }
    Ok(())
}

/// Reads the photos of an upload that only the steps of a refinement learn, each with its longer
/// side at most `side_max`, and hands them on in their order, a few at a time. One whose pixels
/// cannot be read is left out. Returns how many pixels were decoded: of a large JPEG fewer than it
/// has.
///
/// # Errors
/// As [`read`]; `cancelled`; those of `put`.
pub fn more(
    upload: &Upload,
    mode: CamerasMode,
    side_max: u32,
    limits: &Limits,
    cancel: &AtomicBool,
    mut put: impl FnMut(PosedPhoto) -> Result<()>,
) -> Result<u64> {
    // Those whose cameras are solved have all been seen by networks.
    if find_unposed(upload, mode, limits)?.is_some() {
        return Ok(0);
    }
    let found = find(upload, limits)?;
    if found.more.is_empty() {
        return Ok(0);
    }
    let all = AllUndecoded::new(&found, limits, cancel)?;
    let sizes: Vec<u64> = all.more.iter().map(|one| one.header.working_pixels()).collect();
    let decoded = AtomicU64::new(0);
    for together in decoded_together(&sizes, limits.photo_pixels_max) {
        let some: Vec<_> = together
            .into_par_iter()
            .map(|i| {
                unless_cancelled(cancel)?;
                let one = &all.more[i];
                Ok(one.found.bytes.read().and_then(|bytes| {
                    let header = one.header.at_least(side_max, &bytes);
                    decoded.fetch_add(header.decoded_pixels(), Ordering::Relaxed);
                    one.decoded(&header, bytes, side_max, limits)
                }))
            })
            .collect::<Result<_>>()?;
        for read in some {
            match read {
                Ok((photo, _)) => put(photo)?,
                Err(error) => tracing::warn!(reason = error.message(), "not learnt"),
            }
        }
    }
    Ok(decoded.into_inner())
}

/// The photos of an upload whose cameras are to be solved; `None` where it has cameras that count.
///
/// # Errors
/// As [`read`]; `cancelled`.
pub fn read_unposed(
    upload: &Upload,
    mode: CamerasMode,
    limits: &Limits,
    cancel: &AtomicBool,
) -> Result<Option<ReadUnposed>> {
    let found = find_unposed(upload, mode, limits)?;
    found.map(|found| unposed::decoded(&found, limits, cancel)).transpose()
}

/// As [`read_unposed`], of a folder; also the files that were read as an upload.
///
/// # Errors
/// As there.
pub fn read_unposed_dir(
    dir: &Path,
    mode: CamerasMode,
    limits: &Limits,
    cancel: &AtomicBool,
) -> Result<Option<(ReadUnposed, Upload)>> {
    let Some(found) = find_unposed_in_dir(dir, mode, limits)? else { return Ok(None) };
    let read = unposed::decoded(&found, limits, cancel)?;
    let mut masks = BTreeMap::new();
    let mut photos = Vec::with_capacity(found.photos.len());
    for file in found.photos {
        photos.push(UploadFile { name: file.name, bytes: file.bytes.read()?.into_owned() });
        put_mask(&mut masks, file.mask)?;
    }
    photos.extend(masks.into_iter().map(|(name, bytes)| UploadFile { name, bytes }));
    Ok(Some((read, Upload { photos, ..Upload::default() })))
}

/// The solved cameras of a scene by the files of their photos, as its record has them.
pub fn solved<'s>(
    cameras: &'s [SceneCamera],
    report: &'s CamerasReport,
) -> impl Iterator<Item = (&'s str, SolvedCamera)> {
    let k1 = |file: &str| report.placed.iter().find(|one| one.file == file).map_or(0.0, |p| p.k1);
    cameras.iter().map(move |of| (&*of.file, SolvedCamera { camera: of.camera, k1: k1(&of.file) }))
}

/// A photo whose header is read, and whose pixels are not.
struct Undecoded<'f, 'a> {
    found: &'f FoundPhoto<'a>,
    /// Its name in messages.
    label: String,
    header: Header,
    /// How it is turned before anything else.
    turn: Orientation,
    /// The lens of the turned photo.
    lens: LensAtSize,
}

impl<'f, 'a> Undecoded<'f, 'a> {
    fn new(
        found: &'f FoundPhoto<'a>,
        label: String,
        header: Header,
        turn: Orientation,
    ) -> Result<Self> {
        let [width, height] = header.size_after(turn);
        let lens = found.lens.at_size(width, height, &label)?;
        Ok(Self { found, label, header, turn, lens })
    }

    fn size(&self) -> [u32; 2] {
        self.header.size_after(self.turn)
    }

    /// The photo with its longer side at most `side_max`, without what its mask leaves out and
    /// without the distortion of its lens; also the shares of its pixels that these two took.
    fn read(&self, side_max: u32, limits: &Limits) -> Result<(PosedPhoto, [f64; 2])> {
        self.decoded(&self.header, self.found.bytes.read()?, side_max, limits)
    }

    /// The same of its bytes, decoded as `header` says.
    fn decoded(
        &self,
        header: &Header,
        bytes: Cow<'_, [u8]>,
        side_max: u32,
        limits: &Limits,
    ) -> Result<(PosedPhoto, [f64; 2])> {
        let (found, lens) = (self.found, &self.lens);
        let photo = decode::pixels(&bytes, header, self.turn, &self.label, limits)?;
        drop(bytes);
        let before = valid_share(&photo);
        let photo = match &found.mask {
            Some(mask) => mask::applied(photo, mask, &self.label, limits)?,
            None => photo,
        };
        let unmasked = valid_share(&photo);
        // A large JPEG is decoded smaller than its header says.
        let intrinsics = lens.intrinsics.resized(photo.width, photo.height);
        // The lens after the size: its terms are of rays, not of pixels.
        let (photo, intrinsics) = decode::at_most(photo, intrinsics, side_max);
        let reduced = valid_share(&photo);
        let photo = undistort::undistort(photo, lens, intrinsics);
        let taken = [before - unmasked, reduced - valid_share(&photo)];
        let posed = PosedPhoto {
            file: found.name.clone(),
            photo,
            camera: Camera { intrinsics, camera_to_world: found.pose },
            intrinsics_made_for: lens.made_for,
        };
        Ok((posed, taken))
    }

    /// Whether [`Self::read`] gives the pixels of the file as they are.
    fn is_as_sent(&self, side_max: u32) -> bool {
        let [width, height] = self.size();
        width.max(height) <= side_max
            && self.header.reduction == 1
            && self.turn == Orientation::NoTransforms
            && self.lens.terms.is_none()
    }
}

fn valid_share(photo: &Photo) -> f64 {
    photo.valid.as_ref().map_or(1.0, |valid| {
        valid.iter().filter(|valid| **valid).count() as f64 / valid.len().max(1) as f64
    })
}

/// The photos of a scene whose headers are read, and whose pixels are not.
struct AllUndecoded<'f, 'a> {
    /// Those that the networks see.
    photos: Vec<Undecoded<'f, 'a>>,
    /// Those that only steps learn.
    more: Vec<Undecoded<'f, 'a>>,
    /// Longer side at which they are kept.
    side_max: u32,
    /// What was done that nobody asked for.
    warnings: Vec<Warning>,
}

impl<'f, 'a> AllUndecoded<'f, 'a> {
    fn new(found: &'f FoundPhotos<'a>, limits: &Limits, cancel: &AtomicBool) -> Result<Self> {
        let with_headers = |found: &'f [FoundPhoto<'a>]| -> Result<Vec<WithHeader<'f, 'a>>> {
            found.iter().enumerate().map(|(i, found)| WithHeader::new(i, found, limits)).collect()
        };
        let (seen, more) = (with_headers(&found.photos)?, with_headers(&found.more)?);
        let photos = |all: &[WithHeader<'f, 'a>], either: bool| -> Result<Vec<Undecoded<'f, 'a>>> {
            all.iter().map(|one| one.undecoded(either)).collect()
        };
        let small = |either: bool| -> Result<Vec<PosedPhoto>> {
            let read = read_all(&photos(&seen, either)?, SIDE_COMPARED, limits, cancel)?;
            Ok(read.into_iter().map(|(photo, _)| photo).collect())
        };
        let names: Vec<&str> = found.photos.iter().map(|photo| &*photo.named).collect();
        let ways: Vec<Option<Way>> = seen.iter().map(|one| one.way).collect();
        let (either, turned) = turns::settled(&names, &ways, small, cancel)?;
        let (photos, more) = (photos(&seen, either)?, photos(&more, either)?);
        let sizes: Vec<[u32; 2]> = photos.iter().map(Undecoded::size).collect();
        let mut warnings: Vec<Warning> = turned.into_iter().collect();
        warnings.extend(large(&photos, limits));
        warnings.extend(undone_lens(&photos));
        Ok(Self { side_max: side_kept(&sizes, limits), photos, more, warnings })
    }
}

/// A photo whose header is read, and of which it is not known yet whether it is turned.
struct WithHeader<'f, 'a> {
    found: &'f FoundPhoto<'a>,
    label: String,
    header: Header,
    way: Option<Way>,
}

impl<'f, 'a> WithHeader<'f, 'a> {
    fn new(i: usize, found: &'f FoundPhoto<'a>, limits: &Limits) -> Result<Self> {
        let label = label(i, &found.named);
        let header = decode::header(&found.bytes.read()?, &label, limits)?;
        let way = turns::way(&header, &found.lens);
        Ok(Self { found, label, header, way })
    }

    /// The photo, turned where that is known, or where it may be either way and `either` is right.
    fn undecoded(&self, either: bool) -> Result<Undecoded<'f, 'a>> {
        let is_turned = self.way == Some(Way::Turned) || either && self.way == Some(Way::Either);
        let turn = if is_turned { self.header.orientation } else { Orientation::NoTransforms };
        Undecoded::new(self.found, self.label.clone(), self.header, turn)
    }
}

/// Names photos over the size up to which all formats are read.
fn large(photos: &[Undecoded<'_, '_>], limits: &Limits) -> Option<Warning> {
    let pixels = |[w, h]: [u32; 2]| u64::from(w) * u64::from(h);
    let is_large = |one: &&Undecoded<'_, '_>| pixels(one.size()) > limits.photo_pixels_max;
    let large: Vec<&Undecoded<'_, '_>> = photos.iter().filter(is_large).collect();
    let first = large.first()?;
    let [width, height] = first.size();
    let how = match first.header.reduction {
        1 => "decoded whole and reduced".to_owned(),
        by => format!("decoded at a {} of their sides", if by == 2 { "half" } else { "quarter" }),
    };
    let message = format!(
        "{}: {width}x{height} px, over {} px ({} of {} photos): {how}; no stage looks closer than \
         {} px a side",
        first.label,
        limits.photo_pixels_max,
        large.len(),
        photos.len(),
        limits.photo_side_kept_max
    );
    Some(Warning { code: WarningCode::PhotosReduced, message, value: large.len() as f64 })
}

/// Names photos whose lens bends rays and was made for about their size: undoing a lens changes the
/// size of a photo a little, so that they may be undone already.
fn undone_lens(photos: &[Undecoded<'_, '_>]) -> Option<Warning> {
    let about = |one: &&Undecoded<'_, '_>| {
        let ([width, _], Some([made_for, _])) = (one.size(), one.lens.made_for) else {
            return false;
        };
        let ratio = f64::from(width) / f64::from(made_for);
        one.lens.terms.is_some() && (0.8..1.25).contains(&ratio)
    };
    let doubtful: Vec<&Undecoded<'_, '_>> = photos.iter().filter(about).collect();
    let first = doubtful.first()?;
    let ([width, height], [w, h]) = (first.size(), first.lens.made_for?);
    let message = format!(
        "{}: its lens bends rays and is of {w}x{h} px, the photo is {width}x{height} px ({} of {} \
         photos): photos whose distortion was undone have such sizes, and cameras of their own",
        first.label,
        doubtful.len(),
        photos.len()
    );
    Some(Warning { code: WarningCode::LensDoubtful, message, value: doubtful.len() as f64 })
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

/// The cameras of a scene whose photos are handed on.
#[derive(Clone, Copy, Debug)]
pub struct KnownCameras<'s> {
    /// Whether the cameras of the upload were used.
    pub mode: CamerasMode,
    /// The cameras of the scene.
    pub cameras: &'s [SceneCamera],
    /// What is known of them.
    pub report: &'s CamerasReport,
}

/// Hands on the photos of an upload in the order of the cameras, one at a time. What need not be
/// decoded is not. Photos that came without cameras have those of `known`.
///
/// # Errors
/// As [`read`], and those of `see`.
pub fn each(
    upload: &Upload,
    known: KnownCameras<'_>,
    limits: &Limits,
    mut see: impl FnMut(SentPhoto<'_>) -> Result<()>,
) -> Result<()> {
    if let Some(found) = find_unposed(upload, known.mode, limits)? {
        return each_solved(&found, known, limits, see);
    }
    let found = find(upload, limits)?;
    let all = AllUndecoded::new(&found, limits, &AtomicBool::new(false))?;
    for one in &all.photos {
        let (file, camera_to_world) = (one.found.name.as_str(), one.found.pose);
        if one.is_as_sent(all.side_max) {
            let camera = Camera { intrinsics: one.lens.intrinsics, camera_to_world };
            let bytes = one.found.bytes.read()?;
            see(SentPhoto { file, camera, pixels: SentPixels::File(&bytes) })?;
        } else {
            let (PosedPhoto { photo, camera, .. }, _) = one.read(all.side_max, limits)?;
            see(SentPhoto { file, camera, pixels: SentPixels::Made(photo) })?;
        }
    }
    Ok(())
}

/// The photos of solved cameras, in the order of these.
fn each_solved(
    found: &FoundUnposed<'_>,
    known: KnownCameras<'_>,
    limits: &Limits,
    mut see: impl FnMut(SentPhoto<'_>) -> Result<()>,
) -> Result<()> {
    let all = unposed::Undecoded::all(found, limits)?;
    let side_max = unposed::side_of(&all, limits);
    for (name, solved) in solved(known.cameras, known.report) {
        let Some(one) = all.iter().find(|one| one.file.name == name) else { continue };
        let made = posed(one.read(side_max, limits)?, &solved);
        see(SentPhoto { file: name, camera: made.camera, pixels: SentPixels::Made(made.photo) })?;
    }
    Ok(())
}

/// [`Undecoded::read`] of all photos, a few at a time.
fn read_all(
    photos: &[Undecoded<'_, '_>],
    side_max: u32,
    limits: &Limits,
    cancel: &AtomicBool,
) -> Result<Vec<(PosedPhoto, [f64; 2])>> {
    let read = |i: usize| {
        unless_cancelled(cancel)?;
        photos[i].read(side_max, limits)
    };
    let sizes: Vec<u64> = photos.iter().map(|one| one.header.working_pixels()).collect();
    let mut all = Vec::with_capacity(photos.len());
    for together in decoded_together(&sizes, limits.photo_pixels_max) {
        let some: Vec<Result<_>> = together.into_par_iter().map(read).collect();
        all.extend(some.into_iter().collect::<Result<Vec<_>>>()?);
    }
    Ok(all)
}

/// Decodes the photos, and removes the distortion of their lenses.
fn decoded(found: &FoundPhotos<'_>, limits: &Limits, cancel: &AtomicBool) -> Result<ReadPhotos> {
    let all = AllUndecoded::new(found, limits, cancel)?;
    let read = read_all(&all.photos, all.side_max, limits, cancel)?;
    let (photos, taken): (Vec<_>, Vec<_>) = read.into_iter().unzip();
    let mut warnings = [found.warnings.clone(), all.warnings.clone()].concat();
    warnings.extend(masked(&all.photos, &taken));
    warnings.extend(bent_away(&all.photos, &taken));
    Ok(ReadPhotos { photos, warnings, unit: found.unit })
}

/// Says how much masks leave out.
fn masked(photos: &[Undecoded<'_, '_>], taken: &[[f64; 2]]) -> Option<Warning> {
    let masks = photos.iter().filter_map(|one| one.found.mask.as_ref());
    let (count, first) = (masks.clone().count(), masks.map(|mask| &mask.path).next()?);
    let share = taken.iter().map(|[masked, _]| masked).sum::<f64>() / count as f64;
    let message = format!(
        "{count} of {} photos have masks, as {:?}, which leave {:.1} % of their pixels out of the \
         scene",
        photos.len(),
        short(first),
        100.0 * share
    );
    (share > 0.0).then_some(Warning { code: WarningCode::MasksUsed, message, value: share })
}

/// Names photos of which a lens leaves less than half.
fn bent_away(photos: &[Undecoded<'_, '_>], taken: &[[f64; 2]]) -> Option<Warning> {
    let bad = photos.iter().zip(taken).filter(|(_, [_, by_lens])| *by_lens > LENS_TAKES_MAX);
    let count = bad.clone().count();
    let (worst, [_, share]) = bad.max_by(|a, b| a.1[1].total_cmp(&b.1[1]))?;
    let message = format!(
        "{}: the distortion of its lens leaves {:.0} % of its pixels ({count} of {} photos have \
         less than half); check k1 to k6, p1 and p2",
        worst.label,
        100.0 * (1.0 - share),
        photos.len()
    );
    Some(Warning { code: WarningCode::LensDoubtful, message, value: *share })
}
