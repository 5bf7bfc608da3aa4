//! What texts select in views of labelled scenes.
//!
//! The paper's protocol: a labelled photo is the target, the photos nearest to it (with `--overlap`
//! those that overlap so much) are the input, and the class names are asked in a view from the
//! target's camera. Each preset makes a scene of its own, and scores it. The *flat* baseline has no
//! 3D: each mask of the nearest photo is scored by the same text, and the masks are laid over the
//! target as they are.

mod boxes;
pub mod labels;
pub mod pca;
mod split;
pub mod tally;
mod views;

use std::path::PathBuf;

use segsplat::service::ScoringOptions;
use segsplat_core::names::named;
use serde_json::{Value, json};

use self::{
    labels::{LabelledFrame, LabelledScene, NOT_SEEN},
    tally::{Tally, TextMap},
    views::{Made, Seen, Tools, Way},
};
use crate::{
    error::{Error, Result},
    grid,
    limits::Limits,
    models::{NetworkOptions, ProviderChoice},
    pipeline::Pipeline,
    render::cpu::CpuRenderer,
    rows::{Rows, progress},
    scene::{Preset, SceneOptions, with_pairs},
    scenes::{inputs, means_by_use, spread, use_of},
    setup::Inputs,
};

/// Words for what is in no scene. A scene that has a class of this name does not ask the word.
const ABSENT: &str = "airplane,elephant,church,waterfall,bicycle,violin,helmet,bridge";
/// Width of the pictures of a grid.
const PICTURE_WIDTH: u32 = 320;

/// What to evaluate: labelled scene folders (masks/classes.json or segmentations/).
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    inputs: Inputs,
    /// Labelled photos of a scene to score, evenly spread; 0: all of them
    #[arg(long, default_value_t = 0)]
    targets: usize,
    /// Least projected overlap of each two photos put in, 0 to 1; the paper's inputs have 0.6
    #[arg(long, default_value_t = 0.0)]
    overlap: f64,
    /// Photos put in are spread over those that are no target; one scene is made for all targets
    #[arg(long, conflicts_with = "overlap")]
    spread: bool,
    /// Judge the boxes of parts in space in place of masks, of scenes that `make eval-scenes` made
    #[arg(long, conflicts_with = "overlap")]
    boxes: bool,
    /// Say of each word in each view where its pixels are lost: outlined in photos, lifted to the
    /// scene, named by its best entry, selected
    #[arg(long, conflicts_with = "boxes")]
    split: bool,
    /// Only time the semantics of each scene's spread photos: so many runs after a first one, which
    /// opens the networks
    #[arg(long, conflicts_with_all = ["boxes", "split", "overlap"], value_name = "RUNS")]
    timed: Option<usize>,
    /// Provider of the networks: cpu, cuda or webgpu
    #[arg(long, default_value = "cpu", value_parser = named::<ProviderChoice>)]
    provider: ProviderChoice,
    /// Words for what is in no scene, separated by commas
    #[arg(long, value_delimiter = ',', default_value = ABSENT)]
    absent: Vec<String>,
    /// How scenes are made, understood and scored, separated by commas: default, paper
    #[arg(long, value_delimiter = ',', value_parser = named::<Preset>, default_value = "default")]
    preset: Vec<Preset>,
    /// A change of the method of every preset, of scenes or of scoring: `--method lambda=0.8`,
    /// `--method tau=20`, `--method 'canon=["object"]'`; docs/method.md has all
    #[arg(long, value_name = "NAME=VALUE")]
    method: Vec<String>,
    /// Folder for picture grids, one a scene: photo, view, E and F of the view by their principal
    /// components, labels, what the texts select
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
}

