//! What each text says of each pixel of the target: by the stages of the product, and by the flat
//! baseline without 3D.

use std::{
    sync::{Arc, atomic::AtomicBool},
    time::Instant,
};

use segsplat_vision::semantics::{
    Components, Cutter, InstanceOptions, Scorer, Scoring, TextScores, add_context, contexts,
};
use serde_json::{Value, json};

use super::{
    labels::{LabelledFrame, LabelledScene},
    pca, split,
    tally::TextMap,
};
use crate::{
    error::{Error, Result},
    models::ImageText,
    pipeline::{
        Pipeline, Reconstruction, masks,
        semantics::{SemanticsInput, understand},
    },
    render::{
        Kinds, Labels, PixelWeights, RenderRequest, Renderer, cpu::CpuRenderer, plan::served,
    },
    scene::{
        Bank, Camera, Crop, IndexMap, Method, PhotoMasks, PosedPhoto, RowViews, Scene,
        SceneOptions, SemanticsReport, Watch,
    },
    scenes::{make, scene_of, view_request},
};

/// What all targets share.
pub(super) struct Tools<'a> {
    engine: &'a Pipeline,
    renderer: &'a CpuRenderer,
    towers: Arc<ImageText>,
}

/// How a scene is made and understood, and how texts are scored.
pub(super) struct Way {
    pub(super) options: SceneOptions,
    pub(super) scoring: Arc<Scoring>,
}

/// A scene with its meaning.
pub(super) struct Made {
    given: Vec<PosedPhoto>,
    method: Method,
    pub(super) scene: Scene,
    pub(super) bank: Bank,
    pub(super) views: RowViews,
    pub(super) components: Components,
    /// Entries of each photo's cells.
    maps: Vec<IndexMap>,
    meaning: SemanticsReport,
}

/// One target, seen from its inputs.
pub(super) struct Seen {
    /// The view's colours, for pictures.
    pub(super) color: Vec<[f32; 3]>,
    /// Files of the target and its inputs, the nearest first; how semantics and the stages before
    /// went; the mean sum of the weights of a pixel of the target over the bank, 0 to 1.
    pub(super) report: Value,
    /// The view of the scene, and the nearest photo taken for the target, where that was asked for.
    pub(super) banks: Vec<BankView>,
    /// Files of the inputs, and the entries of their cells.
    outlined: Vec<(String, IndexMap)>,
}

/// A bank and the weights of each pixel of the target over it.
pub(super) struct BankView {
    bank: Bank,
    views: RowViews,
    touching: Vec<[u16; 2]>,
    weights: PixelWeights,
}

impl<'a> Tools<'a> {
    pub(super) fn open(engine: &'a Pipeline, renderer: &'a CpuRenderer) -> Result<Self> {
        Ok(Self { engine, renderer, towers: engine.image_text()? })
    }

