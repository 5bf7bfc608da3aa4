//! What is wrong with a capture: the photos are compared again under the usual mistakes.
//!
//! A mistake is named when the photos agree far better under its correction than as given. The
//! bounds below were set on the real scenes of the test data, all of whose cameras are right, and
//! on the same scenes with their cameras spoilt.

use super::{
    agreement, content,
    depth::Ranges,
    gray::GrayView,
    name,
    pairs::{self, PairFound},
};
use crate::{
    error::{Error, Result},
    scene::{Camera, CameraToWorld, PosedPhoto, Warning, WarningCode},
};

/// Pairs that witness for or against a mistake.
const WITNESSES: usize = 4;
/// Photos that agree on this share are right as given; no mistake is looked for.
const CLEARLY_RIGHT: f64 = 0.60;
/// A correction must agree on this share at least,
const ALTERNATIVE_MIN: f64 = 0.15;
/// on this many times what the given cameras agree on,
const ALTERNATIVE_RATIO: f64 = 1.5;
/// and by this much more.
const ALTERNATIVE_GAIN: f64 = 0.08;
/// With a principal point that itself speaks of another resolution, this ratio is enough.
const IMPLIED_RATIO: f64 = 1.03;
/// Agreement under this is chance: strangers reach it.
const CHANCE: f64 = 0.06;
/// Least share of corners found again, cameras aside, in photos of one thing.
const CONTENT_MIN: f64 = 0.05;
/// Agreement under this, between photos that look the same way, is poor.
const POOR: f64 = 0.12;
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
/// Ratios of focal length that are tried first, and when those do not settle it.
const RATIOS: [f64; 2] = [0.5, 2.0];
const MORE_RATIOS: [f64; 6] = [0.25, 1.0 / 3.0, 2.0 / 3.0, 1.5, 3.0, 4.0];

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
        };
        Warning { code, message: format!("{what}; {figures}"), value }
    }
}

/// Adds what looks wrong to `warnings`; refuses photos that share nothing.
pub(super) fn warnings(
    photos: &[PosedPhoto],
    views: &[GrayView],
    found: &[PairFound],
    ranges: &Ranges,
    overlap: &mut [Vec<f64>],
    warnings: &mut Vec<Warning>,
) -> Result<()> {
    let implied = implied_scale(photos);
    if let Some((mistake, given, corrected)) = mistaken(views, found, implied)? {
        warnings.push(mistake.warning(photos, given, corrected));
        if !matches!(mistake, Mistake::Resolution(_)) {
            principal_point(photos, warnings);
        }
        return Ok(());
    }
    principal_point(photos, warnings);
    if found.iter().all(|p| agreement(p) < CHANCE) {
        return nothing_agrees(photos, views, found, warnings);
    }
    poor_agreement(photos, found, warnings);
    strays(photos, found, overlap, warnings);
    low_overlap(photos, overlap, warnings);
    baselines(found, ranges, warnings);
    range_hit(photos, found, warnings);
    Ok(())
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
    let mut all: Vec<[usize; 2]> = ranked
        .iter()
        .enumerate()
        .filter_map(|(i, row)| row.first().map(|&j| [i.min(j), i.max(j)]))
        .collect();
    all.sort_unstable();
    all.dedup();
    let count = all.len().min(WITNESSES);
    Ok((0..count).map(|i| all[i * all.len() / count]).collect())
}

fn mean_agreement(found: &[PairFound]) -> f64 {
    found.iter().map(agreement).sum::<f64>() / found.len().max(1) as f64
}

