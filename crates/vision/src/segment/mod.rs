//! Everything in a photo as masks: a grid of points is decoded, good masks stay, one a pixel.
//!
//! [`proposals`] is Segment Anything's everything-mode up to the end of its filters and NMS.
//! [`everything`] goes on to whole objects and one mask for each pixel. [`Settings`] has a switch
//! for each saving: masks are filtered on the decoder's own coarse grid, points are skipped where a
//! mask lies already, and points known from other photos come first. The decoder is behind
//! [`PromptDecoder`]: this module knows no network.

mod assign;
mod bitset;
mod crops;
mod decode;
mod filter;
mod nms;
mod photo_grid;
mod prompts;
mod proposal;
mod regions;
mod settings;

use std::sync::atomic::AtomicBool;

pub use bitset::{Bitset, Box2};
pub use decode::PromptDecoder;
pub use filter::iou_over;
pub use proposal::{Proposal, Proposals};
pub use settings::{Seed, Settings};

use self::{decode::decoded, photo_grid::PhotoGrid};
use crate::{
    error::Result,
    scene::{Photo, PhotoMasks},
};

/// All masks of a photo that pass the filters and NMS, parts and wholes alike.
///
/// # Errors
/// `cancelled`; `internal` when the decoder fails or its answer has no sense.
pub fn proposals(
    decoder: &dyn PromptDecoder,
    photo: &Photo,
    settings: &Settings,
    seeds: &[Seed],
    cancel: &AtomicBool,
) -> Result<Proposals> {
    Ok(passed(decoder, photo, settings, seeds, cancel, false)?.0)
}

/// What is in a photo: whole objects (or those of [`Settings::level`]), at most one a pixel.
///
/// # Errors
/// `cancelled`; `internal` when the decoder fails or its answer has no sense.
pub fn everything(
    decoder: &dyn PromptDecoder,
    photo: &Photo,
    settings: &Settings,
    seeds: &[Seed],
    cancel: &AtomicBool,
) -> Result<PhotoMasks> {
    let (found, photo_grid) = passed(decoder, photo, settings, seeds, cancel, true)?;
    let masks = photo_grid.map(|grid| assign::one_a_pixel(&found, grid, photo, settings));
    Ok(masks.unwrap_or_default())
}

/// The masks that pass the filters and NMS. With `wholes` one mask of each point,
/// by [`Settings::level`].
fn passed(
    decoder: &dyn PromptDecoder,
    photo: &Photo,
    settings: &Settings,
    seeds: &[Seed],
    cancel: &AtomicBool,
    wholes: bool,
) -> Result<(Proposals, Option<PhotoGrid>)> {
    let (mut found, photo_grid) = decoded(decoder, photo, settings, seeds, cancel, wholes)?;
    nms::suppress(&mut found.masks, settings);
    if settings.full_resolution && settings.crop_n_layers > 0 {
        crops::add(&mut found, decoder, photo, settings, cancel, wholes)?;
    }
    if settings.min_mask_region_area > 0 {
        let boxes = settings.box_nms_thresh.max(settings.crop_nms_thresh);
        regions::clean(&mut found, settings.min_mask_region_area as usize, boxes);
    }
    if let Some(nms) = &settings.overlap_nms {
        nms::overlap(&mut found.masks, nms);
    }
    Ok((found, photo_grid))
}
