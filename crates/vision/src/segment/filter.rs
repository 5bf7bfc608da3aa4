//! Which masks of a decoder are good: predicted IoU, stability, area.

use std::borrow::Cow;

use rayon::prelude::*;

use crate::{
    error::{Error, Result},
    scene::{JudgedMasks, MaskJudging, MaskLogits, Photo},
    segment::{Bitset, PhotoGrid, Proposal, Settings, photo_grid::Resample, proposal::Patch},
};

/// Keeps the good masks of one photo.
#[derive(Debug)]
pub(super) struct MaskFilter {
    photo_grid: PhotoGrid,
    levels: usize,
    /// To the photo's pixels; `None`: the decoder's cells that lie over the photo, as they are.
    resample: Option<Resample>,
    map: [usize; 2],
    /// Cells without a source in the photo.
    blank: Option<Bitset>,
    settings: Settings,
}

/// What a predicted IoU must be over. As in Segment Anything a threshold of 0 asks nothing, so that
/// a mask stays whose predicted IoU is less than 0.
#[must_use]
pub fn iou_over(pred_iou_thresh: f32) -> f32 {
    if pred_iou_thresh > 0.0 { pred_iou_thresh } else { f32::NEG_INFINITY }
}

impl MaskFilter {
    /// For a decoder's levels and `[width, height]` of its grid.
    pub(super) fn new(
        (side, resized): (u32, [u32; 2]),
        (levels, grid): (usize, [usize; 2]),
        photo: &Photo,
        settings: &Settings,
    ) -> Result<Self> {
        let photo_grid = PhotoGrid { grid, side, resized };
        let inside = resized.iter().all(|&v| v > 0 && v <= side);
        if grid.contains(&0) || levels == 0 || !inside {
            return Err(Error::internal(format!(
                "masks: the decoder answers {levels} levels on {photo_grid:?}"
            )));
        }
        let resample = settings.full_resolution.then(|| photo_grid.to_photo(photo));
        let map = resample.as_ref().map_or_else(|| photo_grid.cells(), Resample::size);
        let blank = blank(photo, map);
        Ok(Self { photo_grid, levels, resample, map, blank, settings: settings.clone() })
    }

    pub(super) fn photo_grid(&self) -> PhotoGrid {
        self.photo_grid
    }

    /// Masks of a point.
    pub(super) fn levels(&self) -> usize {
        self.levels
    }

    /// `[width, height]` of the masks.
    pub(super) fn map(&self) -> [usize; 2] {
        self.map
    }

    /// The masks that pass, in the order of points and levels; of each point only one
    /// where `wholes` is set, by [`Settings::level`].
    pub(super) fn pass(
        &self,
        decoded: &MaskLogits,
        points: &[[f32; 2]],
        wholes: bool,
    ) -> Result<Vec<Proposal>> {
        let cells = self.photo_grid.grid[0] * self.photo_grid.grid[1];
        let count = points.len() * self.levels;
        if decoded.grid != self.photo_grid.grid
            || decoded.levels != self.levels
            || decoded.logits.len() != count * cells
            || decoded.predicted_iou.len() != count
        {
            return Err(Error::internal(format!(
                "masks: {} points are answered by {} levels on {:?}, {} logits and {} IoUs",
                points.len(),
                decoded.levels,
                decoded.grid,
                decoded.logits.len(),
                decoded.predicted_iou.len()
            )));
        }
        Ok(self.of_points(points, wholes, |i, level| {
            let at = i * self.levels + level;
            let logits = &decoded.logits[at * cells..(at + 1) * cells];
            let proposal = self.passed(logits, decoded.predicted_iou[at], wholes)?;
            Some(Proposal { level, point: points[i], ..proposal })
        }))
    }

    /// How a decoder is to judge the masks that [`Self::pass_judged`] looks at; `None` where they
    /// are not judged at the photo's pixels.
    pub(super) fn judging(&self, wholes: bool) -> Option<MaskJudging> {
        let resample = self.resample.as_ref()?;
        let one = self.settings.level.place(self.levels).filter(|_| wholes);
        let [rows, columns] = resample.matrices();
        Some(MaskJudging {
            levels: one.map_or_else(|| (0..self.levels).collect(), |level| vec![level]),
            pixels: self.map,
            rows,
            columns,
            stability_offset: self.settings.stability_score_offset,
        })
    }

