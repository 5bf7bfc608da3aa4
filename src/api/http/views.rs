//! Many cameras and kinds in one request; the pictures go out one by one as they are made.

use std::{
    io::{self, Write},
    sync::{Arc, Mutex, PoisonError},
};

use axum::{
    Extension,
    body::{Body, Bytes},
    http::{HeaderMap, header},
    response::{IntoResponse, Response},
};
use futures_util::{Stream, StreamExt, stream};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use super::{
    body::held_bytes,
    error::{ApiError, ErrorBody},
    extract::{CallerApi, Id, JsonBody},
    fields::Fields,
    headers::text_of,
    middleware::Deadline,
    render::{camera, content_type, view_headers},
};
use crate::{
    api::request_id,
    error::{Error, Result},
    service::{
        CameraFields, Format, PictureKind, RenderedView, TextOptions, ViewOptions, ViewsSpec,
    },
};

/// Between the parts of a multipart answer; the pictures' own bytes cannot hold it by accident.
const BOUNDARY: &str = "segsplat-7d1f0b9c52e84a36";

/// Body of `render_views`: views, and what they come in.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ViewsRequest)]
pub(super) struct ViewsBody {
    #[serde(flatten)]
    spec: ViewsSpec,
    /// `multipart` or `zip`; else `Accept` decides, else multipart.
    container: Option<Container>,
}

/// What many pictures come in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub(super) enum Container {
    /// `multipart/mixed`.
    Multipart,
    /// `application/zip`, stored.
    Zip,
}

impl ViewsBody {
    fn of(mut body: Fields) -> Result<Self> {
        let f = &mut body;
        let cameras: Vec<CameraFields> = f.value("cameras")?.unwrap_or_default();
        let cameras = cameras.into_iter().enumerate();
        let cameras = cameras.map(|(i, fields)| camera(fields, &format!("cameras[{i}]")));
        let spec = ViewsSpec {
            cameras: cameras.collect::<Result<_>>()?,
            kinds: f.value("kinds")?.unwrap_or_else(|| vec![PictureKind::Color]),
            options: f.take()?,
            picture: f.take()?,
            text: TextOptions { scoring: f.take()?, ..f.take()? },
        };
        let container = f.value("container")?;
        body.finish()?;
        Ok(Self { spec, container })
    }
}

/// Many views of a scene: each camera in each kind
#[utoipa::path(
    post, path = "/v1/scenes/{id}/views", operation_id = "render_views", tag = "views",
    params(Id), request_body = ViewsBody,
    responses((
        status = 200, content((Vec<u8> = "multipart/mixed"), (Vec<u8> = "application/zip")),
        description = "The pictures camera by camera. A part of multipart/mixed that is \
            application/json is an ErrorBody, and the last"
    ))
)]
pub(super) async fn views(
    CallerApi(api): CallerApi,
    Id(id): Id,
    Extension(Deadline(deadline)): Extension<Deadline>,
    headers: HeaderMap,
    JsonBody(body): JsonBody,
) -> Result<Response, ApiError> {
    let ViewsBody { spec, container } = ViewsBody::of(body)?;
    let wants_zip = text_of(&headers, "accept").is_some_and(|a| a.contains("application/zip"));
    let accepted = if wants_zip { Container::Zip } else { Container::Multipart };
    let options = ViewOptions { deadline, ..spec.options };
    let spec = ViewsSpec { options, ..spec };
    let pictures = api.service.render_many(&id, &spec).await?.boxed();
    let request_id = text_of(&headers, request_id::HEADER).unwrap_or_default().to_owned();
    let fault = move |error| ApiError::of_scene(error, &id).body(&request_id);
    let (kind, body) = match container.unwrap_or(accepted) {
        Container::Multipart => (
            format!("multipart/mixed; boundary={BOUNDARY}"),
            Body::from_stream(multipart(pictures, fault)),
        ),
        Container::Zip => ("application/zip".to_owned(), Body::from_stream(zip(pictures))),
    };
    Ok(([(header::CONTENT_TYPE, kind)], body).into_response())
}

