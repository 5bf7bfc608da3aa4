//! How far a picture is from a reference.

use std::collections::BTreeMap;

use serde::Serialize;

use super::generated::Random;
use crate::{
    error::Result,
    render::{
        Frame, RenderRequest,
        oracle::{self, OraclePixel},
    },
    scene::Gaussians,
};

/// Pixels apart by more than this are looked at by the oracle: one level of an 8-bit picture.
pub const DIFFERENCE_MAX: f32 = 1.0 / 255.0;
/// Pixels that the oracle is asked for.
pub const ORACLE_PIXELS: usize = 4096;

/// How a picture differs from a reference: colour, alpha, labels, and depth relative to depth.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Compared {
    /// Pixels compared.
    pub pixels: usize,
    /// Largest difference of the pixels that are not `flips`.
    pub max: f32,
    /// Mean difference of all pixels.
    pub mean: f64,
    /// Largest difference of all pixels, flips and faults too.
    pub worst: f32,
    /// PSNR of colour, dB; `None` where it was not drawn or is the same to the last bit.
    pub psnr_db: Option<f64>,
    /// Pixels apart by more than 1/255 where the oracle stands at a cliff.
    pub flips: usize,
    /// Pixels apart by more than 1/255 elsewhere: faults.
    pub faults: usize,
    /// The worst of them: column, row and difference.
    pub fault: Option<(u32, u32, f32)>,
    /// Median frame of the CPU renderer, for scale.
    pub cpu_median_ms: f64,
}

/// Largest difference of each pixel over its channels; a NaN is infinitely far.
pub(super) fn differences(got: &Frame, want: &Frame) -> Vec<f32> {
    fn pair<'a, T>(
        got: Option<&'a Vec<T>>,
        want: Option<&'a Vec<T>>,
    ) -> Option<(&'a [T], &'a [T])> {
        Some((got?.as_slice(), want?.as_slice()))
    }
    let colors = pair(got.color.as_ref(), want.color.as_ref());
    let depths = pair(got.depth.as_ref(), want.depth.as_ref());
    let alphas = pair(got.alpha.as_ref(), want.alpha.as_ref());
    let blends = pair(got.blend.as_ref(), want.blend.as_ref());
    let weights = got.weights.as_ref().zip(want.weights.as_ref());
    let pixels = want.width as usize * want.height as usize;
    (0..pixels)
        .map(|i| {
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
        })
        .collect()
}

fn psnr_db(got: &Frame, want: &Frame) -> Option<f64> {
    let (got, want) = (got.color.as_ref()?.as_flattened(), want.color.as_ref()?.as_flattened());
    let square = |(got, want): (&f32, &f32)| f64::from(got - want).powi(2);
    let mean = got.iter().zip(want).map(square).sum::<f64>() / got.len().max(1) as f64;
    (mean > 0.0).then(|| -10.0 * mean.log10())
}

/// The difference of two whole pictures; far pixels are shown to the oracle.
///
/// # Errors
/// Those of the oracle.
pub(super) fn compare(
    got: &Frame,
    want: &Frame,
    gaussians: &Gaussians,
    request: &RenderRequest,
) -> Result<Compared> {
    let apart = differences(got, want);
    let far: Vec<usize> = (0..apart.len()).filter(|&i| apart[i] > DIFFERENCE_MAX).collect();
    let pixels: Vec<[u32; 2]> =
        far.iter().map(|&i| [i as u32 % want.width, i as u32 / want.width]).collect();
    let truth = oracle::render_pixels(gaussians, request, oracle::DepthKey::F32, &pixels)?;
    let far = far.into_iter().zip(&pixels).zip(&truth);
    let far = far.map(|((i, &place), truth)| (i, place, truth));
    Ok(Compared::of(&apart, psnr_db(got, want), far))
}

/// The difference to the oracle, at places drawn by lot.
///
/// # Errors
/// Those of the oracle.
pub(super) fn compare_oracle(
    got: &Frame,
    gaussians: &Gaussians,
    request: &RenderRequest,
) -> Result<Compared> {
    let mut random = Random(3);
    let mut below = |side: u32| (random.range(0.0, side as f32) as u32).min(side - 1);
    let pixels: Vec<[u32; 2]> =
        (0..ORACLE_PIXELS).map(|_| [below(got.width), below(got.height)]).collect();
    let truth = oracle::render_pixels(gaussians, request, oracle::DepthKey::F32, &pixels)?;
    let width = ORACLE_PIXELS as u32;
    let want = Frame {
        width,
        height: 1,
        color: Some(truth.iter().map(|pixel| pixel.color.map(|v| v as f32)).collect()),
        depth: Some(truth.iter().map(|pixel| pixel.depth as f32).collect()),
        alpha: Some(truth.iter().map(|pixel| pixel.alpha as f32).collect()),
        ..Frame::default()
    };
    fn at<T: Copy>(pixels: &[[u32; 2]], width: u32, all: Option<&Vec<T>>) -> Option<Vec<T>> {
        let place = |&[x, y]: &[u32; 2]| (y * width + x) as usize;
        all.map(|all| pixels.iter().map(|pixel| all[place(pixel)]).collect())
    }
    let part = Frame {
        width,
        height: 1,
        color: at(&pixels, got.width, got.color.as_ref()),
        depth: at(&pixels, got.width, got.depth.as_ref()),
        alpha: at(&pixels, got.width, got.alpha.as_ref()),
        ..Frame::default()
    };
    let apart = differences(&part, &want);
    let far = (0..apart.len()).filter(|&i| apart[i] > DIFFERENCE_MAX);
    let far = far.map(|i| (i, pixels[i], &truth[i]));
    Ok(Compared::of(&apart, psnr_db(&part, &want), far))
}

impl Compared {
    /// Of differences a pixel; `far` are those over the bound, with their places and what the
    /// oracle sees there.
    fn of<'a>(
        apart: &[f32],
        psnr_db: Option<f64>,
        far: impl Iterator<Item = (usize, [u32; 2], &'a OraclePixel)>,
    ) -> Self {
        let near = apart.iter().copied().filter(|&d| d <= DIFFERENCE_MAX);
        let mut compared = Self {
            pixels: apart.len(),
            max: near.fold(0.0, f32::max),
            mean: apart.iter().map(|&d| f64::from(d)).sum::<f64>() / apart.len().max(1) as f64,
            worst: apart.iter().copied().fold(0.0, f32::max),
            psnr_db,
            ..Self::default()
        };
        for (i, [x, y], truth) in far {
            if truth.cliff.any() {
                compared.flips += 1;
                continue;
            }
            compared.faults += 1;
            if compared.fault.is_none_or(|(.., worst)| apart[i] > worst) {
                compared.fault = Some((x, y, apart[i]));
            }
        }
        compared
    }
}
