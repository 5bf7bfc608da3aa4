//! A capture as files of a form, as an archive in a form, as the body itself and over gRPC: it is
//! recognised, and each way gives the same scene and says what was left out.

use reqwest::StatusCode;
use segsplat::{
    limits::Limits,
    photos,
    scene::{Upload, UploadCameras, UploadFile},
};
use segsplat_testing::captures::{self, zipped};

use crate::common::{
    client,
    cpu_server::{CpuServer, upload},
    doors::{self, Ask, Fault, Options, bytes, form, grpc, http, json},
    root,
};

/// The sample as COLMAP writes it, with a photo that has no camera.
fn colmap() -> Vec<UploadFile> {
    let posed = photos::read(&upload(), &Limits::default()).unwrap();
    let mut files = captures::write("colmap_bin", &posed, &upload().photos);
    files.push(UploadFile { name: "images/lone.png".to_owned(), bytes: b"?".to_vec() });
    files
}

#[tokio::test]
async fn a_capture_is_recognised_at_every_door() {
    let stand = CpuServer::start().await;
    let files = colmap();
    let zip = zipped(&files, "");
    let of_files = Upload { photos: files, ..Upload::default() };
    let of_zip = Upload { archive: Some(zip.clone()), ..Upload::default() };
    let address = stand.url("/v1/scenes?wait_ms=120000&semantics=off");
    let mut pictures = Vec::new();
    let requests = [
        client().post(&address).multipart(form(&of_files)),
        client().post(&address).multipart(form(&of_zip)),
        client().post(&address).header("content-type", "application/zip").body(zip.clone()),
        client().post(&address).header("content-type", "application/octet-stream").body(zip),
    ];
    for request in requests {
        let answer = request.send().await.unwrap();
        assert_eq!(answer.status(), StatusCode::CREATED);
        let scene = json(answer).await.unwrap();
        let files: Vec<_> = scene["cameras"].as_array().unwrap().iter().collect();
        assert_eq!(files.len(), 3, "{scene}");
        assert_eq!(files[1]["file"], "0001.png");
        let first = &scene["report"]["warnings"][0];
        assert_eq!(first["code"], "photos_unused");
        assert!(first["message"].as_str().unwrap().contains("lone.png"), "{first}");
        let id = scene["id"].as_str().unwrap();
        pictures.push(http(stand.addr).view(id, &Ask::first()).await.unwrap());
    }
    let door = grpc(stand.addr).await;
    for upload in [&of_files, &of_zip] {
        let scene = door.create(upload, &Options::wait()).await.unwrap();
        pictures.push(door.view(&scene.0, &Ask::first()).await.unwrap());
    }
    assert!(pictures.iter().all(|picture| *picture == pictures[0]), "the same scene");
}

/// README's lines that find the cameras of photos alone.
fn lines_of_the_readme() -> Vec<String> {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    let lines: Vec<_> =
        readme.lines().filter(|line| line.starts_with("pycolmap.")).map(str::to_owned).collect();
    assert_eq!(lines.len(), 3, "{lines:?}");
    lines
}

#[tokio::test]
async fn photos_alone_are_taken_at_every_door_and_need_a_network() {
    let stand = CpuServer::start().await;
    let photos = upload().photos;
    let archive = Some(zipped(&photos, "photos/"));
    let both = [Upload { photos, ..Upload::default() }, Upload { archive, ..Upload::default() }];
    for upload in &both {
        for door in doors::both(stand.addr).await {
            let fault = door.create(upload, &Options::wait()).await.expect_err("no network");
            assert_eq!(fault.code, "model_unavailable");
            assert!(fault.message.contains("finds the cameras"), "{door:?}: {}", fault.message);
        }
    }
}

#[test]
fn the_program_and_the_documents_have_the_same_lines() {
    let files = [
        "crates/formats/src/captures/layouts/mod.rs",
        "packaging/wheel/README.md",
        "docs/captures.md",
    ];
    for file in files {
        let text = std::fs::read_to_string(root().join(file)).unwrap();
        for line in lines_of_the_readme() {
            assert!(text.contains(&line), "{file} lacks {line}");
        }
    }
}

