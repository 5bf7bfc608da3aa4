//! What goes into the use cases and what comes out: plain data, no transport's words.

use std::{fmt, time::Duration};

use serde::{Deserialize, Serialize};

use super::{base64, rle::Rle};
use crate::{
    render::{FrameStats, Quality},
    scene::{Camera, Region, SceneOptions, SceneStatus, ScoringProfile, Upload},
};

/// Everything needed to make a scene.
#[derive(Clone, Debug, Default)]
pub struct CreateScene {
    /// Photos and cameras.
    pub upload: Upload,
    /// How to make it.
    pub options: SceneOptions,
    /// Two calls with one key and the same content make one scene; other content is refused.
    pub idempotency_key: Option<String>,
    /// How long to wait for the scene before answering, capped by `limits.wait_ms_max`.
    pub wait: Option<Duration>,
    /// Id of the request, for the log and the trace of the scene's job.
    pub request_id: Option<String>,
}

/// Answer of a create call.
#[derive(Clone, Debug)]
pub struct Created {
    /// The scene, as far as it is.
    pub status: SceneStatus,
    /// Whether an earlier call with the same idempotency key made it.
    pub replayed: bool,
}

/// Which page of the list.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PageRequest {
    /// Scenes on the page; `None` or more than `limits.page_max`: that many.
    pub limit: Option<usize>,
    /// `next` of the page before.
    pub after: Option<String>,
}

/// A page of scenes, newest first, without cameras.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Page {
    /// The scenes.
    pub scenes: Vec<SceneStatus>,
    /// Give as `after` for the next page; `None` on the last.
    pub next: Option<String>,
}

/// Which picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// sRGB colour over the background.
    #[default]
    Color,
    /// Expected depth, world units, 0 where nothing is.
    Depth,
    /// Accumulated opacity, 0..1.
    Alpha,
    /// A fixed colour for each entry of the semantic bank, black where there is none.
    Semantics,
    /// How well each pixel fits a text, 0..1.
    Relevancy,
    /// Where the relevancy is at least 0.5.
    Mask,
}

impl Kind {
    /// Every kind.
    pub const ALL: [Self; 6] =
        [Self::Color, Self::Depth, Self::Alpha, Self::Semantics, Self::Relevancy, Self::Mask];

    /// The kind's snake_case name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Color => "color",
            Self::Depth => "depth",
            Self::Alpha => "alpha",
            Self::Semantics => "semantics",
            Self::Relevancy => "relevancy",
            Self::Mask => "mask",
        }
    }

    /// Whether it answers a text.
    #[must_use]
    pub fn takes_text(self) -> bool {
        matches!(self, Self::Relevancy | Self::Mask)
    }

    /// Whether it needs to know what the scene means.
    #[must_use]
    pub fn needs_semantics(self) -> bool {
        self == Self::Semantics || self.takes_text()
    }
}

/// What is asked by text, and how it is scored.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Ask {
    /// The text; for kinds and exports that take one.
    pub text: Option<String>,
    /// How it is scored.
    pub profile: ScoringProfile,
    /// How long to wait for semantics that are being made; `None`: `limits.text_wait_ms`.
    pub wait: Option<Duration>,
}

/// How a picture is encoded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Format {
    /// 8-bit RGB or grey; 16-bit grey for depth.
    #[default]
    Png,
    /// 8-bit, quality 90; not for depth.
    Jpeg,
    /// 8-bit, lossless; not for depth.
    Webp,
    /// `NumPy` array of little-endian f32, `[H, W, 3]` or `[H, W]`, not clamped.
    Npy,
}

/// Where a camera stands.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PoseSpec {
    /// 16 numbers, row-major, OpenCV camera-to-world.
    CameraToWorld([f64; 16]),
    /// A camera at `eye` that looks at `target`.
    LookAt {
        /// Camera centre.
        eye: [f64; 3],
        /// Point in the middle of the picture (where the principal point is central).
        target: [f64; 3],
        /// Up in the picture; `None`: that of the input cameras, else (0, -1, 0).
        up: Option<[f64; 3]>,
    },
    /// Between two input cameras.
    Between {
        /// Index of one input camera.
        from: usize,
        /// Index of the other.
        to: usize,
        /// 0 at `from`, 1 at `to`; centre linear, rotation by slerp, lens linear.
        t: f64,
    },
}

