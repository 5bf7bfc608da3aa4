//! From what was given to a solution.

use std::sync::atomic::AtomicBool;

use segsplat_core::{
    error::{Error, Result},
    scene::unless_cancelled,
};

use crate::{
    given::{PairMatches, PhotoKeypoints, SolveOptions, check},
    held, joints, judge,
    patch::Grey,
    report::{self, Dropped},
    sharpen,
    solution::{Evidence, Placing, Solution},
    solver, world,
};

/// Finds the cameras of photos.
///
/// `matches` has each pair of photos at most once, in any order; pairs that were tried and did not
/// match are given with few or no pairs of keypoints: they are evidence too. `greys` are the photos
/// themselves, or none: with them keypoints are moved to where pixels agree. `progress` gets shares
/// of the work, 0..1.
///
/// # Errors
/// `invalid_request` for numbers that are not finite or out of range, `limit_exceeded` for more
/// photos or keypoints than the options allow, `cancelled`. Photos that cannot be placed are no
/// error: all of them may be left out.
pub fn solve(
    photos: &[PhotoKeypoints],
    matches: &[PairMatches],
    greys: &[Grey],
    options: &SolveOptions,
    cancel: &AtomicBool,
    progress: &(dyn Fn(f64) + Sync),
) -> Result<Solution> {
    check(photos, matches, options)?;
    let sizes = || greys.iter().map(|grey| grey.size).eq(photos.iter().map(|photo| photo.size));
    if !greys.is_empty() && !sizes() {
        return Err(Error::invalid(format!(
            "greys: {} of other sizes or numbers than the {} photos",
            greys.len(),
            photos.len()
        )));
    }
    let survey = solver::survey(photos, matches, options);
    unless_cancelled(cancel)?;
    progress(0.05);
    let candidates = solver::candidates(&survey, cancel, progress)?;
    let mut candidates = candidates.into_iter();
    let Some(mut best) = candidates.next() else {
        let left_out =
            |photo| Placing::LeftOut(report::why_left_out(&survey, photo, &Dropped::default()));
        return Ok(Solution {
            photos: (0..photos.len()).map(left_out).collect(),
            points: Vec::new(),
            confidence: 0.0,
            evidence: Evidence::default(),
            warnings: vec!["no two photos show enough of the same things".to_owned()],
        });
    };
    let others: Vec<solver::Candidate> = candidates.collect();
    // As they were grown: what is finished explains more than what is not.
    let rivals = judge::rivals(&survey, &best, &others);
    solver::finish(&survey, &mut best, cancel);
    let (links, weak) = joints::drop_weak(&survey, &mut best, cancel);
    let few = held::drop_few(&survey, &mut best, cancel);
    let with_pixels = !greys.is_empty();
    let (seen, mut sharp) = match with_pixels {
        true => sharpen::sharpened(&survey, greys, &best, cancel),
        false => (survey.clone(), best.clone()),
    };
    let loose = held::drop_loose(&seen, &mut sharp, cancel);
    let loose: Vec<usize> = loose.into_iter().map(|(photo, _)| photo).collect();
    if !loose.is_empty() {
        joints::without(&survey, &mut best, &loose, cancel);
    }
    let dropped = Dropped { weak, few, loose };
    // What ends at the same cameras is no other solution.
    let is_other = |other: &solver::Candidate| {
        !with_pixels || judge::differ(&sharp, &sharpen::ended(&survey, greys, other, cancel))
    };
    let rival = judge::strongest(rivals, is_other);
    let evidence = judge::evidence(&survey, &best, &links, rival);
    let (survey, best) = (seen, sharp);
    let why_not = |photo| report::why_left_out(&survey, photo, &dropped);
    let (placings, points) = world::outcome(photos, &survey, &best, why_not)?;
    let confidence = judge::confidence(&evidence);
    let warnings = report::warnings(&survey, &best.grown, &placings, &evidence, confidence);
    progress(1.0);
    Ok(Solution { photos: placings, points, confidence, evidence, warnings })
}
