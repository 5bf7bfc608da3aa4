//! Measures a capture before any network runs: depth ranges, overlap, wrong cameras.
//!
//! Neighbouring photos, reduced to some 20,000 pixels, are compared under the given cameras by a
//! plane sweep (`sweep`). Its confident matches give each photo its depth range and each pair its
//! overlap, in world units and with no scale assumed. How many matches there are tells whether the
//! cameras are right: on the real scenes of the test data neighbours agree on 20 to 90 % of their
//! matchable pixels, under wrong cameras or between strangers on less than 10 %. `diagnose` asks
//! the same question under the usual mistakes.
//!
//! Processor time, measured with AVX-512: 0.06 s for two photos, 0.9 s for 8, 1.6 s for 24; all of
//! it runs on every core that rayon has.

mod content;
mod depth;
mod diagnose;
mod gray;
mod pairs;
mod relative;
mod sets;
mod sweep;
mod warp;

use std::sync::atomic::AtomicBool;

use rayon::prelude::*;

use crate::{
    error::{Error, Result},
    scene::{Camera, Capture, PosedPhoto, Warning, WarningCode, unless_cancelled},
};
use diagnose::{name, warning};
use gray::GrayView;

pub use sets::{more_view_sets, view_sets};

/// Neighbours that each photo is compared with.
const NEIGHBORS: usize = 3;
/// Photos of a capture that each photo which joins it is measured with.
const OLD_PARTNERS: usize = 4;
/// Photos that one warning names.
const NAMED_MAX: usize = 4;
/// Of this many photos and more, one neighbour fewer.
const MANY_PHOTOS: usize = 32;

/// Measures a capture. It stops before the next comparison of two photos once `cancel` is true.
///
/// # Errors
/// `invalid_request` for fewer than two photos, cameras all at one place, cameras of which no two
/// see the same place, or photos that share nothing; the message names the photos and the figure.
/// `cancelled`.
pub fn analyse(photos: &[PosedPhoto], cancel: &AtomicBool) -> Result<Capture> {
    if photos.len() < 2 {
        return Err(Error::invalid(format!(
            "{} photo; a capture needs at least 2 to see depth",
            photos.len()
        )));
    }
    let view = |photo: &PosedPhoto| {
        unless_cancelled(cancel)?;
        Ok(GrayView::new(photo))
    };
    let views: Vec<GrayView> = photos.par_iter().map(view).collect::<Result<_>>()?;
    let neighbours = if views.len() < MANY_PHOTOS { NEIGHBORS } else { NEIGHBORS - 1 };
    let (found, agreement) = rayon::join(
        || pairs::searched(&views, neighbours, cancel),
        || diagnose::agreement(photos, &views, cancel),
    );
    let found = found?;
    let points = depth::pooled(&views, &found);
    let ranges = depth::ranges(&views, &points)?;
    let mut overlap = depth::overlap(&views, &points, &found);
    let mut warnings: Vec<Warning> = made_for_warning(photos).into_iter().collect();
    warnings.extend(same_picture(photos, &views)?);
    warnings.extend(diagnose::warnings(
        photos,
        &views,
        &found,
        &agreement?,
        &ranges,
        &mut overlap,
    )?);
    Ok(Capture { near_far: ranges.near_far, overlap, median_depth: ranges.median_depth, warnings })
}

