//! The lens: from written numbers to pinhole intrinsics of the photo, and distortion undone.
//!
//! Perspective models are Brown-Conrady as in OpenCV and nerfstudio: with r² = x² + y²,
//! x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + 2 p1 x y + p2 (r² + 2 x²), and y' likewise with
//! p1 and p2 changing places. Fisheye models are OpenCV's equidistant one:
//! θ' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸). Undoing keeps the size and K.

use rayon::prelude::*;

use crate::{
    error::{Error, Result},
    scene::{Intrinsics, Photo},
    vectorised,
};

/// Lines of a photo that one thread undistorts at a time.
const LINES_A_TASK: usize = 16;

/// Models whose radial terms act on the tangent of the angle.
const PERSPECTIVE: [&str; 6] =
    ["PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"];
/// Models whose radial terms act on the angle.
const FISHEYE: [&str; 3] = ["OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"];

/// A lens as written; what is absent is `None`, what is not a number is NaN.
#[derive(Clone, Debug, Default)]
pub(super) struct Lens {
    pub(super) model: Option<String>,
    pub(super) is_fisheye: Option<bool>,
    pub(super) fx: Option<f64>,
    pub(super) fy: Option<f64>,
    /// Full angle of view, radians.
    pub(super) angle_x: Option<f64>,
    pub(super) angle_y: Option<f64>,
    pub(super) cx: Option<f64>,
    pub(super) cy: Option<f64>,
    pub(super) width: Option<f64>,
    pub(super) height: Option<f64>,
    pub(super) k: [Option<f64>; 4],
    pub(super) p: [Option<f64>; 2],
}

/// A checked lens for one photo.
#[derive(Clone, Copy, Debug)]
pub(super) struct LensAtSize {
    /// Pinhole part, of the photo's own size.
    pub(super) intrinsics: Intrinsics,
    /// Size the intrinsics were written for, where it is another.
    pub(super) made_for: Option<[u32; 2]>,
    distortion: Option<Distortion>,
}

/// Distortion terms, at least one of them not zero.
#[derive(Clone, Copy, Debug)]
struct Distortion {
    fisheye: bool,
    k: [f64; 4],
    p: [f64; 2],
    /// Largest undistorted radius (tangent of the angle) up to which the model is one to one.
    radius_max: f64,
}

impl LensAtSize {
    /// The same lens of the photo reduced to the size of `intrinsics`.
    pub(super) fn of_smaller(self, intrinsics: Intrinsics) -> Self {
        Self { intrinsics, ..self }
    }
}

impl Lens {
    /// The lens for a photo of `width` x `height`, all numbers checked.
    ///
    /// Intrinsics written for another size of the same aspect are scaled to the photo; another
    /// aspect is refused: it is unknown what was cropped.
    pub(super) fn at_size(&self, width: u32, height: u32, what: &str) -> Result<LensAtSize> {
        let fisheye = self.is_fisheye_model(what)?;
        let stated = self.stated_size(what)?;
        let [w, h] = stated.unwrap_or([width, height]);
        let finite = |name: &str, value: Option<f64>| match value {
            Some(v) if !v.is_finite() => {
                Err(Error::invalid(format!("{what}: {name} is {v}, not a finite number")))
            }
            value => Ok(value),
        };
        let focal = |name: &str, focal: Option<f64>, angle: Option<f64>, side: u32| {
            if let Some(focal) = focal {
                return Ok(Some(focal));
            }
            let Some(angle) = angle else { return Ok(None) };
            if !(angle > 0.0 && angle < std::f64::consts::PI) {
                return Err(Error::invalid(format!(
                    "{what}: the angle of view along {name} is {angle} rad; \
                     it must be over 0 and under pi"
                )));
            }
            Ok(Some(0.5 * f64::from(side) / (0.5 * angle).tan()))
        };
        let fx = focal("x", self.fx, self.angle_x, w)?;
        let fy = focal("y", self.fy, self.angle_y, h)?;
        let (Some(fx), Some(fy)) = (fx.or(fy), fy.or(fx)) else {
            return Err(Error::invalid(format!(
                "{what}: no focal length; give fl_x and fl_y, or camera_angle_x"
            )));
        };
        let written = Intrinsics {
            fx,
            fy,
            cx: finite("cx", self.cx)?.unwrap_or(0.5 * f64::from(w)),
            cy: finite("cy", self.cy)?.unwrap_or(0.5 * f64::from(h)),
            width: w,
            height: h,
        }
        .validated(what)?;
        let made_for = ([w, h] != [width, height]).then_some([w, h]);
        if made_for.is_some() && !same_aspect([w, h], [width, height]) {
            return Err(Error::invalid(format!(
                "{what}: intrinsics are for {w}x{h} px, the photo is {width}x{height} px as \
                 stored (EXIF orientation is ignored): another aspect, so nothing says how they fit"
            )));
        }
        let intrinsics = written.resized(width, height);
        let mut k = [0.0; 4];
        let mut p = [0.0; 2];
        let terms = k.iter_mut().chain(&mut p).zip(self.k.iter().chain(&self.p));
        for ((slot, &value), name) in terms.zip(["k1", "k2", "k3", "k4", "p1", "p2"]) {
            *slot = finite(name, value)?.unwrap_or(0.0);
        }
        let distorted = fisheye || k.iter().chain(&p).any(|&v| v != 0.0);
        let distortion = distorted.then(|| Distortion::new(fisheye, k, p, &intrinsics));
        Ok(LensAtSize { intrinsics, made_for, distortion })
    }

