//! The exposure of each photo: a gain and a bias of each channel, which the steps move too.
//! WGSL: `shaders/exposure.wgsl`.

use rayon::prelude::*;

use super::adam::Moments;

/// What it costs to be another than gain 1, bias 0.
const EXPOSURE_COST: f32 = 1.0;
/// Largest change of a gain, or bias, of a photo.
const EXPOSURE_MAX: f32 = 0.5;
/// Pixels of a task.
const PIXELS_A_TASK: usize = 1 << 13;

/// What makes the colours of the scene those of a photo: gain and bias of each channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Gains.
    pub gain: [f32; 3],
    /// Biases, added after the gains.
    pub bias: [f32; 3],
    moments: [[Moments; 2]; 3],
    count: u16,
}

impl Default for Exposure {
    fn default() -> Self {
        Self::new([1.0; 3], [0.0; 3])
    }
}

impl Exposure {
    /// One that has not moved yet.
    #[must_use]
    pub fn new(gain: [f32; 3], bias: [f32; 3]) -> Self {
        Self { gain, bias, moments: Default::default(), count: 0 }
    }

    /// A colour as the photo has it.
    pub(super) fn of(&self, color: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|c| self.gain[c] * color[c] + self.bias[c])
    }

    /// Moves by what the loss says of the exposed picture.
    pub(super) fn step(&mut self, picture: &[[f32; 3]], by: &[[f32; 3]], rate: f32) {
        self.count = self.count.saturating_add(1);
        let parts: Vec<[[f32; 3]; 2]> = picture
            .par_chunks(PIXELS_A_TASK)
            .zip(by.par_chunks(PIXELS_A_TASK))
            .map(|(picture, by)| {
                let mut sums = [[0.0; 3]; 2];
                for (color, by) in picture.iter().zip(by) {
                    for c in 0..3 {
                        sums[0][c] += color[c] * by[c];
                        sums[1][c] += by[c];
                    }
                }
                sums
            })
            .collect();
        for c in 0..3 {
            let [mut by_gain, mut by_bias] =
                [0, 1].map(|which: usize| parts.iter().map(|part| part[which][c]).sum::<f32>());
            by_gain += 2.0 * EXPOSURE_COST * (self.gain[c] - 1.0);
            by_bias += 2.0 * EXPOSURE_COST * self.bias[c];
            let [gain, bias] = &mut self.moments[c];
            let moved = self.gain[c] - rate * gain.step(by_gain, self.count);
            self.gain[c] = moved.clamp(1.0 - EXPOSURE_MAX, 1.0 + EXPOSURE_MAX);
            let moved = self.bias[c] - rate * bias.step(by_bias, self.count);
            self.bias[c] = moved.clamp(-EXPOSURE_MAX, EXPOSURE_MAX);
        }
    }
}
