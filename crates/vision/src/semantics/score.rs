//! Scores of a text against the bank, without the feature of any pixel.
//!
//! With the weights E of a pixel, the rows B of the bank, a text q and a phrase c:
//! `cos(F, q) - cos(F, c) = (E . B(q - c)) / sqrt(E^T B B^T E)`. So a text becomes one number for
//! each row and phrase, `d_c = B(q - c)`. A mask is the sign of a blend of these numbers, for any
//! size of the bank. Only a relevancy needs the norm, and the norm does not depend on the text.
//!
//! A row of tracks stands for masks of several photos ([`RowViews`]). There the number of a row is
//! the mean over the half of its masks that the text fits best, and over rows that look alike.

use std::{
    ops::Range,
    sync::{Arc, OnceLock},
};

use rayon::prelude::*;

use super::rows::{dot, norm, unit_rows};
use crate::{
    error::{Error, Result},
    scene::{Bank, PixelWeights, RowViews, ScoringMethod},
};

/// Phrases in one blend of four numbers; the fourth number is the coverage.
const GROUP: usize = 3;
/// Difference of cosines of an entry that fits a text much less than the best one does: under the
/// canon, as entries of other things are.
const LEFT_OUT: f64 = -0.05;
/// Rows with this cosine look alike: two photographs of things of one name have 0.5 (median), two
/// things of one photograph 0.35. docs/adr/0074-tracks.md
const ALIKE: f64 = 0.65;
/// Share of the best entry's difference of cosines, and difference of cosines, under which an entry
/// is not sure: another thing across the room mostly is not. docs/adr/0103-false-parts.md
const SURE_SHARE: f64 = 0.7;
const SURE: f64 = 0.06;
/// Pixels of a task.
const PIXELS_EACH: usize = 4096;

/// A [`ScoringMethod`] with the embeddings of its canonical texts.
#[derive(Clone, Debug, PartialEq)]
pub struct Scoring {
    unit_rows: bool,
    canon: Vec<Vec<f32>>,
    tau: f64,
    coverage_floor: f64,
    /// Difference of cosines that counts as none.
    zero: f64,
    /// Least difference of cosines over `zero` that is selected: the relevancy there is the cut.
    margin: f64,
    /// Difference of cosines by which an entry may fit a text less than the best entry does.
    near_best: f64,
    /// Embeddings of everyday words; empty where they do not count.
    words: Arc<[Vec<f32>]>,
    /// A text must fit an entry as well as the one of them that is at this place, from 1.
    rivals: usize,
}

impl Scoring {
    /// From the embeddings of the method's canonical texts, and of the bundle's list of words,
    /// which count where `rivals` is under 1; each of length 1.
    ///
    /// # Errors
    /// `invalid_request` when a number of the method is out of its bounds; `internal` when the
    /// embeddings are not those of its texts, differ in length, or have a number that is not
    /// finite.
    pub fn new(
        method: &ScoringMethod,
        canon: Vec<Vec<f32>>,
        words: Arc<[Vec<f32>]>,
    ) -> Result<Self> {
        method.check()?;
        let dim = canon.first().map_or(0, Vec::len);
        let mut all = canon.iter().chain(&*words);
        let fit = all.all(|c| c.len() == dim && c.iter().all(|v| v.is_finite()));
        if dim == 0 || canon.len() != method.canon.len() || !fit {
            return Err(Error::internal(format!(
                "scoring: {} embeddings, not all of {dim} finite numbers, for {} canonical texts",
                canon.len(),
                method.canon.len()
            )));
        }
        let ScoringMethod { unit_rows, tau, coverage_floor, margin: zero, cut, near_best, .. } =
            *method;
        // Exactly 0 for a cut of 0.5.
        let margin = (cut / (1.0 - cut)).ln() / tau;
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share")]
        let rivals = ((method.rivals * words.len() as f64) as usize).max(1);
        let words = if method.rivals < 1.0 { words } else { Arc::default() };
        Ok(Self { unit_rows, canon, tau, coverage_floor, zero, margin, near_best, words, rivals })
    }

    /// A pixel with less coverage has relevancy 0.
    #[must_use]
    pub fn coverage_floor(&self) -> f64 {
        self.coverage_floor
    }

    /// Whether rows are brought to length 1. Two scorings that agree in this share [`ViewNorms`].
    #[must_use]
    pub fn unit_rows(&self) -> bool {
        self.unit_rows
    }

