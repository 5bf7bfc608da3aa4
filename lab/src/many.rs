//! Many photos: how good a scene of N photos is at photos that no one saw, and what refinement
//! makes of it.
//!
//! Every sixth photo from the fourth is a target. N of the others, spread evenly, are given. Views
//! are whole photos of one set of Gaussians over the backdrop, without layers.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use serde_json::json;

use crate::{
    error::{Error, Result},
    limits::Limits,
    metrics::{clamped, psnr, to_unit},
    photo_files,
    pipeline::{Pipeline, refinement::at_side},
    refine::{RefineBudget, RefineOptions, held_out, refine, split},
    render::{
        Background, Frame, Kinds, RenderRequest, Switches,
        plan::{default_near, served},
    },
    rows::{Rows, ms, progress},
    scene::{Camera, Gaussians, PosedPhoto, SceneOptions},
    scenes::{is_posed, make, scene_of, use_of, view_request},
    setup::Inputs,
};

/// Every so many photos one is a target, from this one on.
const TARGET_EVERY: usize = 6;
const TARGET_FIRST: usize = 3;

/// What to measure.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    inputs: Inputs,
    /// Options of the scenes, each as NAME=VALUE: `max_views=8`, `front_photos=0`
    #[arg(long, value_name = "NAME=VALUE", value_delimiter = ',')]
    method: Vec<String>,
    /// Refine in so many steps
    #[arg(long, conflicts_with = "refine_ms")]
    refine_steps: Option<u32>,
    /// Refine for so many milliseconds
    #[arg(long)]
    refine_ms: Option<u64>,
    /// Longer side of the photos that refinement sees, pixels: what is learnt smaller than it is
    /// shown has gaps
    #[arg(long)]
    refine_side: Option<u32>,
    /// Most Gaussians that refinement begins with
    #[arg(long)]
    gaussians_max: Option<usize>,
    /// Factor on all learning rates
    #[arg(long, default_value_t = 1.0)]
    rate: f32,
}

/// Makes a row for each scene: PSNR at the targets before and after refinement.
///
/// # Errors
/// `invalid_request` when there is no scene or too few photos, else whatever a stage says.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    let engine = Pipeline::open(&args.inputs.setup.networks(1))?;
    let (renderer, _adapters) = args.inputs.setup.renderer(Switches::default())?;
    let options = SceneOptions::default().with(&args.method)?;
    for (name, dir) in args.inputs.find(is_posed)? {
        let all = photo_files::read_dir(&dir, &Limits::default())?;
        let (targets, given) = given(&all, args.inputs.photos);
        if given.len() < 2 || targets.is_empty() {
            return Err(Error::invalid(format!("{name}: {} photos are too few", all.len())));
        }
        let refines = args.refine_steps.is_some() || args.refine_ms.is_some();
        let (learnt, out) =
            if refines { split(given.clone()) } else { (given.clone(), Vec::new()) };
        let begun = Instant::now();
        let scene = scene_of(make(&engine, &learnt, &options)?);
        let create_ms = ms(begun);
        let judge = |gaussians: &Gaussians| {
            let near = default_near(scene.meta.report.median_depth);
            let background = Background::Backdrop(Arc::clone(&scene.backdrop));
            mean_psnr(&targets, |camera| {
                let plain = RenderRequest::plain(camera, Kinds::COLOR, near);
                renderer
                    .render(gaussians, &RenderRequest { background: background.clone(), ..plain })
            })
        };
        let before = judge(&scene.gaussians)?;
        let as_served = mean_psnr(&targets, |camera| {
            let median_depth = scene.meta.report.median_depth;
            let plain = view_request(camera, Kinds::COLOR, median_depth);
            renderer.render(&scene.gaussians, &served(&scene, plain))
        })?;
        let mut row = json!({
            "scene": name,
            "use": use_of(&name),
            "photos": given.len(),
            "gaussians": scene.gaussians.len(),
            "create_ms": create_ms,
            "psnr": before,
            "served_psnr": as_served,
            "peak_mib": peak_mib(),
        });
        if refines {
            let budget = match (args.refine_steps, args.refine_ms) {
                (Some(steps), _) => RefineBudget::steps(steps),
                (_, ms) => {
                    let time = Duration::from_millis(ms.unwrap_or_default());
                    RefineBudget { steps: u32::MAX, time }
                }
            };
            let plain = RefineOptions::default();
            let rates = plain.rates.scaled(args.rate);
            let gaussians_max = args.gaussians_max.unwrap_or(plain.gaussians_max);
            let side = args.refine_side.unwrap_or(plain.side);
            let options = RefineOptions { budget, rates, gaussians_max, side, ..plain };
            let sized = |photos: &[PosedPhoto]| -> Vec<PosedPhoto> {
                photos.iter().map(|photo| at_side(photo, side)).collect()
            };
            let photos = (&sized(&learnt)[..], &sized(&out)[..]);
            let (begun, cpu) = (Instant::now(), cpu_seconds());
            let mut steps = 0;
            let publish = &mut |version: &crate::refine::RefinedVersion| {
                steps = version.report.steps;
                Ok(())
            };
            let best = refine(&*renderer, &scene, photos, &options, &mut |_| Ok(()), publish)?;
            row["refine_ms"] = json!(ms(begun));
            row["refine_cpu_s"] = json!(cpu_seconds() - cpu);
            row["steps"] = json!(steps);
            row["held_out"] = json!(held_out(given.len()));
            row["own_psnr_before"] = json!(best.report.psnr_before);
            row["own_psnr_after"] = json!(best.report.psnr_after);
            row["refined_gaussians"] = json!(best.gaussians.len());
            row["refined_psnr"] = json!(judge(&best.gaussians)?);
        }
        progress(&format!("{name}: {row}"));
        let error = row.get("refined_psnr").unwrap_or(&row["psnr"]).clone();
        rows.push(json!({ "psnr_db": error }), row)?;
    }
    Ok(())
}

