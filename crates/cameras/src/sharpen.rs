//! Keypoints moved to where the photos' pixels agree: of each point of a solution one photo is the
//! reference, and its small patch is laid into the others, by the cameras first, then by steps of
//! Gauss and Newton over an affine map and the light. Keypoints of a network drift by half a pixel
//! over things that turn, all the same way; this takes it out.

use std::sync::atomic::AtomicBool;

use nalgebra::{Matrix2, Vector2, Vector3};
use rayon::prelude::*;

use crate::{
    grow::{Grower, Grown},
    patch::{Grey, Patch},
    solver::{Candidate, finish},
    survey::Survey,
    tracks::Sighting,
};

/// Correlation under which a patch is not found.
const ALIKE_MIN: f64 = 0.9;
/// How far a keypoint may move, in units of the distance at which it agrees.
const MOVED_MAX: f64 = 1.5;
/// Rounds: each lays the patches by the cameras of the one before.
const ROUNDS: usize = 2;
/// Keypoints of a photo that pixels confirm, from which on its others do not count.
const SURE_MIN: usize = 40;

/// Adjusts a solution to keypoints that lie where the photos' pixels agree, and leaves out those
/// that pixels do not confirm. The survey has them where they are then.
pub(crate) fn sharpened(
    survey: &Survey,
    photos: &[Grey],
    best: &Candidate,
    cancel: &AtomicBool,
) -> (Survey, Candidate) {
    let (mut survey, mut best) = (survey.clone(), best.clone());
    for _ in 0..ROUNDS {
        let found = found(&survey, photos, &best);
        let is_poor = |of: &Vec<Option<Vector2<f64>>>| of.iter().flatten().count() < SURE_MIN;
        let poor: Vec<bool> = found.iter().map(is_poor).collect();
        for (view, found) in survey.views.iter_mut().zip(&found) {
            for (pixel, found) in view.pixels.iter_mut().zip(found) {
                *pixel = found.unwrap_or(*pixel);
            }
        }
        let stays = |(photo, keypoint): &Sighting| {
            let photo = *photo as usize;
            poor[photo] || found[photo][*keypoint as usize].is_some()
        };
        let (mut tracks, mut points) = (Vec::new(), Vec::new());
        for (track, point) in best.tracks.iter().zip(&best.grown.points) {
            let own: Vec<Sighting> = track.iter().copied().filter(stays).collect();
            if own.len() >= 2 && point.is_some() {
                tracks.push(own);
                points.push(*point);
            }
        }
        let mut grower = Grower::new(&survey, &tracks, &[], &best.grown.lenses, cancel);
        grower.state.poses.clone_from(&best.grown.poses);
        grower.state.points = points;
        grower.filter();
        grower.settle();
        let grown = grower.state;
        (best.grown, best.tracks) = (grown, tracks);
    }
    (survey, best)
}

/// Where another solution ends when it is finished as the best one is.
pub(crate) fn ended(
    survey: &Survey,
    photos: &[Grey],
    other: &Candidate,
    cancel: &AtomicBool,
) -> Candidate {
    let mut other = other.clone();
    finish(survey, &mut other, cancel);
    sharpened(survey, photos, &other, cancel).1
}

/// Where the photos' pixels say that the keypoints of a solution's points are, from the photos'
/// middles; `None` for keypoints of no point, and where the photos do not agree.
fn found(survey: &Survey, photos: &[Grey], best: &Candidate) -> Vec<Vec<Option<Vector2<f64>>>> {
    let of_track = |index: usize| {
        let (track, agrees) = (&best.tracks[index], &best.grown.agrees[index]);
        let own = track.iter().zip(agrees).filter(|(_, agrees)| **agrees).map(|(s, _)| *s);
        let point = best.grown.points[index].as_ref()?;
        of_point(survey, photos, &best.grown, &own.collect::<Vec<_>>(), point)
    };
    let moved: Vec<_> = (0..best.tracks.len()).into_par_iter().filter_map(of_track).collect();
    let mut found: Vec<Vec<Option<Vector2<f64>>>> =
        survey.views.iter().map(|view| vec![None; view.pixels.len()]).collect();
    for ((photo, keypoint), place) in moved.into_iter().flatten() {
        found[photo as usize][keypoint as usize] = Some(place);
    }
    found
}

