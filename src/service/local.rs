//! The same answers for a scene that lies in a file, without a server.

use std::sync::Arc;

use super::{
    asker::Asker,
    pick,
    query::{Ground, gaussians_of, selected},
    texts,
    types::{Kind, PickSpec, Picked, QueryAnswer, QuerySpec, RenderedView, ViewSpec},
    view::{Told, resolve_one},
};
use crate::{
    error::{Error, ErrorCode, Result},
    jobs::SemanticsMaker,
    limits::Limits,
    render::Renderer,
    scene::{Gaussians, Scene, ScoringProfile, Semantics},
};

/// A renderer, networks and one scene at a time.
pub struct Local {
    asker: Asker,
    renderer: Arc<dyn Renderer>,
    limits: Limits,
}

impl std::fmt::Debug for Local {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Local").field("renderer", &self.renderer.name()).finish_non_exhaustive()
    }
}

impl Local {
    /// Answers with these.
    #[must_use]
    pub fn new(
        semantics: Arc<dyn SemanticsMaker>,
        renderer: Arc<dyn Renderer>,
        limits: Limits,
    ) -> Self {
        Self { asker: Asker::new(semantics, &limits), renderer, limits }
    }

    fn semantics<'a>(&self, scene: &'a Scene, what: &str) -> Result<&'a Semantics> {
        if let Some(lack) = self.asker.lacks() {
            let message = format!("{what}: the bundle has {lack}");
            return Err(Error::new(ErrorCode::ModelUnavailable, message));
        }
        scene.semantics.as_deref().ok_or_else(|| {
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
    pub fn render(&self, scene: &Scene, spec: &ViewSpec) -> Result<RenderedView> {
        let ask = texts::check_ask(&[spec.kind], &spec.ask, &self.limits)?;
        let view = resolve_one(scene, spec.camera, spec.kind, &spec.options, &self.limits)?;
        let told = if spec.kind.needs_semantics() {
            let semantics = self.semantics(scene, &format!("kind={}", spec.kind.name()))?;
            Some(Told::new(&self.asker, semantics, scene.meta.id.to_string(), &ask)?)
        } else {
            None
        };
        view.draw_one(&*self.renderer, scene, told.as_ref())
    }

    /// As [`super::Service::query`].
    ///
    /// # Errors
    /// As there; `semantics_off` where the scene has no semantics.
    pub fn query(&self, scene: &Scene, spec: &QuerySpec) -> Result<QueryAnswer> {
        let texts = texts::all_checked(&spec.texts, "texts", &self.limits)?;
        let view = spec
            .camera
            .map(|camera| resolve_one(scene, camera, Kind::Mask, &spec.options, &self.limits));
        let view = view.transpose()?;
        let ground = Ground {
            asker: &self.asker,
            renderer: &*self.renderer,
            limits: &self.limits,
            scene,
            semantics: self.semantics(scene, "query")?,
            tag: scene.meta.id.as_str(),
        };
        ground.answer(&texts, spec, view.as_ref(), || ())
    }

    /// As [`super::Service::pick`], without labels.
    ///
    /// # Errors
    /// As there.
    pub fn pick(&self, scene: &Scene, spec: &PickSpec) -> Result<Picked> {
        let view = resolve_one(scene, spec.camera, Kind::Alpha, &spec.options, &self.limits)?;
        pick::pick(scene, &view, spec.x, spec.y)
    }

    /// The Gaussians that a text selects.
    ///
    /// # Errors
    /// As [`Self::query`].
    pub fn select(&self, scene: &Scene, text: &str, profile: ScoringProfile) -> Result<Gaussians> {
        let text = texts::checked(text, "text", &self.limits)?;
        let semantics = self.semantics(scene, "text")?;
        select(&self.asker, scene, semantics, scene.meta.id.as_str(), text, profile)
    }
}

/// The Gaussians that a checked text selects.
pub(super) fn select(
    asker: &Asker,
    scene: &Scene,
    semantics: &Semantics,
    tag: &str,
    text: String,
    profile: ScoringProfile,
) -> Result<Gaussians> {
    let scorer = asker.scorer(tag, semantics, profile)?;
    let asked = asker.ask(&scorer, &[text])?;
    let mut keep = vec![false; scene.gaussians.len()];
    for one in &asked {
        for i in gaussians_of(scene, &selected(one)) {
            keep[i as usize] = true;
        }
    }
    Ok(scene.gaussians.only(|i| keep[i]))
}
