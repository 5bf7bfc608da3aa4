//! Gradient steps that bring Gaussians closer to photos.
//!
//! A step draws a photo's view or several, as the photo was exposed ([`Exposure`]), compares
//! ([`photo_loss()`]), goes back through the renderer ([`crate::backward`]) and moves what the
//! photos show ([`LearningRates`]). A [`Trainer`] is where that runs. [`HostTrainer`] does all but
//! the drawing on the processor. The GPU renderer has one on the device (`shaders/photo_loss.wgsl`,
//! `exposure.wgsl`, `adam.wgsl`): photos and Gaussians go up once, and only what is asked for comes
//! back. Where a step says so the camera of its photo moves too ([`pose`]). An oracle in
//! `tests/support` judges the loss.

pub mod adam;
pub mod exposure;
pub(crate) mod growth;
mod host;
pub mod photo_loss;
pub mod pose;
mod streamed;

pub use self::{
    adam::{LearningRates, checked},
    exposure::Exposure,
    host::HostTrainer,
    photo_loss::{PhotoLoss, photo_loss},
    pose::{PoseGradient, PoseRates},
    streamed::{PhotoSource, StreamedPhoto},
};
use crate::{
    Frame, RenderRequest,
    error::{Error, Result},
    scene::{CameraToWorld, Gaussians, Photo},
};

/// A photo to learn from.
#[derive(Clone, Debug)]
pub struct TrainingPhoto<'a> {
    /// Its pixels.
    pub photo: &'a Photo,
    /// The view of the scene that should look like it, of the same size.
    pub request: RenderRequest,
    /// Number of its camera: copies of a photo share one, which stands where the first of them
    /// says. Numbers begin at 0 and leave none out.
    pub pose: usize,
}

/// What a [`Trainer`] begins with.
#[derive(Clone, Debug)]
pub struct TrainingSet<'a> {
    /// The Gaussians to move.
    pub gaussians: &'a Gaussians,
    /// The photos that the trainer keeps. Steps name photos by their numbers.
    pub photos: Vec<TrainingPhoto<'a>>,
    /// Photos that are read for each of their steps. Their numbers go on behind those of `photos`.
    pub streamed: Vec<StreamedPhoto>,
    /// Share of SSIM in the loss, 0..1.
    pub ssim_share: f32,
    /// Most Gaussians that [`Trainer::grow`] makes of them.
    pub gaussians_max: usize,
}

impl TrainingSet<'_> {
    /// The views of all photos and the numbers of their cameras, by the numbers of the photos.
    fn views(&self) -> impl Iterator<Item = (&RenderRequest, usize)> {
        let kept = self.photos.iter().map(|photo| (&photo.request, photo.pose));
        kept.chain(self.streamed.iter().map(|photo| (&photo.request, photo.pose)))
    }

    /// The cameras of the photos.
    pub(crate) fn poses(&self) -> Vec<pose::Pose> {
        let mut poses = Vec::new();
        for (request, pose) in self.views() {
            if pose == poses.len() {
                poses.push(pose::Pose::new(request.camera.camera_to_world));
            }
        }
        poses
    }

    /// Refuses a photo of another size than its view, and a number of a camera that leaves one out.
    ///
    /// # Errors
    /// `internal`, with both.
    pub(crate) fn check(&self) -> Result<()> {
        let mut poses = 0;
        for (_, pose) in self.views() {
            if pose > poses {
                return Err(Error::internal(format!("training: camera {pose} after {poses}")));
            }
            poses = poses.max(pose + 1);
        }
        for TrainingPhoto { photo, request, .. } in &self.photos {
            let lens = request.lens();
            let (has, shown) = ([photo.width, photo.height], [lens.width, lens.height]);
            if has != shown {
                return Err(Error::internal(format!(
                    "training: a photo of {has:?}, not {shown:?}"
                )));
            }
        }
        Ok(())
    }
}

/// How a step moves what it moves.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrainingStep {
    /// How far numbers of Gaussians move.
    pub rates: LearningRates,
    /// How far gains and biases move.
    pub exposure: f32,
    /// How far the cameras of the photos move.
    pub poses: PoseRates,
    /// Gaussians under this opacity are dropped after the step; 0 drops none.
    pub opacity_min: f32,
}

/// A place where steps are taken. Twins: from the same start they come to the same numbers, to the
/// rounding of f32.
pub trait Trainer {
    /// Takes one step by the sum of what the photos of these numbers say.
    ///
    /// # Errors
    /// Those of [`crate::DifferentiableRenderer::backward`]; `internal` for a photo that
    /// is not there. After an error the trainer is of no use.
    fn step(&mut self, photos: &[usize], step: &TrainingStep) -> Result<()>;

    /// Makes two of each of those Gaussians that are most to blame for how the scene differs from
    /// the photos of these numbers, until there are `until` or the most that the set allows. The
    /// two lie side by side and inherit all else. Returns how many there are.
    ///
    /// # Errors
    /// As [`Self::step`].
    fn grow(&mut self, photos: &[usize], until: usize) -> Result<usize>;

    /// Draws the Gaussians as they are now.
    ///
    /// # Errors
    /// Those of [`crate::Renderer::render`].
    fn render(&mut self, request: &RenderRequest) -> Result<Frame>;

    /// The Gaussians as they are now: those of the start that were not dropped, in their order, and
    /// those that came by [`Self::grow`], behind them or in the places of dropped ones.
    ///
    /// # Errors
    /// As [`Self::step`].
    fn gaussians(&mut self) -> Result<Gaussians>;

    /// The exposure of each photo, and its loss before its last step: NaN where there was none.
    ///
    /// # Errors
    /// As [`Self::step`].
    fn exposures(&mut self) -> Result<Vec<(Exposure, f64)>>;

    /// Where the cameras stand, by their numbers.
    ///
    /// # Errors
    /// As [`Self::step`].
    fn poses(&mut self) -> Result<Vec<CameraToWorld>>;
}

/// A number of a photo.
pub(crate) fn absent(at: usize) -> Error {
    Error::internal(format!("training: there is no photo {at}"))
}

/// Pixels in 0..1, `[H * W]`.
#[must_use]
pub fn unit(photo: &Photo) -> Vec<[f32; 3]> {
    let pixels = photo.rgb.chunks_exact(3);
    pixels.map(|c| [c[0], c[1], c[2]].map(|v| f32::from(v) / 255.0)).collect()
}
