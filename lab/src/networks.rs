//! Time of each network on a provider beside the CPU in one process, and how far they differ.
//!
//! Both take turns, so that a busy machine is as busy for one as for the other. With `--other` the
//! geometry of another bundle takes its turn too.

use std::{path::PathBuf, sync::Arc, time::Instant};

use segsplat_core::names::named;
use serde_json::{Value, json};

use crate::{
    error::Result,
    models::{
        Bundle, Geometry, GeometryInput, ImageText, MaskNetwork, NetworkOptions, ProviderChoice,
        Runtime,
    },
    rows::{Rows, median, ms},
    sample::{self, SampleOptions},
    scene::{Crop, PosedPhoto},
    setup::Setup,
};

/// What to time.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// What is held to the CPU
    #[arg(long, default_value = "auto", value_parser = named::<ProviderChoice>)]
    provider: ProviderChoice,
    /// A bundle whose geometry is timed beside it, on the CPU
    #[arg(long, value_name = "DIR")]
    other: Option<PathBuf>,
    /// Numbers of photos that the geometry network gets
    #[arg(long, value_delimiter = ',', default_values_t = [2, 4, 8])]
    views: Vec<usize>,
    /// Runs after the first
    #[arg(long, default_value_t = 5)]
    runs: usize,
    #[command(flatten)]
    setup: Setup,
}

