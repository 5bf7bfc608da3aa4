//! A whole refinement: first without the photos that are held out, which says whether it helps,
//! then with all, and again with more steps as long as these help. And what it needs of the other
//! stages: photos at the size at which they are learnt, the scene of the photos that are not held
//! out, and semantics that follow other Gaussians.

use std::{
    path::Path,
    sync::{
        atomic::AtomicBool,
        mpsc::{RecvTimeoutError, channel},
    },
    thread,
    time::{Duration, Instant},
};

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use segsplat_render::{DifferentiableRenderer, Kinds, RenderRequest, plan::default_near};

use super::Reconstruction;
use crate::{
    error::Result,
    limits::Limits,
    models::{ResizeFilter, fit},
    photos,
    refine::{
        self, ALIGNING_STEPS, Judged, LearntPhotos, MorePhotos, PhotoSpool, RefineBudget,
        RefineOptions, RefinedVersion, Stepped, UNWATCHED_STEPS_MAX, aligned, carried, covered,
        differences, extent, fewer, held_out, judged_as_plain, judged_as_served, ready,
        unexplained,
    },
    scene::{
        Camera, CameraToWorld, CameraUse, CamerasMode, Gaussians, HealthReport, Method,
        MovedCamera, Photo, PosedPhoto, RefineReport, Scene, SceneCamera, SceneMeta, Semantics,
        Upload,
    },
    semantics::{Views, from_source as assigned},
};

/// Time between two views that keep a device from lowering its clocks, and their longer side,
/// pixels.
const AWAKE_EVERY: Duration = Duration::from_millis(4);
const AWAKE_SIDE: u32 = 64;

/// Longer side at which photos are learnt on a processor, and of smaller copies there, pixels.
const PROCESSOR_SIDE: u32 = 640;
const PROCESSOR_COARSE_SIDE: u32 = 240;
/// Most Gaussians to begin with there, and a factor on all rates: its steps are few, so they are to
/// be short and to go far (docs/adr/0115).
const PROCESSOR_FIRST: usize = 100_000;
const PROCESSOR_RATE: f32 = 1.6;
/// About what a Gaussian of degree 0 takes on a device, with moments, gradients and tile pairs.
const DEVICE_BYTES_A_GAUSSIAN: u64 = 600;

/// Times that each camera is brought to where the others say, before all are learnt.
const SETTLING_ROUNDS: usize = 2;

/// Photos of which the first proof leaves more than this share unexplained, and so many times as
/// much as of the one in the middle, are left out: their cameras cannot be right (docs/adr/0078).
const LEFT_OUT_FROM: f64 = 0.75;
const LEFT_OUT_FACTOR: f64 = 2.0;

/// A proof that differs so many times as much from the held-out photos as from learnt ones is no
/// proof: nothing is published (docs/adr/0073).
const OVERFIT_REFUSED: f64 = 6.0;

/// The work on a version makes all that was done this many times as long.
const LONGER: u32 = 4;
/// Share of all that is left which a proof has, where those before it were not better.
const LAST_PROOF_SHARE: f32 = 0.5;

/// What a refinement came to.
#[derive(Clone, Debug)]
pub struct Refined {
    /// Its figures.
    pub report: RefineReport,
    /// How much the first proof's Gaussians differ from the held-out photos, as a multiple of how
    /// much they differ from the learnt ones beside them; `None` where there was no proof, or
    /// nothing better.
    pub overfit: Option<f64>,
    /// What the held-out photos gained by cameras that fit the first proof ([`Judged::score`]);
    /// `None` where that was not asked.
    pub pose_gain: Option<f64>,
    /// Versions that were published.
    pub versions: u32,
}

/// What the networks make of photos but those of some numbers: [`super::make_for_refinement`].
pub type Remake<'a> = &'a mut dyn FnMut(&[usize]) -> Result<(Reconstruction, Gaussians)>;

/// What a refinement asks of its caller. An error ends it.
#[expect(missing_debug_implementations, reason = "functions have none")]
pub struct RefineCalls<'a> {
    /// The scene without some photos, and the same as one set. The last call is that of all photos.
    pub remake: Remake<'a>,
    /// Finds where the cameras stand by other means than steps, and has the networks run with them:
    /// what `remake` gives from then on is of these. `None`: nothing is found, and nothing changes.
    pub recast: &'a mut dyn FnMut() -> Result<Option<Vec<CameraToWorld>>>,
    /// Reads the photos that only the steps learn, at this longer side at most; asked once.
    pub more: &'a mut dyn FnMut(u32) -> Result<Option<PhotoSpool>>,
    /// Gets the share of the budget that is spent, 0..1, before each step, and may wait.
    pub pace: &'a mut dyn FnMut(f32) -> Result<()>,
    /// Gets each version that is better than the one before, with the scene that it began with.
    pub publish: &'a mut dyn FnMut(&Scene, &RefinedVersion) -> Result<()>,
}

