//! The order of the stages that give a scene its meaning: masks ▸ embed ▸ bank ▸ assign.
//!
//! [`understand`] runs them with the pipeline's networks, which are opened at the first call;
//! [`understand_with`] with whatever gives masks and embeddings. All stages but the last need only
//! the photos, so [`label_photos`] can run while the scene is made. Every Gaussian takes the entry
//! of the pixel that made it. [`Method`] says whether other photos vote.

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
        mpsc,
    },
};

use rayon::prelude::*;

use super::{
    Pipeline, Stages, count, fraction,
    masks::{self, MasksOfPhotos},
    networks::opened,
};
use crate::{
    error::{Error, ErrorCode, Result},
    models::{ImageText, MaskNetwork},
    scene::{
        Bank, BankMask, Crop, CropShape, DenseFeatures, Gaussians, IndexMap, Method, Photo,
        PhotoMasks, PosedPhoto, Preset, RowViews, SceneCamera, ScoringMethod, Semantics,
        SemanticsReport, Stage, Watch, unless_cancelled,
    },
    semantics::{self, Clusters, Cutter, Scorer, Scoring, TextScores, Tracks, Views},
};

/// Crops that take an image tower as long as a whole photo, about.
const CROPS_A_PHOTO: usize = 5;
/// Masks of a row that are kept beside it. Half of them name a thing, so more say little.
const VIEWS_MAX: usize = 16;

/// What gives masks and embeddings.
pub struct SemanticsTools<'a, P> {
    /// The masks of each photo; those that are there are embedded while others are found.
    pub masks: &'a MasksOfPhotos<'a>,
    /// A batch of crops as `embed` takes it.
    pub prepare: &'a (dyn Fn(&[Crop]) -> P + Sync),
    /// `[crops * dim]` unit embeddings of a batch; the next one is prepared meanwhile.
    pub embed: &'a (dyn Fn(&P) -> Result<Vec<f32>> + Sync),
    /// Numbers of an embedding.
    pub dim: usize,
    /// Added around a mask's box on each side, share of its longer side.
    pub crop_margin: f64,
    /// What a crop shows of a box that is no square.
    pub crop_shape: CropShape,
    /// Crops that are embedded together, and so in memory together.
    pub batch: usize,
    /// What sees whole photos; `None`: crops alone.
    pub context: Option<Context<'a>>,
}

/// What an image tower says of whole photos.
#[derive(Clone, Copy)]
pub struct Context<'a> {
    /// The features of a photo; `None` where there are none.
    pub dense: &'a (dyn Fn(&Photo) -> Result<Option<DenseFeatures>> + Sync),
    /// How much the context of a mask of this area (share of its photo) weighs beside its crop.
    pub weight: &'a (dyn Fn(f64) -> f64 + Sync),
}

impl<P> std::fmt::Debug for SemanticsTools<'_, P> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("SemanticsTools").field("dim", &self.dim).finish_non_exhaustive()
    }
}

impl std::fmt::Debug for Context<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Context").finish_non_exhaustive()
    }
}

/// A scene whose semantics are to be made.
#[derive(Clone, Copy, Debug)]
pub struct SemanticsInput<'a> {
    /// Undistorted photos, in the scene's order.
    pub photos: &'a [PosedPhoto],
    /// The scene's cameras, in the same order.
    pub cameras: &'a [SceneCamera],
    /// Its Gaussians.
    pub gaussians: &'a Gaussians,
}

impl Pipeline {
    /// The mask network, opened at the first call.
    ///
    /// # Errors
    /// `model_unavailable` when the bundle has none or it does not open.
    pub fn masks(&self) -> Result<Arc<MaskNetwork>> {
        let open = || MaskNetwork::open(&self.runtime, &self.bundle, &self.lazy.options);
        opened(&self.lazy.masks, "mask network", open)
    }

    /// The image and the text tower, opened at the first call.
    ///
    /// # Errors
    /// `model_unavailable` when the bundle has none or one does not open.
    pub fn image_text(&self) -> Result<Arc<ImageText>> {
        let open = || ImageText::open(&self.runtime, &self.bundle, &self.lazy.options);
        opened(&self.lazy.image_text, "image and text towers", open)
    }

