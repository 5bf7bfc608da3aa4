//! Vectors of f32 as wide as the processor has them, by `pulp` (AVX-512, AVX2 with FMA, or what
//! every processor of the target has), and a fast power of two.
//!
//! A kernel is compiled once for each width. The renderer picks one when it is opened. Products and
//! sums are fused where the processor can, so the two wide forms agree to the last bit and the
//! portable one differs by rounding. Every function is inlined, so that it is compiled for the
//! width of its caller.

use std::ops::{Add, Div, Mul, Sub};

use pulp::Simd;
#[cfg(target_arch = "x86_64")]
use pulp::x86::{V3, V4};

use crate::switches::{Skip, Switches, Width};

/// One number for each of 16 pixels or cells, in one line of the cache.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C, align(64))]
pub(super) struct Numbers(pub(super) [f32; 16]);

impl Numbers {
    pub(super) const ZERO: Self = Self([0.0; 16]);
    pub(super) const ONE: Self = Self([1.0; 16]);

    /// Vector `i`.
    #[inline(always)]
    pub(super) fn at<S: Lanes>(&self, simd: S, i: usize) -> S::f32s {
        simd.load(&self.0, i)
    }

    /// Writes vector `i`.
    #[inline(always)]
    pub(super) fn put<S: Lanes>(&mut self, simd: S, i: usize, value: S::f32s) {
        simd.store(&mut self.0, i, value);
    }
}

/// How the kernels of a frame run. The default: the widest lanes, and no needless work.
#[derive(Clone, Copy, Debug)]
pub struct KernelOptions {
    /// Lanes.
    pub width: Width,
    /// Needless work that is done all the same.
    pub without: Option<Skip>,
}

impl KernelOptions {
    pub(super) fn new(switches: &Switches) -> Self {
        let width = switches.width().unwrap_or_else(Width::widest);
        Self { width, without: switches.without() }
    }

    /// Whether work of this kind is left out.
    #[inline]
    pub(super) fn skips(self, skip: Skip) -> bool {
        skip.applies(self.without)
    }
}

impl Default for KernelOptions {
    fn default() -> Self {
        Self::new(&Switches::default())
    }
}

impl Width {
    /// Runs `kernel`, compiled for this width, or for the next one if the processor lacks it.
    #[inline]
    pub(super) fn run<K: LaneKernel>(self, kernel: K) {
        #[cfg(target_arch = "x86_64")]
        {
            if self == Self::Sixteen
                && let Some(simd) = V4::try_new()
            {
                return simd.vectorize(Compiled { simd, kernel });
            }
            if self != Self::Four
                && let Some(simd) = V3::try_new()
            {
                return simd.vectorize(Compiled { simd, kernel });
            }
        }
        kernel.run(pulp::Scalar128b);
    }
}

/// Work that is compiled for each width.
pub(super) trait LaneKernel {
    /// Does the work; must be inlined.
    fn run<S: Lanes>(self, simd: S);
}

struct Compiled<S, K> {
    simd: S,
    kernel: K,
}

impl<S: Lanes, K: LaneKernel> pulp::NullaryFnOnce for Compiled<S, K> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        self.kernel.run(self.simd);
    }
}

/// A width, with operations that `pulp` lacks: a mask as bits, and fast products with a sum.
pub(super) trait Lanes: Simd {
    /// One bit for each lane, lane 0 the lowest.
    fn bits(self, mask: Self::m32s) -> u32;

    /// `a · b + c`, fused where the processor fuses.
    #[inline(always)]
    fn fused(self, a: Self::f32s, b: Self::f32s, c: Self::f32s) -> Self::f32s {
        self.mul_add_f32s(a, b, c)
    }

    /// `a · b + c`, fused where the processor fuses.
    #[inline(always)]
    fn fused_f64(self, a: Self::f64s, b: Self::f64s, c: Self::f64s) -> Self::f64s {
        self.mul_add_f64s(a, b, c)
    }

    /// `|a|`. That of `pulp` is a call for each vector: its `not_f32s` is not compiled for the
    /// width of the caller.
    #[inline(always)]
    fn abs(self, a: Self::f32s) -> Self::f32s {
        self.max_f32s(a, self.sub_f32s(self.splat_f32s(0.0), a))
    }

