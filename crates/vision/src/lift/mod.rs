//! From each photo's Gaussians to one scene in the world. Useless and repeated ones are dropped.
//!
//! In: [`ViewGaussians`] (a rigid motion away from the world), one for each photo and set. Out:
//! checked [`Gaussians`] relative to the mean of the camera centres, and how many were dropped for
//! which reason. Nothing is dropped uncounted.

mod backdrop;
mod fuse;
mod sh;
mod thin;

pub use backdrop::backdrop;

use std::sync::atomic::AtomicBool;

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use crate::{
    error::{Error, Result},
    lift::{
        fuse::{Fate, fuse},
        sh::ShRotation,
    },
    point,
    scene::{
        Camera, DropCount, Gaussians, Intrinsics, RawGaussians, SourcePixel, ViewGaussians,
        unless_cancelled,
    },
};

pub use fuse::FuseOptions;
pub use thin::ThinOptions;

/// How far beyond the searched depths a Gaussian may lie: less than half of the nearest or more
/// than twice the farthest was not measured.
const DEPTH_SLACK: f64 = 2.0;
/// How far beyond its own picture a Gaussian may lie, as a share of the picture's side.
const FRAME_SLACK: f64 = 0.1;

/// A lifted scene.
#[derive(Clone, Debug)]
pub struct Lifted {
    /// The Gaussians, world frame.
    pub gaussians: Gaussians,
    /// What was dropped or clamped, by reason; reasons that never happened are left out.
    pub dropped: Vec<DropCount>,
    /// Lens of the network's picture of each photo, which `SourcePixel` counts pixels of.
    pub lenses: Vec<Option<Intrinsics>>,
    /// Median depth of the kept Gaussians from the cameras that made them, world units.
    pub median_depth: f64,
}

/// Lifts, fuses and thins. `cameras` are all cameras of the scene; their mean centre is the origin.
///
/// # Errors
/// `internal` when arrays disagree in length or views in SH degree; `cancelled` once `cancel` is
/// true, which is read before each view.
pub fn lift(
    views: Vec<ViewGaussians>,
    cameras: &[Camera],
    fusing: &FuseOptions,
    thinning: Option<&ThinOptions>,
    cancel: &AtomicBool,
) -> Result<Lifted> {
    let degree = views.first().map_or(0, |view| view.sh_degree);
    for view in &views {
        check_lengths(view, degree)?;
    }
    let mut counts = Counts::default();
    let mut views = best_of_each_photo(views, &mut counts);
    let mut candidate = Vec::with_capacity(views.len());
    for view in &views {
        unless_cancelled(cancel)?;
        candidate.push(candidates(view, &mut counts));
    }
    let mut fates = fuse(&views, &candidate, fusing, cancel)?;
    if let Some(thinning) = thinning {
        views.par_iter_mut().zip(&mut fates).try_for_each(|(view, fates)| {
            unless_cancelled(cancel)?;
            thin::thin(view, fates, thinning);
            Ok::<_, Error>(())
        })?;
    }
    for fate in fates.iter().flatten() {
        match fate {
            Fate::Duplicate => counts.add("duplicate", 1),
            Fate::Merged => counts.add("merged", 1),
            Fate::Keep | Fate::Absent => {}
        }
    }
    let mut lenses = vec![None; cameras.len()];
    for view in &views {
        if let Some(lens) = lenses.get_mut(usize::from(view.photo)) {
            *lens = Some(view.camera.intrinsics);
        }
    }
    let origin = center_of(cameras);
    let mut raw = RawGaussians { origin, sh_degree: degree, ..RawGaussians::default() };
    let mut depths = Vec::new();
    for (view, fate) in views.iter().zip(&fates) {
        unless_cancelled(cancel)?;
        append(&mut raw, view, fate, origin, &mut depths);
    }
    let (gaussians, report) = Gaussians::sanitize(raw)?;
    for (reason, count) in report.counts() {
        counts.add(reason, count);
    }
    Ok(Lifted { gaussians, dropped: counts.0, lenses, median_depth: median(depths) })
}

/// Counts by reason, in the order the reasons first came.
#[derive(Debug, Default)]
struct Counts(Vec<DropCount>);

impl Counts {
    fn add(&mut self, reason: &str, count: u64) {
        if count == 0 {
            return;
        }
        match self.0.iter_mut().find(|entry| entry.reason == reason) {
            Some(entry) => entry.count += count,
            None => self.0.push(DropCount { reason: reason.to_owned(), count }),
        }
    }
}

fn check_lengths(view: &ViewGaussians, degree: u8) -> Result<()> {
    let n = view.camera.intrinsics.width as usize * view.camera.intrinsics.height as usize;
    let k = (usize::from(degree) + 1).pow(2);
    let lengths = [
        ("means", view.means.len(), n),
        ("scales", view.scales.len(), n),
        ("quats", view.quats.len(), n),
        ("opacities", view.opacities.len(), n),
        ("sh", view.sh.len(), n * k),
        ("confidence", view.confidence.len(), n),
        ("valid", view.valid.as_ref().map_or(n, Vec::len), n),
    ];
    match lengths.iter().find(|(_, got, want)| got != want) {
        Some((name, got, want)) => {
            Err(Error::internal(format!("lift: {name} has {got} rows, not {want}")))
        }
        None if view.sh_degree != degree => Err(Error::internal(format!(
            "lift: SH degrees {} and {degree} in one scene",
            view.sh_degree
        ))),
        None => Ok(()),
    }
}