/// Sightings of a point in whose photos its patch was found, and where.
fn of_point(
    survey: &Survey,
    photos: &[Grey],
    grown: &Grown,
    sightings: &[Sighting],
    point: &Vector3<f64>,
) -> Option<Vec<(Sighting, Vector2<f64>)>> {
    let view = |sighting: &Sighting| &survey.views[sighting.0 as usize];
    let pixel = |sighting: &Sighting| view(sighting).pixels[sighting.1 as usize];
    let middle = |sighting: &Sighting| Vector2::from(view(sighting).size) * 0.5;
    let pose = |sighting: &Sighting| grown.poses[sighting.0 as usize].as_ref();
    let lens = |sighting: &Sighting| grown.lenses[view(sighting).lens];
    let rays = sightings.iter().map(|s| Some((point - pose(s)?.center()).normalize()));
    let rays: Vec<Vector3<f64>> = rays.collect::<Option<_>>()?;
    let mean = rays.iter().sum::<Vector3<f64>>().try_normalize(1e-9)?;
    let from =
        (0..rays.len()).max_by(|&a, &b| rays[a].dot(&mean).total_cmp(&rays[b].dot(&mean)))?;
    let from = sightings[from];
    let center = pixel(&from);
    let patch = Patch::new(&photos[from.0 as usize], &(center + middle(&from)))?;
    let own = pose(&from)?;
    // The point of the plane through the point, across its mean ray, that is seen at a pixel.
    let on_plane = |pixel: Vector2<f64>| {
        let ray = own.r.transpose() * lens(&from).direction(&pixel).push(1.0);
        own.center() + ray * ((point - own.center()).dot(&mean) / ray.dot(&mean))
    };
    let steps = [Vector2::zeros(), Vector2::x(), Vector2::y()].map(|step| on_plane(center + step));
    let in_other = |sighting: &Sighting| {
        let (other, lens) = (pose(sighting)?, lens(sighting));
        let [o, x, y] = steps.map(|step| lens.project(&other.seen(&step)));
        let affine = Matrix2::from_columns(&[x? - o?, y? - o?]);
        let start = pixel(sighting);
        let grey = &photos[sighting.0 as usize];
        let (place, alike) = patch.found(grey, affine, start + middle(sighting))?;
        let place = place - middle(sighting);
        let is_near = (place - start).norm() <= MOVED_MAX * view(sighting).agree_px;
        (alike >= ALIKE_MIN && is_near).then_some((*sighting, place))
    };
    let others = sightings.iter().filter(|s| **s != from).filter_map(in_other);
    let all: Vec<_> = std::iter::once((from, center)).chain(others).collect();
    (all.len() >= 2).then_some(all)
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use nalgebra::{Vector2, Vector3};

    use super::{Grey, found, sharpened};
    use crate::{
        adjust::LensPrior,
        grow::Grown,
        lens::Lens,
        pose::{Pose, rotation},
        solver::Candidate,
        survey::{Survey, View},
    };

    const SIZE: [u32; 2] = [320, 240];
    const LENS: Lens = Lens { focal: 300.0, k1: 0.0 };

    fn middle() -> Vector2<f64> {
        Vector2::new(f64::from(SIZE[0]), f64::from(SIZE[1])) * 0.5
    }

    fn texture(x: f64, y: f64, seed: f64) -> f64 {
        let wave = |a: f64, b: f64| (a * x + b * y + seed * (1.0 + a)).sin();
        128.0 + 30.0 * wave(13.0, 4.0) + 30.0 * wave(-5.0, 14.0) + 30.0 * wave(23.0, -19.0)
    }

    fn pose(photo: usize) -> Pose {
        let along = photo as f64 - 1.0;
        let r = rotation(&Vector3::new(0.02, 0.15 * along, 0.01 * along));
        Pose { r, t: -(r * Vector3::new(-0.7 * along, 0.1 * along, 0.0)) }
    }

    /// Where a pixel's ray meets the wall at a distance of 5.
    fn wall(photo: usize, pixel: &Vector2<f64>) -> Vector3<f64> {
        let pose = pose(photo);
        let ray = pose.r.transpose() * LENS.direction(pixel).push(1.0);
        let center = pose.center();
        center + ray * ((5.0 - center.z) / ray.z)
    }

    /// A wall in four photos, keypoints that drift from photo to photo, and the right cameras. The
    /// wall of the last photo has other paper.
    fn drifting() -> (Survey, Vec<Grey>, Candidate) {
        let grey = |photo: usize| {
            let value = |i: u32| {
                let pixel = Vector2::new(f64::from(i % SIZE[0]), f64::from(i / SIZE[0]));
                let p = wall(photo, &(pixel.add_scalar(0.5) - middle()));
                texture(p.x, p.y, if photo == 3 { 9.0 } else { 1.0 }) as u8
            };
            let rgb: Vec<u8> = (0..SIZE[0] * SIZE[1]).flat_map(|i| [value(i); 3]).collect();
            Grey::new(SIZE[0], SIZE[1], &rgb)
        };
        let points: Vec<Vector3<f64>> = (0..99)
            .map(|i| {
                Vector3::new(f64::from(i % 11) * 0.2 - 1.0, f64::from(i / 11) * 0.2 - 0.8, 5.0)
            })
            .collect();
        let view = |photo: usize| View {
            lens: 0,
            pixels: points
                .iter()
                .enumerate()
                .map(|(k, p)| {
                    let drift = Vector2::new(0.4, [0.0, -0.6, 0.6, 0.0][photo]);
                    let drift = if k % 2 == 0 { drift } else { -drift };
                    LENS.project(&pose(photo).seen(p)).unwrap() + drift
                })
                .collect(),
            agree_px: 2.0,
            side: 320.0,
            size: SIZE.map(f64::from),
        };
        let prior = LensPrior { focal: 300.0, log_spread: 0.01, known: true, k1_spread: 0.01 };
        let survey = Survey {
            views: (0..4).map(view).collect(),
            pairs: Vec::new(),
            priors: vec![prior],
            guess: None,
            seed: 0,
        };
        let tracks: Vec<_> = (0..99).map(|k| (0..4).map(|photo| (photo, k)).collect()).collect();
        let grown = Grown {
            poses: (0..4).map(|photo| Some(pose(photo))).collect(),
            lenses: vec![LENS],
            points: points.into_iter().map(Some).collect(),
            agrees: vec![vec![true; 4]; 99],
        };
        let best = Candidate { grown, links: Vec::new(), tracks, score: 1.0 };
        (survey, (0..4).map(grey).collect(), best)
    }

    #[test]
    fn keypoints_that_drift_end_where_the_pixels_agree() {
        let (survey, photos, best) = drifting();
        let found = found(&survey, &photos, &best);
        let mut worst = 0.0_f64;
        let [one, two, three, _] = &found[..] else { panic!("four photos") };
        for ((one, two), three) in one.iter().zip(two).zip(three) {
            let places = [one, two, three].into_iter().enumerate();
            let places: Vec<_> = places.filter_map(|(i, place)| Some((i, (*place)?))).collect();
            for (photo, place) in &places {
                let there = wall(places[0].0, &places[0].1);
                let seen = LENS.project(&pose(*photo).seen(&there)).unwrap();
                worst = worst.max((seen - place).norm());
            }
        }
        assert!(worst < 0.15, "{worst} pixels between keypoints of one point");
        let sure = |photo: usize| found[photo].iter().flatten().count();
        assert!((0..3).all(|photo| sure(photo) >= 80), "{:?}", [0, 1, 2].map(sure));
        assert!(sure(3) < 5, "{} keypoints of other paper are confirmed", sure(3));
    }

    #[test]
    fn a_sharpened_solution_fits_its_keypoints() {
        let (survey, photos, mut best) = drifting();
        // What pixels do not confirm in a photo stays where it has little else: leave it out.
        best.grown.poses[3] = None;
        best.tracks.iter_mut().for_each(|track| track.truncate(3));
        best.grown.agrees.iter_mut().for_each(|agrees| agrees.truncate(3));
        let (survey, sharp) = sharpened(&survey, &photos, &best, &AtomicBool::new(false));
        let mut errors = Vec::new();
        for (track, point) in sharp.tracks.iter().zip(&sharp.grown.points) {
            let Some(point) = point else { continue };
            for (photo, keypoint) in track {
                let pose = sharp.grown.poses[*photo as usize].as_ref().unwrap();
                let seen = sharp.grown.lenses[0].project(&pose.seen(point)).unwrap();
                let pixel = survey.views[*photo as usize].pixels[*keypoint as usize];
                errors.push((seen - pixel).norm());
            }
        }
        errors.sort_by(f64::total_cmp);
        assert!(errors.len() > 250, "{}", errors.len());
        assert!(errors[errors.len() / 2] < 0.08, "{} pixels", errors[errors.len() / 2]);
    }
}
