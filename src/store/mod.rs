//! Scenes kept and in memory: uploads and statuses in, scenes out, nothing acknowledged lost.
//!
//! ```text
//! scenes/ID/upload.segsplat     photos and cameras as sent, with the first record
//! scenes/ID/added-*.segsplat    photos that joined it later, with the record before they did
//! scenes/ID/upload-* added-*-*  files of these two that went to the store as they came
//! scenes/ID/scene.segsplat      the finished scene
//! scenes/ID/semantics.segsplat  its semantics, once a text needed them
//! scenes/ID/edits.json          its list of edits, once there was one
//! scenes/ID/scale.json          metres of a unit of it, where a call said them
//! scenes/ID/status.json         the record of what is over: done or failed
//! scenes/ID/*.quarantined       an object that failed its checksum
//! pending/ID                    the record of what is not over; gone soon after there is a status
//! keys/HASH  contents/HASH      scene of an idempotency key, and of a content hash
//! replicas/R claims/ID.R growing/ID deleted/ID   only where replicas share the store: see `shared`
//! probe/ID                      for a moment: whether a store that kept nothing does again
//! ```
//!
//! An object is there whole or not at all, and every byte read is under a checksum. A scene exists
//! while it has a status or a pending record; a sweep removes objects of scenes that have neither.
//! A bad object is put aside, and the start goes on.

mod added;
mod edits;
mod files;
mod hashes;
mod index;
mod objects;
mod open;
mod received;
mod record;
mod shared;
mod sweep;
mod upload_file;

use std::{
    collections::{HashMap, HashSet},
    path::Path,
    sync::Arc,
    time::Instant,
};

use fs_err as fs;
use object_store::path::Path as Name;
use parking_lot::Mutex;

pub(crate) use self::hashes::is_of_request;
use self::objects::Objects;
pub(crate) use self::received::Receiving;
pub use self::{
    files::sha256,
    hashes::{provenance, request_sha256},
    index::KeyUse,
    open::StoreLocation,
    record::{AddedPhotos, Growth, PhotoChange, Record, RefineOrder},
    upload_file::hashes,
};
use crate::{
    cache::Cache,
    error::{Error, ErrorCode, Result},
    formats::container::{read_scene, read_semantics, write_scene, write_semantics},
    scene::{Scene, SceneId, Semantics, Upload},
};

/// Name of the object with the upload that a scene is made of.
pub(crate) const UPLOAD: &str = "upload.segsplat";
const STATUS: &str = "status.json";
const EDITS: &str = "edits.json";
const SCALE: &str = "scale.json";
const SCENE: &str = "scene.segsplat";
const SEMANTICS: &str = "semantics.segsplat";
const PROBE: &str = "probe";
const QUARANTINED: &str = "quarantined";

/// The scenes of one folder or bucket. Calls block on it; all are safe from any thread.
#[derive(Debug)]
pub struct Store {
    objects: Arc<Objects>,
    /// Whether other processes use the same objects.
    shared: bool,
    /// Finished scenes, by the bytes of their arrays.
    cache: Cache<SceneId, Arc<Scene>>,
    /// One lock a scene that is read or put: many callers read it once, and none brings back into
    /// memory what was replaced while it read.
    turns: Mutex<HashMap<SceneId, Arc<Mutex<()>>>>,
    /// Scenes whose upload and first record are being written: a sweep leaves them alone.
    arriving: Mutex<HashSet<SceneId>>,
    /// Lists of the files of uploads that are being received: a sweep leaves these alone.
    receiving: Mutex<HashSet<Name>>,
    /// Scenes deleted here: what a job still writes of one is removed again.
    gone: Mutex<HashMap<SceneId, Instant>>,
    /// What is put and removed to see whether things are kept. Always the same: one that comes late
    /// stays alone.
    probe: Name,
    /// Dropped with the store: another process may then use the folder.
    _lock: Option<fs::File>,
}

/// The file of a scene's semantics before it is put, and the scene that carries them.
#[derive(Debug)]
pub(crate) struct PackedSemantics {
    scene: Arc<Scene>,
    file: Vec<u8>,
}