impl Args {
    fn way(&self, engine: &Pipeline, preset: Preset) -> Result<Way> {
        // Names of neither are told by those of scenes.
        let known = json!(ScoringOptions::default());
        let scores =
            |pair: &&String| pair.split_once('=').is_some_and(|p| known.get(p.0).is_some());
        let (scores, makes): (Vec<_>, Vec<_>) = self.method.iter().partition(scores);
        let [scores, makes] =
            [scores, makes].map(|all| all.into_iter().cloned().collect::<Vec<_>>());
        let options = SceneOptions { preset, ..SceneOptions::default() }.with(&makes)?;
        options.method().check()?;
        let changes = with_pairs(&ScoringOptions::default(), &scores)?;
        let method = changes.change(engine.scoring_method(preset)?);
        Ok(Way { options, scoring: engine.scoring(&method)?.into() })
    }
}

/// Makes a row for each scene, rows of means, and one of the counts of all views together where
/// every scene is asked the same texts; the error is one less the mean IoU.
///
/// # Errors
/// `invalid_request` when there is no labelled scene or an option is out of range, else whatever a
/// stage says, with scene and target named.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    if args.inputs.photos < 2 {
        return Err(Error::invalid("photos must be at least 2"));
    }
    if !(0.0..=1.0).contains(&args.overlap) {
        return Err(Error::invalid(format!("overlap is {}; it must be 0 to 1", args.overlap)));
    }
    let options = args.inputs.setup.networks(1);
    let engine = Pipeline::open(&NetworkOptions { provider: args.provider, ..options })?;
    let renderer = CpuRenderer::new(args.inputs.setup.threads())?;
    let ways = args.preset.iter().map(|preset| args.way(&engine, *preset));
    let ways = ways.collect::<Result<Vec<Way>>>()?;
    let tools = Tools::open(&engine, &renderer)?;
    let bundle = engine.bundle();
    let sources = [
        Some(&bundle.geometry().source),
        bundle.masks().map(|masks| &masks.source),
        bundle.image_text().map(|towers| &towers.source),
    ];
    let networks: Vec<&str> = sources.into_iter().flatten().map(String::as_str).collect();
    let (bundle, networks) =
        (format!("{} {}", bundle.name(), bundle.version()), networks.join("; "));
    let mut push = |mut row: Value| {
        row["bundle"] = json!(bundle);
        row["networks"] = json!(networks);
        row["photos"] = json!(args.inputs.photos);
        row["overlap"] = json!(args.overlap);
        row["spread"] = json!(args.spread);
        let first = args.preset.first().copied().unwrap_or_default().to_string();
        let miou = row[first]["scene"]["miou"].as_f64().unwrap_or(f64::NAN);
        let scene = row["scene"].as_str().unwrap_or_default();
        progress(&format!("{scene}: mIoU {miou:.3}"));
        rows.push(json!({ "one_less_miou": 1.0 - miou }), row)
    };
    if args.boxes {
        let way = ways.first().ok_or_else(|| Error::invalid("--boxes needs a preset"))?;
        return judge_boxes(&tools, way, args, rows);
    }
    if let Some(runs) = args.timed {
        let way = ways.first().ok_or_else(|| Error::invalid("--timed needs a preset"))?;
        for (name, dir) in args.inputs.find(labels::is_labelled)? {
            let scene = labels::read(&dir, &Limits::default())?;
            let given = spread(scene.photos.len(), &[], args.inputs.photos);
            let times = tools.timed(&scene.photos, &given, way, runs)?;
            let median = times[times.len() / 2];
            progress(&format!("{name}: {} photos, semantics in {median:.0} ms", given.len()));
            let row = json!({
                "scene": name, "photos": given.len(), "bundle": bundle, "networks": networks,
                "provider": tools.provider(), "times_ms": times,
            });
            rows.push(json!({ "median_ms": median }), row)?;
        }
        return Ok(());
    }
    let (mut scenes, mut counted) = (Vec::new(), Vec::new());
    for (name, dir) in args.inputs.find(labels::is_labelled)? {
        let scene = labels::read(&dir, &Limits::default())?;
        let (mut row, tallies) = judge(&tools, &ways, &name, &scene, args)?;
        figures(&mut row, args, &tallies);
        push(row.clone())?;
        scenes.push(row);
        counted.push(Some(tallies));
    }
    means_by_use(&scenes).into_iter().try_for_each(&mut push)?;
    let together = counted.into_iter().reduce(|all, more| merged(all?, &more?)).flatten();
    if let Some(tallies) = together.filter(|_| scenes.len() > 1) {
        let mut row = json!({ "scene": "**all views together**", "use": "all" });
        figures(&mut row, args, &tallies);
        push(row)?;
    }
    Ok(())
}