/// Refines `scene`, which was made of `photos`, within the budget of `options`.
///
/// The work is done in parts. The first has few steps, so that a better version is there soon, and
/// each further one makes the work four times as long. A part begins with the proof: a scene
/// without the held-out photos is refined in a share of the time
/// ([`RefineOptions::proof_share`]; half of it where no proof was better yet and no other part
/// follows, docs/adr/0116). Where its PSNR on these photos rises over that of what is served, the
/// scene of all photos is refined in the time of the part that is left, and published.
/// Where the proof of a further part gains less than [`RefineOptions::gain_min`] in PSNR and SSIM
/// together ([`Judged::score`]), the work ends: so more time is never worse. It also ends where the
/// proof overfits, for what its held-out photos gain then, other views lose: with the first
/// version where that one's proof does so ([`RefineOptions::overfit_max`]), which has no more steps
/// than the first part in any time, and before a further one ([`RefineOptions::overfit_further`]).
///
/// The first scene of all photos goes on from the proof's Gaussians, and those of the held-out
/// photos, where the proof explains these nearly as well as photos that it learnt
/// ([`RefineOptions::overfit_max`]); else it begins with those of the networks (docs/adr/0041),
/// where there is time for its steps. Of too few photos none is held out, and few steps are taken.
///
/// **Cameras.** The first proof also says whether cameras are wrong: where the held-out photos gain
/// [`RefineOptions::mends_from`] by cameras that fit the scene of the others, cameras are learnt
/// from then on, and held-out photos are judged where their cameras fit, before as after.
///
/// # Errors
/// Those of `calls` and of [`refine::refine`].
pub fn refined(
    renderer: &dyn DifferentiableRenderer,
    scene: &Scene,
    photos: &[PosedPhoto],
    options: &RefineOptions,
    calls: RefineCalls<'_>,
) -> Result<Refined> {
    let held = held_out(photos.len());
    let options = fitted(options, photos, renderer.is_device());
    let pose_rate = match scene.meta.report.method.camera {
        CameraUse::Given => 0.0,
        CameraUse::Mended => options.pose_rate,
    };
    let options = RefineOptions { pose_rate, ..options };
    let sized = photos.par_iter().map(|photo| at_side(photo, options.side)).collect();
    let given: Vec<CameraToWorld> = photos.iter().map(pose_of).collect();
    let more = (calls.more)(options.side)?.and_then(MorePhotos::of);
    let mut parts = Parts {
        renderer,
        scene,
        photos: sized,
        more,
        made: given.clone(),
        given,
        mends: false,
        left_out: Vec::new(),
        options,
        calls,
        done: Work::default(),
    };
    if held.is_empty() { parts.unwatched() } else { parts.watched(&held) }
}

/// What comes next: a proof, and a version where that is better.
#[derive(Clone, Copy, Debug)]
struct Part {
    budget: RefineBudget,
    /// Share of it that the proof has.
    proof_share: f32,
}

/// Steps that were taken, and their time.
#[derive(Clone, Copy, Debug, Default)]
struct Work {
    steps: u32,
    time: Duration,
}

/// The scene without the photos that are held out, which says how good versions are.
struct Proof<'a> {
    /// Numbers of these photos.
    held: &'a [usize],
    start: Scene,
    /// As far as they are refined.
    gaussians: Gaussians,
    /// How they show the held-out photos.
    judged: Option<Judged>,
    /// PSNR of what is served at these photos.
    before: Option<f64>,
}

impl Proof<'_> {
    fn psnr(&self) -> Option<f64> {
        self.judged.map(|judged| judged.psnr)
    }
}

/// The scene of all photos, as far as it is refined.
struct Whole {
    start: Scene,
    gaussians: Gaussians,
    steps: u32,
}

/// A refinement at work.
struct Parts<'a, 'c> {
    renderer: &'a dyn DifferentiableRenderer,
    scene: &'a Scene,
    /// At the size at which they are learnt, with their cameras as they stand now.
    photos: Vec<PosedPhoto>,
    /// Photos that the networks did not see.
    more: Option<MorePhotos>,
    /// Where their cameras stood.
    given: Vec<CameraToWorld>,
    /// Where those stood that the Gaussians of the networks were made with.
    made: Vec<CameraToWorld>,
    /// Whether cameras are learnt.
    mends: bool,
    /// Photos whose cameras cannot be right.
    left_out: Vec<usize>,
    options: RefineOptions,
    calls: RefineCalls<'c>,
    /// All that was done so far.
    done: Work,
}

