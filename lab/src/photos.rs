//! How good scenes are: views against photos that were held out.
//!
//! Every triple (two inputs and a target between them) goes through the product's own stages:
//! undistortion, capture analysis, the geometry network, lifting, the CPU renderer. Beside PSNR
//! and SSIM a row has the *hindsight warp*: the best PSNR that a warp of either input by one
//! constant depth can have, when the depth is chosen by the answer.

use std::{path::PathBuf, time::Instant};

use segsplat_core::names::named;
use serde_json::{Value, json};

use crate::{
    error::{Error, Result},
    grid,
    metrics::{clamped, psnr, ssim},
    pipeline::{
        Pipeline,
        refinement::{RefineCalls, refined, version_of},
    },
    refine::RefinedVersion,
    refinements::Variant,
    render::{Kinds, Renderer, cpu::CpuRenderer, plan::served, train::unit},
    rows::{Rows, each, means, ms, progress},
    scene::{PosedPhoto, Preset, Scene, SceneOptions},
    scenes::{
        SIDE, is_posed, make, make_for_refinement, make_keeping, means_by_use, scene_of, squares,
        use_of, view_request,
    },
    setup::Inputs,
    triples::{Triple, triples},
    warp::hindsight_warp,
};

/// What to compare.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    inputs: Inputs,
    /// Triples at work at the same time
    #[arg(long, default_value_t = 1)]
    at_once: usize,
    /// Most triples of a scene, spread evenly [default: all]
    #[arg(long)]
    most: Option<usize>,
    /// Side of the square photos, pixels: views are as large
    #[arg(long, default_value_t = SIDE)]
    side: u32,
    /// How scenes are made and drawn: default, or paper
    #[arg(long, value_parser = named::<Preset>, default_value = "default")]
    preset: Preset,
    /// A change of the method: `--method prune=true`; docs/method.md has all
    #[arg(long, value_name = "NAME=VALUE")]
    method: Vec<String>,
    /// A refinement of each scene, as NAME=VALUE,...: `ms=60000`; the row has both figures
    #[arg(long, value_name = "NAME=VALUE,...")]
    refine: Option<String>,
    /// Folder for picture grids, one a scene
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
}

/// Makes a row for each scene, and rows of means over scenes and over triples.
///
/// # Errors
/// `invalid_request` when there is no scene or an option is out of range, else whatever a stage of
/// the pipeline says, with scene and triple named.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    let photos = args.inputs.photos;
    if photos < 2 || args.at_once == 0 || args.most == Some(0) {
        return Err(Error::invalid("photos must be at least 2, at-once and most at least 1"));
    }
    let threads = args.inputs.setup.threads();
    let at_once = args.at_once.min(threads);
    let engine = Pipeline::open(&args.inputs.setup.networks(at_once))?;
    let renderer = CpuRenderer::new((threads / at_once).max(1))?;
    let options = SceneOptions { preset: args.preset, ..SceneOptions::default() };
    let options = options.with(&args.method)?;
    let refinement = args.refine.as_deref().map(str::parse::<Variant>).transpose()?;
    let method = (photos, &options, refinement.as_ref());
    let mut scenes = Vec::new();
    for (name, dir) in args.inputs.find(is_posed)? {
        let squares = squares(&dir, args.side)?;
        let all = triples(&squares);
        let count = args.most.map_or(all.len(), |most| most.min(all.len()));
        let chosen: Vec<Triple> = (0..count).map(|k| all[k * all.len() / count]).collect();
        let mut judged = each(chosen.len(), at_once, |i| {
            judge(&engine, &renderer, &squares, &chosen[i], method).map_err(|e| {
                let target = &squares[chosen[i].target].file;
                Error::new(e.code(), format!("{name}, target {target}: {e}")).caused_by(e)
            })
        })?;
        let mut row = means(judged.iter().map(|(row, _)| row));
        row["scene"] = json!(name);
        row["use"] = json!(use_of(&name));
        row["preset"] = json!(args.preset);
        row["photos"] = json!(photos);
        row["triples"] = json!(judged.len());
        row["each"] = judged.iter().map(|(row, _)| row.clone()).collect();
        progress(&format!("{name}: {:.2} dB", row["psnr"].as_f64().unwrap_or(f64::NAN)));
        push(rows, row.clone())?;
        scenes.extend((!judged.is_empty()).then_some(row));
        if let Some(out) = &args.pictures {
            let psnr = |(row, _): &(Value, grid::Row)| row["psnr"].as_f64().unwrap_or(f64::NAN);
            judged.sort_by(|a, b| psnr(a).total_cmp(&psnr(b)));
            grid::write(out, &name, &judged.iter().map(|(_, row)| row).collect::<Vec<_>>())?;
        }
    }
    for of_scenes in means_by_use(&scenes) {
        let of_use = || scenes.iter().filter(|scene| scene["use"] == of_scenes["use"]);
        let triples: Vec<&Value> =
            of_use().filter_map(|scene| scene["each"].as_array()).flatten().collect();
        let mut of_triples = means(triples.iter().copied());
        of_triples["scene"] = json!("**mean of triples**");
        of_triples["use"] = of_scenes["use"].clone();
        for mut row in [of_scenes, of_triples] {
            row["photos"] = json!(photos);
            row["triples"] = json!(triples.len());
            push(rows, row)?;
        }
    }
    Ok(())
}

