//! The object store under everything kept: blocking calls for any thread, each with a time limit.
//!
//! A put is there whole or not at all: a local folder writes a staging file, syncs and renames it;
//! an S3-compatible store takes one PUT.

use std::{
    future::Future,
    path::{Path as FilePath, PathBuf},
    sync::{Arc, mpsc},
    time::Duration,
};

use fs_err as fs;
use futures_util::{StreamExt, TryStreamExt, stream};
use object_store::{
    Error as Fault, ObjectMeta, ObjectStore, ObjectStoreExt, PutMode, PutOptions, PutPayload,
    path::Path,
};
use tokio::runtime::Runtime;

use crate::error::{Error, ErrorCode, Result};

/// Calls to the store at the same time where many objects are read at once.
const AT_ONCE: usize = 16;

/// An object and what tells its versions apart.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Listed {
    pub(super) path: Path,
    pub(super) stamp: String,
    pub(super) age: Duration,
}

/// Blocking calls to an object store.
pub(super) struct Objects {
    store: Arc<dyn ObjectStore>,
    /// Of a local store: deletions are synced there.
    folder: Option<PathBuf>,
    /// Runs the calls; taken when dropped.
    runtime: Option<Runtime>,
    timeout: Duration,
}

impl std::fmt::Debug for Objects {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Objects({})", self.store)
    }
}

