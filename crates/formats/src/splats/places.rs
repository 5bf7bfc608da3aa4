//! Whether positions keep their places in the steps of a format.
//!
//! A format that has positions as f32, or with a fixed point, has coarser steps the farther a scene
//! lies from zero. A step matters where it is not small against the Gaussian that it moves.

use glam::DVec3;

use crate::{error::Error, scene::Gaussians};

/// Share of a Gaussian's size (the middle one of its scales) that a step of its position may be.
const SHARE: f64 = 0.25;
/// Share of the Gaussians that must keep their places, and that the scene's radius reaches.
const KEPT: f64 = 0.9;
/// What counts as the size of a Gaussian without one: so small a share of the scene's radius.
const SIZE_MIN: f64 = 1.0 / 65_536.0;

/// A step of positions that is too coarse, and the largest that would not be, world units.
#[derive(Clone, Copy, Debug)]
pub(super) struct Coarse {
    pub(super) step: f32,
    pub(super) bound: f32,
}

impl Coarse {
    /// The worst step of all but a tenth of the Gaussians, where it is too coarse. `step` gives
    /// that at a position.
    pub(super) fn of(gaussians: &Gaussians, step: impl Fn(DVec3) -> f64) -> Option<Self> {
        if gaussians.is_empty() {
            return None;
        }
        let least = SIZE_MIN * reach(gaussians).1;
        let of_one = |i: usize| {
            let mut scales = gaussians.scales()[i];
            scales.sort_unstable_by(f32::total_cmp);
            let bound = SHARE * f64::from(scales[1]).max(least);
            Self { step: step(world(gaussians, i)) as f32, bound: bound as f32 }
        };
        let mut all: Vec<Self> = (0..gaussians.len()).map(of_one).collect();
        let at = ((all.len() - 1) as f64 * KEPT) as usize;
        let ratio = |one: &Self| one.step / one.bound;
        let (_, worst, _) = all.select_nth_unstable_by(at, |a, b| ratio(a).total_cmp(&ratio(b)));
        (ratio(worst) > 1.0).then_some(*worst)
    }

    /// Where positions are f32 of the world.
    pub(super) fn in_f32(gaussians: &Gaussians) -> Option<Self> {
        Self::of(gaussians, |at| f32_step(at.abs().max_element()))
    }

    /// The error of a format that has no finer steps.
    pub(super) fn refused(self, format: &str) -> Error {
        let Self { step, bound } = self;
        let bound = format!(
            "{bound}, a quarter of a Gaussian's size, for one of ten or more: the scene is too far \
             from zero for this format; ply, glb and sog keep it"
        );
        Error::limit(format!("{format}: step of positions, world units"), step, bound)
    }
}

/// The step of f32 at a coordinate.
fn f32_step(at: f64) -> f64 {
    let at = at as f32;
    f64::from(at.next_up() - at)
}

/// World position of Gaussian `i`.
pub(super) fn world(gaussians: &Gaussians, i: usize) -> DVec3 {
    gaussians.origin() + DVec3::from_array(gaussians.means()[i].map(f64::from))
}

/// The median centre of the Gaussians, of which there is one at least, about their origin, and the
/// radius of the sphere about it that has nine of ten.
pub(super) fn reach(gaussians: &Gaussians) -> (DVec3, f64) {
    let means = gaussians.means();
    let middle: [f32; 3] =
        std::array::from_fn(|k| quantile(means.iter().map(|mean| mean[k]).collect(), 0.5));
    let middle = DVec3::from_array(middle.map(f64::from));
    let away = |mean: &[f32; 3]| DVec3::from_array(mean.map(f64::from)).distance(middle) as f32;
    let radius = quantile(means.iter().map(away).collect(), KEPT);
    // Gaussians in one place are as large as the widest of them.
    let widest = gaussians.scales().iter().flatten().fold(0.0, |a: f32, b| a.max(*b));
    (middle, f64::from(if radius > 0.0 { radius } else { 3.0 * widest }))
}

/// The number that this share of all, of which there is one at least, is not over.
fn quantile(mut numbers: Vec<f32>, share: f64) -> f32 {
    let at = ((numbers.len() - 1) as f64 * share) as usize;
    *numbers.select_nth_unstable_by(at, f32::total_cmp).1
}
