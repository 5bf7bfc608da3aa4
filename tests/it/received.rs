//! Uploads whose files go to the store as they come: the same scenes as of those in memory, and
//! nothing is left of what breaks off.

use std::{io::Write as _, net::TcpStream, path::Path};

use segsplat::{
    error::ErrorCode,
    formats::container::read_scene,
    limits::Limits,
    photos,
    scene::{KeptFile, SceneId, Upload, UploadFile},
    store::{Store, StoreLocation},
};
use segsplat_testing::captures::{self, zipped};

use crate::common::{
    client,
    doors::{Options, both, bytes, form},
    process::eventually,
    root,
    server::{TestServer, upload},
};

/// A server that keeps next to nothing of an upload in memory.
async fn apart() -> TestServer {
    TestServer::with(|config, _| config.limits.upload_memory_bytes_max = 1_000).await
}

fn archive() -> Upload {
    let posed = photos::read(&upload(), &Limits::default()).unwrap();
    let files = captures::write("colmap_bin", &posed, &upload().photos);
    Upload { archive: Some(zipped(&files, "")), ..Upload::default() }
}

fn splats() -> Upload {
    let bytes = std::fs::read(root().join("tests/fixtures/splats/source.ply")).unwrap();
    let splats = Some(UploadFile { name: "source.ply".to_owned(), bytes });
    Upload { splats, ..Upload::default() }
}