    /// How texts are scored under a preset, with the bundle's canonical texts for the default.
    ///
    /// # Errors
    /// `model_unavailable` when the bundle has no text tower.
    pub fn scoring_method(&self, preset: Preset) -> Result<ScoringMethod> {
        let towers = self.image_text()?;
        let manifest = towers.manifest();
        let (tau, floor) = (f64::from(manifest.tau), f64::from(manifest.coverage_floor));
        let (margin, rivals) = (f64::from(manifest.margin), f64::from(manifest.rivals));
        Ok(ScoringMethod::of(preset, manifest.canon.clone(), tau, floor, margin, rivals))
    }

    /// The same, ready to score.
    ///
    /// # Errors
    /// `model_unavailable` when the bundle has no text tower, `internal` when it fails,
    /// `invalid_request` when a number is out of its bounds.
    pub fn scoring(&self, method: &ScoringMethod) -> Result<Scoring> {
        let towers = self.image_text()?;
        let rows = towers.embed_texts(&method.canon)?;
        let words = towers.rivals()?;
        Scoring::new(method, rows.into_iter().map(|text| text.row).collect(), words)
    }
}

/// Gives a scene its meaning with the pipeline's networks.
///
/// # Errors
/// `model_unavailable`, `cancelled`, `internal`; `invalid_request` when the scene does not say
/// which pixel made each Gaussian.
pub fn understand(
    pipeline: &Pipeline,
    input: &SemanticsInput<'_>,
    method: &Method,
    watch: Watch<'_>,
) -> Result<Semantics> {
    check_input(input)?;
    let seeds = method.seeds.then_some(input.gaussians);
    label_photos(pipeline, input.photos, seeds, method, watch)?.label_gaussians(input, watch)
}

/// The stages that need no scene, with the pipeline's networks. `seeds` are the scene's Gaussians,
/// where masks found in one photo are to be asked for in the next.
///
/// # Errors
/// `model_unavailable`, `cancelled`, `internal`.
pub fn label_photos(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    seeds: Option<&Gaussians>,
    method: &Method,
    watch: Watch<'_>,
) -> Result<LabelledPhotos> {
    label_more(pipeline, photos, None, seeds, method, watch)
}

/// The same where the first photos are labelled already, as `known` says: only the others go
/// through the networks. Masks that depend on other photos, as those by `seeds`, are all made anew.
///
/// # Errors
/// As [`label_photos`].
pub fn label_more(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    known: Option<&LabelledPhotos>,
    seeds: Option<&Gaussians>,
    method: &Method,
    watch: Watch<'_>,
) -> Result<LabelledPhotos> {
    // A refinement changes how a scene is drawn, and nothing of its masks.
    let of_masks = |of: &Method| Method { front_photos: 0, magnify: false, ..of.clone() };
    let same = |known: &&LabelledPhotos| of_masks(&known.report.method) == of_masks(method);
    let known = known.filter(|_| seeds.is_none()).filter(same);
    let photos = known.map_or(photos, |known| photos.get(known.masks.len()..).unwrap_or_default());
    let (network, towers) = (pipeline.masks()?, pipeline.image_text()?);
    let settings = masks::settings(network.manifest(), method);
    let image = &towers.manifest().image;
    let weight = |area: f64| image.dense.as_ref().map_or(0.0, |dense| dense.weight(area));
    let context = Context { dense: &|photo| towers.dense(photo), weight: &weight };
    let tools = SemanticsTools {
        masks: &|give| masks::each_photo(&network, photos, seeds, &settings, give, watch.cancel),
        prepare: &|crops| towers.prepare(crops),
        embed: &|prepared| towers.embed_prepared(prepared),
        dim: towers.manifest().dim,
        crop_margin: if method.crop_margin { f64::from(image.crop_margin) } else { 0.0 },
        crop_shape: image.crop_shape,
        batch: image.batch,
        context: (method.context && image.dense.is_some()).then_some(context),
    };
    // Not on a thread of the pool: one that waits for a network would be missing there, and one
    // that waits for its own tasks might begin another job.
    let mut labelled = std::thread::scope(|scope| {
        // What the first text is compared with, meanwhile; a failure is told to the text.
        (method.preset == Preset::Default).then(|| scope.spawn(|| towers.rivals()));
        label_photos_with(&tools, photos, known, method, watch)
    })?;
    labelled.report.bundle_sha256 = pipeline.bundle.sha256().to_owned();
    labelled.report.execution_provider = towers.provider().name().to_owned();
    Ok(labelled)
}

