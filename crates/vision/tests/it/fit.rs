//! Photos at the size of the geometry network.

use segsplat_core::scene::{Camera, CameraToWorld, Intrinsics, Photo};
use segsplat_vision::models::{ResizeFilter, bucket_for, fit};

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
        let fitted = fit(&photo, &camera, bucket, ResizeFilter::Triangle);
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
    }
}

#[test]
fn the_same_size_changes_no_pixel() {
    let photo = ramp(48, 32);
    let fitted = fit(&photo, &camera(48, 32), [32, 48], ResizeFilter::Triangle);
    let same = fitted.rgb.iter().zip(&photo.rgb).all(|(a, b)| (a * 255.0).round() == f32::from(*b));
    assert!(same, "identity");
    assert_eq!(fitted.camera, camera(48, 32), "camera unchanged");
}

#[test]
fn the_filters_are_pillows() {
    // numpy: (np.arange(7 * 5 * 3) * 37 % 256).reshape(5, 7, 3); Image.resize((3, 2), LANCZOS,
    // box=(0, 1 / 6, 7, 5 - 1 / 6)), and so on: the crop of 7x5 to the shape 3:2.
    let rgb: Vec<u8> = (0..105).map(|i| (i * 37 % 256) as u8).collect();
    let photo = Photo { width: 7, height: 5, rgb, valid: None };
    let pillow: [(ResizeFilter, [u8; 18]); 3] = [
        (
            ResizeFilter::Triangle,
            [
                104, 86, 123, 146, 123, 100, 123, 160, 142, 106, 104, 141, 146, 123, 118, 141, 162,
                132,
            ],
        ),
        (
            ResizeFilter::Bicubic,
            [
                100, 79, 126, 158, 124, 87, 117, 166, 149, 100, 103, 146, 153, 119, 111, 141, 166,
                134,
            ],
        ),
        (
            ResizeFilter::Lanczos,
            [101, 73, 128, 164, 126, 82, 113, 172, 152, 98, 102, 149, 155, 117, 110, 142, 169, 132],
        ),
    ];
    for (filter, wanted) in pillow {
        let found = fit(&photo, &camera(7, 5), [2, 3], filter).rgb;
        for (found, wanted) in found.iter().zip(wanted) {
            // Pillow rounds to 8 bits after the columns and after the rows.
            let off = (found * 255.0 - f32::from(wanted)).abs();
            assert!(off < 1.01, "{filter:?}: {} for {wanted}", found * 255.0);
        }
    }
}

#[test]
fn a_reduction_averages_and_does_not_alias() {
    // A one-pixel checkerboard reduced by 4 is grey everywhere away from the border.
    let (w, h) = (128_u32, 128_u32);
    let rgb = (0..h)
        .flat_map(|y| (0..w).flat_map(move |x| [if (x + y) % 2 == 0 { 255 } else { 0 }; 3]))
        .collect();
    let photo = Photo { width: w, height: h, rgb, valid: None };
    let fitted = fit(&photo, &camera(w, h), [32, 32], ResizeFilter::Triangle);
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
    let fitted = fit(&photo, &camera(64, 64), [32, 32], ResizeFilter::Triangle);
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

#[test]
fn at_its_own_size_a_photo_keeps_its_levels() {
    let levels: Vec<u8> = (0..=u8::MAX).flat_map(|v| [v, 255 - v, v ^ 0x55]).collect();
    let photo = Photo { width: 16, height: 16, rgb: levels.clone(), valid: None };
    let wanted: Vec<f32> = levels.iter().map(|v| f32::from(*v) / 255.0).collect();
    for filter in [ResizeFilter::Triangle, ResizeFilter::Lanczos] {
        let found = fit(&photo, &camera(16, 16), [16, 16], filter).rgb;
        // Lanczos gives the neighbours weights of 1e-17. An ulp of a level is 1e-10 and more.
        let far = |(a, b): (&f32, &f32)| (a - b).abs() > 1e-12;
        assert!(!found.iter().zip(&wanted).any(far), "{filter:?}: not v / 255");
    }
}