/// Makes a row for the boxes of each scene, and one of means; the error is one less the IoU.
fn judge_boxes(tools: &Tools<'_>, way: &Way, args: &Args, rows: &mut Rows) -> Result<()> {
    let mut push = |row: Value| {
        let iou = row["upright_iou"].as_f64().unwrap_or(f64::NAN);
        progress(&format!("{}: IoU of upright boxes {iou:.3}", row["scene"]));
        rows.push(json!({ "one_less_iou": 1.0 - iou }), row)
    };
    let mut scenes = Vec::new();
    for (name, dir) in args.inputs.find(labels::is_labelled)? {
        let scene = labels::read(&dir, &Limits::default())?;
        let mut row = boxes::judge(tools, way, &dir, &scene, args.inputs.photos)?;
        row["scene"] = json!(name);
        row["use"] = json!(use_of(&name));
        row["photos"] = json!(args.inputs.photos);
        push(row.clone())?;
        scenes.push(row);
    }
    means_by_use(&scenes).into_iter().try_for_each(push)
}

/// Counts of the scene and of the flat baseline.
type Tallies = [Tally; 2];

/// Adds the figures of each preset to a row.
fn figures(row: &mut Value, args: &Args, tallies: &[Tallies]) {
    for (preset, [scene, flat]) in args.preset.iter().zip(tallies) {
        row[preset.to_string()] = json!({ "scene": scene.scores(), "flat": flat.scores() });
    }
}

/// The counts of both, for each preset; `None` where other texts were asked.
fn merged(mut all: Vec<Tallies>, more: &[Tallies]) -> Option<Vec<Tallies>> {
    let mut pairs = all.iter_mut().flatten().zip(more.iter().flatten());
    pairs.all(|(all, more)| all.merge(more)).then_some(all)
}

