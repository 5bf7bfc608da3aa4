//! What the blend of a frame computes: the channels of a Gaussian, what lies behind them, and the
//! options of the kernels.

use super::{footprint::Footprint, lanes::KernelOptions, sky::Sky};
use crate::{
    Background, Kinds, Labels, RenderRequest, Samples,
    budget::{Budget, RayEnd},
    labels::BLEND_WIDTH,
    view::View,
};

/// Most channels: colour, depth, labels.
pub(super) const CHANNELS: usize = 3 + 1 + BLEND_WIDTH;

/// What lies behind colour.
#[derive(Clone, Copy, Debug)]
pub(super) enum Behind<'a> {
    Color([f32; 3]),
    Sky(Sky<'a>),
}

/// What the blend computes, chosen once for each frame.
#[derive(Clone, Copy, Debug)]
pub struct Paint<'a> {
    /// Pictures asked for.
    kinds: Kinds,
    /// What lies behind colour.
    pub(super) behind: Behind<'a>,
    /// Numbers of the pictures.
    pub(super) samples: Samples,
    /// Labels asked for.
    pub(super) labels: &'a Labels,
    /// `[N]` entry of each Gaussian.
    pub(super) entries: &'a [u16],
    /// Where rays end.
    pub(super) ray_end: RayEnd,
    pub(super) options: KernelOptions,
}

impl<'a> Paint<'a> {
    /// The blend of `request`, of which `view` is the camera, of Gaussians with these entries,
    /// `[N]`, and colours up to `brightest`.
    pub fn new(
        request: &'a RenderRequest,
        view: &View,
        entries: &'a [u16],
        brightest: f32,
        options: KernelOptions,
    ) -> Self {
        let RenderRequest { kinds, background, samples, labels, .. } = request;
        let behind = match background {
            Background::Color(color) => Behind::Color(*color),
            Background::Backdrop(backdrop) => Behind::Sky(Sky::new(backdrop, view)),
        };
        let ray_end = RayEnd::new(Budget::of(request).rays, request, brightest);
        Self { kinds: *kinds, behind, samples: *samples, labels, entries, ray_end, options }
    }

    /// Whether colour is asked for.
    pub(super) fn has_color(&self) -> bool {
        self.kinds.color
    }

    /// First channel of depth and of labels, and the number of all.
    pub(super) fn layout(&self) -> [usize; 3] {
        let depth = if self.kinds.color { 3 } else { 0 };
        let label = depth + usize::from(self.kinds.depth);
        let blend = self.labels.table().is_some();
        [depth, label, label + if blend { BLEND_WIDTH } else { 0 }]
    }

    /// Writes the channels of Gaussian `id`, as many as the layout has.
    #[inline(always)]
    pub(super) fn put_channels(
        &self,
        footprint: &Footprint,
        id: usize,
        channels: &mut [f32; CHANNELS],
    ) {
        let [depth, label, _] = self.layout();
        if self.kinds.color {
            channels[..3].copy_from_slice(&footprint.color);
        }
        if self.kinds.depth {
            channels[depth] = footprint.depth;
        }
        if let Some(table) = self.labels.table() {
            let row = Labels::row(table, self.entries[id]);
            channels[label..label + BLEND_WIDTH].copy_from_slice(&row);
        }
    }
}
