//! Reading, replacing and applying the edits of a scene.

use std::{sync::Arc, time::Duration};

use super::{
    kept::{EditList, EditedScene},
    resolve::{self, ResolvedEdits},
    spec::{EditSpec, SceneEdits},
    uncovered::uncovered,
};
use crate::{
    error::{Error, Result},
    scene::{Scene, SceneId, edited},
    service::{
        access::SceneAccess,
        offline::OfflineService,
        search::SemanticScene,
        shared::{Service, Shared},
        tags::edits_tag,
        tasks::blocking,
    },
};

impl Shared {
    /// The list of edits of a finished scene: from memory, or from the store where another replica
    /// may have put another one.
    pub(in crate::service) async fn edit_list(
        self: &Arc<Self>,
        id: &SceneId,
    ) -> Result<Arc<EditList>> {
        let fresh = Duration::from_millis(self.limits().record_fresh_ms);
        let fresh = self.store.is_shared().then_some(fresh);
        if let Some(known) = self.edits.known(id, fresh) {
            return Ok(known);
        }
        let (inner, id) = (Arc::clone(self), id.clone());
        blocking(move || inner.stored_edits(&id)).await?
    }

    fn stored_edits(&self, id: &SceneId) -> Result<Arc<EditList>> {
        let _turn = self.edits.putting.lock();
        let list = self.store.edits(id)?.map(|json| EditList::read(&json)).transpose()?;
        Ok(self.edits.learn(id, list.unwrap_or_default()))
    }

    /// A scene that is done after the edits that it has now, for nobody in particular. Blocks.
    pub(in crate::service) fn load_as_served(&self, id: &SceneId) -> Result<Arc<Scene>> {
        let list = match self.edits.known(id, None) {
            Some(known) => known,
            None => self.stored_edits(id)?,
        };
        let base = self.store.scene(id)?;
        if list.is_empty() {
            return Ok(base);
        }
        self.apply_edits(id, &list, &base).map(|edited| edited.scene)
    }

    /// The scene after its edits, where they are known in memory.
    pub(in crate::service) fn edited_in_memory(
        &self,
        access: &SceneAccess,
        base: Arc<Scene>,
    ) -> Option<Arc<Scene>> {
        if access.edits().is_empty() {
            return Some(base);
        }
        let tag = edits_tag(&base, access.edits().sha256());
        self.edits.scene(access.id(), &tag).map(|edited| edited.scene)
    }

    /// The scene after its edits. Blocks.
    pub(in crate::service) fn edited(
        &self,
        access: &SceneAccess,
        base: Arc<Scene>,
    ) -> Result<Arc<Scene>> {
        if access.edits().is_empty() {
            return Ok(base);
        }
        self.apply_edits(access.id(), access.edits(), &base).map(|edited| edited.scene)
    }

    fn apply_edits(&self, id: &SceneId, list: &EditList, base: &Arc<Scene>) -> Result<EditedScene> {
        let tag = edits_tag(base, &list.sha256);
        if let Some(known) = self.edits.scene(id, &tag) {
            return Ok(known);
        }
        let lock = Arc::clone(self.edits.applying.lock().entry(id.clone()).or_default());
        let applied = {
            let _one = lock.lock();
            match self.edits.scene(id, &tag) {
                Some(known) => Ok(known),
                None => self.apply_now(tag, list, base).inspect(|edited| {
                    let bytes = edited.scene.size_bytes();
                    self.edits.scenes.insert(id.clone(), edited.clone(), bytes);
                }),
            }
        };
        self.edits.applying.lock().remove(id);
        applied
    }

    fn apply_now(&self, tag: String, list: &EditList, base: &Arc<Scene>) -> Result<EditedScene> {
        let limits = self.limits();
        let stale = list.needs_semantics() && list.semantics_sha256 != base.semantics_sha256;
        let (gaussians, counts) = if stale {
            if base.semantics.is_none() {
                // They were lost: a text, or these edits, order them again.
                self.jobs.lose_semantics(&base.meta.id)?;
                self.jobs.understand(&base.meta.id)?;
            }
            let find = |scene: &Scene, texts: &[String]| self.jobs.find_words(scene, texts);
            let found = resolve::resolve(&self.backend, Some(&find), &limits, base, &list.specs)?;
            (found.gaussians, found.counts)
        } else {
            let found =
                edited(&list.resolved, &base.gaussians, &base.meta.cameras, limits.gaussians_max)?;
            (found.gaussians, found.counts)
        };
        let scene = Arc::new(base.after_edits(gaussians, list.sha256.clone()));
        Ok(EditedScene { tag, scene, counts: counts.into(), uncovered: Arc::default() })
    }

