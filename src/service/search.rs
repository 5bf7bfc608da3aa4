//! Texts and scenes: the data that views, queries, picks and exports need.
//!
//! A [`Backend`] keeps what earlier texts needed: embeddings, banks ready to be scored, words that
//! a network masked in the photos, connected components, and the weights of views. A
//! [`SceneTexts`] is one scene, the texts for it, and how the bank scores them.

use std::{
    collections::{BTreeSet, HashMap},
    sync::{Arc, OnceLock},
};

use parking_lot::Mutex;

use super::{
    request::ScoringOptions,
    tags::{cache_key, etag, semantics_tag, text_key},
    times::{ViewTimes, staged},
    types::{KnownWord, TextWarning},
    words::KnownWords,
};
use crate::{
    cache::Cache,
    error::{Error, Result},
    jobs::{Phrases, SemanticNetworks},
    limits::Limits,
    render::{Labels, PixelWeights, RenderRequest, Renderer},
    scene::{Gaussians, Preset, Scene, ScoringMethod, Semantics, TextEmbedding},
    semantics::{Components, InstanceOptions, Scorer, Scoring, TextScores, ViewNorms, WordBank},
};

/// Finds texts in the photos of a scene: of each one the score at each Gaussian, thousandths;
/// `None` where that cannot be.
pub(super) type FindWords<'a> = dyn Fn(&Scene, &[String]) -> Result<Option<Vec<Vec<u16>>>> + 'a;

/// How a call wants texts to be scored.
#[derive(Clone, Debug, Default)]
pub(super) struct ScoringChoice {
    /// That of the scene where none is named.
    pub(super) preset: Option<Preset>,
    /// What is changed of it.
    pub(super) changes: ScoringOptions,
}

/// What answers are computed with, and what was kept from earlier texts. Its calls block; they
/// belong on a blocking thread.
pub(super) struct Backend {
    pub(super) renderer: Arc<dyn Renderer>,
    networks: Arc<dyn SemanticNetworks>,
    words: KnownWords,
    /// By text; each weighs 1.
    embeddings: Cache<String, Arc<TextEmbedding>>,
    /// By scene, semantics and the choice of scoring, with what the choice came to; by bytes.
    scorers: Cache<String, (ScoringMethod, Arc<Scorer>)>,
    /// Scores of texts that were found in photos, by scene and text; by bytes.
    found: Cache<String, Arc<[u16]>>,
    /// Banks of such texts, by scene and texts; by bytes.
    worded: Cache<String, Arc<WordedScene>>,
    /// Held by who finds texts in photos: who asks for the same ones waits for them.
    finding: Mutex<()>,
    /// By scene and semantics; by bytes.
    components: Cache<String, Arc<Components>>,
    /// By scene, semantics, renderer and camera; by bytes.
    views: Cache<String, Arc<LabelledView>>,
}

impl Backend {
    pub(super) fn new(
        renderer: Arc<dyn Renderer>,
        networks: Arc<dyn SemanticNetworks>,
        words: &[KnownWord],
        limits: &Limits,
    ) -> Self {
        Self {
            renderer,
            networks,
            words: KnownWords::new(words),
            embeddings: Cache::new(limits.texts_cached_max as u64),
            scorers: Cache::new(limits.scorers_cache_bytes_max),
            found: Cache::new(limits.scorers_cache_bytes_max),
            worded: Cache::new(limits.scorers_cache_bytes_max),
            finding: Mutex::default(),
            components: Cache::new(limits.pieces_cache_bytes_max),
            views: Cache::new(limits.entries_cache_bytes_max),
        }
    }

    /// What the bundle lacks, `None` where nothing.
    pub(super) fn lacks(&self) -> Option<String> {
        self.networks.lacks()
    }

    /// Whether texts are found in the photos of a scene.
    pub(super) fn masks_texts(&self) -> bool {
        self.networks.masks_texts()
    }

