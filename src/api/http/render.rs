//! One rendered view, and the scene as a file.

use std::{collections::BTreeMap, time::Duration};

use axum::{
    Extension,
    body::Body,
    http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::Deserialize;
use utoipa::{
    IntoParams, IntoResponses, PartialSchema,
    openapi::{self, RefOr, content::ContentBuilder, response::ResponseBuilder},
};

use super::{
    error::ApiError,
    extract::{CallerApi, Id},
    fields::Fields,
    headers::text_of,
    middleware::Deadline,
};
use crate::{
    api::{Held, server_timing},
    error::{Error, ErrorCode, Result, short},
    service::{
        CameraFields, CameraSpec, Export, ExportFormat, FeatureKind, FeaturesSpec, Format,
        PictureKind, PictureOptions, Preset, RenderedView, ScoringOptions, TextOptions,
        ViewOptions, ViewSpec,
    },
};

/// A picture is a caller's own, and is asked for each time: its tag says whether it is the same.
const CACHE: &str = "private, no-cache";
/// `Accept` chooses the encoding of a picture.
const VARY: [(HeaderName, &str); 1] = [(header::VARY, "accept")];

/// What a view shows.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(default)]
#[into_params(parameter_in = Query)]
pub(super) struct ViewParams {
    /// `color` (default), `depth`, `alpha`, `holes` (what edits uncovered and nothing fills),
    /// `semantics` (a fixed colour for each entry of the bank), `relevancy` or `mask` (of a text).
    #[param(inline)]
    kind: PictureKind,
}

/// What an export is.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(default)]
#[into_params(parameter_in = Query)]
pub(super) struct ExportParams {
    /// What the file is; `ply` by default.
    #[param(inline)]
    format: ExportFormat,
    /// How a text is scored: `default` or `paper`. By default as the scene was made.
    #[param(inline)]
    preset: Option<Preset>,
}

/// What features are, and of what.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(default)]
#[into_params(parameter_in = Query)]
pub(super) struct FeaturesParams {
    /// `weights` (default): E, sparse. `features`: F, `[H, W, D]`.
    #[param(inline)]
    kind: FeatureKind,
    /// Milliseconds to wait for semantics that are being made.
    wait_ms: Option<u64>,
}

/// One view of a scene
#[utoipa::path(
    get, path = "/v1/scenes/{id}/view", operation_id = "render_view", tag = "views",
    params(
        Id, CameraFields, ViewParams, ViewOptions, PictureOptions, TextOptions, ScoringOptions
    ),
    responses(
        (
            status = 200, content_type = "image/png", body = Vec<u8>,
            description = "The picture. x-depth-scale: world units a step of a depth PNG. \
                x-shape: height, width and samples of a pixel of rgb8, rgba8 and grey8. \
                x-error: bound of its difference to the exact picture, levels of 255. \
                x-detail: how far Gaussians are at most from merged ones, pixels"
        ),
        (status = 304, description = "If-None-Match names this picture"),
    )
)]
pub(super) async fn view(
    CallerApi(api): CallerApi,
    Id(id): Id,
    Extension(Deadline(deadline)): Extension<Deadline>,
    headers: HeaderMap,
    fields: Fields,
) -> Result<Response, ApiError> {
    let mut spec = spec_of(fields, text_of(&headers, "accept"))?;
    spec.options.deadline = deadline;
    if headers.contains_key(header::IF_NONE_MATCH)
        && let Some(etag) = api.service.view_etag(&id, &spec).await?
        && let Some(answer) = not_modified(&headers, &etag)
    {
        return Ok((VARY, answer).into_response());
    }
    let mut view = api.service.render(&id, spec).await?;
    let held = view.held.take().map(|held| Extension(Held::new(held)));
    Ok((view_headers(&view), VARY, held, view.bytes).into_response())
}

/// The scene, or what a text selects of it, as a file
#[utoipa::path(
    get,
    path = "/v1/scenes/{id}/export",
    operation_id = "export",
    tag = "views",
    params(Id, ExportParams, TextOptions, ScoringOptions),
    responses(ExportFile)
)]
pub(super) async fn export(
    CallerApi(api): CallerApi,
    Id(id): Id,
    headers: HeaderMap,
    mut fields: Fields,
) -> Result<Response, ApiError> {
    let ExportParams { format, preset } = fields.take()?;
    let ask = text(&mut fields)?;
    fields.finish()?;
    file(&headers, api.service.export(&id, format, preset, &ask).await?).await
}

