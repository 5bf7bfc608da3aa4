//! Resizes 8-bit pictures as Pillow does: a filter widened by the reduction, in integers.
//!
//! First columns, then rows. Each pass has 22-bit weights and rounds to 8 bits. That is Pillow's
//! `resize`, bit for bit: networks were trained on pictures that it made.

use std::f64::consts::PI;

use rayon::prelude::*;
use serde::Deserialize;

/// A filter of Pillow's.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ResizeFilter {
    /// `BILINEAR`.
    #[default]
    #[serde(alias = "bilinear")]
    Triangle,
    /// `BICUBIC`, with a = -1/2.
    Bicubic,
    /// `LANCZOS`, with three lobes.
    Lanczos,
}

impl ResizeFilter {
    /// Half of its width, pixels of the smaller picture.
    fn support(self) -> f64 {
        match self {
            Self::Triangle => 1.0,
            Self::Bicubic => 2.0,
            Self::Lanczos => 3.0,
        }
    }

    fn weight(self, x: f64) -> f64 {
        let x = x.abs();
        let sinc = |x: f64| if x == 0.0 { 1.0 } else { (PI * x).sin() / (PI * x) };
        match self {
            Self::Triangle => (1.0 - x).max(0.0),
            Self::Bicubic if x < 1.0 => (1.5 * x - 2.5) * x * x + 1.0,
            Self::Bicubic if x < 2.0 => ((-0.5 * x + 2.5) * x - 4.0) * x + 2.0,
            Self::Lanczos if x < 3.0 => sinc(x) * sinc(x / 3.0),
            Self::Bicubic | Self::Lanczos => 0.0,
        }
    }

    /// For each of `outputs` pixels that lie over `length` source pixels beginning at `start`: the
    /// first source pixel, and the weights from there on. Their sum is 1. `size` is how many source
    /// pixels there are; `narrow` makes the weights' type.
    pub(super) fn taps<T>(
        self,
        size: u32,
        [start, length]: [f64; 2],
        outputs: u32,
        narrow: impl Fn(f64) -> T,
    ) -> Vec<(usize, Vec<T>)> {
        let scale = length / f64::from(outputs);
        let widened = scale.max(1.0);
        let support = self.support() * widened;
        let tap = |i: u32| {
            let centre = start + (f64::from(i) + 0.5) * scale;
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in range")]
            let (first, last) = (
                (centre - support + 0.5).max(0.0) as usize,
                (centre + support + 0.5).min(f64::from(size)) as usize,
            );
            let raw: Vec<f64> =
                (first..last).map(|j| self.weight((j as f64 - centre + 0.5) / widened)).collect();
            let sum: f64 = raw.iter().sum();
            (first, raw.iter().map(|w| narrow(w / sum)).collect())
        };
        (0..outputs).map(tap).collect()
    }
}

/// Lines of a plane that one thread makes at a time.
const LINES_A_TASK: usize = 32;
/// Bits of a weight after the point: 8 bits of pixel and 2 of head room are left of 32.
const WEIGHT_BITS: u32 = 32 - 8 - 2;

/// A weight in integers, rounded away from 0 as Pillow does.
#[expect(clippy::cast_possible_truncation, reason = "at most 2^23")]
fn fixed_point(weight: f64) -> i32 {
    (weight * f64::from(1_u32 << WEIGHT_BITS)).round() as i32
}

/// `[height, width, 3]` pixels at another size; sides must be over 0.
pub(super) fn resize(
    rgb: &[u8],
    [width, height]: [usize; 2],
    [out_width, out_height]: [usize; 2],
    filter: ResizeFilter,
) -> Vec<u8> {
    if [width, height] == [out_width, out_height] {
        return rgb.to_vec();
    }
    let taps = |size: usize, outputs: usize| {
        let narrow = |side: usize| u32::try_from(side).unwrap_or(u32::MAX);
        filter.taps(narrow(size), [0.0, size as f64], narrow(outputs), fixed_point)
    };
    let columns = taps(width, out_width);
    let mut wide = vec![0_u8; height * out_width * 3];
    let lines = wide.par_chunks_mut(out_width * 3).zip(rgb.par_chunks(width * 3));
    lines.for_each(|(out, line)| {
        for (pixel, (first, weights)) in out.chunks_exact_mut(3).zip(&columns) {
            let mut sum = [1_i32 << (WEIGHT_BITS - 1); 3];
            for (source, weight) in line[first * 3..].chunks_exact(3).zip(weights) {
                for (s, v) in sum.iter_mut().zip(source) {
                    *s += weight * i32::from(*v);
                }
            }
            pixel.copy_from_slice(&sum.map(narrow));
        }
    });
    let rows = taps(height, out_height);
    let mut out = vec![0_u8; out_height * out_width * 3];
    out.par_chunks_mut(out_width * 3).zip(&rows).for_each(|(out, (first, weights))| {
        let mut sums = vec![1_i32 << (WEIGHT_BITS - 1); out_width * 3];
        for (line, weight) in wide[first * out_width * 3..].chunks(out_width * 3).zip(weights) {
            for (s, v) in sums.iter_mut().zip(line) {
                *s += weight * i32::from(*v);
            }
        }
        for (v, sum) in out.iter_mut().zip(sums) {
            *v = narrow(sum);
        }
    });
    out
}

