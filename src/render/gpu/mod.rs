//! The GPU renderer: the stages of the CPU renderer in WGSL (shaders/*.wgsl), on wgpu.
//!
//! A frame is one submission and one read-back. The number of Gaussian-tile pairs is known to the
//! device alone: it sizes the later stages itself, and a frame that turns out to need more room
//! than there is draws nothing, says how much, and is drawn again. What the adapter cannot hold at
//! once is drawn in bands of tile rows. Nothing here ends the process: faults are errors, and a
//! lost device is opened again at the next frame.

pub mod buffers;
mod device;
mod frame;
pub mod pipelines;
mod readback;
mod recorder;
pub mod stages;

use std::sync::{Mutex, MutexGuard, PoisonError};

use self::{
    buffers::{SceneCache, ViewRow, narrow},
    device::Gpu,
    frame::Drawing,
    pipelines::Kernels,
    recorder::Scratch,
};
use super::{
    Frame, Labels, RenderRequest, Renderer, constants::ISECTS_MAX, select::AdapterReport,
    view::View,
};
use crate::{error::Result, scene::Gaussians};

/// Bytes of scenes kept on the device.
const SCENE_BYTES_MAX: u64 = 2 << 30;
/// How a GPU renderer is opened.
#[derive(Clone, Debug)]
pub struct GpuOptions {
    /// Part of the adapter's name; `None` takes the best hardware adapter, never a software one.
    pub adapter: Option<String>,
    /// Asks for WebGPU's portable floor instead of all that the adapter has: 128 MiB a binding,
    /// 8 storage buffers a stage, 16 KiB of workgroup storage.
    pub portable: bool,
    /// Gaussian-tile pairs held at once; more are drawn in bands.
    pub isects_max: u32,
}

impl Default for GpuOptions {
    fn default() -> Self {
        Self { adapter: None, portable: false, isects_max: ISECTS_MAX as u32 }
    }
}

/// Renders with compute shaders, one frame at a time.
#[derive(Debug)]
pub struct GpuRenderer {
    options: GpuOptions,
    report: AdapterReport,
    /// `None` after the device was lost.
    engine: Mutex<Option<Engine>>,
}

/// A device with what was compiled and kept on it.
#[derive(Debug)]
struct Engine {
    gpu: Gpu,
    kernels: Kernels,
    scratch: Scratch,
    scenes: SceneCache,
}

impl Engine {
    fn open(options: &GpuOptions) -> (Vec<AdapterReport>, Result<(Self, AdapterReport)>) {
        let (reports, chosen) = device::choose(options.adapter.as_deref());
        let opened = chosen.and_then(|(adapter, report)| {
            let gpu = Gpu::open(&adapter, options.portable)?;
            let kernels = Kernels::compile(&gpu)?;
            let scenes = SceneCache::new(SCENE_BYTES_MAX);
            Ok((Self { gpu, kernels, scratch: Scratch::default(), scenes }, report))
        });
        (reports, opened)
    }
}

impl GpuRenderer {
    /// Opens the adapter that `options` name and compiles the kernels; also which adapters there
    /// are.
    ///
    /// # Errors
    /// `gpu_unavailable` when no adapter fits or it refuses, `internal` when a kernel does not
    /// compile.
    pub fn open(options: GpuOptions) -> (Vec<AdapterReport>, Result<Self>) {
        let (reports, opened) = Engine::open(&options);
        let renderer = opened.map(|(engine, report)| Self {
            options,
            report,
            engine: Mutex::new(Some(engine)),
        });
        (reports, renderer)
    }

    /// The adapter in use.
    #[must_use]
    pub fn adapter(&self) -> &AdapterReport {
        &self.report
    }

    /// Scenes kept on the device now.
    #[must_use]
    pub fn scenes_held(&self) -> usize {
        self.lock().as_ref().map_or(0, |engine| engine.scenes.len())
    }

    /// Ends the device as a driver's fault would, for tests of the recovery.
    pub fn lose_device(&self) {
        if let Some(engine) = self.lock().as_ref() {
            engine.gpu.device.destroy();
            let _ = engine.gpu.give_up("lost on purpose".to_owned());
        }
    }

    fn lock(&self) -> MutexGuard<'_, Option<Engine>> {
        self.engine.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Runs `work` on the device, opened again if it was lost.
    fn with_engine<T>(&self, work: impl FnOnce(&mut Engine) -> Result<T>) -> Result<T> {
        let mut slot = self.lock();
        let engine = match &mut *slot {
            Some(engine) => engine,
            None => {
                let (engine, _) = Engine::open(&self.options).1?;
                tracing::warn!(adapter = self.report.name, "the GPU device was opened again");
                slot.insert(engine)
            }
        };
        let result = work(engine);
        if engine.gpu.is_lost() {
            tracing::error!(adapter = self.report.name, "the GPU device was lost");
            *slot = None;
        }
        result
    }
}

impl Renderer for GpuRenderer {
    fn name(&self) -> String {
        self.report.name.clone()
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        let view = View::new(gaussians.origin(), request)?;
        if gaussians.is_empty() {
            return Ok(frame::background(&view, request));
        }
        self.with_engine(|engine| {
            let count = narrow("gaussians", gaussians.len())?;
            let sh_count = gaussians.sh_count() as u32;
            let scene = engine.scenes.get(&engine.gpu, gaussians)?;
            let mut row = ViewRow::new(&view, request.background, request.antialiased);
            (row.gaussian_count, row.sh_count) = (count, sh_count);
            let labels = match request.labels {
                Labels::None => None,
                _ => Some(engine.scenes.labels(&engine.gpu, gaussians)?),
            };
            let mut drawing = Drawing {
                gpu: &engine.gpu,
                kernels: &engine.kernels,
                scratch: &mut engine.scratch,
                scene: &scene,
                row,
                kinds: request.kinds,
                wanted: &request.labels,
                labels: labels.as_ref(),
                isects_max: self.options.isects_max,
                frame: frame::background(&view, request),
                entries: Vec::new(),
                entries_max: 0,
            };
            drawing.rows(0..view.tiles_y())?;
            drawing.finish()
        })
    }
}