/// All targets of one scene: for each preset the figures of the scene (texts asked of it, at the
/// target's camera) and of the flat baseline.
fn judge(
    tools: &Tools<'_>,
    ways: &[Way],
    name: &str,
    scene: &LabelledScene,
    args: &Args,
) -> Result<(Value, Vec<Tallies>)> {
    let is_class =
        |word: &&String| scene.classes.iter().any(|class| class.name.eq_ignore_ascii_case(word));
    let absent: Vec<String> = args.absent.iter().filter(|w| !is_class(w)).cloned().collect();
    let blank = Tally::new(&scene.classes, &absent);
    let texts = tools.texts(&blank.texts())?;
    let mut tallies = vec![[blank.clone(), blank]; ways.len()];
    let every = match args.targets {
        0 => 1,
        most => scene.frames.len().div_ceil(most).max(1),
    };
    let (mut targets, mut left_out, mut pictures) = (Vec::new(), Vec::new(), Vec::new());
    let mut lost = Vec::new();
    let asked: Vec<usize> = scene.frames.iter().step_by(every).map(|frame| frame.photo).collect();
    let given = spread(scene.photos.len(), &asked, args.inputs.photos);
    if args.spread && given.len() < 2 {
        let count = given.len();
        let message = format!("{name}: {count} photos are no target; spread needs 2 or more");
        return Err(Error::invalid(message));
    }
    let make = |way| tools.make(&scene.photos, &given, way);
    let all = ways.iter().filter(|_| args.spread).map(make).collect::<Result<Vec<Made>>>();
    let all = all.map_err(|e| Error::new(e.code(), format!("{name}: {e}")).caused_by(e))?;
    for frame in scene.frames.iter().step_by(every) {
        let file = &scene.photos[frame.photo].file;
        let fault =
            |e: Error| Error::new(e.code(), format!("{name}, target {file}: {e}")).caused_by(e);
        let inputs = match args.spread {
            true => Some(Vec::new()),
            false => inputs(&scene.photos, frame.photo, args.inputs.photos, args.overlap),
        };
        let Some(inputs) = inputs else {
            left_out.push(file);
            continue;
        };
        let (mut all_maps, mut color) = (Vec::new(), None);
        for (at, (tallies, way)) in tallies.iter_mut().zip(ways).enumerate() {
            let target = &scene.photos[frame.photo];
            let seen = match all.get(at) {
                Some(made) => tools.see(made, target, false),
                None => tools
                    .make(&scene.photos, &inputs, way)
                    .and_then(|made| tools.see(&made, target, true)),
            };
            let seen = seen.map_err(fault)?;
            if args.split {
                lost.append(&mut seen.split(scene, frame, &way.scoring, &texts)?);
            }
            for (tally, bank) in tallies.iter_mut().zip(&seen.banks) {
                let maps = bank.maps(&way.scoring, &texts)?;
                tally.add(&frame.label, &maps);
                all_maps.push(maps);
            }
            targets.push(seen.report.clone());
            color.get_or_insert(seen);
        }
        if let (true, Some(seen)) = (args.pictures.is_some(), color) {
            pictures.push(shown(scene, frame, &seen, &all_maps));
        }
    }
    if targets.is_empty() {
        return Err(Error::invalid(format!(
            "{name}: no target has {} photos beside it that overlap by {}",
            args.inputs.photos, args.overlap
        )));
    }
    if let Some(out) = &args.pictures {
        grid::write(out, name, &pictures.iter().collect::<Vec<_>>())?;
    }
    let mut row =
        json!({ "scene": name, "use": use_of(name), "targets": targets, "left_out": left_out });
    if args.split {
        split::told(&lost).iter().for_each(|line| progress(line));
        row["split"] = json!(lost);
    }
    Ok((row, tallies))
}

/// One target's pictures: photo, view, E and F of the view, labels, then for each preset the best
/// selecting text of the scene and of the flat baseline.
fn shown(
    scene: &LabelledScene,
    frame: &LabelledFrame,
    seen: &Seen,
    maps: &[Vec<TextMap>],
) -> grid::Row {
    let photo = &scene.photos[frame.photo].photo;
    let asked: Vec<usize> = (0..scene.classes.len()).filter(|c| scene.classes[*c].asked).collect();
    let pixels = photo.rgb.len() / 3;
    let tint = |p: usize, class: Option<usize>| match class {
        Some(c) => segsplat_vision::semantics::colour(u16::try_from(c + 1).unwrap_or(u16::MAX)),
        None => {
            let sum: u16 = photo.rgb[p * 3..p * 3 + 2].iter().map(|v| u16::from(*v)).sum();
            [f32::from(sum) / (6.0 * 255.0); 3]
        }
    };
    let tinted = |class: &dyn Fn(usize) -> Option<usize>| -> Vec<[f32; 3]> {
        (0..pixels).map(|p| tint(p, class(p))).collect()
    };
    let labelled = tinted(&|p| {
        let label = frame.label[p];
        let class = usize::from(label).checked_sub(1).filter(|_| label != NOT_SEEN)?;
        asked.iter().position(|a| *a == class)
    });
    let best = maps.iter().map(|maps| {
        let classes = &maps[..asked.len().min(maps.len())];
        tinted(&|p| tally::best_selected(classes, p))
    });
    let mut all = vec![grid::photo(photo)];
    let [weights, features] = [seen.banks[0].weights_shown(), seen.banks[0].features_shown()];
    let drawn = [seen.color.clone(), weights, features, labelled].into_iter().chain(best);
    all.extend(drawn.map(|picture| grid::color(&picture, photo.width)));
    let height = (photo.height * PICTURE_WIDTH / photo.width.max(1)).max(1);
    all.iter().map(|p| image::imageops::thumbnail(p, PICTURE_WIDTH, height)).collect()
}