#[expect(clippy::cast_sign_loss, reason = "clamped to 8 bits")]
fn narrow(sum: i32) -> u8 {
    (sum >> WEIGHT_BITS).clamp(0, 255) as u8
}

/// `[3, rows, columns]` f32, normalised; the picture lies in the top left corner, the rest is 0.
pub(super) fn planes(
    rgb: &[u8],
    [width, height]: [usize; 2],
    [columns, rows]: [usize; 2],
    mean: [f32; 3],
    std: [f32; 3],
) -> Vec<f32> {
    let of_level = |c: usize| {
        (0..=u8::MAX).map(move |level| (f32::from(level) / 255.0 - mean[c]) / std[c]).collect()
    };
    let levels: [Vec<f32>; 3] = [0, 1, 2].map(of_level);
    let mut planes = vec![0.0; 3 * rows * columns];
    let lines = planes.par_chunks_exact_mut(columns).with_min_len(LINES_A_TASK).enumerate();
    lines.for_each(|(at, out)| {
        let (c, y) = (at / rows, at % rows);
        if y < height {
            let line = &rgb[y * width * 3..(y + 1) * width * 3];
            for (v, pixel) in out.iter_mut().zip(line.chunks_exact(3)) {
                *v = levels[c][usize::from(pixel[c])];
            }
        }
    });
    planes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pillow_gives_the_same_bytes() {
        // numpy: (np.arange(7 * 5 * 3) * 37 % 256).reshape(5, 7, 3); Image.resize. For each filter:
        // 7x5 to 3x2, the sum of 7x5 to 9x11, and two of its pixels.
        let rgb: Vec<u8> = (0..105).map(|i| (i * 37 % 256) as u8).collect();
        let pillow: [(ResizeFilter, [u8; 18], u32, [u8; 6]); 3] = [
            (
                ResizeFilter::Triangle,
                [
                    104, 86, 123, 146, 123, 100, 123, 160, 142, 105, 104, 141, 145, 122, 118, 141,
                    161, 131,
                ],
                37_103,
                [181, 218, 56, 125, 162, 86],
            ),
            (
                ResizeFilter::Bicubic,
                [
                    99, 79, 126, 158, 124, 87, 117, 165, 149, 99, 103, 146, 152, 118, 111, 141,
                    165, 132,
                ],
                37_003,
                [194, 236, 44, 122, 159, 72],
            ),
            (
                ResizeFilter::Lanczos,
                [
                    101, 73, 128, 164, 126, 82, 113, 172, 151, 98, 102, 148, 154, 116, 110, 142,
                    169, 131,
                ],
                36_956,
                [195, 247, 50, 124, 155, 51],
            ),
        ];
        for (filter, small, sum, two) in pillow {
            assert_eq!(resize(&rgb, [7, 5], [3, 2], filter), small, "{filter:?}: 7x5 to 3x2");
            let large = resize(&rgb, [7, 5], [9, 11], filter);
            let found: u32 = large.iter().map(|v| u32::from(*v)).sum();
            assert_eq!(found, sum, "{filter:?}: 7x5 to 9x11");
            assert_eq!(large[150..156], two, "{filter:?}: 7x5 to 9x11");
        }
    }

    #[test]
    fn planes_are_padded_right_and_bottom_after_normalisation() {
        let planes =
            planes(&[255, 0, 51, 0, 255, 51], [2, 1], [3, 3], [0.5, 0.0, 0.2], [0.5, 1.0, 1.0]);
        let rows: Vec<&[f32]> = planes.chunks(3).collect();
        assert_eq!(rows[0], [1.0, -1.0, 0.0], "red");
        assert_eq!(rows[3], [0.0, 1.0, 0.0], "green");
        assert_eq!(rows[6], [0.0, 0.0, 0.0], "blue is its mean");
        assert!(rows[1].iter().chain(rows[2]).all(|v| *v == 0.0), "the rest is 0");
    }
}