/// The targets, and `count` of the other photos, spread evenly.
fn given(all: &[PosedPhoto], count: usize) -> (Vec<PosedPhoto>, Vec<PosedPhoto>) {
    let is_target = |i: &usize| i % TARGET_EVERY == TARGET_FIRST;
    let (targets, rest): (Vec<usize>, Vec<usize>) = (0..all.len()).partition(is_target);
    let count = count.min(rest.len());
    let spread = |k: usize| if count < 2 { 0 } else { k * (rest.len() - 1) / (count - 1) };
    let pick = |i: &usize| all[*i].clone();
    let given = (0..count).map(|k| pick(&rest[spread(k)])).collect();
    (targets.iter().map(pick).collect(), given)
}

/// Mean PSNR of what `draw` gives at the targets' cameras.
fn mean_psnr(targets: &[PosedPhoto], draw: impl Fn(Camera) -> Result<Frame>) -> Result<f64> {
    let mut sum = 0.0;
    for target in targets {
        let frame = draw(target.camera)?;
        let truth = to_unit(&target.photo);
        sum += psnr(&clamped(frame.color), &truth, target.photo.valid.as_deref());
    }
    Ok(sum / targets.len() as f64)
}

/// Most memory that this process had, MiB; NaN where the system does not tell.
fn peak_mib() -> f64 {
    let status = fs_err::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kib = peak.and_then(|text| text.split_whitespace().next()?.parse::<f64>().ok());
    kib.map_or(f64::NAN, |kib| kib / 1024.0)
}

/// Seconds of processor time of this process, NaN where the system does not tell.
fn cpu_seconds() -> f64 {
    let stat = fs_err::read_to_string("/proc/self/stat").unwrap_or_default();
    let after_name = stat.rsplit(')').next().unwrap_or_default();
    // Fields 14 and 15 of proc(5): user and system time in hundredths of a second.
    let ticks = |field: usize| -> Option<f64> {
        after_name.split_whitespace().nth(field - 3)?.parse().ok()
    };
    ticks(14).zip(ticks(15)).map_or(f64::NAN, |(user, system)| (user + system) / 100.0)
}