    /// Vector `i` of a row of numbers.
    #[inline(always)]
    fn load(self, row: &[f32; 16], i: usize) -> Self::f32s {
        Self::as_simd_f32s(row).0[i]
    }

    /// Writes vector `i` of a row of numbers.
    #[inline(always)]
    fn store(self, row: &mut [f32; 16], i: usize, value: Self::f32s) {
        Self::as_mut_simd_f32s(row).0[i] = value;
    }
}

#[cfg(target_arch = "x86_64")]
impl Lanes for V4 {
    #[inline(always)]
    fn bits(self, mask: Self::m32s) -> u32 {
        u32::from(mask.0)
    }
}

#[cfg(target_arch = "x86_64")]
impl Lanes for V3 {
    #[inline(always)]
    fn bits(self, mask: Self::m32s) -> u32 {
        self.avx._mm256_movemask_ps(pulp::cast(mask)).cast_unsigned()
    }
}

/// Whether every processor of the target fuses. Else a fused product is a function call.
const FUSES: bool = cfg!(any(target_arch = "aarch64", target_feature = "fma"));

impl Lanes for pulp::Scalar128b {
    #[inline(always)]
    fn fused(self, a: Self::f32s, b: Self::f32s, c: Self::f32s) -> Self::f32s {
        match FUSES {
            true => self.mul_add_f32s(a, b, c),
            false => self.add_f32s(self.mul_f32s(a, b), c),
        }
    }

    #[inline(always)]
    fn fused_f64(self, a: Self::f64s, b: Self::f64s, c: Self::f64s) -> Self::f64s {
        match FUSES {
            true => self.mul_add_f64s(a, b, c),
            false => self.add_f64s(self.mul_f64s(a, b), c),
        }
    }

    #[inline(always)]
    fn bits(self, mask: Self::m32s) -> u32 {
        let pulp::m32x4(a, b, c, d) = mask;
        [a, b, c, d].iter().rev().fold(0, |bits, lane| bits << 1 | u32::from(lane.is_set()))
    }
}

/// A row of f64 that vectors are read from and written to.
pub(super) type Row = [f64; 16];

/// A vector of f64 with the usual signs.
#[derive(Clone, Copy)]
pub(super) struct Wide<S: Lanes>(S, S::f64s);

impl<S: Lanes> Wide<S> {
    /// The same number in all lanes.
    #[inline(always)]
    pub(super) fn of(simd: S, value: f64) -> Self {
        Self(simd, simd.splat_f64s(value))
    }

    /// Vector `i` of a row.
    #[inline(always)]
    pub(super) fn at(simd: S, row: &Row, i: usize) -> Self {
        Self(simd, S::as_simd_f64s(row).0[i])
    }

    /// Writes it as vector `i` of a row.
    #[inline(always)]
    pub(super) fn put(self, row: &mut Row, i: usize) {
        S::as_mut_simd_f64s(row).0[i] = self.1;
    }

    /// `self · factor + term`, fused where the processor fuses.
    #[inline(always)]
    pub(super) fn times_plus(self, factor: Self, term: Self) -> Self {
        Self(self.0, self.0.fused_f64(self.1, factor.1, term.1))
    }

    #[inline(always)]
    pub(super) fn sqrt(self) -> Self {
        Self(self.0, self.0.sqrt_f64s(self.1))
    }

    #[inline(always)]
    pub(super) fn max(self, other: Self) -> Self {
        Self(self.0, self.0.max_f64s(self.1, other.1))
    }

    #[inline(always)]
    pub(super) fn min(self, other: Self) -> Self {
        Self(self.0, self.0.min_f64s(self.1, other.1))
    }

    /// Mask of the lanes that are at least those of `other`; NaN never is.
    #[inline(always)]
    pub(super) fn at_least(self, other: Self) -> S::m64s {
        self.0.less_than_or_equal_f64s(other.1, self.1)
    }

    /// These numbers in the lanes of `mask`, 0 in the others.
    #[inline(always)]
    pub(super) fn only(self, mask: S::m64s) -> Self {
        Self(self.0, self.0.select_f64s(mask, self.1, self.0.splat_f64s(0.0)))
    }

