//! The surface under a pixel, from the centres of the Gaussians around it.
//!
//! The depth that a view blends is no measure: what is nearer is in front of what is beside it, so
//! a surface that leans is seen too near, by half a percent to one at the floor of a room. The
//! centres are not: the inverse of a plane's depth is linear over a picture, and is fitted to them.

use glam::{DVec2, DVec3};
use rayon::prelude::*;
use segsplat_core::scene::{biweight, least_squares};

use super::{RenderRequest, oracle};
use crate::{
    error::Result,
    scene::{Gaussians, Intrinsics},
};

/// How far around the pixel the centres count, as a share of the picture's longer side: at this
/// distance 1/√e of what they do at the pixel, at twice as much nothing.
const REACH: f64 = 0.0125;
/// How far from the blended depth, as a share of it, is another surface.
const ANOTHER: f64 = 0.08;
/// A Gaussian that is off by so many times the median is none of the surface; never under the
/// other one, a share of the depth.
const OFF: (f64, f64) = (4.0, 0.005);
/// Fewest Gaussians of a surface.
const GAUSSIANS_MIN: usize = 8;
/// Rounds in which those that are off lose their weight.
const ROUNDS: usize = 6;

/// A centre near the pixel: where it is, in shares of the reach; its depth and weight.
struct Near {
    from: DVec2,
    /// The blended depth over its own.
    inverse: f64,
    weight: f64,
}

/// How far around a pixel of a lens a surface is looked for, pixels.
pub fn reach(lens: &Intrinsics) -> f64 {
    2.0 * REACH * f64::from(lens.width.max(lens.height))
}

/// Depth at a place of the whole picture where the view blends `blended`; `None` where too few
/// Gaussians tell. `among` are those that are asked, ascending, or all: those within [`reach`].
///
/// # Errors
/// `invalid_request` when the intrinsics are unusable.
pub fn depth(
    gaussians: &Gaussians,
    request: &RenderRequest,
    at: DVec2,
    blended: f64,
    among: Option<&[u32]>,
) -> Result<Option<f64>> {
    let lens = request.camera.intrinsics.validated("camera")?;
    let reach = 0.5 * reach(&lens);
    let (viewmat, origin) = (request.camera.camera_to_world.viewmat(), gaussians.origin());
    let near = |i: usize| {
        let mean = DVec3::from(gaussians.means()[i].map(f64::from)) + origin;
        let seen = viewmat.transform_point3(mean);
        if (seen.z / blended - 1.0).abs() > ANOTHER {
            return None;
        }
        let from = (DVec2::from(lens.project(seen)) - at) / reach;
        if from.length() > 2.0 {
            return None;
        }
        let opacity = oracle::splat(gaussians, i, request, &lens)?.opacity;
        let weight = opacity * (-0.5 * from.length_squared()).exp();
        Some(Near { from, inverse: blended / seen.z, weight })
    };
    let near: Vec<Near> = oracle::numbers(gaussians, among).filter_map(near).collect();
    Ok(fitted(&near).map(|inverse| blended / inverse))
}

