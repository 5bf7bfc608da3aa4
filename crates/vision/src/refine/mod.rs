//! Refinement: gradient steps that bring a scene's Gaussians closer to its photos.
//!
//! In: a scene and photos. Out: better Gaussians, version by version. A step
//! draws one photo or several, compares ([`photo_loss`]), goes back through the renderer
//! ([`segsplat_render::backward`]) and moves what the photo shows ([`LearningRates`]). A gain and a
//! bias for each photo and channel take up its exposure. Gaussians that become transparent are
//! dropped as it goes.
//!
//! **Held out.** Of five photos and more, every eighth is held out ([`held_out`]): the steps never
//! see it, and a version counts as better only where its PSNR on these photos is over that of the
//! scene as it is served. They must not be in the Gaussians that come in either: make the scene of
//! the others ([`split`]).
//!
//! That says whether it helps and how many steps are good. What is served then is refined with as
//! many steps from a scene of all photos, so that it lacks none.
//!
//! **One set.** A scene that comes in may be served in layers and with magnification. What comes
//! out is plain: the same Gaussians for every view and for other programs.

mod adam;
mod loss;

use std::time::{Duration, Instant};

use rayon::prelude::*;
use segsplat_render::{
    Background, Frame, Kinds, RenderRequest,
    backward::{DifferentiableRenderer, FrameGradients, Gradients},
    compare::psnr,
    constants::OWN_SIZE,
    plan::{default_near, served},
};

pub use self::{
    adam::LearningRates,
    loss::{PhotoLoss, photo_loss},
};
use crate::{
    error::{Error, Result},
    point,
    refine::adam::{Adam, Moments},
    scene::{BLUR_PX2, Camera, Gaussians, PosedPhoto, RefineReport, Scene},
};

/// Fewest photos of which one is held out.
pub const HOLDS_OUT_FROM: usize = 5;
/// Every so many photos one is held out.
pub const HELD_OUT_EVERY: usize = 8;
/// Most steps of a scene of few photos, where none is held out to tell when to stop.
pub const UNWATCHED_STEPS_MAX: u32 = 30;
/// Looks at the held-out photos in a whole budget.
const LOOKS: u32 = 10;
/// Looks without a better version after which it stops.
const PATIENCE: u32 = 3;
/// Rates as multiples of those of 3DGS, which takes 30,000 steps: docs/adr/0039.
const RATE: f32 = 2.5;
/// Rates fall to this share over the budget.
const LAST_RATE: f32 = 0.1;
/// How fast an exposure moves, and what it costs to be another than gain 1, bias 0.
const EXPOSURE_RATE: f32 = 5e-3;
const EXPOSURE_COST: f32 = 1.0;
/// Pixels of a task.
const PIXELS_A_TASK: usize = 1 << 13;
/// Largest change of a gain, or bias, of a photo.
const EXPOSURE_MAX: f32 = 0.5;

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
    /// Longer side at which the photos are learnt, pixels: what is learnt smaller than it is shown
    /// has gaps.
    pub side: u32,
    /// How far numbers move.
    pub rates: LearningRates,
    /// Most Gaussians to begin with: of more, this many are chosen at random and made wider.
    pub gaussians_max: usize,
    /// Gaussians under this opacity are dropped.
    pub opacity_min: f32,
    /// Steps between two times of dropping.
    pub prune_every: u32,
    /// Share of SSIM in the loss, 0..1.
    pub ssim_share: f32,
    /// Seed of all that is random.
    pub seed: u64,
}

impl Default for RefineOptions {
    fn default() -> Self {
        Self {
            budget: RefineBudget::steps(400),
            batch: 1,
            side: 640,
            rates: LearningRates::default().scaled(RATE),
            gaussians_max: 150_000,
            opacity_min: 0.01,
            prune_every: 50,
            ssim_share: 0.2,
            seed: 1,
        }
    }
}

