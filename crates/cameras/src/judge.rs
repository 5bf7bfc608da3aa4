//! How far a solution can be trusted.

use std::sync::atomic::AtomicBool;

use nalgebra::{Matrix3, Vector3};

use crate::{
    grow::{Grower, Grown, angle_between},
    held,
    joints::{weakest, weakest_min},
    pose::{Pose, angle_deg},
    solution::Evidence,
    solver::{Candidate, between, explained, score_of},
    survey::{Link, Survey},
};

/// What is short is not cancelled.
static NEVER: AtomicBool = AtomicBool::new(false);
/// Solutions whose cameras are turned against each other by more than this differ, degrees.
const DIFFERENT_DEG: f64 = 5.0;

/// Rays to a point that differ by less see the same side of it, degrees.
const NEAR_DEG: f64 = 12.0;
/// Two photos with so many points in common should match.
const POINTS_IN_BOTH_MIN: usize = 60;
/// Under this number of near pairs nothing is said of those that did not match.
const NEAR_PAIRS_MIN: u32 = 3;

/// Confidence in two photos at most: nothing confirms a pair, and it does not tell a focal length.
const TWO_PLACED: f64 = 0.4;
const TWO_PLACED_FOCAL_KNOWN: f64 = 0.7;
/// Where each kind of doubt halves the confidence; chosen on seven scenes (`docs/adr`, number 71).
const AGREEING_MIN: f64 = 0.75;
pub(crate) const EXPLAINED_MIN: f64 = 0.8;
pub(crate) const RIVAL_MAX: f64 = 0.95;
/// Rivals from which on it is asked whether they end at the same cameras.
const RIVAL_SEEN: f64 = 0.9;
pub(crate) const MIRRORED_MAX: f64 = 0.92;
pub(crate) const MISSING_MAX: f64 = 0.55;
pub(crate) const LOOPS_MIN: f64 = 0.5;
/// Photos from which on the links of a photo are counted, and how many there must be.
pub(crate) const CHAIN_PLACED: usize = 8;
pub(crate) const CHAIN_LINKS: f64 = 1.5;
const HELD_MIN: f64 = 25.0;

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

/// The scene inside out, adjusted: what a distant camera can hardly tell from it. The share of the
/// sightings that still agree, where it is another solution.
fn mirrored(survey: &Survey, best: &Candidate) -> f64 {
    let points: Vec<Vector3<f64>> = best.grown.points.iter().flatten().copied().collect();
    let Some(reference) = best.grown.poses.iter().flatten().next() else { return 0.0 };
    let n = points.len().max(1) as f64;
    let middle = points.iter().sum::<Vector3<f64>>() / n;
    // World axes of the reference camera, origin in the middle of the points.
    let to_frame = |p: &Vector3<f64>| reference.r * (p - middle);
    let flip = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
    let mut grower = Grower::new(survey, &best.tracks, &[], &best.grown.lenses, &NEVER);
    grower.state = best.grown.clone();
    for point in grower.state.points.iter_mut().flatten() {
        *point = flip * to_frame(point);
    }
    for pose in grower.state.poses.iter_mut().flatten() {
        let r = pose.r * reference.r.transpose();
        let t = pose.r * middle + pose.t;
        *pose = Pose { r: flip * r * flip, t };
    }
    grower.adjust(30);
    let other = difference_deg(&best.grown, &grower.state).is_some_and(|d| d > DIFFERENT_DEG);
    let all = best.grown.agrees.iter().flatten().filter(|agrees| **agrees).count();
    if other { grower.agreeing() as f64 / all.max(1) as f64 } else { 0.0 }
}

/// A number that goes from 0 to 1 about `middle`, nearly all of it within three times `width`.
fn rising(value: f64, middle: f64, width: f64) -> f64 {
    1.0 / (1.0 + ((middle - value) / width).exp())
}