    /// Keeps a list that is resolved; gives it and the scene after it. Blocks.
    fn put_edits(
        &self,
        base: &Arc<Scene>,
        specs: Vec<EditSpec>,
        found: ResolvedEdits,
    ) -> Result<SceneEdits> {
        let id = &base.meta.id;
        let needs = specs.iter().any(EditSpec::needs_semantics);
        let semantics_sha256 = if needs { base.semantics_sha256.clone() } else { String::new() };
        let list =
            EditList { specs, resolved: found.edits, semantics_sha256, sha256: String::new() };
        let json = serde_json::to_string(&list)
            .map_err(|e| Error::internal("the edits cannot be written").caused_by(e))?;
        let list = {
            let _turn = self.edits.putting.lock();
            // Read back, so that what is applied now is what a start will apply.
            let list = EditList::read(&json)?;
            self.store.put_edits(id, json)?;
            self.edits.learn(id, list)
        };
        let come_to = self.come_to(&list, base);
        self.foresight.want(id);
        come_to
    }

    /// What a list comes to. Blocks.
    fn come_to(&self, list: &EditList, base: &Arc<Scene>) -> Result<SceneEdits> {
        let edits = list.specs.clone();
        if list.is_empty() {
            let gaussians = base.gaussians.len() as u64;
            return Ok(SceneEdits { edits, gaussians, ..SceneEdits::default() });
        }
        let EditedScene { scene, counts, uncovered: known, .. } =
            self.apply_edits(&base.meta.id, list, base)?;
        let (before, after) = (&base.gaussians, &scene.gaussians);
        let uncovered = *known.get_or_init(|| uncovered(&base.meta.cameras, before, after));
        let gaussians = after.len() as u64;
        Ok(SceneEdits { edits, counts: counts.to_vec(), gaussians, uncovered })
    }
}

impl OfflineService {
    /// A scene after a list of edits, as [`Service::set_edits`] makes it, and what each took.
    ///
    /// # Errors
    /// As there; `scene_not_ready` for texts and picks of a scene without semantics.
    pub fn edit(&self, scene: &Arc<Scene>, specs: &[EditSpec]) -> Result<(Scene, SceneEdits)> {
        resolve::check(specs, &self.limits)?;
        let found = resolve::resolve(&self.backend, None, &self.limits, scene, specs)?;
        let gaussians = found.gaussians.len() as u64;
        let uncovered = uncovered(&scene.meta.cameras, &scene.gaussians, &found.gaussians);
        let mut after = scene.after_edits(found.gaussians, String::new());
        after.meta.report.gaussians = gaussians;
        let edits = specs.to_vec();
        let took = SceneEdits { edits, counts: found.counts, gaussians, uncovered };
        Ok((after, took))
    }
}

impl Service {
    /// The edits of a scene, and what each took of the version that is served.
    ///
    /// # Errors
    /// As [`Service::export`].
    pub async fn edits(&self, id: &SceneId) -> Result<SceneEdits> {
        let (inner, access) = (Arc::clone(&self.inner), self.scene(id).await?.finished()?);
        blocking(move || {
            let base = inner.load_unedited(&access)?;
            inner.come_to(access.edits(), &base)
        })
        .await?
    }

    /// Puts a list of edits in place of the one before, and gives it as [`Self::edits`] does. They
    /// are applied in their order to the scene as it was made; an empty list brings it back.
    /// Texts and picks need semantics and wait for them: at most `wait`, or as long as a text
    /// would. What was acknowledged stays, whatever stops.
    ///
    /// # Errors
    /// `invalid_request`, `limit_exceeded`; else as [`Service::query`] and [`Service::pick`].
    pub async fn set_edits(
        &self,
        id: &SceneId,
        specs: Vec<EditSpec>,
        wait: Option<Duration>,
    ) -> Result<SceneEdits> {
        let inner = &self.inner;
        let access = self.scene(id).await?.unedited()?;
        let limits = self.limits();
        resolve::check(&specs, &limits)?;
        let of = if specs.iter().any(EditSpec::needs_semantics) {
            Some(inner.semantic_scene(&access, "edits", wait).await?)
        } else {
            None
        };
        let inner = Arc::clone(inner);
        blocking(move || {
            let base = match of {
                Some(SemanticScene { scene, .. }) => scene,
                None => inner.load(&access)?,
            };
            let find = |scene: &Scene, texts: &[String]| inner.jobs.find_words(scene, texts);
            let found = resolve::resolve(&inner.backend, Some(&find), &limits, &base, &specs)?;
            inner.put_edits(&base, specs, found)
        })
        .await?
    }
}