/// The pixels of a view over the bank, as arrays
#[utoipa::path(
    get, path = "/v1/scenes/{id}/features", operation_id = "features", tag = "views",
    params(Id, CameraFields, FeaturesParams, ViewOptions, ScoringOptions),
    responses((
        status = 200, content_type = "application/octet-stream", body = Vec<u8>,
        description = "npz. weights: size, offsets, entries, weights. features: features"
    ))
)]
pub(super) async fn features(
    CallerApi(api): CallerApi,
    Id(id): Id,
    Extension(Deadline(deadline)): Extension<Deadline>,
    headers: HeaderMap,
    mut fields: Fields,
) -> Result<Response, ApiError> {
    let f = &mut fields;
    let camera = camera(f.take()?, "camera")?;
    let FeaturesParams { kind, wait_ms } = f.take()?;
    let options = ViewOptions { deadline, ..f.take()? };
    let wait = wait_ms.map(Duration::from_millis);
    let spec = FeaturesSpec { camera, options, kind, scoring: scoring(f)?, wait };
    fields.finish()?;
    file(&headers, api.service.features(&id, spec).await?).await
}

/// The answer of an export, by the table of formats.
struct ExportFile;

impl IntoResponses for ExportFile {
    fn responses() -> BTreeMap<String, RefOr<openapi::Response>> {
        let titles: Vec<&str> = ExportFormat::all().map(|format| format.title).collect();
        let mut answer = ResponseBuilder::new().description(titles.join(", "));
        for format in ExportFormat::all() {
            let content = ContentBuilder::new().schema(Some(<Vec<u8> as PartialSchema>::schema()));
            answer = answer.content(format.media_type, content.build());
        }
        BTreeMap::from([("200".to_owned(), answer.build().into())])
    }
}

/// A file that is written while it is sent, unless the caller has it.
async fn file(headers: &HeaderMap, export: Export) -> Result<Response, ApiError> {
    if let Some(answer) = not_modified(headers, &export.etag) {
        return Ok(answer);
    }
    let disposition = format!("attachment; filename=\"{}\"", export.file_name);
    let headers = [
        (header::CONTENT_TYPE, export.media_type.to_owned()),
        // It is written while it is sent, always from its start.
        (header::ACCEPT_RANGES, "none".to_owned()),
        (header::CONTENT_DISPOSITION, disposition),
        (header::ETAG, quoted(&export.etag)),
        (header::CACHE_CONTROL, CACHE.to_owned()),
    ];
    let body = export.begin().await?;
    let size = body.size_bytes.map(|bytes| [(header::CONTENT_LENGTH, bytes.to_string())]);
    let place = body.place.clone().map(|place| Extension(Held::new(place)));
    let body = Body::from_stream(body.into_stream());
    Ok((headers, size, place, body).into_response())
}

/// The changes of how texts are scored, from a query string.
pub(super) fn scoring(fields: &mut Fields) -> Result<ScoringOptions> {
    let canon = fields.all("canon")?;
    Ok(ScoringOptions { canon, ..fields.take()? })
}

/// A text and how it is scored, from a query string.
fn text(fields: &mut Fields) -> Result<TextOptions> {
    Ok(TextOptions { scoring: scoring(fields)?, ..fields.take()? })
}

/// Headers of a picture: type, tag, camera, depth scale, shape of samples without a codec.
pub(super) fn view_headers(view: &RenderedView) -> HeaderMap {
    let mut headers = HeaderMap::new();
    let pose = view.camera.camera_to_world.to_row_major().map(|v| v.to_string()).join(",");
    let k = view.camera.intrinsics;
    let texts = [
        ("content-type", content_type(view.format).to_owned()),
        ("etag", quoted(&view.etag)),
        ("cache-control", CACHE.to_owned()),
        ("server-timing", server_timing(view.times.stages())),
        ("x-camera-to-world", pose),
        ("x-intrinsics", format!("{},{},{},{}", k.fx, k.fy, k.cx, k.cy)),
        ("x-error", view.error.to_string()),
        ("x-detail", view.detail.to_string()),
    ];
    let scale = view.depth_scale.map(|scale| ("x-depth-scale", scale.to_string()));
    let shape = view.shape().map(|shape| shape.iter().map(u32::to_string).collect::<Vec<_>>());
    let shape = shape.map(|sides| ("x-shape", sides.join(",")));
    for (name, text) in texts.into_iter().chain(scale).chain(shape) {
        if let Ok(value) = HeaderValue::from_str(&text) {
            headers.insert(name, value);
        }
    }
    headers
}

