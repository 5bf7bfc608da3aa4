//! The same answers for a scene that lies in a file, without a server.

use std::{io::Write, sync::Arc};

use super::{
    features, pick, query,
    request::{FeaturesSpec, PickSpec, PictureKind, QuerySpec, ScoringOptions, ViewSpec},
    search::{Backend, SceneTexts, ScoringChoice, SemanticScene},
    texts,
    times::ViewTimes,
    types::{KnownWord, Picked, QueryAnswer, RenderedView},
    view::resolve_one,
    work::Work,
};
use crate::{
    error::{Error, ErrorCode, Result},
    jobs::SemanticNetworks,
    limits::Limits,
    render::Renderer,
    scene::{Gaussians, Preset, Scene},
};

/// The use cases of [`super::Service`] for scenes that lie in files: no store, jobs or owners.
pub struct OfflineService {
    pub(super) backend: Arc<Backend>,
    pub(super) limits: Limits,
}

impl std::fmt::Debug for OfflineService {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "OfflineService({})", self.backend.renderer.name())
    }
}

impl OfflineService {
    /// A service with these networks, this renderer, what was measured of words, and these limits.
    pub fn new(
        semantics: Arc<dyn SemanticNetworks>,
        renderer: Arc<dyn Renderer>,
        words: &[KnownWord],
        limits: Limits,
    ) -> Self {
        Self { backend: Arc::new(Backend::new(renderer, semantics, words, &limits)), limits }
    }

    /// What draws the views.
    pub fn renderer(&self) -> &Arc<dyn Renderer> {
        &self.backend.renderer
    }

    /// Scores checked texts for a scene; `what` asks for it.
    pub(super) fn score(
        &self,
        scene: &Arc<Scene>,
        what: &str,
        preset: Option<Preset>,
        changes: &ScoringOptions,
        texts: &[String],
    ) -> Result<SceneTexts> {
        let how = ScoringChoice { preset, changes: changes.clone() };
        SceneTexts::new(&self.backend, self.semantic_scene(scene, what)?, &how, texts, None)
    }

    fn semantic_scene(&self, scene: &Arc<Scene>, what: &str) -> Result<SemanticScene> {
        if let Some(lack) = self.backend.lacks() {
            let message = format!("{what}: the bundle has {lack}");
            return Err(Error::new(ErrorCode::ModelUnavailable, message));
        }
        SemanticScene::new(Arc::clone(scene)).ok_or_else(|| {
            let message = format!(
                "{what}: the scene file has no semantics beside it; make it with --semantics eager"
            );
            Error::new(ErrorCode::SemanticsOff, message)
        })
    }

    /// As [`super::Service::render`].
    ///
    /// # Errors
    /// As there; `semantics_off` where the scene has no semantics.
    pub fn render(&self, scene: &Arc<Scene>, spec: &ViewSpec) -> Result<RenderedView> {
        if spec.kind == PictureKind::Holes {
            let why = "kind=holes: a scene file has no edits; ask the server that keeps the scene";
            return Err(Error::invalid(why));
        }
        let ask = texts::check_ask(&[spec.kind], &spec.text, &self.limits)?;
        let view = resolve_one(&self.limits, &**scene, spec)?;
        let texts = if spec.kind.needs_semantics() {
            let (what, preset) = (format!("kind={}", spec.kind), spec.options.preset);
            Some(self.score(scene, &what, preset, &ask.scoring, ask.text.as_slice())?)
        } else {
            None
        };
        let times = texts.as_ref().map_or_else(ViewTimes::default, SceneTexts::times);
        let work = &mut Work::default();
        let mut views = view.draw(&self.backend, [scene, scene], texts.as_ref(), times, work)?;
        views.pop().ok_or_else(|| Error::internal("a render gave no picture"))
    }

    /// As [`super::Service::query`].
    ///
    /// # Errors
    /// As there; `semantics_off` where the scene has no semantics.
    pub fn query(&self, scene: &Arc<Scene>, spec: &QuerySpec) -> Result<QueryAnswer> {
        let texts = texts::all_checked(&spec.texts, "texts", &self.limits)?;
        let view = query::query_view(&self.limits, &**scene, spec)?;
        texts::check_scoring(&spec.scoring, &self.limits)?;
        let texts = self.score(scene, "query", spec.options.preset, &spec.scoring, &texts)?;
        query::answer(&texts, &self.limits, spec, view.as_ref(), &mut Work::default())
    }

    /// As [`super::Service::pick`], without labels.
    ///
    /// # Errors
    /// As there.
    pub fn pick(&self, scene: &Scene, spec: &PickSpec) -> Result<Picked> {
        let view = pick::pick_view(&self.limits, scene, spec)?;
        pick::pick(Some(&*self.backend.renderer), scene, &view, [spec.x, spec.y])
    }

    /// As [`super::Service::export`] of the semantics, and as [`super::Service::features`] where
    /// there is a view: an npz file, written to `to`.
    ///
    /// # Errors
    /// As there; `semantics_off` where the scene has no semantics.
    pub fn arrays(
        &self,
        scene: &Arc<Scene>,
        spec: Option<&FeaturesSpec>,
        to: &mut dyn Write,
    ) -> Result<()> {
        let Some(spec) = spec else {
            return features::write_semantics(&self.semantic_scene(scene, "arrays")?.semantics, to);
        };
        let view = features::features_view(&self.limits, &**scene, spec)?;
        let texts = self.score(scene, "arrays", spec.options.preset, &spec.scoring, &[])?;
        let (weights, _new) = view.weights(&texts)?;
        features::check_size(&texts, &weights, spec.kind, &self.limits)?;
        features::write(&texts, &weights, spec.kind, to)
    }

    /// The Gaussians that a text selects, scored as `spec` says.
    ///
    /// # Errors
    /// As [`Self::query`].
    pub fn select(&self, scene: &Arc<Scene>, text: &str, spec: &QuerySpec) -> Result<Gaussians> {
        let text = texts::checked(text, "text", &self.limits)?;
        let preset = spec.options.preset;
        Ok(self.score(scene, "text", preset, &spec.scoring, &[text])?.gaussians())
    }
}