/// Gives a scene its meaning with any masks and embeddings.
///
/// # Errors
/// Those of the tools, `cancelled`, `internal` when an answer has another length than asked for;
/// `invalid_request` when the scene does not say which pixel made each Gaussian.
pub fn understand_with<P: Send>(
    tools: &SemanticsTools<'_, P>,
    input: &SemanticsInput<'_>,
    method: &Method,
    watch: Watch<'_>,
) -> Result<Semantics> {
    check_input(input)?;
    label_photos_with(tools, input.photos, None, method, watch)?.label_gaussians(input, watch)
}

/// Labels `photos`, which come after those of `known`.
fn label_photos_with<P: Send>(
    tools: &SemanticsTools<'_, P>,
    photos: &[PosedPhoto],
    known: Option<&LabelledPhotos>,
    method: &Method,
    watch: Watch<'_>,
) -> Result<LabelledPhotos> {
    let mut stages = Stages::new(watch);
    let (masks, embedded) = masks_and_embeddings(tools, photos, &mut stages)?;
    let (masks, embedded) = match known {
        Some(known) => known.with(masks, embedded),
        None => (masks, embedded),
    };
    let clusters = match method.tracks {
        true => None,
        false => Some(stages.run(Stage::Bank, || {
            let wanted = match method.bank_rows as usize {
                0 => semantics::rows_wanted(embedded.of.len(), masks.len(), method.lambda),
                rows => rows,
            };
            semantics::bank(&embedded.rows, tools.dim, wanted)
        })?),
    };
    let report = SemanticsReport {
        masks: masks.iter().map(|of| count(of.masks.len())).collect(),
        method: method.clone(),
        stages: stages.times,
        ..SemanticsReport::default()
    };
    Ok(LabelledPhotos { masks, embedded, dim: tools.dim, clusters, report })
}

/// The stages `masks` and `embed`. What is embedded while masks are found is part of the first.
fn masks_and_embeddings<P: Send>(
    tools: &SemanticsTools<'_, P>,
    photos: &[PosedPhoto],
    stages: &mut Stages<'_>,
) -> Result<(Vec<PhotoMasks>, Embedded)> {
    let (watch, total) = (stages.watch, AtomicUsize::new(0));
    // Says nothing before it is known how much there is to do.
    let step = |done: usize| {
        match total.load(Ordering::Acquire) {
            0 => {}
            total => (watch.progress)(Stage::Embed, fraction(done, total)),
        }
        unless_cancelled(watch.cancel)
    };
    std::thread::scope(|scope| {
        let (sent, taken) = mpsc::channel();
        let embedder = scope.spawn(|| {
            let mut embedding = Embedding::new(tools, photos, &step);
            let mut early = BTreeMap::new();
            for (photo, masks) in taken {
                early.insert(photo, masks);
                while let Some(next) = early.remove(&embedding.masks.len()) {
                    embedding.add(next)?;
                }
            }
            embedding.finish()
        });
        let (told, asked) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let found = stages.run(Stage::Masks, || {
            (tools.masks)(&|photo, masks: PhotoMasks| {
                let whole = match tools.context {
                    Some(_) if !masks.masks.is_empty() => CROPS_A_PHOTO,
                    _ => 0,
                };
                asked.fetch_add(masks.masks.len() + whole, Ordering::Relaxed);
                let told = told.fetch_add(1, Ordering::Relaxed) + 1;
                (watch.progress)(Stage::Masks, fraction(told, photos.len()));
                // Where nobody takes them, the embedder has failed, and says why.
                let unwanted = |_| Error::new(ErrorCode::Cancelled, "the masks are not wanted");
                sent.send((photo, masks)).map_err(unwanted)
            })
        });
        drop(sent);
        let rest = || {
            total.store(asked.load(Ordering::Relaxed), Ordering::Release);
            embedder.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
        };
        let embedded = if found.is_ok() { stages.run(Stage::Embed, rest) } else { rest() };
        let (masks, embedded) = embedded?;
        found?;
        if masks.len() != photos.len() {
            let (masks, photos) = (masks.len(), photos.len());
            return Err(Error::internal(format!("masks of {masks} photos, not of {photos}")));
        }
        Ok((masks, embedded))
    })
}

