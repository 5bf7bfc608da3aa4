//! Photos without cameras: decoded, upright, with the focal length of their EXIF. Once they have
//! cameras the distortion of their lens is taken out as that of any other photo.

use std::sync::atomic::AtomicBool;

use rayon::prelude::*;

use super::{
    decode::{self, Header},
    mask,
    room::{decoded_together, side_kept},
    undistort,
};
use crate::{
    error::Result,
    formats::captures::{FoundUnposed, LensAtSize, Terms, UnposedFile},
    limits::Limits,
    photo_label as label,
    scene::{Intrinsics, PosedPhoto, SolvedCamera, UnposedPhoto, Warning, unless_cancelled},
};

/// The photos of an upload that has no cameras.
#[derive(Clone, Debug)]
pub struct ReadUnposed {
    /// The photos, in the order of their names.
    pub photos: Vec<UnposedPhoto>,
    /// What of the upload was not used.
    pub warnings: Vec<Warning>,
}

/// Decodes photos; stops before the next one once `cancel` is true.
///
/// # Errors
/// `photo_unreadable` for files that are not what they claim, `limit_exceeded`; each names photo,
/// value and bound. `cancelled`.
pub(super) fn decoded(
    found: &FoundUnposed<'_>,
    limits: &Limits,
    cancel: &AtomicBool,
) -> Result<ReadUnposed> {
    let all = Undecoded::all(found, limits)?;
    let side_max = side_of(&all, limits);
    let read = |i: usize| {
        unless_cancelled(cancel)?;
        all[i].read(side_max, limits)
    };
    let sizes: Vec<u64> = all.iter().map(|one| one.header.working_pixels()).collect();
    let mut photos = Vec::with_capacity(all.len());
    for together in decoded_together(&sizes, limits.photo_pixels_max) {
        let some: Vec<Result<_>> = together.into_par_iter().map(read).collect();
        photos.extend(some.into_iter().collect::<Result<Vec<_>>>()?);
    }
    Ok(ReadUnposed { photos, warnings: found.warnings.clone() })
}

/// Longer side at which the photos are kept.
pub(super) fn side_of(all: &[Undecoded<'_, '_>], limits: &Limits) -> u32 {
    let sizes: Vec<[u32; 2]> =
        all.iter().map(|one| one.header.size_after(one.header.orientation)).collect();
    side_kept(&sizes, limits)
}

/// A photo whose header is read, and whose pixels are not.
pub(super) struct Undecoded<'f, 'a> {
    pub(super) file: &'f UnposedFile<'a>,
    label: String,
    header: Header,
}

impl<'f, 'a> Undecoded<'f, 'a> {
    /// All photos of an upload.
    pub(super) fn all(found: &'f FoundUnposed<'a>, limits: &Limits) -> Result<Vec<Self>> {
        let one = |(i, file): (usize, &'f UnposedFile<'a>)| {
            let label = label(i, &file.name);
            let header = decode::header(&file.bytes.read()?, &label, limits)?;
            Ok(Self { file, label, header })
        };
        found.photos.iter().enumerate().map(one).collect()
    }

    /// The photo, upright, with its longer side at most `side_max`.
    pub(super) fn read(&self, side_max: u32, limits: &Limits) -> Result<UnposedPhoto> {
        let Self { file, label, header } = self;
        let bytes = file.bytes.read()?;
        let photo = decode::pixels(&bytes, header, header.orientation, label, limits)?;
        let photo = match &file.mask {
            Some(mask) => mask::applied(photo, mask, label, limits)?,
            None => photo,
        };
        // The focal length follows the photo's size as intrinsics do.
        let size = [photo.width, photo.height];
        let focal = decode::focal(&bytes, header, size);
        drop(bytes);
        let f = focal.unwrap_or(1.0);
        let lens = Intrinsics { fx: f, fy: f, cx: 0.0, cy: 0.0, width: size[0], height: size[1] };
        let (photo, lens) = decode::at_most(photo, lens, side_max);
        Ok(UnposedPhoto {
            file: file.name.clone(),
            photo,
            file_size: header.size_after(header.orientation),
            focal: focal.map(|_| lens.fx),
        })
    }
}

/// A photo with the camera that was solved for it, without the distortion of its lens.
#[must_use]
pub fn posed(unposed: UnposedPhoto, solved: &SolvedCamera) -> PosedPhoto {
    let UnposedPhoto { file, photo, .. } = unposed;
    let SolvedCamera { camera, k1 } = *solved;
    let terms = (k1 != 0.0).then(|| Terms::of_k1(k1));
    let lens = LensAtSize { intrinsics: camera.intrinsics, made_for: None, terms };
    let photo = undistort::undistort(photo, &lens, camera.intrinsics);
    PosedPhoto { file, photo, camera, intrinsics_made_for: None }
}
