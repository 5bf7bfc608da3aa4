//! The ground of a scene, and lengths in it.
//!
//! The ground is the plane, nearly level, that most Gaussians lie on, of those with little under
//! them: of a room its floor, of a table that fills the photos the table. The more a plane leans,
//! or has under it, the less it counts: a plane through a table and the floor beyond it holds more
//! than the floor, and is none.

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::scene::{Gaussians, biweight, least_squares};

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
/// Angle at which a plane counts 1/e of a level one, degrees.
const TILT: f64 = 8.0;
/// How far from the plane its Gaussians are, as a share of the median depth.
const THICK: f64 = 0.01;
/// Share of all Gaussians that may be under the ground.
const UNDER: f64 = 0.05;
/// Share with which a plane counts nothing.
const UNDER_MAX: f64 = 0.3;
/// Fewest Gaussians that are a ground, as a share of all.
const SHARE_MIN: f64 = 0.04;
/// Fewest Gaussians that a plane is fitted to.
const GAUSSIANS_MIN: usize = 8;
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

    /// How many times `way` it is from `eye` to the ground; `None` where that never meets it.
    #[must_use]
    pub fn along(&self, eye: DVec3, way: DVec3) -> Option<f64> {
        let times = -self.height(eye) / DVec3::from(self.normal).dot(way);
        (times.is_finite() && times > 0.0).then_some(times)
    }
}

/// The ground of Gaussians whose median depth in their photos is `depth`; `up` is what the photos
/// say of it. `None` where too little is level.
#[must_use]
pub fn ground(gaussians: &Gaussians, up: DVec3, depth: f64) -> Option<Ground> {
    let opacities = gaussians.opacities().iter().map(|opacity| f64::from(*opacity));
    let means = gaussians.means().iter().map(|mean| DVec3::from(mean.map(f64::from)));
    let all: Vec<(DVec3, f64)> = means.zip(opacities).collect();
    let seen = all.iter().filter(|(_, opacity)| *opacity >= f64::from(OPACITY_MIN));
    let seen: Vec<DVec3> = seen.map(|(mean, _)| *mean).collect();
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
        let [on, under] = shares(&tried_on, plane, thick);
        let tilt = normal.angle_between(up).to_degrees() / TILT;
        let alone = ((UNDER_MAX - under) / (UNDER_MAX - UNDER)).clamp(0.0, 1.0);
        Some((on * alone * (-tilt * tilt).exp(), i, plane))
    };
    let best = (0..PLANES).into_par_iter().filter_map(try_one).filter(|tried| tried.0 > 0.0);
    let best = best.max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)));
    let (_, _, mut plane) = best?;
    for _ in 0..ROUNDS {
        plane = fitted(&all, plane, thick)?;
    }
    let (normal, along) = plane;
    let [share, _] = shares(&points, plane, thick);
    let on: Vec<DVec3> =
        points.iter().filter(|p| (normal.dot(**p) - along).abs() <= thick).copied().collect();
    let middle = on.iter().sum::<DVec3>() / on.len().max(1) as f64;
    let point = middle + normal * (along - normal.dot(middle)) + gaussians.origin();
    (share >= SHARE_MIN && normal.dot(up) >= level).then_some(Ground {
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

/// The shares of points on a plane (normal, place along it), and under it.
fn shares(points: &[DVec3], (normal, along): (DVec3, f64), thick: f64) -> [f64; 2] {
    let (mut on, mut under) = (0_usize, 0_usize);
    for point in points {
        let height = normal.dot(*point) - along;
        on += usize::from(height.abs() <= thick);
        under += usize::from(height < -3.0 * thick);
    }
    [on, under].map(|count| count as f64 / points.len() as f64)
}

/// The plane with the least squared heights of the points near this one, by their weights.
fn fitted(
    points: &[(DVec3, f64)],
    (normal, along): (DVec3, f64),
    thick: f64,
) -> Option<(DVec3, f64)> {
    let weigh = |(point, weight): &(DVec3, f64)| {
        let weight = weight * biweight(normal.dot(*point) - along, thick);
        (weight > 0.0).then_some((*point, weight))
    };
    let near: Vec<(DVec3, f64)> = points.iter().filter_map(weigh).collect();
    if near.len() < GAUSSIANS_MIN {
        return None;
    }
    let total: f64 = near.iter().map(|(_, weight)| weight).sum();
    let middle = near.iter().map(|(point, weight)| *point * *weight).sum::<DVec3>() / total;
    let (x, y) = normal.any_orthonormal_pair();
    let slope = least_squares(near.iter().map(|(point, weight)| {
        let from = *point - middle;
        (DVec3::new(from.dot(x), from.dot(y), 1.0), from.dot(normal), *weight)
    }))?;
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

    /// A table that fills the photos, and of the floor little beyond it, of another depth than it
    /// has: a plane through both holds most, and has nothing under it.
    #[test]
    fn a_plane_that_leans_on_a_table_is_no_ground() {
        let points: Vec<DVec3> = (0..20_000)
            .map(|i| {
                let [a, b, c] = [0, 1, 2].map(|k| drawn(i, k));
                let noise = 0.01 * (c - 0.5);
                match i % 20 {
                    0..2 => DVec3::new(2.0 * a - 1.0, noise, 2.5 + b),
                    2..9 => DVec3::new(2.0 * a - 1.0, -0.75 + noise, b),
                    9..13 => DVec3::new(2.0 * a - 1.0, -0.75 + 0.3 * (b + 0.4) + noise, b + 0.9),
                    _ => DVec3::new(2.0 * a - 1.0, -0.8 - b, 3.5 * c),
                }
            })
            .collect();
        let found = ground(&of(&points, DVec3::ZERO), DVec3::NEG_Y, 3.0).unwrap();
        let off = DVec3::from(found.normal).angle_between(DVec3::NEG_Y).to_degrees();
        assert!(off < 2.0, "{off} degrees off, {found:?}");
    }

    #[test]
    fn a_ray_meets_the_ground_in_front_of_it_alone() {
        let ground = Ground { normal: [0.0, -1.0, 0.0], point: [3.0, 1.0, 0.0], share: 0.2 };
        let eye = DVec3::new(0.0, -1.0, 0.0);
        assert_eq!(ground.along(eye, DVec3::new(0.5, 0.25, 1.0)), Some(8.0));
        assert_eq!(ground.along(eye, DVec3::new(0.5, -0.25, 1.0)), None, "up");
        assert_eq!(ground.along(eye, DVec3::Z), None, "level");
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
        assert_eq!(ground(&of(&cloud[..40], DVec3::ZERO), DVec3::NEG_Y, 3.0), None, "few");
        assert_eq!(ground(&of(&[], DVec3::ZERO), DVec3::NEG_Y, 3.0), None);
        assert_eq!(ground(&of(&wall, DVec3::ZERO), DVec3::NEG_Y, 0.0), None);
    }
}
