//! Damaged bytes from outside, with fixed seeds: every reader answers or refuses with a code; none
//! panics, hangs or reports a fault of the server.
//!
//! `FUZZ_SEED` and `FUZZ_ITERS` choose others than the default; with `FUZZ_SECONDS` each target
//! goes on for so many seconds of CPU time (`make fuzz`), and `FUZZ_TARGET` names the one that
//! runs. What fails is written to `target/fuzz`. With `FUZZ_KEEP=1` a
//! case that is refused as none was before joins the corpus in `tests/fixtures/fuzz`.

use std::{
    collections::BTreeSet,
    io::{Read as _, Write as _},
    net::SocketAddr,
    panic::{AssertUnwindSafe, catch_unwind},
    path::PathBuf,
    sync::{Arc, LazyLock},
    time::Duration,
};

use flate2::{Compression, read::GzDecoder, write::GzEncoder};
use prost::Message;
use segsplat::{
    api::grpc::{pb, pb_inference},
    cli::engine,
    config::Config,
    error::{ErrorCode, Result, TABLE},
    formats::{
        container::{read_scene, read_semantics, write_scene, write_semantics},
        splats::{GLB, SOG, SplatFile},
        table::{read_splats, splat_formats},
    },
    limits::Limits,
    photos,
    render::cpu::CpuRenderer,
    sample::{self, SampleOptions},
    scene::{
        Backdrop, Bank, HealthReport, IndexMap, Provenance, RowViews, Scene, SceneId, SceneMeta,
        Semantics, SemanticsReport, Upload, UploadCameras,
    },
};
use segsplat_testing::captures;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::common::{
    doors::{Ask, Options, messages},
    opened, root,
    scenes::{Random, cloud},
    server::TestServer,
};

/// No answer to a few kilobytes may take longer, whatever they say.
const ANSWER_MAX: Duration = Duration::from_secs(20);
/// Largest file and most files of a target's corpus.
const KEPT_BYTES_MAX: usize = 4 << 10;
const KEPT_FILES_MAX: usize = 24;

fn environment(name: &str) -> Option<u64> {
    std::env::var(name).ok().and_then(|value| value.parse().ok())
}

/// Time of the processor that this process has taken.
fn cpu_time() -> Duration {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    #[expect(unsafe_code, reason = "a call into the C library")]
    // SAFETY: it writes to `time` alone, which lives on.
    let failed = unsafe { libc::clock_gettime(libc::CLOCK_PROCESS_CPUTIME_ID, &raw mut time) };
    assert_eq!(failed, 0, "the system counts the time of a process");
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

/// Numbers and words that broke readers before.
const TOKENS: [&[u8]; 22] = [
    b"-1",
    b"0",
    b"1e999",
    b"-1e-999",
    b"NaN",
    b"null",
    b"18446744073709551616",
    b"4294967295",
    b"9223372036854775807",
    b"0.0000000001",
    b"{}",
    b"[]",
    b"\"\"",
    b"[[[[",
    b"../../etc/passwd",
    b"\0",
    b"\xff\xfe",
    b"\r\n\r\n",
    b"--",
    b"%00",
    b"%2e%2e%2f",
    b"\xed\xa0\x80",
];

/// One seed, spoilt in one to eight places.
fn spoil(random: &mut Random, seeds: &[Vec<u8>]) -> Vec<u8> {
    let pick = |random: &mut Random, below: usize| random.bits() as usize % below.max(1);
    let mut bytes = seeds[pick(random, seeds.len())].clone();
    for _ in 0..1 + pick(random, 8) {
        let at = pick(random, bytes.len() + 1);
        let to = at + pick(random, (bytes.len() - at).min(64) + 1);
        match pick(random, 9) {
            0 if at < bytes.len() => bytes[at] ^= 1 << pick(random, 8),
            1 if at < bytes.len() => bytes[at] = random.bits() as u8,
            2 => drop(bytes.drain(at..to)),
            3 => {
                let piece = bytes[at..to].to_vec();
                bytes.splice(at..at, piece);
            }
            4 => bytes.truncate(at),
            5 | 6 => {
                let token = TOKENS[pick(random, TOKENS.len())];
                bytes.splice(at..at, token.iter().copied());
            }
            7 => {
                // A number becomes another one.
                let is_number = |b: u8| b.is_ascii_digit() || b".-e".contains(&b);
                let start = bytes[at..].iter().position(|b| b.is_ascii_digit()).map(|n| at + n);
                if let Some(start) = start {
                    let length = bytes[start..].iter().take_while(|b| is_number(**b)).count();
                    let token = TOKENS[pick(random, 10)];
                    bytes.splice(start..start + length, token.iter().copied());
                }
            }
            _ => {
                let other = &seeds[pick(random, seeds.len())];
                let from = pick(random, other.len() + 1);
                let end = from + pick(random, (other.len() - from).min(256) + 1);
                bytes.splice(at..to, other[from..end].iter().copied());
            }
        }
        bytes.truncate(256 << 10);
    }
    bytes
}

fn corpus_of(target: &str) -> PathBuf {
    root().join("tests/fixtures/fuzz").join(target)
}

/// The committed corpus of a target, after the seeds that the program makes itself.
fn corpus(target: &str, mut seeds: Vec<Vec<u8>>) -> Vec<Vec<u8>> {
    let mut files: Vec<_> = std::fs::read_dir(corpus_of(target))
        .map(|entries| entries.map(|entry| entry.unwrap().path()).collect())
        .unwrap_or_default();
    files.sort();
    seeds.extend(files.iter().map(|file| std::fs::read(file).unwrap()));
    assert!(seeds.iter().all(|seed| seed.len() <= 256 << 10), "{target}: a seed is too large");
    seeds
}

/// Cases of a target until their number or time is over: its seeds as they are, then spoilt ones.
struct Cases<'a> {
    target: &'a str,
    seeds: Vec<Vec<u8>>,
    seed: u64,
    count: u64,
    begun: Duration,
    last: Vec<u8>,
    refusals: BTreeSet<String>,
}