impl PackedSemantics {
    /// sha256 of the file, hex.
    pub(crate) fn file_sha256(&self) -> &str {
        &self.scene.semantics_sha256
    }
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
    /// The folder that it is; none where it is a bucket.
    pub(crate) fn folder(&self) -> Option<&Path> {
        self.objects.folder()
    }

    /// Whether other processes use the same scenes.
    pub(crate) fn is_shared(&self) -> bool {
        self.shared
    }

    /// Whether what jobs put was kept, or something as large since. Never blocks.
    pub(crate) fn keeps(&self) -> bool {
        self.objects.keeps()
    }

    /// Looks whether the store keeps things again.
    /// Fails with `store_unavailable` where it does not.
    pub(crate) fn probe(&self) -> Result<()> {
        self.objects.probe(self.probe.clone())
    }

    /// Looks whether there is room for what waits for it, before more is taken in.
    /// Fails with `store_unavailable` where there is not.
    pub(crate) fn has_room(&self) -> Result<()> {
        if self.keeps() { Ok(()) } else { self.probe() }
    }

    /// Nothing waits for room any more.
    pub(crate) fn forget_refused(&self) {
        self.objects.forget_refused();
    }

    /// Bytes of scenes in memory.
    pub(crate) fn cached_bytes(&self) -> u64 {
        self.cache.weight()
    }

    /// Keeps the first record of a scene, before anything else of it.
    pub(crate) fn announce(&self, record: &Record) -> Result<()> {
        self.put_sealed(pending(&record.status.id), record)
    }

