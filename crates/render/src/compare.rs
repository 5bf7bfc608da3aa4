//! How much a picture differs from a reference. `segsplat bench`, the laboratory and the tests use
//! it.

use std::collections::BTreeMap;

use rayon::prelude::*;
use serde::Serialize;

use crate::{
    Frame, RenderRequest,
    error::Result,
    oracle::{self, OraclePixel},
    scene::Gaussians,
};

/// The oracle judges pixels that differ by more than this: one level of an 8-bit picture.
pub const DIFFERENCE_MAX: f32 = 1.0 / 255.0;
/// Pixels that are compared with the oracle.
pub const ORACLE_PIXELS: usize = 4096;
/// PSNR that stands for equal pictures, dB.
pub const PSNR_MAX: f64 = 200.0;
/// Pixels that are summed by one task.
const PART: usize = 1 << 14;

/// Differences between a picture and a reference, over all pixels: those of colour, alpha and
/// labels, and of depth relative to depth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Compared {
    /// Pixels compared.
    pub pixels: usize,
    /// Largest difference of all pixels.
    pub max: f32,
    /// Largest difference of the pixels that are no flips.
    pub max_without_flips: f32,
    /// Mean difference of all pixels.
    pub mean: f64,
    /// PSNR of colour, dB; `None` where it was not drawn.
    pub psnr_db: Option<f64>,
    /// Pixels that differ by more than [`DIFFERENCE_MAX`] where the oracle finds a cliff: a
    /// rounding of f32 there decides whether a Gaussian counts.
    pub flips: usize,
    /// Pixels that differ by more than [`DIFFERENCE_MAX`] elsewhere: faults.
    pub faults: usize,
    /// The worst fault: column, row and difference.
    pub fault: Option<(u32, u32, f32)>,
}

/// Peak signal-to-noise ratio in dB of colours in 0..1, over the pixels that are valid; at most
/// [`PSNR_MAX`].
pub fn psnr(picture: &[[f32; 3]], truth: &[[f32; 3]], valid: Option<&[bool]>) -> f64 {
    // In parts of the same size on every machine, so that the sum is the same.
    let parts = picture.par_chunks(PART).zip(truth.par_chunks(PART)).enumerate();
    let sums = parts.map(|(at, (picture, truth))| {
        let known = |i: usize| valid.is_none_or(|valid| valid[at * PART + i]);
        let pixels = picture.iter().zip(truth).enumerate().filter(|(i, _)| known(*i));
        pixels.fold((0.0, 0_u64), |(sum, count), (_, (a, b))| {
            let squares = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2));
            (sum + squares.sum::<f64>(), count + 3)
        })
    });
    let sums: Vec<(f64, u64)> = sums.collect();
    let (sum, count) = sums.iter().fold((0.0, 0), |all, part| (all.0 + part.0, all.1 + part.1));
    if count == 0 || sum <= 0.0 {
        return PSNR_MAX;
    }
    (-10.0 * (sum / count as f64).log10()).min(PSNR_MAX)
}

/// Largest difference of each pixel over its channels; a NaN is infinitely far.
pub fn differences(got: &Frame, want: &Frame) -> Vec<f32> {
    let colors = got.color.as_ref().zip(want.color.as_ref());
    let depths = got.depth.as_ref().zip(want.depth.as_ref());
    let alphas = got.alpha.as_ref().zip(want.alpha.as_ref());
    let blends = got.blend.as_ref().zip(want.blend.as_ref());
    let weights = got.weights.as_ref().zip(want.weights.as_ref());
    let of_pixel = |i: usize| {
        let mut worst = 0.0_f32;
        let mut add = |difference: f32| {
            let d = if difference.is_nan() { f32::INFINITY } else { difference.abs() };
            worst = worst.max(d);
        };
        if let Some((got, want)) = colors {
            (0..3).for_each(|k| add(got[i][k] - want[i][k]));
        }
        if let Some((got, want)) = depths {
            add((got[i] - want[i]) / want[i].abs().max(1.0));
        }
        if let Some((got, want)) = alphas {
            add(got[i] - want[i]);
        }
        if let Some((got, want)) = blends {
            (0..4).for_each(|k| add(got[i][k] - want[i][k]));
        }
        if let Some((got, want)) = weights {
            let mut sums: BTreeMap<u16, f32> = got.pixel(i).collect();
            want.pixel(i).for_each(|(m, weight)| *sums.entry(m).or_default() -= weight);
            sums.into_values().for_each(&mut add);
        }
        worst
    };
    (0..want.width as usize * want.height as usize).map(of_pixel).collect()
}

