//! From each photo's Gaussians to one scene in the world. Useless and repeated ones are dropped.
//!
//! In: [`ViewGaussians`] (a rigid motion away from the world), one for each photo and set. Out:
//! checked [`Gaussians`] relative to the mean of the camera centres, and how many were dropped for
//! which reason. Nothing is dropped uncounted.

mod backdrop;
mod free_space;
mod fuse;
mod layers;
mod surface;
mod thin;
mod union;

pub use backdrop::backdrop;

use std::sync::atomic::AtomicBool;

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use crate::{
    error::{Error, Result},
    lift::{
        fuse::fuse,
        surface::{Fate, PIXELS_A_TASK, median, sum_of_confidence},
        union::unite,
    },
    point,
    scene::{
        Camera, DropCount, Gaussians, Intrinsics, RawGaussians, ShRotation, SourcePixel,
        ViewGaussians, unless_cancelled,
    },
};

pub use free_space::FreeSpace;
pub use fuse::FuseOptions;
pub use thin::ThinOptions;
pub use union::UnionOptions;

/// How the Gaussians of all photos become one scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Fusion {
    /// For views that draw the nearest photos in front of all others.
    Layers(FuseOptions),
    /// For views of one set, which know nothing of the photos.
    OneSet(UnionOptions),
}

impl Default for Fusion {
    fn default() -> Self {
        Self::Layers(FuseOptions::default())
    }
}

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

/// Lifts, drops what adds nothing where `prune` is set, fuses and thins. `cameras` are all cameras
/// of the scene; their mean centre is the origin.
///
/// Without `prune` every pixel of each view keeps its Gaussian. An opacity under 1/255 becomes
/// 1/255, which is blended at the very centre alone.
///
/// # Errors
/// `internal` when arrays disagree in length or views in SH degree; `cancelled` once `cancel` is
/// true, which is read before each view.
pub fn lift(
    views: Vec<ViewGaussians>,
    cameras: &[Camera],
    prune: bool,
    fusing: &Fusion,
    thinning: Option<&ThinOptions>,
    cancel: &AtomicBool,
) -> Result<Lifted> {
    let degree = views.first().map_or(0, |view| view.sh_degree);
    for view in &views {
        check_lengths(view, degree)?;
    }
    let mut counts = Counts::default();
    let mut views = best_of_each_photo(views, &mut counts);
    if !prune {
        let opacities = views.iter_mut().flat_map(|view| &mut view.opacities);
        opacities.for_each(|opacity| *opacity = opacity.max(Gaussians::OPACITY_MIN));
    }
    let judged = |view: &ViewGaussians| {
        unless_cancelled(cancel)?;
        Ok(if prune { candidates(view) } else { (vec![true; view.len()], [0; 3]) })
    };
    let judged: Vec<(Vec<bool>, [u64; 3])> = views.par_iter().map(judged).collect::<Result<_>>()?;
    let mut candidate = Vec::with_capacity(views.len());
    for (kept, dropped) in judged {
        let reasons = ["no_source_pixel", "opacity_below_1_255", "out_of_reach"];
        reasons.into_iter().zip(dropped).for_each(|(reason, count)| counts.add(reason, count));
        candidate.push(kept);
    }
    let mut fates = match fusing {
        Fusion::Layers(options) => fuse(&views, &candidate, options, cancel)?,
        Fusion::OneSet(options) => unite(&mut views, &candidate, options, cancel)?,
    };
    if let Some(thinning) = thinning {
        views.par_iter_mut().zip(&mut fates).try_for_each(|(view, fates)| {
            unless_cancelled(cancel)?;
            thin::thin(view, fates, thinning);
            Ok::<_, Error>(())
        })?;
    }
    let reasons =
        [("free_space", Fate::FreeSpace), ("duplicate", Fate::Duplicate), ("merged", Fate::Merged)];
    for (reason, dropped) in reasons {
        let of_view = |fates: &Vec<Fate>| fates.iter().filter(|fate| **fate == dropped).count();
        counts.add(reason, fates.par_iter().map(of_view).sum::<usize>() as u64);
    }
    let mut lenses = vec![None; cameras.len()];
    for view in &views {
        if let Some(lens) = lenses.get_mut(usize::from(view.photo)) {
            *lens = Some(view.camera.intrinsics);
        }
    }
    let origin = center_of(cameras);
    unless_cancelled(cancel)?;
    let (raw, depths) = moved(&views, &fates, origin, degree);
    drop((views, fates));
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
        None if degree > 3 => Err(Error::internal(format!("lift: SH degree {degree} is over 3"))),
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
        let score = sum_of_confidence(&view);
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

/// Which Gaussians of a view can count at all. The others by reason: no source pixel, transparent,
/// out of reach.
fn candidates(view: &ViewGaussians) -> (Vec<bool>, [u64; 3]) {
    let lens = &view.camera.intrinsics;
    let (w, h) = (f64::from(lens.width), f64::from(lens.height));
    let to_camera = view.camera.camera_to_world.viewmat() * view.frame_to_world.matrix();
    let [near, far] = view.near_far;
    let fault = |i: usize| {
        if view.valid.as_ref().is_some_and(|valid| !valid[i]) {
            return Some(0);
        }
        if view.opacities[i] < Gaussians::OPACITY_MIN {
            return Some(1);
        }
        let mean = point(view.means[i]);
        if !mean.is_finite() {
            return None; // counted as not finite by the last check
        }
        let seen = to_camera.transform_point3(mean);
        let (x, y) = lens.project(seen);
        let reached = seen.z >= near / DEPTH_SLACK
            && seen.z <= far * DEPTH_SLACK
            && (-FRAME_SLACK * w..=(1.0 + FRAME_SLACK) * w).contains(&x)
            && (-FRAME_SLACK * h..=(1.0 + FRAME_SLACK) * h).contains(&y);
        (!reached).then_some(2)
    };
    let all = (0..view.len()).into_par_iter().with_min_len(PIXELS_A_TASK);
    let faults: Vec<Option<u8>> = all.map(fault).collect();
    let mut dropped = [0; 3];
    faults.iter().flatten().for_each(|&reason| dropped[usize::from(reason)] += 1);
    (faults.iter().map(Option::is_none).collect(), dropped)
}

/// How the Gaussians of a view move to the world.
struct Move<'a> {
    view: &'a ViewGaussians,
    rotation: DMat3,
    turn: DQuat,
    shift: DVec3,
    sh_rotation: ShRotation,
    camera: DVec3,
    axis: DVec3,
    origin: DVec3,
    width: usize,
}

