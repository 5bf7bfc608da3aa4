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
    pipelines::{EXPOSURE_WORDS, GRADIENT_WORDS, Kernel, PAIR_SUMS, POSE_GROUPS, RasterKinds},
    readback,
    scratch::Scratch,
};
use crate::{
    Frame, Kinds, RenderRequest,
    backward::backward_request,
    constants::TILE_SIZE,
    error::{Error, Result},
    scene::{CameraToWorld, Gaussians, Photo, RawGaussians},
    train::{
        Exposure, LearningRates, PoseGradient, StreamedPhoto, Trainer, TrainingPhoto, TrainingSet,
        TrainingStep, absent, adam, checked,
        growth::{Origins, halves, most_blamed},
        pose::Pose,
    },
};

const ROW_BYTES: u64 = size_of::<TrainingRow>() as u64;
/// Bytes of a tile pair: its place in both halves, and its sums.
const PAIR_BYTES: u64 = 16 + 4 * PAIR_SUMS as u64;
/// Tile pairs of a Gaussian that are expected.
const PAIRS_A_GAUSSIAN: u64 = 4;
/// What comes back of a step: its plan, then what it says of the camera.
const POSE_BYTES: u64 = 32 * POSE_GROUPS as u64;
const TOLD_BYTES: u64 = PLAN_BYTES + POSE_BYTES;
/// Photos that go up at once.
const PHOTO_CHUNK_BYTES: u64 = 32 << 20;

/// Bytes that a trainer of `set` takes on a device, about.
pub(super) fn trainer_bytes(set: &TrainingSet<'_>) -> u64 {
    let pixels = |at: &TrainingPhoto<'_>| u64::from(at.photo.width) * u64::from(at.photo.height);
    let streamed = streamed_pixels(set);
    let most = set.photos.iter().map(pixels).max().unwrap_or(0).max(streamed);
    let numbers = 3 * set.gaussians.sh_count() as u64;
    let row = size_of::<GaussianRow>() as u64 + 4 * numbers;
    let learnt = gradient_bytes(1, numbers) + moment_bytes(1, numbers);
    let each = row + learnt + PAIRS_A_GAUSSIAN * PAIR_BYTES;
    // Pictures, what the loss says of them, and SSIM's windows.
    let pictures = most * 4 * (4 + 4 + 9);
    let photos = set.photos.iter().map(pixels).sum::<u64>() + streamed;
    4 * photos + pictures + each * places_of(set) as u64
}

/// Pixels of the largest photo that is read for each of its steps: all of them have one place.
fn streamed_pixels(set: &TrainingSet<'_>) -> u64 {
    set.streamed.iter().map(StreamedPhoto::pixels).max().unwrap_or(0)
}

/// Places for Gaussians that a trainer of `set` has.
fn places_of(set: &TrainingSet<'_>) -> usize {
    set.gaussians_max.max(set.gaussians.len())
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
    /// Number of its camera.
    pose: usize,
    /// Where its pixels are, of one that goes up for each of its steps.
    streamed: Option<StreamedPhoto>,
}

/// A [`Trainer`] on a device, with buffers of its own.
#[derive(Debug)]
pub(super) struct DeviceTrainer {
    on: OpenDevice,
    isects_max: u32,
    scratch: Scratch,
    origin: DVec3,
    sh_degree: u8,
    /// Of each place.
    origins: Origins,
    /// As they are now. A place without a Gaussian has opacity 0: one was dropped, or none came.
    scene: DeviceScene,
    /// Places from the first on, behind which none had a Gaussian yet.
    used: usize,
    training: TrainingBuffers,
    /// Gradients of the photos before the last one of a step; there for steps of several.
    earlier: Option<wgpu::Buffer>,
    targets: Vec<Target>,
    poses: Vec<Pose>,
    ssim_share: f32,
    /// Most tile pairs that a step has needed.
    isects: u32,
    /// Where what submissions tell comes back, by turns.
    told: [wgpu::Buffer; 2],
    /// The last step, while it is not known whether it had room.
    pending: Option<Pending>,
}

/// A submission of which nothing came back yet.
#[derive(Debug)]
struct Pending {
    photo_step: PhotoStep,
    /// Tile pairs that it had room for.
    capacity: u32,
    told: readback::PendingRead,
}

/// What a submission does: the photo that it draws, the step, whether it adds what earlier photos
/// say, whether it moves the Gaussians, and whether it blames them in place of learning.
#[derive(Clone, Copy, Debug)]
struct PhotoStep {
    at: usize,
    step: TrainingStep,
    adds: bool,
    moves: bool,
    blames: bool,
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
    blames: bool,
    /// Whether the camera is asked about, too.
    poses: bool,
    /// Where its plan goes, and what it says of the camera.
    told: &'a wgpu::Buffer,
}