/// The sample with a mask for each photo that leaves its left third out: as a part `masks`, as
/// files of a folder `masks`, as what the cameras name, and as the alpha of the photos.
fn masked() -> [(&'static str, Upload, Vec<UploadFile>); 4] {
    let plain = upload();
    let stem = |file: &UploadFile| {
        let name = file.name.rsplit('/').next().unwrap();
        name.trim_end_matches(".png").to_owned()
    };
    let kept = |x: u32, width: u32| 3 * x >= width;
    let mask = |file: &UploadFile| {
        let photo = image::load_from_memory(&file.bytes).unwrap().to_rgb8();
        let kept = |x, _| image::Luma([255 * u8::from(kept(x, photo.width()))]);
        png(&image::GrayImage::from_fn(photo.width(), photo.height(), kept).into())
    };
    let named = |name: &dyn Fn(&UploadFile) -> String| -> Vec<UploadFile> {
        plain.photos.iter().map(|f| UploadFile { name: name(f), bytes: mask(f) }).collect()
    };
    let with = |masks: Vec<UploadFile>| Upload {
        photos: [plain.photos.clone(), masks].concat(),
        ..plain.clone()
    };
    let mut said: serde_json::Value = match &plain.cameras {
        Some(UploadCameras::Transforms(json)) => serde_json::from_slice(json).unwrap(),
        other => panic!("{other:?}"),
    };
    for frame in said["frames"].as_array_mut().unwrap() {
        let name = frame["file_path"].as_str().unwrap().replace("images/", "left_out/");
        frame["mask_path"] = name.into();
    }
    let mut by_name = with(named(&|file| format!("left_out/{}.png", stem(file))));
    by_name.cameras = Some(UploadCameras::Transforms(said.to_string().into_bytes()));
    let mut alpha = plain.clone();
    for file in &mut alpha.photos {
        let mut photo = image::load_from_memory(&file.bytes).unwrap().to_rgba8();
        let width = photo.width();
        for (x, _, pixel) in photo.enumerate_pixels_mut() {
            pixel.0[3] = 255 * u8::from(kept(x, width));
        }
        file.bytes = png(&photo.into());
    }
    [
        ("part", plain.clone(), named(&|file| format!("{}.png", stem(file)))),
        ("folder", with(named(&|file| format!("masks/{}.png.png", stem(file)))), vec![]),
        ("named", by_name, vec![]),
        ("alpha", alpha, vec![]),
    ]
}

fn png(image: &image::DynamicImage) -> Vec<u8> {
    let mut out = std::io::Cursor::new(Vec::new());
    image.write_to(&mut out, image::ImageFormat::Png).unwrap();
    out.into_inner()
}

#[tokio::test]
async fn masks_mean_the_same_at_every_door() {
    let stand = CpuServer::start().await;
    let address = stand.url("/v1/scenes?wait_ms=120000&semantics=off");
    let door = grpc(stand.addr).await;
    for (way, upload, parts) in masked() {
        let mut parts_form = form(&upload);
        for file in &parts {
            let bytes = reqwest::multipart::Part::bytes(file.bytes.clone());
            parts_form = parts_form.part("masks", bytes.file_name(file.name.clone()));
        }
        let request = client().post(&address).multipart(parts_form);
        let scene = json(request.send().await.unwrap()).await.unwrap();
        let mut warnings = vec![scene["report"]["warnings"].clone()];
        // gRPC has no parts: there masks are files of a folder `masks`.
        let masks = parts.iter().map(|file| UploadFile {
            name: format!("masks/{}", file.name),
            bytes: file.bytes.clone(),
        });
        let photos = upload.photos.iter().cloned().chain(masks).collect();
        let made = door.create(&Upload { photos, ..upload }, &Options::wait()).await.unwrap();
        let status = client().get(stand.url(&format!("/v1/scenes/{}", made.0)));
        let status = json(status.send().await.unwrap()).await.unwrap();
        warnings.push(status["report"]["warnings"].clone());
        for warnings in &warnings {
            let masks: Vec<_> = warnings.as_array().unwrap().iter().collect();
            if way == "alpha" {
                assert!(masks.is_empty(), "{way}: {masks:?}");
                continue;
            }
            assert_eq!(masks.len(), 1, "{way}: {masks:?}");
            assert_eq!(masks[0]["code"], "masks_used", "{way}");
            let share = masks[0]["value"].as_f64().unwrap();
            assert!((share - 1.0 / 3.0).abs() < 0.01, "{way}: {share}");
        }
        assert_eq!(warnings[0], warnings[1], "{way}");
    }
}

#[tokio::test]
async fn a_body_that_is_no_archive_is_refused() {
    let stand = CpuServer::start().await;
    let send = async |kind: &str, body: Vec<u8>| -> Fault {
        let request = client().post(stand.url("/v1/scenes")).header("content-type", kind);
        bytes(request.body(body).send().await.unwrap()).await.expect_err("refused")
    };
    let fault = send("application/zip", b"hello".to_vec()).await;
    assert_eq!((&*fault.code, fault.number), ("photo_unreadable", 422));
    let fault = send("application/x-tar; a=b", Vec::new()).await;
    assert_eq!(fault.code, "photo_unreadable");
    let fault = send("text/plain", b"hello".to_vec()).await;
    assert_eq!(fault.code, "invalid_request");
    assert!(fault.message.contains("application/zip"), "{fault:?}");
}