impl<'a> Cases<'a> {
    fn new(target: &'a str, seeds: Vec<Vec<u8>>) -> Self {
        let seeds = corpus(target, seeds);
        let seed = environment("FUZZ_SEED").unwrap_or(20);
        let (begun, last, refusals) = (cpu_time(), Vec::new(), BTreeSet::new());
        Self { target, seeds, seed, count: 0, begun, last, refusals }
    }

    fn next(&mut self, iterations: u64) -> Option<Vec<u8>> {
        let other = std::env::var("FUZZ_TARGET").is_ok_and(|named| named != self.target);
        let on = match environment("FUZZ_SECONDS") {
            _ if other => return None,
            Some(seconds) => cpu_time() - self.begun < Duration::from_secs(seconds),
            None => self.count < environment("FUZZ_ITERS").unwrap_or(iterations),
        };
        if !on {
            let (count, ways) = (self.count, self.refusals.len());
            let (target, took) = (self.target, cpu_time() - self.begun);
            println!("{target}: {count} cases, {ways} ways to be refused, {took:.1?} of CPU time");
            return None;
        }
        let own = usize::try_from(self.count).ok().and_then(|i| self.seeds.get(i)).cloned();
        let mut random = Random(self.seed.wrapping_mul(1_000_003) ^ self.count);
        self.last = own.unwrap_or_else(|| spoil(&mut random, &self.seeds));
        self.count += 1;
        Some(self.last.clone())
    }

    /// Takes what became of the case at hand: nothing bad, or a refusal's code and message.
    fn judge(&mut self, refusal: Option<(&str, &str)>) {
        let Some((code, message)) = refusal else { return };
        if code == ErrorCode::Internal.name() {
            self.fail(&format!("it calls this a fault of its own: {message}"));
        }
        // Without what the input put in: numbers and quoted words.
        let plain = message.split('"').step_by(2).flat_map(str::chars);
        let plain = plain.filter(|c| c.is_ascii_alphabetic()).take(50);
        let new = self.refusals.insert(format!("{code}-{}", plain.collect::<String>()));
        if new && environment("FUZZ_KEEP") == Some(1) && self.last.len() <= KEPT_BYTES_MAX {
            let folder = corpus_of(self.target);
            std::fs::create_dir_all(&folder).unwrap();
            let hash = Sha256::digest(&self.last);
            let name = hash[..4].iter().map(|byte| format!("{byte:02x}"));
            if std::fs::read_dir(&folder).unwrap().count() < KEPT_FILES_MAX {
                std::fs::write(folder.join(name.collect::<String>()), &self.last).unwrap();
            }
            self.seeds.push(self.last.clone());
        }
    }

