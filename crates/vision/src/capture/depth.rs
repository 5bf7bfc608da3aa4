//! Depth ranges and overlap from matches.

use glam::DVec3;

use super::{
    gray::{GrayView, Grid},
    pairs::{PairFound, baseline},
    relative::Relative,
};
use crate::error::{Error, Result};

/// Quantiles of the inverse depth that bound a view's range before the margin.
const QUANTILES: [f64; 2] = [0.01, 0.99];
/// Margin on both sides, in spans of inverse depth: what the network was trained with.
const MARGIN: f64 = 0.15;
/// Further margin on the near side of a view none of whose matchable pixels were matched, less for
/// a view that was matched in part: what only one photo sees is mostly what stands close.
const UNSEEN_MARGIN: f64 = 0.25;
/// A range is at least this share of its nearest inverse depth wide.
const SPAN_MIN: f64 = 0.05;
/// Farthest depth worth telling apart, in the largest baseline of the photos.
const FAR_BASELINES: f64 = 1_000.0;
/// A view with fewer points of its own takes those that its partners see in it.
const POINTS_MIN: usize = 40;
/// Range where no point is known at all, in the largest baseline.
const UNKNOWN_BASELINES: [f64; 2] = [1.0, 100.0];
/// Relative difference of inverse depth beyond which a point is hidden behind another.
const HIDDEN: f64 = 0.2;

/// A matched pixel of a view with its inverse depth.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    /// Column and row of the small picture.
    pub(super) x: u16,
    pub(super) y: u16,
    /// Inverse depth, at least 0.
    pub(super) w: f64,
    /// Change of inverse depth of one pixel in the view it was matched in.
    pub(super) w_per_px: f64,
}

/// Depth range of each view and the median depth of all.
#[derive(Clone, Debug)]
pub(super) struct Ranges {
    pub(super) near_far: Vec<[f64; 2]>,
    pub(super) median_depth: f64,
    /// Inverse depth that only a tenth of the points of all views exceeds.
    pub(super) near_tenth_w: f64,
}

/// The points of each view: the most precise match of each candidate over its pairs.
pub(super) fn pooled(views: &[GrayView], found: &[PairFound]) -> Vec<Vec<Point>> {
    views
        .iter()
        .enumerate()
        .map(|(i, view)| {
            let mut best: Vec<Option<Point>> = vec![None; view.candidates.len()];
            for (pair, side) in found.iter().filter_map(|p| p.side(i).map(|side| (p, side))) {
                for m in &pair.matches[side] {
                    let at = view.candidates[m.candidate];
                    let w_per_px = m.w_per_px;
                    let slot = &mut best[m.candidate];
                    if slot.is_none_or(|old| w_per_px < old.w_per_px) {
                        *slot = Some(Point { x: at.x, y: at.y, w: m.w.max(0.0), w_per_px });
                    }
                }
            }
            best.into_iter().flatten().collect()
        })
        .collect()
}

fn quantile(sorted: &[f64], q: f64) -> f64 {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..len")]
    let i = ((sorted.len() - 1) as f64 * q).round() as usize;
    sorted[i]
}

/// The range of each view from robust quantiles of its points, with margin.
pub(super) fn ranges(views: &[GrayView], points: &[Vec<Point>]) -> Result<Ranges> {
    let largest = views
        .iter()
        .flat_map(|a| views.iter().map(move |b| baseline(&a.camera, &b.camera)))
        .fold(0.0_f64, f64::max);
    if !(largest > 0.0 && largest.is_finite()) {
        return Err(Error::invalid(format!(
            "the largest baseline is {largest}; it must be over 0"
        )));
    }
    let farthest = 1.0 / (FAR_BASELINES * largest);
    let mut all: Vec<f64> = points.iter().flatten().map(|p| p.w).collect();
    all.sort_by(f64::total_cmp);
    let (median_w, near_tenth_w) = if all.is_empty() {
        let guess = (UNKNOWN_BASELINES[0] * UNKNOWN_BASELINES[1]).sqrt() * largest;
        (1.0 / guess, 1.0 / guess)
    } else {
        (quantile(&all, 0.5), quantile(&all, 0.9))
    };
    let near_far = (0..views.len())
        .map(|i| {
            let mut ws: Vec<f64> = points[i].iter().map(|p| p.w).collect();
            if ws.len() < POINTS_MIN {
                ws.extend(seen_by_others(views, points, i));
            }
            ws.sort_by(f64::total_cmp);
            if ws.len() < POINTS_MIN {
                return UNKNOWN_BASELINES.map(|b| b * largest);
            }
            let [lo, hi] = QUANTILES.map(|q| quantile(&ws, q));
            let hi = hi.max(4.0 * farthest);
            let span = (hi - lo).max(SPAN_MIN * hi);
            let candidates = views[i].candidates.len().max(1);
            let unseen = 1.0 - (points[i].len() as f64 / candidates as f64).min(1.0);
            let near_margin = MARGIN + UNSEEN_MARGIN * unseen;
            [1.0 / (hi + near_margin * span), 1.0 / (lo - MARGIN * span).max(farthest)]
        })
        .collect();
    Ok(Ranges { near_far, median_depth: 1.0 / median_w.max(farthest), near_tenth_w })
}