/// The difference of two whole pictures; the oracle judges pixels that are far apart.
///
/// # Errors
/// Those of the oracle.
pub fn compare(
    got: &Frame,
    want: &Frame,
    gaussians: &Gaussians,
    request: &RenderRequest,
) -> Result<Compared> {
    let apart = differences(got, want);
    let far: Vec<usize> = (0..apart.len()).filter(|&i| apart[i] > DIFFERENCE_MAX).collect();
    let pixels: Vec<[u32; 2]> =
        far.iter().map(|&i| [i as u32 % want.width, i as u32 / want.width]).collect();
    let truth = oracle::render_pixels(gaussians, request, &pixels)?;
    let far = far.into_iter().zip(pixels).zip(&truth).map(|((i, at), truth)| (i, at, truth));
    Ok(Compared::of(&apart, got, want, far))
}

/// The difference to the oracle at [`ORACLE_PIXELS`] pixels, spread over the picture.
///
/// # Errors
/// Those of the oracle.
pub fn compare_oracle(
    got: &Frame,
    gaussians: &Gaussians,
    request: &RenderRequest,
) -> Result<Compared> {
    let all = u64::from(got.width) * u64::from(got.height);
    // Steps of the golden ratio: every part of the picture, no pattern.
    let place = |i: u64| {
        let share = ((i.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 32) * all) >> 32;
        [(share % u64::from(got.width)) as u32, (share / u64::from(got.width)) as u32]
    };
    let pixels: Vec<[u32; 2]> = (0..ORACLE_PIXELS as u64).map(place).collect();
    let truth = oracle::render_pixels(gaussians, request, &pixels)?;
    let width = ORACLE_PIXELS as u32;
    let blank = || Frame { width, height: 1, ..Frame::default() };
    let want = Frame {
        color: Some(truth.iter().map(|pixel| pixel.color.map(|v| v as f32)).collect()),
        depth: Some(truth.iter().map(|pixel| pixel.depth as f32).collect()),
        alpha: Some(truth.iter().map(|pixel| pixel.alpha as f32).collect()),
        ..blank()
    };
    fn at<T: Copy>(pixels: &[[u32; 2]], width: u32, all: Option<&Vec<T>>) -> Option<Vec<T>> {
        let place = |&[x, y]: &[u32; 2]| (y * width + x) as usize;
        all.map(|all| pixels.iter().map(|pixel| all[place(pixel)]).collect())
    }
    let part = Frame {
        color: at(&pixels, got.width, got.color.as_ref()),
        depth: at(&pixels, got.width, got.depth.as_ref()),
        alpha: at(&pixels, got.width, got.alpha.as_ref()),
        ..blank()
    };
    let apart = differences(&part, &want);
    let far = (0..apart.len()).filter(|&i| apart[i] > DIFFERENCE_MAX);
    Ok(Compared::of(&apart, &part, &want, far.map(|i| (i, pixels[i], &truth[i]))))
}

impl Compared {
    /// Of differences a pixel; `far` are those over the bound, with their places and what the
    /// oracle sees there.
    fn of<'a>(
        apart: &[f32],
        got: &Frame,
        want: &Frame,
        far: impl Iterator<Item = (usize, [u32; 2], &'a OraclePixel)>,
    ) -> Self {
        let largest = |all: &[f32]| all.iter().copied().fold(0.0, f32::max);
        let colors = got.color.as_ref().zip(want.color.as_ref());
        let mut rest = apart.to_vec();
        let mut compared = Self {
            pixels: apart.len(),
            max: largest(apart),
            mean: apart.iter().map(|&d| f64::from(d)).sum::<f64>() / apart.len().max(1) as f64,
            psnr_db: colors.map(|(got, want)| psnr(got, want, None)),
            ..Self::default()
        };
        for (i, [x, y], truth) in far {
            if truth.cliff.any() {
                compared.flips += 1;
                rest[i] = 0.0;
                continue;
            }
            compared.faults += 1;
            if compared.fault.is_none_or(|(.., worst)| apart[i] > worst) {
                compared.fault = Some((x, y, apart[i]));
            }
        }
        compared.max_without_flips = largest(&rest);
        compared
    }
}