/// A version of a scene.
#[derive(Clone, Debug)]
pub struct RefinedVersion {
    /// Its Gaussians: a part of those that came in, moved, in their order. Entries and sources came
    /// with them.
    pub gaussians: Gaussians,
    /// How good it is; which photos are held out is for the caller to say.
    pub report: RefineReport,
}

/// Numbers of the photos that are held out of `count`: the fourth and every eighth from there on,
/// none of fewer than [`HOLDS_OUT_FROM`].
#[must_use]
pub fn held_out(count: usize) -> Vec<usize> {
    if count < HOLDS_OUT_FROM {
        return Vec::new();
    }
    (HELD_OUT_EVERY / 2 - 1..count).step_by(HELD_OUT_EVERY).collect()
}

/// Photos to learn from, and those held out: what makes the scene that is refined must see the
/// first alone.
#[must_use]
pub fn split(photos: Vec<PosedPhoto>) -> (Vec<PosedPhoto>, Vec<PosedPhoto>) {
    let held = held_out(photos.len());
    let (mut learnt, mut out) = (Vec::new(), Vec::new());
    for (i, photo) in photos.into_iter().enumerate() {
        let to = if held.contains(&i) { &mut out } else { &mut learnt };
        to.push(photo);
    }
    (learnt, out)
}

/// A photo as the loss needs it.
struct Target {
    camera: Camera,
    /// `[H * W]` 0..1.
    rgb: Vec<[f32; 3]>,
    valid: Option<Vec<bool>>,
    exposure: Exposure,
}

impl Target {
    fn new(posed: &PosedPhoto) -> Self {
        let pixels = posed.photo.rgb.chunks_exact(3);
        let rgb = pixels.map(|c| [c[0], c[1], c[2]].map(|v| f32::from(v) / 255.0)).collect();
        let valid = posed.photo.valid.clone();
        Self { camera: posed.camera, rgb, valid, exposure: Exposure::default() }
    }

    fn width(&self) -> usize {
        self.camera.intrinsics.width as usize
    }
}

/// What makes the colours of the scene those of a photo: gain and bias of each channel.
#[derive(Clone, Copy, Debug)]
struct Exposure {
    gain: [f32; 3],
    bias: [f32; 3],
    moments: [[Moments; 2]; 3],
    count: u16,
}

impl Default for Exposure {
    fn default() -> Self {
        Self { gain: [1.0; 3], bias: [0.0; 3], moments: Default::default(), count: 0 }
    }
}

impl Exposure {
    fn of(&self, color: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|c| self.gain[c] * color[c] + self.bias[c])
    }

    /// Moves by what the loss says of the exposed picture.
    fn step(&mut self, picture: &[[f32; 3]], by: &[[f32; 3]], rate: f32) {
        self.count = self.count.saturating_add(1);
        let parts: Vec<[[f32; 3]; 2]> = picture
            .par_chunks(PIXELS_A_TASK)
            .zip(by.par_chunks(PIXELS_A_TASK))
            .map(|(picture, by)| {
                let mut sums = [[0.0; 3]; 2];
                for (color, by) in picture.iter().zip(by) {
                    for c in 0..3 {
                        sums[0][c] += color[c] * by[c];
                        sums[1][c] += by[c];
                    }
                }
                sums
            })
            .collect();
        for c in 0..3 {
            let [mut by_gain, mut by_bias] =
                [0, 1].map(|which: usize| parts.iter().map(|part| part[which][c]).sum::<f32>());
            by_gain += 2.0 * EXPOSURE_COST * (self.gain[c] - 1.0);
            by_bias += 2.0 * EXPOSURE_COST * self.bias[c];
            let [gain, bias] = &mut self.moments[c];
            let moved = self.gain[c] - rate * gain.step(by_gain, self.count);
            self.gain[c] = moved.clamp(1.0 - EXPOSURE_MAX, 1.0 + EXPOSURE_MAX);
            let moved = self.bias[c] - rate * bias.step(by_bias, self.count);
            self.bias[c] = moved.clamp(-EXPOSURE_MAX, EXPOSURE_MAX);
        }
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

/// A refinement at work.
struct Refinement<'a> {
    renderer: &'a dyn DifferentiableRenderer,
    start: &'a Scene,
    first: &'a Gaussians,
    near: f32,
    extent: f32,
    options: &'a RefineOptions,
    targets: Vec<Target>,
    looks: Vec<Target>,
}

