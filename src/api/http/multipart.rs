//! An upload, a form or an archive alone, read as it comes and refused at the first byte over a
//! cap.

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

use super::{error::ApiError, fields::Fields, headers::text_of};
use crate::{
    api::{
        Api,
        upload::{UploadBuilder, UploadGuard},
    },
    error::{Error, Result, short},
    formats::captures::decoded_name,
    scene::{SceneId, SceneOptions, Upload, UploadCameras},
};

/// Bytes still read of an upload that was refused, so that the caller gets the answer.
const DRAIN_BYTES_MAX: usize = 512 << 20;
/// How long that may take.
const DRAIN_TIME_MAX: Duration = Duration::from_secs(20);
/// Bytes that may come before the next head of a part or the next bytes of a part.
const HEAD_BYTES_MAX: usize = 1 << 20;
/// Longest option as a text part.
const OPTION_BYTES_MAX: usize = 256;
/// Options that may come as text parts as well as in the query string.
const OPTIONS: [&[&str]; 2] = [SceneOptions::NAMES, &["bundle", "wait_ms"]];

/// The part that each mask of a photo is sent as, and the folder that masks are in.
const MASKS: &str = "masks";

/// Parts of the upload, for `/openapi.json`: no value has this type, parts are read as they come.
#[derive(ToSchema)]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct UploadForm {
    /// A nerfstudio or instant-ngp `transforms.json` (OpenGL axes).
    #[schema(content_media_type = "application/json")]
    transforms: Option<String>,
    /// Our own JSON (OpenCV axes):
    /// `{"cameras":[{"file","intrinsics","camera_to_world"}]}`; or the word `solve`, which is the
    /// option of this name.
    #[schema(content_media_type = "application/json")]
    cameras: Option<String>,
    /// A zip or tar of a folder with a capture of any known layout (docs/captures.md), instead of
    /// all other parts.
    #[schema(content_media_type = "application/octet-stream")]
    archive: Option<String>,
    /// A file of Gaussians, of any format of Gaussians that `export` writes, instead of all other
    /// parts. A `.splat` is known by the ending of the file's name alone.
    #[schema(content_media_type = "application/octet-stream")]
    splats: Option<String>,
    /// A mask of a photo, its file named as the photo (`0001.png` or `0001.jpg.png`): what is black
    /// in it takes no part in the scene. Parts and files of a folder `masks` are masks, too.
    #[schema(content_media_type = "image/*")]
    masks: Option<Vec<String>>,
    /// Any other part is a photo, or a camera file of a capture, named by its part or file. Without
    /// `transforms` and `cameras` the files' paths tell the layout.
    #[schema(content_media_type = "image/*")]
    photo: Option<Vec<String>>,
}

/// Content types of an archive that is the whole body.
const ARCHIVES: [&str; 4] = [
    "application/zip",
    "application/x-zip-compressed",
    "application/x-tar",
    "application/octet-stream",
];

/// What the body of a request is.
enum Sent {
    Form(Multipart),
    Archive(Body),
}

/// A zip or tar of a folder with a capture, as the whole body: for `/openapi.json` alone.
#[derive(ToSchema)]
#[schema(content_media_type = "application/octet-stream")]
#[expect(dead_code, reason = "read by the derive alone")]
pub(super) struct ArchiveBody(String);

