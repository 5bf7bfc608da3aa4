//! The lens: from written numbers to pinhole intrinsics of the photo, and how it bends rays.
//!
//! Perspective models are Brown-Conrady as in OpenCV and nerfstudio: with r² = x² + y²,
//! x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) + 2 p1 x y + p2 (r² + 2 x²), and y' likewise with
//! p1 and p2 changing places. Fisheye models are OpenCV's equidistant one:
//! θ' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸). [`Terms`] has the form that holds these and all
//! other models of COLMAP.

use crate::{
    error::{Error, Result},
    limits::FOCAL_RANGE,
    scene::Intrinsics,
};

/// Models whose radial terms act on the tangent of the angle.
const PERSPECTIVE: [&str; 6] =
    ["PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"];
/// Models whose radial terms act on the angle.
const FISHEYE: [&str; 5] =
    ["OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"];

/// How the sizes of cameras fit those of photos, the worst first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Sizes {
    /// Another aspect: the photos would be refused.
    Contradict,
    /// Photos that cannot be read.
    Unknown,
    /// The same aspect.
    Scaled,
    /// The same, or the cameras state none.
    Fit,
}

/// A lens as written; what is absent is `None`, what is not a number is NaN.
#[derive(Clone, Debug, Default)]
pub struct Lens {
    pub(crate) model: Option<String>,
    pub(crate) is_fisheye: Option<bool>,
    pub(crate) fx: Option<f64>,
    pub(crate) fy: Option<f64>,
    /// Full angle of view, radians.
    pub(crate) angle_x: Option<f64>,
    pub(crate) angle_y: Option<f64>,
    pub(crate) cx: Option<f64>,
    pub(crate) cy: Option<f64>,
    pub(crate) width: Option<f64>,
    pub(crate) height: Option<f64>,
    pub(crate) k: [Option<f64>; 4],
    pub(crate) p: [Option<f64>; 2],
    /// Whether focal lengths and principal point are shares of the photo's width and height.
    pub(crate) of_size: bool,
    /// The distortion, where a reader knows it whole: `model`, `is_fisheye`, `k` and `p` are not
    /// looked at then.
    pub(crate) terms: Option<Terms>,
}

/// How a lens bends rays: the point (x, y) of the plane z = 1 goes through `base`, then
///
/// `x' = x N(r²)/D(r²) + 2 p1 x y + p2 (r² + 2 x²) + s1 r² + s2 r⁴`, and y' with p1 and p2 changing
/// places and s3, s4. `N = 1 + Σ k_i r^2i`, `D = 1 + Σ d_i r^2i`. Formulas and order of numbers are
/// those of COLMAP's `src/colmap/sensor/models.h`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Terms {
    pub(crate) base: Base,
    pub(crate) k: [f64; 6],
    pub(crate) d: [f64; 3],
    pub(crate) p: [f64; 2],
    pub(crate) s: [f64; 4],
    /// Whether the terms of p and s are of the point that N/D has moved already
    /// (`RAD_TAN_THIN_PRISM_FISHEYE`).
    pub(crate) after_radial: bool,
}

/// What is done to the radius before the polynomial.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Base {
    /// Nothing: the tangent of the angle to the axis.
    #[default]
    Tangent,
    /// The angle itself, as fisheye models have it.
    Angle,
    /// `atan(2 r tan(ω/2)) / ω` (Devernay and Faugeras); ω is over 0.
    Field(f64),
    /// The root of `r = r' / (1 + k r'²)`, the division model.
    Division(f64),
    /// `r / (α √(β r² + 1) + 1 - α)`, the extended unified model.
    Unified(f64, f64),
}

impl Base {
    /// New over old radius at radius² `r2`; not a number where the model has none.
    #[inline(always)]
    fn factor(self, r2: f64) -> f64 {
        let r = r2.sqrt();
        match self {
            Self::Tangent => 1.0,
            _ if r < 1e-9 => match self {
                Self::Field(omega) => 2.0 * (0.5 * omega).tan() / omega,
                _ => 1.0,
            },
            Self::Angle => r.atan() / r,
            Self::Field(omega) => (2.0 * r * (0.5 * omega).tan()).atan() / (r * omega),
            Self::Division(k) => 2.0 / (1.0 + (1.0 - 4.0 * k * r2).sqrt()),
            Self::Unified(alpha, beta) => 1.0 / (alpha * (beta * r2 + 1.0).sqrt() + (1.0 - alpha)),
        }
    }
}

