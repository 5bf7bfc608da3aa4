//! Frame times of a renderer on a generated scene, with their error.
//!
//! The scene is what two photos give: a Gaussian a pixel on a wavy surface with steps, seen by two
//! cameras a fifth of the depth apart, drawn from between them. Its Gaussians have bank entries in
//! patches, as things do: `--labels` times labels beside colour.

pub(crate) mod aims;
pub(crate) mod backward;
pub(crate) mod detail;
pub(crate) mod frontier;
mod generated;
pub(crate) mod skips;

use std::{path::PathBuf, time::Instant};

use clap::ValueEnum;
use glam::DVec3;
use segsplat_testing::{labels::table, scenes};
use serde_json::{Value, json};

use self::generated::{dump, scene, with_degree};
use crate::{
    error::{Error, Result},
    render::{
        DeviceTimes, DispatchTime, Frame, Kinds, Labels, RenderRequest, Renderer, Samples,
        Switches,
        compare::{Compared, compare, compare_oracle},
        cpu::CpuRenderer,
    },
    rows::{Rows, each, median, ms},
    scene::{Camera, CameraToWorld, Gaussians},
    setup::Setup,
};

/// Most Gaussians of a generated scene.
const GAUSSIANS_MAX: usize = 32 << 20;
/// Most frames of the CPU renderer beside those of a GPU.
const CPU_FRAMES_MAX: usize = 20;

/// What to time.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// Gaussians, 2 and more; rounded down to two square photos
    #[arg(long)]
    gaussians: usize,
    /// Height of the picture in pixels; the field of view is that of a square of this side
    #[arg(long, default_value_t = 256)]
    size: u32,
    /// Width of the picture in pixels [default: its height]
    #[arg(long)]
    width: Option<u32>,
    /// Frames after the first
    #[arg(long, default_value_t = 50)]
    frames: usize,
    /// What the picture is compared with
    #[arg(long, default_value = "oracle")]
    compare: Reference,
    /// Labels to time beside colour
    #[arg(long)]
    labels: Option<LabelKind>,
    /// Entries of the bank that the scene has
    #[arg(long, default_value_t = 24)]
    bank: u16,
    /// Degree of the harmonics
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u8).range(0..=3))]
    degree: u8,
    /// Also times this many callers at once
    #[arg(long, default_value_t = 0)]
    callers: usize,
    /// Callers ask for levels of 8 bits, not for f32
    #[arg(long)]
    levels: bool,
    /// Folder whose files replace the built-in shaders
    #[arg(long)]
    shaders: Option<PathBuf>,
    /// Lets the shaders check every index and loop
    #[arg(long)]
    checked: bool,
    /// File to write the scene, the camera and the picture to (safetensors)
    #[arg(long)]
    dump: Option<PathBuf>,
    #[command(flatten)]
    setup: Setup,
}

/// What a picture is compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Reference {
    /// The CPU renderer's exact picture, every pixel
    Cpu,
    /// The f64 oracle, at 4,096 pixels
    Oracle,
}

/// Labels to time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum LabelKind {
    /// Four numbers a Gaussian, blended: what a text's mask needs
    Blend,
    /// The weight of every entry at every pixel, sparse
    #[value(alias = "entries")]
    Weights,
}

impl Args {
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
        let (gaussians, camera) = scene(self.gaussians, self.bank, [self.width(), self.size])?;
        let gaussians = match self.degree {
            0 => gaussians,
            degree => with_degree(gaussians, degree),
        };
        Ok((gaussians, scenes::request(camera)))
    }
}

/// A view of a scene by a renderer.
#[derive(Clone, Copy)]
struct Drawing<'a> {
    renderer: &'a dyn Renderer,
    gaussians: &'a Gaussians,
    request: &'a RenderRequest,
}

/// Makes a row of the frame times of the renderer that the arguments name. `first_ms` has the
/// upload and the warm-up, `device` the device's own times of colour, `cpu_ms` the CPU renderer's
/// frame where that is the reference.
///
/// # Errors
/// `invalid_request` when an argument is out of range, and those of the renderer.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    args.check()?;
    let (gaussians, request) = args.scene()?;
    let begun = Instant::now();
    let (renderer, adapters) = args.setup.renderer(args.switches())?;
    let open_ms = ms(begun);
    let drawing = Drawing { renderer: &*renderer, gaussians: &gaussians, request: &request };
    let begun = Instant::now();
    let frame = drawing.frame()?;
    let first_ms = ms(begun);
    if let Some(path) = &args.dump {
        dump(path, &gaussians, &request, &frame, &[])?;
    }
    let times = drawing.times(args.frames)?;
    let device = drawing.device_times(args.frames)?;
    let callers = match args.callers {
        0 => Value::Null,
        callers => drawing.call_together(callers, args)?,
    };
    let (labels, of_labels) = match args.labels {
        Some(labels) => drawing.label_times(args, labels)?,
        None => (Value::Null, None),
    };
    // After the times: a GPU that waits meanwhile lowers its clocks.
    let mut cpu_ms = None;
    let of_picture = match args.compare {
        Reference::Cpu => {
            let cpu = CpuRenderer::new(args.setup.threads())?;
            let of_cpu = Drawing { renderer: &cpu, ..drawing };
            let want = of_cpu.frame()?;
            cpu_ms = Some(median(of_cpu.times(args.frames.min(CPU_FRAMES_MAX))?));
            compare(&frame, &want, &gaussians, &request)?
        }
        Reference::Oracle => compare_oracle(&frame, &gaussians, &request)?,
    };
    let row = json!({
        "renderer": renderer.name(),
        "adapters": adapters,
        "gaussians": gaussians.len(),
        "width": args.width(),
        "height": args.size,
        "frames": args.frames,
        "open_ms": open_ms,
        "first_ms": first_ms,
        "min_ms": times.iter().copied().fold(f64::INFINITY, f64::min),
        "median_ms": median(times),
        "visible": frame.stats.visible,
        "intersections": frame.stats.intersections,
        "device": device,
        "cpu_ms": cpu_ms,
        "callers": callers,
        "labels": labels,
    });
    rows.push(json!({ "picture": of_picture, "labels": of_labels }), row)
}

