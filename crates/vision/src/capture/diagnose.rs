//! Which mistake the cameras of a capture have: the photos are compared again under the usual ones.
//!
//! A mistake is reported when the photos agree far better after its correction. The bounds below
//! were chosen on the real scenes of the test data, whose cameras are right, and on the same scenes
//! with wrong cameras.

use std::sync::atomic::AtomicBool;

use rayon::prelude::*;

use super::{
    content,
    depth::Ranges,
    gray::GrayView,
    pairs::{self, PairFound},
};
use crate::{
    error::{Error, Result},
    photo_label,
    scene::{Camera, CameraToWorld, Intrinsics, PosedPhoto, Warning, WarningCode},
};

/// Pairs that witness for or against a mistake.
const WITNESSES: usize = 4;
/// Pixels of the pictures in which mistakes are looked for: a tenth of the time of the others.
const AREA: f64 = 6_000.0;
/// A correction must agree on this share at least,
const ALTERNATIVE_MIN: f64 = 0.15;
/// on this many times what the given cameras agree on (a small motion says little of a focal
/// length, and half a turn keeps the lines that matches lie on, so there less must do),
const ALTERNATIVE_RATIO: f64 = 1.5;
const FOCAL_RATIO: f64 = 1.2;
/// and by this much more.
const ALTERNATIVE_GAIN: f64 = 0.08;
/// With a principal point that itself speaks of another resolution, this ratio is enough.
const IMPLIED_RATIO: f64 = 1.03;
/// Agreement under this may be chance: strangers were seen to reach 0.11.
const CHANCE: f64 = 0.12;
/// Cameras that agree on little are still right where they agree on this share at least
const DISTINCT_MIN: f64 = 0.02;
/// and on this many times the best that wrong cameras reach; strangers reached 1.0.
const DISTINCT_RATIO: f64 = 1.2;
/// Least share of corners found again, cameras aside, in photos of one thing: neighbours have 0.1
/// to 0.95, strangers 0 to 0.09, mostly 0.
const CONTENT_MIN: f64 = 0.06;
/// A photo among others that agrees with none of its partners on this share is not used.
const STRAY: f64 = 0.06;
/// Photos whose axes differ by more than this may well agree poorly.
const POOR_ANGLE_MAX: f64 = 25.0;
/// Principal point from the picture's centre, in sides.
const PRINCIPAL_OFF: f64 = 0.20;
/// Best overlap of a photo under which it is warned of.
const OVERLAP_MIN: f64 = 0.30;
/// Baseline over depth under which depth is a guess.
const BASELINE_MIN: f64 = 0.01;
/// Share of pixels whose best plane is the nearest searched.
const RANGE_HIT_MAX: f64 = 0.05;
/// Ratios of focal length that are tried.
const RATIOS: [f64; 8] = [0.25, 1.0 / 3.0, 0.5, 2.0 / 3.0, 1.5, 2.0, 3.0, 4.0];

/// A usual mistake, by the correction that undoes it.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Mistake {
    Axes,
    Inverted,
    InvertedAndAxes,
    /// Focal lengths times this, principal point kept.
    Focal(f64),
    /// All of K times this.
    Resolution(f64),
    /// The photos turned by this many quarters clockwise against their cameras.
    Turned(u8),
}

impl Mistake {
    /// The camera as it would be without the mistake.
    fn corrected(self, camera: &Camera) -> Result<Camera> {
        let flipped = |p: CameraToWorld| {
            CameraToWorld::from_opengl_row_major(&p.to_row_major(), "flipped pose")
        };
        let inverted = |p: CameraToWorld| {
            CameraToWorld::from_row_major(&p.viewmat().transpose().to_cols_array(), "inverse pose")
        };
        let mut camera = *camera;
        let (k, pose) = (&mut camera.intrinsics, camera.camera_to_world);
        match self {
            Self::Axes => camera.camera_to_world = flipped(pose)?,
            Self::Inverted => camera.camera_to_world = inverted(pose)?,
            Self::InvertedAndAxes => camera.camera_to_world = flipped(inverted(pose)?)?,
            Self::Focal(s) => (k.fx, k.fy) = (k.fx * s, k.fy * s),
            Self::Resolution(s) => {
                (k.fx, k.fy, k.cx, k.cy) = (k.fx * s, k.fy * s, k.cx * s, k.cy * s);
            }
            Self::Turned(quarters) => {
                for _ in 0..quarters {
                    camera = turned(&camera)?;
                }
            }
        }
        Ok(camera)
    }

