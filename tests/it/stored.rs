//! What is kept on the disk, from version to version: this program reads what the last released
//! format holds, and writes what a program of that format reads.
//!
//! `tests/fixtures/stored/0.1.0` is the data folder of `segsplat serve` with the bundle `colours`
//! after a scene of two photos, made with an idempotency key, and one text.

use std::{fs, path::Path};

use segsplat::{
    formats::container::{write_scene, write_semantics},
    limits::Limits,
    scene::{SceneId, SceneState, SceneStatus},
    store::{Record, Store, StoreLocation},
};
use serde_json::Value;

use crate::{
    common::{
        root,
        server::{TestServer, upload},
    },
    store::reheaded,
};

const KEPT: &str = "tests/fixtures/stored/0.1.0";

fn copied(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let (path, to) = {
            let entry = entry.unwrap();
            (entry.path(), to.join(entry.file_name()))
        };
        if path.is_dir() {
            copied(&path, &to);
        } else {
            fs::copy(path, to).unwrap();
        }
    }
}

/// Every file below a folder with its bytes, without the lock.
fn files(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files(&path));
        } else if !path.ends_with("lock") {
            found.push((path.display().to_string(), fs::read(&path).unwrap()));
        }
    }
    found.sort();
    found
}

/// A copy of the folder, opened; the one scene in it.
fn opened(folder: &Path) -> (Store, Record, SceneId) {
    copied(&root().join(KEPT), folder);
    let (store, mut records) =
        Store::open(&StoreLocation::Folder(folder.to_owned()), &Limits::default())
            .expect("the folder is whole");
    assert_eq!(records.len(), 1);
    let record = records.remove(0);
    let id = record.status.id.clone();
    (store, record, id)
}

#[test]
fn what_the_released_format_holds_is_read_to_the_last_file() {
    let folder = tempfile::tempdir().unwrap();
    let (store, record, id) = opened(folder.path());
    let before = files(folder.path());
    assert_eq!(record.status.state, SceneState::Done);
    assert_eq!(record.idempotency_key.as_deref(), Some("first"));
    let scene = store.scene(&id).expect("the scene");
    assert_eq!(Some(&scene.sha256), record.scene_sha256.as_ref());
    assert!(scene.gaussians.len() > 100, "{} Gaussians", scene.gaussians.len());
    assert_eq!(scene.meta.cameras.len(), 2);
    let semantics = scene.semantics.as_ref().expect("its semantics");
    assert_eq!(Some(&scene.semantics_sha256), record.semantics_sha256.as_ref());
    assert_eq!(semantics.index.len(), scene.gaussians.len());
    assert_eq!(store.upload(&id).expect("the upload").photos.len(), 2);
    assert!(files(folder.path()) == before, "reading changed a file");
}

