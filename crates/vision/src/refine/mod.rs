//! Refinement: gradient steps that bring a scene's Gaussians closer to its photos.
//!
//! In: a scene and photos. Out: better Gaussians. The steps are those of
//! [`segsplat_render::train`], on the renderer's device where that has room for them, else on the
//! processor. A gain and a bias for each photo and channel take up its exposure. Gaussians that
//! become transparent are dropped as it goes, and others are split where the scene differs from the
//! photos ([`segsplat_render::train::Trainer::grow`]). Large photos are learnt at half their size
//! first.
//!
//! **Held out.** Of five photos and more, some are held out ([`held_out`]): the steps never see
//! them, and steps are of use only where PSNR on these photos is over that of the scene as it is
//! served. They must not be in the Gaussians that come in either: make the scene of the others
//! ([`split`]).
//!
//! That says whether steps help, and whether more of them do. What is served learns all photos, so
//! that it lacks none ([`crate::pipeline::refinement::refined`]).
//!
//! **One set.** A scene that comes in may be served in layers and with magnification. What comes
//! out is plain: the same Gaussians for every view and for other programs.

mod half;
mod spool;

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use glam::{DQuat, DVec3};
use rayon::prelude::*;
use segsplat_render::{
    Background, DifferentiableRenderer, Frame, Kinds, Layer, RenderRequest, Renderer,
    compare::psnr,
    plan::{default_near, served, widened},
    train::{
        HostTrainer, PhotoSource, PoseRates, StreamedPhoto, Trainer, TrainingPhoto, TrainingSet,
        TrainingStep, checked, photo_loss, unit,
    },
};

pub use self::spool::{MorePhotos, PhotoSpool};
use self::{
    half::{halved, halved_camera},
    spool::Halved,
};
pub use segsplat_render::train::LearningRates;

use crate::{
    error::{Error, ErrorCode, Result},
    scene::{Camera, CameraToWorld, Gaussians, Photo, PosedPhoto, RefineReport, Scene},
};

/// Fewest photos of which one is held out.
pub const HOLDS_OUT_FROM: usize = 5;
/// Every so many photos one is held out: fewer where that is one alone, which says little.
const HELD_OUT_EVERY: [usize; 2] = [4, 8];
/// Photos that are held out at least, where there are enough, and the photos that are enough.
const HELD_OUT_MIN: usize = 3;
const HELD_OUT_MORE_FROM: usize = 8;
/// Most steps of a scene of few photos, where none is held out to tell when to stop.
pub const UNWATCHED_STEPS_MAX: u32 = 30;
/// Shares of the budget between which Gaussians are added, steps between two times, what share of
/// them comes each time, and photos that say where: docs/adr/0070.
const GROWS_BETWEEN: [f32; 2] = [0.1, 0.7];
const GROWS_EVERY: u32 = 100;
/// Expected steps under which none is added: they would not pay for it.
const GROWS_FROM_STEPS: f32 = 300.0;
const GROWTH_PHOTOS: usize = 4;
/// How far numbers move at first, `means` as a share of the median depth. 3DGS takes 30,000 steps
/// that move less: docs/adr/0041, and of means docs/adr/0101.
const RATES: LearningRates = LearningRates {
    means: 6e-5,
    quats: 5e-3,
    scales: 7.5e-2,
    opacities: 6.25e-2,
    sh: 6.25e-3,
    sh_rest: 3.125e-4,
};
/// Rates fall to this share over the budget.
const LAST_RATE: f32 = 0.1;
/// Steps for each photo with which the rates are right, how rates grow where there are fewer, and
/// how far: docs/adr/0041.
const STEPS_A_PHOTO: f32 = 200.0;
const RATE_FACTOR_POWER: f32 = 0.4;
const RATE_FACTOR_MAX: f32 = 2.0;
/// What an SSIM of 1 is worth, dB of PSNR.
const SSIM_DB: f64 = 20.0;
/// How fast an exposure moves.
const EXPOSURE_RATE: f32 = 5e-3;
/// Gains of a photo's exposure that are believed where it is compared with a view.
const GAINS: [f64; 2] = [0.4, 2.5];
/// Opacity of a pixel that Gaussians cover, and share of a photo that they must.
const COVERED: f32 = 0.9;
const COVERED_MIN: f64 = 0.2;
/// Steps in which the camera of a photo comes to fit Gaussians that stay.
pub const ALIGNING_STEPS: u8 = 30;

/// How long to refine: until either is spent. With steps alone the result is the same on every
/// machine with the same lanes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RefineBudget {
    /// So many steps.
    pub steps: u32,
    /// So much time.
    pub time: Duration,
}

