//! One adapter of the pool: its device, what is kept on it, and the callers that share it.

use std::sync::{
    Arc, Mutex, MutexGuard, PoisonError,
    atomic::{AtomicU64, Ordering},
};

use super::{
    GpuOptions,
    buffers::SceneCache,
    device::Gpu,
    frame::{Drawing, Tools},
    pipelines::{Kernels, VIEWS_MAX},
    pool::{Job, Queue},
    profile::Marks,
    scratch::Scratch,
};
use crate::{
    error::{ErrorCode, Result},
    render::{
        DeviceTimes, Frame, Labels, RenderRequest, StageTime, select::AdapterReport, view::View,
    },
    scene::Gaussians,
};

/// Devices opened for one submission before its views are given up.
const OPENED_MAX: u32 = 3;
/// Gaussians of all views of one submission: beyond it a view fills a device alone.
const BATCH_GAUSSIANS: usize = 4 << 20;

/// A device with what was compiled and kept on it.
#[derive(Debug)]
pub(super) struct Engine {
    pub(super) gpu: Gpu,
    pub(super) kernels: Kernels,
    pub(super) scratch: Scratch,
    pub(super) scenes: SceneCache,
}

/// One adapter.
#[derive(Debug)]
pub(super) struct Station {
    options: GpuOptions,
    adapter: wgpu::Adapter,
    report: AdapterReport,
    /// `None` after the device was lost.
    engine: Mutex<Option<Engine>>,
    /// The engine's device, for those who do not wait for the engine.
    current: Mutex<Option<Gpu>>,
    /// The engine's scenes, likewise.
    held: Mutex<Vec<u64>>,
    queue: Queue,
    submissions: AtomicU64,
    views: AtomicU64,
}

impl Station {
    /// Opens a device and compiles the kernels.
    ///
    /// # Errors
    /// `gpu_unavailable` when the adapter refuses, `internal` when a kernel does not compile.
    pub(super) fn open(
        adapter: wgpu::Adapter,
        report: AdapterReport,
        options: &GpuOptions,
    ) -> Result<Self> {
        let station = Self {
            options: options.clone(),
            adapter,
            report,
            engine: Mutex::default(),
            current: Mutex::default(),
            held: Mutex::default(),
            queue: Queue::new(options.waiting_max),
            submissions: AtomicU64::new(0),
            views: AtomicU64::new(0),
        };
        let engine = station.new_engine()?;
        *lock(&station.engine) = Some(engine);
        Ok(station)
    }

    fn new_engine(&self) -> Result<Engine> {
        let gpu = Gpu::open(&self.adapter, self.options.portable)?;
        let kernels =
            Kernels::compile(&gpu, self.options.shaders.as_deref(), self.options.checked)?;
        *lock(&self.current) = Some(gpu.clone());
        let scenes = SceneCache::new(self.options.scene_bytes_max);
        Ok(Engine { gpu, kernels, scratch: Scratch::default(), scenes })
    }

    pub(super) fn adapter(&self) -> &AdapterReport {
        &self.report
    }

    pub(super) fn scenes_held(&self) -> usize {
        lock(&self.engine).as_ref().map_or(0, |engine| engine.scenes.len())
    }

    /// Whether the scene of that shape was here when the last view was drawn.
    pub(super) fn holds(&self, shape: u64) -> bool {
        lock(&self.held).contains(&shape)
    }

    /// Views that wait or are being drawn.
    pub(super) fn waiting(&self) -> usize {
        self.queue.len()
    }

    pub(super) fn submissions(&self) -> (u64, u64) {
        (self.submissions.load(Ordering::Relaxed), self.views.load(Ordering::Relaxed))
    }

    /// Ends the device as a driver's fault would, whatever runs on it.
    pub(super) fn lose_device(&self) {
        if let Some(gpu) = lock(&self.current).as_ref() {
            gpu.lose();
        }
    }

    /// Runs `work` on the device, opened again if it was lost.
    pub(super) fn with_engine<T>(&self, work: impl FnOnce(&mut Engine) -> Result<T>) -> Result<T> {
        let mut slot = lock(&self.engine);
        if slot.as_ref().is_some_and(|engine| engine.gpu.is_lost()) {
            self.give_up(&mut slot);
        }
        let engine = match &mut *slot {
            Some(engine) => engine,
            None => {
                let engine = self.new_engine()?;
                tracing::warn!(adapter = self.report.name, "the GPU device was opened again");
                slot.insert(engine)
            }
        };
        let result = work(engine);
        *lock(&self.held) = engine.scenes.shapes();
        if engine.gpu.is_lost() {
            self.give_up(&mut slot);
        }
        result
    }

    fn give_up(&self, slot: &mut Option<Engine>) {
        tracing::error!(adapter = self.report.name, "the GPU device was lost");
        lock(&self.held).clear();
        *slot = None;
    }

    /// Runs `work` as [`Self::with_engine`], once more on a new device each time one is lost.
    fn persistently<T>(&self, mut work: impl FnMut(&mut Engine) -> Result<T>) -> Result<T> {
        let mut opened = 1;
        loop {
            match self.with_engine(&mut work) {
                Err(error) if error.code() == ErrorCode::GpuUnavailable && opened < OPENED_MAX => {
                    opened += 1;
                }
                other => return other,
            }
        }
    }

