//! Generated photos: points of a scene seen by known cameras, matched with a share of wrong pairs.

use glam::{DMat3, DQuat, DVec2, DVec3};
use segsplat_cameras::{PairMatches, PhotoKeypoints, Placing, Solution};
use segsplat_core::scene::{Camera, CameraToWorld, Intrinsics};

/// Random numbers (`xorshift`), uniform and normal.
pub(crate) struct Draw(pub(crate) u64);

impl Draw {
    fn next(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    pub(crate) fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.next()
    }

    fn below(&mut self, bound: usize) -> usize {
        ((self.next() * bound as f64) as usize).min(bound - 1)
    }

    fn normal(&mut self) -> f64 {
        (-2.0 * self.next().max(1e-300).ln()).sqrt() * (std::f64::consts::TAU * self.next()).cos()
    }

    pub(crate) fn point(&mut self, half: f64) -> DVec3 {
        DVec3::from_array([0; 3].map(|_| self.between(-half, half)))
    }
}

/// A camera: rotation from the world, centre.
#[derive(Clone, Copy)]
pub(crate) struct Truth {
    pub(crate) turn: DMat3,
    pub(crate) center: DVec3,
}

impl Truth {
    pub(crate) fn looking_at(center: DVec3, target: DVec3) -> Self {
        let ahead = (target - center).normalize();
        let right = ahead.cross(DVec3::NEG_Y).normalize();
        let down = ahead.cross(right);
        Self { turn: DMat3::from_cols(right, down, ahead).transpose(), center }
    }
}

/// What is generated.
pub(crate) struct Plan {
    pub(crate) points: Vec<DVec3>,
    pub(crate) cameras: Vec<Truth>,
    pub(crate) focal: f64,
    pub(crate) k1: f64,
    /// Spread of keypoints, pixels.
    pub(crate) noise: f64,
    /// Share of wrong matches.
    pub(crate) wrong: f64,
    pub(crate) seed: u64,
}

pub(crate) const SIZE: [u32; 2] = [640, 480];

/// Cameras on an arc of `degrees` about the origin, at `distance`, a little above it.
pub(crate) fn arc(count: usize, degrees: f64, distance: f64) -> Vec<Truth> {
    let at = |i: usize| {
        let angle = (degrees * i as f64 / (count - 1) as f64).to_radians();
        let height = -0.4 - 0.15 * (i % 3) as f64;
        DVec3::new(angle.sin() * distance, height * distance * 0.5, -angle.cos() * distance)
    };
    (0..count).map(|i| Truth::looking_at(at(i), DVec3::ZERO)).collect()
}

/// Points on the walls, the floor and the ceiling of a room.
pub(crate) fn room(count: usize, half: f64, seed: u64) -> Vec<DVec3> {
    let mut draw = Draw(seed);
    let wall = |_| {
        let mut p = draw.point(half);
        let axis = draw.below(3);
        p[axis] = if draw.below(2) == 0 { half } else { -half };
        p
    };
    (0..count).map(wall).collect()
}

pub(crate) fn cloud(count: usize, half: f64, seed: u64) -> Vec<DVec3> {
    let mut draw = Draw(seed);
    (0..count).map(|_| draw.point(half)).collect()
}

/// The cameras of a plan, each turned by `degrees` and moved by `way` in a direction of its own.
pub(crate) fn cameras(plan: &Plan, degrees: f64, way: f64) -> Vec<Camera> {
    let mut draw = Draw(11);
    let [width, height] = SIZE;
    let (fx, fy) = (plan.focal, plan.focal);
    let [cx, cy] = [width, height].map(|side| f64::from(side) * 0.5);
    let intrinsics = Intrinsics { fx, fy, cx, cy, width, height };
    let wrong = |truth: &Truth| {
        let [turn, shift] = [draw.point(1.0), draw.point(1.0)].map(DVec3::normalize);
        let turn = DMat3::from_quat(DQuat::from_scaled_axis(turn * degrees.to_radians()));
        let rotation = truth.turn.transpose() * turn;
        let camera_to_world = CameraToWorld::from_rotation(rotation, truth.center + shift * way);
        Camera { intrinsics, camera_to_world }
    };
    plan.cameras.iter().map(wrong).collect()
}