/// The meaning of a scene's photos: their masks and what each one looks like.
#[derive(Clone, Debug)]
pub struct LabelledPhotos {
    masks: Vec<PhotoMasks>,
    embedded: Embedded,
    /// Numbers of an embedding.
    dim: usize,
    /// The bank, where it needs no scene.
    clusters: Option<Clusters>,
    /// Of the stages so far.
    report: SemanticsReport,
}

impl LabelledPhotos {
    /// Photos that it is of.
    #[must_use]
    pub fn photos(&self) -> usize {
        self.masks.len()
    }

    /// Bytes of its embeddings and maps.
    #[must_use]
    pub fn size_bytes(&self) -> u64 {
        let maps: usize = self.masks.iter().map(|of| of.map.index.len()).sum();
        (4 * self.embedded.rows.len() + 2 * maps) as u64
    }

    /// The same of the photos of these numbers alone, ascending.
    #[must_use]
    pub fn only(&self, kept: &[usize]) -> Self {
        let mut embedded = Embedded::default();
        let rows = self.embedded.rows.chunks_exact(self.dim.max(1));
        for (&[photo, mask], row) in self.embedded.of.iter().zip(rows) {
            if let Some(number) = kept.iter().position(|&one| one == photo) {
                embedded.of.push([number, mask]);
                embedded.rows.extend_from_slice(row);
            }
        }
        let masks = kept.iter().map(|&i| self.masks[i].clone()).collect();
        Self { masks, embedded, clusters: None, dim: self.dim, report: self.report.clone() }
    }

    /// Masks and embeddings of these photos, then those of photos after them.
    fn with(&self, masks: Vec<PhotoMasks>, more: Embedded) -> (Vec<PhotoMasks>, Embedded) {
        let before = self.masks.len();
        let mut embedded = self.embedded.clone();
        embedded.rows.extend(more.rows);
        embedded.of.extend(more.of.into_iter().map(|[photo, mask]| [before + photo, mask]));
        (self.masks.iter().cloned().chain(masks).collect(), embedded)
    }

    /// What scores texts by the masks, each of which is a row.
    pub(super) fn scorer(&self, scoring: Arc<Scoring>) -> Result<Scorer> {
        Scorer::new(&Bank { dim: self.dim, rows: self.embedded.rows.clone() }, scoring)
    }

    /// Of each photo the cells of the masks that a text of [`Self::scorer`] selects: 1.
    pub(super) fn selected(&self, text: &TextScores) -> Vec<IndexMap> {
        let mut becomes: Vec<Vec<u16>> =
            self.masks.iter().map(|of| vec![0; of.masks.len()]).collect();
        for (row, &[photo, mask]) in (1..).zip(&self.embedded.of) {
            becomes[photo][mask] = text.selects(row).into();
        }
        let maps = self.masks.iter().zip(&becomes);
        maps.map(|(of, becomes)| semantics::relabel(&of.map, becomes)).collect()
    }

