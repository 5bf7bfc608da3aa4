//! Frame times of a renderer on a generated scene, with their error.
//!
//! The scene is what two photos give: a Gaussian a pixel on a wavy surface with steps, seen by two
//! cameras a fifth of the depth apart, drawn from between them. Its Gaussians have bank entries in
//! patches, as things do: `--labels` times labels beside colour.

mod generated;
pub mod skips;

use std::{path::PathBuf, time::Instant};

use clap::ValueEnum;
use glam::DVec3;
use serde::Serialize;
use serde_json::json;

pub use self::generated::scene;
use self::generated::{Random, dump};
use crate::{
    error::{Error, Result},
    render::{
        DeviceTimes, DispatchTime, Kinds, Labels, Quality, RenderRequest, Renderer, Switches,
        compare::{Compared, compare, compare_oracle},
        cpu::CpuRenderer,
        select::AdapterReport,
    },
    rows::{Rows, median, ms},
    scene::{Camera, CameraToWorld, Gaussians},
    setup::Setup,
};

/// Most Gaussians of a generated scene.
pub const GAUSSIANS_MAX: usize = 16 << 20;
/// Most frames of the CPU renderer beside those of a GPU.
const CPU_FRAMES_MAX: usize = 20;

/// What to time.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Gaussians, 2 and more; rounded down to two square photos
    #[arg(long)]
    pub gaussians: usize,
    /// Height of the picture in pixels; the field of view is that of a square of this side
    #[arg(long, default_value_t = 256)]
    pub size: u32,
    /// Width of the picture in pixels [default: its height]
    #[arg(long)]
    pub width: Option<u32>,
    /// Frames after the first
    #[arg(long, default_value_t = 50)]
    pub frames: usize,
    /// How closely to keep to the model: exact or fast
    #[arg(long, default_value = "exact", value_parser = segsplat_core::names::named::<Quality>)]
    pub quality: Quality,
    /// What the picture is compared with
    #[arg(long, default_value = "oracle")]
    pub compare: Reference,
    /// Labels to time beside colour
    #[arg(long)]
    pub labels: Option<LabelKind>,
    /// Entries of the bank that the scene has
    #[arg(long, default_value_t = 24)]
    pub bank: u16,
    /// Also times this many callers at once
    #[arg(long, default_value_t = 0)]
    pub callers: usize,
    /// Folder whose files replace the built-in shaders
    #[arg(long)]
    pub shaders: Option<PathBuf>,
    /// Lets the shaders check every index and loop
    #[arg(long)]
    pub checked: bool,
    /// File to write the scene, the camera and the picture to (safetensors)
    #[arg(long)]
    pub dump: Option<PathBuf>,
    /// What draws
    #[command(flatten)]
    pub setup: Setup,
}

/// What a picture is compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Reference {
    /// The CPU renderer's exact picture, every pixel
    Cpu,
    /// The f64 oracle, at 4,096 pixels
    Oracle,
}

/// Labels to time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum LabelKind {
    /// Four numbers a Gaussian, blended: what a text's mask needs
    Blend,
    /// The weight of every entry at every pixel, sparse
    Entries,
}

/// What was measured.
#[derive(Clone, Debug, Serialize)]
struct Measured {
    renderer: String,
    quality: Quality,
    adapters: Vec<AdapterReport>,
    gaussians: usize,
    width: u32,
    height: u32,
    frames: usize,
    /// Opening the renderer: adapter, device, kernels, threads.
    open_ms: f64,
    /// First frame: upload, room, warm-up.
    first_ms: f64,
    /// The frames after it, call by call.
    median_ms: f64,
    min_ms: f64,
    visible: u64,
    intersections: u64,
    /// The device's own times of colour, medians; `None` on the CPU.
    device: Option<DeviceTimes>,
    /// Median frame of the CPU renderer, where it is the reference.
    cpu_ms: Option<f64>,
    callers: Option<Callers>,
    labels: Option<LabelTimes>,
}

/// Views a second that callers of one scene get.
#[derive(Clone, Copy, Debug, Serialize)]
struct Callers {
    callers: usize,
    one_per_s: f64,
    all_per_s: f64,
    ratio: f64,
}

