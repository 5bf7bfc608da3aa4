//! Steps on the device: photos and Gaussians go up once, a step is one submission for each photo,
//! and of each only the number of its tile pairs comes back. A step is written and submitted while
//! the device has the one before. One that lacked room for its tile pairs moved nothing, and is
//! taken again after the one that was under way.

use bytemuck::Zeroable;
use glam::DVec3;
use rayon::prelude::*;
use wgpu::BufferUsages;

use super::{
    batch_buffers::{BatchSizes, BufferCopy, TrainingBuffers},
    bindings::Inputs,
    buffers::{DeviceScene, GaussianRow, PlanRow, TrainingRow, narrow},
    context::OpenDevice,
    device::{Gpu, STORAGE},
    drawing::Drawing,
    frame::{ATTEMPTS_MAX, Batch, PLAN_BYTES, Tools},
    pipelines::{EXPOSURE_WORDS, GRADIENT_WORDS, Kernel, PAIR_SUMS, RasterKinds},
    readback,
    scratch::Scratch,
};
use crate::{
    Frame, Kinds, RenderRequest,
    backward::backward_request,
    constants::TILE_SIZE,
    error::{Error, Result},
    scene::{Gaussians, Photo},
    train::{Exposure, Trainer, TrainingPhoto, TrainingSet, TrainingStep, absent, adam, checked},
};

const ROW_BYTES: u64 = size_of::<TrainingRow>() as u64;
/// Bytes of a tile pair: its place in both halves, and its sums.
const PAIR_BYTES: u64 = 16 + 4 * PAIR_SUMS as u64;
/// Tile pairs of a Gaussian that are expected.
const PAIRS_A_GAUSSIAN: u64 = 4;
/// Photos that go up at once.
const PHOTO_CHUNK_BYTES: u64 = 32 << 20;

/// Bytes that a trainer of `set` takes on a device, about.
pub(super) fn trainer_bytes(set: &TrainingSet<'_>) -> u64 {
    let pixels = |at: &TrainingPhoto<'_>| u64::from(at.photo.width) * u64::from(at.photo.height);
    let most = set.photos.iter().map(pixels).max().unwrap_or(0);
    let numbers = 3 * set.gaussians.sh_count() as u64;
    let row = size_of::<GaussianRow>() as u64 + 4 * numbers;
    let learnt = gradient_bytes(1, numbers) + moment_bytes(1, numbers);
    // As they are, and as they were kept.
    let each = 2 * row + learnt + PAIRS_A_GAUSSIAN * PAIR_BYTES;
    // Pictures, what the loss says of them, and SSIM's windows.
    let pictures = most * 4 * (4 + 4 + 9);
    4 * set.photos.iter().map(pixels).sum::<u64>() + pictures + each * set.gaussians.len() as u64
}

/// Of `count` Gaussians with so many numbers of harmonics.
fn gradient_bytes(count: u64, numbers: u64) -> u64 {
    4 * count * (u64::from(GRADIENT_WORDS) + numbers)
}

fn moment_bytes(count: u64, numbers: u64) -> u64 {
    4 * count * (1 + 2 * (adam::SHAPE as u64 + numbers))
}

/// A photo of the trainer.
#[derive(Clone, Debug)]
struct Target {
    request: RenderRequest,
    /// Its first pixel.
    start: u32,
}

/// A [`Trainer`] on a device, with buffers of its own.
#[derive(Debug)]
pub(super) struct DeviceTrainer {
    on: OpenDevice,
    isects_max: u32,
    scratch: Scratch,
    /// As they came in.
    start: Gaussians,
    /// As they are now. One that was dropped has opacity 0.
    scene: DeviceScene,
    /// Rows and harmonics as they were when they were kept.
    kept: Option<[wgpu::Buffer; 2]>,
    training: TrainingBuffers,
    /// Gradients of the photos before the last one of a step; there for steps of several.
    earlier: Option<wgpu::Buffer>,
    targets: Vec<Target>,
    ssim_share: f32,
    /// Most tile pairs that a step has needed.
    isects: u32,
    /// Where the plans of submissions come back, by turns.
    plans: [wgpu::Buffer; 2],
    /// The last step, while it is not known whether it had room.
    pending: Option<Pending>,
}

