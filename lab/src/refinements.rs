//! Refinements to measure, as the command line names them: `ms=5000,rate=2`.

use std::{str::FromStr, time::Duration};

use serde::{Deserialize, Serialize};

use crate::{
    error::{Error, Result},
    pipeline::Reconstruction,
    refine::{LearningRates, RefineBudget, RefineOptions},
    scene::{Gaussians, with_pairs},
};

/// How a scene is refined: what is not named is as the product does it.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(crate) struct Variant {
    /// Whether it begins with the Gaussians that are served in layers.
    layers: bool,
    /// So many steps, or so much time.
    steps: u32,
    ms: u64,
    side: u32,
    gaussians_first: usize,
    gaussians_a_pixel: f32,
    gaussians_max: usize,
    growth: f32,
    coarse_share: f32,
    first_steps: u32,
    gain_min: f64,
    batch: usize,
    prune_every: u32,
    opacity_min: f32,
    ssim_share: f32,
    pose_rate: f32,
    mends_from: f64,
    proof_share: f32,
    overfit_max: f32,
    overfit_further: f32,
    device_bytes_max: u64,
    /// Factors on learning rates: on all, and on single ones.
    rate: f32,
    means: f32,
    quats: f32,
    scales: f32,
    opacities: f32,
    sh: f32,
}

impl Default for Variant {
    fn default() -> Self {
        let plain = RefineOptions::default();
        Self {
            layers: false,
            steps: u32::MAX,
            ms: u64::MAX,
            side: plain.side,
            gaussians_first: plain.gaussians_first,
            gaussians_a_pixel: plain.gaussians_a_pixel,
            gaussians_max: plain.gaussians_max,
            growth: plain.growth,
            coarse_share: plain.coarse_share,
            first_steps: plain.first_steps,
            gain_min: plain.gain_min,
            batch: plain.batch,
            prune_every: plain.prune_every,
            opacity_min: plain.opacity_min,
            ssim_share: plain.ssim_share,
            pose_rate: plain.pose_rate,
            mends_from: plain.mends_from,
            proof_share: plain.proof_share,
            overfit_max: plain.overfit_max,
            overfit_further: plain.overfit_further,
            device_bytes_max: plain.device_bytes_max,
            rate: 1.0,
            means: 1.0,
            quats: 1.0,
            scales: 1.0,
            opacities: 1.0,
            sh: 1.0,
        }
    }
}

impl Variant {
    /// What it begins with, of a scene and its one set of Gaussians.
    pub(crate) fn start(
        &self,
        (made, one_set): (Reconstruction, Gaussians),
    ) -> (Reconstruction, Gaussians) {
        if self.layers { (made.clone(), made.gaussians) } else { (made, one_set) }
    }

    /// Time that it was given: without end where it counts steps, so that they are all that counts.
    fn time(&self) -> Duration {
        if self.ms < u64::MAX { Duration::from_millis(self.ms) } else { Duration::MAX }
    }

    /// Seconds that it was given; none where it counts steps.
    pub(crate) fn asked_s(&self) -> Option<f64> {
        (self.ms < u64::MAX).then_some(self.ms as f64 / 1e3)
    }

    /// The options of the product with these in their place.
    pub(crate) fn options(&self) -> RefineOptions {
        let plain = RefineOptions::default();
        let rates = plain.rates.scaled(self.rate);
        RefineOptions {
            budget: RefineBudget { steps: self.steps, time: self.time() },
            batch: self.batch,
            side: self.side,
            rates: LearningRates {
                means: rates.means * self.means,
                quats: rates.quats * self.quats,
                scales: rates.scales * self.scales,
                opacities: rates.opacities * self.opacities,
                sh: rates.sh * self.sh,
                sh_rest: rates.sh_rest * self.sh,
            },
            gaussians_first: self.gaussians_first,
            gaussians_a_pixel: self.gaussians_a_pixel,
            gaussians_max: self.gaussians_max,
            growth: self.growth,
            coarse_share: self.coarse_share,
            first_steps: self.first_steps,
            gain_min: self.gain_min,
            opacity_min: self.opacity_min,
            prune_every: self.prune_every,
            ssim_share: self.ssim_share,
            pose_rate: self.pose_rate,
            mends_from: self.mends_from,
            proof_share: self.proof_share,
            overfit_max: self.overfit_max,
            overfit_further: self.overfit_further,
            device_bytes_max: self.device_bytes_max,
            ..plain
        }
    }
}

impl FromStr for Variant {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let pairs: Vec<String> = text.split(',').map(str::to_owned).collect();
        with_pairs(&Self::default(), &pairs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_variant_of_steps_has_no_end_in_time() {
        let budget = |text: &str| text.parse::<Variant>().expect("a variant").options().budget;
        assert_eq!(budget("steps=400"), RefineBudget::steps(400));
        let timed = RefineBudget { steps: u32::MAX, time: Duration::from_millis(5_000) };
        assert_eq!(budget("ms=5000"), timed);
    }
}
