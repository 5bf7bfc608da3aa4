//! What texts are answered with: embeddings of texts, banks ready to be scored, and views whose
//! semantic entries are still known. Each is kept for as long as it is asked.

use std::{
    collections::HashMap,
    sync::{Arc, OnceLock},
};

use super::{lru::Lru, types::TextWarning};
use crate::{
    error::{Error, Result},
    jobs::{Phrases, SemanticsMaker, TextEmbedding},
    limits::Limits,
    render::{Entries, Labels, RenderRequest, Renderer, compose},
    scene::{Scene, ScoringProfile, Semantics},
    semantics::{PartOptions, Pieces, PixelEntries, Scorer, Scoring, TextScores, ViewNorms},
};

/// What the paper compares texts with, and how sharply.
const PAPER_CANON: [&str; 3] = ["object", "things", "stuff"];
const PAPER_TAU: f32 = 10.0;

/// Caches and the maker behind them. Calls block; they belong on a thread made for it.
pub(super) struct Asker {
    maker: Arc<dyn SemanticsMaker>,
    /// By text; each weighs 1.
    texts: Lru<String, Arc<TextEmbedding>>,
    /// By scene, semantics and profile; by bytes.
    scorers: Lru<String, Arc<Scorer>>,
    /// By scene and semantics; by bytes.
    pieces: Lru<String, Arc<Pieces>>,
    /// By scene, semantics, renderer and camera; by bytes.
    views: Lru<String, Arc<SeenView>>,
}

/// A text and what the bank says of it.
#[derive(Clone, Debug)]
pub(super) struct Asked {
    pub(super) text: String,
    pub(super) scores: TextScores,
    pub(super) warnings: Vec<TextWarning>,
}

/// E of a view, which answers every further text without drawing.
#[derive(Debug)]
pub(super) struct SeenView {
    pub(super) width: u32,
    pub(super) height: u32,
    entries: Entries,
    /// Of the profiles, in the order of [`profile_at`].
    norms: [OnceLock<ViewNorms>; 2],
}

impl SeenView {
    fn new(width: u32, height: u32, entries: Entries) -> Self {
        Self { width, height, entries, norms: Default::default() }
    }

    pub(super) fn entries(&self) -> PixelEntries<'_> {
        PixelEntries {
            offsets: &self.entries.offsets,
            index: &self.entries.index,
            weight: &self.entries.weight,
        }
    }

    /// Relevancy of each pixel.
    pub(super) fn relevancy(&self, scorer: &Scorer, text: &TextScores) -> Result<Vec<f32>> {
        let kept = &self.norms[profile_at(scorer.scoring().profile())];
        let norms = match kept.get() {
            Some(norms) => norms,
            None => {
                let made = scorer.norms(self.entries())?;
                kept.get_or_init(|| made)
            }
        };
        scorer.relevancy(text, self.entries(), norms)
    }

    /// The entry that each pixel sees most of, 0 where it sees too little of any.
    pub(super) fn strongest(&self, scorer: &Scorer) -> Vec<u16> {
        let floor = scorer.scoring().coverage_floor();
        let strongest = |i: usize| {
            let (mut best, mut most, mut coverage) = (0, 0.0_f32, 0.0_f64);
            for (index, weight) in self.entries.pixel(i) {
                coverage += f64::from(weight);
                if weight > most {
                    (best, most) = (index, weight);
                }
            }
            if coverage < floor { 0 } else { best }
        };
        (0..self.entries.pixels()).map(strongest).collect()
    }

    fn size_bytes(&self) -> u64 {
        // Norms of both profiles, whether they are made yet or not.
        self.entries.size_bytes() + 2 * 4 * self.entries.pixels() as u64
    }
}

fn profile_at(profile: ScoringProfile) -> usize {
    match profile {
        ScoringProfile::Default => 0,
        ScoringProfile::Paper => 1,
    }
}

impl Asker {
    pub(super) fn new(maker: Arc<dyn SemanticsMaker>, limits: &Limits) -> Self {
        Self {
            maker,
            texts: Lru::new(limits.texts_cached_max as u64),
            scorers: Lru::new(limits.scorers_cache_bytes_max),
            pieces: Lru::new(limits.pieces_cache_bytes_max),
            views: Lru::new(limits.entries_cache_bytes_max),
        }
    }

    /// What the bundle lacks, `None` where nothing.
    pub(super) fn lacks(&self) -> Option<String> {
        self.maker.lacks()
    }

