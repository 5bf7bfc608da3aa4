//! Crops and resizes a photo to the network's working size, and changes its intrinsics to match.
//!
//! The crop is central and has the shape of the bucket. It may start between pixels. The filter is
//! the manifest's, widened by the reduction: it does not alias, and the training used it. The
//! result is Pillow's `resize` with a `box`, without the rounding to 8 bits.

use rayon::prelude::*;

use crate::{
    models::ResizeFilter,
    scene::{Camera, Intrinsics, Photo},
};

/// A photo at a network's working size.
#[derive(Clone, Debug)]
pub struct FittedPhoto {
    /// Camera of these pixels.
    pub camera: Camera,
    /// `[height * width * 3]`, 0..1, sRGB as stored, row-major.
    pub rgb: Vec<f32>,
    /// `[height * width]`, false where most of the pixel has no source; `None` when all have one.
    pub valid: Option<Vec<bool>>,
}

/// The bucket `[height, width]` that keeps most of the photos' pixels when all are cropped to it.
///
/// Ties go to the bucket with more pixels, then to the first. Empty `buckets` give `None`.
#[must_use]
pub fn bucket_for(photos: &[Intrinsics], buckets: &[[u32; 2]]) -> Option<[u32; 2]> {
    let kept = |[height, width]: [u32; 2]| -> f64 {
        let wanted = f64::from(width) / f64::from(height);
        let share = |lens: &Intrinsics| {
            let aspect = f64::from(lens.width) / f64::from(lens.height);
            (aspect / wanted).min(wanted / aspect)
        };
        photos.iter().map(share).sum()
    };
    let pixels = |[height, width]: [u32; 2]| u64::from(height) * u64::from(width);
    let mut best: Option<([u32; 2], f64)> = None;
    for &bucket in buckets {
        let score = kept(bucket);
        let better = best.is_none_or(|(of, top)| {
            score > top + 1e-9 || (score > top - 1e-9 && pixels(bucket) > pixels(of))
        });
        if better {
            best = Some((bucket, score));
        }
    }
    best.map(|(bucket, _)| bucket)
}

/// Crops the middle of `photo` to the aspect of `height` x `width` and resizes it to that size.
#[must_use]
pub fn fit(
    photo: &Photo,
    camera: &Camera,
    [height, width]: [u32; 2],
    filter: ResizeFilter,
) -> FittedPhoto {
    let lens = camera.intrinsics;
    let (w, h) = (f64::from(photo.width), f64::from(photo.height));
    let aspect = f64::from(width) / f64::from(height);
    let (crop_w, crop_h) = if w / h > aspect { (h * aspect, h) } else { (w, w / aspect) };
    let (x0, y0) = ((w - crop_w) / 2.0, (h - crop_h) / 2.0);
    let (sx, sy) = (f64::from(width) / crop_w, f64::from(height) / crop_h);
    let intrinsics = Intrinsics {
        fx: lens.fx * sx,
        fy: lens.fy * sy,
        cx: (lens.cx - x0) * sx,
        cy: (lens.cy - y0) * sy,
        width,
        height,
    };
    #[expect(clippy::cast_possible_truncation, reason = "weights need no more than f32")]
    let narrow = |weight: f64| weight as f32;
    let columns = filter.taps(photo.width, [x0, crop_w], width, narrow);
    let rows = filter.taps(photo.height, [y0, crop_h], height, narrow);
    let (rgb, weight) = resample(photo, &columns, &rows);
    let valid = photo.valid.as_ref().map(|_| weight.iter().map(|&w| w >= 0.5).collect());
    FittedPhoto { camera: Camera { intrinsics, ..*camera }, rgb, valid }
}

/// For each output pixel of one axis: the first source pixel and the weights from there on.
type Taps = [(usize, Vec<f32>)];

/// Rows first, then columns; invalid pixels carry no weight. Also the valid weight of each pixel.
fn resample(photo: &Photo, columns: &Taps, rows: &Taps) -> (Vec<f32>, Vec<f32>) {
    let width = photo.width as usize;
    let out_width = columns.len();
    let mut rgb = vec![0.0_f32; rows.len() * out_width * 3];
    let mut weight = vec![0.0_f32; rows.len() * out_width];
    let out = rgb.par_chunks_mut(out_width * 3).zip(weight.par_chunks_mut(out_width));
    rows.par_iter().zip(out).for_each(|((first, weights), (rgb, weight))| {
        let mut line = vec![[0.0_f32; 4]; width];
        for (y, weight) in (*first..).zip(weights) {
            for (x, sum) in line.iter_mut().enumerate() {
                let at = y * width + x;
                if photo.valid.as_ref().is_none_or(|valid| valid[at]) {
                    for (c, s) in sum.iter_mut().enumerate().take(3) {
                        *s += weight * f32::from(photo.rgb[at * 3 + c]);
                    }
                    sum[3] += weight;
                }
            }
        }
        let pixels = rgb.chunks_exact_mut(3).zip(weight);
        for ((first, weights), (rgb, valid)) in columns.iter().zip(pixels) {
            let mut sum = [0.0_f32; 4];
            for (x, weight) in (*first..).zip(weights) {
                for (s, v) in sum.iter_mut().zip(line[x]) {
                    *s += weight * v;
                }
            }
            // One rounding: at its own size a photo has the numbers that others feed the network.
            let whole = if sum[3] > 1e-6 { 255.0 * sum[3] } else { f32::INFINITY };
            rgb.iter_mut().zip(sum).for_each(|(v, s)| *v = (s / whole).clamp(0.0, 1.0));
            *valid = sum[3];
        }
    });
    (rgb, weight)
}
