//! Renders Gaussians: one model (docs/conventions.md), three renderers.
//!
//! [`oracle`] judges the others: f64, pixel by pixel, no tiles. [`cpu`] is the tiled renderer of
//! the product. [`gpu`] has the same stages in WGSL. All three take a [`RenderRequest`]; [`cpu`]
//! and [`gpu`] give a [`Frame`].
//!
//! The feature `testing` adds what tests and the laboratory look at and change: switches, and
//! the inside of [`gpu`]. The product is built without it.
#![cfg_attr(
    not(feature = "testing"),
    allow(unreachable_pub, reason = "public for the tests' view of the inside")
)]

pub mod backward;
pub mod blocks;
pub mod budget;
pub mod coarse;
pub mod compare;
pub mod constants;
pub mod cpu;
pub mod gpu;
pub mod labels;
pub mod levels;
pub mod merged;
pub mod options;
pub mod oracle;
mod places;
pub mod plan;
pub mod renderer;
pub mod select;
pub mod surface;
#[cfg(feature = "testing")]
pub mod switches;
#[cfg(not(feature = "testing"))]
mod switches;
pub mod train;
pub mod view;

use std::sync::Arc;

use rayon::prelude::*;
pub use segsplat_core::scene::PixelWeights;

#[cfg(feature = "testing")]
pub use self::switches::{Skip, Switches};
pub use self::{
    labels::Labels,
    levels::{DepthSteps, Levels},
    options::{RendererChoice, RendererOptions},
    renderer::{DeviceTimes, DifferentiableRenderer, DispatchTime, Renderer},
};
use crate::{
    error::{Error, Result},
    scene::{Backdrop, Camera, Intrinsics, Region},
};
use segsplat_core::{error, limits, scene};

/// Which pictures a request pays for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Kinds {
    /// `[H, W, 3]` colour over the background.
    pub color: bool,
    /// `[H, W]` expected depth, world units, 0 where alpha is 0.
    pub depth: bool,
    /// `[H, W]` accumulated opacity.
    pub alpha: bool,
}

impl Kinds {
    /// Everything.
    pub const ALL: Self = Self { color: true, depth: true, alpha: true };
    /// Colour alone.
    pub const COLOR: Self = Self { color: true, depth: false, alpha: false };
    /// No picture: labels alone.
    pub const NONE: Self = Self { color: false, depth: false, alpha: false };
}

/// What lies behind the Gaussians: a pixel is `colour + (1 - alpha) * background`.
#[derive(Clone, Debug, PartialEq)]
pub enum Background {
    /// One colour, 0..1, sRGB like the photos.
    Color([f32; 3]),
    /// The photos' colours by direction.
    Backdrop(Arc<Backdrop>),
}

impl Background {
    /// Black.
    pub const BLACK: Self = Self::Color([0.0; 3]);
}

/// The numbers of a picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Samples {
    /// f32, not clamped.
    #[default]
    F32,
    /// Colour and alpha in 8 bits, depth in 16: [`Levels`]. Where less than half a level of light
    /// passes the Gaussians, nothing is put behind them.
    Levels,
    /// As [`Self::Levels`]; colour has alpha as its fourth channel.
    LevelsRgba,
}

/// Where a view draws what a photo gave the scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u32)]
pub enum Layer {
    /// By depth.
    #[default]
    Front,
    /// Behind all that is in front, by depth.
    Behind,
    /// Nowhere. Merged Gaussians ([`merged`]) go by the photo that theirs name first.
    LeftOut,
}

impl Layer {
    /// Behind, or in front.
    #[must_use]
    pub const fn behind_if(behind: bool) -> Self {
        if behind { Self::Behind } else { Self::Front }
    }
}

/// A photo of the scene as a view needs it: where its Gaussians were seen from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Source {
    /// Camera centre from the Gaussians' origin, world axes.
    pub center: [f32; 3],
    /// Axis of the camera, length 1, world axes.
    pub axis: [f32; 3],
    /// 1 / focal length in pixels of the network's picture; 0 where nothing is known.
    pub scale: f32,
    /// Where its Gaussians are drawn.
    pub layer: Layer,
}

impl Source {
    /// Refuses row `i` where a number is not finite or the scale is under 0.
    fn check(&self, i: usize) -> Result<()> {
        let Self { center, axis, scale, .. } = self;
        let finite = center.iter().chain(axis).all(|v| v.is_finite());
        if finite && scale.is_finite() && *scale >= 0.0 {
            return Ok(());
        }
        let what = format!("center {center:?}, axis {axis:?}, scale {scale}");
        Err(Error::invalid(format!("source {i} has {what}; numbers must be finite, scale >= 0")))
    }
}