/// What labels cost beside colour: medians of frames drawn in turn.
#[derive(Clone, Debug, Serialize)]
struct LabelTimes {
    labels: LabelKind,
    bank: u16,
    color_ms: f64,
    labels_ms: f64,
    both_ms: f64,
    /// `labels_ms / color_ms`.
    ratio: f64,
    /// The device's own times, medians: labels alone; colour, depth and labels.
    device: Option<DeviceTimes>,
    device_all: Option<DeviceTimes>,
    /// Entries of the view; 0 for a blend.
    entries: usize,
    #[serde(skip)]
    compared: Compared,
}

impl Args {
    /// A small run for tests and defaults.
    #[must_use]
    pub fn small(gaussians: usize, size: u32) -> Self {
        Self {
            gaussians,
            size,
            width: None,
            frames: 1,
            quality: Quality::Exact,
            compare: Reference::Oracle,
            labels: None,
            bank: 24,
            callers: 0,
            shaders: None,
            checked: false,
            dump: None,
            setup: Setup::default(),
        }
    }

    fn width(&self) -> u32 {
        self.width.unwrap_or(self.size)
    }

    fn check(&self) -> Result<()> {
        let counts = (2..=GAUSSIANS_MAX).contains(&self.gaussians);
        if counts && self.size.min(self.width()) > 0 && self.frames > 0 {
            return Ok(());
        }
        let most = GAUSSIANS_MAX;
        Err(Error::invalid(format!("2 to {most} Gaussians, and at least 1 pixel and 1 frame")))
    }

    fn switches(&self) -> Switches {
        Switches { shaders: self.shaders.clone(), checked: self.checked, ..Switches::default() }
    }

    /// The generated scene, and the view of it with every picture.
    fn scene(&self) -> Result<(Gaussians, RenderRequest)> {
        let (gaussians, camera) = scene(self)?;
        let request = RenderRequest {
            background: [0.1, 0.2, 0.3],
            quality: self.quality,
            ..RenderRequest::plain(camera, Kinds::ALL, 0.05)
        };
        Ok((gaussians, request))
    }
}

/// Makes a row of the frame times of the renderer that the arguments name.
///
/// # Errors
/// `invalid_request` when an argument is out of range, and those of the renderer.
pub fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    args.check()?;
    let (gaussians, request) = args.scene()?;
    let begun = Instant::now();
    let (renderer, adapters) = args.setup.renderer(args.switches())?;
    let renderer = &*renderer;
    let open_ms = ms(begun);
    let begun = Instant::now();
    let frame = renderer.render(&gaussians, &request)?;
    let first_ms = ms(begun);
    if let Some(path) = &args.dump {
        dump(path, &gaussians, &request, &frame)?;
    }
    let times = times(renderer, &gaussians, &request, args.frames)?;
    let device = device_times(renderer, &gaussians, &request, args.frames)?;
    let callers = match args.callers {
        0 => None,
        callers => Some(call_together(renderer, &gaussians, &request, callers, args.frames)?),
    };
    let labels = match args.labels {
        Some(labels) => Some(label_times(renderer, &gaussians, &request, args, labels)?),
        None => None,
    };
    // After the times: a GPU that waits meanwhile lowers its clocks.
    let mut cpu_ms = None;
    let compared = match args.compare {
        Reference::Cpu => {
            let cpu = CpuRenderer::new(args.setup.threads())?;
            let exact = RenderRequest { quality: Quality::Exact, ..request.clone() };
            let want = cpu.render(&gaussians, &exact)?;
            let frames = args.frames.min(CPU_FRAMES_MAX);
            cpu_ms = Some(median(self::times(&cpu, &gaussians, &exact, frames)?));
            compare(&frame, &want, &gaussians, &request)?
        }
        Reference::Oracle => compare_oracle(&frame, &gaussians, &request)?,
    };
    let error = json!({ "picture": compared, "labels": labels.as_ref().map(|l| l.compared) });
    let measured = Measured {
        renderer: renderer.name(),
        quality: args.quality,
        adapters,
        gaussians: gaussians.len(),
        width: args.width(),
        height: args.size,
        frames: args.frames,
        open_ms,
        first_ms,
        min_ms: times.iter().copied().fold(f64::INFINITY, f64::min),
        median_ms: median(times),
        visible: frame.stats.visible,
        intersections: frame.stats.intersections,
        device,
        cpu_ms,
        callers,
        labels,
    };
    rows.push(error, &measured)
}

/// Times of `frames` frames, milliseconds.
fn times(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    frames: usize,
) -> Result<Vec<f64>> {
    let time = |_| {
        let begun = Instant::now();
        renderer.render(gaussians, request)?;
        Ok(ms(begun))
    };
    (0..frames).map(time).collect()
}

