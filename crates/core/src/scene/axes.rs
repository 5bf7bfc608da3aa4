//! Axes of an ellipsoid: eigenvectors of a covariance.

use glam::{DMat3, DQuat, DVec3};

/// Covariance of a Gaussian, `R diag(scales²) Rᵀ`; `quat` is w x y z.
#[must_use]
pub fn covariance(quat: [f32; 4], scales: [f32; 3]) -> DMat3 {
    let [w, x, y, z] = quat.map(f64::from);
    let turn = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let variances = DVec3::from_array(scales.map(|s| f64::from(s).powi(2)));
    turn * DMat3::from_diagonal(variances) * turn.transpose()
}

/// Orthonormal eigenvectors of a symmetric matrix, by Jacobi's rotations; their order and signs are
/// arbitrary.
pub fn principal_axes(spread: DMat3) -> [DVec3; 3] {
    let mut a = spread.to_cols_array_2d();
    let mut v: [[f64; 3]; 3] = DMat3::IDENTITY.to_cols_array_2d();
    for _ in 0..32 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q].abs() <= f64::EPSILON * (a[p][p].abs() + a[q][q].abs()) {
                continue;
            }
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            for numbers in a.iter_mut().chain(&mut v) {
                let (kp, kq) = (numbers[p], numbers[q]);
                (numbers[p], numbers[q]) = (c * kp - s * kq, s * kp + c * kq);
            }
            let (ap, aq) = (a[p], a[q]);
            a[p] = std::array::from_fn(|k| c * ap[k] - s * aq[k]);
            a[q] = std::array::from_fn(|k| s * ap[k] + c * aq[k]);
        }
    }
    // The axes are the columns of v, whose rows were turned above.
    [0, 1, 2].map(|k| DVec3::new(v[0][k], v[1][k], v[2][k]).normalize_or(DVec3::X))
}