/// `view-003-depth.png`
fn file_name(view: &RenderedView) -> String {
    let RenderedView { camera_index, kind, format, .. } = view;
    match format {
        Format::Jpeg => format!("view-{camera_index:03}-{kind}.jpg"),
        _ => format!("view-{camera_index:03}-{kind}.{format}"),
    }
}

/// Parts with the headers of a single view; a fault ends it with a part that holds its body.
fn multipart(
    pictures: impl Stream<Item = Result<RenderedView>> + Send + 'static,
    fault: impl Fn(Error) -> ErrorBody + Send + 'static,
) -> impl Stream<Item = Result<Bytes, io::Error>> + Send + 'static {
    let parts = pictures.flat_map(move |picture| {
        let mut part = format!("--{BOUNDARY}\r\n").into_bytes();
        let body = match picture {
            Ok(view) => {
                let headers = view_headers(&view);
                for (name, value) in &headers {
                    let line = [name.as_str().as_bytes(), b": ", value.as_bytes(), b"\r\n"];
                    part.extend(line.concat());
                }
                let (name, length) = (file_name(&view), view.bytes.len());
                let rest = format!(
                    "content-disposition: attachment; filename=\"{name}\"\r\n\
                     content-length: {length}\r\n\r\n"
                );
                part.extend_from_slice(rest.as_bytes());
                held_bytes(view.bytes, view.held)
            }
            Err(error) => {
                part.extend_from_slice(b"content-type: application/json\r\n\r\n");
                serde_json::to_vec(&fault(error)).unwrap_or_default().into()
            }
        };
        let pieces = [Bytes::from(part), body, Bytes::from_static(b"\r\n")];
        stream::iter(pieces.map(Ok))
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
                index.push(index_row(&name, &view));
                Ok(Some((
                    held_bytes(outbox.take(), view.held),
                    (Some((pictures, writer, index)), outbox),
                )))
            }
            None => {
                writer.start_file("index.json", stored)?;
                serde_json::to_writer_pretty(&mut writer, &index)?;
                writer.finish()?;
                Ok(Some((outbox.take().into(), (None, outbox))))
            }
        }
    })
}

fn index_row(name: &str, view: &RenderedView) -> serde_json::Value {
    serde_json::json!({
        "file": name,
        "camera_index": view.camera_index,
        "kind": view.kind,
        "content_type": content_type(view.format),
        "camera": view.camera,
        "depth_scale": view.depth_scale,
        "error": view.error,
        "detail": view.detail,
        "shape": view.shape(),
    })
}

/// What the zip has written and the client has not yet got.
#[derive(Clone, Debug, Default)]
struct Outbox(Arc<Mutex<Vec<u8>>>);

impl Outbox {
    fn take(&self) -> Vec<u8> {
        std::mem::take(&mut *self.0.lock().unwrap_or_else(PoisonError::into_inner))
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{error::ErrorCode, scene::SceneId};

    #[tokio::test]
    async fn an_error_between_the_pictures_says_what_any_other_says() {
        let id: SceneId = "0".repeat(32).parse().unwrap();
        let fault = move |error| ApiError::of_scene(error, &id).body("r1");
        let pictures = stream::iter([Err(Error::new(ErrorCode::Overloaded, "busy"))]);
        let parts: Vec<_> = multipart(pictures, fault).map(Result::unwrap).collect().await;
        let text = String::from_utf8(parts.concat()).unwrap();
        let body = text.split("\r\n").nth(3).unwrap();
        let told: serde_json::Value = serde_json::from_str(body).unwrap();
        let details =
            serde_json::json!({ "retry": true, "retry_after_s": 1, "scene": "0".repeat(32) });
        assert_eq!((&told["code"], &told["request_id"]), (&"overloaded".into(), &"r1".into()));
        assert_eq!(told["details"], details);
    }
}