impl Parts<'_, '_> {
    /// Few photos, of which none is held out.
    fn unwatched(&mut self) -> Result<Refined> {
        let (start, gaussians) = self.begin(&[])?;
        let steps = self.options.budget.steps.min(UNWATCHED_STEPS_MAX);
        let budget = RefineBudget { steps, ..self.options.budget };
        let options = RefineOptions { budget, ..self.options };
        let made = self.work(&start, &gaussians, &[], &options)?;
        let report = self.report_of(&start, &made, made.steps, [None; 2]);
        let (gaussians, poses) = (made.gaussians, self.poses());
        let version = RefinedVersion { gaussians, report: report.clone(), poses };
        (self.calls.publish)(&start, &version)?;
        Ok(Refined { report, overfit: None, pose_gain: None, versions: 1 })
    }

    /// Photos of which those of the numbers `held` say how good versions are.
    fn watched(&mut self, held: &[usize]) -> Result<Refined> {
        let (start, first) = self.begin(held)?;
        let before = self.judged_before(held, &start)?;
        let mut proof = Proof { held, start, gaussians: first.clone(), judged: None, before };
        let report = self.as_before(before);
        let mut found = Refined { report, overfit: None, pose_gain: None, versions: 0 };
        let (mut first, mut whole) = (Some(first), None::<Whole>);
        while let Some(part) = self.next_part(whole.is_some()) {
            let options = self.options_of(part.budget, first.is_some());
            let last = proof.judged.filter(|_| whole.is_some());
            let proven = self.prove(&mut proof, part, &options)?;
            if let Some(first) = first.take() {
                found.pose_gain = self.mend_first(&mut proof, first, part, &options)?;
                found.report = self.as_before(proof.before);
            } else if self.mends {
                self.fit_held_out(&mut proof)?;
            }
            if !self.is_better(&proof, last) {
                // Too few steps may not have been enough; more that gain nothing are too many.
                if whole.is_some() || proven.steps == 0 {
                    break;
                }
                continue;
            }
            let overfit = self.overfit(&proof)?;
            let overfits = whole.is_none() && overfit > f64::from(self.options.overfit_max);
            found.overfit = found.overfit.or(Some(overfit));
            let most = match whole.is_some() {
                true => self.options.overfit_further.into(),
                false => OVERFIT_REFUSED,
            };
            if overfit > most {
                break;
            }
            let mut made = match whole.take() {
                Some(whole) => whole,
                None => self.begin_whole(&proof, overfits && self.can_begin_anew(proven))?,
            };
            let budget = match overfits {
                true => self.budget_of_overfit(),
                false => self.rest_of(part, proven.time),
            };
            let options = RefineOptions { budget, ..options };
            found.report = self.publish(&mut made, &mut proof, &options)?;
            found.versions += 1;
            // What the held-out photos gain by more says nothing of others then.
            if overfits {
                break;
            }
            whole = Some(made);
        }
        Ok(found)
    }

    /// Goes on with the proof for its share of a part. What was done.
    fn prove(
        &mut self,
        proof: &mut Proof<'_>,
        part: Part,
        options: &RefineOptions,
    ) -> Result<Work> {
        let options = RefineOptions {
            budget: of_budget(part.budget, part.proof_share),
            gaussians_max: self.share_without(proof.held, options.gaussians_max),
            ..*options
        };
        let proven = self.work(&proof.start, &proof.gaussians, proof.held, &options)?;
        tracing::debug!(steps = proven.steps, judged = ?proven.judged, "proven");
        (proof.gaussians, proof.judged) = (proven.gaussians, proven.judged);
        Ok(Work { steps: proven.steps, time: proven.time })
    }

    /// What the first proof says of the photos, which began with the Gaussians `first`: those that
    /// cannot be right are left out, and where cameras are wrong it is made again with mended ones.
    /// What the held-out photos gain by cameras that fit.
    fn mend_first(
        &mut self,
        proof: &mut Proof<'_>,
        mut first: Gaussians,
        part: Part,
        options: &RefineOptions,
    ) -> Result<Option<f64>> {
        let is_asked = self.options.pose_rate > 0.0;
        let gain = if is_asked { self.fit_held_out(proof)? } else { None };
        if self.leave_out(proof)? {
            proof.gaussians = self.without_left_out(&proof.gaussians);
            first = self.without_left_out(&first);
            proof.judged = self.judged(proof)?;
        }
        if self.mends {
            if let Some(poses) = (self.calls.recast)()? {
                self.stand_all(&poses);
                self.made.clone_from(&poses);
                (proof.start, first) = self.begin(proof.held)?;
                first = self.without_left_out(&first);
            }
            proof.gaussians = self.settle_cameras(proof.held, &proof.start, &first)?;
            self.prove(proof, part, options)?;
            self.fit_held_out(proof)?;
        }
        if self.mends || !self.left_out.is_empty() {
            proof.before = self.judged_before_fitting(proof.held, &proof.start, &first)?;
        }
        Ok(gain)
    }

