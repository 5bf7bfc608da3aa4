//! The HTTP door over real sockets: a scene's life, pictures in every kind and encoding, and the
//! manners of the protocol.

use std::io::{Cursor, Read};

use reqwest::{
    StatusCode,
    header::{self, HeaderValue},
};
use segsplat::{
    error::ErrorCode,
    render::compare::psnr,
    scene::{Upload, UploadCameras},
};
use serde_json::{Value, json};

use crate::common::{
    cpu_server::{CpuServer, upload},
    doors::{self, Fault, Options, bytes, form, json as body},
};

/// Makes the sample's scene and waits for it.
async fn made(stand: &CpuServer) -> String {
    let request = crate::common::client().post(stand.url("/v1/scenes?wait_ms=120000"));
    let answer = request.multipart(form(&upload())).send().await.unwrap();
    let scene = body(answer).await.unwrap();
    assert_eq!(scene["state"], "done", "{scene}");
    scene["id"].as_str().unwrap().to_owned()
}

async fn get(stand: &CpuServer, path: &str) -> reqwest::Response {
    crate::common::client().get(stand.url(path)).send().await.unwrap()
}

async fn fault(stand: &CpuServer, path: &str) -> Fault {
    bytes(get(stand, path).await).await.expect_err(path)
}

#[tokio::test]
async fn a_scene_is_made_listed_shown_and_deleted() {
    let stand = CpuServer::start().await;
    let request = crate::common::client().post(stand.url("/v1/scenes?wait_ms=120000"));
    let answer = request.multipart(form(&upload())).send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::CREATED);
    let location = answer.headers()[header::LOCATION].to_str().unwrap().to_owned();
    let posted = body(answer).await.unwrap();
    assert_eq!(location, format!("/v1/scenes/{}", posted["id"].as_str().unwrap()));

    let shown = body(get(&stand, &location).await).await.unwrap();
    assert_eq!(shown["state"], "done");
    assert_eq!(shown["cameras"].as_array().unwrap().len(), 3, "cameras of three photos");
    assert_eq!(shown["cameras"][1]["file"], "images/0001.png");
    assert!(shown["report"]["gaussians"].as_u64().unwrap() > 100, "{}", shown["report"]);
    assert_eq!(shown["semantics"]["available"], false);
    assert!(shown["semantics"]["reason"].as_str().unwrap().contains("plane"));

    let second = made(&stand).await;
    let page = body(get(&stand, "/v1/scenes?limit=1").await).await.unwrap();
    assert_eq!(page["scenes"][0]["id"], Value::from(second), "newest first");
    let next = page["next"].as_str().expect("a second page");
    let page = body(get(&stand, &format!("/v1/scenes?limit=1&after={next}")).await).await.unwrap();
    assert_eq!(page["scenes"][0]["id"], posted["id"]);
    assert_eq!(page["next"], Value::Null, "a third page of two scenes");

    let gone = crate::common::client().delete(stand.url(&location)).send().await.unwrap();
    assert_eq!(gone.status(), StatusCode::NO_CONTENT);
    assert_eq!(fault(&stand, &location).await.code, "scene_not_found");
}

#[tokio::test]
async fn creating_without_waiting_is_accepted_and_events_lead_to_done() {
    let stand = CpuServer::start().await;
    let request = crate::common::client().post(stand.url("/v1/scenes"));
    let answer = request.multipart(form(&upload())).send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::ACCEPTED);
    let location = answer.headers()[header::LOCATION].to_str().unwrap().to_owned();
    let events = get(&stand, &format!("{location}/events")).await;
    assert_eq!(events.headers()[header::CONTENT_TYPE], "text/event-stream");
    // The stream ends with the last event.
    let text = events.text().await.unwrap();
    let names: Vec<_> = text.lines().filter_map(|line| line.strip_prefix("event: ")).collect();
    assert_eq!(names.last(), Some(&"done"), "{text}");
    assert!(names.iter().all(|name| ["queued", "running", "done"].contains(name)), "{names:?}");
    for data in text.lines().filter_map(|line| line.strip_prefix("data: ")) {
        let event: Value = serde_json::from_str(data).unwrap();
        assert!(names.contains(&event["event"].as_str().unwrap()), "{event}");
    }
}

