//! What a view means, beside what it looks like: a few numbers a pixel blended from a table, or
//! the weight of every index that a pixel sees.
//!
//! Each Gaussian has one index (0 = background), so a contribution of weight `alpha T` touches one
//! row of the table, or one entry of the pixel, however many rows there are.

use std::sync::Arc;

use super::constants::ENTRIES_MAX;
use crate::error::{Error, Result};

/// Numbers in a row of a table that is blended.
pub const BLEND_WIDTH: usize = 4;

/// Which labels a request pays for.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum Labels {
    /// None.
    #[default]
    None,
    /// `[H, W, 4]`: each Gaussian adds its weight times row `semantic_index` of this table of
    /// M + 1 rows. An index beyond the table counts as 0; row 0 is zeros as a rule.
    Blend(Arc<[[f32; BLEND_WIDTH]]>),
    /// The sparse weights of every index that a pixel sees: [`Entries`].
    Entries,
}

impl Labels {
    /// Refuses a table with numbers that are not finite: one would spoil pixels that it never
    /// touches.
    ///
    /// # Errors
    /// `invalid_request` with the row and the number.
    pub fn check(&self) -> Result<()> {
        let Self::Blend(table) = self else { return Ok(()) };
        match table.iter().enumerate().find(|(_, row)| row.iter().any(|v| !v.is_finite())) {
            Some((m, row)) => {
                Err(Error::invalid(format!("labels: row {m} is {row:?}; numbers must be finite")))
            }
            None => Ok(()),
        }
    }

    /// The row of the table for an index; zeros where there is no table.
    #[inline]
    #[must_use]
    pub fn row(table: &[[f32; BLEND_WIDTH]], index: u16) -> [f32; BLEND_WIDTH] {
        table.get(usize::from(index)).or_else(|| table.first()).copied().unwrap_or_default()
    }
}

/// E, sparse: for each pixel the indices that it sees, ascending, with their weights over 0.
///
/// The weight of index m at a pixel is the sum of `alpha T` over the Gaussians of that index;
/// index 0 is left out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Entries {
    /// `[H * W + 1]`: pixel i has the entries `offsets[i]..offsets[i + 1]`.
    pub offsets: Vec<u32>,
    /// `[offsets.last()]` indices.
    pub index: Vec<u16>,
    /// `[offsets.last()]` weights, 0..1.
    pub weight: Vec<f32>,
}

impl Entries {
    /// No entries at all, over `pixels` pixels.
    #[must_use]
    pub fn none(pixels: usize) -> Self {
        Self { offsets: vec![0; pixels + 1], ..Self::default() }
    }

    /// Number of pixels.
    #[must_use]
    pub fn pixels(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// Indices and weights of pixel `i`, ascending.
    pub fn pixel(&self, i: usize) -> impl Iterator<Item = (u16, f32)> + '_ {
        let range = self.offsets[i] as usize..self.offsets[i + 1] as usize;
        self.index[range.clone()].iter().copied().zip(self.weight[range].iter().copied())
    }

    /// Sum of the weights of pixel `i`.
    #[must_use]
    pub fn coverage(&self, i: usize) -> f32 {
        self.pixel(i).map(|(_, weight)| weight).sum()
    }

    /// Bytes held.
    #[must_use]
    pub fn size_bytes(&self) -> u64 {
        (self.offsets.len() * 4 + self.index.len() * 6) as u64
    }

    /// Puts rows of tiles together, in their order.
    ///
    /// # Errors
    /// `limit_exceeded` when there are more entries than [`ENTRIES_MAX`].
    pub(super) fn join(parts: Vec<EntryRows>) -> Result<Self> {
        let total: usize = parts.iter().flat_map(|part| &part.rows).map(Vec::len).sum();
        check_total(total)?;
        let pixels = parts.iter().map(|part| part.counts.len()).sum::<usize>();
        let mut all = Self {
            offsets: Vec::with_capacity(pixels + 1),
            index: Vec::with_capacity(total),
            weight: Vec::with_capacity(total),
        };
        let mut end = 0;
        all.offsets.push(0);
        for part in parts {
            all.offsets.extend(part.counts.iter().map(|count| {
                end += count;
                end
            }));
            for row in part.rows {
                all.index.extend(row.iter().map(|entry| entry.0));
                all.weight.extend(row.iter().map(|entry| entry.1));
            }
        }
        Ok(all)
    }

