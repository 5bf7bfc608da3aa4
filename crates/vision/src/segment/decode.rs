//! A photo's points decoded, and the masks that pass the filters.

use std::sync::atomic::AtomicBool;

use crate::{
    error::{Error, Result},
    scene::{JudgedMasks, MaskJudging, MaskLogits, Photo, unless_cancelled},
    segment::{PhotoGrid, Proposals, Seed, Settings, filter::MaskFilter, prompts::Prompts},
};

/// A photo and the network that gives masks for its points.
pub trait PromptDecoder: Sync {
    /// Points that are best decoded together.
    fn batch(&self) -> usize;

    /// Side in pixels of the square that the network saw, and `[width, height]` of the photo in it.
    fn placed(&self) -> (u32, [u32; 2]);

    /// Masks of each point; points are shares 0..1 of the photo's width and height.
    ///
    /// # Errors
    /// What the network says.
    fn decode(&self, points: &[[f32; 2]]) -> Result<MaskLogits>;

    /// Levels and `[width, height]` of the grid of a decoder that judges masks at the photo's
    /// pixels by itself, and is to be asked for that.
    fn judges(&self) -> Option<(usize, [usize; 2])> {
        None
    }

    /// As [`Self::decode`], judged at the photo's pixels.
    ///
    /// # Errors
    /// What the network says; `internal` of a decoder that does not judge.
    fn judge(&self, _: &[[f32; 2]], _: &MaskJudging) -> Result<JudgedMasks> {
        Err(Error::internal("masks: the decoder does not judge masks"))
    }

    /// The same network on another photo: a part of this one, at its full size.
    ///
    /// # Errors
    /// What the network says.
    fn on<'a>(&'a self, photo: &'a Photo) -> Result<Box<dyn PromptDecoder + 'a>>;
}

/// The masks that pass the filters, in the order of points; with
/// `wholes` one mask of each point, by [`Settings::level`].
pub(super) fn decoded(
    decoder: &dyn PromptDecoder,
    photo: &Photo,
    settings: &Settings,
    seeds: &[Seed],
    cancel: &AtomicBool,
    wholes: bool,
) -> Result<(Proposals, Option<PhotoGrid>)> {
    let seeds = if settings.use_seeds { seeds } else { &[] };
    let mut prompts = Prompts::new(settings, seeds);
    let mut found = Proposals::default();
    let of = |answer| MaskFilter::new(decoder.placed(), answer, photo, settings);
    let judges = decoder.judges().filter(|_| settings.full_resolution);
    let mut filter: Option<MaskFilter> = judges.map(of).transpose()?;
    let judging = filter.as_ref().and_then(|filter| filter.judging(wholes));
    loop {
        let points = prompts.next(decoder.batch());
        if points.is_empty() {
            break;
        }
        unless_cancelled(cancel)?;
        let (masks, filter) = match (&judging, &mut filter) {
            (Some(how), Some(filter)) => {
                let judged = decoder.judge(&points, how)?;
                (filter.pass_judged(&judged, how, &points, wholes)?, filter)
            }
            (_, filter) => {
                let decoded = decoder.decode(&points)?;
                let filter = match filter {
                    Some(filter) => filter,
                    none => none.insert(of((decoded.levels, decoded.grid))?),
                };
                (filter.pass(&decoded, &points, wholes)?, filter)
            }
        };
        found.asked += points.len();
        [found.width, found.height] = filter.map();
        prompts.cover(&masks, filter.map(), filter.levels());
        found.masks.extend(masks);
    }
    Ok((found, filter.map(|filter| filter.photo_grid())))
}
