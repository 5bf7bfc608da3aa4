//! A multipart upload, read as it comes and refused at the first byte over a cap.

use std::{
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    task::{Poll, ready},
    time::Duration,
};

use axum::{
    body::{Body, BodyDataStream, Bytes},
    extract::{FromRequest, Multipart, Request, multipart::Field},
};
use futures_util::{Stream, StreamExt, stream};
use utoipa::ToSchema;

use super::{error::ApiError, fields::Fields};
use crate::{
    api::{
        Api,
        upload::{UploadBuilder, UploadGuard},
    },
    error::{Error, Result},
    scene::{Upload, UploadCameras},
};

/// What is still read of an upload already refused, so that the caller sees the answer.
const DRAIN_BYTES_MAX: usize = 512 << 20;
/// How long that may take.
const DRAIN_TIME_MAX: Duration = Duration::from_secs(20);
/// Bytes that may come without the head of a part, or its next bytes, among them.
const HEAD_BYTES_MAX: usize = 1 << 20;
/// Longest text option.
const OPTION_BYTES_MAX: usize = 256;
/// Options that may come as text parts as well as in the query string.
const OPTIONS: [&str; 5] = ["semantics", "bundle", "max_views", "density", "wait_ms"];

/// Parts of the upload, for `/openapi.json`: no value has this type, parts are read as they come.
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

/// Reads the parts of `request`; text parts that are options go to `fields`.
pub(super) async fn receive(
    api: &Api,
    request: Request,
    fields: &mut Fields,
) -> Result<(Upload, UploadGuard), ApiError> {
    let limits = api.service.limits();
    let length = request
        .headers()
        .get("content-length")
        .and_then(|value| value.to_str().ok())
        .and_then(|value| value.parse::<usize>().ok());
    let room_in_queue = api.service.has_room(request.headers().contains_key("idempotency-key"));
    let (wire, request) = Wire::of(request);
    let form = Multipart::from_request(request, api).await;
    // Parts' headers come on top of their bytes.
    let room = limits.upload_bytes_max + (1 << 20);
    let received = match length {
        Some(length) if length > room => Err(Error::limit(
            "upload",
            format!("{length} bytes"),
            format!("{} bytes", limits.upload_bytes_max),
        )),
        _ => match (room_in_queue, form) {
            (Ok(()), Ok(mut form)) => parts(api, &mut form, fields, &wire).await,
            (Err(full), Ok(_)) => Err(full),
            (_, Err(_)) => Err(Error::invalid(
                "body: not multipart/form-data with a boundary; send photos as parts",
            )),
        },
    };
    let received = received.map_err(|error| wire.too_long().unwrap_or(error));
    if received.is_err() {
        read_on(stream::poll_fn(move |context| wire.lock().0.poll_next_unpin(context)));
    }
    Ok(received?)
}

/// Reads the rest of a refused body and forgets it, after the answer: closing a connection with
/// unread bytes resets it, and the answer is lost with it.
pub(super) fn read_on(
    mut rest: impl Stream<Item = std::result::Result<Bytes, axum::Error>> + Send + Unpin + 'static,
) {
    let forgotten = async move {
        let mut read = 0;
        while let Some(Ok(piece)) = rest.next().await {
            read += piece.len();
            if read > DRAIN_BYTES_MAX {
                return;
            }
        }
    };
    tokio::spawn(tokio::time::timeout(DRAIN_TIME_MAX, forgotten));
}

async fn parts(
    api: &Api,
    form: &mut Multipart,
    fields: &mut Fields,
    wire: &Wire,
) -> Result<(Upload, UploadGuard)> {
    let limits = api.service.limits();
    let mut upload = UploadBuilder::new(&limits, &api.uploads);
    let mut options = OPTIONS.to_vec();
    loop {
        let Some(mut field) = form.next_field().await.map_err(broken)? else { break };
        wire.progressed();
        let name = field.name().unwrap_or_default().to_owned();
        match name.as_str() {
            "transforms" => upload.begin_cameras(UploadCameras::Transforms(Vec::new()))?,
            "cameras" => upload.begin_cameras(UploadCameras::Cameras(Vec::new()))?,
            "archive" => upload.begin_archive(),
            option if OPTIONS.contains(&option) => {
                // Each once, or options alone could fill the memory.
                let Some(at) = options.iter().position(|left| *left == option) else {
                    return Err(Error::invalid(format!("upload: {option} is given twice")));
                };
                fields.push(options.swap_remove(at), text(&mut field).await?);
                wire.progressed();
                continue;
            }
            _ => upload.begin_photo(&photo_name(&name, field.file_name())?)?,
        }
        while let Some(piece) = field.chunk().await.map_err(broken)? {
            wire.progressed();
            upload.extend(&piece)?;
        }
    }
    upload.finish()
}

