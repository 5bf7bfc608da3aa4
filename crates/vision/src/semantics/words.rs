//! Words that a network masks in the photos, as a bank of their own.
//!
//! A bank of words has a row for each combination of words and scores that a Gaussian has. Its
//! numbers are such that the relevancy of a word at a Gaussian is the word's score there, so all
//! that reads banks (views, parts, exports) reads it like any other.

use rustc_hash::FxHashMap;

use crate::{
    error::{Error, Result},
    scene::{Bank, ScoringMethod},
};

/// Scores that are told apart, from 1 to the score 1; they are thousandths in maps.
const LEVELS: u16 = 50;
const SURE: u16 = 1_000;
/// Least and largest relevancy of a Gaussian that has a word, and that of one that has not.
const RELEVANCIES: [f64; 3] = [0.51, 0.99, 0.1];
/// Sharpness, so large that the numbers of all words of a call fit in a row of length 1.
const TAU: f64 = 500.0;
/// What a word is compared with, in answers.
const NOTHING: &str = "(no mask)";

/// Words of a scene as a bank.
#[derive(Clone, Debug, PartialEq)]
pub struct WordBank {
    /// A row for each combination of scores.
    pub bank: Bank,
    /// `[N]` row of each Gaussian, from 1.
    pub index: Vec<u16>,
    /// `[T]` the vector that scores each word.
    pub texts: Vec<Vec<f32>>,
    /// The vector of what a word is compared with.
    pub canon: Vec<f32>,
}

impl WordBank {
    /// Of the scores of each word at each Gaussian, thousandths; 0 where it is not.
    ///
    /// # Errors
    /// `invalid_request` when more combinations occur than a bank may have rows.
    pub fn new(words: &[&[u16]], gaussians: usize) -> Result<Self> {
        let mut rows_of: FxHashMap<Vec<u16>, u16> = FxHashMap::default();
        let (mut levels, mut index) = (Vec::new(), Vec::with_capacity(gaussians));
        for i in 0..gaussians {
            levels.clear();
            levels.extend(words.iter().map(|scores| level(scores[i])));
            let next = u16::try_from(rows_of.len() + 1).map_err(|_| {
                Error::invalid(format!("{} words overlap in too many ways; ask fewer", words.len()))
            })?;
            index.push(match rows_of.get(&levels) {
                Some(row) => *row,
                None => *rows_of.entry(levels.clone()).or_insert(next),
            });
        }
        // What scores a word, what it is compared with, and the rest of a row of length 1.
        let dim = words.len() + 2;
        let unit = |at: usize| (0..dim).map(|d| f32::from(u8::from(d == at))).collect();
        let mut all: Vec<(u16, Vec<u16>)> =
            rows_of.into_iter().map(|(of, row)| (row, of)).collect();
        all.sort_unstable();
        let rows = all.iter().flat_map(|(_, levels)| row(levels)).collect();
        let texts = (0..words.len()).map(unit).collect();
        Ok(Self { bank: Bank { dim, rows }, index, texts, canon: unit(words.len()) })
    }

    /// How words are scored with such a bank.
    #[must_use]
    pub fn method(coverage_floor: f64) -> ScoringMethod {
        ScoringMethod {
            unit_rows: true,
            canon: vec![NOTHING.to_owned()],
            tau: TAU,
            coverage_floor,
            margin: 0.0,
            cut: ScoringMethod::CUT,
            near_best: ScoringMethod::NEAR_BEST_MAX,
            rivals: 1.0,
        }
    }
}

fn level(score: u16) -> u16 {
    (score.min(SURE) * LEVELS).div_ceil(SURE)
}

/// Of each word the difference that makes its relevancy; 0; and what is left to length 1.
fn row(levels: &[u16]) -> Vec<f32> {
    let [least, most, without] = RELEVANCIES;
    let lead = |level: &u16| {
        let relevancy = match level {
            0 => without,
            level => (f64::from(*level) / f64::from(LEVELS)).clamp(least, most),
        };
        (relevancy / (1.0 - relevancy)).ln() / TAU
    };
    let leads: Vec<f64> = levels.iter().map(lead).collect();
    let rest = (1.0 - leads.iter().map(|lead| lead * lead).sum::<f64>()).max(0.0).sqrt();
    #[expect(clippy::cast_possible_truncation, reason = "rows are f32")]
    leads.into_iter().chain([0.0, rest]).map(|v| v as f32).collect()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::semantics::{Scorer, Scoring};

    #[test]
    fn a_word_has_its_score_where_it_is_and_is_not_selected_elsewhere() {
        let (chair, table) = ([900_u16, 0, 700, 0], [0_u16, 505, 640, 0]);
        let words = WordBank::new(&[&chair, &table], 4).unwrap();
        let scoring =
            Scoring::new(&WordBank::method(0.05), vec![words.canon.clone()], Arc::default());
        let scorer = Scorer::new(&words.bank, Arc::new(scoring.unwrap())).unwrap();
        for (text, scores) in words.texts.iter().zip([chair, table]) {
            let found = scorer.text(text).unwrap();
            for (row, score) in words.index.iter().zip(scores) {
                let relevancy = found.relevancies()[usize::from(*row)];
                assert_eq!(found.selects(*row), score > 0, "{score}: {relevancy}");
                if score > 0 {
                    assert!((relevancy - f32::from(score) / 1e3).abs() < 0.021, "{relevancy}");
                }
            }
        }
    }

    #[test]
    fn many_words_on_one_gaussian_keep_their_scores() {
        let words: Vec<Vec<u16>> = (0..400).map(|i| vec![500 + i, 0]).collect();
        let words: Vec<&[u16]> = words.iter().map(Vec::as_slice).collect();
        let bank = WordBank::new(&words, 2).unwrap();
        let scoring =
            Scoring::new(&WordBank::method(0.0), vec![bank.canon.clone()], Arc::default());
        let scorer = Scorer::new(&bank.bank, Arc::new(scoring.unwrap())).unwrap();
        for (i, text) in (500_u16..).zip(&bank.texts) {
            let found = scorer.text(text).unwrap();
            let relevancy = found.relevancies()[usize::from(bank.index[0])];
            assert!((relevancy - f32::from(i) / 1e3).abs() < 0.03, "{i}: {relevancy}");
            assert!(found.selects(bank.index[0]) && !found.selects(bank.index[1]), "{i}");
        }
    }
}
