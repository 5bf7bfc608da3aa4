//! `/openapi.json`: the calls of this door. The schemas say what the bodies hold;
//! `tests/it/errors.rs` compares them with real answers and the paths with the routes.

use axum::Json;
use utoipa::{
    IntoParams, Modify, OpenApi, ToSchema,
    openapi::{self, RefOr, Response, content::ContentBuilder, response::ResponseBuilder},
};

use super::{ask, health, render, scenes, viewer, views};

/// `GET /openapi.json`
#[utoipa::path(
    get, path = "/openapi.json", operation_id = "openapi", tag = "server",
    responses((status = 200, description = "This document", content_type = "application/json"))
)]
pub(super) async fn document() -> Json<openapi::OpenApi> {
    Json(Document::openapi())
}

#[derive(OpenApi)]
#[openapi(
    info(
        title = "SegSplat Server",
        description = "Posed photos in; views at any pose, and answers to texts, out."
    ),
    paths(
        scenes::create, scenes::list, scenes::get, scenes::delete, scenes::events, render::view,
        views::views, ask::query, ask::pick, render::export, health::models, health::live,
        health::ready, health::metrics, document, viewer::index,
    ),
    components(schemas(ErrorBody)),
    tags(
        (name = "scenes", description = "Make, list, show, watch and delete scenes"),
        (name = "views", description = "Pictures and files of a scene"),
        (name = "texts", description = "Where is it? A scene asked by text"),
        (name = "server", description = "Health, models, this document"),
    ),
    modifiers(&EveryCall),
)]
struct Document;

/// Adds to every call what every call has: `deadline_ms` is documented once, errors by default.
struct EveryCall;

impl Modify for EveryCall {
    fn modify(&self, document: &mut openapi::OpenApi) {
        let error = openapi::Ref::from_schema_name("ErrorBody");
        let fault: Response = ResponseBuilder::new()
            .description("An error of the table in docs/errors.md")
            .content("application/json", ContentBuilder::new().schema(Some(error)).build())
            .build();
        for item in document.paths.paths.values_mut() {
            let operations = [&mut item.get, &mut item.post, &mut item.delete];
            for operation in operations.into_iter().flatten() {
                let fault = RefOr::T(fault.clone());
                operation.responses.responses.insert("default".to_owned(), fault);
            }
        }
    }
}

/// The id in the path.
#[derive(IntoParams)]
#[into_params(parameter_in = Path)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct IdParam {
    /// 32 lower-case hex digits.
    id: String,
}

/// Parameters of `create_scene`.
#[derive(IntoParams)]
#[into_params(parameter_in = Query)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct CreateParams {
    /// When a scene's semantics are made: `lazy` (default) with the first text, `eager` as soon as
    /// it can be viewed, `off` never.
    semantics: Option<String>,
    /// Name of the model bundle; the loaded one by default.
    bundle: Option<String>,
    /// Views the network takes at once.
    max_views: Option<u32>,
    /// Gaussians kept: `thinned` (default), one for up to 16 neighbours where the photos are flat,
    /// or `full`, one a pixel.
    density: Option<String>,
    /// Milliseconds to wait for the scene before answering.
    wait_ms: Option<u64>,
    /// Milliseconds after which the call is given up.
    deadline_ms: Option<u64>,
}

/// Parts of the upload.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct UploadForm {
    /// A nerfstudio or instant-ngp `transforms.json` (OpenGL axes).
    #[schema(content_media_type = "application/json")]
    transforms: Option<String>,
    /// Our own JSON (OpenCV axes):
    /// `{"cameras":[{"file","intrinsics","camera_to_world"}]}`.
    #[schema(content_media_type = "application/json")]
    cameras: Option<String>,
    /// A zip or tar of a folder of photos and its camera JSON, instead of all other parts.
    #[schema(content_media_type = "application/octet-stream")]
    archive: Option<String>,
    /// Any other part is a photo, named by its part or file.
    #[schema(content_media_type = "image/*")]
    photo: Option<Vec<String>>,
}

/// Parameters of `list_scenes`.
#[derive(IntoParams)]
#[into_params(parameter_in = Query)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct ListParams {
    /// Scenes on the page.
    limit: Option<u32>,
    /// `next` of the page before.
    after: Option<String>,
}