    /// Whether a text selects where it is nearer than every canonical text (a cut of 0.5), so that
    /// a mask is the sign of a blend and needs no norms.
    #[must_use]
    pub fn is_signed(&self) -> bool {
        self.margin == 0.0
    }
}

/// 1 / length of the feature of each pixel of a view; 0 where it has no length. It serves every
/// text.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ViewNorms {
    inverse: Vec<f32>,
}

impl ViewNorms {
    /// Bytes held.
    #[must_use]
    pub fn size_bytes(&self) -> u64 {
        (self.inverse.len() * size_of::<f32>()) as u64
    }
}

/// The scores of a text against a bank.
#[derive(Clone, Debug, PartialEq)]
pub struct TextScores {
    /// For each group of three phrases: `[M + 1]` rows of 1 (it sums to the coverage) and three
    /// `B(q - c)`. Row 0 is zeros. A short group repeats its first phrase, which changes no result.
    groups: Vec<Vec<[f64; 4]>>,
    /// `[M + 1]` relevancy of each entry alone.
    relevancies: Vec<f32>,
    /// `[M + 1]` bit c is set if the row is nearer to phrase c than to the text. If all rows of a
    /// pixel share a bit, no weights can select the pixel. Row 0 adds nothing, so it has all bits.
    nearer: Vec<u64>,
    /// `[M]` lengths of the rows, shared with the scorer.
    norms: Arc<[f64]>,
    /// That of the scoring.
    margin: f64,
}

impl TextScores {
    /// The row, counted from 0, fits the text less than the canon does.
    fn leave_out(&mut self, row: usize) {
        let score = LEFT_OUT * self.norms[row];
        self.groups.iter_mut().for_each(|rows| rows[row + 1] = [1.0, score, score, score]);
        self.nearer[row + 1] = u64::MAX;
    }

    /// Entries count against a text by no more than the best one, which fits it by `best`, counts
    /// for it: else those beside an entry that is barely taken take its edges away.
    fn keep_edges(&mut self, best: f64) {
        let over = best - self.margin;
        if over <= 0.0 {
            return;
        }
        let least = self.margin - over;
        for rows in &mut self.groups {
            for (row, norm) in rows.iter_mut().skip(1).zip(&*self.norms) {
                row[1..].iter_mut().for_each(|score| *score = score.max(least * norm));
            }
        }
    }

    /// The scores of a text that says nothing: no entry fits it.
    #[must_use]
    pub fn silent(mut self) -> Self {
        (0..self.norms.len()).for_each(|row| self.leave_out(row));
        self.relevancies.fill(0.0);
        self
    }

    /// Tables to blend, one for each group of three phrases: `[M + 1]` rows of the coverage and
    /// three scores. A pixel is selected where its coverage reaches the floor, no blended score is
    /// under 0 and not all of them are 0.
    #[must_use]
    pub fn tables(&self) -> Vec<Arc<[[f32; 4]]>> {
        #[expect(clippy::cast_possible_truncation, reason = "renderers blend f32")]
        let table = |rows: &Vec<[f64; 4]>| rows.iter().map(|row| row.map(|v| v as f32)).collect();
        self.groups.iter().map(table).collect()
    }

    /// `[M + 1]` relevancy of each entry alone, 0..1; that of the background is 0.
    #[must_use]
    pub fn relevancies(&self) -> &[f32] {
        &self.relevancies
    }

    /// Whether no pixel can be selected, because all rows are nearer to the same phrase.
    #[must_use]
    pub fn selects_nothing(&self) -> bool {
        self.margin >= 0.0 && self.nearer.iter().fold(u64::MAX, |all, row| all & row) != 0
    }

    /// Whether the rows of pixel `p` exclude it, so that no blend is needed.
    fn ruled_out(&self, weights: &PixelWeights, p: usize) -> bool {
        if self.margin < 0.0 {
            return false;
        }
        let rows = weights.slices(p).0.iter();
        let nearer = |m: &u16| self.nearer.get(usize::from(*m)).copied().unwrap_or(u64::MAX);
        rows.fold(u64::MAX, |all, m| all & nearer(m)) != 0
    }

