//! What the bodies of `query` and `pick` hold, for `/openapi.json`.

use utoipa::{IntoParams, ToSchema};

use super::openapi::{CameraFields, Intrinsics};

/// Body of `query`.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct QueryBody {
    /// 1 to 128 texts of 1 to 256 characters.
    texts: Vec<String>,
    /// View to answer in; without it the answer is 3D alone.
    camera: Option<CameraFields>,
    /// Width of the view, pixels.
    width: Option<u32>,
    /// Height of the view, pixels.
    height: Option<u32>,
    /// As in `render_view`.
    antialiased: Option<bool>,
    /// Near plane, world units.
    near: Option<f32>,
    /// Boxes of the parts: `oriented` (default), `aligned` or `none`.
    boxes: Option<String>,
    /// Masks of the view: `rle` (default, COCO's compressed counts), `png` or `none`.
    mask: Option<String>,
    /// Whether the view's relevancy is given as a PNG too.
    relevancy: Option<bool>,
    /// How texts are scored: `default`, or `paper`.
    profile: Option<String>,
    /// Milliseconds to wait for semantics that are being made; 0 answers `scene_not_ready` at once.
    wait_ms: Option<u64>,
}

/// What a query found.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct QueryResult {
    /// Entries of the scene's bank (M).
    bank_size: u32,
    /// How texts were scored.
    profile: String,
    /// Camera of the view.
    camera: Option<ViewCamera>,
    /// Milliseconds of drawing the view for all texts; 0 where it was still known.
    render_ms: Option<f64>,
    /// One result a text, in their order.
    results: Vec<TextResult>,
}

/// Camera of a view.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct ViewCamera {
    /// Lens.
    intrinsics: Intrinsics,
    /// 16 numbers, row-major, OpenCV.
    camera_to_world: Vec<f64>,
}

/// What a text found.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct TextResult {
    /// The text, without blanks around it.
    text: String,
    /// Relevancy of each entry of the bank, 0..1; the first is entry 1.
    scores: Vec<f32>,
    /// Entries selected: those of relevancy 0.5 and more.
    entries: Vec<u16>,
    /// Gaussians selected.
    gaussians: u64,
    /// Connected parts of the selection, the largest first.
    parts: Vec<Part>,
    /// What makes the answer doubtful.
    warnings: Vec<TextWarning>,
    /// What it found in the view.
    view: Option<TextView>,
}

/// A connected part of a selection and its box, world frame of the upload.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct Part {
    /// Gaussians.
    gaussians: u64,
    /// Centre of the box.
    center: Vec<f64>,
    /// Unit axes of the box, one a row.
    axes: Vec<Vec<f64>>,
    /// Full lengths along the axes, world units.
    size: Vec<f64>,
}

/// Something that makes the answer to a text doubtful.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct TextWarning {
    /// `unknown_words` or `text_cut`.
    code: String,
    /// A sentence.
    message: String,
}

/// What a text found in a view.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct TextView {
    /// Mask as run lengths.
    mask_rle: Option<Rle>,
    /// Mask as a PNG, base64.
    mask_png: Option<String>,
    /// Relevancy as a PNG, base64.
    relevancy_png: Option<String>,
    /// Pixels of the mask.
    area: u64,
    /// Left, top, width and height of the mask, pixels.
    bbox: Option<Vec<u32>>,
    /// Where the relevancy is highest; none where it is 0 everywhere.
    peak: Option<Peak>,
}

/// A mask as COCO's run lengths.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct Rle {
    /// Height and width, pixels.
    size: Vec<u32>,
    /// Compressed counts, as `pycocotools` reads them.
    counts: String,
}

/// The pixel of the highest relevancy.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct Peak {
    /// Column.
    x: u32,
    /// Row.
    y: u32,
    /// Relevancy, 0.5 to 1.
    relevancy: f32,
}

/// Parameters of `pick`: a camera as in `render_view`, and a pixel.
#[derive(IntoParams)]
#[into_params(parameter_in = Query)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct PickParams {
    /// Across, pixels of the picture.
    x: f64,
    /// Down, pixels of the picture.
    y: f64,
    /// Pose: 16 numbers, row-major, OpenCV camera to world, separated by commas.
    camera_to_world: Option<String>,
    /// Pose: camera centre, three numbers.
    eye: Option<String>,
    /// Pose: point looked at, three numbers; goes with `eye`.
    target: Option<String>,
    /// Pose: up in the picture, three numbers; goes with `eye`.
    up: Option<String>,
    /// Pose: index of an input camera.
    from: Option<u32>,
    /// Pose: index of another input camera; goes with `from`.
    to: Option<u32>,
    /// Pose: 0 at `from`, 1 at `to`.
    t: Option<f64>,
    /// Lens: focal length along x, pixels.
    fx: Option<f64>,
    /// Lens: focal length along y; `fx` by default.
    fy: Option<f64>,
    /// Lens: principal point x; the centre by default.
    cx: Option<f64>,
    /// Lens: principal point y; the centre by default.
    cy: Option<f64>,
    /// Lens: vertical field of view, degrees.
    fov: Option<f64>,
    /// Width of the picture, pixels.
    width: Option<u32>,
    /// Height of the picture, pixels.
    height: Option<u32>,
    /// As in `render_view`.
    antialiased: Option<bool>,
    /// Near plane, world units.
    near: Option<f32>,
    /// A text to name the entry with; may be given many times.
    label: Option<Vec<String>>,
    /// How labels are scored: `default`, or `paper`.
    profile: Option<String>,
    /// Milliseconds to wait for semantics that are being made.
    wait_ms: Option<u64>,
    /// Milliseconds after which the call is given up.
    deadline_ms: Option<u64>,
}

/// What lies under a pixel.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct PickAnswer {
    /// Accumulated opacity, 0..1.
    alpha: f32,
    /// Expected depth along the camera's axis, world units; null where nothing is.
    depth: Option<f64>,
    /// Point at that depth.
    point: Option<Vec<f64>>,
    /// The Gaussian that adds most, counted from 0 in the scene's order.
    gaussian: Option<u64>,
    /// Its entry of the bank, from 1; null where the scene is not understood yet, or it has none.
    entry: Option<u16>,
    /// The labels asked for, the best first.
    labels: Vec<Label>,
}

/// A text and how well it names an entry.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct Label {
    /// The text.
    text: String,
    /// Relevancy, 0..1; under 0.5 it does not name it.
    relevancy: f32,
}
