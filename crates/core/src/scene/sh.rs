//! Spherical harmonics rotated exactly, any degree up to 3, 3DGS basis and order.
//!
//! A rotation maps each band to itself: `M_ij = ∫ Y_i(d) Y_j(R⁻¹ d) dd`, and the integrand is a
//! polynomial of degree 6 at most, which Gauss-Legendre in z times equal steps in azimuth
//! integrates exactly. No recursion, no special cases.

use glam::{DMat3, DVec3};

/// Coefficients of degree 3.
pub const SH_COUNT_MAX: usize = 16;
/// Gauss-Legendre nodes and weights, order 4: exact to degree 7.
const NODES: [(f64, f64); 4] = [
    (-0.861_136_311_594_052_6, 0.347_854_845_137_453_86),
    (-0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
    (0.339_981_043_584_856_3, 0.652_145_154_862_546_1),
    (0.861_136_311_594_052_6, 0.347_854_845_137_453_86),
];
/// Steps in azimuth: exact to order 7.
const STEPS: usize = 8;

/// The real orthonormal basis at unit direction `d`, with 3DGS's signs.
#[must_use]
pub fn sh_basis(d: DVec3) -> [f64; SH_COUNT_MAX] {
    let (x, y, z) = (d.x, d.y, d.z);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        0.282_094_791_773_878_14,
        -0.488_602_511_902_919_9 * y,
        0.488_602_511_902_919_9 * z,
        -0.488_602_511_902_919_9 * x,
        1.092_548_430_592_079_2 * x * y,
        -1.092_548_430_592_079_2 * y * z,
        0.315_391_565_252_520_05 * (2.0 * zz - xx - yy),
        -1.092_548_430_592_079_2 * x * z,
        0.546_274_215_296_039_6 * (xx - yy),
        -0.590_043_589_926_643_5 * y * (3.0 * xx - yy),
        2.890_611_442_640_554 * x * y * z,
        -0.457_045_799_464_465_8 * y * (4.0 * zz - xx - yy),
        0.373_176_332_590_115_4 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -0.457_045_799_464_465_8 * x * (4.0 * zz - xx - yy),
        1.445_305_721_320_277 * z * (xx - yy),
        -0.590_043_589_926_643_5 * x * (xx - 3.0 * yy),
    ]
}

/// Rotates coefficients of functions on the sphere: `f'(d) = f(R⁻¹ d)`.
#[derive(Clone, Debug)]
pub struct ShRotation {
    matrix: [[f64; SH_COUNT_MAX]; SH_COUNT_MAX],
    degree: u8,
}

impl ShRotation {
    /// The rotation of functions by `rotation`, up to `degree` (3 at most).
    #[must_use]
    pub fn new(rotation: DMat3, degree: u8) -> Self {
        let back = rotation.transpose();
        let mut matrix = [[0.0; SH_COUNT_MAX]; SH_COUNT_MAX];
        for (z, weight) in NODES {
            let r = (1.0 - z * z).sqrt();
            for step in 0..STEPS {
                let phi = std::f64::consts::TAU * step as f64 / STEPS as f64;
                let d = DVec3::new(r * phi.cos(), r * phi.sin(), z);
                let (here, there) = (sh_basis(d), sh_basis(back * d));
                let w = weight * std::f64::consts::TAU / STEPS as f64;
                for (row, yi) in matrix.iter_mut().zip(here) {
                    for (m, yj) in row.iter_mut().zip(there) {
                        *m += w * yi * yj;
                    }
                }
            }
        }
        Self { matrix, degree }
    }

    /// Rotates one Gaussian's coefficients, `[K, 3]`, in place.
    pub fn apply(&self, sh: &mut [[f32; 3]]) {
        for band in 1..=usize::from(self.degree) {
            let range = band * band..(band + 1) * (band + 1);
            let mut old = [[0.0_f64; 3]; 7];
            for (o, c) in old.iter_mut().zip(&sh[range.clone()]) {
                *o = c.map(f64::from);
            }
            for i in range.clone() {
                let mut sum = [0.0_f64; 3];
                for (m, c) in self.matrix[i][range.clone()].iter().zip(&old) {
                    for (s, v) in sum.iter_mut().zip(c) {
                        *s += m * v;
                    }
                }
                sh[i] = sum.map(|v| v as f32);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    #[test]
    fn a_rotated_function_has_the_same_values_at_rotated_directions() {
        let rotation = DMat3::from_quat(DQuat::from_xyzw(0.3, -0.5, 0.1, 0.8).normalize());
        for degree in 0..=3_u8 {
            let count = (usize::from(degree) + 1).pow(2);
            let before: Vec<[f32; 3]> =
                (0..count).map(|i| [0.1 * i as f32 + 0.3, 1.0 - i as f32 * 0.07, 0.5]).collect();
            let mut after = before.clone();
            ShRotation::new(rotation, degree).apply(&mut after);
            for d in [DVec3::X, DVec3::new(1.0, 2.0, -0.5), DVec3::new(-0.2, 0.4, 3.0)] {
                let d = d.normalize();
                let value = |sh: &[[f32; 3]], d: DVec3| -> f64 {
                    sh_basis(d).iter().zip(sh).map(|(y, c)| y * f64::from(c[1])).sum()
                };
                let (a, b) = (value(&before, d), value(&after, rotation * d));
                assert!((a - b).abs() < 1e-6, "degree {degree}: {a} is not {b}");
            }
        }
    }

    #[test]
    fn no_rotation_changes_nothing() {
        let before: Vec<[f32; 3]> = (0..16).map(|i| [i as f32, -1.0, 0.25]).collect();
        let mut after = before.clone();
        ShRotation::new(DMat3::IDENTITY, 3).apply(&mut after);
        for (a, b) in before.iter().zip(&after) {
            assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5), "{a:?} is not {b:?}");
        }
    }
}
