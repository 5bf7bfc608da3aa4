//! Photos at half their size, which are learnt first.

use crate::scene::{Camera, Intrinsics, Photo};

/// A photo of half the size: the mean of each two by two pixels. One is known where all four are.
pub(super) fn halved(photo: &Photo) -> Photo {
    let (width, height) = (photo.width / 2, photo.height / 2);
    let four = |i: usize| {
        let (x, y) = (2 * (i % width as usize), 2 * (i / width as usize));
        let at = y * photo.width as usize + x;
        [at, at + 1, at + photo.width as usize, at + photo.width as usize + 1]
    };
    let mean = |i: usize| -> [u8; 3] {
        let sum = |c: usize| four(i).iter().map(|at| u16::from(photo.rgb[3 * at + c])).sum::<u16>();
        std::array::from_fn(|c| (sum(c) + 2).div_euclid(4) as u8)
    };
    let pixels = 0..width as usize * height as usize;
    let rgb = pixels.clone().flat_map(mean).collect();
    let known = |valid: &Vec<bool>| -> Vec<bool> {
        pixels.map(|i| four(i).iter().all(|at| valid[*at])).collect()
    };
    let valid = photo.valid.as_ref().map(known);
    Photo { width, height, rgb, valid }
}

/// The camera of such a photo.
pub(super) fn halved_camera(camera: Camera) -> Camera {
    let lens = camera.intrinsics;
    let (width, height) = (lens.width / 2, lens.height / 2);
    let [fx, fy, cx, cy] = [lens.fx, lens.fy, lens.cx, lens.cy].map(|v| v / 2.0);
    Camera { intrinsics: Intrinsics { fx, fy, cx, cy, width, height }, ..camera }
}
