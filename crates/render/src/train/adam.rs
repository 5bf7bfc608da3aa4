//! The numbers of Gaussians that are learnt, and Adam (Kingma and Ba 2015) for them.
//! WGSL: `shaders/adam.wgsl`.
//!
//! Scales move as logarithms and opacities as logits, as in 3DGS. Only Gaussians that the picture
//! shows move, and each counts its own steps for the correction of the moments.

use rayon::prelude::*;

use crate::{
    backward::Gradients,
    error::{Error, Result},
    scene::{Gaussians, RawGaussians},
};

/// Decay of the first and the second moment.
const DECAY: [f32; 2] = [0.9, 0.999];
const EPSILON: f32 = 1e-15;
/// Numbers of a Gaussian beside its colours: mean, quaternion, log-scales, logit of the opacity.
pub(crate) const SHAPE: usize = 3 + 4 + 3 + 1;
/// Largest opacity that is learnt: its logit is finite.
const OPACITY_MAX: f32 = 0.9999;
/// Largest |coefficient| that is learnt: far beyond any colour.
const SH_LEARNT_MAX: f32 = 64.0;
/// Gaussians of a task.
const CHUNK: usize = 1 << 12;

/// How far a number moves in a step. The default has the values of 3DGS, `means` as a share of the
/// scene's extent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LearningRates {
    /// Centres, world units.
    pub means: f32,
    /// Quaternions.
    pub quats: f32,
    /// Logarithms of scales.
    pub scales: f32,
    /// Logits of opacities.
    pub opacities: f32,
    /// Harmonics of degree 0.
    pub sh: f32,
    /// Harmonics of higher degrees.
    pub sh_rest: f32,
}

impl Default for LearningRates {
    fn default() -> Self {
        Self {
            means: 1.6e-4,
            quats: 1e-3,
            scales: 5e-3,
            opacities: 5e-2,
            sh: 2.5e-3,
            sh_rest: 2.5e-3 / 20.0,
        }
    }
}

impl LearningRates {
    /// All of them times `by`.
    #[must_use]
    pub fn scaled(&self, by: f32) -> Self {
        Self {
            means: self.means * by,
            quats: self.quats * by,
            scales: self.scales * by,
            opacities: self.opacities * by,
            sh: self.sh * by,
            sh_rest: self.sh_rest * by,
        }
    }
}

/// A moment pair that a number needs.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Moments([f32; 2]);

impl Moments {
    /// The step, in units of the rate, for `gradient`, the `count`-th one, counted from 1.
    pub(super) fn step(&mut self, gradient: f32, count: u16) -> f32 {
        let [mean, square] = &mut self.0;
        *mean = DECAY[0] * *mean + (1.0 - DECAY[0]) * gradient;
        *square = DECAY[1] * *square + (1.0 - DECAY[1]) * gradient * gradient;
        let [a, b] = DECAY.map(|decay| 1.0 - decay.powi(count.into()));
        let step = (*mean / a) / ((*square / b).sqrt() + EPSILON);
        if step.is_finite() { step } else { 0.0 }
    }
}

/// Moments of all Gaussians.
#[derive(Debug)]
pub(super) struct Adam {
    /// `[N, SHAPE + 3 K]`.
    moments: Vec<Moments>,
    /// `[N]` steps taken.
    counts: Vec<u16>,
    /// Numbers of a Gaussian.
    width: usize,
}

impl Adam {
    pub(super) fn new(gaussians: &Gaussians) -> Self {
        let width = SHAPE + 3 * gaussians.sh_count();
        let count = gaussians.len();
        Self { moments: vec![Moments::default(); count * width], counts: vec![0; count], width }
    }

