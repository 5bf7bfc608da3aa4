//! Which pairs of photos are compared, and the comparison of a pair in both directions.

use std::sync::atomic::AtomicBool;

use rayon::prelude::*;

use super::{
    gray::{GrayView, Grid},
    relative::Relative,
    sweep::{Match, Sweep, consistent, sweep},
};
use crate::{
    error::{Error, Result},
    scene::{Camera, unless_cancelled},
};

/// Baselines under this share of the largest give no depth.
const SAME_PLACE: f64 = 1e-6;
/// Degrees between viewing axes that weigh as much as a baseline e times the usual.
const ANGLE_SCALE: f64 = 15.0;

/// A view whose best pair agrees on less looks for other partners.
const WEAK: f64 = 0.15;

/// Two photos compared with each other.
#[derive(Clone, Debug)]
pub(super) struct PairFound {
    /// The two views, lower index first.
    pub(super) views: [usize; 2],
    /// Matches of the first view in the second, and the reverse; supported by their neighbours.
    pub(super) matches: [Vec<Match>; 2],
    /// Matched share of the candidates that could lie in the other photo, 0..1, each direction.
    pub(super) agreement: [f64; 2],
    /// Share of the matched candidates whose best plane was the nearest one, each direction.
    pub(super) at_nearest: [f64; 2],
    /// Candidates of either photo that could lie in the other.
    pub(super) inside: usize,
    /// Distance between the cameras.
    pub(super) baseline: f64,
    /// Angle between the viewing axes, degrees.
    pub(super) angle: f64,
}

impl PairFound {
    /// The better of the two directions' agreement.
    pub(super) fn best(&self) -> f64 {
        self.agreement[0].max(self.agreement[1])
    }

    /// Position of `view` in the pair.
    pub(super) fn side(&self, view: usize) -> Option<usize> {
        self.views.iter().position(|&v| v == view)
    }
}

/// Distance between two cameras.
pub(super) fn baseline(a: &Camera, b: &Camera) -> f64 {
    a.camera_to_world.center().distance(b.camera_to_world.center())
}

/// Angle between the viewing axes of two cameras, degrees.
fn angle(a: &Camera, b: &Camera) -> f64 {
    let (a, b) = (a.camera_to_world.axis(), b.camera_to_world.axis());
    a.dot(b).clamp(-1.0, 1.0).acos().to_degrees()
}

/// For each camera its most promising partners, best first: similar direction and a baseline near
/// the usual distance of neighbours, since the depth is not known yet.
pub(super) fn ranked(cameras: &[Camera]) -> Result<Vec<Vec<usize>>> {
    let n = cameras.len();
    let distances: Vec<Vec<f64>> =
        cameras.iter().map(|a| cameras.iter().map(|b| baseline(a, b)).collect()).collect();
    let largest = distances.iter().flatten().copied().fold(0.0, f64::max);
    let usable = |d: f64| d > SAME_PLACE * largest && d > 0.0;
    let mut nearest: Vec<f64> = distances
        .iter()
        .map(|row| row.iter().copied().filter(|&d| usable(d)).fold(f64::INFINITY, f64::min))
        .filter(|d| d.is_finite())
        .collect();
    if nearest.is_empty() {
        return Err(Error::invalid(format!(
            "all {n} cameras stand at one place; depth needs a baseline over 0"
        )));
    }
    nearest.sort_by(f64::total_cmp);
    let usual = nearest[nearest.len() / 2];
    Ok((0..n)
        .map(|i| {
            let mut cost: Vec<(f64, usize)> = (0..n)
                .filter(|&j| j != i && usable(distances[i][j]))
                .map(|j| {
                    let stretch = (distances[i][j] / usual).ln();
                    (angle(&cameras[i], &cameras[j]) / ANGLE_SCALE + stretch.abs(), j)
                })
                .collect();
            cost.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            cost.into_iter().map(|(_, j)| j).collect()
        })
        .collect())
}

/// Compares each view with its `count` most promising partners, each pair once; the few views that
/// agree with none of these are given a second choice.
pub(super) fn searched(
    views: &[GrayView],
    count: usize,
    cancel: &AtomicBool,
) -> Result<Vec<PairFound>> {
    let cameras: Vec<Camera> = views.iter().map(|v| v.camera).collect();
    let ranked = ranked(&cameras)?;
    let first = unique((0..views.len()).flat_map(|i| tied(i, ranked[i].iter().take(count))));
    let mut found = compare(views, &first, cancel)?;
    let weak: Vec<usize> = (0..views.len()).filter(|&i| best_of(i, &found) < WEAK).collect();
    if !weak.is_empty() && 3 * weak.len() <= views.len() {
        let more = weak.iter().flat_map(|&i| tied(i, ranked[i].iter().skip(count).take(2 * count)));
        let mut second = unique(more);
        second.retain(|pair| first.binary_search(pair).is_err());
        found.extend(compare(views, &second, cancel)?);
    }
    Ok(found)
}

