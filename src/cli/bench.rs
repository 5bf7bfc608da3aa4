//! `segsplat bench`: times of the stages and of a frame on generated photos, median of some runs;
//! with `--gaussians`, of the renderer alone.

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    path::PathBuf,
    sync::{Arc, atomic::AtomicBool},
    time::Instant,
};

use serde_json::json;

use super::{engine, output::Output};
use crate::{
    bench::{
        self, BenchArgs, BenchLabels, CallerTimes, Compared, LabelTimes, Reference, SkipTimes,
    },
    config::{Config, ConfigArgs},
    error::{Error, Result},
    jobs::{PipelineMaker, SceneMaker, Work},
    pipeline::Engine,
    render::{DeviceTimes, Kinds, Quality, RenderRequest},
    sample::{self, SampleOptions},
    scene::SceneOptions,
    service::default_near,
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    /// Photos, 2 to 64
    #[arg(long, default_value_t = 2)]
    photos: usize,
    /// Side of the square photos and views in pixels
    #[arg(long, default_value_t = 256)]
    side: u32,
    /// Runs; the first one warms up and is told apart
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(2..=1000))]
    runs: u32,
    /// Times the renderer alone, on a generated scene of this many Gaussians
    #[arg(long)]
    gaussians: Option<usize>,
    /// With --gaussians: side of the square view in pixels, its height with --width
    #[arg(long, default_value_t = 256)]
    size: u32,
    /// With --gaussians: width of the view in pixels [default: its height]
    #[arg(long)]
    width: Option<u32>,
    /// With --gaussians: also times this many callers at once
    #[arg(long, default_value_t = 0)]
    callers: usize,
    /// With --gaussians: folder whose files stand in for the shaders
    #[arg(long, hide = true)]
    shaders: Option<PathBuf>,
    /// With --gaussians: has the shaders check every index and loop
    #[arg(long, hide = true)]
    checked: bool,
    /// With --gaussians: file to write the scene, the camera and the picture to (safetensors)
    #[arg(long)]
    dump: Option<PathBuf>,
    /// With --gaussians: frames after the first
    #[arg(long, default_value_t = 50)]
    frames: usize,
    /// With --gaussians: exact, or fast within a stated error
    #[arg(long, value_parser = super::camera::quality, default_value = "exact")]
    quality: Quality,
    /// With --gaussians: compares the picture with another of it
    #[arg(long)]
    compare: Option<ReferenceArg>,
    /// With --gaussians: times these labels beside colour
    #[arg(long)]
    labels: Option<LabelArg>,
    /// With --labels: entries of the semantic bank that the scene has
    #[arg(long, default_value_t = 24)]
    bank: u16,
    /// With --gaussians: what each thing that is left out saves, and that no pixel changes
    #[arg(long)]
    skips: bool,
    #[command(flatten)]
    pub(super) config: ConfigArgs,
}

/// What a picture is compared with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum ReferenceArg {
    /// The CPU renderer's exact pictures
    Cpu,
    /// The f64 oracle, at some thousand pixels
    Oracle,
}

/// Labels to time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum LabelArg {
    /// Four numbers a pixel: what a text's mask takes
    Blend,
    /// The sparse weights of all entries
    Entries,
}

pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    match args.gaussians {
        Some(gaussians) => frames(args, gaussians, config, out),
        None => stages(args, config, out),
    }
}

/// The renderer alone.
fn frames(args: &Args, gaussians: usize, config: &Config, out: &Output) -> Result<()> {
    let (size, frames) = (args.size, args.frames);
    let labels = args.labels.map(|labels| match labels {
        LabelArg::Blend => BenchLabels::Blend,
        LabelArg::Entries => BenchLabels::Entries,
    });
    let compare = args.compare.map(|reference| match reference {
        ReferenceArg::Cpu => Reference::Cpu,
        ReferenceArg::Oracle => Reference::Oracle,
    });
    let width = args.width.unwrap_or(size);
    let wanted = BenchArgs {
        gaussians,
        size,
        width,
        callers: args.callers,
        shaders: args.shaders.clone(),
        dump: args.dump.clone(),
        checked: args.checked,
        frames,
        quality: args.quality,
        compare,
        labels,
        bank: args.bank,
        skips: args.skips,
    };
    let report = bench::run(&wanted, config)?;
    let mut text = String::new();
    for adapter in &report.adapters {
        let mark = if adapter.chosen { "*" } else { " " };
        let (name, backend, driver) = (&adapter.name, &adapter.backend, &adapter.driver);
        let _ = writeln!(text, "{mark} {name} ({}, {backend}, {driver})", adapter.kind);
    }
    let _ = writeln!(
        text,
        "{} Gaussians at {width}x{size} px on {}: open {:.1} ms, first frame {:.2} ms, \
         median {:.3} ms, fastest {:.3} ms ({} visible, {} tile pairs)",
        report.gaussians,
        report.renderer,
        report.open_ms,
        report.first_ms,
        report.median_ms,
        report.min_ms,
        report.visible,
        report.intersections
    );
    if let Some(times) = &report.device {
        device(&mut text, "colour", times);
    }
    if let Some(CallerTimes { callers, one_per_s, all_per_s }) = &report.callers {
        let _ = writeln!(
            text,
            "one caller {one_per_s:.0} views/s, {callers} callers {all_per_s:.0} views/s ({:.2}x)",
            all_per_s / one_per_s
        );
    }
    if let Some(found) = &report.compared {
        let _ = writeln!(
            text,
            "against the reference (CPU {:.2} ms): max {:.2e}, mean {:.2e}, {} of {} px flipped at \
             a cliff, {} faults; of all {:.2e}, {:.1} dB",
            found.cpu_median_ms,
            found.max,
            found.mean,
            found.flips,
            found.pixels,
            found.faults,
            found.worst,
            found.psnr_db.unwrap_or(f64::INFINITY)
        );
        fault(&mut text, found);
    }
    if let Some(times) = &report.labels {
        let LabelTimes { labels, bank, color_ms, labels_ms, both_ms, ratio, entries, .. } = times;
        let _ = writeln!(
            text,
            "{labels:?} of a bank of {bank}: colour alone {color_ms:.3} ms, labels alone \
             {labels_ms:.3} ms ({ratio:.2}x), both {both_ms:.3} ms, {entries} entries"
        );
        for (name, times) in
            [("labels alone", &times.device), ("colour, depth and labels", &times.device_all)]
        {
            if let Some(times) = times {
                device(&mut text, name, times);
            }
        }
        if let Some(found) = &times.compared {
            let _ = writeln!(
                text,
                "  against the CPU renderer: max {:.2e}, mean {:.2e}, {} of {} px flipped at a \
                 cliff, {} faults",
                found.max, found.mean, found.flips, found.pixels, found.faults
            );
            fault(&mut text, found);
        }
    }
    for times in &report.skips {
        let SkipTimes { skip, scene, clock, with_ms, without_ms, apart, max } = times;
        let _ = writeln!(
            text,
            "{:<13} {scene:<7} {with_ms:.3} ms, without it {without_ms:.3} ms ({:.2}x, {clock}); \
             {apart} px apart, at most {max:.1e}",
            skip.name(),
            without_ms / with_ms
        );
    }
    out.answer(&text, &report)
}

