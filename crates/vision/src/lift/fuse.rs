//! Fusion: a surface that many photos show is kept from a few of them.
//!
//! First what hides the surfaces of many other photos is dropped ([`FreeSpace`]). Then photos are
//! taken one after another, the surest first. A Gaussian is dropped where at least
//! [`FuseOptions::layers`] photos before it *kept* a Gaussian of the same surface at that place,
//! no coarser than its own. So no hole opens, and a surface that sixty photos show has as many
//! layers as a surface that a few photos show.

use std::sync::atomic::AtomicBool;

use glam::DVec3;
use rayon::prelude::*;

use super::free_space::{FreeSpace, carve, neighbors};
use crate::{
    error::Result,
    point,
    scene::{ViewGaussians, unless_cancelled},
    seen_at,
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

/// What becomes of each Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fate {
    /// Kept.
    Keep,
    /// Was not a candidate: dropped for another reason before.
    Absent,
    /// It hides what other photos see.
    FreeSpace,
    /// The surface has enough layers already.
    Duplicate,
    /// Thinning merged it with its neighbours.
    Merged,
}

impl Fate {
    /// What is no candidate is absent; all others are kept.
    pub(super) fn of_candidates(candidate: &[Vec<bool>]) -> Vec<Vec<Self>> {
        let fate = |there: &bool| if *there { Self::Keep } else { Self::Absent };
        candidate.iter().map(|row| row.iter().map(fate).collect()).collect()
    }
}

/// A view and what fusion needs of each of its pixels.
pub(super) struct Surface<'a> {
    pub(super) view: &'a ViewGaussians,
    /// `[H * W]` z in this view's camera of the pixel's own Gaussian; NaN where it is absent.
    pub(super) depth: Vec<f32>,
}

/// A Gaussian as another photo shows it.
pub(super) struct Look {
    /// Pixel of the photo.
    pub(super) at: usize,
    /// Depth of the Gaussian in the photo's camera.
    pub(super) z: f64,
    /// Depth of the photo's own Gaussian there.
    pub(super) surface: f64,
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

/// Sum of the confidence of all pixels that have one.
pub(super) fn sum_of_confidence(view: &ViewGaussians) -> f64 {
    view.confidence.iter().filter(|c| c.is_finite()).map(|&c| f64::from(c)).sum()
}

/// Views by mean confidence, the surest first; ties by index.
pub(super) fn surest_first(views: &[ViewGaussians]) -> Vec<usize> {
    let sure = |v: usize| -> f64 { sum_of_confidence(&views[v]) / views[v].len().max(1) as f64 };
    let mut order: Vec<(usize, f64)> = (0..views.len()).map(|v| (v, sure(v))).collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    order.into_iter().map(|(v, _)| v).collect()
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

impl<'a> Surface<'a> {
    pub(super) fn new(view: &'a ViewGaussians, keep: &[bool]) -> Self {
        let to_camera = view.camera.camera_to_world.viewmat() * view.frame_to_world.matrix();
        #[expect(clippy::cast_possible_truncation, reason = "a depth compared to per cents")]
        let depth =
            view.means
                .par_iter()
                .zip(keep)
                .map(|(mean, &keep)| {
                    if keep { to_camera.transform_point3(point(*mean)).z as f32 } else { f32::NAN }
                })
                .collect();
        Self { view, depth }
    }

    /// World point of the centre of Gaussian `i`.
    pub(super) fn world(&self, i: usize) -> DVec3 {
        self.view.frame_to_world.matrix().transform_point3(point(self.view.means[i]))
    }

    /// Width in the world of the pixel of Gaussian `i`.
    pub(super) fn footprint(&self, i: usize) -> f64 {
        f64::from(self.depth[i]) / self.view.camera.intrinsics.fx
    }

    /// How sure the network is of the depth of Gaussian `i`; 0 where it says no number.
    pub(super) fn confidence(&self, i: usize) -> f64 {
        let confidence = f64::from(self.view.confidence[i]);
        if confidence.is_finite() { confidence } else { 0.0 }
    }

    /// What this view has where it shows a world point; `None` where it shows none, or nothing is
    /// there.
    pub(super) fn look(&self, world: DVec3) -> Option<Look> {
        let (seen, x, y) = seen_at(&self.view.camera, world)?;
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "inside")]
        let (x, y) = (x as usize, y as usize);
        let at = y * self.view.camera.intrinsics.width as usize + x;
        let surface = f64::from(self.depth[at]);
        (surface > 0.0).then_some(Look { at, z: seen.z, surface })
    }
}
