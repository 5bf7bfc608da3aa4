//! Files of Gaussians become scenes: what they show, what can be asked of them, what is refused,
//! and what a restart leaves of them.

use std::{
    io::Write as _,
    sync::{Arc, atomic::Ordering},
};

use flate2::{Compression, write::GzEncoder};
use segsplat::{
    error::Result,
    formats::{
        splats::{COMPRESSED_PLY, GLB, PLY, SOG, SPLAT, SPZ, SPZ4, SplatFile, SplatFormat},
        table::{read_splats, splat_formats},
    },
    jobs::{NetworkState, SceneNetworks},
    pipeline::{PhotoSet, Reconstruction},
    render::compare::psnr,
    scene::{
        Bank, SceneId, SceneOptions, SceneState, SceneStatus, Semantics, SemanticsReport,
        SemanticsState, Upload, UploadFile, Watch,
    },
    service::ModelsInfo,
    store::{Store, StoreLocation},
};
use segsplat_testing::scenes::cloud;
use serde_json::{Value, json as object};

use crate::common::{
    client,
    cpu_server::{self, CpuServer},
    doors::{self, Ask, Door, Fault, Options, bytes, form, json},
    meaning::{DIM, PhotoMeaning},
    server::TestServer,
};

/// A file as an upload.
fn upload(name: &str, bytes: Vec<u8>) -> Upload {
    Upload { splats: Some(UploadFile { name: name.to_owned(), bytes }), ..Upload::default() }
}

/// 300 Gaussians as a file, of which 100 have entry 1 and 100 entry 2 of a bank of two.
fn file(format: &'static SplatFormat, bundle: &str) -> Upload {
    let mut rows = vec![0.0; 2 * DIM];
    (rows[0], rows[DIM + 1]) = (1.0, 1.0);
    let semantics = Semantics {
        bank: Bank { dim: DIM, rows },
        index: (0..300).map(|i| i % 3).collect(),
        report: SemanticsReport { bundle_sha256: bundle.to_owned(), ..SemanticsReport::default() },
        ..Semantics::default()
    };
    let gaussians = cloud(300, 0, 3).with_semantic_index(semantics.index.clone()).unwrap();
    let file = SplatFile::new(format, gaussians, Some(&semantics)).unwrap();
    let mut bytes = Vec::new();
    file.write(&mut bytes).unwrap();
    upload(&format!("a.{}", format.ending), bytes)
}

async fn understanding() -> TestServer {
    TestServer::with(|_, parts| {
        parts.semantics = Arc::new(PhotoMeaning::default());
        parts.models = models();
    })
    .await
}

fn models() -> ModelsInfo {
    ModelsInfo {
        bundle: "ours".to_owned(),
        bundle_sha256: "0123456789abcdef".to_owned(),
        ..ModelsInfo::default()
    }
}

/// Posts a file and waits: the scene, or why not.
async fn post(server: &TestServer, upload: &Upload, query: &str) -> Result<Value, Fault> {
    let url = server.url(&format!("/v1/scenes?wait_ms=120000{query}"));
    json(client().post(url).multipart(form(upload)).send().await.unwrap()).await
}

async fn query(server: &TestServer, id: &str, text: &str) -> Result<Value, Fault> {
    let url = server.url(&format!("/v1/scenes/{id}/query"));
    json(client().post(url).json(&object!({ "texts": [text] })).send().await.unwrap()).await
}

/// The pixels of a colour view as numbers.
fn pixels(npy: &[u8]) -> Vec<[f32; 3]> {
    let data = 10 + usize::from(u16::from_le_bytes([npy[8], npy[9]]));
    let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
    npy[data..].chunks_exact(12).map(|p| [number(p), number(&p[4..]), number(&p[8..])]).collect()
}