    /// Whether the text selects entry `m`.
    #[must_use]
    pub fn selects(&self, m: u16) -> bool {
        // The rule of the masks, so that 3D and views agree on ties.
        let known = m > 0 && usize::from(m) < self.relevancies.len();
        let [least, most, _] = self.blend(&[m], &[1.0]);
        let length = usize::from(m).checked_sub(1).and_then(|row| self.norms.get(row));
        known && self.takes([least, most], length.map_or(0.0, |length| length.recip()))
    }

    /// Whether a feature with these smallest and largest scores, and this 1 / length, is selected.
    fn takes(&self, [least, most]: [f64; 2], inverse: f64) -> bool {
        if self.margin == 0.0 {
            return selected(least, most);
        }
        inverse.is_finite() && inverse > 0.0 && least * inverse >= self.margin
    }

    fn blend_pixel(&self, weights: &PixelWeights, p: usize) -> [f64; 3] {
        let (entries, weights) = weights.slices(p);
        self.blend(entries, weights)
    }

    /// Smallest and largest blended score of a pixel's entries, and their coverage.
    fn blend(&self, entries: &[u16], weights: &[f32]) -> [f64; 3] {
        let (mut least, mut most, mut coverage) = (f64::INFINITY, f64::NEG_INFINITY, 0.0);
        for rows in &self.groups {
            // Entry 0 and entries beyond the bank add a row of zeros.
            let mut sums = [0.0_f64; 4];
            for (m, weight) in entries.iter().zip(weights) {
                let row = rows.get(usize::from(*m)).unwrap_or(&[0.0; 4]);
                let weight = f64::from(*weight);
                for (sum, v) in sums.iter_mut().zip(row) {
                    *sum += weight * v;
                }
            }
            coverage = sums[0];
            least = least.min(sums[1].min(sums[2]).min(sums[3]));
            most = most.max(sums[1].max(sums[2]).max(sums[3]));
        }
        [least, most, coverage]
    }
}

/// Whether a pixel is selected: no blended score is under 0 and not all of them are 0.
fn selected(least: f64, most: f64) -> bool {
    least >= 0.0 && most > 0.0
}

/// A bank under a scoring method, ready for texts.
#[derive(Debug)]
pub struct Scorer {
    bank: Bank,
    scoring: Arc<Scoring>,
    /// `[M]` lengths of the rows.
    norms: Arc<[f64]>,
    /// What a text is compared with, by row: see [`phrases`].
    phrases: Vec<Vec<f64>>,
    /// The masks that rows stand for; `None`: the rows are all there is.
    views: Option<Views>,
    /// `[M]` rows that touch each one in space; `None`: it is not known, or does not count.
    touching: Option<Vec<Vec<usize>>>,
    /// Lower triangle of B B^T, row by row. The first call of [`Self::norms`] computes it.
    gram: OnceLock<Vec<f64>>,
}

impl Scorer {
    /// Prepares a bank of plain centroids.
    ///
    /// # Errors
    /// `internal` when the bank's rows and the canonical phrases differ in length.
    pub fn new(bank: &Bank, scoring: Arc<Scoring>) -> Result<Self> {
        let dim = scoring.canon[0].len();
        if !bank.is_empty() && bank.dim != dim {
            return Err(Error::internal(format!(
                "scoring: rows of {} numbers, texts of {dim}",
                bank.dim
            )));
        }
        let rows = if scoring.unit_rows { unit_rows(bank) } else { bank.rows.clone() };
        let bank = Bank { dim, rows };
        let norms: Arc<[f64]> = bank.rows.chunks_exact(dim).map(norm).collect();
        let phrases = phrases(&bank, &norms, &scoring);
        let (views, touching, gram) = (None, None, OnceLock::new());
        Ok(Self { bank, scoring, norms, phrases, views, touching, gram })
    }

    /// The same, where a row stands for masks of several photos.
    ///
    /// # Errors
    /// `internal` when the views are not of this bank.
    pub fn with_views(mut self, views: &RowViews) -> Result<Self> {
        let rows = 1..=self.rows();
        if views.rows.len() != views.entries.len() * self.bank.dim
            || !views.entries.iter().all(|m| rows.contains(&usize::from(*m)))
        {
            return Err(Error::internal("scoring: the views are not of this bank"));
        }
        if !views.entries.is_empty() {
            self.views = Some(Views::new(views, &self.bank, &self.scoring));
            // The views are compared already.
            self.phrases = vec![vec![0.0; self.rows()]];
        }
        Ok(self)
    }

