//! Solved cameras beside the true ones.
//!
//! Rotations are compared after the one turn of the world that makes the median error least,
//! centres after scale and shift too.

use glam::{DMat3, DQuat, DVec3};
use serde_json::{Value, json};

use crate::{rows::median, scene::Camera};

/// Turns of the world nearer to the best one than this are averaged, degrees.
const NEAR_DEG: f64 = 1.0;

/// How far solved cameras are from the true ones. Not a number where fewer than two are placed.
#[derive(Clone, Copy, Debug)]
pub(super) struct Compared {
    pub(super) placed: usize,
    /// Errors of rotations, degrees.
    pub(super) rotation_deg: Off,
    /// Errors of centres, shares of the longest way between two true ones.
    pub(super) position: Off,
    /// Median of the solved focal lengths over the true ones.
    pub(super) focal: f64,
}

/// The median and the largest of some errors.
#[derive(Clone, Copy, Debug)]
pub(super) struct Off {
    pub(super) median: f64,
    pub(super) worst: f64,
}

impl Off {
    fn of(errors: Vec<f64>) -> Self {
        let worst = errors.iter().copied().fold(0.0, f64::max);
        Self { median: median(errors), worst }
    }

    fn unknown() -> Self {
        Self { median: f64::NAN, worst: f64::NAN }
    }
}

impl Compared {
    /// Of pairs of a true camera and a solved one.
    pub(super) fn new(pairs: &[(Camera, Camera)]) -> Self {
        let placed = pairs.len();
        // Share of the width: photos as sent and undistorted ones may differ in size.
        let wide = |camera: &Camera| camera.intrinsics.fx / f64::from(camera.intrinsics.width);
        let focal = pairs.iter().map(|(truth, solved)| wide(solved) / wide(truth)).collect();
        let focal = if pairs.is_empty() { f64::NAN } else { median(focal) };
        if placed < 2 {
            let (rotation_deg, position) = (Off::unknown(), Off::unknown());
            return Self { placed, rotation_deg, position, focal };
        }
        let turns = pairs.iter().map(|(truth, solved)| {
            truth.camera_to_world.rotation() * solved.camera_to_world.rotation().transpose()
        });
        let turns: Vec<DMat3> = turns.collect();
        let world = world(&turns);
        let rotation_deg = Off::of(turns.iter().map(|turn| angle_deg(turn, &world)).collect());
        let centers = pairs.iter().map(|(truth, solved)| {
            [truth.camera_to_world.center(), world * solved.camera_to_world.center()]
        });
        let position = Off::of(moved(&centers.collect::<Vec<_>>()));
        Self { placed, rotation_deg, position, focal }
    }

    /// The fields of a row.
    pub(super) fn row(&self) -> Value {
        json!({
            "placed": self.placed,
            "rotation_deg": number(self.rotation_deg.median),
            "rotation_worst_deg": number(self.rotation_deg.worst),
            "position": number(self.position.median),
            "position_worst": number(self.position.worst),
            "focal": number(self.focal),
        })
    }
}

/// A number of a row.
pub(super) fn number(value: f64) -> Value {
    if value.is_finite() { json!(value) } else { Value::Null }
}

/// The turn of the world of least median error, and the mean with those near to it.
fn world(turns: &[DMat3]) -> DMat3 {
    let error = |of: &DMat3| median(turns.iter().map(|turn| angle_deg(turn, of)).collect());
    let best = turns.iter().min_by(|a, b| error(a).total_cmp(&error(b)));
    let best = best.copied().unwrap_or(DMat3::IDENTITY);
    let near = turns.iter().filter(|turn| angle_deg(turn, &best) <= NEAR_DEG);
    // The small turns from the best one: their quaternions have the same sign.
    let sum = near.map(|turn| DQuat::from_mat3(&(*turn * best.transpose())));
    let mean = sum.fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |sum, turn| {
        if turn.w < 0.0 { sum - turn } else { sum + turn }
    });
    DMat3::from_quat(mean.normalize()) * best
}