    /// Rounds down. For numbers under 2⁵⁰.
    #[inline(always)]
    pub(super) fn floor(self) -> Self {
        let (one, shift) = (Self::of(self.0, 1.0), Self::of(self.0, 6_755_399_441_055_744.0));
        let whole = (self + shift) - shift;
        whole - one.only(self.0.less_than_f64s(self.1, whole.1))
    }

    /// Rounds up. For numbers under 2⁵⁰.
    #[inline(always)]
    pub(super) fn ceil(self) -> Self {
        let (one, shift) = (Self::of(self.0, 1.0), Self::of(self.0, 6_755_399_441_055_744.0));
        let whole = (self + shift) - shift;
        whole + one.only(self.0.less_than_f64s(whole.1, self.1))
    }
}

macro_rules! operators {
    ($($operator:ident $name:ident $lanes:ident;)+) => {
        $(impl<S: Lanes> $operator for Wide<S> {
            type Output = Self;
            #[inline(always)]
            fn $name(self, other: Self) -> Self {
                Self(self.0, self.0.$lanes(self.1, other.1))
            }
        })+
    };
}

operators! {
    Add add add_f64s;
    Sub sub sub_f64s;
    Mul mul mul_f64s;
    Div div div_f64s;
}

/// Powers above this count as infinite: 2^-120 is far under 1/255.
const POWER_MAX: f32 = 120.0;
/// Adding and subtracting 1.5 · 2²³ rounds to an integer, which stays in the low bits.
const ROUND: f32 = 12_582_912.0;
/// 2^-g over |g| <= ½ to 9.2e-8 of its value (least largest relative error, by Lawson's weights).
#[expect(clippy::approx_constant, reason = "the best first term is not ln 2, and near it")]
const TERMS: [f32; 5] = [-0.693_147, 0.240_222_42, -0.055_507_336, 0.009_671_513, -0.001_326_472_7];

/// 2^-power for power >= 0, within 2e-7 of its value.
#[inline(always)]
pub(super) fn exp2_neg<S: Lanes>(simd: S, power: S::f32s) -> S::f32s {
    let x = simd.min_f32s(power, simd.splat_f32s(POWER_MAX));
    let round = simd.splat_f32s(ROUND);
    let shifted = simd.sub_f32s(round, x);
    // g = power less the nearest whole number.
    let g = simd.add_f32s(x, simd.sub_f32s(shifted, round));
    let mut mantissa = simd.splat_f32s(TERMS[4]);
    for coefficient in [TERMS[3], TERMS[2], TERMS[1], TERMS[0], 1.0] {
        mantissa = simd.fused(mantissa, g, simd.splat_f32s(coefficient));
    }
    let whole = simd.transmute_u32s_f32s(shifted);
    let exponent = simd.wrapping_dyn_shl_u32s(whole, simd.splat_u32s(23));
    simd.transmute_f32s_u32s(simd.add_u32s(simd.transmute_u32s_f32s(mantissa), exponent))
}

/// log2(1 + r) over 0 <= r <= 1 to 2.2e-6, as r times a polynomial of r (least largest error, by
/// Lawson's weights).
const LOG_TERMS: [f32; 6] =
    [1.442_553_2, -0.718_281_9, 0.458_270_76, -0.279_538, 0.123_451_36, -0.026_457_405];
/// Its last bits count by one.
const WHOLE: f32 = 8_388_608.0;

