//! One rendered view, and the scene as a file.

use std::{convert::Infallible, time::Duration};

use axum::{
    Extension,
    body::Body,
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use futures_util::StreamExt;

use super::{
    edge::Deadline,
    error::ApiError,
    extract::{Called, Id},
    openapi::{ExportParams, IdParam, ViewParams},
    params::Params,
};
use crate::{
    api::{
        camera::CameraFields,
        semantics::{kind, profile, quality},
    },
    error::{Error, Result},
    scene::Region,
    service::{Ask, ExportFormat, Format, Kind, RenderedView, ViewOptions, ViewSpec},
};

/// `GET /v1/scenes/{id}/view`
#[utoipa::path(
    get, path = "/v1/scenes/{id}/view", operation_id = "render_view", tag = "views",
    params(IdParam, ViewParams),
    responses(
        (
            status = 200, content_type = "image/png", body = Vec<u8>,
            description = "The picture; x-depth-scale is world units a step of a depth PNG"
        ),
        (status = 304, description = "If-None-Match names this picture"),
    )
)]
pub(super) async fn view(
    Called(api): Called,
    Id(id): Id,
    deadline: Option<Extension<Deadline>>,
    headers: HeaderMap,
    params: Params,
) -> Result<Response, ApiError> {
    let mut spec = spec_of(params, accept(&headers))?;
    spec.options.deadline = deadline.map(|Extension(Deadline(deadline))| deadline);
    if let Some(known) = headers.get(header::IF_NONE_MATCH).and_then(|v| v.to_str().ok()) {
        let etag = api.service.view_etag(&id, &spec).await?.map(|etag| quoted(&etag));
        if let Some(etag) = etag.filter(|etag| matches_etag(known, etag)) {
            return Ok((StatusCode::NOT_MODIFIED, [(header::ETAG, etag)]).into_response());
        }
    }
    let view = api.service.render(&id, spec).await?;
    let mut answer = Response::new(Body::empty());
    *answer.headers_mut() = view_headers(&view);
    *answer.body_mut() = Body::from(view.bytes);
    Ok(answer)
}

/// `GET /v1/scenes/{id}/export`
#[utoipa::path(
    get, path = "/v1/scenes/{id}/export", operation_id = "export", tag = "views",
    params(IdParam, ExportParams),
    responses((
        status = 200, content_type = "application/octet-stream", body = Vec<u8>,
        description = "Standard 3DGS PLY"
    ))
)]
pub(super) async fn export(
    Called(api): Called,
    Id(id): Id,
    headers: HeaderMap,
    mut params: Params,
) -> Result<Response, ApiError> {
    let format = match params.text("format")?.as_deref() {
        None | Some("ply") => ExportFormat::Ply,
        Some(other) => {
            let shown: String = other.chars().take(40).collect();
            return Err(Error::invalid(format!("format is {shown:?}; it must be ply")).into());
        }
    };
    let ask = ask(&mut params)?;
    params.finish()?;
    let export = api.service.export(&id, format, &ask).await?;
    let etag = quoted(&export.etag);
    let known = headers.get(header::IF_NONE_MATCH).and_then(|v| v.to_str().ok());
    if known.is_some_and(|known| matches_etag(known, &etag)) {
        return Ok((StatusCode::NOT_MODIFIED, [(header::ETAG, etag)]).into_response());
    }
    let disposition = format!("attachment; filename=\"{}\"", export.file_name);
    let headers = [
        (header::CONTENT_TYPE, "application/octet-stream".to_owned()),
        (header::CONTENT_LENGTH, export.size_bytes.to_string()),
        (header::CONTENT_DISPOSITION, disposition),
        (header::ETAG, etag),
        (header::CACHE_CONTROL, "private, no-cache".to_owned()),
    ];
    let pieces = export.into_stream().map(Ok::<_, Infallible>);
    Ok((headers, Body::from_stream(pieces)).into_response())
}

