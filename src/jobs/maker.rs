//! The product's own way of making a scene and its meaning: the pipeline, with its stages as one
//! fraction.

use std::sync::Arc;

use crate::{
    error::Result,
    jobs::{
        EmbeddedText, Made, Networks, Phrases, SceneMaker, SemanticsMaker, SemanticsWork, Work,
    },
    limits::Limits,
    pipeline::{
        self, LateEngine, Stage,
        semantics::{SemanticsOptions, SemanticsStage, Watch, understand_upload},
    },
    scene::{Semantics, Upload},
};

/// Makes scenes with an [`Engine`](pipeline::Engine).
#[derive(Debug)]
pub struct PipelineMaker {
    engine: Arc<LateEngine>,
    limits: Limits,
}

impl PipelineMaker {
    /// A maker that reads photos under these limits.
    #[must_use]
    pub fn new(engine: Arc<LateEngine>, limits: Limits) -> Self {
        Self { engine, limits }
    }
}

impl SceneMaker for PipelineMaker {
    fn identity(&self) -> String {
        self.engine.bundle().sha256().to_owned()
    }

    fn networks(&self) -> Networks {
        match self.engine.peek() {
            None => Networks::Opening,
            Some(Ok(engine)) => Networks::Open(engine.geometry().provider().name()),
            Some(Err(_)) => Networks::Broken,
        }
    }

    fn check(&self, upload: &Upload, limits: &Limits) -> Result<()> {
        pipeline::check(upload, limits)
    }

    fn make(&self, work: Work<'_>) -> Result<Made> {
        let progress = |stage: Stage, fraction: f32| {
            let [from, to] = share_of(stage);
            (work.progress)(stage.name(), from + (to - from) * fraction);
        };
        let made = pipeline::make(
            self.engine.get()?,
            work.upload,
            &self.limits,
            work.options,
            &progress,
            work.cancel,
        )?;
        Ok(Made {
            gaussians: made.gaussians,
            backdrop: made.backdrop,
            report: made.report,
            cameras: made.cameras,
            bundle_sha256: self.engine.bundle().sha256().to_owned(),
        })
    }
}

/// Where a stage begins and ends in the whole, 0..1; most of the time goes to the network.
fn share_of(stage: Stage) -> [f32; 2] {
    match stage {
        Stage::Photos => [0.0, 0.1],
        Stage::Capture => [0.1, 0.2],
        Stage::Geometry => [0.2, 0.9],
        Stage::Lift => [0.9, 0.97],
        Stage::Store => [0.97, 1.0],
    }
}

/// Makes what scenes mean with an [`Engine`](pipeline::Engine), whose networks for that are opened
/// at the first use.
#[derive(Debug)]
pub struct PipelineSemantics {
    engine: Arc<LateEngine>,
    limits: Limits,
}

impl PipelineSemantics {
    /// A maker that reads photos under these limits.
    #[must_use]
    pub fn new(engine: Arc<LateEngine>, limits: Limits) -> Self {
        Self { engine, limits }
    }
}

impl SemanticsMaker for PipelineSemantics {
    fn lacks(&self) -> Option<String> {
        self.engine.bundle().lacks_semantics().map(str::to_owned)
    }

    fn phrases(&self) -> Result<Phrases> {
        let towers = self.engine.get()?.image_text()?;
        let manifest = towers.manifest();
        Ok(Phrases {
            canon: manifest.canon.clone(),
            tau: manifest.tau,
            coverage_floor: manifest.coverage_floor,
        })
    }

    fn embed_texts(&self, texts: &[String]) -> Result<Vec<EmbeddedText>> {
        let embedded = self.engine.get()?.image_text()?.embed_texts(texts)?;
        let texts = embedded.into_iter().map(|text| EmbeddedText {
            row: text.row,
            tokens: text.tokens,
            unknown: text.unknown,
            cut: text.cut,
        });
        Ok(texts.collect())
    }

    fn make(&self, work: SemanticsWork<'_>) -> Result<Semantics> {
        let progress = |stage: SemanticsStage, fraction: f32| {
            let [from, to] = stage.share();
            (work.progress)(stage.name(), from + (to - from) * fraction);
        };
        let watch = Watch { progress: &progress, cancel: work.cancel };
        let options = SemanticsOptions::default();
        let engine = self.engine.get()?;
        understand_upload(engine, work.upload, &self.limits, work.scene, &options, watch)
    }
}
