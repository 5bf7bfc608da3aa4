//! Scenes on disk and in memory: uploads and statuses in, scenes out, nothing acknowledged lost.
//!
//! ```text
//! DATA_DIR/lock                          held by the one process that uses the folder
//! DATA_DIR/incoming/ID/                  an upload being written; rubbish after a crash
//! DATA_DIR/scenes/ID/upload.segsplat     photos and cameras as sent, with the first record
//! DATA_DIR/scenes/ID/status.json         the newest record, with its checksum
//! DATA_DIR/scenes/ID/scene.segsplat      the finished scene
//! DATA_DIR/scenes/ID/semantics.segsplat  what it means, once somebody has asked
//! DATA_DIR/scenes/ID/*.quarantined       a file that failed its checksum
//! DATA_DIR/trash/ID/                     being deleted; rubbish after a crash
//! ```
//!
//! Files appear by rename, folders too, each after an fsync: a file is there whole or not at all.
//! Every byte read is under a checksum. A bad file is put aside, and the start goes on.

mod cache;
mod container;
mod files;
mod open;
pub mod ply;
mod record;
mod scene_file;
mod semantics_file;
mod upload_file;

use std::{
    collections::HashMap,
    io,
    path::{Path, PathBuf},
    sync::{Arc, Mutex, PoisonError},
};

use fs_err as fs;

use self::{cache::Cache, files::unavailable};
pub use self::{
    record::Record,
    scene_file::{read_scene, write_scene},
    semantics_file::{read_semantics, write_semantics},
    upload_file::hashes,
};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{Scene, SceneId, Semantics, Upload},
};

const UPLOAD: &str = "upload.segsplat";
const STATUS: &str = "status.json";
const SCENE: &str = "scene.segsplat";
const SEMANTICS: &str = "semantics.segsplat";
const QUARANTINED: &str = "quarantined";

/// Scenes of one data folder. Calls block on the disk; all are safe from any thread.
#[derive(Debug)]
pub struct Store {
    root: PathBuf,
    cache: Cache,
    /// One lock a scene being read, so that many callers read it once.
    reading: Mutex<HashMap<SceneId, Arc<Mutex<()>>>>,
    /// Dropped with the store: another process may then use the folder.
    _lock: fs::File,
}

impl Store {
    fn folder(&self, id: &SceneId) -> PathBuf {
        self.root.join("scenes").join(id.as_str())
    }

    /// Bytes of scenes in memory.
    #[must_use]
    pub fn cached_bytes(&self) -> u64 {
        self.cache.size_bytes()
    }