/// Parameters of `render_view`: one pose, at most one lens, the picture.
#[derive(IntoParams)]
#[into_params(parameter_in = Query)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct ViewParams {
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
    /// Width, pixels.
    width: Option<u32>,
    /// Height, pixels.
    height: Option<u32>,
    /// `color` (default), `depth`, `alpha`, `semantics` (a fixed colour for each entry of the
    /// bank), `relevancy` or `mask` (of a text).
    kind: Option<String>,
    /// `png`, `jpeg`, `webp` or `npy`; else `Accept` decides, else PNG.
    format: Option<String>,
    /// `backdrop` (default: the photos' colours by direction), `black`, `white`, `#rrggbb` or
    /// three numbers of 0..1.
    background: Option<String>,
    /// Opacity compensated for the blur of the picture's pixels.
    antialiased: Option<bool>,
    /// Near plane, world units.
    near: Option<f32>,
    /// The part of the picture that is drawn: first column, first row, width and height in pixels
    /// of the whole, four whole numbers separated by commas.
    crop: Option<String>,
    /// `exact` (default) or `fast`.
    quality: Option<String>,
    /// What to look for, for `relevancy` and `mask`.
    text: Option<String>,
    /// How the text is scored: `default`, or `paper`.
    profile: Option<String>,
    /// Milliseconds to wait for semantics that are being made; 0 answers `scene_not_ready` at once.
    wait_ms: Option<u64>,
    /// Milliseconds after which the call is given up.
    deadline_ms: Option<u64>,
}

/// Parameters of `export`.
#[derive(IntoParams)]
#[into_params(parameter_in = Query)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct ExportParams {
    /// `ply` (default).
    format: Option<String>,
    /// Writes only what this text selects.
    text: Option<String>,
    /// How the text is scored: `default`, or `paper`.
    profile: Option<String>,
    /// Milliseconds to wait for semantics that are being made.
    wait_ms: Option<u64>,
}

/// Every error.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct ErrorBody {
    /// Stable snake_case code.
    code: String,
    /// Names input, value and bound.
    message: String,
    /// Finds the call in the log; also in the header `x-request-id`.
    request_id: String,
    /// More about it.
    details: ErrorDetails,
}

/// More about an error.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct ErrorDetails {
    /// Whether the same call may succeed later.
    retry: bool,
    /// When.
    retry_after_s: Option<u32>,
    /// The scene it is about.
    scene: Option<String>,
}

/// A scene.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct Scene {
    /// Id: 32 lower-case hex digits.
    id: String,
    /// `queued`, `running`, `done`, `failed` or `cancelled`.
    state: String,
    /// Stage at work while running: `photos`, `capture`, `geometry`, `lift`, `store`.
    stage: Option<String>,
    /// Share of the whole work that is done, 0..1.
    fraction: f32,
    /// Time of the create call, milliseconds since 1970.
    created_ms: u64,
    /// Time of the last change of state, milliseconds since 1970.
    updated_ms: u64,
    /// Why it failed.
    error: Option<SceneError>,
    /// Health report, once done.
    report: Option<HealthReport>,
    /// Input cameras, once done; not in lists.
    cameras: Option<Vec<SceneCamera>>,
    /// What can be asked of it by text.
    semantics: SemanticsStatus,
}

/// Why a scene failed.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct SceneError {
    /// Stable snake_case code.
    code: String,
    /// Names input, value and bound.
    message: String,
}

/// What can be asked of a scene by text.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct SemanticsStatus {
    /// Whether a text can be asked: at once where `ready`, else after they are made.
    available: bool,
    /// Why not.
    reason: Option<String>,
    /// `off`, `none` (not made yet), `running`, `ready` or `failed`.
    state: String,
    /// Stage at work while running: `masks`, `embed`, `bank`, `assign`.
    stage: Option<String>,
    /// Share of their making that is done, 0..1.
    fraction: f32,
    /// Entries of the bank (M), once ready.
    bank_size: Option<u32>,
    /// Why they failed; the next text tries again.
    error: Option<SceneError>,
    /// Counts and times, once ready.
    report: Option<SemanticsReport>,
}

/// How the making of a scene's semantics went.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct SemanticsReport {
    /// Masks of each photo.
    masks: Vec<u32>,
    /// Entries of the bank (M).
    bank_size: u32,
    /// Gaussians that have an entry.
    labelled: u64,
    /// sha256 of the bundle's manifest, hex.
    bundle_sha256: String,
    /// Scoring profile they were made under.
    profile: String,
    /// Time of each stage.
    stages: Vec<StageTime>,
    /// Execution provider of the networks.
    execution_provider: String,
}

/// Counts, figures and warnings.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct HealthReport {
    /// Photos given.
    photos: u32,
    /// Photos used.
    views_used: u32,
    /// Gaussians kept.
    gaussians: u64,
    /// Gaussians dropped or clamped, by reason.
    dropped: Vec<DropCount>,
    /// Nearest and farthest depth searched, world units.
    depth_range: Vec<f64>,
    /// Median depth of the Gaussians from the input cameras, world units.
    median_depth: f64,
    /// Mean share of a view's matchable pixels found in its best partner, 0..1.
    overlap: f64,
    /// Focal length of each photo in the network's picture of it, pixels; 0 where it was not used.
    network_focal_px: Vec<f64>,
    /// Time of each stage.
    stages: Vec<StageTime>,
    /// Execution provider of the geometry network.
    execution_provider: String,
    /// What looks wrong with the capture.
    warnings: Vec<Warning>,
}

