//! Crops and resizes a photo to the network's working size, and changes its intrinsics to match.
//!
//! The crop is central and has the shape of the bucket. It may start between pixels. The filter is
//! the triangle, widened by the reduction: it does not alias, and the training used it.

use rayon::prelude::*;

use crate::scene::{Camera, Intrinsics, Photo};

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
pub fn fit(photo: &Photo, camera: &Camera, [height, width]: [u32; 2]) -> FittedPhoto {
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
    let columns = Taps::new(photo.width, x0, crop_w, width);
    let rows = Taps::new(photo.height, y0, crop_h, height);
    let (rgb, weight) = resample(photo, &columns, &rows);
    let valid = photo.valid.as_ref().map(|_| weight.iter().map(|&w| w >= 0.5).collect());
    FittedPhoto { camera: Camera { intrinsics, ..*camera }, rgb, valid }
}

/// For each output pixel of one axis: the first source pixel and the weights from there on.
struct Taps(Vec<(usize, Vec<f32>)>);

impl Taps {
    /// Triangle filter from `length` source pixels beginning at `start` to `outputs` pixels.
    fn new(size: u32, start: f64, length: f64, outputs: u32) -> Self {
        let scale = length / f64::from(outputs);
        let support = scale.max(1.0);
        let taps = (0..outputs).map(|i| {
            let centre = start + (f64::from(i) + 0.5) * scale;
            let first = (centre - support).floor().max(0.0);
            let last = (centre + support).ceil().min(f64::from(size));
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "in range")]
            let (first, last) = (first as usize, (last as usize).max(first as usize + 1));
            let raw: Vec<f64> = (first..last)
                .map(|j| (1.0 - ((j as f64 + 0.5 - centre) / support).abs()).max(0.0))
                .collect();
            let sum: f64 = raw.iter().sum();
            #[expect(clippy::cast_possible_truncation, reason = "weights need no more than f32")]
            let weights = raw.iter().map(|w| (w / sum) as f32).collect();
            (first, weights)
        });
        Self(taps.collect())
    }
}