/// Headers of a picture: type, tag, camera, depth scale.
pub(super) fn view_headers(view: &RenderedView) -> HeaderMap {
    let mut headers = HeaderMap::new();
    let pose = view.camera.camera_to_world.to_row_major().map(|v| v.to_string()).join(",");
    let k = view.camera.intrinsics;
    let lens = format!("{},{},{},{}", k.fx, k.fy, k.cx, k.cy);
    let texts = [
        ("content-type", content_type(view.format).to_owned()),
        ("etag", quoted(&view.etag)),
        ("cache-control", "private, no-cache".to_owned()),
        (
            "server-timing",
            format!("render;dur={:.2}, encode;dur={:.2}", view.render_ms, view.encode_ms),
        ),
        ("x-camera-to-world", pose),
        ("x-intrinsics", lens),
    ];
    let scale = view.depth_scale.map(|scale| ("x-depth-scale", scale.to_string()));
    for (name, text) in texts.into_iter().chain(scale) {
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
    }
}

/// The camera's fields, as separate parameters.
pub(super) fn camera_fields(p: &mut Params) -> Result<CameraFields> {
    Ok(CameraFields {
        camera_to_world: p.numbers("camera_to_world")?,
        eye: p.numbers("eye")?,
        target: p.numbers("target")?,
        up: p.numbers("up")?,
        from: p.whole("from")?,
        to: p.whole("to")?,
        t: p.number("t", "a number")?,
        fx: p.number("fx", "a number")?,
        fy: p.number("fy", "a number")?,
        cx: p.number("cx", "a number")?,
        cy: p.number("cy", "a number")?,
        fov: p.number("fov", "a number of degrees")?,
    })
}

/// What is asked by text.
fn ask(p: &mut Params) -> Result<Ask> {
    Ok(Ask {
        text: p.text("text")?,
        profile: profile(p.text("profile")?.as_deref())?,
        wait: p.whole::<u64>("wait_ms")?.map(Duration::from_millis),
    })
}

fn spec_of(mut params: Params, accept: Option<&str>) -> Result<ViewSpec> {
    let p = &mut params;
    let fields = camera_fields(p)?;
    let kind = kind(p.text("kind")?.as_deref().unwrap_or("color"))?;
    let format = match p.text("format")? {
        Some(name) => format(&name)?,
        None => negotiate(accept, kind)?,
    };
    let options = ViewOptions {
        width: p.whole("width")?,
        height: p.whole("height")?,
        format,
        background: p.text("background")?.map_or(Ok(None), |text| background(&text))?,
        antialiased: p.flag("antialiased")?.unwrap_or(false),
        near: p.number("near", "a number")?,
        crop: p.wholes("crop")?.map(crop),
        quality: quality(p.text("quality")?.as_deref())?,
        deadline: None,
    };
    let ask = ask(p)?;
    params.finish()?;
    Ok(ViewSpec { camera: fields.spec("view")?, kind, options, ask })
}

/// A part of a picture from its first column, first row, width and height.
pub(super) fn crop([x, y, width, height]: [u32; 4]) -> Region {
    Region { x, y, width, height }
}

/// The encoding named `name`.
pub(super) fn format(name: &str) -> Result<Format> {
    match name {
        "png" => Ok(Format::Png),
        "jpeg" | "jpg" => Ok(Format::Jpeg),
        "webp" => Ok(Format::Webp),
        "npy" => Ok(Format::Npy),
        other => {
            let shown: String = other.chars().take(40).collect();
            Err(Error::invalid(format!("format is {shown:?}; it must be png, jpeg, webp or npy")))
        }
    }
}