fn push(rows: &mut Rows, row: Value) -> Result<()> {
    rows.push(json!({ "psnr_db": row["psnr"], "ssim": row["ssim"] }), row)
}

/// The figures of one triple, and its pictures: inputs, target, view and depth.
fn judge(
    engine: &Pipeline,
    renderer: &CpuRenderer,
    squares: &[PosedPhoto],
    triple: &Triple,
    (photos, options, refinement): (usize, &SceneOptions, Option<&Variant>),
) -> Result<(Value, grid::Row)> {
    let inputs = triple.inputs(squares, photos);
    let given: Vec<PosedPhoto> = inputs.iter().map(|&i| squares[i].clone()).collect();
    let begun = Instant::now();
    let scene = scene_of(make(engine, &given, options)?);
    let total_ms = ms(begun);
    let report = &scene.meta.report;
    let target = &squares[triple.target];
    let kinds = Kinds { color: true, depth: true, alpha: false };
    let view = |scene: &Scene| {
        let request = view_request(target.camera, kinds, report.median_depth);
        renderer.render(&scene.gaussians, &served(scene, request))
    };
    let (truth, valid) = (unit(&target.photo), target.photo.valid.as_deref());
    let frame = view(&scene)?;
    let color = clamped(frame.color);
    let pair = triple.pair.map(|i| &squares[i]);
    let geometry = report.stages.iter().filter(|stage| stage.stage == "geometry");
    let mut row = json!({
        "target": target.file,
        "psnr": psnr(&color, &truth, valid),
        "ssim": ssim(&color, &truth, target.photo.width as usize, valid),
        "warp_psnr": hindsight_warp(target, &pair, triple.baseline),
        "gaussians": report.gaussians,
        "geometry_ms": geometry.map(|stage| stage.ms).sum::<f64>(),
        "total_ms": total_ms,
    });
    if let Some(variant) = refinement {
        let seen = make_keeping(engine, &given, options)?.1;
        let mut remake =
            |held: &[usize]| Ok(variant.start(make_for_refinement(engine, &given, held, &seen)?));
        let mut best = None;
        let mut publish = |start: &Scene, version: &RefinedVersion| {
            best = Some(version_of(start, &scene, version)?);
            Ok(())
        };
        let (pace, recast) = (&mut |_| Ok(()), &mut || Ok(None));
        let more = &mut |_| Ok(None);
        let calls = RefineCalls { remake: &mut remake, recast, more, pace, publish: &mut publish };
        refined(renderer, &scene, &given, &variant.options(), calls)?;
        row["refined_psnr"] = row["psnr"].clone();
        if let Some(version) = &best {
            row["refined_psnr"] = json!(psnr(&clamped(view(version)?.color), &truth, valid));
        }
    }
    let mut pictures: grid::Row = given.iter().map(|posed| grid::photo(&posed.photo)).collect();
    pictures.push(grid::photo(&target.photo));
    pictures.push(grid::color(&color, target.photo.width));
    pictures.push(grid::depth(&frame.depth.unwrap_or_default(), target.photo.width));
    Ok((row, pictures))
}
