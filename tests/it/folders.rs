//! Scenes as folders in a zip: COLMAP, nerfstudio, COCO and `LabelMe`, over both doors. What other
//! programs read of them is judged by `tests/tools/judge_folders.py`.

use std::{
    collections::BTreeMap,
    io::{Cursor, Read as _},
    sync::Arc,
};

use reqwest::StatusCode;
use segsplat::{
    api::grpc::pb,
    limits::Limits,
    photos,
    scene::{PosedPhoto, SceneCamera, SceneOptions, SceneStatus, SemanticsMode},
    scene::{Upload, UploadCameras, UploadFile},
    service::{
        Boxes, CameraSpec, CreateScene, LensSpec, PoseSpec, QuerySpec, Rle, TextView, ViewOptions,
    },
};
use serde_json::Value;

use crate::common::{
    client,
    cpu_server::{CpuServer, PlaneNetworks, upload},
    doors::{Ask, Door, Options, both, bytes, url},
    meaning::PhotoMeaning,
    root,
    server::{PATIENCE, TestServer},
};

type Files = BTreeMap<String, Vec<u8>>;

fn unzipped(zip: &[u8]) -> Files {
    let mut zip = zip::ZipArchive::new(Cursor::new(zip)).unwrap();
    let names: Vec<String> = zip.file_names().map(|name| name.unwrap().into_owned()).collect();
    let mut read = |name: String| {
        let mut file = Vec::new();
        zip.by_name(&name).unwrap().read_to_end(&mut file).unwrap();
        (name, file)
    };
    names.into_iter().map(&mut read).collect()
}

fn archive(zip: &[u8]) -> Upload {
    Upload { archive: Some(zip.to_vec()), ..Upload::default() }
}

fn read(upload: &Upload) -> Vec<PosedPhoto> {
    photos::read(upload, &Limits::default()).unwrap()
}

