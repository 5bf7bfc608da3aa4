//! How far a frame is from its photo, and what that says of each pixel.
//! WGSL: `shaders/photo_loss.wgsl`.
//!
//! `(1 - s) mean|x - y| + s (1 - mean SSIM(x, y))` over pixels and channels, the loss of 3DGS
//! (Kerbl et al. 2023), where `s` is 0.2. SSIM has the 11 x 11 Gaussian window of sigma 1.5, taken
//! where it lies inside the picture, per channel. A pixel without a source counts as equal.

use std::borrow::Cow;

use rayon::prelude::*;

use crate::vectorised;

/// Side of SSIM's window, pixels.
const WINDOW: usize = 11;
/// Standard deviation of SSIM's window, pixels.
const SIGMA: f32 = 1.5;
/// SSIM's constants for a range of 1.
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
/// Numbers of a row that SSIM's windows have less than the picture.
const MARGIN: usize = (WINDOW - 1) * CHANNELS;
/// Numbers of a pixel: the rows are interleaved.
const CHANNELS: usize = 3;
/// Rows of a task.
const BAND: usize = 16;
/// Numbers that are added up at once.
const LANES: usize = 16;

/// A loss and its derivative by each number of the picture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhotoLoss {
    /// The loss.
    pub value: f64,
    /// `[H * W]` its derivative by the picture.
    pub gradient: Vec<[f32; 3]>,
}

/// The loss of `picture` against `photo`, both `[height * width]` in 0..1; `ssim_share` is `s`. A
/// picture smaller than SSIM's window has the absolute difference alone.
#[must_use]
pub fn photo_loss(
    picture: &[[f32; 3]],
    photo: &[[f32; 3]],
    width: usize,
    valid: Option<&[bool]>,
    ssim_share: f32,
) -> PhotoLoss {
    let height = photo.len() / width.max(1);
    // Pixels that do not count are those of the photo.
    let shown: Cow<'_, [[f32; 3]]> = match valid {
        None => picture.into(),
        Some(valid) => {
            (0..photo.len()).map(|i| if valid[i] { picture[i] } else { photo[i] }).collect()
        }
    };
    let (x, y, stride) = (shown.as_flattened(), photo.as_flattened(), width * CHANNELS);
    let fits = width >= WINDOW && height >= WINDOW && ssim_share > 0.0;
    let share = if fits { ssim_share } else { 0.0 };
    let each = (1.0 - share) / x.len().max(1) as f32;
    let ssim = fits.then(|| Ssim::of(x, y, stride));
    let mut gradient = vec![[0.0; 3]; x.len() / CHANNELS];
    let rows = gradient.par_chunks_mut(width.max(1)).enumerate();
    let away: Vec<f64> = rows
        .map(|(row, out)| {
            let out = out.as_flattened_mut();
            let (x, y) = (&x[row * stride..][..out.len()], &y[row * stride..][..out.len()]);
            if let Some(ssim) = &ssim {
                ssim.gradient(row, x, y, -share, out);
            }
            vectorised(|| -> f64 {
                for (out, (x, y)) in out.iter_mut().zip(x.iter().zip(y)) {
                    *out += if x == y { 0.0 } else { each.copysign(x - y) };
                }
                x.iter().zip(y).map(|(x, y)| f64::from((x - y).abs())).sum()
            })
        })
        .collect();
    let mut value = f64::from(each) * away.iter().sum::<f64>();
    value += ssim.map_or(0.0, |ssim| f64::from(share) * (1.0 - ssim.mean));
    if let Some(valid) = valid {
        gradient.iter_mut().zip(valid).filter(|(_, v)| !**v).for_each(|(by, _)| *by = [0.0; 3]);
    }
    PhotoLoss { value, gradient }
}

/// Mean SSIM, and its derivatives by the means of x, x² and x y in each window.
struct Ssim {
    mean: f64,
    /// `[rows * inner]` each.
    by: [Vec<f32>; 3],
    /// Windows of a column, and numbers of a row of windows.
    rows: usize,
    inner: usize,
}

