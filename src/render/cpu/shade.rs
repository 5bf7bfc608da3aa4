//! Stage 4: colour of each visible Gaussian as seen from the camera. Partner: `shaders/shade.wgsl`
//!
//! In: spherical harmonics and the depth order. Out: footprints with colour, in depth order.

use glam::DVec3;
use rayon::prelude::*;

use super::{project::Footprint, radix_sort};
use crate::{
    render::{
        constants::{SH_C0, SH_C1, SH_C2, SH_C3, SH_OFFSET},
        view::View,
    },
    scene::Gaussians,
};

/// Gaussians a task.
const CHUNK: usize = 1024;

/// Gathers the visible footprints in the order of `sorted` and gives each its colour.
pub fn shade(
    gaussians: &Gaussians,
    view: &View,
    footprints: &[Footprint],
    sorted: &[u64],
    shaded: &mut Vec<Footprint>,
) {
    shaded.resize(sorted.len(), Footprint::default());
    let coefficients = gaussians.sh_count();
    shaded.par_chunks_mut(CHUNK).zip(sorted.par_chunks(CHUNK)).for_each(|(shaded, sorted)| {
        for (out, &pair) in shaded.iter_mut().zip(sorted) {
            let i = radix_sort::value(pair) as usize;
            let sh = &gaussians.sh()[i * coefficients..(i + 1) * coefficients];
            let toward = DVec3::from(gaussians.means()[i].map(f64::from)) - view.center;
            *out = footprints[i];
            out.color = color(sh, toward);
        }
    });
}

/// Colour of harmonics `sh` (`[K, 3]`, 3DGS basis and order) seen along `toward` (any length).
#[must_use]
pub fn color(sh: &[[f32; 3]], toward: DVec3) -> [f32; 3] {
    let basis = basis(toward.normalize_or_zero().as_vec3().into());
    let mut color = [SH_OFFSET; 3];
    for (coefficient, weight) in sh.iter().zip(basis) {
        for channel in 0..3 {
            color[channel] += weight * coefficient[channel];
        }
    }
    color.map(|value| value.max(0.0))
}

/// The 16 basis functions up to degree 3 at a unit direction, signs of 3DGS included.
fn basis([x, y, z]: [f32; 3]) -> [f32; 16] {
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        SH_C0,
        -SH_C1 * y,
        SH_C1 * z,
        -SH_C1 * x,
        SH_C2[0] * x * y,
        SH_C2[1] * y * z,
        SH_C2[2] * (2.0 * zz - xx - yy),
        SH_C2[3] * x * z,
        SH_C2[4] * (xx - yy),
        SH_C3[0] * y * (3.0 * xx - yy),
        SH_C3[1] * x * y * z,
        SH_C3[2] * y * (4.0 * zz - xx - yy),
        SH_C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        SH_C3[4] * x * (4.0 * zz - xx - yy),
        SH_C3[5] * z * (xx - yy),
        SH_C3[6] * x * (xx - 3.0 * yy),
    ]
}
