//! What texts select in views of labelled scenes.
//!
//! The paper's protocol: a labelled photo is the target, the photos nearest to it are the input,
//! and the class names are asked in a view from the target's camera. Both scoring profiles are
//! judged from one scene. Beside them stands the *flat* baseline without any 3D: the masks of the
//! nearest photo, each scored by the same text on its own, laid over the target as they are.

mod labels;
mod llff;
mod tally;
mod views;

use std::path::PathBuf;

use serde::Serialize;
use serde_json::json;

use self::{
    labels::{LabelledFrame, LabelledScene, NOT_SEEN},
    tally::{Tally, TextMap},
    views::{Seen, Tools},
};
use crate::{
    error::{Error, Result},
    folders::{Folders, REPORTED, nearest},
    grid,
    limits::Limits,
    pipeline::{Pipeline, semantics::SemanticsOptions},
    render::cpu::CpuRenderer,
    rows::{Rows, progress},
    scene::{Camera, ScoringProfile},
    setup::Setup,
};

pub use self::{
    tally::{AbsentScore, ClassScore, Scores},
    views::TargetReport,
};

/// Words for what is in no scene, unless others are given. A scene that has one does not ask it.
pub const ABSENT: &str = "airplane,elephant,church,waterfall,bicycle,violin,helmet,bridge";
/// Profiles in the order they are judged.
const PROFILES: [ScoringProfile; 2] = [ScoringProfile::Paper, ScoringProfile::Default];
/// Width of the pictures of a grid.
const PICTURE_WIDTH: u32 = 320;

/// What to evaluate.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    /// Labelled scene folders (masks/classes.json or segmentations/)
    #[command(flatten)]
    pub folders: Folders,
    /// Photos in: those nearest to the labelled photo
    #[arg(long, default_value_t = 2)]
    pub photos: usize,
    /// Labelled photos of a scene to score, evenly spread; 0: all of them
    #[arg(long, default_value_t = 0)]
    pub targets: usize,
    /// Words for what is in no scene, separated by commas
    #[arg(long, value_delimiter = ',', default_value = ABSENT)]
    pub absent: Vec<String>,
    /// Ask a photo first where masks of earlier photos reappear [default: as the service]
    #[arg(long)]
    pub seeds: Option<bool>,
    /// Let all photos that show a Gaussian vote for its entry [default: as the service]
    #[arg(long)]
    pub votes: Option<bool>,
    /// Join bank entries that are one thing, at least this alike (cosine); 0: none [default: as
    /// the service]
    #[arg(long, value_name = "COSINE")]
    pub merge: Option<f64>,
    /// Folder for picture grids, one a scene
    #[arg(long, value_name = "DIR")]
    pub pictures: Option<PathBuf>,
    /// What runs the networks
    #[command(flatten)]
    pub setup: Setup,
}

/// One profile: the product's views beside the flat baseline.
#[derive(Clone, Debug, Serialize)]
pub struct Judgement {
    /// Scoring profile.
    pub profile: ScoringProfile,
    /// Texts asked of the scene, at the target's camera.
    pub scene: Scores,
    /// Texts asked of the nearest photo's masks, laid over the target.
    pub flat: Scores,
}

/// One scene, or the means over scenes (then without targets).
#[derive(Clone, Debug, Serialize)]
pub struct SceneReport {
    /// Folder name.
    pub scene: String,
    /// Whether it is one of the scenes whose figures are reported.
    pub reported: bool,
    /// Name and version of the bundle.
    pub bundle: String,
    /// Photos put in.
    pub photos: usize,
    /// Profile `paper`.
    pub paper: Judgement,
    /// Profile `default`.
    pub default: Judgement,
    /// The targets.
    pub targets: Vec<TargetReport>,
}

impl Args {
    fn understanding(&self) -> SemanticsOptions {
        let mut options = SemanticsOptions::default();
        options.seeds = self.seeds.unwrap_or(options.seeds);
        options.votes = self.votes.unwrap_or(options.votes);
        if let Some(cosine) = self.merge {
            options.merge = (cosine > 0.0).then_some(cosine);
        }
        options
    }
}