/// The mistake that explains the photos far better than the given cameras, with both agreements.
fn mistaken(
    views: &[GrayView],
    found: &[PairFound],
    implied: Option<f64>,
) -> Result<Option<(Mistake, f64, f64)>> {
    let cameras: Vec<Camera> = views.iter().map(|v| v.camera).collect();
    let asked = witnesses(&cameras)?;
    let answers: Vec<PairFound> =
        found.iter().filter(|p| asked.contains(&p.views)).cloned().collect();
    let given = mean_agreement(&answers);
    let under = |mistake: Mistake| -> Result<(Mistake, f64)> {
        let corrected: Vec<Camera> =
            cameras.iter().map(|c| mistake.corrected(c)).collect::<Result<_>>()?;
        // Only inverting moves the cameras, and with them who is whose neighbour.
        let asked = match mistake {
            Mistake::Inverted | Mistake::InvertedAndAxes => witnesses(&corrected)?,
            _ => asked.clone(),
        };
        Ok((mistake, mean_agreement(&pairs::compare_as(views, &corrected, &asked))))
    };
    if let Some(scale) = implied {
        let (mistake, share) = under(Mistake::Resolution(scale))?;
        if share >= ALTERNATIVE_MIN && share >= IMPLIED_RATIO * given {
            return Ok(Some((mistake, given, share)));
        }
    }
    if given >= CLEARLY_RIGHT {
        return Ok(None);
    }
    let wins = |share: f64| {
        share >= ALTERNATIVE_MIN
            && share >= ALTERNATIVE_RATIO * given
            && share >= given + ALTERNATIVE_GAIN
    };
    let best_of = |mistakes: &[Mistake]| -> Result<Option<(Mistake, f64)>> {
        let tried: Vec<(Mistake, f64)> =
            mistakes.iter().map(|&m| under(m)).collect::<Result<_>>()?;
        Ok(tried.into_iter().max_by(|a, b| a.1.total_cmp(&b.1)))
    };
    let mut usual = vec![Mistake::Axes, Mistake::Inverted, Mistake::InvertedAndAxes];
    usual.extend(RATIOS.map(Mistake::Focal));
    let mut best = best_of(&usual)?;
    let settled = best.is_some_and(|(m, share)| wins(share) && !matches!(m, Mistake::Focal(_)));
    if !settled && given < CLEARLY_RIGHT / 2.0 {
        let more = best_of(&MORE_RATIOS.map(Mistake::Focal))?;
        best = best.into_iter().chain(more).max_by(|a, b| a.1.total_cmp(&b.1));
    }
    Ok(best.filter(|&(_, share)| wins(share)).map(|(mistake, share)| (mistake, given, share)))
}

/// No pair agrees: strangers are refused, photos that do share something are warned of.
fn nothing_agrees(
    photos: &[PosedPhoto],
    views: &[GrayView],
    found: &[PairFound],
    warnings: &mut Vec<Warning>,
) -> Result<()> {
    let best = found
        .iter()
        .max_by(|a, b| agreement(a).total_cmp(&agreement(b)))
        .ok_or_else(|| Error::internal("a capture of two photos or more has a pair"))?;
    let [i, j] = best.views;
    let share = agreement(best);
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
    warnings.push(Warning {
        code: WarningCode::PoorPoseAgreement,
        message: format!(
            "the photos show the same things but do not agree under the given cameras: at best \
             {:.1} % of the matchable pixels, {} and {}; the poses or intrinsics are wrong in a way \
             that no usual mistake explains",
            100.0 * share,
            name(photos, i),
            name(photos, j)
        ),
        value: share,
    });
    Ok(())
}

fn poor_agreement(photos: &[PosedPhoto], found: &[PairFound], warnings: &mut Vec<Warning>) {
    let poor = |p: &&PairFound| p.angle <= POOR_ANGLE_MAX && agreement(p) < POOR;
    let close = found.iter().filter(|p| p.angle <= POOR_ANGLE_MAX).count();
    let bad: Vec<&PairFound> = found.iter().filter(poor).collect();
    let Some(worst) = bad.iter().min_by(|a, b| agreement(a).total_cmp(&agreement(b))) else {
        return;
    };
    if 2 * bad.len() < close {
        return;
    }
    let share = agreement(worst);
    warnings.push(Warning {
        code: WarningCode::PoorPoseAgreement,
        message: format!(
            "{} of {close} pairs of photos that look the same way agree on less than {:.0} % of \
             their matchable pixels; worst are {} and {} with {:.1} %",
            bad.len(),
            100.0 * POOR,
            name(photos, worst.views[0]),
            name(photos, worst.views[1]),
            100.0 * share
        ),
        value: share,
    });
}

