//! Which renderer serves. The adapters are looked at once, and the log says which one is used. A
//! software adapter is used only when it is named.

use std::sync::Arc;

use crate::{
    Frame, RenderRequest,
    backward::{FrameGradients, Gradients},
    cpu::CpuRenderer,
    error::{ErrorCode, Result},
    gpu::GpuRenderer,
    options::{AdapterReport, RendererChoice, RendererOptions},
    renderer::{DeviceTimes, DifferentiableRenderer, Renderer},
    scene::Gaussians,
    train::{Trainer, TrainingSet},
};

/// The renderer that `options` ask for, and the adapters found on the way.
///
/// `auto` takes a hardware adapter or the CPU renderer; `gpu` refuses to start without an adapter;
/// an adapter that is named must be there.
///
/// # Errors
/// `gpu_unavailable` when an adapter was asked for and none fits, `internal` when threads or
/// kernels cannot be started.
pub fn select(
    options: &RendererOptions,
) -> Result<(Arc<dyn DifferentiableRenderer>, Vec<AdapterReport>)> {
    let cpu = CpuRenderer::with_switches(options.threads, &options.switches)?;
    if options.renderer == RendererChoice::Cpu {
        tracing::info!(renderer = "cpu", "renderer chosen as configured");
        return Ok((Arc::new(cpu), Vec::new()));
    }
    let (reports, gpu) = GpuRenderer::open(options);
    for report in &reports {
        tracing::info!(
            adapter = report.name,
            kind = report.kind,
            backend = report.backend,
            driver = report.driver,
            software = report.software,
            chosen = report.chosen,
            "GPU adapter found"
        );
    }
    let named = options.adapter.is_some() || options.renderer == RendererChoice::Gpu;
    let renderer: Arc<dyn DifferentiableRenderer> = match gpu {
        Ok(gpu) => {
            tracing::info!(renderer = gpu.name(), "renderer chosen");
            if options.renderer == RendererChoice::Gpu {
                Arc::new(gpu)
            } else {
                Arc::new(WithCpu { gpu, cpu })
            }
        }
        Err(error) if named => return Err(error),
        Err(error) => {
            tracing::info!(renderer = "cpu", reason = error.message(), "renderer chosen");
            Arc::new(cpu)
        }
    };
    Ok((renderer, reports))
}

/// Whether the CPU renderer draws a view that the GPU renderer answered with this error: where the
/// device failed or the view does not fit it. A wrong request stays wrong, a full queue says so to
/// the caller, and a cancelled view is wanted no more.
fn cpu_draws_after(code: ErrorCode) -> bool {
    !matches!(
        code,
        ErrorCode::InvalidRequest
            | ErrorCode::Overloaded
            | ErrorCode::Cancelled
            | ErrorCode::DeadlineExceeded
            | ErrorCode::Stopping
    )
}

/// The GPU renderer's answer, or what the CPU renderer draws instead.
fn or_else(answer: Result<Frame>, cpu: impl FnOnce() -> Result<Frame>) -> Result<Frame> {
    let error = match answer {
        Err(error) if cpu_draws_after(error.code()) => error,
        answer => return answer,
    };
    tracing::warn!(
        reason = error.message(),
        source = std::error::Error::source(&error).map(tracing::field::display),
        "the GPU renderer refused a view; the CPU renderer draws it"
    );
    cpu()
}

/// A GPU renderer, and the CPU renderer for the views that it fails to draw, each logged.
#[derive(Debug)]
struct WithCpu {
    gpu: GpuRenderer,
    cpu: CpuRenderer,
}

impl Renderer for WithCpu {
    fn name(&self) -> String {
        self.gpu.name()
    }

    fn concurrency(&self) -> usize {
        self.gpu.concurrency()
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        or_else(self.gpu.render(gaussians, request), || self.cpu.render(gaussians, request))
    }

    fn prepare(&self, gaussians: &Gaussians) -> Result<()> {
        self.gpu.prepare(gaussians)
    }

    fn near(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        at: [f64; 2],
        by: f64,
    ) -> Result<Option<Vec<u32>>> {
        self.cpu.near(gaussians, request, at, by)
    }

    fn differentiable(self: Arc<Self>) -> Option<Arc<dyn DifferentiableRenderer>> {
        if self.gpu.adapter().software { None } else { Some(self) }
    }

    fn device_times(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
    ) -> Result<Option<DeviceTimes>> {
        self.gpu.device_times(gaussians, request)
    }
}

impl DifferentiableRenderer for WithCpu {
    fn backward(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        loss: &mut dyn FnMut(&Frame) -> Result<FrameGradients>,
        gradients: &mut Gradients,
    ) -> Result<Frame> {
        or_else(self.gpu.backward(gaussians, request, loss, gradients), || {
            self.cpu.backward(gaussians, request, loss, gradients)
        })
    }

    fn backward_times(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        by: &FrameGradients,
    ) -> Result<Option<DeviceTimes>> {
        self.gpu.backward_times(gaussians, request, by)
    }

    fn trainer<'a>(
        &'a self,
        set: &TrainingSet<'a>,
        bytes_max: u64,
    ) -> Result<Option<Box<dyn Trainer + 'a>>> {
        self.gpu.trainer(set, bytes_max)
    }

    fn is_device(&self) -> bool {
        self.gpu.is_device()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_cpu_draws_what_the_device_fails_at_and_nothing_else() {
        use ErrorCode::{
            Cancelled, GpuUnavailable, Internal, InvalidRequest, LimitExceeded, Overloaded,
        };
        let drawn = |code: &ErrorCode| cpu_draws_after(*code);
        assert!([GpuUnavailable, LimitExceeded, Internal].iter().all(drawn));
        assert!(![InvalidRequest, Overloaded, Cancelled].iter().any(drawn));
    }
}