impl DeviceTrainer {
    /// Uploads all that `set` has.
    /// Errors: `limit_exceeded` where it does not fit; `internal` for a photo of another size than
    /// its view.
    pub(super) fn new(on: OpenDevice, isects_max: u32, set: &TrainingSet<'_>) -> Result<Self> {
        set.check()?;
        let (gpu, places) = (&on.gpu, places_of(set));
        let count = places as u64;
        // No step waits for a compiler.
        for kernel in Kernel::TRAINING {
            on.kernels.get(gpu, kernel)?;
        }
        let numbers = 3 * set.gaussians.sh_count() as u64;
        let (mut targets, mut pixels, mut most) = (Vec::new(), 0_usize, [0_u32; 2]);
        for TrainingPhoto { photo, request, pose } in &set.photos {
            let start = narrow("pixels of photos", pixels)?;
            let (request, pose) = (backward_request(request), *pose);
            targets.push(Target { request, start, pose, streamed: None });
            pixels += photo.width as usize * photo.height as usize;
            most = [most[0].max(photo.width), most[1].max(photo.height)];
        }
        // One place for all that are streamed: what is written before a step is written after the
        // step before.
        let start = narrow("pixels of photos", pixels)?;
        for photo in &set.streamed {
            let request = backward_request(&photo.request);
            let (lens, pose) = (request.lens(), photo.pose);
            most = [most[0].max(lens.width), most[1].max(lens.height)];
            targets.push(Target { request, start, pose, streamed: Some(photo.clone()) });
        }
        let pixels = pixels as u64 + streamed_pixels(set);
        let tiles = most.map(|side| u64::from(side.div_ceil(TILE_SIZE)));
        let storage = |label, bytes| gpu.create_buffer(label, bytes, STORAGE);
        let training = TrainingBuffers {
            row: gpu.create_buffer(
                "training",
                ROW_BYTES,
                BufferUsages::UNIFORM | BufferUsages::COPY_DST,
            )?,
            photos: storage("photos to learn", 4 * pixels)?,
            exposures: storage("exposures", 4 * u64::from(EXPOSURE_WORDS) * targets.len() as u64)?,
            by_windows: storage("windows", 36 * u64::from(most[0]) * u64::from(most[1]))?,
            partials: storage("sums of the loss", 48 * tiles[0] * tiles[1])?,
            moments: storage("moments", moment_bytes(count, numbers))?,
            pose_sums: storage("sums of the camera", POSE_BYTES)?,
        };
        let back = BufferUsages::MAP_READ | BufferUsages::COPY_DST;
        let told = || gpu.create_buffer("what a step tells", TOLD_BYTES, back);
        let told = [told()?, told()?];
        put_photos(gpu, &training.photos, &set.photos)?;
        let mut exposure = [0.0_f32; EXPOSURE_WORDS as usize];
        exposure[..3].fill(1.0);
        exposure[EXPOSURE_WORDS as usize - 1] = f32::NAN;
        let exposures = exposure.repeat(targets.len());
        let scene = DeviceScene::with_places(gpu, set.gaussians, places)?;
        let mut source = set.gaussians.source().to_vec();
        let mut semantic_index = set.gaussians.semantic_index().to_vec();
        source.resize_with(places, Default::default);
        semantic_index.resize(places, 0);
        gpu.scoped("training", || {
            gpu.queue.write_buffer(&training.exposures, 0, bytemuck::cast_slice(&exposures));
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            encoder.clear_buffer(&training.moments, 0, None);
            gpu.queue.submit([encoder.finish()]);
        })?;
        Ok(Self {
            isects_max,
            scratch: Scratch::default(),
            origin: set.gaussians.origin(),
            sh_degree: set.gaussians.sh_degree(),
            origins: Origins { source, semantic_index },
            scene,
            used: set.gaussians.len(),
            training,
            earlier: None,
            targets,
            poses: set.poses(),
            ssim_share: set.ssim_share,
            isects: 0,
            told,
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

    /// Waits for a submission; whether its tile pairs had room. If not, there is more for the next;
    /// if so, the photo's camera moves.
    fn had_room(&mut self, submitted: Pending) -> Result<bool> {
        let Pending { capacity, told, photo_step } = submitted;
        let (plan, sums) = readback::wait(&self.on.gpu, told, |bytes| {
            let (plan, sums) = bytes.split_at(PLAN_BYTES as usize);
            let sums: Vec<[[f32; 4]; 2]> = bytemuck::pod_collect_to_vec(sums);
            (bytemuck::pod_read_unaligned::<PlanRow>(plan), sums)
        })?;
        self.isects = plan.needed.max(self.isects);
        let had_room = plan.needed <= capacity;
        let PhotoStep { at, step, .. } = photo_step;
        if had_room && step.poses.moves() {
            let sum = sums.iter().fold(PoseGradient::default(), |sum, [shift, turn]| {
                let [shift, turn] = [shift, turn].map(|v| DVec3::from_slice(&v.map(f64::from)));
                sum.plus(PoseGradient { turn, shift })
            });
            let pose = self.targets[at].pose;
            self.poses[pose].step(&sum, step.poses);
        }
        Ok(had_room)
    }

    fn tools(&mut self) -> Tools<'_> {
        let Self { on, scratch, scene, isects, isects_max, .. } = self;
        scratch.isects = *isects;
        let (gpu, kernels) = (&on.gpu, &*on.kernels);
        Tools { gpu, kernels, scratch, scene, isects_max: *isects_max, marks: None }
    }

    /// Submits the step of a photo, and asks for its plan.
    fn submit(&mut self, photo_step: PhotoStep) -> Result<Pending> {
        let PhotoStep { at, step, adds, moves, blames } = photo_step;
        let mut target = self.targets.get(at).ok_or_else(|| absent(at))?.clone();
        target.request.camera.camera_to_world = self.poses[target.pose].now;
        if let Some(photo) = &target.streamed {
            let pixels = rgba_of(&photo.read()?);
            let (to, at) = (&self.training.photos, 4 * u64::from(target.start));
            let bytes = bytemuck::cast_slice(&pixels);
            self.on
                .gpu
                .scoped("a photo to learn", || self.on.gpu.queue.write_buffer(to, at, bytes))?;
        }
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
            blames: blames.into(),
        };
        // That of the step before may still be under way in the other.
        self.told.reverse();
        let (told, training) = (self.told[0].clone(), self.training.clone());
        let (earlier, origin) = (self.earlier.clone(), self.origin);
        let poses = step.poses.moves();
        let step = DeviceStep {
            request: &target.request,
            row,
            training: &training,
            earlier: earlier.as_ref(),
            adds,
            moves,
            blames,
            poses,
            told: &told,
        };
        let mut tools = self.tools();
        let capacity = tools.capacity(1);
        tools.train(origin, &step, capacity)?;
        let told = readback::ask(&self.on.gpu, &told, TOLD_BYTES)?;
        Ok(Pending { photo_step, capacity, told })
    }

    /// Buffers from a byte on, and how many bytes, one after another.
    fn read<T>(
        &mut self,
        parts: &[(&wgpu::Buffer, u64, u64)],
        take: impl FnOnce(&[u8]) -> T,
    ) -> Result<T> {
        let gpu = &self.on.gpu;
        let total = parts.iter().map(|part| part.2).sum::<u64>();
        let staging = self.scratch.staging(gpu, total)?;
        gpu.scoped("training", || {
            let mut encoder = gpu.device.create_command_encoder(&Default::default());
            let mut to = 0;
            for (buffer, from, bytes) in parts {
                encoder.copy_buffer_to_buffer(buffer, *from, &staging, to, Some(*bytes));
                to += bytes;
            }
            gpu.queue.submit([encoder.finish()]);
        })?;
        readback::read(gpu, &staging, total, take)
    }

    /// Bytes of the rows and of the harmonics of so many places.
    fn sizes(&self, places: usize) -> [u64; 2] {
        let (places, k) = (places as u64, u64::from(self.scene.sh_count));
        [size_of::<GaussianRow>() as u64 * places, 12 * k * places]
    }

    /// Rows and harmonics of the places that are used.
    fn read_places(&mut self, rows: &wgpu::Buffer, sh: &wgpu::Buffer) -> Result<Places> {
        let [row_bytes, sh_bytes] = self.sizes(self.used);
        self.read(&[(rows, 0, row_bytes), (sh, 0, sh_bytes)], |bytes| {
            let (rows, sh) = bytes.split_at(row_bytes as usize);
            (bytemuck::pod_collect_to_vec(rows), bytemuck::pod_collect_to_vec(sh))
        })
    }

    /// How much each place is to blame for how the scene differs from the photos.
    fn blame(&mut self, photos: &[usize]) -> Result<Vec<f32>> {
        let earlier = self.earlier()?;
        // Nothing moves.
        let rates = LearningRates::default().scaled(0.0);
        let step = TrainingStep { rates, ..TrainingStep::default() };
        for (place, &at) in photos.iter().enumerate() {
            self.take(PhotoStep { at, step, adds: place > 0, moves: false, blames: true })?;
        }
        let (count, k) = (u64::from(self.scene.count), self.scene.sh_count as usize);
        let by_colours = (&earlier, gradient_bytes(count, 0), self.sizes(self.used)[1]);
        self.read(&[by_colours], |bytes| {
            let by: Vec<[f32; 3]> = bytemuck::pod_collect_to_vec(bytes);
            by.par_chunks(k).with_min_len(1 << 12).map(|by| by[0].iter().sum()).collect()
        })
    }

    /// Number of a photo's camera.
    fn pose_of(&self, at: usize) -> Option<usize> {
        self.targets.get(at).map(|target| target.pose)
    }

    /// Where the gradients of a photo are while those of the next are taken.
    fn earlier(&mut self) -> Result<wgpu::Buffer> {
        if self.earlier.is_none() {
            let bytes = gradient_bytes(self.scene.count.into(), 3 * u64::from(self.scene.sh_count));
            self.earlier = Some(self.on.gpu.create_buffer("earlier gradients", bytes, STORAGE)?);
        }
        self.earlier.clone().ok_or_else(|| Error::internal("training: no earlier gradients"))
    }

    /// What the loss says of the last picture, which photo `at` has the size of; `[H * W]`.
    #[cfg(feature = "testing")]
    pub(super) fn by_picture(&mut self, at: usize) -> Result<Vec<[f32; 3]>> {
        self.settle()?;
        let target = self.targets.get(at).ok_or_else(|| absent(at))?;
        let lens = target.request.lens();
        let bytes = 12 * u64::from(lens.width) * u64::from(lens.height);
        let by = self.scratch.backward_room(&self.on.gpu, [0; 3])?.by_pictures;
        self.read(&[(&by, 0, bytes)], bytemuck::pod_collect_to_vec)
    }
}

impl Trainer for DeviceTrainer {
    fn step(&mut self, photos: &[usize], step: &TrainingStep) -> Result<()> {
        if photos.len() > 1 {
            self.earlier()?;
        }
        let step = *step;
        if let [at] = *photos {
            // Its camera must have moved by the step before.
            let same = |last: &Pending| self.pose_of(last.photo_step.at) == self.pose_of(at);
            if step.poses.moves() && self.pending.as_ref().is_some_and(same) {
                self.settle()?;
            }
            let next =
                self.submit(PhotoStep { at, step, adds: false, moves: true, blames: false })?;
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
            let (adds, moves) = (place > 0, place + 1 == photos.len());
            self.take(PhotoStep { at, step, adds, moves, blames: false })?;
        }
        Ok(())
    }