    /// Embeddings of texts: known ones from memory, all others from one run of the network.
    fn embedded(&self, texts: &[String]) -> Result<Vec<Arc<TextEmbedding>>> {
        let known =
            texts.iter().filter_map(|text| Some((text.clone(), self.embeddings.find(text)?)));
        let mut found: HashMap<String, Arc<TextEmbedding>> = known.collect();
        let unknown: BTreeSet<&String> =
            texts.iter().filter(|text| !found.contains_key(*text)).collect();
        let unknown: Vec<String> = unknown.into_iter().cloned().collect();
        if !unknown.is_empty() {
            let new = self.networks.embed_texts(&unknown)?;
            for (text, embedding) in unknown.into_iter().zip(new) {
                let embedding = Arc::new(embedding);
                self.embeddings.insert(text.clone(), Arc::clone(&embedding), 1);
                found.insert(text, embedding);
            }
        }
        let lost = || Error::internal("a text has no embedding");
        texts.iter().map(|text| found.get(text).cloned().ok_or_else(lost)).collect()
    }

    /// How texts are scored by a preset with some changes.
    fn scoring(&self, preset: Preset, changes: &ScoringOptions) -> Result<ScoringMethod> {
        let Phrases { canon, tau, coverage_floor, margin, rivals } = self.networks.phrases()?;
        let [tau, floor, margin, rivals] = [tau, coverage_floor, margin, rivals].map(f64::from);
        let of_preset = ScoringMethod::of(preset, canon, tau, floor, margin, rivals);
        let method = changes.change(of_preset);
        method.check()?;
        Ok(method)
    }

    /// How texts are scored for a scene, and its bank ready for that.
    fn scorer(
        &self,
        of: &SemanticScene,
        preset: Preset,
        changes: &ScoringOptions,
    ) -> Result<(ScoringMethod, Arc<Scorer>)> {
        let key = text_key(&of.tag, None, preset, changes)?;
        if let Some(known) = self.scorers.find(&key) {
            return Ok(known);
        }
        let method = self.scoring(preset, changes)?;
        let canon = self.embedded(&method.canon)?;
        let canon = canon.iter().map(|embedding| embedding.row.clone()).collect();
        let listed = method.rivals < 1.0;
        let words = if listed { self.networks.rivals()? } else { Arc::default() };
        let scoring = Arc::new(Scoring::new(&method, canon, words)?);
        let bank = &of.semantics.bank;
        let views = &of.semantics.views;
        let mut scorer = Scorer::new(bank, scoring)?.with_views(views)?;
        if !views.entries.is_empty() {
            let components = self.components(of, &InstanceOptions::default());
            scorer = scorer.with_touching(&components.touching_entries());
        }
        let made = (method, Arc::new(scorer));
        let rows = bank.len() as u64;
        // Rows with their views, and the products of each two of them.
        let numbers = (bank.rows.len() + of.semantics.views.rows.len()) as u64;
        let bytes = 4 * numbers + 4 * rows * (rows + 1);
        self.scorers.insert(key, made.clone(), bytes);
        Ok(made)
    }

    /// The connected components of a scene's entries.
    fn components(&self, of: &SemanticScene, options: &InstanceOptions) -> Arc<Components> {
        if let Some(known) = self.components.find(&of.tag) {
            return known;
        }
        let scene = &of.scene;
        let made = Arc::new(Components::new(&scene.gaussians, &scene.meta.cameras, options));
        self.components.insert(of.tag.clone(), Arc::clone(&made), made.size_bytes());
        made
    }

    /// Scores of texts at the Gaussians of a scene, found in its photos by `find` where they are
    /// not known; `None` where that cannot be.
    fn found(
        &self,
        of: &SemanticScene,
        texts: &[String],
        find: &FindWords<'_>,
    ) -> Result<Option<Vec<Arc<[u16]>>>> {
        let key = |text: &String| format!("{} {text}", of.tag);
        let known = |text: &String| self.found.find(&key(text));
        if let Some(all) = texts.iter().map(known).collect() {
            return Ok(Some(all));
        }
        let _alone = self.finding.lock();
        let unknown: BTreeSet<&String> =
            texts.iter().filter(|text| known(text).is_none()).collect();
        let unknown: Vec<String> = unknown.into_iter().cloned().collect();
        let mut found = HashMap::new();
        if !unknown.is_empty() {
            let Some(new) = find(&of.scene, &unknown)? else { return Ok(None) };
            for (text, scores) in unknown.into_iter().zip(new) {
                let scores: Arc<[u16]> = scores.into();
                self.found.insert(key(&text), Arc::clone(&scores), 2 * scores.len() as u64);
                found.insert(text, scores);
            }
        }
        let lost = || Error::internal("a text has no scores");
        let scores =
            |text: &String| found.get(text).cloned().or_else(|| known(text)).ok_or_else(lost);
        texts.iter().map(scores).collect::<Result<_>>().map(Some)
    }

