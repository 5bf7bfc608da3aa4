//! PSNR, SSIM, means and the hindsight warp of known pictures.

use segsplat_core::scene::{Camera, CameraToWorld, Intrinsics, PosedPhoto};
use segsplat_lab::{
    metrics::{psnr, ssim},
    rows::means,
    warp::{hindsight_warp, warp},
};
use segsplat_render::{compare::PSNR_MAX, train::unit};
use serde_json::json;

use crate::posed;

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
    let wanted = (2.0 * 0.35 + 0.0001) / (0.25 + 0.49 + 0.0001);
    assert!((ssim(&a, &b, 32, None) - wanted).abs() < 1e-6, "luminance");
    let inverse: Vec<[f32; 3]> = texture.iter().map(|c| c.map(|v| 0.9 - v)).collect();
    assert!(ssim(&inverse, &texture, 32, None) < 0.0, "opposite structure");
}

#[test]
fn means_are_those_of_numbers_at_any_depth() {
    let [a, b] = [1.0, 3.0].map(|n| json!({ "n": n, "in": { "x": 2.0 * n }, "name": "t" }));
    assert_eq!(means([&a, &b]), json!({ "n": 2.0, "in": { "x": 4.0 } }));
    let missing = json!({ "n": null });
    assert_eq!(means([&a, &missing]), json!({ "in": {} }), "no number, no mean");
    assert_eq!(means([]), json!({}));
}

/// A wall at z = `depth` with a pattern, seen from x = `eye`.
fn wall(eye: f64, depth: f64) -> PosedPhoto {
    let lens = Intrinsics { fx: 64., fy: 64., cx: 32., cy: 32., width: 64, height: 64 };
    let pose = [1., 0., 0., eye, 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
    let mut rgb = Vec::new();
    for y in 0..64 {
        for x in 0..64 {
            let p = lens.unproject(f64::from(x) + 0.5, f64::from(y) + 0.5, depth);
            let v = 127.5 + 60.0 * ((p.x + eye) * 5.0).sin() + 60.0 * (p.y * 6.0).cos();
            rgb.extend([v as u8; 3]);
        }
    }
    let camera_to_world = CameraToWorld::from_row_major(&pose, "t").unwrap();
    posed(Camera { intrinsics: lens, camera_to_world }, rgb)
}

#[test]
fn a_wall_at_a_tried_depth_is_met() {
    let baseline = 0.2;
    let depth = baseline * 30.0_f64.powf(12.0 / 23.0);
    let target = wall(0.1, depth);
    let best = hindsight_warp(&target, &[&wall(0.0, depth), &wall(0.2, depth)], baseline);
    let other = warp(&target, &wall(0.0, depth), depth * 2.0);
    let off = psnr(&other, &unit(&target.photo), None);
    assert!(best > off + 5.0, "{best} dB at the right depth, {off} at another");
}
