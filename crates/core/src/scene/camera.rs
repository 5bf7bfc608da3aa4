//! Pinhole cameras, OpenCV frame: +x right, +y down, +z forward; pixel centres at +0.5.

use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::{
    error::{Error, Result},
    names::shown,
};

/// How far a rotation may be from orthonormal (largest number of |R Rᵀ - I|).
pub const ORTHONORMAL_TOLERANCE: f64 = 1e-3;
/// What a turn of one radian costs against a step of one median depth.
const TURN_COST: f64 = 0.5;

/// Pinhole intrinsics in pixels of the image they belong to. The centre of pixel (0, 0) is (0.5,
/// 0.5); the principal point need not be central.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Intrinsics {
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point x, pixels.
    pub cx: f64,
    /// Principal point y, pixels.
    pub cy: f64,
    /// Image width, pixels.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
}

impl Intrinsics {
    /// Checks that all numbers are finite, focal lengths positive and sides at least one pixel.
    ///
    /// # Errors
    /// `invalid_request`, with a message that starts with `what` and names the value.
    pub fn validated(self, what: &str) -> Result<Self> {
        let refuse = |why: String| Err(Error::invalid(format!("{what}: {why}")));
        for (name, value) in [("fx", self.fx), ("fy", self.fy), ("cx", self.cx), ("cy", self.cy)] {
            if !value.is_finite() {
                return refuse(format!("{name} is {value}, not a finite number"));
            }
        }
        for (name, value) in [("fx", self.fx), ("fy", self.fy)] {
            if value <= 0.0 {
                return refuse(format!("{name} is {}; it must be over 0", shown(value)));
            }
        }
        if self.width == 0 || self.height == 0 {
            let (width, height) = (self.width, self.height);
            return refuse(format!("{width}x{height} px; both sides must be at least 1"));
        }
        Ok(self)
    }

    /// Intrinsics of the image after cropping to `x, y, width, height` (pixels of this image).
    #[must_use]
    pub fn cropped(self, x: f64, y: f64, width: u32, height: u32) -> Self {
        Self { cx: self.cx - x, cy: self.cy - y, width, height, ..self }
    }

    /// Intrinsics of the part `crop` of this image.
    #[must_use]
    pub fn part(self, crop: Region) -> Self {
        self.cropped(f64::from(crop.x), f64::from(crop.y), crop.width, crop.height)
    }

    /// Intrinsics of the image resized to `width` x `height`. Exact with pixel centres at +0.5:
    /// coordinates scale about the image corner.
    #[must_use]
    pub fn resized(self, width: u32, height: u32) -> Self {
        let sx = f64::from(width) / f64::from(self.width);
        let sy = f64::from(height) / f64::from(self.height);
        Self {
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: self.cx * sx,
            cy: self.cy * sy,
            width,
            height,
        }
    }

    /// Pixel of a point in camera coordinates (z > 0).
    pub fn project(&self, point: DVec3) -> (f64, f64) {
        (self.fx * point.x / point.z + self.cx, self.fy * point.y / point.z + self.cy)
    }

    /// Point in camera coordinates seen at pixel (u, v) at depth z.
    pub fn unproject(&self, u: f64, v: f64, z: f64) -> DVec3 {
        DVec3::new((u - self.cx) / self.fx * z, (v - self.cy) / self.fy * z, z)
    }
}

