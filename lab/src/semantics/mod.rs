//! What texts select in views of labelled scenes.
//!
//! The paper's protocol: a labelled photo is the target, the photos nearest to it are the input,
//! and the class names are asked in a view from the target's camera. Each preset makes a scene of
//! its own, and scores it. The *flat* baseline has no 3D: each mask of the nearest photo is scored
//! by the same text, and the masks are laid over the target as they are.

pub mod labels;
pub mod tally;
mod views;

use std::path::PathBuf;

use segsplat::service::ScoringOptions;
use segsplat_core::names::named;
use serde_json::{Value, json};

use self::{
    labels::{LabelledFrame, LabelledScene, NOT_SEEN},
    tally::{Tally, TextMap},
    views::{Seen, Tools, Way},
};
use crate::{
    error::{Error, Result},
    grid,
    limits::Limits,
    pipeline::Pipeline,
    render::cpu::CpuRenderer,
    rows::{Rows, progress},
    scene::{Preset, SceneOptions, with_pairs},
    scenes::{means_by_use, nearest, use_of},
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
    /// Folder for picture grids, one a scene
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

/// Makes a row for each scene, and rows of means; the error is one less the mean IoU.
///
/// # Errors
/// `invalid_request` when there is no labelled scene or an option is out of range, else whatever a
/// stage says, with scene and target named.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    if args.inputs.photos < 2 {
        return Err(Error::invalid("photos must be at least 2"));
    }
    let engine = Pipeline::open(&args.inputs.setup.networks(1))?;
    let renderer = CpuRenderer::new(args.inputs.setup.threads())?;
    let ways = args.preset.iter().map(|preset| args.way(&engine, *preset));
    let ways = ways.collect::<Result<Vec<Way>>>()?;
    let tools = Tools::open(&engine, &renderer)?;
    let bundle = format!("{} {}", engine.bundle().name(), engine.bundle().version());
    let mut push = |mut row: Value| {
        row["bundle"] = json!(bundle);
        row["photos"] = json!(args.inputs.photos);
        let first = args.preset.first().copied().unwrap_or_default().to_string();
        let miou = row[first]["scene"]["miou"].as_f64().unwrap_or(f64::NAN);
        let scene = row["scene"].as_str().unwrap_or_default();
        progress(&format!("{scene}: mIoU {miou:.3}"));
        rows.push(json!({ "one_less_miou": 1.0 - miou }), row)
    };
    let mut scenes = Vec::new();
    for (name, dir) in args.inputs.find(labels::is_labelled)? {
        let scene = labels::read(&dir, &Limits::default())?;
        let row = judge(&tools, &ways, &name, &scene, args)?;
        push(row.clone())?;
        scenes.push(row);
    }
    means_by_use(&scenes).into_iter().try_for_each(push)
}

/// All targets of one scene: for each preset the figures of the scene (texts asked of it, at the
/// target's camera) and of the flat baseline.
fn judge(
    tools: &Tools<'_>,
    ways: &[Way],
    name: &str,
    scene: &LabelledScene,
    args: &Args,
) -> Result<Value> {
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
    let (mut targets, mut pictures) = (Vec::new(), Vec::new());
    for frame in scene.frames.iter().step_by(every) {
        let inputs = nearest(&scene.photos, frame.photo, args.inputs.photos);
        let fault = |e: Error| {
            let file = &scene.photos[frame.photo].file;
            Error::new(e.code(), format!("{name}, target {file}: {e}")).caused_by(e)
        };
        if inputs.len() < args.inputs.photos {
            return Err(fault(Error::invalid(format!("{} photos beside it", inputs.len()))));
        }
        let (mut all_maps, mut color) = (Vec::new(), None);
        for (tallies, way) in tallies.iter_mut().zip(ways) {
            let seen = tools.see(&scene.photos, frame.photo, &inputs, way).map_err(fault)?;
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
    if let Some(out) = &args.pictures {
        grid::write(out, name, &pictures.iter().collect::<Vec<_>>())?;
    }
    let mut row = json!({ "scene": name, "use": use_of(name), "targets": targets });
    for (preset, [scene, flat]) in args.preset.iter().zip(&tallies) {
        row[preset.to_string()] = json!({ "scene": scene.scores(), "flat": flat.scores() });
    }
    Ok(row)
}

/// One target's pictures: photo, view, labels, then for each preset the best selecting text of
/// the scene and of the flat baseline.
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
    let drawn = [seen.color.clone(), labelled].into_iter().chain(best);
    all.extend(drawn.map(|picture| grid::color(&picture, photo.width)));
    let height = (photo.height * PICTURE_WIDTH / photo.width.max(1)).max(1);
    all.iter().map(|p| image::imageops::thumbnail(p, PICTURE_WIDTH, height)).collect()
}
