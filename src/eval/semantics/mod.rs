//! What texts select in views of labelled scenes: `segsplat eval semantics DIR`.
//!
//! The paper's protocol: a labelled photo is the target, the photos nearest to it are the input,
//! and the class names are asked in a view from the target's camera. Both scoring profiles are
//! judged from one scene. Beside them stands the *flat* baseline without any 3D: the masks of the
//! nearest photo, each scored by the same text on its own, laid over the target as they are.

mod labels;
mod llff;
mod pictures;
mod report;
mod road;
mod tally;

use std::path::{Path, PathBuf};

use crate::{
    config::Config,
    error::{Error, Result},
    pipeline::{Engine, semantics::SemanticsOptions},
    render::cpu::CpuRenderer,
    scene::{Camera, ScoringProfile},
};

use self::{
    labels::LabelledScene,
    road::Road,
    tally::{Tally, TextMap},
};

pub use self::{
    report::{Judgement, SemanticsEvalReport, SemanticsSceneReport, TargetReport},
    tally::{AbsentScore, ClassScore, Scores},
};

/// Words for what is in no scene, unless others are given. A scene that has one does not ask it.
pub const ABSENT: &str = "airplane,elephant,church,waterfall,bicycle,violin,helmet,bridge";
/// Profiles in the order they are judged.
const PROFILES: [ScoringProfile; 2] = [ScoringProfile::Paper, ScoringProfile::Default];

/// How scenes are understood unless an option says otherwise: as the service does it.
#[must_use]
pub fn understanding() -> SemanticsOptions {
    SemanticsOptions::default()
}

/// What to evaluate.
#[derive(Clone, Debug)]
pub struct SemanticsEval {
    /// A labelled scene folder, or a folder of them.
    pub dir: PathBuf,
    /// Names of the scenes to take; empty: all.
    pub scenes: Vec<String>,
    /// Photos in, 2 or more: those nearest to the target.
    pub photos: usize,
    /// Labelled photos of a scene that become targets, evenly spread; 0: all.
    pub targets: usize,
    /// Words for what is in no scene.
    pub absent: Vec<String>,
    /// What is done beyond the paper.
    pub understanding: SemanticsOptions,
    /// Folder for picture grids, one a scene.
    pub pictures: Option<PathBuf>,
}

/// Evaluates; `done` hears of each scene as it finishes.
///
/// # Errors
/// `invalid_request` when there is no labelled scene or an option is out of range, else whatever a
/// stage says, with scene and target named.
pub fn run(
    config: &Config,
    options: &SemanticsEval,
    done: &dyn Fn(&SemanticsSceneReport),
) -> Result<SemanticsEvalReport> {
    if options.photos < 2 {
        return Err(Error::invalid(format!(
            "eval semantics: {} photos in; it must be at least 2",
            options.photos
        )));
    }
    let engine = Engine::open(&config.networks())?;
    let renderer = CpuRenderer::new(config.threads)?;
    let road = Road::open(&engine, &renderer, options.understanding)?;
    let mut scenes = Vec::new();
    for dir in labelled_dirs(&options.dir, &options.scenes)? {
        let name = dir.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let scene = labels::read(&dir, &config.limits)?;
        let report = judge(&road, &name, &scene, options)?;
        done(&report);
        scenes.push(report);
    }
    Ok(SemanticsEvalReport::new(scenes, options.photos, &engine, &road))
}

