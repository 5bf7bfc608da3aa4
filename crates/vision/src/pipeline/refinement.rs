//! A whole refinement: first without the photos that are held out, which says whether it helps and
//! with how many steps, then with all. And what it needs of the other stages: photos at the size at
//! which they are learnt, the scene of the photos that are not held out, and semantics that follow
//! other Gaussians.

use std::{
    sync::mpsc::{RecvTimeoutError, channel},
    thread,
    time::Duration,
};

use segsplat_render::{DifferentiableRenderer, Kinds, RenderRequest, plan::default_near};

use super::Reconstruction;
use crate::{
    error::Result,
    models::{ResizeFilter, fit},
    refine::{
        self, RefineBudget, RefineOptions, RefinedVersion, UNWATCHED_STEPS_MAX, fewer, held_out,
        mean_difference, ready, split,
    },
    scene::{
        Camera, Gaussians, HealthReport, Method, Photo, PosedPhoto, RefineReport, Scene,
        SceneCamera, SceneMeta, Semantics,
    },
    semantics::{Views, from_source},
};

/// Time between two views that keep a device from lowering its clocks, and their longer side,
/// pixels.
const AWAKE_EVERY: Duration = Duration::from_millis(4);
const AWAKE_SIDE: u32 = 64;

/// Longer side at which photos are learnt on a processor, pixels.
const PROCESSOR_SIDE: u32 = 640;
/// About what a Gaussian of degree 0 takes on a device, with moments, gradients and tile pairs.
const DEVICE_BYTES_A_GAUSSIAN: u64 = 600;

/// What a refinement came to.
#[derive(Clone, Debug)]
pub struct Refined {
    /// Its figures.
    pub report: RefineReport,
    /// How much the proof's Gaussians differ from the held-out photos, as a multiple of how much
    /// they differ from the learnt ones beside them; `None` where there was no proof, or nothing
    /// better.
    pub overfit: Option<f64>,
    /// What it began with and the better version; `None` where none was better.
    pub version: Option<(Scene, RefinedVersion)>,
}

/// What the networks make of photos: [`super::reconstruct_for_refinement`].
pub type Remake<'a> = &'a mut dyn FnMut(Vec<PosedPhoto>) -> Result<(Reconstruction, Gaussians)>;

/// Refines `scene`, which was made of `photos`, within the budget of `options`.
///
/// First the proof: a scene without the held-out photos is refined in a share of the time
/// ([`RefineOptions::proof_share`]). Where its PSNR on these photos rises over that of what was
/// served, a scene of all photos is refined with as many steps for each second that is left. It
/// goes on from the proof's Gaussians, and those of the held-out photos, where the proof explains
/// these nearly as well as photos that it learnt ([`RefineOptions::overfit_max`]); else it begins
/// with those of the networks (docs/adr/0041). Of too few photos none is held out, and few steps
/// are taken.
///
/// # Errors
/// Those of `remake`, of `pace` and of [`refine::refine`].
pub fn refined(
    renderer: &dyn DifferentiableRenderer,
    scene: &Scene,
    photos: &[PosedPhoto],
    options: &RefineOptions,
    remake: Remake<'_>,
    pace: &mut dyn FnMut(f32) -> Result<()>,
) -> Result<Refined> {
    let held = held_out(photos.len());
    let options = &fitted(options, photos, renderer.is_device());
    let sized: Vec<PosedPhoto> = photos.iter().map(|photo| at_side(photo, options.side)).collect();
    // The proof leaves room for the Gaussians of the photos that it lacks.
    let share_of = |all: usize, held: &[usize]| {
        all.saturating_mul(photos.len() - held.len()) / photos.len().max(1)
    };
    // The scene without the photos `held`, and what its refinement begins with.
    let mut begin = |held: &[usize]| -> Result<(Scene, Gaussians)> {
        let (learnt, one_set) = awake(renderer, scene, || remake(split(photos, held).0))?;
        let (start, first) = start_of(scene, held, learnt, one_set)?;
        let gaussians_first = share_of(options.gaussians_first.min(options.gaussians_max), held);
        let gaussians = ready(&start, &first, &RefineOptions { gaussians_first, ..*options })?;
        Ok((start, gaussians))
    };
    let mut part = |start: (&Scene, &Gaussians),
                    held: &[usize],
                    options: &RefineOptions,
                    [begin, end]: [f32; 2]| {
        let (learnt, held_out) = split(&sized, held);
        let mut pace = |spent: f32| pace(begin + (end - begin) * spent);
        refine::refine(renderer, start.0, start.1, &learnt, &held_out, options, &mut pace)
    };
    let RefineBudget { steps, time } = options.budget;
    if held.is_empty() {
        let (start, gaussians) = begin(&[])?;
        let budget = RefineBudget { steps: steps.min(UNWATCHED_STEPS_MAX), time };
        let options = RefineOptions { budget, ..*options };
        let version = part((&start, &gaussians), &[], &options, [0.0, 1.0])?;
        let report = version.report.clone();
        return Ok(Refined { report, overfit: None, version: Some((start, version)) });
    }
    let share = options.proof_share.clamp(0.01, 0.99);
    let budget = RefineBudget { steps, time: of_time(time, share) };
    let (start, gaussians) = begin(&held)?;
    let gaussians_max = share_of(options.gaussians_max, &held);
    let proof_options = RefineOptions { budget, gaussians_max, ..*options };
    let proof = part((&start, &gaussians), &held, &proof_options, [0.0, share])?;
    let earlier = scene.meta.report.refinement.as_ref().and_then(|report| report.psnr_after);
    if proof.report.steps == 0 || proof.report.psnr_after <= earlier {
        return Ok(Refined { report: proof.report, overfit: None, version: None });
    }
    let differs = |at: &dyn Fn(usize) -> usize| {
        let photos: Vec<PosedPhoto> = held.iter().map(|&i| sized[at(i)].clone()).collect();
        mean_difference(renderer, &start, &proof.gaussians, &photos)
    };
    // The photo before each is learnt.
    let overfit = differs(&|i| i)? / differs(&|i| i - 1)?;
    let more = ((1.0 - share) / share).max(1.0);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a few steps")]
    let as_many = (proof.report.steps as f32 * more).round() as u32;
    // All the time that is left, unless the proof became worse again.
    let is_timed = time < Duration::MAX && !proof.is_peak;
    let mut options = RefineOptions {
        budget: RefineBudget {
            steps: if is_timed { steps } else { as_many.min(steps) },
            time: of_time(time, 1.0 - share),
        },
        ..*options
    };
    let (start, mut gaussians) = begin(&[])?;
    if overfit <= f64::from(options.overfit_max) {
        let of_held = |i: usize| held.contains(&usize::from(gaussians.source()[i].view));
        let room = options.gaussians_max.saturating_sub(proof.gaussians.len());
        let more = fewer(&gaussians.only(of_held), room, options.seed)?;
        gaussians = proof.gaussians.joined(&more)?;
        options.coarse_share = 0.0;
    }
    let mut version = part((&start, &gaussians), &[], &options, [share, 1.0])?;
    version.report = RefineReport {
        seconds: proof.report.seconds + version.report.seconds,
        psnr_before: proof.report.psnr_before,
        psnr_after: proof.report.psnr_after,
        ..version.report
    };
    let report = version.report.clone();
    Ok(Refined { report, overfit: Some(overfit), version: Some((start, version)) })
}