    /// As [`Self::pass`], of masks that the decoder judged.
    pub(super) fn pass_judged(
        &self,
        judged: &JudgedMasks,
        judging: &MaskJudging,
        points: &[[f32; 2]],
        wholes: bool,
    ) -> Result<Vec<Proposal>> {
        let (kinds, bytes) = (judging.levels.len(), (self.map[0] * self.map[1]).div_ceil(64) * 8);
        let count = points.len() * kinds;
        let [bits, counts] = [judged.bits.len(), judged.counts.len()];
        if bits != count * bytes || counts != 2 * count || judged.predicted_iou.len() != count {
            return Err(Error::internal(format!(
                "masks: {count} masks of {:?} pixels are judged by {bits} bytes, {counts} counts \
                 and {} IoUs",
                self.map,
                judged.predicted_iou.len()
            )));
        }
        Ok(self.of_points(points, wholes, |i, level| {
            let at = i * kinds + judging.levels.iter().position(|&judged| judged == level)?;
            let predicted_iou = judged.predicted_iou[at];
            if !self.is_sure(predicted_iou) {
                return None;
            }
            let stability = self.stability(judged.counts[2 * at], judged.counts[2 * at + 1])?;
            let mask = Bitset::of_bytes(&judged.bits[at * bytes..(at + 1) * bytes]);
            let proposal = self.proposal(mask)?;
            Some(Proposal { level, predicted_iou, stability, point: points[i], ..proposal })
        }))
    }

    /// The masks that pass of each point; `mask` gives one by point and level.
    fn of_points(
        &self,
        points: &[[f32; 2]],
        wholes: bool,
        mask: impl Fn(usize, usize) -> Option<Proposal> + Sync,
    ) -> Vec<Proposal> {
        let of_point = |i: usize| -> Vec<Proposal> {
            let mask = |level: usize| mask(i, level);
            match self.settings.level.place(self.levels) {
                _ if !wholes => (0..self.levels).filter_map(mask).collect(),
                None => (0..self.levels).rev().find_map(mask).into_iter().collect(),
                Some(level) => mask(level).into_iter().collect(),
            }
        };
        let each: Vec<Vec<Proposal>> = (0..points.len()).into_par_iter().map(of_point).collect();
        each.into_iter().flatten().collect()
    }

    fn is_sure(&self, predicted_iou: f32) -> bool {
        predicted_iou > iou_over(self.settings.pred_iou_thresh)
    }

    /// The cells over the stricter threshold by those over the looser one, where that is enough.
    fn stability(&self, strict: f32, loose: f32) -> Option<f32> {
        let stability = if loose == 0.0 { 0.0 } else { strict / loose };
        (stability >= self.settings.stability_score_thresh).then_some(stability)
    }

    /// A mask's cells, area and box, where its area is within the bounds.
    fn proposal(&self, mut mask: Bitset) -> Option<Proposal> {
        if let Some(blank) = &self.blank {
            mask.subtract(blank);
        }
        let (s, area) = (&self.settings, mask.count());
        let share = f64::from(area) / (self.map[0] * self.map[1]) as f64;
        if share < s.min_area || share > s.max_area {
            return None;
        }
        let bounds = mask.bounds(self.map[0]);
        Some(Proposal { mask, area, bounds, ..Proposal::default() })
    }

    fn passed(&self, logits: &[f32], predicted_iou: f32, keep_logits: bool) -> Option<Proposal> {
        let s = &self.settings;
        if !self.is_sure(predicted_iou) {
            return None;
        }
        let values = match &self.resample {
            Some(resample) => Cow::Owned(resample.apply(logits)),
            None => cropped(logits, self.photo_grid.grid[0], self.map),
        };
        let over = |threshold: f32| values.iter().filter(|v| **v > threshold).count();
        let (strict, loose) = (over(s.stability_score_offset), over(-s.stability_score_offset));
        let stability = self.stability(strict as f32, loose as f32)?;
        let proposal = self.proposal(Bitset::over(&values, 0.0))?;
        let fine = keep_logits && self.resample.is_none() && s.map_scale > 1;
        let logits = match fine {
            true => Patch::new(logits, self.photo_grid.grid, proposal.bounds),
            false => Patch::default(),
        };
        Some(Proposal { predicted_iou, stability, logits, ..proposal })
    }
}

/// The left top of a grid.
fn cropped(logits: &[f32], grid_width: usize, [width, height]: [usize; 2]) -> Cow<'_, [f32]> {
    if width == grid_width {
        return Cow::Borrowed(&logits[..width * height]);
    }
    let mut values = Vec::with_capacity(width * height);
    let rows = logits.chunks_exact(grid_width).take(height);
    rows.for_each(|row| values.extend_from_slice(&row[..width]));
    Cow::Owned(values)
}

/// Cells of a map whose middle has no source in the photo.
pub(super) fn blank(photo: &Photo, [width, height]: [usize; 2]) -> Option<Bitset> {
    let valid = photo.valid.as_ref()?;
    let middle = |i: usize, cells: usize, pixels: u32| (2 * i + 1) * pixels as usize / (2 * cells);
    let missing = |cell: usize| {
        let x = middle(cell % width, width, photo.width);
        let y = middle(cell / width, height, photo.height);
        !valid.get(y * photo.width as usize + x).copied().unwrap_or(true)
    };
    let values: Vec<f32> =
        (0..width * height).map(|cell| f32::from(u8::from(missing(cell)))).collect();
    Some(Bitset::over(&values, 0.5))
}