/// A part of a picture, pixels of the whole one; in serde four numbers: x, y, width, height.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "[u32; 4]", into = "[u32; 4]")]
pub struct Region {
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

impl From<[u32; 4]> for Region {
    fn from([x, y, width, height]: [u32; 4]) -> Self {
        Self { x, y, width, height }
    }
}

impl From<Region> for [u32; 4] {
    fn from(region: Region) -> Self {
        [region.x, region.y, region.width, region.height]
    }
}

impl Region {
    /// Refuses a part that is empty or not inside a picture of `width` x `height`.
    ///
    /// # Errors
    /// `invalid_request`, with a message that starts with `what` and names the numbers.
    pub fn inside(self, width: u32, height: u32, what: &str) -> Result<Self> {
        let Self { x, y, width: w, height: h } = self;
        let fits = |at: u32, size: u32, whole: u32| {
            size > 0 && u64::from(at) + u64::from(size) <= u64::from(whole)
        };
        if fits(x, w, width) && fits(y, h, height) {
            return Ok(self);
        }
        Err(Error::invalid(format!(
            "{what}: crop is {w}x{h} px at {x},{y}; it must be at least 1x1 px and lie inside the \
             picture of {width}x{height} px"
        )))
    }
}

/// A rigid camera-to-world pose in the OpenCV frame; checked at construction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraToWorld(DMat4);

impl CameraToWorld {
    /// From 16 numbers, row-major. `what` names the camera in messages.
    ///
    /// # Errors
    /// `invalid_request` when not finite, the last row is not (0,0,0,1), the rotation is singular,
    /// not orthonormal within [`ORTHONORMAL_TOLERANCE`], or a reflection.
    pub fn from_row_major(m: &[f64; 16], what: &str) -> Result<Self> {
        let refuse = |why: String| Err(Error::invalid(format!("{what}: {why}")));
        if let Some(i) = m.iter().position(|v| !v.is_finite()) {
            let (row, column, value) = (i / 4, i % 4, m[i]);
            return refuse(format!(
                "camera_to_world[{row}][{column}] is {value}, not a finite number"
            ));
        }
        let last = [m[12], m[13], m[14], m[15] - 1.0];
        if last.iter().any(|v| v.abs() > ORTHONORMAL_TOLERANCE) {
            let last = [m[12], m[13], m[14], m[15]].map(shown).join(", ");
            return refuse(format!(
                "the last row of camera_to_world is [{last}]; it must be [0, 0, 0, 1]"
            ));
        }
        let mat = DMat4::from_cols_array(m).transpose();
        let r = DMat3::from_mat4(mat);
        let det = r.determinant();
        if det.abs() < 1e-6 {
            return refuse(format!(
                "the rotation of camera_to_world is singular (determinant {det:.3e})"
            ));
        }
        let gram = r * r.transpose() - DMat3::IDENTITY;
        let off = gram.to_cols_array().iter().fold(0.0_f64, |worst, v| worst.max(v.abs()));
        if off > ORTHONORMAL_TOLERANCE {
            return refuse(format!(
                "the rotation of camera_to_world is not orthonormal \
                 (off by {off:.3e}, at most {ORTHONORMAL_TOLERANCE:.0e})"
            ));
        }
        if det < 0.0 {
            return refuse(format!("camera_to_world is mirrored (determinant {det:.3})"));
        }
        Ok(Self::orthonormalised(mat))
    }

    /// From an OpenGL camera-to-world (x right, y up, z backwards): y and z columns flipped.
    ///
    /// # Errors
    /// As [`Self::from_row_major`].
    pub fn from_opengl_row_major(m: &[f64; 16], what: &str) -> Result<Self> {
        let mut cv = *m;
        for row in 0..3 {
            cv[row * 4 + 1] = -cv[row * 4 + 1];
            cv[row * 4 + 2] = -cv[row * 4 + 2];
        }
        Self::from_row_major(&cv, what)
    }

    /// Rows of the same pose with OpenGL's axes, y up and z back: what
    /// [`Self::from_opengl_row_major`] reads.
    #[must_use]
    pub fn to_opengl_rows(&self) -> [[f64; 4]; 4] {
        let m = self.to_row_major();
        let turned = |row: usize| [m[row], -m[row + 1], -m[row + 2], m[row + 3]];
        [turned(0), turned(4), turned(8), [0.0, 0.0, 0.0, 1.0]]
    }

