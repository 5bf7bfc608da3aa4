//! One knob of time against error: what a view may differ from the exact one, and who spends it.
//!
//! A caller names the largest difference that it accepts, in levels of 255
//! ([`RenderRequest::error`]). [`Budget`] is the one place that says which part each spender gets.
//! What each does is true for every scene: the parts together are never over what was asked.
//!
//! **Rays end early.** When the transmittance of a ray is T, what is behind adds between `T low`
//! and `T high`: a blend of colours that lie between `low` and `high`, the least and the largest
//! colour of the scene and of its background. A ray that ends there takes the middle, and is wrong
//! by at most `T (high - low) / 2`. Sums of labels have no such middle: they are wrong by at most
//! T.

use std::str::FromStr;

use rayon::prelude::*;
use segsplat_core::scene::Gaussians;
use serde::{Deserialize, Deserializer, Serialize, de};

use crate::{
    Background, Kinds, Labels, RenderRequest,
    constants::{SH_OFFSET, TRANSMITTANCE_MIN},
    error::{Error, Result},
};

/// Largest error that a caller may accept, levels of 255.
pub const ERROR_MAX: f32 = 32.0;
/// The error that is called `fast`, levels of 255.
pub const ERROR_FAST: f32 = 2.0;
/// Share of a budget that is not spent, for the rounding of f32.
const RESERVE: f32 = 1e-3;
/// Gaussians that one task looks at.
const PART: usize = 1 << 14;

/// Refuses an error out of range.
///
/// # Errors
/// `invalid_request` with the value and the bounds.
pub fn check_error(error: f32) -> Result<()> {
    if (0.0..=ERROR_MAX).contains(&error) {
        return Ok(());
    }
    let bounds = format!("0 to {ERROR_MAX} levels of 255, exact (0) or fast ({ERROR_FAST})");
    Err(Error::invalid(format!("error is {error}; it must be {bounds}")))
}

/// The bound of a view's error where `error` is accepted, levels of 255. A view with depth is
/// exact: what is behind a ray may be at any depth.
pub fn bound(error: f32, kinds: Kinds) -> f32 {
    if kinds.depth { 0.0 } else { error }
}

/// The parts of a view's error, as shares of a picture's range of 1. Their sum is at most the
/// error that was asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Budget {
    /// For rays that end early.
    pub rays: f32,
}

impl Budget {
    /// The parts of the error of `request`: none for a view with depth, see [`bound`].
    pub fn of(request: &RenderRequest) -> Self {
        let all = bound(request.error, request.kinds) / 255.0 * (1.0 - RESERVE);
        Self { rays: all }
    }
}

/// Where the rays of a view end.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RayEnd {
    /// A ray goes no farther when its transmittance is this or less. [`TRANSMITTANCE_MIN`] where
    /// nothing may be spent: no ray that goes on has less.
    pub transmittance: f32,
    /// Colour of what is behind such a ray.
    pub behind: f32,
}

impl RayEnd {
    /// For a budget of `rays`, of Gaussians whose colours are 0 to `brightest`.
    pub fn new(rays: f32, request: &RenderRequest, brightest: f32) -> Self {
        let (mut low, mut high) = (0.0_f32, brightest.max(0.0));
        match &request.background {
            Background::Color(color) => {
                low = color.iter().copied().fold(low, f32::min);
                high = color.iter().copied().fold(high, f32::max);
            }
            Background::Backdrop(_) => high = high.max(1.0),
        }
        // Opacity is between 0 and 1.
        let span = if request.kinds.color { (high - low).max(1.0) } else { 1.0 };
        let share = if request.labels == Labels::None { 2.0 / span } else { (2.0 / span).min(1.0) };
        let transmittance = (rays * share).max(TRANSMITTANCE_MIN);
        Self { transmittance, behind: 0.5 * (low + high) }
    }
}

/// A bound of the colours of Gaussians from everywhere. Of each degree l the harmonics give at most
/// `√((2l + 1) / 4π)` times the length of their coefficients.
pub fn brightest(gaussians: &Gaussians) -> f32 {
    let count = gaussians.sh_count();
    let of_one = |sh: &[[f32; 3]]| {
        let of_channel = |channel: usize| {
            let mut sum = SH_OFFSET;
            let mut first = 0;
            for degree in 0..4_usize {
                let next = (degree + 1).pow(2);
                let Some(band) = sh.get(first..next) else { break };
                let squares: f32 = band.iter().map(|c| c[channel] * c[channel]).sum();
                let scale = ((2 * degree + 1) as f32 / (4.0 * std::f32::consts::PI)).sqrt();
                sum += match degree {
                    0 => band[0][channel] * scale,
                    _ => squares.sqrt() * scale,
                };
                first = next;
            }
            sum
        };
        of_channel(0).max(of_channel(1)).max(of_channel(2))
    };
    let parts = gaussians.sh().par_chunks(PART * count);
    let largest = |part: &[[f32; 3]]| part.chunks(count).map(of_one).fold(0.0, f32::max);
    parts.map(largest).reduce(|| 0.0, f32::max)
}

/// The largest error that a caller accepts, levels of 255: a number, or `exact` or `fast`. Any
/// number; [`check_error`] knows the bounds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
#[serde(transparent)]
pub struct MaxError(pub f32);

impl MaxError {
    /// What it must be, for messages.
    const SYNTAX: &str = "a number of levels, exact or fast";
}

impl FromStr for MaxError {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "exact" => Ok(Self(0.0)),
            "fast" => Ok(Self(ERROR_FAST)),
            _ => text.parse().map(Self).map_err(|_| format!("it must be {}", Self::SYNTAX)),
        }
    }
}

impl<'de> Deserialize<'de> for MaxError {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Visitor;
        impl de::Visitor<'_> for Visitor {
            type Value = MaxError;

            fn expecting(&self, to: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                to.write_str(MaxError::SYNTAX)
            }

            fn visit_str<E: de::Error>(self, text: &str) -> Result<MaxError, E> {
                text.parse().map_err(E::custom)
            }

            fn visit_f64<E>(self, levels: f64) -> Result<MaxError, E> {
                Ok(MaxError(levels as f32))
            }

            fn visit_u64<E>(self, levels: u64) -> Result<MaxError, E> {
                Ok(MaxError(levels as f32))
            }

            fn visit_i64<E>(self, levels: i64) -> Result<MaxError, E> {
                Ok(MaxError(levels as f32))
            }
        }
        from.deserialize_any(Visitor)
    }
}
