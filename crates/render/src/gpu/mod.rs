//! The GPU renderer: the stages of the CPU renderer in WGSL (shaders/*.wgsl), on wgpu.
//!
//! A frame is one submission and one read-back. Only the device knows the number of Gaussian-tile
//! pairs, so it sizes the later stages itself. A frame that needs more room than there is draws
//! nothing and reports how much it needs; then it is drawn again. A frame that is too large for the
//! adapter is drawn in bands of tile rows. Views of one scene that wait together are one
//! submission. No fault ends the process: faults become errors, and after a lost device the views
//! are drawn on a new one.

mod adapter;
mod backward;
mod batch_buffers;
mod bindings;
mod buffers;
mod context;
mod device;
mod drawing;
mod frame;
#[cfg(feature = "testing")]
pub mod internals;
mod parts;
mod pipelines;
mod pool;
mod profile;
mod readback;
mod recorder;
mod scratch;
mod trainer;

use std::sync::Arc;

use self::adapter::Adapter;
use super::{
    Frame, RenderRequest,
    backward::{FrameGradients, Gradients, backward_request},
    options::{AdapterReport, RendererOptions},
    renderer::{DeviceTimes, DifferentiableRenderer, Renderer},
    train::{Trainer, TrainingSet},
    view::View,
};
use crate::{
    error::{ErrorCode, Result},
    scene::Gaussians,
};

/// Renders with compute shaders on one or more devices, which callers share.
#[derive(Debug)]
pub struct GpuRenderer {
    adapters: Vec<Adapter>,
}

impl GpuRenderer {
    /// Opens the adapters that `options` name and compiles the kernels; also which adapters there
    /// are. Of several, those that refuse are left out.
    ///
    /// # Errors
    /// `gpu_unavailable` when no adapter fits or all refuse, `internal` when a kernel does not
    /// compile.
    pub fn open(options: &RendererOptions) -> (Vec<AdapterReport>, Result<Self>) {
        let (mut reports, chosen) = device::choose(options.adapter.as_deref());
        let opened = chosen.and_then(|chosen| {
            let (mut adapters, mut refused) = (Vec::new(), None);
            for (adapter, report) in chosen {
                match Adapter::open(adapter, report.clone(), options) {
                    Ok(adapter) => adapters.push(adapter),
                    Err(error) => {
                        tracing::warn!(
                            adapter = report.name,
                            reason = error.message(),
                            "a GPU adapter is left out"
                        );
                        let same = |other: &&mut AdapterReport| **other == report;
                        reports.iter_mut().find(same).into_iter().for_each(|r| r.chosen = false);
                        refused = Some(error);
                    }
                }
            }
            match refused {
                Some(error) if adapters.is_empty() => Err(error),
                _ => Ok(Self { adapters }),
            }
        });
        (reports, opened)
    }

    /// The first adapter in use.
    pub fn adapter(&self) -> &AdapterReport {
        self.adapters[0].report()
    }

    /// The device to draw `gaussians` on: the one that holds them, unless it has a submission's
    /// worth of views more to draw than the one with the fewest.
    fn adapter_for(&self, gaussians: &Gaussians) -> &Adapter {
        let least = self.adapters.iter().min_by_key(|adapter| adapter.waiting());
        let least = least.unwrap_or(&self.adapters[0]);
        let shape = gaussians.shape_identity();
        let room = least.waiting() + pipelines::VIEWS_MAX as usize;
        let holds = |adapter: &&Adapter| adapter.holds(shape) && adapter.waiting() <= room;
        self.adapters.iter().find(holds).unwrap_or(least)
    }
}

impl Renderer for GpuRenderer {
    fn name(&self) -> String {
        self.adapter().name.clone()
    }

    /// For every device the views of each submission under way, and those of the next one.
    fn concurrency(&self) -> usize {
        self.adapters.len() * (pool::SUBMISSIONS_MAX + 1) * pipelines::VIEWS_MAX as usize
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        let view = View::new(gaussians.origin(), request)?;
        if gaussians.is_empty() {
            return crate::cpu::background(&view, request);
        }
        let adapter = self.adapter_for(gaussians);
        match adapter.render(gaussians, request) {
            // Lost for good: the others serve.
            Err(error) if error.code() == ErrorCode::GpuUnavailable => {
                let other = |other: &&Adapter| !std::ptr::eq(*other, adapter);
                match self.adapters.iter().find(other) {
                    Some(other) => other.render(gaussians, request),
                    None => Err(error),
                }
            }
            other => other,
        }
    }

    fn prepare(&self, gaussians: &Gaussians) -> Result<()> {
        if gaussians.is_empty() { Ok(()) } else { self.adapter_for(gaussians).prepare(gaussians) }
    }

    fn differentiable(self: Arc<Self>) -> Option<Arc<dyn DifferentiableRenderer>> {
        if self.adapter().software { None } else { Some(self) }
    }

    fn device_times(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
    ) -> Result<Option<DeviceTimes>> {
        if gaussians.is_empty() {
            return Ok(None);
        }
        self.adapter_for(gaussians).device_times(gaussians, request)
    }
}

impl DifferentiableRenderer for GpuRenderer {
    fn backward(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        loss: &mut dyn FnMut(&Frame) -> Result<FrameGradients>,
        gradients: &mut Gradients,
    ) -> Result<Frame> {
        let request = backward_request(request);
        if gaussians.is_empty() {
            let frame =
                crate::cpu::background(&View::new(gaussians.origin(), &request)?, &request)?;
            loss(&frame)?.check_of(&frame)?;
            gradients.clear(0, gaussians.sh_count());
            return Ok(frame);
        }
        self.adapter_for(gaussians).backward(gaussians, &request, loss, gradients)
    }

    fn backward_times(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        by: &FrameGradients,
    ) -> Result<Option<DeviceTimes>> {
        if gaussians.is_empty() {
            return Ok(None);
        }
        self.adapter_for(gaussians).backward_times(gaussians, &backward_request(request), by)
    }

    fn trainer<'a>(
        &'a self,
        set: &TrainingSet<'a>,
        bytes_max: u64,
    ) -> Result<Option<Box<dyn Trainer + 'a>>> {
        if set.gaussians.is_empty() {
            return Ok(None);
        }
        Ok(Some(Box::new(self.adapter_for(set.gaussians).trainer(set, bytes_max)?)))
    }

    fn is_device(&self) -> bool {
        !self.adapter().software
    }
}
