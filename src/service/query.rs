//! Many texts for one scene: scores of the bank, parts in 3D, and with a camera one drawing of the
//! view for all of them.

use std::{collections::HashMap, sync::Arc};

use glam::DMat4;
use rayon::prelude::*;

use super::{
    Service,
    encode::{self, Layer},
    request::{
        Boxes, CameraSpec, Format, Kind, LensSpec, MaskFormat, PictureOptions, PoseSpec, QuerySpec,
    },
    search::{self, LabelledView, SceneTexts, ScoredText},
    texts,
    times::{ViewTimes, staged},
    types::{InstanceBox, Peak, QueryAnswer, TextResult, TextView},
    view::{Inputs, Resolved, resolve_one},
};
use crate::{
    error::Result,
    formats::rle::Rle,
    limits::Limits,
    render::Kinds,
    scene::SceneId,
    semantics::{Instance, InstanceOptions, Scorer},
};

/// What each set of entries selects.
type Selections = HashMap<Vec<u16>, Selection>;

/// A set of entries, what it selects, and in which parts.
struct Selection {
    gaussians: u64,
    parts: Vec<InstanceBox>,
}

/// Answers the texts; `view` is that of the camera, where one was given. Calls `drawn` when it is
/// drawn. `times` has the stages before.
pub(super) fn answer(
    texts: &SceneTexts<'_>,
    limits: &Limits,
    spec: &QuerySpec,
    view: Option<&Resolved>,
    mut times: ViewTimes,
    drawn: impl FnOnce(),
) -> Result<QueryAnswer> {
    let (mut labelled, mut render_ms) = (None, None);
    if let Some(view) = view {
        let key = view.labels_key(texts.of.tag, &texts.backend.renderer.name())?;
        let request = view.request(texts.of.scene, Kinds::NONE);
        let (found, ms) = staged("render", || texts.view(&request, key));
        let (found, new) = found?;
        times.render_ms = ms;
        render_ms = Some(if new { ms } else { 0.0 });
        // Once, before the texts need them side by side.
        let (norms, ms) = staged("score", || found.norms(&texts.scorer).map(drop));
        norms?;
        *times.score_ms.get_or_insert_default() += ms;
        labelled = Some(found);
    }
    drawn();
    let result = |text: &ScoredText, selections: &Selections| -> Result<TextResult> {
        let entries = text.selected();
        let selection = selections.get(&entries);
        let view = labelled.as_ref().map(|view| text_view(view, &texts.scorer, text, spec));
        Ok(TextResult {
            text: text.text.clone(),
            scores: text.scores.relevancies().iter().skip(1).copied().collect(),
            gaussians: selection.map_or(0, |selection| selection.gaussians),
            parts: selection.map_or_else(Vec::new, |selection| selection.parts.clone()),
            entries,
            warnings: text.warnings.clone(),
            view: view.transpose()?,
        })
    };
    let (results, ms) = staged("encode", || {
        let selections = selections(texts, limits, spec.boxes);
        texts.texts.par_iter().map(|text| result(text, &selections)).collect::<Result<_>>()
    });
    times.encode_ms = ms;
    Ok(QueryAnswer {
        bank_size: u32::try_from(texts.of.semantics.bank.len()).unwrap_or(u32::MAX),
        scoring: texts.scoring.clone(),
        camera: view.map(Resolved::camera),
        render_ms,
        results: results?,
        times,
    })
}

/// The view that a query asks for, where it has a camera.
pub(super) fn query_view<'a>(
    limits: &Limits,
    inputs: impl Into<Inputs<'a>>,
    spec: &QuerySpec,
) -> Result<Option<Resolved>> {
    let options = (&spec.options, &PictureOptions::default());
    // The options of a view that is not asked for are checked all the same.
    let any = PoseSpec::CameraToWorld(DMat4::IDENTITY.to_cols_array());
    let camera = spec.camera.unwrap_or(CameraSpec { pose: any, lens: LensSpec::default() });
    let view = resolve_one(limits, inputs, camera, Kind::Mask, options)?;
    Ok(spec.camera.map(|_| view))
}