/// One view to render.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderRequest {
    /// The camera; its intrinsics carry the whole picture's size.
    pub camera: Camera,
    /// The part of the picture that is drawn; `None`: all of it. Its pixels are those of the whole
    /// picture, to the rounding of f32.
    pub crop: Option<Region>,
    /// Pictures wanted.
    pub kinds: Kinds,
    /// Labels wanted, from the same pass.
    pub labels: Labels,
    /// What lies behind colour.
    pub background: Background,
    /// The photos that `source` of the Gaussians names by `view`: layers and magnification
    /// (docs/conventions.md). A Gaussian without a row is in front, as large as it is.
    pub sources: Arc<[Source]>,
    /// Numbers of the pictures.
    pub samples: Samples,
    /// gsplat's antialiased mode: opacity compensated for the 0.3 px² blur.
    pub antialiased: bool,
    /// Near plane, world units along t.z.
    pub near: f32,
    /// Largest difference to the exact picture that is accepted, levels of 255: 0 to
    /// [`budget::ERROR_MAX`]; 0 is exact. docs/conventions.md says what it means for each picture.
    pub error: f32,
    /// Permission to draw merged Gaussians in place of those that are far away, pixels: how far
    /// one may be from the one that stands for it, 0 to [`merged::DETAIL_MAX`]. At 0 none are
    /// drawn. `error` says nothing of what they change.
    pub detail: f32,
}

impl RenderRequest {
    /// A view as a caller gets it who asks for nothing in particular: the whole picture, exact,
    /// over black, without labels.
    pub fn plain(camera: Camera, kinds: Kinds, near: f32) -> Self {
        Self {
            camera,
            crop: None,
            kinds,
            labels: Labels::None,
            background: Background::BLACK,
            sources: Arc::default(),
            samples: Samples::F32,
            antialiased: false,
            near,
            error: 0.0,
            detail: 0.0,
        }
    }

    /// Intrinsics of the picture that comes out: those of the part, where one is asked for.
    pub fn lens(&self) -> Intrinsics {
        let whole = self.camera.intrinsics;
        self.crop.map_or(whole, |crop| whole.part(crop))
    }
}

/// Counts of one frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameStats {
    /// Gaussians that passed culling.
    pub visible: u64,
    /// Gaussian-tile pairs blended.
    pub intersections: u64,
}

/// The pictures, row-major; `None` for kinds not asked for. Colour, depth and alpha are either in
/// f32 or in `levels`, as [`RenderRequest::samples`] says.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Frame {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// `[H * W]` colours over the background, not clamped above 1.
    pub color: Option<Vec<[f32; 3]>>,
    /// `[H * W]` expected depth, world units.
    pub depth: Option<Vec<f32>>,
    /// `[H * W]` accumulated opacity, 0..1.
    pub alpha: Option<Vec<f32>>,
    /// Colour, depth and alpha in levels.
    pub levels: Levels,
    /// `[H * W]` rows of [`Labels::Blend`], blended.
    pub blend: Option<Vec<[f32; 4]>>,
    /// What [`Labels::Weights`] asks for.
    pub weights: Option<PixelWeights>,
    /// `[H * W]` 255 where [`Labels::Mask`] selects, else 0.
    pub mask: Option<Vec<u8>>,
    /// Counts.
    pub stats: FrameStats,
}

impl Frame {
    /// Pictures of zeros, `filled` pixels of each kind that is asked for; depth is f32 until
    /// [`Self::finish`]. Without weights.
    fn blank([width, height]: [u32; 2], request: &RenderRequest, filled: usize) -> Self {
        let RenderRequest { kinds, labels, samples, .. } = request;
        let (exact, rgba) = (*samples == Samples::F32, *samples == Samples::LevelsRgba);
        Self {
            width,
            height,
            color: (kinds.color && exact).then(|| zeros(filled)),
            depth: kinds.depth.then(|| zeros(filled)),
            alpha: (kinds.alpha && exact).then(|| zeros(filled)),
            levels: Levels {
                rgb: (kinds.color && !exact && !rgba).then(|| zeros(filled)),
                rgba: (kinds.color && rgba).then(|| zeros(filled)),
                depth: None,
                alpha: (kinds.alpha && !exact).then(|| zeros(filled)),
            },
            blend: matches!(labels, Labels::Blend(_)).then(|| zeros(filled)),
            weights: None,
            mask: matches!(labels, Labels::Mask { .. }).then(|| zeros(filled)),
            stats: FrameStats::default(),
        }
    }

    /// Depth in steps where levels are asked for: their size depends on the farthest of all pixels.
    fn finish(mut self, samples: Samples) -> Self {
        if samples != Samples::F32 {
            self.levels.depth = self.depth.take().map(|depth| DepthSteps::of(&depth));
        }
        self
    }
}

/// A picture of zeros. All threads write them: new pages are most of the time of it.
fn zeros<T: Copy + Default + Send>(pixels: usize) -> Vec<T> {
    (0..pixels).into_par_iter().with_min_len(1 << 16).map(|_| T::default()).collect()
}

/// Runs `kernel` compiled for the widest vectors of this processor. What the kernel calls is
/// compiled with it where it is inlined. Nothing is fused or reordered: the numbers are the same.
pub fn vectorised<T>(kernel: impl FnOnce() -> T) -> T {
    struct Kernel<F>(F);
    impl<T, F: FnOnce() -> T> pulp::WithSimd for Kernel<F> {
        type Output = T;

        #[inline(always)]
        fn with_simd<S: pulp::Simd>(self, _: S) -> T {
            self.0()
        }
    }
    pulp::Arch::new().dispatch(Kernel(kernel))
}
