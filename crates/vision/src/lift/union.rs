//! One set of Gaussians of many photos, for views that know nothing of the photos.
//!
//! 1. **Free space.** What stands in front of the surface that other photos see is dropped
//!    ([`FreeSpace`]).
//! 2. **Layers.** Of a surface that many photos show the Gaussians of a few of them are kept
//!    ([`Layers`]).
//! 3. **Shape.** Wide Gaussians reach over the borders of things, so scales get a bound. The
//!    opacity of the kept ones makes up for the dropped layers.
//!
//! The time is linear in the photos. A scene of few photos stays as the network made it: the
//! network is trained to compose so few.

use std::sync::atomic::AtomicBool;

use rayon::prelude::*;

use super::{free_space::FreeSpace, layers::Layers, surface::Fate};
use crate::{error::Result, point, scene::ViewGaussians};

/// What hides what, and how many layers a surface may have. Chosen on four real scenes of 9 to 20
/// photos that are not reported: docs/adr/0034-many-photos.md.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UnionOptions {
    /// Photos up to which nothing is changed.
    pub few: usize,
    /// What hides the surface that other photos see.
    pub free_space: FreeSpace,
    /// Photos that may keep Gaussians of one surface.
    pub layers: usize,
    /// A coarser layer does not make a finer one superfluous: largest ratio of pixel footprints.
    pub footprint_ratio_max: f64,
    /// Largest standard deviation, in widths of the Gaussian's source pixel.
    pub scale_max_px: f64,
    /// An opacity `a` becomes `1 - (1 - a)^gain`, as if so many of it lay behind each other.
    pub gain: f64,
}

impl Default for UnionOptions {
    fn default() -> Self {
        Self {
            few: 4,
            free_space: FreeSpace {
                neighbors: 16,
                same_surface: 0.03,
                depth: 0.04,
                parallax_px: 1.0,
                against_max: 0.5,
            },
            layers: 2,
            footprint_ratio_max: 1.5,
            scale_max_px: 1.5,
            gain: 1.5,
        }
    }
}

/// The fate of each Gaussian of each view; `candidate` says which are there at all. Opacities and
/// scales of `views` are changed.
pub(super) fn unite(
    views: &mut [ViewGaussians],
    candidate: &[Vec<bool>],
    options: &UnionOptions,
    cancel: &AtomicBool,
) -> Result<Vec<Vec<Fate>>> {
    if views.len() <= options.few {
        return Ok(Fate::of_candidates(candidate));
    }
    let layers = Layers {
        most: options.layers,
        same_surface: options.free_space.same_surface,
        footprint_ratio_max: options.footprint_ratio_max,
        near_only: true,
    };
    let fates = layers.keep(views, candidate, &options.free_space, cancel)?;
    views.par_iter_mut().for_each(|view| shape(view, options));
    Ok(fates)
}

/// Bounds the scales and raises the opacities of a view.
#[expect(clippy::cast_possible_truncation, reason = "scenes are f32")]
fn shape(view: &mut ViewGaussians, options: &UnionOptions) {
    let to_camera = view.camera.camera_to_world.viewmat() * view.frame_to_world.matrix();
    let focal = view.camera.intrinsics.fx;
    for (mean, scale) in view.means.iter().zip(&mut view.scales) {
        let pixel = to_camera.transform_point3(point(*mean)).z / focal;
        let most = (options.scale_max_px * pixel) as f32;
        if most > 0.0 {
            *scale = scale.map(|s| s.min(most));
        }
    }
    let gain = options.gain as f32;
    view.opacities.iter_mut().for_each(|a| *a = 1.0 - (1.0 - a.clamp(0.0, 1.0)).powf(gain));
}