/// Measures photos that join a capture: the first photos are those of `known`, which stays as it
/// was. Only the others are measured, with the photos that stand nearest to each, so that the time
/// does not grow with the capture.
///
/// # Errors
/// As [`analyse`], of these photos.
pub fn analyse_more(
    photos: &[PosedPhoto],
    known: &Capture,
    cancel: &AtomicBool,
) -> Result<Capture> {
    let (before, all) = (known.near_far.len(), photos.len());
    let cameras: Vec<Camera> = photos.iter().map(|photo| photo.camera).collect();
    let ranked = pairs::ranked(&cameras)?;
    let partners = |new: usize| {
        let old = ranked[new].iter().copied().filter(|&i| i < before).take(OLD_PARTNERS);
        old.chain([new])
    };
    let mut asked: Vec<usize> = (before..all).flat_map(partners).collect();
    asked.sort_unstable();
    asked.dedup();
    let some: Vec<PosedPhoto> = asked.iter().map(|&i| photos[i].clone()).collect();
    let found = analyse(&some, cancel)?;
    let mut capture = known.clone();
    capture.near_far.resize(all, [0.0; 2]);
    capture.overlap.iter_mut().for_each(|row| row.resize(all, 0.0));
    capture.overlap.resize(all, vec![0.0; all]);
    for (a, &i) in asked.iter().enumerate() {
        if i >= before {
            capture.near_far[i] = found.near_far[a];
        }
        for (b, &j) in asked.iter().enumerate().filter(|&(_, &j)| i.max(j) >= before) {
            capture.overlap[i][j] = found.overlap[a][b];
        }
    }
    capture.warnings.extend(found.warnings);
    Ok(capture)
}

/// How well photos agree under their cameras: the share of their matchable pixels that neighbours
/// find again in each other, 0..1, of a few pairs.
///
/// # Errors
/// `invalid_request` where all cameras stand at one place; `cancelled`.
pub fn agreement(photos: &[PosedPhoto], cancel: &AtomicBool) -> Result<f64> {
    let views: Vec<GrayView> = photos.par_iter().map(GrayView::new).collect();
    diagnose::agreement_as_given(&views, cancel)
}

/// Names photos that are one picture under different poses: at most one of the poses is right.
///
/// # Errors
/// `invalid_request` where all photos are one picture, which has no depth.
fn same_picture(photos: &[PosedPhoto], views: &[GrayView]) -> Result<Option<Warning>> {
    let same = |i: usize, j: usize| {
        let (a, b) = (&photos[i], &photos[j]);
        views[i].gray == views[j].gray
            && a.photo.rgb == b.photo.rgb
            && a.camera.camera_to_world != b.camera.camera_to_world
    };
    // A blank photo is the same as any other, and its matchable pixels tell.
    let all: Vec<usize> = (0..photos.len()).filter(|&i| !views[i].candidates.is_empty()).collect();
    let copies = |i: usize| all.iter().copied().filter(|&j| j == i || same(i, j)).collect();
    let groups = all.iter().map(|&i| copies(i));
    let largest = groups.max_by_key(|g: &Vec<usize>| (g.len(), photos.len() - g[0]));
    let Some(group) = largest.filter(|group| group.len() > 1) else { return Ok(None) };
    let names: Vec<String> = group.iter().take(NAMED_MAX).map(|&i| name(photos, i)).collect();
    let more = group.len().saturating_sub(NAMED_MAX);
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    let message = format!(
        "{}{more} are the same picture under different poses; at most one of these poses is right",
        names.join(", ")
    );
    if group.len() == photos.len() {
        return Err(Error::invalid(message));
    }
    Ok(Some(warning(WarningCode::SamePicture, group.len() as f64, message)))
}

/// Names the intrinsics that were scaled when the photos were read.
fn made_for_warning(photos: &[PosedPhoto]) -> Option<Warning> {
    let scaled = |i: usize| photos[i].intrinsics_made_for.map(|size| (i, size));
    let all: Vec<(usize, [u32; 2])> = (0..photos.len()).filter_map(scaled).collect();
    let &(i, [w, h]) = all.first()?;
    let k = photos[i].camera.intrinsics;
    let value = f64::from(k.width) / f64::from(w);
    let message = format!(
        "{}: the intrinsics were made for {w}x{h} px and were scaled by {value:.4} to the photo's \
         {}x{} px ({} of {} photos)",
        name(photos, i),
        k.width,
        k.height,
        all.len(),
        photos.len()
    );
    Some(warning(WarningCode::IntrinsicsScale, value, message))
}