/// The options with a side and a number of Gaussians for which there is time and room: a half of a
/// device's bytes is for the photos and their smaller copies, a half for the Gaussians.
fn fitted(options: &RefineOptions, photos: &[PosedPhoto], is_device: bool) -> RefineOptions {
    if !is_device {
        return RefineOptions { side: options.side.min(PROCESSOR_SIDE), ..*options };
    }
    let half = options.device_bytes_max / 2;
    let pixels = |side: u32| -> f64 {
        let of = |posed: &PosedPhoto| {
            let [w, h] = [posed.photo.width, posed.photo.height].map(f64::from);
            w * h * (f64::from(side) / w.max(h)).min(1.0).powi(2)
        };
        photos.iter().map(of).sum()
    };
    let bytes = |side: u32| 5.0 * pixels(side);
    let mut side = options.side;
    while side > PROCESSOR_SIDE && bytes(side) > half as f64 {
        side = (side * 7 / 8).max(PROCESSOR_SIDE);
    }
    let room = usize::try_from(half / DEVICE_BYTES_A_GAUSSIAN).unwrap_or(usize::MAX);
    RefineOptions { side, gaussians_max: options.gaussians_max.min(room.max(1)), ..*options }
}

/// Does `work`, and meanwhile draws a small view now and then, where a device would else rest.
fn awake<T>(renderer: &dyn DifferentiableRenderer, scene: &Scene, work: impl FnOnce() -> T) -> T {
    let Some(photo) = scene.meta.cameras.first().filter(|_| renderer.is_device()) else {
        return work();
    };
    let near = default_near(scene.meta.report.median_depth);
    let lens = photo.camera.intrinsics;
    let longer = lens.width.max(lens.height);
    let side = |length: u32| (length * AWAKE_SIDE / longer).max(1);
    let intrinsics = lens.resized(side(lens.width), side(lens.height));
    let small = RenderRequest::plain(Camera { intrinsics, ..photo.camera }, Kinds::COLOR, near);
    let (working, done) = channel::<()>();
    thread::scope(|scope| {
        scope.spawn(move || {
            while done.recv_timeout(AWAKE_EVERY) == Err(RecvTimeoutError::Timeout) {
                // A device that fails says so in the step that comes.
                let _ = renderer.render(&scene.gaussians, &small);
            }
        });
        let made = work();
        drop(working);
        made
    })
}