impl RefineBudget {
    /// So many steps, however long they take.
    #[must_use]
    pub fn steps(steps: u32) -> Self {
        Self { steps, time: Duration::MAX }
    }
}

/// How to refine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RefineOptions {
    /// How long.
    pub budget: RefineBudget,
    /// Photos of a step.
    pub batch: usize,
    /// Longer side at which the photos are learnt at most, pixels: what is learnt smaller than it
    /// is shown has gaps.
    pub side: u32,
    /// How far numbers move; `means` as a share of the scene's median depth.
    pub rates: LearningRates,
    /// Most Gaussians to begin with: of more, this many are chosen at random and made wider.
    pub gaussians_first: usize,
    /// Most Gaussians for each pixel of a photo: as many are added where the scene differs from the
    /// photos.
    pub gaussians_a_pixel: f32,
    /// Most Gaussians at all.
    pub gaussians_max: usize,
    /// Share of the Gaussians that is added at a time; 0: none is, and none in the place of those
    /// that are dropped.
    pub growth: f32,
    /// Share of the budget in which photos are learnt at half their size, 0..1.
    pub coarse_share: f32,
    /// Longer side of such a smaller copy at least, pixels: under it a photo has none.
    pub coarse_side_min: u32,
    /// Factor on all rates.
    pub rate: f32,
    /// Gaussians under this opacity are dropped.
    pub opacity_min: f32,
    /// Steps between two times of dropping.
    pub prune_every: u32,
    /// Share of SSIM in the loss, 0..1.
    pub ssim_share: f32,
    /// How far cameras turn in a step at first, radians, and move, as a share of the scene's median
    /// depth; 0: they stay where they are.
    pub pose_rate: f32,
    /// What held-out photos must gain by cameras that fit what the others show, for cameras to be
    /// learnt ([`Judged::score`], [`crate::pipeline::refinement::refined`]).
    pub mends_from: f64,
    /// Steps until the first version ([`crate::pipeline::refinement::refined`]).
    pub first_steps: u32,
    /// What the work on a further version must gain on the held-out photos ([`Judged::score`]).
    pub gain_min: f64,
    /// Share of the work that goes to the scene without the held-out photos, 0..1
    /// ([`crate::pipeline::refinement::refined`]).
    pub proof_share: f32,
    /// Most that the proof's Gaussians may differ from the held-out photos, as a multiple of how
    /// much they differ from learnt ones, for the work to go on from them
    /// ([`crate::pipeline::refinement::refined`]).
    pub overfit_max: f32,
    /// The same for a further version to be published: what its held-out photos gain by more than
    /// this, other views lose (docs/adr/0101).
    pub overfit_further: f32,
    /// Bytes that it may take on a device; what needs more is refined on the processor.
    pub device_bytes_max: u64,
    /// Seed of all that is random.
    pub seed: u64,
}

impl Default for RefineOptions {
    fn default() -> Self {
        Self {
            budget: RefineBudget::steps(400),
            batch: 1,
            side: 1_600,
            rates: RATES,
            gaussians_first: 150_000,
            gaussians_a_pixel: 0.5,
            gaussians_max: 1_000_000,
            growth: 0.04,
            coarse_share: 0.5,
            coarse_side_min: 480,
            rate: 1.0,
            opacity_min: 0.01,
            prune_every: 50,
            ssim_share: 0.2,
            pose_rate: 1e-3,
            mends_from: 0.25,
            first_steps: 400,
            gain_min: 0.2,
            proof_share: 0.25,
            overfit_max: 1.5,
            overfit_further: 1.8,
            device_bytes_max: 2 << 30,
            seed: 1,
        }
    }
}

/// A version of a scene.
#[derive(Clone, Debug)]
pub struct RefinedVersion {
    /// Its Gaussians: those that came in, moved, less those that were dropped, and those that came
    /// by growth. Entries and sources came with them.
    pub gaussians: Gaussians,
    /// How good it is; which photos are held out is for the caller to say.
    pub report: RefineReport,
    /// Where the cameras of all photos stand.
    pub poses: Vec<CameraToWorld>,
}

/// Photos to learn from.
#[derive(Clone, Copy, Debug)]
pub struct LearntPhotos<'a> {
    /// Those that are in memory.
    pub kept: &'a [PosedPhoto],
    /// Those that are on disk; their cameras stay where they are.
    pub more: Option<&'a MorePhotos>,
}

impl<'a> From<&'a [PosedPhoto]> for LearntPhotos<'a> {
    fn from(kept: &'a [PosedPhoto]) -> Self {
        Self { kept, more: None }
    }
}