#[tokio::test]
async fn every_kind_comes_in_every_encoding_it_can() {
    let stand = CpuServer::start().await;
    let id = made(&stand).await;
    for (kind, format, media) in [
        ("color", "png", "image/png"),
        ("color", "jpeg", "image/jpeg"),
        ("color", "webp", "image/webp"),
        ("color", "npy", "application/x-npy"),
        ("alpha", "png", "image/png"),
        ("alpha", "npy", "application/x-npy"),
        ("depth", "png", "image/png"),
        ("depth", "npy", "application/x-npy"),
    ] {
        let case = format!("{kind} as {format}");
        let query = format!("from=0&width=80&height=60&kind={kind}&format={format}");
        let answer = get(&stand, &format!("/v1/scenes/{id}/view?{query}")).await;
        assert_eq!(answer.status(), StatusCode::OK, "{case}");
        assert_eq!(answer.headers()[header::CONTENT_TYPE], media, "{case}");
        let scale = answer.headers().get("x-depth-scale").map(|v| v.to_str().unwrap().to_owned());
        let picture = answer.bytes().await.unwrap();
        if format == "npy" {
            assert_eq!(&picture[..6], b"\x93NUMPY", "{case}");
            let head = String::from_utf8_lossy(&picture[..128]).into_owned();
            let shape = if kind == "color" { "(60, 80, 3)" } else { "(60, 80)" };
            assert!(head.contains("<f4") && head.contains(shape), "{case}: {head}");
        } else {
            let decoded = image::load_from_memory(&picture).unwrap();
            assert_eq!((decoded.width(), decoded.height()), (80, 60), "{case}");
        }
        let scaled = kind == "depth" && format == "png";
        assert_eq!(scale.is_some_and(|s| s.parse::<f64>().unwrap() > 0.0), scaled, "{case}");
    }
    for format in ["jpeg", "webp"] {
        let path = format!("/v1/scenes/{id}/view?from=0&kind=depth&format={format}");
        assert_eq!(fault(&stand, &path).await.code, "invalid_request", "depth as {format}");
    }
}

#[tokio::test]
async fn the_picture_from_an_input_camera_looks_like_its_photo() {
    let stand = CpuServer::start().await;
    let id = made(&stand).await;
    let answer = get(&stand, &format!("/v1/scenes/{id}/view?from=0&width=160&height=120")).await;
    let view = image::load_from_memory(&answer.bytes().await.unwrap()).unwrap().to_rgb8();
    let photo = image::load_from_memory(&upload().photos[0].bytes).unwrap().to_rgb8();
    let [view, photo] = [view, photo].map(|picture| -> Vec<[f32; 3]> {
        picture.pixels().map(|pixel| pixel.0.map(|v| f32::from(v) / 255.0)).collect()
    });
    let psnr = psnr(&view, &photo, None);
    assert!(psnr > 18.0, "the board is {psnr:.1} dB from its photo");
}

#[tokio::test]
async fn accept_chooses_the_encoding_and_a_known_tag_saves_the_picture() {
    let stand = CpuServer::start().await;
    let id = made(&stand).await;
    let url = stand.url(&format!("/v1/scenes/{id}/view?from=0&width=40&height=30"));
    let client = crate::common::client();
    let first = client.get(&url).header("accept", "image/webp").send().await.unwrap();
    assert_eq!(first.headers()[header::CONTENT_TYPE], "image/webp");
    let tag = first.headers()[header::ETAG].clone();
    let ask = |tag: HeaderValue| {
        client.get(&url).header("accept", "image/webp").header("if-none-match", tag)
    };
    let again = ask(tag.clone()).send().await.unwrap();
    assert_eq!(again.status(), StatusCode::NOT_MODIFIED);
    for name in [header::ETAG, header::VARY, header::CACHE_CONTROL] {
        assert_eq!(again.headers()[&name], first.headers()[&name], "{name}");
    }
    assert_eq!(again.headers()[header::VARY], "accept");
    assert!(again.bytes().await.unwrap().is_empty(), "304 with a body");
    let other = client.get(&url).header("if-none-match", tag.clone()).send().await.unwrap();
    assert_eq!(other.status(), StatusCode::OK, "PNG under the tag of a WebP");
    let known = tag.to_str().unwrap();
    for (named, status) in [
        (format!("\"a\", W/{known}"), StatusCode::NOT_MODIFIED),
        ("*".to_owned(), StatusCode::NOT_MODIFIED),
        (format!("\"b{known}"), StatusCode::OK),
    ] {
        assert_eq!(ask(named.parse().unwrap()).send().await.unwrap().status(), status, "{named}");
    }
    for (accept, kind, want) in [
        ("image/jpeg", "color", Some("image/jpeg")),
        ("IMAGE/JPEG", "color", Some("image/jpeg")),
        ("image/png;Q=0.5, image/webp", "color", Some("image/webp")),
        ("image/avif,image/webp,*/*;q=0.8", "depth", Some("image/png")),
        ("application/x-npy", "depth", Some("application/x-npy")),
        ("text/html", "color", None),
        ("image/png;q=0", "color", None),
    ] {
        let request = client.get(format!("{url}&kind={kind}")).header("accept", accept);
        let answer = request.send().await.unwrap();
        match want {
            Some(want) => assert_eq!(answer.headers()[header::CONTENT_TYPE], want, "{accept}"),
            None => {
                let fault = bytes(answer).await.unwrap_err();
                assert_eq!((fault.code.as_str(), fault.number), ("not_acceptable", 406));
            }
        }
    }
}