/// Lens of a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum LensSpec {
    /// Pixels of the picture asked for. Without `cx`, `cy` the principal point is central.
    Focal {
        /// Focal length along x, pixels.
        fx: f64,
        /// Focal length along y, pixels; `None`: `fx`.
        fy: Option<f64>,
        /// Principal point x, pixels; `None`: half the width.
        cx: Option<f64>,
        /// Principal point y, pixels; `None`: half the height.
        cy: Option<f64>,
    },
    /// Vertical field of view in degrees, square pixels, central principal point.
    Fov(f64),
    /// That of the input camera (of the first one, or of `from` and `to`), fitted to the size.
    #[default]
    OfScene,
}

/// A camera as asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CameraSpec {
    /// Where it stands.
    pub pose: PoseSpec,
    /// What it sees with.
    pub lens: LensSpec,
}

/// What all pictures of one request share.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewOptions {
    /// Width, pixels; `None`: from the height and the input camera's shape, longer side at
    /// most 384 where both are missing.
    pub width: Option<u32>,
    /// Height, pixels; `None`: as for the width.
    pub height: Option<u32>,
    /// Encoding.
    pub format: Format,
    /// Background colour, 0..1; `None`: the scene's backdrop.
    pub background: Option<[f32; 3]>,
    /// gsplat's antialiased mode.
    pub antialiased: bool,
    /// Near plane, world units; `None`: 0.01 of the scene's median depth.
    pub near: Option<f32>,
    /// The part of the picture that is drawn and sent; `None`: all of it. For views alone.
    pub crop: Option<Region>,
    /// How closely to keep to the rendering model.
    pub quality: Quality,
    /// The caller's own deadline; never over `limits.render_timeout_ms`.
    pub deadline: Option<Duration>,
}

impl Default for ViewOptions {
    fn default() -> Self {
        Self {
            width: None,
            height: None,
            format: Format::Png,
            background: None,
            antialiased: false,
            near: None,
            crop: None,
            quality: Quality::Exact,
            deadline: None,
        }
    }
}

/// One view.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewSpec {
    /// Camera.
    pub camera: CameraSpec,
    /// Picture.
    pub kind: Kind,
    /// Size, encoding and the rest.
    pub options: ViewOptions,
    /// What is asked by text.
    pub ask: Ask,
}

/// Many cameras and kinds; each camera is rendered once for all kinds.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewsSpec {
    /// Cameras.
    pub cameras: Vec<CameraSpec>,
    /// Pictures of each camera.
    pub kinds: Vec<Kind>,
    /// Size, encoding and the rest.
    pub options: ViewOptions,
    /// What is asked by text.
    pub ask: Ask,
}

/// Which boxes hold the parts of a selection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Boxes {
    /// Turned along the part's own axes.
    #[default]
    Oriented,
    /// Along the axes of the world.
    Aligned,
    /// No parts and no boxes.
    None,
}

/// How a query's masks are given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MaskFormat {
    /// COCO's compressed run lengths.
    #[default]
    Rle,
    /// 8-bit grey PNG, 0 or 255.
    Png,
    /// Area, box and peak alone.
    None,
}

/// Many texts asked of a scene, in 3D and, with a camera, in one view.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct QuerySpec {
    /// The texts.
    pub texts: Vec<String>,
    /// View to answer in; none: 3D alone.
    pub camera: Option<CameraSpec>,
    /// Size and the rest of that view; the encoding does not count.
    pub options: ViewOptions,
    /// Boxes of the parts.
    pub boxes: Boxes,
    /// Masks of the view.
    pub mask: MaskFormat,
    /// Whether the view's relevancy is given too, as an 8-bit grey PNG.
    pub relevancy: bool,
    /// How texts are scored.
    pub profile: ScoringProfile,
    /// How long to wait for semantics that are being made; `None`: `limits.text_wait_ms`.
    pub wait: Option<Duration>,
}