/// What steps made.
#[derive(Clone, Debug)]
pub struct Stepped {
    /// The Gaussians after them, as in [`RefinedVersion::gaussians`].
    pub gaussians: Gaussians,
    /// How many were taken.
    pub steps: u32,
    /// How long they took, without what [`refine`]'s `pace` waited.
    pub time: Duration,
    /// How they show the held-out photos; `None` without such photos.
    pub judged: Option<Judged>,
    /// Where the cameras of the learnt photos that are kept stand.
    pub poses: Vec<CameraToWorld>,
}

/// How near views are to photos that are not in a scene.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Judged {
    /// Mean PSNR, dB.
    pub psnr: f64,
    /// Mean SSIM.
    pub ssim: f64,
}

impl Judged {
    /// One number for both, dB: PSNR alone takes what is soft for as good as what is sharp.
    #[must_use]
    pub fn score(&self) -> f64 {
        self.psnr + SSIM_DB * self.ssim
    }
}

/// Numbers of the photos that are held out of `count`, evenly spread: every eighth, of less than 24
/// more often so that there are three where that leaves most; none of fewer than
/// [`HOLDS_OUT_FROM`].
#[must_use]
pub fn held_out(count: usize) -> Vec<usize> {
    if count < HOLDS_OUT_FROM {
        return Vec::new();
    }
    let [often, seldom] = HELD_OUT_EVERY;
    let every = match count < HELD_OUT_MORE_FROM {
        true => seldom,
        false => (count / HELD_OUT_MIN).clamp(often, seldom),
    };
    (every / 2 - 1..count).step_by(every).collect()
}

/// Photos to learn from, and those of the numbers `held`: what makes the scene that is refined must
/// see the first alone.
#[must_use]
pub fn split(photos: &[PosedPhoto], held: &[usize]) -> (Vec<PosedPhoto>, Vec<PosedPhoto>) {
    let of = |inside: bool| {
        let kept = photos.iter().enumerate().filter(|(i, _)| held.contains(i) == inside);
        kept.map(|(_, photo)| photo.clone()).collect()
    };
    (of(false), of(true))
}

/// Mean absolute difference of what `gaussians` show, over what is behind those of `start`, and
/// each photo, in 0..1. Exposures are left out, for nothing knows those of held-out photos.
///
/// # Errors
/// What the renderer says.
pub fn differences(
    renderer: &dyn DifferentiableRenderer,
    start: &Scene,
    gaussians: &Gaussians,
    photos: &[PosedPhoto],
) -> Result<Vec<f64>> {
    let difference = |posed: &PosedPhoto| {
        let frame = renderer.render(gaussians, &plain_view(start, posed.camera))?;
        let (shown, photo) = (frame.color.unwrap_or_default(), unit(&posed.photo));
        let (width, valid) = (posed.photo.width as usize, posed.photo.valid.as_deref());
        Ok(photo_loss(&shown, &photo, width, valid, 0.0).value)
    };
    photos.iter().map(difference).collect()
}

/// How much of each photo `gaussians` do not explain, over what is behind those of `start`: the
/// mean absolute difference after the best gain and bias of each channel, as a share of that of
/// one plain colour. A photo whose camera stands elsewhere has about 1.
///
/// # Errors
/// What the renderer says.
pub fn unexplained(
    renderer: &dyn DifferentiableRenderer,
    start: &Scene,
    gaussians: &Gaussians,
    photos: &[PosedPhoto],
) -> Result<Vec<f64>> {
    let share = |posed: &PosedPhoto| {
        let frame = renderer.render(gaussians, &plain_view(start, posed.camera))?;
        let shown = frame.color.unwrap_or_default();
        let photo = unit(&posed.photo);
        let known = |i: &usize| posed.photo.valid.as_ref().is_none_or(|valid| valid[*i]);
        let (mut left, mut all) = (0.0, 0.0);
        for c in 0..3 {
            let pairs = (0..photo.len()).filter(known);
            let pairs = pairs.map(|i| (f64::from(shown[i][c]), f64::from(photo[i][c])));
            let (mut count, mut sums) = (0.0, [0.0; 4]);
            for (x, y) in pairs.clone() {
                count += 1.0;
                sums = [sums[0] + x, sums[1] + y, sums[2] + x * x, sums[3] + x * y];
            }
            let [x, y, xx, xy] = sums.map(|sum: f64| sum / f64::max(count, 1.0));
            let variance = (xx - x * x).max(f64::MIN_POSITIVE);
            let gain = ((xy - x * y) / variance).clamp(GAINS[0], GAINS[1]);
            for (shown, known) in pairs {
                left += (gain * (shown - x) - (known - y)).abs();
                all += (known - y).abs();
            }
        }
        Ok(left / f64::max(all, f64::MIN_POSITIVE))
    };
    photos.iter().map(share).collect()
}

