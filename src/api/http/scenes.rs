//! Scenes: create, list, show, delete, watch.

use std::{convert::Infallible, time::Duration};

use axum::{
    Json,
    extract::Request,
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{
        IntoResponse, Response,
        sse::{self, KeepAlive, Sse},
    },
};
use futures_util::StreamExt;
use serde::Deserialize;
use utoipa::IntoParams;

use super::{
    error::ApiError,
    extract::{CallerApi, Id},
    fields::Fields,
    headers::text_of,
    multipart::{ArchiveBody, UploadForm, read_upload},
};
use crate::{
    api::{Api, request_id, server_timing, upload::check_bundle},
    error::{Error, Result},
    scene::{Refine, SceneId, SemanticsState},
    service::{
        CreateScene, Event, Page, PageRequest, SceneOptions, SceneState, SceneStatus, WatchUntil,
    },
};

/// What `create_scene` takes besides the upload and the scene's options.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(default)]
#[into_params(parameter_in = Query)]
pub(super) struct CreateParams {
    /// Name of the model bundle; the loaded one by default.
    bundle: Option<String>,
    /// Milliseconds to wait for the scene before answering.
    wait_ms: Option<u64>,
}

/// Make a scene of photos and their cameras, or of a file of Gaussians
#[utoipa::path(
    post, path = "/v1/scenes", operation_id = "create_scene", tag = "scenes",
    params(
        SceneOptions, CreateParams,
        (
            "Idempotency-Key" = Option<String>, Header,
            description = "Calls with one key make one scene; 422 with other photos or options",
        ),
        ("Prefer" = Option<String>, Header, description = "`wait=SECONDS` (RFC 7240)"),
    ),
    request_body(content(
        (UploadForm = "multipart/form-data"),
        (ArchiveBody = "application/zip"),
        (ArchiveBody = "application/x-tar"),
    )),
    responses(
        (status = 201, description = "Made", body = SceneStatus),
        (status = 202, description = "Taken; see Location", body = SceneStatus),
    )
)]
pub(super) async fn create(
    CallerApi(api): CallerApi,
    mut fields: Fields,
    request: Request,
) -> Result<Response, ApiError> {
    let idempotency_key = idempotency_key(request.headers())?;
    let preferred = preferred_wait(request.headers());
    let request_id = request.headers().get(request_id::HEADER);
    let request_id = request_id.and_then(|id| id.to_str().ok()).map(str::to_owned);
    let least = api.service.limits().photos_min;
    let (upload, _guard) = read_upload(&api, request, &mut fields, least, None).await?;
    let (options, wait) = options(&api, fields)?;
    let (wait, preferred) = wait_or(wait, preferred);
    let request = CreateScene { upload, options, idempotency_key, wait, request_id };
    let created = api.service.create_scene(request).await?;
    if let (Some(error), Some(_)) = (&created.status.error, wait) {
        return Err(ApiError::of_scene(error.to_error(), &created.status.id));
    }
    let status = match created.status.state {
        SceneState::Done => StatusCode::CREATED,
        _ => StatusCode::ACCEPTED,
    };
    let times = created
        .status
        .report
        .as_ref()
        .map(|report| server_timing(report.stages.iter().map(|s| (s.stage.as_str(), s.ms))));
    let location = format!("/v1/scenes/{}", created.status.id);
    let body = Json(created.status);
    let mut answer = (status, [(header::LOCATION, location)], body).into_response();
    if let Some(value) = times.and_then(|times| HeaderValue::from_str(&times).ok()) {
        answer.headers_mut().insert("server-timing", value);
    }
    tell_applied(answer.headers_mut(), preferred, created.replayed);
    Ok(answer)
}

/// A page of the scenes
#[utoipa::path(
    get, path = "/v1/scenes", operation_id = "list_scenes", tag = "scenes", params(PageRequest),
    responses((status = 200, description = "A page, newest first", body = Page))
)]
pub(super) async fn list(
    CallerApi(api): CallerApi,
    mut fields: Fields,
) -> Result<Json<Page>, ApiError> {
    let page: PageRequest = fields.take()?;
    fields.finish()?;
    Ok(Json(api.service.list(&page).await?))
}

