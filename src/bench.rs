//! Frame times of a renderer on a generated scene, with the error beside them: `segsplat bench`
//! with `--gaussians`.
//!
//! The scene is what two photos give: a Gaussian a pixel on a wavy surface with steps, seen by two
//! cameras a fifth of the depth apart, drawn from between them. Its Gaussians carry bank indices in
//! patches, as things are: `--labels` times labels beside colour.

mod compared;
mod generated;
mod skips;

use std::{path::PathBuf, time::Instant};

use glam::DVec3;
use serde::Serialize;

pub use self::{
    compared::{Compared, DIFFERENCE_MAX, ORACLE_PIXELS},
    generated::scene,
    skips::SkipTimes,
};
use self::{
    compared::{compare, compare_oracle},
    generated::{Random, dump},
};
use crate::{
    config::Config,
    error::{Error, Result},
    render::{
        DeviceTimes, DispatchTime, Kinds, Labels, Quality, RenderRequest, Renderer,
        cpu::CpuRenderer,
        gpu::GpuOptions,
        select::{AdapterReport, select_with},
    },
    scene::{Camera, CameraToWorld, Gaussians},
};

/// Most Gaussians that a bench makes.
pub const GAUSSIANS_MAX: usize = 16 << 20;

/// What to time.
#[derive(Clone, Debug, Default)]
pub struct BenchArgs {
    /// Gaussians, 2 and more; rounded down to two square photos.
    pub gaussians: usize,
    /// Height of the picture, pixels; the field of view is that of a square one of this side.
    pub size: u32,
    /// Width of the picture, pixels.
    pub width: u32,
    /// Callers that draw views of their own at once, beside one alone; 0 times none.
    pub callers: usize,
    /// Folder whose files stand in for the GPU renderer's shaders.
    pub shaders: Option<PathBuf>,
    /// Whether the GPU renderer's shaders check themselves.
    pub checked: bool,
    /// File to write scene, camera and the renderer's picture to, for other renderers.
    pub dump: Option<PathBuf>,
    /// Frames after the first.
    pub frames: usize,
    /// How closely to keep to the model.
    pub quality: Quality,
    /// What to compare the picture with.
    pub compare: Option<Reference>,
    /// Labels to time beside colour.
    pub labels: Option<BenchLabels>,
    /// Rows of the bank (M): indices that occur in the scene.
    pub bank: u16,
    /// Whether to time frames without each of [`crate::render::skip::Skip::ALL`] as well.
    pub skips: bool,
}

/// What a picture is compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reference {
    /// The exact pictures of the CPU renderer, every pixel.
    Cpu,
    /// The f64 oracle, at [`ORACLE_PIXELS`] places.
    Oracle,
}

/// Labels that a bench times.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum BenchLabels {
    /// Four numbers of a table's row, blended.
    Blend,
    /// The sparse weights of every index.
    Entries,
}

/// What was measured.
#[derive(Clone, Debug, Serialize)]
pub struct BenchReport {
    /// Name of the renderer.
    pub renderer: String,
    /// Adapters found, the one used marked.
    pub adapters: Vec<AdapterReport>,
    /// Gaussians of the scene.
    pub gaussians: usize,
    /// Side of the picture, pixels.
    pub size: u32,
    /// Width of the picture, pixels.
    pub width: u32,
    /// Frames timed.
    pub frames: usize,
    /// Opening the renderer: adapter, device, kernels, threads.
    pub open_ms: f64,
    /// First frame: upload, room, warm-up.
    pub first_ms: f64,
    /// Median of the frames after it.
    pub median_ms: f64,
    /// Fastest of the frames after it.
    pub min_ms: f64,
    /// Gaussians that touch the picture.
    pub visible: u64,
    /// Gaussian-tile pairs.
    pub intersections: u64,
    /// The device's own times of colour, medians; `None` on the CPU.
    pub device: Option<DeviceTimes>,
    /// Views a second by callers, where they were asked for.
    pub callers: Option<CallerTimes>,
    /// Difference to the reference, where one was asked for.
    pub compared: Option<Compared>,
    /// Times of labels, where they were asked for.
    pub labels: Option<LabelTimes>,
    /// What each skip saves, where it was asked for.
    pub skips: Vec<SkipTimes>,
}