/// A view of one set of Gaussians over what `start` has behind its own.
fn plain_view(start: &Scene, camera: Camera) -> RenderRequest {
    let near = default_near(start.meta.report.median_depth);
    let plain = RenderRequest::plain(camera, Kinds::COLOR, near);
    let Background::Backdrop(_) = served(start, plain.clone()).background else {
        return RenderRequest { background: Background::BLACK, ..plain };
    };
    RenderRequest { background: Background::Backdrop(start.backdrop.clone()), ..plain }
}

/// How much larger rates are where few steps are expected for each photo, 1..=2; 1 where it is not
/// known how many.
#[must_use]
pub fn rate_factor(steps_a_photo: f32) -> f32 {
    if steps_a_photo > 0.0 {
        (STEPS_A_PHOTO / steps_a_photo).powf(RATE_FACTOR_POWER).clamp(1.0, RATE_FACTOR_MAX)
    } else {
        1.0
    }
}

/// A held-out photo.
struct HeldOutPhoto {
    camera: Camera,
    /// `[H * W]` 0..1.
    rgb: Vec<[f32; 3]>,
    valid: Option<Vec<bool>>,
}

impl HeldOutPhoto {
    fn new(posed: &PosedPhoto) -> Self {
        let rgb = unit(&posed.photo);
        Self { camera: posed.camera, rgb, valid: posed.photo.valid.clone() }
    }
}

/// How far a refinement is in its budget.
struct Clock {
    budget: RefineBudget,
    begun: Instant,
    /// Time in which others went first.
    waited: Duration,
}

impl Clock {
    fn worked(&self) -> Duration {
        self.begun.elapsed().saturating_sub(self.waited)
    }

    /// Share of the budget that is spent after `steps`, 0..1.
    fn spent(&self, steps: u32) -> f32 {
        let RefineBudget { steps: all, time } = self.budget;
        let of_steps = f64::from(steps) / f64::from(all.max(1));
        let share = of_steps.max(self.worked().as_secs_f64() / time.as_secs_f64().max(1e-3));
        #[expect(clippy::cast_possible_truncation, reason = "a share")]
        let share = share.min(1.0) as f32;
        share
    }
}

/// The Gaussians that the steps begin with: `first`, the one set of Gaussians of `start`, with its
/// magnification for good, and no more of them than `options` say.
///
/// # Errors
/// `internal` where they cannot be Gaussians any more.
pub fn ready(start: &Scene, first: &Gaussians, options: &RefineOptions) -> Result<Gaussians> {
    let all = widened(start, first, Some(options.side))?;
    fewer(&all, options.gaussians_first.min(options.gaussians_max), options.seed)
}

/// Refines `gaussians` on the photos that are learnt, over what is behind those of `start` (what
/// they are, [`ready`] says), and looks at the held-out ones afterwards. The photos are used at the
/// size that they have. Before each step `pace` gets the share of the budget that is spent, 0..1;
/// it may wait, which is not counted, and its error ends the work.
///
/// Without held-out photos, of fewer than [`HOLDS_OUT_FROM`] at most [`UNWATCHED_STEPS_MAX`] steps
/// are taken.
///
/// # Errors
/// `invalid_request` for options out of range; what the renderer or `pace` says.
pub fn refine(
    renderer: &dyn DifferentiableRenderer,
    start: &Scene,
    gaussians: &Gaussians,
    learnt: LearntPhotos<'_>,
    held_out: &[PosedPhoto],
    options: &RefineOptions,
    pace: &mut dyn FnMut(f32) -> Result<()>,
) -> Result<Stepped> {
    let LearntPhotos { kept: learnt, more } = learnt;
    let over_0 = [options.gaussians_first, options.gaussians_max, options.batch];
    if options.prune_every == 0 || over_0.contains(&0) {
        return Err(Error::invalid("refine: batch, prune_every, gaussians_* must be over 0"));
    }
    let held_out: Vec<HeldOutPhoto> = held_out.par_iter().map(HeldOutPhoto::new).collect();
    if learnt.is_empty() || gaussians.is_empty() {
        let view = |camera| renderer.render(gaussians, &plain_view(start, camera));
        let (steps, time, judged) = (0, Duration::ZERO, judged(&held_out, view)?);
        let poses = learnt.iter().map(|posed| posed.camera.camera_to_world).collect();
        return Ok(Stepped { gaussians: gaussians.clone(), steps, time, judged, poses });
    }
    // Behind the photos their smaller copies.
    let has_room = |camera: &Camera| {
        let lens = camera.intrinsics;
        lens.width.max(lens.height) / 2 >= options.coarse_side_min
            && lens.width.min(lens.height) > 1
    };
    let all_have = more.is_none_or(|more| more.cameras().all(has_room));
    let coarse = match options.coarse_share > 0.0 && all_have {
        true => coarse_copies(learnt, options),
        false => Vec::new(),
    };
    let (ssim_share, gaussians_max) = (options.ssim_share, most_gaussians(learnt, options));
    let photos = [training_photos(start, learnt), training_photos(start, &coarse)].concat();
    let is_few = held_out.is_empty() && learnt.len() < HOLDS_OUT_FROM;
    let has_coarse = !coarse.is_empty();
    let streamed = more.map_or_else(Vec::new, |more| streamed(start, more, learnt.len()));
    let course = Course {
        is_few,
        kept: learnt.len(),
        streamed: more.map_or(0, |more| more.numbers.len()),
        has_coarse,
        coarse_share: if has_coarse { options.coarse_share } else { 0.0 },
        gaussians: gaussians.len(),
        gaussians_max,
        rates: rates_of(start, options),
        poses: pose_rates(start, options),
        options,
        order: Vec::new(),
        random: options.seed,
        grows_at: 0,
    };
    let set = TrainingSet { gaussians, photos, streamed, ssim_share, gaussians_max };
    with_trainer(renderer, &set, options, |trainer| {
        let (steps, time) = course.clone().run(trainer, pace)?;
        let judged = judged(&held_out, |camera| trainer.render(&plain_view(start, camera)))?;
        let (gaussians, mut poses) = (trainer.gaussians()?, trainer.poses()?);
        poses.truncate(learnt.len());
        Ok(Stepped { gaussians, steps, time, judged, poses })
    })
}