/// A photo that went through the network in several sets is kept from the set that was surest.
fn best_of_each_photo(mut views: Vec<ViewGaussians>, counts: &mut Counts) -> Vec<ViewGaussians> {
    let mut kept: Vec<(f64, ViewGaussians)> = Vec::with_capacity(views.len());
    for view in views.drain(..) {
        let score = fuse::sum_of_confidence(&view);
        match kept.iter_mut().find(|(_, other)| other.photo == view.photo) {
            None => kept.push((score, view)),
            Some(entry) => {
                counts.add("repeated_photo", view.len() as u64);
                if score > entry.0 {
                    *entry = (score, view);
                }
            }
        }
    }
    kept.sort_by_key(|(_, view)| view.photo);
    kept.into_iter().map(|(_, view)| view).collect()
}

/// Which Gaussians of a view can count at all.
fn candidates(view: &ViewGaussians, counts: &mut Counts) -> Vec<bool> {
    let lens = &view.camera.intrinsics;
    let (w, h) = (f64::from(lens.width), f64::from(lens.height));
    let to_camera = view.camera.camera_to_world.viewmat() * view.frame_to_world.matrix();
    let [near, far] = view.near_far;
    let (mut no_source, mut transparent, mut out_of_reach) = (0, 0, 0);
    let kept = (0..view.len())
        .map(|i| {
            if view.valid.as_ref().is_some_and(|valid| !valid[i]) {
                no_source += 1;
                return false;
            }
            if view.opacities[i] < Gaussians::OPACITY_MIN {
                transparent += 1;
                return false;
            }
            let mean = point(view.means[i]);
            if !mean.is_finite() {
                return true; // counted as not finite by the last check
            }
            let seen = to_camera.transform_point3(mean);
            let (x, y) = lens.project(seen);
            let reached = seen.z >= near / DEPTH_SLACK
                && seen.z <= far * DEPTH_SLACK
                && (-FRAME_SLACK * w..=(1.0 + FRAME_SLACK) * w).contains(&x)
                && (-FRAME_SLACK * h..=(1.0 + FRAME_SLACK) * h).contains(&y);
            out_of_reach += u64::from(!reached);
            reached
        })
        .collect();
    counts.add("no_source_pixel", no_source);
    counts.add("opacity_below_1_255", transparent);
    counts.add("out_of_reach", out_of_reach);
    kept
}

/// Moves the kept Gaussians of a view to the world and appends them.
#[expect(clippy::cast_possible_truncation, reason = "scenes are f32 relative to an f64 origin")]
fn append(
    raw: &mut RawGaussians,
    view: &ViewGaussians,
    fate: &[Fate],
    origin: DVec3,
    depths: &mut Vec<f64>,
) {
    let rotation: DMat3 = view.frame_to_world.rotation();
    let turn = DQuat::from_mat3(&rotation);
    let shift = view.frame_to_world.center() - origin;
    let sh_rotation = ShRotation::new(rotation, view.sh_degree);
    let sh_count = (usize::from(view.sh_degree) + 1).pow(2);
    let (camera, axis) = (view.camera.camera_to_world.center(), view.camera.camera_to_world.axis());
    let kept: Vec<usize> = (0..view.len()).filter(|&i| fate[i] == Fate::Keep).collect();
    let width = view.camera.intrinsics.width as usize;
    let moved: Vec<([f32; 3], [f32; 4], f64)> = kept
        .par_iter()
        .map(|&i| {
            let mean = rotation * point(view.means[i]) + shift;
            let [w, x, y, z] = view.quats[i].map(f64::from);
            let quat = turn * DQuat::from_xyzw(x, y, z, w);
            let quat = [quat.w as f32, quat.x as f32, quat.y as f32, quat.z as f32];
            ((mean.as_vec3()).to_array(), quat, (mean + origin - camera).dot(axis))
        })
        .collect();
    for (&i, (mean, quat, depth)) in kept.iter().zip(moved) {
        raw.means.push(mean);
        raw.quats.push(quat);
        raw.scales.push(view.scales[i]);
        raw.opacities.push(view.opacities[i]);
        let mut coefficients = view.sh[i * sh_count..(i + 1) * sh_count].to_vec();
        sh_rotation.apply(&mut coefficients);
        raw.sh.extend(coefficients);
        raw.semantic_index.push(0);
        raw.source.push(SourcePixel {
            view: view.photo,
            x: (i % width) as u16,
            y: (i / width) as u16,
        });
        if depth.is_finite() {
            depths.push(depth);
        }
    }
}

fn center_of(cameras: &[Camera]) -> DVec3 {
    let sum: DVec3 = cameras.iter().map(|camera| camera.camera_to_world.center()).sum();
    if cameras.is_empty() { sum } else { sum / cameras.len() as f64 }
}

/// Median, 0 of nothing.
fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}