/// A submission whose plan is not here yet.
#[derive(Debug)]
struct Pending {
    photo_step: PhotoStep,
    /// Tile pairs that it had room for.
    capacity: u32,
    plan: readback::PendingRead,
}

/// What a submission does: the photo that it draws, the step, whether it adds what earlier photos
/// say, and whether it moves the Gaussians.
#[derive(Clone, Copy, Debug)]
struct PhotoStep {
    at: usize,
    step: TrainingStep,
    adds: bool,
    moves: bool,
}

/// A photo's step as the device takes it.
struct DeviceStep<'a> {
    request: &'a RenderRequest,
    row: TrainingRow,
    training: &'a TrainingBuffers,
    /// What earlier photos of the step say.
    earlier: Option<&'a wgpu::Buffer>,
    adds: bool,
    moves: bool,
    /// Where its plan goes.
    plan: &'a wgpu::Buffer,
}

impl DeviceTrainer {
    /// Uploads all that `set` has.
    /// Errors: `limit_exceeded` where it does not fit; `internal` for a photo of another size than
    /// its view.
    pub(super) fn new(on: OpenDevice, isects_max: u32, set: &TrainingSet<'_>) -> Result<Self> {
        set.check()?;
        let (gpu, count) = (&on.gpu, set.gaussians.len() as u64);
        // No step waits for a compiler.
        for kernel in Kernel::TRAINING {
            on.kernels.get(gpu, kernel)?;
        }
        let numbers = 3 * set.gaussians.sh_count() as u64;
        let (mut targets, mut pixels, mut most) = (Vec::new(), 0_usize, [0_u32; 2]);
        for TrainingPhoto { photo, request } in &set.photos {
            let start = narrow("pixels of photos", pixels)?;
            targets.push(Target { request: backward_request(request), start });
            pixels += photo.width as usize * photo.height as usize;
            most = [most[0].max(photo.width), most[1].max(photo.height)];
        }
        let tiles = most.map(|side| u64::from(side.div_ceil(TILE_SIZE)));
        let storage = |label, bytes| gpu.create_buffer(label, bytes, STORAGE);
        let training = TrainingBuffers {
            row: gpu.create_buffer(
                "training",
                ROW_BYTES,
                BufferUsages::UNIFORM | BufferUsages::COPY_DST,
            )?,
            photos: storage("photos to learn", 4 * pixels as u64)?,
            exposures: storage("exposures", 4 * u64::from(EXPOSURE_WORDS) * targets.len() as u64)?,
            by_windows: storage("windows", 36 * u64::from(most[0]) * u64::from(most[1]))?,
            partials: storage("sums of the loss", 48 * tiles[0] * tiles[1])?,
            moments: storage("moments", moment_bytes(count, numbers))?,
        };
        let back = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        let plan = || gpu.create_buffer("plan of a step", PLAN_BYTES, back);
        let plans = [plan()?, plan()?];
        put_photos(gpu, &training.photos, &set.photos)?;
        let mut exposure = [0.0_f32; EXPOSURE_WORDS as usize];
        exposure[..3].fill(1.0);
        exposure[EXPOSURE_WORDS as usize - 1] = f32::NAN;
        let exposures = exposure.repeat(targets.len());
        let scene = DeviceScene::upload(gpu, set.gaussians, None)?;
        gpu.scoped("training", || {
            gpu.queue.write_buffer(&training.exposures, 0, bytemuck::cast_slice(&exposures));
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            encoder.clear_buffer(&training.moments, 0, None);
            gpu.queue.submit([encoder.finish()]);
        })?;
        Ok(Self {
            isects_max,
            scratch: Scratch::default(),
            start: set.gaussians.clone(),
            scene,
            kept: None,
            training,
            earlier: None,
            targets,
            ssim_share: set.ssim_share,
            isects: 0,
            plans,
            pending: None,
            on,
        })
    }

    /// Takes the step of a photo, with more room until its tile pairs fit.
    fn take(&mut self, photo_step: PhotoStep) -> Result<()> {
        let capacity_max = self.tools().capacity_max(1);
        let mut attempts = 0;
        while attempts < ATTEMPTS_MAX && self.isects <= capacity_max {
            let submitted = self.submit(photo_step)?;
            if self.had_room(submitted)? {
                return Ok(());
            }
            attempts += 1;
        }
        Err(Error::limit("training: Gaussian-tile pairs of a view", self.isects, capacity_max))
    }