/// Keypoints of the points that each camera sees, and the matches of all pairs.
pub(crate) fn photos(plan: &Plan) -> (Vec<PhotoKeypoints>, Vec<PairMatches>) {
    let mut draw = Draw(plan.seed);
    let mut photos = Vec::new();
    let mut ids: Vec<Vec<Option<u32>>> = Vec::new();
    let middle = DVec2::new(f64::from(SIZE[0]), f64::from(SIZE[1])) * 0.5;
    for camera in &plan.cameras {
        let mut keypoints = Vec::new();
        let mut seen = vec![None; plan.points.len()];
        for (id, point) in plan.points.iter().enumerate() {
            let p = camera.turn * (*point - camera.center);
            if p.z < 0.05 {
                continue;
            }
            let d = p.truncate() / p.z;
            let noise = DVec2::new(draw.normal(), draw.normal()) * plan.noise;
            let pixel = d * plan.focal * (1.0 + plan.k1 * d.length_squared()) + middle + noise;
            if pixel.min_element() > 0.0 && pixel.x < middle.x * 2.0 && pixel.y < middle.y * 2.0 {
                seen[id] = Some(keypoints.len() as u32);
                keypoints.push([pixel.x as f32, pixel.y as f32]);
            }
        }
        photos.push(PhotoKeypoints { size: SIZE, keypoints, ..PhotoKeypoints::default() });
        ids.push(seen);
    }
    let mut pairs = Vec::new();
    for a in 0..photos.len() {
        for b in a + 1..photos.len() {
            let both = ids[a].iter().zip(&ids[b]).filter_map(|(i, j)| Some([(*i)?, (*j)?]));
            let mut pair: Vec<[u32; 2]> = both.collect();
            // Wrong ones: second keypoints change places.
            let wrong: Vec<usize> = (0..pair.len()).filter(|_| draw.next() < plan.wrong).collect();
            for k in 1..wrong.len() {
                let other = wrong[draw.below(k)];
                let kept = pair[wrong[k]][1];
                pair[wrong[k]][1] = pair[other][1];
                pair[other][1] = kept;
            }
            pairs.push(PairMatches { photos: [a, b], pairs: pair, scores: Vec::new() });
        }
    }
    (photos, pairs)
}

fn angle(r: DMat3) -> f64 {
    let sine =
        DVec3::new(r.y_axis.z - r.z_axis.y, r.z_axis.x - r.x_axis.z, r.x_axis.y - r.y_axis.x);
    let trace = r.x_axis.x + r.y_axis.y + r.z_axis.z;
    sine.length().atan2(trace - 1.0).to_degrees()
}

/// How far a solution is from the truth: photos placed, largest relative rotation error in degrees,
/// largest error of a centre as a share of the cameras' extent, focal ratio.
pub(crate) struct Off {
    pub(crate) placed: usize,
    pub(crate) degrees: f64,
    pub(crate) center: f64,
    pub(crate) focal: f64,
}

pub(crate) fn off(solution: &Solution, plan: &Plan) -> Off {
    let placed: Vec<_> = solution
        .photos
        .iter()
        .zip(&plan.cameras)
        .filter_map(|(placing, truth)| match placing {
            Placing::Placed(placed) => Some((placed.camera, *truth)),
            Placing::LeftOut(_) => None,
        })
        .collect();
    let mut off = Off { placed: placed.len(), degrees: 0.0, center: 0.0, focal: f64::NAN };
    let Some((first, first_truth)) = placed.first() else { return off };
    off.focal = first.intrinsics.fx / plan.focal;
    // Rotation from the solution's world to the true one by the first camera; then the scale.
    let turn = first_truth.turn.transpose() * first.camera_to_world.rotation().transpose();
    let moved: Vec<(DVec3, DVec3)> = placed
        .iter()
        .map(|(camera, truth)| {
            let pose = &camera.camera_to_world;
            let from_first = turn * (pose.center() - first.camera_to_world.center());
            (from_first, truth.center - first_truth.center)
        })
        .collect();
    let (across, own) =
        moved.iter().fold((0.0, 0.0), |(a, b), (m, t)| (a + m.dot(*t), b + m.dot(*m)));
    let scale = if own > 0.0 { across / own } else { 1.0 };
    let extent = moved.iter().map(|(_, t)| t.length()).fold(1e-9, f64::max);
    for (m, t) in &moved {
        off.center = off.center.max((*m * scale - *t).length() / extent);
    }
    for (i, (a, ta)) in placed.iter().enumerate() {
        for (b, tb) in &placed[i + 1..] {
            let solved = a.camera_to_world.rotation().transpose() * b.camera_to_world.rotation();
            let truth = ta.turn * tb.turn.transpose();
            off.degrees = off.degrees.max(angle(solved * truth.transpose()));
        }
    }
    off
}
