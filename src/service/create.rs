//! Creating a scene: check, make safe in the store, queue, wait as long as the caller wants.

use std::{sync::Arc, time::Duration};

use sha2::{Digest, Sha256};
use tokio::sync::OwnedMutexGuard;

use super::{
    refine,
    request::CreateScene,
    shared::{KEY_LOCKS, Service, Shared},
    tasks::blocking,
    texts,
    types::Created,
};
use crate::{
    error::{Error, Result},
    keys::Caller,
    limits::IDEMPOTENCY_KEY_BYTES_MAX,
    scene::{SceneId, SceneOptions, SceneState, SceneStatus, SemanticsMode, Upload},
    store::{self, Receiving, Record, Store, UPLOAD},
    telemetry,
};

/// A create call that waits. When its caller goes away before it has the id, and nobody else
/// watches the scene, the scene is deleted.
struct Waiting {
    service: Service,
    id: Option<SceneId>,
}

impl Drop for Waiting {
    fn drop(&mut self) {
        let (Some(id), Ok(runtime)) = (self.id.take(), tokio::runtime::Handle::try_current())
        else {
            return;
        };
        let service = self.service.clone();
        runtime.spawn(async move {
            let jobs = &service.inner.jobs;
            let open = jobs.record(&id).is_ok_and(|record| !record.status.state.is_final());
            if open && jobs.records.watchers(&id) == 0 {
                tracing::info!(scene = %id, "its caller went away before it had an id");
                if let Err(error) = service.delete(&id).await {
                    tracing::warn!(scene = %id, %error, "it cannot be dropped");
                }
            }
        });
    }
}

impl Service {
    /// Takes an upload, makes it safe in the store, queues it, and waits as long as the caller
    /// wants.
    ///
    /// Faults of photos and cameras themselves are answered here; a fault that only the pipeline
    /// finds becomes the scene's error. When a caller without an idempotency key goes away while it
    /// waits, the scene is deleted: nobody knows its id.
    ///
    /// # Errors
    /// `invalid_request`, `photo_unreadable`, `limit_exceeded`, `overloaded`, `store_unavailable`.
    pub async fn create_scene(&self, request: CreateScene) -> Result<Created> {
        let CreateScene { upload, mut options, idempotency_key, wait, request_id } = request;
        check_request(&options, idempotency_key.as_deref(), &self.limits())?;
        options.ignore = checked_words(&options.ignore, &self.limits())?;
        if !options.ignore.is_empty() {
            self.inner.can_understand("ignore")?;
        }
        if options.semantics == SemanticsMode::Eager {
            self.inner.can_understand("semantics=eager")?;
        }
        let needs_photos =
            options.semantics == SemanticsMode::Lazy && upload.sent_splats().is_none();
        if needs_photos && !self.inner.config.keep_photos {
            // Without photos there is no later.
            let can = self.inner.can_understand("semantics").is_ok();
            options.semantics = if can { SemanticsMode::Eager } else { SemanticsMode::Off };
        }
        let keyed = idempotency_key.is_some();
        self.has_room(keyed)?;
        self.inner.memory.admit(upload.memory_bytes())?;
        let turn = self.inner.turn_of(idempotency_key.as_deref()).await;
        let record = |record| Record { options, idempotency_key, request_id, ..record };
        let (id, replayed) = self.submit(upload, record, turn).await?;
        if let Some(wait) = wait {
            let unknown = (!keyed && !replayed).then(|| id.clone());
            let mut waiting = Waiting { service: self.clone(), id: unknown };
            let waited = self.wait(&id, wait).await;
            waiting.id = None;
            waited?;
        }
        Ok(Created { status: self.get(&id).await?, replayed })
    }

