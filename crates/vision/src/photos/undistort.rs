//! Distortion undone: a photo of a lens becomes one of a pinhole camera. Size and K stay.

use rayon::prelude::*;

use crate::{
    formats::captures::{LensAtSize, Terms},
    scene::{Intrinsics, Photo},
    vectorised,
};

/// Lines of a photo that one thread undistorts at a time.
const LINES_A_TASK: usize = 16;

/// Terms that bend rays.
#[derive(Clone, Copy, Debug)]
struct Distortion {
    terms: Terms,
    /// Largest undistorted radius (tangent of the angle) up to which the model is one to one.
    radius_max: f64,
}

impl Distortion {
    fn new(terms: Terms, intrinsics: &Intrinsics) -> Self {
        let reach = |c: f64, side: u32, f: f64| (c.abs().max((f64::from(side) - c).abs())) / f;
        let corner = reach(intrinsics.cx, intrinsics.width, intrinsics.fx).hypot(reach(
            intrinsics.cy,
            intrinsics.height,
            intrinsics.fy,
        ));
        let mut this = Self { terms, radius_max: f64::INFINITY };
        // Past the first turn of the radial curve the model folds the picture over itself.
        const STEPS: u32 = 1024;
        let mut last = 0.0;
        for step in 1..=STEPS {
            let r = corner * f64::from(step) / f64::from(STEPS);
            let distorted = r * terms.radial(r * r);
            // Not a number where the model has no answer.
            if distorted <= last || distorted.is_nan() {
                this.radius_max = corner * f64::from(step - 1) / f64::from(STEPS);
                break;
            }
            last = distorted;
        }
        this
    }

    /// Where the ray (x, y, 1) fell on the image plane; `None` past the fold.
    #[inline(always)]
    fn apply(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        let inside = (x * x + y * y).sqrt() <= self.radius_max;
        inside.then(|| self.terms.apply(x, y))
    }
}

/// The photo as a pinhole camera of the same size and K, `k`, would have taken it; `lens` is that
/// of the photo before it was reduced.
///
/// Bilinear in the stored values; a pixel whose source lies outside the photo, or beyond where the
/// distortion model is one to one, or touches an invalid pixel, is black and not valid.
pub(super) fn undistort(photo: Photo, lens: &LensAtSize, k: Intrinsics) -> Photo {
    let Some(terms) = lens.terms else { return photo };
    let distortion = Distortion::new(terms, &lens.intrinsics);
    let (width, height) = (photo.width as usize, photo.height as usize);
    let mut rgb = vec![0_u8; width * height * 3];
    let mut valid = vec![false; width * height];
    let columns: Vec<f64> = (0..width).map(|col| (col as f64 + 0.5 - k.cx) / k.fx).collect();
    let line = |(row, (rgb, valid)): (usize, (&mut [u8], &mut [bool]))| {
        let y = (row as f64 + 0.5 - k.cy) / k.fy;
        for ((&x, rgb), valid) in columns.iter().zip(rgb.as_chunks_mut::<3>().0).zip(valid) {
            let Some((dx, dy)) = distortion.apply(x, y) else { continue };
            let at = (k.fx * dx + k.cx, k.fy * dy + k.cy);
            if let Some(value) = bilinear(&photo, at) {
                *rgb = value;
                *valid = true;
            }
        }
    };
    let lines = rgb.par_chunks_mut(width * 3).zip(valid.par_chunks_mut(width)).enumerate();
    lines.with_min_len(LINES_A_TASK).for_each(|of| {
        vectorised(
            #[inline(always)]
            || line(of),
        );
    });
    let valid = valid.contains(&false).then_some(valid);
    Photo { width: photo.width, height: photo.height, rgb, valid }
}

/// The colour at (u, v), pixel centres at +0.5; `None` outside the picture or on invalid pixels.
#[inline(always)]
fn bilinear(photo: &Photo, (u, v): (f64, f64)) -> Option<[u8; 3]> {
    let (width, height) = (photo.width as usize, photo.height as usize);
    if !(u >= 0.0 && v >= 0.0 && u <= width as f64 && v <= height as f64) {
        return None;
    }
    let x = (u - 0.5).clamp(0.0, width as f64 - 1.0);
    let y = (v - 0.5).clamp(0.0, height as f64 - 1.0);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped above")]
    let (x0, y0) = (x as usize, y as usize);
    let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
    let (ax, ay) = (x - x0 as f64, y - y0 as f64);
    let corners = [
        (x0, y0, (1.0 - ax) * (1.0 - ay)),
        (x1, y0, ax * (1.0 - ay)),
        (x0, y1, (1.0 - ax) * ay),
        (x1, y1, ax * ay),
    ];
    let mut sum = [0.0; 3];
    for (px, py, weight) in corners {
        let i = py * width + px;
        if weight > 0.0 && photo.valid.as_ref().is_some_and(|valid| !valid[i]) {
            return None;
        }
        for (sum, &value) in sum.iter_mut().zip(&photo.rgb[i * 3..i * 3 + 3]) {
            *sum += weight * f64::from(value);
        }
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..=255")]
    Some(sum.map(|v| v.round() as u8))
}
