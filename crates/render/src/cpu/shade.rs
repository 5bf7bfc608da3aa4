//! Stage 4: colour of each visible Gaussian, seen from the camera. Shader: `shaders/shade.wgsl`
//!
//! In: spherical harmonics `[N, K, 3]`. Out: the colour of each footprint that touches a tile.

use glam::DVec3;
use rayon::prelude::*;

use super::{lanes::KernelOptions, project::Projected};
use crate::{
    constants::{SH_C0, SH_C1, SH_C2, SH_C3, SH_OFFSET},
    scene::Gaussians,
    switches::Skip,
    view::View,
};

/// Gaussians of a task.
const CHUNK: usize = 1024;

/// Writes the colour of every visible footprint, in place. The footprints keep the order of the
/// scene, which suits the rasteriser's cache better than depth order. A scene of degree 0 looks the
/// same from everywhere, so no direction is computed. Returns the largest number of a colour if
/// that is to be `bounded`, else 0.
pub fn shade(
    gaussians: &Gaussians,
    view: &View,
    options: KernelOptions,
    bounded: bool,
    projected: &mut Projected,
) -> f32 {
    let flat = gaussians.sh_count() == 1 && options.skips(Skip::FlatColor);
    let coefficients = gaussians.sh_count();
    let Projected { shown, footprints, tiles_per_gauss, .. } = projected;
    let chunks = footprints.par_chunks_mut(CHUNK);
    let chunks = chunks.zip(tiles_per_gauss.par_chunks(CHUNK)).enumerate();
    let brightest = chunks.map(|(chunk, (footprints, tiles))| {
        let mut brightest = 0.0_f32;
        for (k, (footprint, &tiles)) in footprints.iter_mut().zip(tiles).enumerate() {
            if tiles > 0 {
                let (gaussians, i) = shown.find(gaussians, chunk * CHUNK + k);
                let sh = &gaussians.sh()[i * coefficients..(i + 1) * coefficients];
                footprint.color = if flat {
                    sh[0].map(|value| (SH_OFFSET + SH_C0 * value).max(0.0))
                } else {
                    let mean = DVec3::from(gaussians.means()[i].map(f64::from));
                    color(sh, mean - view.center)
                };
                // It waits for what was written, so it is left out where it can be.
                if bounded {
                    brightest = footprint.color.into_iter().fold(brightest, f32::max);
                }
            }
        }
        brightest
    });
    brightest.reduce(|| 0.0, f32::max)
}

/// Colour of harmonics `sh` (`[K, 3]`, 3DGS basis and order) seen along `toward` (any length).
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
#[inline]
pub(super) fn basis([x, y, z]: [f32; 3]) -> [f32; 16] {
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
