//! Steps of which a renderer takes the drawing and going back, and the processor the rest.

use std::sync::Arc;

use rayon::prelude::*;

use super::{
    Exposure, PhotoLoss, StreamedPhoto, Trainer, TrainingPhoto, TrainingSet, TrainingStep, absent,
    adam::{Adam, checked},
    growth::{halves, most_blamed},
    photo_loss,
    pose::{Pose, PoseGradient},
    unit,
};
use crate::{
    DifferentiableRenderer, Frame, RenderRequest,
    backward::{FrameGradients, Gradients},
    error::Result,
    scene::{CameraToWorld, Gaussians, Photo},
};

/// The pixels of a photo as the loss needs them.
#[derive(Debug)]
struct Pixels {
    /// `[H * W]` 0..1.
    rgb: Vec<[f32; 3]>,
    valid: Option<Vec<bool>>,
}

impl Pixels {
    fn of(photo: &Photo) -> Arc<Self> {
        Arc::new(Self { rgb: unit(photo), valid: photo.valid.clone() })
    }
}

/// Where the pixels of a photo are.
#[derive(Debug)]
enum Place {
    Kept(Arc<Pixels>),
    Streamed(Box<StreamedPhoto>),
}

/// A photo to learn from.
#[derive(Debug)]
struct Target {
    request: RenderRequest,
    place: Place,
    exposure: Exposure,
    loss: f64,
    /// Number of its camera.
    pose: usize,
}

impl Target {
    fn new(request: &RenderRequest, place: Place, pose: usize) -> Self {
        let (request, exposure) = (request.clone(), Exposure::default());
        Self { request, place, exposure, loss: f64::NAN, pose }
    }

    fn kept(TrainingPhoto { photo, request, pose }: &TrainingPhoto<'_>) -> Self {
        Self::new(request, Place::Kept(Pixels::of(photo)), *pose)
    }

    fn streamed(photo: &StreamedPhoto) -> Self {
        Self::new(&photo.request, Place::Streamed(Box::new(photo.clone())), photo.pose)
    }

    fn pixels(&self) -> Result<Arc<Pixels>> {
        match &self.place {
            Place::Kept(pixels) => Ok(Arc::clone(pixels)),
            Place::Streamed(photo) => photo.read().map(|photo| Pixels::of(&photo)),
        }
    }

    /// Its view, where its camera stands now.
    fn view(&self, poses: &[Pose]) -> RenderRequest {
        let mut request = self.request.clone();
        request.camera.camera_to_world = poses[self.pose].now;
        request
    }

    /// What the loss says of a frame; the exposure moves.
    fn compare(
        &mut self,
        photo: &Pixels,
        frame: &Frame,
        ssim_share: f32,
        rate: f32,
    ) -> FrameGradients {
        let plain = frame.color.as_deref().unwrap_or_default();
        let exposure = self.exposure;
        let shown: Vec<[f32; 3]> = plain.par_iter().map(|color| exposure.of(*color)).collect();
        let (width, valid) = (frame.width as usize, photo.valid.as_deref());
        let PhotoLoss { value, gradient } =
            photo_loss(&shown, &photo.rgb, width, valid, ssim_share);
        let mut by = gradient;
        self.loss = value;
        self.exposure.step(plain, &by, rate);
        let gain = exposure.gain;
        by.par_iter_mut().for_each(|by| *by = std::array::from_fn(|c| by[c] * gain[c]));
        FrameGradients { color: Some(by), ..FrameGradients::default() }
    }

    /// How far each number of a frame is from the photo.
    fn differences(&self, photo: &Pixels, frame: &Frame) -> FrameGradients {
        let plain = frame.color.as_deref().unwrap_or_default();
        let known = |i: usize| photo.valid.as_ref().is_none_or(|valid| valid[i]);
        let away = |(i, (color, right)): (usize, (&[f32; 3], &[f32; 3]))| {
            let shown = self.exposure.of(*color);
            std::array::from_fn(|c| if known(i) { (shown[c] - right[c]).abs() } else { 0.0 })
        };
        let away = plain.par_iter().zip(&photo.rgb).enumerate().map(away).collect();
        FrameGradients { color: Some(away), ..FrameGradients::default() }
    }
}