/// Makes a row for each scene, and rows of means; the error is one less the mean IoU.
///
/// # Errors
/// `invalid_request` when there is no labelled scene or an option is out of range, else whatever a
/// stage says, with scene and target named.
pub fn run(args: &Args, rows: &mut Rows) -> Result<Vec<SceneReport>> {
    if args.photos < 2 {
        return Err(Error::invalid("photos must be at least 2"));
    }
    let engine = Pipeline::open(&args.setup.networks(1))?;
    let renderer = CpuRenderer::new(args.setup.threads())?;
    let tools = Tools::open(&engine, &renderer, args.understanding())?;
    let mut scenes = Vec::new();
    for (name, dir) in args.folders.find(labels::is_labelled)? {
        let scene = labels::read(&dir, &Limits::default())?;
        let report = judge(&tools, name, &scene, args)?;
        report.push(rows)?;
        progress(&format!("{}: mIoU {:.3}", report.scene, report.default.scene.miou));
        scenes.push(report);
    }
    let groups = [("mean of reported", true), ("mean of choosing", false)];
    for (name, reported) in groups {
        let of: Vec<&SceneReport> = scenes.iter().filter(|s| s.reported == reported).collect();
        let [first, _, ..] = of[..] else { continue };
        let over = |judgement: fn(&SceneReport) -> &Judgement| Judgement {
            profile: judgement(first).profile,
            scene: Scores::mean(&of.iter().map(|s| &judgement(s).scene).collect::<Vec<_>>()),
            flat: Scores::mean(&of.iter().map(|s| &judgement(s).flat).collect::<Vec<_>>()),
        };
        let means = SceneReport {
            scene: name.to_owned(),
            reported,
            bundle: first.bundle.clone(),
            photos: args.photos,
            paper: over(|s| &s.paper),
            default: over(|s| &s.default),
            targets: Vec::new(),
        };
        means.push(rows)?;
    }
    Ok(scenes)
}

impl SceneReport {
    fn push(&self, rows: &mut Rows) -> Result<()> {
        rows.push(json!({ "one_less_miou": 1.0 - self.default.scene.miou }), self)
    }
}

/// All targets of one scene.
fn judge(
    tools: &Tools<'_>,
    name: String,
    scene: &LabelledScene,
    args: &Args,
) -> Result<SceneReport> {
    let is_class =
        |word: &&String| scene.classes.iter().any(|class| class.name.eq_ignore_ascii_case(word));
    let absent: Vec<String> = args.absent.iter().filter(|w| !is_class(w)).cloned().collect();
    let blank = Tally::new(&scene.classes, &absent);
    let texts = tools.texts(&blank.texts())?;
    let mut tallies = [[blank.clone(), blank.clone()], [blank.clone(), blank]];
    let cameras: Vec<Camera> = scene.photos.iter().map(|p| p.camera).collect();
    let every = match args.targets {
        0 => 1,
        most => scene.frames.len().div_ceil(most).max(1),
    };
    let (mut targets, mut pictures) = (Vec::new(), Vec::new());
    for frame in scene.frames.iter().step_by(every) {
        let inputs = nearest(&cameras, frame.photo, args.photos);
        let fault = |e: Error| {
            let file = &scene.photos[frame.photo].file;
            Error::new(e.code(), format!("{name}, target {file}: {e}")).caused_by(e)
        };
        if inputs.len() < args.photos {
            return Err(fault(Error::invalid(format!("{} photos beside it", inputs.len()))));
        }
        let seen = tools.see(&scene.photos, frame.photo, &inputs).map_err(fault)?;
        let mut all_maps = Vec::new();
        for (tallies, profile) in tallies.iter_mut().zip(PROFILES) {
            let maps = seen.maps(tools, profile, &texts)?;
            for (tally, maps) in tallies.iter_mut().zip(&maps) {
                tally.add(&frame.label, maps);
            }
            all_maps.extend(maps);
        }
        if args.pictures.is_some() {
            pictures.push(shown(scene, frame, &seen, &all_maps));
        }
        targets.push(seen.report);
    }
    if let Some(out) = &args.pictures {
        grid::write(out, &name, &pictures.iter().collect::<Vec<_>>())?;
    }
    let [paper, default] = [0, 1].map(|i| Judgement {
        profile: PROFILES[i],
        scene: tallies[i][0].scores(),
        flat: tallies[i][1].scores(),
    });
    let reported = REPORTED.contains(&name.as_str());
    let bundle = tools.bundle();
    Ok(SceneReport { scene: name, reported, bundle, photos: args.photos, paper, default, targets })
}

/// One target's pictures: photo, view, labels, then for each profile the best selecting text of
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
