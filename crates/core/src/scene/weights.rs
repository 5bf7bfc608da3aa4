//! The entries of the bank that each pixel of a view shows, with their weights.

use crate::error::{Error, Result};

/// The weights E of a view, sparse: of each pixel the entries that it shows, ascending, each with
/// its weight over 0. The weight of entry m at a pixel is the sum of `alpha T` over the Gaussians
/// of that entry. Entry 0 (the background) is left out.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PixelWeights {
    /// `[H * W + 1]`: the weights of pixel i are `offsets[i]..offsets[i + 1]`.
    pub offsets: Vec<u32>,
    /// `[offsets.last()]` entries of the bank, from 1.
    pub entries: Vec<u16>,
    /// `[offsets.last()]` weights, 0..1.
    pub weights: Vec<f32>,
}

impl PixelWeights {
    /// `pixels` pixels that show no entry.
    pub fn none(pixels: usize) -> Self {
        Self { offsets: vec![0; pixels + 1], ..Self::default() }
    }

    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// The entries of pixel `i`, ascending, and their weights.
    pub fn slices(&self, i: usize) -> (&[u16], &[f32]) {
        let range = self.offsets[i] as usize..self.offsets[i + 1] as usize;
        (&self.entries[range.clone()], &self.weights[range])
    }

    /// As [`Self::slices`], in pairs.
    pub fn pixel(&self, i: usize) -> impl Iterator<Item = (u16, f32)> + Clone + '_ {
        let (entries, weights) = self.slices(i);
        entries.iter().copied().zip(weights.iter().copied())
    }

    /// Sum of the weights of pixel `i`.
    pub fn coverage(&self, i: usize) -> f32 {
        self.slices(i).1.iter().sum()
    }

    /// Bytes held.
    pub fn size_bytes(&self) -> u64 {
        (self.offsets.len() * 4 + self.entries.len() * 6) as u64
    }

    /// Checks that the arrays fit each other.
    ///
    /// # Errors
    /// `internal` when they do not.
    pub fn check(&self) -> Result<()> {
        let last = self.offsets.last().map_or(0, |last| *last as usize);
        let rising = self.offsets.windows(2).all(|pair| pair[0] <= pair[1]);
        if !rising || last != self.entries.len() || last != self.weights.len() {
            return Err(Error::internal(format!(
                "pixel weights: {} entries and {} weights for offsets up to {last}",
                self.entries.len(),
                self.weights.len()
            )));
        }
        Ok(())
    }
}