/// A share of a time that may be endless.
fn of_time(time: Duration, share: f32) -> Duration {
    Duration::try_from_secs_f64(time.as_secs_f64() * f64::from(share)).unwrap_or(Duration::MAX)
}

/// A photo whose longer side is `side` pixels, or as it is if that is shorter.
fn at_side(posed: &PosedPhoto, side: u32) -> PosedPhoto {
    let (width, height) = (posed.photo.width, posed.photo.height);
    let longer = width.max(height);
    if longer <= side {
        return posed.clone();
    }
    let scaled = |length: u32| (length * side).div_ceil(longer).max(1);
    let size = [scaled(height), scaled(width)];
    let fitted = fit(&posed.photo, &posed.camera, size, ResizeFilter::default());
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..255")]
    let rgb = fitted.rgb.iter().map(|v| (v * 255.0).round() as u8).collect();
    let photo = Photo { width: scaled(width), height: scaled(height), rgb, valid: fitted.valid };
    PosedPhoto { photo, camera: fitted.camera, ..posed.clone() }
}

/// What refinement begins with: `learnt` and `one_set` were made of the photos of `scene` less
/// those held out, and get its place. Photos keep their numbers.
/// Errors: `internal` when it is not a scene of these photos.
fn start_of(
    scene: &Scene,
    held: &[usize],
    learnt: Reconstruction,
    one_set: Gaussians,
) -> Result<(Scene, Gaussians)> {
    let kept = |i: &usize| !held.contains(i);
    let numbers: Vec<usize> = (0..scene.meta.cameras.len()).filter(kept).collect();
    let numbered = |gaussians: Gaussians| {
        let mut raw = gaussians.into_raw();
        for source in &mut raw.source {
            let number = numbers.get(usize::from(source.view)).copied().unwrap_or(usize::MAX);
            source.view = u16::try_from(number).unwrap_or(u16::MAX);
        }
        Gaussians::restore(raw)
    };
    let gaussians = numbered(learnt.gaussians)?;
    let mut cameras: Vec<SceneCamera> = scene.meta.cameras.clone();
    let mut focals = vec![0.0; cameras.len()];
    cameras.iter_mut().for_each(|camera| camera.network = None);
    for (i, &number) in numbers.iter().enumerate() {
        cameras[number].network = learnt.cameras.get(i).and_then(|camera| camera.network);
        focals[number] = learnt.report.network_focal_px.get(i).copied().unwrap_or(0.0);
    }
    let report = HealthReport {
        gaussians: gaussians.len() as u64,
        method: learnt.report.method,
        median_depth: learnt.report.median_depth,
        network_focal_px: focals,
        refinement: None,
        ..scene.meta.report.clone()
    };
    let meta = SceneMeta { cameras, report, ..scene.meta.clone() };
    Ok((Scene::new(meta, gaussians, learnt.backdrop), numbered(one_set)?))
}

/// A report with the numbers of the photos that are held out of `photos`.
#[must_use]
pub fn reported(photos: usize, found: &RefineReport) -> RefineReport {
    let held = refine::held_out(photos).into_iter();
    let held_out = held.filter_map(|i| u32::try_from(i).ok()).collect();
    RefineReport { held_out, ..found.clone() }
}

/// A version as a scene: of `start`, with the semantics that `served` has now.
///
/// # Errors
/// `internal` when the parts do not fit each other.
pub fn version_of(
    start: &Scene,
    served: &Scene,
    version: &refine::RefinedVersion,
) -> Result<Scene> {
    // One set of Gaussians: plain views show what was learnt.
    let method = Method { front_photos: 0, magnify: false, ..start.meta.report.method.clone() };
    let report = HealthReport {
        gaussians: version.gaussians.len() as u64,
        method,
        refinement: Some(reported(start.meta.cameras.len(), &version.report)),
        ..start.meta.report.clone()
    };
    let meta = SceneMeta { report, ..start.meta.clone() };
    let plain = Scene {
        meta,
        gaussians: version.gaussians.clone(),
        semantics: None,
        sha256: String::new(),
        semantics_sha256: String::new(),
        ..start.clone()
    };
    let Some(semantics) = &served.semantics else { return Ok(plain) };
    let semantics = follow(semantics, &plain);
    let with = plain.with_semantics(std::sync::Arc::new(semantics))?;
    Ok(Scene { semantics_sha256: served.semantics_sha256.clone(), ..with })
}

/// Semantics whose entries are given to the Gaussians of another version: by the same maps of the
/// photos, as at first.
fn follow(semantics: &Semantics, scene: &Scene) -> Semantics {
    let (gaussians, cameras) = (&scene.gaussians, &scene.meta.cameras[..]);
    let own = from_source(gaussians.source(), cameras, &semantics.photos);
    let index = match scene.meta.report.method.votes {
        true => Views::new(gaussians, cameras).vote(&own, &semantics.photos),
        false => own,
    };
    Semantics { index, ..semantics.clone() }
}
