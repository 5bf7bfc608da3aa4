//! Which views go through the network together, and which are the sources of each.

use crate::scene::{Capture, PosedPhoto, ViewSet};

/// Least overlap for a photo to be a source of another.
const OVERLAP_MIN: f64 = 0.05;
/// Angle between two rays to the scene, radians, that serves depth best: about 5 degrees.
const BEST_ANGLE: f64 = 0.09;
/// One view in so many of a set is of an earlier set, so that sets overlap.
const SHARED_EVERY: usize = 4;

/// Groups the photos into overlapping sets of at most `views_max`, each view with
/// `min(views - 1, neighbors_max)` sources of the same set.
///
/// A set has at least `views_min` views where there are as many photos: photos of other sets fill
/// it up, and then the nearest ones.
///
/// Every photo that overlaps another is in at least one set; those that overlap none are in none.
/// Without any overlap all photos are grouped by distance of their cameras. Deterministic.
#[must_use]
pub fn view_sets(
    capture: &Capture,
    photos: &[PosedPhoto],
    views: [usize; 2],
    neighbors_max: usize,
) -> Vec<ViewSet> {
    more_view_sets(capture, photos, 0, views, neighbors_max)
}

/// The same where the first `known` photos are in sets already: sets that have all others.
#[must_use]
pub fn more_view_sets(
    capture: &Capture,
    photos: &[PosedPhoto],
    known: usize,
    [views_min, views_max]: [usize; 2],
    neighbors_max: usize,
) -> Vec<ViewSet> {
    let n = photos.len();
    let (views_max, neighbors_max) = (views_max.max(2), neighbors_max.max(1));
    let center = |i: usize| photos[i].camera.camera_to_world.center();
    let worth = worth(capture, photos);
    let usable: Vec<usize> =
        (0..n).filter(|&i| (0..n).any(|j| j != i && worth[i][j] > 0.0)).collect();
    let mut covered: Vec<bool> = (0..n).map(|i| i < known).collect();
    let mut sets = Vec::new();
    while let Some(seed) = next_seed(&usable, &covered, &worth) {
        let mut views = vec![seed];
        // Ties to what is there already, then as many new ones as fit.
        let known = usable.iter().copied().filter(|&i| covered[i]);
        let wanted = (views_max / SHARED_EVERY).max(1);
        for _ in 0..wanted {
            let Some(best) = best_of(known.clone(), &views, &worth) else { break };
            views.push(best);
        }
        let fresh = usable.iter().copied().filter(|&i| !covered[i]);
        while views.len() < views_max {
            let Some(best) = best_of(fresh.clone(), &views, &worth) else { break };
            views.push(best);
        }
        // A rest of one or two photos sees more with company.
        while views.len() < views_max.min(views_min.max(4)) {
            let Some(best) = best_of(usable.iter().copied(), &views, &worth) else { break };
            views.push(best);
        }
        // A network of a fixed number of views takes no fewer.
        while (2..views_min).contains(&views.len()) {
            let others = (0..n).filter(|i| !views.contains(i));
            let Some(near) = best_by(others, |i| -center(i).distance(center(seed))) else { break };
            views.push(near);
        }
        for &i in &views {
            covered[i] = true;
        }
        if views.len() > 1 {
            let neighbors = neighbors(&views, &worth, capture, neighbors_max);
            sets.push(ViewSet { views, neighbors });
        }
    }
    sets
}

/// How much photo j helps photo i and the reverse: mutual overlap, weighed by the angle between
/// their rays. Without any overlap at all, nearness.
fn worth(capture: &Capture, photos: &[PosedPhoto]) -> Vec<Vec<f64>> {
    let n = photos.len();
    let center = |i: usize| photos[i].camera.camera_to_world.center();
    let pair = |i: usize, j: usize| {
        let overlap = capture.overlap[i][j].min(capture.overlap[j][i]);
        if i == j || overlap < OVERLAP_MIN {
            return 0.0;
        }
        let angle = center(i).distance(center(j)) / capture.median_depth;
        let off = if angle < BEST_ANGLE {
            2.0 * (1.0 - angle / BEST_ANGLE)
        } else {
            (angle / BEST_ANGLE).ln()
        };
        overlap * (-0.5 * off * off).exp().max(0.05)
    };
    let table: Vec<Vec<f64>> = (0..n).map(|i| (0..n).map(|j| pair(i, j)).collect()).collect();
    if table.iter().flatten().any(|&v| v > 0.0) {
        return table;
    }
    let near = |i: usize, j: usize| {
        let d = center(i).distance(center(j));
        if i == j || d <= 0.0 { 0.0 } else { 1.0 / d }
    };
    (0..n).map(|i| (0..n).map(|j| near(i, j)).collect()).collect()
}

/// The uncovered photo that is best tied to the covered ones; at first the best tied of all.
fn next_seed(usable: &[usize], covered: &[bool], worth: &[Vec<f64>]) -> Option<usize> {
    let any = usable.iter().any(|&i| covered[i]);
    let tie = |i: usize| -> f64 {
        usable.iter().filter(|&&j| !any || covered[j]).map(|&j| worth[i][j]).sum()
    };
    best_by(usable.iter().copied().filter(|&i| !covered[i]), tie)
}

/// The candidate best tied to the views, if it is tied to any.
fn best_of(
    candidates: impl Iterator<Item = usize>,
    views: &[usize],
    worth: &[Vec<f64>],
) -> Option<usize> {
    let tie = |i: usize| views.iter().map(|&v| worth[i][v]).sum::<f64>();
    best_by(candidates.filter(|i| !views.contains(i)), tie).filter(|&i| tie(i) > 0.0)
}

/// The first of the largest.
fn best_by(items: impl Iterator<Item = usize>, key: impl Fn(usize) -> f64) -> Option<usize> {
    items.fold(None, |best: Option<usize>, i| match best {
        Some(b) if key(b) >= key(i) => Some(b),
        _ => Some(i),
    })
}

fn neighbors(
    views: &[usize],
    worth: &[Vec<f64>],
    capture: &Capture,
    neighbors_max: usize,
) -> Vec<Vec<usize>> {
    let count = (views.len() - 1).min(neighbors_max);
    let row = |at: usize| {
        let i = views[at];
        let mut others: Vec<usize> = (0..views.len()).filter(|&o| o != at).collect();
        others.sort_by(|&a, &b| {
            let key = |o: usize| (worth[i][views[o]], capture.overlap[i][views[o]]);
            let (ka, kb) = (key(a), key(b));
            kb.0.total_cmp(&ka.0).then(kb.1.total_cmp(&ka.1)).then(a.cmp(&b))
        });
        others.truncate(count);
        others
    };
    (0..views.len()).map(row).collect()
}
