//! Creating a scene: check, make safe on disk, queue, wait as long as asked.

use std::{collections::HashMap, hash::BuildHasher, sync::Arc, time::Duration};

use sha2::{Digest, Sha256};

use super::{
    Inner, Service,
    types::{CreateScene, Created},
};
use crate::{
    error::{Error, Result},
    keys::Caller,
    limits::IDEMPOTENCY_KEY_BYTES_MAX,
    scene::{
        SceneId, SceneOptions, SceneState, SceneStatus, SemanticsMode, SemanticsState, Upload,
    },
    store::{self, Record},
};

/// By owner and key: digest of what the key was used for, and the scene it made.
pub(super) type Keys = HashMap<(Option<String>, String), (String, SceneId)>;

/// The keys of the scenes kept.
pub(super) fn keys_of(records: &[Record]) -> Keys {
    let entry = |record: &Record| {
        let value = (record.request_sha256.clone(), record.status.id.clone());
        Some(((record.owner.clone(), record.idempotency_key.clone()?), value))
    };
    records.iter().filter_map(entry).collect()
}

impl Service {
    /// Takes an upload, makes it safe on disk, queues it, and waits as long as asked.
    ///
    /// What is wrong with photos and cameras themselves is answered here; what only the pipeline
    /// finds becomes the scene's error.
    ///
    /// # Errors
    /// `invalid_request`, `photo_unreadable`, `limit_exceeded`, `overloaded`, `store_unavailable`.
    pub async fn create_scene(&self, request: CreateScene) -> Result<Created> {
        let CreateScene { upload, options, idempotency_key, wait } = request;
        check_request(&options, idempotency_key.as_deref(), &self.limits())?;
        if options.semantics == SemanticsMode::Eager {
            self.inner.can_understand("semantics=eager")?;
        }
        let (id, replayed) = match idempotency_key {
            None => (self.submit(upload, options, None).await?, false),
            Some(key) => {
                // Held to the end, so that two calls with one key cannot both be the first.
                let mut keys = self.inner.keys.lock().await;
                let (upload, digest) = digest(upload, options.clone()).await?;
                let name = (self.caller.owner().map(str::to_owned), key);
                match keys.get(&name) {
                    Some((known, id)) if *known == digest => (id.clone(), true),
                    Some((_, id)) => {
                        return Err(Error::invalid(format!(
                            "the idempotency key was used for another upload (scene {id})"
                        )));
                    }
                    None => {
                        let id = self.submit(upload, options, Some(name.1.clone())).await?;
                        keys.insert(name, (digest, id.clone()));
                        (id, false)
                    }
                }
            }
        };
        if let Some(wait) = wait {
            self.wait(&id, wait).await?;
        }
        Ok(Created { status: self.get(&id)?, replayed })
    }

    /// Waits until nothing more will happen to the scene, at most `limits.wait_ms_max`.
    ///
    /// # Errors
    /// `scene_not_found`.
    pub async fn wait(&self, id: &SceneId, at_most: Duration) -> Result<SceneStatus> {
        self.sees(id)?;
        let mut watcher = self.inner.jobs.watch(id)?;
        let at_most = at_most.min(Duration::from_millis(self.limits().wait_ms_max));
        let end = watcher.wait_for(|record| record.status.is_settled());
        // Late or deleted: either way the present state is the answer.
        let _ = tokio::time::timeout(at_most, end).await;
        let status = watcher.borrow().status.clone();
        Ok(self.shown(status))
    }

    async fn submit(
        &self,
        upload: Upload,
        options: SceneOptions,
        key: Option<String>,
    ) -> Result<SceneId> {
        let (inner, caller) = (Arc::clone(&self.inner), self.caller.clone());
        let turn = Arc::clone(&inner.reading).acquire_owned().await;
        let turn = turn.map_err(|e| Error::internal("no upload is read now").caused_by(e))?;
        blocking(move || {
            let _turn = turn;
            inner.submit_here(&upload, options, key, &caller)
        })
        .await?
    }
}

impl Inner {
    fn submit_here(
        &self,
        upload: &Upload,
        options: SceneOptions,
        key: Option<String>,
        caller: &Caller,
    ) -> Result<SceneId> {
        self.maker.check(upload, &self.limits())?;
        let id = new_id();
        let mut status = SceneStatus::new(id.clone(), SceneState::Queued, store::now_ms());
        if options.semantics == SemanticsMode::Off {
            status.semantics.state = SemanticsState::Off;
        }
        let record = Record {
            status,
            request_sha256: request_sha256(upload, &options),
            owner: caller.owner().map(str::to_owned),
            options,
            idempotency_key: key,
            attempts: 0,
            scene_sha256: None,
            semantics_sha256: None,
        };
        self.jobs.submit(upload, record)?;
        tracing::info!(scene = %id, photos = upload.photos.len(), "queued");
        Ok(id)
    }
}

/// Runs what takes long on a thread made for it.
pub(super) async fn blocking<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T> {
    let span = tracing::Span::current();
    tokio::task::spawn_blocking(move || span.in_scope(work))
        .await
        .map_err(|e| Error::internal("the work was broken off").caused_by(e))
}

async fn digest(upload: Upload, options: SceneOptions) -> Result<(Upload, String)> {
    blocking(move || {
        let digest = request_sha256(&upload, &options);
        (upload, digest)
    })
    .await
}

fn request_sha256(upload: &Upload, options: &SceneOptions) -> String {
    let mut hash = Sha256::new();
    for file in store::hashes(upload) {
        // Lengths first, so that no two lists of files read the same.
        hash.update((file.file.len() as u64).to_le_bytes());
        hash.update(file.file);
        hash.update(file.sha256);
    }
    hash.update(format!("{options:?}"));
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn check_request(
    options: &SceneOptions,
    key: Option<&str>,
    limits: &crate::limits::Limits,
) -> Result<()> {
    if let Some(views) = options.max_views
        && !(limits.photos_min..=limits.photos_max).contains(&views)
    {
        return Err(Error::invalid(format!(
            "max_views is {views}; it must be {} to {}",
            limits.photos_min, limits.photos_max
        )));
    }
    match key.map(str::len) {
        Some(0) => Err(Error::invalid("the idempotency key is empty")),
        Some(bytes) if bytes > IDEMPOTENCY_KEY_BYTES_MAX => {
            Err(Error::limit("idempotency key: bytes", bytes, IDEMPOTENCY_KEY_BYTES_MAX))
        }
        _ => Ok(()),
    }
}

/// 128 bits nobody can guess: std's hash keys are the system's random numbers.
fn new_id() -> SceneId {
    let random = || std::hash::RandomState::new().hash_one(std::time::Instant::now());
    let mut hash = Sha256::new();
    for word in [random(), random(), random(), random(), store::now_ms()] {
        hash.update(word.to_le_bytes());
    }
    let mut bytes = [0; 16];
    bytes.copy_from_slice(&hash.finalize()[..16]);
    SceneId::from_bytes(bytes)
}