    /// Whether the proof is better than what is served, or enough so than it was at the `last`
    /// version.
    fn is_better(&self, proof: &Proof<'_>, last: Option<Judged>) -> bool {
        if let (Some(last), Some(now)) = (last, proof.judged) {
            return now.score() > last.score() + self.options.gain_min;
        }
        let earlier = self.scene.meta.report.refinement.as_ref().and_then(|it| it.psnr_after);
        proof.psnr() > if earlier > proof.before { earlier } else { proof.before }
    }

    /// Goes on with the scene of all photos and publishes it. Its figures.
    fn publish(
        &mut self,
        whole: &mut Whole,
        proof: &mut Proof<'_>,
        options: &RefineOptions,
    ) -> Result<RefineReport> {
        let mut made = self.work(&whole.start, &whole.gaussians, &[], options)?;
        if self.mends {
            let back = self.anchor();
            made.gaussians = carried(&made.gaussians, |_| Some(back))?;
            proof.gaussians = carried(&proof.gaussians, |_| Some(back))?;
        }
        whole.steps += made.steps;
        let report = self.report_of(&whole.start, &made, whole.steps, [proof.before, proof.psnr()]);
        let (gaussians, poses) = (made.gaussians, self.poses());
        let version = RefinedVersion { gaussians, report: report.clone(), poses };
        (self.calls.publish)(&whole.start, &version)?;
        whole.gaussians = version.gaussians;
        Ok(report)
    }

    /// Leaves photos out from now on that the proof does not explain at all: their cameras cannot
    /// be right. Whether there are some.
    fn leave_out(&mut self, proof: &Proof<'_>) -> Result<bool> {
        let shares = unexplained(self.renderer, &proof.start, &proof.gaussians, &self.photos)?;
        let mut sorted = shares.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let least = LEFT_OUT_FROM.max(LEFT_OUT_FACTOR * sorted[sorted.len() / 2]);
        self.left_out = (0..shares.len()).filter(|&i| shares[i] > least).collect();
        tracing::debug!(?shares, left_out = ?self.left_out, "what photos the proof explains");
        self.leave_out_more(proof, least)?;
        Ok(!self.left_out.is_empty())
    }

    /// The same of the photos that the networks did not see: those go of which more than `least` is
    /// not explained.
    fn leave_out_more(&mut self, proof: &Proof<'_>, least: f64) -> Result<()> {
        let spent = self.spent(self.done.steps, self.done.time);
        let Some(more) = &mut self.more else { return Ok(()) };
        let numbers = std::mem::take(&mut more.numbers);
        for number in numbers {
            (self.calls.pace)(spent)?;
            let photo = more.spool.posed(number)?;
            let shares = unexplained(self.renderer, &proof.start, &proof.gaussians, &[photo])?;
            if shares[0] <= least {
                more.numbers.push(number);
            }
        }
        Ok(())
    }

    /// The Gaussians that did not come from photos that are left out.
    fn without_left_out(&self, gaussians: &Gaussians) -> Gaussians {
        let photo = |i: usize| usize::from(gaussians.source()[i].view);
        gaussians.only(|i| !self.left_out.contains(&photo(i)))
    }

    /// The photos to learn from, and those of the numbers `held`.
    fn parted(&self, held: &[usize]) -> (Vec<PosedPhoto>, Vec<PosedPhoto>) {
        let (learnt, held) = self.numbers(held);
        [learnt, held].map(|all| all.into_iter().map(|i| self.photos[i].clone()).collect()).into()
    }

    /// The photos that the networks did not see: none where cameras are mended, for nothing mends
    /// theirs.
    fn more(&self) -> Option<&MorePhotos> {
        self.more.as_ref().filter(|_| !self.mends)
    }

    /// Their numbers.
    fn numbers(&self, held: &[usize]) -> (Vec<usize>, Vec<usize>) {
        let used = (0..self.photos.len()).filter(|i| !self.left_out.contains(i));
        used.partition(|i| !held.contains(i))
    }

    /// PSNR of the scene without the photos `held`, as it is served, at these.
    fn judged_before(&self, held: &[usize], start: &Scene) -> Result<Option<f64>> {
        let held_photos = self.parted(held).1;
        let judged = judged_as_served(self.renderer, start, &held_photos)?;
        Ok(judged.map(|judged| judged.psnr))
    }

