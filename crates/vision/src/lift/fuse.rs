//! Fusion: a surface that many photos show is kept from a few of them.
//!
//! Photos are taken one after another, the surest first. A Gaussian is dropped where at least
//! [`FuseOptions::layers`] photos before it *kept* a Gaussian of the same surface at that place,
//! no coarser than its own. So no hole opens, and a surface that sixty photos show has as many
//! layers as a surface that a few photos show.

use std::sync::atomic::AtomicBool;

use rayon::prelude::*;

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
}

impl Default for FuseOptions {
    fn default() -> Self {
        Self { layers: 4, same_surface: 0.02, footprint_ratio_max: 1.2 }
    }
}

/// What becomes of each Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fate {
    /// Kept.
    Keep,
    /// Was not a candidate: dropped for another reason before.
    Absent,
    /// The surface has enough layers already.
    Duplicate,
    /// Thinning merged it with its neighbours.
    Merged,
}

/// A view and what fusion needs of each of its pixels.
struct Surface<'a> {
    view: &'a ViewGaussians,
    /// `[H * W]` z in this view's camera of the pixel's own Gaussian; NaN where it is absent.
    depth: Vec<f32>,
    /// `[H * W]` which of them were kept; `None` until this view was decided.
    kept: Option<Vec<bool>>,
}

/// The fate of each Gaussian of each view; `candidate` says which are there at all.
pub(super) fn fuse(
    views: &[ViewGaussians],
    candidate: &[Vec<bool>],
    options: &FuseOptions,
    cancel: &AtomicBool,
) -> Result<Vec<Vec<Fate>>> {
    let mut fates: Vec<Vec<Fate>> = candidate
        .iter()
        .map(|row| row.iter().map(|&c| if c { Fate::Keep } else { Fate::Absent }).collect())
        .collect();
    if views.len() <= options.layers {
        return Ok(fates);
    }
    let mut surfaces: Vec<Surface<'_>> =
        views.iter().zip(candidate).map(|(view, keep)| Surface::new(view, keep)).collect();
    for v in surest_first(views) {
        unless_cancelled(cancel)?;
        let decided: Vec<Fate> = (0..views[v].len())
            .into_par_iter()
            .map(|i| match fates[v][i] {
                Fate::Keep => fate_of(&surfaces, options, v, i),
                other => other,
            })
            .collect();
        let kept = decided.iter().map(|fate| *fate == Fate::Keep).collect();
        surfaces[v].kept = Some(kept);
        fates[v] = decided;
    }
    Ok(fates)
}

/// Sum of the confidence of all pixels that have one.
pub(super) fn sum_of_confidence(view: &ViewGaussians) -> f64 {
    view.confidence.iter().filter(|c| c.is_finite()).map(|&c| f64::from(c)).sum()
}

/// Views by mean confidence, the surest first; ties by index.
fn surest_first(views: &[ViewGaussians]) -> Vec<usize> {
    let sure = |v: usize| -> f64 { sum_of_confidence(&views[v]) / views[v].len().max(1) as f64 };
    let mut order: Vec<(usize, f64)> = (0..views.len()).map(|v| (v, sure(v))).collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    order.into_iter().map(|(v, _)| v).collect()
}

fn fate_of(surfaces: &[Surface<'_>], options: &FuseOptions, v: usize, i: usize) -> Fate {
    let own = &surfaces[v];
    let world = own.view.frame_to_world.matrix().transform_point3(point(own.view.means[i]));
    let own_footprint = f64::from(own.depth[i]) / own.view.camera.intrinsics.fx;
    let mut covered = 0;
    for (w, other) in surfaces.iter().enumerate() {
        let (Some(kept), true) = (&other.kept, w != v) else { continue };
        let Some((at, z)) = other.look(world) else { continue };
        let seen = f64::from(other.depth[at]);
        let fine =
            seen / other.view.camera.intrinsics.fx <= own_footprint * options.footprint_ratio_max;
        if kept[at] && fine && ((z - seen) / seen).abs() <= options.same_surface {
            covered += 1;
        }
    }
    if covered >= options.layers { Fate::Duplicate } else { Fate::Keep }
}

impl<'a> Surface<'a> {
    fn new(view: &'a ViewGaussians, keep: &[bool]) -> Self {
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
        Self { view, depth, kept: None }
    }

    /// Pixel that shows a world point, and the depth of the point there.
    fn look(&self, world: glam::DVec3) -> Option<(usize, f64)> {
        let (seen, x, y) = seen_at(&self.view.camera, world)?;
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "inside")]
        let (x, y) = (x as usize, y as usize);
        Some((y * self.view.camera.intrinsics.width as usize + x, seen.z))
    }
}