    fn warning(self, photos: &[PosedPhoto], given: f64, corrected: f64) -> Warning {
        let figures = format!(
            "neighbouring photos agree on {:.0} % of their matchable pixels with it undone and on \
             {:.0} % as given",
            100.0 * corrected,
            100.0 * given
        );
        let (code, what, value) = match self {
            Self::Axes => (
                WarningCode::AxesSwapped,
                "the y and z axes of the cameras look swapped between OpenGL and OpenCV".to_owned(),
                corrected,
            ),
            Self::Inverted | Self::InvertedAndAxes => (
                WarningCode::PoseInverted,
                "the poses look like world-to-camera given for camera-to-world".to_owned(),
                corrected,
            ),
            Self::Focal(s) | Self::Resolution(s) => {
                let k = photos[0].camera.intrinsics;
                let side = |n: u32| f64::from(n) / s;
                let what = format!(
                    "the intrinsics look made for another resolution: for about {:.0}x{:.0} px, \
                     while {} is {}x{} px (times {s:.3} they fit)",
                    side(k.width),
                    side(k.height),
                    name(photos, 0),
                    k.width,
                    k.height
                );
                (WarningCode::IntrinsicsScale, what, s)
            }
            Self::Turned(quarters) => {
                let degrees = 90 * u32::from(quarters);
                let what = format!(
                    "the photos look turned by {degrees} degrees clockwise against their cameras: \
                     turn them back (their EXIF orientation may say the same), or find their \
                     cameras again"
                );
                (WarningCode::PhotosTurned, what, corrected)
            }
        };
        warning(code, value, format!("{what}; {figures}"))
    }
}

/// The camera of a photo that was turned by a quarter clockwise.
fn turned(camera: &Camera) -> Result<Camera> {
    let k = camera.intrinsics;
    // The x axis of the turned photo is the y axis of the other backwards, its y axis the x axis.
    let intrinsics = Intrinsics {
        fx: k.fy,
        fy: k.fx,
        cx: f64::from(k.height) - k.cy,
        cy: k.cx,
        width: k.height,
        height: k.width,
    };
    let m = camera.camera_to_world.to_row_major();
    let row = |r: usize| [-m[4 * r + 1], m[4 * r], m[4 * r + 2], m[4 * r + 3]];
    let rows = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
    let mut flat = [0.0; 16];
    flat.copy_from_slice(rows.as_flattened());
    let camera_to_world = CameraToWorld::from_row_major(&flat, "turned pose")?;
    Ok(Camera { intrinsics, camera_to_world })
}

/// What looks wrong. Photos that share nothing, and cameras that see nothing in common, are
/// refused.
pub(super) fn warnings(
    photos: &[PosedPhoto],
    views: &[GrayView],
    found: &[PairFound],
    answer: &Agreement,
    ranges: &Ranges,
    overlap: &mut [Vec<f64>],
) -> Result<Vec<Warning>> {
    if let Some((mistake, corrected)) = answer.mistake {
        let scaled = matches!(mistake, Mistake::Resolution(_));
        let point = if scaled { None } else { principal_point(photos) };
        let warning = mistake.warning(photos, answer.given, corrected);
        return Ok([warning].into_iter().chain(point).collect());
    }
    refuse_apart(photos, views, found)?;
    let distinct = answer.given >= DISTINCT_MIN && answer.given >= DISTINCT_RATIO * answer.rival;
    let found_wrong = if !distinct && found.iter().all(|p| p.best() < CHANCE) {
        vec![principal_point(photos), Some(nothing_agrees(photos, views, found)?)]
    } else {
        vec![
            principal_point(photos),
            poor_agreement(photos, found),
            strays(photos, found, overlap),
            low_overlap(photos, overlap),
            baselines(found, ranges),
            range_hit(photos, found),
        ]
    };
    Ok(found_wrong.into_iter().flatten().collect())
}