impl Ssim {
    /// Of pictures with rows of `stride` numbers.
    fn of(x: &[f32], y: &[f32], stride: usize) -> Self {
        let (rows, inner) = (x.len() / stride + 1 - WINDOW, stride - MARGIN);
        let (weights, per) = (window(), 1.0 / (rows * inner) as f32);
        let mut by = [(); 3].map(|()| vec![0.0_f32; rows * inner]);
        let [m, xx, xy] = &mut by;
        let bands = m.par_chunks_mut(BAND * inner).zip(xx.par_chunks_mut(BAND * inner));
        let bands = bands.zip(xy.par_chunks_mut(BAND * inner)).enumerate();
        let sums: Vec<f64> = bands
            .map(|(band, ((m, xx), xy))| {
                let from =
                    band * BAND * stride..(band * BAND + m.len() / inner + WINDOW - 1) * stride;
                vectorised(|| {
                    let mut sum = 0.0;
                    let (x, y) = (&x[from.clone()], &y[from]);
                    let product = |a: &[f32], b: &[f32]| -> Vec<f32> {
                        a.iter().zip(b).map(|(a, b)| a * b).collect()
                    };
                    let (squares, of_y, both) = (product(x, x), product(y, y), product(x, y));
                    let mut down = vec![0.0; stride];
                    let mut means = [(); 5].map(|()| vec![0.0; inner]);
                    let m = m.chunks_exact_mut(inner).zip(xx.chunks_exact_mut(inner));
                    let out = m.zip(xy.chunks_exact_mut(inner)).enumerate();
                    for (row, ((m, xx), xy)) in out {
                        let maps = [x, y, &squares[..], &of_y[..], &both[..]];
                        for (map, mean) in maps.into_iter().zip(&mut means) {
                            weigh(&weights, &mut down, |k| &map[(row + k) * stride..]);
                            weigh(&weights, mean, |k| &down[k * CHANNELS..]);
                        }
                        sum += derivatives(&means, per, [m, xx, xy]);
                    }
                    sum
                })
            })
            .collect();
        Self { mean: sums.iter().sum::<f64>() / (rows * inner) as f64, by, rows, inner }
    }

    /// Writes `share` times the derivative by each number of a row of x.
    fn gradient(&self, row: usize, x: &[f32], y: &[f32], share: f32, out: &mut [f32]) {
        let Self { by, rows, inner, .. } = self;
        let weights = window();
        vectorised(|| {
            let none = vec![0.0; *inner];
            // Each window gives to the pixels under it.
            let mut wide = vec![0.0; inner + 2 * MARGIN];
            let mut spread = [(); 3].map(|()| vec![0.0; out.len()]);
            for (by, spread) in by.iter().zip(&mut spread) {
                weigh(&weights, &mut wide[MARGIN..MARGIN + inner], |k| {
                    let from = row.checked_sub(k).filter(|from| from < rows);
                    from.map_or(&none[..], |from| &by[from * inner..])
                });
                weigh(&weights, spread, |k| &wide[MARGIN - k * CHANNELS..]);
            }
            let [by_m, by_xx, by_xy] = &spread;
            let by = by_m.iter().zip(by_xx).zip(by_xy);
            for (out, ((x, y), ((m, xx), xy))) in out.iter_mut().zip(x.iter().zip(y).zip(by)) {
                *out = share * (m + 2.0 * x * xx + y * xy);
            }
        });
    }
}

/// A row of derivatives of SSIM by the means of x, x² and x y, times `per`; `means` are those of x,
/// y, x², y² and x y. Gives the sum of SSIM.
#[inline(always)]
fn derivatives(means: &[Vec<f32>; 5], per: f32, by: [&mut [f32]; 3]) -> f64 {
    let [by_m, by_xx, by_xy] = by;
    let count = by_m.len();
    let [mx, my, xx, yy, xy] = means.each_ref().map(|mean| &mean[..count]);
    let (by_xx, by_xy) = (&mut by_xx[..count], &mut by_xy[..count]);
    for i in 0..count {
        let (mx, my) = (mx[i], my[i]);
        let (a1, b1) = (2.0 * mx * my + C1, mx * mx + my * my + C1);
        let a2 = 2.0 * (xy[i] - mx * my) + C2;
        let b2 = (xx[i] - mx * mx) + (yy[i] - my * my) + C2;
        let per_b = per / (b1 * b2);
        let value = a1 * a2 * per_b;
        let (by_square, by_product) = (-value / b2, 2.0 * a1 * per_b);
        by_xx[i] = by_square;
        by_xy[i] = by_product;
        by_m[i] =
            2.0 * my * a2 * per_b - value * 2.0 * mx / b1 - 2.0 * mx * by_square - my * by_product;
    }
    // By the derivative by x²: SSIM is -b2 times it.
    let value = |i: usize| {
        let b2 = (xx[i] - mx[i] * mx[i]) + (yy[i] - my[i] * my[i]) + C2;
        f64::from(-by_xx[i] * b2)
    };
    (0..count).map(value).sum::<f64>() / f64::from(per)
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

/// The weighted sums of the numbers at the same place of [`WINDOW`] rows, which may be longer.
#[inline(always)]
fn weigh<'a>(weights: &[f32; WINDOW], out: &mut [f32], row: impl Fn(usize) -> &'a [f32]) {
    let count = out.len();
    let rows: [&[f32]; WINDOW] = std::array::from_fn(|k| &row(k)[..count]);
    let whole = count - count % LANES;
    for at in (0..whole).step_by(LANES) {
        let mut sums = [0.0; LANES];
        for (row, weight) in rows.iter().zip(weights) {
            let from = &row[at..at + LANES];
            sums.iter_mut().zip(from).for_each(|(sum, v)| *sum += weight * v);
        }
        out[at..at + LANES].copy_from_slice(&sums);
    }
    for at in whole..count {
        out[at] = rows.iter().zip(weights).map(|(row, weight)| weight * row[at]).sum();
    }
}
