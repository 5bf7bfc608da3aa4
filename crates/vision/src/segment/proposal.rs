//! The masks of a photo that passed.

use half::f16;

use crate::segment::{Bitset, Box2, Settings};

/// A mask that passed.
#[derive(Clone, Debug, Default)]
pub struct Proposal {
    /// Its cells.
    pub mask: Bitset,
    /// How many they are.
    pub area: u32,
    /// Around them.
    pub bounds: Box2,
    /// Which of the decoder's masks it is, from parts to the whole.
    pub level: usize,
    /// Predicted IoU.
    pub predicted_iou: f32,
    /// Stability.
    pub stability: f32,
    /// Its prompt, shares 0..1.
    pub point: [f32; 2],
    /// Logits of its box and one cell around it, where a finer map is wanted.
    pub(super) logits: Patch,
}

impl Proposal {
    /// Predicted IoU, times stability with [`Settings::surest_first`]. A network is unsure of the
    /// IoU on photos of a kind that it has not seen; whether the outline is sharp says more then.
    #[must_use]
    pub fn sureness(&self, settings: &Settings) -> f32 {
        if settings.surest_first { self.predicted_iou * self.stability } else { self.predicted_iou }
    }
}

/// The masks of a photo that passed.
#[derive(Clone, Debug, Default)]
pub struct Proposals {
    /// Columns of the masks' grid, which lies over the whole photo.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The masks, surest first; those of the smallest parts of the photo before.
    pub masks: Vec<Proposal>,
    /// Points that were decoded.
    pub asked: usize,
}

/// A part of a decoder's grid of logits.
#[derive(Clone, Debug, Default)]
pub(super) struct Patch {
    at: Box2,
    values: Vec<f16>,
}

impl Patch {
    /// The box and one cell around it, within the grid.
    pub(super) fn new(logits: &[f32], [width, height]: [usize; 2], bounds: Box2) -> Self {
        let last = |cells: usize| u32::try_from(cells).unwrap_or(u32::MAX).saturating_sub(1);
        let at = Box2 {
            x0: bounds.x0.saturating_sub(1),
            y0: bounds.y0.saturating_sub(1),
            x1: (bounds.x1 + 1).min(last(width)),
            y1: (bounds.y1 + 1).min(last(height)),
        };
        let columns = at.x0 as usize..=at.x1 as usize;
        let rows = logits.chunks_exact(width).take(at.y1 as usize + 1).skip(at.y0 as usize);
        let values = rows.flat_map(|row| row[columns.clone()].iter().map(|v| f16::from_f32(*v)));
        Self { at, values: values.collect() }
    }

    /// The whole grid, outside where nothing is known.
    pub(super) fn spread(&self, [width, height]: [usize; 2]) -> Vec<f32> {
        let mut grid = vec![-1.0; width * height];
        let columns = (self.at.x1 - self.at.x0 + 1) as usize;
        let rows = grid.chunks_exact_mut(width).skip(self.at.y0 as usize);
        for (row, values) in rows.zip(self.values.chunks_exact(columns)) {
            let out = row.iter_mut().skip(self.at.x0 as usize);
            out.zip(values).for_each(|(out, v)| *out = v.to_f32());
        }
        grid
    }
}
