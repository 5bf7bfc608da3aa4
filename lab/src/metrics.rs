//! PSNR and SSIM on RGB in 0..1.

pub use crate::render::compare::psnr;

/// Side of SSIM's window, pixels.
const WINDOW: usize = 11;
/// Standard deviation of SSIM's Gaussian window, pixels.
const SIGMA: f64 = 1.5;
/// SSIM's constants for a range of 1.
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Colours as a picture of 8 bits holds them: within 0 and 1.
pub(crate) fn clamped(color: Option<Vec<[f32; 3]>>) -> Vec<[f32; 3]> {
    let mut color = color.unwrap_or_default();
    color.iter_mut().flatten().for_each(|v| *v = v.clamp(0.0, 1.0));
    color
}

/// Structural similarity: 11x11 Gaussian window of sigma 1.5 inside the picture, mean over windows
/// and channels. Pixels that are not valid count as equal.
#[must_use]
pub fn ssim(picture: &[[f32; 3]], truth: &[[f32; 3]], width: usize, valid: Option<&[bool]>) -> f64 {
    let height = truth.len() / width.max(1);
    if width < WINDOW || height < WINDOW || picture.len() != truth.len() {
        return f64::NAN;
    }
    let window = gaussian();
    let mut total = 0.0;
    for channel in 0..3 {
        let b: Vec<f64> = truth.iter().map(|c| f64::from(c[channel])).collect();
        let shown = |i: usize| if valid.is_none_or(|v| v[i]) { picture[i] } else { truth[i] };
        let a: Vec<f64> = (0..truth.len()).map(|i| f64::from(shown(i)[channel])).collect();
        let product = |x: &[f64], y: &[f64]| -> Vec<f64> {
            let xy: Vec<f64> = x.iter().zip(y).map(|(x, y)| x * y).collect();
            blurred(&xy, width, &window)
        };
        let (ma, mb) = (blurred(&a, width, &window), blurred(&b, width, &window));
        let (aa, bb, ab) = (product(&a, &a), product(&b, &b), product(&a, &b));
        let sum: f64 = (0..ma.len())
            .map(|i| {
                let (va, vb) = (aa[i] - ma[i] * ma[i], bb[i] - mb[i] * mb[i]);
                let cov = ab[i] - ma[i] * mb[i];
                (2.0 * ma[i] * mb[i] + C1) * (2.0 * cov + C2)
                    / ((ma[i] * ma[i] + mb[i] * mb[i] + C1) * (va + vb + C2))
            })
            .sum();
        total += sum / ma.len() as f64;
    }
    total / 3.0
}

fn gaussian() -> [f64; WINDOW] {
    let mut window = [0.0; WINDOW];
    for (i, w) in window.iter_mut().enumerate() {
        let x = i as f64 - (WINDOW / 2) as f64;
        *w = (-x * x / (2.0 * SIGMA * SIGMA)).exp();
    }
    let sum: f64 = window.iter().sum();
    window.map(|w| w / sum)
}

/// Separable blur, only where the whole window lies inside.
fn blurred(values: &[f64], width: usize, window: &[f64; WINDOW]) -> Vec<f64> {
    let (height, inner) = (values.len() / width, width - WINDOW + 1);
    let mut rows = Vec::with_capacity(height * inner);
    for line in values.chunks_exact(width) {
        for part in line.windows(WINDOW) {
            rows.push(part.iter().zip(window).map(|(v, w)| v * w).sum::<f64>());
        }
    }
    let mut out = vec![0.0; (height - WINDOW + 1) * inner];
    for (y, line) in out.chunks_exact_mut(inner).enumerate() {
        for (k, w) in window.iter().enumerate() {
            for (o, v) in line.iter_mut().zip(&rows[(y + k) * inner..]) {
                *o += w * v;
            }
        }
    }
    out
}
