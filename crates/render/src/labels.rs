//! Labels of a view: four numbers a pixel, blended from a table, or the weights of all entries
//! that a pixel shows.
//!
//! Each Gaussian has one entry (0 = background). So a Gaussian that adds the weight `alpha T` to a
//! pixel needs one row of the table, or adds to one weight of the pixel. The size of the bank does
//! not matter.

use std::sync::Arc;

use rayon::prelude::*;

use super::constants::PIXEL_WEIGHTS_MAX;
use crate::{
    error::{Error, Result},
    scene::PixelWeights,
};

/// Numbers in a row of a table that is blended.
pub const BLEND_WIDTH: usize = 4;

/// Which labels a request pays for.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum Labels {
    /// None.
    #[default]
    None,
    /// `[H, W, 4]`: each Gaussian adds its weight times row `semantic_index` of this table of
    /// M + 1 rows. An entry beyond the table counts as entry 0; row 0 is zeros as a rule.
    Blend(Arc<[[f32; BLEND_WIDTH]]>),
    /// The weights of all entries that a pixel shows: [`PixelWeights`].
    Weights,
    /// A mask: 255 where the blend of the table is [`selected`], else 0.
    Mask {
        /// As that of [`Self::Blend`]: the coverage, then three scores.
        table: Arc<[[f32; BLEND_WIDTH]]>,
        /// Least coverage of a pixel that is selected.
        coverage_floor: f32,
    },
}

/// Whether a blended row selects its pixel: its coverage is at least the floor, no score is under
/// 0, and not all of them are 0.
#[inline(always)]
pub fn selected([coverage, scores @ ..]: [f32; BLEND_WIDTH], coverage_floor: f32) -> bool {
    let all = scores.iter().all(|&score| score >= 0.0);
    coverage >= coverage_floor && all && scores.iter().any(|&score| score > 0.0)
}

impl Labels {
    /// The table that is blended.
    pub fn table(&self) -> Option<&[[f32; BLEND_WIDTH]]> {
        match self {
            Self::Blend(table) | Self::Mask { table, .. } => Some(table),
            Self::None | Self::Weights => None,
        }
    }

    /// Refuses a table or a floor with a number that is not finite.
    ///
    /// # Errors
    /// `invalid_request` with the row and the number.
    pub fn check(&self) -> Result<()> {
        if let Self::Mask { coverage_floor: floor, .. } = self
            && !floor.is_finite()
        {
            return Err(Error::invalid(format!("labels: the coverage floor is {floor}")));
        }
        let Some(table) = self.table() else { return Ok(()) };
        match table.iter().enumerate().find(|(_, row)| row.iter().any(|v| !v.is_finite())) {
            Some((m, row)) => {
                Err(Error::invalid(format!("labels: row {m} is {row:?}; numbers must be finite")))
            }
            None => Ok(()),
        }
    }

    /// The row of the table for an entry; zeros where the table is empty.
    #[inline]
    pub fn row(table: &[[f32; BLEND_WIDTH]], entry: u16) -> [f32; BLEND_WIDTH] {
        table.get(usize::from(entry)).or_else(|| table.first()).copied().unwrap_or_default()
    }
}

/// The weights of some rows of pixels. The rows are filled in any order.
#[derive(Clone, Debug, Default)]
pub struct WeightRows {
    /// Number of weights of each pixel, row-major.
    counts: Vec<u32>,
    /// Of each row of pixels its (entry, weight) pairs, from left to right.
    rows: Vec<Vec<(u16, f32)>>,
    width: usize,
}

impl WeightRows {
    /// `rows` rows of `width` pixels without weights.
    pub fn new(rows: usize, width: usize) -> Self {
        Self { counts: vec![0; rows * width], rows: vec![Vec::new(); rows], width }
    }

    /// Adds a weight to pixel (`column`, `row`). Columns of a row come in ascending order, and so
    /// do the entries of a pixel.
    #[inline]
    pub fn push(&mut self, column: usize, row: usize, entry: u16, weight: f32) {
        self.counts[row * self.width + column] += 1;
        self.rows[row].push((entry, weight));
    }

