//! What goes into the use cases and what comes out: plain data, no transport's words.

use std::{fmt, time::Duration};

use serde::{Deserialize, Serialize};

use crate::{
    render::FrameStats,
    scene::{Camera, SceneOptions, SceneStatus, Upload},
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
    /// Jobs that wait.
    pub jobs_queued: usize,
    /// Jobs at work.
    pub jobs_running: usize,
    /// Renders at work or waiting.
    pub renders: usize,
}