    /// A camera at `eye` that looks at `target`; `up` is up in the picture.
    ///
    /// # Errors
    /// `invalid_request` when eye and target coincide or `up` is parallel to the view axis.
    pub fn look_at(eye: DVec3, target: DVec3, up: DVec3, what: &str) -> Result<Self> {
        if !(eye.is_finite() && target.is_finite() && up.is_finite()) {
            let why = format!("{what}: eye, target and up must be finite numbers");
            return Err(Error::invalid(why));
        }
        let forward = (target - eye)
            .try_normalize()
            .ok_or_else(|| Error::invalid(format!("{what}: eye and target are the same point")))?;
        let right = forward.cross(up).try_normalize().ok_or_else(|| {
            Error::invalid(format!("{what}: up is zero or parallel to the view axis"))
        })?;
        Ok(Self::from_axes(right, forward, eye))
    }

    /// The pose at share `t` of the way, 0..1: centres on a line, rotations by the shortest turn.
    pub fn between(from: &Self, to: &Self, t: f64) -> Self {
        let [a, b] = [from, to].map(|pose| DQuat::from_mat3(&pose.rotation()));
        let turn = a.slerp(b, t).normalize();
        let center = from.center().lerp(to.center(), t);
        Self::orthonormalised(DMat4::from_rotation_translation(turn, center))
    }

    fn orthonormalised(mat: DMat4) -> Self {
        let forward = mat.z_axis.truncate().normalize();
        let x = mat.x_axis.truncate();
        let right = (x - forward * forward.dot(x)).normalize();
        Self::from_axes(right, forward, mat.w_axis.truncate())
    }

    /// From two unit axes at right angles, and the centre.
    fn from_axes(right: DVec3, forward: DVec3, center: DVec3) -> Self {
        let down = forward.cross(right);
        let [right, down, forward] = [right, down, forward].map(|axis| axis.extend(0.0));
        Self(DMat4::from_cols(right, down, forward, center.extend(1.0)))
    }

    /// From a rotation, which is brought to length 1 and right angles again, and the centre.
    #[must_use]
    pub fn from_rotation(rotation: DMat3, center: DVec3) -> Self {
        let [x, y, z] = [rotation.x_axis, rotation.y_axis, rotation.z_axis];
        let [x, y, z] = [x, y, z].map(|axis| axis.extend(0.0));
        Self::orthonormalised(DMat4::from_cols(x, y, z, center.extend(1.0)))
    }

    /// Angle of the turn between the two, radians.
    #[must_use]
    pub fn turn_to(&self, other: &Self) -> f64 {
        let [a, b] = [self, other].map(|pose| DQuat::from_mat3(&pose.rotation()));
        a.angle_between(b)
    }

    /// The matrix, camera to world.
    pub fn matrix(&self) -> DMat4 {
        self.0
    }

    /// World to camera.
    pub fn viewmat(&self) -> DMat4 {
        self.0.inverse()
    }

    /// Rotation, camera to world.
    pub fn rotation(&self) -> DMat3 {
        DMat3::from_mat4(self.0)
    }

    /// Camera centre in the world.
    pub fn center(&self) -> DVec3 {
        self.0.w_axis.truncate()
    }

    /// Unit viewing axis (+z of the camera) in the world.
    pub fn axis(&self) -> DVec3 {
        self.0.z_axis.truncate()
    }

    /// How far another camera is, where the nearest are looked for: the step between both in units
    /// of `depth`, world units, and half of the angle between their axes, radians.
    pub fn apart(&self, other: &Self, depth: f64) -> f64 {
        let step = self.center().distance(other.center()) / depth;
        step + TURN_COST * self.axis().dot(other.axis()).clamp(-1.0, 1.0).acos()
    }

    /// 16 numbers, row-major.
    pub fn to_row_major(&self) -> [f64; 16] {
        self.0.transpose().to_cols_array()
    }
}

impl Serialize for CameraToWorld {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.to_row_major().serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for CameraToWorld {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let numbers = <[f64; 16]>::deserialize(deserializer)?;
        Self::from_row_major(&numbers, "camera_to_world").map_err(serde::de::Error::custom)
    }
}

/// A pinhole camera with a pose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Camera {
    /// Lens, in pixels of the picture to be made or that was taken.
    pub intrinsics: Intrinsics,
    /// Pose: 16 numbers, row-major, OpenCV camera-to-world.
    #[schema(value_type = [f64; 16])]
    pub camera_to_world: CameraToWorld,
}