/// Refines `first` on the photos that are learnt and watches the held-out ones. `start` is what is
/// served of the learnt photos alone, and `first` the same as one set of Gaussians. The photos are
/// used at the size that they have. Before each step `pace` gets the share of the budget that is
/// spent, 0..1; it may wait, which is not counted, and its error ends the work. Each better version
/// goes to `publish`. Returns the best one: `start` itself where none was better.
///
/// Without held-out photos the last version is the one. Of fewer than [`HOLDS_OUT_FROM`] at most
/// [`UNWATCHED_STEPS_MAX`] steps are taken.
///
/// # Errors
/// `invalid_request` for options out of range; what the renderer, `pace` or `publish` says. What
/// was published stays.
pub fn refine(
    renderer: &dyn DifferentiableRenderer,
    (start, first): (&Scene, &Gaussians),
    (learnt, held_out): (&[PosedPhoto], &[PosedPhoto]),
    options: &RefineOptions,
    pace: &mut dyn FnMut(f32) -> Result<()>,
    publish: &mut dyn FnMut(&RefinedVersion) -> Result<()>,
) -> Result<RefinedVersion> {
    if options.batch == 0 || options.prune_every == 0 || options.gaussians_max == 0 {
        return Err(Error::invalid("refine: batch, prune_every and gaussians_max must be over 0"));
    }
    let extent = start.meta.report.median_depth;
    #[expect(clippy::cast_possible_truncation, reason = "a length")]
    let extent_f32 = if extent.is_finite() && extent > 0.0 { extent as f32 } else { 1.0 };
    let work = Refinement {
        renderer,
        start,
        first,
        near: default_near(extent),
        extent: extent_f32,
        options,
        targets: learnt.par_iter().map(Target::new).collect(),
        looks: held_out.par_iter().map(Target::new).collect(),
    };
    work.run(pace, publish)
}