    /// The same, where pairs of entries touch in space: what a text takes must touch what it is
    /// sure of. A method that leaves out nothing by the best entry leaves out nothing here.
    #[must_use]
    pub fn with_touching(mut self, pairs: &[[u16; 2]]) -> Self {
        let mut touching = vec![Vec::new(); self.rows()];
        for pair in pairs.iter().map(|pair| pair.map(usize::from)) {
            for [entry, other] in [pair, [pair[1], pair[0]]] {
                if entry.min(other) > 0 && entry.max(other) <= self.rows() {
                    touching[entry - 1].push(other - 1);
                }
            }
        }
        let counts = self.scoring.near_best < ScoringMethod::NEAR_BEST_MAX;
        self.touching = counts.then_some(touching);
        self
    }

    /// Rows that a text takes though it is not sure of them, and they touch none of which it is,
    /// not even over others that it takes. The best one here has masks of several photos, where
    /// the text takes one that has: a speck of one photo mostly is another thing.
    fn apart(&self, leads: &[f64], best: f64) -> Vec<usize> {
        let Some(touching) = &self.touching else { return Vec::new() };
        let several = |row: &usize| self.views.as_ref().is_some_and(|of| of.of_row[*row].len() > 1);
        let several = (0..leads.len()).filter(several).map(|row| leads[row]);
        let best = several.filter(|lead| *lead >= 0.0).reduce(f64::max).unwrap_or(best);
        let mut sure: Vec<bool> =
            leads.iter().map(|lead| *lead >= (SURE_SHARE * best).clamp(0.0, SURE)).collect();
        let mut next: Vec<usize> = (0..sure.len()).filter(|row| sure[*row]).collect();
        while let Some(row) = next.pop() {
            for &other in &touching[row] {
                if leads[other] >= 0.0 && !std::mem::replace(&mut sure[other], true) {
                    next.push(other);
                }
            }
        }
        (0..sure.len()).filter(|row| leads[*row] >= 0.0 && !sure[*row]).collect()
    }

    /// How it scores.
    #[must_use]
    pub fn scoring(&self) -> &Scoring {
        &self.scoring
    }

    /// The rows as they are blended: plain centroids, or these at length 1.
    #[must_use]
    pub fn bank(&self) -> &Bank {
        &self.bank
    }

    /// Rows of the bank (M).
    #[must_use]
    pub fn rows(&self) -> usize {
        self.norms.len()
    }

    /// Scores a text by its unit embedding: M dot products.
    ///
    /// # Errors
    /// `internal` when the embedding's length is another or a number is not finite.
    pub fn text(&self, embedding: &[f32]) -> Result<TextScores> {
        if embedding.len() != self.bank.dim || embedding.iter().any(|v| !v.is_finite()) {
            return Err(Error::internal(format!(
                "scoring: a text of {} numbers, not {} finite ones",
                embedding.len(),
                self.bank.dim
            )));
        }
        let own = match &self.views {
            Some(views) => views
                .leads(embedding)
                .iter()
                .zip(&*self.norms)
                .map(|(lead, norm)| lead * norm)
                .collect(),
            None => scores(&self.bank, embedding),
        };
        let group = |canon: &[Vec<f64>]| -> Vec<[f64; 4]> {
            let row = |m: usize| {
                let [a, b, c] = [0, 1, 2].map(|g| own[m] - canon.get(g).unwrap_or(&canon[0])[m]);
                [1.0, a, b, c]
            };
            std::iter::once([0.0; 4]).chain((0..own.len()).map(row)).collect()
        };
        let nearer = |m: usize| {
            let phrases = self.phrases.iter().take(u64::BITS as usize).enumerate();
            phrases.fold(0_u64, |bits, (c, canon)| bits | u64::from(own[m] < canon[m]) << c)
        };
        let mut text = TextScores {
            groups: self.phrases.chunks(GROUP).map(group).collect(),
            relevancies: vec![0.0],
            nearer: std::iter::once(u64::MAX).chain((0..own.len()).map(nearer)).collect(),
            norms: Arc::clone(&self.norms),
            margin: self.scoring.margin,
        };
        let leads = (1..).zip(&*self.norms).map(|(m, length)| {
            let [least, ..] = text.blend(&[m], &[1.0]);
            if *length > 0.0 { least / length } else { f64::NEG_INFINITY }
        });
        let mut leads: Vec<f64> = leads.collect();
        // docs/adr/0062-near-the-best-entry.md
        let of_scene = |row: usize| self.views.as_ref().is_none_or(|of| !of.of_row[row].is_empty());
        let best =
            leads.iter().enumerate().filter(|(row, _)| of_scene(*row)).map(|(_, lead)| *lead);
        let best = best.fold(f64::NEG_INFINITY, f64::max);
        for (row, lead) in leads.iter_mut().enumerate() {
            if *lead >= 0.0 && *lead < best - self.scoring.near_best {
                *lead = LEFT_OUT;
                text.leave_out(row);
            }
        }
        for row in self.apart(&leads, best) {
            leads[row] = LEFT_OUT;
            text.leave_out(row);
        }
        if self.views.is_some() {
            text.keep_edges(best);
        }
        text.relevancies.extend(leads.iter().map(|lead| self.sharpen(*lead)));
        Ok(text)
    }

