//! The same answers for a scene that lies in a file, without a server.

use std::{io::Write, sync::Arc};

use super::{
    features, pick, query,
    request::{FeaturesSpec, PickSpec, QuerySpec, ViewSpec},
    search::{Backend, SceneTexts, Subject, check_scoring},
    texts,
    times::ViewTimes,
    types::{Picked, QueryAnswer, RenderedView},
    view::resolve_one,
};
use crate::{
    error::{Error, ErrorCode, Result},
    jobs::SemanticNetworks,
    limits::Limits,
    render::Renderer,
    scene::{Gaussians, Scene},
};

/// The use cases of [`super::Service`] for scenes that lie in files: no store, jobs or owners.
pub struct OfflineService {
    pub(super) backend: Backend,
    pub(super) limits: Limits,
}

impl std::fmt::Debug for OfflineService {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "OfflineService({})", self.backend.renderer.name())
    }
}

impl OfflineService {
    /// A service with these networks, this renderer and these limits.
    pub fn new(
        semantics: Arc<dyn SemanticNetworks>,
        renderer: Arc<dyn Renderer>,
        limits: Limits,
    ) -> Self {
        Self { backend: Backend::new(renderer, semantics, &limits), limits }
    }

    pub(super) fn subject<'a>(&self, scene: &'a Scene, what: &str) -> Result<Subject<'a>> {
        if let Some(lack) = self.backend.lacks() {
            let message = format!("{what}: the bundle has {lack}");
            return Err(Error::new(ErrorCode::ModelUnavailable, message));
        }
        let semantics = scene.semantics.as_deref().ok_or_else(|| {
            let message = format!(
                "{what}: the scene file has no semantics beside it; make it with --semantics eager"
            );
            Error::new(ErrorCode::SemanticsOff, message)
        })?;
        Ok(Subject { scene, semantics, tag: scene.meta.id.as_str() })
    }

    /// As [`super::Service::render`].
    ///
    /// # Errors
    /// As there; `semantics_off` where the scene has no semantics.
    pub fn render(&self, scene: &Scene, spec: &ViewSpec) -> Result<RenderedView> {
        let ask = texts::check_ask(&[spec.kind], &spec.text, &self.limits)?;
        let options = (&spec.options, &spec.picture);
        let view = resolve_one(&self.limits, scene, spec.camera, spec.kind, options)?;
        let texts = if spec.kind.needs_semantics() {
            let subject = self.subject(scene, &format!("kind={}", spec.kind))?;
            let text = ask.text.as_slice();
            let how = (spec.options.preset, &ask.scoring);
            Some(SceneTexts::new(&self.backend, subject, how, text)?)
        } else {
            None
        };
        let tag = scene.meta.id.as_str();
        let mut views =
            view.draw(&self.backend, scene, tag, texts.as_ref(), ViewTimes::default(), || ())?;
        views.pop().ok_or_else(|| Error::internal("a render gave no picture"))
    }

    /// As [`super::Service::query`].
    ///
    /// # Errors
    /// As there; `semantics_off` where the scene has no semantics.
    pub fn query(&self, scene: &Scene, spec: &QuerySpec) -> Result<QueryAnswer> {
        let texts = texts::all_checked(&spec.texts, "texts", &self.limits)?;
        let view = query::query_view(&self.limits, scene, spec)?;
        let subject = self.subject(scene, "query")?;
        check_scoring(&spec.scoring, &self.limits)?;
        let how = (spec.options.preset, &spec.scoring);
        let texts = SceneTexts::new(&self.backend, subject, how, &texts)?;
        query::answer(&texts, &self.limits, spec, view.as_ref(), ViewTimes::default(), || ())
    }

    /// As [`super::Service::pick`], without labels.
    ///
    /// # Errors
    /// As there.
    pub fn pick(&self, scene: &Scene, spec: &PickSpec) -> Result<Picked> {
        let view = pick::pick_view(&self.limits, scene, spec)?;
        pick::pick(scene, &view, [spec.x, spec.y])
    }

    /// As [`super::Service::export`] of the semantics, and as [`super::Service::features`] where
    /// there is a view: an npz file, written to `to`.
    ///
    /// # Errors
    /// As there; `semantics_off` where the scene has no semantics.
    pub fn arrays(
        &self,
        scene: &Scene,
        spec: Option<&FeaturesSpec>,
        to: &mut dyn Write,
    ) -> Result<()> {
        let subject = self.subject(scene, "arrays")?;
        let Some(spec) = spec else { return features::write_semantics(subject, to) };
        let view = features::features_view(&self.limits, scene, spec)?;
        let how = (spec.options.preset, &spec.scoring);
        let texts = SceneTexts::new(&self.backend, subject, how, &[])?;
        let weights = features::drawn(&texts, &view)?;
        features::check_size(&texts, &weights, spec.kind, &self.limits)?;
        features::write(&texts, &weights, spec.kind, to)
    }

    /// The Gaussians that a text selects, scored as `spec` says.
    ///
    /// # Errors
    /// As [`Self::query`].
    pub fn select(&self, scene: &Scene, text: &str, spec: &QuerySpec) -> Result<Gaussians> {
        let text = texts::checked(text, "text", &self.limits)?;
        let subject = self.subject(scene, "text")?;
        let how = (spec.options.preset, &spec.scoring);
        Ok(SceneTexts::new(&self.backend, subject, how, &[text])?.gaussians())
    }
}