/// Refuses cameras of which no two see the same place: there is no depth, whatever photos show.
fn refuse_apart(photos: &[PosedPhoto], views: &[GrayView], found: &[PairFound]) -> Result<()> {
    let blank = |v: &usize| views[*v].candidates.is_empty();
    if found.iter().any(|pair| pair.inside > 0 || pair.views.iter().any(blank)) {
        return Ok(());
    }
    let Some(least) = found.iter().min_by(|a, b| a.angle.total_cmp(&b.angle)) else {
        return Ok(());
    };
    let [a, b] = least.views.map(|view| name(photos, view));
    Err(Error::invalid(format!(
        "under the given cameras no two photos see the same place; {a} and {b}, which are turned \
         least from each other, look {:.0} degrees apart: their poses or lenses must be wrong",
        least.angle
    )))
}

/// Scale of K that would bring the principal point to the centre, where x and y imply the same.
fn implied_scale(photos: &[PosedPhoto]) -> Option<f64> {
    let mut scales: Vec<f64> = Vec::with_capacity(photos.len());
    for photo in photos {
        let k = photo.camera.intrinsics;
        let (x, y) = (2.0 * k.cx / f64::from(k.width), 2.0 * k.cy / f64::from(k.height));
        if !(x > 0.0 && y > 0.0 && (x / y - 1.0).abs() < 0.15) {
            return None;
        }
        scales.push(2.0 / (x + y));
    }
    scales.sort_by(f64::total_cmp);
    let median = scales[scales.len() / 2];
    (!(0.8..=1.25).contains(&median)).then_some(median)
}

/// Pairs spread over the photos, each photo with its best partner.
fn witnesses(cameras: &[Camera]) -> Result<Vec<[usize; 2]>> {
    let ranked = pairs::ranked(cameras)?;
    let best = |(i, row): (usize, &Vec<usize>)| row.first().map(|&j| [i.min(j), i.max(j)]);
    let all = pairs::unique(ranked.iter().enumerate().filter_map(best));
    let count = all.len().min(WITNESSES);
    Ok((0..count).map(|i| all[i * all.len() / count]).collect())
}

fn mean_agreement(found: &[PairFound]) -> f64 {
    found.iter().map(PairFound::best).sum::<f64>() / found.len().max(1) as f64
}

/// How well the photos agree under the given cameras.
pub(super) fn agreement_as_given(views: &[GrayView], cancel: &AtomicBool) -> Result<f64> {
    let views: Vec<GrayView> = views.par_iter().map(|v| v.reduced(AREA)).collect();
    let cameras: Vec<Camera> = views.iter().map(|v| v.camera).collect();
    Ok(mean_agreement(&pairs::compare(&views, &witnesses(&cameras)?, cancel)?))
}

/// How well the photos agree under the given cameras and under the usual mistakes.
pub(super) struct Agreement {
    /// Agreement under the given cameras.
    given: f64,
    /// Best agreement under a correction that is not called for: what chance gives here.
    rival: f64,
    /// The correction that explains the photos far better, and its agreement.
    mistake: Option<(Mistake, f64)>,
}

/// Looks for a mistake that explains the photos far better than the given cameras.
pub(super) fn agreement(
    photos: &[PosedPhoto],
    views: &[GrayView],
    cancel: &AtomicBool,
) -> Result<Agreement> {
    let views: Vec<GrayView> = views.par_iter().map(|v| v.reduced(AREA)).collect();
    let cameras: Vec<Camera> = views.iter().map(|v| v.camera).collect();
    let asked = witnesses(&cameras)?;
    let given = mean_agreement(&pairs::compare(&views, &asked, cancel)?);
    let under = |mistake: Mistake| -> Result<(Mistake, f64)> {
        let corrected: Vec<Camera> =
            cameras.iter().map(|c| mistake.corrected(c)).collect::<Result<_>>()?;
        // Only inverting moves the cameras, and with them who is whose neighbour.
        let asked = match mistake {
            Mistake::Inverted | Mistake::InvertedAndAxes => witnesses(&corrected)?,
            _ => asked.clone(),
        };
        Ok((mistake, mean_agreement(&pairs::compare_as(&views, &corrected, &asked, cancel)?)))
    };
    if let Some(scale) = implied_scale(photos) {
        let (mistake, share) = under(Mistake::Resolution(scale))?;
        if share >= ALTERNATIVE_MIN && share >= IMPLIED_RATIO * given {
            return Ok(Agreement { given, rival: share, mistake: Some((mistake, share)) });
        }
    }
    let wins = |&(mistake, share): &(Mistake, f64)| {
        let ratio = if matches!(mistake, Mistake::Focal(_) | Mistake::Turned(_)) {
            FOCAL_RATIO
        } else {
            ALTERNATIVE_RATIO
        };
        share >= ALTERNATIVE_MIN && share >= ratio * given && share >= given + ALTERNATIVE_GAIN
    };
    let mut tried = vec![Mistake::Axes, Mistake::Inverted, Mistake::InvertedAndAxes];
    tried.extend(RATIOS.map(Mistake::Focal));
    // By a quarter only where a photo keeps its size.
    let is_square = |view: &GrayView| view.width == view.height;
    let quarters = if views.iter().all(is_square) { 1..=3 } else { 2..=2 };
    tried.extend(quarters.map(Mistake::Turned));
    let shares: Vec<(Mistake, f64)> = tried.into_par_iter().map(under).collect::<Result<_>>()?;
    // Photos on their side may agree by more than chance.
    let chance = shares.iter().filter(|(mistake, _)| !matches!(mistake, Mistake::Turned(_)));
    let rival = chance.map(|s| s.1).fold(0.0, f64::max);
    let mistake = shares.into_iter().filter(wins).max_by(|a, b| a.1.total_cmp(&b.1));
    Ok(Agreement { given, rival, mistake })
}

