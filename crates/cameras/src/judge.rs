//! How far a solution can be trusted.

use nalgebra::{Matrix3, Vector3};

use crate::{
    grow::{Grower, Grown, angle_between},
    pose::{Pose, angle_deg},
    solver::{Candidate, between, explained, score_of},
    survey::Survey,
};

/// Solutions whose cameras are turned against each other by more than this differ, degrees.
const DIFFERENT_DEG: f64 = 5.0;

/// What speaks for a solution and against it.
#[derive(Clone, Copy, Debug, Default)]
pub struct Evidence {
    /// Pairs of placed photos whose matches fit one geometry of two views.
    pub links: usize,
    /// Share of these pairs, by their matches, that are turned as the cameras are, within 5 degrees.
    pub agreeing: f64,
    /// Share of the matches of these pairs that the cameras explain.
    pub explained: f64,
    /// Matches that the best other solution explains, as a share of those of this one.
    pub rival: f64,
    /// The same of the mirrored solution: the scene inside out.
    pub mirrored: f64,
    /// Points that three photos or more see, in the photo that sees fewest of them.
    pub held: usize,
    /// The same in the median photo.
    pub held_median: usize,
    /// Median of the widest angle at which a point is seen, degrees.
    pub angle_deg: f64,
    /// Median distance of keypoints from their points, in units of the distance at which they agree.
    pub error: f64,
    /// Share of placed photos that hang together by links without any single photo.
    pub cycles: f64,
    /// Share of the pairs that should match by the solution and do not.
    pub missing: f64,
    /// Photos placed.
    pub placed: usize,
}

/// Angles between the rotations of two solutions, over the pairs of photos that both place: the
/// median, degrees.
pub(crate) fn difference_deg(a: &Grown, b: &Grown) -> Option<f64> {
    let both: Vec<(Matrix3<f64>, Matrix3<f64>)> =
        a.poses.iter().zip(&b.poses).filter_map(|(a, b)| Some(((*a)?.r, (*b)?.r))).collect();
    let mut angles = Vec::new();
    for (i, (a, b)) in both.iter().enumerate() {
        for (c, d) in &both[i + 1..] {
            angles.push(angle_deg(&((c * a.transpose()) * (d * b.transpose()).transpose())));
        }
    }
    angles.sort_by(f64::total_cmp);
    angles.get(angles.len() / 2).copied()
}

/// The scene inside out: what a distant camera can hardly tell from it. `None` where too few fit.
pub(crate) fn mirrored(survey: &Survey, best: &Candidate) -> Option<Grown> {
    let points: Vec<Vector3<f64>> = best.grown.points.iter().flatten().copied().collect();
    let reference = best.grown.poses.iter().flatten().next()?;
    let n = points.len().max(1) as f64;
    let middle = points.iter().sum::<Vector3<f64>>() / n;
    // World axes of the reference camera, origin in the middle of the points.
    let to_frame = |p: &Vector3<f64>| reference.r * (p - middle);
    let flip = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
    let mut grower = Grower::new(survey, &best.tracks, &best.grown.lenses);
    grower.state = best.grown.clone();
    for point in grower.state.points.iter_mut().flatten() {
        *point = flip * to_frame(point);
    }
    for pose in grower.state.poses.iter_mut().flatten() {
        let r = pose.r * reference.r.transpose();
        let t = pose.r * middle + pose.t;
        *pose = Pose { r: flip * r * flip, t };
    }
    for _ in 0..3 {
        grower.adjust(12);
        grower.filter();
        grower.triangulate();
    }
    grower.place_all(survey.seed);
    (grower.placed() >= 2).then_some(grower.state)
}

/// The evidence for the first of the candidates; `others` are the rest.
pub(crate) fn evidence(survey: &Survey, best: &Candidate, others: &[&Grown]) -> Evidence {
    let grown = &best.grown;
    let score = score_of(survey, &best.links, grown).max(1.0);
    let (mut links, mut all, mut agreeing, mut inliers, mut near) = (0, 0.0, 0.0, 0.0, 0.0);
    for link in &best.links {
        let [a, b] = link.photos;
        let (Some(first), Some(second)) = (&grown.poses[a], &grown.poses[b]) else { continue };
        let Some((seen, own)) = explained(survey, link, grown) else { continue };
        links += 1;
        all += own;
        inliers += own;
        near += seen.min(own);
        let turned = between(first, second).r * link.geometry.pose.r.transpose();
        if angle_deg(&turned) < DIFFERENT_DEG {
            agreeing += own;
        }
    }
    let rival = others
        .iter()
        .filter(|other| difference_deg(grown, other).is_some_and(|angle| angle > DIFFERENT_DEG))
        .map(|other| score_of(survey, &best.links, other) / score)
        .fold(0.0, f64::max);
    let mirrored = mirrored(survey, best)
        .filter(|other| difference_deg(grown, other).is_some_and(|angle| angle > DIFFERENT_DEG))
        .map_or(0.0, |other| score_of(survey, &best.links, &other) / score);
    let mut held = vec![0; grown.poses.len()];
    let mut angles = Vec::new();
    let mut errors = Vec::new();
    for ((track, agrees), point) in best.tracks.iter().zip(&grown.agrees).zip(&grown.points) {
        let Some(point) = point else { continue };
        let near: Vec<_> = track.iter().zip(agrees).filter(|(_, a)| **a).map(|(s, _)| s).collect();
        if near.len() >= 3 {
            for sighting in &near {
                held[sighting.0 as usize] += 1;
            }
        }
        let rays: Vec<Vector3<f64>> = near
            .iter()
            .filter_map(|s| {
                let photo = s.0 as usize;
                let view = &survey.views[photo];
                let pose = grown.poses[photo].as_ref()?;
                let pixel = grown.lenses[view.lens].project(&pose.to_camera(point))?;
                errors.push((pixel - view.pixels[s.1 as usize]).norm() / view.agree_px);
                Some((point - pose.center()).normalize())
            })
            .collect();
        let pairs = rays
            .iter()
            .enumerate()
            .flat_map(|(i, a)| rays[i + 1..].iter().map(move |b| angle_between(a, b)));
        angles.push(pairs.fold(0.0, f64::max));
    }
    let median = |values: &mut Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    let mut of_placed: Vec<usize> = held
        .iter()
        .zip(&grown.poses)
        .filter(|(_, pose)| pose.is_some())
        .map(|(held, _)| *held)
        .collect();
    of_placed.sort_unstable();
    Evidence {
        links,
        agreeing: agreeing / f64::max(all, 1.0),
        explained: near / f64::max(inliers, 1.0),
        rival,
        mirrored,
        held: of_placed.first().copied().unwrap_or(0),
        held_median: of_placed.get(of_placed.len() / 2).copied().unwrap_or(0),
        angle_deg: median(&mut angles),
        error: median(&mut errors),
        cycles: 0.0,
        missing: 0.0,
        placed: of_placed.len(),
    }
}