    /// A scene whose entries are texts that were found in its photos; `None` where that cannot be.
    fn worded(
        &self,
        of: &SemanticScene,
        texts: &[String],
        find: &FindWords<'_>,
    ) -> Result<Option<Arc<WordedScene>>> {
        let key = cache_key(&(&of.tag, texts))?;
        if let Some(known) = self.worded.find(&key) {
            return Ok(Some(known));
        }
        let Some(found) = self.found(of, texts, find)? else { return Ok(None) };
        let found: Vec<&[u16]> = found.iter().map(|scores| &**scores).collect();
        let words = WordBank::new(&found, of.scene.gaussians.len())?;
        let scoring = WordBank::method(f64::from(self.networks.phrases()?.coverage_floor));
        let how = Scoring::new(&scoring, vec![words.canon], Arc::default())?;
        let scorer = Arc::new(Scorer::new(&words.bank, Arc::new(how))?);
        let bytes = 2 * words.index.len() as u64 + 8 * words.bank.rows.len() as u64;
        let report = of.semantics.report.clone();
        let (bank, index) = (words.bank, words.index);
        let semantics = Arc::new(Semantics { bank, index, report, ..Semantics::default() });
        let scene = Arc::new(of.scene.with_semantics(Arc::clone(&semantics))?);
        let of = SemanticScene { scene, semantics, tag: etag(&key), load_ms: of.load_ms };
        let made = Arc::new(WordedScene { of, scorer, scoring, texts: words.texts });
        self.worded.insert(key, Arc::clone(&made), bytes);
        Ok(Some(made))
    }
}

/// A scene whose entries are combinations of texts that were found in its photos.
struct WordedScene {
    of: SemanticScene,
    scorer: Arc<Scorer>,
    scoring: ScoringMethod,
    /// What scores each text.
    texts: Vec<Vec<f32>>,
}

/// A text, how the bank scores it, what is known of its word, and what makes that doubtful.
#[derive(Clone, Debug)]
pub(super) struct ScoredText {
    pub(super) text: String,
    pub(super) scores: TextScores,
    pub(super) known: Option<KnownWord>,
    pub(super) warnings: Vec<TextWarning>,
}

impl ScoredText {
    /// Entries that the text selects, ascending.
    pub(super) fn selected(&self) -> Vec<u16> {
        let count = u16::try_from(self.scores.relevancies().len()).unwrap_or(u16::MAX);
        (1..count).filter(|&m| self.scores.selects(m)).collect()
    }
}

/// The weights of a view's pixels over the bank: they answer every further text without a drawing.
#[derive(Debug)]
pub(super) struct LabelledView {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) weights: PixelWeights,
    /// Of plain rows, and of rows of length 1.
    norms: [OnceLock<ViewNorms>; 2],
}

impl LabelledView {
    /// Lengths of the pixels' features, for all texts.
    pub(super) fn norms(&self, scorer: &Scorer) -> Result<&ViewNorms> {
        let kept = &self.norms[usize::from(scorer.scoring().unit_rows())];
        match kept.get() {
            Some(norms) => Ok(norms),
            None => {
                let norms = scorer.norms(&self.weights)?;
                Ok(kept.get_or_init(|| norms))
            }
        }
    }

    /// `[H * W]` relevancy of a text.
    pub(super) fn relevancy(&self, scorer: &Scorer, text: &TextScores) -> Result<Vec<f32>> {
        scorer.relevancy(text, &self.weights, self.norms(scorer)?)
    }