    /// One view, drawn with the others of its scene that wait.
    ///
    /// # Errors
    /// As [`crate::render::Renderer::render`], and `overloaded` when too many wait.
    pub(super) fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        let views_max = (BATCH_GAUSSIANS / gaussians.len().max(1)).clamp(1, VIEWS_MAX as usize);
        let scene = gaussians.identity();
        self.queue.render(scene, request, views_max, |jobs| self.draw(gaussians, jobs))
    }

    /// Draws and answers all of `jobs`.
    fn draw(&self, gaussians: &Gaussians, jobs: &[Arc<Job>]) {
        self.submissions.fetch_add(1, Ordering::Relaxed);
        self.views.fetch_add(jobs.len() as u64, Ordering::Relaxed);
        if jobs.len() > 1 {
            let requests: Vec<_> = jobs.iter().map(|job| &job.request).collect();
            match self.persistently(|engine| self.together(engine, gaussians, &requests)) {
                Ok(frames) => {
                    for (job, frame) in jobs.iter().zip(frames) {
                        job.answer(frame.map_or_else(|| self.alone(gaussians, job), Ok));
                    }
                    return;
                }
                // One of them may be at fault: the others must not suffer.
                Err(error) => tracing::warn!(
                    adapter = self.report.name,
                    reason = error.message(),
                    views = jobs.len(),
                    "views are drawn one by one"
                ),
            }
        }
        for job in jobs {
            job.answer(self.alone(gaussians, job));
        }
    }

    fn alone(&self, gaussians: &Gaussians, job: &Job) -> Result<Frame> {
        let drawn = self.persistently(|engine| self.one(engine, gaussians, &job.request, None));
        match drawn {
            // Memory may be held by other scenes and by larger views: once without them.
            Err(error) if error.code() == ErrorCode::LimitExceeded => self.persistently(|engine| {
                engine.scenes.clear(&engine.gpu);
                engine.scratch = Scratch::default();
                self.one(engine, gaussians, &job.request, None)
            }),
            other => other,
        }
        .map(|drawn| drawn.0)
    }

    /// Views of one submission; `None` for one that needs more room than was guessed.
    fn together(
        &self,
        engine: &mut Engine,
        gaussians: &Gaussians,
        requests: &[&RenderRequest],
    ) -> Result<Vec<Option<Frame>>> {
        let views: Vec<_> = requests
            .iter()
            .map(|request| View::new(gaussians.origin(), request))
            .collect::<Result<_>>()?;
        let scene = engine.scenes.get(&engine.gpu, gaussians)?;
        let labelled = requests.first().is_some_and(|one| one.labels != Labels::None);
        let labels = match labelled {
            true => Some(engine.scenes.labels(&engine.gpu, gaussians)?),
            false => None,
        };
        let mut drawings: Vec<_> = views
            .iter()
            .zip(requests)
            .map(|(view, request)| Drawing::new(view, request, &scene))
            .collect();
        let mut tools = Tools {
            gpu: &engine.gpu,
            kernels: &engine.kernels,
            scratch: &mut engine.scratch,
            scene: &scene,
            labels: labels.as_ref(),
            isects_max: self.options.isects_max,
            marks: None,
            times: Vec::new(),
        };
        let drawn = tools.together(&mut drawings)?;
        let frames = drawings
            .into_iter()
            .zip(drawn)
            .map(|(drawing, drawn)| drawn.then(|| drawing.finish(&mut engine.scratch)).transpose());
        frames.collect()
    }

    /// One frame, and the times of its last submission where marks are given.
    fn one(
        &self,
        engine: &mut Engine,
        gaussians: &Gaussians,
        request: &RenderRequest,
        marks: Option<&mut Marks>,
    ) -> Result<(Frame, Vec<StageTime>)> {
        let view = View::new(gaussians.origin(), request)?;
        let scene = engine.scenes.get(&engine.gpu, gaussians)?;
        let labels = match request.labels {
            Labels::None => None,
            _ => Some(engine.scenes.labels(&engine.gpu, gaussians)?),
        };
        let mut tools = Tools {
            gpu: &engine.gpu,
            kernels: &engine.kernels,
            scratch: &mut engine.scratch,
            scene: &scene,
            labels: labels.as_ref(),
            isects_max: self.options.isects_max,
            marks,
            times: Vec::new(),
        };
        let mut drawing = Drawing::new(&view, request, &scene);
        let rows = drawing.whole();
        tools.rows(&mut drawing, rows)?;
        let times = std::mem::take(&mut tools.times);
        Ok((drawing.finish(&mut engine.scratch)?, times))
    }

    /// Times of a view by the device's clock.
    ///
    /// # Errors
    /// As [`Self::render`].
    pub(super) fn device_times(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
    ) -> Result<Option<DeviceTimes>> {
        self.with_engine(|engine| {
            if !engine.gpu.has_times {
                return Ok(None);
            }
            let mut times = |each| -> Result<Vec<StageTime>> {
                let mut marks = Marks::new(&engine.gpu, each)?;
                Ok(self.one(engine, gaussians, request, Some(&mut marks))?.1)
            };
            let total_ms = times(false)?.iter().map(|stage| stage.ms).sum();
            Ok(Some(DeviceTimes { total_ms, stages: times(true)? }))
        })
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