/// Reads the parts of `request`, or the archive that its body is; text parts that are options go to
/// `fields`. So many photos must come at least; they may join a scene.
pub(super) async fn read_upload(
    api: &Api,
    request: Request,
    fields: &mut Fields,
    photos_min: usize,
    scene: Option<SceneId>,
) -> Result<(Upload, UploadGuard), ApiError> {
    let limits = &api.service.limits();
    let upload = UploadBuilder::new(limits, &api.uploads).at_least(photos_min);
    let upload = upload.kept_by(&api.service, scene);
    let length = text_of(request.headers(), "content-length");
    let length = length.and_then(|value| value.parse::<usize>().ok());
    let has_room = api.service.has_room(request.headers().contains_key("idempotency-key"));
    let kind = text_of(request.headers(), "content-type").unwrap_or_default();
    let kind = kind.split(';').next().unwrap_or_default().trim().to_ascii_lowercase();
    let (body, request) = WatchedBody::of(request);
    let sent = match ARCHIVES.contains(&kind.as_str()) {
        true => Ok(Sent::Archive(request.into_body())),
        false => Multipart::from_request(request, api).await.map(Sent::Form),
    };
    // Parts' headers come on top of their bytes.
    let max = limits.upload_bytes_max + (1 << 20);
    let read = match (length, has_room, sent) {
        (Some(length), ..) if length > max => Err(Error::limit(
            "upload",
            format!("{length} bytes"),
            format!("{} bytes", limits.upload_bytes_max),
        )),
        (_, _, Err(_)) => Err(Error::invalid(
            "body: not multipart/form-data with a boundary; send photos as parts, or a zip or tar \
             as application/zip or application/x-tar",
        )),
        (_, Err(full), _) => Err(full),
        (_, Ok(()), Ok(Sent::Form(mut form))) => {
            parts(upload, &mut form, fields, limits.texts_max, &body).await
        }
        (_, Ok(()), Ok(Sent::Archive(whole))) => archive(upload, whole, &body).await,
    };
    let read = read.map_err(|error| body.too_long().unwrap_or(error));
    if read.is_err() {
        read_on(stream::poll_fn(move |context| body.lock().0.poll_next_unpin(context)));
    }
    Ok(read?)
}

/// Reads the rest of a refused body after the answer and drops it: a connection that is closed with
/// unread bytes is reset, and the caller does not get the answer.
pub(super) fn read_on(
    mut rest: impl Stream<Item = std::result::Result<Bytes, axum::Error>> + Send + Unpin + 'static,
) {
    let dropped = async move {
        let mut read = 0;
        while let Some(Ok(piece)) = rest.next().await {
            read += piece.len();
            if read > DRAIN_BYTES_MAX {
                return;
            }
        }
    };
    tokio::spawn(tokio::time::timeout(DRAIN_TIME_MAX, dropped));
}

async fn archive(
    mut upload: UploadBuilder<'_>,
    whole: Body,
    body: &WatchedBody,
) -> Result<(Upload, UploadGuard)> {
    upload.begin_archive().await?;
    let mut pieces = whole.into_data_stream();
    while let Some(piece) = pieces.next().await {
        let piece = piece.map_err(|e| Error::invalid("upload: the body broke off").caused_by(e))?;
        body.progressed();
        upload.extend(&piece).await?;
    }
    upload.finish().await
}

async fn parts(
    mut upload: UploadBuilder<'_>,
    form: &mut Multipart,
    fields: &mut Fields,
    words_max: usize,
    body: &WatchedBody,
) -> Result<(Upload, UploadGuard)> {
    let all = OPTIONS.concat();
    let mut options = all.clone();
    let mut words = 0;
    loop {
        let Some(mut field) = form.next_field().await.map_err(broken)? else { break };
        body.progressed();
        let name = field.name().unwrap_or_default().to_owned();
        match name.as_str() {
            "transforms" => upload.begin_cameras(UploadCameras::Transforms(Vec::new()))?,
            // The option and the JSON part share a name: JSON begins with a bracket.
            "cameras" => {
                let first = field.chunk().await.map_err(broken)?.unwrap_or_default();
                if first.first().is_some_and(u8::is_ascii_alphabetic) {
                    let Some(at) = options.iter().position(|left| *left == "cameras") else {
                        return Err(Error::invalid("upload: cameras is given twice"));
                    };
                    let value = text_from(first.to_vec(), &mut field).await?;
                    fields.push(options.swap_remove(at), value);
                    body.progressed();
                    continue;
                }
                upload.begin_cameras(UploadCameras::Cameras(Vec::new()))?;
                upload.extend(&first).await?;
            }
            "archive" => upload.begin_archive().await?,
            "splats" => upload.begin_splats(field.file_name().unwrap_or_default()).await?,
            // More than a call may have say so by their number.
            "ignore" if words <= words_max => {
                words += 1;
                fields.push("ignore", text(&mut field).await?);
                body.progressed();
                continue;
            }
            option if all.contains(&option) => {
                // Each once, or options alone could fill the memory.
                let Some(at) = options.iter().position(|left| *left == option) else {
                    return Err(Error::invalid(format!("upload: {option} is given twice")));
                };
                fields.push(options.swap_remove(at), text(&mut field).await?);
                body.progressed();
                continue;
            }
            _ => {
                let disposition = field.headers().get("content-disposition");
                let extended = disposition.and_then(|value| extended_name(value.as_bytes()));
                let file = extended.as_deref().or_else(|| field.file_name());
                let in_masks = file.filter(|_| name == MASKS).map(in_masks);
                upload.begin_photo(&photo_name(&name, in_masks.as_deref().or(file))?).await?;
            }
        }
        while let Some(piece) = field.chunk().await.map_err(broken)? {
            body.progressed();
            upload.extend(&piece).await?;
        }
    }
    upload.finish().await
}

