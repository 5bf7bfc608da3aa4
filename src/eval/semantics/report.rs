//! What an evaluation of semantics found, as JSON and as a table.

use std::fmt;

use serde::Serialize;

use super::{road::Road, tally::Scores};
use crate::{
    pipeline::Engine,
    scene::{ScoringProfile, SemanticsReport, StageTime},
};

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

/// One target.
#[derive(Clone, Debug, Serialize)]
pub struct TargetReport {
    /// File of the target.
    pub target: String,
    /// Files of the inputs, the nearest first.
    pub inputs: Vec<String>,
    /// How semantics went: masks, bank size, times.
    pub semantics: SemanticsReport,
    /// Times of the stages before.
    pub stages: Vec<StageTime>,
    /// Mean sum of the weights that a pixel of the target has over the bank, 0..1.
    pub coverage: f64,
    /// What looked wrong with the inputs.
    pub warnings: usize,
}

/// One scene.
#[derive(Clone, Debug, Serialize)]
pub struct SemanticsSceneReport {
    /// Folder name.
    pub scene: String,
    /// Profile `paper`, then `default`.
    pub judgements: Vec<Judgement>,
    /// The targets.
    pub targets: Vec<TargetReport>,
}

/// All scenes.
#[derive(Clone, Debug, Serialize)]
pub struct SemanticsEvalReport {
    /// Name and version of the bundle.
    pub bundle: String,
    /// sha256 of its manifest.
    pub bundle_sha256: String,
    /// Execution provider of the networks.
    pub execution_provider: String,
    /// What was done beyond the paper, in words.
    pub understanding: String,
    /// Photos put in.
    pub photos: usize,
    /// Means over scenes, profile `paper`, then `default`.
    pub judgements: Vec<Judgement>,
    /// The scenes.
    pub scenes: Vec<SemanticsSceneReport>,
}

impl SemanticsEvalReport {
    pub(super) fn new(
        scenes: Vec<SemanticsSceneReport>,
        photos: usize,
        engine: &Engine,
        road: &Road<'_>,
    ) -> Self {
        let over = |profile: usize, of: fn(&Judgement) -> &Scores| {
            Scores::mean(&scenes.iter().filter_map(move |s| s.judgements.get(profile)).map(of))
        };
        let judgements = super::PROFILES
            .iter()
            .enumerate()
            .map(|(at, &profile)| Judgement {
                profile,
                scene: over(at, |j| &j.scene),
                flat: over(at, |j| &j.flat),
            })
            .collect();
        let bundle = engine.bundle();
        Self {
            bundle: format!("{} {}", bundle.name(), bundle.version()),
            bundle_sha256: bundle.sha256().to_owned(),
            execution_provider: engine.geometry().provider().name().to_owned(),
            understanding: format!("{:?}", road.understanding()),
            photos,
            judgements,
            scenes,
        }
    }

    /// The heading of the table that [`SemanticsSceneReport`]s print.
    #[must_use]
    pub fn heading() -> String {
        format!(
            "{:<18} {:<8} {:<6} {:>6} {:>7} {:>7} {:>6} {:>7} {:>7}",
            "scene", "profile", "road", "mIoU", "closed", "acc", "open", "acc", "absent"
        )
    }
}

fn row(
    f: &mut fmt::Formatter<'_>,
    name: &str,
    profile: &str,
    road: &str,
    s: &Scores,
) -> fmt::Result {
    write!(
        f,
        "{name:<18} {profile:<8} {road:<6} {:>6.3} {:>7.3} {:>7.3} {:>6.3} {:>7.3} {:>7.4}",
        s.miou, s.miou_closed, s.accuracy_closed, s.miou_open, s.accuracy_open, s.absent
    )
}

/// Two lines a profile, without a line end after the last.
fn rows(f: &mut fmt::Formatter<'_>, name: &str, judgements: &[Judgement]) -> fmt::Result {
    for (at, judged) in judgements.iter().enumerate() {
        let profile = match judged.profile {
            ScoringProfile::Paper => "paper",
            ScoringProfile::Default => "default",
        };
        row(f, if at == 0 { name } else { "" }, profile, "scene", &judged.scene)?;
        writeln!(f)?;
        row(f, "", "", "flat", &judged.flat)?;
        if at + 1 < judgements.len() {
            writeln!(f)?;
        }
    }
    Ok(())
}

impl fmt::Display for SemanticsSceneReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        rows(f, &self.scene, &self.judgements)
    }
}

impl fmt::Display for SemanticsEvalReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        rows(f, "mean of scenes", &self.judgements)?;
        let targets: usize = self.scenes.iter().map(|s| s.targets.len()).sum();
        write!(
            f,
            "\n{targets} targets of {} scenes, {} photos in; bundle {} on {}; {}",
            self.scenes.len(),
            self.photos,
            self.bundle,
            self.execution_provider,
            self.understanding
        )
    }
}
