//! What a frame asks of the blend: the channels of a Gaussian, and how the kernels work.

use super::{footprint::Footprint, lanes::Width};
use crate::{Kinds, Labels, RenderRequest, labels::BLEND_WIDTH, skip::Skip};

/// Most channels: colour, depth, labels.
pub(super) const CHANNELS: usize = 3 + 1 + BLEND_WIDTH;

/// What a Gaussian is blended with, chosen once a frame.
#[derive(Clone, Copy, Debug)]
pub struct Paint<'a> {
    /// Pictures wanted.
    kinds: Kinds,
    /// Behind everything, in colour.
    pub(super) background: [f32; 3],
    /// Labels wanted.
    pub(super) labels: &'a Labels,
    /// `[N]` bank index of each Gaussian.
    pub(super) index: &'a [u16],
    /// Lanes of the kernel.
    pub(super) width: Width,
    /// What is not left out.
    pub(super) without: Option<Skip>,
}

impl<'a> Paint<'a> {
    /// What `request` asks for, of Gaussians with the bank indices `index`, `[N]`.
    #[must_use]
    pub fn new(request: &'a RenderRequest, index: &'a [u16]) -> Self {
        let RenderRequest { kinds, background, labels, .. } = request;
        let (kinds, background, width) = (*kinds, *background, Width::widest());
        Self { kinds, background, labels, index, width, without: None }
    }

    /// The same with kernels of another width.
    #[must_use]
    pub fn with_width(self, width: Width) -> Self {
        Self { width, ..self }
    }

    /// The same, one kind of needless work not left out.
    #[must_use]
    pub fn without(self, without: Option<Skip>) -> Self {
        Self { without, ..self }
    }

    /// Labels wanted.
    #[must_use]
    pub fn labels(&self) -> &'a Labels {
        self.labels
    }

    /// First channel of depth and of labels, and the number of all.
    pub(super) fn layout(&self) -> [usize; 3] {
        let depth = if self.kinds.color { 3 } else { 0 };
        let label = depth + usize::from(self.kinds.depth);
        let blend = matches!(self.labels, Labels::Blend(_));
        [depth, label, label + if blend { BLEND_WIDTH } else { 0 }]
    }

    /// The channels of Gaussian `id`.
    #[inline(always)]
    pub(super) fn channels(&self, footprint: &Footprint, id: usize) -> [f32; CHANNELS] {
        let [depth, label, _] = self.layout();
        let mut channels = [0.0; CHANNELS];
        if self.kinds.color {
            channels[..3].copy_from_slice(&footprint.color);
        }
        if self.kinds.depth {
            channels[depth] = footprint.depth;
        }
        if let Labels::Blend(table) = self.labels {
            let row = Labels::row(table, self.index[id]);
            channels[label..label + BLEND_WIDTH].copy_from_slice(&row);
        }
        channels
    }
}
