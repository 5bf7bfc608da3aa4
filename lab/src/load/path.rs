//! Where views are taken from: a smooth way back and forth through the scene's own cameras, with
//! steps to the side. No two numbers give the same view.

use std::f64::consts::TAU;

use glam::DVec3;

use crate::{
    error::{Error, Result},
    scene::{Camera, CameraToWorld, Intrinsics},
};

/// Ways there and back for each view; irrational, so that none comes again.
const STEP: f64 = 0.001_618_033_988_749_895;
/// Turns of the steps to the side for each way there and back.
const TURNS: [f64; 3] = [3.302_775_637_731_995, 5.192_582_403_567_252, 2.414_213_562_373_095];
/// Length of the steps to the side, in median depths of the scene.
const ASIDE: f64 = 0.03;

/// The way.
#[derive(Clone, Debug)]
pub(super) struct Path {
    cameras: Vec<Camera>,
    aside: f64,
    lens: Intrinsics,
}

impl Path {
    /// Through these cameras; views of `width` x `height` with the first camera's field of view.
    pub(super) fn new(
        cameras: Vec<Camera>,
        median_depth: f64,
        [width, height]: [u32; 2],
    ) -> Result<Self> {
        let Some(first) = cameras.first() else {
            return Err(Error::invalid("the scene has no cameras"));
        };
        let own = first.intrinsics;
        let (w, h) = (f64::from(width), f64::from(height));
        let scale = (w / f64::from(own.width)).max(h / f64::from(own.height));
        let lens = Intrinsics {
            fx: own.fx * scale,
            fy: own.fy * scale,
            cx: w / 2.0,
            cy: h / 2.0,
            width,
            height,
        };
        Ok(Self { aside: median_depth.max(0.0) * ASIDE, cameras, lens })
    }

    /// The camera of the `n`-th view.
    pub(super) fn camera(&self, n: u64) -> Result<Camera> {
        let way = n as f64 * STEP;
        let spans = self.cameras.len() - 1;
        let along = (0.5 - 0.5 * (TAU * way).cos()) * spans as f64;
        let from = (along as usize).min(spans.saturating_sub(1));
        let pose = |i: usize| self.cameras[i.min(spans)].camera_to_world;
        let pose = CameraToWorld::between(&pose(from), &pose(from + 1), along - from as f64);
        let aside = DVec3::from_array(TURNS.map(|turns| (TAU * turns * way).sin())) * self.aside;
        let center = pose.center() + pose.rotation() * aside;
        let mut matrix = pose.to_row_major();
        for (i, value) in center.to_array().into_iter().enumerate() {
            matrix[4 * i + 3] = value;
        }
        let camera_to_world = CameraToWorld::from_row_major(&matrix, "the view")?;
        Ok(Camera { intrinsics: self.lens, camera_to_world })
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn the_way_is_smooth_and_no_view_comes_twice() {
        let lens =
            Intrinsics { fx: 200.0, fy: 200.0, cx: 128.0, cy: 128.0, width: 256, height: 256 };
        let camera = |x: f64| {
            let eye = DVec3::new(x, 0.0, 0.0);
            let pose = CameraToWorld::look_at(eye, DVec3::Z * 4.0, DVec3::NEG_Y, "test").unwrap();
            Camera { intrinsics: lens, camera_to_world: pose }
        };
        let path = Path::new(vec![camera(-0.5), camera(0.1), camera(0.5)], 4.0, [64, 32]).unwrap();
        let (mut seen, mut last) = (HashSet::new(), None::<DVec3>);
        for n in 0..20_000 {
            let camera = path.camera(n).unwrap();
            let pose = camera.camera_to_world;
            assert!(seen.insert(pose.to_row_major().map(f64::to_bits)), "view {n} came before");
            let step = last.map_or(0.0, |last| last.distance(pose.center()));
            assert!(step < 0.02, "{step} at {n}");
            assert!(pose.center().length() < 1.0);
            last = Some(pose.center());
        }
        assert_eq!(path.camera(7).unwrap(), path.camera(7).unwrap());
        let lens = path.camera(0).unwrap().intrinsics;
        assert_eq!((lens.fx, lens.cx, lens.cy), (50.0, 32.0, 16.0), "it covers the picture");
    }
}
