//! Small holes and islands of masks go, as in Segment Anything's `postprocess_small_regions`.

use rayon::prelude::*;

use crate::segment::{Bitset, Proposal, Proposals, nms};

/// Fills holes and removes islands of fewer than `least` cells in every mask. Of two masks whose
/// boxes then have more IoU than `box_threshold` one that was not changed stays, else the first.
pub(super) fn clean(found: &mut Proposals, least: usize, box_threshold: f32) {
    let map = [found.width, found.height];
    let changed = |proposal: &mut Proposal| {
        let Some(mask) = cleaned(&proposal.mask, map, least) else { return false };
        (proposal.area, proposal.bounds) = (mask.count(), mask.bounds(map[0]));
        proposal.mask = mask;
        true
    };
    let changed: Vec<bool> = found.masks.par_iter_mut().map(changed).collect();
    let mut order: Vec<usize> = (0..changed.len()).collect();
    order.sort_by_key(|&at| changed[at]);
    let masks = &found.masks;
    let kept = nms::greedy(&order, |a, b| masks[a].bounds.iou(masks[b].bounds) > box_threshold);
    let mut at = 0;
    found.masks.retain(|_| {
        at += 1;
        kept.contains(&(at - 1))
    });
}

/// The mask without its small holes, then without its small islands; `None` where it has none.
/// Where all islands are small the largest stays.
fn cleaned(mask: &Bitset, map: [usize; 2], least: usize) -> Option<Bitset> {
    let mut cells: Vec<bool> = (0..map[0] * map[1]).map(|cell| mask.has(cell)).collect();
    let mut changed = false;
    for inside in [false, true] {
        let regions = regions(&cells, map, inside);
        let largest = regions.iter().map(Vec::len).max().unwrap_or(0);
        let only = regions.iter().position(|r| inside && largest < least && r.len() == largest);
        changed |= regions.iter().any(|region| region.len() < least);
        for (i, region) in regions.iter().enumerate() {
            if region.len() < least && only != Some(i) {
                region.iter().for_each(|&cell| cells[cell] = !inside);
            }
        }
    }
    let values: Vec<f32> = cells.iter().map(|&cell| f32::from(u8::from(cell))).collect();
    changed.then(|| Bitset::over(&values, 0.5))
}

/// Cells of the value `inside` that touch at a side or a corner, region by region.
fn regions(cells: &[bool], [width, height]: [usize; 2], inside: bool) -> Vec<Vec<usize>> {
    let mut waits: Vec<bool> = cells.iter().map(|&cell| cell == inside).collect();
    let mut found = Vec::new();
    for start in 0..cells.len() {
        if !std::mem::replace(&mut waits[start], false) {
            continue;
        }
        let (mut region, mut next) = (vec![start], 0);
        while let Some(&cell) = region.get(next) {
            next += 1;
            let (x, y) = (cell % width, cell / width);
            for y in y.saturating_sub(1)..=(y + 1).min(height - 1) {
                for x in x.saturating_sub(1)..=(x + 1).min(width - 1) {
                    if std::mem::replace(&mut waits[y * width + x], false) {
                        region.push(y * width + x);
                    }
                }
            }
        }
        found.push(region);
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mask(rows: &[&str]) -> Bitset {
        let values: Vec<f32> = rows
            .iter()
            .flat_map(|row| row.bytes())
            .map(|c| f32::from(u8::from(c == b'#')))
            .collect();
        Bitset::over(&values, 0.5)
    }

    #[test]
    fn segment_anything_gives_the_same() {
        // remove_small_regions of segment_anything.utils.amg, holes and then islands, area 3.
        let rows = ["####...#", "#.##....", "####..#.", "####.#.#", "........"];
        let wanted = ["####....", "####....", "####..#.", "####.#.#", "........"];
        let found = cleaned(&mask(&rows), [8, 5], 3).unwrap();
        assert_eq!(found, mask(&wanted), "a hole of 1 and an island of 1 go; 3 at corners stay");
        assert_eq!(cleaned(&found, [8, 5], 3), None, "nothing small is left");
        let small = cleaned(&mask(&["#..##...", "........"]), [8, 2], 5).unwrap();
        assert_eq!(small, mask(&["...##...", "........"]), "the largest of small islands stays");
    }

    #[test]
    fn one_of_two_masks_that_became_alike_goes() {
        let proposal = |rows: &[&str], predicted_iou| {
            let mask = mask(rows);
            let (area, bounds) = (mask.count(), mask.bounds(8));
            Proposal { mask, area, bounds, predicted_iou, ..Proposal::default() }
        };
        let with_island = proposal(&["####...#", "####....", "####...."], 0.9);
        let plain = proposal(&["####....", "####....", "####...."], 0.8);
        let mut found =
            Proposals { width: 8, height: 3, masks: vec![with_island.clone(), plain], asked: 2 };
        clean(&mut found, 3, 0.7);
        assert_eq!(found.masks.len(), 1, "one box");
        assert!((found.masks[0].predicted_iou - 0.8).abs() < 1e-6, "the one that was not changed");
        let mut alone = Proposals { masks: vec![with_island], ..found };
        clean(&mut alone, 3, 0.7);
        assert_eq!((alone.masks[0].area, alone.masks[0].bounds.x1), (12, 3), "area and box follow");
    }
}