/// Names of what is kept of a scene, those of files that came one by one.
fn files(server: &TestServer, id: &str) -> Vec<String> {
    let folder = std::fs::read_dir(server.data_dir().join("scenes").join(id));
    let names = folder.into_iter().flatten();
    let names = names.map(|file| file.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<String> = names.filter(|name| name.starts_with("upload-")).collect();
    names.sort();
    names
}

fn folders(data: &Path) -> usize {
    std::fs::read_dir(data.join("scenes")).into_iter().flatten().count()
}

#[tokio::test(flavor = "multi_thread")]
async fn files_that_go_to_the_store_as_they_come_make_the_same_scenes() {
    let (whole, apart) = (TestServer::start().await, apart().await);
    for (sent, count) in [(upload(), 3), (archive(), 1), (splats(), 1)] {
        let mut contents = Vec::new();
        for server in [&whole, &apart] {
            for door in both(server.addr).await {
                let (id, state) = door.create(&sent, &Options::wait()).await.unwrap();
                assert_eq!(state, "done", "{}", door.name());
                let file = server.data_dir().join("scenes").join(&id).join("scene.segsplat");
                let file = std::fs::read(file).unwrap();
                contents.push(read_scene(&file).unwrap().0.meta.provenance);
                let named: Vec<String> = match std::ptr::eq(server, &whole) {
                    true => Vec::new(),
                    false => (0..count).map(|i| format!("upload-{i:05}")).collect(),
                };
                assert_eq!(files(server, &id), named, "{}", door.name());
            }
        }
        assert!(contents.iter().all(|of| *of == contents[0]), "{contents:?}");
        assert!(!contents[0].files.is_empty());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn they_are_there_after_a_restart_under_their_checksums_and_go_with_the_scene() {
    let server = apart().await;
    let door = &both(server.addr).await[0];
    let key = Options { idempotency_key: Some("one".to_owned()), ..Options::wait() };
    let (id, _) = door.create(&upload(), &key).await.unwrap();
    let again = door.create(&upload(), &key).await.unwrap();
    assert_eq!(again.0, id, "the same photos with the same key");
    eventually("what came twice goes", async || (folders(server.data_dir()) == 1).then_some(()))
        .await;
    let (of_zip, _) = door.create(&archive(), &Options::wait()).await.unwrap();
    let server = server.restart().await;
    for id in [&id, &of_zip] {
        let url = server.url(&format!("/v1/scenes/{id}/export?format=nerfstudio"));
        let zip = bytes(client().get(url).send().await.unwrap()).await.unwrap();
        let names = zip::ZipArchive::new(std::io::Cursor::new(zip)).unwrap();
        assert!(names.len() > 3, "its photos are in the folder");
    }
    let data = server.data_dir().to_owned();
    let folder = server.stop().await;
    let of = |id: &str, name: &str| data.join("scenes").join(id).join(name);
    for (id, name) in [(&id, "upload-00001"), (&of_zip, "upload-00000")] {
        let mut file = std::fs::read(of(id, name)).unwrap();
        let middle = file.len() / 2;
        file[middle] ^= 1;
        std::fs::write(of(id, name), file).unwrap();
    }
    let place = StoreLocation::Folder(data.clone());
    let (store, _) = Store::open(&place, &Limits::default()).unwrap();
    let read = |id: &str, i: usize, from: u64| {
        let upload = store.upload(&id.parse::<SceneId>().unwrap()).unwrap();
        let file: &KeptFile = upload.kept().nth(i).unwrap();
        file.bytes.read(from, file.size - from).map_err(|e| e.code())
    };
    assert!(read(&id, 0, 0).is_ok() && read(&id, 2, 0).is_ok());
    assert_eq!(read(&id, 1, 0), Err(ErrorCode::SceneCorrupt));
    assert_eq!(read(&of_zip, 0, 9), Err(ErrorCode::SceneCorrupt), "also of a part");
    std::fs::remove_file(of(&id, "upload-00002")).unwrap();
    assert_eq!(read(&id, 2, 0), Err(ErrorCode::SceneCorrupt), "and of one that is gone");
    // Files whose list a kill kept from being put.
    std::fs::remove_file(of(&id, "upload.segsplat")).unwrap();
    std::fs::write(of(&of_zip, "added-0000000000001-ab-00000"), "x").unwrap();
    assert_eq!(store.sweep(std::time::Duration::ZERO).unwrap(), 3);
    assert!(of(&id, "scene.segsplat").exists() && of(&of_zip, "upload-00000").exists());
    drop((store, folder));
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_is_left_of_an_upload_that_breaks_off_is_refused_or_deleted() {
    let server = TestServer::with(|config, _| {
        config.limits.upload_memory_bytes_max = 1_000;
        config.limits.upload_file_bytes_max = 30_000;
    })
    .await;
    let data = server.data_dir().to_owned();
    let nothing = async |why: &str| {
        eventually(why, async || (folders(&data) == 0).then_some(())).await;
    };
    // A caller that goes away in the middle of a photo.
    let mut caller = TcpStream::connect(server.addr).unwrap();
    let head = "POST /v1/scenes HTTP/1.1\r\nhost: x\r\ncontent-length: 90000\r\n\
                content-type: multipart/form-data; boundary=b\r\n\r\n\
                --b\r\ncontent-disposition: form-data; name=\"photo\"; filename=\"a.png\"\r\n\r\n";
    caller.write_all(head.as_bytes()).unwrap();
    caller.write_all(&[7; 20_000]).unwrap();
    caller.flush().unwrap();
    tokio::time::sleep(std::time::Duration::from_millis(200)).await;
    drop(caller);
    nothing("it broke off").await;
    let mut large = upload();
    large.photos[1].bytes.resize(30_001, 0);
    let sent = client().post(server.url("/v1/scenes")).multipart(form(&large));
    let fault = bytes(sent.send().await.unwrap()).await.unwrap_err();
    assert_eq!(fault.code, "limit_exceeded");
    assert!(fault.message.contains("30000 bytes"), "{fault:?}");
    nothing("it is too large").await;
    let mut torn = upload();
    torn.photos[1].bytes.truncate(60);
    let fault = both(server.addr).await[1].create(&torn, &Options::wait()).await.unwrap_err();
    assert_eq!(fault.code, "photo_unreadable");
    nothing("it is no scene").await;
    let (id, _) = both(server.addr).await[1].create(&upload(), &Options::wait()).await.unwrap();
    assert_eq!(folders(&data), 1);
    server.service.delete(&id.parse().unwrap()).await.unwrap();
    nothing("it is deleted").await;
}