    /// Joins parts of the same rows of pixels, from left to right.
    pub(super) fn beside(mut parts: Vec<Self>) -> Option<Self> {
        if parts.len() < 2 {
            return parts.pop();
        }
        let rows = parts[0].rows.len();
        let mut all = Self::new(rows, parts.iter().map(|part| part.width).sum());
        let mut first = 0;
        for part in parts {
            for (row, pairs) in part.rows.into_iter().enumerate() {
                let to = row * all.width + first;
                let counts = &part.counts[row * part.width..(row + 1) * part.width];
                all.counts[to..to + part.width].copy_from_slice(counts);
                all.rows[row].extend(pairs);
            }
            first += part.width;
        }
        Some(all)
    }

    fn total(&self) -> usize {
        self.rows.iter().map(Vec::len).sum()
    }

    /// Joins bands of a view, from top to bottom.
    /// Errors: `limit_exceeded` when there are more weights than [`PIXEL_WEIGHTS_MAX`].
    pub(super) fn join(parts: Vec<Self>) -> Result<PixelWeights> {
        let total: usize = parts.iter().map(Self::total).sum();
        if total as u64 > PIXEL_WEIGHTS_MAX {
            return Err(Error::limit("render: weights of one view", total, PIXEL_WEIGHTS_MAX));
        }
        let pixels = parts.iter().map(|part| part.counts.len()).sum::<usize>();
        let mut all = PixelWeights {
            offsets: vec![0; pixels + 1],
            entries: vec![0; total],
            weights: vec![0.0; total],
        };
        let mut offsets = &mut all.offsets[1..];
        let (mut entries, mut weights) = (&mut all.entries[..], &mut all.weights[..]);
        let mut tasks = Vec::with_capacity(parts.len());
        let mut start = 0;
        for part in parts {
            let (mine, mine_entries, mine_weights);
            (mine, offsets) = offsets.split_at_mut(part.counts.len());
            (mine_entries, entries) = entries.split_at_mut(part.total());
            (mine_weights, weights) = weights.split_at_mut(part.total());
            let first = start;
            start += mine_entries.len() as u32;
            tasks.push((part, first, mine, mine_entries, mine_weights));
        }
        tasks.into_par_iter().for_each(|(part, mut end, offsets, entries, weights)| {
            for (offset, count) in offsets.iter_mut().zip(&part.counts) {
                end += count;
                *offset = end;
            }
            let pairs = part.rows.iter().flatten();
            for ((entry, weight), pair) in entries.iter_mut().zip(weights).zip(pairs) {
                (*entry, *weight) = *pair;
            }
        });
        Ok(all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_joined_in_their_order_whatever_order_they_were_filled_in() {
        let mut top = WeightRows::new(2, 2);
        top.push(1, 1, 7, 0.5);
        top.push(0, 0, 3, 0.25);
        top.push(0, 0, 4, 0.75);
        let mut bottom = WeightRows::new(1, 2);
        bottom.push(0, 0, 9, 1.0);
        let all = WeightRows::join(vec![top, bottom]).expect("few weights");
        assert_eq!(all.offsets, [0, 2, 2, 2, 3, 4, 4], "offsets");
        assert_eq!(all.entries, [3, 4, 7, 9], "entries");
        assert_eq!(all.weights, [0.25, 0.75, 0.5, 1.0], "weights");
        assert_eq!(all.coverage(0), 1.0, "coverage of the first pixel");
        assert_eq!((all.pixels(), all.coverage(1)), (6, 0.0), "a pixel without weights");
    }

    #[test]
    fn parts_of_rows_are_joined_from_left_to_right() {
        let (mut left, mut right) = (WeightRows::new(2, 1), WeightRows::new(2, 2));
        right.push(1, 0, 7, 0.5);
        left.push(0, 0, 3, 0.25);
        right.push(0, 1, 4, 0.75);
        let all = WeightRows::beside(vec![left, right]).expect("two parts");
        let all = WeightRows::join(vec![all]).expect("few weights");
        assert_eq!(all.offsets, [0, 1, 1, 2, 2, 3, 3], "offsets");
        assert_eq!(all.entries, [3, 7, 4], "entries");
        assert!(WeightRows::beside(Vec::new()).is_none(), "no parts");
    }
}