/// Where the cameras of photos stand so that they come closest to what `gaussians` show, over
/// what is behind those of `start`: after so many steps for each that move nothing else. `pace`
/// is called before each step.
///
/// # Errors
/// What the renderer or `pace` says.
pub fn aligned(
    renderer: &dyn DifferentiableRenderer,
    start: &Scene,
    gaussians: &Gaussians,
    photos: &[PosedPhoto],
    options: &RefineOptions,
    steps: u8,
    pace: &mut dyn FnMut() -> Result<()>,
) -> Result<Vec<CameraToWorld>> {
    if photos.is_empty() || gaussians.is_empty() {
        return Ok(photos.iter().map(|posed| posed.camera.camera_to_world).collect());
    }
    let coarse = coarse_copies(photos, options);
    let photos = training_photos(start, if coarse.is_empty() { photos } else { &coarse });
    let (count, ssim_share, gaussians_max) = (photos.len(), options.ssim_share, gaussians.len());
    let set = TrainingSet { gaussians, photos, streamed: Vec::new(), ssim_share, gaussians_max };
    let poses = pose_rates(start, options);
    with_trainer(renderer, &set, options, |trainer| {
        for turn in 0..steps {
            let fall = LAST_RATE.powf(f32::from(turn) / f32::from(steps));
            let step = TrainingStep {
                rates: options.rates.scaled(0.0),
                exposure: EXPOSURE_RATE,
                poses: poses.scaled(fall),
                ..TrainingStep::default()
            };
            for at in 0..count {
                pace()?;
                trainer.step(&[at], &step)?;
            }
        }
        trainer.poses()
    })
}

/// A photo whose pixels count only where `gaussians` cover them; `None` where they cover little.
///
/// # Errors
/// What the renderer says.
pub(crate) fn covered(
    renderer: &dyn DifferentiableRenderer,
    start: &Scene,
    gaussians: &Gaussians,
    posed: &PosedPhoto,
) -> Result<Option<PosedPhoto>> {
    let kinds = Kinds { alpha: true, ..Kinds::COLOR };
    let request = RenderRequest { kinds, ..plain_view(start, posed.camera) };
    let alpha = renderer.render(gaussians, &request)?.alpha.unwrap_or_default();
    let known = |i: usize| posed.photo.valid.as_ref().is_none_or(|valid| valid[i]);
    let valid: Vec<bool> =
        alpha.iter().enumerate().map(|(i, alpha)| *alpha >= COVERED && known(i)).collect();
    let count = valid.iter().filter(|valid| **valid).count();
    let photo = Photo { valid: Some(valid), ..posed.photo.clone() };
    let share = count as f64 / alpha.len().max(1) as f64;
    Ok((share >= COVERED_MIN).then(|| PosedPhoto { photo, ..posed.clone() }))
}