impl Drop for Objects {
    fn drop(&mut self) {
        // Dropping it in place would wait, which an async thread may not.
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

impl Objects {
    pub(super) fn new(
        store: Arc<dyn ObjectStore>,
        folder: Option<PathBuf>,
        timeout: Duration,
    ) -> Result<Self> {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .thread_name("store")
            .enable_all()
            .build()
            .map_err(|e| Error::internal("the store's threads do not start").caused_by(e))?;
        Ok(Self { store, folder, runtime: Some(runtime), timeout })
    }

    /// Does `call` on the store's own threads, so that any thread may wait for it.
    fn run<T: Send + 'static>(
        &self,
        call: impl Future<Output = Result<T, Fault>> + Send + 'static,
    ) -> Result<T, Fault> {
        let gone = |why: &str| Fault::Generic { store: "scenes", source: why.into() };
        let Some(runtime) = &self.runtime else { return Err(gone("the store is closed")) };
        let (answer, answered) = mpsc::sync_channel(1);
        let timeout = self.timeout;
        runtime.spawn(async move {
            let done = tokio::time::timeout(timeout, call).await.unwrap_or_else(|_late| {
                let source = std::io::Error::from(std::io::ErrorKind::TimedOut);
                Err(Fault::Generic { store: "scenes", source: source.into() })
            });
            // Whoever asked is waiting, unless the program ends.
            let _ = answer.send(done);
        });
        answered.recv().unwrap_or_else(|_| Err(gone("the call was broken off")))
    }

    /// Keeps an object, whatever was there.
    pub(super) fn put(&self, path: Path, bytes: impl Into<PutPayload>) -> Result<(), Fault> {
        self.put_as(path, bytes.into(), PutMode::Overwrite)
    }

    /// Keeps an object unless there is one; whether it was kept.
    pub(super) fn create(&self, path: Path, bytes: Vec<u8>) -> Result<bool, Fault> {
        match self.put_as(path, bytes.into(), PutMode::Create) {
            Ok(()) => Ok(true),
            Err(Fault::AlreadyExists { .. } | Fault::Precondition { .. }) => Ok(false),
            Err(fault) => Err(fault),
        }
    }

    fn put_as(&self, path: Path, bytes: PutPayload, mode: PutMode) -> Result<(), Fault> {
        let store = Arc::clone(&self.store);
        self.run(async move {
            let options = PutOptions { mode, ..PutOptions::default() };
            store.put_opts(&path, bytes, options).await.map(drop)
        })
    }

    /// An object's bytes; `None` where there is none.
    pub(super) fn get(&self, path: Path) -> Result<Option<Vec<u8>>, Fault> {
        let store = Arc::clone(&self.store);
        self.run(async move { whole(&*store, &path).await })
    }

    /// The bytes of many objects, in their order.
    pub(super) fn get_all(&self, paths: Vec<Path>) -> Result<Vec<Option<Vec<u8>>>, Fault> {
        let store = Arc::clone(&self.store);
        self.run(async move {
            let get = |path: Path| {
                let store = Arc::clone(&store);
                async move { whole(&*store, &path).await }
            };
            stream::iter(paths).map(get).buffered(AT_ONCE).try_collect().await
        })
    }

    pub(super) fn exists(&self, path: Path) -> Result<bool, Fault> {
        let store = Arc::clone(&self.store);
        self.run(async move {
            match store.head(&path).await {
                Ok(_) => Ok(true),
                Err(Fault::NotFound { .. }) => Ok(false),
                Err(fault) => Err(fault),
            }
        })
    }

    /// Removes an object, for good on return; whether it was there, as far as the store says (S3
    /// does not).
    pub(super) fn delete(&self, path: Path) -> Result<bool, Fault> {
        let (store, folder) = (Arc::clone(&self.store), self.folder.clone());
        self.run(async move {
            match store.delete(&path).await {
                Ok(()) => {}
                Err(Fault::NotFound { .. }) => return Ok(false),
                Err(fault) => return Err(fault),
            }
            if let Some(folder) = folder {
                let file = folder.join(path.as_ref());
                let synced = tokio::task::spawn_blocking(move || sync_above(&folder, &file)).await;
                let failed = |source| Fault::Generic { store: "scenes", source };
                synced.map_err(|e| failed(e.into()))?.map_err(|e| failed(e.into()))?;
            }
            Ok(true)
        })
    }

    /// Puts an object under another name; `false` where there was none.
    pub(super) fn rename(&self, from: Path, to: Path) -> Result<bool, Fault> {
        let store = Arc::clone(&self.store);
        self.run(async move {
            match store.rename(&from, &to).await {
                Ok(()) => Ok(true),
                Err(Fault::NotFound { .. }) => Ok(false),
                Err(fault) => Err(fault),
            }
        })
    }

    /// All objects under a prefix.
    pub(super) fn list(&self, prefix: &str) -> Result<Vec<Listed>, Fault> {
        let (store, prefix) = (Arc::clone(&self.store), Path::from(prefix));
        self.run(async move {
            let now = std::time::SystemTime::now();
            let listed = |meta: ObjectMeta| Listed {
                stamp: format!("{:?} {}", meta.e_tag, meta.last_modified.timestamp_millis()),
                age: now.duration_since(meta.last_modified.into()).unwrap_or_default(),
                path: meta.location,
            };
            store.list(Some(&prefix)).map_ok(listed).try_collect().await
        })
    }
}

async fn whole(store: &dyn ObjectStore, path: &Path) -> Result<Option<Vec<u8>>, Fault> {
    match store.get(path).await {
        Ok(found) => Ok(Some(Vec::from(found.bytes().await?))),
        Err(Fault::NotFound { .. }) => Ok(None),
        Err(fault) => Err(fault),
    }
}

/// Makes it last that `file` is gone: its folder may be gone with it.
fn sync_above(root: &FilePath, file: &FilePath) -> std::io::Result<()> {
    let mut at = file.parent();
    while let Some(folder) = at.filter(|folder| folder.starts_with(root)) {
        match fs::File::open(folder) {
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => at = folder.parent(),
            opened => return opened?.sync_all(),
        }
    }
    Ok(())
}

/// A failed call as an error for the client; the cause stays for the log.
pub(super) fn unavailable(what: &str, fault: Fault) -> Error {
    let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(&fault);
    let mut why = match &fault {
        Fault::PermissionDenied { .. } | Fault::Unauthenticated { .. } => "access is denied",
        Fault::NotFound { .. } => "what it needs is not there",
        _ => "the call failed",
    }
    .to_owned();
    while let Some(error) = cause {
        if let Some(io) = error.downcast_ref::<std::io::Error>() {
            why = io.kind().to_string();
        }
        cause = error.source();
    }
    Error::new(ErrorCode::StoreUnavailable, format!("the store cannot {what} now: {why}"))
        .caused_by(fault)
        .retry_after_s(5)
}
