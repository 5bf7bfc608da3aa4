//! Masks: which pixels of a photo take part in its scene. What a mask leaves out is not valid in
//! the photo, as what has no source behind a lens: no stage takes Gaussians, steps or names of it.

use crate::{
    error::{Error, Result, short},
    formats::captures::{FoundMask, same_aspect},
    limits::Limits,
    scene::Photo,
};

use super::decode;

/// The photo without what its mask leaves out. A pixel takes part where the mask is not black; in a
/// JPEG, whose black is not exact, where it is over half of white. A mask of another size of the
/// same aspect is scaled.
///
/// # Errors
/// As for photos; `invalid_request` for a mask of another aspect.
pub(super) fn applied(
    mut photo: Photo,
    mask: &FoundMask<'_>,
    what: &str,
    limits: &Limits,
) -> Result<Photo> {
    let what = format!("{what}: its mask {:?}", short(&mask.path));
    let bytes = mask.bytes.read()?;
    let header = decode::header(&bytes, &what, limits)?;
    let ([w, h], size) = (header.size(), [photo.width, photo.height]);
    if !same_aspect([w, h], size) {
        let [width, height] = size;
        return Err(Error::invalid(format!(
            "{what} is {w}x{h} px, the photo is {width}x{height} px: another aspect, so nothing \
             says how they fit"
        )));
    }
    let kept = decode::kept(&bytes, &header, &what, limits)?;
    let [mask_width, mask_height] = kept.size.map(|side| side as usize);
    let (width, height) = (photo.width as usize, photo.height as usize);
    // The pixel of the mask at the middle of a pixel of the photo.
    let at = |i: usize, pixels: usize, cells: usize| (2 * i + 1) * cells / (2 * pixels);
    let columns: Vec<usize> = (0..width).map(|x| at(x, width, mask_width)).collect();
    let mut valid = photo.valid.take().unwrap_or_else(|| vec![true; width * height]);
    for (y, line) in valid.chunks_exact_mut(width).enumerate() {
        let row = &kept.pixels[at(y, height, mask_height) * mask_width..][..mask_width];
        for (valid, &x) in line.iter_mut().zip(&columns) {
            *valid &= row[x] != mask.marks_left_out;
        }
    }
    photo.valid = valid.contains(&false).then_some(valid);
    Ok(photo)
}
