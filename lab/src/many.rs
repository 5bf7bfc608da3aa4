//! Many photos: how good a scene of N photos is at photos that no one saw, and what refinement
//! makes of it.
//!
//! Every sixth photo from the fourth is a target. N of the others, spread evenly, are given. Views
//! are whole photos of one set of Gaussians over the backdrop, without layers.

use std::{cell::RefCell, path::PathBuf, sync::Arc, time::Instant};

use glam::DVec3;
use segsplat_testing::scenes::Random;
use serde_json::{Value, json};

use crate::{
    error::{Error, Result},
    grid,
    limits::Limits,
    metrics::{clamped, psnr, ssim},
    photo_files,
    pipeline::{
        Pipeline, growth, ignored,
        refinement::{RefineCalls, refined},
    },
    refine::{ALIGNING_STEPS, RefinedVersion, aligned, held_out},
    refinements::Variant,
    render::{
        Background, Frame, Kinds, RenderRequest, Renderer, Switches,
        plan::{default_near, served},
        train::{pose::moved, unit},
    },
    rows::{Rows, ms, progress},
    scene::{Camera, CameraToWorld, Gaussians, PosedPhoto, Scene, SceneOptions, floaters},
    scenes::{
        SILENT, is_posed, make_for_refinement, make_keeping, make_more, recast, scene_of, spread,
        use_of, view_request,
    },
    setup::Inputs,
    words::paste::{self, Pasted},
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
    /// A refinement to measure, as NAME=VALUE,...: `ms=5000,rate=2`; each is a row of its own
    #[arg(long, value_name = "NAME=VALUE,...")]
    refine: Vec<String>,
    /// Also with the cameras of the given photos turned by so many degrees and moved by a share of
    /// the median depth
    #[arg(long, num_args = 2, value_names = ["DEGREES", "SHARE"])]
    disturb: Option<Vec<f64>>,
    /// So many of the given photos join the scene of all others: how good it is before and after
    #[arg(long, conflicts_with_all = ["refine", "disturb"])]
    join: Option<usize>,
    /// What is left of the scene without its floaters, and of the scene with so many more of them:
    /// a share of its Gaussians
    #[arg(long, value_name = "SHARE", conflicts_with_all = ["refine", "disturb", "join"])]
    floaters: Option<f64>,
    /// Also with cut-outs of this tar (`images/`, `masks/`) pasted into every third given photo
    #[arg(long, value_name = "TAR")]
    paste: Option<PathBuf>,
    /// What these words name is left out of the given photos
    #[arg(long, value_name = "WORD")]
    ignore: Vec<String>,
    /// Not without what is disturbed or pasted
    #[arg(long)]
    only_changed: bool,
    /// Folder whose files replace the built-in shaders
    #[arg(long)]
    shaders: Option<PathBuf>,
    /// Folder for pictures of the first target: the photo, and the scene before and after
    #[arg(long)]
    pictures: Option<PathBuf>,
}