impl Terms {
    /// The first radial term alone, of OpenCV's model.
    #[must_use]
    pub fn of_k1(k1: f64) -> Self {
        Self { k: [k1, 0.0, 0.0, 0.0, 0.0, 0.0], ..Self::default() }
    }

    /// Whether it leaves every ray where it is.
    fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// The numbers, for a look at whether all are finite.
    fn numbers(&self) -> impl Iterator<Item = f64> {
        let base = match self.base {
            Base::Tangent | Base::Angle => [0.0; 2],
            Base::Field(a) | Base::Division(a) => [a, 0.0],
            Base::Unified(a, b) => [a, b],
        };
        let Self { k, d, p, s, .. } = *self;
        base.into_iter().chain(k).chain(d).chain(p).chain(s)
    }

    /// Distorted over undistorted radius at undistorted radius² `r2`, by the radial terms alone.
    #[inline(always)]
    pub fn radial(&self, r2: f64) -> f64 {
        let base = self.base.factor(r2);
        base * self.polynomial(r2 * base * base)
    }

    /// N/D at radius² `r2`.
    #[inline(always)]
    fn polynomial(&self, r2: f64) -> f64 {
        let [k1, k2, k3, k4, k5, k6] = self.k;
        let above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * (k4 + r2 * (k5 + r2 * k6)))));
        let [d1, d2, d3] = self.d;
        if self.d == [0.0; 3] { above } else { above / (1.0 + r2 * (d1 + r2 * (d2 + r2 * d3))) }
    }

    /// Where the ray (x, y, 1) falls on the image plane.
    #[inline(always)]
    pub fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        let base = self.base.factor(x * x + y * y);
        let (x, y) = (x * base, y * base);
        let radial = self.polynomial(x * x + y * y);
        let (to_x, to_y) = (x * radial, y * radial);
        let (x, y) = if self.after_radial { (to_x, to_y) } else { (x, y) };
        let r2 = x * x + y * y;
        let ([p1, p2], [s1, s2, s3, s4]) = (self.p, self.s);
        (
            to_x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + r2 * s2),
            to_y + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y) + r2 * (s3 + r2 * s4),
        )
    }
}

/// A checked lens for one photo.
#[derive(Clone, Copy, Debug)]
pub struct LensAtSize {
    /// Pinhole part, of the photo's own size.
    pub intrinsics: Intrinsics,
    /// Size the intrinsics were written for, where it is another.
    pub made_for: Option<[u32; 2]>,
    /// The distortion, where it bends rays, so that photos must be undistorted.
    pub terms: Option<Terms>,
}

