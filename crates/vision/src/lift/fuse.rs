//! Fusion: a surface that many photos show is kept from a few of them ([`Layers`]).

use std::sync::atomic::AtomicBool;

use super::{free_space::FreeSpace, layers::Layers, surface::Fate};
use crate::{error::Result, scene::ViewGaussians};

/// What counts as one surface, and how many layers it may have.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FuseOptions {
    /// Photos that may keep Gaussians of one surface. Networks are trained on the union of their
    /// views, so fewer layers than three show through: measured on 8 triples of fox, `red_kitchen`
    /// and `coke_can` with four photos, one layer loses 11 dB, two lose 2.3, three 0.2.
    pub layers: usize,
    /// Relative depth difference under which two Gaussians are one surface.
    pub same_surface: f64,
    /// A coarser layer does not make a finer one superfluous: largest ratio of pixel footprints.
    pub footprint_ratio_max: f64,
    /// What hides the surface that other photos see, in scenes of more photos than `layers`. A
    /// network composes the views of a set, so only what much speaks against is dropped: chosen
    /// on six scenes that are not reported, docs/adr/0100-free-space-of-layers.md.
    pub free_space: FreeSpace,
}

impl Default for FuseOptions {
    fn default() -> Self {
        Self {
            layers: 4,
            same_surface: 0.02,
            footprint_ratio_max: 1.2,
            free_space: FreeSpace {
                neighbors: 16,
                same_surface: 0.03,
                depth: 0.1,
                parallax_px: 4.0,
                against_max: 4.0,
            },
        }
    }
}

/// The fate of each Gaussian of each view; `candidate` says which are there at all.
pub(super) fn fuse(
    views: &[ViewGaussians],
    candidate: &[Vec<bool>],
    options: &FuseOptions,
    cancel: &AtomicBool,
) -> Result<Vec<Vec<Fate>>> {
    if views.len() <= options.layers {
        return Ok(Fate::of_candidates(candidate));
    }
    let layers = Layers {
        most: options.layers,
        same_surface: options.same_surface,
        footprint_ratio_max: options.footprint_ratio_max,
        near_only: false,
    };
    layers.keep(views, candidate, &options.free_space, cancel)
}