#[tokio::test]
async fn a_scene_of_the_released_format_is_served() {
    let folder = tempfile::tempdir().unwrap();
    copied(&root().join(KEPT), folder.path());
    let server = TestServer::at(&StoreLocation::Folder(folder.path().to_owned()), |_, _| {}).await;
    let list: Value = crate::common::client()
        .get(server.url("/v1/scenes"))
        .send()
        .await
        .unwrap()
        .json()
        .await
        .unwrap();
    let id = list["scenes"][0]["id"].as_str().expect("it is listed");
    let view = server.url(&format!("/v1/scenes/{id}/view?from=0&width=64&height=48"));
    assert_eq!(crate::common::client().get(view).send().await.unwrap().status(), 200);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scene_that_is_not_made_waits_for_the_version_that_reads_its_photos() {
    let folder = tempfile::tempdir().unwrap();
    let place = StoreLocation::Folder(folder.path().to_owned());
    let (store, _) = Store::open(&place, &Limits::default()).unwrap();
    let id = SceneId::from_bytes([7; 16]);
    let queued = Record::new(SceneStatus::new(id.clone(), SceneState::Queued, 1));
    store.put_upload(upload(), &queued).unwrap();
    drop(store);
    let file = folder.path().join("scenes").join(id.as_str()).join("upload.segsplat");
    let ours = fs::read(&file).unwrap();
    let other = reheaded(&ours, |header| header["__metadata__"]["version"] = "3".into());
    fs::write(&file, &other).unwrap();
    // Oftener than a job may be begun.
    for _ in 0..4 {
        let server = TestServer::at(&place, |_, _| {}).await;
        let status = server.finished(&id).await;
        let error = status.error.expect("why it is not made");
        assert_eq!((status.state, error.code.as_str()), (SceneState::Failed, "other_version"));
        assert!(error.message.contains("segsplat-upload version 3"), "{error:?}");
        server.stop().await;
        assert!(fs::read(&file).unwrap() == other, "its photos are left as they are");
    }
    fs::write(&file, ours).unwrap();
    let server = TestServer::at(&place, |_, _| {}).await;
    assert_eq!(server.finished(&id).await.state, SceneState::Done);
    server.stop().await;
}

/// What `old` has and `new` has not, or has in another form.
fn lacks(old: &Value, new: &Value, place: &str) -> Vec<String> {
    match (old, new) {
        (Value::Object(old), Value::Object(new)) => {
            let of = |(key, value): (&String, &Value)| match new.get(key) {
                Some(new) => lacks(value, new, &format!("{place}/{key}")),
                None => vec![format!("{place}/{key} is gone")],
            };
            old.iter().flat_map(of).collect()
        }
        (Value::Array(old), Value::Array(new)) => {
            let pairs = old.iter().zip(new).take(1);
            pairs.flat_map(|(old, new)| lacks(old, new, &format!("{place}[]"))).collect()
        }
        (Value::Null, _) => Vec::new(),
        _ if std::mem::discriminant(old) == std::mem::discriminant(new) => Vec::new(),
        _ => vec![format!("{place} was {old} and is {new}")],
    }
}

/// The header of a container, with its JSON read.
fn header(file: &[u8]) -> Value {
    let end = 8 + u64::from_le_bytes(file[..8].try_into().unwrap()) as usize;
    let mut header: Value = serde_json::from_slice(&file[8..end]).unwrap();
    let json = header["__metadata__"]["json"].as_str().unwrap().to_owned();
    header["__metadata__"]["json"] = serde_json::from_str(&json).unwrap();
    header
}

fn record_of(status: &[u8]) -> Value {
    let sealed: Value = serde_json::from_slice(status).unwrap();
    serde_json::from_str(sealed["record"].as_str().unwrap()).unwrap()
}

#[test]
fn what_is_written_now_has_all_that_a_program_of_the_released_format_reads() {
    let folder = tempfile::tempdir().unwrap();
    let (store, record, id) = opened(folder.path());
    let scene = store.scene(&id).unwrap();
    let (mut of_scene, mut of_semantics) = (Vec::new(), Vec::new());
    write_scene(&mut of_scene, &scene).unwrap();
    write_semantics(&mut of_semantics, &id, scene.semantics.as_ref().unwrap()).unwrap();
    store.put_upload(store.upload(&id).unwrap(), &record).unwrap();
    store.put_record(&record).unwrap();
    let path = |root: &Path, name: &str| root.join("scenes").join(id.as_str()).join(name);
    let [old, new] = [root().join(KEPT), folder.path().to_owned()];
    let read = |root: &Path, name: &str| fs::read(path(root, name)).unwrap();
    let containers = [
        ("scene.segsplat", of_scene),
        ("semantics.segsplat", of_semantics),
        ("upload.segsplat", read(&new, "upload.segsplat")),
    ];
    let mut faults = Vec::new();
    for (name, now) in containers {
        let (then, now) = (header(&read(&old, name)), header(&now));
        for word in ["kind", "version"] {
            assert_eq!(now["__metadata__"][word], then["__metadata__"][word], "{name}");
        }
        for (array, told) in then.as_object().unwrap().iter().filter(|(a, _)| *a != "__metadata__")
        {
            assert_eq!(now[array]["dtype"], told["dtype"], "{name}: {array}");
        }
        faults.extend(lacks(&then, &now, name));
    }
    let [then, now] = [&old, &new].map(|root| record_of(&read(root, "status.json")));
    faults.extend(lacks(&then, &now, "status.json"));
    assert!(faults.is_empty(), "{}", faults.join("\n"));
}
