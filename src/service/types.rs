//! What the use cases answer: plain data. The requests are in `request.rs`.

use std::{fmt, io, sync::Arc};

use base64::{Engine as _, prelude::BASE64_STANDARD};
use futures_util::future::BoxFuture;
use serde::{Deserialize, Serialize, Serializer};
use tokio::sync::OwnedSemaphorePermit;
use utoipa::ToSchema;

use super::{
    memory::Share,
    request::{Format, PictureKind},
    times::ViewTimes,
};
use crate::{
    error::Result,
    formats::rle::Rle,
    limits::Limits,
    names::display_names,
    render::FrameStats,
    scene::{Camera, SceneStatus, ScoringMethod},
};

/// Answer of a create call.
#[derive(Clone, Debug)]
pub struct Created {
    /// The scene, as far as it is.
    pub status: SceneStatus,
    /// Whether an earlier call with the same idempotency key made it.
    pub replayed: bool,
}

/// A page of scenes, newest first, without cameras.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct Page {
    /// The scenes.
    pub scenes: Vec<SceneStatus>,
    /// Give as `after` for the next page; `None` on the last.
    pub next: Option<String>,
}

/// What a query found.
#[derive(Clone, Debug, Default, PartialEq, Serialize, ToSchema)]
#[schema(as = QueryResult)]
pub struct QueryAnswer {
    /// Entries of the scene's bank (M).
    pub bank_size: u32,
    /// How texts were scored.
    pub scoring: ScoringMethod,
    /// Camera of the view.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<Camera>,
    /// Time of drawing the view for all texts; 0 where it was still known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub render_ms: Option<f64>,
    /// One result a text, in their order.
    pub results: Vec<TextResult>,
    /// Where the time went; a header of the answer.
    #[serde(skip)]
    pub times: ViewTimes,
}

/// What a text found.
#[derive(Clone, Debug, Default, PartialEq, Serialize, ToSchema)]
pub struct TextResult {
    /// The text, without blanks around it.
    pub text: String,
    /// `[M]` relevancy of each entry of the bank, 0..1; entry m is the m-th, counted from 1.
    pub scores: Vec<f32>,
    /// Entries selected: those whose relevancy is at the cut or over it.
    pub entries: Vec<u16>,
    /// Whether the scene has what the text names: some Gaussian is selected.
    pub found: bool,
    /// Gaussians selected.
    pub gaussians: u64,
    /// Connected parts of the selection, the one with the best score first.
    pub parts: Vec<InstanceBox>,
    /// The measured word that the text is about: one of `/v1/models`; none where there is none.
    pub word: Option<String>,
    /// What to expect of that word.
    pub trust: Option<Trust>,
    /// What makes the answer doubtful.
    pub warnings: Vec<TextWarning>,
    /// What it found in the view.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub view: Option<TextView>,
}

/// Something that makes the answer to a text doubtful.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, ToSchema)]
pub struct TextWarning {
    /// Stable snake_case code: `unknown_words`, `text_cut`.
    pub code: String,
    /// A sentence.
    pub message: String,
}

/// A connected part of a selection and its box, world frame of the upload.
#[derive(Clone, Debug, Default, PartialEq, Serialize, ToSchema)]
#[schema(as = Part)]
pub struct InstanceBox {
    /// Gaussians.
    pub gaussians: u64,
    /// Relevancy of its best entry, 0..1; of those that a tenth of its Gaussians have.
    pub score: f32,
    /// Centre of the box.
    pub center: [f64; 3],
    /// Unit axes of the box, one a row, right-handed.
    pub axes: [[f64; 3]; 3],
    /// Full lengths along the axes, world units. The few Gaussians far from most of them are left
    /// out.
    pub size: [f64; 3],
    /// Mean centre of its Gaussians, world units.
    pub centroid: [f64; 3],
    /// Covariance of its Gaussians, each counted once: the mean of their own and the spread of
    /// their centres. World units squared.
    pub covariance: [[f64; 3]; 3],
    /// `[V]` share of its Gaussians that each photo of the scene shows, 0..1, in the order of the
    /// scene's cameras.
    pub visibility: Vec<f32>,
}

