//! The hindsight warp: a network is of use only where it is better than this.

use rayon::prelude::*;

use crate::{metrics::psnr, render::train::unit, scene::PosedPhoto};

/// Depths tried, geometric from the first to the last, in baselines.
const DEPTHS: i32 = 24;
const NEAREST: f64 = 1.0;
const FARTHEST: f64 = 30.0;

/// Best PSNR over 24 constant depths (of the target's camera) and all inputs, dB.
///
/// Each target pixel takes the input's colour where a plane at that depth puts it: bilinear, the
/// border repeated.
#[must_use]
pub fn hindsight_warp(target: &PosedPhoto, inputs: &[&PosedPhoto], baseline: f64) -> f64 {
    let truth = unit(&target.photo);
    let tries: Vec<(&PosedPhoto, i32)> =
        inputs.iter().flat_map(|input| (0..DEPTHS).map(move |step| (*input, step))).collect();
    let ratio: f64 = FARTHEST / NEAREST;
    tries
        .par_iter()
        .map(|(input, step)| {
            let share = f64::from(*step) / f64::from(DEPTHS - 1);
            let warped = warp(target, input, NEAREST * ratio.powf(share) * baseline);
            psnr(&warped, &truth, target.photo.valid.as_deref())
        })
        .max_by(f64::total_cmp)
        .unwrap_or_default()
}

/// `input` seen from the target's camera, as if all of it lay at `depth` of the target's camera.
#[must_use]
pub fn warp(target: &PosedPhoto, input: &PosedPhoto, depth: f64) -> Vec<[f32; 3]> {
    let lens = target.camera.intrinsics;
    let to_input = input.camera.camera_to_world.viewmat() * target.camera.camera_to_world.matrix();
    let mut out = Vec::with_capacity(lens.width as usize * lens.height as usize);
    for y in 0..lens.height {
        for x in 0..lens.width {
            let point = lens.unproject(f64::from(x) + 0.5, f64::from(y) + 0.5, depth);
            let seen = to_input.transform_point3(point);
            let (u, v) = input.camera.intrinsics.project(seen);
            let width = input.photo.width as usize;
            let colour = bilinear(&input.photo.rgb, width, u - 0.5, v - 0.5);
            #[expect(clippy::cast_possible_truncation, reason = "0..=1")]
            out.push(colour.map(|v| (v / 255.0) as f32));
        }
    }
    out
}

/// Colour at (x, y) of rows of RGB, pixel centres at whole numbers, the border repeated.
#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped inside")]
pub(crate) fn bilinear<T: Copy + Into<f64>>(rgb: &[T], width: usize, x: f64, y: f64) -> [f64; 3] {
    let (w, h) = (width, rgb.len() / (3 * width));
    let inside = |v: f64, n: usize| if v.is_finite() { v.clamp(0.0, n as f64 - 1.0) } else { 0.0 };
    let (x, y) = (inside(x, w), inside(y, h));
    let (x0, y0) = (x as usize, y as usize);
    let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
    let (tx, ty) = (x - x0 as f64, y - y0 as f64);
    let at = |x: usize, y: usize, c: usize| -> f64 { rgb[(y * w + x) * 3 + c].into() };
    std::array::from_fn(|c| {
        let top = at(x0, y0, c) * (1.0 - tx) + at(x1, y0, c) * tx;
        let bottom = at(x0, y1, c) * (1.0 - tx) + at(x1, y1, c) * tx;
        top * (1.0 - ty) + bottom * ty
    })
}