/// A [`Trainer`] on the processor, over any renderer.
#[expect(missing_debug_implementations, reason = "renderers have none")]
pub struct HostTrainer<'a> {
    renderer: &'a dyn DifferentiableRenderer,
    gaussians: Gaussians,
    adam: Adam,
    targets: Vec<Target>,
    poses: Vec<Pose>,
    ssim_share: f32,
    gaussians_max: usize,
    /// Of a step, and of one of its photos.
    found: (Gradients, Gradients),
}

impl<'a> HostTrainer<'a> {
    /// A trainer that draws with `renderer`.
    ///
    /// # Errors
    /// `internal` for a photo of another size than its view.
    pub fn new(renderer: &'a dyn DifferentiableRenderer, set: &TrainingSet<'_>) -> Result<Self> {
        set.check()?;
        let mut targets: Vec<Target> = set.photos.par_iter().map(Target::kept).collect();
        targets.extend(set.streamed.iter().map(Target::streamed));
        Ok(Self {
            renderer,
            gaussians: set.gaussians.clone(),
            adam: Adam::new(set.gaussians),
            targets,
            poses: set.poses(),
            ssim_share: set.ssim_share,
            gaussians_max: set.gaussians_max,
            found: Default::default(),
        })
    }
}

impl Trainer for HostTrainer<'_> {
    fn step(&mut self, photos: &[usize], step: &TrainingStep) -> Result<()> {
        let Self { renderer, gaussians, adam, targets, poses, ssim_share, found, .. } = self;
        for (place, &at) in photos.iter().enumerate() {
            let target = targets.get_mut(at).ok_or_else(|| absent(at))?;
            let (request, photo) = (target.view(poses), target.pixels()?);
            let mut loss =
                |frame: &Frame| Ok(target.compare(&photo, frame, *ssim_share, step.exposure));
            let into = if place == 0 { &mut found.0 } else { &mut found.1 };
            renderer.backward(gaussians, &request, &mut loss, into)?;
            if step.poses.moves() {
                let pose = &mut poses[target.pose];
                let by = PoseGradient::of(gaussians, into, pose.now.center());
                pose.step(&by, step.poses);
            }
            if place > 0 {
                add(&mut found.0, &found.1);
            }
        }
        *gaussians = adam.step(std::mem::take(gaussians), &found.0, &step.rates)?;
        if step.opacity_min > 0.0 {
            *gaussians = adam.prune(gaussians, step.opacity_min);
        }
        Ok(())
    }

    fn grow(&mut self, photos: &[usize], until: usize) -> Result<usize> {
        let (count, k) = (self.gaussians.len(), self.gaussians.sh_count());
        let more = until.min(self.gaussians_max).saturating_sub(count);
        if more == 0 {
            return Ok(count);
        }
        let Self { renderer, gaussians, targets, poses, found: (found, _), .. } = self;
        let mut blame = vec![0.0; count];
        for &at in photos {
            let target = targets.get(at).ok_or_else(|| absent(at))?;
            let photo = target.pixels()?;
            let mut loss = |frame: &Frame| Ok(target.differences(&photo, frame));
            renderer.backward(gaussians, &target.view(poses), &mut loss, found)?;
            let by_colour = found.sh.par_chunks(k).with_min_len(1 << 12);
            blame.par_iter_mut().zip(by_colour).for_each(|(blame, by)| {
                *blame += by[0].iter().sum::<f32>();
            });
        }
        let parents = most_blamed(&blame, more);
        let mut raw = std::mem::take(gaussians).into_raw();
        for &i in &parents {
            let [one, other] = halves(raw.means[i], raw.quats[i], raw.scales[i]);
            (raw.means[i], raw.scales[i]) = one;
            raw.means.push(other.0);
            raw.scales.push(other.1);
            raw.quats.push(raw.quats[i]);
            raw.opacities.push(raw.opacities[i]);
            raw.sh.extend_from_within(i * k..(i + 1) * k);
            raw.semantic_index.push(raw.semantic_index[i]);
            raw.source.push(raw.source[i]);
        }
        self.adam.begin_anew(&parents);
        self.gaussians = checked(raw)?;
        Ok(self.gaussians.len())
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Frame> {
        self.renderer.render(&self.gaussians, request)
    }

    fn gaussians(&mut self) -> Result<Gaussians> {
        Ok(self.gaussians.clone())
    }

    fn exposures(&mut self) -> Result<Vec<(Exposure, f64)>> {
        Ok(self.targets.iter().map(|target| (target.exposure, target.loss)).collect())
    }

    fn poses(&mut self) -> Result<Vec<CameraToWorld>> {
        Ok(self.poses.iter().map(|pose| pose.now).collect())
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