/// One scene
#[utoipa::path(
    get, path = "/v1/scenes/{id}", operation_id = "get_scene", tag = "scenes", params(Id),
    responses((status = 200, description = "The scene", body = SceneStatus))
)]
pub(super) async fn get(
    CallerApi(api): CallerApi,
    Id(id): Id,
    fields: Fields,
) -> Result<Json<SceneStatus>, ApiError> {
    fields.finish()?;
    Ok(Json(api.service.get(&id).await?))
}

/// Delete a scene
#[utoipa::path(
    delete, path = "/v1/scenes/{id}", operation_id = "delete_scene", tag = "scenes",
    params(Id), responses((status = 204, description = "Gone"))
)]
pub(super) async fn delete(
    CallerApi(api): CallerApi,
    Id(id): Id,
    fields: Fields,
) -> Result<StatusCode, ApiError> {
    fields.finish()?;
    api.service.delete(&id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// How a scene is refined.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(default)]
#[into_params(parameter_in = Query)]
pub(super) struct RefineParams {
    /// `auto` (default), so many milliseconds, or `off`, which ends a refinement.
    #[param(value_type = Option<String>)]
    refine: Refine,
}

/// Refine a scene, or end its refinement
///
/// Takes gradient steps on the photos of a finished scene, which is served meanwhile. In gsplat and
/// Brush "refine" means to densify and prune; that is not what this does.
#[utoipa::path(
    post, path = "/v1/scenes/{id}/refine", operation_id = "refine_scene", tag = "scenes",
    params(Id, RefineParams),
    responses((status = 202, description = "The scene; it is served meanwhile", body = SceneStatus))
)]
pub(super) async fn refine(
    CallerApi(api): CallerApi,
    Id(id): Id,
    mut fields: Fields,
) -> Result<(StatusCode, Json<SceneStatus>), ApiError> {
    let RefineParams { refine } = fields.take()?;
    fields.finish()?;
    Ok((StatusCode::ACCEPTED, Json(api.service.refine(&id, refine).await?)))
}

/// How long a scene is watched.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(default)]
#[into_params(parameter_in = Query)]
pub(super) struct WatchParams {
    /// Go on after the scene is made until its semantics are: who asks a first text at the same
    /// time sees all of its stages.
    semantics: bool,
    /// Go on until the scene is deleted: its list of edits is told first, and each time that it is
    /// another one, whoever changed it.
    edits: bool,
}

/// What happens to a scene, as it happens
#[utoipa::path(
    get, path = "/v1/scenes/{id}/events", operation_id = "watch_scene", tag = "scenes",
    params(
        Id, WatchParams,
        ("Last-Event-ID" = Option<String>, Header, description = "The id of the last event seen"),
    ),
    responses(
        (
            status = 200, content_type = "text/event-stream", body = Event,
            description = "Server-sent events; the data of each is an Event as JSON"
        ),
        (status = 204, description = "The caller has seen the last event: an EventSource ends"),
    )
)]
pub(super) async fn events(
    CallerApi(api): CallerApi,
    Id(id): Id,
    headers: HeaderMap,
    mut fields: Fields,
) -> Result<Response, ApiError> {
    let WatchParams { semantics, edits } = fields.take()?;
    fields.finish()?;
    let until = WatchUntil { semantics, edits };
    let events = api.service.watch_for(&id, until).await?;
    let seen = text_of(&headers, "last-event-id");
    if seen.is_some() && seen == end_of(&api, &id, until).await.as_deref() {
        return Ok(StatusCode::NO_CONTENT.into_response());
    }
    // A server that stops ends the stream: the caller comes back, to the next server.
    let events = events.then(move |event| {
        let (api, id) = (api.clone(), id.clone());
        async move {
            let id = end_of(&api, &id, until).await;
            let event = sse_event(&event);
            Ok::<_, Infallible>(id.into_iter().fold(event, sse::Event::id))
        }
    });
    let keep_alive = KeepAlive::new().interval(Duration::from_secs(15));
    Ok(Sse::new(events).keep_alive(keep_alive).into_response())
}

