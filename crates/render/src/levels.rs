//! Pictures as files have them: 8-bit levels, and depth in 16-bit steps.
//! Shader: `shaders/depth_steps.wgsl`

use rayon::prelude::*;

/// Largest step of a depth; 0 is kept for "nothing there".
const STEPS: f64 = 65_535.0;
/// Pixels of a task.
const PIXELS_EACH: usize = 1 << 14;

/// Pictures in levels, row-major; `None` for kinds not asked for.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Levels {
    /// `[H * W]` colours over the background: [`crate::Samples::Levels`].
    pub rgb: Option<Vec<[u8; 3]>>,
    /// `[H * W]` colours over the background, with alpha: [`crate::Samples::LevelsRgba`].
    pub rgba: Option<Vec<[u8; 4]>>,
    /// `[H * W]` expected depth.
    pub depth: Option<DepthSteps>,
    /// `[H * W]` accumulated opacity.
    pub alpha: Option<Vec<u8>>,
}

/// Depths in steps of one size.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthSteps {
    /// `[H * W]` depths, `scale` each; 0 where alpha is 0, else at least 1.
    pub steps: Vec<u16>,
    /// World units of a step: the farthest depth has 65,535 of them. 1 where nothing is seen.
    pub scale: f64,
}

impl Default for DepthSteps {
    fn default() -> Self {
        Self { steps: Vec::new(), scale: 1.0 }
    }
}

impl DepthSteps {
    /// No depths, in steps for those up to `farthest`, world units.
    pub(crate) fn to(farthest: f32) -> Self {
        let scale = if farthest > 0.0 { f64::from(farthest) / STEPS } else { 1.0 };
        Self { steps: Vec::new(), scale }
    }

    /// From depths in world units, 0 or under where there is none.
    pub fn of(depth: &[f32]) -> Self {
        let farthest = |depths: &[f32]| {
            depths.iter().copied().filter(|d| d.is_finite()).fold(0.0_f32, f32::max)
        };
        let farthest = depth.par_chunks(PIXELS_EACH).map(farthest).reduce(|| 0.0, f32::max);
        let scale = Self::to(farthest).scale;
        let step = |&d: &f32| match d > 0.0 {
            true => (f64::from(d) / scale).round().clamp(1.0, STEPS) as u16,
            false => 0,
        };
        let steps = depth.par_iter().with_min_len(PIXELS_EACH).map(step).collect();
        Self { steps, scale }
    }
}

/// 0..1 as 0..255, clamped and rounded; NaN is 0.
#[inline]
pub fn level(value: f32) -> u8 {
    (value.clamp(0.0, 1.0) * 255.0 + 0.5) as u8
}