/// Photos that agree with no other: their overlap is nothing, so that no view set takes them.
fn strays(
    photos: &[PosedPhoto],
    found: &[PairFound],
    overlap: &mut [Vec<f64>],
    warnings: &mut Vec<Warning>,
) {
    let best = |i: usize| {
        found.iter().filter(|p| p.side(i).is_some()).map(agreement).fold(0.0_f64, f64::max)
    };
    let strays: Vec<usize> = (0..photos.len()).filter(|&i| best(i) < CHANCE).collect();
    let Some(&first) = strays.first() else { return };
    for &i in &strays {
        for j in (0..photos.len()).filter(|&j| j != i) {
            overlap[i][j] = 0.0;
            overlap[j][i] = 0.0;
        }
    }
    warnings.push(Warning {
        code: WarningCode::PhotosUnused,
        message: format!(
            "{} of {} photos agree with no other on {:.0} % of their matchable pixels or more and \
             are not used; the first is {} with {:.1} %",
            strays.len(),
            photos.len(),
            100.0 * CHANCE,
            name(photos, first),
            100.0 * best(first)
        ),
        value: strays.len() as f64,
    });
}

fn principal_point(photos: &[PosedPhoto], warnings: &mut Vec<Warning>) {
    let off = |photo: &PosedPhoto| {
        let k = photo.camera.intrinsics;
        let x = (k.cx / f64::from(k.width) - 0.5).abs();
        let y = (k.cy / f64::from(k.height) - 0.5).abs();
        x.max(y)
    };
    let bad: Vec<usize> = (0..photos.len()).filter(|&i| off(&photos[i]) > PRINCIPAL_OFF).collect();
    let Some(&i) = bad.first() else { return };
    let k = photos[i].camera.intrinsics;
    warnings.push(Warning {
        code: WarningCode::PrincipalPointOff,
        message: format!(
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
        value: off(&photos[i]),
    });
}

fn low_overlap(photos: &[PosedPhoto], overlap: &[Vec<f64>], warnings: &mut Vec<Warning>) {
    let best = |i: usize| {
        (0..photos.len()).filter(|&j| j != i).map(|j| overlap[i][j]).fold(0.0_f64, f64::max)
    };
    let low: Vec<usize> =
        (0..photos.len()).filter(|&i| best(i) > 0.0 && best(i) < OVERLAP_MIN).collect();
    let Some(&worst) = low.iter().min_by(|&&a, &&b| best(a).total_cmp(&best(b))) else { return };
    warnings.push(Warning {
        code: WarningCode::LowOverlap,
        message: format!(
            "{} of {} photos share less than {:.0} % of their matched pixels with any other; least \
             has {} with {:.0} %",
            low.len(),
            photos.len(),
            100.0 * OVERLAP_MIN,
            name(photos, worst),
            100.0 * best(worst)
        ),
        value: best(worst),
    });
}

fn baselines(found: &[PairFound], ranges: &Ranges, warnings: &mut Vec<Warning>) {
    let longest =
        found.iter().filter(|p| agreement(p) >= CHANCE).map(|p| p.baseline).fold(0.0, f64::max);
    let ratio = longest * ranges.near_tenth_w;
    if longest > 0.0 && ratio < BASELINE_MIN {
        warnings.push(Warning {
            code: WarningCode::SmallBaseline,
            message: format!(
                "the longest baseline of neighbouring photos, {longest:.4}, is {:.2} % of the depth \
                 that nine tenths of the matched pixels lie beyond; under {:.0} % depth is a guess",
                100.0 * ratio,
                100.0 * BASELINE_MIN
            ),
            value: ratio,
        });
    }
}

fn range_hit(photos: &[PosedPhoto], found: &[PairFound], warnings: &mut Vec<Warning>) {
    let worst = found
        .iter()
        .flat_map(|p| [(p, 0), (p, 1)])
        .max_by(|a, b| a.0.at_nearest[a.1].total_cmp(&b.0.at_nearest[b.1]));
    let Some((pair, side)) = worst else { return };
    let share = pair.at_nearest[side];
    if share > RANGE_HIT_MAX {
        warnings.push(Warning {
            code: WarningCode::DepthRangeHit,
            message: format!(
                "{}: {:.1} % of its matchable pixels match {} best at the nearest depth searched, \
                 over {:.0} %: something stands too close for this baseline",
                name(photos, pair.views[side]),
                100.0 * share,
                name(photos, pair.views[1 - side]),
                100.0 * RANGE_HIT_MAX
            ),
            value: share,
        });
    }
}