#[tokio::test]
async fn many_views_come_as_parts_or_as_a_zip_and_equal_single_views() {
    let stand = CpuServer::start().await;
    let id = made(&stand).await;
    let url = stand.url(&format!("/v1/scenes/{id}/views"));
    let cameras = json!([{ "from": 0 }, { "from": 0, "to": 2, "t": 0.5 }]);
    let request = json!({
        "cameras": cameras, "kinds": ["color", "alpha"], "width": 40, "height": 30,
    });
    let answer = crate::common::client().post(&url).json(&request).send().await.unwrap();
    let media = answer.headers()[header::CONTENT_TYPE].to_str().unwrap().to_owned();
    let boundary = media.strip_prefix("multipart/mixed; boundary=").expect(&media).to_owned();
    let parts = split(&answer.bytes().await.unwrap(), &boundary);
    assert_eq!(parts.len(), 4, "two cameras of two kinds");

    let mut zipped = request.clone();
    zipped["container"] = "zip".into();
    let answer = crate::common::client().post(&url).json(&zipped).send().await.unwrap();
    assert_eq!(answer.headers()[header::CONTENT_TYPE], "application/zip");
    let file = Cursor::new(answer.bytes().await.unwrap());
    let mut archive = zip::ZipArchive::new(file).unwrap();
    let names = ["view-000-color.png", "view-000-alpha.png", "view-001-color.png"];
    for (name, part) in names.into_iter().zip(&parts) {
        let mut stored = Vec::new();
        archive.by_name(name).unwrap().read_to_end(&mut stored).unwrap();
        assert_eq!(&stored, part, "{name} differs between zip and multipart");
    }
    assert_eq!(archive.len(), 5, "four pictures and index.json");

    let path = format!("/v1/scenes/{id}/view?from=0&to=2&t=0.5&width=40&height=30");
    let single = get(&stand, &path).await.bytes().await.unwrap();
    assert_eq!(single, parts[2], "a single view of the same camera");
}

/// The bodies of a multipart answer.
fn split(body: &[u8], boundary: &str) -> Vec<Vec<u8>> {
    let mark = format!("--{boundary}").into_bytes();
    let at: Vec<_> = (0..body.len()).filter(|&i| body[i..].starts_with(&mark)).collect();
    at.windows(2)
        .map(|pair| {
            let part = &body[pair[0] + mark.len() + 2..pair[1] - 2];
            let blank = part.windows(4).position(|four| four == b"\r\n\r\n").expect("headers");
            part[blank + 4..].to_vec()
        })
        .collect()
}

#[tokio::test]
async fn a_scene_exports_as_ply() {
    let stand = CpuServer::start().await;
    let id = made(&stand).await;
    let answer = get(&stand, &format!("/v1/scenes/{id}/export?format=ply")).await;
    let length = answer.headers()[header::CONTENT_LENGTH].to_str().unwrap().to_owned();
    assert_eq!(answer.headers()[header::ACCEPT_RANGES], "none");
    assert!(answer.headers()[header::CONTENT_DISPOSITION].to_str().unwrap().contains(".ply"));
    let file = answer.bytes().await.unwrap();
    assert_eq!(length, file.len().to_string());
    assert!(file.starts_with(b"ply\n"), "{:?}", &file[..16]);
    let path = format!("/v1/scenes/{id}/export?format=obj");
    assert_eq!(fault(&stand, &path).await.code, "invalid_request");
}

