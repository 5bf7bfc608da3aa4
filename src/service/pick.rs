//! What lies under a pixel: the ray's own Gaussians, one by one, as the renderers blend them.

use std::sync::Arc;

use super::{
    Inner, Service,
    request::{Kind, PickSpec, PictureOptions},
    search::{SceneTexts, check_scoring},
    semantics::Understood,
    texts,
    types::{Label, Picked},
    view::{Inputs, Resolved, resolve_one},
};
use crate::{
    error::{Error, Result},
    limits::Limits,
    names::shown,
    render::{Kinds, oracle::contributions},
    scene::{Scene, SceneId},
};

/// The view of a pick.
pub(super) fn pick_view<'a>(
    limits: &Limits,
    inputs: impl Into<Inputs<'a>>,
    spec: &PickSpec,
) -> Result<Resolved> {
    let options = (&spec.options, &PictureOptions::default());
    resolve_one(limits, inputs, spec.camera, Kind::Alpha, options)
}

/// Depth, point and Gaussian of a pixel of a view.
pub(super) fn pick(scene: &Scene, view: &Resolved, [x, y]: [f64; 2]) -> Result<Picked> {
    let request = view.request(scene, Kinds::NONE);
    let lens = request.camera.intrinsics;
    let pixel = [(x, lens.width, "x", "wide"), (y, lens.height, "y", "high")];
    let mut whole = [0; 2];
    for (whole, (value, size, name, side)) in whole.iter_mut().zip(pixel) {
        if !(0.0..f64::from(size)).contains(&value) {
            return Err(Error::invalid(format!(
                "{name} is {}; the picture is {size} px {side}",
                shown(value)
            )));
        }
        *whole = value.floor() as u32;
    }
    let found = contributions(&scene.gaussians, &request, whole)?;
    let alpha: f64 = found.iter().map(|one| one.weight).sum();
    let mut picked = Picked { alpha: alpha as f32, ..Picked::default() };
    if alpha <= 0.0 {
        return Ok(picked);
    }
    let depth = found.iter().map(|one| one.weight * one.depth).sum::<f64>() / alpha;
    let [u, v] = whole.map(|at| f64::from(at) + 0.5);
    let point = lens.unproject(u, v, depth);
    let world = request.camera.camera_to_world.matrix().transform_point3(point);
    picked.depth = Some(depth);
    picked.point = Some(world.to_array());
    let strongest = found.iter().max_by(|a, b| a.weight.total_cmp(&b.weight));
    if let Some(one) = strongest {
        picked.gaussian = Some(one.gaussian as u64);
        let entry = scene.gaussians.semantic_index().get(one.gaussian).copied().unwrap_or(0);
        picked.entry = Some(entry).filter(|&m| m > 0 && scene.semantics.is_some());
    }
    Ok(picked)
}

impl Inner {
    fn labels(
        &self,
        understood: &Understood,
        spec: &PickSpec,
        labels: &[String],
        entry: u16,
    ) -> Result<Vec<Label>> {
        let subject = understood.subject();
        let how = (spec.options.preset, &spec.scoring);
        let texts = SceneTexts::new(&self.backend, subject, how, labels)?.texts;
        let score = |scores: &[f32]| scores.get(usize::from(entry)).copied().unwrap_or(0.0);
        let named = texts
            .into_iter()
            .map(|one| Label { relevancy: score(one.scores.relevancies()), text: one.text });
        let mut named: Vec<Label> = named.collect();
        named.sort_by(|a, b| b.relevancy.total_cmp(&a.relevancy));
        Ok(named)
    }
}

impl Service {
    /// What lies under a pixel of a view: depth, point, Gaussian, entry of the bank, and how well
    /// the given labels name it. Without labels it needs no semantics.
    ///
    /// # Errors
    /// As [`Service::query`] where labels are given, else as [`Service::render`].
    pub async fn pick(&self, id: &SceneId, spec: PickSpec) -> Result<Picked> {
        let scene = self.scene(id).await?;
        let inner = &self.inner;
        let scene = scene.finished()?;
        let view = pick_view(&self.limits(), scene.record(), &spec)?;
        let (labels, understood) = if spec.labels.is_empty() {
            (Vec::new(), None)
        } else {
            inner.can_understand("labels")?;
            check_scoring(&spec.scoring, &self.limits())?;
            let labels = texts::all_checked(&spec.labels, "labels", &self.limits())?;
            (labels, Some(inner.understood(&scene, "labels", spec.wait).await?))
        };
        let deadline = inner.deadline(&spec.options);
        if let Some(understood) = &understood {
            let how = (spec.options.preset, &spec.scoring);
            inner.embed(understood, how, &labels, deadline).await?;
        }
        let shared = Arc::clone(inner);
        inner
            .scheduled(deadline, 1, "the pick", move |_slot| {
                let scene = match &understood {
                    Some(understood) => Arc::clone(&understood.scene),
                    None => shared.load(&scene)?,
                };
                let mut picked = pick(&scene, &view, [spec.x, spec.y])?;
                if let (Some(understood), Some(entry)) = (&understood, picked.entry) {
                    picked.labels = shared.labels(understood, &spec, &labels, entry)?;
                }
                Ok(picked)
            })
            .await
    }
}
