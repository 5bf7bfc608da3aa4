//! The sparse weights of a view's pixels over the bank, as a renderer made them.

use crate::error::{Error, Result};

/// Weights of each pixel over the bank, sparse: what a view was blended from.
#[derive(Clone, Copy, Debug)]
pub struct PixelEntries<'a> {
    /// `[P + 1]` where each pixel's entries begin.
    pub offsets: &'a [u32],
    /// Bank indices, from 1.
    pub index: &'a [u16],
    /// Their weights.
    pub weight: &'a [f32],
}

impl<'a> PixelEntries<'a> {
    /// Number of pixels (P).
    #[must_use]
    pub fn pixels(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    pub(super) fn range(&self, p: usize) -> std::ops::Range<usize> {
        self.offsets[p] as usize..self.offsets[p + 1] as usize
    }

    /// Index and weight of each entry of pixel `p`.
    pub(super) fn of(&self, p: usize) -> impl Iterator<Item = (usize, f64)> + Clone + 'a {
        let range = self.range(p);
        let (index, weight) = (&self.index[range.clone()], &self.weight[range]);
        index.iter().map(|m| usize::from(*m)).zip(weight.iter().map(|w| f64::from(*w)))
    }

    /// Refuses arrays that do not belong together.
    pub(super) fn check(&self) -> Result<()> {
        let last = self.offsets.last().map_or(0, |last| *last as usize);
        let rising = self.offsets.windows(2).all(|pair| pair[0] <= pair[1]);
        if !rising || last != self.index.len() || last != self.weight.len() {
            return Err(Error::internal(format!(
                "entries: {} indices and {} weights for offsets up to {last}",
                self.index.len(),
                self.weight.len()
            )));
        }
        Ok(())
    }
}