/// What many callers of one scene get.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct CallerTimes {
    /// Callers at once.
    pub callers: usize,
    /// Views a second of one caller.
    pub one_per_s: f64,
    /// Views a second of all of them.
    pub all_per_s: f64,
}

/// What labels cost beside colour: medians of frames drawn in turn.
#[derive(Clone, Debug, Serialize)]
pub struct LabelTimes {
    /// Labels timed.
    pub labels: BenchLabels,
    /// Rows of the bank.
    pub bank: u16,
    /// Colour alone.
    pub color_ms: f64,
    /// Labels alone.
    pub labels_ms: f64,
    /// Colour and labels in one pass.
    pub both_ms: f64,
    /// `labels_ms / color_ms`.
    pub ratio: f64,
    /// The device's own times of labels alone, medians.
    pub device: Option<DeviceTimes>,
    /// The same of colour, depth and labels together.
    pub device_all: Option<DeviceTimes>,
    /// Entries of the view; 0 for a blend.
    pub entries: usize,
    /// Difference to the labels of the CPU renderer, where it was asked for.
    pub compared: Option<Compared>,
}

/// Renders the scene of `args` with the renderer that `config` asks for.
///
/// # Errors
/// `invalid_request` when `args` are out of range, and those of [`select_with`] and of the
/// renderer.
pub fn run(args: &BenchArgs, config: &Config) -> Result<BenchReport> {
    if !(2..=GAUSSIANS_MAX).contains(&args.gaussians)
        || args.size.min(args.width) == 0
        || args.frames == 0
    {
        return Err(Error::invalid(format!(
            "bench: {} Gaussians at {} px, {} frames; there must be 2 to {GAUSSIANS_MAX}, 1 and 1",
            args.gaussians, args.size, args.frames
        )));
    }
    let (gaussians, camera) = scene(args)?;
    let kinds = if args.compare.is_some() { Kinds::ALL } else { Kinds::COLOR };
    let request = RenderRequest {
        background: [0.1, 0.2, 0.3],
        quality: args.quality,
        ..RenderRequest::plain(camera, kinds, 0.05)
    };
    let begun = Instant::now();
    let options = GpuOptions {
        shaders: args.shaders.clone(),
        checked: args.checked,
        ..GpuOptions::default()
    };
    let (renderer, adapters) = select_with(&config.renderer(), options)?;
    let open_ms = ms(begun);
    let begun = Instant::now();
    let frame = renderer.render(&gaussians, &request)?;
    let first_ms = ms(begun);
    if let Some(path) = &args.dump {
        dump(path, &gaussians, &request, &frame)?;
    }
    let times = times(&*renderer, &gaussians, &request, args.frames)?;
    let device = device_times(&*renderer, &gaussians, &request, args.frames)?;
    let callers = match args.callers {
        0 => None,
        callers => Some(caller_times(&*renderer, &gaussians, &request, callers, args.frames)?),
    };
    let labels = match args.labels {
        Some(labels) => Some(label_times(&*renderer, &gaussians, &request, args, labels, config)?),
        None => None,
    };
    // After the times: a GPU that waits meanwhile lowers its clocks.
    let compared = match args.compare {
        Some(Reference::Cpu) => {
            let cpu = CpuRenderer::new(config.threads)?;
            let exact = RenderRequest { quality: Quality::Exact, ..request.clone() };
            let want = cpu.render(&gaussians, &exact)?;
            let mut compared = compare(&frame, &want, &gaussians, &request)?;
            let times = self::times(&cpu, &gaussians, &exact, args.frames.min(20))?;
            compared.cpu_median_ms = times[times.len() / 2];
            Some(compared)
        }
        Some(Reference::Oracle) => Some(compare_oracle(&frame, &gaussians, &request)?),
        None => None,
    };
    Ok(BenchReport {
        renderer: renderer.name(),
        adapters,
        gaussians: gaussians.len(),
        size: args.size,
        width: args.width,
        frames: args.frames,
        open_ms,
        first_ms,
        median_ms: times[times.len() / 2],
        min_ms: times[0],
        visible: frame.stats.visible,
        intersections: frame.stats.intersections,
        device,
        callers,
        compared,
        labels,
        skips: if args.skips { skips::run(&gaussians, &request, args, config)? } else { vec![] },
    })
}

