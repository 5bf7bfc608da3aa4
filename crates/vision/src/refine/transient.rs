//! Things that are in single photos alone: somebody who walks through the scene.
//!
//! The Gaussians that a photo made itself look right from where it stands, so what passes is found
//! by those of the other photos: where these cover a pixel and show something else there, over an
//! area and by far more than elsewhere in the photo, the photo shows what the others do not. Both
//! are blurred first, for edges that are off by a pixel say nothing.

use std::mem::take;

use rayon::prelude::*;
use segsplat_render::{DifferentiableRenderer, Kinds, RenderRequest, train::unit};

use super::{COVERED, GAINS, plain_view};
use crate::{
    error::Result,
    scene::{Gaussians, IndexMap, PosedPhoto, Scene},
};

/// Longer side at which photos are compared, pixels.
pub const TRANSIENT_SIDE: u32 = 320;
/// Pixels on each side that are blurred, and that an area is made wider by.
const BLUR: usize = 4;
/// Share of the pixels of a window that must be known.
const KNOWN_MIN: f32 = 0.5;
/// Rounds in which the exposure is fitted, and the share of the pixels that stay for the next one.
const EXPOSURE_ROUNDS: usize = 4;
const EXPOSURE_KEEPS: f64 = 0.7;
/// Differences, in 0..1 and as a multiple of the photo's median: an area reaches as far as the
/// first ones, and counts where it somewhere has the second ones.
const REACHES: [f32; 2] = [0.06, 2.0];
const COUNTS: [f32; 2] = [0.12, 4.0];
/// Share of a photo that an area must have.
const AREA_MIN: f64 = 0.004;

/// Of each photo the cells that show what passes (1), by what the Gaussians of the other photos
/// show there, over what is behind those of `start`. Photos are those of the scene, in their order,
/// with a longer side of [`TRANSIENT_SIDE`] at most.
///
/// # Errors
/// What the renderer says.
pub fn transient(
    renderer: &dyn DifferentiableRenderer,
    start: &Scene,
    gaussians: &Gaussians,
    photos: &[PosedPhoto],
) -> Result<Vec<IndexMap>> {
    let of_photo = |(i, posed): (usize, &PosedPhoto)| {
        let others = gaussians.only(|at| usize::from(gaussians.source()[at].view) != i);
        transient_of(renderer, start, &others, posed)
    };
    photos.iter().enumerate().map(of_photo).collect()
}

/// The same of one photo that none of the Gaussians came from.
///
/// # Errors
/// What the renderer says.
pub(crate) fn transient_of(
    renderer: &dyn DifferentiableRenderer,
    start: &Scene,
    others: &Gaussians,
    posed: &PosedPhoto,
) -> Result<IndexMap> {
    let kinds = Kinds { alpha: true, ..Kinds::COLOR };
    let request = RenderRequest { kinds, ..plain_view(start, posed.camera) };
    let frame = renderer.render(others, &request)?;
    let (color, alpha) = (frame.color.unwrap_or_default(), frame.alpha.unwrap_or_default());
    let photo = unit(&posed.photo);
    let valid = posed.photo.valid.as_deref();
    let known = |i: usize| alpha[i] >= COVERED && valid.is_none_or(|valid| valid[i]);
    let known: Vec<bool> = (0..photo.len()).map(known).collect();
    Ok(contradicted(&color, &photo, &known, posed.photo.width as usize))
}

/// The pixels of a photo of this width that show something else than `shown` does, where it is
/// known.
fn contradicted(shown: &[[f32; 3]], photo: &[[f32; 3]], known: &[bool], width: usize) -> IndexMap {
    let height = photo.len() / width.max(1);
    let apart = exposed(shown, photo, known);
    let blurred = blurred(&apart, known, width);
    let mut sorted: Vec<f32> = blurred.iter().copied().filter(|v| *v >= 0.0).collect();
    sorted.sort_unstable_by(f32::total_cmp);
    let median = sorted.get(sorted.len() / 2).copied().unwrap_or(0.0);
    let [reaches, counts] = [REACHES, COUNTS].map(|[least, times]| least.max(times * median));
    let areas = areas(&blurred, width, reaches, counts);
    let index = areas.into_iter().map(u16::from).collect();
    let [width, height] = [width, height].map(|side| u32::try_from(side).unwrap_or(u32::MAX));
    IndexMap { width, height, index }.wider(BLUR)
}

