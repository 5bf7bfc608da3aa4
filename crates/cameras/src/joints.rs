//! What joins the photos of a solution: pairs of which its cameras explain many matches. Two parts
//! that only weak pairs join may be two places, or two sides of a thing that look alike.

use std::sync::atomic::AtomicBool;

use crate::{
    grow::{Grower, Grown},
    solver::{Candidate, between_placed, explained, links_under},
    survey::{Link, Survey},
};

/// Where the share of the weakest joint halves the confidence.
const WEAKEST_MIN: f64 = 0.5;
/// Added where the links are a tree: no loop shows what is wrong.
const WEAKEST_OF_TREE: f64 = 0.2;

/// Where the share of the weakest joint halves the confidence: the fewer links there are a photo,
/// the more each must be trusted.
pub(crate) fn weakest_min(placed: usize, links: usize) -> f64 {
    if placed < 3 {
        return WEAKEST_MIN;
    }
    let placed = placed as f64;
    let links = links as f64 / (placed - 1.0);
    // Three photos have no more than three links.
    let enough = (0.5 * placed).min(2.0);
    WEAKEST_MIN + WEAKEST_OF_TREE * (enough - links).clamp(0.0, 1.0)
}

/// The share of the weakest of the strongest links that join all placed photos.
pub(crate) fn weakest(survey: &Survey, links: &[Link], grown: &Grown) -> f64 {
    let joints = joints(survey, links, grown);
    let placed = grown.poses.iter().flatten().count();
    let least = joints.iter().map(|(share, _)| *share).fold(1.0, f64::min);
    if joints.len() + 1 < placed { 0.0 } else { least }
}

/// Takes photos out of a solution that only weak links join with the others: of two parts of which
/// the cameras explain less than [`weakest_min`] of the matches of any pair across, the
/// larger one stays. Returns the links under the final lenses and the photos that were taken out.
pub(crate) fn drop_weak(
    survey: &Survey,
    best: &mut Candidate,
    cancel: &AtomicBool,
) -> (Vec<Link>, Vec<usize>) {
    let mut dropped = Vec::new();
    loop {
        let links = links_under(survey, best);
        let weak = beside_largest(survey, &links, &best.grown);
        // Where no part is more than half, none is better than the others: the confidence says it.
        if weak.is_empty() || 2 * weak.len() >= best.grown.poses.iter().flatten().count() {
            return (links, dropped);
        }
        without(survey, best, &weak, cancel);
        dropped.extend(weak);
    }
}

/// Takes photos out of a solution and adjusts the others.
pub(crate) fn without(
    survey: &Survey,
    best: &mut Candidate,
    photos: &[usize],
    cancel: &AtomicBool,
) {
    let mut grower = Grower::new(survey, &best.tracks, &[], &best.grown.lenses, cancel);
    grower.state = best.grown.clone();
    for photo in photos {
        grower.state.poses[*photo] = None;
    }
    grower.settle();
    best.grown = grower.state;
}

/// The placed photos that strong links do not join with the largest part.
fn beside_largest(survey: &Survey, links: &[Link], grown: &Grown) -> Vec<usize> {
    let placed: Vec<usize> = (0..grown.poses.len()).filter(|&i| grown.poses[i].is_some()).collect();
    let is_placed = |link: &&Link| between_placed(&grown.poses, link.photos).is_some();
    let least = weakest_min(placed.len(), links.iter().filter(is_placed).count());
    let mut part: Vec<usize> = (0..grown.poses.len()).collect();
    for (share, photos) in joints(survey, links, grown) {
        if share >= least {
            join(&mut part, photos);
        }
    }
    let size =
        |photo: &&usize| placed.iter().filter(|other| part[**other] == part[**photo]).count();
    let Some(largest) = placed.iter().rev().max_by_key(size).map(|photo| part[*photo]) else {
        return Vec::new();
    };
    placed.into_iter().filter(|photo| part[*photo] != largest).collect()
}

/// The strongest links that join the placed photos (a spanning tree, or several where photos are
/// not linked), the strongest first: each with the share of its matches that the cameras explain.
fn joints(survey: &Survey, links: &[Link], grown: &Grown) -> Vec<(f64, [usize; 2])> {
    let share = |link: &Link| {
        let (seen, _) = explained(survey, link, grown)?;
        Some((seen / survey.pairs[link.pair].matches.len() as f64, link.photos))
    };
    let mut order: Vec<(f64, [usize; 2])> = links.iter().filter_map(share).collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut part: Vec<usize> = (0..survey.views.len()).collect();
    order.retain(|(_, photos)| join(&mut part, *photos));
    order
}

/// Makes one part of those of two photos; says whether they were two.
fn join(part: &mut [usize], photos: [usize; 2]) -> bool {
    let [a, b] = photos.map(|photo| part[photo]);
    part.iter_mut().filter(|part| **part == b).for_each(|part| *part = a);
    a != b
}