    /// The same where the cameras of these photos fit `first`, its one set of Gaussians, if cameras
    /// are mended.
    fn judged_before_fitting(
        &mut self,
        held: &[usize],
        start: &Scene,
        first: &Gaussians,
    ) -> Result<Option<f64>> {
        let now = self.poses();
        if self.mends {
            let poses = self.fitting(held, start, first)?;
            self.stand(&self.numbers(held).1, &poses);
        }
        let before = self.judged_before(held, start);
        self.stand_all(&now);
        before
    }

    /// How the proof shows the held-out photos.
    fn judged(&self, proof: &Proof<'_>) -> Result<Option<Judged>> {
        let held_photos = self.parted(proof.held).1;
        judged_as_plain(self.renderer, &proof.start, &proof.gaussians, &held_photos)
    }

    /// What the held-out photos gain by cameras that fit the proof. Their cameras are as wrong as
    /// the others: where cameras are mended, or this gain says that they are to be, theirs fit from
    /// now on.
    fn fit_held_out(&mut self, proof: &mut Proof<'_>) -> Result<Option<f64>> {
        let now = self.poses();
        let poses = self.fitting(proof.held, &proof.start, &proof.gaussians)?;
        self.stand(&self.numbers(proof.held).1, &poses);
        let fitting = self.judged(proof)?;
        let gain =
            proof.judged.zip(fitting).map(|(as_given, fits)| fits.score() - as_given.score());
        self.mends |= gain.is_some_and(|gain| gain > self.options.mends_from);
        match self.mends {
            true => proof.judged = fitting,
            false => self.stand_all(&now),
        }
        Ok(gain)
    }

    /// Where the cameras of the photos `held` fit these Gaussians.
    fn fitting(
        &mut self,
        held: &[usize],
        start: &Scene,
        gaussians: &Gaussians,
    ) -> Result<Vec<CameraToWorld>> {
        let photos = self.parted(held).1;
        self.fitting_photos(&photos, start, gaussians)
    }

    /// The same of these photos.
    fn fitting_photos(
        &mut self,
        photos: &[PosedPhoto],
        start: &Scene,
        gaussians: &Gaussians,
    ) -> Result<Vec<CameraToWorld>> {
        let spent = self.spent(self.done.steps, self.done.time);
        // Not more than was worked so far.
        let most = self.done.steps / u32::try_from(photos.len().max(1)).unwrap_or(u32::MAX);
        let steps = u8::try_from(most).unwrap_or(u8::MAX).clamp(1, ALIGNING_STEPS);
        let (begun, mut waited) = (Instant::now(), Duration::ZERO);
        let pace = &mut *self.calls.pace;
        let mut pace = || {
            let paused = Instant::now();
            pace(spent)?;
            waited += paused.elapsed();
            Ok(())
        };
        let poses =
            aligned(self.renderer, start, gaussians, photos, &self.options, steps, &mut pace)?;
        self.done.time += begun.elapsed().saturating_sub(waited);
        Ok(poses)
    }

    /// Brings the camera of each photo but those of `held` to where the Gaussians of the others
    /// say, and its own Gaussians with it: these look right from where it stands, wherever that
    /// is.
    fn settle_cameras(
        &mut self,
        held: &[usize],
        start: &Scene,
        gaussians: &Gaussians,
    ) -> Result<Gaussians> {
        let mut gaussians = gaussians.clone();
        for _ in 0..SETTLING_ROUNDS {
            for i in self.numbers(held).0 {
                let others = gaussians.only(|at| usize::from(gaussians.source()[at].view) != i);
                let Some(photo) = covered(self.renderer, start, &others, &self.photos[i])? else {
                    continue;
                };
                let before = pose_of(&photo);
                let poses = self.fitting_photos(&[photo], start, &others)?;
                self.stand(&[i], &poses);
                let motion = motion(&before, &poses[0]);
                gaussians = carried(&gaussians, |view| (view == i).then_some(motion))?;
            }
        }
        let back = self.anchor();
        carried(&gaussians, |_| Some(back))
    }

    /// The Gaussians of the networks where the cameras of their photos stand now.
    fn with_cameras(&self, gaussians: Gaussians) -> Result<Gaussians> {
        let of = |view: usize| Some(motion(self.made.get(view)?, &pose_of(self.photos.get(view)?)));
        if self.mends { carried(&gaussians, of) } else { Ok(gaussians) }
    }