/// A scene of photos, exported in each format and posted again, over both transports: the views are
/// those of the scene to the step of the format. docs/formats.md has the figures.
#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_is_exported_and_posted_again_gives_the_same_views() {
    let server = CpuServer::start().await;
    // Files of a scene with magnification have its blur: the next test.
    let made = post(&server, &cpu_server::upload(), "&magnify=false").await.unwrap();
    let id = made["id"].as_str().unwrap();
    // Between two of its cameras, in numbers: the other scenes do not have these cameras.
    let camera = &made["cameras"][1];
    let numbers: Vec<f64> = serde_json::from_value(camera["camera_to_world"].clone()).unwrap();
    let mut ask = Ask::default().with_numbers("camera_to_world", &numbers);
    for name in ["fx", "fy", "cx", "cy", "width", "height"] {
        ask = ask.with(name, &camera["intrinsics"][name]);
    }
    let ask = ask.with("near", 0.05).with_numbers("background", &[0.2, 0.4, 0.6]);
    let ask = ask.with("format", "npy");
    let [http, grpc] = doors::both(server.addr).await;
    let truth = pixels(&http.view(id, &ask).await.unwrap());
    for (format, floor) in [
        (&PLY, 110.0),
        (&GLB, 120.0),
        (&SPLAT, 50.0),
        (&SPZ, 45.0),
        (&SPZ4, 45.0),
        (&SOG, 40.0),
        (&COMPRESSED_PLY, 45.0),
    ] {
        let file = http.export_as(id, format.name).await.unwrap();
        let sent = upload(&format!("a.{}", format.ending), file);
        let (again, state) = http.create(&sent, &Options::wait()).await.unwrap();
        assert_eq!(state, "done");
        let view = http.view(&again, &ask).await.unwrap();
        let found = psnr(&pixels(&view), &truth, None);
        println!("{}: {found:.1} dB", format.name);
        assert!(found > floor, "{}: {found:.1} dB, not {floor}", format.name);
        let (of_grpc, _) = grpc.create(&sent, &Options::wait()).await.unwrap();
        assert!(grpc.view(&of_grpc, &ask).await.unwrap() == view, "{}", format.name);
        // What was read once does not change any more where the format has fixed steps.
        let second = http.export_as(&again, format.name).await.unwrap();
        if format.name == GLB.name || format.name == SPLAT.name {
            let [one, two] = [&sent.splats.unwrap().bytes, &second].map(|file| {
                let mut file = &file[..];
                read_splats(&mut file, "a.splat", &server.service.limits()).unwrap().gaussians
            });
            assert!(one.means() == two.means(), "{}", format.name);
        }
    }
    server.stop().await;
}

/// It has a camera, is listed, watched and deleted as any scene.
#[tokio::test]
async fn a_file_is_a_scene_like_any_other() {
    let server = CpuServer::start().await;
    let scene = post(&server, &file(&SPZ, ""), "").await.unwrap();
    let (id, report) = (scene["id"].as_str().unwrap(), &scene["report"]);
    assert_eq!(report["file_format"], "spz");
    assert_eq!([&report["photos"], &report["gaussians"]], [0, 300]);
    assert_eq!(scene["cameras"].as_array().map(Vec::len), Some(1));
    assert_eq!(scene["cameras"][0]["file"], "overview");
    let door = doors::http(server.addr);
    let alpha = Ask::first().with("kind", "alpha").with("format", "grey8");
    let seen = door.view(id, &alpha).await.unwrap().iter().filter(|alpha| **alpha > 0).count();
    assert!(seen > 64 * 48 / 20, "its camera sees it: {seen} pixels");
    let depth = Ask::first().with("kind", "depth").with("format", "npy");
    assert!(door.view(id, &depth).await.is_ok());
    let list = client().get(server.url("/v1/scenes")).send().await.unwrap();
    let list = json(list).await.unwrap();
    assert_eq!(list["scenes"][0]["report"]["file_format"], "spz");
    let events = client().get(server.url(&format!("/v1/scenes/{id}/events")));
    let events = events.send().await.unwrap().text().await.unwrap();
    assert!(events.starts_with("event: done"), "{events}");
    for format in splat_formats() {
        assert!(!door.export_as(id, format.name).await.unwrap().is_empty());
    }
    assert!(!door.export_as(id, "packed").await.unwrap().is_empty());
    door.delete(id).await.unwrap();
    assert_eq!(door.get(id).await.unwrap_err().code, "scene_not_found");
    server.stop().await;
}

