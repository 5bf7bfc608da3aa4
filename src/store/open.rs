//! Opening a data folder: one process only, rubbish cleared, every scene accounted for.

use std::path::Path;

use fs_err as fs;

use super::{
    Cache, QUARANTINED, Record, SCENE, SEMANTICS, STATUS, Store, UPLOAD, files::unavailable,
    quarantine, record, scene_file, upload_file, write_record,
};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{SceneError, SceneId, SceneState, SceneStatus},
};

impl Store {
    /// Opens a folder, made where missing, and gives the record of every scene in it.
    ///
    /// A scene whose status is bad gets it back from its scene file or its upload; one that has
    /// neither is reported as failed with `scene_corrupt`.
    ///
    /// # Errors
    /// `store_unavailable` when the folder cannot be used or another process uses it.
    pub fn open(root: &Path, cache_bytes_max: u64) -> Result<(Self, Vec<Record>)> {
        let prepare = || -> std::io::Result<fs::File> {
            for folder in ["scenes", "incoming", "trash"] {
                fs::create_dir_all(root.join(folder))?;
            }
            fs::OpenOptions::new().create(true).truncate(false).write(true).open(root.join("lock"))
        };
        let lock = prepare().map_err(|cause| unavailable("open the data folder", cause))?;
        lock.file().try_lock().map_err(|cause| {
            Error::new(ErrorCode::StoreUnavailable, "another process uses the data folder")
                .caused_by(cause)
        })?;
        let store = Self {
            root: root.to_owned(),
            cache: Cache::new(cache_bytes_max),
            reading: std::sync::Mutex::default(),
            _lock: lock,
        };
        let records = store.recover().map_err(|cause| unavailable("read its folder", cause))?;
        Ok((store, records))
    }

    fn recover(&self) -> std::io::Result<Vec<Record>> {
        for rubbish in ["incoming", "trash"] {
            for entry in fs::read_dir(self.root.join(rubbish))? {
                let path = entry?.path();
                if let Err(error) = fs::remove_dir_all(&path) {
                    tracing::warn!(%error, "a left-over folder cannot be removed");
                }
            }
        }
        let mut records = Vec::new();
        for entry in fs::read_dir(self.root.join("scenes"))? {
            let entry = entry?;
            let id = entry.file_name().to_str().and_then(|name| name.parse::<SceneId>().ok());
            let Some(id) = id else {
                tracing::warn!("the data folder holds something that is no scene; left alone");
                continue;
            };
            records.push(recover_record(&entry.path(), &id));
        }
        Ok(records)
    }
}

/// The record of the scene in `folder`, from whatever of it is sound.
fn recover_record(folder: &Path, id: &SceneId) -> Record {
    clear_temporary(folder);
    let status = fs::read(folder.join(STATUS)).map_err(|e| unavailable("read a status", e));
    let error = match status.and_then(|file| record::unseal(&file)) {
        Ok(record) if record.status.id == *id => return record,
        Ok(_) => Error::new(ErrorCode::SceneCorrupt, "the scene's status is another scene's"),
        Err(error) => error,
    };
    tracing::error!(scene = %id, error = %error, "a scene's status is bad; rebuilding it");
    let record = from_scene(folder, id).or_else(|| from_upload(folder, id)).unwrap_or_else(|| {
        let now = super::now_ms();
        Record {
            status: SceneStatus {
                error: Some(SceneError::from(&error)),
                ..SceneStatus::new(id.clone(), SceneState::Failed, now)
            },
            owner: None,
            options: crate::scene::SceneOptions::default(),
            idempotency_key: None,
            request_sha256: String::new(),
            attempts: 0,
            scene_sha256: None,
            semantics_sha256: None,
        }
    });
    if folder.join(STATUS).exists() {
        quarantine(&folder.join(STATUS));
    }
    if let Err(error) = write_record(folder, &record) {
        tracing::error!(scene = %id, %error, "the rebuilt status cannot be written");
    }
    record
}

fn from_scene(folder: &Path, id: &SceneId) -> Option<Record> {
    let (scene, sha256) = scene_file::read_scene(&fs::read(folder.join(SCENE)).ok()?).ok()?;
    let meta = scene.meta;
    if meta.id != *id {
        return None;
    }
    Some(Record {
        status: SceneStatus {
            fraction: 1.0,
            report: Some(meta.report),
            cameras: meta.cameras,
            ..SceneStatus::new(id.clone(), SceneState::Done, meta.created_ms)
        },
        // Without the upload nobody but an admin sees it: better than the wrong owner.
        owner: first_record(folder, id).and_then(|record| record.owner),
        options: meta.provenance.options,
        idempotency_key: None,
        request_sha256: String::new(),
        attempts: 1,
        scene_sha256: Some(sha256),
        semantics_sha256: None,
    })
}

fn from_upload(folder: &Path, id: &SceneId) -> Option<Record> {
    if folder.join(SCENE).with_extension(QUARANTINED).exists() {
        return None;
    }
    first_record(folder, id)
}

/// The record that the upload was kept with.
fn first_record(folder: &Path, id: &SceneId) -> Option<Record> {
    let (_, record) = upload_file::read(&fs::read(folder.join(UPLOAD)).ok()?).ok()?;
    (record.status.id == *id).then_some(record)
}

/// A write that a crash cut off.
fn clear_temporary(folder: &Path) {
    for name in [UPLOAD, STATUS, SCENE, SEMANTICS] {
        // Absent is the rule.
        let _ = fs::remove_file(folder.join(name).with_extension(super::files::TEMPORARY));
    }
}
