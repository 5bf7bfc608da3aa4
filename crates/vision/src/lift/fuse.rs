//! Fusion: a surface that many photos show is kept from a few of them.
//!
//! First what hides the surfaces of many other photos is dropped ([`FreeSpace`]). Then photos are
//! taken one after another, the surest first. A Gaussian is dropped where at least
//! [`FuseOptions::layers`] photos before it *kept* a Gaussian of the same surface at that place,
//! no coarser than its own. So no hole opens, and a surface that sixty photos show has as many
//! layers as a surface that a few photos show.

use std::sync::atomic::AtomicBool;

use rayon::prelude::*;

use super::{
    free_space::{FreeSpace, carve, neighbors},
    surface::{Fate, Look, Surface, surest_first},
};
use crate::{
    error::Result,
    scene::{ViewGaussians, unless_cancelled},
};

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
    let mut fates = Fate::of_candidates(candidate);
    if views.len() <= options.layers {
        return Ok(fates);
    }
    let surfaces: Vec<Surface<'_>> =
        views.iter().zip(candidate).map(|(view, keep)| Surface::new(view, keep)).collect();
    let near = neighbors(&surfaces, options.free_space.neighbors);
    carve(&surfaces, &near, &mut fates, &options.free_space, cancel)?;
    let mut before: Vec<usize> = Vec::with_capacity(views.len());
    for v in surest_first(views) {
        unless_cancelled(cancel)?;
        let mut own = std::mem::take(&mut fates[v]);
        own.par_iter_mut().enumerate().for_each(|(i, fate)| {
            if *fate == Fate::Keep && is_covered(&surfaces, &fates, &before, options, v, i) {
                *fate = Fate::Duplicate;
            }
        });
        fates[v] = own;
        before.push(v);
    }
    Ok(fates)
}

/// Whether enough of the views `before` kept a Gaussian of the surface of Gaussian `i` of view `v`.
fn is_covered(
    surfaces: &[Surface<'_>],
    fates: &[Vec<Fate>],
    before: &[usize],
    options: &FuseOptions,
    v: usize,
    i: usize,
) -> bool {
    let (world, own_footprint) = (surfaces[v].world(i), surfaces[v].footprint(i));
    let covers = |&&w: &&usize| {
        let other = &surfaces[w];
        other.look(world).is_some_and(|Look { at, z, surface }| {
            fates[w][at] == Fate::Keep
                && other.footprint(at) <= own_footprint * options.footprint_ratio_max
                && ((z - surface) / surface).abs() <= options.same_surface
        })
    };
    before.iter().filter(covers).take(options.layers).count() >= options.layers
}
