//! Words that keep what they name out of a scene: what is found of them in a photo takes no part,
//! as what a mask leaves out.
//!
//! Where the bundle has a network that masks what a text says, it is asked. Else the masks of the
//! photos are compared with the words, as those of a scene are.

use std::{sync::Arc, time::Instant};

use super::{PhotoSet, Pipeline, semantics::label_photos};
use crate::{
    error::{Result, short},
    scene::{
        IndexMap, Method, PosedPhoto, Preset, Stage, StageTime, Warning, WarningCode, Watch,
        unless_cancelled,
    },
};

/// A thing is taken wider on each side by this share of the photo's longer side: its edge is in the
/// colours beside it.
const WIDER: f64 = 0.012;

/// The photos without what the words name, and warnings that say how much that is. Photos that are
/// without it already stay as they are.
///
/// # Errors
/// `model_unavailable` where the bundle cannot find words, `invalid_request` for a word that its
/// network cannot read, `cancelled`, `internal`.
pub fn without_words(
    pipeline: &Pipeline,
    mut photos: PhotoSet,
    words: &[String],
    method: &Method,
    watch: Watch<'_>,
) -> Result<PhotoSet> {
    if words.is_empty() || photos.is_without_words {
        return Ok(photos);
    }
    let begun = Instant::now();
    let shares = leave_out_words(pipeline, &mut photos.photos, words, method, watch)?;
    let ms = begun.elapsed().as_secs_f64() * 1e3;
    photos.stages.push(StageTime { stage: Stage::Masks.name().to_owned(), ms });
    photos.warnings.extend(words.iter().zip(&shares).map(|(word, shares)| told(word, shares)));
    photos.is_without_words = true;
    Ok(photos)
}

/// Leaves what the words name out of photos. Of each word the share of each photo that it names.
///
/// # Errors
/// As [`without_words`].
pub fn leave_out_words(
    pipeline: &Pipeline,
    photos: &mut [PosedPhoto],
    words: &[String],
    method: &Method,
    watch: Watch<'_>,
) -> Result<Vec<Vec<f64>>> {
    let maps = match pipeline.bundle().text_masks() {
        Some(_) => by_network(pipeline, photos, words, watch)?,
        None => by_masks(pipeline, photos, words, method, watch)?,
    };
    for maps in &maps {
        for (posed, map) in photos.iter_mut().zip(maps) {
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "cells")]
            let cells = (WIDER * f64::from(map.width.max(map.height))).ceil() as usize;
            posed.photo.leave_out(&map.wider(cells));
        }
    }
    Ok(maps.iter().map(|maps| maps.iter().map(IndexMap::share).collect()).collect())
}

/// By the network that masks what a text says.
fn by_network(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    words: &[String],
    watch: Watch<'_>,
) -> Result<Vec<Vec<IndexMap>>> {
    let network = pipeline.text_masks()?;
    let mut maps: Vec<Vec<IndexMap>> = vec![Vec::with_capacity(photos.len()); words.len()];
    for posed in photos {
        unless_cancelled(watch.cancel)?;
        let seen = network.see(&posed.photo)?;
        for (maps, word) in maps.iter_mut().zip(words) {
            maps.push(network.find(&seen, word)?);
        }
    }
    Ok(maps)
}

/// By masks, and what they look like.
fn by_masks(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    words: &[String],
    method: &Method,
    watch: Watch<'_>,
) -> Result<Vec<Vec<IndexMap>>> {
    let silent = Watch { progress: &|_, _| (), cancel: watch.cancel };
    let labelled = label_photos(pipeline, photos, None, method, silent)?;
    let scoring = Arc::new(pipeline.scoring(&pipeline.scoring_method(Preset::Default)?)?);
    let texts = pipeline.image_text()?.embed_texts(words)?;
    let scorer = labelled.scorer(scoring)?;
    texts.iter().map(|text| Ok(labelled.selected(&scorer.text(&text.row)?))).collect()
}

/// Says what a word leaves out of the photos.
fn told(word: &str, shares: &[f64]) -> Warning {
    let found = shares.iter().filter(|share| **share > 0.0).count();
    let share = shares.iter().sum::<f64>() / shares.len().max(1) as f64;
    let message = match found {
        0 => format!("ignore: {:?} is found in no photo", short(word)),
        _ => format!(
            "ignore: {:?} is found in {found} of {} photos; {:.1} % of their pixels are left out \
             of the scene",
            short(word),
            shares.len(),
            100.0 * share
        ),
    };
    Warning { code: WarningCode::WordsIgnored, message, value: share }
}