    /// What runs the towers.
    pub(super) fn provider(&self) -> &'static str {
        self.towers.provider().name()
    }

    /// Unit embeddings of texts.
    pub(super) fn texts(&self, texts: &[String]) -> Result<Vec<Vec<f32>>> {
        Ok(self.towers.embed_texts(texts)?.into_iter().map(|text| text.row).collect())
    }

    /// Makes the scene of `inputs`, and its meaning.
    pub(super) fn make(&self, photos: &[PosedPhoto], inputs: &[usize], way: &Way) -> Result<Made> {
        let given: Vec<PosedPhoto> = inputs.iter().map(|&i| photos[i].clone()).collect();
        let cancel = AtomicBool::new(false);
        let reconstruction = make(self.engine, &given, &way.options)?;
        let method = reconstruction.report.method.clone();
        let parts = SemanticsInput {
            photos: &given,
            cameras: &reconstruction.cameras,
            gaussians: &reconstruction.gaussians,
        };
        let watch = Watch { progress: &|_, _| (), cancel: &cancel };
        let meaning = understand(self.engine, &parts, &method, watch)?;
        let gaussians = reconstruction.gaussians.with_semantic_index(meaning.index)?;
        let scene = scene_of(Reconstruction { gaussians, ..reconstruction });
        let (gaussians, cameras) = (&scene.gaussians, &scene.meta.cameras);
        let components = Components::new(gaussians, cameras, &InstanceOptions::default());
        Ok(Made {
            given,
            method,
            components,
            scene,
            bank: meaning.bank,
            views: meaning.views,
            maps: meaning.photos,
            meaning: meaning.report,
        })
    }

    /// Milliseconds of giving the scene of `inputs` its meaning, `runs` times after a first one
    /// that does not count, ascending.
    pub(super) fn timed(
        &self,
        photos: &[PosedPhoto],
        inputs: &[usize],
        way: &Way,
        runs: usize,
    ) -> Result<Vec<f64>> {
        let given: Vec<PosedPhoto> = inputs.iter().map(|&i| photos[i].clone()).collect();
        let made = make(self.engine, &given, &way.options)?;
        let (cameras, gaussians) = (&made.cameras, &made.gaussians);
        let parts = SemanticsInput { photos: &given, cameras, gaussians };
        let cancel = AtomicBool::new(false);
        let watch = Watch { progress: &|_, _| (), cancel: &cancel };
        let once = |_| -> Result<f64> {
            let begun = Instant::now();
            understand(self.engine, &parts, &made.report.method, watch)?;
            Ok(begun.elapsed().as_secs_f64() * 1e3)
        };
        let mut times = (0..=runs.max(1)).map(once).collect::<Result<Vec<f64>>>()?;
        times.remove(0);
        times.sort_by(f64::total_cmp);
        Ok(times)
    }

    /// Looks at a scene from the target's camera; with `flat` also at its first photo alone.
    pub(super) fn see(&self, made: &Made, target: &PosedPhoto, flat: bool) -> Result<Seen> {
        let Made { given, method, scene, maps, meaning, .. } = made;
        let plain = view_request(target.camera, Kinds::COLOR, scene.meta.report.median_depth);
        let request = RenderRequest { labels: Labels::Weights, ..plain };
        let frame = self.renderer.render(&scene.gaussians, &served(scene, request))?;
        let weights = frame.weights.ok_or_else(|| Error::internal("the view has no weights"))?;
        let weight: f64 = weights.weights.iter().map(|w| f64::from(*w)).sum();
        let report = json!({
            "target": target.file,
            "inputs": given.iter().map(|photo| &photo.file).collect::<Vec<_>>(),
            "semantics": meaning,
            "stages": scene.meta.report.stages,
            "coverage": weight / weights.pixels().max(1) as f64,
            "warnings": scene.meta.report.warnings.len(),
        });
        let (bank, views) = (made.bank.clone(), made.views.clone());
        let touching = made.components.touching_entries();
        let mut banks = vec![BankView { bank, views, touching, weights }];
        if let Some(nearest) = given.first().filter(|_| flat) {
            let cancel = AtomicBool::new(false);
            banks.push(self.flat(nearest, &target.camera, method, &cancel)?);
        }
        let photos = given.iter().zip(maps);
        let outlined = photos.map(|(photo, map)| (photo.file.clone(), map.clone())).collect();
        Ok(Seen { color: frame.color.unwrap_or_default(), banks, outlined, report })
    }

    /// The masks of one photo, each with a row of its own, laid over a picture of the size of the
    /// target.
    fn flat(
        &self,
        photo: &PosedPhoto,
        target: &Camera,
        method: &Method,
        cancel: &AtomicBool,
    ) -> Result<BankView> {
        let network = self.engine.masks()?;
        let settings = masks::settings(network.manifest(), method);
        let photos = std::slice::from_ref(photo);
        let found = masks::photo_masks(&network, photos, None, &settings, &|_| (), cancel)?;
        let none = PhotoMasks::default();
        let masks = found.first().unwrap_or(&none);
        let cutter = Cutter::new(&photo.photo, masks);
        let manifest = self.towers.manifest();
        let margin = match method.crop_margin {
            true => f64::from(manifest.image.crop_margin),
            false => 0.0,
        };
        let black = || Crop { width: 1, height: 1, rgb: vec![0; 3] };
        let shape = manifest.image.crop_shape;
        let cut = |k: usize| cutter.cut(k, margin, shape).unwrap_or_else(black);
        let crops: Vec<Crop> = (0..masks.masks.len()).map(cut).collect();
        let mut rows = self.towers.embed_images(&crops)?;
        let dense = manifest.image.dense.as_ref().filter(|_| method.context);
        if let Some((dense, features)) = dense.zip(self.towers.dense(&photo.photo)?) {
            let contexts = contexts(&features, masks);
            let both = rows.chunks_exact_mut(manifest.dim).zip(contexts.chunks(manifest.dim));
            for ((row, context), mask) in both.zip(&masks.masks) {
                add_context(row, context, dense.weight(mask.area));
            }
        }
        let lens = target.intrinsics;
        let mut weights = PixelWeights { offsets: vec![0], ..PixelWeights::default() };
        for y in 0..lens.height {
            for x in 0..lens.width {
                let share = |at: u32, of: u32| (f64::from(at) + 0.5) / f64::from(of);
                let index = masks.map.at(share(x, lens.width), share(y, lens.height));
                if index > 0 {
                    weights.entries.push(index);
                    weights.weights.push(1.0);
                }
                weights.offsets.push(u32::try_from(weights.entries.len()).unwrap_or(u32::MAX));
            }
        }
        let bank = Bank { dim: manifest.dim, rows };
        Ok(BankView { bank, views: RowViews::default(), touching: Vec::new(), weights })
    }
}

