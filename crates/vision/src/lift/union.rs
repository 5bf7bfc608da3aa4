//! One set of Gaussians of many photos, for views that know nothing of the photos.
//!
//! Each photo is compared with a bounded number of its neighbours, by the depth of their own
//! Gaussians (visibility-based fusion: Merrell et al., "Real-time visibility-based fusion of depth
//! maps", 2007).
//!
//! 1. **Free space.** A Gaussian that stands in front of a neighbour's surface hides what that
//!    photo saw. Neighbours that see a surface at its place speak for it, with their confidence. It
//!    is dropped where too much speaks against it.
//! 2. **Layers.** Photos are taken one after another, the surest first. A Gaussian is dropped where
//!    [`UnionOptions::layers`] neighbours before it *kept* a Gaussian of the same surface, not much
//!    coarser than its own. So no hole opens.
//! 3. **Shape.** Wide Gaussians reach over the borders of things, so scales get a bound. The
//!    opacity of the kept ones makes up for the dropped layers.
//!
//! The time is linear in the photos. A scene of few photos stays as the network made it: the
//! network is trained to compose so few.

use std::sync::atomic::AtomicBool;

use rayon::prelude::*;

use super::fuse::{Fate, Look, Surface, surest_first};
use crate::{
    error::Result,
    point,
    scene::{ViewGaussians, unless_cancelled},
};

/// Pixels that one thread takes at a time.
pub(super) const PIXELS_A_TASK: usize = 1 << 11;

/// What hides what, and how many layers a surface may have. Chosen on four real scenes of 9 to 20
/// photos that are not reported: docs/adr/0034-many-photos.md.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UnionOptions {
    /// Photos up to which nothing is changed.
    pub few: usize,
    /// Nearest photos that each photo is compared with.
    pub neighbors: usize,
    /// Relative depth difference under which two Gaussians are one surface.
    pub same_surface: f64,
    /// Relative depth difference beyond which the nearer Gaussian is in the free space of the
    /// photo that sees the farther one.
    pub free_space: f64,
    /// The same in pixels of that photo, by the parallax between both photos.
    pub free_space_px: f64,
    /// Largest confidence against a Gaussian, as a share of the confidence for it.
    pub against_max: f64,
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
            neighbors: 16,
            same_surface: 0.03,
            free_space: 0.04,
            free_space_px: 1.0,
            against_max: 0.5,
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
    let mut fates = Fate::of_candidates(candidate);
    if views.len() <= options.few {
        return Ok(fates);
    }
    let surfaces: Vec<Surface<'_>> =
        views.iter().zip(candidate).map(|(view, keep)| Surface::new(view, keep)).collect();
    let near = neighbors(&surfaces, options.neighbors);
    for (v, fates) in fates.iter_mut().enumerate() {
        unless_cancelled(cancel)?;
        fates.par_iter_mut().enumerate().with_min_len(PIXELS_A_TASK).for_each(|(i, fate)| {
            if *fate == Fate::Keep && in_free_space(&surfaces, &near[v], v, i, options) {
                *fate = Fate::FreeSpace;
            }
        });
    }
    // Views that were decided; the others cover nothing yet.
    let mut decided = vec![false; views.len()];
    for v in surest_first(views) {
        unless_cancelled(cancel)?;
        let before: Vec<usize> = near[v].iter().copied().filter(|&w| decided[w]).collect();
        let mut own = std::mem::take(&mut fates[v]);
        own.par_iter_mut().enumerate().with_min_len(PIXELS_A_TASK).for_each(|(i, fate)| {
            if *fate == Fate::Keep && is_covered(&surfaces, &fates, &before, v, i, options) {
                *fate = Fate::Duplicate;
            }
        });
        fates[v] = own;
        decided[v] = true;
    }
    drop(surfaces);
    views.par_iter_mut().for_each(|view| shape(view, options));
    Ok(fates)
}

/// For each view its nearest ones by step and turn of the camera, at most `count`, nearest first.
fn neighbors(surfaces: &[Surface<'_>], count: usize) -> Vec<Vec<usize>> {
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
fn in_free_space(
    surfaces: &[Surface<'_>],
    near: &[usize],
    v: usize,
    i: usize,
    options: &UnionOptions,
) -> bool {
    let own = &surfaces[v];
    let world = own.world(i);
    let (mut speak_for, mut against) = (own.confidence(i), 0.0);
    for other in near.iter().map(|&w| &surfaces[w]) {
        let Some(Look { at, z, surface }) = other.look(world) else { continue };
        let off = (z - surface) / surface;
        if off.abs() < options.same_surface {
            speak_for += other.confidence(at);
        } else if off < -options.free_space {
            let [from, to] = [own, other].map(|s| s.view.camera.camera_to_world.center());
            let parallax = from.distance(to) * (1.0 / z - 1.0 / surface);
            if parallax * other.view.camera.intrinsics.fx > options.free_space_px {
                against += other.confidence(at);
            }
        }
    }
    against > options.against_max * speak_for
}

/// Whether enough of the views `before` kept a Gaussian of the surface of Gaussian `i` of view `v`.
fn is_covered(
    surfaces: &[Surface<'_>],
    fates: &[Vec<Fate>],
    before: &[usize],
    v: usize,
    i: usize,
    options: &UnionOptions,
) -> bool {
    let own = &surfaces[v];
    let (world, finest) = (own.world(i), own.footprint(i));
    let covers = |&&w: &&usize| {
        let other = &surfaces[w];
        other.look(world).is_some_and(|Look { at, z, surface }| {
            fates[w][at] == Fate::Keep
                && other.footprint(at) <= finest * options.footprint_ratio_max
                && ((z - surface) / surface).abs() < options.same_surface
        })
    };
    before.iter().filter(covers).take(options.layers).count() >= options.layers
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

/// Median, 0 of nothing.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}
