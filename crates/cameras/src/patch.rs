//! Small patches of grey photos, found again in other photos.

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

/// Longest side of the grey photos, about: keypoints of larger photos are found in reduced ones.
const SIDE: f64 = 800.0;
/// Half of the side of a patch, pixels of the grey photo.
const HALF: i32 = 6;
/// Steps of Gauss and Newton, and the shift under which they end, pixels.
const STEPS: usize = 12;
const STEP_MIN: f64 = 0.003;

/// A grey photo, reduced where it is large, smoothed a little.
#[derive(Clone, Debug)]
pub struct Grey {
    /// Size of the photo, and pixels of it along a pixel here.
    pub(crate) size: [u32; 2],
    step: usize,
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Grey {
    /// From a photo of `[height * width * 3]`.
    pub fn new(width: u32, height: u32, rgb: &[u8]) -> Self {
        let size = [width, height];
        let step = (f64::from(width.max(height)) / SIDE).round().max(1.0) as usize;
        let stride = width as usize;
        let (width, height) = (stride / step, height as usize / step);
        let luma: Vec<f32> = (0..width * height)
            .map(|i| {
                let first = i / width * step * stride + i % width * step;
                let of = |k: usize| {
                    let p = &rgb[3 * (first + k / step * stride + k % step)..][..3];
                    0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2])
                };
                (0..step * step).map(of).sum::<f32>() / (step * step) as f32
            })
            .collect();
        // A binomial filter of five.
        let taps = [0.0625_f32, 0.25, 0.375, 0.25, 0.0625];
        let mut rows = vec![0.0; luma.len()];
        for y in 0..height {
            for x in 0..width {
                let at = |i: usize| luma[y * width + (x + i).saturating_sub(2).min(width - 1)];
                rows[y * width + x] = (0..5).map(|i| taps[i] * at(i)).sum();
            }
        }
        let mut values = vec![0.0; luma.len()];
        for y in 0..height {
            for x in 0..width {
                let at = |i: usize| rows[(y + i).saturating_sub(2).min(height - 1) * width + x];
                values[y * width + x] = (0..5).map(|i| taps[i] * at(i)).sum();
            }
        }
        Self { size, step, width, height, values }
    }

    /// Value and gradient at a place, pixels; `None` at the border.
    fn at(&self, p: &Vector2<f64>) -> Option<(f64, Vector2<f64>)> {
        let step = self.step as f64;
        let (x, y) = (p.x / step - 0.5, p.y / step - 0.5);
        let (i, j) = (x.floor(), y.floor());
        if !(i >= 1.0 && j >= 1.0 && i + 3.0 < self.width as f64 && j + 3.0 < self.height as f64) {
            return None;
        }
        let (u, v) = (x - i, y - j);
        let first = (j as usize - 1) * self.width + i as usize - 1;
        // Cubic, by Catmull and Rom.
        let weights = |t: f64| {
            let (t2, t3) = (t * t, t * t * t);
            [
                -0.5 * t3 + t2 - 0.5 * t,
                1.5 * t3 - 2.5 * t2 + 1.0,
                -1.5 * t3 + 2.0 * t2 + 0.5 * t,
                0.5 * t3 - 0.5 * t2,
            ]
        };
        let slopes = |t: f64| {
            let t2 = t * t;
            [-1.5 * t2 + 2.0 * t - 0.5, 4.5 * t2 - 5.0 * t, -4.5 * t2 + 4.0 * t + 0.5, 1.5 * t2 - t]
        };
        let (wx, wy, sx, sy) = (weights(u), weights(v), slopes(u), slopes(v));
        let (mut value, mut dx, mut dy) = (0.0, 0.0, 0.0);
        for b in 0..4 {
            let row = &self.values[first + b * self.width..][..4];
            let (mut w, mut s) = (0.0, 0.0);
            for a in 0..4 {
                w += wx[a] * f64::from(row[a]);
                s += sx[a] * f64::from(row[a]);
            }
            value += wy[b] * w;
            dx += wy[b] * s;
            dy += sy[b] * w;
        }
        Some((value, Vector2::new(dx, dy) / step))
    }
}

/// Where a patch of the reference lies.
pub(crate) struct Patch {
    offsets: Vec<Vector2<f64>>,
    values: Vec<f64>,
    spread: f64,
}

impl Patch {
    pub(crate) fn new(grey: &Grey, at: &Vector2<f64>) -> Option<Self> {
        let (mut offsets, mut values) = (Vec::new(), Vec::new());
        for y in -HALF..=HALF {
            for x in -HALF..=HALF {
                let offset = Vector2::new(f64::from(x), f64::from(y)) * grey.step as f64;
                values.push(grey.at(&(at + offset))?.0);
                offsets.push(offset);
            }
        }
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        values.iter_mut().for_each(|v| *v -= mean);
        let spread = values.iter().map(|v| v * v).sum::<f64>().sqrt();
        (spread > 1e-6).then_some(Self { offsets, values, spread })
    }

