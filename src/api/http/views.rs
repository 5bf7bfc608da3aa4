//! Many cameras and kinds in one request; the pictures go out one by one as they are made.

use std::{
    io::{self, Write},
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use axum::{
    Extension,
    body::{Body, Bytes},
    http::{HeaderMap, header},
    response::{IntoResponse, Response},
};
use futures_util::{Stream, StreamExt, stream};
use serde::Deserialize;
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use super::{
    edge::Deadline,
    error::ApiError,
    extract::{Called, Id, JsonBody},
    openapi::{IdParam, ViewsRequest},
    params::Params,
    render::{background, content_type, crop, format, view_headers},
};
use crate::{
    api::{
        camera::CameraFields,
        semantics::{kind, profile, quality},
    },
    error::{Error, Result},
    service::{Ask, Format, Kind, RenderedView, ViewOptions, ViewsSpec},
};

/// Between the parts of a multipart answer; the pictures' own bytes cannot hold it by accident.
const BOUNDARY: &str = "segsplat-7d1f0b9c52e84a36";

/// Body of `POST /v1/scenes/{id}/views`.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ViewsBody {
    cameras: Vec<CameraFields>,
    kinds: Option<Vec<String>>,
    width: Option<u32>,
    height: Option<u32>,
    format: Option<String>,
    background: Option<BackgroundBody>,
    #[serde(default)]
    antialiased: bool,
    near: Option<f32>,
    crop: Option<[u32; 4]>,
    quality: Option<String>,
    text: Option<String>,
    profile: Option<String>,
    wait_ms: Option<u64>,
    container: Option<String>,
}

/// A background as text (as in the query string) or as three numbers.
#[derive(Clone, Debug, Deserialize)]
#[serde(untagged)]
enum BackgroundBody {
    Text(String),
    Numbers([f32; 3]),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Container {
    Multipart,
    Zip,
}

/// `POST /v1/scenes/{id}/views`
#[utoipa::path(
    post, path = "/v1/scenes/{id}/views", operation_id = "render_views", tag = "views",
    params(IdParam), request_body = ViewsRequest,
    responses((
        status = 200, content_type = "multipart/mixed", body = Vec<u8>,
        description = "The pictures camera by camera; or application/zip"
    ))
)]
pub(super) async fn views(
    Called(api): Called,
    Id(id): Id,
    deadline: Option<Extension<Deadline>>,
    headers: HeaderMap,
    params: Params,
    JsonBody(body): JsonBody<ViewsBody>,
) -> Result<Response, ApiError> {
    params.finish()?;
    let container = container(body.container.as_deref(), &headers)?;
    let mut spec = spec_of(body)?;
    spec.options.deadline = deadline.map(|Extension(Deadline(deadline))| deadline);
    let pictures = api.service.render_many(&id, &spec).await?.boxed();
    Ok(match container {
        Container::Multipart => {
            let kind = format!("multipart/mixed; boundary={BOUNDARY}");
            ([(header::CONTENT_TYPE, kind)], Body::from_stream(multipart(pictures))).into_response()
        }
        Container::Zip => {
            let kind = "application/zip".to_owned();
            ([(header::CONTENT_TYPE, kind)], Body::from_stream(zip(pictures))).into_response()
        }
    })
}

fn container(asked: Option<&str>, headers: &HeaderMap) -> Result<Container> {
    match asked {
        Some("multipart") => Ok(Container::Multipart),
        Some("zip") => Ok(Container::Zip),
        Some(other) => {
            let shown: String = other.chars().take(40).collect();
            Err(Error::invalid(format!("container is {shown:?}; it must be multipart or zip")))
        }
        None => {
            let accept = headers.get(header::ACCEPT).and_then(|value| value.to_str().ok());
            let zip = accept.is_some_and(|accept| accept.contains("application/zip"));
            Ok(if zip { Container::Zip } else { Container::Multipart })
        }
    }
}

