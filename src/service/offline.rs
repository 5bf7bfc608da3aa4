//! The same answers for a scene that lies in a file, without a server.

use std::sync::Arc;

use super::{
    pick, query,
    request::{PickSpec, QuerySpec, ViewSpec},
    search::{Backend, SceneTexts, Subject},
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
    scene::{Gaussians, Scene, ScoringProfile},
};

/// The use cases of [`super::Service`] for scenes that lie in files: no store, jobs or owners.
pub struct OfflineService {
    backend: Backend,
    limits: Limits,
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

    fn subject<'a>(&self, scene: &'a Scene, what: &str) -> Result<Subject<'a>> {
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
            Some(SceneTexts::new(&self.backend, subject, ask.profile, text)?)
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
        let texts = SceneTexts::new(&self.backend, subject, spec.profile, &texts)?;
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

    /// The Gaussians that a text selects.
    ///
    /// # Errors
    /// As [`Self::query`].
    pub fn select(&self, scene: &Scene, text: &str, profile: ScoringProfile) -> Result<Gaussians> {
        let text = texts::checked(text, "text", &self.limits)?;
        let subject = self.subject(scene, "text")?;
        Ok(SceneTexts::new(&self.backend, subject, profile, &[text])?.gaussians())
    }
}