fn ms(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

/// Sorted times of `frames` frames, milliseconds.
fn times(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    frames: usize,
) -> Result<Vec<f64>> {
    let mut times = Vec::with_capacity(frames);
    for _ in 0..frames {
        let begun = Instant::now();
        renderer.render(gaussians, request)?;
        times.push(ms(begun));
    }
    times.sort_by(f64::total_cmp);
    Ok(times)
}

/// Medians of the device's own times over `frames` frames.
fn device_times(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    frames: usize,
) -> Result<Option<DeviceTimes>> {
    let mut runs = Vec::with_capacity(frames);
    for _ in 0..frames {
        match renderer.device_times(gaussians, request)? {
            Some(times) => runs.push(times),
            None => return Ok(None),
        }
    }
    let middle = |mut times: Vec<f64>| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    };
    let stages = runs[0].stages.iter().enumerate().map(|(i, stage)| {
        let of_stage = runs.iter().filter_map(|run| run.stages.get(i)).map(|stage| stage.ms);
        DispatchTime { stage: stage.stage, ms: middle(of_stage.collect()) }
    });
    let total_ms = middle(runs.iter().map(|run| run.total_ms).collect());
    Ok(Some(DeviceTimes { total_ms, stages: stages.collect() }))
}

/// Views a second of one caller and of `callers` at once, each view from a place of its own.
fn caller_times(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    callers: usize,
    frames: usize,
) -> Result<CallerTimes> {
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
                thread.join().map_err(|_| Error::internal("a caller of the bench panicked"))?
            })
        })?;
        Ok((callers * frames) as f64 / begun.elapsed().as_secs_f64())
    };
    // The first round makes room.
    rate(callers)?;
    let (one_per_s, all_per_s) = (rate(1)?, rate(callers)?);
    Ok(CallerTimes { callers, one_per_s, all_per_s })
}

