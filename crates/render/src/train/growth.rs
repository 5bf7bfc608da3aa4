//! More Gaussians where a scene differs from its photos.
//!
//! A Gaussian is *blamed* for the absolute differences of the pixels that it covers, each times the
//! weight that it has there (Rota Bulò et al. 2024, "Revising Densification in Gaussian
//! Splatting"). That is what the backward pass gives by its colour where the loss says the absolute
//! difference of each number of the picture. Those that are blamed most become two.

use crate::scene::SourcePixel;

/// How far the halves lie from the centre, as a share of the longest axis, and what is left of that
/// axis: the variance along it stays, `0.6² + 0.8² = 1`.
const APART: f32 = 0.6;
const SHORTER: f32 = 0.8;

/// The places of the `count` Gaussians that are blamed most, or of all that are blamed at all, the
/// most blamed first; of equals the first.
pub(crate) fn most_blamed(blame: &[f32], count: usize) -> Vec<usize> {
    let mut places: Vec<usize> = (0..blame.len()).filter(|&i| blame[i] > 0.0).collect();
    let more = |a: &usize, b: &usize| blame[*b].total_cmp(&blame[*a]).then(a.cmp(b));
    if count < places.len() {
        places.select_nth_unstable_by(count, more);
        places.truncate(count);
    }
    places.sort_unstable_by(more);
    places
}

/// Centre and scales of the two halves of a Gaussian, side by side along its longest axis. `quat`
/// is wxyz, of length 1.
pub(crate) fn halves(mean: [f32; 3], quat: [f32; 4], scale: [f32; 3]) -> [([f32; 3], [f32; 3]); 2] {
    let longest = (0..3).max_by(|&a, &b| scale[a].total_cmp(&scale[b])).unwrap_or(0);
    let [w, x, y, z] = quat;
    let axis = glam::Quat::from_xyzw(x, y, z, w) * glam::Vec3::AXES[longest];
    let away = axis * (APART * scale[longest]);
    let mut shorter = scale;
    shorter[longest] *= SHORTER;
    let mean = glam::Vec3::from(mean);
    [((mean - away).into(), shorter), ((mean + away).into(), shorter)]
}

/// What steps do not move of Gaussians: where each came from, and its entry of the bank.
#[derive(Clone, Debug, Default)]
pub(crate) struct Origins {
    /// `[N]`
    pub(crate) source: Vec<SourcePixel>,
    /// `[N]`
    pub(crate) semantic_index: Vec<u16>,
}