/// Medians of the device's own times over `frames` frames.
fn device_times(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    frames: usize,
) -> Result<Option<DeviceTimes>> {
    let all = (0..frames).map(|_| renderer.device_times(gaussians, request));
    let Some(runs) = all.collect::<Result<Option<Vec<DeviceTimes>>>>()? else { return Ok(None) };
    let stages = runs[0].stages.iter().enumerate().map(|(i, stage)| {
        let of_stage = runs.iter().filter_map(|run| run.stages.get(i)).map(|stage| stage.ms);
        DispatchTime { stage: stage.stage, ms: median(of_stage.collect()) }
    });
    let total_ms = median(runs.iter().map(|run| run.total_ms).collect());
    Ok(Some(DeviceTimes { total_ms, stages: stages.collect() }))
}

/// Views a second of one caller and of `callers` at once, each view from a place of its own.
fn call_together(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    callers: usize,
    frames: usize,
) -> Result<Callers> {
    let request = &RenderRequest { kinds: Kinds::COLOR, ..request.clone() };
    let views = |caller: usize| -> Result<()> {
        for frame in 0..frames {
            let place = 1e-4 * (caller * frames + frame) as f64;
            let at = request.camera.camera_to_world.center() + DVec3::X * place;
            let camera_to_world = CameraToWorld::look_at(at, at + DVec3::Z, DVec3::NEG_Y, "bench")?;
            let camera = Camera { camera_to_world, ..request.camera };
            renderer.render(gaussians, &RenderRequest { camera, ..request.clone() })?;
        }
        Ok(())
    };
    let rate = |callers: usize| -> Result<f64> {
        let begun = Instant::now();
        std::thread::scope(|scope| {
            let threads: Vec<_> =
                (0..callers).map(|caller| scope.spawn(move || views(caller))).collect();
            threads.into_iter().try_for_each(|thread| {
                thread.join().map_err(|_| Error::internal("a caller panicked"))?
            })
        })?;
        Ok((callers * frames) as f64 / begun.elapsed().as_secs_f64())
    };
    // The first round makes room.
    rate(callers)?;
    let (one_per_s, all_per_s) = (rate(1)?, rate(callers)?);
    Ok(Callers { callers, one_per_s, all_per_s, ratio: all_per_s / one_per_s })
}

/// Draws colour, labels and both in turn, so that a noisy machine is as noisy to each.
fn label_times(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    args: &Args,
    labels: LabelKind,
) -> Result<LabelTimes> {
    let mut random = Random(2);
    let mut row = |m| [(); 4].map(|()| if m == 0 { 0.0 } else { random.range(-1.0, 1.0) });
    let wanted = match labels {
        LabelKind::Entries => Labels::Weights,
        LabelKind::Blend => Labels::Blend((0..=args.bank).map(&mut row).collect()),
    };
    let with = |kinds, labels| RenderRequest { kinds, labels, ..request.clone() };
    let alone = with(Kinds::NONE, wanted.clone());
    let all = with(Kinds { color: true, depth: true, alpha: false }, wanted.clone());
    let requests = [with(Kinds::COLOR, Labels::None), alone.clone(), with(Kinds::COLOR, wanted)];
    let mut runs = [const { Vec::new() }; 3];
    // The first round warms up.
    for round in 0..=args.frames {
        for (request, runs) in requests.iter().zip(&mut runs) {
            let time = times(renderer, gaussians, request, 1)?;
            runs.extend(time.into_iter().filter(|_| round > 0));
        }
    }
    let [color_ms, labels_ms, both_ms] = runs.map(median);
    let frame = renderer.render(gaussians, &alone)?;
    let exact = RenderRequest { quality: Quality::Exact, ..alone.clone() };
    let want = CpuRenderer::new(args.setup.threads())?.render(gaussians, &exact)?;
    Ok(LabelTimes {
        labels,
        bank: args.bank,
        color_ms,
        labels_ms,
        both_ms,
        ratio: labels_ms / color_ms,
        device: device_times(renderer, gaussians, &alone, args.frames)?,
        device_all: device_times(renderer, gaussians, &all, args.frames)?,
        entries: frame.weights.as_ref().map_or(0, |weights| weights.entries.len()),
        compared: compare(&frame, &want, gaussians, &alone)?,
    })
}
