//! Scenes kept and in memory: uploads and statuses in, scenes out, nothing acknowledged lost.
//!
//! ```text
//! scenes/ID/upload.segsplat     photos and cameras as sent, with the first record
//! scenes/ID/scene.segsplat      the finished scene
//! scenes/ID/semantics.segsplat  what it means, once somebody has asked
//! scenes/ID/status.json         the record of what is over: done or failed
//! scenes/ID/*.quarantined       an object that failed its checksum
//! pending/ID                    the record of what is not over; gone once there is a status
//! keys/HASH  contents/HASH      scene of an idempotency key, and of a content hash
//! replicas/R claims/ID.R deleted/ID   only where replicas share the store: see `shared`
//! ```
//!
//! An object is there whole or not at all, and every byte read is under a checksum. A scene exists
//! while it has a status or a pending record; what has neither is rubbish that a sweep removes.
//! A bad object is put aside, and the start goes on.

mod container;
mod files;
mod hashes;
mod index;
mod objects;
mod open;
pub mod ply;
mod record;
mod scene_file;
mod semantics_file;
mod shared;
mod sweep;
mod upload_file;

use std::{
    collections::HashMap,
    path::Path,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Instant,
};

use fs_err as fs;
use object_store::path::Path as Name;

pub(crate) use self::hashes::is_of_request;
use self::objects::{Objects, unavailable};
pub use self::{
    hashes::{provenance, request_sha256},
    index::KeyUse,
    open::Place,
    record::Record,
    scene_file::{read_scene, write_scene},
    semantics_file::{read_semantics, write_semantics},
    shared::Beat,
    upload_file::hashes,
};
use crate::{
    cache::Cache,
    error::{Error, ErrorCode, Result},
    scene::{Scene, SceneId, Semantics, Upload},
};

const UPLOAD: &str = "upload.segsplat";
const STATUS: &str = "status.json";
const SCENE: &str = "scene.segsplat";
const SEMANTICS: &str = "semantics.segsplat";
const QUARANTINED: &str = "quarantined";

/// The scenes of one folder or bucket. Calls block on it; all are safe from any thread.
#[derive(Debug)]
pub struct Store {
    objects: Objects,
    /// Whether other processes use the same objects.
    shared: bool,
    /// Finished scenes, by the bytes of their arrays.
    cache: Cache<SceneId, Arc<Scene>>,
    /// One lock a scene being read, so that many callers read it once.
    reading: Mutex<HashMap<SceneId, Arc<Mutex<()>>>>,
    /// Scenes deleted here: what a job still writes of one is removed again.
    gone: Mutex<HashMap<SceneId, Instant>>,
    /// Dropped with the store: another process may then use the folder.
    _lock: Option<fs::File>,
}

fn of(id: &SceneId, name: &str) -> Name {
    Name::from(format!("scenes/{id}/{name}"))
}

fn pending(id: &SceneId) -> Name {
    Name::from(format!("pending/{id}"))
}

fn aside(name: &str) -> String {
    let stem = name.rsplit_once('.').map_or(name, |(stem, _)| stem);
    format!("{stem}.{QUARANTINED}")
}

impl Store {
    /// Whether other processes use the same scenes.
    #[must_use]
    pub fn is_shared(&self) -> bool {
        self.shared
    }

    /// Bytes of scenes in memory.
    #[must_use]
    pub fn cached_bytes(&self) -> u64 {
        self.cache.weight()
    }