/// Inverse depths in view `i` of the points of all other views that fall into its picture.
fn seen_by_others<'a>(
    views: &'a [GrayView],
    points: &'a [Vec<Point>],
    i: usize,
) -> impl Iterator<Item = f64> + 'a {
    (0..views.len()).filter(move |&j| j != i).flat_map(move |j| {
        let relative = Relative::new(&views[j], &views[i]);
        points[j].iter().filter_map(move |p| {
            let (_, w) = landed(&views[j], &views[i], &relative, p)?;
            Some(w)
        })
    })
}

/// Pixel and inverse depth in `to` of a point of `from`; `None` outside the picture.
fn landed(
    from: &GrayView,
    to: &GrayView,
    relative: &Relative,
    p: &Point,
) -> Option<((usize, usize), f64)> {
    let ray: DVec3 = from.ray(f64::from(p.x), f64::from(p.y));
    let (u, v) = relative.pixel(ray, p.w)?;
    if !(u >= 0.0 && v >= 0.0 && u < to.width as f64 && v < to.height as f64) {
        return None;
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "checked above")]
    let pixel = (u as usize, v as usize);
    // Depth there is relative_depth / w, so inverse depth is w / relative_depth.
    Some((pixel, p.w / relative.relative_depth(ray, p.w)))
}

/// Share of each view's points that lie in each other view's picture and are not hidden there.
///
/// A view without points takes the agreement of the pairs it was compared in.
pub(super) fn overlap(
    views: &[GrayView],
    points: &[Vec<Point>],
    found: &[PairFound],
) -> Vec<Vec<f64>> {
    let surfaces: Vec<Surface> =
        views.iter().zip(points).map(|(view, points)| Surface::new(view, points)).collect();
    let share = |i: usize, j: usize| {
        if i == j {
            return 1.0;
        }
        if points[i].len() < POINTS_MIN {
            let pair = found.iter().find(|p| p.side(i).is_some() && p.side(j).is_some());
            return pair.map_or(0.0, |p| p.agreement[p.side(i).unwrap_or(0)]);
        }
        let relative = Relative::new(&views[i], &views[j]);
        let seen = points[i].iter().filter(|p| {
            landed(&views[i], &views[j], &relative, p)
                .is_some_and(|(pixel, w)| !surfaces[j].hides(pixel, w))
        });
        seen.count() as f64 / points[i].len() as f64
    };
    (0..views.len()).map(|i| (0..views.len()).map(|j| share(i, j)).collect()).collect()
}

/// The matched inverse depths of a view.
struct Surface {
    grid: Grid,
    slack: f64,
}

impl Surface {
    fn new(view: &GrayView, points: &[Point]) -> Self {
        let grid = Grid::new(view, points.iter().map(|p| (p.x, p.y, p.w)));
        Self { grid, slack: points.iter().map(|p| p.w_per_px).fold(0.0, f64::max) }
    }

    /// Whether all that is known around the pixel lies clearly before inverse depth `w`.
    fn hides(&self, (x, y): (usize, usize), w: f64) -> bool {
        let mut around = self.grid.around(x, y).peekable();
        around.peek().is_some() && around.all(|at| at > w * (1.0 + HIDDEN) + self.slack)
    }
}
