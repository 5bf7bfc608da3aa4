//! Free space: what stands in front of the surface that other photos see.
//!
//! Each photo is compared with a bounded number of its neighbours, by the depth of their own
//! Gaussians (visibility-based fusion: Merrell et al., "Real-time visibility-based fusion of depth
//! maps", 2007). A Gaussian that stands in front of a neighbour's surface hides what that photo
//! saw. Neighbours that see a surface at its place speak for it, with their confidence. It is
//! dropped where too much speaks against it. The time is linear in the photos.

use std::sync::atomic::AtomicBool;

use rayon::prelude::*;

use super::surface::{Fate, Look, PIXELS_A_TASK, Surface, median};
use crate::{error::Result, scene::unless_cancelled};

/// What counts as hiding another photo's surface, and how much of it is too much.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FreeSpace {
    /// Nearest photos that each photo is compared with.
    pub neighbors: usize,
    /// Relative depth difference under which two Gaussians are one surface.
    pub same_surface: f64,
    /// Relative depth difference beyond which the nearer Gaussian is in the free space of the
    /// photo that sees the farther one.
    pub depth: f64,
    /// The same in pixels of that photo, by the parallax between both photos.
    pub parallax_px: f64,
    /// Largest confidence against a Gaussian, as a share of the confidence for it.
    pub against_max: f64,
}

/// Drops what stands in free space. `near[v]`: the neighbours of view `v`, of [`neighbors`].
pub(super) fn carve(
    surfaces: &[Surface<'_>],
    near: &[Vec<usize>],
    fates: &mut [Vec<Fate>],
    options: &FreeSpace,
    cancel: &AtomicBool,
) -> Result<()> {
    for (v, fates) in fates.iter_mut().enumerate() {
        unless_cancelled(cancel)?;
        fates.par_iter_mut().enumerate().with_min_len(PIXELS_A_TASK).for_each(|(i, fate)| {
            if *fate == Fate::Keep && hides(surfaces, &near[v], v, i, options) {
                *fate = Fate::FreeSpace;
            }
        });
    }
    Ok(())
}

/// For each view its nearest ones by step and turn of the camera, at most `count`, nearest first.
pub(super) fn neighbors(surfaces: &[Surface<'_>], count: usize) -> Vec<Vec<usize>> {
    let depths = |surface: &Surface<'_>| {
        median(surface.depth.iter().filter(|z| z.is_finite()).map(|&z| f64::from(z)).collect())
    };
    let depth = median(surfaces.par_iter().map(depths).collect());
    let unit = if depth > 0.0 { depth } else { 1.0 };
    let pose = |v: usize| &surfaces[v].view.camera.camera_to_world;
    let cost = |v: usize, w: usize| pose(v).apart(pose(w), unit);
    let of = |v: usize| {
        let others = (0..surfaces.len()).filter(|&w| w != v);
        let mut costs: Vec<(f64, usize)> = others.map(|w| (cost(v, w), w)).collect();
        costs.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        costs.into_iter().take(count).map(|(_, w)| w).collect()
    };
    (0..surfaces.len()).map(of).collect()
}

/// Whether Gaussian `i` of view `v` stands in front of what its neighbours see.
fn hides(
    surfaces: &[Surface<'_>],
    near: &[usize],
    v: usize,
    i: usize,
    options: &FreeSpace,
) -> bool {
    let own = &surfaces[v];
    let world = own.world(i);
    let (mut speak_for, mut against) = (own.confidence(i), 0.0);
    for other in near.iter().map(|&w| &surfaces[w]) {
        let Some(Look { at, z, surface }) = other.look(world) else { continue };
        let off = (z - surface) / surface;
        if off.abs() < options.same_surface {
            speak_for += other.confidence(at);
        } else if off < -options.depth {
            let [from, to] = [own, other].map(|s| s.view.camera.camera_to_world.center());
            let parallax = from.distance(to) * (1.0 / z - 1.0 / surface);
            if parallax * other.view.camera.intrinsics.fx > options.parallax_px {
                against += other.confidence(at);
            }
        }
    }
    against > options.against_max * speak_for
}
