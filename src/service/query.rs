//! Many texts asked of one scene: scores of the bank, parts in 3D, and with a camera one drawing
//! of the view for all of them.

use std::{collections::HashMap, sync::Arc, time::Instant};

use rayon::prelude::*;

use super::{
    Service,
    asker::{Asked, Asker, SeenView},
    encode::{self, Layer},
    rle::Rle,
    semantics::Understood,
    texts,
    types::{
        Boxes, Format, Kind, MaskFormat, Part3, Peak, QueryAnswer, QuerySpec, TextResult, TextView,
    },
    view::{Resolved, refuse_crop, resolve_for},
};
use crate::{
    error::Result,
    limits::Limits,
    render::{Kinds, Renderer},
    scene::{Scene, SceneId, Semantics},
    semantics::{PartOptions, Pieces, Scorer},
};

/// Relevancy from which a text selects.
const SELECTED: f32 = 0.5;

/// What a query is answered from.
#[derive(Clone, Copy)]
pub(super) struct Ground<'a> {
    pub(super) asker: &'a Asker,
    pub(super) renderer: &'a dyn Renderer,
    pub(super) limits: &'a Limits,
    pub(super) scene: &'a Scene,
    pub(super) semantics: &'a Semantics,
    /// Tells scene and semantics.
    pub(super) tag: &'a str,
}

/// A set of entries, what it selects, and in which parts.
struct Selection {
    gaussians: u64,
    parts: Vec<Part3>,
}

impl Ground<'_> {
    /// Answers checked texts; `view` is the camera's, where one was given. Calls `drawn` when it is
    /// drawn.
    pub(super) fn answer(
        &self,
        texts: &[String],
        spec: &QuerySpec,
        view: Option<&Resolved>,
        drawn: impl FnOnce(),
    ) -> Result<QueryAnswer> {
        let scorer = self.asker.scorer(self.tag, self.semantics, spec.profile)?;
        let asked = self.asker.ask(&scorer, texts)?;
        let (mut seen, mut render_ms) = (None, None);
        if let Some(view) = view {
            let started = Instant::now();
            let request = view.labels_request(Kinds::NONE);
            let key = view.seen_key(self.tag, &self.renderer.name());
            let (found, new) = self.asker.seen(self.renderer, self.scene, &request, key)?;
            render_ms = Some(if new { started.elapsed().as_secs_f64() * 1e3 } else { 0.0 });
            seen = Some(found);
        }
        drawn();
        let selections = self.selections(&asked, spec.boxes);
        let result = |asked: &Asked| -> Result<TextResult> {
            let entries = selected(asked);
            let selection = selections.get(&entries);
            let view = match &seen {
                Some(seen) => Some(look(seen, &scorer, asked, spec)?),
                None => None,
            };
            Ok(TextResult {
                text: asked.text.clone(),
                scores: asked.scores.entries().iter().skip(1).copied().collect(),
                gaussians: selection.map_or(0, |selection| selection.gaussians),
                parts: selection.map_or_else(Vec::new, |selection| selection.parts.clone()),
                entries,
                warnings: asked.warnings.clone(),
                view,
            })
        };
        Ok(QueryAnswer {
            bank_size: u32::try_from(self.semantics.bank.len()).unwrap_or(u32::MAX),
            profile: spec.profile,
            camera: view.map(Resolved::camera),
            render_ms,
            results: asked.par_iter().map(result).collect::<Result<_>>()?,
        })
    }

    /// What each set of entries selects; texts that select the same share it.
    fn selections(&self, asked: &[Asked], boxes: Boxes) -> HashMap<Vec<u16>, Selection> {
        let mut sets: Vec<Vec<u16>> = asked.iter().map(selected).collect();
        sets.sort_unstable();
        sets.dedup();
        let mut held = vec![0_u64; usize::from(u16::MAX) + 1];
        for m in self.scene.gaussians.semantic_index() {
            held[usize::from(*m)] += 1;
        }
        let options = PartOptions::default();
        let wanted = boxes != Boxes::None && sets.iter().any(|set| !set.is_empty());
        let pieces = wanted.then(|| self.asker.pieces(self.tag, self.scene, &options));
        let selection = |set: Vec<u16>| {
            let gaussians = set.iter().map(|m| held[usize::from(*m)]).sum();
            let parts = pieces.as_deref().map(|pieces| self.parts(pieces, &set, boxes, &options));
            (set, Selection { gaussians, parts: parts.unwrap_or_default() })
        };
        sets.into_par_iter().map(selection).collect()
    }

    fn parts(
        &self,
        pieces: &Pieces,
        entries: &[u16],
        boxes: Boxes,
        options: &PartOptions,
    ) -> Vec<Part3> {
        let found = pieces.parts(&self.scene.gaussians, entries, options);
        let told = found.into_iter().take(self.limits.parts_max).map(|part| {
            let held = if boxes == Boxes::Aligned { part.aligned } else { part.oriented };
            Part3 {
                gaussians: part.gaussians.len() as u64,
                center: held.center,
                axes: held.axes,
                size: held.size,
            }
        });
        told.collect()
    }
}