/// The confidence that the evidence gives: the product of what each kind of doubt leaves.
pub(crate) fn confidence(evidence: &Evidence) -> f64 {
    if evidence.placed < 2 {
        return 0.0;
    }
    let few = match (evidence.placed, evidence.focal_known) {
        (2, true) => TWO_PLACED_FOCAL_KNOWN,
        (2, false) => TWO_PLACED,
        _ => rising(evidence.held as f64, HELD_MIN, 6.0),
    };
    // A long chain without loops adds up its errors, and nothing shows them.
    let links = evidence.links as f64 / (evidence.placed - 1) as f64;
    let held = if evidence.placed < CHAIN_PLACED { 1.0 } else { rising(links, CHAIN_LINKS, 0.1) };
    few * held
        * rising(evidence.loops, LOOPS_MIN, 0.05)
        * rising(evidence.weakest, weakest_min(evidence.placed, evidence.links), 0.03)
        * rising(evidence.agreeing, AGREEING_MIN, 0.05)
        * rising(evidence.explained, EXPLAINED_MIN, 0.03)
        * rising(-evidence.rival, -RIVAL_MAX, 0.015)
        * rising(-evidence.mirrored, -MIRRORED_MAX, 0.015)
        * rising(-evidence.missing, -MISSING_MAX, 0.03)
}

/// Solutions that differ, each with its score over the photos that `best` places, as a share of
/// that of `best`; the best first.
pub(crate) fn rivals<'a>(
    survey: &Survey,
    best: &Candidate,
    others: &'a [Candidate],
) -> Vec<(f64, &'a Candidate)> {
    let of = |other: &'a Candidate| {
        let mut grown = other.grown.clone();
        for (pose, own) in grown.poses.iter_mut().zip(&best.grown.poses) {
            *pose = pose.filter(|_| own.is_some());
        }
        (score_of(survey, &grown) / best.score.max(1.0), other)
    };
    let mut all: Vec<_> = others.iter().filter(|other| differ(best, other)).map(of).collect();
    all.sort_by(|a, b| b.0.total_cmp(&a.0));
    all
}

/// Whether two solutions say different cameras.
pub(crate) fn differ(a: &Candidate, b: &Candidate) -> bool {
    difference_deg(&a.grown, &b.grown).is_some_and(|angle| angle > DIFFERENT_DEG)
}

/// The share of the strongest rival that is one. Those that cost no confidence are not asked.
pub(crate) fn strongest(
    rivals: Vec<(f64, &Candidate)>,
    is_one: impl Fn(&Candidate) -> bool,
) -> f64 {
    let first = rivals.into_iter().find(|(share, other)| *share < RIVAL_SEEN || is_one(other));
    first.map_or(0.0, |(share, _)| share)
}