    /// The sigmoid of a difference of cosines, in a form that cannot overflow.
    fn sharpen(&self, difference: f64) -> f32 {
        #[expect(clippy::cast_possible_truncation, reason = "a score 0..1")]
        let score = (1.0 / (1.0 + (-self.scoring.tau * difference).exp())) as f32;
        score
    }

    /// Lengths of a view's features, for [`Self::relevancy`].
    ///
    /// # Errors
    /// `internal` when the arrays of `weights` do not belong together.
    pub fn norms(&self, weights: &PixelWeights) -> Result<ViewNorms> {
        weights.check()?;
        let gram = match self.gram.get() {
            Some(gram) => gram,
            None => {
                // Not inside of the lock: a thread that waits for its part of the work may begin
                // another text, which would wait for the lock.
                let made = gram(&self.bank);
                self.gram.get_or_init(|| made)
            }
        };
        let rows = self.rows();
        let inverse = (0..weights.pixels())
            .into_par_iter()
            .with_min_len(PIXELS_EACH)
            .map(|p| {
                let mut square = 0.0_f64;
                let of = weights
                    .pixel(p)
                    .map(|(m, weight)| (usize::from(m), f64::from(weight)))
                    .filter(|(m, _)| (1..=rows).contains(m));
                for (i, (m, weight)) in of.clone().enumerate() {
                    let mut across = 0.0;
                    for (n, other) in of.clone().take(i) {
                        across += other * gram[triangle(m - 1, n - 1)];
                    }
                    square += weight * (weight * gram[triangle(m - 1, m - 1)] + 2.0 * across);
                }
                if square <= 0.0 {
                    return 0.0;
                }
                #[expect(clippy::cast_possible_truncation, reason = "a relevancy is f32")]
                let inverse = (1.0 / square.sqrt()) as f32;
                if inverse.is_finite() { inverse } else { 0.0 }
            })
            .collect();
        Ok(ViewNorms { inverse })
    }

    /// `[P]` relevancy of each pixel, from the cut to 1, or 0 where the text does not apply.
    ///
    /// # Errors
    /// `internal` when `weights` and `norms` are not of one view.
    pub fn relevancy(
        &self,
        text: &TextScores,
        weights: &PixelWeights,
        norms: &ViewNorms,
    ) -> Result<Vec<f32>> {
        weights.check()?;
        if norms.inverse.len() != weights.pixels() {
            return Err(Error::internal(format!(
                "scoring: {} norms for {} pixels",
                norms.inverse.len(),
                weights.pixels()
            )));
        }
        if text.selects_nothing() {
            return Ok(vec![0.0; weights.pixels()]);
        }
        let score = |(p, inverse): (usize, &f32)| {
            if *inverse <= 0.0 || text.ruled_out(weights, p) {
                return 0.0;
            }
            let [least, most, coverage] = text.blend_pixel(weights, p);
            let inverse = f64::from(*inverse);
            let takes = coverage >= self.scoring.coverage_floor;
            let takes = takes && text.takes([least, most], inverse);
            if takes { self.sharpen(least * inverse) } else { 0.0 }
        };
        Ok(norms.inverse.par_iter().enumerate().with_min_len(PIXELS_EACH).map(score).collect())
    }

