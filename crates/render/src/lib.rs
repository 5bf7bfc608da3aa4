//! Renders Gaussians: one model (docs/conventions.md), three renderers.
//!
//! [`oracle`] judges the others: f64, pixel by pixel, no tiles. [`cpu`] is the tiled renderer of
//! the product. [`gpu`] has the same stages in WGSL. All three take a [`RenderRequest`]; [`cpu`]
//! and [`gpu`] give a [`Frame`].

pub mod compare;
pub mod constants;
pub mod cpu;
pub mod gpu;
pub mod labels;
pub mod oracle;
pub mod plan;
pub mod select;
pub mod switches;
pub mod view;

pub use segsplat_core::scene::PixelWeights;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

pub use self::{
    labels::Labels,
    plan::ViewPlanner,
    select::{RendererChoice, RendererOptions},
    switches::{Skip, Switches},
};
use crate::{
    error::Result,
    scene::{Camera, Gaussians, Intrinsics, Region},
    view::View,
};
use segsplat_core::{error, limits, scene};

/// Which pictures a request pays for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
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

/// How closely a renderer keeps to the model; `docs/conventions.md` bounds what `Fast` may differ.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Quality {
    /// f32 all through.
    #[default]
    Exact,
    /// Faster where a renderer has a faster way, else the same.
    Fast,
}

impl Quality {
    /// All, the default first.
    pub const ALL: [Self; 2] = [Self::Exact, Self::Fast];
}

segsplat_core::names::display_names!(Quality);

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
    /// Background colour, 0..1, sRGB like the photos.
    pub background: [f32; 3],
    /// gsplat's antialiased mode: opacity compensated for the 0.3 px² blur.
    pub antialiased: bool,
    /// Near plane, world units along t.z.
    pub near: f32,
    /// How closely to keep to the model.
    pub quality: Quality,
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
            background: [0.0; 3],
            antialiased: false,
            near,
            quality: Quality::Exact,
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

/// The pictures, row-major; `None` for kinds not asked for.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Frame {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// `[H * W]` colours, not clamped above 1.
    pub color: Option<Vec<[f32; 3]>>,
    /// `[H * W]` expected depth, world units.
    pub depth: Option<Vec<f32>>,
    /// `[H * W]` accumulated opacity, 0..1.
    pub alpha: Option<Vec<f32>>,
    /// `[H * W]` rows of [`Labels::Blend`], blended.
    pub blend: Option<Vec<[f32; 4]>>,
    /// What [`Labels::Weights`] asks for.
    pub weights: Option<PixelWeights>,
    /// Counts.
    pub stats: FrameStats,
}

impl Frame {
    /// Pictures of zeros, `filled` pixels of each kind that is asked for. Without weights.
    fn blank([width, height]: [u32; 2], request: &RenderRequest, filled: usize) -> Self {
        let RenderRequest { kinds, labels, .. } = request;
        Self {
            width,
            height,
            color: kinds.color.then(|| vec![[0.0; 3]; filled]),
            depth: kinds.depth.then(|| vec![0.0; filled]),
            alpha: kinds.alpha.then(|| vec![0.0; filled]),
            blend: matches!(labels, Labels::Blend(_)).then(|| vec![[0.0; 4]; filled]),
            weights: None,
            stats: FrameStats::default(),
        }
    }

    /// A frame without Gaussians.
    fn background(view: &View, request: &RenderRequest) -> Self {
        let pixels = view.width as usize * view.height as usize;
        let mut frame = Self::blank([view.width, view.height], request, pixels);
        frame.color.iter_mut().for_each(|color| color.fill(request.background));
        frame.weights = (request.labels == Labels::Weights).then(|| PixelWeights::none(pixels));
        frame
    }
}

/// Time of one dispatch, by the device's own clock.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct DispatchTime {
    /// Kernel.
    pub stage: &'static str,
    /// Milliseconds.
    pub ms: f64,
}

/// Times of one frame on a device, by its own clock.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct DeviceTimes {
    /// From before the first stage to after the last, no stage marked between: milliseconds.
    pub total_ms: f64,
    /// Every dispatch of another frame, in order.
    pub stages: Vec<DispatchTime>,
}

/// A renderer of the one model.
pub trait Renderer: Send + Sync {
    /// Name for logs, `/v1/models` and benchmarks: `cpu`, or the adapter's own name.
    fn name(&self) -> String;

    /// Views that it draws at the same time with profit; more callers only wait for one another.
    fn concurrency(&self) -> usize;

    /// Renders one view.
    ///
    /// # Errors
    /// `limit_exceeded` when the work does not fit the device's limits, `gpu_unavailable`
    /// when the device is lost, `internal` for a fault of ours. An empty scene is a clean
    /// background.
    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame>;

    /// Renders one view for the times of it on the device; `None` where none keeps them.
    ///
    /// # Errors
    /// As [`Self::render`].
    fn device_times(
        &self,
        _gaussians: &Gaussians,
        _request: &RenderRequest,
    ) -> Result<Option<DeviceTimes>> {
        Ok(None)
    }
}
