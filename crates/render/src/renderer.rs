//! What a renderer gives: views, their times on a device, and the way back from a loss.

use std::sync::Arc;

use serde::Serialize;

use crate::{
    Frame, RenderRequest,
    backward::{FrameGradients, Gradients},
    error::Result,
    scene::Gaussians,
    train::{Trainer, TrainingSet},
};

/// Time of one dispatch, by the device's own clock.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DispatchTime {
    /// Kernel.
    pub stage: &'static str,
    /// Milliseconds.
    pub ms: f64,
}

/// Times of one frame on a device, by its own clock.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct DeviceTimes {
    /// From before the first stage to after the last, no stage marked between: milliseconds.
    pub total_ms: f64,
    /// Every dispatch of another frame, in order.
    pub stages: Vec<DispatchTime>,
}

/// A renderer of the one model.
pub trait Renderer: Send + Sync {
    /// Name for logs, `/v1/models` and benchmarks: `cpu`, or the adapter's own name.
    fn name(&self) -> String;

    /// Views that it draws at the same time with profit; more callers only wait for one another.
    fn concurrency(&self) -> usize;

    /// Renders one view.
    ///
    /// # Errors
    /// `limit_exceeded` when the work does not fit the device's limits, `gpu_unavailable`
    /// when the device is lost, `internal` for a fault of ours. An empty scene is a clean
    /// background.
    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame>;

    /// Puts a scene where its views are drawn, so that its first one need not wait for that. Views
    /// of other scenes do not wait either. Nothing depends on it.
    ///
    /// # Errors
    /// `limit_exceeded` when the device has no room, `gpu_unavailable` when it is lost.
    fn prepare(&self, _gaussians: &Gaussians) -> Result<()> {
        Ok(())
    }

    /// The Gaussians that may touch what is within `by` pixels of a place of the picture, or beside
    /// the picture, ascending; others may be among them. `None`: all, as it has none in blocks.
    ///
    /// # Errors
    /// As [`Self::render`].
    fn near(
        &self,
        _gaussians: &Gaussians,
        _request: &RenderRequest,
        _at: [f64; 2],
        _by: f64,
    ) -> Result<Option<Vec<u32>>> {
        Ok(None)
    }

    /// The same renderer where it has a backward pass of its own that is worth its device.
    fn differentiable(self: Arc<Self>) -> Option<Arc<dyn DifferentiableRenderer>> {
        None
    }

    /// Renders one view for the times of it on the device; `None` where none keeps them.
    ///
    /// # Errors
    /// As [`Self::render`].
    fn device_times(
        &self,
        _gaussians: &Gaussians,
        _request: &RenderRequest,
    ) -> Result<Option<DeviceTimes>> {
        Ok(None)
    }
}

/// A renderer that also says how a frame depends on the Gaussians.
pub trait DifferentiableRenderer: Renderer {
    /// Renders one view, asks `loss` what it says of the frame, and writes what that means for each
    /// Gaussian into `gradients`, whose old content is lost. Returns the frame: colour, alpha and
    /// what the request asks for, in f32. Labels of the request are not drawn. Where a device fails
    /// meanwhile, `loss` is asked again, of the same view.
    ///
    /// # Errors
    /// As [`Renderer::render`]; `limit_exceeded` when the view needs more Gaussian-tile pairs than
    /// are held at once; whatever `loss` says.
    fn backward(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        loss: &mut dyn FnMut(&Frame) -> Result<FrameGradients>,
        gradients: &mut Gradients,
    ) -> Result<Frame>;

    /// Draws one view and goes back by `by`, for the times of it on the device; `None` where none
    /// keeps them.
    ///
    /// # Errors
    /// As [`Self::backward`].
    fn backward_times(
        &self,
        _gaussians: &Gaussians,
        _request: &RenderRequest,
        _by: &FrameGradients,
    ) -> Result<Option<DeviceTimes>> {
        Ok(None)
    }

    /// A trainer that keeps photos and Gaussians on a device; `None` where there is none, and
    /// [`crate::train::HostTrainer`] is the one.
    ///
    /// # Errors
    /// `limit_exceeded` where they need more than about `bytes_max` bytes of the device, or do not
    /// fit it; as [`Self::backward`].
    fn trainer<'a>(
        &'a self,
        _set: &TrainingSet<'a>,
        _bytes_max: u64,
    ) -> Result<Option<Box<dyn Trainer + 'a>>> {
        Ok(None)
    }

    /// Whether it draws on a device: steps on large photos are quick there. And its clocks may fall
    /// while nothing is drawn: one NVIDIA H200 is two to six times as slow in the first half second
    /// after that.
    fn is_device(&self) -> bool {
        false
    }
}