    /// Moves the Gaussians that were seen.
    ///
    /// # Errors
    /// `internal` when a Gaussian would be lost, which is a fault of ours.
    pub(super) fn step(
        &mut self,
        gaussians: Gaussians,
        by: &Gradients,
        rates: &LearningRates,
    ) -> Result<Gaussians> {
        let k = gaussians.sh_count();
        let mut raw = gaussians.into_raw();
        let out = raw.means.par_chunks_mut(CHUNK).zip(raw.quats.par_chunks_mut(CHUNK));
        let out = out.zip(raw.scales.par_chunks_mut(CHUNK));
        let out =
            out.zip(raw.opacities.par_chunks_mut(CHUNK)).zip(raw.sh.par_chunks_mut(CHUNK * k));
        let out = out.zip(self.moments.par_chunks_mut(CHUNK * self.width));
        let out = out.zip(self.counts.par_chunks_mut(CHUNK)).enumerate();
        out.for_each(|(at, ((((((means, quats), scales), opacities), sh), moments), counts))| {
            let moments = moments.chunks_exact_mut(3 * k + SHAPE).zip(counts);
            for (j, (moments, count)) in moments.enumerate() {
                let i = at * CHUNK + j;
                if !by.seen[i] {
                    continue;
                }
                *count = count.saturating_add(1);
                let (shape, colours) = moments.split_at_mut(SHAPE);
                let mut step = |at: usize, by: f32| shape[at].step(by, *count);
                for c in 0..3 {
                    let moved = means[j][c] - rates.means * step(c, by.means[i][c]);
                    means[j][c] =
                        moved.clamp(-Gaussians::COORDINATE_MAX, Gaussians::COORDINATE_MAX);
                    let scale = &mut scales[j][c];
                    let more = (-rates.scales * step(7 + c, by.scales[i][c] * *scale)).exp();
                    *scale = (*scale * more).clamp(Gaussians::SCALE_MIN, Gaussians::SCALE_MAX);
                }
                for (c, (value, by)) in quats[j].iter_mut().zip(by.quats[i]).enumerate() {
                    *value -= rates.quats * step(3 + c, by);
                }
                let opacity = opacities[j].clamp(Gaussians::OPACITY_MIN, OPACITY_MAX);
                let slope = opacity * (1.0 - opacity);
                let logit = (opacity / (1.0 - opacity)).ln()
                    - rates.opacities * step(10, by.opacities[i] * slope);
                opacities[j] =
                    (1.0 / (1.0 + (-logit).exp())).clamp(Gaussians::OPACITY_MIN, OPACITY_MAX);
                let own = &mut sh[j * k..(j + 1) * k];
                let found = &by.sh[i * k..(i + 1) * k];
                let numbers = own.as_flattened_mut().iter_mut().zip(found.as_flattened());
                for (at, ((value, by), moments)) in numbers.zip(colours).enumerate() {
                    let rate = if at < 3 { rates.sh } else { rates.sh_rest };
                    let moved = *value - rate * moments.step(*by, *count);
                    *value = moved.clamp(-SH_LEARNT_MAX, SH_LEARNT_MAX);
                }
            }
        });
        checked(raw)
    }

    /// The Gaussians in these places have no moments any more, and as many come behind all.
    pub(super) fn begin_anew(&mut self, places: &[usize]) {
        for &i in places {
            self.moments[i * self.width..][..self.width].fill(Moments::default());
            self.counts[i] = 0;
        }
        let count = self.counts.len() + places.len();
        self.moments.resize(count * self.width, Moments::default());
        self.counts.resize(count, 0);
    }

    /// Drops the Gaussians whose opacity is under `least`.
    pub(super) fn prune(&mut self, gaussians: &Gaussians, least: f32) -> Gaussians {
        let keep = |i: usize| gaussians.opacities()[i] >= least;
        let width = self.width;
        let kept: Vec<usize> = (0..gaussians.len()).filter(|&i| keep(i)).collect();
        self.moments = kept
            .iter()
            .flat_map(|&i| self.moments[i * width..(i + 1) * width].iter().copied())
            .collect();
        self.counts = kept.iter().map(|&i| self.counts[i]).collect();
        gaussians.only(keep)
    }
}

/// The Gaussians of arrays that lose none.
///
/// # Errors
/// `internal` where one is lost.
pub fn checked(raw: RawGaussians) -> Result<Gaussians> {
    let count = raw.means.len();
    let (gaussians, report) = Gaussians::sanitize(raw)?;
    match gaussians.len() == count {
        true => Ok(gaussians),
        false => Err(Error::internal(format!("Gaussians lost: {report:?}"))),
    }
}