/// What a query found.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct QueryAnswer {
    /// Entries of the scene's bank (M).
    pub bank_size: u32,
    /// How texts were scored.
    pub profile: ScoringProfile,
    /// Camera of the view.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<Camera>,
    /// Time of drawing the view for all texts; 0 where it was still known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub render_ms: Option<f64>,
    /// One result a text, in their order.
    pub results: Vec<TextResult>,
}

/// What a text found.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TextResult {
    /// The text, without blanks around it.
    pub text: String,
    /// `[M]` relevancy of each entry of the bank, 0..1; entry m is the m-th, counted from 1.
    pub scores: Vec<f32>,
    /// Entries selected: those of relevancy 0.5 and more.
    pub entries: Vec<u16>,
    /// Gaussians selected.
    pub gaussians: u64,
    /// Connected parts of the selection, the largest first.
    pub parts: Vec<Part3>,
    /// What makes the answer doubtful.
    pub warnings: Vec<TextWarning>,
    /// What it found in the view.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub view: Option<TextView>,
}

/// Something that makes the answer to a text doubtful.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct TextWarning {
    /// Stable snake_case code: `unknown_words`, `text_cut`.
    pub code: String,
    /// A sentence.
    pub message: String,
}

/// A connected part of a selection and its box, world frame of the upload.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Part3 {
    /// Gaussians.
    pub gaussians: u64,
    /// Centre of the box.
    pub center: [f64; 3],
    /// Unit axes of the box, one a row.
    pub axes: [[f64; 3]; 3],
    /// Full lengths along the axes, world units.
    pub size: [f64; 3],
}

/// What a text found in a view.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct TextView {
    /// Mask as run lengths.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mask_rle: Option<Rle>,
    /// Mask as a PNG; base64 in JSON.
    #[serde(skip_serializing_if = "Option::is_none", serialize_with = "base64::optional")]
    pub mask_png: Option<Vec<u8>>,
    /// Relevancy as a PNG; base64 in JSON.
    #[serde(skip_serializing_if = "Option::is_none", serialize_with = "base64::optional")]
    pub relevancy_png: Option<Vec<u8>>,
    /// Pixels of the mask.
    pub area: u64,
    /// Left, top, width and height of the mask, pixels.
    pub bbox: Option<[u32; 4]>,
    /// Where the relevancy is highest; none where it is 0 everywhere.
    pub peak: Option<Peak>,
}

/// The pixel of the highest relevancy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Peak {
    /// Column.
    pub x: u32,
    /// Row.
    pub y: u32,
    /// Relevancy, 0..1.
    pub relevancy: f32,
}

/// What lies under a pixel of a view.
#[derive(Clone, Debug, PartialEq)]
pub struct PickSpec {
    /// Camera.
    pub camera: CameraSpec,
    /// Across, pixels of the picture; the first pixel is 0 to 1.
    pub x: f64,
    /// Down, pixels.
    pub y: f64,
    /// Size and the rest of the view.
    pub options: ViewOptions,
    /// Texts to name the entry with; none: semantics are not made for it.
    pub labels: Vec<String>,
    /// How labels are scored.
    pub profile: ScoringProfile,
    /// How long to wait for semantics that are being made; `None`: `limits.text_wait_ms`.
    pub wait: Option<Duration>,
}

/// What was found under a pixel.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Picked {
    /// Accumulated opacity, 0..1.
    pub alpha: f32,
    /// Expected depth along the camera's axis, world units; none where nothing is.
    pub depth: Option<f64>,
    /// Point at that depth, world frame of the upload.
    pub point: Option<[f64; 3]>,
    /// The Gaussian that adds most, counted from 0 in the scene's order.
    pub gaussian: Option<u64>,
    /// Its entry of the bank, counted from 1; none where the scene is not understood yet, or the
    /// Gaussian is background.
    pub entry: Option<u16>,
    /// The labels asked for, the best first.
    pub labels: Vec<Label>,
}