/// A scene of a file for antialiased views is drawn so unless a view says otherwise, and leaves so.
#[tokio::test]
async fn the_mode_of_a_file_is_that_of_its_views_and_exports() {
    let server = CpuServer::start().await;
    let mut file = Vec::new();
    let made = SplatFile::new(&PLY, cloud(300, 0, 3), None).unwrap().antialiased(true);
    made.write(&mut file).unwrap();
    let text = String::from_utf8_lossy(&file[..90]).into_owned();
    assert!(text.contains("comment SplatRenderMode: mip\n"), "{text}");
    let scene = post(&server, &upload("a.ply", file), "").await.unwrap();
    let id = scene["id"].as_str().unwrap();
    assert_eq!(scene["report"]["antialiased"], true);
    for door in doors::both(server.addr).await {
        let drawn = async |given: Option<&str>| {
            let ask = Ask::first().with("width", "64").with("format", "rgb8");
            let ask = given.into_iter().fold(ask, |ask, given| ask.with("antialiased", given));
            door.view(id, &ask).await.unwrap()
        };
        let (usual, on, off) =
            (drawn(None).await, drawn(Some("true")).await, drawn(Some("false")).await);
        assert!(usual == on && usual != off);
    }
    let door = doors::http(server.addr);
    for format in splat_formats() {
        let out = door.export_as(id, format.name).await.unwrap();
        let name = format!("a.{}", format.ending);
        let back = read_splats(&mut &out[..], &name, &server.service.limits()).unwrap();
        assert_eq!(back.antialiased, format.name != SPLAT.name, "{}", format.name);
    }
    server.stop().await;
}

#[tokio::test]
async fn texts_are_answered_where_the_file_brings_a_bank_and_else_it_is_said_why_not() {
    let server = understanding().await;
    for format in [&PLY, &GLB] {
        let scene = post(&server, &file(format, "0123456789abcdef"), "").await.unwrap();
        let id = scene["id"].as_str().unwrap();
        assert_eq!(scene["semantics"]["state"], "ready", "{scene}");
        assert_eq!(scene["semantics"]["bank_size"], 2);
        let answer = query(&server, id, "photo 1").await.unwrap();
        assert_eq!(answer["results"][0]["gaussians"], 100, "{answer}");
        let mask = Ask::first().with("kind", "mask").with("text", "photo 0");
        let [http, grpc] = doors::both(server.addr).await;
        assert!(http.view(id, &mask).await.unwrap() == grpc.view(id, &mask).await.unwrap());
        // The semantics leave with an export and come again.
        let again = upload("b.ply", http.export_as(id, "ply").await.unwrap());
        let again = post(&server, &again, "&semantics=eager").await.unwrap();
        let answer = query(&server, again["id"].as_str().unwrap(), "photo 0").await.unwrap();
        assert_eq!(answer["results"][0]["gaussians"], 100, "{answer}");
    }
    let scene = post(&server, &file(&SPZ, ""), "").await.unwrap();
    assert_eq!(scene["semantics"]["available"], false);
    let reason = scene["semantics"]["reason"].as_str().unwrap();
    assert!(reason.contains("is a file of Gaussians (spz) without semantics"), "{reason}");
    let refused = query(&server, scene["id"].as_str().unwrap(), "photo 0").await.unwrap_err();
    assert_eq!(refused.code, "semantics_off");
    assert!(refused.message.contains("(spz) without semantics"), "{refused:?}");
    // What is not wanted is not kept.
    let scene = post(&server, &file(&GLB, ""), "&semantics=off").await.unwrap();
    let refused = query(&server, scene["id"].as_str().unwrap(), "photo 0").await.unwrap_err();
    assert_eq!(
        (refused.code.as_str(), &scene["semantics"]["state"]),
        ("semantics_off", &"off".into())
    );
    // Numbers of another bundle cannot be compared with texts of this one; they stay in the scene.
    let scene = post(&server, &file(&GLB, "fedcba9876543210"), "").await.unwrap();
    let id = scene["id"].as_str().unwrap();
    let reason = scene["semantics"]["reason"].as_str().unwrap();
    assert!(reason.contains("fedcba987654;") && reason.contains("0123456789ab"), "{reason}");
    for _ in 0..2 {
        let refused = query(&server, id, "photo 0").await.unwrap_err();
        assert_eq!(refused.code, "model_unavailable");
        assert!(refused.message.contains("of the bundle fedcba987654"), "{refused:?}");
    }
    let out = doors::http(server.addr).export_as(id, "glb").await.unwrap();
    let limits = server.service.limits();
    assert!(read_splats(&mut &out[..], "", &limits).unwrap().semantics.is_some());
}