    /// `[H * W]` entry of the largest weight, 0 where the weights are too small together.
    pub(super) fn strongest(&self, scorer: &Scorer) -> Vec<u16> {
        let floor = scorer.scoring().coverage_floor();
        let strongest = |i: usize| {
            let (mut best, mut most, mut coverage) = (0, 0.0_f32, 0.0_f64);
            for (index, weight) in self.weights.pixel(i) {
                coverage += f64::from(weight);
                if weight > most {
                    (best, most) = (index, weight);
                }
            }
            if coverage < floor { 0 } else { best }
        };
        (0..self.weights.pixels()).map(strongest).collect()
    }

    fn size_bytes(&self) -> u64 {
        // Norms of both kinds, also where they are not computed yet.
        self.weights.size_bytes() + 2 * 4 * self.weights.pixels() as u64
    }
}

/// A scene with its semantics, ready for texts.
#[derive(Clone, Debug)]
pub(super) struct SemanticScene {
    pub(super) scene: Arc<Scene>,
    pub(super) semantics: Arc<Semantics>,
    /// Tells this scene with these semantics from all others.
    pub(super) tag: String,
    /// Time until it was ready, milliseconds.
    pub(super) load_ms: f64,
}

impl SemanticScene {
    /// `None` where the scene has no semantics.
    pub(super) fn new(scene: Arc<Scene>) -> Option<Self> {
        let semantics = scene.semantics.clone()?;
        let tag = semantics_tag(&scene);
        Some(Self { scene, semantics, tag, load_ms: 0.0 })
    }
}

/// A scene and its scored texts. It is made once for a call, and needs no network afterwards.
pub(super) struct SceneTexts {
    pub(super) backend: Arc<Backend>,
    /// What the texts are scored with.
    pub(super) of: SemanticScene,
    /// The scene as it is stored: another one where the texts were found in its photos.
    pub(super) stored: SemanticScene,
    pub(super) scorer: Arc<Scorer>,
    pub(super) scoring: ScoringMethod,
    preset: Preset,
    changes: ScoringOptions,
    pub(super) texts: Vec<ScoredText>,
    /// Time of scoring, milliseconds.
    score_ms: f64,
}

impl SceneTexts {
    /// Scores checked texts. Networks embed those that are not known. With `find` and the scoring
    /// of the default they are found in the scene's photos, where that can be. Blocks.
    pub(super) fn new(
        backend: &Arc<Backend>,
        of: SemanticScene,
        how: &ScoringChoice,
        texts: &[String],
        find: Option<&FindWords<'_>>,
    ) -> Result<Self> {
        let score = || {
            let preset = how.preset.unwrap_or(of.scene.meta.report.method.preset);
            let plain = preset == Preset::Default && how.changes == ScoringOptions::default();
            if let Some(find) = find.filter(|_| plain && !texts.is_empty())
                && let Some(worded) = backend.worded(&of, texts, find)?
            {
                return Self::worded(backend, of, preset, texts, &worded);
            }
            let (scoring, scorer) = backend.scorer(&of, preset, &how.changes)?;
            let scored = |(text, embedding): (&String, Arc<TextEmbedding>)| {
                let scores = scorer.text(&embedding.row)?;
                let silent = embedding.unknown > 0 && embedding.unknown >= embedding.tokens;
                Ok(ScoredText {
                    text: text.clone(),
                    scores: if silent { scores.silent() } else { scores },
                    known: backend.words.of(text).cloned(),
                    warnings: warnings(text, &embedding),
                })
            };
            let embeddings = backend.embedded(texts)?;
            let texts = texts.iter().zip(embeddings).map(scored).collect::<Result<_>>()?;
            let (backend, changes) = (Arc::clone(backend), how.changes.clone());
            let (stored, score_ms) = (of.clone(), 0.0);
            Ok(Self { backend, of, stored, scorer, scoring, preset, changes, texts, score_ms })
        };
        let (made, score_ms) = staged("score", score);
        Ok(Self { score_ms, ..made? })
    }

