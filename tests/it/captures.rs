//! A capture as files of a form, as an archive in a form, as the body itself and over gRPC: it is
//! recognised, and each way gives the same scene and says what was left out.

use reqwest::StatusCode;
use segsplat::{
    limits::Limits,
    photos,
    scene::{Upload, UploadFile},
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
async fn photos_alone_are_told_at_every_door_what_finds_their_cameras() {
    let stand = CpuServer::start().await;
    let photos = upload().photos;
    let archive = Some(zipped(&photos, "photos/"));
    let both = [Upload { photos, ..Upload::default() }, Upload { archive, ..Upload::default() }];
    for upload in &both {
        for door in doors::both(stand.addr).await {
            let fault = door.create(upload, &Options::wait()).await.expect_err("no cameras");
            assert_eq!(fault.code, "invalid_request");
            for line in lines_of_the_readme() {
                assert!(fault.message.contains(&line), "{door:?}: {}", fault.message);
            }
        }
    }
}

#[test]
fn the_page_the_client_and_the_documents_have_the_same_lines() {
    let files = [
        "web/capture.js",
        "clients/python/src/segsplat/calls.py",
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