    /// Gives it to the scene that was made of these photos: the last stage.
    ///
    /// # Errors
    /// `cancelled`; `internal` when the scene has other photos, `invalid_request` when it does not
    /// say which pixel made each Gaussian.
    pub fn label_gaussians(
        self,
        input: &SemanticsInput<'_>,
        watch: Watch<'_>,
    ) -> Result<Semantics> {
        check_input(input)?;
        let Self { masks, embedded, dim, clusters, mut report } = self;
        let mut stages = Stages::new(watch);
        let method = &report.method;
        let (gaussians, cameras) = (input.gaussians, input.cameras);
        let (labels, index) = match clusters {
            Some(clusters) => {
                let mut labels = label(&masks, &embedded.of, clusters);
                let index = stages.run(Stage::Assign, || Ok(assign(&mut labels, input, method)))?;
                (labels, index)
            }
            None => {
                let views = Views::new(gaussians, cameras);
                let labels = stages.run(Stage::Bank, || {
                    let tracks = semantics::tracks(&views, cameras, &masks, &embedded.of);
                    Ok(label_tracks(&masks, &embedded, dim, &tracks))
                })?;
                let index = stages.run(Stage::Assign, || {
                    let own = semantics::from_source(gaussians.source(), cameras, &labels.maps);
                    Ok(if method.votes { views.vote(&own, &labels.maps) } else { own })
                })?;
                (labels, index)
            }
        };
        let Labels { bank, views, maps, masks } = labels;
        report.bank_size = count(bank.len());
        report.labelled = index.iter().filter(|m| **m > 0).count() as u64;
        report.stages.extend(stages.times);
        Ok(Semantics { bank, views, index, photos: maps, masks, report })
    }
}

/// Refuses a scene whose Gaussians cannot be found in its photos.
pub(super) fn check_input(input: &SemanticsInput<'_>) -> Result<()> {
    let (photos, cameras) = (input.photos.len(), input.cameras.len());
    let named = input.photos.iter().zip(input.cameras).all(|(p, c)| p.file == c.file);
    if photos != cameras || !named {
        return Err(Error::internal(format!(
            "semantics: {photos} photos are not those of the scene's {cameras} cameras"
        )));
    }
    if !input.gaussians.is_empty() && input.cameras.iter().all(|c| c.network.is_none()) {
        return Err(Error::invalid(
            "semantics: the scene does not say which pixels made its Gaussians (an older program \
             made it, or none did); make it again from its photos",
        ));
    }
    Ok(())
}

/// Embeddings of all masks that have one.
#[derive(Clone, Debug, Default)]
struct Embedded {
    /// `[count * dim]`.
    rows: Vec<f32>,
    /// Photo and mask of each, both counted from 0.
    of: Vec<[usize; 2]>,
}

/// Embeds the masks of photos, which come in their order. A mask without pixels, or whose embedding
/// has no length, has no meaning and stays background.
struct Embedding<'a, P> {
    tools: &'a SemanticsTools<'a, P>,
    photos: &'a [PosedPhoto],
    /// Told how much is done, in crops.
    step: &'a (dyn Fn(usize) -> Result<()> + Sync),
    done: usize,
    /// Of the photos so far.
    masks: Vec<PhotoMasks>,
    /// Photo and number of masks that do not fill a batch yet.
    waiting: Vec<[usize; 2]>,
    found: Embedded,
    /// `[masks * dim]` of each photo; empty where none weighs something.
    contexts: Vec<Vec<f32>>,
}

impl<'a, P: Send> Embedding<'a, P> {
    fn new(
        tools: &'a SemanticsTools<'a, P>,
        photos: &'a [PosedPhoto],
        step: &'a (dyn Fn(usize) -> Result<()> + Sync),
    ) -> Self {
        let (masks, waiting, contexts) = (Vec::new(), Vec::new(), Vec::new());
        let found = Embedded::default();
        Self { tools, photos, step, done: 0, masks, waiting, found, contexts }
    }

    /// The next photo: its masks are embedded as far as they fill batches.
    fn add(&mut self, masks: PhotoMasks) -> Result<()> {
        let photo = self.masks.len();
        self.waiting.extend((0..masks.masks.len()).map(|k| [photo, k]));
        self.masks.push(masks);
        let whole = self.waiting.len() - self.waiting.len() % self.tools.batch.max(1);
        let rest = self.waiting.split_off(whole);
        let batches = std::mem::replace(&mut self.waiting, rest);
        self.embed(&batches)?;
        let contexts = self.contexts_of(photo)?;
        self.contexts.push(contexts);
        Ok(())
    }