/// What needs photos says so, and nothing is made.
#[tokio::test]
async fn what_needs_photos_is_refused_by_name() {
    let server = understanding().await;
    let sent = file(&SPZ, "");
    for (option, name) in [
        ("&refine=500", "refine: it needs photos"),
        ("&max_views=2", "max_views: it needs photos"),
        ("&density=full", "density: it needs photos"),
        ("&semantics=eager", "semantics=eager: it needs photos"),
    ] {
        let refused = post(&server, &sent, option).await.unwrap_err();
        assert_eq!(
            (refused.code.as_str(), refused.number),
            ("invalid_request", 400),
            "{refused:?}"
        );
        assert!(refused.message.starts_with(name), "{refused:?}");
    }
    let scene = post(&server, &sent, "&refine=auto").await.unwrap();
    assert_eq!(scene["refinement"]["state"], "none");
    let url = server.url(&format!("/v1/scenes/{}/refine", scene["id"].as_str().unwrap()));
    let refused = bytes(client().post(&url).send().await.unwrap()).await.unwrap_err();
    assert_eq!(refused.code, "invalid_request");
    assert!(refused.message.contains("file of Gaussians (spz); it has no photos"), "{refused:?}");
    let off = client().post(format!("{url}?refine=off")).send().await.unwrap();
    assert!(off.status().is_success());
}

/// SPZ of many Gaussians that are all zeros: a few kilobytes.
fn bomb(count: u32, degree: u8) -> Vec<u8> {
    let mut to = GzEncoder::new(Vec::new(), Compression::fast());
    to.write_all(b"NGSP\x03\0\0\0").unwrap();
    to.write_all(&count.to_le_bytes()).unwrap();
    to.write_all(&[degree, 12, 0, 0]).unwrap();
    let each = 20 + 3 * ((usize::from(degree) + 1).pow(2) - 1);
    to.write_all(&vec![0; each * count as usize]).unwrap();
    to.finish().unwrap()
}

/// Files that cannot be a scene are answered at once, over both transports.
#[tokio::test(flavor = "multi_thread")]
async fn files_that_cannot_be_a_scene_are_refused_at_once() {
    let server = TestServer::with(|config, _| {
        config.limits.gaussians_max = 20_000;
        config.limits.splats_bytes_max = 1 << 20;
    })
    .await;
    let good = |format| file(format, "").splats.unwrap().bytes;
    let mut too_many_rows = Semantics {
        bank: Bank { dim: 1, rows: vec![1.0; 5_000] },
        index: vec![0; 10],
        ..Semantics::default()
    };
    let with = |semantics: &Semantics| {
        let mut bytes = Vec::new();
        let index = semantics.index.clone();
        let gaussians = cloud(10, 0, 1).with_semantic_index(index).unwrap();
        SplatFile::new(&PLY, gaussians, Some(semantics)).unwrap().write(&mut bytes).unwrap();
        bytes
    };
    let rows = with(&too_many_rows);
    too_many_rows.bank.rows.truncate(3);
    too_many_rows.index[9] = 4;
    let index = with(&too_many_rows);
    let ply = String::from_utf8_lossy(&good(&PLY)).into_owned();
    let empty = ply.split_once("end_header").unwrap().0.replace("vertex 300", "vertex 0");
    let empty = empty.replace("comment segsplat_semantics_bytes", "comment");
    let cases = [
        ("a.ply", good(&PLY)[..5_000].to_vec(), "invalid_request", "of 300 Gaussians"),
        ("a.spz", good(&SPZ)[..200].to_vec(), "invalid_request", "SPZ"),
        ("a.spz", good(&SPZ4)[..200].to_vec(), "invalid_request", "SPZ: stream"),
        ("a.glb", b"glTF\x02".to_vec(), "invalid_request", "GLB"),
        ("a.splat", vec![0; 33], "invalid_request", "1 of 2"),
        ("a.splat", Vec::new(), "invalid_request", "the file is empty"),
        ("a.bin", good(&SPLAT), "invalid_request", "the file is none of Gaussians"),
        ("", good(&SPLAT), "invalid_request", "by the ending of its name"),
        ("a.zip", b"PK\x03\x04".to_vec(), "invalid_request", "zip"),
        ("a.spz", bomb(20_001, 0), "limit_exceeded", "20001"),
        ("a.spz", bomb(16_385, 0), "limit_exceeded", "1048640 bytes in memory"),
        ("a.spz", bomb(10_000, 3), "limit_exceeded", "10000 of degree 3, 2440000 bytes"),
        ("a.ply", (empty + "end_header\n").into_bytes(), "invalid_request", "it has none"),
        ("a.spz", bomb(100, 0), "invalid_request", "100 opacity_below_1_255"),
        ("a.ply", rows, "limit_exceeded", "rows of the bank"),
        ("a.ply", index, "invalid_request", "highest index 4"),
    ];
    for (name, bytes, code, says) in cases {
        for door in doors::both(server.addr).await {
            // Without a name gRPC has no first piece.
            if name.is_empty() && matches!(door, Door::Grpc { .. }) {
                continue;
            }
            let sent = upload(name, bytes.clone());
            // An empty file has no piece over gRPC.
            if bytes.is_empty() && matches!(door, Door::Grpc { .. }) {
                continue;
            }
            let refused = door.create(&sent, &Options::default()).await.unwrap_err();
            assert_eq!(refused.code, code, "{name}: {refused:?}");
            assert!(refused.message.contains(says), "{name}: {refused:?} lacks {says:?}");
        }
    }
    let list = client().get(server.url("/v1/scenes")).send().await.unwrap();
    assert_eq!(json(list).await.unwrap()["scenes"], object!([]));
    assert!(doors::http(server.addr).create(&file(&PLY, ""), &Options::wait()).await.is_ok());
}