/// The Gaussians, each turned and moved by the motion that `of` gives for its photo: a rotation
/// about the origin of the world, then a way.
///
/// # Errors
/// `internal` where they cannot be Gaussians any more.
pub(crate) fn carried(
    gaussians: &Gaussians,
    of: impl Fn(usize) -> Option<(DQuat, DVec3)>,
) -> Result<Gaussians> {
    let (origin, mut raw) = (gaussians.origin(), gaussians.clone().into_raw());
    for i in 0..raw.means.len() {
        let Some((turn, way)) = of(usize::from(raw.source[i].view)) else { continue };
        let mean = DVec3::from_array(raw.means[i].map(f64::from)) + origin;
        raw.means[i] = (turn * mean + way - origin).as_vec3().to_array();
        let [w, x, y, z] = raw.quats[i].map(f64::from);
        let quat = (turn * DQuat::from_xyzw(x, y, z, w)).normalize().as_quat();
        raw.quats[i] = [quat.w, quat.x, quat.y, quat.z];
    }
    checked(raw)
}

/// Does `work` with a trainer of `set`: on a device first. What that has no room for, or what is
/// lost with it, is done over.
fn with_trainer<T>(
    renderer: &dyn DifferentiableRenderer,
    set: &TrainingSet<'_>,
    options: &RefineOptions,
    mut work: impl FnMut(&mut dyn Trainer) -> Result<T>,
) -> Result<T> {
    let made = renderer
        .trainer(set, options.device_bytes_max)
        .and_then(|trainer| trainer.map(|mut it| work(&mut *it)).transpose());
    match made {
        Ok(None) => {}
        Ok(Some(made)) => return Ok(made),
        Err(error) if is_of_device(error.code()) => {
            tracing::warn!(reason = error.message(), "refined on the processor");
        }
        Err(error) => return Err(error),
    }
    work(&mut HostTrainer::new(renderer, set)?)
}

/// Photos for a trainer, each with a camera of its own.
fn training_photos<'a>(start: &Scene, photos: &'a [PosedPhoto]) -> Vec<TrainingPhoto<'a>> {
    let of = |(pose, posed): (usize, &'a PosedPhoto)| {
        let request = plain_view(start, posed.camera);
        TrainingPhoto { photo: &posed.photo, request, pose }
    };
    photos.iter().enumerate().map(of).collect()
}

/// Photos on disk for a trainer, then the same at half their size. Their cameras come after those
/// of the photos that are kept.
fn streamed(start: &Scene, more: &MorePhotos, kept: usize) -> Vec<StreamedPhoto> {
    let whole: Arc<dyn PhotoSource> = more.spool.clone();
    let half: Arc<dyn PhotoSource> = Arc::new(Halved(Arc::clone(&more.spool)));
    let of = |source: &Arc<dyn PhotoSource>, camera: fn(Camera) -> Camera| {
        let photo = |(at, (&number, of)): (usize, (&usize, &Camera))| StreamedPhoto {
            source: Arc::clone(source),
            number,
            request: plain_view(start, camera(*of)),
            pose: kept + at,
        };
        more.numbers.iter().zip(more.cameras()).enumerate().map(photo).collect::<Vec<_>>()
    };
    [of(&whole, |camera| camera), of(&half, halved_camera)].concat()
}

/// How near what `gaussians` show, over what is behind those of `start`, is to photos that are not
/// in them; `None` of no photo.
///
/// # Errors
/// What the renderer says.
pub fn judged_as_plain(
    renderer: &dyn DifferentiableRenderer,
    start: &Scene,
    gaussians: &Gaussians,
    held_out: &[PosedPhoto],
) -> Result<Option<Judged>> {
    let held_out: Vec<HeldOutPhoto> = held_out.par_iter().map(HeldOutPhoto::new).collect();
    judged(&held_out, |camera| renderer.render(gaussians, &plain_view(start, camera)))
}

/// How near a scene as it is served, in layers where it has some, is to photos that are not in it;
/// `None` of no photo.
///
/// # Errors
/// What the renderer says.
pub fn judged_as_served(
    renderer: &dyn Renderer,
    scene: &Scene,
    held_out: &[PosedPhoto],
) -> Result<Option<Judged>> {
    let held_out: Vec<HeldOutPhoto> = held_out.par_iter().map(HeldOutPhoto::new).collect();
    judged(&held_out, |camera| renderer.render(&scene.gaussians, &served_at(scene, camera)))
}

/// How near a scene is to a photo of its own when what this one gave it is left out.
///
/// # Errors
/// Those of the renderer.
pub(crate) fn judged_without(
    renderer: &dyn Renderer,
    scene: &Scene,
    number: usize,
    photo: &PosedPhoto,
) -> Result<Option<Judged>> {
    // The Gaussians are shared: a renderer that has them has nothing to prepare.
    let mut scene = scene.clone();
    if let Some(focal) = scene.meta.report.network_focal_px.get_mut(number) {
        *focal = 0.0;
    }
    judged(&[HeldOutPhoto::new(photo)], |camera| {
        let mut view = served_at(&scene, camera);
        if let Some(source) = Arc::make_mut(&mut view.sources).get_mut(number) {
            source.layer = Layer::LeftOut;
        }
        renderer.render(&scene.gaussians, &view)
    })
}

