//! Layers: of a surface that many photos show the Gaussians of a few of them are kept.
//!
//! First what hides the surfaces of other photos is dropped ([`FreeSpace`]). Then photos are taken
//! one after another, the surest first. A Gaussian is dropped where enough photos before it *kept*
//! a Gaussian of the same surface at that place, not much coarser than its own. So no hole opens,
//! and a surface that sixty photos show has as many layers as a surface that a few photos show.

use std::sync::atomic::AtomicBool;

use rayon::prelude::*;

use super::{
    free_space::{FreeSpace, carve, neighbors},
    surface::{Fate, Look, PIXELS_A_TASK, Surface, surest_first},
};
use crate::{
    error::Result,
    scene::{ViewGaussians, unless_cancelled},
};

/// What counts as one surface, and how many layers it may have.
pub(super) struct Layers {
    /// Photos that may keep Gaussians of one surface.
    pub(super) most: usize,
    /// Relative depth difference up to which two Gaussians are one surface.
    pub(super) same_surface: f64,
    /// A coarser layer does not make a finer one superfluous: largest ratio of pixel footprints.
    pub(super) footprint_ratio_max: f64,
    /// Whether a photo is compared with its neighbours in free space alone, not with all.
    pub(super) near_only: bool,
}

impl Layers {
    /// The fate of each Gaussian of each view; `candidate` says which are there at all.
    pub(super) fn keep(
        &self,
        views: &[ViewGaussians],
        candidate: &[Vec<bool>],
        free_space: &FreeSpace,
        cancel: &AtomicBool,
    ) -> Result<Vec<Vec<Fate>>> {
        let mut fates = Fate::of_candidates(candidate);
        let surfaces: Vec<Surface<'_>> =
            views.iter().zip(candidate).map(|(view, keep)| Surface::new(view, keep)).collect();
        let near = neighbors(&surfaces, free_space.neighbors);
        carve(&surfaces, &near, &mut fates, free_space, cancel)?;
        // Views that were decided; the others cover nothing yet.
        let mut decided = Vec::with_capacity(views.len());
        for v in surest_first(views) {
            unless_cancelled(cancel)?;
            let mut before = decided.clone();
            before.retain(|w| !self.near_only || near[v].contains(w));
            let mut own = std::mem::take(&mut fates[v]);
            own.par_iter_mut().enumerate().with_min_len(PIXELS_A_TASK).for_each(|(i, fate)| {
                if *fate == Fate::Keep && self.are_full(&surfaces, &fates, &before, v, i) {
                    *fate = Fate::Duplicate;
                }
            });
            fates[v] = own;
            decided.push(v);
        }
        Ok(fates)
    }

    /// Whether enough of the views `before` kept a Gaussian of the surface of Gaussian `i` of view
    /// `v`.
    fn are_full(
        &self,
        surfaces: &[Surface<'_>],
        fates: &[Vec<Fate>],
        before: &[usize],
        v: usize,
        i: usize,
    ) -> bool {
        let (world, finest) = (surfaces[v].world(i), surfaces[v].footprint(i));
        let covers = |&&w: &&usize| {
            let other = &surfaces[w];
            other.look(world).is_some_and(|Look { at, z, surface }| {
                fates[w][at] == Fate::Keep
                    && other.footprint(at) <= finest * self.footprint_ratio_max
                    && ((z - surface) / surface).abs() <= self.same_surface
            })
        };
        before.iter().filter(covers).take(self.most).count() >= self.most
    }
}