    /// Moves all cameras together so that in the mean they stand as they were given, for nothing in
    /// the photos tells where all of them are. The motion.
    fn anchor(&mut self) -> (DQuat, DVec3) {
        let used = self.numbers(&[]).0;
        let turn = |i: &usize| motion(&self.given[*i], &pose_of(&self.photos[*i])).0;
        let turns = used.iter().map(|i| turn(i).to_scaled_axis());
        let back = DQuat::from_scaled_axis(-turns.sum::<DVec3>() / used.len() as f64);
        let way = |i: &usize| self.given[*i].center() - back * pose_of(&self.photos[*i]).center();
        let way = used.iter().map(way).sum::<DVec3>() / used.len() as f64;
        for posed in &mut self.photos {
            let pose = &mut posed.camera.camera_to_world;
            let rotation = DMat3::from_quat(back) * pose.rotation();
            *pose = CameraToWorld::from_rotation(rotation, back * pose.center() + way);
        }
        (back, way)
    }

    /// Where the cameras of all photos stand now.
    fn poses(&self) -> Vec<CameraToWorld> {
        self.photos.iter().map(pose_of).collect()
    }

    /// The cameras of these photos stand there from now on.
    fn stand(&mut self, photos: &[usize], poses: &[CameraToWorld]) {
        for (&i, pose) in photos.iter().zip(poses) {
            self.photos[i].camera.camera_to_world = *pose;
        }
    }

    fn stand_all(&mut self, poses: &[CameraToWorld]) {
        let all: Vec<usize> = (0..poses.len()).collect();
        self.stand(&all, poses);
    }

    /// How far the camera of each photo moved; none where they are not mended.
    fn moved(&self, start: &Scene) -> Vec<MovedCamera> {
        let moved = |(given, now): (&CameraToWorld, CameraToWorld)| MovedCamera {
            degrees: given.turn_to(&now).to_degrees(),
            share: given.center().distance(now.center()) / extent(start),
        };
        let all = self.given.iter().zip(self.poses());
        if self.mends { all.map(moved).collect() } else { Vec::new() }
    }

    /// Share of the whole budget that so much is, 0..1.
    fn spent(&self, steps: u32, time: Duration) -> f32 {
        let budget = self.options.budget;
        let steps = f64::from(steps) / f64::from(budget.steps.max(1));
        let share = steps.max(time.as_secs_f64() / budget.time.as_secs_f64().max(1e-3));
        #[expect(clippy::cast_possible_truncation, reason = "a share")]
        let share = share.min(1.0) as f32;
        share
    }

    /// The part that comes next; `None` where all is spent.
    fn next_part(&self, is_published: bool) -> Option<Part> {
        let (left, proof_share) = (self.left(), self.proof_share());
        if left.steps == 0 || left.time.is_zero() {
            return None;
        }
        if self.done.steps == 0 {
            let steps = left.steps.min(self.options.first_steps);
            return Some(Part { budget: RefineBudget { steps, ..left }, proof_share });
        }
        // Where nothing was published yet, only proofs were made.
        let proofs = if is_published { 1.0 } else { 1.0 / proof_share };
        let longer = (LONGER - 1) as f32 * proofs;
        let mut budget = left;
        // What would be left after it must be worth a part of its own.
        let is_last = if self.is_timed() {
            budget.time = self.done.time.mul_f32(longer);
            left.time < budget.time * 2
        } else {
            budget.steps = share_of(self.done.steps, longer);
            left.steps / 2 < budget.steps
        };
        if !is_last {
            return Some(Part { budget, proof_share });
        }
        let proof_share = if is_published { proof_share } else { LAST_PROOF_SHARE };
        Some(Part { budget: left, proof_share })
    }

    /// What a part has left after its proof, which took so long; all that is left at all where not
    /// much more would come after it.
    fn rest_of(&self, part: Part, proof: Duration) -> RefineBudget {
        let (left, share) = (self.left(), 1.0 - part.proof_share);
        let rest = of_budget(part.budget, share);
        let is_last = if self.is_timed() {
            left.time < proof.mul_f32(2.0 * share / part.proof_share)
        } else {
            left.steps / 2 < rest.steps
        };
        if is_last { left } else { rest }
    }

    /// What the one version of a proof that overfits has: the steps of the first part in any time
    /// that suffices for them, for more lose (docs/adr/0108).
    fn budget_of_overfit(&self) -> RefineBudget {
        let left = self.left();
        RefineBudget { steps: self.steps_of_overfit().min(left.steps), ..left }
    }

    fn steps_of_overfit(&self) -> u32 {
        share_of(self.options.first_steps, 1.0 - self.proof_share()).max(1)
    }

    /// Whether what is left suffices for these steps, at the pace of the proof. Fewer that begin
    /// with the Gaussians of the networks come to less than what is served (docs/adr/0116).
    fn can_begin_anew(&self, proven: Work) -> bool {
        let (left, steps) = (self.left(), self.steps_of_overfit());
        let time = proven.time.mul_f64(f64::from(steps) / f64::from(proven.steps.max(1)));
        steps <= left.steps && time <= left.time
    }

