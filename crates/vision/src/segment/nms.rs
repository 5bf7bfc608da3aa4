//! Of masks that are nearly equal only the best one stays.

use rayon::prelude::*;

use crate::{
    scene::OverlapNms,
    segment::{Proposal, Settings},
};

/// A mask lies in another where the other has this share of it, and it less than [`FILLED_MAX`] of
/// the other.
const INSIDE_MIN: f32 = 0.85;
const FILLED_MAX: f32 = 0.5;

/// Sorts the masks, the surest first, and thins them out. In a tie of [`Proposal::sureness`] the
/// earlier mask stays.
pub(super) fn suppress(masks: &mut Vec<Proposal>, settings: &Settings) {
    masks.sort_by(|a, b| b.sureness(settings).total_cmp(&a.sureness(settings)));
    thin(masks, settings.box_nms_thresh, settings.mask_nms_thresh);
}

/// Of masks that are too similar the first stays: greedy, as torchvision's `nms` over boxes and
/// then the same over the masks themselves. A threshold of 1 or more keeps everything.
pub(super) fn thin(masks: &mut Vec<Proposal>, box_threshold: f32, mask_threshold: f32) {
    let order: Vec<usize> = (0..masks.len()).collect();
    let boxed = greedy(&order, |a, b| masks[a].bounds.iou(masks[b].bounds) > box_threshold);
    let kept = greedy(&boxed, |a, b| {
        let (a, b) = (&masks[a], &masks[b]);
        // The smaller over the larger bounds the IoU from above.
        let (small, large) = (a.area.min(b.area) as f32, a.area.max(b.area) as f32);
        small > mask_threshold * large && iou(a, b) > mask_threshold
    });
    *masks = kept.into_iter().map(|at| std::mem::take(&mut masks[at])).collect();
}

/// `LangSplat`'s `mask_nms` (its `preprocess.py`), surest first: a mask goes where predicted IoU
/// times stability is not over `score`, where its IoU with a surer mask is over `iou`, and where it
/// lies in another mask, surer or not, so that the product of both masks' shares of what they have
/// in common is less than `inner`. A mask that went still acts on others.
///
/// Where no mask is sure enough none is left; there `LangSplat`'s own code ends with an error.
pub(super) fn overlap(masks: &mut Vec<Proposal>, nms: &OverlapNms) {
    let score = |mask: &Proposal| mask.predicted_iou * mask.stability;
    masks.sort_by(|a, b| score(b).total_cmp(&score(a)));
    let stays = |at: usize| {
        let mask = &masks[at];
        let lies_in = |other: &Proposal| {
            let common = mask.mask.common(&other.mask) as f32;
            let (of_mask, of_other) = (common / mask.area as f32, common / other.area as f32);
            of_mask >= INSIDE_MIN && of_other < FILLED_MAX && of_mask * of_other < nms.inner
        };
        score(mask) > nms.score
            && !masks[..at].iter().any(|surer| iou(surer, mask) > nms.iou)
            && !masks.iter().any(lies_in)
    };
    let stays: Vec<bool> = (0..masks.len()).into_par_iter().map(stays).collect();
    let mut stays = stays.into_iter();
    masks.retain(|_| stays.next().unwrap_or_default());
}

/// Removes from `order` each mask that is too similar to an earlier one that stays.
pub(super) fn greedy(order: &[usize], alike: impl Fn(usize, usize) -> bool) -> Vec<usize> {
    let mut kept: Vec<usize> = Vec::new();
    for &mask in order {
        if !kept.iter().any(|&before| alike(before, mask)) {
            kept.push(mask);
        }
    }
    kept
}

