//! How well the points of a solution hold each of its photos. One that they hold badly is left out:
//! its camera may be off by degrees, and the pixels agree as well.

use std::sync::atomic::AtomicBool;

use nalgebra::Matrix3;

use crate::{
    adjust::{Bundle, Sight},
    grow::Grower,
    joints::without,
    solver::Candidate,
    survey::Survey,
};

/// A photo is left out where fewer of its points are seen by two more photos.
const POINTS_MIN: usize = 25;
/// A photo is left out where its turn is known by less, degrees: the deviation for keypoints that
/// are off each by itself. They are off together: the worst are some thirty times as far off.
const TURN_MAX_DEG: f64 = 0.15;
/// Photos that stay: two confirm nothing.
const PHOTOS_MIN: usize = 3;
/// Median distance of keypoints that are off by one along x and along y.
const MEDIAN_OF_ONE: f64 = 1.177;

/// Takes photos out of a solution that few points hold, each with the number of its points that two
/// more photos see.
pub(crate) fn drop_few(
    survey: &Survey,
    best: &mut Candidate,
    cancel: &AtomicBool,
) -> Vec<(usize, usize)> {
    let fewest = |best: &Candidate| {
        let points = points(best);
        let fewest = placed(best).min_by_key(|photo| points[*photo])?;
        (points[fewest] < POINTS_MIN).then(|| (fewest, points[fewest]))
    };
    drop_worst(survey, best, cancel, fewest)
}

/// Takes photos out of a solution whose turns are not known, each with its deviation in degrees.
pub(crate) fn drop_loose(
    survey: &Survey,
    best: &mut Candidate,
    cancel: &AtomicBool,
) -> Vec<(usize, f64)> {
    let loosest = |best: &Candidate| {
        let turns = turns_deg(survey, best, cancel)?;
        let loosest = placed(best).max_by(|a, b| turns[*a].total_cmp(&turns[*b]))?;
        (turns[loosest] > TURN_MAX_DEG).then(|| (loosest, turns[loosest]))
    };
    drop_worst(survey, best, cancel, loosest)
}

/// Takes out the `worst` photo of a solution, one after the other, with what was measured of it.
fn drop_worst<T>(
    survey: &Survey,
    best: &mut Candidate,
    cancel: &AtomicBool,
    worst: impl Fn(&Candidate) -> Option<(usize, T)>,
) -> Vec<(usize, T)> {
    let mut dropped = Vec::new();
    while placed(best).count() > PHOTOS_MIN
        && let Some((photo, measured)) = worst(best)
    {
        without(survey, best, &[photo], cancel);
        dropped.push((photo, measured));
    }
    dropped
}

fn placed(best: &Candidate) -> impl Iterator<Item = usize> + '_ {
    (0..best.grown.poses.len()).filter(|&photo| best.grown.poses[photo].is_some())
}

/// Points of each photo that two more photos see.
pub(crate) fn points(best: &Candidate) -> Vec<usize> {
    let mut points = vec![0; best.grown.poses.len()];
    for (_, near) in best.grown.seen(&best.tracks) {
        if near.clone().count() >= 3 {
            near.for_each(|sighting| points[sighting.0 as usize] += 1);
        }
    }
    points
}

/// The deviation of each photo's turn, degrees, for keypoints that are off each by itself, by as
/// much as those of all are.
fn turns_deg(survey: &Survey, best: &Candidate, cancel: &AtomicBool) -> Option<Vec<f64>> {
    let mut grower = Grower::new(survey, &best.tracks, &[], &best.grown.lenses, cancel);
    grower.state = best.grown.clone();
    let fixed = best.grown.poses.iter().position(Option::is_some)?;
    let (bundle, _) = grower.bundle();
    let turns = bundle.turns(fixed, &grower.options(0))?;
    let error_px = median_error_px(&bundle) / MEDIAN_OF_ONE;
    let spread = |turn: &Matrix3<f64>| turn.symmetric_eigenvalues().max().max(0.0).sqrt();
    Some(turns.iter().map(|turn| (error_px * spread(turn)).to_degrees()).collect())
}

fn median_error_px(bundle: &Bundle) -> f64 {
    let of_point = |(point, sights): (_, &Vec<Sight>)| -> Vec<f64> {
        let error = |sight: &Sight| {
            let lens = bundle.lenses[bundle.lens_of[sight.camera]];
            let seen = lens.project(&bundle.poses[sight.camera].seen(point))?;
            Some((seen - sight.pixel).norm())
        };
        sights.iter().filter_map(error).collect()
    };
    let mut errors: Vec<f64> =
        bundle.points.iter().zip(&bundle.sights).flat_map(of_point).collect();
    errors.sort_by(f64::total_cmp);
    errors.get(errors.len() / 2).copied().unwrap_or(0.0)
}