    fn is_fisheye_model(&self, what: &str) -> Result<bool> {
        let named = match self.model.as_deref() {
            None => false,
            Some(model) if PERSPECTIVE.contains(&model) => false,
            Some(model) if FISHEYE.contains(&model) => true,
            Some(other) => {
                let other: String = other.chars().take(40).collect();
                return Err(Error::invalid(format!(
                    "{what}: camera_model {other:?} is not one of {}, {}",
                    PERSPECTIVE.join(", "),
                    FISHEYE.join(", ")
                )));
            }
        };
        Ok(named || self.is_fisheye == Some(true))
    }

    fn stated_size(&self, what: &str) -> Result<Option<[u32; 2]>> {
        let side = |name: &str, value: f64| {
            let rounded = value.round();
            if !((1.0..=1e6).contains(&rounded) && (rounded - value).abs() < 0.01) {
                return Err(Error::invalid(format!(
                    "{what}: {name} of the intrinsics is {value}; it must be a whole number of \
                     pixels from 1 to 1000000"
                )));
            }
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "1..1e6")]
            Ok(rounded as u32)
        };
        match (self.width, self.height) {
            (None, None) => Ok(None),
            (Some(w), Some(h)) => Ok(Some([side("width", w)?, side("height", h)?])),
            _ => Err(Error::invalid(format!(
                "{what}: the intrinsics state only one of width and height"
            ))),
        }
    }
}

/// Whether one size is the other scaled, up to one pixel of rounding in the smaller.
fn same_aspect(a: [u32; 2], b: [u32; 2]) -> bool {
    let [aw, ah] = a.map(f64::from);
    let [bw, bh] = b.map(f64::from);
    let (small, big) = if aw * ah < bw * bh { ([aw, ah], [bw, bh]) } else { ([bw, bh], [aw, ah]) };
    let by_width = (small[1] - big[1] * small[0] / big[0]).abs();
    let by_height = (small[0] - big[0] * small[1] / big[1]).abs();
    by_width.min(by_height) <= 1.0
}

impl Distortion {
    fn new(fisheye: bool, k: [f64; 4], p: [f64; 2], intrinsics: &Intrinsics) -> Self {
        let reach = |c: f64, side: u32, f: f64| (c.abs().max((f64::from(side) - c).abs())) / f;
        let corner = reach(intrinsics.cx, intrinsics.width, intrinsics.fx).hypot(reach(
            intrinsics.cy,
            intrinsics.height,
            intrinsics.fy,
        ));
        let mut this = Self { fisheye, k, p, radius_max: f64::INFINITY };
        // Past the first turn of the radial curve the model folds the picture over itself.
        const STEPS: u32 = 1024;
        let mut last = 0.0;
        for step in 1..=STEPS {
            let r = corner * f64::from(step) / f64::from(STEPS);
            let distorted = r * this.radial(r * r);
            if distorted <= last {
                this.radius_max = corner * f64::from(step - 1) / f64::from(STEPS);
                break;
            }
            last = distorted;
        }
        this
    }

    /// Distorted over undistorted radius at undistorted radius² `r2`.
    #[inline(always)]
    fn radial(&self, r2: f64) -> f64 {
        let [k1, k2, k3, k4] = self.k;
        if self.fisheye {
            let r = r2.sqrt();
            if r < 1e-9 {
                return 1.0;
            }
            let theta = r.atan();
            let t2 = theta * theta;
            theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / r
        } else {
            1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
        }
    }

    /// Where the ray (x, y, 1) fell on the image plane; `None` past the fold.
    #[inline(always)]
    fn apply(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        let r2 = x * x + y * y;
        if r2.sqrt() > self.radius_max {
            return None;
        }
        let d = self.radial(r2);
        if self.fisheye {
            return Some((x * d, y * d));
        }
        let [p1, p2] = self.p;
        Some((
            x * d + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * d + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y),
        ))
    }
}

/// The photo as a pinhole camera of the same size and K would have taken it.
///
/// Bilinear in the stored values; a pixel whose source lies outside the photo, or beyond where the
/// distortion model is one to one, or touches an invalid pixel, is black and not valid.
pub(super) fn undistort(photo: Photo, lens: &LensAtSize) -> Photo {
    let Some(distortion) = lens.distortion else { return photo };
    let k = lens.intrinsics;
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

#[cfg(test)]
mod tests {
    use super::same_aspect;

    #[test]
    fn a_size_may_be_rounded_by_a_pixel() {
        assert!(same_aspect([1080, 1920], [360, 640]));
        assert!(same_aspect([1297, 840], [648, 420]));
        assert!(!same_aspect([640, 480], [640, 360]));
    }
}