impl Lens {
    /// The lens for a photo of `width` x `height`, all numbers checked.
    ///
    /// Intrinsics written for another size of the same aspect are scaled to the photo; another
    /// aspect is refused: it is unknown what was cropped.
    ///
    /// # Errors
    /// `invalid_request`, which names the number that is impossible.
    pub fn at_size(&self, width: u32, height: u32, what: &str) -> Result<LensAtSize> {
        let stated = self.stated_size(what)?;
        let [w, h] = stated.unwrap_or([width, height]);
        let terms = self.bending(what)?;
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
        let shares = if self.of_size { [w, h].map(f64::from) } else { [1.0; 2] };
        let fx = focal("x", self.fx, self.angle_x, w)?;
        let fy = focal("y", self.fy, self.angle_y, h)?;
        let (Some(fx), Some(fy)) = (fx.or(fy), fy.or(fx)) else {
            return Err(Error::invalid(format!(
                "{what}: no focal length; give fl_x and fl_y, or camera_angle_x"
            )));
        };
        let [cx, cy] = [finite(what, "cx", self.cx)?, finite(what, "cy", self.cy)?];
        let written = Intrinsics {
            fx: fx * shares[0],
            fy: fy * shares[1],
            cx: cx.map_or(0.5 * f64::from(w), |cx| cx * shares[0]),
            cy: cy.map_or(0.5 * f64::from(h), |cy| cy * shares[1]),
            width: w,
            height: h,
        }
        .validated(what)?;
        let [least, most] = FOCAL_RANGE;
        for (name, focal) in [("fx", written.fx), ("fy", written.fy)] {
            if !(least..=most).contains(&focal) {
                return Err(Error::invalid(format!(
                    "{what}: {name} is {focal:e} px; it must be {least} to {most}"
                )));
            }
        }
        let made_for = ([w, h] != [width, height]).then_some([w, h]);
        if made_for.is_some() && !same_aspect([w, h], [width, height]) {
            return Err(Error::invalid(format!(
                "{what}: intrinsics are for {w}x{h} px, the photo is {width}x{height} px as \
                 stored, and its EXIF orientation does not make it fit: another aspect, so nothing \
                 says how they fit"
            )));
        }
        let intrinsics = written.resized(width, height);
        let terms = (!terms.is_none()).then_some(terms);
        Ok(LensAtSize { intrinsics, made_for, terms })
    }

    /// How the size that is written fits that of a photo.
    #[must_use]
    pub fn sizes(&self, photo: [u32; 2]) -> Sizes {
        match self.stated_size("") {
            Ok(None) => Sizes::Fit,
            Ok(Some(stated)) if stated == photo => Sizes::Fit,
            Ok(Some(stated)) if same_aspect(stated, photo) => Sizes::Scaled,
            _ => Sizes::Contradict,
        }
    }

    /// The distortion, all numbers finite.
    fn bending(&self, what: &str) -> Result<Terms> {
        if let Some(terms) = self.terms {
            if let Some(wrong) = terms.numbers().find(|v| !v.is_finite()) {
                let why = format!("{what}: a term of the lens is {wrong}, not a finite number");
                return Err(Error::invalid(why));
            }
            return Ok(terms);
        }
        let mut terms = Terms::default();
        if self.is_fisheye_model(what)? {
            terms.base = Base::Angle;
        }
        let slots = terms.k[..4].iter_mut().chain(&mut terms.p);
        let written = slots.zip(self.k.iter().chain(&self.p));
        for ((slot, &value), name) in written.zip(["k1", "k2", "k3", "k4", "p1", "p2"]) {
            *slot = finite(what, name, value)?.unwrap_or(0.0);
        }
        if terms.base == Base::Angle {
            terms.p = [0.0; 2];
        }
        Ok(terms)
    }

    fn is_fisheye_model(&self, what: &str) -> Result<bool> {
        let is_one = |all: &[&str], model: &str| all.iter().any(|m| m.eq_ignore_ascii_case(model));
        let named = match self.model.as_deref() {
            None => false,
            Some(model) if is_one(&PERSPECTIVE, model) => false,
            Some(model) if is_one(&FISHEYE, model) => true,
            Some(other) => {
                let other: String = other.chars().take(40).collect();
                return Err(Error::invalid(format!(
                    "{what}: camera_model {other:?} is not read; there are {}, {}",
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

fn finite(what: &str, name: &str, value: Option<f64>) -> Result<Option<f64>> {
    match value {
        Some(v) if !v.is_finite() => {
            Err(Error::invalid(format!("{what}: {name} is {v}, not a finite number")))
        }
        value => Ok(value),
    }
}

/// Whether one size is the other scaled, up to one pixel of rounding in the smaller.
#[must_use]
pub fn same_aspect(a: [u32; 2], b: [u32; 2]) -> bool {
    let [aw, ah] = a.map(f64::from);
    let [bw, bh] = b.map(f64::from);
    let (small, big) = if aw * ah < bw * bh { ([aw, ah], [bw, bh]) } else { ([bw, bh], [aw, ah]) };
    let by_width = (small[1] - big[1] * small[0] / big[0]).abs();
    let by_height = (small[0] - big[0] * small[1] / big[1]).abs();
    by_width.min(by_height) <= 1.0
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