/// Makes a row for each scene and refinement: PSNR at the targets before and after it.
///
/// # Errors
/// `invalid_request` when there is no scene or too few photos, else whatever a stage says.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    let variants = args.refine.iter().map(|text| Ok((text, text.parse::<Variant>()?)));
    let variants: Vec<(&String, Variant)> = variants.collect::<Result<_>>()?;
    let engine = Pipeline::open(&args.inputs.setup.networks(1))?;
    let switches = Switches { shaders: args.shaders.clone(), ..Switches::default() };
    let (renderer, _adapters) = args.inputs.setup.renderer(switches)?;
    let scene_options = SceneOptions::default().with(&args.method)?;
    for (name, dir) in args.inputs.find(is_posed)? {
        let all = photo_files::read_dir(&dir, &Limits::default())?;
        let (targets, right) = given(&all, args.inputs.photos);
        if right.len() < 2 || targets.is_empty() {
            return Err(Error::invalid(format!("{name}: {} photos are too few", all.len())));
        }
        if let Some(count) = args.join {
            let row = joining(&engine, &*renderer, &right, count, &scene_options, &targets)?;
            let row = json!({ "scene": name, "use": use_of(&name), "joined": row });
            progress(&row.to_string());
            rows.push(json!({ "psnr_db": row["joined"]["psnr"] }), row)?;
            continue;
        }
        if let Some(share) = args.floaters {
            let row = cleaned(&engine, &*renderer, &right, share, &scene_options, &targets)?;
            let row = json!({ "scene": name, "use": use_of(&name), "cleaned": row });
            progress(&row.to_string());
            rows.push(json!({ "psnr_db": row["cleaned"]["psnr"] }), row)?;
            continue;
        }
        let wrong = args.disturb.as_deref().map(|at| [at[0], at[1]]);
        let mut median_depth = 1.0;
        let kinds = [None].into_iter().chain(wrong.map(Some)).map(|wrong| (wrong, None));
        let kinds = kinds.chain(args.paste.as_ref().map(|tar| (None, Some(tar))));
        let is_changed = |(wrong, tar): &(Option<[f64; 2]>, Option<&PathBuf>)| {
            !args.only_changed || wrong.is_some() || tar.is_some()
        };
        for (wrong, tar) in kinds.filter(is_changed) {
            let pasted: Vec<Pasted> = match tar {
                None => right.iter().map(|posed| (posed.clone(), None)).collect(),
                Some(tar) => paste::pasted(&right, tar)?,
            };
            let (mut given, pasted): (Vec<PosedPhoto>, Vec<_>) = pasted.into_iter().unzip();
            if let Some([degrees, share]) = wrong {
                given = disturbed(&right, degrees, share * median_depth);
            }
            let searched = Instant::now();
            if !args.ignore.is_empty() {
                ignored::leave_out_words(
                    &engine,
                    &mut given,
                    &args.ignore,
                    &scene_options.method(),
                    SILENT,
                )?;
            }
            let ignored = left_out(&given, &pasted);
            let ignore_ms = ms(searched);
            let begun = Instant::now();
            let (made, seen) = make_keeping(&engine, &given, &scene_options)?;
            let scene = scene_of(made);
            let create_ms = ms(begun);
            median_depth = scene.meta.report.median_depth;
            let (_, first) = make_for_refinement(&engine, &given, &[], &seen)?;
            let one_set = |gaussians: &Gaussians, camera| {
                let near = default_near(scene.meta.report.median_depth);
                let background = Background::Backdrop(Arc::clone(&scene.backdrop));
                let plain = RenderRequest::plain(camera, Kinds::COLOR, near);
                renderer.render(gaussians, &RenderRequest { background, ..plain })
            };
            let judge =
                |gaussians: &Gaussians| mean_psnr(&targets, |camera| one_set(gaussians, camera));
            let similarity =
                |gaussians: &Gaussians| mean_ssim(&targets, |camera| one_set(gaussians, camera));
            let as_served = |camera| {
                let plain = view_request(camera, Kinds::COLOR, scene.meta.report.median_depth);
                renderer.render(&scene.gaussians, &served(&scene, plain))
            };
            let picture = |what: &str, frame: Frame| match &args.pictures {
                Some(dir) => {
                    let file = dir.join(format!("{name}-{}-{what}.png", given.len()));
                    let size = targets[0].camera.intrinsics;
                    let saved = grid::color(&clamped(frame.color), size.width).save(file);
                    saved.map_err(|e| Error::internal(format!("a picture: {e}")))
                }
                None => Ok(()),
            };
            let camera = targets[0].camera;
            let photo = Frame { color: Some(unit(&targets[0].photo)), ..Frame::default() };
            picture("photo", photo)?;
            picture("served", as_served(camera)?)?;
            let plain = json!({
                "scene": name,
                "use": use_of(&name),
                "photos": given.len(),
                "method": args.method,
                "gaussians": scene.gaussians.len(),
                "create_ms": create_ms,
                "psnr": judge(&scene.gaussians)?,
                "first_psnr": judge(&first)?,
                "served_psnr": mean_psnr(&targets, as_served)?,
                "disturb": wrong,
                "paste": tar.is_some(),
                "ignore": args.ignore,
                "ignored": ignored,
                "ignore_ms": ignore_ms,
                "peak_mib": peak_mib(),
            });
            if variants.is_empty() {
                progress(&format!("{name}: {plain}"));
                rows.push(json!({ "psnr_db": plain["psnr"] }), plain.clone())?;
            }
            for (text, variant) in &variants {
                let mut row = plain.clone();
                // With the cameras that the photos have now.
                let made_of = RefCell::new((given.clone(), seen.clone()));
                let mut remake = |held: &[usize]| {
                    let (photos, seen) = &*made_of.borrow();
                    Ok(variant.start(make_for_refinement(&engine, photos, held, seen)?))
                };
                let mut recast = || {
                    let Some((found, seen)) = recast(&engine, &given, &scene_options)? else {
                        return Ok(None);
                    };
                    let poses = poses_of(&found);
                    *made_of.borrow_mut() = (found, seen);
                    Ok(Some(poses))
                };
                let mut paces = 0_u32;
                let mut pace = |_: f32| {
                    paces += 1;
                    Ok(())
                };
                let (begun, cpu) = (Instant::now(), cpu_seconds());
                // When each version came, and the version.
                let mut versions: Vec<(f64, RefinedVersion)> = Vec::new();
                let mut publish = |_: &Scene, version: &RefinedVersion| {
                    versions.push((ms(begun), version.clone()));
                    Ok(())
                };
                let (options, renderer) = (variant.options(), &*renderer);
                // Where the cameras of all photos have moved together, so must those of targets.
                let fitted = |gaussians: &Gaussians| -> Result<Value> {
                    let no_wait = &mut || Ok(());
                    let poses = aligned(
                        renderer,
                        &scene,
                        gaussians,
                        &targets,
                        &options,
                        ALIGNING_STEPS,
                        no_wait,
                    )?;
                    let stand = |(target, pose): (&PosedPhoto, CameraToWorld)| {
                        let camera = Camera { camera_to_world: pose, ..target.camera };
                        PosedPhoto { camera, ..target.clone() }
                    };
                    let targets: Vec<PosedPhoto> = targets.iter().zip(poses).map(stand).collect();
                    Ok(json!([
                        mean_psnr(&targets, |camera| one_set(gaussians, camera))?,
                        mean_ssim(&targets, |camera| one_set(gaussians, camera))?,
                    ]))
                };
                let calls = RefineCalls {
                    remake: &mut remake,
                    recast: &mut recast,
                    more: &mut |_| Ok(None),
                    pace: &mut pace,
                    publish: &mut publish,
                };
                let found = refined(renderer, &scene, &given, &options, calls)?;
                let refine_ms = ms(begun);
                row["refine"] = json!(text);
                row["asked_s"] = json!(variant.asked_s());
                row["refine_ms"] = json!(refine_ms);
                row["step_ms"] = json!(refine_ms / f64::from(paces.max(1)));
                row["steps_made"] = json!(paces);
                row["refine_cpu_s"] = json!(cpu_seconds() - cpu);
                row["steps"] = json!(found.report.steps);
                row["overfit"] = json!(found.overfit);
                row["pose_gain"] = json!(found.pose_gain);
                row["moved"] = json!(found.report.cameras);
                row["held_out"] = json!(held_out(given.len()));
                row["own_psnr_before"] = json!(found.report.psnr_before);
                row["own_psnr_after"] = json!(found.report.psnr_after);
                // Where no version was better, what is served stays.
                row["refined_psnr"] = plain["served_psnr"].clone();
                let came = |(ms, version): &(f64, RefinedVersion)| {
                    let psnr = judge(&version.gaussians)?;
                    Ok(json!({ "ms": ms, "psnr": psnr, "report": version.report }))
                };
                row["versions"] = versions.iter().map(came).collect::<Result<Value>>()?;
                if let Some((_, version)) = versions.last() {
                    row["refined_psnr"] = json!(judge(&version.gaussians)?);
                    row["refined_gaussians"] = json!(version.gaussians.len());
                    row["refined_ssim"] = json!(similarity(&version.gaussians)?);
                    row["fitted"] = fitted(&version.gaussians)?;
                    row["off_degrees"] = json!(off_degrees(&version.poses, &right));
                    row["off_recast"] = json!(off_degrees(&poses_of(&made_of.borrow().0), &right));
                    row["off_degrees_given"] = json!(off_degrees(&poses_of(&given), &right));
                    picture(text, one_set(&version.gaussians, camera)?)?;
                }
                progress(&format!("{name}: {row}"));
                rows.push(json!({ "psnr_db": row["refined_psnr"] }), row)?;
            }
        }
    }
    Ok(())
}

