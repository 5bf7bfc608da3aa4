//! What lies under a pixel: the ray's own Gaussians, one by one, as the renderers blend them, and
//! the place of their surface. A place that is the ground's, as far as depth is known, is on it:
//! thousands of Gaussians tell where that is.

use std::sync::Arc;

use super::{
    request::{PickSpec, PictureKind, ViewSpec},
    schedule::Demand,
    search::{SceneTexts, ScoredText, ScoringChoice},
    shared::Service,
    texts,
    types::{Label, Picked},
    view::{Inputs, Resolved, resolve_one},
    work::Work,
};
use crate::{
    error::{Error, Result},
    limits::Limits,
    names::shown,
    render::{Kinds, Renderer, oracle::contributions, surface},
    scene::{Scene, SceneId},
};

/// How far from the ground, as a share of the depth, a surface may be that is the ground's, at the
/// median depth of the scene and beyond. What is nearer is known the better.
const UNSURE: f64 = 0.03;

/// The view of a pick.
pub(super) fn pick_view<'a>(
    limits: &Limits,
    inputs: impl Into<Inputs<'a>>,
    spec: &PickSpec,
) -> Result<Resolved> {
    resolve_one(
        limits,
        inputs,
        &ViewSpec::new(spec.camera, PictureKind::Alpha, spec.options.clone()),
    )
}

/// The depth of a surface where a ray meets the ground at another one.
fn grounded(depth: f64, ground: f64, median: f64) -> f64 {
    let unsure = UNSURE * (ground / median).min(1.0);
    if (depth / ground - 1.0).abs() <= unsure { ground } else { depth }
}

/// Depth, point and Gaussian of a pixel of a view. The renderer knows which Gaussians are near; for
/// one pick of a scene that is not drawn all are asked.
pub(super) fn pick(
    renderer: Option<&dyn Renderer>,
    scene: &Scene,
    view: &Resolved,
    [x, y]: [f64; 2],
) -> Result<Picked> {
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
    let at = whole.map(|at| f64::from(at) + 0.5);
    let near = match renderer {
        Some(renderer) => renderer.near(&scene.gaussians, &request, at, surface::reach(&lens))?,
        None => None,
    };
    let found = contributions(&scene.gaussians, &request, whole, near.as_deref())?;
    let alpha: f64 = found.iter().map(|one| one.weight).sum();
    let mut picked = Picked { alpha: alpha as f32, ..Picked::default() };
    if alpha <= 0.0 {
        return Ok(picked);
    }
    let blended = found.iter().map(|one| one.weight * one.depth).sum::<f64>() / alpha;
    let depth = surface::depth(&scene.gaussians, &request, at.into(), blended, near.as_deref())?;
    let [u, v] = at;
    let mut depth = depth.unwrap_or(blended);
    let pose = request.camera.camera_to_world;
    let way = pose.rotation() * lens.unproject(u, v, 1.0);
    if let Some(ground) = scene.ground().and_then(|ground| ground.along(pose.center(), way)) {
        depth = grounded(depth, ground, scene.meta.report.median_depth);
    }
    picked.depth = Some(depth);
    picked.point = Some((pose.center() + way * depth).to_array());
    let strongest = found.iter().max_by(|a, b| a.weight.total_cmp(&b.weight));
    if let Some(one) = strongest {
        picked.gaussian = Some(one.gaussian as u64);
        let entry = scene.gaussians.semantic_index().get(one.gaussian).copied().unwrap_or(0);
        picked.entry = Some(entry).filter(|&m| m > 0 && scene.semantics.is_some());
    }
    Ok(picked)
}

/// How well each text names an entry of the bank, the best first.
fn labels_of(texts: &SceneTexts, entry: u16) -> Vec<Label> {
    let label = |text: &ScoredText| {
        let relevancy = text.scores.relevancies().get(usize::from(entry)).copied();
        Label { relevancy: relevancy.unwrap_or(0.0), text: text.text.clone() }
    };
    let mut labels: Vec<Label> = texts.texts.iter().map(label).collect();
    labels.sort_by(|a, b| b.relevancy.total_cmp(&a.relevancy));
    labels
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
        let (of, labels) = if spec.labels.is_empty() {
            (None, Vec::new())
        } else {
            inner.can_understand("labels")?;
            texts::check_scoring(&spec.scoring, &self.limits())?;
            let labels = texts::all_checked(&spec.labels, "labels", &self.limits())?;
            (Some(inner.semantic_scene(&scene, "labels", spec.wait).await?), labels)
        };
        let deadline = inner.deadline(&spec.options);
        let how = ScoringChoice { preset: spec.options.preset, changes: spec.scoring };
        let texts = match of {
            Some(of) => Some(inner.score_bank(of, how, labels, deadline).await?),
            None => None,
        };
        let (shared, pixel) = (Arc::clone(inner), [spec.x, spec.y]);
        let pick = move |_: &mut Work| {
            let scene = match &texts {
                Some(texts) => Arc::clone(&texts.of.scene),
                None => shared.load(&scene)?,
            };
            let renderer = &*shared.backend.renderer;
            let mut picked = pick(Some(renderer), &scene, &view, pixel)?;
            if let (Some(texts), Some(entry)) = (&texts, picked.entry) {
                picked.labels = labels_of(texts, entry);
            }
            Ok(picked)
        };
        inner.scheduled(Demand::view(&self.caller, 1), deadline, "the pick", pick).await
    }
}

#[cfg(test)]
mod tests {
    use super::grounded;

    #[test]
    fn what_is_the_grounds_as_far_as_depth_is_known_is_on_it() {
        assert_eq!(grounded(3.9, 4.0, 4.0), 4.0, "2.5 % at the median depth");
        assert_eq!(grounded(7.8, 8.0, 4.0), 8.0, "no more is forgiven beyond it");
        assert_eq!(grounded(7.7, 8.0, 4.0), 7.7, "3.75 %");
        assert_eq!(grounded(0.975, 1.0, 4.0), 0.975, "near, a thing that lies on it");
        assert_eq!(grounded(0.995, 1.0, 4.0), 1.0);
    }
}