fn tied<'a>(
    i: usize,
    partners: impl Iterator<Item = &'a usize> + 'a,
) -> impl Iterator<Item = [usize; 2]> + 'a {
    partners.map(move |&j| [i.min(j), i.max(j)])
}

/// Best agreement of a view with any other.
pub(super) fn best_of(view: usize, found: &[PairFound]) -> f64 {
    found.iter().filter(|p| p.side(view).is_some()).map(PairFound::best).fold(0.0, f64::max)
}

/// The pairs sorted, each once.
pub(super) fn unique(pairs: impl Iterator<Item = [usize; 2]>) -> Vec<[usize; 2]> {
    let mut pairs: Vec<[usize; 2]> = pairs.collect();
    pairs.sort_unstable();
    pairs.dedup();
    pairs
}

/// Compares each pair in both directions.
pub(super) fn compare(
    views: &[GrayView],
    pairs: &[[usize; 2]],
    cancel: &AtomicBool,
) -> Result<Vec<PairFound>> {
    // Few sweeps are split over the threads: a thread that waits for parts may begin another sweep,
    // and each sweep takes megabytes.
    let split = pairs.len() < rayon::current_num_threads();
    let one_way = |i: usize, j: usize| {
        unless_cancelled(cancel)?;
        let there = Relative::new(&views[i], &views[j]);
        Ok::<_, Error>((sweep(&views[i], &views[j], &there, split), there))
    };
    let both_ways = |&[i, j]: &[usize; 2]| {
        let (forward, backward) = rayon::join(|| one_way(i, j), || one_way(j, i));
        Ok(joined([i, j], [&views[i], &views[j]], &[forward?, backward?]))
    };
    pairs.par_iter().map(both_ways).collect()
}

/// What the sweeps of a pair, there and back, say together.
fn joined(
    indices: [usize; 2],
    [a, b]: [&GrayView; 2],
    [(forward, there), (backward, back)]: &[(Sweep, Relative); 2],
) -> PairFound {
    let first = consistent(a, b, there, back, forward, backward);
    let second = consistent(b, a, back, there, backward, forward);
    let matches = [supported(a, &first), supported(b, &second)];
    let sweeps = [forward, backward];
    let share = |count: usize, of: usize| count as f64 / of.max(1) as f64;
    PairFound {
        views: indices,
        agreement: [0, 1].map(|s| share(matches[s].len(), sweeps[s].inside)),
        at_nearest: [0, 1].map(|s| share(sweeps[s].at_nearest, sweeps[s].inside)),
        inside: forward.inside + backward.inside,
        matches,
        baseline: baseline(&a.camera, &b.camera),
        angle: angle(&a.camera, &b.camera),
    }
}

/// Compares each pair with other cameras in place of the views' own.
pub(super) fn compare_as(
    views: &[GrayView],
    cameras: &[Camera],
    pairs: &[[usize; 2]],
    cancel: &AtomicBool,
) -> Result<Vec<PairFound>> {
    let view = |i: usize| GrayView { camera: cameras[i], ..views[i].clone() };
    let changed: Vec<GrayView> = (0..views.len()).map(view).collect();
    compare(&changed, pairs, cancel)
}

/// Keeps the matches that at least two others nearby agree with: surfaces are in one piece,
/// chance is not.
fn supported(view: &GrayView, matches: &[Match]) -> Vec<Match> {
    const NEEDED: usize = 2;
    const PIXELS: f64 = 2.0;
    let at = |m: &Match| view.candidates[m.candidate];
    let grid = Grid::new(view, matches.iter().map(|m| (at(m).x, at(m).y, m.w)));
    let enough = |m: &&Match| {
        let around = grid.around(at(m).x.into(), at(m).y.into());
        let agreeing = around.filter(|w| (w - m.w).abs() <= PIXELS * m.w_per_px).count();
        // The match itself agrees with itself.
        agreeing > NEEDED
    };
    matches.iter().filter(enough).copied().collect()
}