/// How many Gaussians were dropped or clamped for one reason.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct DropCount {
    /// Why, snake_case.
    reason: String,
    /// How many.
    count: u64,
}

/// Time of one stage.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct StageTime {
    /// Stage.
    stage: String,
    /// Wall time, milliseconds.
    ms: f64,
}

/// Something that looks wrong with a capture.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct Warning {
    /// Stable snake_case code.
    code: String,
    /// A sentence that names photo, value and bound.
    message: String,
    /// The measured figure.
    value: f64,
}

/// Pinhole lens in pixels of its picture.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct Intrinsics {
    /// Focal length along x.
    fx: f64,
    /// Focal length along y.
    fy: f64,
    /// Principal point x.
    cx: f64,
    /// Principal point y.
    cy: f64,
    /// Width.
    width: u32,
    /// Height.
    height: u32,
}

/// An input camera.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct SceneCamera {
    /// File name of its photo.
    file: String,
    /// Lens of the undistorted photo.
    intrinsics: Intrinsics,
    /// 16 numbers, row-major, OpenCV.
    camera_to_world: Vec<f64>,
    /// Lens of the network's picture of it; absent where the photo was not used.
    network: Option<Intrinsics>,
}

/// A page of scenes, newest first.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct Page {
    /// Without their cameras.
    scenes: Vec<Scene>,
    /// Give as `after` for the next page; null on the last.
    next: Option<String>,
}

/// A camera of a `views` request: one pose, at most one lens; fields as in `render_view`.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct CameraFields {
    /// 16 numbers, row-major, OpenCV camera to world.
    camera_to_world: Option<Vec<f64>>,
    /// Camera centre.
    eye: Option<Vec<f64>>,
    /// Point looked at.
    target: Option<Vec<f64>>,
    /// Up in the picture.
    up: Option<Vec<f64>>,
    /// Index of an input camera.
    from: Option<u32>,
    /// Index of another.
    to: Option<u32>,
    /// 0 at `from`, 1 at `to`.
    t: Option<f64>,
    /// Focal length along x, pixels.
    fx: Option<f64>,
    /// Focal length along y, pixels.
    fy: Option<f64>,
    /// Principal point x, pixels.
    cx: Option<f64>,
    /// Principal point y, pixels.
    cy: Option<f64>,
    /// Vertical field of view, degrees.
    fov: Option<f64>,
}

/// Body of `render_views`.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct ViewsRequest {
    /// Cameras.
    cameras: Vec<CameraFields>,
    /// As in `render_view`; colour by default.
    kinds: Option<Vec<String>>,
    /// Width of every picture, pixels.
    width: Option<u32>,
    /// Height of every picture, pixels.
    height: Option<u32>,
    /// `png` (default), `jpeg`, `webp` or `npy`.
    format: Option<String>,
    /// As in `render_view`, or three numbers.
    background: Option<serde_json::Value>,
    /// As in `render_view`.
    antialiased: Option<bool>,
    /// Near plane, world units.
    near: Option<f32>,
    /// The part of every picture that is drawn: first column, first row, width, height.
    crop: Option<[u32; 4]>,
    /// `exact` (default) or `fast`.
    quality: Option<String>,
    /// What to look for, for `relevancy` and `mask`.
    text: Option<String>,
    /// How the text is scored: `default`, or `paper`.
    profile: Option<String>,
    /// Milliseconds to wait for semantics that are being made.
    wait_ms: Option<u64>,
    /// `multipart` or `zip`; else `Accept` decides, else multipart.
    container: Option<String>,
}

/// What makes and renders the scenes.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct Models {
    /// Name of the bundle.
    bundle: String,
    /// sha256 of its manifest, hex.
    bundle_sha256: String,
    /// Networks of the bundle.
    models: Vec<Model>,
    /// Execution provider in use.
    execution_provider: String,
    /// Renderer in use.
    renderer: String,
    /// Version of this server.
    server_version: String,
}

/// One network.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct Model {
    /// What it does.
    name: String,
    /// File in the bundle.
    file: String,
    /// sha256, hex.
    sha256: String,
    /// Size.
    size_bytes: u64,
    /// Licence of the weights.
    licence: String,
    /// Views it takes at once.
    views_max: u32,
    /// Working sizes, height and width.
    sizes: Vec<Vec<u32>>,
}

/// Whether new work is taken.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct Readiness {
    /// Whether new work is taken.
    ready: bool,
    /// `opening` (scenes are taken and wait), `open` or `broken`.
    networks: String,
    /// Jobs that wait.
    jobs_queued: u64,
    /// Jobs at work.
    jobs_running: u64,
    /// Renders at work or waiting.
    renders: u64,
}

/// Whether the process answers.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct Liveness {
    /// True.
    live: bool,
}