    /// Whether time is what ends it.
    fn is_timed(&self) -> bool {
        self.options.budget.time < Duration::MAX
    }

    fn proof_share(&self) -> f32 {
        self.options.proof_share.clamp(0.01, 0.99)
    }

    /// What is not spent of the budget.
    fn left(&self) -> RefineBudget {
        let (done, RefineBudget { steps, time }) = (self.done, self.options.budget);
        let steps = steps.saturating_sub(done.steps);
        RefineBudget { steps, time: time.saturating_sub(done.time) }
    }

    /// The options of a part: photos are learnt at half their size in the first alone.
    fn options_of(&self, budget: RefineBudget, is_first: bool) -> RefineOptions {
        let options = RefineOptions { budget, ..self.options };
        match is_first {
            true => options,
            false => RefineOptions { coarse_share: 0.0, ..options },
        }
    }

    /// Takes steps on all photos but those of the numbers `held`.
    fn work(
        &mut self,
        start: &Scene,
        gaussians: &Gaussians,
        held: &[usize],
        options: &RefineOptions,
    ) -> Result<Stepped> {
        let ((learnt, held_out), more) = (self.parted(held), self.more().cloned());
        let (done, budget, plan) = (self.done, self.options.budget, options.budget);
        let begin = self.spent(done.steps, done.time);
        let end = self.spent(
            done.steps.saturating_add(plan.steps).min(budget.steps),
            done.time.saturating_add(plan.time).min(budget.time),
        );
        let at = |spent: f32| (begin + (end - begin) * spent).min(1.0);
        let mut pace = |spent: f32| (self.calls.pace)(at(spent));
        let pose_rate = if self.mends { options.pose_rate } else { 0.0 };
        let (renderer, options) = (self.renderer, RefineOptions { pose_rate, ..*options });
        let learnt = LearntPhotos { kept: &learnt, more: more.as_ref() };
        let made =
            refine::refine(renderer, start, gaussians, learnt, &held_out, &options, &mut pace)?;
        if self.mends {
            self.stand(&self.numbers(held).0, &made.poses);
        }
        self.done.steps += made.steps;
        self.done.time += made.time;
        Ok(made)
    }

    /// The scene without the photos `held`, and what its refinement begins with.
    fn begin(&mut self, held: &[usize]) -> Result<(Scene, Gaussians)> {
        let (renderer, scene) = (self.renderer, self.scene);
        let (learnt, one_set) = awake(renderer, scene, || (self.calls.remake)(held))?;
        let (start, first) = start_of(scene, held, learnt, one_set)?;
        // The proof leaves room for the Gaussians of the photos that it lacks.
        let most = self.options.gaussians_first.min(self.options.gaussians_max);
        let gaussians_first = self.share_without(held, most);
        let options = RefineOptions { gaussians_first, ..self.options };
        let gaussians = ready(&start, &first, &options)?;
        Ok((start, gaussians))
    }

    /// How much the proof differs from the held-out photos, as a multiple of how much it differs
    /// from the learnt ones beside them.
    fn overfit(&self, proof: &Proof<'_>) -> Result<f64> {
        let differs = |at: &dyn Fn(usize) -> usize| {
            let is_used = |i: &usize| !self.left_out.contains(i);
            let held = proof.held.iter().filter(|&i| is_used(i) && is_used(&(i - 1)));
            let photos: Vec<PosedPhoto> = held.map(|&i| self.photos[at(i)].clone()).collect();
            let found = differences(self.renderer, &proof.start, &proof.gaussians, &photos)?;
            Ok::<_, crate::error::Error>(found.iter().sum::<f64>() / found.len() as f64)
        };
        // The photo before each is learnt.
        Ok(differs(&|i| i)? / differs(&|i| i - 1)?)
    }

    /// The scene of all photos, before its first step; it goes on from the proof, or begins `anew`.
    fn begin_whole(&mut self, proof: &Proof<'_>, anew: bool) -> Result<Whole> {
        let (start, gaussians) = self.begin(&self.left_out.clone())?;
        let gaussians = self.with_cameras(gaussians)?;
        let begun = |gaussians| Whole { start, gaussians, steps: 0 };
        if anew {
            return Ok(begun(gaussians));
        }
        let of_held = |i: usize| proof.held.contains(&usize::from(gaussians.source()[i].view));
        let room = self.options.gaussians_max.saturating_sub(proof.gaussians.len());
        let more = fewer(&gaussians.only(of_held), room, self.options.seed)?;
        Ok(begun(proof.gaussians.joined(&more)?))
    }