    /// Keeps the case at hand and fails.
    fn fail(&self, why: &str) -> ! {
        let folder = root().join("target/fuzz");
        let file = folder.join(format!("{}-{}-{}", self.target, self.seed, self.count));
        let kept =
            std::fs::create_dir_all(&folder).and_then(|()| std::fs::write(&file, &self.last));
        panic!("{}: {why}; case {} ({kept:?})", self.target, file.display());
    }

    /// Runs a reader on every case.
    fn run(mut self, iterations: u64, read: impl Fn(&[u8]) -> Result<()>) {
        while let Some(case) = self.next(iterations) {
            let begun = cpu_time();
            match catch_unwind(AssertUnwindSafe(|| read(&case))) {
                Err(_) => self.fail("it panicked"),
                Ok(_) if cpu_time() - begun > ANSWER_MAX => self.fail("it took too long"),
                Ok(Ok(())) => {}
                Ok(Err(error)) => self.judge(Some((error.code().name(), error.message()))),
            }
        }
    }
}

/// Two photos of 16x16 pixels and their cameras.
fn small() -> Upload {
    static MADE: LazyLock<Upload> = LazyLock::new(|| {
        let options = SampleOptions { photos: 2, width: 16, height: 16, seed: 5 };
        sample::upload(&options).expect("the sample is made")
    });
    MADE.clone()
}

fn transforms() -> Vec<u8> {
    match small().cameras {
        Some(UploadCameras::Transforms(json)) => json,
        other => panic!("the sample has {other:?}"),
    }
}

fn cameras() -> Vec<u8> {
    let photos = photos::read(&small(), &Limits::default()).unwrap();
    let camera = |posed: &segsplat::scene::PosedPhoto| {
        serde_json::json!({
            "file": posed.file,
            "intrinsics": posed.camera.intrinsics,
            "camera_to_world": posed.camera.camera_to_world.to_row_major(),
        })
    };
    let cameras: Vec<_> = photos.iter().map(camera).collect();
    serde_json::to_vec(&serde_json::json!({ "cameras": cameras })).unwrap()
}

fn read_upload(upload: &Upload) -> Result<()> {
    photos::read(upload, &Limits::default()).map(drop)
}

#[test]
fn camera_descriptions() {
    let with = |cameras| Upload { cameras: Some(cameras), ..small() };
    Cases::new("transforms", vec![transforms()])
        .run(400, |case| read_upload(&with(UploadCameras::Transforms(case.to_vec()))));
    Cases::new("cameras", vec![cameras()])
        .run(400, |case| read_upload(&with(UploadCameras::Cameras(case.to_vec()))));
}