    /// Keeps an upload and its first record: all of it or nothing, safe on disk on return.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn put_upload(&self, upload: &Upload, record: &Record) -> Result<()> {
        let id = &record.status.id;
        let incoming = self.root.join("incoming").join(id.as_str());
        let write = || -> io::Result<()> {
            fs::create_dir(&incoming)?;
            files::write_atomic(&incoming.join(UPLOAD), |to| {
                upload_file::write(to, upload, record)
            })?;
            write_record(&incoming, record)?;
            let folder = self.folder(id);
            fs::rename(&incoming, &folder)?;
            files::sync_parent(&folder)
        };
        write().map_err(|cause| {
            // What is left is cleared at the next start.
            let _ = fs::remove_dir_all(&incoming);
            unavailable("keep the upload", cause)
        })
    }

    /// The upload of a scene.
    ///
    /// # Errors
    /// `scene_not_found` when it is not kept, `scene_corrupt`, `store_unavailable`.
    pub fn upload(&self, id: &SceneId) -> Result<Upload> {
        let file = self.read(id, UPLOAD, "the upload")?;
        Ok(upload_file::read(&file)?.0)
    }

    /// Keeps a newer record.
    ///
    /// # Errors
    /// `store_unavailable`, also when the scene was deleted.
    pub fn put_record(&self, record: &Record) -> Result<()> {
        write_record(&self.folder(&record.status.id), record)
            .map_err(|cause| unavailable("keep the scene's status", cause))
    }

    /// Keeps a finished scene, also in memory; gives the sha256 of its file, hex.
    ///
    /// # Errors
    /// `store_unavailable`, also when the scene was deleted.
    pub fn put_scene(&self, scene: Scene) -> Result<String> {
        let path = self.folder(&scene.meta.id).join(SCENE);
        let mut digest = String::new();
        files::write_atomic(&path, |to| {
            digest = write_scene(to, &scene)?;
            Ok(())
        })
        .map_err(|cause| unavailable("keep the scene", cause))?;
        self.cache.insert(Arc::new(scene));
        Ok(digest)
    }

    /// Keeps what a scene means; gives the scene that carries it and the file's sha256, hex.
    ///
    /// # Errors
    /// As [`Self::scene`]; `scene_corrupt` also when they are of other Gaussians.
    pub fn put_semantics(
        &self,
        id: &SceneId,
        semantics: Semantics,
    ) -> Result<(Arc<Scene>, String)> {
        let scene = Arc::new(self.scene(id)?.with_semantics(Arc::new(semantics))?);
        let mut digest = String::new();
        files::write_atomic(&self.folder(id).join(SEMANTICS), |to| {
            if let Some(semantics) = &scene.semantics {
                digest = write_semantics(to, id, semantics)?;
            }
            Ok(())
        })
        .map_err(|cause| unavailable("keep the scene's semantics", cause))?;
        self.cache.insert(Arc::clone(&scene));
        Ok((scene, digest))
    }

    /// A finished scene, from memory or disk, with its semantics where they were made; every byte
    /// from disk is checked. Bad semantics are put aside: the scene is whole without them.
    ///
    ///
    /// # Errors
    /// `scene_not_found`, `scene_corrupt` (its file is then put aside), `store_unavailable`.
    pub fn scene(&self, id: &SceneId) -> Result<Arc<Scene>> {
        if let Some(scene) = self.cache.find(id) {
            return Ok(scene);
        }
        let lock = Arc::clone(
            self.reading
                .lock()
                .unwrap_or_else(PoisonError::into_inner)
                .entry(id.clone())
                .or_default(),
        );
        let scene = {
            let _one_reader = lock.lock().unwrap_or_else(PoisonError::into_inner);
            match self.cache.find(id) {
                Some(scene) => Ok(scene),
                None => self.read_scene(id),
            }
        };
        self.reading.lock().unwrap_or_else(PoisonError::into_inner).remove(id);
        scene
    }

    fn read_scene(&self, id: &SceneId) -> Result<Arc<Scene>> {
        let folder = self.folder(id);
        if !folder.join(SCENE).exists() && folder.join(SCENE).with_extension(QUARANTINED).exists() {
            return Err(Error::new(
                ErrorCode::SceneCorrupt,
                format!("scene {id} failed its checksum and was put aside"),
            ));
        }
        let file = self.read(id, SCENE, "the scene")?;
        let checked = read_scene(&file).and_then(|(scene, _)| {
            if scene.meta.id == *id {
                Ok(scene)
            } else {
                let other = &scene.meta.id;
                Err(Error::new(
                    ErrorCode::SceneCorrupt,
                    format!("scene {id}: its file holds {other}"),
                ))
            }
        });
        match checked {
            Ok(scene) => {
                let scene = Arc::new(self.with_its_semantics(scene)?);
                self.cache.insert(Arc::clone(&scene));
                Ok(scene)
            }
            Err(error) => {
                tracing::error!(scene = %id, error = %error, "a scene file is put aside");
                quarantine(&folder.join(SCENE));
                Err(error)
            }
        }
    }

    /// The scene with the semantics that are kept beside it, if any are and they are sound.
    fn with_its_semantics(&self, scene: Scene) -> Result<Scene> {
        let id = scene.meta.id.clone();
        let path = self.folder(&id).join(SEMANTICS);
        let file = match fs::read(&path) {
            Ok(file) => file,
            Err(cause) if cause.kind() == io::ErrorKind::NotFound => return Ok(scene),
            Err(cause) => return Err(unavailable("read the scene's semantics", cause)),
        };
        let checked = read_semantics(&file, &id)
            .and_then(|(semantics, _)| scene.with_semantics(Arc::new(semantics)));
        checked.or_else(|error| {
            tracing::error!(scene = %id, %error, "semantics are put aside, to be made again");
            quarantine(&path);
            Ok(scene)
        })
    }

    /// Forgets what a scene means, as when the networks that said so are no longer loaded.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn drop_semantics(&self, id: &SceneId) -> Result<()> {
        self.cache.remove(id);
        let path = self.folder(id).join(SEMANTICS);
        match fs::remove_file(&path).and_then(|()| files::sync_parent(&path)) {
            Err(cause) if cause.kind() != io::ErrorKind::NotFound => {
                Err(unavailable("forget the scene's semantics", cause))
            }
            _ => Ok(()),
        }
    }

    /// Removes everything of a scene; gone is gone at once, even if power fails.
    ///
    /// # Errors
    /// `scene_not_found`, `store_unavailable`.
    pub fn remove(&self, id: &SceneId) -> Result<()> {
        let folder = self.folder(id);
        let trash = self.root.join("trash").join(id.as_str());
        match fs::rename(&folder, &trash) {
            Ok(()) => {}
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Err(not_found(id)),
            Err(cause) => return Err(unavailable("delete the scene", cause)),
        }
        self.cache.remove(id);
        files::sync_parent(&folder)
            .and_then(|()| fs::remove_dir_all(&trash))
            .map_err(|cause| unavailable("delete the scene", cause))
    }

    fn read(&self, id: &SceneId, name: &str, what: &str) -> Result<Vec<u8>> {
        fs::read(self.folder(id).join(name)).map_err(|cause| match cause.kind() {
            io::ErrorKind::NotFound => not_found(id),
            _ => unavailable(&format!("read {what}"), cause),
        })
    }
}

