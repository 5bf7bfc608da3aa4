//! Which photos are put in and which one is held out.

use crate::scene::{Camera, PosedPhoto};

/// Baselines taken, when the median distance to the nearest neighbour is [`MEDIAN_NEAREST`].
const BASELINE: [f64; 2] = [0.25, 1.3];
/// The median nearest-neighbour distance that [`BASELINE`] was chosen for.
const MEDIAN_NEAREST: f64 = 0.30;
/// Largest angle between the viewing axes of the inputs, degrees.
const INPUT_ANGLE: f64 = 22.0;
/// Largest angle between the viewing axes of first input and target, degrees.
const TARGET_ANGLE: f64 = 20.0;
/// How far from the middle of the inputs the target may stand, in baselines.
const MIDDLE: f64 = 0.45;

/// Two inputs and the target between them, by index.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Triple {
    /// The inputs.
    pub(crate) pair: [usize; 2],
    /// The photo to be predicted.
    pub(crate) target: usize,
    /// Distance between the inputs, world units.
    pub(crate) baseline: f64,
}

/// All triples of a capture, in the order of the inputs.
pub(crate) fn triples(cameras: &[Camera]) -> Vec<Triple> {
    let Some(nearest) = median_nearest(cameras) else { return Vec::new() };
    let scale = nearest / MEDIAN_NEAREST;
    let center = |i: usize| cameras[i].camera_to_world.center();
    let angle = |i: usize, j: usize| {
        let cosine = cameras[i].camera_to_world.axis().dot(cameras[j].camera_to_world.axis());
        cosine.clamp(-1.0, 1.0).acos().to_degrees()
    };
    let mut found = Vec::new();
    for i in 0..cameras.len() {
        for j in i + 1..cameras.len() {
            let baseline = center(i).distance(center(j));
            let in_range = (BASELINE[0] * scale..=BASELINE[1] * scale).contains(&baseline);
            if !in_range || angle(i, j) >= INPUT_ANGLE {
                continue;
            }
            let middle = (center(i) + center(j)) / 2.0;
            let away = |k: &usize| center(*k).distance(middle);
            let target = (0..cameras.len())
                .filter(|&k| k != i && k != j)
                .min_by(|a, b| away(a).total_cmp(&away(b)));
            if let Some(target) = target
                && away(&target) < MIDDLE * baseline
                && angle(i, target) < TARGET_ANGLE
            {
                found.push(Triple { pair: [i, j], target, baseline });
            }
        }
    }
    found
}

/// Median over cameras of the distance to the nearest other, as numpy takes it (the mean of the
/// two in the middle of an even count); `None` for fewer than two cameras.
fn median_nearest(cameras: &[Camera]) -> Option<f64> {
    if cameras.len() < 2 {
        return None;
    }
    let center = |camera: &Camera| camera.camera_to_world.center();
    let mut nearest: Vec<f64> = cameras
        .iter()
        .enumerate()
        .map(|(i, a)| {
            let others = cameras.iter().enumerate().filter(|(j, _)| *j != i);
            others.map(|(_, b)| center(a).distance(center(b))).fold(f64::INFINITY, f64::min)
        })
        .collect();
    nearest.sort_by(f64::total_cmp);
    let middle = nearest.len() / 2;
    let even = nearest.len().is_multiple_of(2);
    Some(if even { (nearest[middle - 1] + nearest[middle]) / 2.0 } else { nearest[middle] })
}

impl Triple {
    /// The pair, and up to `count` photos in all: the nearest to the target, never the target.
    pub(crate) fn inputs(&self, photos: &[PosedPhoto], count: usize) -> Vec<usize> {
        let target = photos[self.target].camera.camera_to_world.center();
        let away = |i: usize| photos[i].camera.camera_to_world.center().distance(target);
        let mut rest: Vec<usize> =
            (0..photos.len()).filter(|i| *i != self.target && !self.pair.contains(i)).collect();
        rest.sort_by(|&a, &b| away(a).total_cmp(&away(b)));
        self.pair.into_iter().chain(rest).take(count).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{CameraToWorld, Intrinsics, Photo};
    use glam::DVec3;

    fn line(count: usize, step: f64) -> Vec<Camera> {
        let lens = Intrinsics { fx: 9., fy: 9., cx: 4., cy: 4., width: 8, height: 8 };
        (0..count)
            .map(|i| {
                // Uneven steps: no target is as near to a middle as another.
                let eye = DVec3::new(
                    (i as f64 + 0.01 * (i * i) as f64 - 0.01 * i as f64) * step,
                    0.0,
                    0.0,
                );
                let pose = CameraToWorld::look_at(eye, eye + DVec3::Z, DVec3::NEG_Y, "t").unwrap();
                Camera { intrinsics: lens, camera_to_world: pose }
            })
            .collect()
    }

    #[test]
    fn triples_do_not_depend_on_the_unit_of_length() {
        let pairs = |step| -> Vec<_> {
            triples(&line(9, step)).iter().map(|t| (t.pair, t.target)).collect()
        };
        assert_eq!(pairs(0.3), pairs(40.0), "scaled");
        assert!(!pairs(0.3).is_empty(), "some");
        // 1.3 / 0.3 steps at most: no pair is five apart.
        assert!(pairs(0.3).iter().all(|(p, _)| p[1] - p[0] <= 4), "{:?}", pairs(0.3));
        // Neighbours have nobody within 0.45 of a step from their middle.
        assert!(pairs(0.3).iter().all(|(p, _)| p[1] - p[0] >= 2), "{:?}", pairs(0.3));
    }

    #[test]
    fn more_inputs_are_the_nearest_and_never_the_target() {
        let photos: Vec<PosedPhoto> = line(9, 0.3)
            .into_iter()
            .map(|camera| PosedPhoto {
                file: String::new(),
                photo: Photo { width: 8, height: 8, rgb: vec![0; 192], valid: None },
                camera,
                intrinsics_made_for: None,
            })
            .collect();
        let triple = Triple { pair: [2, 6], target: 4, baseline: 1.2 };
        assert_eq!(triple.inputs(&photos, 2), [2, 6], "the pair");
        let mut four = triple.inputs(&photos, 4);
        four.sort_unstable();
        assert_eq!(four, [2, 3, 5, 6], "and the two beside the target");
    }

    #[test]
    fn the_median_of_an_even_count_is_the_mean_of_two() {
        let mut cameras = line(2, 1.0);
        cameras.extend(line(2, 3.0).into_iter().map(|mut camera| {
            let mut m = camera.camera_to_world.to_row_major();
            m[3] += 100.0;
            camera.camera_to_world = CameraToWorld::from_row_major(&m, "t").unwrap();
            camera
        }));
        assert_eq!(median_nearest(&cameras), Some(2.0), "1, 1, 3, 3");
    }
}