/// A view of colour of a scene as it is served.
fn served_at(scene: &Scene, camera: Camera) -> RenderRequest {
    let near = default_near(scene.meta.report.median_depth);
    served(scene, RenderRequest::plain(camera, Kinds::COLOR, near))
}

/// How near what `draw` gives is to photos, colours as 8 bits hold them; `None` of no photo.
fn judged(
    photos: &[HeldOutPhoto],
    mut draw: impl FnMut(Camera) -> Result<Frame>,
) -> Result<Option<Judged>> {
    let mut sum = Judged { psnr: 0.0, ssim: 0.0 };
    for photo in photos {
        let mut color = draw(photo.camera)?.color.unwrap_or_default();
        color.iter_mut().flatten().for_each(|v| *v = v.clamp(0.0, 1.0));
        let (width, valid) = (photo.camera.intrinsics.width as usize, photo.valid.as_deref());
        sum.psnr += psnr(&color, &photo.rgb, valid);
        sum.ssim += 1.0 - photo_loss(&color, &photo.rgb, width, valid, 1.0).value;
    }
    let count = photos.len() as f64;
    Ok((count > 0.0).then(|| Judged { psnr: sum.psnr / count, ssim: sum.ssim / count }))
}

/// The scene's median depth, world units; 1 where it has none.
pub(crate) fn extent(start: &Scene) -> f64 {
    let extent = start.meta.report.median_depth;
    if extent.is_finite() && extent > 0.0 { extent } else { 1.0 }
}

/// The rates at first, means in world units.
fn rates_of(start: &Scene, options: &RefineOptions) -> LearningRates {
    #[expect(clippy::cast_possible_truncation, reason = "a length")]
    let extent = extent(start) as f32;
    let rates = LearningRates { means: options.rates.means * extent, ..options.rates };
    rates.scaled(options.rate)
}

/// The same for cameras.
fn pose_rates(start: &Scene, options: &RefineOptions) -> PoseRates {
    #[expect(clippy::cast_possible_truncation, reason = "a length")]
    let extent = extent(start) as f32;
    PoseRates { turn: options.pose_rate, shift: options.pose_rate * extent }
}

/// The photos at half their size, where they are large enough.
fn coarse_copies(photos: &[PosedPhoto], options: &RefineOptions) -> Vec<PosedPhoto> {
    let longer = |posed: &PosedPhoto| posed.photo.width.max(posed.photo.height);
    let least = photos.iter().map(longer).min().unwrap_or(0) / 2;
    if least < options.coarse_side_min {
        return Vec::new();
    }
    let half = |posed: &PosedPhoto| PosedPhoto {
        photo: halved(&posed.photo),
        camera: halved_camera(posed.camera),
        ..posed.clone()
    };
    photos.par_iter().map(half).collect()
}

/// Most Gaussians that such photos can tell apart.
fn most_gaussians(photos: &[PosedPhoto], options: &RefineOptions) -> usize {
    let pixels = |posed: &PosedPhoto| posed.photo.width as usize * posed.photo.height as usize;
    let most = photos.iter().map(pixels).max().unwrap_or(0);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a number of them")]
    let shown = (most as f32 * options.gaussians_a_pixel) as usize;
    options.gaussians_max.min(shown.max(options.gaussians_first))
}

/// Whether a device was at fault.
fn is_of_device(code: ErrorCode) -> bool {
    matches!(code, ErrorCode::GpuUnavailable | ErrorCode::LimitExceeded)
}

/// What each step does.
#[derive(Clone, Debug)]
struct Course<'a> {
    options: &'a RefineOptions,
    /// Whether nothing tells when to stop.
    is_few: bool,
    /// Photos that the trainer keeps; behind them it has their smaller copies, where they are used.
    kept: usize,
    /// Photos that it streams, behind those; behind them their smaller copies.
    streamed: usize,
    has_coarse: bool,
    coarse_share: f32,
    /// Gaussians now, and most of them.
    gaussians: usize,
    gaussians_max: usize,
    /// At first.
    rates: LearningRates,
    poses: PoseRates,
    /// Photos that come next, the last one first.
    order: Vec<usize>,
    random: u64,
    /// Steps after which some are added again.
    grows_at: u32,
}