/// What a text found in a view.
#[derive(Clone, Debug, Default, PartialEq, Serialize, ToSchema)]
pub struct TextView {
    /// Mask as run lengths.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mask_rle: Option<Rle>,
    /// Mask as a PNG; base64 in JSON.
    #[serde(skip_serializing_if = "Option::is_none", serialize_with = "as_base64")]
    #[schema(value_type = Option<String>)]
    pub mask_png: Option<Vec<u8>>,
    /// Relevancy as a PNG; base64 in JSON.
    #[serde(skip_serializing_if = "Option::is_none", serialize_with = "as_base64")]
    #[schema(value_type = Option<String>)]
    pub relevancy_png: Option<Vec<u8>>,
    /// Pixels of the mask.
    pub area: u64,
    /// Left, top, width and height of the mask, pixels.
    pub bbox: Option<[u32; 4]>,
    /// Where the relevancy is highest; none where it is 0 everywhere.
    pub peak: Option<Peak>,
}

#[expect(clippy::ref_option, reason = "serde calls it so")]
fn as_base64<S: Serializer>(file: &Option<Vec<u8>>, to: S) -> Result<S::Ok, S::Error> {
    file.as_ref().map(|bytes| BASE64_STANDARD.encode(bytes)).serialize(to)
}

/// The pixel of the highest relevancy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, ToSchema)]
pub struct Peak {
    /// Column.
    pub x: u32,
    /// Row.
    pub y: u32,
    /// Relevancy, 0..1.
    pub relevancy: f32,
}

/// What was found under a pixel.
#[derive(Clone, Debug, Default, PartialEq, Serialize, ToSchema)]
#[schema(as = PickAnswer)]
pub struct Picked {
    /// Accumulated opacity, 0..1.
    pub alpha: f32,
    /// Depth of the surface along the camera's axis, world units; none where nothing is. The
    /// depth that a view blends is up to a percent less where a surface leans.
    pub depth: Option<f64>,
    /// Point at that depth, world frame of the upload; on the ground where it is the ground's.
    pub point: Option<[f64; 3]>,
    /// The Gaussian that adds most, counted from 0 in the scene's order.
    pub gaussian: Option<u64>,
    /// Its entry of the bank, counted from 1; none where the scene has no semantics yet, or the
    /// Gaussian is background.
    pub entry: Option<u16>,
    /// The labels of the request, the best first.
    pub labels: Vec<Label>,
}

/// A text and how well it names an entry.
#[derive(Clone, Debug, Default, PartialEq, Serialize, ToSchema)]
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
    pub kind: PictureKind,
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
    /// Bound of its difference to the exact picture, levels of 255; 0: it is exact. Of merged
    /// Gaussians it is that of theirs.
    pub error: f32,
    /// How far a Gaussian is at most from the merged one that stands for it, pixels; 0: none is
    /// merged.
    pub detail: f32,
    /// Camera it was rendered with.
    pub camera: Camera,
    /// Hash of scene and request; equal tags mean equal bytes.
    pub etag: String,
    /// Counts of the frame.
    pub stats: FrameStats,
    /// Where the time went.
    pub times: ViewTimes,
    /// Its bytes in the budget of answers, until they are sent; `None` on the command line.
    pub held: Option<Arc<Share>>,
}

impl RenderedView {
    /// Shape of the array of a format without a codec: height and width, and the samples of a pixel
    /// where there are several.
    pub fn shape(&self) -> Option<Vec<u32>> {
        let (height, width) = (self.height, self.width);
        match self.format.samples()? {
            1 => Some(vec![height, width]),
            samples => Some(vec![height, width, samples]),
        }
    }
}

impl fmt::Debug for RenderedView {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { camera_index, kind, format, width, height, bytes, .. } = self;
        write!(f, "RenderedView(camera {camera_index}, {kind:?} as {format:?}, ")?;
        write!(f, "{width}x{height}, {} bytes)", bytes.len())
    }
}

/// A file for other programs, not begun.
pub struct Export {
    /// Proposed file name.
    pub file_name: String,
    /// Media type.
    pub media_type: &'static str,
    /// Hash of scene and format.
    pub etag: String,
    pub(super) begin: BoxFuture<'static, Result<ExportBody>>,
}

impl fmt::Debug for Export {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Export({}, {})", self.file_name, self.etag)
    }
}

impl Export {
    /// Makes the file and begins to write it.
    ///
    /// # Errors
    /// `overloaded` where too many exports are being sent; `invalid_request` and `limit_exceeded`
    /// for a scene that the format cannot hold; with a text also those of its network.
    pub async fn begin(self) -> Result<ExportBody> {
        self.begin.await
    }
}

/// The place of a file among the exports.
#[derive(Debug)]
pub struct ExportPlace {
    pub(super) _shares: [Share; 2],
    pub(super) _folder: Option<OwnedSemaphorePermit>,
}