/// Media type of an encoding.
pub(super) fn content_type(format: Format) -> &'static str {
    match format {
        Format::Png => "image/png",
        Format::Jpeg => "image/jpeg",
        Format::Webp => "image/webp",
        Format::Npy => "application/x-npy",
        Format::Rgb8 => "application/x-rgb8",
        Format::Rgba8 => "application/x-rgba8",
        Format::Grey8 => "application/x-grey8",
    }
}

/// The camera of these fields; `what` names it in messages.
pub(super) fn camera(fields: CameraFields, what: &str) -> Result<CameraSpec> {
    let wrong = |error: Error| Error::invalid(format!("{what}: {}", error.message()));
    CameraSpec::try_from(fields).map_err(wrong)
}

fn spec_of(mut fields: Fields, accept: Option<&str>) -> Result<ViewSpec> {
    let f = &mut fields;
    let format_given = f.has("format");
    let camera = camera(f.take()?, "camera")?;
    let ViewParams { kind } = f.take()?;
    let (options, mut picture, text) = (f.take()?, f.take::<PictureOptions>()?, text(f)?);
    fields.finish()?;
    if !format_given {
        picture.format = negotiate(accept, kind)?;
    }
    Ok(ViewSpec { camera, kind, options, picture, text })
}

/// The encoding of `Accept` with the highest weight that fits the kind; PNG where any will do.
fn negotiate(accept: Option<&str>, kind: PictureKind) -> Result<Format> {
    let Some(accept) = accept else { return Ok(Format::Png) };
    let lossy = !matches!(kind, PictureKind::Depth | PictureKind::Semantics | PictureKind::Mask);
    let mut best: Option<(f32, Format)> = None;
    for range in accept.split(',') {
        let range = range.to_ascii_lowercase();
        let mut pieces = range.split(';').map(str::trim);
        let format = match pieces.next().unwrap_or_default() {
            "image/png" | "image/*" | "*/*" => Format::Png,
            "image/jpeg" if lossy => Format::Jpeg,
            "image/webp" if kind != PictureKind::Depth => Format::Webp,
            "application/x-npy" => Format::Npy,
            "application/x-rgb8" => Format::Rgb8,
            "application/x-rgba8" => Format::Rgba8,
            "application/x-grey8" => Format::Grey8,
            _ => continue,
        };
        let weight = pieces
            .find_map(|piece| piece.strip_prefix("q="))
            .map_or(1.0, |weight| weight.parse().unwrap_or(0.0));
        if weight > 0.0 && best.is_none_or(|(weight_so_far, _)| weight > weight_so_far) {
            best = Some((weight, format));
        }
    }
    best.map(|(_, format)| format).ok_or_else(|| {
        let message = format!(
            "Accept is {:?}; a kind={kind} picture can be image/png{}{}, application/x-npy",
            short(accept),
            if lossy { ", image/jpeg" } else { "" },
            if kind == PictureKind::Depth { "" } else { ", image/webp" },
        );
        Error::new(ErrorCode::NotAcceptable, message)
    })
}

fn quoted(etag: &str) -> String {
    format!("\"{etag}\"")
}

/// The answer to a caller that has the file of this tag.
fn not_modified(headers: &HeaderMap, etag: &str) -> Option<Response> {
    let etag = quoted(etag);
    let has = matches_etag(text_of(headers, "if-none-match")?, &etag);
    let headers = [(header::ETAG, etag), (header::CACHE_CONTROL, CACHE.to_owned())];
    has.then(|| (StatusCode::NOT_MODIFIED, headers).into_response())
}

fn matches_etag(known: &str, etag: &str) -> bool {
    known
        .split(',')
        .map(|tag| tag.trim().trim_start_matches("W/"))
        .any(|tag| tag == "*" || tag == etag)
}