/// What becomes of a scene when `count` of its photos, spread evenly, join those before: PSNR at
/// the targets before, after, and of a scene made of all photos at once.
fn joining(
    engine: &Pipeline,
    renderer: &dyn Renderer,
    photos: &[PosedPhoto],
    count: usize,
    options: &SceneOptions,
    targets: &[PosedPhoto],
) -> Result<Value> {
    let new = spread(photos.len(), &[], count);
    let old: Vec<usize> = (0..photos.len()).filter(|i| !new.contains(i)).collect();
    let all: Vec<PosedPhoto> = old.iter().chain(&new).map(|&i| photos[i].clone()).collect();
    let (made, seen) = make_keeping(engine, &all[..old.len()], options)?;
    let before = scene_of(made);
    let begun = Instant::now();
    let grown = make_more(engine, &all, old.len(), seen, options)?;
    let made_ms = ms(begun);
    let kept: Vec<usize> = (0..old.len()).collect();
    let after = scene_of(growth::version(renderer, &before, &kept, &grown, &all)?);
    let join_ms = ms(begun);
    let at_once = scene_of(make_keeping(engine, photos, options)?.0);
    let each = |scene: &Scene| -> Result<Vec<f64>> {
        let draw = |camera| {
            let plain = view_request(camera, Kinds::COLOR, scene.meta.report.median_depth);
            renderer.render(&scene.gaussians, &served(scene, plain))
        };
        targets.iter().map(|target| mean_psnr(std::slice::from_ref(target), draw)).collect()
    };
    let [had, has, anew] = [each(&before)?, each(&after)?, each(&at_once)?];
    let united = each(&scene_of(grown.made.clone()))?;
    let mean = |of: &[f64]| of.iter().sum::<f64>() / of.len() as f64;
    let lost = had.iter().zip(&has).map(|(had, has)| had - has).fold(f64::MIN, f64::max);
    Ok(json!({
        "photos": old.len(),
        "join": new.len(),
        "remade": after.gaussians.means() == grown.made.gaussians.means(),
        "psnr_before": mean(&had),
        "psnr": mean(&has),
        "lost_most": lost,
        "psnr_united": mean(&united),
        "psnr_at_once": mean(&anew),
        "made_ms": made_ms,
        "join_ms": join_ms,
    }))
}

