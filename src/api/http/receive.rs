//! A multipart upload, read as it comes and refused at the first byte over a cap.

use std::time::Duration;

use axum::extract::{FromRequest, Multipart, Request, multipart::Field};

use super::{error::ApiError, params::Params};
use crate::{
    api::{
        Api,
        upload::{UploadBuilder, UploadGuard},
    },
    error::{Error, ErrorCode, Result},
    scene::{Upload, UploadCameras},
};

/// Longest pause between two pieces of an upload.
const PAUSE_MAX: Duration = Duration::from_secs(30);
/// What is still read of an upload already refused, so that the caller sees the answer.
const DRAIN_BYTES_MAX: usize = 512 << 20;
/// How long that may take.
const DRAIN_TIME_MAX: Duration = Duration::from_secs(20);
/// Longest text option.
const OPTION_BYTES_MAX: usize = 256;
/// Options that may come as text parts as well as in the query string.
const OPTIONS: [&str; 5] = ["semantics", "bundle", "max_views", "density", "wait_ms"];

/// Reads the parts of `request`; text parts that are options go to `params`.
pub(super) async fn receive(
    api: &Api,
    request: Request,
    params: &mut Params,
) -> Result<(Upload, UploadGuard), ApiError> {
    let limits = api.service.limits();
    let length = request
        .headers()
        .get("content-length")
        .and_then(|value| value.to_str().ok())
        .and_then(|value| value.parse::<usize>().ok());
    let mut form = Multipart::from_request(request, api).await.map_err(|_| {
        Error::invalid("body: not multipart/form-data with a boundary; send photos as parts")
    })?;
    // Parts' headers come on top of their bytes.
    let room = limits.upload_bytes_max + (1 << 20);
    let received = match length {
        Some(length) if length > room => Err(Error::limit(
            "upload",
            format!("{length} bytes"),
            format!("{} bytes", limits.upload_bytes_max),
        )),
        _ => parts(api, &mut form, params).await,
    };
    if received.is_err() {
        // Closing a connection with unread bytes resets it, and the answer is lost with it.
        tokio::spawn(tokio::time::timeout(DRAIN_TIME_MAX, drain(form)));
    }
    Ok(received?)
}

async fn parts(
    api: &Api,
    form: &mut Multipart,
    params: &mut Params,
) -> Result<(Upload, UploadGuard)> {
    let limits = api.service.limits();
    let mut upload = UploadBuilder::new(&limits, &api.uploads);
    loop {
        let next = tokio::time::timeout(PAUSE_MAX, form.next_field()).await.map_err(|_| pause())?;
        let Some(mut field) = next.map_err(broken)? else { break };
        let name = field.name().unwrap_or_default().to_owned();
        match name.as_str() {
            "transforms" => upload.begin_cameras(UploadCameras::Transforms(Vec::new()))?,
            "cameras" => upload.begin_cameras(UploadCameras::Cameras(Vec::new()))?,
            "archive" => upload.begin_archive(),
            option if OPTIONS.contains(&option) => {
                let value = text(&mut field).await?;
                params.push(option, value);
                continue;
            }
            _ => upload.begin_photo(&photo_name(&name, field.file_name())?)?,
        }
        while let Some(piece) = chunk(&mut field).await? {
            upload.extend(&piece)?;
        }
    }
    upload.finish()
}

/// A photo is named by its part where that has an extension, else by its file.
fn photo_name(part: &str, file: Option<&str>) -> Result<String> {
    let chosen = match file {
        Some(file) if !part.contains('.') && !file.is_empty() => file,
        _ => part,
    };
    if chosen.is_empty() {
        return Err(Error::invalid("upload: a part has no name; name each photo by its file"));
    }
    Ok(chosen.to_owned())
}

async fn text(field: &mut Field<'_>) -> Result<String> {
    let mut bytes = Vec::new();
    while let Some(piece) = chunk(field).await? {
        bytes.extend_from_slice(&piece);
        if bytes.len() > OPTION_BYTES_MAX {
            let name = field.name().unwrap_or_default();
            let (value, bound) = (bytes.len(), OPTION_BYTES_MAX);
            return Err(Error::limit(name, format!("{value} bytes"), format!("{bound} bytes")));
        }
    }
    String::from_utf8(bytes).map_err(|_| Error::invalid("upload: an option is not UTF-8 text"))
}

async fn chunk(field: &mut Field<'_>) -> Result<Option<axum::body::Bytes>> {
    let piece = tokio::time::timeout(PAUSE_MAX, field.chunk()).await.map_err(|_| pause())?;
    piece.map_err(broken)
}

/// Reads on and forgets what it reads.
async fn drain(mut form: Multipart) {
    let mut read = 0;
    while let Ok(Some(mut field)) = form.next_field().await {
        while let Ok(Some(piece)) = field.chunk().await {
            read += piece.len();
            if read > DRAIN_BYTES_MAX {
                return;
            }
        }
    }
}

fn pause() -> Error {
    Error::new(
        ErrorCode::DeadlineExceeded,
        format!("upload: nothing came for {} s", PAUSE_MAX.as_secs()),
    )
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
            ("photo", None, "photo"),
        ] {
            assert_eq!(photo_name(part, file).unwrap(), name, "{part} {file:?}");
        }
        assert!(photo_name("", None).is_err());
    }
}