/// Makes a row for each network and number of views.
///
/// # Errors
/// `model_unavailable` where provider, library or a bundle is not there or differs from the CPU.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    let options = NetworkOptions { provider: args.provider, ..args.setup.networks(1) };
    let bundle = Bundle::find(&options)?;
    let runtime = Runtime::load(&options)?;
    // The same library, or none could be held to the other in one process.
    let on_cpu = NetworkOptions {
        provider: ProviderChoice::Cpu,
        ort_library: Some(runtime.path().to_owned()),
        ..options.clone()
    };
    let begun = Instant::now();
    let device = Geometry::open(&runtime, &bundle, &options)?;
    let open_ms = ms(begun);
    let cpu = Geometry::open(&runtime, &bundle, &on_cpu)?;
    let other = match &args.other {
        Some(dir) => Some(Geometry::open(&runtime, &Bundle::open(dir)?, &on_cpu)?),
        None => None,
    };
    let provider = device.provider().name();
    let mut push = |what: &str, timed: Timed| {
        let mut row = timed.row;
        row["network"] = json!(what);
        row["provider"] = json!(provider);
        row["threads"] = json!(options.threads);
        row["open_ms"] = json!(open_ms);
        rows.push(timed.error, row)
    };
    for &views in &args.views {
        let photos = SampleOptions { photos: views, width: 256, height: 256, ..Default::default() };
        let photos = sample::photos(&photos)?;
        let geometry = |network: &Geometry| geometry(network, &photos);
        let mut turns: Vec<TimedRun<'_>> =
            vec![Box::new(|| geometry(&cpu)), Box::new(|| geometry(&device))];
        turns.extend(other.iter().map(|other| Box::new(|| geometry(other)) as TimedRun<'_>));
        push(&format!("geometry, {views} views"), take(&turns, args.runs)?)?;
    }
    let open = |options| -> Result<_> {
        let masks = MaskNetwork::open(&runtime, &bundle, options)?;
        Ok(masks.zip(ImageText::open(&runtime, &bundle, options)?))
    };
    let (Some(device), Some(cpu)) = (open(&options)?, open(&on_cpu)?) else { return Ok(()) };
    let photo = sample::photos(&SampleOptions { photos: 2, ..Default::default() })?.remove(0).photo;
    let seen = Arc::new(cpu.0.encode(&photo)?);
    let encode = |network: &MaskNetwork| network.encode(&photo).map(|seen| seen.numbers());
    push("mask encoder", take_both([&cpu.0, &device.0], &encode, args.runs)?)?;
    let points: Vec<[f32; 2]> =
        (0..64).map(|i| [(i % 8) as f32 / 8.0 + 0.06, (i / 8) as f32 / 8.0 + 0.06]).collect();
    let decode = |network: &MaskNetwork| Ok(network.decode(&seen, &points)?.logits);
    push("mask decoder, 64 points", take_both([&cpu.0, &device.0], &decode, args.runs)?)?;
    let crop = |i: usize| Crop {
        width: 128,
        height: 128,
        rgb: photo.rgb.iter().cycle().skip(i * 3 * 997).take(128 * 128 * 3).copied().collect(),
    };
    let crops: Vec<Crop> = (0..40).map(crop).collect();
    let embed = |towers: &ImageText| towers.embed_images(&crops);
    push("image tower, 40 crops", take_both([&cpu.1, &device.1], &embed, args.runs)?)?;
    let texts = ["a red mug on the table".to_owned()];
    let read = |towers: &ImageText| {
        Ok(towers.embed_texts(&texts)?.into_iter().flat_map(|text| text.row).collect())
    };
    push("text tower", take_both([&cpu.1, &device.1], &read, args.runs)?)
}

/// Means, scales, colours and opacities of all views.
fn geometry(network: &Geometry, photos: &[PosedPhoto]) -> Result<Vec<f32>> {
    let views: Vec<usize> = (0..photos.len()).collect();
    let each = (photos.len() - 1).min(network.manifest().neighbors_max);
    let neighbors: Vec<Vec<usize>> =
        views.iter().map(|v| (1..=each).map(|n| (v + n) % photos.len()).collect()).collect();
    let input = GeometryInput {
        photos,
        views: &views,
        near_far: &vec![[1.5, 8.0]; photos.len()],
        median_depth: 3.0,
        neighbors: &neighbors,
    };
    let found = network.run(&input)?;
    let numbers = found.iter().flat_map(|view| {
        let rows = view.means.iter().chain(&view.scales).chain(&view.sh).flatten();
        rows.chain(&view.opacities).copied()
    });
    Ok(numbers.collect())
}

/// One of those that are timed beside each other.
type TimedRun<'a> = Box<dyn Fn() -> Result<Vec<f32>> + 'a>;

struct Timed {
    row: Value,
    error: Value,
}

/// Runs what the CPU and the provider both have.
fn take_both<T>(both: [&T; 2], run: &dyn Fn(&T) -> Result<Vec<f32>>, runs: usize) -> Result<Timed> {
    take(&both.map(|network| Box::new(move || run(network)) as TimedRun<'_>), runs)
}

/// Runs all in turns. The first is the CPU, the second the provider, the third the other bundle.
fn take(turns: &[TimedRun<'_>], runs: usize) -> Result<Timed> {
    let mut firsts = Vec::new();
    let mut answers = Vec::new();
    for turn in turns {
        let begun = Instant::now();
        answers.push(turn()?);
        firsts.push(ms(begun));
    }
    let mut times = vec![Vec::new(); turns.len()];
    for _ in 0..runs {
        for (turn, times) in turns.iter().zip(&mut times) {
            let begun = Instant::now();
            turn()?;
            times.push(ms(begun));
        }
    }
    let medians: Vec<f64> = times.into_iter().map(median).collect();
    let differs = |found: &[f32]| {
        let wanted = &answers[0];
        let pairs = || found.iter().zip(wanted).map(|(a, b)| f64::from(*a) - f64::from(*b));
        let (off, all) = (
            pairs().map(|v| v * v).sum::<f64>(),
            wanted.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>(),
        );
        let largest =
            |values: &mut dyn Iterator<Item = f64>| values.fold(0.0, |m: f64, v| m.max(v.abs()));
        let most = largest(&mut pairs()) / largest(&mut wanted.iter().map(|v| f64::from(*v)));
        json!({ "rms": (off / all).sqrt(), "largest": most })
    };
    let mut row = json!({
        "cpu_first_ms": firsts[0],
        "cpu_ms": medians[0],
        "first_ms": firsts[1],
        "ms": medians[1],
    });
    if let Some(other) = medians.get(2) {
        row["other_ms"] = json!(other);
        row["other_differs"] = differs(&answers[2]);
    }
    Ok(Timed { row, error: differs(&answers[1]) })
}
