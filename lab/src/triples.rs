//! Which photos are put in and which one is held out.

use crate::{scene::PosedPhoto, scenes::nearest};

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
pub struct Triple {
    /// The inputs.
    pub pair: [usize; 2],
    /// The photo to be predicted.
    pub target: usize,
    /// Distance between the inputs, world units.
    pub baseline: f64,
}

/// All triples of a capture, in the order of the inputs.
#[must_use]
pub fn triples(photos: &[PosedPhoto]) -> Vec<Triple> {
    let Some(median) = median_nearest(photos) else { return Vec::new() };
    let scale = median / MEDIAN_NEAREST;
    let pose = |i: usize| photos[i].camera.camera_to_world;
    let center = |i: usize| pose(i).center();
    let angle = |i: usize, j: usize| {
        pose(i).axis().dot(pose(j).axis()).clamp(-1.0, 1.0).acos().to_degrees()
    };
    let mut found = Vec::new();
    for i in 0..photos.len() {
        for j in i + 1..photos.len() {
            let baseline = center(i).distance(center(j));
            let in_range = (BASELINE[0] * scale..=BASELINE[1] * scale).contains(&baseline);
            if !in_range || angle(i, j) >= INPUT_ANGLE {
                continue;
            }
            let middle = (center(i) + center(j)) / 2.0;
            let away = |k: &usize| center(*k).distance(middle);
            let target = (0..photos.len())
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
#[must_use]
pub fn median_nearest(photos: &[PosedPhoto]) -> Option<f64> {
    let center = |i: usize| photos[i].camera.camera_to_world.center();
    let distance = |i: usize| Some(center(i).distance(center(*nearest(photos, i, 1).first()?)));
    let mut distances: Vec<f64> = (0..photos.len()).filter_map(distance).collect();
    distances.sort_by(f64::total_cmp);
    let middle = distances.len() / 2;
    let even = distances.len().is_multiple_of(2);
    let upper = *distances.get(middle)?;
    Some(if even { (distances[middle - 1] + upper) / 2.0 } else { upper })
}

impl Triple {
    /// The pair, and up to `count` photos in all: the nearest to the target, never the target.
    #[must_use]
    pub fn inputs(&self, photos: &[PosedPhoto], count: usize) -> Vec<usize> {
        let rest = nearest(photos, self.target, photos.len());
        let rest = rest.into_iter().filter(|i| !self.pair.contains(i));
        self.pair.into_iter().chain(rest).take(count).collect()
    }
}