/// A scene without its floaters, and one with `share` of its Gaussians more that float, before and
/// after: PSNR at the targets, and which of the added ones are taken.
fn cleaned(
    engine: &Pipeline,
    renderer: &dyn Renderer,
    photos: &[PosedPhoto],
    share: f64,
    options: &SceneOptions,
    targets: &[PosedPhoto],
) -> Result<Value> {
    let scene = scene_of(make_keeping(engine, photos, options)?.0);
    let judge = |gaussians: &Gaussians| {
        let scene = Scene { gaussians: gaussians.clone(), ..scene.clone() };
        mean_psnr(targets, |camera| {
            let plain = view_request(camera, Kinds::COLOR, scene.meta.report.median_depth);
            renderer.render(&scene.gaussians, &served(&scene, plain))
        })
    };
    let cameras = &scene.meta.cameras;
    let begun = Instant::now();
    let found = floaters(&scene.gaussians, cameras);
    let clean_ms = ms(begun);
    let clean = scene.gaussians.only(|i| !found[i]);
    // Drawn ones come nearer to the photo that gave them, along their rays.
    let mut random = Random(17);
    let (count, origin) = (scene.gaussians.len(), scene.gaussians.origin());
    let drawn: Vec<bool> = (0..count).map(|_| f64::from(random.range(0.0, 1.0)) < share).collect();
    let mut more = scene.gaussians.only(|i| drawn[i]).into_raw();
    for ((mean, source), scales) in more.means.iter_mut().zip(&more.source).zip(&mut more.scales) {
        let eye = cameras[usize::from(source.view)].camera.camera_to_world.center() - origin;
        let at = f64::from(random.range(0.25, 0.75));
        let place = eye + at * (DVec3::from(mean.map(f64::from)) - eye);
        *mean = place.as_vec3().to_array();
        let scale = f64::from(random.range(1.0, 4.0)) * at;
        *scales = scales.map(|v| (f64::from(v) * scale) as f32);
    }
    let added = more.means.len();
    let dirty = scene.gaussians.joined(&Gaussians::restore(more)?)?;
    let floating = floaters(&dirty, cameras);
    let cleaned = dirty.only(|i| !floating[i]);
    let taken = floating[count..].iter().filter(|is| **is).count();
    Ok(json!({
        "photos": photos.len(),
        "gaussians": count,
        "floaters": found.iter().filter(|is| **is).count(),
        "clean_ms": clean_ms,
        "psnr_before": judge(&scene.gaussians)?,
        "psnr": judge(&clean)?,
        "added": added,
        "added_taken": taken,
        "own_taken": floating[..count].iter().filter(|is| **is).count(),
        "psnr_dirty": judge(&dirty)?,
        "psnr_cleaned": judge(&cleaned)?,
    }))
}