    /// Waits for the step that is not known to be done, and takes it again where it lacked room.
    fn settle(&mut self) -> Result<()> {
        let Some(pending) = self.pending.take() else { return Ok(()) };
        let photo_step = pending.photo_step;
        if self.had_room(pending)? { Ok(()) } else { self.take(photo_step) }
    }

    /// Waits for a submission; whether its tile pairs had room. If not, there is more for the next.
    fn had_room(&mut self, submitted: Pending) -> Result<bool> {
        let Pending { capacity, plan, .. } = submitted;
        let plan: PlanRow = readback::wait(&self.on.gpu, plan, bytemuck::pod_read_unaligned)?;
        self.isects = plan.needed.max(self.isects);
        Ok(plan.needed <= capacity)
    }

    fn tools(&mut self) -> Tools<'_> {
        let Self { on, scratch, scene, isects, isects_max, .. } = self;
        scratch.isects = *isects;
        let (gpu, kernels) = (&on.gpu, &*on.kernels);
        Tools { gpu, kernels, scratch, scene, isects_max: *isects_max, marks: None }
    }

    /// Submits the step of a photo, and asks for its plan.
    fn submit(&mut self, photo_step: PhotoStep) -> Result<Pending> {
        let PhotoStep { at, step, adds, moves } = photo_step;
        let target = self.targets.get(at).ok_or_else(|| absent(at))?.clone();
        let rates = &step.rates;
        let row = TrainingRow {
            means: rates.means,
            quats: rates.quats,
            scales: rates.scales,
            opacities: rates.opacities,
            sh: rates.sh,
            sh_rest: rates.sh_rest,
            exposure: step.exposure,
            opacity_min: step.opacity_min,
            ssim_share: self.ssim_share,
            photo: at as u32,
            photo_start: target.start,
            ..TrainingRow::zeroed()
        };
        // That of the step before may still be under way in the other.
        self.plans.reverse();
        let (plan, training) = (self.plans[0].clone(), self.training.clone());
        let (earlier, origin) = (self.earlier.clone(), self.start.origin());
        let step = DeviceStep {
            request: &target.request,
            row,
            training: &training,
            earlier: earlier.as_ref(),
            adds,
            moves,
            plan: &plan,
        };
        let mut tools = self.tools();
        let capacity = tools.capacity(1);
        tools.train(origin, &step, capacity)?;
        let plan = readback::ask(&self.on.gpu, &plan, PLAN_BYTES)?;
        Ok(Pending { photo_step, capacity, plan })
    }

    /// Bytes of a buffer.
    fn read<T>(
        &mut self,
        parts: &[(&wgpu::Buffer, u64)],
        take: impl FnOnce(&[u8]) -> T,
    ) -> Result<T> {
        let gpu = &self.on.gpu;
        let total = parts.iter().map(|part| part.1).sum::<u64>();
        let staging = self.scratch.staging(gpu, total)?;
        gpu.scoped("training", || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let mut to = 0;
            for (buffer, bytes) in parts {
                encoder.copy_buffer_to_buffer(buffer, 0, &staging, to, Some(*bytes));
                to += bytes;
            }
            gpu.queue.submit([encoder.finish()]);
        })?;
        readback::read(gpu, &staging, total, take)
    }

    /// Bytes of the rows and of the harmonics.
    fn sizes(&self) -> [u64; 2] {
        let count = self.start.len();
        let rows = size_of::<GaussianRow>() * count;
        [rows as u64, 12 * (count * self.start.sh_count()) as u64]
    }

    /// The Gaussians of buffers of rows and harmonics.
    fn read_gaussians(&mut self, [rows, sh]: [wgpu::Buffer; 2]) -> Result<Gaussians> {
        let sizes = self.sizes();
        let row_bytes = size_of::<GaussianRow>() * self.start.len();
        let parts = [(&rows, sizes[0]), (&sh, sizes[1])];
        let mut raw = self.start.clone().into_raw();
        self.read(&parts, |bytes| {
            let (rows, sh) = bytes.split_at(row_bytes);
            raw.sh.copy_from_slice(bytemuck::cast_slice(sh));
            let rows: &[GaussianRow] = bytemuck::cast_slice(rows);
            let out = raw.means.par_iter_mut().zip(&mut raw.quats).zip(&mut raw.scales);
            let out = out.zip(&mut raw.opacities).zip(rows).with_min_len(1 << 14);
            out.for_each(|((((mean, quat), scale), opacity), row)| {
                (*mean, *quat, *scale) = (row.mean, row.quat, row.scale);
                *opacity = row.opacity;
            });
        })?;
        // Those that were dropped are under the smallest opacity.
        let dropped = |opacity: &f32| *opacity < Gaussians::OPACITY_MIN;
        let dropped: Vec<bool> = raw.opacities.iter().map(dropped).collect();
        let raised = |opacity: &mut f32| *opacity = opacity.max(Gaussians::OPACITY_MIN);
        raw.opacities.iter_mut().for_each(raised);
        let all = checked(raw)?;
        Ok(if dropped.contains(&true) { all.only(|i| !dropped[i]) } else { all })
    }

    /// What the loss says of the last picture, which photo `at` has the size of; `[H * W]`.
    #[cfg(feature = "testing")]
    pub(super) fn by_picture(&mut self, at: usize) -> Result<Vec<[f32; 3]>> {
        self.settle()?;
        let target = self.targets.get(at).ok_or_else(|| absent(at))?;
        let lens = target.request.lens();
        let bytes = 12 * u64::from(lens.width) * u64::from(lens.height);
        let by = self.scratch.backward_room(&self.on.gpu, [0; 3])?.by_pictures;
        self.read(&[(&by, bytes)], bytemuck::pod_collect_to_vec)
    }
}

