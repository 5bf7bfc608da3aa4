//! Time of each stage from photos to a view, on generated photos.

use std::{collections::BTreeMap, time::Instant};

use serde_json::json;

use crate::{
    error::{Error, Result},
    limits::Limits,
    metrics::{clamped, psnr, to_unit},
    photo_files,
    pipeline::Pipeline,
    render::{Kinds, Switches},
    rows::{Rows, median, ms},
    sample::{self, SampleOptions},
    scene::SceneOptions,
    scenes::{make, view_request},
    setup::Setup,
};

/// What to time.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    /// Photos, 2 to 64
    #[arg(long, default_value_t = 2)]
    photos: usize,
    /// Side of the square photos and views in pixels
    #[arg(long, default_value_t = 256)]
    side: u32,
    /// Runs; the first one warms up and is a row of its own
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(2..=1000))]
    runs: u32,
    #[command(flatten)]
    setup: Setup,
}

/// Makes a row of the medians; its error is the PSNR of the first photo's view to that photo.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    let side = args.side;
    let options =
        SampleOptions { photos: args.photos, width: side, height: side, ..Default::default() };
    let upload = sample::upload(&options)?;
    let begun = Instant::now();
    let engine = Pipeline::open(&args.setup.networks(1))?;
    let open_ms = ms(begun);
    let (renderer, _adapters) = args.setup.renderer(Switches::default())?;
    let mut times: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    let (mut gaussians, mut error) = (0, 0.0);
    for _ in 0..args.runs {
        let begun = Instant::now();
        let photos = photo_files::read(&upload, &Limits::default())?;
        let read_ms = ms(begun);
        let scene = make(&engine, &photos, &SceneOptions::default())?;
        let mut all = vec![("scene".to_owned(), ms(begun)), ("read".to_owned(), read_ms)];
        all.extend(scene.report.stages.iter().map(|s| (s.stage.clone(), s.ms)));
        let first = photos.first().ok_or_else(|| Error::internal("there is no photo"))?;
        let request = view_request(first.camera, Kinds::COLOR, scene.report.median_depth);
        for name in ["first view", "view"] {
            let begun = Instant::now();
            let frame = renderer.render(&scene.gaussians, &request)?;
            all.push((name.to_owned(), ms(begun)));
            error = psnr(&clamped(frame.color), &to_unit(&first.photo), None);
        }
        all.into_iter().for_each(|(name, ms)| times.entry(name).or_default().push(ms));
        gaussians = scene.gaussians.len();
    }
    let of_first: BTreeMap<_, _> = times.iter().map(|(name, runs)| (name, runs[0])).collect();
    let medians: BTreeMap<_, _> =
        times.iter().map(|(name, runs)| (name, median(runs[1..].to_vec()))).collect();
    let row = json!({
        "photos": args.photos,
        "side": side,
        "gaussians": gaussians,
        "threads": args.setup.threads(),
        "execution_provider": engine.geometry().provider().name(),
        "renderer": renderer.name(),
        "open_ms": open_ms,
        "first_ms": of_first,
        "median_ms": medians,
    });
    rows.push(json!({ "psnr_db": error }), row)
}
