//! The camera of a request, relative to the Gaussians' origin. It is computed in f64, before any
//! number becomes f32.

use std::ops::Range;

use glam::{DMat3, DVec3};

use super::{
    Background, RenderRequest,
    budget::check_error,
    constants::{FRUSTUM_MARGIN, TILE_SIZE},
    merged::check_detail,
};
use crate::error::{Error, Result};

/// Pixels that a renderer agrees to draw: 3.4 GB of pictures. Callers have smaller limits.
const PIXELS_MAX: u64 = 1 << 27;
/// Longest side: ids of tiles stay in 16 bits a side.
const SIDE_MAX: u32 = 1 << 18;

/// Camera of one frame, relative to the scene's origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// World to camera, rotation.
    pub rotation: DMat3,
    /// World to camera, translation for means relative to the origin: t = rotation · mean + this.
    pub translation: DVec3,
    /// Camera centre relative to the origin, world axes.
    pub center: DVec3,
    /// Focal lengths, pixels.
    pub focal: [f64; 2],
    /// Principal point, pixels of the part drawn.
    pub principal: [f64; 2],
    /// Smallest t.x / t.z and t.y / t.z at which the Jacobian is taken (negative as a rule).
    pub slope_min: [f64; 2],
    /// Largest t.x / t.z and t.y / t.z at which the Jacobian is taken.
    pub slope_max: [f64; 2],
    /// Gaussians with t.z under this are dropped, world units.
    pub near: f64,
    /// Width of the part drawn, pixels.
    pub width: u32,
    /// Height of the part drawn, pixels.
    pub height: u32,
}

impl View {
    /// Checks the request and subtracts the origin from the camera.
    ///
    /// # Errors
    /// `invalid_request` when the intrinsics are unusable, the near plane is not a finite number
    /// over 0, the error or the detail is out of range, or background, sources or labels are not
    /// finite; `limit_exceeded` for a picture beyond memory.
    pub fn new(origin: DVec3, request: &RenderRequest) -> Result<Self> {
        let lens = request.camera.intrinsics.validated("camera")?;
        let cropped = match request.crop {
            None => lens,
            Some(crop) => lens.part(crop.inside(lens.width, lens.height, "camera")?),
        };
        if !(request.near.is_finite() && request.near > 0.0) {
            let near = request.near;
            return Err(Error::invalid(format!(
                "near is {near}; it must be a finite number over 0"
            )));
        }
        if let Background::Color(color) = &request.background
            && let Some(value) = color.iter().find(|value| !value.is_finite())
        {
            return Err(Error::invalid(format!("background holds {value}, not a finite number")));
        }
        for (i, source) in request.sources.iter().enumerate() {
            source.check(i)?;
        }
        check_error(request.error)?;
        check_detail(request.detail)?;
        request.labels.check()?;
        let pixels = u64::from(cropped.width) * u64::from(cropped.height);
        if pixels > PIXELS_MAX || cropped.width.max(cropped.height) > SIDE_MAX {
            let size = format!("{}x{}", cropped.width, cropped.height);
            let bound = format!("{PIXELS_MAX} in all or {SIDE_MAX} a side");
            return Err(Error::limit("camera: pixels of the picture", size, bound));
        }
        let pose = request.camera.camera_to_world;
        let rotation = pose.rotation().transpose();
        let center = pose.center() - origin;
        let (focal, principal) = ([lens.fx, lens.fy], [lens.cx, lens.cy]);
        let size = [f64::from(lens.width), f64::from(lens.height)];
        // Measured from the true principal point: with an off-centre one the two sides differ. And
        // of the whole picture: a part shows what the whole shows there.
        let margin = |axis: usize| f64::from(FRUSTUM_MARGIN) * 0.5 * size[axis] / focal[axis];
        let low = |axis: usize| -principal[axis] / focal[axis] - margin(axis);
        let high = |axis: usize| (size[axis] - principal[axis]) / focal[axis] + margin(axis);
        Ok(Self {
            rotation,
            translation: -(rotation * center),
            center,
            focal,
            principal: [cropped.cx, cropped.cy],
            slope_min: [low(0), low(1)],
            slope_max: [high(0), high(1)],
            near: f64::from(request.near),
            width: cropped.width,
            height: cropped.height,
        })
    }

    /// The part of it in some rows of tiles.
    pub(crate) fn band(&self, rows: &Range<u32>) -> Self {
        let first = rows.start * TILE_SIZE;
        let [x, y] = self.principal;
        let height = (rows.end * TILE_SIZE).min(self.height) - first;
        Self { principal: [x, y - f64::from(first)], height, ..*self }
    }

    /// The ray of the first pixel's centre, and its change to the next column and row: world axes,
    /// of a length whose square is an f32.
    pub(crate) fn rays(&self) -> [[f32; 3]; 3] {
        let to_world = self.rotation.transpose();
        let ray = |x: f64, y: f64| {
            let [x, y] = [(x, 0), (y, 1)].map(|(at, k)| (at - self.principal[k]) / self.focal[k]);
            to_world * DVec3::new(x, y, 1.0)
        };
        let first = ray(0.5, 0.5);
        let last = ray(f64::from(self.width), f64::from(self.height));
        let scale = first.length().max(last.length()).recip();
        let across = to_world * DVec3::X / self.focal[0];
        let down = to_world * DVec3::Y / self.focal[1];
        [first, across, down].map(|v| (v * scale).as_vec3().to_array())
    }

    /// Pixels by which a point of the picture moves at most where it moves by 1 in the world at a
    /// depth of 1.
    pub(crate) fn pixels_per_step(&self) -> f64 {
        let steepest = |axis: usize| self.slope_min[axis].abs().max(self.slope_max[axis].abs());
        let slope = steepest(0).hypot(steepest(1));
        self.focal[0].max(self.focal[1]) * slope.hypot(1.0)
    }

    /// Tiles in a row of tiles.
    pub fn tiles_x(&self) -> u32 {
        self.width.div_ceil(TILE_SIZE)
    }

    /// Rows of tiles.
    pub fn tiles_y(&self) -> u32 {
        self.height.div_ceil(TILE_SIZE)
    }
}