fn fault(text: &mut String, found: &Compared) {
    if let Some((x, y, apart)) = found.fault {
        let _ = writeln!(text, "  the worst fault: column {x}, row {y}, {apart:.2e} off");
    }
}

fn device(text: &mut String, name: &str, times: &DeviceTimes) {
    let _ = write!(text, "{name} on the device: {:.3} ms;", times.total_ms);
    for stage in &times.stages {
        let _ = write!(text, " {} {:.3}", stage.stage, stage.ms);
    }
    text.push('\n');
}

fn stages(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let side = args.side;
    let options =
        SampleOptions { photos: args.photos, width: side, height: side, ..Default::default() };
    let upload = sample::upload(&options)?;
    let begun = Instant::now();
    let engine = Engine::open(&config.networks())?;
    let open_ms = ms(begun);
    let provider = engine.geometry().provider().name();
    let renderer = engine::renderer(config)?;
    let maker = PipelineMaker::new(Arc::new(engine.into()), config.limits.clone());
    let mut times: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    let mut gaussians = 0;
    for i in 0..args.runs {
        out.progress("bench", i as f32 / args.runs as f32);
        let begun = Instant::now();
        let made = maker.make(Work {
            upload: &upload,
            options: &SceneOptions::default(),
            progress: &|_, _| {},
            cancel: &AtomicBool::new(false),
        })?;
        let mut all: Vec<(String, f64)> = vec![("scene".to_owned(), ms(begun))];
        all.extend(made.report.stages.iter().map(|s| (format!("scene: {}", s.stage), s.ms)));
        let camera =
            made.cameras.first().ok_or_else(|| Error::internal("a scene has no camera"))?;
        let near = default_near(made.report.median_depth);
        let request = RenderRequest::plain(camera.camera, Kinds::COLOR, near);
        let begun = Instant::now();
        renderer.render(&made.gaussians, &request)?;
        all.push(("view: first".to_owned(), ms(begun)));
        let begun = Instant::now();
        renderer.render(&made.gaussians, &request)?;
        all.push(("view: again".to_owned(), ms(begun)));
        for (name, time) in all {
            times.entry(name).or_default().push(time);
        }
        gaussians = made.gaussians.len();
    }
    out.progress("done", 1.0);
    let rows: BTreeMap<&str, _> = times
        .iter()
        .map(|(name, runs)| {
            let mut warm = runs[1..].to_vec();
            warm.sort_by(f64::total_cmp);
            (name.as_str(), json!({ "first_ms": runs[0], "median_ms": warm[warm.len() / 2] }))
        })
        .collect();
    let mut text = format!(
        "{} photos of {side}x{side} px, {gaussians} Gaussians, {} threads, network on {provider}, \
         renderer {}\n  opening {open_ms:.0} ms\n  {:<20}{:>10}{:>10}\n",
        args.photos,
        config.threads,
        renderer.name(),
        "",
        "first ms",
        "median ms"
    );
    for (name, row) in &rows {
        let value = |key: &str| row[key].as_f64().unwrap_or_default();
        let (first, median) = (value("first_ms"), value("median_ms"));
        let _ = writeln!(text, "  {name:<20}{first:>10.1}{median:>10.1}");
    }
    let value = json!({
        "photos": args.photos,
        "side": side,
        "gaussians": gaussians,
        "threads": config.threads,
        "execution_provider": provider,
        "renderer": renderer.name(),
        "open_ms": open_ms,
        "times": rows,
    });
    out.answer(&text, &value)
}

fn ms(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}
