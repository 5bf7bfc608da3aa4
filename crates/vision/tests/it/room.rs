//! The photos in `tests/fixtures/room`: generated, so that a clone alone can test what real photos
//! test, and made like real ones. JPEG files, a lens that distorts, one set of intrinsics for all.

use std::path::PathBuf;

use glam::DVec3;
use image::codecs::jpeg::JpegEncoder;
use segsplat_core::scene::{Camera, CameraToWorld, Intrinsics};
use segsplat_testing::root;
use segsplat_vision::sample::{Room, TARGET};
use serde_json::json;

/// Seed of the room.
const SEED: u64 = 11;
pub(crate) const PHOTOS: usize = 6;
const WIDTH: u32 = 320;
const HEIGHT: u32 = 240;
const FOCAL: f64 = 300.0;
/// Distortion of the lens, as OpenCV defines it: `k1 k2 p1 p2`.
const LENS: [f64; 4] = [-0.12, 0.05, 0.002, -0.001];

/// The folder: `transforms.json` and `images/`.
pub(crate) fn folder() -> PathBuf {
    root().join("tests/fixtures/room")
}

/// The room itself, which gives the true picture and depth at any camera.
pub(crate) fn room() -> Room {
    Room::new(SEED)
}

/// OpenCV camera-to-world of photo `i`. The cameras go round the target and come nearer.
fn pose(i: usize) -> CameraToWorld {
    let step = i as f64;
    let (arc, rise) = (-0.35 + 0.13 * step, -0.2 - 0.11 * step);
    let eye = TARGET + DVec3::new(arc.sin(), rise, -arc.cos()).normalize() * (3.7 - 0.12 * step);
    CameraToWorld::look_at(eye, TARGET, -DVec3::Y, "a photo of the room").unwrap()
}

/// The undistorted image point whose distorted one is (x, y), both at depth 1.
fn undistorted(x: f64, y: f64) -> (f64, f64) {
    let [k1, k2, p1, p2] = LENS;
    let (mut a, mut b) = (x, y);
    for _ in 0..50 {
        let r2 = a * a + b * b;
        let radial = 1.0 + k1 * r2 + k2 * r2 * r2;
        let (dx, dy) = (
            2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a),
            p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b,
        );
        (a, b) = ((x - dx) / radial, (y - dy) / radial);
    }
    (a, b)
}

/// RGB of photo `i` as the lens sees it.
fn distorted(i: usize) -> Vec<u8> {
    // A picture without distortion, twice as fine and wider, from which the lens takes its pixels.
    let (fine, width, height) = (2.0 * FOCAL, 3 * WIDTH, 3 * HEIGHT);
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    let intrinsics = Intrinsics { fx: fine, fy: fine, cx, cy, width, height };
    let sharp = room().view(&Camera { intrinsics, camera_to_world: pose(i) }).photo.rgb;
    let at = |x: usize, y: usize, c: usize| f64::from(sharp[3 * (y * width as usize + x) + c]);
    let mut rgb = Vec::new();
    for pixel in 0..WIDTH * HEIGHT {
        let (u, v) = (f64::from(pixel % WIDTH) + 0.5, f64::from(pixel / WIDTH) + 0.5);
        let (x, y) = undistorted(
            (u - f64::from(WIDTH) / 2.0) / FOCAL,
            (v - f64::from(HEIGHT) / 2.0) / FOCAL,
        );
        let (x, y) = (fine * x + cx - 0.5, fine * y + cy - 0.5);
        let (x0, y0) = (x.floor(), y.floor());
        let (ax, ay) = (x - x0, y - y0);
        let (x0, y0) = (x0 as usize, y0 as usize);
        for c in 0..3 {
            let above = at(x0, y0, c) * (1.0 - ax) + at(x0 + 1, y0, c) * ax;
            let below = at(x0, y0 + 1, c) * (1.0 - ax) + at(x0 + 1, y0 + 1, c) * ax;
            rgb.push((above * (1.0 - ay) + below * ay).round() as u8);
        }
    }
    rgb
}

#[test]
#[ignore = "writes tests/fixtures/room anew"]
fn write() {
    let images = folder().join("images");
    std::fs::create_dir_all(&images).unwrap();
    let frames: Vec<_> = (0..PHOTOS)
        .map(|i| {
            let name = format!("{i:04}.jpg");
            let mut file = Vec::new();
            JpegEncoder::new_with_quality(&mut file, 90)
                .encode(&distorted(i), WIDTH, HEIGHT, image::ExtendedColorType::Rgb8)
                .unwrap();
            std::fs::write(images.join(&name), file).unwrap();
            // OpenGL: y up, z backwards.
            let mut m = pose(i).to_row_major();
            for row in 0..3 {
                (m[row * 4 + 1], m[row * 4 + 2]) = (-m[row * 4 + 1], -m[row * 4 + 2]);
            }
            let rows: Vec<_> = m.chunks(4).map(<[f64]>::to_vec).collect();
            json!({ "file_path": format!("images/{name}"), "transform_matrix": rows })
        })
        .collect();
    let transforms = json!({
        "camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL,
        "cx": f64::from(WIDTH) / 2.0, "cy": f64::from(HEIGHT) / 2.0,
        "k1": LENS[0], "k2": LENS[1], "p1": LENS[2], "p2": LENS[3], "frames": frames,
    });
    std::fs::write(folder().join("transforms.json"), format!("{transforms:#}\n")).unwrap();
}