impl Drawing<'_> {
    fn frame(&self) -> Result<Frame> {
        self.renderer.render(self.gaussians, self.request)
    }

    /// Times of `frames` frames, milliseconds.
    fn times(&self, frames: usize) -> Result<Vec<f64>> {
        let time = |_| {
            let begun = Instant::now();
            self.frame()?;
            Ok(ms(begun))
        };
        (0..frames).map(time).collect()
    }

    /// Medians of the device's own times over `frames` frames.
    fn device_times(&self, frames: usize) -> Result<Option<DeviceTimes>> {
        let all = (0..frames).map(|_| self.renderer.device_times(self.gaussians, self.request));
        let Some(runs) = all.collect::<Result<Option<Vec<DeviceTimes>>>>()? else {
            return Ok(None);
        };
        let stages = runs[0].stages.iter().enumerate().map(|(i, stage)| {
            let of_stage = runs.iter().filter_map(|run| run.stages.get(i)).map(|stage| stage.ms);
            DispatchTime { stage: stage.stage, ms: median(of_stage.collect()) }
        });
        let total_ms = median(runs.iter().map(|run| run.total_ms).collect());
        Ok(Some(DeviceTimes { total_ms, stages: stages.collect() }))
    }

    /// Views a second of one caller and of `callers` at once, each view from a place of its own.
    fn call_together(&self, callers: usize, args: &Args) -> Result<Value> {
        let (frames, samples) = match args.levels {
            true => (args.frames, Samples::Levels),
            false => (args.frames, Samples::F32),
        };
        let request = &RenderRequest { kinds: Kinds::COLOR, samples, ..self.request.clone() };
        let views = |caller: usize| -> Result<()> {
            for frame in 0..frames {
                let place = 1e-4 * (caller * frames + frame) as f64;
                let at = request.camera.camera_to_world.center() + DVec3::X * place;
                let camera_to_world =
                    CameraToWorld::look_at(at, at + DVec3::Z, DVec3::NEG_Y, "bench")?;
                let camera = Camera { camera_to_world, ..request.camera };
                let request = RenderRequest { camera, ..request.clone() };
                self.renderer.render(self.gaussians, &request)?;
            }
            Ok(())
        };
        let rate = |callers: usize| -> Result<f64> {
            let begun = Instant::now();
            each(callers, callers, views)?;
            Ok((callers * frames) as f64 / begun.elapsed().as_secs_f64())
        };
        // The first round makes room.
        rate(callers)?;
        let (one, all) = (rate(1)?, rate(callers)?);
        let levels = args.levels;
        let ratio = all / one;
        Ok(json!({
            "callers": callers, "levels": levels, "one_per_s": one, "all_per_s": all,
            "ratio": ratio,
        }))
    }

    /// What labels cost beside colour: medians of frames drawn in turn, so that a noisy machine is
    /// as noisy to each; the device's own times of labels alone, and of colour, depth and labels.
    /// Also how far the labels are from those of the CPU renderer.
    fn label_times(&self, args: &Args, kind: LabelKind) -> Result<(Value, Option<Compared>)> {
        let (name, labels) = match kind {
            LabelKind::Weights => ("weights", Labels::Weights),
            LabelKind::Blend => ("blend", Labels::Blend(table(usize::from(args.bank) + 1, 2))),
        };
        let with = |kinds, labels: &Labels| RenderRequest {
            kinds,
            labels: labels.clone(),
            ..self.request.clone()
        };
        let color_depth = Kinds { color: true, depth: true, alpha: false };
        let [color, alone, both, all] = [
            with(Kinds::COLOR, &Labels::None),
            with(Kinds::NONE, &labels),
            with(Kinds::COLOR, &labels),
            with(color_depth, &labels),
        ];
        let of = |request| Drawing { request, ..*self };
        let mut runs = [const { Vec::new() }; 3];
        // The first round warms up.
        for round in 0..=args.frames {
            for (request, runs) in [&color, &alone, &both].into_iter().zip(&mut runs) {
                let time = of(request).times(1)?;
                runs.extend(time.into_iter().filter(|_| round > 0));
            }
        }
        let [color_ms, labels_ms, both_ms] = runs.map(median);
        let frame = of(&alone).frame()?;
        let cpu = CpuRenderer::new(args.setup.threads())?;
        let want = cpu.render(self.gaussians, &alone)?;
        let times = json!({
            "labels": name,
            "bank": args.bank,
            "color_ms": color_ms,
            "labels_ms": labels_ms,
            "both_ms": both_ms,
            "ratio": labels_ms / color_ms,
            "device": of(&alone).device_times(args.frames)?,
            "device_all": of(&all).device_times(args.frames)?,
            "weights": frame.weights.as_ref().map_or(0, |weights| weights.weights.len()),
        });
        Ok((times, Some(compare(&frame, &want, self.gaussians, &alone)?)))
    }
}