/// The id of the last event of a scene to which nothing more will happen; where its semantics are
/// awaited not before they are made, or never will be.
async fn end_of(api: &Api, id: &SceneId, until: WatchUntil) -> Option<String> {
    let status = api.service.get(id).await.ok()?;
    let of = &status.semantics;
    let awaited = until.semantics && of.available && of.state != SemanticsState::Ready
        || until.edits && status.state == SceneState::Done;
    let over = status.is_settled() && !status.is_refined_now() && !awaited;
    over.then(|| format!("{}-{}", status.state, status.version))
}

/// The event's name as SSE's `event`, the whole of it as JSON in `data`.
fn sse_event(event: &Event) -> sse::Event {
    let data = serde_json::to_value(event).unwrap_or_default();
    let name = data["event"].as_str().unwrap_or_default();
    sse::Event::default().event(name).data(data.to_string())
}

fn options(api: &Api, mut fields: Fields) -> Result<(SceneOptions, Option<Duration>)> {
    let ignore = fields.all("ignore")?;
    let options = SceneOptions { ignore, ..fields.take()? };
    let CreateParams { bundle, wait_ms } = fields.take()?;
    fields.finish()?;
    check_bundle(&bundle.unwrap_or_default(), api.service.bundle())?;
    Ok((options, wait_ms.map(Duration::from_millis)))
}

/// Seconds of the preference `wait` (RFC 7240), the first one that is there. A preference that is
/// not understood is left alone, as that document asks.
pub(super) fn preferred_wait(headers: &HeaderMap) -> Option<u32> {
    let values = headers.get_all("prefer").into_iter().filter_map(|value| value.to_str().ok());
    let mut preferences = values.flat_map(|value| value.split(','));
    preferences.find_map(|preference| {
        let first = preference.split(';').next()?;
        let (name, value) = first.split_once('=')?;
        let is_wait = name.trim().eq_ignore_ascii_case("wait");
        is_wait.then(|| value.trim().trim_matches('"').parse().ok())?
    })
}

/// How long to wait: what the query says, else what `Prefer` asks for; and the seconds of `Prefer`
/// where they count.
pub(super) fn wait_or(
    query: Option<Duration>,
    preferred: Option<u32>,
) -> (Option<Duration>, Option<u32>) {
    let preferred = preferred.filter(|_| query.is_none());
    (query.or(preferred.map(|seconds| Duration::from_secs(seconds.into()))), preferred)
}

/// Tells which seconds of `Prefer` counted, and that the answer is that of an earlier call.
pub(super) fn tell_applied(headers: &mut HeaderMap, preferred: Option<u32>, replayed: bool) {
    if let Some(seconds) = preferred {
        let applied = HeaderValue::from_str(&format!("wait={seconds}"));
        applied.map(|value| headers.insert("preference-applied", value)).ok();
    }
    if replayed {
        headers.insert("idempotency-replayed", HeaderValue::from_static("true"));
    }
}

/// 1 to 255 printable ASCII characters, once.
pub(super) fn idempotency_key(headers: &HeaderMap) -> Result<Option<String>> {
    let mut given = headers.get_all("idempotency-key").iter();
    let Some(value) = given.next() else { return Ok(None) };
    if given.next().is_some() {
        return Err(Error::invalid("Idempotency-Key is given twice"));
    }
    let printable = value.as_bytes().iter().all(|byte| (b' '..=b'~').contains(byte));
    match value.to_str() {
        Ok(key) if printable && (1..=255).contains(&key.len()) => Ok(Some(key.to_owned())),
        _ => Err(Error::invalid("Idempotency-Key must be 1 to 255 printable ASCII characters")),
    }
}