/// `Prefer: wait=SECONDS` (RFC 7240) is `wait_ms`, and the answer says so. The query counts before
/// it, and what is no such preference changes nothing.
#[tokio::test]
async fn a_caller_may_prefer_to_wait() {
    let stand = CpuServer::start().await;
    let post = async |query: &str, prefer: &[&str]| {
        let mut request = crate::common::client().post(stand.url(&format!("/v1/scenes{query}")));
        for prefer in prefer {
            request = request.header("prefer", *prefer);
        }
        let answer = request.multipart(form(&upload())).send().await.unwrap();
        let applied = answer.headers().get("preference-applied").cloned();
        (answer.status().as_u16(), applied.map(|value| value.to_str().unwrap().to_owned()))
    };
    let applied = Some("wait=60".to_owned());
    assert_eq!(post("", &["wait=60"]).await, (201, applied.clone()));
    assert_eq!(post("", &["respond-async, Wait=\"60\"; a=b"]).await, (201, applied.clone()));
    assert_eq!(post("", &["return=minimal", "wait=60", "wait=0"]).await, (201, applied));
    assert_eq!(post("", &["wait=0"]).await, (202, Some("wait=0".to_owned())));
    for ignored in ["wait", "wait=soon", "wait=-1", "waits=60", "wait=1e3", ""] {
        assert_eq!(post("", &[ignored]).await, (202, None), "{ignored:?}");
    }
    assert_eq!(post("?wait_ms=0", &["wait=60"]).await, (202, None));
}

#[tokio::test]
async fn one_idempotency_key_makes_one_scene_and_is_refused_for_another() {
    let stand = CpuServer::start().await;
    let post = async || {
        let request = crate::common::client().post(stand.url("/v1/scenes?wait_ms=120000"));
        let request = request.header("idempotency-key", "key-1").multipart(form(&upload()));
        request.send().await.unwrap()
    };
    let first = post().await;
    assert!(!first.headers().contains_key("idempotency-replayed"));
    let again = post().await;
    assert_eq!(again.headers()["idempotency-replayed"], "true");
    let (first, again) = (body(first).await.unwrap(), body(again).await.unwrap());
    assert_eq!(first["id"], again["id"], "a second scene");
    let id = first["id"].as_str().unwrap();
    let same = Options { idempotency_key: Some("key-1".to_owned()), ..Options::wait() };
    let changed = |change: fn(&mut Upload)| {
        let mut other = upload();
        change(&mut other);
        (other, same.clone())
    };
    let others = [
        changed(|other| other.photos.reverse()),
        changed(|other| drop(other.photos.pop())),
        changed(|other| other.photos[1].bytes = other.photos[0].bytes.clone()),
        changed(|other| match &mut other.cameras {
            Some(UploadCameras::Transforms(json)) => json.push(b' '),
            sent => panic!("the sample has {sent:?}"),
        }),
        (upload(), Options { semantics: Some("off"), ..same.clone() }),
        (upload(), Options { preset: Some("paper"), ..same.clone() }),
    ];
    let row = ErrorCode::IdempotencyKeyReused.row();
    for door in doors::both(stand.addr).await {
        // How long to wait is no part of what is asked for.
        let short = Options { wait_ms: None, ..same.clone() };
        assert_eq!(door.create(&upload(), &short).await.unwrap().0, id, "{}", door.name());
        for (i, (other, options)) in others.iter().enumerate() {
            let refused = door.create(other, options).await.unwrap_err();
            let found = (&*refused.code, refused.number);
            assert_eq!(found, (row.name, door.number_of(row)), "{i} {}", door.name());
            assert!(refused.message.contains(id), "{refused:?}");
        }
    }
    assert_eq!(row.http, 422, "as draft-ietf-httpapi-idempotency-key-header has it");
    let list = crate::common::client().get(stand.url("/v1/scenes")).send().await.unwrap();
    assert_eq!(body(list).await.unwrap()["scenes"].as_array().map(Vec::len), Some(1));
}

#[tokio::test]
async fn an_archive_and_options_as_text_parts_are_taken() {
    let stand = CpuServer::start().await;
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default();
    let whole = upload();
    let Some(segsplat::scene::UploadCameras::Transforms(transforms)) = whole.cameras else {
        panic!("the sample has transforms");
    };
    let files = whole.photos.into_iter().map(|photo| (photo.name, photo.bytes));
    for (name, data) in files.chain([("transforms.json".to_owned(), transforms)]) {
        zip.start_file(name, options).unwrap();
        std::io::Write::write_all(&mut zip, &data).unwrap();
    }
    let archive = zip.finish().unwrap().into_inner();
    let form = form(&Upload { archive: Some(archive), ..Upload::default() })
        .text("semantics", "off")
        .text("wait_ms", "120000");
    let answer =
        crate::common::client().post(stand.url("/v1/scenes")).multipart(form).send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::CREATED);
    assert_eq!(body(answer).await.unwrap()["cameras"].as_array().unwrap().len(), 3);
}

