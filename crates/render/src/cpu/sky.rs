//! The backdrop as a view sees it: from a pixel to a cell of the map. Shader:
//! `shaders/common/backdrop.wgsl`

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use super::lanes::Lanes;
use crate::{constants::ATAN, scene::Backdrop, view::View};

const LAST_ROW: f32 = Backdrop::HEIGHT as f32 - 1.0;
const LAST_COLUMN: f32 = Backdrop::WIDTH as f32 - 1.0;

/// A backdrop and the rays of a view. The ray of a pixel's centre is
/// `first + x * across + y * down` in world axes, of any length.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sky<'a> {
    backdrop: &'a Backdrop,
    first: [f32; 3],
    across: [f32; 3],
    down: [f32; 3],
}

impl<'a> Sky<'a> {
    pub(super) fn new(backdrop: &'a Backdrop, view: &View) -> Self {
        let [first, across, down] = view.rays();
        Self { backdrop, first, across, down }
    }

    /// Places in the map of the pixels in columns `x` and rows `y` of the picture: longitude and
    /// latitude in cells, counted from the centre of the first.
    #[inline(always)]
    pub(super) fn places<S: Lanes>(&self, simd: S, x: S::f32s, y: S::f32s) -> (S::f32s, S::f32s) {
        let number = |value: f64| simd.splat_f32s(value as f32);
        let mut ray = [x; 3];
        for (k, ray) in ray.iter_mut().enumerate() {
            let row = simd.fused(y, simd.splat_f32s(self.down[k]), simd.splat_f32s(self.first[k]));
            *ray = simd.fused(x, simd.splat_f32s(self.across[k]), row);
        }
        let [x, y, z] = ray;
        let flat = simd.sqrt_f32s(simd.fused(x, x, simd.mul_f32s(z, z)));
        let (width, height) = (Backdrop::WIDTH as f64, Backdrop::HEIGHT as f64);
        let u = simd.fused(atan2(simd, x, z), number(width / TAU), number(0.5 * width - 0.5));
        let v = simd.fused(atan2(simd, y, flat), number(height / PI), number(0.5 * height - 0.5));
        let v = simd.min_f32s(simd.max_f32s(v, number(0.0)), simd.splat_f32s(LAST_ROW));
        (u, v)
    }

    /// The colour at a place in the map, between the centres of four cells.
    #[inline(always)]
    pub(super) fn color(&self, u: f32, v: f32) -> [f32; 3] {
        let (u0, v0) = (u.clamp(-1.0, LAST_COLUMN).floor(), v.clamp(0.0, LAST_ROW).floor());
        let (fu, fv) = (u - u0, v - v0);
        let (x0, y0) = ((u0 as i32).rem_euclid(Backdrop::WIDTH as i32) as usize, v0 as usize);
        let (x1, y1) = ((x0 + 1) % Backdrop::WIDTH, (y0 + 1).min(Backdrop::HEIGHT - 1));
        let cells = self.backdrop.cells();
        let at = |x: usize, y: usize| &cells[y * Backdrop::WIDTH + x];
        let corners = [at(x0, y0), at(x1, y0), at(x0, y1), at(x1, y1)];
        let mut color = [0.0; 3];
        for (k, color) in color.iter_mut().enumerate() {
            let [a, b, c, d] = corners.map(|cell| f32::from(cell[k]));
            let (top, low) = (a + fu * (b - a), c + fu * (d - c));
            *color = (top + fv * (low - top)) * (1.0 / 255.0);
        }
        color
    }
}

/// The angle of (`x`, `y`) from the x axis, to 4e-7.
#[inline(always)]
fn atan2<S: Lanes>(simd: S, y: S::f32s, x: S::f32s) -> S::f32s {
    let number = |value: f64| simd.splat_f32s(value as f32);
    let zero = number(0.0);
    let (wide, tall) = (simd.abs(x), simd.abs(y));
    let long = simd.max_f32s(simd.max_f32s(wide, tall), simd.splat_f32s(f32::MIN_POSITIVE));
    let share = simd.div_f32s(simd.min_f32s(wide, tall), long);
    let square = simd.mul_f32s(share, share);
    let mut angle = simd.splat_f32s(ATAN[6]);
    for term in ATAN[..6].iter().rev() {
        angle = simd.fused(angle, square, simd.splat_f32s(*term));
    }
    let angle = simd.mul_f32s(angle, share);
    let steep = simd.greater_than_f32s(tall, wide);
    let angle = simd.select_f32s(steep, simd.sub_f32s(number(FRAC_PI_2), angle), angle);
    let back = simd.greater_than_f32s(zero, x);
    let angle = simd.select_f32s(back, simd.sub_f32s(number(PI), angle), angle);
    simd.select_f32s(simd.greater_than_f32s(zero, y), simd.sub_f32s(zero, angle), angle)
}