    fn grow(&mut self, photos: &[usize], until: usize) -> Result<usize> {
        self.settle()?;
        let (now, k) = (self.scene.clone(), self.scene.sh_count as usize);
        let (mut rows, mut sh) = self.read_places(&now.gaussians, &now.sh)?;
        let mut free: Vec<usize> = (0..rows.len()).filter(|&i| !is_there(&rows[i])).collect();
        let there = rows.len() - free.len();
        free.extend(rows.len()..now.count as usize);
        free.truncate(until.saturating_sub(there));
        if free.is_empty() {
            return Ok(there);
        }
        let parents = most_blamed(&self.blame(photos)?, free.len());
        let free = &free[..parents.len()];
        self.used = free.last().map_or(0, |last| last + 1).max(rows.len());
        rows.resize(self.used, GaussianRow::zeroed());
        sh.resize(self.used * k, [0.0; 3]);
        let counts = (&self.training.moments.clone(), 0, 4 * self.used as u64);
        let mut counts: Vec<f32> = self.read(&[counts], bytemuck::pod_collect_to_vec)?;
        for (&i, &to) in parents.iter().zip(free) {
            let [one, other] = halves(rows[i].mean, rows[i].quat, rows[i].scale);
            (rows[i].mean, rows[i].scale) = one;
            rows[to] = GaussianRow { mean: other.0, scale: other.1, ..rows[i] };
            sh.copy_within(i * k..(i + 1) * k, to * k);
            self.origins.source[to] = self.origins.source[i];
            self.origins.semantic_index[to] = self.origins.semantic_index[i];
            // New, says shaders/adam.wgsl.
            (counts[i], counts[to]) = (-1.0, -1.0);
        }
        let gpu = &self.on.gpu;
        gpu.scoped("training", || {
            gpu.queue.write_buffer(&now.gaussians, 0, bytemuck::cast_slice(&rows));
            gpu.queue.write_buffer(&now.sh, 0, bytemuck::cast_slice(&sh));
            gpu.queue.write_buffer(&self.training.moments, 0, bytemuck::cast_slice(&counts));
            gpu.queue.submit([]);
        })?;
        Ok(there + parents.len())
    }