    /// The share of `all` Gaussians that belongs to the photos but those of the numbers `held`.
    fn share_without(&self, held: &[usize], all: usize) -> usize {
        let photos = self.photos.len();
        all.saturating_mul(photos - held.len()) / photos.max(1)
    }

    /// The figures where nothing is better than what is served.
    fn as_before(&self, psnr: Option<f64>) -> RefineReport {
        let left_out = self.left_out.iter().map(|&i| self.photos[i].file.clone());
        let more = self.more.iter().flat_map(MorePhotos::left_out);
        let gaussians = self.scene.gaussians.len() as u64;
        RefineReport {
            psnr_before: psnr,
            psnr_after: psnr,
            gaussians_before: gaussians,
            gaussians_after: gaussians,
            left_out: left_out.chain(more.map(str::to_owned)).collect(),
            ..RefineReport::default()
        }
    }

    /// The figures of a version that so many steps made of all photos.
    fn report_of(
        &self,
        start: &Scene,
        made: &Stepped,
        steps: u32,
        psnr: [Option<f64>; 2],
    ) -> RefineReport {
        let [psnr_before, psnr_after] = psnr;
        RefineReport {
            steps,
            seconds: self.done.time.as_secs_f64(),
            psnr_before,
            psnr_after,
            gaussians_after: made.gaussians.len() as u64,
            more_photos: self.more().map_or(0, |more| super::count(more.numbers.len())),
            cameras: self.moved(start),
            ..self.as_before(None)
        }
    }
}

/// The options with a side and a number of Gaussians for which there is time and room: a half of a
/// device's bytes is for the photos and their smaller copies, a half for the Gaussians.
fn fitted(options: &RefineOptions, photos: &[PosedPhoto], is_device: bool) -> RefineOptions {
    if !is_device {
        let side = options.side.min(PROCESSOR_SIDE);
        return RefineOptions {
            side,
            coarse_side_min: PROCESSOR_COARSE_SIDE,
            gaussians_first: options.gaussians_first.min(PROCESSOR_FIRST),
            rate: options.rate * PROCESSOR_RATE,
            ..*options
        };
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

/// A share of a budget that may be endless; a step at least.
fn of_budget(budget: RefineBudget, share: f32) -> RefineBudget {
    let time = Duration::try_from_secs_f64(budget.time.as_secs_f64() * f64::from(share));
    let steps = share_of(budget.steps, share).max(1);
    RefineBudget { steps, time: time.unwrap_or(Duration::MAX) }
}

/// So many times `count`, the most that there is where that is more.
fn share_of(count: u32, times: f32) -> u32 {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "saturates")]
    let times = (f64::from(count) * f64::from(times)).round() as u32;
    times
}

/// The motion that brings a camera from one place to another: a rotation about the origin of the
/// world, then a way.
fn motion(from: &CameraToWorld, to: &CameraToWorld) -> (DQuat, DVec3) {
    let turn = DQuat::from_mat3(&(to.rotation() * from.rotation().transpose())).normalize();
    (turn, to.center() - turn * from.center())
}

fn pose_of(posed: &PosedPhoto) -> CameraToWorld {
    posed.camera.camera_to_world
}

/// A photo whose longer side is `side` pixels, or as it is if that is shorter.
#[must_use]
pub fn at_side(posed: &PosedPhoto, side: u32) -> PosedPhoto {
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

/// Reads the photos of an upload that only the steps learn, at this longer side at most, onto a
/// disk: in the folder `dir`, or where the system keeps such files. `ready` gets each before, may
/// wait and leave pixels out; its error ends the work.
///
/// # Errors
/// Those of [`photos::more`] and [`PhotoSpool`], and of `ready`.
pub fn spooled(
    upload: &Upload,
    mode: CamerasMode,
    side: u32,
    limits: &Limits,
    dir: Option<&Path>,
    ready: &mut dyn FnMut(&mut PosedPhoto) -> Result<()>,
) -> Result<PhotoSpool> {
    let (mut spool, never) = (PhotoSpool::new(dir)?, AtomicBool::new(false));
    let decoded = photos::more(upload, mode, side, limits, &never, |mut photo| {
        ready(&mut photo)?;
        spool.push(&photo)
    })?;
    tracing::debug!(decoded, "pixels of more photos");
    Ok(spool)
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
    let mut meta = SceneMeta { report, ..start.meta.clone() };
    for (camera, pose) in meta.cameras.iter_mut().zip(&version.poses) {
        camera.camera.camera_to_world = *pose;
    }
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
    let own = assigned(gaussians.source(), cameras, &semantics.photos);
    let index = match scene.meta.report.method.votes {
        true => Views::new(gaussians, cameras).vote(&own, &semantics.photos),
        false => own,
    };
    Semantics { index, ..semantics.clone() }
}
