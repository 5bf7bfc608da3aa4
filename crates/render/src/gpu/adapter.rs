//! One adapter of the pool: its device, the scenes on it, and the callers that share it.

use std::sync::{
    Arc,
    atomic::{AtomicU64, Ordering},
};

use parking_lot::Mutex;

use super::{
    buffers::{DeviceScene, SceneCache},
    context::{Context, OpenDevice},
    device::Gpu,
    drawing::Drawing,
    pipelines::{Kernels, VIEWS_MAX},
    pool::{QueuedView, SUBMISSIONS_MAX, ViewQueue},
    profile::Marks,
    scratch::Scratch,
    trainer::{DeviceTrainer, trainer_bytes},
};
use crate::{
    Frame, Labels, RenderRequest,
    backward::{FrameGradients, Gradients},
    blocks::blocks_from,
    constants::ISECTS_MAX,
    error::{Error, ErrorCode, Result},
    options::{AdapterReport, RendererOptions},
    renderer::{DeviceTimes, DispatchTime},
    scene::Gaussians,
    train::TrainingSet,
    view::View,
};

/// How often one submission is tried on a new device before its views fail.
const OPENED_MAX: u32 = 3;
/// Gaussians of all views of one submission. A view with more of them fills a device alone.
const BATCH_GAUSSIANS: usize = 4 << 20;

/// The device of an adapter, and the buffers that no submission uses now.
#[derive(Debug, Default)]
pub(super) struct DeviceState {
    /// `None` after the device was lost.
    pub(super) opened: Option<OpenDevice>,
    idle: Vec<Scratch>,
}

/// One adapter.
#[derive(Debug)]
pub(super) struct Adapter {
    options: RendererOptions,
    adapter: wgpu::Adapter,
    report: AdapterReport,
    pub(super) state: Mutex<DeviceState>,
    /// Shape identities of the device's scenes. Reading them does not wait for an upload.
    pub(super) shapes: Mutex<Vec<u64>>,
    queue: ViewQueue,
    pub(super) submissions: AtomicU64,
    pub(super) views: AtomicU64,
}

impl Adapter {
    /// Opens a device and compiles the kernels.
    /// Errors: `gpu_unavailable` when the adapter refuses, `internal` when a kernel does not
    /// compile.
    pub(super) fn open(
        adapter: wgpu::Adapter,
        report: AdapterReport,
        options: &RendererOptions,
    ) -> Result<Self> {
        let opened = Self {
            options: options.clone(),
            adapter,
            report,
            state: Mutex::default(),
            shapes: Mutex::default(),
            queue: ViewQueue::default(),
            submissions: AtomicU64::new(0),
            views: AtomicU64::new(0),
        };
        opened.state.lock().opened = Some(opened.open_device()?);
        Ok(opened)
    }

    fn open_device(&self) -> Result<OpenDevice> {
        let gpu = Gpu::open(&self.adapter, &self.options.switches)?;
        let kernels = Kernels::compile(&gpu, &self.options.switches, self.report.software)?;
        let scenes = SceneCache::new(self.options.scene_bytes_max, self.blocks_from());
        Ok(OpenDevice { gpu, kernels: Arc::new(kernels), scenes: Arc::new(Mutex::new(scenes)) })
    }

    pub(super) fn report(&self) -> &AdapterReport {
        &self.report
    }

    fn blocks_from(&self) -> usize {
        blocks_from(&self.options.switches)
    }

    fn isects_max(&self) -> u32 {
        self.options.switches.isects_max().unwrap_or(ISECTS_MAX)
    }

    /// Whether the device held the scene of that shape when the last view was drawn.
    pub(super) fn holds(&self, shape: u64) -> bool {
        self.shapes.lock().contains(&shape)
    }

    /// Views that wait or are being drawn.
    pub(super) fn waiting(&self) -> usize {
        self.queue.len()
    }

    /// Runs `work` on the device. A lost device is opened again first.
    pub(super) fn with_context<T>(
        &self,
        work: impl FnOnce(&mut Context) -> Result<T>,
    ) -> Result<T> {
        let mut context = self.context()?;
        let result = work(&mut context);
        *self.shapes.lock() = context.on.scenes.lock().shapes();
        let mut state = self.state.lock();
        if context.on.gpu.is_lost() {
            self.give_up(&mut state);
        } else if state.idle.len() < SUBMISSIONS_MAX {
            state.idle.push(context.scratch);
        }
        result
    }