impl Course<'_> {
    /// Takes steps until the budget is spent. How many, and how long they took.
    fn run(
        mut self,
        trainer: &mut dyn Trainer,
        pace: &mut dyn FnMut(f32) -> Result<()>,
    ) -> Result<(u32, Duration)> {
        let (budget, begun) = (self.options.budget, Instant::now());
        let mut clock = Clock { budget, begun, waited: Duration::ZERO };
        let mut steps = 0;
        loop {
            let spent = clock.spent(steps);
            let paused = Instant::now();
            pace(spent)?;
            clock.waited += paused.elapsed();
            if spent >= 1.0 || (self.is_few && steps >= UNWATCHED_STEPS_MAX) {
                return Ok((steps, clock.worked()));
            }
            if let Some((photos, until)) = self.growth(steps, spent) {
                self.gaussians = trainer.grow(&photos, until)?;
                tracing::debug!(steps, gaussians = self.gaussians, "grown");
            }
            let step = self.step(steps, spent);
            steps += 1;
            trainer.step(&self.next_photos(spent), &step)?;
        }
    }

    /// Where Gaussians are to be added before the next step: photos that say where, and how many
    /// there are to be then.
    fn growth(&mut self, steps: u32, spent: f32) -> Option<(Vec<usize>, usize)> {
        let [from, to] = GROWS_BETWEEN;
        let growth = self.options.growth;
        let grows = growth > 0.0 && (from..to).contains(&spent) && !self.is_few;
        let pays = steps as f32 >= GROWS_FROM_STEPS * spent;
        if !grows || !pays || steps < self.grows_at {
            return None;
        }
        self.grows_at = steps + GROWS_EVERY;
        let photos = shuffled(self.photos(), &mut self.random).into_iter().take(GROWTH_PHOTOS);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share")]
        let more = (self.gaussians as f32 * growth) as usize;
        let until = self.gaussians_max.min(self.gaussians + more);
        Some((photos.map(|i| self.copy_of(i, spent)).collect(), until))
    }

    /// Photos of the next step: all of them by turns, each time in another order.
    fn next_photos(&mut self, spent: f32) -> Vec<usize> {
        let batch = self.options.batch;
        let next = |_| {
            if self.order.is_empty() {
                self.order = shuffled(self.photos(), &mut self.random);
            }
            let next = self.order.pop().unwrap_or_default();
            self.copy_of(next, spent)
        };
        (0..batch).map(next).collect()
    }

    /// All photos to learn.
    fn photos(&self) -> usize {
        self.kept + self.streamed
    }

    /// The trainer's number of a photo in the size that is learnt now.
    fn copy_of(&self, photo: usize, spent: f32) -> usize {
        let is_coarse = spent < self.coarse_share;
        let Some(streamed) = photo.checked_sub(self.kept) else {
            return if is_coarse { self.kept + photo } else { photo };
        };
        let first = self.kept * if self.has_coarse { 2 } else { 1 };
        first + streamed + if is_coarse { self.streamed } else { 0 }
    }

    /// How the step after so many moves what it moves.
    fn step(&self, steps: u32, spent: f32) -> TrainingStep {
        let expected = steps as f32 / spent / self.photos() as f32;
        let rate = LAST_RATE.powf(spent) * if self.is_few { 1.0 } else { rate_factor(expected) };
        let prunes = (steps + 1).is_multiple_of(self.options.prune_every);
        TrainingStep {
            rates: self.rates.scaled(rate),
            exposure: EXPOSURE_RATE * rate,
            poses: self.poses.scaled(rate),
            opacity_min: if prunes { self.options.opacity_min } else { 0.0 },
        }
    }
}

/// The next number of a row that looks random (`SplitMix64`, Steele et al. 2014).
fn next(random: &mut u64) -> u64 {
    *random = random.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut z = *random;
    z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ z >> 31
}

/// The numbers under `count` in a random order.
fn shuffled(count: usize, random: &mut u64) -> Vec<usize> {
    let mut order: Vec<(u64, usize)> = (0..count).map(|i| (next(random), i)).collect();
    order.sort_unstable();
    order.into_iter().map(|(_, i)| i).collect()
}

/// At most `most` of the Gaussians, chosen at random; as much wider as there are fewer, so that
/// together they cover what all did.
///
/// # Errors
/// `internal` where they cannot be Gaussians any more.
pub fn fewer(all: &Gaussians, most: usize, seed: u64) -> Result<Gaussians> {
    if all.len() <= most {
        return Ok(all.clone());
    }
    let (mut keep, mut random) = (vec![false; all.len()], seed);
    shuffled(all.len(), &mut random).into_iter().take(most).for_each(|i| keep[i] = true);
    let wider = (all.len() as f32 / most as f32).sqrt();
    let mut raw = all.only(|i| keep[i]).into_raw();
    raw.scales.iter_mut().flatten().for_each(|scale| *scale *= wider);
    checked(raw)
}
