//! Rotations and poses, world to camera.

use glam::{DMat3, DVec3};
use nalgebra::{Matrix3, Vector3};
use segsplat_core::scene::CameraToWorld;

/// World to camera: `x = r X + t`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pose {
    pub(crate) r: Matrix3<f64>,
    pub(crate) t: Vector3<f64>,
}

impl Pose {
    pub(crate) fn identity() -> Self {
        Self { r: Matrix3::identity(), t: Vector3::zeros() }
    }

    pub(crate) fn of(camera_to_world: &CameraToWorld) -> Self {
        let [x, y, z] = camera_to_world.rotation().transpose().to_cols_array_2d();
        let r = Matrix3::from_columns(&[x.into(), y.into(), z.into()]);
        let center: Vector3<f64> = camera_to_world.center().to_array().into();
        Self { r, t: -(r * center) }
    }

    pub(crate) fn seen(&self, world: &Vector3<f64>) -> Vector3<f64> {
        self.r * world + self.t
    }

    pub(crate) fn inverse(&self) -> Self {
        let r = self.r.transpose();
        Self { r, t: -(r * self.t) }
    }

    pub(crate) fn center(&self) -> Vector3<f64> {
        -(self.r.transpose() * self.t)
    }

    /// Turned by `turn` (axis times angle) after it and moved by `shift`, both in the camera.
    pub(crate) fn moved(&self, turn: &Vector3<f64>, shift: &Vector3<f64>) -> Self {
        let step = rotation(turn);
        Self { r: orthonormal(&(step * self.r)), t: step * self.t + shift }
    }
}

/// The matrix of `a ×`.
pub(crate) fn cross(a: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -a.z, a.y, a.z, 0.0, -a.x, -a.y, a.x, 0.0)
}

/// The rotation about `turn` by its length.
pub(crate) fn rotation(turn: &Vector3<f64>) -> Matrix3<f64> {
    let angle = turn.norm();
    let k = cross(turn);
    let (a, b) = if angle < 1e-6 {
        (1.0 - angle * angle / 6.0, 0.5 - angle * angle / 24.0)
    } else {
        (angle.sin() / angle, (1.0 - angle.cos()) / (angle * angle))
    };
    Matrix3::identity() + k * a + k * k * b
}

/// Takes rounding out of a matrix that is nearly a rotation.
pub(crate) fn orthonormal(r: &Matrix3<f64>) -> Matrix3<f64> {
    let x = r.row(0).transpose().normalize();
    let y = r.row(1).transpose();
    let y = (y - x * x.dot(&y)).normalize();
    let z = x.cross(&y);
    Matrix3::from_rows(&[x.transpose(), y.transpose(), z.transpose()])
}

/// Angle of a rotation, degrees.
pub(crate) fn angle_deg(r: &Matrix3<f64>) -> f64 {
    let sine =
        Vector3::new(r[(2, 1)] - r[(1, 2)], r[(0, 2)] - r[(2, 0)], r[(1, 0)] - r[(0, 1)]).norm();
    sine.atan2(r.trace() - 1.0).to_degrees()
}

/// The rotation that best takes unit vectors `from` to `to`; `None` where they are parallel.
pub(crate) fn best_rotation(
    pairs: impl Iterator<Item = (Vector3<f64>, Vector3<f64>)>,
) -> Option<Matrix3<f64>> {
    let sum = pairs.fold(Matrix3::zeros(), |sum, (from, to)| sum + to * from.transpose());
    project(&sum)
}

/// The rotation nearest to a matrix; `None` where several are equally near.
pub(crate) fn project(matrix: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let svd = matrix.try_svd(true, true, 1e-14, 100)?;
    let (u, v_t) = (svd.u?, svd.v_t?);
    // nalgebra orders the singular values from the largest down.
    let flip = Vector3::new(1.0, 1.0, (u * v_t).determinant().signum());
    (svd.singular_values[1] > 1e-9 * svd.singular_values[0])
        .then(|| u * Matrix3::from_diagonal(&flip) * v_t)
}

pub(crate) fn camera_to_world(pose: &Pose) -> CameraToWorld {
    let axis = |row: usize| DVec3::from_array([0, 1, 2].map(|column| pose.r[(row, column)]));
    let rotation = DMat3::from_cols(axis(0), axis(1), axis(2));
    CameraToWorld::from_rotation(rotation, DVec3::from_array(pose.center().into()))
}