    /// Keeps the first record of a scene, before anything else of it.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn announce(&self, record: &Record) -> Result<()> {
        self.put_sealed(pending(&record.status.id), record)
    }

    /// Keeps an upload and its first record: all of it or nothing, safe on return.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn put_upload(&self, upload: Upload, record: &Record) -> Result<()> {
        let id = &record.status.id;
        let keep = || -> Result<()> {
            let file = upload_file::pack(upload, record)
                .map_err(|e| Error::internal("the upload cannot be packed").caused_by(e))?;
            // The record first: an upload without one is rubbish, however the call ends.
            self.announce(record)?;
            self.objects.put(of(id, UPLOAD), file).map_err(|e| unavailable("keep the upload", e))
        };
        keep().inspect_err(|_| {
            // What cannot be removed now is removed at the next start.
            let _ = self.objects.delete(pending(id));
            let _ = self.objects.delete(of(id, UPLOAD));
        })
    }

    /// The upload of a scene.
    ///
    /// # Errors
    /// `scene_not_found` when it is not kept, `scene_corrupt`, `store_unavailable`.
    pub fn upload(&self, id: &SceneId) -> Result<Upload> {
        let file = self.get(id, UPLOAD, "read the upload")?.ok_or_else(|| not_found(id))?;
        Ok(upload_file::read(&file)?.0)
    }

    /// Forgets photos and cameras of a scene; what needs them can then not be made.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn drop_upload(&self, id: &SceneId) -> Result<()> {
        let deleted = self.objects.delete(of(id, UPLOAD));
        deleted.map(drop).map_err(|e| unavailable("forget the photos", e))
    }

    /// Keeps a newer record.
    ///
    /// # Errors
    /// `store_unavailable`; `scene_not_found` when the scene was deleted.
    pub fn put_record(&self, record: &Record) -> Result<()> {
        let id = &record.status.id;
        if record.status.state.is_final() {
            self.put_sealed(of(id, STATUS), record)?;
            self.unless_deleted(id)?;
            self.end_pending(id)
        } else {
            self.put_sealed(pending(id), record)?;
            self.unless_deleted(id)
        }
    }

    fn put_sealed(&self, path: Name, record: &Record) -> Result<()> {
        let sealed = record::seal(record)
            .map_err(|e| Error::internal("the scene's status cannot be written").caused_by(e))?;
        self.objects.put(path, sealed).map_err(|e| unavailable("keep the scene's status", e))
    }

    /// Keeps a finished scene, also in memory; gives it and the sha256 of its file, hex.
    ///
    /// Where another replica was faster, its file stays and is the scene.
    ///
    /// # Errors
    /// `store_unavailable`; `scene_not_found` when the scene was deleted.
    pub fn put_scene(&self, scene: Scene) -> Result<(Arc<Scene>, String)> {
        let id = scene.meta.id.clone();
        let mut file = Vec::with_capacity(scene.gaussians.size_bytes() as usize + (64 << 10));
        let mut digest = write_scene(&mut file, &scene)
            .map_err(|e| Error::internal("the scene cannot be packed").caused_by(e))?;
        let mut scene = Arc::new(scene);
        let failed = |e| unavailable("keep the scene", e);
        if !self.shared {
            self.objects.put(of(&id, SCENE), file).map_err(failed)?;
        } else if !self.objects.create(of(&id, SCENE), file.clone()).map_err(failed)? {
            match self.get(&id, SCENE, "read the scene")?.map(|theirs| read_scene(&theirs)) {
                Some(Ok((theirs, sha256))) if theirs.meta.id == id => {
                    (scene, digest) = (Arc::new(theirs), sha256);
                }
                _ => self.objects.put(of(&id, SCENE), file).map_err(failed)?,
            }
        }
        self.unless_deleted(&id)?;
        self.keep(Arc::clone(&scene));
        Ok((scene, digest))
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
        let semantics = Arc::new(semantics);
        let scene = Arc::new(self.scene(id)?.with_semantics(Arc::clone(&semantics))?);
        let mut file = Vec::new();
        let digest = write_semantics(&mut file, id, &semantics)
            .map_err(|e| Error::internal("the semantics cannot be packed").caused_by(e))?;
        let kept = self.objects.put(of(id, SEMANTICS), file);
        kept.map_err(|e| unavailable("keep the scene's semantics", e))?;
        self.unless_deleted(id)?;
        self.keep(Arc::clone(&scene));
        Ok((scene, digest))
    }

    /// A finished scene, from memory or the store, with its semantics where they were made; every
    /// byte read is checked. Bad semantics are put aside: the scene is whole without them.
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

    /// sha256 of a scene's file as it is kept, hex; `None` where there is none that is sound.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn scene_digest(&self, id: &SceneId) -> Result<Option<String>> {
        let file = self.get(id, SCENE, "read the scene")?;
        Ok(file.and_then(|file| read_scene(&file).ok()).map(|(_, sha256)| sha256))
    }

    fn keep(&self, scene: Arc<Scene>) {
        let size = scene.size_bytes();
        self.cache.insert(scene.meta.id.clone(), scene, size);
    }

    /// Forgets the copy of a scene in memory: the next call reads what the store has.
    pub fn forget(&self, id: &SceneId) {
        self.cache.remove(id);
    }

    fn read_scene(&self, id: &SceneId) -> Result<Arc<Scene>> {
        let Some(file) = self.get(id, SCENE, "read the scene")? else {
            let put_aside = self.objects.exists(of(id, &aside(SCENE)));
            return Err(if put_aside.map_err(|e| unavailable("read the scene", e))? {
                Error::new(
                    ErrorCode::SceneCorrupt,
                    format!("scene {id} failed its checksum and was put aside"),
                )
            } else {
                not_found(id)
            });
        };
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
                self.keep(Arc::clone(&scene));
                Ok(scene)
            }
            Err(error) => {
                tracing::error!(scene = %id, error = %error, "a scene file is put aside");
                self.quarantine(id, SCENE);
                Err(error)
            }
        }
    }

    /// The scene with the semantics that are kept beside it, if any are and they are sound.
    fn with_its_semantics(&self, scene: Scene) -> Result<Scene> {
        let id = scene.meta.id.clone();
        let Some(file) = self.get(&id, SEMANTICS, "read the scene's semantics")? else {
            return Ok(scene);
        };
        let checked = read_semantics(&file, &id)
            .and_then(|(semantics, _)| scene.with_semantics(Arc::new(semantics)));
        checked.or_else(|error| {
            tracing::error!(scene = %id, %error, "semantics are put aside, to be made again");
            self.quarantine(&id, SEMANTICS);
            Ok(scene)
        })
    }

    /// Forgets what a scene means, as when the networks that said so are no longer loaded.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn drop_semantics(&self, id: &SceneId) -> Result<()> {
        self.cache.remove(id);
        let deleted = self.objects.delete(of(id, SEMANTICS));
        deleted.map(drop).map_err(|e| unavailable("forget the scene's semantics", e))
    }

    /// Removes everything of a scene; gone is gone at once, even if power fails.
    ///
    /// # Errors
    /// `scene_not_found`, `store_unavailable`: it may then be there still, whole.
    pub fn remove(&self, record: &Record) -> Result<()> {
        let id = &record.status.id;
        let failed = |e| unavailable("delete the scene", e);
        self.lock_gone().insert(id.clone(), Instant::now());
        let unmake = || -> Result<bool> {
            if self.shared {
                self.put_tombstone(id)?;
            }
            // What makes it a scene goes first: the rest is rubbish from then on.
            let status = self.objects.delete(of(id, STATUS)).map_err(failed)?;
            Ok(self.objects.delete(pending(id)).map_err(failed)? || status)
        };
        let was_there = unmake().inspect_err(|_| {
            self.lock_gone().remove(id);
        })?;
        self.cache.remove(id);
        // The next sweep takes what cannot be removed now: the scene is gone all the same.
        if let Err(error) = self.purge(id).and_then(|()| self.unlink(record)) {
            tracing::warn!(scene = %id, %error, "left-overs of a deleted scene stay for a sweep");
        }
        if was_there { Ok(()) } else { Err(not_found(id)) }
    }

    /// Takes back what was just written where the scene has been deleted meanwhile.
    fn unless_deleted(&self, id: &SceneId) -> Result<()> {
        let here = self.lock_gone().contains_key(id);
        let deleted = here || self.shared && self.has_tombstone(id)?;
        if !deleted {
            return Ok(());
        }
        for path in [of(id, STATUS), pending(id)] {
            let deleted = self.objects.delete(path);
            deleted.map_err(|e| unavailable("remove a deleted scene", e))?;
        }
        self.purge(id)?;
        self.cache.remove(id);
        Err(not_found(id))
    }

    /// Removes all objects under a scene's name.
    fn purge(&self, id: &SceneId) -> Result<()> {
        let failed = |e| unavailable("remove a deleted scene", e);
        for object in self.objects.list(&format!("scenes/{id}")).map_err(failed)? {
            self.objects.delete(object.path).map_err(failed)?;
        }
        Ok(())
    }

    /// The scene is over: there is a status.
    fn end_pending(&self, id: &SceneId) -> Result<()> {
        let ended = self.objects.delete(pending(id));
        ended.map(drop).map_err(|e| unavailable("keep the scene's status", e))?;
        if self.shared { self.drop_claims(id) } else { Ok(()) }
    }

    fn get(&self, id: &SceneId, name: &str, what: &str) -> Result<Option<Vec<u8>>> {
        self.objects.get(of(id, name)).map_err(|e| unavailable(what, e))
    }

    fn quarantine(&self, id: &SceneId, name: &str) {
        if let Err(error) = self.objects.rename(of(id, name), of(id, &aside(name))) {
            tracing::error!(scene = %id, %error, "a bad object cannot be put aside");
        }
    }

    fn lock_gone(&self) -> MutexGuard<'_, HashMap<SceneId, Instant>> {
        self.gone.lock().unwrap_or_else(PoisonError::into_inner)
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
    .map_err(|cause| files::unavailable("write the scene file", cause))?;
    Ok(digest)
}

/// Writes what a scene means to any path, whole or not at all; for the command line.
///
/// # Errors
/// `store_unavailable`.
pub fn write_semantics_file(path: &Path, id: &SceneId, semantics: &Semantics) -> Result<()> {
    files::write_atomic(path, |to| write_semantics(to, id, semantics).map(drop))
        .map_err(|cause| files::unavailable("write the semantics file", cause))
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