/// The natural logarithm of finite numbers from 1 on, within 3e-6.
#[inline(always)]
pub(super) fn ln<S: Lanes>(simd: S, value: S::f32s) -> S::f32s {
    let one = simd.splat_f32s(1.0);
    let bits = simd.transmute_u32s_f32s(value);
    let exponent = simd.wrapping_dyn_shr_u32s(bits, simd.splat_u32s(23));
    let exponent = simd.or_u32s(exponent, simd.splat_u32s(WHOLE.to_bits()));
    let biased = simd.splat_f32s(WHOLE + 127.0);
    let exponent = simd.sub_f32s(simd.transmute_f32s_u32s(exponent), biased);
    let mantissa = simd.and_u32s(bits, simd.splat_u32s(0x007f_ffff));
    let mantissa = simd.or_u32s(mantissa, simd.splat_u32s(1.0_f32.to_bits()));
    let rest = simd.sub_f32s(simd.transmute_f32s_u32s(mantissa), one);
    let mut log = simd.splat_f32s(LOG_TERMS[LOG_TERMS.len() - 1]);
    for &term in LOG_TERMS.iter().rev().skip(1) {
        log = simd.fused(log, rest, simd.splat_f32s(term));
    }
    let log = simd.fused(log, rest, exponent);
    simd.mul_f32s(log, simd.splat_f32s(std::f32::consts::LN_2))
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Powers<'a> {
        from: &'a [[f32; 16]],
        to: &'a mut [[f32; 16]],
    }

    impl LaneKernel for Powers<'_> {
        #[inline(always)]
        fn run<S: Lanes>(self, simd: S) {
            for (from, to) in self.from.iter().zip(self.to) {
                for i in 0..16 / S::F32_LANES {
                    simd.store(to, i, exp2_neg(simd, simd.load(from, i)));
                }
            }
        }
    }

    struct Logarithms<'a>(&'a [[f32; 16]], &'a mut [[f32; 16]]);

    impl LaneKernel for Logarithms<'_> {
        #[inline(always)]
        fn run<S: Lanes>(self, simd: S) {
            for (from, to) in self.0.iter().zip(self.1) {
                for i in 0..16 / S::F32_LANES {
                    simd.store(to, i, ln(simd, simd.load(from, i)));
                }
            }
        }
    }

    #[test]
    fn logarithms_are_within_3e_6_at_every_width() {
        let of = |i: usize| (1.0 + i as f32 * 1e-3).powi(1 + (i % 3) as i32);
        let values: Vec<[f32; 16]> =
            (0..20_000).map(|i| std::array::from_fn(|k| of(16 * i + k))).collect();
        for width in Width::ALL.into_iter().filter(|width| width.available()) {
            let mut got = vec![[0.0; 16]; values.len()];
            width.run(Logarithms(&values, &mut got));
            for (got, value) in got.iter().flatten().zip(values.iter().flatten()) {
                let want = f64::from(*value).ln();
                let most = 3e-6_f64.max(2e-7 * want);
                assert!((f64::from(*got) - want).abs() < most, "{width:?}: ln {value} is {got}");
            }
        }
    }

    #[test]
    fn powers_of_two_are_within_2e_7_at_every_width() {
        let powers: Vec<[f32; 16]> = (0..80_000_u32)
            .map(|i| std::array::from_fn(|k| (16 * i + k as u32) as f32 * 9e-5))
            .collect();
        let of = |width: Width| {
            let mut got = vec![[0.0; 16]; powers.len()];
            width.run(Powers { from: &powers, to: &mut got });
            got
        };
        for width in Width::ALL.into_iter().filter(|width| width.available()) {
            let mut worst = 0.0_f64;
            let got = of(width);
            for (got, power) in got.iter().flatten().zip(powers.iter().flatten()) {
                let want = (-f64::from(*power)).exp2();
                worst = worst.max((f64::from(*got) / want - 1.0).abs());
            }
            assert!(worst < 2e-7, "{width:?}: relative error {worst:.2e}");
            assert_eq!(got[0][0], 1.0, "2^0");
            let mut last = [[0.0; 16]];
            width.run(Powers { from: &[[f32::INFINITY; 16]], to: &mut last });
            assert!(last[0][0] < 1e-30, "{width:?}: 2^-inf is {}", last[0][0]);
        }
        if Width::Sixteen.available() {
            assert!(of(Width::Sixteen) == of(Width::Eight), "the wide forms differ");
        }
    }

    struct Masks<'a>(&'a mut u32);

    impl LaneKernel for Masks<'_> {
        #[inline(always)]
        fn run<S: Lanes>(self, simd: S) {
            let row: [f32; 16] = std::array::from_fn(|k| k as f32);
            for i in 0..16 / S::F32_LANES {
                let odd = simd.greater_than_f32s(simd.load(&row, i), simd.splat_f32s(6.5));
                *self.0 |= simd.bits(odd) << (i * S::F32_LANES);
            }
        }
    }

    #[test]
    fn bits_of_a_mask_are_in_the_order_of_the_lanes() {
        for width in Width::ALL.into_iter().filter(|width| width.available()) {
            let mut bits = 0;
            width.run(Masks(&mut bits));
            assert_eq!(bits, 0xff80, "{width:?}");
        }
    }
}