    /// Texts that were found in the scene's photos.
    fn worded(
        backend: &Arc<Backend>,
        stored: SemanticScene,
        preset: Preset,
        texts: &[String],
        worded: &WordedScene,
    ) -> Result<Self> {
        let scored = |(text, row): (&String, &Vec<f32>)| {
            let scores = worded.scorer.text(row)?;
            // What is known of a word is of the towers.
            Ok(ScoredText { text: text.clone(), scores, known: None, warnings: Vec::new() })
        };
        Ok(Self {
            backend: Arc::clone(backend),
            of: SemanticScene { load_ms: stored.load_ms, ..worded.of.clone() },
            stored,
            scorer: Arc::clone(&worded.scorer),
            scoring: worded.scoring.clone(),
            preset,
            changes: ScoringOptions::default(),
            texts: texts.iter().zip(&worded.texts).map(scored).collect::<Result<_>>()?,
            score_ms: 0.0,
        })
    }

    /// Whether the texts were found in the scene's photos: entries are of these texts alone.
    pub(super) fn is_of_photos(&self) -> bool {
        self.of.tag != self.stored.tag
    }

    /// What tells the first text, how it is scored and the scene from all others, in tags.
    pub(super) fn key(&self) -> Result<String> {
        let text = self.texts.first().map(|text| text.text.as_str());
        text_key(&self.of.tag, text, self.preset, &self.changes)
    }

    /// Times of an answer as far as the texts are scored.
    pub(super) fn times(&self) -> ViewTimes {
        let (load_ms, score_ms) = (self.of.load_ms, Some(self.score_ms));
        ViewTimes { load_ms, score_ms, ..ViewTimes::default() }
    }

    /// The connected components of the scene's entries.
    pub(super) fn components(&self, options: &InstanceOptions) -> Arc<Components> {
        self.backend.components(&self.of, options)
    }

    /// The Gaussians that any of the texts selects.
    pub(super) fn gaussians(&self) -> Gaussians {
        let index = self.of.scene.gaussians.semantic_index();
        let most = index.iter().copied().max().unwrap_or(0);
        let mut chosen = vec![false; usize::from(most) + 1];
        for m in self.texts.iter().flat_map(ScoredText::selected).filter(|&m| m <= most) {
            chosen[usize::from(m)] = true;
        }
        self.stored.scene.gaussians.only(|i| chosen[usize::from(index[i])])
    }

    /// A view's weights where they are still known; `key` tells the view from all others.
    pub(super) fn known_view(&self, key: &str) -> Option<Arc<LabelledView>> {
        self.backend.views.find(&key.to_owned())
    }

    /// Keeps the weights of a view that was drawn.
    pub(super) fn keep_view(
        &self,
        key: String,
        [width, height]: [u32; 2],
        weights: PixelWeights,
    ) -> Arc<LabelledView> {
        let view = Arc::new(LabelledView { width, height, weights, norms: Default::default() });
        self.backend.views.insert(key, Arc::clone(&view), view.size_bytes());
        view
    }

    /// A view's weights, drawn where they are not known; and whether they are new.
    pub(super) fn view(
        &self,
        request: &RenderRequest,
        key: String,
    ) -> Result<(Arc<LabelledView>, bool)> {
        if let Some(known) = self.known_view(&key) {
            return Ok((known, false));
        }
        let request = RenderRequest { labels: Labels::Weights, ..request.clone() };
        let frame = self.backend.renderer.render(&self.of.scene.gaussians, &request)?;
        let weights =
            frame.weights.ok_or_else(|| Error::internal("the renderer gave no weights"))?;
        Ok((self.keep_view(key, [frame.width, frame.height], weights), true))
    }
}

fn warnings(text: &str, embedding: &TextEmbedding) -> Vec<TextWarning> {
    let warning = |code: &str, message: String| TextWarning { code: code.to_owned(), message };
    let mut warnings = Vec::new();
    let (tokens, unknown) = (embedding.tokens, embedding.unknown);
    if unknown > 0 && unknown >= tokens {
        let message = format!("the text tower knows no word of {text:?}, so it finds nothing");
        warnings.push(warning("unknown_words", message));
    } else if unknown > 0 {
        let message = format!("the text tower does not know {unknown} of {tokens} pieces of it");
        warnings.push(warning("unknown_words", message));
    }
    if embedding.cut {
        let message = format!("the text is longer than the text tower reads: {text:?} was cut");
        warnings.push(warning("text_cut", message));
    }
    warnings
}
