//! Labels of a view: four numbers a pixel, blended from a table, or the weights of all entries
//! that a pixel shows.
//!
//! Each Gaussian has one entry (0 = background). So a Gaussian that adds the weight `alpha T` to a
//! pixel needs one row of the table, or adds to one weight of the pixel. The size of the bank does
//! not matter.

use std::sync::Arc;

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

    /// Joins bands of a view, from top to bottom.
    /// Errors: `limit_exceeded` when there are more weights than [`PIXEL_WEIGHTS_MAX`].
    pub(super) fn join(parts: Vec<Self>) -> Result<PixelWeights> {
        let total: usize = parts.iter().flat_map(|part| &part.rows).map(Vec::len).sum();
        if total as u64 > PIXEL_WEIGHTS_MAX {
            return Err(Error::limit("render: weights of one view", total, PIXEL_WEIGHTS_MAX));
        }
        let pixels = parts.iter().map(|part| part.counts.len()).sum::<usize>();
        let mut all = PixelWeights {
            offsets: Vec::with_capacity(pixels + 1),
            entries: Vec::with_capacity(total),
            weights: Vec::with_capacity(total),
        };
        let mut end = 0;
        all.offsets.push(0);
        for part in parts {
            all.offsets.extend(part.counts.iter().map(|count| {
                end += count;
                end
            }));
            for row in part.rows {
                all.entries.extend(row.iter().map(|pair| pair.0));
                all.weights.extend(row.iter().map(|pair| pair.1));
            }
        }
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
}
