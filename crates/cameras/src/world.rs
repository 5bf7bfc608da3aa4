//! From a grown solution to what callers get: a frame and scale of the world, cameras, points.

use glam::DMat4;
use nalgebra::{Matrix3, Vector3};
use segsplat_core::{
    error::Result,
    scene::{Camera, CameraToWorld, Intrinsics},
};

use crate::{
    given::PhotoKeypoints,
    pose::Pose,
    solution::{Placed, Placing, SeenPoint},
    solver::Candidate,
    survey::Survey,
};

/// A similarity of the world: `scale * turn * (X - origin)`.
struct Frame {
    origin: Vector3<f64>,
    turn: Matrix3<f64>,
    scale: f64,
}

impl Frame {
    /// The median of the points as origin, the cameras' mean up as -y, half of the points within
    /// 0.5.
    fn of(poses: &[Option<Pose>], points: &[Vector3<f64>]) -> Self {
        let median = |mut values: Vec<f64>| {
            values.sort_by(f64::total_cmp);
            values.get(values.len() / 2).copied().unwrap_or(0.0)
        };
        let origin = Vector3::from_fn(|k, _| median(points.iter().map(|p| p[k]).collect()));
        let radius = median(points.iter().map(|p| (p - origin).norm()).collect());
        let axis = |row: usize| -> Vector3<f64> {
            poses.iter().flatten().map(|p| p.r.row(row).transpose()).sum()
        };
        // Rows of a pose's rotation are its axes: right, down, ahead.
        let down = axis(1).try_normalize(1e-9).unwrap_or_else(Vector3::y);
        let ahead = axis(2);
        let ahead = (ahead - down * down.dot(&ahead)).try_normalize(1e-9).unwrap_or_else(|| {
            let side = if down.x.abs() < 0.6 { Vector3::x() } else { Vector3::z() };
            (side - down * down.dot(&side)).normalize()
        });
        let right = down.cross(&ahead);
        let turn = Matrix3::from_rows(&[right.transpose(), down.transpose(), ahead.transpose()]);
        let scale = if radius > 1e-12 { 0.5 / radius } else { 1.0 };
        Self { origin, turn, scale }
    }

    fn point(&self, p: &Vector3<f64>) -> Vector3<f64> {
        self.turn * (p - self.origin) * self.scale
    }

    fn camera_to_world(&self, pose: &Pose) -> Result<CameraToWorld> {
        let r = self.turn * pose.r.transpose();
        let c = self.point(&pose.center());
        let rows = [
            r[(0, 0)],
            r[(0, 1)],
            r[(0, 2)],
            c.x,
            r[(1, 0)],
            r[(1, 1)],
            r[(1, 2)],
            c.y,
            r[(2, 0)],
            r[(2, 1)],
            r[(2, 2)],
            c.z,
            0.0,
            0.0,
            0.0,
            1.0,
        ];
        debug_assert!(DMat4::from_cols_array(&rows).is_finite(), "a finite camera");
        CameraToWorld::from_row_major(&rows, "solved camera")
    }
}

/// Cameras of the placed photos and the points.
pub(crate) fn outcome(
    photos: &[PhotoKeypoints],
    survey: &Survey,
    best: &Candidate,
    why_not: impl Fn(usize) -> String,
) -> Result<(Vec<Placing>, Vec<SeenPoint>)> {
    let grown = &best.grown;
    let known: Vec<Vector3<f64>> = grown.points.iter().flatten().copied().collect();
    let frame = Frame::of(&grown.poses, &known);
    let mut fits = vec![(0_usize, 0.0); photos.len()];
    let mut points = Vec::with_capacity(known.len());
    for (point, near) in grown.seen(&best.tracks) {
        let mut own = Vec::new();
        let mut sum = 0.0;
        for sighting in near {
            let photo = sighting.0 as usize;
            let view = &survey.views[photo];
            let Some(pose) = &grown.poses[photo] else { continue };
            let Some(pixel) = grown.lenses[view.lens].project(&pose.seen(point)) else {
                continue;
            };
            let error2 = (pixel - view.pixels[sighting.1 as usize]).norm_squared();
            fits[photo].0 += 1;
            fits[photo].1 += error2;
            sum += error2;
            own.push(sighting);
        }
        let error_px = (sum / own.len().max(1) as f64).sqrt();
        points.push(SeenPoint { position: frame.point(point).into(), track: own, error_px });
    }
    let mut placings = Vec::with_capacity(photos.len());
    for (index, photo) in photos.iter().enumerate() {
        let Some(pose) = &grown.poses[index] else {
            placings.push(Placing::LeftOut(why_not(index)));
            continue;
        };
        let lens = grown.lenses[survey.views[index].lens];
        let [width, height] = photo.size;
        let intrinsics = Intrinsics {
            fx: lens.focal,
            fy: lens.focal,
            cx: f64::from(width) * 0.5,
            cy: f64::from(height) * 0.5,
            width,
            height,
        };
        let camera = Camera { intrinsics, camera_to_world: frame.camera_to_world(pose)? };
        let (inliers, sum) = fits[index];
        let error_px = (sum / inliers.max(1) as f64).sqrt();
        placings.push(Placing::Placed(Placed { camera, k1: lens.k1, inliers, error_px }));
    }
    Ok((placings, points))
}