#[tokio::test]
async fn one_key_makes_one_scene_of_a_file() {
    let server = understanding().await;
    let key = || Options { idempotency_key: Some("k".to_owned()), ..Options::wait() };
    let [http, grpc] = doors::both(server.addr).await;
    let (first, _) = http.create(&file(&GLB, ""), &key()).await.unwrap();
    assert_eq!(grpc.create(&file(&GLB, ""), &key()).await.unwrap().0, first);
    let other = http.create(&file(&PLY, ""), &key()).await.unwrap_err();
    assert_eq!((&*other.code, other.number), ("idempotency_key_reused", 422), "{other:?}");
    // The same file under no key is a copy with the semantics.
    let (copy, _) = http.create(&file(&GLB, ""), &Options::wait()).await.unwrap();
    assert_ne!(copy, first);
    let answer = query(&server, &copy, "photo 0").await.unwrap();
    assert_eq!(answer["results"][0]["gaussians"], 100);
}

/// Networks that never open: what is posted stays queued.
#[derive(Debug)]
struct Closed;

impl SceneNetworks for Closed {
    fn state(&self) -> NetworkState {
        NetworkState::Opening
    }

    fn make(&self, _: &PhotoSet, _: &SceneOptions, _: Watch<'_>) -> Result<Reconstruction> {
        panic!("a file needs no network")
    }
}

/// Opens a server on this place; `closed`: it makes nothing.
async fn server_at(place: &StoreLocation, closed: bool) -> TestServer {
    TestServer::at(place, |_, parts| {
        parts.semantics = Arc::new(PhotoMeaning::default());
        parts.models = models();
        if closed {
            parts.scenes = Arc::new(Closed);
        }
    })
    .await
}