/// Photos whose cameras are turned by so many degrees and moved by `way` world units, each about an
/// axis and along a line of its own, the same in each run.
fn disturbed(photos: &[PosedPhoto], degrees: f64, way: f64) -> Vec<PosedPhoto> {
    let mut random = Random(40);
    let wrong = |posed: &PosedPhoto| {
        let [turn, shift] = [(); 2].map(|()| {
            DVec3::from_array([(); 3].map(|()| f64::from(random.range(-1.0, 1.0)))).normalize()
        });
        let pose = &posed.camera.camera_to_world;
        let camera_to_world = moved(pose, turn * degrees.to_radians(), shift * way);
        PosedPhoto { camera: Camera { camera_to_world, ..posed.camera }, ..posed.clone() }
    };
    photos.iter().map(wrong).collect()
}

/// Share of the pasted pixels that are left out of the photos, and of the others.
fn left_out(photos: &[PosedPhoto], pasted: &[Option<Vec<bool>>]) -> [f64; 2] {
    let mut counts = [[0_u64; 2]; 2];
    for (posed, pasted) in photos.iter().zip(pasted) {
        for i in 0..posed.photo.rgb.len() / 3 {
            let kind = usize::from(pasted.as_ref().is_none_or(|pasted| !pasted[i]));
            counts[kind][0] += 1;
            counts[kind][1] += u64::from(posed.photo.valid.as_ref().is_some_and(|v| !v[i]));
        }
    }
    counts.map(|[all, out]| out as f64 / all.max(1) as f64)
}

fn poses_of(photos: &[PosedPhoto]) -> Vec<CameraToWorld> {
    photos.iter().map(|posed| posed.camera.camera_to_world).collect()
}

/// Mean angle of the cameras to the right ones, degrees.
fn off_degrees(poses: &[CameraToWorld], right: &[PosedPhoto]) -> f64 {
    let off = poses.iter().zip(poses_of(right)).map(|(pose, right)| pose.turn_to(&right));
    off.sum::<f64>().to_degrees() / poses.len() as f64
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
        let truth = unit(&target.photo);
        sum += psnr(&clamped(frame.color), &truth, target.photo.valid.as_deref());
    }
    Ok(sum / targets.len() as f64)
}

/// The same for SSIM.
fn mean_ssim(targets: &[PosedPhoto], draw: impl Fn(Camera) -> Result<Frame>) -> Result<f64> {
    let mut sum = 0.0;
    for target in targets {
        let (shown, truth) = (clamped(draw(target.camera)?.color), unit(&target.photo));
        let (width, valid) = (target.photo.width as usize, target.photo.valid.as_deref());
        sum += ssim(&shown, &truth, width, valid);
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