#[test]
fn archives() {
    use std::io::{Cursor, Write as _};
    let small = small();
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let mut tar = tar::Builder::new(Vec::new());
    let transforms = transforms();
    let photos = small.photos.iter().map(|p| (p.name.as_str(), p.bytes.as_slice()));
    for (name, bytes) in photos.chain([("transforms.json", transforms.as_slice())]) {
        zip.start_file(name, zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(bytes).unwrap();
        let mut header = tar::Header::new_gnu();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        tar.append_data(&mut header, name, bytes).unwrap();
    }
    let seeds = vec![zip.finish().unwrap().into_inner(), tar.into_inner().unwrap()];
    Cases::new("archive", seeds).run(400, |case| {
        read_upload(&Upload { archive: Some(case.to_vec()), ..Upload::default() })
    });
}

#[test]
fn captures_of_every_layout() {
    let upload = small();
    let posed = photos::read(&upload, &Limits::default()).unwrap();
    let lenses = [
        ("colmap_bin", "sparse/0/cameras.bin"),
        ("colmap_txt", "sparse/0/cameras.txt"),
        ("arkitscenes", "41069021/lowres_wide_intrinsics/41069021_305.377.pincam"),
    ];
    let described = captures::LAYOUTS.map(|(layout, _)| (layout, captures::described_by(layout)));
    for (layout, file) in described.into_iter().chain(lenses) {
        let files = captures::write(layout, &posed, &upload.photos);
        let at = files.iter().position(|f| f.name == file).expect("the layout has its cameras");
        let target = format!("{layout}-{}", file.rsplit('/').next().unwrap_or(file));
        Cases::new(&target, vec![files[at].bytes.clone()]).run(100, |case| {
            let mut photos = files.clone();
            photos[at].bytes = case.to_vec();
            read_upload(&Upload { photos, ..Upload::default() })
        });
    }
}

#[test]
fn photos_of_every_format() {
    let upload = small();
    let picture = image::load_from_memory(&upload.photos[0].bytes).unwrap().to_rgb8();
    let encoded = |format| {
        let mut file = std::io::Cursor::new(Vec::new());
        picture.write_to(&mut file, format).unwrap();
        file.into_inner()
    };
    use image::ImageFormat::{Jpeg, Png, WebP};
    Cases::new("photo", [Png, Jpeg, WebP].map(encoded).to_vec()).run(300, |case| {
        let mut upload = upload.clone();
        upload.photos[0].bytes = case.to_vec();
        read_upload(&upload)
    });
}

fn scene() -> Scene {
    let meta = SceneMeta {
        id: SceneId::from_bytes([7; 16]),
        created_ms: 1,
        cameras: Vec::new(),
        report: HealthReport::default(),
        provenance: Provenance::default(),
    };
    Scene::new(meta, cloud(20, 1, 3), Backdrop::default())
}

/// With its last 32 bytes made right again: what is behind the checksum is read as well.
fn resealed(case: &[u8]) -> Vec<u8> {
    let content = &case[..case.len().saturating_sub(32)];
    [content, &Sha256::digest(content)[..]].concat()
}

fn semantics() -> Semantics {
    let bank = Bank { dim: 3, rows: vec![0.5; 6] };
    let map = IndexMap { width: 3, height: 2, index: vec![0, 1, 2, 0, 1, 2] };
    let report = SemanticsReport::default();
    Semantics {
        bank,
        views: RowViews { entries: vec![1, 2], rows: vec![0.5; 6] },
        index: vec![1; 20],
        photos: vec![map.clone(), map],
        masks: Vec::new(),
        report,
    }
}

#[test]
fn containers_of_scenes_and_semantics() {
    let id = SceneId::from_bytes([7; 16]);
    let (mut of_scene, mut of_semantics) = (Vec::new(), Vec::new());
    write_scene(&mut of_scene, &scene()).unwrap();
    write_semantics(&mut of_semantics, &id, &semantics()).unwrap();
    assert_eq!(resealed(&of_scene), of_scene, "the checksum is elsewhere");
    // Each case as it is, where the checksum speaks, and with a right one, where the rest does.
    let either = |whole: Result<()>, sealed: Result<()>| {
        assert!(whole.is_err() || sealed.is_ok(), "a right checksum makes a good file bad");
        let known = |code| matches!(code, ErrorCode::SceneCorrupt | ErrorCode::LimitExceeded);
        let other = [&whole, &sealed].into_iter().find_map(|r| r.as_ref().err());
        assert!(other.is_none_or(|error| known(error.code())), "{other:?} for a bad file");
        sealed
    };
    Cases::new("scene", vec![of_scene]).run(300, |case| {
        let read = |bytes: &[u8]| read_scene(bytes).map(drop);
        either(read(case), read(&resealed(case)))
    });
    Cases::new("semantics", vec![of_semantics]).run(300, |case| {
        let read = |bytes: &[u8]| read_semantics(bytes, &id).map(drop);
        either(read(case), read(&resealed(case)))
    });
}

#[test]
fn files_of_gaussians() {
    for format in splat_formats() {
        let file = SplatFile::new(format, cloud(20, 1, 3), Some(&semantics())).unwrap();
        let mut bytes = Vec::new();
        file.write(&mut bytes).unwrap();
        let name = format!("a.{}", format.ending);
        let limits = Limits { gaussians_max: 10_000, ..Limits::default() };
        // The bytes of SPZ are spoilt before they are packed: those under gzip's own sum are
        // refused by it.
        let packed = |case: &[u8]| {
            let mut gzip = GzEncoder::new(Vec::new(), Compression::fast());
            gzip.write_all(case).and_then(|()| gzip.finish()).unwrap()
        };
        let is_packed = bytes.starts_with(&[0x1f, 0x8b]);
        if is_packed {
            let mut whole = Vec::new();
            GzDecoder::new(&bytes[..]).read_to_end(&mut whole).unwrap();
            bytes = whole;
        }
        Cases::new(format.name, vec![bytes]).run(600, |case| {
            let read = |mut bytes: &[u8]| read_splats(&mut bytes, &name, &limits).map(drop);
            if is_packed { read(case).or_else(|_| read(&packed(case))) } else { read(case) }
        });
    }
}

/// A GLB's document, and files of a SOG, spoilt before they are packed: what they are packed in
/// would refuse most of those that are spoilt after.
#[test]
fn insides_of_files_of_gaussians() {
    let limits = Limits { gaussians_max: 10_000, ..Limits::default() };
    let read = |file: &[u8]| read_splats(&mut &file[..], "", &limits).map(drop);
    let written = |format| {
        let mut bytes = Vec::new();
        let file = SplatFile::new(format, cloud(20, 1, 3), Some(&semantics())).unwrap();
        file.write(&mut bytes).unwrap();
        bytes
    };
    let glb = written(&GLB);
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    let (document, rest) = glb[20..].split_at(length);
    Cases::new("glb-document", vec![document.to_vec()]).run(600, |case| {
        let length = (case.len() as u32).to_le_bytes();
        read(&[&glb[..12], &length, b"JSON", case, rest].concat())
    });
    let sog = written(&SOG);
    let mut zip = zip::ZipArchive::new(std::io::Cursor::new(&sog)).unwrap();
    let files: Vec<(String, Vec<u8>)> = (0..zip.len())
        .map(|i| {
            let mut file = zip.by_index(i).unwrap();
            let mut bytes = Vec::new();
            file.read_to_end(&mut bytes).unwrap();
            (file.name().unwrap().into_owned(), bytes)
        })
        .collect();
    for spoilt in ["meta.json", "means_u.webp", "shN_centroids.webp", "shN_labels.webp"] {
        let (_, seed) = files.iter().find(|(name, _)| name == spoilt).expect(spoilt);
        Cases::new(&format!("sog-{spoilt}"), vec![seed.clone()]).run(200, |case| {
            let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
            for (name, bytes) in &files {
                let stored = zip::write::SimpleFileOptions::default()
                    .compression_method(zip::CompressionMethod::Stored);
                zip.start_file(&**name, stored).unwrap();
                zip.write_all(if name == spoilt { case } else { bytes }).unwrap();
            }
            read(&zip.finish().unwrap().into_inner())
        });
    }
}

/// A server that draws as the product does.
async fn server() -> TestServer {
    TestServer::with(|config, parts| {
        parts.renderer = Arc::new(CpuRenderer::new(2).expect("two threads"));
        // A picture of every size asked for would be what takes the time.
        config.limits.view_side_max = 64;
    })
    .await
}

/// Code and message of an HTTP answer that is no success; one without a code of ours fails.
fn refusal(status: u16, body: &[u8]) -> Option<(String, String)> {
    if (200..400).contains(&status) {
        return None;
    }
    let body: serde_json::Value = serde_json::from_slice(body).unwrap_or_default();
    let text = |name: &str| body[name].as_str().unwrap_or_default().to_owned();
    let code = text("code");
    assert!(TABLE.iter().any(|row| row.name == code), "{status}: {body}");
    Some((code, text("message")))
}

#[tokio::test]
async fn multipart_bodies() {
    let server = server().await;
    let (client, url) = (crate::common::client(), server.url("/v1/scenes"));
    let mut body = Vec::new();
    let mut part = |head: &str, bytes: &[u8]| {
        body.extend(format!("--b\r\ncontent-disposition: form-data; {head}\r\n\r\n").as_bytes());
        body.extend(bytes);
        body.extend(b"\r\n");
    };
    part("name=\"transforms\"", &transforms());
    for photo in small().photos {
        part(&format!("name=\"photo\"; filename=\"{}\"", photo.name), &photo.bytes);
    }
    part("name=\"semantics\"", b"off");
    body.extend(b"--b--\r\n");
    let mut cases = Cases::new("multipart", vec![body]);
    while let Some(case) = cases.next(150) {
        let request = client.post(&url).header("content-type", "multipart/form-data; boundary=b");
        let answer = tokio::time::timeout(ANSWER_MAX, request.body(case).send()).await;
        let Ok(answer) = answer else { cases.fail("no answer") };
        let answer = answer.expect("an answer");
        let status = answer.status().as_u16();
        let refused = refusal(status, &answer.bytes().await.expect("a body"));
        cases.judge(refused.as_ref().map(|(code, message)| (&**code, &**message)));
    }
    check_alive(&server).await;
}

/// Whatever was sent, the server answers after it.
async fn check_alive(server: &TestServer) {
    let answer = crate::common::client().get(server.url("/healthz")).send().await.unwrap();
    assert_eq!(answer.status(), 200);
}

/// Sends a request line as it is and gives what is answered; nothing where it takes too long.
async fn line(address: SocketAddr, case: &[u8]) -> Option<Vec<u8>> {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let mut socket = tokio::net::TcpStream::connect(address).await.unwrap();
    let mut bytes = b"GET ".to_vec();
    // A line ends where the caller says it does.
    bytes.extend(case.iter().filter(|byte| !b"\r\n".contains(byte)));
    bytes.extend(b" HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n");
    let mut answer = Vec::new();
    let talk = async {
        socket.write_all(&bytes).await?;
        socket.read_to_end(&mut answer).await
    };
    // A connection that is closed is an answer too.
    let talked = tokio::time::timeout(ANSWER_MAX, talk).await;
    talked.is_ok().then_some(answer)
}

#[tokio::test]
async fn ids_and_query_strings() {
    let server = server().await;
    let id = server.scene().await.id;
    let view = format!(
        "/v1/scenes/{id}/view?camera_to_world=1,0,0,0,0,1,0,0,0,0,1,0,0,0,0,1&fx=50&fy=50\
         &width=32&height=24&kind=depth&format=npy&background=%23ff0000&near=0.1&deadline_ms=900"
    );
    let between = format!("/v1/scenes/{id}/view?from=0&to=1&t=0.5&width=32&height=24&fov=50");
    let pick = format!("/v1/scenes/{id}/pick?from=0&x=9&y=9&width=32&height=24");
    let list = format!("/v1/scenes?limit=3&after=17-{id}");
    let look = format!("/v1/scenes/{id}/view?eye=0,0,-1&target=0,0,1&up=0,1,0&fov=40&width=8");
    let seeds = [view, between, pick, list, look].map(String::into_bytes).to_vec();
    let mut cases = Cases::new("query", seeds);
    while let Some(case) = cases.next(300) {
        let Some(answer) = line(server.addr, &case).await else { cases.fail("no answer") };
        let status = answer.get(9..12).and_then(|s| std::str::from_utf8(s).ok()?.parse().ok());
        let body = answer.windows(4).position(|w| w == b"\r\n\r\n").map(|end| &answer[end + 4..]);
        // What is no HTTP is refused by the framework, without a body.
        if let (Some(status), Some(body @ [_, ..])) = (status, body) {
            let refused = refusal(status, body);
            cases.judge(refused.as_ref().map(|(code, message)| (&**code, &**message)));
        }
    }
    check_alive(&server).await;
}

#[tokio::test]
async fn grpc_messages() {
    let server = server().await;
    let scene_id = server.scene().await.id.to_string();
    let client = crate::common::client_builder().http2_prior_knowledge().build().unwrap();
    let ask = Ask::first();
    let (camera, options) = (Some(ask.camera()), Some(ask.options()));
    let view = pb::RenderViewRequest {
        scene_id: scene_id.clone(),
        camera: camera.clone(),
        options,
        ..Default::default()
    };
    let list = pb::ListScenesRequest { limit: Some(3), after: format!("17-{scene_id}") };
    let pick = pb::PickRequest { scene_id, camera, x: 3.0, y: 3.0, ..Default::default() };
    let framed = |message: Vec<u8>| {
        let length = u32::try_from(message.len()).unwrap().to_be_bytes();
        [&[0_u8][..], &length, &message].concat()
    };
    let upload: Vec<u8> = messages(&small(), &Options::default())
        .into_iter()
        .flat_map(|message| framed(message.encode_to_vec()))
        .collect();
    for (method, seed) in [
        ("RenderView", framed(view.encode_to_vec())),
        ("Pick", framed(pick.encode_to_vec())),
        ("ListScenes", framed(list.encode_to_vec())),
        ("CreateScene", upload),
    ] {
        let target = format!("grpc-{method}");
        let mut cases = Cases::new(&target, vec![seed]);
        let url = server.url(&format!("/segsplat.v1.SceneService/{method}"));
        while let Some(case) = cases.next(100) {
            let request = client.post(&url).header("content-type", "application/grpc");
            let sent = request.header("te", "trailers").body(case).send();
            let Ok(answer) = tokio::time::timeout(ANSWER_MAX, sent).await else {
                cases.fail("no answer")
            };
            // A stream that is reset is an answer too.
            let Ok(answer) = answer else { continue };
            let text = |name: &str| answer.headers().get(name).and_then(|v| v.to_str().ok());
            cases.judge(text("segsplat-code").zip(text("grpc-message").or(Some(""))));
        }
    }
    check_alive(&server).await;
}

#[tokio::test]
async fn runs_of_networks() {
    let configured = |config: &mut Config| {
        config.bundle = Some(root().join("tests/fixtures/colours"));
        (config.threads, config.jobs) = (1, 1);
    };
    let mut config = Config::default();
    configured(&mut config);
    let opened = opened(engine::parts(&config).and_then(|(parts, all)| all.get().map(|_| parts)));
    let Some(parts) = opened else { return };
    let server = TestServer::with(|of_server, of_test| {
        configured(of_server);
        *of_test = parts;
    })
    .await;
    let [ids, there] = [[1_i64, 2, 3, 3, 2, 0], [1, 1, 1, 1, 1, 0]];
    let bytes = |data: [i64; 6]| data.map(i64::to_le_bytes).concat();
    let http = |own: [Value; 2]| {
        let inputs = ["input_ids", "attention_mask"].into_iter().zip(own).map(|(name, own)| {
            let mut input = json!({ "name": name, "shape": [2, 3], "datatype": "INT64" });
            input.as_object_mut().unwrap().extend(own.as_object().unwrap().clone());
            input
        });
        let outputs = json!([{ "name": "embeddings", "parameters": { "binary_data": true } }]);
        let inputs: Vec<Value> = inputs.collect();
        json!({ "id": "7", "inputs": inputs, "outputs": outputs }).to_string().into_bytes()
    };
    let listed = http([json!({ "data": ids }), json!({ "data": [&there[..3], &there[3..]] })]);
    let size = || json!({ "parameters": { "binary_data_size": 48 } });
    let json = http([size(), size()]);
    let behind = [&json[..], &bytes(ids), &bytes(there)].concat();
    let input = |name: &str| pb_inference::model_infer_request::InferInputTensor {
        name: name.to_owned(),
        datatype: "INT64".to_owned(),
        shape: vec![2, 3],
        ..Default::default()
    };
    let message = pb_inference::ModelInferRequest {
        model_name: "image_text.text".to_owned(),
        inputs: vec![input("input_ids"), input("attention_mask")],
        raw_input_contents: vec![bytes(ids).into(), bytes(there).into()],
        ..Default::default()
    };
    let message = message.encode_to_vec();
    let length = u32::try_from(message.len()).unwrap().to_be_bytes();
    let framed = [&[0_u8][..], &length, &message].concat();
    let path = "/v2/models/image_text.text/infer";
    let rpc = "/inference.GRPCInferenceService/ModelInfer";
    for (target, path, seed) in [
        ("inference-json", path, listed),
        ("inference-bytes", path, behind),
        ("inference-grpc", rpc, framed),
    ] {
        let grpc = target.ends_with("grpc");
        let client = crate::common::client_builder();
        let client = if grpc { client.http2_prior_knowledge() } else { client };
        let client = client.build().unwrap();
        let mut cases = Cases::new(target, vec![seed]);
        while let Some(case) = cases.next(150) {
            let request = client.post(server.url(path)).body(case);
            let request = match target {
                "inference-bytes" => request.header("inference-header-content-length", json.len()),
                "inference-grpc" => {
                    request.header("content-type", "application/grpc").header("te", "trailers")
                }
                _ => request,
            };
            let Ok(answer) = tokio::time::timeout(ANSWER_MAX, request.send()).await else {
                cases.fail("no answer")
            };
            // A stream that is reset is an answer too.
            let Ok(answer) = answer else { continue };
            if grpc {
                let text = |name: &str| answer.headers().get(name).and_then(|v| v.to_str().ok());
                cases.judge(text("segsplat-code").zip(text("grpc-message").or(Some(""))));
                continue;
            }
            let status = answer.status().as_u16();
            let refused = refusal(status, &answer.bytes().await.expect("a body"));
            cases.judge(refused.as_ref().map(|(code, message)| (&**code, &**message)));
        }
    }
    check_alive(&server).await;
}