/// Writes a scene container to any path, whole or not at all; for the command line.
///
/// # Errors
/// `store_unavailable`.
pub fn write_scene_file(path: &Path, scene: &Scene) -> Result<String> {
    let mut digest = String::new();
    files::write_atomic(path, |to| {
        digest = write_scene(to, scene)?;
        Ok(())
    })
    .map_err(|cause| unavailable("write the scene file", cause))?;
    Ok(digest)
}

/// Writes what a scene means to any path, whole or not at all; for the command line.
///
/// # Errors
/// `store_unavailable`.
pub fn write_semantics_file(path: &Path, id: &SceneId, semantics: &Semantics) -> Result<()> {
    files::write_atomic(path, |to| write_semantics(to, id, semantics).map(drop))
        .map_err(|cause| unavailable("write the semantics file", cause))
}

fn write_record(folder: &Path, record: &Record) -> io::Result<()> {
    let sealed = record::seal(record)?;
    files::write_atomic(&folder.join(STATUS), |to| to.write_all(&sealed))
}

fn quarantine(path: &Path) {
    let aside = path.with_extension(QUARANTINED);
    if let Err(error) = fs::rename(path, &aside).and_then(|()| files::sync_parent(path)) {
        tracing::error!(%error, "a bad file cannot be put aside");
    }
}

/// Milliseconds since 1970.
#[must_use]
pub fn now_ms() -> u64 {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    now.map_or(0, |since| u64::try_from(since.as_millis()).unwrap_or(u64::MAX))
}

/// No scene of this id.
#[must_use]
pub fn not_found(id: &SceneId) -> Error {
    Error::new(ErrorCode::SceneNotFound, format!("no scene has the id {id}"))
}