/// A restart makes what was acknowledged; one that was cut off between the scene and its semantics
/// has both.
#[tokio::test(flavor = "multi_thread")]
async fn a_file_that_was_acknowledged_is_a_scene_after_any_restart() {
    let folder = tempfile::tempdir().unwrap();
    let place = StoreLocation::Folder(folder.path().join("data"));
    let server = server_at(&place, true).await;
    let door = doors::http(server.addr);
    let mut ids = Vec::new();
    for format in [&GLB, &PLY, &SPZ] {
        let (id, state) = door.create(&file(format, ""), &Options::default()).await.unwrap();
        assert_eq!(state, "queued");
        ids.push(id.parse::<SceneId>().unwrap());
    }
    server.stop().await;
    {
        let limits = segsplat::limits::Limits::default();
        let (store, records) = Store::open(&place, &limits).unwrap();
        let record = records.into_iter().find(|record| record.status.id == ids[0]).unwrap();
        let sent = store.upload(&ids[0]).unwrap().splats.unwrap();
        let read = read_splats(&mut &sent.bytes[..], &sent.name, &limits).unwrap();
        let mut scene = read.into_scene(&record.options).unwrap();
        scene.meta.id = ids[0].clone();
        scene.semantics = None;
        let status = SceneStatus { state: SceneState::Running, ..record.status.clone() };
        store.put_record(&segsplat::store::Record { status, attempts: 1, ..record }).unwrap();
        store.put_scene(scene).unwrap();
    }
    let server = server_at(&place, false).await;
    for (id, state) in
        ids.iter().zip([SemanticsState::Ready, SemanticsState::Ready, SemanticsState::Off])
    {
        let status = server.finished(id).await;
        assert_eq!((status.state, status.semantics.state), (SceneState::Done, state), "{status:?}");
    }
    let answer = query(&server, ids[0].as_str(), "photo 0").await.unwrap();
    let view = doors::http(server.addr).view(ids[0].as_str(), &Ask::first()).await.unwrap();
    server.stop().await;
    // Done is done.
    let meaning = Arc::new(PhotoMeaning::default());
    let given = Arc::clone(&meaning);
    let server = TestServer::at(&place, |_, parts| {
        (parts.semantics, parts.models) = (given, models());
    })
    .await;
    assert_eq!(
        query(&server, ids[0].as_str(), "photo 0").await.unwrap()["results"],
        answer["results"]
    );
    assert!(doors::http(server.addr).view(ids[0].as_str(), &Ask::first()).await.unwrap() == view);
    let refused = query(&server, ids[2].as_str(), "photo 0").await.unwrap_err();
    assert_eq!(refused.code, "semantics_off");
    assert_eq!(meaning.calls.load(Ordering::Acquire), 0, "there are no photos");
}

/// The command line makes the same of a file, without a network and a server.
#[test]
fn the_command_line_makes_a_scene_file_of_a_file() {
    let folder = tempfile::tempdir().unwrap();
    let run = |arguments: &[&std::ffi::OsStr]| -> (Option<i32>, Value) {
        let mut program = std::process::Command::new(env!("CARGO_BIN_EXE_segsplat"));
        let done = program.arg("--json").args(arguments).output().unwrap();
        let text = if done.status.success() { done.stdout } else { done.stderr };
        (done.status.code(), serde_json::from_slice(&text).unwrap())
    };
    let scene = folder.path().join("a.segsplat");
    let ply = folder.path().join("out.ply");
    for (format, semantics) in [(&GLB, true), (&SPZ, false)] {
        let sent = file(format, "").splats.unwrap();
        let source = folder.path().join(&sent.name);
        std::fs::write(&source, sent.bytes).unwrap();
        let words = ["reconstruct".as_ref(), source.as_os_str(), "-o".as_ref(), scene.as_os_str()];
        let (code, made) = run(&words);
        assert_eq!(code, Some(0), "{made}");
        assert_eq!(made["report"]["file_format"], format.name);
        assert_eq!(made["cameras"][0]["file"], "overview");
        let (_, inside) = run(&["inspect".as_ref(), scene.as_os_str()]);
        assert_eq!(
            [&inside["format"], &inside["gaussians"]],
            [&object!("segsplat"), &object!(300)]
        );
        // The semantics of the scene before are gone.
        let words = ["export".as_ref(), scene.as_os_str(), "-o".as_ref(), ply.as_os_str()];
        assert_eq!(run(&words).1["semantics"], semantics, "{}", format.name);
        let picture = folder.path().join("a.png");
        let view = ["render".as_ref(), scene.as_os_str(), "-o".as_ref(), picture.as_os_str()];
        let (code, drawn) = run(&[&view[..], &["--from".as_ref(), "0".as_ref()]].concat());
        assert!(code == Some(0) && drawn["visible"].as_u64() > Some(250), "{drawn}");
        let options = ["--max-views".as_ref(), "2".as_ref()];
        let words = ["reconstruct".as_ref(), source.as_os_str(), "-o".as_ref(), scene.as_os_str()];
        let (code, refused) = run(&[&words[..], &options].concat());
        assert!(code == Some(2) && refused.to_string().contains("max_views: it needs photos"));
    }
}
