//! The ground of a scene, and lengths in it.
//!
//! The ground is the plane, nearly level, that most Gaussians lie on, of those with next to nothing
//! under them: of a room its floor, of a table that fills the photos the table.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::scene::Gaussians;

/// Opacity from which a Gaussian is a surface.
const OPACITY_MIN: f32 = 0.5;
/// Gaussians that decide.
const SAMPLES: usize = 16_384;
/// Of these the ones that each of the first planes is tried on.
const TRIED_ON: usize = 2_048;
/// Planes through three Gaussians each that are begun with.
const PLANES: u32 = 20_000;
/// Largest angle between up as the photos tell it and the ground's, degrees.
const TILT_MAX: f64 = 20.0;
/// How far from the plane its Gaussians are, as a share of the median depth.
const THICK: f64 = 0.01;
/// Most of the Gaussians that may be under the ground, as a share of all.
const UNDER_MAX: f64 = 0.05;
/// Fewest Gaussians that are a ground, as a share of all.
const SHARE_MIN: f64 = 0.05;
/// Rounds in which the plane is fitted to its Gaussians.
const ROUNDS: usize = 6;

/// A plane that things stand on.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Ground {
    /// Up, a unit vector.
    pub normal: [f64; 3],
    /// A point of it, in the middle of what was seen of it; world units.
    pub point: [f64; 3],
    /// Share of the scene's Gaussians that lie on it, 0 to 1.
    pub share: f64,
}

impl Ground {
    /// How far over it a point is, world units; under 0 below it.
    #[must_use]
    pub fn height(&self, point: DVec3) -> f64 {
        DVec3::from(self.normal).dot(point - DVec3::from(self.point))
    }
}

/// The ground of Gaussians whose median depth in their photos is `depth`; `up` is what the photos
/// say of it. `None` where too little is level.
#[must_use]
pub fn ground(gaussians: &Gaussians, up: DVec3, depth: f64) -> Option<Ground> {
    let seen: Vec<DVec3> = gaussians
        .means()
        .iter()
        .zip(gaussians.opacities())
        .filter(|(_, opacity)| **opacity >= OPACITY_MIN)
        .map(|(mean, _)| DVec3::from(mean.map(f64::from)))
        .collect();
    let points: Vec<DVec3> = some(&seen, SAMPLES);
    let thick = THICK * depth;
    if points.len() < 16 || thick.is_nan() || thick <= 0.0 {
        return None;
    }
    let tried_on = some(&points, TRIED_ON);
    let level = TILT_MAX.to_radians().cos();
    let try_one = |i: u32| {
        let [a, b, c] = [0, 1, 2].map(|k| points[number(3 * i + k) as usize % points.len()]);
        let normal = (b - a).cross(c - a).try_normalize()?;
        let normal = normal * normal.dot(up).signum();
        if normal.dot(up) < level {
            return None;
        }
        let plane = (normal, normal.dot(a));
        Some((share(&tried_on, plane, thick)?, i, plane))
    };
    let best = (0..PLANES).into_par_iter().filter_map(try_one);
    let best = best.max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)));
    let (_, _, mut plane) = best?;
    for _ in 0..ROUNDS {
        plane = fitted(&points, plane, thick)?;
    }
    let (normal, along) = plane;
    let share = share(&points, plane, thick).filter(|share| *share >= SHARE_MIN)?;
    let on: Vec<DVec3> =
        points.iter().filter(|p| (normal.dot(**p) - along).abs() <= thick).copied().collect();
    let middle = on.iter().sum::<DVec3>() / on.len().max(1) as f64;
    let point = middle + normal * (along - normal.dot(middle)) + gaussians.origin();
    (normal.dot(up) >= level).then_some(Ground {
        normal: normal.to_array(),
        point: point.to_array(),
        share,
    })
}

/// At most so many of these, evenly chosen.
fn some(all: &[DVec3], most: usize) -> Vec<DVec3> {
    all.iter().step_by(all.len().div_ceil(most).max(1)).copied().collect()
}

/// A number that looks drawn, and is the same at each call.
fn number(i: u32) -> u32 {
    let x = (i ^ 61) ^ (i >> 16);
    let x = x.wrapping_mul(9);
    let x = (x ^ (x >> 4)).wrapping_mul(0x27d4_eb2d);
    x ^ (x >> 15)
}

/// The share of points on a plane (normal, place along it); `None` where too many are under it.
fn share(points: &[DVec3], (normal, along): (DVec3, f64), thick: f64) -> Option<f64> {
    let (mut on, mut under) = (0_usize, 0_usize);
    for point in points {
        let height = normal.dot(*point) - along;
        on += usize::from(height.abs() <= thick);
        under += usize::from(height < -3.0 * thick);
    }
    let all = points.len() as f64;
    (under as f64 / all <= UNDER_MAX).then_some(on as f64 / all)
}

