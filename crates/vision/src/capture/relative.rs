//! A second camera seen from a first, and the planes that a sweep compares them on.

use glam::{DMat3, DVec3};

use super::gray::GrayView;

/// Nearest plane, in baselines.
const NEAREST_BASELINES: f64 = 0.45;
/// Planes lie at most this far apart, in pixels of the second picture.
const STEP_PX: f64 = 1.0;
/// Planes beyond infinity, pixels: where a true infinity lands when the pose is slightly off.
const BEYOND_PX: f64 = 2.0;
/// Most planes: past this the step grows.
const PLANES_MAX: usize = 600;

/// A second camera seen from a first, in pixels of the small pictures.
#[derive(Clone, Copy, Debug)]
pub(super) struct Relative {
    /// K' R
    pub(super) kr: DMat3,
    /// K' t
    pub(super) kt: DVec3,
    baseline: f64,
}

impl Relative {
    /// From the poses and lenses of two views.
    pub(super) fn new(reference: &GrayView, source: &GrayView) -> Self {
        let k = source.camera.intrinsics;
        let k = DMat3::from_cols(
            DVec3::new(k.fx, 0.0, 0.0),
            DVec3::new(0.0, k.fy, 0.0),
            DVec3::new(k.cx, k.cy, 1.0),
        );
        let (from, to) = (&reference.camera.camera_to_world, &source.camera.camera_to_world);
        let to_camera = to.rotation().transpose();
        let shift = from.center() - to.center();
        Self {
            kr: k * to_camera * from.rotation(),
            kt: k * (to_camera * shift),
            baseline: shift.length(),
        }
    }

    /// Where the point of `ray` at inverse depth `w` falls; `None` behind the camera.
    pub(super) fn pixel(&self, ray: DVec3, w: f64) -> Option<(f64, f64)> {
        let p = self.kr * ray + self.kt * w;
        (p.z > 1e-9).then(|| (p.x / p.z, p.y / p.z))
    }

    /// Depth in the second camera of the point of `ray` at depth 1/w, times w.
    pub(super) fn relative_depth(&self, ray: DVec3, w: f64) -> f64 {
        (self.kr * ray + self.kt * w).z
    }

    /// Inverse depths from beyond infinity to close by, at most a pixel apart.
    pub(super) fn planes(&self, reference: &GrayView, source: &GrayView) -> Vec<f64> {
        const GRID: usize = 5;
        let mut rays = Vec::with_capacity(GRID * GRID);
        for gy in 0..GRID {
            for gx in 0..GRID {
                let at = |g: usize, n: usize| (n - 1) as f64 * g as f64 / (GRID - 1) as f64;
                rays.push(reference.ray(at(gx, reference.width), at(gy, reference.height)));
            }
        }
        let w_max = 1.0 / (NEAREST_BASELINES * self.baseline);
        let longest = w_max / 40.0;
        let shortest = w_max / PLANES_MAX as f64;
        let (width, height) = (source.width as f64, source.height as f64);
        let step_at = |w: f64| {
            let mut speed = 0.0_f64;
            for &ray in &rays {
                let p = self.kr * ray + self.kt * w;
                if p.z <= 1e-6 {
                    continue;
                }
                let (u, v) = (p.x / p.z, p.y / p.z);
                // Outside by less than half a picture still counts: windows between grid points.
                if u < -0.5 * width || v < -0.5 * height || u > 1.5 * width || v > 1.5 * height {
                    continue;
                }
                let du = (self.kt.x - u * self.kt.z) / p.z;
                let dv = (self.kt.y - v * self.kt.z) / p.z;
                speed = speed.max(du.hypot(dv));
            }
            if speed > 0.0 { (STEP_PX / speed).clamp(shortest, longest) } else { longest }
        };
        let first = step_at(0.0);
        let mut planes = Vec::new();
        let mut w = -BEYOND_PX / STEP_PX * first;
        while w < w_max && planes.len() < 2 * PLANES_MAX {
            planes.push(w);
            w += if w < 0.0 { first } else { step_at(w) };
        }
        planes
    }
}
