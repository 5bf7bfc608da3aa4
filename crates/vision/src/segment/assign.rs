//! Joins masks to whole objects and gives each pixel to one mask.

use rayon::prelude::*;

use crate::{
    scene::{IndexMap, MaskInfo, Photo, PhotoMasks},
    segment::{Bitset, PhotoGrid, Proposal, Proposals, Settings, filter::blank},
};

/// Most masks of a photo: a mask number is a u16, and 0 is none.
const MASKS_MAX: usize = u16::MAX as usize;
/// What a mask e times as large must have more of sureness to keep its pixels: a cup lies on its
/// table. Chosen on labelled photographs that no training saw; 0 to 0.2 do nearly the same.
const SURENESS_OF_SIZE: f32 = 0.1;

/// The index map of the masks, sorted by area, the largest first.
///
/// A mask that lies in the mask of a whole object is dropped. Of the others, the surest for its
/// size has a pixel, or the smallest ([`Settings::surest_first`]). A mask with too few visible
/// pixels is dropped.
pub(super) fn one_a_pixel(
    found: &Proposals,
    photo_grid: PhotoGrid,
    photo: &Photo,
    settings: &Settings,
) -> PhotoMasks {
    let mut wholes = wholes(&found.masks, settings.part_thresh);
    if settings.surest_first {
        let rank = |at: usize| {
            let mask = &found.masks[at];
            mask.sureness(settings) - SURENESS_OF_SIZE * (mask.area.max(1) as f32).ln()
        };
        wholes.sort_by(|&a, &b| rank(b).total_cmp(&rank(a)));
    } else {
        wholes.sort_by_key(|&at| found.masks[at].area);
    }
    let scale = if settings.full_resolution { 1 } else { settings.map_scale.max(1) as usize };
    let [width, height] = [found.width * scale, found.height * scale];
    let cells = width * height;
    let resample = (scale > 1).then(|| photo_grid.to_map([width, height]));
    let blank = blank(photo, [width, height]);
    let mut taken = blank.unwrap_or_else(|| Bitset::empty(cells));
    let fine = |&at: &usize| {
        let proposal = &found.masks[at];
        let mask = match &resample {
            Some(to) => Bitset::over(&to.apply(&proposal.logits.spread(photo_grid.grid)), 0.0),
            None => proposal.mask.clone(),
        };
        (at, mask)
    };
    let fine: Vec<(usize, Bitset)> = wholes.par_iter().map(fine).collect();
    let mut kept = Vec::new();
    for (at, mut mask) in fine {
        let before = settings.keep_wholes.then(|| mask.runs());
        mask.subtract(&taken);
        let left = mask.count();
        if left > 0 && f64::from(left) >= settings.min_area * cells as f64 {
            taken.add(&mask);
            kept.push((at, mask, before));
        }
    }
    kept.sort_by_key(|(at, ..)| std::cmp::Reverse(found.masks[*at].area));
    kept.truncate(MASKS_MAX);
    let mut map = PhotoMasks::default();
    let mut index = vec![0_u16; cells];
    for (k, (at, mask, whole)) in (1..).zip(kept) {
        mask.cells().for_each(|cell| index[cell] = k);
        map.wholes.extend(whole);
        let proposal = &found.masks[at];
        map.masks.push(MaskInfo {
            area: f64::from(mask.count()) / cells as f64,
            predicted_iou: proposal.predicted_iou,
            stability: proposal.stability,
            point: proposal.point,
        });
    }
    let narrow = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    map.map = IndexMap { width: narrow(width), height: narrow(height), index };
    map
}

/// Positions of the masks that do not lie in the mask of a whole object.
fn wholes(masks: &[Proposal], part_thresh: f64) -> Vec<usize> {
    let is_part = |part: &Proposal| {
        masks.iter().any(|whole| {
            whole.level > part.level
                && whole.area > part.area
                && f64::from(whole.mask.common(&part.mask)) >= part_thresh * f64::from(part.area)
        })
    };
    (0..masks.len()).filter(|&at| !is_part(&masks[at])).collect()
}