#[tokio::test]
async fn unknown_paths_methods_and_parameters_are_answered_in_our_shape() {
    let stand = CpuServer::start().await;
    let missing = fault(&stand, "/v1/nothing?x=1").await;
    assert_eq!((missing.code.as_str(), missing.number), ("not_found", 404));
    assert!(missing.message.contains("/v1/nothing"), "{}", missing.message);
    let answer = crate::common::client().put(stand.url("/v1/scenes")).send().await.unwrap();
    let allow = answer.headers()[header::ALLOW].to_str().unwrap().to_owned();
    assert!(allow.contains("GET") && allow.contains("POST"), "{allow}");
    let method = bytes(answer).await.unwrap_err();
    assert_eq!((method.code.as_str(), method.number), ("method_not_allowed", 405));
    for limit in [0, 101] {
        let page = fault(&stand, &format!("/v1/scenes?limit={limit}")).await;
        assert_eq!(page.message, format!("limit is {limit}; it must be 1 to 100"));
    }
    // A part that is neither known nor a photo: a name that was mistyped.
    let form = form(&upload()).text("semantcs", "off");
    let odd =
        crate::common::client().post(stand.url("/v1/scenes")).multipart(form).send().await.unwrap();
    let odd = bytes(odd).await.unwrap_err();
    assert_eq!(odd.code, "invalid_request");
    assert!(odd.message.contains("semantcs") && odd.message.contains("density"), "{odd:?}");
    let unknown = fault(&stand, "/v1/scenes?limti=3").await;
    assert_eq!(unknown.code, "invalid_request");
    assert!(unknown.message.contains("limti") && unknown.message.contains("limit"), "{unknown:?}");
    let not_form =
        crate::common::client().post(stand.url("/v1/scenes")).json(&json!({})).send().await;
    let not_form = bytes(not_form.unwrap()).await.unwrap_err();
    assert!(not_form.message.contains("multipart"), "{}", not_form.message);
}

#[tokio::test]
async fn request_ids_are_kept_and_deadlines_end_a_call() {
    let stand = CpuServer::start().await;
    let request =
        crate::common::client().get(stand.url("/healthz")).header("x-request-id", "mine-7");
    let answer = request.send().await.unwrap();
    assert_eq!(answer.headers()["x-request-id"], "mine-7");
    let long = "a".repeat(65);
    let mut fresh = std::collections::BTreeSet::new();
    for odd in [&b""[..], b"a b", b"a\"b", "ä".as_bytes(), long.as_bytes()] {
        let odd = HeaderValue::from_bytes(odd).unwrap();
        let request = crate::common::client().get(stand.url("/healthz"));
        let answer = request.header("x-request-id", odd).send().await.unwrap();
        let id = answer.headers()["x-request-id"].to_str().unwrap().to_owned();
        assert_eq!(id.len(), 16, "{id}");
        assert!(fresh.insert(id), "new ids repeat");
    }
    assert_eq!(answer.headers()[header::X_CONTENT_TYPE_OPTIONS], "nosniff");
    let odd = fault(&stand, "/v1/scenes?deadline_ms=soon").await;
    assert!(odd.message.contains("soon"), "{}", odd.message);
    let request = crate::common::client().post(stand.url("/v1/scenes?wait_ms=60000&deadline_ms=1"));
    let late = request.multipart(form(&upload())).send().await.unwrap();
    let late = bytes(late).await.unwrap_err();
    assert_eq!((late.code.as_str(), late.number), ("deadline_exceeded", 504));
}

#[tokio::test]
async fn deadlines_and_keys_that_are_given_twice_or_hidden_are_not_overlooked() {
    let stand = CpuServer::start().await;
    for (query, says) in [
        ("deadline_ms=60000&deadline_ms=1", "deadline_ms is given twice"),
        ("deadline_ms=60000&deadline%5Fms=1", "deadline_ms is given twice"),
        ("deadline%5Fms=soon", "deadline_ms is \"soon\""),
    ] {
        let odd = fault(&stand, &format!("/v1/scenes?{query}")).await;
        assert_eq!((odd.code.as_str(), odd.number), ("invalid_request", 400), "{query}");
        assert!(odd.message.contains(says), "{query}: {odd:?}");
    }
    for (keys, says) in [(&["a", "b"][..], "given twice"), (&["a\tb"], "printable ASCII")] {
        let request = crate::common::client().post(stand.url("/v1/scenes"));
        let request = keys.iter().fold(request, |r, key| r.header("idempotency-key", *key));
        let odd = bytes(request.multipart(form(&upload())).send().await.unwrap()).await;
        let odd = odd.expect_err(says);
        assert_eq!(odd.code, "invalid_request", "{keys:?}");
        assert!(odd.message.contains(says), "{keys:?}: {odd:?}");
    }
}