impl Refinement<'_> {
    fn run(
        mut self,
        pace: &mut dyn FnMut(f32) -> Result<()>,
        publish: &mut dyn FnMut(&RefinedVersion) -> Result<()>,
    ) -> Result<RefinedVersion> {
        let (start, options) = (self.start, self.options);
        let begun = Instant::now();
        let mut clock = Clock { budget: options.budget, begun, waited: Duration::ZERO };
        let watched = !self.looks.is_empty();
        let earlier = start.meta.report.refinement.clone();
        let report = match &earlier {
            Some(earlier) => earlier.clone(),
            None => self.as_served()?,
        };
        let before = RefineReport { psnr_before: report.psnr_before, ..report.clone() };
        let mut best = RefinedVersion { gaussians: start.gaussians.clone(), report };
        if self.targets.is_empty() || self.first.is_empty() {
            return Ok(best);
        }
        let mut random = options.seed;
        let mut gaussians =
            fewer(&blurred(self.first, start, options.side)?, options, &mut random)?;
        let mut adam = Adam::new(&gaussians);
        let mut order: Vec<usize> = Vec::new();
        let (mut steps, mut looked, mut waited, mut highest) = (0, 0, 0, None);
        let mut found = (Gradients::default(), Gradients::default());
        loop {
            let spent = clock.spent(steps);
            let paused = Instant::now();
            pace(spent)?;
            clock.waited += paused.elapsed();
            let few = self.targets.len() < HOLDS_OUT_FROM && steps >= UNWATCHED_STEPS_MAX;
            let last = spent >= 1.0 || (!watched && few);
            if last || (watched && spent * LOOKS as f32 >= (looked + 1) as f32) {
                looked += 1;
                waited += 1;
                let after = self.look(&gaussians, &|camera| self.request(camera))?;
                if after > highest {
                    (highest, waited) = (after, 0);
                }
                tracing::debug!(steps, psnr = after, gaussians = gaussians.len(), "looked");
                let better = match (after, best.report.psnr_after) {
                    (Some(after), Some(before)) => after > before,
                    _ => last && steps > 0,
                };
                if better {
                    let report = RefineReport {
                        steps: before.steps + steps,
                        seconds: before.seconds + clock.worked().as_secs_f64(),
                        psnr_after: after,
                        gaussians_after: gaussians.len() as u64,
                        ..before.clone()
                    };
                    best = RefinedVersion { gaussians: gaussians.clone(), report };
                    publish(&best)?;
                }
                if last || waited >= PATIENCE {
                    return Ok(best);
                }
            }
            let rate = LAST_RATE.powf(spent);
            for photo in 0..options.batch {
                if order.is_empty() {
                    order = shuffled(self.targets.len(), &mut random);
                }
                let Some(at) = order.pop() else { break };
                let into = if photo == 0 { &mut found.0 } else { &mut found.1 };
                self.photo(&gaussians, at, rate, into)?;
                if photo > 0 {
                    add(&mut found.0, &found.1);
                }
            }
            let rates = options.rates.scaled(rate);
            gaussians = adam.step(gaussians, &found.0, &rates, self.extent)?;
            steps += 1;
            if steps.is_multiple_of(options.prune_every) {
                gaussians = adam.prune(&gaussians, options.opacity_min);
            }
        }
    }

    /// The report of the scene before any step: as it is served, in layers where it has some.
    fn as_served(&self) -> Result<RefineReport> {
        let (scene, count) = (self.start, self.start.gaussians.len() as u64);
        let view = |camera| served(scene, RenderRequest::plain(camera, Kinds::COLOR, self.near));
        let psnr = self.look(&scene.gaussians, &view)?;
        let counts = RefineReport {
            gaussians_before: count,
            gaussians_after: count,
            ..RefineReport::default()
        };
        Ok(RefineReport { psnr_before: psnr, psnr_after: psnr, ..counts })
    }

    /// A plain view over what the scene has behind its Gaussians.
    fn request(&self, camera: Camera) -> RenderRequest {
        let plain = RenderRequest::plain(camera, Kinds::COLOR, self.near);
        let Background::Backdrop(_) = served(self.start, plain.clone()).background else {
            return RenderRequest { background: Background::BLACK, ..plain };
        };
        RenderRequest { background: Background::Backdrop(self.start.backdrop.clone()), ..plain }
    }

    /// Mean PSNR on the held-out photos, colours as 8 bits hold them.
    fn look(
        &self,
        gaussians: &Gaussians,
        view: &dyn Fn(Camera) -> RenderRequest,
    ) -> Result<Option<f64>> {
        let mut sum = 0.0;
        for target in &self.looks {
            let frame = self.renderer.render(gaussians, &view(target.camera))?;
            let mut color = frame.color.unwrap_or_default();
            color.iter_mut().flatten().for_each(|v| *v = v.clamp(0.0, 1.0));
            sum += psnr(&color, &target.rgb, target.valid.as_deref());
        }
        Ok((!self.looks.is_empty()).then(|| sum / self.looks.len() as f64))
    }

    /// What one photo says; its exposure moves.
    fn photo(
        &mut self,
        gaussians: &Gaussians,
        at: usize,
        rate: f32,
        into: &mut Gradients,
    ) -> Result<()> {
        let request = self.request(self.targets[at].camera);
        let ssim_share = self.options.ssim_share;
        let target = &mut self.targets[at];
        let mut loss = |frame: &Frame| {
            let plain = frame.color.as_deref().unwrap_or_default();
            let shown: Vec<[f32; 3]> = plain.par_iter().map(|c| target.exposure.of(*c)).collect();
            let width = target.width();
            let valid = target.valid.as_deref();
            let mut by = photo_loss(&shown, &target.rgb, width, valid, ssim_share).gradient;
            let gain = target.exposure.gain;
            target.exposure.step(plain, &by, EXPOSURE_RATE * rate);
            by.par_iter_mut().for_each(|by| *by = std::array::from_fn(|c| by[c] * gain[c]));
            Ok(FrameGradients { color: Some(by), ..FrameGradients::default() })
        };
        self.renderer.backward(gaussians, &request, &mut loss, into)?;
        Ok(())
    }
}