    fn context(&self) -> Result<Context> {
        let mut state = self.state.lock();
        self.give_up(&mut state);
        let on = match &state.opened {
            Some(opened) => opened.clone(),
            None => {
                let opened = self.open_device()?;
                tracing::warn!(adapter = self.report.name, "the GPU device was opened again");
                state.opened.insert(opened).clone()
            }
        };
        Ok(Context { on, scratch: state.idle.pop().unwrap_or_default() })
    }

    /// Drops the device if it is lost.
    fn give_up(&self, state: &mut DeviceState) {
        if state.opened.as_ref().is_some_and(|opened| opened.gpu.is_lost()) {
            tracing::error!(adapter = self.report.name, "the GPU device was lost");
            *state = DeviceState::default();
            self.shapes.lock().clear();
        }
    }

    /// As [`Self::with_context`]; when the device is lost, `work` runs again on a new one.
    fn persistently<T>(&self, mut work: impl FnMut(&mut Context) -> Result<T>) -> Result<T> {
        let mut opened = 1;
        loop {
            match self.with_context(&mut work) {
                Err(error) if error.code() == ErrorCode::GpuUnavailable && opened < OPENED_MAX => {
                    opened += 1;
                }
                other => return other,
            }
        }
    }

    /// Uploads a scene that no view was drawn of yet. Other scenes can be drawn meanwhile.
    pub(super) fn prepare(&self, gaussians: &Gaussians) -> Result<()> {
        // The next view opens a device that was lost.
        let Some(on) = self.state.lock().opened.clone() else { return Ok(()) };
        let pages = on.scenes.lock().pages(&on.gpu, gaussians, false);
        if pages || self.holds(gaussians.shape_identity()) {
            return Ok(());
        }
        let scene = DeviceScene::for_views(&on.gpu, gaussians, self.blocks_from(), false)?;
        let mut scenes = on.scenes.lock();
        scenes.put(&on.gpu, scene);
        *self.shapes.lock() = scenes.shapes();
        Ok(())
    }