fn spec_of(body: ViewsBody) -> Result<ViewsSpec> {
    let cameras = body.cameras.iter().enumerate();
    let cameras =
        cameras.map(|(i, fields)| fields.spec(&format!("camera {i}"))).collect::<Result<_>>()?;
    let kinds = match body.kinds {
        None => vec![Kind::Color],
        Some(names) => names.iter().map(|name| kind(name)).collect::<Result<_>>()?,
    };
    let background = match body.background {
        None => None,
        Some(BackgroundBody::Numbers(numbers)) => Some(numbers),
        Some(BackgroundBody::Text(text)) => background(&text)?,
    };
    let options = ViewOptions {
        width: body.width,
        height: body.height,
        format: body.format.map_or(Ok(Format::Png), |name| format(&name))?,
        background,
        antialiased: body.antialiased,
        near: body.near,
        crop: body.crop.map(crop),
        quality: quality(body.quality.as_deref())?,
        deadline: None,
    };
    let ask = Ask {
        text: body.text,
        profile: profile(body.profile.as_deref())?,
        wait: body.wait_ms.map(Duration::from_millis),
    };
    Ok(ViewsSpec { cameras, kinds, options, ask })
}

/// `view-003-depth.png`
fn file_name(view: &RenderedView) -> String {
    let extension = match view.format {
        Format::Png => "png",
        Format::Jpeg => "jpg",
        Format::Webp => "webp",
        Format::Npy => "npy",
    };
    format!("view-{:03}-{}.{extension}", view.camera_index, view.kind.name())
}

/// Parts with the headers of a single view; a fault ends it with a part that holds the error.
fn multipart(
    pictures: impl Stream<Item = Result<RenderedView>> + Send + 'static,
) -> impl Stream<Item = Result<Bytes, io::Error>> + Send + 'static {
    let parts = pictures.map(|picture| {
        let mut part = format!("--{BOUNDARY}\r\n").into_bytes();
        match picture {
            Ok(view) => {
                let headers = view_headers(&view);
                for (name, value) in &headers {
                    part.extend_from_slice(name.as_str().as_bytes());
                    part.extend_from_slice(b": ");
                    part.extend_from_slice(value.as_bytes());
                    part.extend_from_slice(b"\r\n");
                }
                let disposition = format!("attachment; filename=\"{}\"", file_name(&view));
                let length = view.bytes.len();
                let rest = format!(
                    "content-disposition: {disposition}\r\ncontent-length: {length}\r\n\r\n"
                );
                part.extend_from_slice(rest.as_bytes());
                part.extend_from_slice(&view.bytes);
            }
            Err(error) => {
                let body = serde_json::json!({
                    "code": error.code().name(),
                    "message": error.message(),
                });
                part.extend_from_slice(b"content-type: application/json\r\n\r\n");
                part.extend_from_slice(body.to_string().as_bytes());
            }
        }
        part.extend_from_slice(b"\r\n");
        Ok(Bytes::from(part))
    });
    parts.chain(stream::once(async { Ok(Bytes::from(format!("--{BOUNDARY}--\r\n"))) }))
}

/// A zip of the pictures, stored as they are, with an `index.json`; a fault breaks it off.
fn zip(
    pictures: stream::BoxStream<'static, Result<RenderedView>>,
) -> impl Stream<Item = Result<Bytes, io::Error>> + Send + 'static {
    let outbox = Outbox::default();
    let writer = ZipWriter::new_stream(outbox.clone());
    let state = Some((pictures, writer, Vec::new()));
    stream::try_unfold((state, outbox), |(state, outbox)| async move {
        let Some((mut pictures, mut writer, mut index)) = state else { return Ok(None) };
        let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
        match pictures.next().await {
            Some(picture) => {
                let view = picture.map_err(io::Error::other)?;
                let name = file_name(&view);
                writer.start_file(&name, stored)?;
                writer.write_all(&view.bytes)?;
                index.push(index_entry(&name, &view));
                Ok(Some((outbox.take(), (Some((pictures, writer, index)), outbox))))
            }
            None => {
                writer.start_file("index.json", stored)?;
                serde_json::to_writer_pretty(&mut writer, &index)?;
                writer.finish()?;
                Ok(Some((outbox.take(), (None, outbox))))
            }
        }
    })
}

fn index_entry(name: &str, view: &RenderedView) -> serde_json::Value {
    serde_json::json!({
        "file": name,
        "camera_index": view.camera_index,
        "kind": view.kind.name(),
        "content_type": content_type(view.format),
        "camera": view.camera,
        "depth_scale": view.depth_scale,
    })
}

/// What the zip has written and the client has not yet got.
#[derive(Clone, Debug, Default)]
struct Outbox(Arc<Mutex<Vec<u8>>>);

impl Outbox {
    fn take(&self) -> Bytes {
        let mut written = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        Bytes::from(std::mem::take(&mut *written))
    }
}

impl Write for Outbox {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