impl Trainer for DeviceTrainer {
    fn step(&mut self, photos: &[usize], step: &TrainingStep) -> Result<()> {
        if photos.len() > 1 && self.earlier.is_none() {
            let bytes = gradient_bytes(self.scene.count.into(), 3 * u64::from(self.scene.sh_count));
            self.earlier = Some(self.on.gpu.create_buffer("earlier gradients", bytes, STORAGE)?);
        }
        let step = *step;
        if let [at] = *photos {
            let next = self.submit(PhotoStep { at, step, adds: false, moves: true })?;
            let Some(last) = self.pending.replace(next) else { return Ok(()) };
            let photo_step = last.photo_step;
            if !self.had_room(last)? {
                self.settle()?;
                self.take(photo_step)?;
            }
            return Ok(());
        }
        // What the last photo moves needs what the others say.
        self.settle()?;
        for (place, &at) in photos.iter().enumerate() {
            self.take(PhotoStep { at, step, adds: place > 0, moves: place + 1 == photos.len() })?;
        }
        Ok(())
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Frame> {
        self.settle()?;
        // How bright its colours have become is not known here.
        let request = &RenderRequest { error: 0.0, ..request.clone() };
        let mut drawing = Drawing::new(self.start.origin(), request, &self.scene)?;
        let rows = drawing.whole();
        self.tools().rows(&mut drawing, rows)?;
        drawing.finish(&mut self.scratch)
    }

    fn gaussians(&mut self) -> Result<Gaussians> {
        self.settle()?;
        let now = [self.scene.gaussians.clone(), self.scene.sh.clone()];
        self.read_gaussians(now)
    }

    fn keep(&mut self) -> Result<()> {
        self.settle()?;
        let (gpu, sizes) = (&self.on.gpu, self.sizes());
        let kept = match self.kept.take() {
            Some(kept) => kept,
            None => [
                gpu.create_buffer("kept rows", sizes[0], STORAGE)?,
                gpu.create_buffer("kept harmonics", sizes[1], STORAGE)?,
            ],
        };
        gpu.scoped("training", || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let now = [&self.scene.gaussians, &self.scene.sh];
            for ((from, to), bytes) in now.into_iter().zip(&kept).zip(sizes) {
                encoder.copy_buffer_to_buffer(from, 0, to, 0, Some(bytes));
            }
            gpu.queue.submit([encoder.finish()]);
        })?;
        self.kept = Some(kept);
        Ok(())
    }

    fn kept(&mut self) -> Result<Gaussians> {
        match self.kept.clone() {
            Some(kept) => self.read_gaussians(kept),
            None => self.gaussians(),
        }
    }

