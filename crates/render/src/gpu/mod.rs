//! The GPU renderer: the stages of the CPU renderer in WGSL (shaders/*.wgsl), on wgpu.
//!
//! A frame is one submission and one read-back. Only the device knows the number of Gaussian-tile
//! pairs, so it sizes the later stages itself. A frame that needs more room than there is draws
//! nothing and reports how much it needs; then it is drawn again. A frame that is too large for the
//! adapter is drawn in bands of tile rows. Views of one scene that wait together are one
//! submission. No fault ends the process: faults become errors, and after a lost device the views
//! are drawn on a new one.

mod adapter;
pub mod buffers;
mod device;
mod frame;
pub mod pipelines;
mod pool;
mod profile;
mod readback;
mod recorder;
mod scratch;
pub mod stages;

use std::path::PathBuf;

use self::adapter::{Adapter, Context};
use super::{
    DeviceTimes, Frame, RenderRequest, Renderer, constants::ISECTS_MAX, select::AdapterReport,
    skip::Skip, view::View,
};
use crate::{
    error::{ErrorCode, Result},
    limits::Limits,
    scene::Gaussians,
};

/// How a GPU renderer is opened.
#[derive(Clone, Debug)]
pub struct GpuOptions {
    /// Parts of adapters' names, with commas between; `None` takes every hardware adapter, never a
    /// software one.
    pub adapter: Option<String>,
    /// Asks for WebGPU's portable floor instead of all that the adapter has: 128 MiB a binding,
    /// 8 storage buffers a stage, 16 KiB of workgroup storage.
    pub portable: bool,
    /// Gaussian-tile pairs held at once; more are drawn in bands.
    pub isects_max: u32,
    /// Views that wait for one device.
    pub waiting_max: usize,
    /// Bytes of scenes kept on one device.
    pub scene_bytes_max: u64,
    /// Folder whose files stand in for the built-in shaders: to try changes without a build.
    pub shaders: Option<PathBuf>,
    /// Has every index and loop of the shaders checked by code of its own.
    pub checked: bool,
    /// Whether the kernels made for software adapters are used, where an invocation does what many
    /// share on a GPU; `None`: on those alone.
    pub serial: Option<bool>,
    /// Needless work that is not left out, for tests and benchmarks.
    pub without: Option<Skip>,
}

impl Default for GpuOptions {
    fn default() -> Self {
        let limits = Limits::default();
        Self {
            adapter: None,
            portable: false,
            isects_max: ISECTS_MAX as u32,
            waiting_max: limits.queued_renders_max,
            scene_bytes_max: limits.device_scene_bytes_max,
            shaders: None,
            checked: false,
            serial: None,
            without: None,
        }
    }
}

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
    pub fn open(options: &GpuOptions) -> (Vec<AdapterReport>, Result<Self>) {
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
    #[must_use]
    pub fn adapter(&self) -> &AdapterReport {
        self.adapters[0].adapter()
    }

    /// Devices in use.
    #[must_use]
    pub fn devices(&self) -> usize {
        self.adapters.len()
    }

    /// Scenes kept on all devices now.
    #[must_use]
    pub fn scenes_held(&self) -> usize {
        self.adapters.iter().map(Adapter::scenes_held).sum()
    }

    /// Submissions so far, and views drawn by them.
    #[must_use]
    pub fn submissions(&self) -> (u64, u64) {
        let both = self.adapters.iter().map(Adapter::submissions);
        both.fold((0, 0), |sum, one| (sum.0 + one.0, sum.1 + one.1))
    }

    /// Has every device seen as lost at once, whatever runs on it; the adapters stay. For tests of
    /// the recovery.
    pub fn lose_devices(&self) {
        self.adapters.iter().for_each(Adapter::lose_device);
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

    fn with_context<T>(&self, work: impl FnOnce(&mut Context) -> Result<T>) -> Result<T> {
        self.adapters[0].with_context(work)
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
            return Ok(frame::background(&view, request));
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