/// What each set of entries selects; texts that select the same share it.
fn selections(texts: &SceneTexts<'_>, limits: &Limits, boxes: Boxes) -> Selections {
    let mut sets: Vec<Vec<u16>> = texts.texts.iter().map(ScoredText::selected).collect();
    sets.sort_unstable();
    sets.dedup();
    let gaussians = &texts.of.scene.gaussians;
    let mut counts = vec![0_u64; usize::from(u16::MAX) + 1];
    for m in gaussians.semantic_index() {
        counts[usize::from(*m)] += 1;
    }
    let options = InstanceOptions::default();
    let wanted = boxes != Boxes::None && sets.iter().any(|set| !set.is_empty());
    let components = wanted.then(|| texts.components(&options));
    let boxed = |instance: Instance| {
        let held = match boxes {
            Boxes::Aligned => instance.aligned(),
            Boxes::Upright => instance.upright(),
            Boxes::Oriented | Boxes::None => instance.oriented(),
        };
        InstanceBox {
            gaussians: instance.gaussians.len() as u64,
            center: held.center,
            axes: held.axes,
            size: held.size,
            centroid: instance.centroid,
            covariance: instance.covariance,
            visibility: instance.visibility,
        }
    };
    let selection = |set: Vec<u16>| {
        let parts = components.as_deref().map(|of| of.instances(gaussians, &set, &options));
        let parts = parts.into_iter().flatten().take(limits.parts_max).map(boxed).collect();
        let gaussians = set.iter().map(|m| counts[usize::from(*m)]).sum();
        (set, Selection { gaussians, parts })
    };
    sets.into_par_iter().map(selection).collect()
}

/// What a text finds in a view.
fn text_view(
    labelled: &LabelledView,
    scorer: &Scorer,
    text: &ScoredText,
    spec: &QuerySpec,
) -> Result<TextView> {
    let relevancy = labelled.relevancy(scorer, &text.scores)?;
    // A relevancy under the cut is 0, so this is the mask of the short form too.
    let mask: Vec<bool> = relevancy.iter().map(|score| *score > 0.0).collect();
    let (width, height) = (labelled.width, labelled.height);
    let png = |layer| Ok(encode::encode(layer, width, height, Format::Png)?.bytes);
    let (mut view, mut corners) = (TextView::default(), None::<[u32; 4]>);
    let mut best = 0.0_f32;
    for (y, row) in (0..height).zip(relevancy.chunks_exact(width.max(1) as usize)) {
        if row.iter().all(|score| *score == 0.0) {
            continue;
        }
        for (x, score) in (0..width).zip(row).filter(|(_, score)| **score > 0.0) {
            view.area += 1;
            let [left, top, right, bottom] = corners.unwrap_or([x, y, x, y]);
            corners = Some([left.min(x), top.min(y), right.max(x), bottom.max(y)]);
            if *score > best {
                best = *score;
                view.peak = Some(Peak { x, y, relevancy: *score });
            }
        }
    }
    view.bbox =
        corners.map(|[left, top, right, bottom]| [left, top, right - left + 1, bottom - top + 1]);
    match spec.mask {
        MaskFormat::Rle => view.mask_rle = Some(Rle::encode(&mask, width, height)),
        MaskFormat::Png => view.mask_png = Some(png(Layer::Mask(&mask))?),
        MaskFormat::None => {}
    }
    if spec.relevancy {
        view.relevancy_png = Some(png(Layer::Share(relevancy.as_slice().into()))?);
    }
    Ok(view)
}

impl Service {
    /// Answers many texts for a scene: which entries of its bank and which Gaussians they select,
    /// in which connected parts; with a camera also where in that view.
    ///
    /// The first text of a scene starts the job that makes its semantics, and waits for it.
    ///
    /// # Errors
    /// `invalid_request`, `limit_exceeded`, `scene_not_found`, `scene_not_ready` also when the
    /// semantics are not ready in time, `semantics_off`, `model_unavailable`, `overloaded`,
    /// `deadline_exceeded`, and the error of the job that makes the semantics.
    pub async fn query(&self, id: &SceneId, spec: QuerySpec) -> Result<QueryAnswer> {
        let scene = self.scene(id).await?;
        let inner = &self.inner;
        inner.can_understand("query")?;
        let texts = texts::all_checked(&spec.texts, "texts", &self.limits())?;
        search::check_scoring(&spec.scoring, &self.limits())?;
        let scene = scene.finished()?;
        let view = query_view(&self.limits(), scene.record(), &spec)?;
        let understood = inner.understood(&scene, "query", spec.wait).await?;
        let deadline = inner.deadline(&spec.options);
        let how = (spec.options.preset, &spec.scoring);
        let embed_ms = inner.embed(&understood, how, &texts, deadline).await?;
        let shared = Arc::clone(inner);
        let pixels = view.as_ref().map_or(0, Resolved::pixels);
        inner
            .scheduled(deadline, pixels, "the query", move |slot| {
                let subject = understood.subject();
                let how = (spec.options.preset, &spec.scoring);
                let scored = || SceneTexts::new(&shared.backend, subject, how, &texts);
                let (texts, ms) = staged("score", scored);
                let times = ViewTimes {
                    queue_ms: slot.queue_ms,
                    load_ms: understood.load_ms,
                    score_ms: Some(embed_ms + ms),
                    ..ViewTimes::default()
                };
                answer(&texts?, &shared.limits(), &spec, view.as_ref(), times, || slot.drawn())
            })
            .await
    }
}