/// Adds the gradients of another photo.
fn add(sum: &mut Gradients, more: &Gradients) {
    fn all<const N: usize>(sum: &mut [[f32; N]], more: &[[f32; N]]) {
        let numbers = sum.as_flattened_mut().iter_mut().zip(more.as_flattened());
        numbers.for_each(|(sum, more)| *sum += more);
    }
    all(&mut sum.means, &more.means);
    all(&mut sum.quats, &more.quats);
    all(&mut sum.scales, &more.scales);
    all(&mut sum.sh, &more.sh);
    sum.opacities.iter_mut().zip(&more.opacities).for_each(|(sum, more)| *sum += more);
    sum.seen.iter_mut().zip(&more.seen).for_each(|(sum, more)| *sum |= more);
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

/// Gaussians of a scene with its magnification: what its views add to those that are shown larger
/// than in the network's picture ([`segsplat_render::plan`]) is added for good, for photos whose
/// longer side is `side`.
fn blurred(gaussians: &Gaussians, scene: &Scene, side: u32) -> Result<Gaussians> {
    let (report, cameras) = (&scene.meta.report, &scene.meta.cameras);
    if !report.method.magnify {
        return Ok(gaussians.clone());
    }
    let origin = gaussians.origin();
    // Of each photo: centre, axis, width of a source pixel at depth 1, and share of the blur lost.
    let rows = cameras.iter().zip(&report.network_focal_px).map(|(photo, focal)| {
        let (lens, pose) = (photo.camera.intrinsics, &photo.camera.camera_to_world);
        let shown = lens.fx * (f64::from(side) / f64::from(lens.width.max(lens.height))).min(1.0);
        let larger = (shown / focal / f64::from(OWN_SIZE)).max(1.0);
        let lost = f64::from(BLUR_PX2) * (1.0 - larger.powi(-2));
        (*focal > 0.0 && lost > 0.0)
            .then(|| (pose.center() - origin, pose.axis(), lost / focal / focal))
    });
    let rows: Vec<_> = rows.collect();
    let mut raw = gaussians.as_raw().clone();
    let scales = raw.scales.par_iter_mut().zip(&raw.means).zip(&raw.source);
    scales.for_each(|((scales, mean), source)| {
        let Some(Some((center, axis, lost))) = rows.get(usize::from(source.view)) else { return };
        let depth = (point(*mean) - *center).dot(*axis);
        #[expect(clippy::cast_possible_truncation, reason = "scales are f32")]
        let wider = (lost * depth * depth) as f32;
        for scale in scales {
            *scale = (*scale * *scale + wider).sqrt().min(Gaussians::SCALE_MAX);
        }
    });
    adam::checked(raw)
}

/// At most as many of the Gaussians as `options` say, chosen at random; as much wider as there are
/// fewer, so that together they cover what all did.
fn fewer(all: &Gaussians, options: &RefineOptions, random: &mut u64) -> Result<Gaussians> {
    let most = options.gaussians_max;
    if all.len() <= most {
        return Ok(all.clone());
    }
    let mut keep = vec![false; all.len()];
    shuffled(all.len(), random).into_iter().take(most).for_each(|i| keep[i] = true);
    let wider = (all.len() as f32 / most as f32).sqrt();
    let mut raw = all.only(|i| keep[i]).into_raw();
    raw.scales.iter_mut().flatten().for_each(|scale| *scale *= wider);
    adam::checked(raw)
}
