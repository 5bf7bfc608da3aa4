//! What wants to hurt: bombs, claims without end, names that climb. Each is refused with its code,
//! at once, and all of them together take no more memory than uploads may.
//!
//! With `RUN_SLOW_TESTS=1` each may take 100 ms, which is for a release build on a quiet
//! machine (`SEGSPLAT_TEST_BINARY` names another program than the one built with the tests).

use std::time::{Duration, Instant};

use segsplat::scene::{Upload, UploadCameras};
use tokio_stream::StreamExt;

use super::bad_input::{huge_png, photo, png, uploads, zipped};
use crate::common::{
    cpu_server::upload,
    doors::form,
    process::{Start, can_serve, long},
};

/// A refusal may take so long: the bar, and what a slow machine with a debug build never misses.
const REFUSED_WITHIN: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(10)];
/// Bytes that uploads may hold in this test; the bar is half as much again over the idle server.
const BUDGET_BYTES: u64 = 64 << 20;

/// What is sent.
enum Sent {
    Form(Upload),
    /// Content type and body, to a path.
    Post(&'static str, &'static str, Vec<u8>),
    /// As above, the second piece again and again, without saying how much there will be.
    Endless(&'static str, &'static str, Vec<u8>, Vec<u8>),
    Get(String),
    /// A method of the gRPC service and what is in its stream.
    Rpc(&'static str, Vec<u8>),
}

const SCENES: &str = "/v1/scenes";
const MULTIPART: &str = "multipart/form-data; boundary=b";
const JSON: &str = "application/json";
const VIEWS: &str = "/v1/scenes/00000000000000000000000000000000/views";
const QUERY: &str = "/v1/scenes/00000000000000000000000000000000/query";

fn part(head: &str, bytes: &[u8]) -> Vec<u8> {
    let head = format!("--b\r\ncontent-disposition: form-data; {head}\r\n\r\n");
    [head.as_bytes(), bytes, b"\r\n"].concat()
}

fn cameras(json: Vec<u8>) -> Sent {
    Sent::Form(Upload { cameras: Some(UploadCameras::Transforms(json)), ..upload() })
}

fn archive(bytes: Vec<u8>) -> Sent {
    Sent::Form(Upload { archive: Some(bytes), ..Upload::default() })
}

/// A zip whose headers say that its one file has ten bytes; it has as many as it likes.
fn lying_zip() -> Vec<u8> {
    let mut zip = zipped(vec![("transforms.json", vec![b' '; 600 << 20])]).archive.unwrap();
    let real = (600_u32 << 20).to_le_bytes();
    let places: Vec<_> = (0..zip.len() - 4).filter(|&i| zip[i..i + 4] == real).collect();
    assert!(!places.is_empty(), "the size is not in the headers");
    for at in places {
        zip[at..at + 4].copy_from_slice(&10_u32.to_le_bytes());
    }
    zip
}

fn tar_entry(kind: tar::EntryType, claimed: u64) -> Vec<u8> {
    let mut header = tar::Header::new_ustar();
    header.set_entry_type(kind);
    header.set_size(claimed);
    header.set_path("transforms.json").unwrap();
    if kind == tar::EntryType::Symlink {
        header.set_link_name("/etc/passwd").unwrap();
    }
    header.set_cksum();
    [header.as_bytes().as_slice(), &[b' '; 1024]].concat()
}

/// The picture's header and a text chunk of `side` MiB, packed; no pixels.
fn png_with_text_bomb(mib: usize) -> Vec<u8> {
    let zip = zipped(vec![("t", vec![0; mib << 20])]).archive.unwrap();
    // A zip member is a raw deflate stream; a zlib header before it will do for a chunk whose
    // checksum nobody should come to ask for.
    let start = 30 + 1;
    let body = [b"t\0\0\x78\x9c".as_slice(), &zip[start..]].concat();
    let mut file = png(&[(b"IHDR", &[0, 0, 0, 160, 0, 0, 0, 120, 8, 2, 0, 0, 0])]);
    file.extend(&png(&[(b"zTXt", &body), (b"iCCP", &body)])[8..]);
    file
}

/// A message of gRPC with its flag and the length that it claims.
fn framed(flag: u8, length: u32, bytes: &[u8]) -> Vec<u8> {
    [&[flag][..], &length.to_be_bytes(), bytes].concat()
}

/// What is wrong, what is sent, and the code.
fn hostile() -> Vec<(String, Sent, &'static str)> {
    let mut cases: Vec<_> = uploads()
        .into_iter()
        // Judged by its pixels, not at the door.
        .filter(|(name, ..)| *name != "nothing in common")
        .map(|(name, upload, code, _)| (name.to_owned(), Sent::Form(upload), code))
        .collect();
    let unknown = format!("/v1/scenes/{}", "0".repeat(32));
    let small = |i: usize| part(&format!("name=\"photo\"; filename=\"{i}.png\""), b"x");
    let many_files: Vec<_> = (0..20_000).map(|i| (format!("{i}.png"), vec![0; 9])).collect();
    let many_files = many_files.iter().map(|(name, bytes)| (&**name, bytes.clone())).collect();
    let deep = b"[".repeat(1 << 20);
    let frames = [b"{\"frames\":[".to_vec(), b"{},".repeat(2 << 20), b"{}]}".to_vec()].concat();
    let objects = [b"{\"frames\":[".to_vec(), b"{\"\":0},".repeat(1 << 20), b"{}]}".to_vec()];
    let objects = objects.concat();
    let no_pixels = png(&[(b"IHDR", &[0, 0, 18, 192, 0, 0, 14, 16, 8, 2, 0, 0, 0])]);
    let jpeg = [
        b"\xff\xd8\xff\xc0\0\x11\x08".as_slice(),
        &[0xfd, 0xe8, 0xfd, 0xe8, 3, 1, 0x22, 0, 2, 0x11, 1, 3, 0x11, 1],
        b"\xff\xd9",
    ]
    .concat();
    let webp = [
        b"RIFF\x20\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0".as_slice(),
        &[0xfe, 0x3f, 0, 0xfe, 0x3f, 0, 0, 0, 0, 0],
    ]
    .concat();
    let head = b"--b\r\nx-long: ".to_vec();
    let (limit, bad, unread) = ("limit_exceeded", "invalid_request", "photo_unreadable");
    let more = vec![
        ("zip that lies of its size", archive(lying_zip()), unread),
        ("zip of 20,000 files", Sent::Form(zipped(many_files)), limit),
        ("tar that claims 8 GiB", archive(tar_entry(tar::EntryType::Regular, 8 << 30)), limit),
        ("tar with a link", archive(tar_entry(tar::EntryType::Symlink, 0)), bad),
        ("gzip", archive([b"\x1f\x8b\x08".as_slice(), &[0; 1 << 16]].concat()), unread),
        ("a million brackets", cameras(deep.clone()), limit),
        ("a million little objects", cameras(objects), limit),
        ("two million empty frames", cameras(frames), limit),
        ("one string of 8 MiB", cameras([b"\"".as_slice(), &[b'a'; 8 << 20]].concat()), limit),
        ("17 megapixels without data", Sent::Form(photo(no_pixels)), unread),
        ("JPEG of 65,000 pixels a side", Sent::Form(photo(jpeg)), unread),
        ("WebP of 16,383 pixels a side", Sent::Form(photo(webp)), unread),
        ("PNG with packed text", Sent::Form(photo(png_with_text_bomb(300))), unread),
        ("PNG of no size", Sent::Form(photo(huge_png(0))), unread),
        (
            "one option without end",
            Sent::Endless(SCENES, MULTIPART, Vec::new(), part("name=\"wait_ms\"", b"1")),
            bad,
        ),
        ("a part's head without end", Sent::Endless(SCENES, MULTIPART, head, vec![b'a'; 9]), limit),
        (
            "an archive without end",
            Sent::Endless(
                SCENES,
                MULTIPART,
                part("name=\"archive\"", b"PK"),
                part("name=\"archive\"", &[0; 1 << 16]),
            ),
            limit,
        ),
        (
            "photos without end",
            Sent::Post(SCENES, MULTIPART, (0..20_000).flat_map(small).collect()),
            limit,
        ),
        (
            "a name of 5,000 bytes",
            Sent::Post(SCENES, MULTIPART, part(&format!("name=\"{}\"", "a".repeat(5_000)), b"x")),
            limit,
        ),
        ("no boundary", Sent::Post(SCENES, "multipart/form-data", vec![0; 1 << 20]), bad),
        ("not even a form", Sent::Post(SCENES, MULTIPART, b"\xff".repeat(1 << 20)), bad),
        (
            "an id that climbs",
            Sent::Get("/v1/scenes/..%2f..%2fetc%2fpasswd".into()),
            "scene_not_found",
        ),
        ("a query of 50 KB", Sent::Get(format!("{unknown}/view?from={}", "9".repeat(50_000))), bad),
        ("5,000 parameters", Sent::Get(format!("{unknown}/view?{}", "fx=1&".repeat(5_000))), bad),
        ("a body of brackets", Sent::Post(VIEWS, JSON, deep), limit),
        ("a body of 9 MiB", Sent::Post(VIEWS, JSON, vec![b' '; 9 << 20]), limit),
        ("a deep query", Sent::Post(QUERY, JSON, b"[".repeat(1 << 16)), bad),
        ("a message of 4 GiB", Sent::Rpc("CreateScene", framed(0, u32::MAX, &[0; 1024])), limit),
        ("a message of noise", Sent::Rpc("CreateScene", framed(0, 64, &[0xff; 64])), bad),
        ("a packed message", Sent::Rpc("RenderView", framed(1, 64, &[0; 64])), bad),
        ("a message cut short", Sent::Rpc("Query", framed(0, 1 << 20, &[10; 64])), bad),
        ("no such method", Sent::Rpc("Obey", framed(0, 0, &[])), "not_found"),
    ];
    cases.extend(more.into_iter().map(|(name, sent, code)| (name.to_owned(), sent, code)));
    cases
}

/// The request, ready to go: what it takes to put it together is no time of the server's.
fn request(base: &str, clients: &[reqwest::Client; 2], sent: &Sent) -> reqwest::RequestBuilder {
    let [http, h2] = clients;
    match sent {
        Sent::Form(upload) => http.post(format!("{base}{SCENES}")).multipart(form(upload)),
        Sent::Post(path, kind, body) => {
            http.post(format!("{base}{path}")).header("content-type", *kind).body(body.clone())
        }
        Sent::Endless(path, kind, first, again) => {
            // Pieces as large as a socket takes.
            let piece = again.repeat((1 << 16) / again.len() + 1);
            let pieces = tokio_stream::iter(std::iter::repeat_n(piece, 16_000));
            let pieces = tokio_stream::iter([first.clone()]).chain(pieces);
            let body = reqwest::Body::wrap_stream(pieces.map(Ok::<_, std::io::Error>));
            http.post(format!("{base}{path}")).header("content-type", *kind).body(body)
        }
        Sent::Get(path) => http.get(format!("{base}{path}")),
        Sent::Rpc(method, body) => h2
            .post(format!("{base}/segsplat.v1.SceneService/{method}"))
            .header("content-type", "application/grpc")
            .header("te", "trailers")
            .body(body.clone()),
    }
}

/// The code of the refusal.
async fn send(request: reqwest::RequestBuilder) -> String {
    let answer = request.send().await.expect("an answer");
    if let Some(code) = answer.headers().get("segsplat-code") {
        return code.to_str().unwrap().to_owned();
    }
    let status = answer.status();
    let body = answer.text().await.expect("a body");
    let body: serde_json::Value = serde_json::from_str(&body).unwrap_or_default();
    body["code"].as_str().map_or_else(|| format!("{status} without a code"), str::to_owned)
}

#[tokio::test]
async fn what_wants_to_hurt_is_refused_at_once_and_in_little_memory() {
    if !can_serve() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("segsplat.toml");
    let limits = format!(
        "[limits]\nuploads_bytes_max = {BUDGET_BYTES}\nupload_bytes_max = {}\n\
         archive_unpacked_bytes_max = {BUDGET_BYTES}\n",
        BUDGET_BYTES / 2
    );
    std::fs::write(&config, limits).unwrap();
    let start = Start::on(&folder.path().join("data"));
    let server = start.arg("--config").arg(config.to_str().unwrap()).start();
    let plain = crate::common::client();
    let h2 = crate::common::client_builder().http2_prior_knowledge().build().unwrap();
    let clients = [plain, h2];
    let (bar, slow) = (REFUSED_WITHIN[0], REFUSED_WITHIN[usize::from(!long())]);
    let cases = hostile();
    assert!(cases.len() >= 40, "{}", cases.len());
    // The first connection of each kind is no part of what is measured.
    for warm in [Sent::Get("/healthz".into()), Sent::Rpc("ListScenes", framed(0, 0, &[]))] {
        send(request(&server.url, &clients, &warm)).await;
    }
    let idle = server.peak();
    let (mut wrong, mut slowest) = (Vec::new(), Duration::ZERO);
    for (case, sent, want) in &cases {
        let request = request(&server.url, &clients, sent);
        let begun = Instant::now();
        let code = send(request).await;
        let (took, peak) = (begun.elapsed(), (server.peak() - idle) >> 20);
        println!("{case}: {code} after {took:.1?}, memory {peak} MiB over idle");
        if code != *want || took > slow {
            wrong.push(format!("{case}: {code} after {took:?}; wanted {want} within {slow:?}"));
        }
        slowest = slowest.max(took);
        if long() && matches!(sent, Sent::Endless(..)) {
            // Its rest is still sent, by this very thread, and read: no time of the next case.
            tokio::time::sleep(Duration::from_secs(2)).await;
        }
    }
    let peak = server.peak() - idle;
    println!("{} cases, slowest {slowest:.1?} (bar {bar:?}), {} MiB", cases.len(), peak >> 20);
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
    assert!(peak <= BUDGET_BYTES * 3 / 2, "{peak} bytes over idle, budget {BUDGET_BYTES}");
    let alive = clients[0].get(server.url("/readyz")).send().await.unwrap();
    assert_eq!(alive.status(), 200);
}