    /// The rest, and the contexts added to all.
    fn finish(mut self) -> Result<(Vec<PhotoMasks>, Embedded)> {
        let rest = std::mem::take(&mut self.waiting);
        self.embed(&rest)?;
        let dim = self.tools.dim.max(1);
        if let Some(context) = &self.tools.context {
            let rows = self.found.rows.chunks_exact_mut(dim);
            for (row, &[photo, k]) in rows.zip(&self.found.of) {
                let weight = (context.weight)(self.masks[photo].masks[k].area);
                let own = self.contexts[photo].get(k * dim..(k + 1) * dim).unwrap_or_default();
                semantics::add_context(row, own, weight);
            }
        }
        Ok((self.masks, self.found))
    }

    /// Cuts and embeds masks, a batch at a time.
    fn embed(&mut self, all: &[[usize; 2]]) -> Result<()> {
        let (tools, first) = (self.tools, all.first().map_or(0, |of| of[0]));
        let shown = all.last().map_or(0, |of| of[0] + 1);
        let both = self.photos.par_iter().zip(&self.masks).take(shown).skip(first);
        let cutters: Vec<_> = both.map(|(posed, of)| Cutter::new(&posed.photo, of)).collect();
        let cut = |&[photo, k]: &[usize; 2]| {
            let crop = cutters[photo - first].cut(k, tools.crop_margin, tools.crop_shape)?;
            Some(([photo, k], crop))
        };
        let prepare = |batch: &[[usize; 2]]| {
            let (of, crops): (Vec<_>, Vec<Crop>) = batch.par_iter().filter_map(cut).unzip();
            let prepared = (!crops.is_empty()).then(|| (tools.prepare)(&crops));
            (of, prepared)
        };
        let batches: Vec<&[[usize; 2]]> = all.chunks(tools.batch.max(1)).collect();
        let mut next = batches.first().map(|batch| prepare(batch));
        for (i, batch) in batches.iter().enumerate() {
            (self.step)(self.done)?;
            let (of, prepared) = next.take().unwrap_or_else(|| prepare(batch));
            let rows = std::thread::scope(|scope| {
                let ahead = batches.get(i + 1).map(|batch| scope.spawn(|| prepare(batch)));
                let rows = prepared.as_ref().map_or(Ok(Vec::new()), tools.embed);
                // One that panicked is prepared again, and panics where it can be seen.
                next = ahead.and_then(|ahead| ahead.join().ok());
                rows
            })?;
            if rows.len() != of.len() * tools.dim {
                return Err(Error::internal(format!(
                    "semantics: {} numbers for {} crops of {}",
                    rows.len(),
                    of.len(),
                    tools.dim
                )));
            }
            for (of, row) in of.into_iter().zip(rows.chunks_exact(tools.dim.max(1))) {
                if row.iter().any(|v| *v != 0.0) {
                    self.found.rows.extend_from_slice(row);
                    self.found.of.push(of);
                }
            }
            self.done += batch.len();
        }
        Ok(())
    }

    /// The contexts of a photo's masks in the whole photo. One none of whose masks has a context
    /// that weighs something is not looked at.
    fn contexts_of(&mut self, photo: usize) -> Result<Vec<f32>> {
        let (Some(context), masks) = (self.tools.context, &self.masks[photo]) else {
            return Ok(Vec::new());
        };
        let mut contexts = Vec::new();
        if masks.masks.iter().any(|mask| (context.weight)(mask.area) > 0.0) {
            (self.step)(self.done)?;
            let features = (context.dense)(&self.photos[photo].photo)?;
            contexts = features.map_or_else(Vec::new, |of| semantics::contexts(&of, masks));
        }
        if !masks.masks.is_empty() {
            self.done += CROPS_A_PHOTO;
        }
        Ok(contexts)
    }
}

