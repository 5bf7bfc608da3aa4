//! PSNR and SSIM on RGB in 0..1.

pub use crate::render::compare::psnr;
use crate::render::train::photo_loss;

/// Side of SSIM's window, pixels.
const WINDOW: usize = 11;

/// Colours as a picture of 8 bits holds them: within 0 and 1.
pub(crate) fn clamped(color: Option<Vec<[f32; 3]>>) -> Vec<[f32; 3]> {
    let mut color = color.unwrap_or_default();
    color.iter_mut().flatten().for_each(|v| *v = v.clamp(0.0, 1.0));
    color
}

/// Structural similarity, as [`photo_loss`] has it: 11x11 Gaussian window of sigma 1.5 inside the
/// picture, mean over windows and channels; NaN of a picture that is smaller than that, or of
/// another size. Pixels that are not valid count as equal.
#[must_use]
pub fn ssim(picture: &[[f32; 3]], truth: &[[f32; 3]], width: usize, valid: Option<&[bool]>) -> f64 {
    let sides = [width, truth.len() / width.max(1)];
    if sides.into_iter().any(|side| side < WINDOW) || picture.len() != truth.len() {
        return f64::NAN;
    }
    1.0 - photo_loss(picture, truth, width, valid, 1.0).value
}