/// A body on its way to the form's reader, which keeps what belongs to no part yet: a part's head
/// without end would fill the memory outside of every budget, and be searched from its start at
/// each piece.
#[derive(Clone)]
struct Wire(Arc<Mutex<(BodyDataStream, usize)>>);

impl Wire {
    /// The request with its body watched. The reader takes all that is there before it looks at
    /// any of it: after each piece it is told that there is no more just now.
    fn of(request: Request) -> (Self, Request) {
        let (parts, body) = request.into_parts();
        let wire = Self(Arc::new(Mutex::new((body.into_data_stream(), 0))));
        let (of_body, mut taken) = (wire.clone(), false);
        let paced = stream::poll_fn(move |context| {
            if of_body.too_long().is_some() {
                return Poll::Ready(Some(Err(axum::Error::new("too long"))));
            }
            if std::mem::take(&mut taken) {
                context.waker().wake_by_ref();
                return Poll::Pending;
            }
            let mut body = of_body.lock();
            let piece = ready!(body.0.poll_next_unpin(context));
            if let Some(Ok(piece)) = &piece {
                taken = true;
                body.1 += piece.len();
            }
            Poll::Ready(piece)
        });
        (wire, Request::from_parts(parts, Body::from_stream(paced)))
    }

    fn lock(&self) -> MutexGuard<'_, (BodyDataStream, usize)> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A part's head or a piece of its bytes was found.
    fn progressed(&self) {
        self.lock().1 = 0;
    }

    fn too_long(&self) -> Option<Error> {
        let (bytes, max) = (self.lock().1, HEAD_BYTES_MAX);
        let limit = || Error::limit("upload: the head of a part", format!("{bytes} bytes"), max);
        (bytes > max).then(limit)
    }
}

/// A photo is named by its part where that has an extension, else by its file. A part with neither
/// is no photo.
fn photo_name(part: &str, file: Option<&str>) -> Result<String> {
    match file.filter(|file| !file.is_empty()) {
        _ if part.contains('.') => Ok(part.to_owned()),
        Some(file) => Ok(file.to_owned()),
        None if part.is_empty() => {
            Err(Error::invalid("upload: a part has no name; name each photo by its file"))
        }
        // Its length is refused with the bound.
        None if part.len() > OPTION_BYTES_MAX => Ok(part.to_owned()),
        None => {
            let shown: String = part.chars().take(40).collect();
            Err(Error::invalid(format!(
                "upload: unknown part {shown:?}; there are transforms, cameras, archive, {}, and \
                 photos, each with the name of its file",
                OPTIONS.join(", ")
            )))
        }
    }
}

async fn text(field: &mut Field<'_>) -> Result<String> {
    let mut bytes = Vec::new();
    while let Some(piece) = field.chunk().await.map_err(broken)? {
        bytes.extend_from_slice(&piece);
        if bytes.len() > OPTION_BYTES_MAX {
            let name = field.name().unwrap_or_default();
            let (value, bound) = (bytes.len(), OPTION_BYTES_MAX);
            return Err(Error::limit(name, format!("{value} bytes"), format!("{bound} bytes")));
        }
    }
    String::from_utf8(bytes).map_err(|_| Error::invalid("upload: an option is not UTF-8 text"))
}

fn broken(error: axum::extract::multipart::MultipartError) -> Error {
    Error::invalid(format!("upload: the multipart body is damaged: {}", error.body_text()))
        .caused_by(error)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photos_are_named_by_their_part_or_file() {
        for (part, file, name) in [
            ("images/a.png", Some("local.png"), "images/a.png"),
            ("photo", Some("a.png"), "a.png"),
            ("a.png", None, "a.png"),
        ] {
            assert_eq!(photo_name(part, file).unwrap(), name, "{part} {file:?}");
        }
        assert!(photo_name("", None).is_err());
        assert!(photo_name("semantcs", None).unwrap_err().message().contains("density"));
    }
}