/// The bank, what the photos say, and the row of each mask.
#[derive(Debug)]
struct Labels {
    bank: Bank,
    views: RowViews,
    maps: Vec<IndexMap>,
    masks: Vec<BankMask>,
}

/// Replaces the numbers of the masks by entries.
fn label(masks: &[PhotoMasks], of: &[[usize; 2]], clusters: Clusters) -> Labels {
    let mut becomes: Vec<Vec<u16>> = masks.iter().map(|m| vec![0; m.masks.len()]).collect();
    for ([photo, mask], entry) in of.iter().zip(&clusters.entries) {
        becomes[*photo][*mask] = *entry;
    }
    let maps = masks
        .iter()
        .zip(&becomes)
        .map(|(m, becomes)| semantics::relabel(&m.map, becomes))
        .collect();
    let mask = |photo: usize, mask: usize, entry: u16| BankMask {
        photo: count(photo),
        mask: count(mask),
        entry,
    };
    let of_photo = |(photo, entries): (usize, &Vec<u16>)| -> Vec<BankMask> {
        entries.iter().enumerate().map(|(k, entry)| mask(photo, k, *entry)).collect()
    };
    let masks = becomes.iter().enumerate().flat_map(of_photo).collect();
    Labels { bank: clusters.bank, views: RowViews::default(), maps, masks }
}

/// The same for tracks: a row is the mean of its masks, and the largest of them are kept beside it,
/// where it is a part of the scene.
fn label_tracks(masks: &[PhotoMasks], embedded: &Embedded, dim: usize, tracks: &Tracks) -> Labels {
    let row = |i: usize| &embedded.rows[i * dim..(i + 1) * dim];
    let area = |i: usize| {
        let [photo, mask] = embedded.of[i];
        masks[photo].masks[mask].area
    };
    let (mut rows, mut views) = (Vec::new(), RowViews::default());
    for (entry, members) in (1..).zip(tracks.rows()) {
        rows.extend(semantics::mean_row(members.iter().map(|&i| row(i)), dim));
        if usize::from(entry) > tracks.on_gaussians() {
            continue;
        }
        let mut largest = members.clone();
        largest.sort_by(|&a, &b| area(b).total_cmp(&area(a)));
        for &i in largest.iter().take(VIEWS_MAX) {
            views.entries.push(entry);
            views.rows.extend(row(i));
        }
    }
    let clusters =
        Clusters { bank: Bank { dim, rows }, entries: tracks.entries(embedded.of.len()) };
    Labels { views, ..label(masks, &embedded.of, clusters) }
}

/// `[N]` entry of each Gaussian. With a `merge_cosine`, entries of one object are joined first.
fn assign(labels: &mut Labels, input: &SemanticsInput<'_>, method: &Method) -> Vec<u16> {
    let mut own = semantics::from_source(input.gaussians.source(), input.cameras, &labels.maps);
    let merge = Some(method.merge_cosine).filter(|cosine| *cosine > 0.0);
    if !method.votes && merge.is_none() {
        return own;
    }
    let views = Views::new(input.gaussians, input.cameras);
    if let Some(cosine_min) = merge {
        let group = views.same_things(&own, &labels.maps, &labels.bank, cosine_min);
        let mut counts = vec![0_u32; labels.bank.len()];
        for mask in labels.masks.iter().filter(|mask| mask.entry > 0) {
            counts[usize::from(mask.entry) - 1] += 1;
        }
        let (bank, becomes) = semantics::merge(&labels.bank, &counts, &group);
        let renamed = |map: &IndexMap| semantics::relabel(map, &becomes[1..]);
        labels.maps = labels.maps.iter().map(renamed).collect();
        labels.masks.iter_mut().for_each(|mask| mask.entry = becomes[usize::from(mask.entry)]);
        own.iter_mut().for_each(|m| *m = becomes[usize::from(*m)]);
        labels.bank = bank;
    }
    if method.votes { views.vote(&own, &labels.maps) } else { own }
}
