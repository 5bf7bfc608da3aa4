//! Resizes 8-bit pictures by the triangle filter, widened by the reduction, in integers.
//!
//! First columns, then rows. Each pass has 22-bit weights and rounds to 8 bits. That is Pillow's
//! `BILINEAR`, bit for bit: Segment Anything and similar networks were trained on it.

use rayon::prelude::*;

/// Bits of a weight after the point: 8 bits of pixel and 2 of head room are left of 32.
const WEIGHT_BITS: u32 = 32 - 8 - 2;

/// For each output pixel of one axis: the first source pixel and the weights from there on.
struct Taps(Vec<(usize, Vec<i32>)>);

impl Taps {
    fn new(size: usize, outputs: usize) -> Self {
        let scale = size as f64 / outputs as f64;
        let support = scale.max(1.0);
        let taps = (0..outputs).map(|i| {
            let centre = (i as f64 + 0.5) * scale;
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in range")]
            let (first, last) = (
                (centre - support + 0.5).max(0.0) as usize,
                ((centre + support + 0.5) as usize).min(size),
            );
            let raw: Vec<f64> = (first..last)
                .map(|j| (1.0 - ((j as f64 - centre + 0.5) / support).abs()).max(0.0))
                .collect();
            let sum: f64 = raw.iter().sum();
            let one = f64::from(1_u32 << WEIGHT_BITS);
            #[expect(clippy::cast_possible_truncation, reason = "at most 2^22")]
            let weights = raw.iter().map(|w| (0.5 + w / sum * one) as i32).collect();
            (first, weights)
        });
        Self(taps.collect())
    }
}

/// `[height, width, 3]` pixels at another size; sides must be over 0.
pub(super) fn resize(
    rgb: &[u8],
    [width, height]: [usize; 2],
    [out_width, out_height]: [usize; 2],
) -> Vec<u8> {
    if [width, height] == [out_width, out_height] {
        return rgb.to_vec();
    }
    let columns = Taps::new(width, out_width);
    let mut wide = vec![0_u8; height * out_width * 3];
    let lines = wide.par_chunks_mut(out_width * 3).zip(rgb.par_chunks(width * 3));
    lines.for_each(|(out, line)| {
        for (pixel, (first, weights)) in out.chunks_exact_mut(3).zip(&columns.0) {
            let mut sum = [1_i32 << (WEIGHT_BITS - 1); 3];
            for (source, weight) in line[first * 3..].chunks_exact(3).zip(weights) {
                for (s, v) in sum.iter_mut().zip(source) {
                    *s += weight * i32::from(*v);
                }
            }
            pixel.copy_from_slice(&sum.map(narrow));
        }
    });
    let rows = Taps::new(height, out_height);
    let mut out = vec![0_u8; out_height * out_width * 3];
    out.par_chunks_mut(out_width * 3).zip(&rows.0).for_each(|(out, (first, weights))| {
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

/// `[3, side, side]` f32, normalised; the picture lies in the top left corner, the rest is 0.
pub(super) fn planes(
    rgb: &[u8],
    [width, height]: [usize; 2],
    side: usize,
    mean: [f32; 3],
    std: [f32; 3],
) -> Vec<f32> {
    let mut planes = vec![0.0; 3 * side * side];
    for (c, plane) in planes.chunks_exact_mut(side * side).enumerate() {
        let lines = plane.chunks_exact_mut(side).zip(rgb.chunks_exact(width * 3)).take(height);
        for (out, line) in lines {
            for (v, pixel) in out.iter_mut().zip(line.chunks_exact(3)) {
                *v = (f32::from(pixel[c]) / 255.0 - mean[c]) / std[c];
            }
        }
    }
    planes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pillow_gives_the_same_bytes() {
        // numpy: (np.arange(7 * 5 * 3) * 37 % 256).reshape(5, 7, 3); Image.resize(BILINEAR).
        let rgb: Vec<u8> = (0..105).map(|i| (i * 37 % 256) as u8).collect();
        let small = [
            104, 86, 123, 146, 123, 100, 123, 160, 142, 105, 104, 141, 145, 122, 118, 141, 161, 131,
        ];
        assert_eq!(resize(&rgb, [7, 5], [3, 2]), small, "7x5 to 3x2");
        let large = resize(&rgb, [7, 5], [9, 11]);
        let sum: u32 = large.iter().map(|v| u32::from(*v)).sum();
        assert_eq!(sum, 37_103, "7x5 to 9x11");
        assert_eq!(large[150..156], [181, 218, 56, 125, 162, 86], "7x5 to 9x11");
    }

    #[test]
    fn planes_are_padded_right_and_bottom_after_normalisation() {
        let planes = planes(&[255, 0, 51, 0, 255, 51], [2, 1], 3, [0.5, 0.0, 0.2], [0.5, 1.0, 1.0]);
        let rows: Vec<&[f32]> = planes.chunks(3).collect();
        assert_eq!(rows[0], [1.0, -1.0, 0.0], "red");
        assert_eq!(rows[3], [0.0, 1.0, 0.0], "green");
        assert_eq!(rows[6], [0.0, 0.0, 0.0], "blue is its mean");
        assert!(rows[1].iter().chain(rows[2]).all(|v| *v == 0.0), "the rest is 0");
    }
}
