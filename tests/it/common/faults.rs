//! An object store that fails, tears and stalls, over a real one.

use std::{
    fmt,
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use futures_util::{
    StreamExt, TryStreamExt,
    stream::{self, BoxStream},
};
use object_store::{
    CopyOptions, Error, GetOptions, GetResult, ListResult, MultipartUpload, ObjectMeta,
    ObjectStore, PutMultipartOptions, PutOptions, PutPayload, PutResult, Result, path::Path,
};
use tokio::sync::Semaphore;

/// What goes wrong with a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Wrong {
    /// It fails and does nothing.
    Fails,
    /// It fails and has done its work all the same, as when an answer is lost.
    Lost,
    /// Half of what it writes is written, then it fails.
    Tears,
    /// It hangs, and does its work long after its caller has gone.
    Stalls,
    /// It reads at once, and answers late.
    Late,
    /// It hangs until the test lets go.
    Held,
    /// There is no room.
    Full,
    /// A local store misses a folder that a deletion emptied and removed meanwhile.
    NoFolder,
}

/// A call that is held, until it goes on or its caller gives it up.
struct Held(Arc<AtomicUsize>);

impl Held {
    fn begin(count: Arc<AtomicUsize>) -> Self {
        count.fetch_add(1, Ordering::AcqRel);
        Self(count)
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::AcqRel);
    }
}

type Plan = Box<dyn FnMut(&str, &Path) -> Option<Wrong> + Send>;

/// A store in which a plan says what goes wrong; the plan sees `put`, `get`, `delete` or `list`
/// and the path.
pub(crate) struct FaultStore {
    inner: Arc<dyn ObjectStore>,
    plan: Mutex<Plan>,
    pub(crate) wrongs: AtomicUsize,
    stall: Duration,
    /// Calls that are held now.
    pub(crate) held: Arc<AtomicUsize>,
    /// Closed when the test lets go.
    gate: Arc<Semaphore>,
}

impl FaultStore {
    pub(crate) fn new(inner: Arc<dyn ObjectStore>, stall: Duration) -> Self {
        let plan: Plan = Box::new(|_, _| None);
        let (held, gate) = (Arc::default(), Arc::new(Semaphore::new(0)));
        Self { inner, plan: Mutex::new(plan), wrongs: AtomicUsize::new(0), stall, held, gate }
    }

    /// Lets all held calls go on, also those that come later.
    pub(crate) fn let_go(&self) {
        self.gate.close();
    }

    /// Waits until the test lets go.
    fn hold(&self) -> impl Future<Output = ()> + Send + use<> {
        let (held, gate) = (Arc::clone(&self.held), Arc::clone(&self.gate));
        async move {
            let _one = Held::begin(held);
            drop(gate.acquire().await);
        }
    }

    pub(crate) fn plan(&self, plan: impl FnMut(&str, &Path) -> Option<Wrong> + Send + 'static) {
        *self.plan.lock().unwrap_or_else(PoisonError::into_inner) = Box::new(plan);
    }

    fn wrong(&self, what: &str, path: &Path) -> Option<Wrong> {
        let wrong = self.plan.lock().unwrap_or_else(PoisonError::into_inner)(what, path);
        self.wrongs.fetch_add(usize::from(wrong.is_some()), Ordering::Relaxed);
        wrong
    }
}

fn error(kind: std::io::ErrorKind) -> Error {
    Error::Generic { store: "faults", source: std::io::Error::from(kind).into() }
}

impl fmt::Debug for FaultStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "FaultStore({})", self.inner)
    }
}

impl fmt::Display for FaultStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self, f)
    }
}

#[async_trait::async_trait]
impl ObjectStore for FaultStore {
    async fn put_opts(
        &self,
        location: &Path,
        payload: PutPayload,
        opts: PutOptions,
    ) -> Result<PutResult> {
        use std::io::ErrorKind;
        match self.wrong("put", location) {
            None | Some(Wrong::Late) => self.inner.put_opts(location, payload, opts).await,
            Some(Wrong::Fails) => Err(error(ErrorKind::ConnectionReset)),
            Some(Wrong::Full) => Err(error(ErrorKind::StorageFull)),
            Some(Wrong::Held) => {
                self.hold().await;
                self.inner.put_opts(location, payload, opts).await
            }
            Some(Wrong::NoFolder) => Err(error(ErrorKind::NotFound)),
            Some(Wrong::Lost) => {
                self.inner.put_opts(location, payload, opts).await?;
                Err(error(ErrorKind::ConnectionReset))
            }
            Some(Wrong::Tears) => {
                let whole: Vec<u8> = payload.iter().flat_map(|part| part.to_vec()).collect();
                let half = PutPayload::from(whole[..whole.len() / 2].to_vec());
                self.inner.put_opts(location, half, opts).await?;
                Err(error(ErrorKind::UnexpectedEof))
            }
            Some(Wrong::Stalls) => {
                let (inner, location, stall) =
                    (Arc::clone(&self.inner), location.clone(), self.stall);
                // Its own task: it goes on when the caller has given up.
                let late = tokio::spawn(async move {
                    tokio::time::sleep(stall).await;
                    inner.put_opts(&location, payload, opts).await
                });
                late.await.unwrap_or_else(|_| Err(error(ErrorKind::TimedOut)))
            }
        }
    }

    async fn put_multipart_opts(
        &self,
        location: &Path,
        opts: PutMultipartOptions,
    ) -> Result<Box<dyn MultipartUpload>> {
        self.inner.put_multipart_opts(location, opts).await
    }

    async fn get_opts(&self, location: &Path, options: GetOptions) -> Result<GetResult> {
        match self.wrong("get", location) {
            None | Some(Wrong::Full) => self.inner.get_opts(location, options).await,
            Some(Wrong::Stalls) => {
                tokio::time::sleep(self.stall).await;
                self.inner.get_opts(location, options).await
            }
            Some(Wrong::Late) => {
                let found = self.inner.get_opts(location, options).await;
                tokio::time::sleep(self.stall).await;
                found
            }
            Some(_) => Err(error(std::io::ErrorKind::ConnectionReset)),
        }
    }

    fn delete_stream(
        &self,
        locations: BoxStream<'static, Result<Path>>,
    ) -> BoxStream<'static, Result<Path>> {
        // Callers of the tests delete one at a time.
        let inner = Arc::clone(&self.inner);
        let wrong = self.wrong("delete", &Path::default());
        match wrong {
            None
            | Some(Wrong::Full | Wrong::NoFolder | Wrong::Tears | Wrong::Stalls | Wrong::Late) => {
                inner.delete_stream(locations)
            }
            Some(Wrong::Held) => {
                let held = self.hold();
                stream::once(async move {
                    held.await;
                    inner.delete_stream(locations)
                })
                .flatten()
                .boxed()
            }
            Some(Wrong::Fails) => locations
                .and_then(|_| async { Err(error(std::io::ErrorKind::ConnectionReset)) })
                .boxed(),
            Some(Wrong::Lost) => inner
                .delete_stream(locations)
                .and_then(|_| async { Err(error(std::io::ErrorKind::ConnectionReset)) })
                .boxed(),
        }
    }

    fn list(&self, prefix: Option<&Path>) -> BoxStream<'static, Result<ObjectMeta>> {
        self.inner.list(prefix)
    }

    async fn list_with_delimiter(&self, prefix: Option<&Path>) -> Result<ListResult> {
        self.inner.list_with_delimiter(prefix).await
    }

    async fn copy_opts(&self, from: &Path, to: &Path, options: CopyOptions) -> Result<()> {
        self.inner.copy_opts(from, to, options).await
    }
}