    fn exposures(&mut self) -> Result<Vec<(Exposure, f64)>> {
        self.settle()?;
        let exposures = self.training.exposures.clone();
        let bytes = 4 * u64::from(EXPOSURE_WORDS) * self.targets.len() as u64;
        self.read(&[(&exposures, bytes)], |bytes| {
            let rows: &[[f32; EXPOSURE_WORDS as usize]] = bytemuck::cast_slice(bytes);
            let read = |row: &[f32; EXPOSURE_WORDS as usize]| {
                let (gain, bias) = ([row[0], row[1], row[2]], [row[3], row[4], row[5]]);
                (Exposure::new(gain, bias), f64::from(row[19]))
            };
            rows.iter().map(read).collect()
        })
    }
}

/// Uploads the pixels of all photos, one after another.
fn put_photos(gpu: &Gpu, to: &wgpu::Buffer, photos: &[TrainingPhoto<'_>]) -> Result<()> {
    gpu.scoped("photos to learn", || {
        let (mut start, mut unsent) = (0, 0);
        for TrainingPhoto { photo, .. } in photos {
            let pixels = rgba_of(photo);
            let bytes: &[u8] = bytemuck::cast_slice(&pixels);
            gpu.queue.write_buffer(to, start, bytes);
            start += bytes.len() as u64;
            unsent += bytes.len() as u64;
            if unsent >= PHOTO_CHUNK_BYTES {
                gpu.queue.submit([]);
                unsent = 0;
            }
        }
    })
}

/// Pixels as the shaders read them: RGBA, A = 0 where none is known.
fn rgba_of(photo: &Photo) -> Vec<[u8; 4]> {
    let known = |i: usize| photo.valid.as_ref().is_none_or(|valid| valid[i]);
    let pixels = photo.rgb.chunks_exact(3).enumerate();
    pixels.map(|(i, c)| [c[0], c[1], c[2], if known(i) { 255 } else { 0 }]).collect()
}

impl Tools<'_> {
    /// Draws, compares, goes back and moves, in one submission of one view with room for `capacity`
    /// tile pairs. Where the plan says that it needs more, nothing is moved.
    fn train(&mut self, origin: DVec3, step: &DeviceStep<'_>, capacity: u32) -> Result<()> {
        let DeviceStep { request, training, earlier, adds, moves, .. } = *step;
        let (gpu, scene) = (self.gpu, self.scene);
        let drawing = Drawing::new(origin, request, scene)?;
        let (tiles, layouts) = (drawing.tiles(), [drawing.layout(drawing.whole(), 0)]);
        let gradient_bytes = gradient_bytes(scene.count.into(), 3 * u64::from(scene.sh_count));
        let sums = 4 * u64::from(capacity) * u64::from(PAIR_SUMS);
        let sizes = [layouts[0].picture_bytes(), sums, gradient_bytes];
        // First, for both share a staging buffer, which this one needs the larger one of.
        let backward = self.scratch.backward_room(gpu, sizes)?;
        let batch = Batch::new(&[drawing], &layouts, capacity);
        let sizes = batch.sizes(scene, !self.kernels.flat(scene.sh_count));
        let room = self.scratch.room(gpu, &BatchSizes { staging_bytes: 0, ..sizes })?;
        let held = std::mem::take(&mut self.scratch.backdrops);
        let inputs = Inputs {
            backward: Some(&backward),
            training: Some(training),
            earlier,
            ..Inputs::new(self.kernels, &room, Some(scene), 1)
        };
        gpu.scoped("training", || {
            batch.write(gpu, &room, &held);
            gpu.queue.write_buffer(&training.row, 0, bytemuck::bytes_of(&step.row));
            let [plans, ends, _] = room.zeros();
            let mut stages = self.recorder(inputs, &[plans, ends, &backward.sums]);
            stages.draw(RasterKinds::from(request), tiles);
            stages.compare(tiles);
            stages.backward(Kinds::COLOR, tiles);
            if adds && earlier.is_some() {
                stages.gaussians(Kernel::AddEarlier);
            }
            let copy = |from, to, bytes| BufferCopy { from: (from, 0), to: (to, 0), bytes };
            let plan = copy(&room.plans, step.plan, PLAN_BYTES);
            match earlier {
                Some(earlier) if !moves => {
                    stages.submit(&[plan, copy(&backward.gradients, earlier, gradient_bytes)])
                }
                _ => {
                    stages.gaussians(Kernel::Adam);
                    stages.submit(&[plan])
                }
            }
        })??;
        self.scratch.backdrops = batch.held_after(held);
        Ok(())
    }
}
