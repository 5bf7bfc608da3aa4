//! Many texts for one scene: scores of the bank, parts in 3D, and with a camera one drawing of the
//! view for all of them.

use std::collections::HashMap;

use glam::DMat4;
use rayon::prelude::*;

use super::{
    encode::{self, Layer},
    request::{
        Boxes, CameraSpec, Format, LensSpec, MaskFormat, PictureKind, PoseSpec, QuerySpec, ViewSpec,
    },
    schedule::Demand,
    search::{LabelledView, SceneTexts, ScoredText, ScoringChoice},
    shared::Service,
    texts,
    times::{ViewTimes, staged},
    types::{InstanceBox, Peak, QueryAnswer, TextResult, TextView},
    view::{Inputs, Resolved, resolve_one},
    work::Work,
};
use crate::{
    error::Result,
    formats::rle::Rle,
    limits::Limits,
    scene::SceneId,
    semantics::{Box3, Instance, InstanceOptions, Scorer},
};

/// What each set of entries selects.
type Selections = HashMap<Vec<u16>, Selection>;

/// A set of entries, what it selects, and in which parts.
struct Selection {
    gaussians: u64,
    parts: Vec<(Instance, Box3)>,
}

impl Selection {
    /// The parts as a text finds them, the best first.
    fn scored(&self, text: &ScoredText) -> Vec<InstanceBox> {
        let part = |(of, held): &(Instance, Box3)| InstanceBox {
            gaussians: of.gaussians.len() as u64,
            score: of.score(text.scores.relevancies()),
            center: held.center,
            axes: held.axes,
            size: held.size,
            centroid: of.centroid,
            covariance: of.covariance,
            visibility: of.visibility.clone(),
        };
        let mut parts: Vec<InstanceBox> = self.parts.iter().map(part).collect();
        // Of one score the largest stays first.
        parts.sort_by(|a, b| b.score.total_cmp(&a.score));
        parts
    }
}