/// Draws colour, labels and both in turn, so that a noisy machine is as noisy to each.
fn label_times(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    args: &BenchArgs,
    labels: BenchLabels,
    config: &Config,
) -> Result<LabelTimes> {
    let mut random = Random(2);
    let wanted = match labels {
        BenchLabels::Entries => Labels::Weights,
        BenchLabels::Blend => Labels::Blend(
            (0..=args.bank)
                .map(|m| [(); 4].map(|()| if m == 0 { 0.0 } else { random.range(-1.0, 1.0) }))
                .collect(),
        ),
    };
    let with = |kinds, labels| RenderRequest { kinds, labels, ..request.clone() };
    let alone = with(Kinds::NONE, wanted.clone());
    let all = with(Kinds { color: true, depth: true, alpha: false }, wanted.clone());
    let requests = [with(Kinds::COLOR, Labels::None), alone.clone(), with(Kinds::COLOR, wanted)];
    let mut runs = [const { Vec::new() }; 3];
    // The first round warms up.
    for round in 0..=args.frames {
        for (request, times) in requests.iter().zip(&mut runs) {
            let begun = Instant::now();
            renderer.render(gaussians, request)?;
            if round > 0 {
                times.push(ms(begun));
            }
        }
    }
    let [color_ms, labels_ms, both_ms] = runs.map(|mut times| {
        times.sort_by(f64::total_cmp);
        times[times.len() / 2]
    });
    let device = device_times(renderer, gaussians, &alone, args.frames)?;
    let device_all = device_times(renderer, gaussians, &all, args.frames)?;
    let frame = renderer.render(gaussians, &alone)?;
    let compared = match args.compare {
        Some(Reference::Cpu) => {
            let exact = RenderRequest { quality: Quality::Exact, ..alone.clone() };
            let want = CpuRenderer::new(config.threads)?.render(gaussians, &exact)?;
            Some(compare(&frame, &want, gaussians, &alone)?)
        }
        _ => None,
    };
    Ok(LabelTimes {
        labels,
        bank: args.bank,
        color_ms,
        labels_ms,
        both_ms,
        ratio: labels_ms / color_ms,
        device,
        device_all,
        entries: frame.weights.map_or(0, |weights| weights.entries.len()),
        compared,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::RendererChoice;

    #[test]
    fn a_wrong_pixel_is_a_fault_and_nan_is_far() {
        let args = BenchArgs {
            gaussians: 800,
            size: 24,
            width: 24,
            callers: 2,
            shaders: None,
            dump: None,
            checked: false,
            skips: false,
            frames: 1,
            quality: Quality::Exact,
            compare: Some(Reference::Cpu),
            labels: Some(BenchLabels::Entries),
            bank: 24,
        };
        let config = Config { renderer: RendererChoice::Cpu, threads: 1, ..Config::default() };
        let report = run(&args, &config).expect("a bench of the CPU against itself");
        let compared = report.compared.expect("a comparison");
        assert_eq!((compared.max, compared.flips, compared.faults), (0.0, 0, 0), "itself");
        assert!(report.visible > 0, "the scene is seen");
        let labels = report.labels.expect("labels were timed");
        let compared = labels.compared.expect("labels were compared");
        assert_eq!((compared.max, compared.flips, compared.faults), (0.0, 0, 0), "itself");
        assert!(labels.entries > 24, "{} entries", labels.entries);

        let report = run(&BenchArgs { compare: Some(Reference::Oracle), ..args.clone() }, &config);
        let compared = report.expect("a bench").compared.expect("a comparison");
        assert_eq!((compared.pixels, compared.flips, compared.faults), (4096, 0, 0), "the oracle");
        assert!(compared.worst > 0.0 && compared.worst < 2e-5, "{compared:?}");
        assert!(compared.psnr_db.is_some_and(|db| db > 100.0), "{compared:?}");

        let (gaussians, camera) = scene(&args).expect("a scene");
        let request = RenderRequest::plain(camera, Kinds::ALL, 0.05);
        let want = CpuRenderer::new(1)
            .and_then(|cpu| cpu.render(&gaussians, &request))
            .expect("a picture");
        for wrong in [0.5, f32::NAN] {
            let mut got = want.clone();
            got.color.as_mut().expect("colour")[100][1] += wrong;
            let found = compare(&got, &want, &gaussians, &request).expect("a comparison");
            assert_eq!(found.flips + found.faults, 1, "{wrong}: {found:?}");
        }
        for labels in [Labels::Weights, Labels::Blend([[1.0; 4]; 25].into())] {
            let request = RenderRequest { labels, kinds: Kinds::NONE, ..request.clone() };
            let want = CpuRenderer::new(1).and_then(|cpu| cpu.render(&gaussians, &request));
            let want = want.expect("labels");
            let mut got = want.clone();
            if let Some(blend) = &mut got.blend {
                blend[7][3] += 0.5;
            }
            if let Some(weights) = &mut got.weights {
                weights.entries[0] += 1;
            }
            let found = compare(&got, &want, &gaussians, &request).expect("a comparison");
            assert_eq!(found.flips + found.faults, 1, "a wrong label: {found:?}");
        }
    }
}
