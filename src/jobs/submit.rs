//! What callers do to scenes: they create them and delete them.

use std::sync::{Arc, atomic::AtomicBool};

use super::{change::Change, job::Reason, photos::ReadUpload, scene::SCENE, shared::Jobs};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{PhotoHash, SceneId, SemanticsMode, SemanticsState, SemanticsStatus, Upload},
    store::{self, KeyUse, Record, not_found},
};

impl Jobs {
    /// Reads an upload, makes it safe in the store and queues it. Gives its id, or that of the
    /// scene of an earlier call with the same idempotency key.
    ///
    /// # Errors
    /// `invalid_request`, `photo_unreadable`, `limit_exceeded` where the upload cannot be a scene;
    /// `model_unavailable` where photos came without cameras and no network finds them;
    /// `idempotency_key_reused` when the key was used with others; `overloaded` when the queue is
    /// full or the server stops; `store_unavailable` where it is not kept, or where earlier scenes
    /// wait for room.
    pub(crate) fn submit(&self, upload: Upload, mut record: Record) -> Result<SceneId> {
        let (limits, never) = (self.parts.limits.get(), AtomicBool::new(false));
        let read = ReadUpload::of(&upload, &record.options, &limits, &never)?;
        if read.is_unposed() && !self.parts.scenes.finds_cameras() {
            let why = "no network finds the cameras of photos; send cameras with them";
            return Err(Error::new(ErrorCode::ModelUnavailable, why));
        }
        record.options.semantics = read.semantics(record.options.semantics);
        if record.options.semantics == SemanticsMode::Off {
            record.status.semantics = SemanticsStatus::new(SemanticsState::Off);
        }
        let files = &read.files;
        record.request_sha256 = store::request_sha256(files, &record.options);
        // First, so that a full queue still answers for scenes that it holds.
        if let Some(earlier) = self.earlier(files, &record)? {
            return Ok(earlier);
        }
        let reserved = self.queue.reserve(SCENE, record.owner.as_deref());
        let place = reserved.map_err(|full| self.overloaded(full))?;
        // Acknowledged scenes come first: another upload would take the room that they wait for.
        self.parts.store.has_room()?;
        record.replica = self.replicas.name().map(str::to_owned);
        let id = record.status.id.clone();
        self.replicas.hold(&id);
        let kept = || -> Result<Option<SceneId>> {
            if let Some(other) = self.use_key(files, &record)? {
                return Ok(Some(other));
            }
            self.parts.store.put_upload(upload, &record).inspect_err(|_| {
                if let Some(key) = &record.idempotency_key {
                    // A key that stays leads to no scene and counts as unused.
                    let _ = self.parts.store.forget_key(record.owner.as_deref(), key);
                }
            })?;
            Ok(None)
        };
        if let Some(other) = kept().inspect_err(|_| self.release(&id))? {
            self.release(&id);
            return Ok(other);
        }
        self.uploads.keep(&id, Arc::new(read));
        self.records.insert(record);
        place.fill(id.clone());
        Ok(id)
    }

    /// The scene of an earlier call with this record's idempotency key.
    fn earlier(&self, files: &[PhotoHash], record: &Record) -> Result<Option<SceneId>> {
        let Some(key) = &record.idempotency_key else { return Ok(None) };
        let owner = record.owner.as_deref();
        let Some(used) = self.parts.store.key_use(owner, key)? else { return Ok(None) };
        self.refresh(&used.id)?;
        if self.records.find(&used.id).is_none() {
            // Deleted, or never acknowledged.
            self.parts.store.forget_key(owner, key)?;
            return Ok(None);
        }
        self.replayed(files, record, used).map(Some)
    }

    /// Notes the use of the record's key; gives the scene of a call that was faster.
    fn use_key(&self, files: &[PhotoHash], record: &Record) -> Result<Option<SceneId>> {
        let Some(key) = &record.idempotency_key else { return Ok(None) };
        let (store, id) = (&self.parts.store, &record.status.id);
        let new = KeyUse { id: id.clone(), request_sha256: record.request_sha256.clone() };
        // The scene is announced before the key leads to it.
        store.announce(record)?;
        match store.use_key(record.owner.as_deref(), key, &new) {
            Ok(None) => Ok(None),
            Ok(Some(used)) => {
                store.drop_pending(id)?;
                self.replayed(files, record, used).map(Some)
            }
            Err(error) => {
                let _ = store.drop_pending(id);
                Err(error)
            }
        }
    }

    /// The scene of an earlier use of a key, if it was for the same request.
    fn replayed(&self, files: &[PhotoHash], record: &Record, used: KeyUse) -> Result<SceneId> {
        let id = used.id;
        if !store::is_of_request(&used.request_sha256, files, &record.options) {
            let message = "the idempotency key was used with other photos or options";
            let message = format!("{message} (scene {id})");
            return Err(Error::new(ErrorCode::IdempotencyKeyReused, message));
        }
        let over = self.records.find(&id).is_some_and(|known| known.status.state.is_final());
        if !over && !self.replicas.is_acknowledged(&self.parts.store, &id)? {
            // Another replica still writes it and may fail: nothing is acknowledged for it.
            let message = format!("the first call with this idempotency key (scene {id}) is open");
            return Err(Error::new(ErrorCode::Overloaded, message).retry_after_s(1));
        }
        Ok(id)
    }

    /// Refuses where another scene of this owner would not be queued now.
    /// Fails with `overloaded` when the queue is full or the server stops.
    pub(crate) fn has_room(&self, owner: Option<&str>) -> Result<()> {
        let reserved = self.queue.reserve(SCENE, owner);
        reserved.map(drop).map_err(|full| self.overloaded(full))
    }

    /// Stops the scene's jobs and removes everything that is kept of it.
    /// Fails with `scene_not_found`.
    pub(crate) fn delete(&self, id: &SceneId) -> Result<()> {
        let record = self.record(id)?;
        self.queue.remove(id, None);
        self.running.stop(Reason::Cancelled, |job| job.scene == *id);
        self.bell.ring();
        let removed = self.parts.store.remove(&record);
        let removed_here = removed.is_ok();
        match removed {
            // A job that was about to end may have removed its own objects first.
            Err(error) if error.code() != ErrorCode::SceneNotFound => {
                // It still exists, but no job makes it any more.
                self.records.apply(id, &Change::Stopped)?;
                return Err(error);
            }
            _ => {}
        }
        // What watches the other replicas may have seen first that it is gone.
        let existed = self.records.remove(id) || removed_here;
        if !self.kinds.iter().any(|kind| kind.lasts() && self.queue.len(*kind) > 0) {
            self.parts.store.forget_refused();
        }
        // Only now: a job that ends meanwhile either is seen here, or sees there that its scene is
        // gone.
        if !self.running.has(id) {
            self.release(id);
        }
        if existed { Ok(()) } else { Err(not_found(id)) }
    }

    /// Marks a finished scene as failed: its file turned out to be bad.
    pub(crate) fn spoil(&self, id: &SceneId, error: &Error) {
        self.fail(SCENE, id, error);
    }

    /// Scenes that wait for a worker, and scenes that a worker makes.
    pub(crate) fn counts(&self) -> (usize, usize) {
        (self.queue.len(SCENE), self.running.scenes(SCENE).len())
    }

    /// Scenes that are made before this one; `None` when it does not wait.
    pub(crate) fn ahead(&self, id: &SceneId) -> Option<usize> {
        self.queue.ahead(SCENE, id)
    }
}
