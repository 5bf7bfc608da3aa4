//! How far a frame is from its photo, and what that says of each pixel.
//!
//! `0.8 mean|x - y| + 0.2 (1 - mean SSIM(x, y))` over pixels and channels, the loss of 3DGS (Kerbl
//! et al. 2023). SSIM has the 11 x 11 Gaussian window of sigma 1.5, taken where it lies inside the
//! picture, per channel. A pixel without a source counts as equal.

use rayon::prelude::*;

use crate::vectorised;

/// Share of SSIM in the loss.
const SSIM_SHARE: f32 = 0.2;
/// Side of SSIM's window, pixels.
const WINDOW: usize = 11;
/// Standard deviation of SSIM's window, pixels.
const SIGMA: f32 = 1.5;
/// SSIM's constants for a range of 1.
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
/// Numbers of a pixel: the rows are interleaved.
const CHANNELS: usize = 3;

/// A loss and its derivative by each number of the picture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhotoLoss {
    /// The loss.
    pub value: f64,
    /// `[H * W]` its derivative by the picture.
    pub gradient: Vec<[f32; 3]>,
}

/// The loss of `picture` against `photo`, both `[height * width]` in 0..1. A picture smaller than
/// SSIM's window has the absolute difference alone.
#[must_use]
pub fn photo_loss(
    picture: &[[f32; 3]],
    photo: &[[f32; 3]],
    width: usize,
    valid: Option<&[bool]>,
) -> PhotoLoss {
    let height = photo.len() / width.max(1);
    // Pixels that do not count are those of the photo.
    let shown: Vec<[f32; 3]> = match valid {
        None => picture.to_vec(),
        Some(valid) => {
            (0..photo.len()).map(|i| if valid[i] { picture[i] } else { photo[i] }).collect()
        }
    };
    let (x, y) = (shown.as_flattened(), photo.as_flattened());
    let fits = width >= WINDOW && height >= WINDOW;
    let share = if fits { SSIM_SHARE } else { 0.0 };
    let each = (1.0 - share) / x.len().max(1) as f32;
    let away: f64 = x.iter().zip(y).map(|(x, y)| f64::from((x - y).abs())).sum();
    let mut value = f64::from(each) * away;
    let step = |x: f32, y: f32| match x.total_cmp(&y) {
        _ if x == y => 0.0,
        std::cmp::Ordering::Less => -each,
        _ => each,
    };
    let mut gradient: Vec<f32> = x.iter().zip(y).map(|(&x, &y)| step(x, y)).collect();
    if fits {
        let (ssim, by) = ssim(x, y, width * CHANNELS);
        value += f64::from(share) * (1.0 - ssim);
        gradient.iter_mut().zip(by).for_each(|(sum, by)| *sum -= share * by);
    }
    let mut gradient: Vec<[f32; 3]> =
        gradient.chunks_exact(CHANNELS).map(|c| [c[0], c[1], c[2]]).collect();
    if let Some(valid) = valid {
        gradient.iter_mut().zip(valid).filter(|(_, v)| !**v).for_each(|(by, _)| *by = [0.0; 3]);
    }
    PhotoLoss { value, gradient }
}