/// A body, and the bytes since the last part began or went on. The reader of the form keeps bytes
/// that belong to no part yet: a part's head without end would fill the memory outside of every
/// budget, and each piece would search it from its start.
#[derive(Clone)]
struct WatchedBody(Arc<Mutex<(BodyDataStream, usize)>>);

impl WatchedBody {
    /// The request with its body watched. The reader takes all bytes that are there before it looks
    /// at them: after each piece this body says that there are no more just now.
    fn of(request: Request) -> (Self, Request) {
        let (parts, body) = request.into_parts();
        let watched = Self(Arc::new(Mutex::new((body.into_data_stream(), 0))));
        let (of_body, mut taken) = (watched.clone(), false);
        let pieces = stream::poll_fn(move |context| {
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
        (watched, Request::from_parts(parts, Body::from_stream(pieces)))
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

/// The path of the file of a part that is a mask.
fn in_masks(file: &str) -> String {
    let is_there = file.strip_prefix(MASKS).is_some_and(|rest| rest.starts_with(['/', '\\']));
    if is_there { file.to_owned() } else { format!("{MASKS}/{file}") }
}

/// The name of a file is that of its part where it has an extension or a folder, else that of its
/// file. A part with neither is no photo.
fn photo_name(part: &str, file: Option<&str>) -> Result<String> {
    match file.filter(|file| !file.is_empty()) {
        _ if part.contains(['.', '/']) => Ok(part.to_owned()),
        Some(file) => Ok(file.to_owned()),
        None if part.is_empty() => {
            Err(Error::invalid("upload: a part has no name; name each photo by its file"))
        }
        // Its length is refused with the bound.
        None if part.len() > OPTION_BYTES_MAX => Ok(part.to_owned()),
        None => Err(Error::invalid(format!(
            "upload: unknown part {:?}; there are transforms, cameras, archive, splats, masks, {}, \
             and photos, each with the name of its file",
            short(part),
            OPTIONS.concat().join(", ")
        ))),
    }
}

/// The value of `filename*=UTF-8''…`, which is meant where `filename` is there too (RFC 6266).
fn extended_name(disposition: &[u8]) -> Option<String> {
    let text = std::str::from_utf8(disposition).ok()?;
    let at = text.to_ascii_lowercase().find("filename*")?;
    let value = text[at + "filename*".len()..].trim_start().strip_prefix('=')?;
    let value = value.split(';').next()?.trim().trim_matches('"');
    let (charset, value) = value.split_once('\'')?;
    let (_language, value) = value.split_once('\'')?;
    let is_utf8 = charset.eq_ignore_ascii_case("utf-8");
    is_utf8.then(|| decoded_name(value).unwrap_or_else(|| value.to_owned()))
}

async fn text(field: &mut Field<'_>) -> Result<String> {
    text_from(Vec::new(), field).await
}

/// The text of a part whose first bytes are these.
async fn text_from(mut bytes: Vec<u8>, field: &mut Field<'_>) -> Result<String> {
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
    use super::extended_name;

    #[test]
    fn the_extended_name_of_a_file_is_decoded() {
        for (header, want) in [
            ("form-data; name=\"photo\"; filename*=UTF-8''K%C3%BCche%200.jpg", Some("Küche 0.jpg")),
            ("form-data; filename=\"=?x?=\"; FileName* = utf-8'de'a%2Fb.jpg; x=1", Some("a/b.jpg")),
            ("form-data; filename*=\"UTF-8''plain.jpg\"", Some("plain.jpg")),
            ("form-data; filename=\"a.jpg\"", None),
            ("form-data; filename*=utf-7''a.jpg", None),
            ("form-data; filename*=a.jpg", None),
        ] {
            assert_eq!(extended_name(header.as_bytes()).as_deref(), want, "{header}");
        }
    }
}