    /// `[P]` whether the relevancy is at the cut or over it. For a cut of 0.5 it needs no norm and
    /// no exponential.
    ///
    /// # Errors
    /// `internal` when the arrays of `weights` do not belong together.
    pub fn mask(&self, text: &TextScores, weights: &PixelWeights) -> Result<Vec<bool>> {
        weights.check()?;
        if !self.scoring.is_signed() {
            let map = self.relevancy(text, weights, &self.norms(weights)?)?;
            return Ok(map.into_iter().map(|relevancy| relevancy > 0.0).collect());
        }
        let inside = |p: usize| {
            if text.ruled_out(weights, p) {
                return false;
            }
            let [least, most, coverage] = text.blend_pixel(weights, p);
            coverage >= self.scoring.coverage_floor && selected(least, most)
        };
        Ok((0..weights.pixels()).into_par_iter().with_min_len(PIXELS_EACH).map(inside).collect())
    }
}

/// The masks that the rows of a bank stand for.
#[derive(Debug)]
struct Views {
    /// `[V]`, each of length 1.
    bank: Bank,
    /// `[M]` the rows, each of length 1.
    unit: Bank,
    /// `[V]` what a text must reach at each: see [`phrases`].
    bars: Vec<f64>,
    /// `[M]` which of them are of each row; none of a row that is no part of the scene.
    of_row: Vec<Range<usize>>,
    /// `[M]` what a text must reach where a row has none.
    row_bars: Vec<f64>,
    /// `[M]` the rows of the scene that look like each one, and how much each counts.
    alike: Vec<Vec<(usize, f64)>>,
}

impl Views {
    fn new(views: &RowViews, rows: &Bank, scoring: &Scoring) -> Self {
        let bank = Bank { dim: rows.dim, rows: views.rows.clone() };
        let unit = Bank { dim: rows.dim, rows: unit_rows(rows) };
        let bars = |of: &Bank| -> Vec<f64> {
            let phrases = phrases(of, &vec![1.0; of.len()], scoring);
            let bar = |m: usize| phrases.iter().map(|all| all[m]).fold(f64::NEG_INFINITY, f64::max);
            (0..of.len()).map(bar).collect()
        };
        let place = |entry: usize| views.entries.partition_point(|m| usize::from(*m) < entry);
        let of_row: Vec<Range<usize>> =
            (1..=rows.len()).map(|entry| place(entry)..place(entry + 1)).collect();
        let like = |row: usize| -> Vec<(usize, f64)> {
            let near =
                |other: &usize| *other == row || dot(unit.row(row), unit.row(*other)) >= ALIKE;
            let near: Vec<usize> = (0..rows.len()).filter(near).collect();
            let all: usize = near.iter().map(|other| of_row[*other].len()).sum();
            if all == 0 {
                return vec![(row, 1.0)];
            }
            let share = |other: usize| of_row[other].len() as f64 / all as f64;
            near.into_iter().map(|other| (other, share(other))).collect()
        };
        let alike = (0..rows.len()).into_par_iter().map(like).collect();
        Self { bars: bars(&bank), row_bars: bars(&unit), alike, bank, unit, of_row }
    }

    /// `[M]` by how much a text fits each row better than what it is compared with: the difference
    /// of cosines over the better half of the row's masks, then over rows that look alike.
    fn leads(&self, text: &[f32]) -> Vec<f64> {
        let over = |bank: &Bank, bars: &[f64]| -> Vec<f64> {
            scores(bank, text).iter().zip(bars).map(|(own, bar)| own - bar).collect()
        };
        let (views, alone) = (over(&self.bank, &self.bars), over(&self.unit, &self.row_bars));
        let better_half = |(row, of): (usize, &Range<usize>)| -> f64 {
            let mut all = views[of.clone()].to_vec();
            if all.is_empty() {
                return alone[row];
            }
            all.sort_unstable_by(|a, b| b.total_cmp(a));
            let half = (all.len() / 2).max(1);
            all[..half].iter().sum::<f64>() / half as f64
        };
        let rows: Vec<f64> = self.of_row.iter().enumerate().map(better_half).collect();
        let mean = |alike: &Vec<(usize, f64)>| -> f64 {
            alike.iter().map(|(row, share)| share * rows[*row]).sum()
        };
        self.alike.iter().map(mean).collect()
    }
}