/// Entries that a text selects, ascending.
pub(super) fn selected(asked: &Asked) -> Vec<u16> {
    let scores = asked.scores.entries();
    let count = u16::try_from(scores.len()).unwrap_or(u16::MAX);
    (1..count).filter(|&m| asked.scores.selects(m)).collect()
}

/// Gaussians of these entries, ascending.
pub(super) fn gaussians_of(scene: &Scene, entries: &[u16]) -> Vec<u32> {
    let most = entries.last().map_or(0, |last| usize::from(*last));
    let mut chosen = vec![false; most + 1];
    entries.iter().for_each(|m| chosen[usize::from(*m)] = true);
    let index = scene.gaussians.semantic_index().iter();
    index
        .zip(0_u32..)
        .filter(|(m, _)| chosen.get(usize::from(**m)).copied().unwrap_or(false))
        .map(|(_, i)| i)
        .collect()
}

/// What a text finds in a view.
fn look(seen: &SeenView, scorer: &Scorer, asked: &Asked, spec: &QuerySpec) -> Result<TextView> {
    let relevancy = seen.relevancy(scorer, &asked.scores)?;
    // A relevancy under 0.5 is 0, so this is the mask of the short form too.
    let mask: Vec<bool> = relevancy.iter().map(|score| *score >= SELECTED).collect();
    let (width, height) = (seen.width, seen.height);
    let png = |layer| encode::layer(layer, width, height, Format::Png);
    let (mut view, mut corners) = (TextView::default(), None::<[u32; 4]>);
    let mut best = 0.0_f32;
    for (y, row) in (0..height).zip(relevancy.chunks_exact(width.max(1) as usize)) {
        if row.iter().all(|score| *score < SELECTED) {
            continue;
        }
        for (x, score) in (0..width).zip(row).filter(|(_, score)| **score >= SELECTED) {
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
        view.relevancy_png = Some(png(Layer::Relevancy(&relevancy))?);
    }
    Ok(view)
}

impl Service {
    /// Asks a scene many texts: which entries of its bank and which Gaussians they select, in
    /// which connected parts; with a camera also where in that view.
    ///
    /// The first text of a scene has its semantics made, and waits for them.
    ///
    /// # Errors
    /// `invalid_request`, `limit_exceeded`, `scene_not_found`, `scene_not_ready` also when the
    /// semantics are not ready in time, `semantics_off`, `model_unavailable`, `overloaded`,
    /// `deadline_exceeded`, and whatever the making of the semantics failed with.
    pub async fn query(&self, id: &SceneId, spec: QuerySpec) -> Result<QueryAnswer> {
        self.sees(id).await?;
        let inner = &self.inner;
        inner.can_understand("query")?;
        refuse_crop(&spec.options, "query")?;
        let texts = texts::all_checked(&spec.texts, "texts", &self.limits())?;
        let record = inner.finished(id)?;
        let view = match spec.camera {
            Some(camera) => {
                let cameras = [camera];
                resolve_for(inner, &record, &cameras, &[Kind::Mask], &spec.options)?.pop()
            }
            None => None,
        };
        let understood = inner.understood(id, "query", spec.wait).await?;
        let deadline = inner.deadline(&spec.options);
        let work = Arc::clone(inner);
        let pixels = view.as_ref().map_or(0, Resolved::pixels);
        inner
            .scheduled(deadline, pixels, "the query", move |slot| {
                let Understood { scene, semantics, .. } = &understood;
                let ground = Ground {
                    asker: &work.asker,
                    renderer: &*work.renderer,
                    limits: &work.limits(),
                    scene,
                    semantics,
                    tag: &understood.tag(),
                };
                ground.answer(&texts, &spec, view.as_ref(), || slot.drawn())
            })
            .await
    }
}