    fn render(&mut self, request: &RenderRequest) -> Result<Frame> {
        self.settle()?;
        // How bright its colours have become is not known here.
        let request = &RenderRequest { error: 0.0, detail: 0.0, ..request.clone() };
        let mut drawing = Drawing::new(self.origin, request, &self.scene)?;
        let rows = drawing.whole();
        self.tools().rows(&mut drawing, rows)?;
        drawing.finish(&mut self.scratch)
    }

    fn gaussians(&mut self) -> Result<Gaussians> {
        self.settle()?;
        let now = self.scene.clone();
        let (rows, sh) = self.read_places(&now.gaussians, &now.sh)?;
        let k = now.sh_count as usize;
        let there: Vec<usize> = (0..rows.len()).filter(|&i| is_there(&rows[i])).collect();
        let origins = &self.origins;
        checked(RawGaussians {
            origin: self.origin,
            means: of_each(&there, |i| rows[i].mean),
            quats: of_each(&there, |i| rows[i].quat),
            scales: of_each(&there, |i| rows[i].scale),
            opacities: of_each(&there, |i| rows[i].opacity),
            sh_degree: self.sh_degree,
            sh: there.iter().flat_map(|i| &sh[i * k..(i + 1) * k]).copied().collect(),
            semantic_index: of_each(&there, |i| origins.semantic_index[i]),
            source: of_each(&there, |i| origins.source[i]),
        })
    }

