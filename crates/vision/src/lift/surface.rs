//! What each photo has at each of its pixels, and what becomes of its Gaussians.

use glam::DVec3;
use rayon::prelude::*;

use crate::{point, scene::ViewGaussians, seen_at};

/// Pixels that one thread takes at a time.
pub(super) const PIXELS_A_TASK: usize = 1 << 11;

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

/// Median, 0 of nothing.
pub(super) fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}