/// Rows first, then columns; invalid pixels carry no weight. Also the valid weight of each pixel.
fn resample(photo: &Photo, columns: &Taps, rows: &Taps) -> (Vec<f32>, Vec<f32>) {
    let width = photo.width as usize;
    let out_width = columns.0.len();
    let lines: Vec<(Vec<f32>, Vec<f32>)> = rows
        .0
        .par_iter()
        .map(|(first, weights)| {
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
            let mut rgb = Vec::with_capacity(out_width * 3);
            let mut valid = Vec::with_capacity(out_width);
            for (first, weights) in &columns.0 {
                let mut sum = [0.0_f32; 4];
                for (x, weight) in (*first..).zip(weights) {
                    for (s, v) in sum.iter_mut().zip(line[x]) {
                        *s += weight * v;
                    }
                }
                let scale = if sum[3] > 1e-6 { 1.0 / (255.0 * sum[3]) } else { 0.0 };
                rgb.extend(sum.iter().take(3).map(|s| (s * scale).clamp(0.0, 1.0)));
                valid.push(sum[3]);
            }
            (rgb, valid)
        })
        .collect();
    let mut rgb = Vec::with_capacity(rows.0.len() * out_width * 3);
    let mut weight = Vec::with_capacity(rows.0.len() * out_width);
    for (line, valid) in lines {
        rgb.extend(line);
        weight.extend(valid);
    }
    (rgb, weight)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::CameraToWorld;
    use glam::DVec3;

    fn camera(width: u32, height: u32) -> Camera {
        let pose = [1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
        Camera {
            intrinsics: Intrinsics { fx: 90.0, fy: 80.0, cx: 47.3, cy: 21.7, width, height },
            camera_to_world: CameraToWorld::from_row_major(&pose, "test").unwrap(),
        }
    }

    /// A picture whose red is the column and green the row, so that sampling can be read off.
    fn ramp(width: u32, height: u32) -> Photo {
        let rgb =
            (0..height).flat_map(|y| (0..width).flat_map(move |x| [x as u8, y as u8, 7])).collect();
        Photo { width, height, rgb, valid: None }
    }

    #[test]
    fn intrinsics_follow_the_crop_and_resize() {
        for (size, bucket) in [((100, 61), [32, 48]), ((61, 100), [32, 32]), ((90, 33), [48, 32])] {
            let photo = ramp(size.0, size.1);
            let camera = camera(size.0, size.1);
            let fitted = fit(&photo, &camera, bucket);
            // The pixel that shows a point must show the colour the photo has at that point.
            for (x, y) in [(10, 12), (16, 20), (25, 9)] {
                let z = 3.0;
                let point =
                    fitted.camera.intrinsics.unproject(f64::from(x) + 0.5, f64::from(y) + 0.5, z);
                let (u, v) = camera.intrinsics.project(point);
                let at = ((y * fitted.camera.intrinsics.width + x) * 3) as usize;
                let (red, green) = (fitted.rgb[at] * 255.0, fitted.rgb[at + 1] * 255.0);
                // A reduction's weights are sampled at whole pixels, so a ramp comes back to a few
                // hundredths; a half-pixel mistake is ten times that.
                assert!((f64::from(red) - (u - 0.5)).abs() < 0.05, "{bucket:?} {red} {u}");
                assert!((f64::from(green) - (v - 0.5)).abs() < 0.05, "{bucket:?} {green} {v}");
            }
            let back = fitted.camera.intrinsics.project(DVec3::new(0.2, 0.1, 1.0));
            assert!(back.0.is_finite(), "finite");
        }
    }

    #[test]
    fn the_same_size_changes_no_pixel() {
        let photo = ramp(48, 32);
        let fitted = fit(&photo, &camera(48, 32), [32, 48]);
        let same =
            fitted.rgb.iter().zip(&photo.rgb).all(|(a, b)| (a * 255.0).round() == f32::from(*b));
        assert!(same, "identity");
        assert_eq!(fitted.camera, camera(48, 32), "camera unchanged");
    }

    #[test]
    fn a_reduction_averages_and_does_not_alias() {
        // A one-pixel checkerboard reduced by 4 is grey everywhere away from the border.
        let (w, h) = (128_u32, 128_u32);
        let rgb = (0..h)
            .flat_map(|y| (0..w).flat_map(move |x| [if (x + y) % 2 == 0 { 255 } else { 0 }; 3]))
            .collect();
        let photo = Photo { width: w, height: h, rgb, valid: None };
        let fitted = fit(&photo, &camera(w, h), [32, 32]);
        for y in 2..30 {
            for x in 2..30 {
                let v = fitted.rgb[(y * 32 + x) * 3];
                assert!((v - 0.5).abs() < 0.01, "({x}, {y}) is {v}");
            }
        }
    }

    #[test]
    fn pixels_without_a_source_do_not_bleed() {
        let mut photo = ramp(64, 64);
        let valid: Vec<bool> = (0..64 * 64).map(|i| i % 64 >= 20).collect();
        for (i, ok) in valid.iter().enumerate() {
            if !ok {
                photo.rgb[i * 3 + 2] = 255;
            }
        }
        photo.valid = Some(valid);
        let fitted = fit(&photo, &camera(64, 64), [32, 32]);
        let mask = fitted.valid.unwrap();
        assert!(!mask[5] && mask[15], "the mask follows");
        for (i, ok) in mask.iter().enumerate() {
            if *ok {
                assert!((fitted.rgb[i * 3 + 2] * 255.0 - 7.0).abs() < 1e-3, "pixel {i} bleeds");
            }
        }
    }

    #[test]
    fn the_bucket_keeps_most_of_all_photos() {
        let buckets = [[256, 256], [256, 352], [352, 256], [224, 384]];
        let size = |w, h| camera(w, h).intrinsics;
        assert_eq!(bucket_for(&[size(640, 480)], &buckets), Some([256, 352]));
        assert_eq!(bucket_for(&[size(360, 640)], &buckets), Some([352, 256]));
        assert_eq!(bucket_for(&[size(1920, 1080)], &buckets), Some([224, 384]));
        let mixed = [size(640, 480), size(480, 640), size(480, 640)];
        assert_eq!(bucket_for(&mixed, &buckets), Some([352, 256]), "as most photos stand");
    }
}
