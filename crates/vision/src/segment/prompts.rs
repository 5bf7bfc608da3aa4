//! Which points are prompts, and in which order.

use crate::segment::{Bitset, Proposal, Seed, Settings};

/// Round `i` has every `STRIDES[i]`-th point of the grid that was not in an earlier round. The last
/// round has all others.
const STRIDES: [u32; 3] = [4, 2, 1];
/// Before the last round a point counts as covered only by a mask smaller than this share of the
/// photo, because small objects lie on large ones.
const COVERING_SHARE_MAX: f64 = 0.1;

/// The prompts that are left.
#[derive(Debug)]
pub(super) struct Prompts {
    /// Point and round; the next one is the last.
    waiting: Vec<([f32; 2], usize)>,
    skip_covered: bool,
    /// Cells covered by masks of whole objects: by any, and by small ones.
    covered: Bitset,
    covered_small: Bitset,
    map: [usize; 2],
}

impl Prompts {
    pub(super) fn new(settings: &Settings, seeds: &[Seed]) -> Self {
        let side = settings.points_per_side.max(1);
        let at = |i: u32| (f64::from(i) + 0.5) / f64::from(side);
        #[expect(clippy::cast_possible_truncation, reason = "a share of the photo")]
        let point = |x: u32, y: u32| [at(x) as f32, at(y) as f32];
        let all = || (0..side).flat_map(|y| (0..side).map(move |x| (x, y)));
        let mut waiting = Vec::new();
        if settings.skip_covered {
            let round = |x: u32, y: u32| {
                // The middle of each square of points, so that rounds are centred.
                let on = |stride: u32| [x, y].iter().all(|v| v % stride == stride / 2);
                STRIDES.iter().position(|&stride| on(stride)).unwrap_or(STRIDES.len() - 1)
            };
            for wanted in 0..STRIDES.len() {
                let of_round = all().filter(|&(x, y)| round(x, y) == wanted);
                waiting.extend(of_round.map(|(x, y)| (point(x, y), wanted)));
            }
        } else {
            waiting.extend(all().map(|(x, y)| (point(x, y), 0)));
        }
        let inside = |seed: &&Seed| seed.point.iter().all(|v| (0.0..1.0).contains(v));
        let last = STRIDES.len() - 1;
        let mut order: Vec<_> =
            seeds.iter().filter(inside).map(|seed| (seed.point, last)).collect();
        order.extend(waiting);
        order.reverse();
        Self {
            waiting: order,
            skip_covered: settings.skip_covered,
            covered: Bitset::default(),
            covered_small: Bitset::default(),
            map: [0, 0],
        }
    }

    /// The next points, at most `batch`; empty at the end.
    pub(super) fn next(&mut self, batch: usize) -> Vec<[f32; 2]> {
        let mut points = Vec::new();
        while points.len() < batch.max(1) {
            let Some((point, round)) = self.waiting.pop() else { break };
            if !self.is_covered(point, round) {
                points.push(point);
            }
        }
        points
    }

    fn is_covered(&self, point: [f32; 2], round: usize) -> bool {
        let [width, height] = self.map;
        if !self.skip_covered || width == 0 {
            return false;
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a cell")]
        let cell = |share: f32, cells: usize| ((share * cells as f32) as usize).min(cells - 1);
        let at = cell(point[1], height) * width + cell(point[0], width);
        if round + 1 == STRIDES.len() { self.covered.has(at) } else { self.covered_small.has(at) }
    }

    /// Marks the cells of masks of whole objects.
    pub(super) fn cover(&mut self, masks: &[Proposal], map: [usize; 2], levels: usize) {
        let cells = map[0] * map[1];
        if self.map != map {
            self.map = map;
            (self.covered, self.covered_small) = (Bitset::empty(cells), Bitset::empty(cells));
        }
        for proposal in masks.iter().filter(|proposal| proposal.level + 1 == levels) {
            self.covered.add(&proposal.mask);
            if f64::from(proposal.area) < COVERING_SHARE_MAX * cells as f64 {
                self.covered_small.add(&proposal.mask);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all(prompts: &mut Prompts, batch: usize) -> Vec<[f32; 2]> {
        std::iter::from_fn(|| Some(prompts.next(batch)).filter(|points| !points.is_empty()))
            .flatten()
            .collect()
    }

    #[test]
    fn what_is_covered_is_not_asked_again_and_small_things_on_large_ones_are() {
        let settings = Settings { points_per_side: 16, ..Settings::default() };
        let cover = |share: f32, level: usize| {
            let mut prompts = Prompts::new(&settings, &[]);
            let first = prompts.next(16);
            assert_eq!(first.len(), 16, "the first round is asked before anything is known");
            let values: Vec<f32> = (0..256).map(|i| share - i as f32 / 256.0).collect();
            let mask = Bitset::over(&values, 0.0);
            let (area, bounds) = (mask.count(), mask.bounds(16));
            let proposal = Proposal { mask, area, bounds, level, ..Proposal::default() };
            prompts.cover(&[proposal], [16, 16], 3);
            all(&mut prompts, 64).len()
        };
        assert_eq!(cover(0.0, 2), 240, "nothing covered");
        // The top 16th, small: 16 points are not asked, less those of the first round.
        assert_eq!(cover(0.0625, 2), 240 - 16, "a small mask covers its points");
        // The upper half, large: its points of the second round are asked all the same.
        assert_eq!(cover(0.5, 2), 64 + (240 - 64) / 2, "a large one only those of the last round");
        assert_eq!(cover(0.5, 1), 240, "a part covers nothing");
    }
}