    /// Where it is found in another photo.
    pub(crate) fn found(
        &self,
        grey: &Grey,
        affine: Matrix2<f64>,
        at: Vector2<f64>,
    ) -> Option<(Vector2<f64>, f64)> {
        let (mut affine, mut at) = (affine, at);
        let n = self.values.len() as f64;
        let mut alike = 0.0;
        for _ in 0..STEPS {
            let mut seen = Vec::with_capacity(self.values.len());
            for offset in &self.offsets {
                seen.push(grey.at(&(at + affine * offset))?);
            }
            let mean = seen.iter().map(|s| s.0).sum::<f64>() / n;
            let own = seen.iter().map(|s| (s.0 - mean).powi(2)).sum::<f64>().sqrt();
            if own < 1e-6 {
                return None;
            }
            alike = seen.iter().zip(&self.values).map(|(s, v)| (s.0 - mean) * v).sum::<f64>()
                / (own * self.spread);
            // seen = gain * reference + bias
            let gain = alike * own / self.spread;
            let mut system = SMatrix::<f64, 8, 8>::zeros();
            let mut right = SVector::<f64, 8>::zeros();
            for ((s, v), o) in seen.iter().zip(&self.values).zip(&self.offsets) {
                let g = s.1;
                let row = SVector::<f64, 8>::from([
                    g.x,
                    g.y,
                    g.x * o.x,
                    g.x * o.y,
                    g.y * o.x,
                    g.y * o.y,
                    -v,
                    -1.0,
                ]);
                let rest = gain * v + mean - s.0;
                system.syger(1.0, &row, &row, 1.0);
                right += row * rest;
            }
            for i in 0..8 {
                system[(i, i)] *= 1.0 + 1e-4;
                system[(i, i)] += 1e-9;
            }
            let step = system.cholesky()?.solve(&right);
            let moved = Vector2::new(step[0], step[1]);
            let most = grey.step as f64;
            at += moved * (most / moved.norm()).min(1.0);
            affine += Matrix2::new(step[2], step[3], step[4], step[5]);
            if moved.norm() < STEP_MIN * most {
                break;
            }
        }
        Some((at, alike))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, Vector2};

    use super::{Grey, Patch};

    #[test]
    fn a_large_photo_is_reduced_and_its_places_stay() {
        let value = |i: u32| (40.0 + 0.06 * f64::from(i % 1600) + 0.05 * f64::from(i / 1600)) as u8;
        let rgb: Vec<u8> = (0..1600 * 1200).flat_map(|i| [value(i); 3]).collect();
        let grey = Grey::new(1600, 1200, &rgb);
        assert_eq!((grey.width, grey.height), (800, 600));
        let (value, slope) = grey.at(&Vector2::new(1000.0, 700.0)).unwrap();
        // Values are cut to whole numbers.
        assert!((value - (40.0 + 60.0 + 35.0 - 0.5)).abs() < 0.5, "{value}");
        assert!(slope.x > 0.0 && slope.norm() < 0.2, "{slope}");
    }

    fn photo(of: impl Fn(f64, f64) -> f64) -> Grey {
        let value = |i: u32| of(f64::from(i % 96) + 0.5, f64::from(i / 96) + 0.5) as u8;
        let rgb: Vec<u8> = (0..96 * 64).flat_map(|i| [value(i); 3]).collect();
        Grey::new(96, 64, &rgb)
    }

    fn texture(x: f64, y: f64) -> f64 {
        120.0 + 40.0 * (0.5 * x + 0.2 * y).sin() + 40.0 * (0.45 * y - 0.1 * x + 1.0).sin()
    }

    #[test]
    fn a_patch_is_found_turned_moved_and_in_another_light() {
        let (at, there) = (Vector2::new(48.3, 31.6), Vector2::new(45.1, 34.2));
        let turned = Matrix2::new(1.1, 0.2, -0.15, 0.95);
        let back = turned.try_inverse().unwrap();
        let first = photo(texture);
        let second = photo(|x, y| {
            let of = back * (Vector2::new(x, y) - there) + at;
            0.7 * texture(of.x, of.y) + 30.0
        });
        let patch = Patch::new(&first, &at).unwrap();
        let start = there + Vector2::new(0.9, -0.8);
        let (place, alike) = patch.found(&second, Matrix2::identity(), start).unwrap();
        assert!((place - there).norm() < 0.05, "{place} is not {there}");
        assert!(alike > 0.99, "{alike}");
    }

    #[test]
    fn a_flat_patch_and_one_at_the_border_are_none() {
        let flat = photo(|_, _| 90.0);
        assert!(Patch::new(&flat, &Vector2::new(48.0, 32.0)).is_none());
        let first = photo(texture);
        assert!(Patch::new(&first, &Vector2::new(5.0, 32.0)).is_none());
        let patch = Patch::new(&first, &Vector2::new(48.0, 32.0)).unwrap();
        assert!(patch.found(&flat, Matrix2::identity(), Vector2::new(48.0, 32.0)).is_none());
    }
}