/// A file being written. While it is, it has a blocking thread, which waits for the caller: there
/// are no more of them than places.
#[derive(Debug)]
pub struct ExportBody {
    /// Whole size, where it is known before the end.
    pub size_bytes: Option<u64>,
    /// Its place among the exports, to be held until the last part is sent.
    pub place: Option<Arc<ExportPlace>>,
    pub(super) chunks: tokio::sync::mpsc::Receiver<io::Result<Vec<u8>>>,
}

impl ExportBody {
    /// The parts as a stream; a fault ends it.
    pub fn into_stream(
        self,
    ) -> impl futures_util::Stream<Item = io::Result<Vec<u8>>> + Send + 'static {
        tokio_stream::wrappers::ReceiverStream::new(self.chunks)
    }
}

/// What makes the scenes: bundle, network, runtime.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = Models)]
pub struct ModelsInfo {
    /// Name of the bundle.
    pub bundle: String,
    /// sha256 of its manifest, hex.
    pub bundle_sha256: String,
    /// Networks of the bundle.
    pub models: Vec<ModelInfo>,
    /// What was measured of everyday words; empty where the bundle does not say.
    pub words: Vec<KnownWord>,
    /// Execution provider in use; in brackets why it is not the one that was to be used.
    pub execution_provider: String,
    /// Renderer in use: `cpu`, or the adapter's name.
    pub renderer: String,
    /// Version of this server.
    pub server_version: String,
    /// What a caller may send and ask for.
    pub limits: CallerLimits,
}

/// The limits in force that a caller must know before a call: what to choose of many photos, how
/// small to make large ones, how many cameras to ask for at once.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CallerLimits {
    /// Photos of a scene.
    pub photos_max: usize,
    /// Those of them that the networks see.
    pub network_photos_max: usize,
    /// Bytes of an upload.
    pub upload_bytes_max: usize,
    /// Pixels of a photo as it is sent.
    pub photo_pixels_max: u64,
    /// Longer side of a photo as the server keeps it, pixels.
    pub photo_side_kept_max: u32,
    /// Pixels of all photos that the networks see, as the server keeps them.
    pub photos_pixels_kept_max: u64,
    /// Cameras of one call for views.
    pub cameras_max: usize,
}

impl From<&Limits> for CallerLimits {
    fn from(limits: &Limits) -> Self {
        Self {
            photos_max: limits.photos_max,
            network_photos_max: limits.network_photos_max,
            upload_bytes_max: limits.upload_bytes_max,
            photo_pixels_max: limits.photo_pixels_max,
            photo_side_kept_max: limits.photo_side_kept_max,
            photos_pixels_kept_max: limits.photos_pixels_kept_max,
            cameras_max: limits.cameras_max,
        }
    }
}

impl Default for CallerLimits {
    fn default() -> Self {
        Self::from(&Limits::default())
    }
}

/// One network.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = Model)]
pub struct ModelInfo {
    /// What it does: `geometry`, `geometry.cpu`, `geometry.many`, `geometry.many.cpu`,
    /// `masks.encoder`, `masks.decoder`, `image_text.image`, `image_text.text`,
    /// `image_text.tokenizer`, `image_text.words`, `text_masks.image`, `text_masks.find`,
    /// `text_masks.tokenizer`, `features`, `matcher`, `cameras`.
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

/// How well the towers of the bundle know a word, on photographs that no training saw.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct KnownWord {
    /// The word.
    pub word: String,
    /// What to expect of it.
    pub trust: Trust,
    /// Things that it may be said of, cut out along their outlines.
    pub things: u32,
    /// Share of them that it selects, 0 to 1; null where there are none.
    pub things_found: Option<f32>,
    /// Whole photographs that it may be said of.
    pub photographs: u32,
    /// Share of them that it selects, 0 to 1; null where there are none.
    pub photographs_found: Option<f32>,
    /// Share of all others that it selects, 0 to 1.
    pub absent: f32,
}

/// What to expect of a word.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Trust {
    /// It selects most of what it names, and hardly anything else.
    Good,
    /// Between the two.
    Fair,
    /// It misses most of what it names, or selects much else.
    Poor,
    /// Too few photographs show it.
    Unmeasured,
}

display_names!(Trust);

/// What `/readyz` says.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct Readiness {
    /// Whether new jobs are taken.
    pub ready: bool,
    /// The networks: `opening` (scenes are taken and wait for them), `open`, or `broken`.
    pub networks: &'static str,
    /// Jobs that wait.
    pub jobs_queued: usize,
    /// Jobs that workers run.
    pub jobs_running: usize,
    /// Views that are drawn, encoded or wait.
    pub renders: usize,
}
