//! Which photos make a scene where there are more than it takes: first those that see most from
//! different places, then the sharpest of those that see the same.
//!
//! Coverage is farthest-point sampling (Gonzalez, 1985) of poses. The distance of two poses is that
//! of their centres over the spread of all centres, and the angle between their axes in radians: on
//! an orbit both say the same. Then each photo gives its place to the sharpest of those near it.
//! Sharpness is not computed from pixels, which would have to be decoded for all: a picture of the
//! same view in the same format takes the more bytes the more fine detail it has.

use crate::scene::CameraToWorld;

use super::lens::Lens;

/// A photo that could be taken.
pub(crate) struct Candidate<'a> {
    pub(crate) pose: &'a CameraToWorld,
    /// Size of its file.
    pub(crate) bytes: u64,
    /// Sizes of files of different kinds are not compared.
    pub(crate) kind: Kind,
}

/// Pictures that take about as many bytes for the same view.
#[derive(Clone, Copy, PartialEq)]
pub(crate) struct Kind([Option<f64>; 2]);

impl From<&Lens> for Kind {
    fn from(lens: &Lens) -> Self {
        Self([lens.width, lens.height])
    }
}

/// The share of the least distance between two chosen photos up to which another may stand in.
const NEAR: f64 = 0.5;

/// The places of the `count` best, ascending. At most `count * N` distances are computed.
pub(crate) fn best(all: &[Candidate<'_>], count: usize) -> Vec<usize> {
    let n = all.len();
    if n <= count {
        return (0..n).collect();
    }
    let mean = all.iter().map(|c| c.pose.center()).sum::<glam::DVec3>() / n as f64;
    let spread = all.iter().map(|c| c.pose.center().distance_squared(mean)).sum::<f64>() / n as f64;
    let spread = spread.sqrt().max(f64::MIN_POSITIVE);
    let apart = |a: usize, b: usize| {
        let (a, b) = (all[a].pose, all[b].pose);
        let angle = a.axis().dot(b.axis()).clamp(-1.0, 1.0).acos();
        a.center().distance(b.center()) / spread + angle
    };
    // The nearest chosen photo of each, and how far it is.
    let mut near = vec![(0, f64::INFINITY); n];
    let (mut chosen, mut next, mut least) = (Vec::with_capacity(count), 0, f64::INFINITY);
    while chosen.len() < count {
        if !chosen.is_empty() {
            least = near[next].1;
        }
        for (i, near) in near.iter_mut().enumerate() {
            let away = apart(i, next);
            if away < near.1 {
                *near = (chosen.len(), away);
            }
        }
        chosen.push(next);
        // Of equal ones the first.
        next = (0..n).rev().max_by(|a, b| near[*a].1.total_cmp(&near[*b].1)).unwrap_or_default();
    }
    let mut sharpest = chosen.clone();
    for (i, &(of, away)) in near.iter().enumerate() {
        let (best, seed) = (&all[sharpest[of]], &all[chosen[of]]);
        if away <= NEAR * least && all[i].kind == seed.kind && all[i].bytes > best.bytes {
            sharpest[of] = i;
        }
    }
    sharpest.sort_unstable();
    sharpest
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    /// Cameras on a circle around the origin, each three times within a thousandth of the circle.
    fn orbit(places: usize) -> Vec<CameraToWorld> {
        let pose = |i: usize| {
            let turn = (i / 3) as f64 / places as f64 + (i % 3) as f64 * 1e-3 / places as f64;
            let (sin, cos) = (turn * std::f64::consts::TAU).sin_cos();
            let eye = DVec3::new(2.0 * cos, 0.0, 2.0 * sin);
            CameraToWorld::look_at(eye, DVec3::ZERO, DVec3::Y, "test").unwrap()
        };
        (0..3 * places).map(pose).collect()
    }

    fn chosen(poses: &[CameraToWorld], count: usize, bytes: impl Fn(usize) -> u64) -> Vec<usize> {
        let kind = Kind([None; 2]);
        let candidate = |(i, pose)| Candidate { pose, bytes: bytes(i), kind };
        best(&poses.iter().enumerate().map(candidate).collect::<Vec<_>>(), count)
    }

    #[test]
    fn every_place_is_seen_and_the_sharpest_of_each_is_taken() {
        let poses = orbit(20);
        // The last of each three is the largest file.
        let all = chosen(&poses, 20, |i| 1_000 + i as u64 % 3);
        assert_eq!(all, (0..20).map(|i| 3 * i + 2).collect::<Vec<_>>());
        // A file however large does not take the place of one that sees something else.
        let all = chosen(&poses, 20, |i| if i < 6 { 1 << 40 } else { 9 });
        let places: Vec<usize> = all.iter().map(|i| i / 3).collect();
        assert_eq!(places, (0..20).collect::<Vec<_>>());
    }

    #[test]
    fn as_many_as_there_are_or_fewer() {
        let poses = orbit(3);
        assert_eq!(chosen(&poses, 9, |_| 1), (0..9).collect::<Vec<_>>());
        for count in 2..9 {
            let mut all = chosen(&poses, count, |_| 1);
            all.dedup();
            assert_eq!(all.len(), count);
        }
        // All poses alike.
        let alike = vec![poses[0]; 5];
        assert_eq!(chosen(&alike, 3, |_| 1).len(), 3);
    }
}
