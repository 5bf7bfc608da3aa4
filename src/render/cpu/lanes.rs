//! Eight f32 at once, in plain Rust that compiles to vector instructions, and a fast exp.
//!
//! Every function is inlined into its caller, so that it is compiled for the caller's processor.

use std::ops::{Add, Mul, Sub};

/// Eight lanes.
#[derive(Clone, Copy, Debug, PartialEq)]
#[repr(align(32))]
pub(super) struct F8(pub(super) [f32; 8]);

impl F8 {
    /// The same value in all lanes.
    #[inline(always)]
    #[must_use]
    pub(super) const fn splat(value: f32) -> Self {
        Self([value; 8])
    }

    #[inline(always)]
    fn map(self, f: impl Fn(f32) -> f32) -> Self {
        let mut out = self.0;
        for lane in &mut out {
            *lane = f(*lane);
        }
        Self(out)
    }

    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        let mut out = self.0;
        for (lane, other) in out.iter_mut().zip(other.0) {
            *lane = f(*lane, other);
        }
        Self(out)
    }

    /// The smaller of each lane and `bound`.
    #[inline(always)]
    #[must_use]
    pub(super) fn min(self, bound: f32) -> Self {
        self.map(|v| if v < bound { v } else { bound })
    }

    /// Lanes under `bound` become 0.
    #[inline(always)]
    #[must_use]
    pub(super) fn zero_under(self, bound: f32) -> Self {
        self.map(|v| if v >= bound { v } else { 0.0 })
    }

    /// Lanes where `test` is not over `bound` become 0.
    #[inline(always)]
    #[must_use]
    pub(super) fn zero_where_not_over(self, test: Self, bound: f32) -> Self {
        self.zip(test, |v, t| if t > bound { v } else { 0.0 })
    }

    /// Whether all lanes are 0.
    #[inline(always)]
    #[must_use]
    pub(super) fn is_zero(self) -> bool {
        self.0.iter().fold(0, |bits, lane| bits | lane.to_bits()) == 0
    }
}

impl Add for F8 {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.zip(other, |a, b| a + b)
    }
}

impl Sub for F8 {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.zip(other, |a, b| a - b)
    }
}

impl Mul for F8 {
    type Output = Self;
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.zip(other, |a, b| a * b)
    }
}

/// Powers above this are as good as infinite: e^-80 is far under any alpha that counts.
const POWER_MAX: f32 = 80.0;
/// Adding and taking away 1.5 · 2²³ rounds to a whole number, which stays in the low bits.
const ROUND: f32 = 12_582_912.0;
/// ln 2 in two parts; the first has few enough bits that its product with n is exact.
const LN_2_HIGH: f32 = 355.0 / 512.0;
const LN_2_LOW: f32 = -2.121_944_4e-4;

/// e^-power for power >= 0, within 2e-7 of its value (Cephes expf: e^x = 2^n e^f, |f| <= ½ ln 2).
#[inline(always)]
#[must_use]
pub(super) fn exp_neg(power: F8) -> F8 {
    power.map(|power| {
        let x = -(if power < POWER_MAX { power } else { POWER_MAX });
        let shifted = x * std::f32::consts::LOG2_E + ROUND;
        let n = shifted - ROUND;
        let f = (x - n * LN_2_HIGH) - n * LN_2_LOW;
        let p = 1.987_569_1e-4 * f + 1.398_2e-3;
        let p = p * f + 8.333_452e-3;
        let p = p * f + 4.166_579_6e-2;
        let p = p * f + 1.666_666_5e-1;
        let p = p * f + 0.5;
        let mantissa = p * f * f + f + 1.0;
        let scale = f32::from_bits((shifted.to_bits() << 23).wrapping_add(1.0_f32.to_bits()));
        mantissa * scale
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_neg_is_within_2e_7_of_the_exact_value() {
        let mut worst = 0.0_f64;
        for i in 0..2_000_000_u32 {
            let power = i as f32 * 4e-5;
            let got = f64::from(exp_neg(F8::splat(power)).0[3]);
            let want = (-f64::from(power)).exp();
            worst = worst.max((got / want - 1.0).abs());
        }
        assert!(worst < 2e-7, "relative error {worst:.2e}");
        assert_eq!(exp_neg(F8::splat(0.0)).0[0], 1.0, "e^0");
        assert!(exp_neg(F8::splat(f32::INFINITY)).0[0] < 1e-30, "e^-inf");
    }
}