/// Answers the texts; `view` is that of the camera, where one was given.
pub(super) fn answer(
    texts: &SceneTexts,
    limits: &Limits,
    spec: &QuerySpec,
    view: Option<&Resolved>,
    work: &mut Work,
) -> Result<QueryAnswer> {
    let mut times = ViewTimes { queue_ms: work.queue_ms, ..texts.times() };
    let (mut labelled, mut render_ms) = (None, None);
    if let Some(view) = view {
        let (found, ms) = staged("render", || view.weights(texts));
        let (found, new) = found?;
        times.render_ms = ms;
        render_ms = Some(if new { ms } else { 0.0 });
        // Once, before the texts need them side by side.
        let (norms, ms) = staged("score", || found.norms(&texts.scorer).map(drop));
        norms?;
        *times.score_ms.get_or_insert_default() += ms;
        labelled = Some(found);
    }
    work.leave_renderer();
    let work = &*work;
    let result = |text: &ScoredText, selections: &Selections| -> Result<TextResult> {
        work.unless_stopped()?;
        let entries = text.selected();
        let selection = selections.get(&entries);
        let view = labelled.as_ref().map(|view| text_view(view, &texts.scorer, text, spec));
        Ok(TextResult {
            text: text.text.clone(),
            scores: text.scores.relevancies().iter().skip(1).copied().collect(),
            found: selection.is_some_and(|selection| selection.gaussians > 0),
            gaussians: selection.map_or(0, |selection| selection.gaussians),
            parts: selection.map_or_else(Vec::new, |selection| selection.scored(text)),
            word: text.known.as_ref().map(|known| known.word.clone()),
            trust: text.known.as_ref().map(|known| known.trust),
            entries,
            warnings: text.warnings.clone(),
            view: view.transpose()?,
        })
    };
    let (results, ms) = staged("encode", || {
        work.unless_stopped()?;
        let selections = selections(texts, limits, spec.boxes, work)?;
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
    // The options of a view that is not asked for are checked all the same.
    let any = PoseSpec::CameraToWorld(DMat4::IDENTITY.to_cols_array());
    let camera = spec.camera.unwrap_or(CameraSpec { pose: any, lens: LensSpec::default() });
    let of = ViewSpec::new(camera, PictureKind::Mask, spec.options.clone());
    let view = resolve_one(limits, inputs, &of)?;
    Ok(spec.camera.map(|_| view))
}

/// What each set of entries selects; texts that select the same share it.
fn selections(
    texts: &SceneTexts,
    limits: &Limits,
    boxes: Boxes,
    work: &Work,
) -> Result<Selections> {
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
            Boxes::Oriented => instance.oriented(),
            Boxes::Upright | Boxes::None => instance.upright(),
        };
        (instance, held)
    };
    let selection = |set: Vec<u16>| {
        work.unless_stopped()?;
        let parts = components.as_deref().map(|of| of.instances(gaussians, &set, &options));
        let parts = parts.into_iter().flatten().take(limits.parts_max).map(boxed).collect();
        let gaussians = set.iter().map(|m| counts[usize::from(*m)]).sum();
        Ok((set, Selection { gaussians, parts }))
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
        texts::check_scoring(&spec.scoring, &self.limits())?;
        let scene = scene.finished()?;
        let view = query_view(&self.limits(), scene.record(), &spec)?;
        let of = inner.semantic_scene(&scene, "query", spec.wait).await?;
        let deadline = inner.deadline(&spec.options);
        let how = ScoringChoice { preset: spec.options.preset, changes: spec.scoring.clone() };
        let texts = inner.score(of, how, texts, deadline).await?;
        let pixels = view.as_ref().map_or(0, Resolved::pixels);
        let gaussians = texts.of.scene.gaussians.len();
        let demand = Demand::view(&self.caller, pixels).with_texts(texts.texts.len(), gaussians);
        let limits = self.limits();
        let answer = move |work: &mut Work| answer(&texts, &limits, &spec, view.as_ref(), work);
        inner.scheduled(demand, deadline, "the query", answer).await
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::{
        error::ErrorCode,
        jobs::{NoSemantics, Phrases, SemanticNetworks},
        render::{Frame, PixelWeights, RenderRequest, Renderer},
        scene::{
            Backdrop, Bank, Gaussians, HealthReport, Method, PosedPhoto, Provenance, RawGaussians,
            Scene, SceneMeta, Semantics, SourcePixel, TextEmbedding, Watch,
        },
        service::search::{Backend, SemanticScene},
    };

    /// Draws views without any weight, and knows every text.
    struct Blank;

    impl Renderer for Blank {
        fn name(&self) -> String {
            "blank".to_owned()
        }

        fn concurrency(&self) -> usize {
            1
        }

        fn render(&self, _: &Gaussians, request: &RenderRequest) -> Result<Frame> {
            let (width, height) =
                (request.camera.intrinsics.width, request.camera.intrinsics.height);
            let weights = Some(PixelWeights::none((width * height) as usize));
            Ok(Frame { width, height, weights, ..Frame::default() })
        }
    }

    impl SemanticNetworks for Blank {
        fn lacks(&self) -> Option<String> {
            None
        }

        fn phrases(&self) -> Result<Phrases> {
            let canon = vec!["thing".to_owned()];
            Ok(Phrases { canon, tau: 10.0, coverage_floor: 0.0, margin: 0.0, rivals: 1.0 })
        }

        fn embed_texts(&self, texts: &[String]) -> Result<Vec<TextEmbedding>> {
            let of = |text: &String| TextEmbedding {
                row: if text == "thing" { vec![0.0, 1.0] } else { vec![1.0, 0.0] },
                ..TextEmbedding::default()
            };
            Ok(texts.iter().map(of).collect())
        }

        fn make(
            &self,
            photos: &[PosedPhoto],
            method: &Method,
            scene: &dyn Fn() -> Result<Arc<Scene>>,
            watch: Watch<'_>,
        ) -> Result<Semantics> {
            NoSemantics.make(photos, method, scene, watch)
        }
    }

    /// Gaussians side by side, so many of each entry in a place of its own, as a scene with this
    /// bank.
    fn rows_of(bank: Bank, counts: &[usize]) -> Arc<Scene> {
        let at = |entry: usize, i: usize| [10.0 * entry as f32, 0.1 * i as f32, 2.0];
        let of_entry = |(entry, &count): (usize, &usize)| (0..count).map(move |i| (entry, i));
        let all: Vec<(usize, usize)> = counts.iter().enumerate().flat_map(of_entry).collect();
        let count = all.len();
        let raw = RawGaussians {
            means: all.iter().map(|&(entry, i)| at(entry, i)).collect(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; count],
            scales: vec![[0.1; 3]; count],
            opacities: vec![0.9; count],
            sh: vec![[0.0; 3]; count],
            semantic_index: vec![0; count],
            source: vec![SourcePixel::default(); count],
            ..RawGaussians::default()
        };
        let meta = SceneMeta {
            id: SceneId::from_bytes([1; 16]),
            created_ms: 0,
            cameras: Vec::new(),
            report: HealthReport::default(),
            provenance: Provenance::default(),
        };
        let scene = Scene::new(meta, Gaussians::sanitize(raw).unwrap().0, Backdrop::default());
        let index = all.iter().map(|(entry, _)| *entry as u16 + 1).collect();
        let semantics = Semantics { bank, index, ..Semantics::default() };
        Arc::new(scene.with_semantics(Arc::new(semantics)).unwrap())
    }

    #[test]
    fn a_query_whose_caller_has_gone_scores_no_text() {
        let scene = rows_of(Bank { dim: 2, rows: vec![1.0, 0.0] }, &[1]);
        let limits = Limits::default();
        let backend = Arc::new(Backend::new(Arc::new(Blank), Arc::new(Blank), &[], &limits));
        let pose = PoseSpec::CameraToWorld(DMat4::IDENTITY.to_cols_array());
        let camera = Some(CameraSpec { pose, lens: LensSpec::default() });
        let spec = QuerySpec { camera, ..QuerySpec::default() };
        let view = query_view(&limits, &*scene, &spec).unwrap();
        let (of, asked) = (SemanticScene::new(scene).unwrap(), ["chair".to_owned()]);
        let texts = SceneTexts::new(&backend, of, &ScoringChoice::default(), &asked, None).unwrap();
        let answer = |work: &mut Work| answer(&texts, &limits, &spec, view.as_ref(), work);
        let whole = answer(&mut Work::default()).unwrap();
        assert_eq!((whole.results.len(), whole.results[0].gaussians), (1, 1));
        let stopped = answer(&mut Work::stopped()).unwrap_err();
        assert_eq!(stopped.code(), ErrorCode::Cancelled);
    }

    #[test]
    fn the_part_that_fits_a_text_best_comes_first_however_small_it_is() {
        // Nearly as good, the best, and in between.
        let bank = Bank { dim: 2, rows: vec![1.0, 0.02, 1.0, 0.0, 1.0, 0.01] };
        let scene = rows_of(bank, &[60, 20, 40]);
        let limits = Limits::default();
        let backend = Arc::new(Backend::new(Arc::new(Blank), Arc::new(Blank), &[], &limits));
        let (of, asked) = (SemanticScene::new(scene).unwrap(), ["chair".to_owned()]);
        let texts = SceneTexts::new(&backend, of, &ScoringChoice::default(), &asked, None).unwrap();
        let spec = QuerySpec::default();
        let found = answer(&texts, &limits, &spec, None, &mut Work::default()).unwrap();
        let parts = &found.results[0].parts;
        let sizes: Vec<u64> = parts.iter().map(|part| part.gaussians).collect();
        assert_eq!(sizes, [20, 40, 60], "{parts:?}");
        assert!(parts.is_sorted_by(|a, b| a.score > b.score));
    }
}
