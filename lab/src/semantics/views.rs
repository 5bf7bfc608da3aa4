//! From photos and texts to what each text says of each pixel of the target: by the product's
//! stages, and by the flat baseline without 3D.

use std::sync::{Arc, atomic::AtomicBool};

use segsplat_vision::semantics::{Cutter, Scorer, Scoring};
use serde::Serialize;

use super::{PROFILES, tally::TextMap};
use crate::{
    error::{Error, Result},
    folders::{scene_of, view_request},
    models::ImageText,
    pipeline::{
        Pipeline, Reconstruction, masks, reconstruct,
        semantics::{SemanticsInput, SemanticsOptions, understand},
    },
    render::{Kinds, Labels, PixelWeights, RenderRequest, ViewPlanner, cpu::CpuRenderer},
    scene::{
        Bank, Camera, Crop, PhotoMasks, PosedPhoto, SceneOptions, ScoringProfile, SemanticsReport,
        StageTime, Watch,
    },
};

/// What every target is seen with.
pub(super) struct Tools<'a> {
    engine: &'a Pipeline,
    renderer: &'a CpuRenderer,
    towers: Arc<ImageText>,
    understanding: SemanticsOptions,
    /// How each profile scores, as [`PROFILES`].
    scorings: Vec<Arc<Scoring>>,
}

/// One target, seen from its inputs.
pub(super) struct Seen {
    /// The view's colours, for pictures.
    pub(super) color: Vec<[f32; 3]>,
    pub(super) report: TargetReport,
    scene: Rows,
    flat: Rows,
}

/// How one target went.
#[derive(Clone, Debug, Serialize)]
pub struct TargetReport {
    /// File of the target.
    pub target: String,
    /// Files of the inputs, the nearest first.
    pub inputs: Vec<String>,
    /// How semantics went: masks, bank size, times.
    pub semantics: SemanticsReport,
    /// Times of the stages before.
    pub stages: Vec<StageTime>,
    /// Mean sum of the weights that a pixel of the target has over the bank, 0..1.
    pub coverage: f64,
    /// What looked wrong with the inputs.
    pub warnings: usize,
}

/// A bank and the weights of each pixel of the target over it.
struct Rows {
    bank: Bank,
    weights: PixelWeights,
}

impl<'a> Tools<'a> {
    pub(super) fn open(
        engine: &'a Pipeline,
        renderer: &'a CpuRenderer,
        understanding: SemanticsOptions,
    ) -> Result<Self> {
        let scorings = PROFILES.iter().map(|&profile| Ok(Arc::new(engine.scoring(profile)?)));
        let scorings = scorings.collect::<Result<_>>()?;
        let towers = engine.image_text()?;
        Ok(Self { engine, renderer, towers, understanding, scorings })
    }

    /// Name and version of the bundle.
    pub(super) fn bundle(&self) -> String {
        let bundle = self.engine.bundle();
        format!("{} {}", bundle.name(), bundle.version())
    }

    /// Unit embeddings of texts.
    pub(super) fn texts(&self, texts: &[String]) -> Result<Vec<Vec<f32>>> {
        Ok(self.towers.embed_texts(texts)?.into_iter().map(|text| text.row).collect())
    }

    /// Makes the scene of `inputs` and looks at it from the target's camera.
    pub(super) fn see(
        &self,
        photos: &[PosedPhoto],
        target: usize,
        inputs: &[usize],
    ) -> Result<Seen> {
        let given: Vec<PosedPhoto> = inputs.iter().map(|&i| photos[i].clone()).collect();
        let cancel = AtomicBool::new(false);
        let made = reconstruct(self.engine, &given, &SceneOptions::default(), &|_, _| (), &cancel)?;
        let parts =
            SemanticsInput { photos: &given, cameras: &made.cameras, gaussians: &made.gaussians };
        let watch = Watch { progress: &|_, _| (), cancel: &cancel };
        let meaning = understand(self.engine, &parts, &self.understanding, watch)?;
        let gaussians = made.gaussians.with_semantic_index(meaning.index)?;
        let plain = view_request(photos[target].camera, Kinds::COLOR, made.report.median_depth);
        let request = RenderRequest { labels: Labels::Weights, ..plain };
        let (warnings, stages) = (made.report.warnings.len(), made.report.stages.clone());
        let scene = scene_of(Reconstruction { gaussians, ..made });
        let frame = ViewPlanner::default().render(self.renderer, &scene, &request, true)?;
        let weights = frame.weights.ok_or_else(|| Error::internal("the view has no weights"))?;
        let weight: f64 = weights.weights.iter().map(|w| f64::from(*w)).sum();
        let report = TargetReport {
            target: photos[target].file.clone(),
            inputs: given.iter().map(|photo| photo.file.clone()).collect(),
            semantics: meaning.report,
            stages,
            coverage: weight / weights.pixels().max(1) as f64,
            warnings,
        };
        Ok(Seen {
            color: frame.color.unwrap_or_default(),
            scene: Rows { bank: meaning.bank, weights },
            flat: self.flat(&given[0], &photos[target].camera, &cancel)?,
            report,
        })
    }

    /// The masks of one photo, each with a row of its own, laid over a picture of the size of the
    /// target.
    fn flat(&self, photo: &PosedPhoto, target: &Camera, cancel: &AtomicBool) -> Result<Rows> {
        let network = self.engine.masks()?;
        let settings = masks::settings(network.manifest());
        let found = masks::photo_masks(
            &network,
            std::slice::from_ref(photo),
            None,
            &settings,
            &|_| (),
            cancel,
        )?;
        let none = PhotoMasks::default();
        let masks = found.first().unwrap_or(&none);
        let cutter = Cutter::new(&photo.photo, masks);
        let manifest = self.towers.manifest();
        let margin = f64::from(manifest.image.crop_margin);
        let cut = |k: usize| cutter.cut(k, margin).unwrap_or(Crop { side: 1, rgb: vec![0; 3] });
        let mut rows = Vec::new();
        let all: Vec<usize> = (0..masks.masks.len()).collect();
        for batch in all.chunks(manifest.image.batch.max(1)) {
            let crops: Vec<Crop> = batch.iter().map(|k| cut(*k)).collect();
            rows.extend(self.towers.embed_images(&crops)?);
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
        Ok(Rows { bank: Bank { dim: manifest.dim, rows }, weights })
    }
}

impl Seen {
    /// What each text says of each pixel of the view of the scene, and of the nearest photo taken
    /// for the target.
    pub(super) fn maps(
        &self,
        tools: &Tools<'_>,
        profile: ScoringProfile,
        texts: &[Vec<f32>],
    ) -> Result<[Vec<TextMap>; 2]> {
        let at = PROFILES.iter().position(|of| *of == profile).unwrap_or_default();
        let scoring = &tools.scorings[at];
        Ok([self.scene.maps(scoring, texts)?, self.flat.maps(scoring, texts)?])
    }
}

impl Rows {
    /// The product's masks, and scores by which texts can be compared at a pixel.
    ///
    /// At one pixel all texts share the feature's length, so the smallest `E . B(q - c)` over the
    /// phrases orders them as their relevancies do.
    fn maps(&self, scoring: &Arc<Scoring>, texts: &[Vec<f32>]) -> Result<Vec<TextMap>> {
        let scorer = Scorer::new(&self.bank, Arc::clone(scoring))?;
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
