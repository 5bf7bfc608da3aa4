//! Refinement: gradient steps that bring a scene's Gaussians closer to its photos.
//!
//! In: Gaussians, what lies behind them, photos. Out: better Gaussians, version by version. A step
//! draws one photo or several, compares ([`photo_loss`]), goes back through the renderer
//! ([`segsplat_render::backward`]) and moves what the photo shows ([`LearningRates`]). A gain and a
//! bias for each photo and channel take up its exposure. Gaussians that become transparent are
//! dropped as it goes.
//!
//! **Held out.** Of five photos and more, every eighth is held out ([`held_out`]): the steps never
//! see it, and a version counts as better only where its PSNR on these photos is. They must not be
//! in the Gaussians that come in either: make the scene of the others ([`split`]).

mod adam;
mod loss;

use std::{
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use rayon::prelude::*;
use segsplat_render::{
    Background, Frame, Kinds, RenderRequest,
    backward::{DifferentiableRenderer, FrameGradients, Gradients},
    compare::psnr,
    plan::default_near,
};

pub use self::{
    adam::LearningRates,
    loss::{PhotoLoss, photo_loss},
};
use crate::{
    error::{Error, Result},
    refine::adam::{Adam, Moments},
    scene::{Backdrop, Camera, Gaussians, PosedPhoto, unless_cancelled},
};

/// Fewest photos of which one is held out.
pub const HOLDS_OUT_FROM: usize = 5;
/// Every so many photos one is held out.
pub const HELD_OUT_EVERY: usize = 8;
/// Most steps where no photo tells when to stop.
pub const UNWATCHED_STEPS_MAX: u32 = 30;
/// Looks at the held-out photos in a whole budget.
const LOOKS: u32 = 10;
/// Looks without a better version after which it stops.
const PATIENCE: u32 = 3;
/// Rates fall to this share over the budget.
const LAST_RATE: f32 = 0.1;
/// How fast an exposure moves, and what it costs to be another than gain 1, bias 0.
const EXPOSURE_RATE: f32 = 5e-3;
const EXPOSURE_COST: f32 = 1.0;
/// Largest change of a gain, or bias, of a photo.
const EXPOSURE_MAX: f32 = 0.5;

/// How long to refine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RefineBudget {
    /// So many steps: the result is the same on every machine with the same lanes.
    Steps(u32),
    /// So much time.
    Time(Duration),
}

/// How to refine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RefineOptions {
    /// How long.
    pub budget: RefineBudget,
    /// Photos of a step.
    pub batch: usize,
    /// How far numbers move.
    pub rates: LearningRates,
    /// Most Gaussians to begin with: of more, this many are chosen at random and made wider.
    pub gaussians_max: usize,
    /// Gaussians under this opacity are dropped.
    pub opacity_min: f32,
    /// Steps between two times of dropping.
    pub prune_every: u32,
    /// Seed of all that is random.
    pub seed: u64,
}

impl Default for RefineOptions {
    fn default() -> Self {
        Self {
            budget: RefineBudget::Steps(400),
            batch: 1,
            rates: LearningRates::default(),
            gaussians_max: 150_000,
            opacity_min: 0.01,
            prune_every: 50,
            seed: 1,
        }
    }
}

/// What was refined and how good it is.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RefineReport {
    /// Steps behind this version.
    pub steps: u32,
    /// Numbers of the held-out photos.
    pub held_out: Vec<usize>,
    /// PSNR on the held-out photos before the first step, dB; `None` where none is held out.
    pub psnr_before: Option<f64>,
    /// The same for this version.
    pub psnr_after: Option<f64>,
}

