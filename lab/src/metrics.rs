//! SSIM on RGB in 0..1.

pub use crate::render::compare::psnr;
use crate::scene::Photo;

/// Side of SSIM's window, pixels.
const WINDOW: usize = 11;
/// Standard deviation of SSIM's Gaussian window, pixels.
const SIGMA: f64 = 1.5;
/// SSIM's constants for a range of 1.
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Pixels of a photo as RGB in 0..1.
pub(crate) fn to_unit(photo: &Photo) -> Vec<[f32; 3]> {
    photo.rgb.chunks_exact(3).map(|c| [c[0], c[1], c[2]].map(|v| f32::from(v) / 255.0)).collect()
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::compare::PSNR_MAX;

    fn picture(f: impl Fn(usize, usize) -> f32) -> Vec<[f32; 3]> {
        (0..32).flat_map(|y| (0..32).map(move |x| (x, y))).map(|(x, y)| [f(x, y); 3]).collect()
    }

    #[test]
    fn psnr_of_a_known_error() {
        let (a, b) = (picture(|_, _| 0.5), picture(|_, _| 0.6));
        assert!((psnr(&a, &b, None) - 20.0).abs() < 1e-4, "0.1 off is 20 dB");
        assert_eq!(psnr(&a, &a, None), PSNR_MAX, "equal");
        let mut one = a.clone();
        one[7] = [1.0; 3];
        let valid: Vec<bool> = (0..one.len()).map(|i| i != 7).collect();
        assert_eq!(psnr(&one, &a, Some(&valid)), PSNR_MAX, "masked");
    }

    #[test]
    fn ssim_of_known_pictures() {
        let texture = picture(|x, y| ((x * 7 + y * 13) % 10) as f32 / 10.0);
        assert!((ssim(&texture, &texture, 32, None) - 1.0).abs() < 1e-9, "equal");
        // Flat pictures: only the luminance term is left.
        let (a, b) = (picture(|_, _| 0.5), picture(|_, _| 0.7));
        let wanted = (2.0 * 0.35 + C1) / (0.25 + 0.49 + C1);
        assert!((ssim(&a, &b, 32, None) - wanted).abs() < 1e-6, "luminance");
        let inverse: Vec<[f32; 3]> = texture.iter().map(|c| c.map(|v| 0.9 - v)).collect();
        assert!(ssim(&inverse, &texture, 32, None) < 0.0, "opposite structure");
    }
}