/// A text and how well it names an entry.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Label {
    /// The text.
    pub text: String,
    /// Relevancy, 0..1; under 0.5 it does not name it.
    pub relevancy: f32,
}

/// One encoded picture.
#[derive(Clone)]
pub struct RenderedView {
    /// Index of its camera in the request.
    pub camera_index: usize,
    /// Picture.
    pub kind: Kind,
    /// Encoding.
    pub format: Format,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// The file.
    pub bytes: Vec<u8>,
    /// World units of one step of a 16-bit depth PNG: depth = value * `depth_scale`.
    pub depth_scale: Option<f64>,
    /// Camera it was rendered with.
    pub camera: Camera,
    /// Hash of scene and request; equal tags mean equal bytes.
    pub etag: String,
    /// Counts of the frame.
    pub stats: FrameStats,
    /// Time of rendering, without waiting and encoding, milliseconds.
    pub render_ms: f64,
    /// Time of encoding, milliseconds.
    pub encode_ms: f64,
}

impl fmt::Debug for RenderedView {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { camera_index, kind, format, width, height, bytes, .. } = self;
        write!(f, "RenderedView(camera {camera_index}, {kind:?} as {format:?}, ")?;
        write!(f, "{width}x{height}, {} bytes)", bytes.len())
    }
}

/// File format of an export.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ExportFormat {
    /// Standard 3DGS PLY with `semantic_index` as an extra attribute.
    #[default]
    Ply,
}

/// A file being written; its size is known from the start.
#[derive(Debug)]
pub struct Export {
    /// Proposed file name.
    pub file_name: String,
    /// Whole size.
    pub size_bytes: u64,
    /// Hash of scene and format.
    pub etag: String,
    pub(super) chunks: tokio::sync::mpsc::Receiver<Vec<u8>>,
}

impl Export {
    /// Next piece; `None` at the end.
    pub async fn next_chunk(&mut self) -> Option<Vec<u8>> {
        self.chunks.recv().await
    }

    /// The pieces as a stream.
    pub fn into_stream(self) -> impl futures_util::Stream<Item = Vec<u8>> + Send + 'static {
        tokio_stream::wrappers::ReceiverStream::new(self.chunks)
    }
}

/// What makes the scenes: bundle, network, runtime.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ModelsInfo {
    /// Name of the bundle.
    pub bundle: String,
    /// sha256 of its manifest, hex.
    pub bundle_sha256: String,
    /// Networks of the bundle.
    pub models: Vec<ModelInfo>,
    /// Execution provider in use.
    pub execution_provider: String,
    /// Renderer in use: `cpu`, or the adapter's name.
    pub renderer: String,
    /// Version of this server.
    pub server_version: String,
}

/// One network.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ModelInfo {
    /// What it does: `geometry`, `masks.encoder`, `masks.decoder`, `image_text.image`,
    /// `image_text.text`, `image_text.tokenizer`.
    pub name: String,
    /// File in the bundle.
    pub file: String,
    /// sha256, hex.
    pub sha256: String,
    /// Size.
    pub size_bytes: u64,
    /// Licence of the weights.
    pub licence: String,
    /// Photos it takes at once; 0 where it takes none.
    pub views_max: usize,
    /// Working sizes, `[height, width]`.
    pub sizes: Vec<[u32; 2]>,
}

/// What `/readyz` says.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Readiness {
    /// Whether new work is taken.
    pub ready: bool,
    /// The networks: `opening` (scenes are taken and wait for them), `open`, or `broken`.
    pub networks: &'static str,
    /// Jobs that wait.
    pub jobs_queued: usize,
    /// Jobs at work.
    pub jobs_running: usize,
    /// Renders at work or waiting.
    pub renders: usize,
}