/// The inverse at the pixel of the plane that these lie on, of all that one surface.
fn fitted(near: &[Near]) -> Option<f64> {
    if near.len() < GAUSSIANS_MIN {
        return None;
    }
    let row = |one: &Near| DVec3::new(1.0, one.from.x, one.from.y);
    let mut weights: Vec<f64> = near.iter().map(|one| one.weight).collect();
    let mut plane = DVec3::ZERO;
    for _ in 0..ROUNDS {
        let rows = near.iter().zip(&weights);
        plane = least_squares(rows.map(|(one, weight)| (row(one), one.inverse, *weight)))?;
        let off = |one: &Near| (one.inverse - plane.dot(row(one))).abs();
        let mut all: Vec<f64> = near.iter().map(off).collect();
        all.sort_by(f64::total_cmp);
        let most = (OFF.0 * all[all.len() / 2]).max(OFF.1);
        weights = near.iter().map(|one| one.weight * biweight(off(one), most)).collect();
    }
    ((plane.x - 1.0).abs() <= ANOTHER).then_some(plane.x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        Kinds,
        oracle::contributions,
        scene::{Camera, CameraToWorld, Intrinsics, RawGaussians, SourcePixel},
    };

    const EYE: f64 = 1.5;

    /// A camera over a floor at y = 0, level, and a Gaussian of the floor for each of its pixels,
    /// where `deeper` times its depth is.
    fn floor(deeper: impl Fn(u32, u32) -> f64) -> (Gaussians, RenderRequest) {
        let lens = Intrinsics { fx: 150.0, fy: 150.0, cx: 80.0, cy: 20.0, width: 160, height: 120 };
        let pose = [1., 0., 0., 7., 0., 1., 0., -EYE, 0., 0., 1., 3., 0., 0., 0., 1.];
        let camera_to_world = CameraToWorld::from_row_major(&pose, "test").unwrap();
        let camera = Camera { intrinsics: lens, camera_to_world };
        let mut raw = RawGaussians { origin: DVec3::new(7.0, 0.0, 5.0), ..RawGaussians::default() };
        for (x, y) in (0..160).flat_map(|x| (60..120).map(move |y| (x, y))) {
            let at = [x, y].map(|at| f64::from(at) + 0.5);
            let z = deeper(x, y) * true_depth(at[1]);
            let place = camera_to_world.matrix().transform_point3(lens.unproject(at[0], at[1], z));
            raw.means.push((place - raw.origin).as_vec3().to_array());
            raw.quats.push([1.0, 0.0, 0.0, 0.0]);
            raw.scales.push([(0.7 * z / lens.fx) as f32; 3]);
            raw.opacities.push(0.4);
            raw.sh.push([0.0; 3]);
            raw.semantic_index.push(0);
            raw.source.push(SourcePixel { view: 0, x: 0, y: 0 });
        }
        let request = RenderRequest::plain(camera, Kinds::NONE, 0.01);
        (Gaussians::sanitize(raw).unwrap().0, request)
    }

    fn true_depth(v: f64) -> f64 {
        EYE * 150.0 / (v - 20.0)
    }

    fn blended((gaussians, request): &(Gaussians, RenderRequest), pixel: [u32; 2]) -> f64 {
        let found = contributions(gaussians, request, pixel, None).unwrap();
        let all: f64 = found.iter().map(|one| one.weight).sum();
        found.iter().map(|one| one.weight * one.depth).sum::<f64>() / all
    }

    fn found(scene: &(Gaussians, RenderRequest), pixel: [u32; 2]) -> [f64; 2] {
        let [u, v] = pixel.map(|at| f64::from(at) + 0.5);
        let (blended, right) = (blended(scene, pixel), true_depth(v));
        let depth = depth(&scene.0, &scene.1, DVec2::new(u, v), blended, None).unwrap();
        [blended / right - 1.0, depth.unwrap() / right - 1.0]
    }

    #[test]
    fn a_floor_is_where_it_is_and_not_where_it_is_blended() {
        let noise = |x: u32, y: u32| 1.0 + 0.01 * (f64::from((x * 7 + y * 13) % 11) / 10.0 - 0.5);
        let scene = floor(noise);
        // The last one has no Gaussians under it, so what is around it is not as deep in the mean.
        for pixel in [[80, 90], [40, 80], [120, 100], [80, 118]] {
            let [blended, depth] = found(&scene, pixel);
            assert!(blended < -0.004, "what is nearer is in front: {blended}");
            assert!(depth.abs() < 0.001, "{depth} at {pixel:?}; blended: {blended}");
        }
    }

    #[test]
    fn what_lies_a_little_deeper_is_another_surface() {
        // At the right of the pixel everything is 5 % deeper: too much for one surface, and less
        // than what is left out unseen.
        let scene = floor(|x, _| if x > 81 { 1.05 } else { 1.0 });
        let [_, depth] = found(&scene, [80, 90]);
        assert!(depth.abs() < 0.003, "{depth}");
    }

    #[test]
    fn a_few_gaussians_are_no_surface() {
        let (all, request) = floor(|_, _| 1.0);
        let at = DVec2::new(80.5, 90.5);
        // Four of the 50 that are near.
        let few = all.only(|i| i % 11 == 0);
        assert_eq!(depth(&few, &request, at, true_depth(90.5), None).unwrap(), None);
        assert_eq!(depth(&all, &request, at, 9.0, None).unwrap(), None, "nothing is there");
    }
}