/// Intersection over union of two masks; 0 where both are empty.
pub(super) fn iou(a: &Proposal, b: &Proposal) -> f32 {
    let common = a.mask.common(&b.mask);
    let all = a.area + b.area - common;
    if all == 0 { 0.0 } else { common as f32 / all as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::segment::Bitset;

    fn proposal(predicted_iou: f32, cells: &[usize]) -> Proposal {
        let values: Vec<f32> = (0..64).map(|i| f32::from(u8::from(cells.contains(&i)))).collect();
        let mask = Bitset::over(&values, 0.5);
        let (area, bounds) = (mask.count(), mask.bounds(8));
        Proposal { mask, area, bounds, predicted_iou, stability: 1.0, ..Proposal::default() }
    }

    fn suppress(masks: &mut Vec<Proposal>, box_nms_thresh: f32, mask_nms_thresh: f32) {
        let settings = Settings { box_nms_thresh, mask_nms_thresh, ..Settings::default() };
        super::suppress(masks, &settings);
    }

    #[test]
    fn the_surest_of_like_masks_stays() {
        // A 3x3 block, the same less a corner, the same block elsewhere, a plus in the first box.
        let block = [0, 1, 2, 8, 9, 10, 16, 17, 18];
        let masks = [
            proposal(0.8, &block[..8]),
            proposal(0.9, &block),
            proposal(0.7, &block.map(|c| c + 36)),
            proposal(0.6, &[1, 8, 9, 10, 17]),
        ];
        let kept = |boxes: f32, over: f32| {
            let mut left = masks.to_vec();
            suppress(&mut left, boxes, over);
            left.iter().map(|mask| (mask.predicted_iou * 10.0).round() as u32).collect::<Vec<_>>()
        };
        assert_eq!(kept(0.7, 0.7), [9, 7], "by boxes");
        assert_eq!(kept(1.0, 0.7), [9, 7, 6], "by masks: the plus is 5/9 of the block");
        assert_eq!(kept(1.0, 0.5), [9, 7], "by stricter masks");
        assert_eq!(kept(1.0, 1.0), [9, 8, 7, 6], "not at all");
        assert!((iou(&masks[0], &masks[1]) - 8.0 / 9.0).abs() < 1e-6, "IoU");
    }

    #[test]
    fn a_blurred_outline_makes_a_mask_less_sure() {
        let blurred = Proposal { stability: 0.5, ..proposal(0.8, &[0, 1, 8, 9]) };
        let masks = [blurred, proposal(0.6, &[0, 1, 8, 9])];
        let kept = |surest_first: bool| {
            let mut left = masks.to_vec();
            let settings = Settings { surest_first, ..Settings::default() };
            super::suppress(&mut left, &settings);
            left.iter().map(|mask| mask.stability).collect::<Vec<_>>()
        };
        assert_eq!(kept(true), [1.0], "0.6 is more than 0.4");
        assert_eq!(kept(false), [0.5], "by predicted IoU alone");
    }

    #[test]
    fn ties_go_to_the_earlier_mask() {
        let first = Proposal { level: 1, ..proposal(0.8, &[0, 1, 8, 9]) };
        let mut masks = vec![first, proposal(0.8, &[0, 1, 8, 9])];
        suppress(&mut masks, 0.7, 0.7);
        assert_eq!((masks.len(), masks[0].level), (1, 1), "the first");
    }

    #[test]
    fn overlap_leaves_what_langsplat_leaves() {
        // Its mask_nms (preprocess.py of d70edb8) on PyTorch, with the same masks and scores.
        let masks = random_masks();
        let kept = |iou, score, inner| {
            let mut left = masks.clone();
            overlap(&mut left, &OverlapNms { iou, score, inner });
            left.iter().map(|mask| mask.level).collect::<Vec<_>>()
        };
        assert_eq!(kept(0.8, 0.5, 0.5), [4, 13, 2, 9], "its own inner");
        assert_eq!(kept(0.3, 0.5, 0.2), [12, 7, 4, 13], "less IoU, and the score");
        assert_eq!(kept(1.0, 0.0, 0.3), [6, 4, 10, 13, 2, 9], "the inner one alone");
    }

    /// Boxes of an 8x8 grid and their scores, from a generator that Python repeats.
    fn random_masks() -> Vec<Proposal> {
        let mut state = 34_u32;
        let mut next = |below: u32| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 16) % below
        };
        let mask = |level: usize| {
            let [x, y, width, height] = [next(6), next(6), 1 + next(8), 1 + next(8)];
            let inside = |c: &usize| {
                let (column, row) = (*c as u32 % 8, *c as u32 / 8);
                (x..x + width).contains(&column) && (y..y + height).contains(&row)
            };
            let cells: Vec<usize> = (0..64).filter(inside).collect();
            let sure = 0.5 + 0.01 * level as f32 + 0.1 * next(4) as f32;
            Proposal { level, stability: 0.9, ..proposal(sure, &cells) }
        };
        (0..14).map(mask).collect()
    }
}