/// Mean SSIM of rows of `stride` numbers, and its derivative by each number of `x`.
fn ssim(x: &[f32], y: &[f32], stride: usize) -> (f64, Vec<f32>) {
    let product = |a: &[f32], b: &[f32]| -> Vec<f32> {
        let product: Vec<f32> = a.iter().zip(b).map(|(a, b)| a * b).collect();
        blurred(&product, stride)
    };
    let (mx, my) = (blurred(x, stride), blurred(y, stride));
    let (xx, yy, xy) = (product(x, x), product(y, y), product(x, y));
    let count = mx.len();
    let per = 1.0 / count.max(1) as f32;
    // By the blurred x, x² and x y.
    let (mut by_m, mut by_xx, mut by_xy) = (vec![0.0; count], vec![0.0; count], vec![0.0; count]);
    let mut sum = 0.0;
    for i in 0..count {
        let (mx, my) = (mx[i], my[i]);
        let (a1, b1) = (2.0 * mx * my + C1, mx * mx + my * my + C1);
        let a2 = 2.0 * (xy[i] - mx * my) + C2;
        let b2 = (xx[i] - mx * mx) + (yy[i] - my * my) + C2;
        let per_b = 1.0 / (b1 * b2);
        let value = a1 * a2 * per_b;
        sum += f64::from(value);
        let (by_square, by_product) = (-value / b2, 2.0 * a1 * per_b);
        by_xx[i] = per * by_square;
        by_xy[i] = per * by_product;
        by_m[i] = per
            * (2.0 * my * a2 * per_b
                - value * 2.0 * mx / b1
                - 2.0 * mx * by_square
                - my * by_product);
    }
    let [by_m, by_xx, by_xy] = [by_m, by_xx, by_xy].map(|by| spread(&by, stride));
    let gradient = (0..x.len()).map(|i| by_m[i] + 2.0 * x[i] * by_xx[i] + y[i] * by_xy[i]);
    (sum / count.max(1) as f64, gradient.collect())
}

fn window() -> [f32; WINDOW] {
    let mut window = [0.0; WINDOW];
    for (i, weight) in window.iter_mut().enumerate() {
        let away = i as f32 - (WINDOW / 2) as f32;
        *weight = (-away * away / (2.0 * SIGMA * SIGMA)).exp();
    }
    let sum: f32 = window.iter().sum();
    window.map(|weight| weight / sum)
}

/// The window's mean at each place where it lies inside: rows are shorter by 10 pixels, and there
/// are 10 fewer.
fn blurred(values: &[f32], stride: usize) -> Vec<f32> {
    let inner = stride - (WINDOW - 1) * CHANNELS;
    let rows = values.len() / stride;
    let mut across = vec![0.0; rows * inner];
    across.par_chunks_mut(inner).zip(values.par_chunks(stride)).for_each(|(out, row)| {
        vectorised(|| {
            for (k, weight) in window().into_iter().enumerate() {
                let from = &row[k * CHANNELS..k * CHANNELS + inner];
                out.iter_mut().zip(from).for_each(|(out, v)| *out += weight * v);
            }
        });
    });
    let mut out = vec![0.0; (rows + 1 - WINDOW) * inner];
    out.par_chunks_mut(inner).enumerate().for_each(|(y, out)| {
        vectorised(|| {
            for (k, weight) in window().into_iter().enumerate() {
                let from = &across[(y + k) * inner..(y + k + 1) * inner];
                out.iter_mut().zip(from).for_each(|(out, v)| *out += weight * v);
            }
        });
    });
    out
}

/// The transpose of [`blurred`]: gives each number to the pixels under its window. `stride`
/// is that of the larger picture.
fn spread(values: &[f32], stride: usize) -> Vec<f32> {
    let inner = stride - (WINDOW - 1) * CHANNELS;
    let rows = values.len() / inner;
    let mut down = vec![0.0; (rows + WINDOW - 1) * inner];
    down.par_chunks_mut(inner).enumerate().for_each(|(y, out)| {
        vectorised(|| {
            for (k, weight) in window().into_iter().enumerate() {
                let Some(row) = y.checked_sub(k).filter(|row| *row < rows) else { continue };
                let from = &values[row * inner..(row + 1) * inner];
                out.iter_mut().zip(from).for_each(|(out, v)| *out += weight * v);
            }
        });
    });
    let mut out = vec![0.0; (rows + WINDOW - 1) * stride];
    out.par_chunks_mut(stride).zip(down.par_chunks(inner)).for_each(|(out, row)| {
        vectorised(|| {
            for (k, weight) in window().into_iter().enumerate() {
                let to = &mut out[k * CHANNELS..k * CHANNELS + inner];
                to.iter_mut().zip(row).for_each(|(out, v)| *out += weight * v);
            }
        });
    });
    out
}