    /// Draws one view, together with waiting views of the same scene.
    pub(super) fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        let views_max = (BATCH_GAUSSIANS / gaussians.len().max(1)).clamp(1, VIEWS_MAX as usize);
        let scene = gaussians.identity();
        self.queue.render(scene, request, views_max, |views| self.draw(gaussians, views))
    }

    /// Draws and answers all of `views`.
    fn draw(&self, gaussians: &Gaussians, views: &[Arc<QueuedView>]) {
        self.submissions.fetch_add(1, Ordering::Relaxed);
        self.views.fetch_add(views.len() as u64, Ordering::Relaxed);
        if views.len() > 1 {
            let requests: Vec<_> = views.iter().map(|view| &view.request).collect();
            match self.persistently(|context| self.together(context, gaussians, &requests)) {
                Ok(frames) => {
                    for (view, frame) in views.iter().zip(frames) {
                        view.answer(frame.map_or_else(|| self.alone(gaussians, view), Ok));
                    }
                    return;
                }
                // One of them may be at fault, so each is drawn alone.
                Err(error) => tracing::warn!(
                    adapter = self.report.name,
                    reason = error.message(),
                    views = views.len(),
                    "views are drawn one by one"
                ),
            }
        }
        for view in views {
            view.answer(self.alone(gaussians, view));
        }
    }

    fn alone(&self, gaussians: &Gaussians, view: &QueuedView) -> Result<Frame> {
        self.with_room(|context| self.one(context, gaussians, &view.request, None))
    }

    /// As [`Self::persistently`]; where memory is short, `work` runs again with that of others.
    fn with_room<T>(&self, mut work: impl FnMut(&mut Context) -> Result<T>) -> Result<T> {
        match self.persistently(&mut work) {
            // Other scenes and larger views may hold the memory: free it and try once more.
            Err(error) if error.code() == ErrorCode::LimitExceeded => {
                self.persistently(|context| {
                    self.state.lock().idle.clear();
                    context.on.scenes.lock().clear(&context.on.gpu);
                    context.scratch = Scratch::default();
                    work(context)
                })
            }
            other => other,
        }
    }

    /// A frame and its backward pass.
    pub(super) fn backward(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        loss: &mut dyn FnMut(&Frame) -> Result<FrameGradients>,
        gradients: &mut Gradients,
    ) -> Result<Frame> {
        self.with_room(|context| {
            let scene = context.learnt(gaussians)?;
            let mut tools = context.tools(&scene, self.isects_max(), None);
            Ok(tools.backward(gaussians.origin(), request, loss, gradients)?.0)
        })
    }

    /// Times of a frame and its backward pass by the clock of the device.
    pub(super) fn backward_times(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        by: &FrameGradients,
    ) -> Result<Option<DeviceTimes>> {
        let mut gradients = Gradients::default();
        self.timed(|context, marks| {
            let scene = context.learnt(gaussians)?;
            let mut tools = context.tools(&scene, self.isects_max(), Some(marks));
            let loss = &mut |_: &_| Ok(by.clone());
            Ok(tools.backward(gaussians.origin(), request, loss, &mut gradients)?.1)
        })
    }

    /// A trainer with buffers of its own on the device, of about `bytes_max` bytes at most.
    pub(super) fn trainer(&self, set: &TrainingSet<'_>, bytes_max: u64) -> Result<DeviceTrainer> {
        let bytes = trainer_bytes(set);
        if bytes > bytes_max {
            return Err(Error::limit("training: bytes of the device", bytes, bytes_max));
        }
        let on = self.persistently(|context| Ok(context.on.clone()))?;
        DeviceTrainer::new(on, self.isects_max(), set)
    }

    /// Views of one submission. `None` stands for a view that needs more room than expected.
    fn together<'a>(
        &self,
        context: &mut Context,
        gaussians: &Gaussians,
        requests: &[&'a RenderRequest],
    ) -> Result<Vec<Option<Frame>>> {
        let labelled = requests.first().is_some_and(|one| one.labels != Labels::None);
        let detailed = requests.iter().any(|request| request.detail > 0.0);
        if context.pages(gaussians, detailed) {
            return Ok(requests.iter().map(|_| None).collect());
        }
        let scene = context.scene(gaussians, labelled, detailed)?;
        let start = |request: &&'a RenderRequest| Drawing::new(gaussians.origin(), request, &scene);
        let mut drawings = requests.iter().map(start).collect::<Result<Vec<_>>>()?;
        let mut tools = context.tools(&scene, self.isects_max(), None);
        let complete = tools.together(&mut drawings)?;
        let frames = drawings.into_iter().zip(complete).map(|(drawing, complete)| {
            complete.then(|| drawing.finish(&mut context.scratch)).transpose()
        });
        frames.collect()
    }

    /// One frame; `marks` has the times of its last submission. Where the device cannot hold what
    /// the view shows, its rows of tiles are halved.
    fn one(
        &self,
        context: &mut Context,
        gaussians: &Gaussians,
        request: &RenderRequest,
        mut marks: Option<&mut Marks>,
    ) -> Result<Frame> {
        let view = View::new(gaussians.origin(), request)?;
        let mut drawn: Option<Drawing<'_>> = None;
        // The topmost last.
        let mut left = Vec::from_iter(Some(0..view.tiles_y()));
        while let Some(rows) = left.pop() {
            let scene = match context.shown(gaussians, request, &view.band(&rows)) {
                Err(error) if error.code() == ErrorCode::LimitExceeded && rows.len() > 1 => {
                    let middle = rows.start.midpoint(rows.end);
                    left.extend([middle..rows.end, rows.start..middle]);
                    continue;
                }
                other => other?,
            };
            let mut drawing = match drawn.take() {
                Some(drawing) => drawing,
                None => Drawing::new(gaussians.origin(), request, &scene)?,
            };
            drawing.draws(&scene);
            let mut tools = context.tools(&scene, self.isects_max(), marks.as_deref_mut());
            tools.rows(&mut drawing, rows)?;
            drawn = Some(drawing);
        }
        let drawing = drawn.ok_or_else(|| Error::internal("a picture without rows"))?;
        drawing.finish(&mut context.scratch)
    }

    /// Times of a view by the clock of the device.
    pub(super) fn device_times(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
    ) -> Result<Option<DeviceTimes>> {
        self.timed(|context, marks| {
            self.one(context, gaussians, request, Some(marks))?;
            marks.read(&context.on.gpu)
        })
    }

    /// Times of the dispatches that `run` submits and returns.
    fn timed(
        &self,
        mut run: impl FnMut(&mut Context, &mut Marks) -> Result<Vec<DispatchTime>>,
    ) -> Result<Option<DeviceTimes>> {
        self.with_context(|context| {
            if !context.on.gpu.has_times {
                return Ok(None);
            }
            let mut times = |each| -> Result<Vec<DispatchTime>> {
                let mut marks = Marks::new(&context.on.gpu, each)?;
                run(context, &mut marks)
            };
            let total_ms = times(false)?.iter().map(|stage| stage.ms).sum();
            Ok(Some(DeviceTimes { total_ms, stages: times(true)? }))
        })
    }
}