/// A version of a scene.
#[derive(Clone, Debug)]
pub struct RefinedVersion {
    /// Its Gaussians: a part of those that came in, moved, in their order. Entries and sources came
    /// with them.
    pub gaussians: Gaussians,
    /// How good it is.
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
pub fn split(photos: &[PosedPhoto]) -> (Vec<PosedPhoto>, Vec<PosedPhoto>) {
    let held = held_out(photos.len());
    let (mut learnt, mut out) = (Vec::new(), Vec::new());
    for (i, photo) in photos.iter().enumerate() {
        let to = if held.contains(&i) { &mut out } else { &mut learnt };
        to.push(photo.clone());
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
        for c in 0..3 {
            let (mut by_gain, mut by_bias) = (0.0, 0.0);
            for (color, by) in picture.iter().zip(by) {
                by_gain += color[c] * by[c];
                by_bias += by[c];
            }
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
}

impl Clock {
    /// Share of the budget that is spent after `steps`, 0..1.
    fn spent(&self, steps: u32) -> f32 {
        let share = match self.budget {
            RefineBudget::Steps(all) => f64::from(steps) / f64::from(all.max(1)),
            RefineBudget::Time(all) => {
                self.begun.elapsed().as_secs_f64() / all.as_secs_f64().max(1e-3)
            }
        };
        #[expect(clippy::cast_possible_truncation, reason = "a share")]
        let share = share.min(1.0) as f32;
        share
    }
}

/// A refinement at work.
struct Refinement<'a> {
    renderer: &'a dyn DifferentiableRenderer,
    backdrop: Arc<Backdrop>,
    near: f32,
    extent: f32,
    options: &'a RefineOptions,
    targets: Vec<Target>,
    looks: Vec<Target>,
}

/// Refines `start` on `learnt` and watches `held_out`, none of which is in `start`. `extent` is the
/// scene's median depth, world units. The photos are used at the size that they have. Each better
/// version goes to `publish`. Returns the best one: `start` itself where none was better.
///
/// Without held-out photos at most [`UNWATCHED_STEPS_MAX`] steps are taken, and the last version is
/// the one.
///
/// # Errors
/// `cancelled` once `cancel` is true, which is read before each step; `invalid_request` for options
/// out of range; what the renderer or `publish` says. What was published stays.
#[expect(clippy::too_many_arguments, reason = "each is another thing")]
pub fn refine(
    renderer: &dyn DifferentiableRenderer,
    start: &Gaussians,
    backdrop: &Arc<Backdrop>,
    (learnt, held_out): (&[PosedPhoto], &[PosedPhoto]),
    extent: f64,
    options: &RefineOptions,
    cancel: &AtomicBool,
    publish: &mut dyn FnMut(&RefinedVersion) -> Result<()>,
) -> Result<RefinedVersion> {
    if options.batch == 0 || options.prune_every == 0 || options.gaussians_max == 0 {
        return Err(Error::invalid("refine: batch, prune_every and gaussians_max must be over 0"));
    }
    #[expect(clippy::cast_possible_truncation, reason = "a length")]
    let extent_f32 = if extent.is_finite() && extent > 0.0 { extent as f32 } else { 1.0 };
    let work = Refinement {
        renderer,
        backdrop: Arc::clone(backdrop),
        near: default_near(extent),
        extent: extent_f32,
        options,
        targets: learnt.par_iter().map(Target::new).collect(),
        looks: held_out.par_iter().map(Target::new).collect(),
    };
    work.run(start, cancel, publish)
}

impl Refinement<'_> {
    fn run(
        mut self,
        start: &Gaussians,
        cancel: &AtomicBool,
        publish: &mut dyn FnMut(&RefinedVersion) -> Result<()>,
    ) -> Result<RefinedVersion> {
        let options = self.options;
        let clock = Clock { budget: options.budget, begun: Instant::now() };
        let watched = !self.looks.is_empty();
        let psnr_before = self.look(start)?;
        let report =
            RefineReport { psnr_before, psnr_after: psnr_before, ..RefineReport::default() };
        let mut best = RefinedVersion { gaussians: start.clone(), report };
        if self.targets.is_empty() || start.is_empty() {
            return Ok(best);
        }
        let mut random = options.seed;
        let mut gaussians = fewer(start, options.gaussians_max, &mut random)?;
        let mut adam = Adam::new(&gaussians);
        let mut order: Vec<usize> = Vec::new();
        let (mut steps, mut looked, mut waited) = (0, 0, 0);
        let mut found = (Gradients::default(), Gradients::default());
        loop {
            unless_cancelled(cancel)?;
            let spent = clock.spent(steps);
            let last = spent >= 1.0 || (!watched && steps >= UNWATCHED_STEPS_MAX);
            if last || (watched && spent * LOOKS as f32 >= (looked + 1) as f32) {
                looked += 1;
                waited += 1;
                let after = self.look(&gaussians)?;
                let better = match (after, best.report.psnr_after) {
                    (Some(after), Some(before)) => after > before,
                    _ => last && steps > 0,
                };
                if better {
                    waited = 0;
                    let report = RefineReport { steps, psnr_after: after, ..best.report };
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

    fn request(&self, camera: Camera) -> RenderRequest {
        let background = Background::Backdrop(Arc::clone(&self.backdrop));
        RenderRequest { background, ..RenderRequest::plain(camera, Kinds::COLOR, self.near) }
    }

    /// Mean PSNR on the held-out photos, colours as 8 bits hold them.
    fn look(&self, gaussians: &Gaussians) -> Result<Option<f64>> {
        let mut sum = 0.0;
        for target in &self.looks {
            let frame = self.renderer.render(gaussians, &self.request(target.camera))?;
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
        let target = &mut self.targets[at];
        let mut loss = |frame: &Frame| {
            let plain = frame.color.as_deref().unwrap_or_default();
            let shown: Vec<[f32; 3]> = plain.iter().map(|c| target.exposure.of(*c)).collect();
            let width = target.width();
            let mut by = photo_loss(&shown, &target.rgb, width, target.valid.as_deref()).gradient;
            let gain = target.exposure.gain;
            target.exposure.step(plain, &by, EXPOSURE_RATE * rate);
            by.iter_mut().for_each(|by| *by = std::array::from_fn(|c| by[c] * gain[c]));
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

/// At most `most` of the Gaussians, chosen at random; as much wider as there are fewer, so that
/// together they cover what all did.
fn fewer(all: &Gaussians, most: usize, random: &mut u64) -> Result<Gaussians> {
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
