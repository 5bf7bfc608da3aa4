//! The loss that judges the others: f64, window by window, as SSIM's paper has it (Wang et al.
//! 2004). Finite differences of its value judge its gradient.

/// Side of SSIM's window, pixels, and its variance, square pixels.
const WINDOW: usize = 11;
const VARIANCE: f64 = 1.5 * 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// [`segsplat_render::train::photo_loss()`] in f64: its value, and its derivative by each number of
/// the picture.
#[must_use]
pub fn photo_loss(
    picture: &[[f64; 3]],
    photo: &[[f64; 3]],
    width: usize,
    valid: Option<&[bool]>,
    ssim_share: f64,
) -> (f64, Vec<[f64; 3]>) {
    let (height, counts) = (photo.len() / width.max(1), |i: usize| valid.is_none_or(|v| v[i]));
    let shown = |i: usize| if counts(i) { picture[i] } else { photo[i] };
    let fits = width >= WINDOW && height >= WINDOW;
    let share = if fits { ssim_share } else { 0.0 };
    let each = (1.0 - share) / (3 * photo.len()).max(1) as f64;
    let mut value = 0.0;
    let mut gradient = vec![[0.0; 3]; photo.len()];
    for (i, by) in gradient.iter_mut().enumerate() {
        for c in 0..3 {
            let away = shown(i)[c] - photo[i][c];
            value += each * away.abs();
            by[c] = if away == 0.0 { 0.0 } else { each * away.signum() };
        }
    }
    if share > 0.0 {
        let weight = |k: usize| (-(k as f64 - 5.0).powi(2) / (2.0 * VARIANCE)).exp();
        let all: f64 = (0..WINDOW).map(weight).sum();
        let windows = (width + 1 - WINDOW) * (height + 1 - WINDOW);
        for window in 0..windows {
            let columns = width + 1 - WINDOW;
            let first = window / columns * width + window % columns;
            let pixels = (0..WINDOW * WINDOW).map(|k| {
                let w = weight(k / WINDOW) * weight(k % WINDOW) / (all * all);
                (first + k / WINDOW * width + k % WINDOW, w)
            });
            for c in 0..3 {
                let mean = |of: &dyn Fn(f64, f64) -> f64| -> f64 {
                    pixels.clone().map(|(at, w)| w * of(shown(at)[c], photo[at][c])).sum()
                };
                let (mx, my) = (mean(&|x, _| x), mean(&|_, y| y));
                let xx = mean(&|x, _| (x - mx).powi(2));
                let yy = mean(&|_, y| (y - my).powi(2));
                let xy = mean(&|x, y| (x - mx) * (y - my));
                let (a1, b1) = (2.0 * mx * my + C1, mx * mx + my * my + C1);
                let (a2, b2) = (2.0 * xy + C2, xx + yy + C2);
                let ssim = a1 * a2 / (b1 * b2);
                let per = share / (3 * windows) as f64;
                value += per * (1.0 - ssim);
                for (at, w) in pixels.clone() {
                    let (x, y) = (shown(at)[c] - mx, photo[at][c] - my);
                    let of_means = 2.0 * my / a1 - 2.0 * mx / b1;
                    let of_variances = 2.0 * y / a2 - 2.0 * x / b2;
                    gradient[at][c] -= per * w * ssim * (of_means + of_variances);
                }
            }
        }
    }
    (0..photo.len()).filter(|&i| !counts(i)).for_each(|i| gradient[i] = [0.0; 3]);
    (value, gradient)
}