fn floats(bytes: &[u8]) -> Vec<f32> {
    bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

/// The numbers of an array of f32.
fn npy(file: &[u8]) -> Vec<f32> {
    floats(&file[10 + usize::from(u16::from_le_bytes([file[8], file[9]]))..])
}

/// A view of a photo's camera at its size.
fn at(camera: &SceneCamera) -> Ask {
    let k = camera.camera.intrinsics;
    let pose = camera.camera.camera_to_world.to_row_major();
    let ask = Ask::default().with_numbers("camera_to_world", &pose);
    let ask = ask.with("fx", k.fx).with("fy", k.fy).with("cx", k.cx).with("cy", k.cy);
    ask.with("width", k.width).with("height", k.height)
}

/// The same cameras, poses to a rounding.
fn same_cameras(one: &[SceneCamera], read: &[PosedPhoto]) {
    assert_eq!(one.len(), read.len());
    for (one, read) in one.iter().zip(read) {
        assert_eq!(one.camera.intrinsics, read.camera.intrinsics);
        let [a, b] = [one.camera, read.camera].map(|camera| camera.camera_to_world.to_row_major());
        let off = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(off < 1e-12, "{}: {off}", one.file);
    }
}

async fn status(stand: &TestServer, id: &str) -> SceneStatus {
    stand.service.get(&id.parse().unwrap()).await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_folder_gives_back_photos_cameras_and_depth() {
    let stand = CpuServer::start().await;
    let [http, grpc] = both(stand.addr).await;
    let (id, _) = http.create(&upload(), &Options::wait()).await.unwrap();
    let scene = status(&stand, &id).await;
    let sent = read(&upload());
    let mut truth = Vec::new();
    for camera in &scene.cameras {
        let ask = at(camera).with("kind", "depth").with("format", "npy");
        truth.push(npy(&http.view(&id, &ask).await.unwrap()));
    }
    assert!(truth[0].iter().filter(|z| **z > 0.0).count() > 1000, "there is depth");
    for format in ["colmap", "nerfstudio"] {
        let zip = http.export_as(&id, format).await.unwrap();
        assert!(grpc.export_as(&id, format).await.unwrap() == zip, "{format}: the same file");
        let (files, back) = (unzipped(&zip), read(&archive(&zip)));
        same_cameras(&scene.cameras, &back);
        for (i, (sent, back)) in sent.iter().zip(&back).enumerate() {
            assert!(sent.photo.rgb == back.photo.rgb, "{format}: photo {i}");
            let name = back.file.rsplit('/').next().unwrap();
            let file = &files[&format!("images/{name}")];
            assert!(*file == upload().photos[i].bytes, "{format}: the file that was sent");
            if format == "colmap" {
                let map = &files[&format!("stereo/depth_maps/{name}.geometric.bin")];
                let head = b"160&120&1&";
                assert_eq!(map[..head.len()], *head);
                assert!(floats(&map[head.len()..]) == truth[i], "the depth of photo {i}");
            } else {
                let map = npy(&files[&format!("depths/{}.npy", name.trim_end_matches(".png"))]);
                let off = |(a, b): (&f32, &f32)| (f64::from(*a) * 1e-3 - f64::from(*b)).abs();
                let off = map.iter().zip(&truth[i]).map(off).fold(0.0, f64::max);
                assert!(map.len() == truth[i].len() && off < 1e-6, "depth of photo {i}: {off}");
            }
        }
        // A scene of the folder has the same cameras, to the last bit where they are JSON.
        let (again, state) = http.create(&archive(&zip), &Options::wait()).await.unwrap();
        assert_eq!(state, "done");
        let again = status(&stand, &again).await;
        same_cameras(&again.cameras, &back);
        assert!(again.report.unwrap().warnings.is_empty(), "nothing of it was left out");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn points_are_those_that_cover_most() {
    let stand = CpuServer::with(PlaneNetworks::default(), |config| {
        config.limits.folder_points_max = 1_000;
    })
    .await;
    let [http, _] = both(stand.addr).await;
    let (id, _) = http.create(&upload(), &Options::wait()).await.unwrap();
    let colmap = unzipped(&http.export_as(&id, "colmap").await.unwrap());
    let points = &colmap["sparse/0/points3D.bin"];
    let word = |bytes: &[u8], at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
    assert_eq!(word(points, 0), 1_000);
    // Each is a pixel of the first photo: id, place, colour, error, a track of one image.
    assert_eq!(points.len(), 8 + 1_000 * (8 + 24 + 3 + 8 + 8 + 8));
    let nerfstudio = unzipped(&http.export_as(&id, "nerfstudio").await.unwrap());
    let ply = &nerfstudio["sparse_pc.ply"];
    let end = ply.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    assert!(String::from_utf8_lossy(&ply[..end]).contains("element vertex 1000\n"));
    assert_eq!(ply.len() - end, 1_000 * 27);
    let scene = status(&stand, &id).await;
    let camera = &scene.cameras[0].camera;
    for i in 0..1_000 {
        let point = &points[8 + 59 * i..][..59];
        assert_eq!(word(point, 0), i as u64 + 1);
        assert_eq!(point[8..35], ply[end + 27 * i..][..27], "place and colour of point {i}");
        assert_eq!(word(point, 43), 1);
        let number = |at: usize| f64::from_bits(word(point, at));
        let place = glam::DVec3::new(number(8), number(16), number(24));
        let seen = camera.camera_to_world.viewmat().transform_point3(place);
        let (u, v) = camera.intrinsics.project(seen);
        // The stand-in takes every second pixel.
        let off = |at: f64| ((at - 0.5) / 2.0 - ((at - 0.5) / 2.0).round()).abs();
        assert!(off(u) + off(v) < 1e-3, "point {i} at {u}, {v}");
    }
    // The first image has all of them.
    let images = &colmap["sparse/0/images.bin"];
    let head = 8 + 4 + 56 + 4 + images[72..].iter().position(|b| *b == 0).unwrap() + 1;
    assert_eq!((word(images, 0), word(images, head)), (3, 1_000));
    assert_eq!(word(images, head + 8 + 16), 1, "the point of its first pixel");
}

#[tokio::test(flavor = "multi_thread")]
async fn photos_of_a_bent_lens_are_written_as_the_scene_has_them() {
    let stand = CpuServer::start().await;
    let mut bent = upload();
    let Some(UploadCameras::Transforms(json)) = &mut bent.cameras else { panic!("transforms") };
    let mut cameras: Value = serde_json::from_slice(json).unwrap();
    cameras["k1"] = 0.05.into();
    *json = cameras.to_string().into_bytes();
    let [http, _] = both(stand.addr).await;
    let (id, _) = http.create(&bent, &Options::wait()).await.unwrap();
    let zip = http.export_as(&id, "nerfstudio").await.unwrap();
    let (seen, back) = (read(&bent), read(&archive(&zip)));
    same_cameras(&status(&stand, &id).await.cameras, &back);
    for (seen, back) in seen.iter().zip(&back) {
        assert!(seen.photo.rgb == back.photo.rgb, "the undistorted photo");
    }
    let file = &unzipped(&zip)["images/0000.png"];
    assert!(*file != bent.photos[0].bytes, "not the file that was sent");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_folder_without_photos_says_which_are_lacking() {
    let stand =
        CpuServer::with(PlaneNetworks::default(), |config| config.keep_photos = false).await;
    let [http, _] = both(stand.addr).await;
    let options = Options { semantics: Some("off"), ..Options::wait() };
    let (id, _) = http.create(&upload(), &options).await.unwrap();
    let files = unzipped(&http.export_as(&id, "colmap").await.unwrap());
    let said = String::from_utf8(files["README.txt"].clone()).unwrap();
    assert!(said.starts_with("3 of 3 photos") && said.contains("0001.png  160 x 120 px"), "{said}");
    assert_eq!(files.keys().filter(|name| name.starts_with("stereo/")).count(), 3);
    assert!(!files.keys().any(|name| name.starts_with("images/")), "{:?}", files.keys());
    // A scene that is a file of Gaussians has one camera, no photo, and points of no photo.
    let file = std::fs::read(root().join("tests/fixtures/splats/source.ply")).unwrap();
    let splats = Some(UploadFile { name: "source.ply".to_owned(), bytes: file });
    let upload = Upload { splats, ..Upload::default() };
    let (id, _) = http.create(&upload, &Options::wait()).await.unwrap();
    let files = unzipped(&http.export_as(&id, "colmap").await.unwrap());
    let points = &files["sparse/0/points3D.bin"];
    assert_eq!(points.len(), 8 + 40 * (8 + 24 + 3 + 8 + 8), "no tracks");
    assert!(files.contains_key("stereo/depth_maps/overview.png.geometric.bin"));
}

/// A server that knows texts, and a scene on it.
async fn understanding() -> (TestServer, SceneStatus) {
    let server = TestServer::with(|_, parts| parts.semantics = Arc::new(PhotoMeaning::default()));
    let server = server.await;
    let options = SceneOptions { semantics: SemanticsMode::Lazy, ..SceneOptions::default() };
    let upload = crate::common::server::upload();
    let request = CreateScene { upload, options, wait: Some(PATIENCE), ..CreateScene::default() };
    let scene = server.service.create_scene(request).await.unwrap().status;
    (server, scene)
}

async fn masks(server: &TestServer, id: &str, format: &str, texts: &str) -> Vec<u8> {
    let [http, grpc] = both(server.addr).await;
    let (Door::Http { base, client }, Door::Grpc { client: grpc }) = (http, grpc) else {
        panic!("two doors")
    };
    let pairs = [("format", format.to_owned()), ("text", texts.to_owned())];
    let url = url(&base, &format!("/v1/scenes/{id}/export"), &pairs);
    let answer = client.get(url).send().await.unwrap();
    assert_eq!(answer.headers()["content-type"], "application/zip");
    let named = answer.headers()["content-disposition"].to_str().unwrap().to_owned();
    assert!(named.contains(&format!("{id}.{format}.zip")), "{named}");
    let file = bytes(answer).await.unwrap();
    let name = format!("EXPORT_FORMAT_{}", format.to_ascii_uppercase());
    let request = pb::ExportRequest {
        scene_id: id.to_owned(),
        format: pb::ExportFormat::from_str_name(&name).unwrap().into(),
        text: texts.to_owned(),
        ..Default::default()
    };
    let mut chunks = grpc.clone().export(request).await.unwrap().into_inner();
    let mut other = Vec::new();
    while let Some(chunk) = chunks.message().await.unwrap() {
        other.extend_from_slice(&chunk.data);
    }
    assert!(other == file, "{format}: the same file over gRPC");
    file
}

/// What a query finds at a photo's camera.
async fn found(server: &TestServer, scene: &SceneStatus, photo: usize) -> Vec<TextView> {
    let camera = scene.cameras[photo].camera;
    let k = camera.intrinsics;
    let spec = QuerySpec {
        texts: TEXTS.map(str::to_owned).to_vec(),
        camera: Some(CameraSpec {
            pose: PoseSpec::CameraToWorld(camera.camera_to_world.to_row_major()),
            lens: LensSpec::Focal { fx: k.fx, fy: Some(k.fy), cx: Some(k.cx), cy: Some(k.cy) },
        }),
        options: ViewOptions {
            width: Some(k.width),
            height: Some(k.height),
            ..ViewOptions::default()
        },
        boxes: Boxes::None,
        ..QuerySpec::default()
    };
    let answer = server.service.query(&scene.id, spec).await.unwrap();
    answer.results.into_iter().map(|result| result.view.unwrap()).collect()
}

const TEXTS: [&str; 3] = ["photo 0", "nothing of it", "photo 2"];

#[tokio::test(flavor = "multi_thread")]
async fn coco_has_the_masks_of_a_query() {
    let (server, scene) = understanding().await;
    let files = unzipped(&masks(&server, scene.id.as_str(), "coco", &TEXTS.join("\n")).await);
    let coco: Value = serde_json::from_slice(&files["annotations.json"]).unwrap();
    let names: Vec<&Value> =
        coco["categories"].as_array().unwrap().iter().map(|one| &one["name"]).collect();
    assert_eq!(names, TEXTS);
    let mut listed = coco["annotations"].as_array().unwrap().iter().enumerate();
    for (photo, camera) in scene.cameras.iter().enumerate() {
        let image = &coco["images"][photo];
        assert_eq!(image["id"], photo + 1);
        let name = image["file_name"].as_str().unwrap();
        assert!(camera.file.ends_with(name) && files.contains_key(&format!("images/{name}")));
        for (text, view) in found(&server, &scene, photo).await.into_iter().enumerate() {
            if view.area == 0 {
                continue;
            }
            let (i, one) = listed.next().expect("an annotation for each mask");
            let ids = [&one["id"], &one["image_id"], &one["category_id"]].map(Value::as_u64);
            assert_eq!(ids, [i + 1, photo + 1, text + 1].map(|id| Some(id as u64)));
            assert_eq!(one["segmentation"], serde_json::to_value(view.mask_rle.unwrap()).unwrap());
            assert_eq!(one["bbox"], serde_json::to_value(view.bbox.unwrap()).unwrap());
            assert_eq!((one["area"].as_u64(), &one["iscrowd"]), (Some(view.area), &0.into()));
        }
    }
    assert!(listed.next().is_none(), "no mask that the query does not have");
    assert!(coco["annotations"].as_array().unwrap().len() >= 3, "{coco}");
}

/// Whether each pixel's centre lies inside of an odd number of ways.
fn filled(polygons: &[Vec<[f64; 2]>], [height, width]: [u32; 2]) -> Vec<bool> {
    let inside = |x: f64, y: f64| {
        let crossed = |polygon: &Vec<[f64; 2]>| {
            let ends = polygon.iter().zip(polygon.iter().cycle().skip(1));
            ends.filter(|(a, b)| (a[1] > y) != (b[1] > y) && a[0] > x).count()
        };
        polygons.iter().map(crossed).sum::<usize>() % 2 == 1
    };
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    // Seams lie in the rows of centres: what is asked is a little above.
    pixels.map(|(x, y)| inside(f64::from(x) + 0.5, f64::from(y) + 0.25)).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn labelme_has_the_masks_of_a_query_as_polygons() {
    let (server, scene) = understanding().await;
    let files = unzipped(&masks(&server, scene.id.as_str(), "labelme", &TEXTS.join("\n")).await);
    let mut some = 0;
    for (photo, camera) in scene.cameras.iter().enumerate() {
        let name = camera.file.rsplit('/').next().unwrap();
        let path = format!("images/{}.json", name.trim_end_matches(".png"));
        let label: Value = serde_json::from_slice(&files[&path]).unwrap();
        assert_eq!((&label["imagePath"], &label["imageData"]), (&name.into(), &Value::Null));
        let shapes = label["shapes"].as_array().unwrap();
        for (text, view) in found(&server, &scene, photo).await.into_iter().enumerate() {
            let of_text = shapes.iter().filter(|shape| shape["label"] == TEXTS[text]);
            let of_text = of_text.inspect(|shape| assert_eq!(shape["group_id"], text));
            let polygons: Vec<Vec<[f64; 2]>> =
                of_text.map(|s| serde_json::from_value(s["points"].clone()).unwrap()).collect();
            let rle: Rle = view.mask_rle.unwrap();
            let mask = rle.decode();
            assert_eq!(mask.iter().filter(|on| **on).count() as u64, view.area);
            assert!(filled(&polygons, rle.size) == mask, "photo {photo}, {:?}", TEXTS[text]);
            some += polygons.len();
        }
    }
    assert!(some >= 3, "{some} polygons");
}

#[tokio::test(flavor = "multi_thread")]
async fn folders_that_cannot_be_are_refused_by_name() {
    let (server, scene) = understanding().await;
    let service = &server.service;
    let ask = async |query: &str| {
        let url = server.url(&format!("/v1/scenes/{}/export?{query}", scene.id));
        bytes(client().get(url).send().await.unwrap()).await
    };
    let limits = (*service.limits()).clone();
    let few = Limits { views_pixels_max: 5 * 64 * 48, ..limits.clone() };
    let small = Limits { view_side_max: 50, ..limits.clone() };
    for (limits, query, code, says) in [
        (&limits, "format=coco", "invalid_request", "no text; give 1 to 128"),
        (&limits, "format=labelme&text=a%0A%0Ab", "invalid_request", "text[1] is empty"),
        (&limits, "format=colmap&text=a", "invalid_request", "not with colmap"),
        (&limits, "format=nerfstudio&text=a", "invalid_request", "not with nerfstudio"),
        (&limits, "format=coco&text=a&cut=2", "invalid_request", "cut is 2"),
        (
            &few,
            "format=coco&text=a%0Ab",
            "limit_exceeded",
            "masks of 2 texts in 3 photos: 18432 px",
        ),
        (&small, "format=colmap", "limit_exceeded", "width: 64 px"),
    ] {
        service.reload(limits.clone());
        let fault = ask(query).await.unwrap_err();
        assert_eq!(fault.code, code, "{query}: {}", fault.message);
        assert!(fault.message.contains(says), "{query}: {}", fault.message);
    }
    service.reload(Limits { views_pixels_max: 3 * 64 * 48, ..limits });
    ask("format=coco&text=a").await.expect("as many pixels as may be");
    // More folders at a time than the limit are refused, and can come later.
    let none = TestServer::with(|config, _| config.limits.folder_exports_max = 0).await;
    let id = none.scene().await.id;
    let url = none.url(&format!("/v1/scenes/{id}/export?format=colmap"));
    let fault = bytes(client().get(url).send().await.unwrap()).await.unwrap_err();
    assert_eq!((&*fault.code, fault.retry_after.as_deref()), ("overloaded", Some("5")));
    let one = TestServer::with(|config, _| config.limits.folder_exports_max = 1).await;
    let id = one.scene().await.id;
    let url = one.url(&format!("/v1/scenes/{id}/export?format=nerfstudio"));
    let mut tag = None;
    for _ in 0..3 {
        let answer = client().get(&url).send().await.unwrap();
        assert_eq!(answer.status(), StatusCode::OK);
        tag = Some(answer.headers()["etag"].clone());
        assert!(bytes(answer).await.unwrap().len() > 10_000);
        // The permit comes back a moment after the last byte.
        tokio::time::sleep(std::time::Duration::from_millis(100)).await;
    }
    let known = client().get(&url).header("if-none-match", tag.unwrap()).send().await.unwrap();
    assert_eq!(known.status(), StatusCode::NOT_MODIFIED);
}