    /// Files of an upload that go to the store as they come: of a new scene, or of photos that join
    /// one.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub(crate) async fn receiving(&self, joined: Option<&SceneId>) -> Result<Receiving> {
        let (scene, list) = match joined {
            Some(id) => (id.clone(), Store::added_name()?),
            None => (store::new_id()?, UPLOAD.to_owned()),
        };
        Receiving::begin(&self.inner.store, scene, list).await
    }

    /// Refuses a create that would find the queue full, before its photos are sent or decoded. A
    /// call with an idempotency key is read first: it may be one that was answered before.
    ///
    /// # Errors
    /// `overloaded`.
    pub fn has_room(&self, keyed: bool) -> Result<()> {
        if keyed { Ok(()) } else { self.inner.jobs.has_room(self.caller.owner()) }
    }

    /// Waits until nothing more will happen to the scene, at most `limits.wait_ms_max`, and not
    /// where the server stops.
    ///
    /// # Errors
    /// `scene_not_found`.
    pub async fn wait(&self, id: &SceneId, at_most: Duration) -> Result<SceneStatus> {
        self.scene(id).await?;
        let mut watcher = self.inner.jobs.watch(id)?;
        let at_most = at_most.min(Duration::from_millis(self.limits().wait_ms_max));
        let end = watcher.wait_for(|record| record.status.is_settled());
        // Late or deleted: either way the present state is the answer.
        tokio::select! {
            _ = tokio::time::timeout(at_most, end) => {}
            () = self.inner.stopped_waiting() => {}
        }
        let status = watcher.borrow().status.clone();
        Ok(self.shown(status))
    }

    async fn submit(
        &self,
        upload: Upload,
        record: impl FnOnce(Record) -> Record + Send + 'static,
        turn: Turn,
    ) -> Result<(SceneId, bool)> {
        let (inner, caller) = (Arc::clone(&self.inner), self.caller.clone());
        let permit = Arc::clone(&inner.reading).acquire_owned().await;
        let permit = permit.map_err(|e| Error::internal("no upload is read now").caused_by(e))?;
        blocking(move || {
            let _until_done = (permit, turn);
            inner.submit_here(upload, record, &caller)
        })
        .await?
    }
}

/// Held by a call with an idempotency key until its work is done.
pub(super) type Turn = Option<OwnedMutexGuard<()>>;

impl Shared {
    fn submit_here(
        &self,
        upload: Upload,
        record: impl FnOnce(Record) -> Record,
        caller: &Caller,
    ) -> Result<(SceneId, bool)> {
        // Files that are in the store already lie beside it.
        let id = match &upload.kept {
            Some(kept) => kept.scene.clone(),
            None => store::new_id()?,
        };
        let status = SceneStatus::new(id.clone(), SceneState::Queued, store::now_ms());
        let record = record(Record {
            owner: caller.owner().map(str::to_owned),
            traceparent: telemetry::traceparent(),
            ..Record::new(status)
        });
        let photos = upload.sent().count();
        let queued = self.jobs.submit(upload, record)?;
        let replayed = queued != id;
        if !replayed {
            tracing::info!(scene = %id, photos, "queued");
        }
        Ok((queued, replayed))
    }

    /// Waits until no other call with this key is at work, so that two of them cannot both be the
    /// first. What the call does keeps it, also where the caller has gone.
    pub(super) async fn turn_of(&self, key: Option<&str>) -> Turn {
        let place = Sha256::digest(key?)[0] as usize % KEY_LOCKS;
        Some(Arc::clone(&self.key_locks[place]).lock_owned().await)
    }
}

fn check_request(
    options: &SceneOptions,
    key: Option<&str>,
    limits: &crate::limits::Limits,
) -> Result<()> {
    if let Some(views) = options.max_views
        && !(limits.photos_min..=limits.network_photos_max).contains(&views)
    {
        return Err(Error::invalid(format!(
            "max_views is {views}; it must be {} to {}",
            limits.photos_min, limits.network_photos_max
        )));
    }
    options.method().check()?;
    options.refine.map_or(Ok(()), |refine| refine::check_refine(refine, limits))?;
    check_key(key)
}

/// The words of `ignore`, each checked; there may be none.
pub(crate) fn checked_words(
    words: &[String],
    limits: &crate::limits::Limits,
) -> Result<Vec<String>> {
    if words.is_empty() { Ok(Vec::new()) } else { texts::all_checked(words, "ignore", limits) }
}

/// Refuses an idempotency key that is empty or too long.
pub(super) fn check_key(key: Option<&str>) -> Result<()> {
    match key.map(str::len) {
        Some(0) => Err(Error::invalid("the idempotency key is empty")),
        Some(bytes) if bytes > IDEMPOTENCY_KEY_BYTES_MAX => {
            Err(Error::limit("idempotency key: bytes", bytes, IDEMPOTENCY_KEY_BYTES_MAX))
        }
        _ => Ok(()),
    }
}