    /// These over `behind`, which is seen through a pixel's `room(i)`, 0..1.
    ///
    /// # Errors
    /// `limit_exceeded` when there are more entries than [`ENTRIES_MAX`].
    pub(super) fn over(&self, behind: &Self, room: impl Fn(usize) -> f32) -> Result<Self> {
        let mut all = Self { offsets: vec![0], ..Self::default() };
        for i in 0..self.pixels() {
            let room = room(i);
            let mut under = behind.pixel(i).map(|(m, w)| (m, w * room)).peekable();
            let mut add = |(index, weight): (u16, f32)| {
                if weight > 0.0 {
                    all.index.push(index);
                    all.weight.push(weight);
                }
            };
            for (index, weight) in self.pixel(i) {
                while let Some(before) = under.next_if(|entry| entry.0 < index) {
                    add(before);
                }
                let same = under.next_if(|entry| entry.0 == index);
                add((index, weight + same.map_or(0.0, |entry| entry.1)));
            }
            under.for_each(add);
            check_total(all.index.len())?;
            all.offsets.push(all.index.len() as u32);
        }
        Ok(all)
    }
}

fn check_total(total: usize) -> Result<()> {
    if total as u64 > ENTRIES_MAX {
        return Err(Error::limit("render: entries of one view", total, ENTRIES_MAX));
    }
    Ok(())
}

/// Entries of some rows of pixels, gathered in any order of the rows.
#[derive(Clone, Debug, Default)]
pub struct EntryRows {
    /// Entries of each pixel, row-major.
    counts: Vec<u32>,
    /// Of each row of pixels its entries, from left to right.
    rows: Vec<Vec<(u16, f32)>>,
    width: usize,
}

impl EntryRows {
    /// `rows` rows of `width` pixels without entries.
    #[must_use]
    pub fn new(rows: usize, width: usize) -> Self {
        Self { counts: vec![0; rows * width], rows: vec![Vec::new(); rows], width }
    }

    /// Adds an entry to pixel (`column`, `row`): indices ascending, columns of a row too.
    #[inline]
    pub fn push(&mut self, column: usize, row: usize, index: u16, weight: f32) {
        self.counts[row * self.width + column] += 1;
        self.rows[row].push((index, weight));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::ErrorCode;

    fn entries(pixels: &[&[(u16, f32)]]) -> Entries {
        let mut rows = EntryRows::new(1, pixels.len());
        for (column, pixel) in pixels.iter().enumerate() {
            pixel.iter().for_each(|&(index, weight)| rows.push(column, 0, index, weight));
        }
        Entries::join(vec![rows]).expect("few entries")
    }

    #[test]
    fn rows_are_joined_in_their_order_whatever_order_they_were_filled_in() {
        let mut top = EntryRows::new(2, 2);
        top.push(1, 1, 7, 0.5);
        top.push(0, 0, 3, 0.25);
        top.push(0, 0, 4, 0.75);
        let mut bottom = EntryRows::new(1, 2);
        bottom.push(0, 0, 9, 1.0);
        let all = Entries::join(vec![top, bottom]).expect("few entries");
        assert_eq!(all.offsets, [0, 2, 2, 2, 3, 4, 4], "offsets");
        assert_eq!(all.index, [3, 4, 7, 9], "indices");
        assert_eq!(all.weight, [0.25, 0.75, 0.5, 1.0], "weights");
        assert_eq!(all.coverage(0), 1.0, "coverage of the first pixel");
        assert_eq!((all.pixels(), all.coverage(1)), (6, 0.0), "a pixel without entries");
    }

    #[test]
    fn over_merges_by_index_and_drops_what_is_hidden() {
        let front = entries(&[&[(2, 0.5), (5, 0.25)], &[(1, 1.0)], &[]]);
        let behind =
            entries(&[&[(1, 0.5), (2, 0.5), (9, 1.0)], &[(1, 0.5), (3, 0.5)], &[(4, 0.5)]]);
        let rooms = [0.25, 0.0, 1.0];
        let all = front.over(&behind, |i| rooms[i]).expect("few entries");
        let want =
            entries(&[&[(1, 0.125), (2, 0.625), (5, 0.25), (9, 0.25)], &[(1, 1.0)], &[(4, 0.5)]]);
        assert_eq!(all, want);
    }

    #[test]
    fn a_table_must_be_finite_and_an_index_beyond_it_is_0() {
        let table = [[9.0; 4], [1.0; 4], [2.0; 4]];
        assert_eq!(Labels::row(&table, 2), [2.0; 4], "the last row");
        assert_eq!(Labels::row(&table, 3), [9.0; 4], "beyond the table");
        assert_eq!(Labels::row(&[], 3), [0.0; 4], "no table");
        Labels::Blend(table.into()).check().expect("finite numbers");
        let mut bad = table;
        bad[1][2] = f32::NAN;
        let error = Labels::Blend(bad.into()).check().expect_err("a NaN");
        assert_eq!(error.code(), ErrorCode::InvalidRequest, "{error}");
        assert!(error.message().starts_with("labels: row 1"), "{error}");
    }
}
