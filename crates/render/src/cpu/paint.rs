//! What the blend of a frame computes: the channels of a Gaussian and the options of the kernels.

use super::{footprint::Footprint, lanes::KernelOptions};
use crate::{Kinds, Labels, RenderRequest, labels::BLEND_WIDTH};

/// Most channels: colour, depth, labels.
pub(super) const CHANNELS: usize = 3 + 1 + BLEND_WIDTH;

/// What the blend computes, chosen once for each frame.
#[derive(Clone, Copy, Debug)]
pub struct Paint<'a> {
    /// Pictures asked for.
    kinds: Kinds,
    /// Background colour.
    pub(super) background: [f32; 3],
    /// Labels asked for.
    pub(super) labels: &'a Labels,
    /// `[N]` entry of each Gaussian.
    pub(super) entries: &'a [u16],
    pub(super) options: KernelOptions,
}

impl<'a> Paint<'a> {
    /// The blend of `request`, of Gaussians with these entries, `[N]`.
    pub fn new(request: &'a RenderRequest, entries: &'a [u16], options: KernelOptions) -> Self {
        let RenderRequest { kinds, background, labels, .. } = request;
        Self { kinds: *kinds, background: *background, labels, entries, options }
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
            let row = Labels::row(table, self.entries[id]);
            channels[label..label + BLEND_WIDTH].copy_from_slice(&row);
        }
        channels
    }
}