/// How far each second centre is from the first of its pair after the best scale and shift.
fn moved(centers: &[[DVec3; 2]]) -> Vec<f64> {
    let mean = |side: usize| centers.iter().map(|pair| pair[side]).sum::<DVec3>();
    let middles = [0, 1].map(|side| mean(side) / centers.len() as f64);
    let from = |pair: &[DVec3; 2]| [pair[0] - middles[0], pair[1] - middles[1]];
    let sums = centers.iter().map(from).map(|[a, b]| (a.dot(b), b.length_squared()));
    let (both, own) = sums.fold((0.0, 0.0), |sum, of| (sum.0 + of.0, sum.1 + of.1));
    let scale = both / own.max(f64::MIN_POSITIVE);
    let ways = centers.iter().flat_map(|a| centers.iter().map(|b| a[0].distance(b[0])));
    let longest = ways.fold(f64::MIN_POSITIVE, f64::max);
    centers.iter().map(from).map(|[a, b]| (scale * b - a).length() / longest).collect()
}

fn angle_deg(a: &DMat3, b: &DMat3) -> f64 {
    let r = *a * b.transpose();
    let axis =
        DVec3::new(r.y_axis.z - r.z_axis.y, r.z_axis.x - r.x_axis.z, r.x_axis.y - r.y_axis.x);
    let trace = r.x_axis.x + r.y_axis.y + r.z_axis.z;
    axis.length().atan2(trace - 1.0).to_degrees()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{CameraToWorld, Intrinsics};

    fn camera(turn: DQuat, center: DVec3, fx: f64) -> Camera {
        let intrinsics = Intrinsics { fx, fy: fx, cx: 32., cy: 24., width: 64, height: 48 };
        let rotation = DMat3::from_quat(turn);
        Camera { intrinsics, camera_to_world: CameraToWorld::from_rotation(rotation, center) }
    }

    /// Cameras on a bent line, and the same ones in another world, twice as large.
    fn pairs() -> Vec<(Camera, Camera)> {
        let world = DQuat::from_rotation_y(2.1) * DQuat::from_rotation_x(-0.7);
        let pair = |i: i32| {
            let x = f64::from(i);
            let (turn, center) = (DQuat::from_rotation_y(0.2 * x), DVec3::new(x, 0.1 * x * x, 3.0));
            let (there, place) = (world * turn, world * center * 2.0 + DVec3::X);
            (camera(turn, center, 60.0), camera(there, place, 63.0))
        };
        (0..6).map(pair).collect()
    }

    #[test]
    fn another_world_is_no_error() {
        let Compared { placed, rotation_deg, position, focal } = Compared::new(&pairs());
        assert_eq!(placed, 6);
        assert!(
            rotation_deg.worst < 1e-9 && position.worst < 1e-9,
            "{rotation_deg:?} {position:?}"
        );
        assert!((focal - 1.05).abs() < 1e-9, "{focal}");
    }

    #[test]
    fn one_wrong_camera_is_the_worst_and_not_the_median() {
        let mut pairs = pairs();
        let pose = &mut pairs[4].1.camera_to_world;
        let turn = DMat3::from_quat(DQuat::from_axis_angle(DVec3::Y, 4_f64.to_radians()));
        *pose = CameraToWorld::from_rotation(turn * pose.rotation(), pose.center());
        let off = Compared::new(&pairs);
        assert!((off.rotation_deg.worst - 4.0).abs() < 1e-6, "{off:?}");
        assert!(off.rotation_deg.median < 1e-6 && off.position.worst < 1e-9, "{off:?}");
        // The way from the first to the last is 5 by 2.5.
        let pose = &mut pairs[4].1.camera_to_world;
        *pose = CameraToWorld::from_rotation(pose.rotation(), pose.center() + DVec3::Y * 0.2);
        let off = Compared::new(&pairs);
        let share = 0.1 / 5_f64.hypot(2.5);
        assert!(off.position.worst > 0.6 * share && off.position.worst < 1.1 * share, "{off:?}");
        assert!(off.position.median < 0.3 * share, "{off:?}");
    }
}