/// No pair agrees: strangers are refused, photos that do share something are warned of.
fn nothing_agrees(
    photos: &[PosedPhoto],
    views: &[GrayView],
    found: &[PairFound],
) -> Result<Warning> {
    let best = found
        .iter()
        .max_by(|a, b| a.best().total_cmp(&b.best()))
        .ok_or_else(|| Error::internal("a capture of two photos or more has a pair"))?;
    let [i, j] = best.views;
    let share = best.best();
    let common = found
        .iter()
        .take(2 * WITNESSES)
        .map(|p| content::common(&views[p.views[0]], &views[p.views[1]]))
        .fold(0.0, f64::max);
    if common < CONTENT_MIN {
        return Err(Error::invalid(format!(
            "the photos share nothing: the best pair, {} and {}, agrees on {:.1} % of its \
             matchable pixels, where {:.0} % is chance, and cameras aside {:.1} % of its corners \
             are found again, at least {:.0} % are needed",
            name(photos, i),
            name(photos, j),
            100.0 * share,
            100.0 * CHANCE,
            100.0 * common,
            100.0 * CONTENT_MIN
        )));
    }
    Ok(warning(
        WarningCode::PoorPoseAgreement,
        share,
        format!(
            "the photos show the same things but do not agree under the given cameras: at best \
             {:.1} % of the matchable pixels, {} and {}; the poses or intrinsics are wrong in a \
             way that no usual mistake explains",
            100.0 * share,
            name(photos, i),
            name(photos, j)
        ),
    ))
}

fn poor_agreement(photos: &[PosedPhoto], found: &[PairFound]) -> Option<Warning> {
    let poor = |p: &&PairFound| p.angle <= POOR_ANGLE_MAX && p.best() < CHANCE;
    let close = found.iter().filter(|p| p.angle <= POOR_ANGLE_MAX).count();
    let bad: Vec<&PairFound> = found.iter().filter(poor).collect();
    let worst = bad.iter().min_by(|a, b| a.best().total_cmp(&b.best()))?;
    if 2 * bad.len() < close {
        return None;
    }
    let share = worst.best();
    Some(warning(
        WarningCode::PoorPoseAgreement,
        share,
        format!(
            "{} of {close} pairs of photos that look the same way agree on less than {:.0} % of \
             their matchable pixels; worst are {} and {} with {:.1} %",
            bad.len(),
            100.0 * CHANCE,
            name(photos, worst.views[0]),
            name(photos, worst.views[1]),
            100.0 * share
        ),
    ))
}