#[tokio::test]
async fn texts_are_packed_for_those_who_take_it_and_unpack_to_the_same() {
    let stand = CpuServer::start().await;
    let client = crate::common::client();
    for path in ["/", "/openapi.json"] {
        let plain = client.get(stand.url(path)).send().await.unwrap();
        assert!(!plain.headers().contains_key(header::CONTENT_ENCODING), "{path}");
        assert_eq!(plain.headers()[header::VARY], "accept-encoding", "{path}");
        let plain = plain.bytes().await.unwrap();
        let request = client.get(stand.url(path)).header("accept-encoding", "br, gzip");
        let packed = request.send().await.unwrap();
        assert_eq!(packed.headers()[header::CONTENT_ENCODING], "gzip", "{path}");
        let length = packed.content_length();
        let packed = packed.bytes().await.unwrap();
        assert_eq!(length, Some(packed.len() as u64), "{path}");
        assert!(packed.len() * 2 < plain.len(), "{path}: {} of {}", packed.len(), plain.len());
        let mut unpacked = Vec::new();
        std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(&packed[..]), &mut unpacked)
            .unwrap();
        assert!(unpacked == plain, "{path}");
    }
    // Pictures are packed by themselves; small answers go in one packet.
    let id = made(&stand).await;
    for path in [format!("/v1/scenes/{id}/view?from=0"), "/healthz".to_owned()] {
        let request = client.get(stand.url(&path)).header("accept-encoding", "gzip");
        let answer = request.send().await.unwrap();
        assert!(!answer.headers().contains_key(header::CONTENT_ENCODING), "{path}");
    }
}

#[tokio::test]
async fn an_event_source_that_has_seen_the_end_is_told_to_end() {
    let stand = CpuServer::start().await;
    let id = made(&stand).await;
    let client = crate::common::client();
    let events = async |seen: Option<&str>| {
        let request = client.get(stand.url(&format!("/v1/scenes/{id}/events")));
        let request = seen.iter().fold(request, |r, id| r.header("last-event-id", *id));
        let answer = request.send().await.unwrap();
        (answer.status().as_u16(), answer.text().await.unwrap())
    };
    let (status, text) = events(None).await;
    assert_eq!(status, 200);
    let last = text.lines().filter_map(|line| line.strip_prefix("id:")).next_back();
    let last = last.unwrap_or_else(|| panic!("no id: {text}")).trim();
    assert_eq!(events(Some(last)).await, (204, String::new()));
    // An id of an earlier version, or of nothing, is no end.
    for other in ["done-0", "", "running"] {
        assert_eq!(events(Some(other)).await, (200, text.clone()), "{other}");
    }
}

#[tokio::test]
async fn health_models_and_the_viewer_answer_over_http_2_as_well() {
    let stand = CpuServer::start().await;
    for client in [
        crate::common::client(),
        crate::common::client_builder().http2_prior_knowledge().build().unwrap(),
    ] {
        let get = async |path: &str| client.get(stand.url(path)).send().await.unwrap();
        assert_eq!(body(get("/healthz").await).await.unwrap()["live"], true);
        assert_eq!(body(get("/readyz").await).await.unwrap()["ready"], true);
        let models = body(get("/v1/models").await).await.unwrap();
        assert_eq!((&models["bundle"], &models["renderer"]), (&"plane".into(), &"cpu".into()));
        let page = get("/").await;
        let policy = page.headers()[header::CONTENT_SECURITY_POLICY].to_str().unwrap();
        assert!(policy.ends_with("; frame-ancestors 'none'"), "{policy}");
        let page = page.text().await.unwrap();
        assert!(page.contains("/v1/scenes") && !page.contains("https://"), "the viewer page");
    }
}

#[tokio::test]
async fn the_stop_signal_ends_the_server_even_with_a_watcher() {
    let stand = CpuServer::start().await;
    let id = made(&stand).await;
    let idle = get(&stand, &format!("/v1/scenes/{id}")).await;
    assert_eq!(idle.status(), StatusCode::OK);
    stand.stop().await;
}
