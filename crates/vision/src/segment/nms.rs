//! Of masks that are nearly equal only the best one stays.

use crate::segment::{Proposal, Settings};

/// Positions of the masks that stay, surest first: greedy, as torchvision's `nms` over boxes and
/// then the same over the masks themselves. A threshold of 1 or more keeps everything.
///
/// In a tie of [`Proposal::sureness`] the earlier mask stays.
pub(super) fn suppress(masks: &[Proposal], settings: &Settings) -> Vec<usize> {
    let sureness = |at: usize| masks[at].sureness(settings);
    let [box_threshold, mask_threshold] = [settings.box_nms_thresh, settings.mask_nms_thresh];
    let mut order: Vec<usize> = (0..masks.len()).collect();
    order.sort_by(|&a, &b| sureness(b).total_cmp(&sureness(a)));
    let boxed = greedy(&order, |a, b| masks[a].bounds.iou(masks[b].bounds) > box_threshold);
    greedy(&boxed, |a, b| {
        let (a, b) = (&masks[a], &masks[b]);
        // The smaller over the larger bounds the IoU from above.
        let (small, large) = (a.area.min(b.area) as f32, a.area.max(b.area) as f32);
        small > mask_threshold * large && iou(a, b) > mask_threshold
    })
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

    fn suppress(masks: &[Proposal], box_nms_thresh: f32, mask_nms_thresh: f32) -> Vec<usize> {
        let settings = Settings { box_nms_thresh, mask_nms_thresh, ..Settings::default() };
        super::suppress(masks, &settings)
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
        assert_eq!(suppress(&masks, 0.7, 0.7), [1, 2], "by boxes");
        assert_eq!(suppress(&masks, 1.0, 0.7), [1, 2, 3], "by masks: the plus is 5/9 of the block");
        assert_eq!(suppress(&masks, 1.0, 0.5), [1, 2], "by stricter masks");
        assert_eq!(suppress(&masks, 1.0, 1.0), [1, 0, 2, 3], "not at all");
        assert!((iou(&masks[0], &masks[1]) - 8.0 / 9.0).abs() < 1e-6, "IoU");
    }

    #[test]
    fn a_blurred_outline_makes_a_mask_less_sure() {
        let blurred = Proposal { stability: 0.5, ..proposal(0.8, &[0, 1, 8, 9]) };
        let masks = [blurred, proposal(0.6, &[0, 1, 8, 9])];
        assert_eq!(suppress(&masks, 0.7, 0.7), [1], "0.6 is more than 0.4");
        let settings = Settings { surest_first: false, ..Settings::default() };
        assert_eq!(super::suppress(&masks, &settings), [0], "by predicted IoU alone");
    }

    #[test]
    fn ties_go_to_the_earlier_mask() {
        let masks = [proposal(0.8, &[0, 1, 8, 9]), proposal(0.8, &[0, 1, 8, 9])];
        assert_eq!(suppress(&masks, 0.7, 0.7), [0], "the first");
    }
}