    /// Embeddings of texts, those asked before from memory and the others in one run.
    fn embedded(&self, texts: &[String]) -> Result<Vec<Arc<TextEmbedding>>> {
        let known: Vec<_> = texts.iter().map(|text| self.texts.find(text)).collect();
        let unknown = texts.iter().zip(&known).filter(|(_, known)| known.is_none());
        let mut unknown: Vec<String> = unknown.map(|(text, _)| text.clone()).collect();
        unknown.sort_unstable();
        unknown.dedup();
        let made =
            if unknown.is_empty() { Vec::new() } else { self.maker.embed_texts(&unknown)? };
        let made = unknown.into_iter().zip(made.into_iter().map(Arc::new));
        let made: HashMap<String, Arc<TextEmbedding>> = made.collect();
        for (text, embedding) in &made {
            self.texts.insert(text.clone(), Arc::clone(embedding), 1);
        }
        let of = |(text, known): (&String, Option<_>)| {
            let embedding = known.or_else(|| made.get(text).cloned());
            embedding.ok_or_else(|| Error::internal("a text has no embedding"))
        };
        texts.iter().zip(known).map(of).collect()
    }

    /// A bank ready to be scored under a profile; `tag` tells scene and semantics.
    pub(super) fn scorer(
        &self,
        tag: &str,
        semantics: &Semantics,
        profile: ScoringProfile,
    ) -> Result<Arc<Scorer>> {
        let key = format!("{tag} {profile:?}");
        if let Some(known) = self.scorers.find(&key) {
            return Ok(known);
        }
        let phrases = match profile {
            ScoringProfile::Default => self.maker.phrases()?,
            ScoringProfile::Paper => Phrases {
                canon: PAPER_CANON.map(str::to_owned).to_vec(),
                tau: PAPER_TAU,
                coverage_floor: 0.0,
            },
        };
        let canon = self.embedded(&phrases.canon)?;
        let canon = canon.iter().map(|embedding| embedding.row.clone()).collect();
        let (tau, floor) = (f64::from(phrases.tau), f64::from(phrases.coverage_floor));
        let scoring = Arc::new(Scoring::new(profile, canon, tau, floor)?);
        let scorer = Arc::new(Scorer::new(&semantics.bank, scoring)?);
        let rows = semantics.bank.len() as u64;
        // Rows, and the products of each two of them.
        let bytes = 4 * semantics.bank.rows.len() as u64 + 4 * rows * (rows + 1);
        self.scorers.insert(key, Arc::clone(&scorer), bytes);
        Ok(scorer)
    }

    /// The connected pieces of a scene's entries; `tag` tells scene and semantics.
    pub(super) fn pieces(&self, tag: &str, scene: &Scene, options: &PartOptions) -> Arc<Pieces> {
        if let Some(known) = self.pieces.find(&tag.to_owned()) {
            return known;
        }
        let made = Arc::new(Pieces::new(&scene.gaussians, &scene.meta.cameras, options));
        self.pieces.insert(tag.to_owned(), Arc::clone(&made), made.size_bytes());
        made
    }

    /// Texts scored against a bank.
    pub(super) fn ask(&self, scorer: &Scorer, texts: &[String]) -> Result<Vec<Asked>> {
        let embeddings = self.embedded(texts)?;
        let asked = |(text, embedding): (&String, Arc<TextEmbedding>)| {
            Ok(Asked {
                text: text.clone(),
                scores: scorer.text(&embedding.row)?,
                warnings: warnings(text, &embedding),
            })
        };
        texts.iter().zip(embeddings).map(asked).collect()
    }

    /// E of a view where it is still known; `key` tells scene, semantics, renderer and camera.
    pub(super) fn known_view(&self, key: &str) -> Option<Arc<SeenView>> {
        self.views.find(&key.to_owned())
    }

    /// Keeps E of a view that was drawn.
    pub(super) fn keep_view(
        &self,
        key: String,
        width: u32,
        height: u32,
        entries: Entries,
    ) -> Arc<SeenView> {
        let seen = Arc::new(SeenView::new(width, height, entries));
        let bytes = seen.size_bytes();
        self.views.insert(key, Arc::clone(&seen), bytes);
        seen
    }

    /// E of a view, drawn where it is not known any more; and whether it was.
    pub(super) fn seen(
        &self,
        renderer: &dyn Renderer,
        scene: &Scene,
        request: &RenderRequest,
        key: String,
    ) -> Result<(Arc<SeenView>, bool)> {
        if let Some(known) = self.known_view(&key) {
            return Ok((known, false));
        }
        let request = RenderRequest { labels: Labels::Entries, ..request.clone() };
        let frame = compose::render_scene(renderer, scene, &request, false)?;
        let entries =
            frame.entries.ok_or_else(|| Error::internal("the renderer gave no entries"))?;
        Ok((self.keep_view(key, frame.width, frame.height, entries), true))
    }
}

fn warnings(text: &str, embedding: &TextEmbedding) -> Vec<TextWarning> {
    let warning = |code: &str, message: String| TextWarning { code: code.to_owned(), message };
    let mut warnings = Vec::new();
    let (tokens, unknown) = (embedding.tokens, embedding.unknown);
    if unknown > 0 && unknown >= tokens {
        let message = format!("the text tower knows no word of {text:?}; its scores mean nothing");
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
