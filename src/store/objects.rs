//! The object store under everything kept: blocking calls for any thread, each with a time limit.
//!
//! A put is there whole or not at all: a local folder writes a staging file, syncs and renames it;
//! an S3-compatible store takes one PUT. The first argument of each call is what a failure says
//! the store cannot do; the error is `store_unavailable`.
//!
//! A call that came too late may still do its work. So calls that change an object go one after the
//! other, also where nobody waits for the first any more: what is deleted does not come back.

use std::{
    collections::HashMap,
    future::Future,
    ops::Range,
    path::{Path as FilePath, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
        mpsc,
    },
    time::Duration,
};

use fs_err as fs;
use futures_util::{StreamExt, TryStreamExt, stream};
use object_store::{
    Error as Fault, ObjectMeta, ObjectStore, ObjectStoreExt, PutMode, PutOptions, PutPayload,
    buffered::BufWriter, path::Path,
};
use parking_lot::Mutex;
use tokio::{
    io::AsyncWriteExt,
    runtime::{Handle, Runtime},
};

use crate::error::{Error, ErrorCode, Result};

/// Bytes of an object that is received which go to the store in one part.
const PART_BYTES: usize = 8 << 20;
/// Calls to the store at the same time where many objects are read at once.
const AT_ONCE: usize = 16;
/// What a probe puts, as often as its size asks for.
static ZEROS: [u8; 1 << 20] = [0; 1 << 20];
/// How often a put to a local store is tried again because its folder was removed meanwhile.
const FOLDER_GONE_MAX: usize = 4;

/// Device and number of a folder.
type FolderId = (u64, u64);

#[cfg(unix)]
fn folder_id(folder: &FilePath) -> Option<FolderId> {
    use std::os::unix::fs::MetadataExt;
    let found = fs::metadata(folder).ok()?;
    Some((found.dev(), found.ino()))
}

/// A folder has no such number here; whether it is there.
#[cfg(not(unix))]
fn folder_id(folder: &FilePath) -> Option<FolderId> {
    folder.is_dir().then_some((0, 0))
}

/// An object and what tells its versions apart.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Listed {
    pub(super) path: Path,
    pub(super) stamp: String,
    pub(super) age: Duration,
}

/// One lock an object that is being changed.
type Turns = Mutex<HashMap<Path, Arc<tokio::sync::Mutex<()>>>>;