    fn exposures(&mut self) -> Result<Vec<(Exposure, f64)>> {
        self.settle()?;
        let exposures = self.training.exposures.clone();
        let bytes = 4 * u64::from(EXPOSURE_WORDS) * self.targets.len() as u64;
        self.read(&[(&exposures, 0, bytes)], |bytes| {
            let rows: &[[f32; EXPOSURE_WORDS as usize]] = bytemuck::cast_slice(bytes);
            let read = |row: &[f32; EXPOSURE_WORDS as usize]| {
                let (gain, bias) = ([row[0], row[1], row[2]], [row[3], row[4], row[5]]);
                (Exposure::new(gain, bias), f64::from(row[19]))
            };
            rows.iter().map(read).collect()
        })
    }

    fn poses(&mut self) -> Result<Vec<CameraToWorld>> {
        self.settle()?;
        Ok(self.poses.iter().map(|pose| pose.now).collect())
    }
}

/// Rows and harmonics of places.
type Places = (Vec<GaussianRow>, Vec<[f32; 3]>);

/// Whether a place has a Gaussian.
fn is_there(row: &GaussianRow) -> bool {
    row.opacity >= Gaussians::OPACITY_MIN
}

fn of_each<T: Send>(places: &[usize], of: impl Fn(usize) -> T + Sync + Send) -> Vec<T> {
    places.par_iter().with_min_len(1 << 14).map(|&i| of(i)).collect()
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
        let DeviceStep { request, training, earlier, adds, moves, blames, poses, .. } = *step;
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
            stages.compare(tiles, !blames);
            stages.backward(Kinds::COLOR, tiles);
            if poses {
                stages.pose_gradient();
            }
            if adds && earlier.is_some() {
                stages.gaussians(Kernel::AddEarlier);
            }
            let copy = |from, to, bytes| BufferCopy { from: (from, 0), to, bytes };
            let plan = copy(&room.plans, (step.told, 0), PLAN_BYTES);
            let pose_bytes = if poses { POSE_BYTES } else { 0 };
            let pose = copy(&training.pose_sums, (step.told, PLAN_BYTES), pose_bytes);
            match earlier {
                Some(earlier) if !moves => {
                    let gradients = copy(&backward.gradients, (earlier, 0), gradient_bytes);
                    stages.submit(&[plan, pose, gradients])
                }
                _ => {
                    stages.gaussians(Kernel::Adam);
                    stages.submit(&[plan, pose])
                }
            }
        })??;
        self.scratch.backdrops = batch.held_after(held);
        Ok(())
    }
}