/// What scores texts by a bank as the product does: where rows are tracks, by what touches, too.
pub(super) fn scorer(
    bank: &Bank,
    views: &RowViews,
    touching: &[[u16; 2]],
    scoring: &Arc<Scoring>,
) -> Result<Scorer> {
    let scorer = Scorer::new(bank, Arc::clone(scoring))?.with_views(views)?;
    Ok(if views.entries.is_empty() { scorer } else { scorer.with_touching(touching) })
}

impl Seen {
    /// Where the pixels of each asked class are lost in this view.
    pub(super) fn split(
        &self,
        scene: &LabelledScene,
        target: &LabelledFrame,
        scoring: &Arc<Scoring>,
        texts: &[Vec<f32>],
    ) -> Result<Vec<Value>> {
        let view = &self.banks[0];
        let (scorer, weights) = (view.scorer(scoring)?, &view.weights);
        let scored = |text: &Vec<f32>| -> Result<(TextScores, Vec<bool>)> {
            let scores = scorer.text(text)?;
            let mask = scorer.mask(&scores, weights)?;
            Ok((scores, mask))
        };
        let asked = texts.iter().map(scored).collect::<Result<Vec<_>>>()?;
        Ok(split::of_view(scene, target, &self.outlined, weights, &asked))
    }
}

impl BankView {
    /// E, the weights of each pixel over the bank, as colours.
    pub(super) fn weights_shown(&self) -> Vec<[f32; 3]> {
        pca::colours(self.weights.pixels(), |pixel| {
            let mut row = vec![0.0; self.bank.len()];
            for (m, weight) in self.entries(pixel) {
                row[m] = weight;
            }
            (self.weights.coverage(pixel) > 0.0).then_some(row)
        })
    }

    /// F, the feature of each pixel at length 1, as colours.
    pub(super) fn features_shown(&self) -> Vec<[f32; 3]> {
        pca::colours(self.weights.pixels(), |pixel| {
            let mut row = vec![0.0_f32; self.bank.dim];
            for (m, weight) in self.entries(pixel) {
                row.iter_mut().zip(self.bank.row(m)).for_each(|(sum, v)| *sum += weight * v);
            }
            let length = row.iter().map(|v| v * v).sum::<f32>().sqrt();
            (length > 0.0).then(|| row.into_iter().map(|v| v / length).collect())
        })
    }

    /// Rows of the bank that a pixel shows, with their weights.
    fn entries(&self, pixel: usize) -> impl Iterator<Item = (usize, f32)> {
        let row = |(entry, weight): (u16, f32)| {
            let m = usize::from(entry).checked_sub(1).filter(|m| *m < self.bank.len())?;
            Some((m, weight))
        };
        self.weights.pixel(pixel).filter_map(row)
    }

    /// What scores texts by its entries, as the product does.
    fn scorer(&self, scoring: &Arc<Scoring>) -> Result<Scorer> {
        scorer(&self.bank, &self.views, &self.touching, scoring)
    }

    /// The product's masks, and scores by which texts can be compared at a pixel.
    ///
    /// At one pixel all texts share the feature's length, so the smallest `E . B(q - c)` over the
    /// phrases orders them as their relevancies do.
    pub(super) fn maps(&self, scoring: &Arc<Scoring>, texts: &[Vec<f32>]) -> Result<Vec<TextMap>> {
        let scorer = self.scorer(scoring)?;
        let of = &self.weights;
        let map = |text: &Vec<f32>| -> Result<TextMap> {
            let scores = scorer.text(text)?;
            let tables = scores.tables();
            let score = |p: usize| {
                let mut sums = vec![[0.0_f64; 4]; tables.len()];
                for (index, weight) in of.pixel(p) {
                    for (sum, table) in sums.iter_mut().zip(&tables) {
                        let row = table.get(usize::from(index)).copied().unwrap_or_default();
                        sum.iter_mut()
                            .zip(row)
                            .for_each(|(sum, v)| *sum += f64::from(weight) * f64::from(v));
                    }
                }
                let known = sums.first().is_some_and(|sum| sum[0] > 0.0);
                let least = sums.iter().flat_map(|sum| &sum[1..]).copied();
                if known { least.fold(f64::INFINITY, f64::min) } else { f64::NEG_INFINITY }
            };
            Ok(TextMap {
                score: (0..of.pixels()).map(score).collect(),
                mask: scorer.mask(&scores, of)?,
            })
        };
        texts.iter().map(map).collect()
    }
}