/// Blocking calls to an object store.
pub(super) struct Objects {
    store: Arc<dyn ObjectStore>,
    /// Of a local store: deletions are synced there.
    folder: Option<PathBuf>,
    /// Which folder that was at the start.
    own: Option<FolderId>,
    /// Runs the calls; taken when dropped.
    runtime: Option<Runtime>,
    timeout: Duration,
    turns: Arc<Turns>,
    /// Held by the one call of [`Self::probe`] at a time.
    looking: Mutex<()>,
    /// Bytes of the largest object that was not kept; 0 once as many were kept again.
    refused: AtomicUsize,
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
        let (own, refused) = (folder.as_deref().and_then(folder_id), AtomicUsize::new(0));
        let (turns, looking) = (Arc::default(), Mutex::default());
        Ok(Self { store, folder, own, runtime: Some(runtime), timeout, turns, looking, refused })
    }

    /// The folder of a local store.
    pub(super) fn folder(&self) -> Option<&FilePath> {
        self.folder.as_deref()
    }

    /// Fails where a local store is not the folder of the start any more. One that was moved away
    /// has its lock with it, so nothing may be written to another one of its name.
    fn unless_moved(&self, what: &str) -> Result<()> {
        match &self.folder {
            Some(folder) if folder_id(folder) != self.own => {
                Err(unavailable(what, fault("the data folder was moved or removed")))
            }
            _ => Ok(()),
        }
    }

    /// Does `call` on the store's own threads, so that any thread may wait for it.
    fn run<T: Send + 'static, F>(
        &self,
        what: &str,
        call: impl FnOnce(Arc<dyn ObjectStore>) -> F,
    ) -> Result<T>
    where
        F: Future<Output = Result<T, Fault>> + Send + 'static,
    {
        let answer = match &self.runtime {
            None => Err(fault("the store is closed")),
            Some(runtime) => {
                let (to, answer) = mpsc::sync_channel(1);
                let (call, timeout) = (call(Arc::clone(&self.store)), self.timeout);
                runtime.spawn(async move {
                    let late = |_| Err(fault(std::io::Error::from(std::io::ErrorKind::TimedOut)));
                    let done = tokio::time::timeout(timeout, call).await.unwrap_or_else(late);
                    // The caller waits for it, unless the program ends.
                    let _ = to.send(done);
                });
                answer.recv().unwrap_or_else(|_| Err(fault("the call was broken off")))
            }
        };
        answer.map_err(|fault| unavailable(what, fault))
    }

    /// [`Self::run`] of a call that changes an object: it begins once those before it have ended,
    /// and goes on where its time is over.
    fn change<T: Send + 'static, F>(
        &self,
        what: &str,
        path: &Path,
        call: impl FnOnce(Arc<dyn ObjectStore>) -> F,
    ) -> Result<T>
    where
        F: Future<Output = Result<T, Fault>> + Send + 'static,
    {
        let (turns, path) = (Arc::clone(&self.turns), path.clone());
        self.run(what, |store| {
            let call = call(store);
            let in_turn = async move {
                let turn = Arc::clone(turns.lock().entry(path.clone()).or_default());
                let done = {
                    let _turn = turn.lock().await;
                    call.await
                };
                let mut turns = turns.lock();
                // This one and that of the map.
                if Arc::strong_count(&turn) == 2 {
                    turns.remove(&path);
                }
                done
            };
            async { tokio::spawn(in_turn).await.map_err(fault)? }
        })
    }

    /// Keeps an object, whatever was there.
    pub(super) fn put(&self, what: &str, path: Path, bytes: impl Into<PutPayload>) -> Result<()> {
        let bytes: PutPayload = bytes.into();
        let size = bytes.content_length();
        self.note(size, self.offer(what, path, bytes))
    }

    /// As [`Self::put`], of an object whose sender is told where it is not kept: that one was too
    /// large does not mean that the store keeps no other.
    pub(super) fn offer(&self, what: &str, path: Path, bytes: impl Into<PutPayload>) -> Result<()> {
        let bytes: PutPayload = bytes.into();
        let file = self.folder.as_ref().map(|folder| folder.join(path.as_ref()));
        self.unless_moved(what).and_then(|()| {
            self.change(what, &path.clone(), |store| async move {
                let mut tries = 0..FOLDER_GONE_MAX;
                let kept = loop {
                    match store.put(&path, bytes.clone()).await {
                        Err(fault) if folder_is_gone(&fault) && tries.next().is_some() => {}
                        kept => break kept.map(drop),
                    }
                };
                // A local store makes the object's folder first. One that holds others stays.
                if let (Err(_), Some(file)) = (&kept, file) {
                    let _ = tokio::task::spawn_blocking(move || file.parent().map(fs::remove_dir))
                        .await;
                }
                kept
            })
        })
    }

    /// Notes whether an object of so many bytes was kept.
    fn note<T>(&self, size: usize, kept: Result<T>) -> Result<T> {
        match &kept {
            Err(_) => drop(self.refused.fetch_max(size.max(1), Ordering::AcqRel)),
            Ok(_) if size >= self.refused.load(Ordering::Acquire) => {
                self.refused.store(0, Ordering::Release);
            }
            Ok(_) => {}
        }
        kept
    }

    /// Whether all objects were kept, or one as large as each that was not since.
    pub(super) fn keeps(&self) -> bool {
        self.refused.load(Ordering::Acquire) == 0
    }

    /// Keeps an object and removes it: of a folder, whose disk may be full, one as large as that
    /// which was not kept.
    pub(super) fn probe(&self, path: Path) -> Result<()> {
        let refused = self.refused.load(Ordering::Acquire);
        let size = if self.folder.is_some() { refused } else { refused.min(1) };
        let what = "keep anything";
        // Each caller of a full store may ask: one look at a time, and no memory for it.
        let Some(_looking) = self.looking.try_lock() else {
            return Err(unavailable(what, fault("another call looks")));
        };
        let piece = |at| PutPayload::from_static(&ZEROS[..ZEROS.len().min(size - at)]);
        let zeros = (0..size).step_by(ZEROS.len()).flat_map(piece);
        self.put(what, path.clone(), zeros.collect::<PutPayload>())?;
        self.delete(what, path)?;
        self.forget_refused();
        Ok(())
    }

    /// Nothing needs the room any more that there was not.
    pub(super) fn forget_refused(&self) {
        self.refused.store(0, Ordering::Release);
    }

    /// Keeps an object unless there is one; whether it was kept.
    pub(super) fn create(&self, what: &str, path: Path, bytes: Vec<u8>) -> Result<bool> {
        let options = PutOptions { mode: PutMode::Create, ..PutOptions::default() };
        let size = bytes.len();
        let kept = self.unless_moved(what).and_then(|()| {
            self.change(what, &path.clone(), |store| async move {
                match store.put_opts(&path, bytes.into(), options).await {
                    Ok(_) => Ok(true),
                    Err(Fault::AlreadyExists { .. } | Fault::Precondition { .. }) => Ok(false),
                    Err(fault) => Err(fault),
                }
            })
        });
        self.note(size, kept)
    }

    /// An object's bytes; `None` where there is none.
    pub(super) fn get(&self, what: &str, path: Path) -> Result<Option<Vec<u8>>> {
        self.run(what, |store| whole(store, path))
    }

    /// Some bytes of an object; `None` where there is none.
    pub(super) fn get_range(
        &self,
        what: &str,
        path: Path,
        range: Range<u64>,
    ) -> Result<Option<Vec<u8>>> {
        self.run(what, |store| async move {
            Ok(found(store.get_range(&path, range).await)?.map(Vec::from))
        })
    }

    /// An object that is put as its bytes come. It is there at its end, or not at all.
    pub(super) fn writer(&self, what: &'static str, path: Path) -> Result<Writer> {
        self.unless_moved(what)?;
        let runtime = self.runtime.as_ref().map(|runtime| runtime.handle().clone());
        let runtime = runtime.ok_or_else(|| unavailable(what, fault("the store is closed")))?;
        let writer = BufWriter::with_capacity(Arc::clone(&self.store), path, PART_BYTES);
        // The part that is gathered and the one that goes out.
        let writer = Some(writer.with_max_concurrency(1));
        Ok(Writer { runtime, timeout: self.timeout, what, writer })
    }

    /// The bytes of many objects, in their order.
    pub(super) fn get_all(&self, what: &str, paths: Vec<Path>) -> Result<Vec<Option<Vec<u8>>>> {
        self.run(what, |store| {
            let get = move |path| whole(Arc::clone(&store), path);
            stream::iter(paths).map(get).buffered(AT_ONCE).try_collect()
        })
    }

    pub(super) fn exists(&self, what: &str, path: Path) -> Result<bool> {
        self.run(what, |store| async move { Ok(found(store.head(&path).await)?.is_some()) })
    }

    /// Removes an object, for good on return; whether it was there, as far as the store says (S3
    /// does not).
    pub(super) fn delete(&self, what: &str, path: Path) -> Result<bool> {
        let folder = self.folder.clone();
        self.change(what, &path.clone(), |store| async move {
            let was_there = match store.delete(&path).await {
                // The object went, and its folder, which another deletion emptied.
                Err(fault) if folder_is_gone(&fault) => true,
                deleted => found(deleted)?.is_some(),
            };
            if !was_there {
                return Ok(false);
            }
            if let Some(folder) = folder {
                let file = folder.join(path.as_ref());
                let synced = tokio::task::spawn_blocking(move || sync_above(&folder, &file)).await;
                synced.map_err(fault)?.map_err(fault)?;
            }
            Ok(true)
        })
    }

    /// Puts an object under another name, where there is one.
    pub(super) fn rename(&self, what: &str, from: Path, to: Path) -> Result<()> {
        self.run(what, |store| async move { found(store.rename(&from, &to).await).map(drop) })
    }

    /// All objects under a prefix.
    pub(super) fn list(&self, what: &str, prefix: &str) -> Result<Vec<Listed>> {
        let prefix = Path::from(prefix);
        self.run(what, |store| async move {
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

/// An object that is being put.
pub(super) struct Writer {
    runtime: Handle,
    timeout: Duration,
    what: &'static str,
    /// None once a call failed.
    writer: Option<BufWriter>,
}

impl Writer {
    /// Bytes that it takes in memory.
    pub(super) const BYTES: usize = 2 * PART_BYTES;

    /// The next bytes.
    pub(super) async fn put(&mut self, bytes: Vec<u8>) -> Result<()> {
        let mut writer = self.take()?;
        let put = async move {
            match writer.put(bytes.into()).await {
                Ok(()) => Ok(writer),
                Err(fault) => {
                    // What is there of it goes; the first fault is told.
                    let _ = writer.abort().await;
                    Err(fault)
                }
            }
        };
        self.writer = Some(call(self.how(), put).await?);
        Ok(())
    }

    /// The object is there, and stays, on return.
    pub(super) async fn end(&mut self) -> Result<()> {
        let mut writer = self.take()?;
        call(self.how(), async move { writer.shutdown().await.map_err(fault) }).await
    }

    fn how(&self) -> (Handle, Duration, &'static str) {
        (self.runtime.clone(), self.timeout, self.what)
    }

    fn take(&mut self) -> Result<BufWriter> {
        let lost = || unavailable(self.what, fault("bytes before these were not kept"));
        self.writer.take().ok_or_else(lost)
    }
}

/// One call of a writer on the store's own threads.
async fn call<T: Send + 'static>(
    (runtime, timeout, what): (Handle, Duration, &'static str),
    call: impl Future<Output = Result<T, Fault>> + Send + 'static,
) -> Result<T> {
    let late = |_| Err(fault(std::io::Error::from(std::io::ErrorKind::TimedOut)));
    let call = async move { tokio::time::timeout(timeout, call).await.unwrap_or_else(late) };
    let done = runtime.spawn(call).await;
    done.unwrap_or_else(|e| Err(fault(e))).map_err(|fault| unavailable(what, fault))
}

impl Drop for Writer {
    fn drop(&mut self) {
        if let Some(mut writer) = self.writer.take() {
            self.runtime.spawn(async move { writer.abort().await });
        }
    }
}

fn fault(source: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Fault {
    Fault::Generic { store: "scenes", source: source.into() }
}

/// Whether a local store missed a folder: deletions remove folders that they empty, also beside a
/// call that needs one.
fn folder_is_gone(fault: &Fault) -> bool {
    let mut cause: Option<&(dyn std::error::Error + 'static)> = Some(fault);
    let mut gone = false;
    while let Some(error) = cause {
        let io = error.downcast_ref::<std::io::Error>();
        gone |= io.is_some_and(|io| io.kind() == std::io::ErrorKind::NotFound);
        cause = error.source();
    }
    gone && !matches!(fault, Fault::NotFound { .. })
}

/// `None` where a call found no object.
fn found<T>(result: Result<T, Fault>) -> Result<Option<T>, Fault> {
    match result {
        Ok(found) => Ok(Some(found)),
        Err(Fault::NotFound { .. }) => Ok(None),
        Err(fault) => Err(fault),
    }
}

async fn whole(store: Arc<dyn ObjectStore>, path: Path) -> Result<Option<Vec<u8>>, Fault> {
    let Some(found) = found(store.get(&path).await)? else { return Ok(None) };
    Ok(Some(Vec::from(found.bytes().await?)))
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