/// All targets of one scene.
fn judge(
    road: &Road<'_>,
    name: &str,
    scene: &LabelledScene,
    options: &SemanticsEval,
) -> Result<SemanticsSceneReport> {
    let named = |word: &&String| {
        let same = |class: &labels::Class| class.name.eq_ignore_ascii_case(word);
        !scene.classes.iter().any(same)
    };
    let absent: Vec<String> = options.absent.iter().filter(named).cloned().collect();
    let blank = Tally::new(&scene.classes, &absent);
    let texts = road.texts(&blank.texts())?;
    let mut tallies = vec![[blank.clone(), blank]; PROFILES.len()];
    let cameras: Vec<Camera> = scene.photos.iter().map(|p| p.camera).collect();
    let every = match options.targets {
        0 => 1,
        most => scene.frames.len().div_ceil(most).max(1),
    };
    let (mut targets, mut shown) = (Vec::new(), Vec::new());
    for frame in scene.frames.iter().step_by(every) {
        let inputs = nearest(&cameras, frame.photo, options.photos);
        let file = &scene.photos[frame.photo].file;
        if inputs.len() < options.photos {
            return Err(Error::invalid(format!(
                "{name}: {} photos beside target {file}, not {}",
                inputs.len(),
                options.photos
            )));
        }
        let seen = road.see(&scene.photos, frame.photo, &inputs).map_err(|e| {
            Error::new(e.code(), format!("{name}, target {file}: {e}")).caused_by(e)
        })?;
        let mut picture = Vec::new();
        for (tallies, profile) in tallies.iter_mut().zip(PROFILES) {
            let maps: [Vec<TextMap>; 2] =
                [seen.scene_maps(road, profile, &texts)?, seen.flat_maps(road, profile, &texts)?];
            for (tally, maps) in tallies.iter_mut().zip(&maps) {
                tally.add(&frame.label, maps);
            }
            picture.extend(maps);
        }
        targets.push(seen.report(&scene.photos, frame.photo, &inputs));
        if options.pictures.is_some() {
            shown.push(pictures::Shown::new(scene, frame, &seen.color, &picture));
        }
    }
    if let Some(out) = &options.pictures {
        pictures::write(out, name, &shown)?;
    }
    let judged = |[ours, flat]: &[Tally; 2], profile| Judgement {
        profile,
        scene: ours.scores(),
        flat: flat.scores(),
    };
    Ok(SemanticsSceneReport {
        scene: name.to_owned(),
        judgements: tallies.iter().zip(PROFILES).map(|(t, p)| judged(t, p)).collect(),
        targets,
    })
}

/// The `count` other photos whose cameras stand nearest to the target's, the nearest first.
fn nearest(cameras: &[Camera], target: usize, count: usize) -> Vec<usize> {
    let center = |i: usize| cameras[i].camera_to_world.center();
    let mut others: Vec<usize> = (0..cameras.len()).filter(|i| *i != target).collect();
    let away = |i: &usize| center(*i).distance_squared(center(target));
    others.sort_by(|a, b| away(a).total_cmp(&away(b)));
    others.truncate(count);
    others
}

/// The labelled folders under `dir` (or `dir` itself), sorted by name.
fn labelled_dirs(dir: &Path, wanted: &[String]) -> Result<Vec<PathBuf>> {
    let fault = |e: std::io::Error| Error::invalid(format!("eval: the folder: {}", e.kind()));
    let mut found = Vec::new();
    if labels::is_labelled(dir) {
        found.push(dir.to_owned());
    } else {
        for entry in fs_err::read_dir(dir).map_err(fault)? {
            let path = entry.map_err(fault)?.path();
            if labels::is_labelled(&path) {
                found.push(path);
            }
        }
    }
    found.sort();
    super::only_named(found, wanted, "labelled scene folder")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{CameraToWorld, Intrinsics};

    #[test]
    fn the_nearest_other_photos_are_the_input() {
        let at = |x: f64| Camera {
            intrinsics: Intrinsics { fx: 9., fy: 9., cx: 4., cy: 4., width: 8, height: 8 },
            camera_to_world: CameraToWorld::from_row_major(
                &[1., 0., 0., x, 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.],
                "t",
            )
            .unwrap(),
        };
        let cameras = [at(5.0), at(0.0), at(1.0), at(-2.0)];
        assert_eq!(nearest(&cameras, 1, 2), [2, 3]);
        assert_eq!(nearest(&cameras, 0, 2), [2, 1]);
        assert_eq!(nearest(&cameras, 0, 9).len(), 3);
    }
}