/// `backdrop` (none), or a colour: `black`, `white`, `#rrggbb` or three numbers of 0..1.
pub(super) fn background(text: &str) -> Result<Option<[f32; 3]>> {
    let shown: String = text.chars().take(40).collect();
    let wrong = || {
        Error::invalid(format!(
            "background is {shown:?}; it must be backdrop, black, white, #rrggbb or three numbers \
             of 0..1"
        ))
    };
    match text {
        "backdrop" => return Ok(None),
        "black" => return Ok(Some([0.0; 3])),
        "white" => return Ok(Some([1.0; 3])),
        _ => {}
    }
    let mut color = [0.0; 3];
    if let Some(hex) = text.strip_prefix('#') {
        let digits = hex.len() == 6 && hex.bytes().all(|b| b.is_ascii_hexdigit());
        let value = u32::from_str_radix(hex, 16).ok().filter(|_| digits);
        let [_, bytes @ ..] = value.ok_or_else(wrong)?.to_be_bytes();
        return Ok(Some(bytes.map(|byte| f32::from(byte) / 255.0)));
    }
    if text.split(',').count() != 3 {
        return Err(wrong());
    }
    for (channel, part) in color.iter_mut().zip(text.split(',')) {
        *channel = part.trim().parse().map_err(|_| wrong())?;
    }
    Ok(Some(color))
}

fn accept(headers: &HeaderMap) -> Option<&str> {
    headers.get(header::ACCEPT).and_then(|value| value.to_str().ok())
}

/// The encoding of `Accept` with the highest weight that fits the kind; PNG where any will do.
fn negotiate(accept: Option<&str>, kind: Kind) -> Result<Format> {
    let Some(accept) = accept else { return Ok(Format::Png) };
    let lossy = !matches!(kind, Kind::Depth | Kind::Semantics | Kind::Mask);
    let mut best: Option<(f32, Format)> = None;
    for range in accept.split(',') {
        let mut pieces = range.split(';').map(str::trim);
        let format = match pieces.next().unwrap_or_default() {
            "image/png" | "image/*" | "*/*" => Format::Png,
            "image/jpeg" if lossy => Format::Jpeg,
            "image/webp" if kind != Kind::Depth => Format::Webp,
            "application/x-npy" => Format::Npy,
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
        let shown: String = accept.chars().take(80).collect();
        Error::invalid(format!(
            "Accept is {shown:?}; a kind={} picture can be image/png{}{}, application/x-npy",
            kind.name(),
            if lossy { ", image/jpeg" } else { "" },
            if kind == Kind::Depth { "" } else { ", image/webp" },
        ))
    })
}

fn quoted(etag: &str) -> String {
    format!("\"{etag}\"")
}

fn matches_etag(known: &str, etag: &str) -> bool {
    known
        .split(',')
        .map(|tag| tag.trim().trim_start_matches("W/"))
        .any(|tag| tag == "*" || tag == etag)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accept_chooses_by_weight_and_depth_is_never_lossy() {
        let pick = |accept, kind| negotiate(Some(accept), kind).ok();
        assert_eq!(pick("image/jpeg", Kind::Color), Some(Format::Jpeg));
        assert_eq!(pick("image/png;q=0.5, image/webp", Kind::Color), Some(Format::Webp));
        assert_eq!(pick("image/avif,image/webp,*/*;q=0.8", Kind::Depth), Some(Format::Png));
        assert_eq!(pick("application/x-npy", Kind::Depth), Some(Format::Npy));
        assert_eq!(pick("text/html", Kind::Color), None);
        assert_eq!(pick("image/png;q=0", Kind::Color), None);
        assert_eq!(negotiate(None, Kind::Color).unwrap(), Format::Png);
    }

    #[test]
    fn backgrounds_are_names_hex_or_numbers() {
        assert_eq!(background("white").unwrap(), Some([1.0; 3]));
        assert_eq!(background("#ff0000").unwrap(), Some([1.0, 0.0, 0.0]));
        assert_eq!(background("0, 0.5,1").unwrap(), Some([0.0, 0.5, 1.0]));
        for odd in ["", "#ff00", "#ggffff", "1,2", "a,b,c", "#+fffff"] {
            assert!(background(odd).is_err(), "{odd} was taken");
        }
    }

    #[test]
    fn etags_match_lists_weak_tags_and_the_star() {
        assert!(matches_etag("\"a\", W/\"b\"", "\"b\""));
        assert!(matches_etag("*", "\"b\""));
        assert!(!matches_etag("\"bb\"", "\"b\""));
    }
}