    /// Keeps an upload and its first record: all of it or nothing, safe on return.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn put_upload(&self, upload: Upload, record: &Record) -> Result<()> {
        let id = &record.status.id;
        // Its files are removed where nobody has them and there is no list of them.
        let kept = upload.kept.clone();
        let keep = || -> Result<()> {
            let file = upload_file::pack(upload, record)
                .map_err(|e| Error::internal("the upload cannot be packed").caused_by(e))?;
            let put = || self.objects.offer("keep the upload", of(id, UPLOAD), file);
            if self.shared {
                // The record first: the sweep of a replica removes an upload without one.
                self.announce(record)?;
                self.check_received(kept.as_ref())?;
                return put();
            }
            self.arriving.lock().insert(id.clone());
            let (announced, kept) = side_by_side(|| self.announce(record), put);
            self.arriving.lock().remove(id);
            announced.and(kept)
        };
        keep().inspect_err(|_| {
            // What cannot be removed now is removed at the next start.
            for path in [pending(id), of(id, UPLOAD)] {
                let _ = self.objects.delete("keep the upload", path);
            }
        })
    }

    /// The upload of a scene.
    ///
    /// # Errors
    /// `scene_not_found` when it is not kept, `scene_corrupt`, `store_unavailable`.
    pub fn upload(&self, id: &SceneId) -> Result<Upload> {
        let file = self.objects.get("read the upload", of(id, UPLOAD))?;
        let file = file.ok_or_else(|| not_found(id))?;
        Ok(self.read_upload(&file, id, UPLOAD)?.0)
    }

    /// Forgets photos and cameras of a scene; what needs them can then not be made.
    pub(crate) fn drop_upload(&self, id: &SceneId) -> Result<()> {
        self.objects.delete("forget the photos", of(id, UPLOAD))?;
        self.drop_files(id, UPLOAD)
    }

    /// Keeps a newer record.
    ///
    /// # Errors
    /// `store_unavailable`; `scene_not_found` when the scene was deleted.
    pub fn put_record(&self, record: &Record) -> Result<()> {
        let id = &record.status.id;
        if !record.status.state.is_final() {
            self.put_sealed(pending(id), record)?;
            return self.unless_deleted(id);
        }
        self.put_status(record)?;
        self.settle(id)
    }

    /// Keeps the record of a scene that is over. Its pending record stays until it is settled.
    pub(crate) fn put_status(&self, record: &Record) -> Result<()> {
        let id = &record.status.id;
        self.put_sealed(of(id, STATUS), record)?;
        self.unless_deleted(id)
    }

    /// Removes the pending record of a scene that has a status. A start does it too.
    pub(crate) fn settle(&self, id: &SceneId) -> Result<()> {
        self.objects.delete("keep the scene's status", pending(id))?;
        if self.shared { self.drop_claims(id) } else { Ok(()) }
    }

    fn put_sealed(&self, path: Name, record: &Record) -> Result<()> {
        let sealed = record::seal(record)
            .map_err(|e| Error::internal("the scene's status cannot be written").caused_by(e))?;
        self.objects.put("keep the scene's status", path, sealed)
    }

    /// Keeps a finished scene, also in memory; gives it as it is kept.
    ///
    /// Where another replica was faster, its file stays and is the scene.
    ///
    /// # Errors
    /// `store_unavailable`; `scene_not_found` when the scene was deleted.
    pub fn put_scene(&self, scene: Scene) -> Result<Arc<Scene>> {
        let what = "keep the scene";
        self.put_packed(scene, |path, file| {
            if !self.shared {
                return self.objects.put(what, path, file).map(|()| None);
            }
            if self.objects.create(what, path.clone(), file.clone())? {
                return Ok(None);
            }
            let theirs = self.objects.get("read the scene", path.clone())?;
            match theirs.map(|theirs| read_scene(&theirs)) {
                Some(Ok((theirs, _))) if of(&theirs.meta.id, SCENE) == path => Ok(Some(theirs)),
                _ => self.objects.put(what, path, file).map(|()| None),
            }
        })
    }

    /// Keeps another version of a finished scene in place of the one before, also in memory; gives
    /// it as it is kept. A start finds the one or the other, whole.
    ///
    /// # Errors
    /// `store_unavailable`; `scene_not_found` when the scene was deleted.
    pub fn put_version(&self, scene: Scene) -> Result<Arc<Scene>> {
        let what = "keep a version of the scene";
        self.put_packed(scene, |path, file| self.objects.put(what, path, file).map(|()| None))
    }

    /// Packs a scene and puts its file; `put` gives the scene that is kept in its place.
    fn put_packed(
        &self,
        scene: Scene,
        put: impl FnOnce(Name, Vec<u8>) -> Result<Option<Scene>>,
    ) -> Result<Arc<Scene>> {
        let id = scene.meta.id.clone();
        let mut file = Vec::with_capacity(scene.gaussians.size_bytes() as usize + (64 << 10));
        let sha256 = write_scene(&mut file, &scene)
            .map_err(|e| Error::internal("the scene cannot be packed").caused_by(e))?;
        self.in_turn(&id, || {
            let kept = put(of(&id, SCENE), file)?;
            self.unless_deleted(&id)?;
            let scene = Arc::new(kept.unwrap_or(Scene { sha256, ..scene }));
            self.keep(Arc::clone(&scene));
            Ok(scene)
        })
    }

    /// Packs the semantics of a scene, to be put.
    /// Fails as [`Self::scene`]; `scene_corrupt` also when they are of other Gaussians.
    pub(crate) fn pack_semantics(
        &self,
        id: &SceneId,
        semantics: Semantics,
    ) -> Result<PackedSemantics> {
        let semantics = Arc::new(semantics);
        let scene = self.scene(id)?.with_semantics(Arc::clone(&semantics))?;
        let mut file = Vec::new();
        let semantics_sha256 = write_semantics(&mut file, id, &semantics)
            .map_err(|e| Error::internal("the semantics cannot be packed").caused_by(e))?;
        Ok(PackedSemantics { scene: Arc::new(Scene { semantics_sha256, ..scene }), file })
    }

    /// Keeps the semantics of a scene; gives the scene that carries them.
    /// Fails with `store_unavailable`; `scene_not_found` when the scene was deleted.
    pub(crate) fn put_semantics(&self, packed: PackedSemantics) -> Result<Arc<Scene>> {
        let PackedSemantics { scene, file } = packed;
        let id = scene.meta.id.clone();
        self.in_turn(&id, || {
            self.objects.put("keep the scene's semantics", of(&id, SEMANTICS), file)?;
            self.unless_deleted(&id)?;
            self.keep(Arc::clone(&scene));
            Ok(scene)
        })
    }

    /// A finished scene, from memory or the store, with its semantics where they were made; every
    /// byte read is checked. Bad semantics are put aside: the scene is whole without them.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_corrupt` (its file is then put aside), `other_version` (it stays),
    /// `store_unavailable`.
    pub fn scene(&self, id: &SceneId) -> Result<Arc<Scene>> {
        if let Some(scene) = self.cache.find(id) {
            return Ok(scene);
        }
        self.in_turn(id, || self.cache.find(id).map_or_else(|| self.read_scene(id), Ok))
    }

    /// Does what one call at a time may do with a scene.
    fn in_turn<T>(&self, id: &SceneId, work: impl FnOnce() -> T) -> T {
        let turn = Arc::clone(self.turns.lock().entry(id.clone()).or_default());
        let done = {
            let _one = turn.lock();
            work()
        };
        let mut turns = self.turns.lock();
        drop(turn);
        // Nobody else waits for it.
        if turns.get(id).is_some_and(|turn| Arc::strong_count(turn) == 1) {
            turns.remove(id);
        }
        done
    }

    /// The scene where it is in memory. Never blocks on the store.
    pub(crate) fn scene_in_memory(&self, id: &SceneId) -> Option<Arc<Scene>> {
        self.cache.find(id)
    }

    fn keep(&self, scene: Arc<Scene>) {
        let size = scene.size_bytes();
        self.cache.insert(scene.meta.id.clone(), scene, size);
    }

    /// Forgets the copy of a scene in memory: the next call reads what the store has.
    pub(crate) fn forget(&self, id: &SceneId) {
        self.cache.remove(id);
    }

    fn read_scene(&self, id: &SceneId) -> Result<Arc<Scene>> {
        let (what, corrupt) = ("read the scene", |why| Error::new(ErrorCode::SceneCorrupt, why));
        let Some(file) = self.objects.get(what, of(id, SCENE))? else {
            let put_aside = self.objects.exists(what, of(id, &aside(SCENE)))?;
            return Err(if put_aside {
                corrupt(format!("scene {id} failed its checksum and was put aside"))
            } else {
                not_found(id)
            });
        };
        let checked = read_scene(&file).and_then(|(scene, _)| match &scene.meta.id {
            own if own == id => Ok(scene),
            other => Err(corrupt(format!("scene {id}: its file holds {other}"))),
        });
        let scene = checked.inspect_err(|error| self.quarantine(id, SCENE, error))?;
        let scene = Arc::new(self.with_its_semantics(scene)?);
        self.keep(Arc::clone(&scene));
        Ok(scene)
    }

    /// The scene with the semantics that are kept beside it, if any are and they are sound. A
    /// version that was made after them has their entries itself. Semantics of other Gaussians stay
    /// where they are: they are put before the version that they belong to.
    fn with_its_semantics(&self, mut scene: Scene) -> Result<Scene> {
        let id = scene.meta.id.clone();
        let entries_of = std::mem::take(&mut scene.semantics_sha256);
        let own = (!entries_of.is_empty()).then(|| scene.gaussians.semantic_index().to_vec());
        if let Some(own) = &own {
            scene.gaussians = scene.gaussians.with_semantic_index(vec![0; own.len()])?;
        }
        let file = self.objects.get("read the scene's semantics", of(&id, SEMANTICS))?;
        let Some(file) = file else { return Ok(scene) };
        let (semantics, sha256) = match read_semantics(&file, &id) {
            Ok(read) => read,
            Err(error) => {
                self.quarantine(&id, SEMANTICS, &error);
                return Ok(scene);
            }
        };
        let index = own.filter(|_| sha256 == entries_of).unwrap_or(semantics.index);
        match scene.with_semantics(Arc::new(Semantics { index, ..semantics })) {
            Ok(with) => Ok(Scene { semantics_sha256: sha256, ..with }),
            Err(error) => {
                tracing::warn!(scene = %id, %error, "its semantics are of another version");
                Ok(scene)
            }
        }
    }

    /// Fails with `other_version` where the semantics that are kept of a scene are another
    /// version's, which is no reason to make them again.
    pub(crate) fn check_semantics(&self, id: &SceneId) -> Result<()> {
        let file = self.objects.get("read the scene's semantics", of(id, SEMANTICS))?;
        match file.map(|file| read_semantics(&file, id)) {
            Some(Err(error)) if error.code() == ErrorCode::OtherVersion => Err(error),
            _ => Ok(()),
        }
    }

    /// Forgets the semantics of a scene, as when the networks that made them are not loaded now.
    pub(crate) fn drop_semantics(&self, id: &SceneId) -> Result<()> {
        self.in_turn(id, || {
            self.cache.remove(id);
            self.objects.delete("forget the scene's semantics", of(id, SEMANTICS)).map(drop)
        })
    }

    /// Removes everything of a scene. It stays removed even if power fails.
    ///
    /// # Errors
    /// `scene_not_found`, `store_unavailable`: it may then be there still, whole.
    pub fn remove(&self, record: &Record) -> Result<()> {
        let (id, what) = (&record.status.id, "delete the scene");
        self.gone.lock().insert(id.clone(), Instant::now());
        let unmake = || -> Result<bool> {
            if self.shared {
                self.put_tombstone(id)?;
            }
            // The records go first: without them a sweep removes the rest.
            let status = self.objects.delete(what, of(id, STATUS))?;
            Ok(self.objects.delete(what, pending(id))? || status)
        };
        let was_there = unmake().inspect_err(|_| {
            self.gone.lock().remove(id);
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
        let here = self.gone.lock().contains_key(id);
        let deleted = here || self.shared && self.has_tombstone(id)?;
        if !deleted {
            return Ok(());
        }
        for path in [of(id, STATUS), pending(id)] {
            self.objects.delete("remove a deleted scene", path)?;
        }
        self.purge(id)?;
        self.cache.remove(id);
        Err(not_found(id))
    }

    /// Removes all objects under a scene's name.
    fn purge(&self, id: &SceneId) -> Result<()> {
        let what = "remove a deleted scene";
        for object in self.objects.list(what, &format!("scenes/{id}"))? {
            self.objects.delete(what, object.path)?;
        }
        Ok(())
    }

    /// Puts a bad object aside; one of another version stays where it is, for that version.
    fn quarantine(&self, id: &SceneId, name: &str, error: &Error) {
        if error.code() == ErrorCode::OtherVersion {
            tracing::error!(scene = %id, %error, "{name} is left as it is");
            return;
        }
        tracing::error!(scene = %id, %error, "{name} is put aside");
        let what = "put a bad object aside";
        if let Err(error) = self.objects.rename(what, of(id, name), of(id, &aside(name))) {
            tracing::error!(scene = %id, %error, "a bad object cannot be put aside");
        }
    }
}

/// Does two things that wait for the disk at the same time.
pub(crate) fn side_by_side<A: Send, B>(
    one: impl FnOnce() -> A + Send,
    other: impl FnOnce() -> B,
) -> (A, B) {
    std::thread::scope(|scope| {
        let one = scope.spawn(one);
        let other = other();
        let one = one.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
        (one, other)
    })
}

/// Writes a scene container to any path, whole or not at all; for the command line.
///
/// # Errors
/// `store_unavailable`.
pub fn write_scene_file(path: &Path, scene: &Scene) -> Result<()> {
    files::write_atomic(path, |to| write_scene(to, scene).map(drop))
        .map_err(|cause| Error::unavailable("write the scene file", cause))
}

/// Writes the semantics of a scene to any path, whole or not at all; for the command line.
///
/// # Errors
/// `store_unavailable`.
pub fn write_semantics_file(path: &Path, id: &SceneId, semantics: &Semantics) -> Result<()> {
    files::write_atomic(path, |to| write_semantics(to, id, semantics).map(drop))
        .map_err(|cause| Error::unavailable("write the semantics file", cause))
}

/// Milliseconds since 1970.
pub fn now_ms() -> u64 {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    now.map_or(0, |since| u64::try_from(since.as_millis()).unwrap_or(u64::MAX))
}

/// A new id: 128 of the system's random bits, which nobody can guess.
/// Fails with `internal` when the system gives none.
pub(crate) fn new_id() -> Result<SceneId> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes)
        .map_err(|e| Error::internal(format!("the system gives no random numbers: {e}")))?;
    Ok(SceneId::from_bytes(bytes))
}

/// No scene of this id.
pub(crate) fn not_found(id: &SceneId) -> Error {
    Error::new(ErrorCode::SceneNotFound, format!("no scene has the id {id}"))
}
