//! One photo against another: planes parallel to the first are swept from infinity to close by,
//! the second photo is warped onto it by each plane's homography, and 7x7 windows are compared by
//! zero-mean normalised cross-correlation (ZNCC).
//!
//! A plane at inverse depth w maps ray r of the first camera to K' (R r + w t) of the second.

use rayon::prelude::*;

use super::{
    gray::{GrayView, Grid},
    relative::Relative,
    warp::{Lines, Warp, find_best, find_rivals},
};

/// Least ZNCC of a match.
const SCORE_MIN: f32 = 0.80;
/// A rival peak at least [`RIVAL_PLANES`] away may have at most this share of the best score's
/// place between -1 and 1: (1 - best) / (1 - rival).
const RIVAL_RATIO_MAX: f32 = 0.75;
/// Planes within which scores belong to the same peak.
const RIVAL_PLANES: usize = 3;
/// Largest distance between a pixel and where its match leads back to, pixels.
const LEFT_RIGHT_PX: f64 = 1.5;
/// Planes that one thread takes at a time.
const PLANES_A_TASK: usize = 8;

/// A confident match of a candidate of the first photo.
#[derive(Clone, Copy, Debug)]
pub(super) struct Match {
    /// Index into the first view's candidates.
    pub(super) candidate: usize,
    /// Inverse depth in the first camera, 1 / world units; may be slightly negative.
    pub(super) w: f64,
    /// Change of inverse depth that moves the match by one pixel.
    pub(super) w_per_px: f64,
}

/// What one sweep of one direction found.
#[derive(Clone, Debug)]
pub(super) struct Sweep {
    /// Confident by score and distinctness, before the return check; sorted by candidate.
    pub(super) matches: Vec<Match>,
    /// Candidates that some plane brought inside the other photo.
    pub(super) inside: usize,
    /// Candidates whose best plane is the nearest one that was searched.
    pub(super) at_nearest: usize,
}

/// Compares `reference` with `source` over all planes, on one thread unless `split`.
pub(super) fn sweep(
    reference: &GrayView,
    source: &GrayView,
    relative: &Relative,
    split: bool,
) -> Sweep {
    let planes = relative.planes(reference, source);
    let count = reference.candidates.len();
    let volume = scores(reference, source, relative, &planes, split);
    let (best, best_plane) = find_best(&volume, count);
    let rival = find_rivals(&volume, &best_plane, RIVAL_PLANES as u32);
    let mut matches = Vec::new();
    let mut at_nearest = 0;
    let inside = best.iter().filter(|&&score| score > -1.0).count();
    for candidate in 0..count {
        let (score, plane) = (best[candidate], best_plane[candidate] as usize);
        // A peak at the last plane is no peak.
        if score >= SCORE_MIN && plane + 1 == planes.len() {
            at_nearest += 1;
        }
        if score < SCORE_MIN || plane == 0 || plane + 1 >= planes.len() {
            continue;
        }
        if 1.0 - score > RIVAL_RATIO_MAX * (1.0 - rival[candidate]) {
            continue;
        }
        let before = volume[(plane - 1) * count + candidate];
        let after = volume[(plane + 1) * count + candidate];
        let bend = before - 2.0 * score + after;
        let shift = if before > -1.0 && after > -1.0 && bend < -1e-6 {
            f64::from(0.5 * (before - after) / bend).clamp(-0.5, 0.5)
        } else {
            0.0
        };
        let gap = if shift < 0.0 {
            planes[plane] - planes[plane - 1]
        } else {
            planes[plane + 1] - planes[plane]
        };
        let w = planes[plane] + shift * gap;
        let at = reference.candidates[candidate];
        let ray = reference.ray(f64::from(at.x), f64::from(at.y));
        let Some((u, v)) = relative.pixel(ray, w) else { continue };
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
        let (px, py) = (
            (u.max(0.0) as usize).min(source.width - 1),
            (v.max(0.0) as usize).min(source.height - 1),
        );
        if !source.is_valid(px, py) {
            continue;
        }
        let ahead = relative.pixel(ray, w + gap).unwrap_or((u, v));
        let moved = (ahead.0 - u).hypot(ahead.1 - v).max(1e-6);
        matches.push(Match { candidate, w, w_per_px: gap / moved });
    }
    Sweep { matches, inside, at_nearest }
}

/// `[planes, candidates]` ZNCC; -1 where the window of a candidate leaves `source`.
fn scores(
    reference: &GrayView,
    source: &GrayView,
    relative: &Relative,
    planes: &[f64],
    split: bool,
) -> Vec<f32> {
    let count = reference.candidates.len();
    let mut volume = vec![-1.0_f32; planes.len() * count];
    let Some(warp) = Warp::new(reference, source, relative).filter(|_| count > 0) else {
        return volume;
    };
    let lines = || Lines::new(reference.width);
    let run = |lines: &mut Lines, (scores, planes): (&mut [f32], &[f64])| {
        for (scores, &w) in scores.chunks_exact_mut(count).zip(planes) {
            warp.plane(w, lines, scores);
        }
    };
    if split {
        let tasks = volume.par_chunks_mut(count * PLANES_A_TASK);
        tasks.zip(planes.par_chunks(PLANES_A_TASK)).for_each_init(lines, run);
    } else {
        run(&mut lines(), (&mut volume, planes));
    }
    volume
}

/// Keeps the matches that lead back to where they came from.
pub(super) fn consistent(
    reference: &GrayView,
    source: &GrayView,
    there: &Relative,
    back: &Relative,
    forward: &Sweep,
    backward: &Sweep,
) -> Vec<Match> {
    let found = backward.matches.iter().map(|m| {
        let at = source.candidates[m.candidate];
        (at.x, at.y, m.w)
    });
    let grid = Grid::new(source, found);
    let leads_back = |m: &&Match| {
        let at = reference.candidates[m.candidate];
        let (x, y) = (f64::from(at.x), f64::from(at.y));
        let Some((u, v)) = there.pixel(reference.ray(x, y), m.w) else { return false };
        // The depth found at that cell, seen along the exact ray of the match.
        let returned = grid.at(u, v).and_then(|w| back.pixel(source.ray(u - 0.5, v - 0.5), w));
        returned.is_some_and(|(bu, bv)| (bu - x - 0.5).hypot(bv - y - 0.5) <= LEFT_RIGHT_PX)
    };
    forward.matches.iter().filter(leads_back).copied().collect()
}
