//! Texts asked of a scene: in 3D, in a view, and of the thing under a pixel.

use std::time::Duration;

use axum::{Extension, Json};
use serde::Deserialize;

use super::{
    edge::Deadline,
    error::ApiError,
    extract::{Called, Id, JsonBody},
    openapi::IdParam,
    params::Params,
    render::camera_fields,
    schemas::{PickAnswer, PickParams, QueryBody as QueryRequest, QueryResult},
};
use crate::{
    api::{camera::CameraFields, semantics},
    error::Error,
    service::{Boxes, MaskFormat, PickSpec, Picked, QueryAnswer, QuerySpec, ViewOptions},
};

/// Body of `POST /v1/scenes/{id}/query`.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct QueryBody {
    #[serde(default)]
    texts: Vec<String>,
    camera: Option<CameraFields>,
    width: Option<u32>,
    height: Option<u32>,
    #[serde(default)]
    antialiased: bool,
    near: Option<f32>,
    boxes: Option<String>,
    mask: Option<String>,
    #[serde(default)]
    relevancy: bool,
    profile: Option<String>,
    wait_ms: Option<u64>,
}

/// `POST /v1/scenes/{id}/query`
#[utoipa::path(
    post, path = "/v1/scenes/{id}/query", operation_id = "query", tag = "texts",
    params(IdParam), request_body = QueryRequest,
    responses((status = 200, description = "What each text found", body = QueryResult))
)]
pub(super) async fn query(
    Called(api): Called,
    Id(id): Id,
    deadline: Option<Extension<Deadline>>,
    params: Params,
    JsonBody(body): JsonBody<QueryBody>,
) -> Result<Json<QueryAnswer>, ApiError> {
    params.finish()?;
    let spec = QuerySpec {
        texts: body.texts,
        camera: body.camera.map(|fields| fields.spec("camera")).transpose()?,
        options: ViewOptions {
            width: body.width,
            height: body.height,
            antialiased: body.antialiased,
            near: body.near,
            deadline: deadline.map(|Extension(Deadline(deadline))| deadline),
            ..ViewOptions::default()
        },
        boxes: body.boxes.map_or(Ok(Boxes::default()), |name| semantics::boxes(&name))?,
        mask: body.mask.map_or(Ok(MaskFormat::default()), |name| semantics::mask(&name))?,
        relevancy: body.relevancy,
        profile: semantics::profile(body.profile.as_deref())?,
        wait: body.wait_ms.map(Duration::from_millis),
    };
    Ok(Json(api.service.query(&id, spec).await?))
}

/// `GET /v1/scenes/{id}/pick`
#[utoipa::path(
    get, path = "/v1/scenes/{id}/pick", operation_id = "pick", tag = "texts",
    params(IdParam, PickParams),
    responses((status = 200, description = "What lies under the pixel", body = PickAnswer))
)]
pub(super) async fn pick(
    Called(api): Called,
    Id(id): Id,
    deadline: Option<Extension<Deadline>>,
    mut params: Params,
) -> Result<Json<Picked>, ApiError> {
    let p = &mut params;
    // First, while they stand in the order they were given in.
    let labels = p.texts("label");
    let camera = camera_fields(p)?.spec("camera")?;
    let what = "a number of pixels";
    let missing = |name| Error::invalid(format!("{name} is missing; give x and y"));
    let (x, y) = (p.number("x", what)?, p.number("y", what)?);
    let spec = PickSpec {
        camera,
        x: x.ok_or_else(|| missing("x"))?,
        y: y.ok_or_else(|| missing("y"))?,
        options: ViewOptions {
            width: p.whole("width")?,
            height: p.whole("height")?,
            antialiased: p.flag("antialiased")?.unwrap_or(false),
            near: p.number("near", "a number")?,
            deadline: deadline.map(|Extension(Deadline(deadline))| deadline),
            ..ViewOptions::default()
        },
        labels,
        profile: semantics::profile(p.text("profile")?.as_deref())?,
        wait: p.whole::<u64>("wait_ms")?.map(Duration::from_millis),
    };
    params.finish()?;
    Ok(Json(api.service.pick(&id, spec).await?))
}