/// Photos that agree with no other: their overlap is nothing, so that no view set takes them.
fn strays(photos: &[PosedPhoto], found: &[PairFound], overlap: &mut [Vec<f64>]) -> Option<Warning> {
    let best = |i: usize| pairs::best_of(i, found);
    let strays: Vec<usize> = (0..photos.len()).filter(|&i| best(i) < STRAY).collect();
    let &first = strays.first()?;
    for &i in &strays {
        for j in (0..photos.len()).filter(|&j| j != i) {
            overlap[i][j] = 0.0;
            overlap[j][i] = 0.0;
        }
    }
    Some(warning(
        WarningCode::PhotosUnused,
        strays.len() as f64,
        format!(
            "{} of {} photos agree with no other on {:.0} % of their matchable pixels or more and \
             are not used; the first is {} with {:.1} %",
            strays.len(),
            photos.len(),
            100.0 * STRAY,
            name(photos, first),
            100.0 * best(first)
        ),
    ))
}

fn principal_point(photos: &[PosedPhoto]) -> Option<Warning> {
    let off = |photo: &PosedPhoto| {
        let k = photo.camera.intrinsics;
        let x = (k.cx / f64::from(k.width) - 0.5).abs();
        let y = (k.cy / f64::from(k.height) - 0.5).abs();
        x.max(y)
    };
    let bad: Vec<usize> = (0..photos.len()).filter(|&i| off(&photos[i]) > PRINCIPAL_OFF).collect();
    let &i = bad.first()?;
    let k = photos[i].camera.intrinsics;
    Some(warning(
        WarningCode::PrincipalPointOff,
        off(&photos[i]),
        format!(
            "{}: the principal point ({:.1}, {:.1}) is {:.2} of a side from the centre of \
             {}x{} px, over {PRINCIPAL_OFF} ({} of {} photos)",
            name(photos, i),
            k.cx,
            k.cy,
            off(&photos[i]),
            k.width,
            k.height,
            bad.len(),
            photos.len()
        ),
    ))
}

fn low_overlap(photos: &[PosedPhoto], overlap: &[Vec<f64>]) -> Option<Warning> {
    let best = |i: usize| {
        (0..photos.len()).filter(|&j| j != i).map(|j| overlap[i][j]).fold(0.0_f64, f64::max)
    };
    let low: Vec<usize> =
        (0..photos.len()).filter(|&i| best(i) > 0.0 && best(i) < OVERLAP_MIN).collect();
    let &worst = low.iter().min_by(|&&a, &&b| best(a).total_cmp(&best(b)))?;
    Some(warning(
        WarningCode::LowOverlap,
        best(worst),
        format!(
            "{} of {} photos share less than {:.0} % of their matched pixels with any other; least \
             has {} with {:.0} %",
            low.len(),
            photos.len(),
            100.0 * OVERLAP_MIN,
            name(photos, worst),
            100.0 * best(worst)
        ),
    ))
}

fn baselines(found: &[PairFound], ranges: &Ranges) -> Option<Warning> {
    let longest =
        found.iter().filter(|p| p.best() >= STRAY).map(|p| p.baseline).fold(0.0, f64::max);
    let ratio = longest * ranges.near_tenth_w;
    let message = format!(
        "the longest baseline of neighbouring photos, {longest:.4}, is {:.2} % of the depth nine \
         tenths of the matches lie beyond; under {:.0} % it is a guess",
        100.0 * ratio,
        100.0 * BASELINE_MIN
    );
    (longest > 0.0 && ratio < BASELINE_MIN)
        .then(|| warning(WarningCode::SmallBaseline, ratio, message))
}

fn range_hit(photos: &[PosedPhoto], found: &[PairFound]) -> Option<Warning> {
    let sides = found.iter().flat_map(|p| [(p, 0), (p, 1)]);
    let (pair, side) = sides.max_by(|a, b| a.0.at_nearest[a.1].total_cmp(&b.0.at_nearest[b.1]))?;
    let share = pair.at_nearest[side];
    let message = format!(
        "{}: {:.1} % of its matchable pixels match {} best at the nearest depth searched, over \
         {:.0} %: something stands too close for this baseline",
        name(photos, pair.views[side]),
        100.0 * share,
        name(photos, pair.views[1 - side]),
        100.0 * RANGE_HIT_MAX
    );
    (share > RANGE_HIT_MAX).then(|| warning(WarningCode::DepthRangeHit, share, message))
}

/// A photo as messages call it.
pub(super) fn name(photos: &[PosedPhoto], i: usize) -> String {
    photo_label(i, &photos[i].file)
}

pub(super) fn warning(code: WarningCode, value: f64, message: String) -> Warning {
    Warning { code, message, value }
}