impl<'a> Move<'a> {
    fn new(view: &'a ViewGaussians, origin: DVec3) -> Self {
        let rotation = view.frame_to_world.rotation();
        let pose = &view.camera.camera_to_world;
        Self {
            view,
            rotation,
            turn: DQuat::from_mat3(&rotation),
            shift: view.frame_to_world.center() - origin,
            sh_rotation: ShRotation::new(rotation, view.sh_degree),
            camera: pose.center(),
            axis: pose.axis(),
            origin,
            width: view.camera.intrinsics.width as usize,
        }
    }

    /// Centre relative to the origin, and depth in the camera.
    fn mean(&self, i: usize) -> ([f32; 3], f64) {
        let mean = self.rotation * point(self.view.means[i]) + self.shift;
        (mean.as_vec3().to_array(), (mean + self.origin - self.camera).dot(self.axis))
    }

    #[expect(clippy::cast_possible_truncation, reason = "scenes are f32")]
    fn quat(&self, i: usize) -> [f32; 4] {
        let [w, x, y, z] = self.view.quats[i].map(f64::from);
        let quat = self.turn * DQuat::from_xyzw(x, y, z, w);
        [quat.w, quat.x, quat.y, quat.z].map(|v| v as f32)
    }

    fn sh(&self, i: usize, into: &mut [[f32; 3]]) {
        let count = into.len();
        into.copy_from_slice(&self.view.sh[i * count..(i + 1) * count]);
        self.sh_rotation.apply(into);
    }

    fn source(&self, i: usize) -> SourcePixel {
        let (x, y) = ((i % self.width) as u16, (i / self.width) as u16);
        SourcePixel { view: self.view.photo, x, y }
    }
}

/// The kept Gaussians of all views in the world, view by view, and their finite depths.
fn moved(
    views: &[ViewGaussians],
    fates: &[Vec<Fate>],
    origin: DVec3,
    degree: u8,
) -> (RawGaussians, Vec<f64>) {
    let moves: Vec<Move<'_>> = views.par_iter().map(|view| Move::new(view, origin)).collect();
    let of_view = |(v, fates): (usize, &Vec<Fate>)| -> Vec<(usize, usize)> {
        let kept = fates.iter().enumerate().filter(|(_, fate)| **fate == Fate::Keep);
        kept.map(|(i, _)| (v, i)).collect()
    };
    let kept: Vec<Vec<(usize, usize)>> = fates.par_iter().enumerate().map(of_view).collect();
    let kept = kept.concat();
    let rows = || kept.par_iter().with_min_len(PIXELS_A_TASK);
    let (mut means, mut depths) = (Vec::new(), Vec::new());
    rows().map(|&(v, i)| moves[v].mean(i)).unzip_into_vecs(&mut means, &mut depths);
    depths.retain(|depth| depth.is_finite());
    let sh_count = (usize::from(degree) + 1).pow(2);
    let mut sh = vec![[0.0; 3]; kept.len() * sh_count];
    sh.par_chunks_mut(sh_count).zip(rows()).for_each(|(sh, &(v, i))| moves[v].sh(i, sh));
    let raw = RawGaussians {
        origin,
        means,
        quats: rows().map(|&(v, i)| moves[v].quat(i)).collect(),
        scales: rows().map(|&(v, i)| views[v].scales[i]).collect(),
        opacities: rows().map(|&(v, i)| views[v].opacities[i]).collect(),
        sh_degree: degree,
        sh,
        semantic_index: vec![0; kept.len()],
        source: rows().map(|&(v, i)| moves[v].source(i)).collect(),
    };
    (raw, depths)
}

fn center_of(cameras: &[Camera]) -> DVec3 {
    let sum: DVec3 = cameras.iter().map(|camera| camera.camera_to_world.center()).sum();
    if cameras.is_empty() { sum } else { sum / cameras.len() as f64 }
}