/// What a text is compared with, `[M]` scores each: the canonical phrases with the margin. Where
/// everyday words count: the best of the phrases for each row, and the word that is at the place of
/// the last rival among those that fit the row best. So a text must be one of the words that fit
/// best; of a hundred words that are not there, few are.
fn phrases(bank: &Bank, norms: &[f64], scoring: &Scoring) -> Vec<Vec<f64>> {
    let with_margin = |phrase: &Vec<f32>| -> Vec<f64> {
        let own = scores(bank, phrase).into_iter().zip(norms);
        own.map(|(score, norm)| score + scoring.zero * norm).collect()
    };
    let canon: Vec<Vec<f64>> = scoring.canon.iter().map(with_margin).collect();
    if scoring.words.is_empty() {
        return canon;
    }
    let best = |m: usize| canon.iter().map(|phrase| phrase[m]).fold(f64::NEG_INFINITY, f64::max);
    let rival = |row: &[f32]| -> f64 {
        let mut all: Vec<f64> = scoring.words.iter().map(|word| dot(row, word)).collect();
        let at = all.len() - scoring.rivals.min(all.len());
        *all.select_nth_unstable_by(at, f64::total_cmp).1
    };
    let rows = bank.rows.par_chunks_exact(bank.dim.max(1));
    vec![(0..bank.len()).map(best).collect(), rows.map(rival).collect()]
}

/// `[M]` dot products of the rows with a vector.
fn scores(bank: &Bank, with: &[f32]) -> Vec<f64> {
    bank.rows.chunks_exact(bank.dim.max(1)).map(|row| dot(row, with)).collect()
}

/// Place of `(m, n)` in a lower triangle.
fn triangle(m: usize, n: usize) -> usize {
    let (row, column) = (m.max(n), m.min(n));
    row * (row + 1) / 2 + column
}

/// Lower triangle of B B^T.
fn gram(bank: &Bank) -> Vec<f64> {
    let row = |m: usize| (0..=m).map(move |n| dot(bank.row(m), bank.row(n)));
    (0..bank.len()).into_par_iter().flat_map_iter(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Preset;

    #[test]
    fn rows_rule_a_pixel_out_only_where_no_blend_of_them_is_selected() {
        let towards = |angle: f32| [angle.cos(), angle.sin()];
        let around = |i: usize| towards(i as f32 * 0.7);
        let rows: Vec<[f32; 2]> = (0..9).map(|i| towards(i as f32 * 0.2)).collect();
        let bank = Bank { dim: 2, rows: rows.concat() };
        let canon: Vec<[f32; 2]> = [3, 17, 31, 45, 59].map(around).to_vec();
        let canon = canon.iter().map(|c| c.to_vec()).collect();
        let method = ScoringMethod::of(Preset::Paper, Vec::new(), 10.0, 0.05, 0.0, 1.0);
        let names = (0..5).map(|c: u8| c.to_string()).collect();
        let method = ScoringMethod { canon: names, ..method };
        let scoring = Scoring::new(&method, canon, Arc::default()).unwrap();
        let scorer = Scorer::new(&bank, Arc::new(scoring)).unwrap();
        let mut view = PixelWeights::none(0);
        for p in 0..400_u16 {
            view.entries.extend((0..1 + p % 4).map(|k| (p * 7 + k * k) % 11));
            view.weights.extend((0..1 + p % 4).map(|k| 0.1 + f32::from(k)));
            view.offsets.push(view.entries.len() as u32);
        }
        let norms = scorer.norms(&view).unwrap();
        let [mut inside, mut ruled_out, mut nothing] = [0; 3];
        for text in (0..50).map(|i| scorer.text(&around(i * 3 + 1)).unwrap()) {
            let blended = |p| {
                let [least, most, _] = text.blend_pixel(&view, p);
                selected(least, most)
            };
            let want: Vec<bool> = (0..400).map(blended).collect();
            assert_eq!(scorer.mask(&text, &view).unwrap(), want);
            let map = scorer.relevancy(&text, &view, &norms).unwrap();
            assert_eq!(map.iter().map(|v| *v >= 0.5).collect::<Vec<_>>(), want);
            inside += want.iter().filter(|on| **on).count();
            ruled_out += (0..400).filter(|p| text.ruled_out(&view, *p)).count();
            nothing += usize::from(text.selects_nothing());
            assert!(!text.selects_nothing() || want.iter().all(|on| !on));
        }
        let told = format!("{inside} selected, {ruled_out} ruled out, {nothing} texts");
        assert!(inside > 500 && ruled_out > 5000 && (5..45).contains(&nothing), "{told}");
    }
}