/// The plane with the least squared heights of the points near this one.
fn fitted(points: &[DVec3], (normal, along): (DVec3, f64), thick: f64) -> Option<(DVec3, f64)> {
    let near: Vec<DVec3> = points
        .iter()
        .filter(|point| (normal.dot(**point) - along).abs() <= thick)
        .copied()
        .collect();
    let middle = near.iter().sum::<DVec3>() / near.len().max(1) as f64;
    let (x, y) = normal.any_orthonormal_pair();
    let (mut square, mut side) = (DMat3::ZERO, DVec3::ZERO);
    for point in &near {
        let from = *point - middle;
        let row = DVec3::new(from.dot(x), from.dot(y), 1.0);
        square += DMat3::from_cols(row * row.x, row * row.y, row);
        side += row * from.dot(normal);
    }
    if near.len() < 8 || square.determinant() <= 0.0 {
        return None;
    }
    let slope = square.inverse() * side;
    let normal = (normal - x * slope.x - y * slope.y).try_normalize()?;
    Some((normal, normal.dot(middle)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{RawGaussians, SourcePixel};

    fn of(points: &[DVec3], origin: DVec3) -> Gaussians {
        let n = points.len();
        let raw = RawGaussians {
            origin,
            means: points.iter().map(|p| (*p - origin).as_vec3().to_array()).collect(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: vec![[0.01; 3]; n],
            opacities: vec![0.9; n],
            sh_degree: 0,
            sh: vec![[0.0; 3]; n],
            semantic_index: vec![0; n],
            source: vec![SourcePixel::default(); n],
        };
        Gaussians::sanitize(raw).unwrap().0
    }

    fn drawn(i: usize, k: u32) -> f64 {
        f64::from(number(4 * i as u32 + k)) / f64::from(u32::MAX)
    }

    /// A floor, a table 0.8 over it that holds more, a wall, and a few floaters under the floor.
    #[test]
    fn the_ground_is_the_lowest_plane_and_not_the_largest() {
        let tilt = glam::DQuat::from_rotation_x(0.12);
        let origin = DVec3::new(5.0, -2.0, 1.0);
        let place = |p: DVec3| origin + tilt * p;
        let points: Vec<DVec3> = (0..20_000)
            .map(|i| {
                let [a, b, c] = [0, 1, 2].map(|k| drawn(i, k));
                let noise = 0.01 * (c - 0.5);
                place(match i % 20 {
                    0..4 => DVec3::new(4.0 * a, noise, 4.0 * b),
                    4..12 => DVec3::new(1.0 + a, -0.8 + noise, 1.0 + b),
                    12..19 => DVec3::new(4.0 * a, -2.5 * b, 4.0 + noise),
                    _ if i % 40 == 19 => DVec3::new(4.0 * a, 1.5 * b, 4.0 * c),
                    _ => DVec3::new(4.0 * a, -2.5 * b, 4.0 * c),
                })
            })
            .collect();
        let found = ground(&of(&points, origin), DVec3::NEG_Y, 3.0).unwrap();
        let up = tilt * DVec3::NEG_Y;
        let off = DVec3::from(found.normal).angle_between(up).to_degrees();
        assert!(off < 0.3, "{off} degrees off");
        for (height, x) in [(0.0, 0.5), (0.8, 1.5), (2.5, 3.0)] {
            let got = found.height(place(DVec3::new(x, -height, 2.0)));
            assert!((got - height).abs() < 0.02, "{got} is not {height}");
        }
        assert!((0.15..0.3).contains(&found.share), "{}", found.share);
    }

    #[test]
    fn walls_and_clouds_have_no_ground() {
        let wall: Vec<DVec3> = (0..4_000)
            .map(|i| DVec3::new(4.0 * drawn(i, 0), 3.0 * drawn(i, 1), 0.01 * drawn(i, 2)))
            .collect();
        assert_eq!(ground(&of(&wall, DVec3::ZERO), DVec3::NEG_Y, 3.0), None);
        let cloud: Vec<DVec3> =
            (0..4_000).map(|i| 4.0 * DVec3::from([0, 1, 2].map(|k| drawn(i, k)))).collect();
        assert_eq!(ground(&of(&cloud, DVec3::ZERO), DVec3::NEG_Y, 3.0), None);
        assert_eq!(ground(&of(&[], DVec3::ZERO), DVec3::NEG_Y, 3.0), None);
        assert_eq!(ground(&of(&wall, DVec3::ZERO), DVec3::NEG_Y, 0.0), None);
    }
}