/// The evidence for a solution; `relinked` are the links under its lenses, `rival` is that of
/// [`strongest`].
pub(crate) fn evidence(
    survey: &Survey,
    best: &Candidate,
    relinked: &[Link],
    rival: f64,
) -> Evidence {
    let grown = &best.grown;
    let (mut links, mut all, mut agreeing, mut inliers, mut near) = (0, 0.0, 0.0, 0.0, 0.0);
    for link in relinked {
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
    let mirrored = mirrored(survey, best);
    let held = held::points(best);
    let mut angles = Vec::new();
    let mut errors = Vec::new();
    for (point, near) in grown.seen(&best.tracks) {
        let rays: Vec<Vector3<f64>> = near
            .filter_map(|s| {
                let photo = s.0 as usize;
                let view = &survey.views[photo];
                let pose = grown.poses[photo].as_ref()?;
                let pixel = grown.lenses[view.lens].project(&pose.seen(point))?;
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
        loops: loops(grown, relinked),
        missing: missing(survey, best, relinked),
        weakest: weakest(survey, relinked, grown),
        placed: of_placed.len(),
        focal_known: survey
            .views
            .iter()
            .zip(&grown.poses)
            .all(|(view, pose)| pose.is_none() || survey.priors[view.lens].known),
    }
}

/// Share of loops of three links between placed photos whose turns close.
fn loops(grown: &Grown, links: &[Link]) -> f64 {
    let count = grown.poses.len();
    let mut turns: Vec<Option<Matrix3<f64>>> = vec![None; count * count];
    for link in links {
        let [a, b] = link.photos;
        if grown.poses[a].is_some() && grown.poses[b].is_some() {
            turns[a * count + b] = Some(link.geometry.pose.r);
            turns[b * count + a] = Some(link.geometry.pose.r.transpose());
        }
    }
    let (mut all, mut closed) = (0, 0);
    for a in 0..count {
        for b in a + 1..count {
            let Some(ab) = turns[a * count + b] else { continue };
            for c in b + 1..count {
                if let (Some(bc), Some(ca)) = (turns[b * count + c], turns[c * count + a]) {
                    all += 1;
                    closed += usize::from(angle_deg(&(ca * bc * ab)) < DIFFERENT_DEG);
                }
            }
        }
    }
    if all == 0 { 1.0 } else { f64::from(closed as u32) / f64::from(all) }
}

/// Share of pairs of near cameras with many points in both photos that are no links.
fn missing(survey: &Survey, best: &Candidate, links: &[Link]) -> f64 {
    let grown = &best.grown;
    let linked: std::collections::BTreeSet<usize> = links.iter().map(|link| link.pair).collect();
    let (mut near, mut lost) = (0, 0);
    for (index, pair) in survey.pairs.iter().enumerate() {
        let [a, b] = pair.photos;
        let (Some(first), Some(second)) = (&grown.poses[a], &grown.poses[b]) else { continue };
        let both = points_in_both(survey, best, [(a, first), (b, second)]);
        if both >= POINTS_IN_BOTH_MIN {
            near += 1;
            lost += usize::from(!linked.contains(&index));
        }
    }
    if near < NEAR_PAIRS_MIN { 0.0 } else { lost as f64 / f64::from(near) }
}

/// Points, seen by one of the two photos, that both could see from nearly the same side.
fn points_in_both(survey: &Survey, best: &Candidate, ends: [(usize, &Pose); 2]) -> usize {
    let grown = &best.grown;
    let seen = grown.seen(&best.tracks).filter(|(point, near)| {
        let by_one = near.clone().any(|s| ends.iter().any(|(photo, _)| *photo == s.0 as usize));
        let inside = |(photo, pose): (usize, &Pose)| {
            let view = &survey.views[photo];
            let pixel = grown.lenses[view.lens].project(&pose.seen(point));
            pixel.is_some_and(|p| p.x.abs() < 0.5 * view.size[0] && p.y.abs() < 0.5 * view.size[1])
        };
        let rays = ends.map(|(_, pose)| (*point - pose.center()).normalize());
        let lengths = ends.map(|(_, pose)| (*point - pose.center()).norm());
        let scale = lengths[0] / lengths[1];
        by_one
            && ends.into_iter().all(inside)
            && angle_between(&rays[0], &rays[1]) < NEAR_DEG
            && (0.6..1.7).contains(&scale)
    });
    seen.count()
}

#[cfg(test)]
mod tests {
    use super::strongest;
    use crate::{grow::Grown, solver::Candidate};

    fn scored(score: f64) -> Candidate {
        let (poses, lenses, points, agrees) = (vec![], vec![], vec![], vec![]);
        let grown = Grown { poses, lenses, points, agrees };
        Candidate { grown, links: vec![], tracks: vec![], score }
    }

    #[test]
    fn a_rival_that_ends_at_the_same_cameras_is_none() {
        let all = [0.99, 0.97, 0.93, 0.8].map(scored);
        let rivals = || all.iter().map(|other| (other.score, other)).collect();
        assert_eq!(strongest(rivals(), |_| true), 0.99);
        assert_eq!(strongest(rivals(), |other| other.score < 0.98), 0.97);
        // What costs no confidence is not finished for it.
        let is_one = |other: &Candidate| {
            assert!(other.score > 0.9, "{} is asked", other.score);
            false
        };
        assert_eq!(strongest(rivals(), is_one), 0.8);
        assert_eq!(strongest(Vec::new(), |_| true), 0.0);
    }
}
