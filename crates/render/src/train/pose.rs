//! Where the camera of each photo stands, which the steps may move too.
//! WGSL of the sums: `shaders/pose.wgsl`.
//!
//! A camera that is turned by `w` about its centre `c` and moved by `t` sees what it saw of
//! Gaussians that are turned by `-w` about `c` and moved by `-t`. So with `x` for the centre of a
//! Gaussian, `q = (q_w, q_v)` for its quaternion and `g` for what the loss says of each,
//! `dL/dt = -sum g_x` and `dL/dw = -sum ((x - c) x g_x + r)`, where
//! `r = (q_w g_v - g_w q_v + q_v x g_v) / 2`.
//!
//! That is exact for colours that are the same from all sides (degree 0) over one background
//! colour. How colours and a backdrop change with the direction is left out.

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use super::adam::Moments;
use crate::{
    backward::Gradients,
    scene::{CameraToWorld, Gaussians},
};

/// Gaussians of a task.
const CHUNK: usize = 1 << 13;

/// How far a camera moves in a step; 0 and 0: it stays.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PoseRates {
    /// Turns about each of its axes, radians.
    pub turn: f32,
    /// Moves along each of its axes, world units.
    pub shift: f32,
}

impl PoseRates {
    /// Both times `by`.
    #[must_use]
    pub fn scaled(&self, by: f32) -> Self {
        Self { turn: self.turn * by, shift: self.shift * by }
    }

    /// Whether cameras move.
    pub(crate) fn moves(&self) -> bool {
        self.turn != 0.0 || self.shift != 0.0
    }
}

/// Derivatives of a loss by how its camera moves.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PoseGradient {
    /// By turns about its centre around the axes of the world, 1 / radians.
    pub turn: DVec3,
    /// By moves along the axes of the world, 1 / world units.
    pub shift: DVec3,
}

impl PoseGradient {
    /// Of a camera at `center`, where the loss says so of `gaussians`.
    #[must_use]
    pub fn of<T: Copy + Into<f64> + Sync>(
        gaussians: &Gaussians,
        gradients: &Gradients<T>,
        center: DVec3,
    ) -> Self {
        let center = center - gaussians.origin();
        let (means, quats) = (gaussians.means(), gaussians.quats());
        let part = |(at, by): (usize, &[[T; 3]])| {
            let mut sum = Self::default();
            for (j, by_mean) in by.iter().enumerate() {
                let i = at * CHUNK + j;
                let by_mean = DVec3::from_array(by_mean.map(Into::into));
                let [by_w, x, y, z] = gradients.quats[i].map(Into::into);
                let by_v = DVec3::new(x, y, z);
                let [w, x, y, z] = quats[i].map(f64::from);
                let v = DVec3::new(x, y, z);
                let arm = DVec3::from_array(means[i].map(f64::from)) - center;
                sum.shift -= by_mean;
                sum.turn -= arm.cross(by_mean) + 0.5 * (w * by_v - by_w * v + v.cross(by_v));
            }
            sum
        };
        // In their order, so that the bits do not depend on the threads.
        let parts: Vec<Self> = gradients.means.par_chunks(CHUNK).enumerate().map(part).collect();
        parts.into_iter().fold(Self::default(), Self::plus)
    }

    /// The sum of both.
    pub(crate) fn plus(self, other: Self) -> Self {
        Self { turn: self.turn + other.turn, shift: self.shift + other.shift }
    }
}

/// A camera that is turned about its centre by the vector `turn` (axis times radians) and moved by
/// `shift`, both in its own axes.
#[must_use]
pub fn moved(pose: &CameraToWorld, turn: DVec3, shift: DVec3) -> CameraToWorld {
    let rotation = pose.rotation();
    let turned = rotation * DMat3::from_quat(DQuat::from_scaled_axis(turn));
    CameraToWorld::from_rotation(turned, pose.center() + rotation * shift)
}

/// A camera that is learnt.
#[derive(Clone, Debug)]
pub(crate) struct Pose {
    /// Where it stands now.
    pub(crate) now: CameraToWorld,
    /// Of turns, then of moves, in its own axes.
    moments: [Moments; 6],
    count: u16,
}

impl Pose {
    pub(crate) fn new(now: CameraToWorld) -> Self {
        Self { now, moments: [Moments::default(); 6], count: 0 }
    }

    /// Moves by what the loss says, with Adam.
    pub(crate) fn step(&mut self, by: &PoseGradient, rates: PoseRates) {
        self.count = self.count.saturating_add(1);
        let own = self.now.rotation().transpose();
        let by = [own * by.turn, own * by.shift].map(|by| by.as_vec3().to_array());
        let mut steps = [0.0; 6];
        for (step, (moments, by)) in
            steps.iter_mut().zip(self.moments.iter_mut().zip(by.as_flattened()))
        {
            *step = -f64::from(moments.step(*by, self.count));
        }
        let [turn, shift] = [&steps[..3], &steps[3..]].map(DVec3::from_slice);
        let (turn, shift) = (turn * f64::from(rates.turn), shift * f64::from(rates.shift));
        self.now = moved(&self.now, turn, shift);
    }
}
