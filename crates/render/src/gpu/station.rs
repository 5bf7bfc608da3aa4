//! One adapter of the pool: its device, what is kept on it, and the callers that share it.

use std::sync::{
    Arc, Mutex, MutexGuard, PoisonError,
    atomic::{AtomicU64, Ordering},
};

use super::{
    GpuOptions,
    buffers::{Scene, SceneCache, SceneLabels},
    device::Gpu,
    frame::{Drawing, Tools},
    pipelines::{Kernels, VIEWS_MAX},
    pool::{Job, Queue, TURNS},
    profile::Marks,
    scratch::Scratch,
};
use crate::{
    DeviceTimes, Frame, Labels, RenderRequest, StageTime,
    error::{ErrorCode, Result},
    scene::Gaussians,
    select::AdapterReport,
    view::View,
};

/// Devices opened for one submission before its views are given up.
const OPENED_MAX: u32 = 3;
/// Gaussians of all views of one submission: beyond it a view fills a device alone.
const BATCH_GAUSSIANS: usize = 4 << 20;

/// A device with what was compiled and kept on it; clones are the same one.
#[derive(Clone, Debug)]
pub(super) struct Opened {
    pub(super) gpu: Gpu,
    pub(super) kernels: Arc<Kernels>,
    scenes: Arc<Mutex<SceneCache>>,
}

/// A device, for one who draws on it, and room of his own.
#[derive(Debug)]
pub(super) struct Engine {
    pub(super) on: Opened,
    pub(super) scratch: Scratch,
}

impl Engine {
    /// What frames of `scene` are drawn with.
    fn tools<'a>(
        &'a mut self,
        scene: &'a Scene,
        labels: Option<&'a SceneLabels>,
        isects_max: u32,
        marks: Option<&'a mut Marks>,
    ) -> Tools<'a> {
        let (gpu, kernels, scratch) = (&self.on.gpu, &*self.on.kernels, &mut self.scratch);
        Tools { gpu, kernels, scratch, scene, labels, isects_max, marks, times: Vec::new() }
    }

    /// The scene of `gaussians`, and its bank indices where they are wanted.
    ///
    /// # Errors
    /// As [`SceneCache::get`].
    pub(super) fn scene(
        &self,
        gaussians: &Gaussians,
        labelled: bool,
    ) -> Result<(Scene, Option<SceneLabels>)> {
        let mut scenes = lock(&self.on.scenes);
        let scene = scenes.get(&self.on.gpu, gaussians)?;
        let labels = match labelled {
            true => Some(scenes.labels(&self.on.gpu, gaussians)?),
            false => None,
        };
        Ok((scene, labels))
    }
}

/// The device of a station and the rooms that nobody uses.
#[derive(Debug, Default)]
struct Held {
    /// `None` after the device was lost.
    opened: Option<Opened>,
    idle: Vec<Scratch>,
}

/// One adapter.
#[derive(Debug)]
pub(super) struct Station {
    options: GpuOptions,
    adapter: wgpu::Adapter,
    report: AdapterReport,
    held: Mutex<Held>,
    /// What tells the device's scenes, for those who do not wait for an upload.
    shapes: Mutex<Vec<u64>>,
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
            held: Mutex::default(),
            shapes: Mutex::default(),
            queue: Queue::new(options.waiting_max),
            submissions: AtomicU64::new(0),
            views: AtomicU64::new(0),
        };
        lock(&station.held).opened = Some(station.open_device()?);
        Ok(station)
    }

    fn open_device(&self) -> Result<Opened> {
        let gpu = Gpu::open(&self.adapter, self.options.portable)?;
        let kernels = Kernels::compile(&gpu, &self.options, self.report.software)?;
        let scenes = SceneCache::new(self.options.scene_bytes_max);
        Ok(Opened { gpu, kernels: Arc::new(kernels), scenes: Arc::new(Mutex::new(scenes)) })
    }

    pub(super) fn adapter(&self) -> &AdapterReport {
        &self.report
    }

    pub(super) fn scenes_held(&self) -> usize {
        lock(&self.shapes).len()
    }

    /// Whether the scene of that shape was here when the last view was drawn.
    pub(super) fn holds(&self, shape: u64) -> bool {
        lock(&self.shapes).contains(&shape)
    }

    /// Views that wait or are being drawn.
    pub(super) fn waiting(&self) -> usize {
        self.queue.len()
    }

    pub(super) fn submissions(&self) -> (u64, u64) {
        (self.submissions.load(Ordering::Relaxed), self.views.load(Ordering::Relaxed))
    }

    /// Has everyone see the device lost, whatever runs on it.
    pub(super) fn lose_device(&self) {
        if let Some(opened) = &lock(&self.held).opened {
            opened.gpu.lose();
        }
    }

    /// Runs `work` on the device, opened again if it was lost.
    pub(super) fn with_engine<T>(&self, work: impl FnOnce(&mut Engine) -> Result<T>) -> Result<T> {
        let mut engine = self.engine()?;
        let result = work(&mut engine);
        *lock(&self.shapes) = lock(&engine.on.scenes).shapes();
        let mut held = lock(&self.held);
        if engine.on.gpu.is_lost() {
            self.give_up(&mut held);
        } else if held.idle.len() < TURNS {
            held.idle.push(engine.scratch);
        }
        result
    }

    fn engine(&self) -> Result<Engine> {
        let mut held = lock(&self.held);
        self.give_up(&mut held);
        let on = match &held.opened {
            Some(opened) => opened.clone(),
            None => {
                let opened = self.open_device()?;
                tracing::warn!(adapter = self.report.name, "the GPU device was opened again");
                held.opened.insert(opened).clone()
            }
        };
        Ok(Engine { on, scratch: held.idle.pop().unwrap_or_default() })
    }

    /// Lets go of the device if it is lost.
    fn give_up(&self, held: &mut Held) {
        if held.opened.as_ref().is_some_and(|opened| opened.gpu.is_lost()) {
            tracing::error!(adapter = self.report.name, "the GPU device was lost");
            *held = Held::default();
            lock(&self.shapes).clear();
        }
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
    /// As [`crate::Renderer::render`], and `overloaded` when too many wait.
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
                lock(&self.held).idle.clear();
                lock(&engine.on.scenes).clear(&engine.on.gpu);
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
        let labelled = requests.first().is_some_and(|one| one.labels != Labels::None);
        let (scene, labels) = engine.scene(gaussians, labelled)?;
        let mut drawings: Vec<_> = views
            .iter()
            .zip(requests)
            .map(|(view, request)| Drawing::new(view, request, &scene))
            .collect();
        let mut tools = engine.tools(&scene, labels.as_ref(), self.options.isects_max, None);
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
        let (scene, labels) = engine.scene(gaussians, request.labels != Labels::None)?;
        let mut tools = engine.tools(&scene, labels.as_ref(), self.options.isects_max, marks);
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
            if !engine.on.gpu.has_times {
                return Ok(None);
            }
            let mut times = |each| -> Result<Vec<StageTime>> {
                let mut marks = Marks::new(&engine.on.gpu, each)?;
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