/// What is shown less the photo, after the gain and the bias that fit most of the known pixels.
fn exposed(shown: &[[f32; 3]], photo: &[[f32; 3]], known: &[bool]) -> Vec<[f32; 3]> {
    let mut fits: Vec<usize> = (0..photo.len()).filter(|&i| known[i]).collect();
    let mut exposure = [[1.0_f64, 0.0]; 3];
    for round in 0..EXPOSURE_ROUNDS {
        if fits.is_empty() {
            break;
        }
        for (c, [gain, bias]) in exposure.iter_mut().enumerate() {
            let mut sums = [0.0; 4];
            for &i in &fits {
                let (x, y) = (f64::from(shown[i][c]), f64::from(photo[i][c]));
                sums = [sums[0] + x, sums[1] + y, sums[2] + x * x, sums[3] + x * y];
            }
            let [x, y, xx, xy] = sums.map(|sum| sum / fits.len() as f64);
            *gain = ((xy - x * y) / (xx - x * x).max(1e-9)).clamp(GAINS[0], GAINS[1]);
            *bias = y - *gain * x;
        }
        if round + 1 < EXPOSURE_ROUNDS {
            let all: Vec<usize> = (0..photo.len()).filter(|&i| known[i]).collect();
            let mut by: Vec<(f32, usize)> =
                all.into_iter().map(|i| (size(apart(&exposure, shown[i], photo[i])), i)).collect();
            by.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share")]
            let keep = (by.len() as f64 * EXPOSURE_KEEPS) as usize;
            fits = by.into_iter().take(keep.max(1)).map(|(_, i)| i).collect();
        }
    }
    let of = |i: usize| match known[i] {
        true => apart(&exposure, shown[i], photo[i]),
        false => [0.0; 3],
    };
    (0..photo.len()).into_par_iter().map(of).collect()
}

fn apart(exposure: &[[f64; 2]; 3], shown: [f32; 3], photo: [f32; 3]) -> [f32; 3] {
    #[expect(clippy::cast_possible_truncation, reason = "a colour")]
    std::array::from_fn(|c| {
        (exposure[c][0] * f64::from(shown[c]) + exposure[c][1] - f64::from(photo[c])) as f32
    })
}

fn size(apart: [f32; 3]) -> f32 {
    apart.iter().map(|v| v.abs()).sum::<f32>() / 3.0
}

/// The size of the mean difference of each pixel's window; under 0 where too little is known.
fn blurred(apart: &[[f32; 3]], known: &[bool], width: usize) -> Vec<f32> {
    let height = apart.len() / width.max(1);
    let window = |at: usize, end: usize| at.saturating_sub(BLUR)..(at + BLUR + 1).min(end);
    // First along the rows.
    let row = |y: usize| -> Vec<[f32; 4]> {
        let of = |x: usize| {
            let mut sum = [0.0; 4];
            for at in window(x, width).map(|x| y * width + x).filter(|&at| known[at]) {
                let [r, g, b] = apart[at];
                sum = [sum[0] + r, sum[1] + g, sum[2] + b, sum[3] + 1.0];
            }
            sum
        };
        (0..width).map(of).collect()
    };
    let rows: Vec<Vec<[f32; 4]>> = (0..height).into_par_iter().map(row).collect();
    let of = |i: usize| {
        let (x, y) = (i % width, i / width);
        let mut sum = [0.0; 4];
        window(y, height).for_each(|y| (0..4).for_each(|k| sum[k] += rows[y][x][k]));
        let all = (window(x, width).len() * window(y, height).len()) as f32;
        let [r, g, b, count] = sum;
        if count < KNOWN_MIN * all { -1.0 } else { size([r, g, b].map(|v| v / count)) }
    };
    (0..apart.len()).into_par_iter().map(of).collect()
}

/// The connected areas in which numbers are over `reaches` and somewhere over `counts`, less small
/// ones.
fn areas(numbers: &[f32], width: usize, reaches: f32, counts: f32) -> Vec<bool> {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share")]
    let least = (numbers.len() as f64 * AREA_MIN) as usize;
    let mut seen: Vec<bool> = numbers.iter().map(|v| *v <= reaches).collect();
    let mut found = vec![false; numbers.len()];
    let (mut area, mut next) = (Vec::new(), Vec::new());
    for first in 0..numbers.len() {
        if std::mem::replace(&mut seen[first], true) {
            continue;
        }
        next.push(first);
        while let Some(at) = next.pop() {
            area.push(at);
            let (x, beside) = (at % width, [at.checked_sub(width), Some(at + width)]);
            let left = (x > 0).then(|| at - 1);
            let right = (x + 1 < width).then_some(at + 1);
            for at in beside.into_iter().chain([left, right]).flatten() {
                if at < seen.len() && !std::mem::replace(&mut seen[at], true) {
                    next.push(at);
                }
            }
        }
        let area = take(&mut area);
        if area.len() >= least && area.iter().any(|&at| numbers[at] > counts) {
            area.into_iter().for_each(|at| found[at] = true);
        }
    }
    found
}
