//! Opening a folder or a bucket, and finding every scene in it, also after a crash.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
    thread,
    time::{Duration, Instant},
};

use fs_err as fs;
use object_store::{
    ClientOptions, ObjectStore, RetryConfig, aws::AmazonS3Builder, local::LocalFileSystem,
    path::Path as Name, prefix::PrefixStore,
};
use parking_lot::Mutex;

use super::{
    Cache, Objects, PROBE, Record, SCENE, STATUS, Store, UPLOAD, aside, new_id, of, pending, record,
};
use crate::{
    config::Config,
    error::{Error, ErrorCode, Result},
    formats::container::read_scene,
    limits::Limits,
    scene::{SceneError, SceneId, SceneState, SceneStatus},
};

/// How often a call to S3 is tried again, within `limits.store_timeout_ms`.
const S3_RETRIES_MAX: usize = 4;
/// Longest wait for the lock of a data folder, and the time between two looks at it.
const LOCK_WAIT: Duration = Duration::from_secs(1);
const LOCK_LOOK: Duration = Duration::from_millis(20);

/// All that a store puts into its folder or bucket lies under these.
const PREFIXES: [&str; 9] =
    ["scenes", "pending", "keys", "contents", "replicas", "claims", "growing", "deleted", PROBE];

/// Where scenes are kept.
#[derive(Clone, Debug)]
pub enum StoreLocation {
    /// A folder that this process alone uses.
    Folder(PathBuf),
    /// Objects that other replicas use too.
    Shared(Arc<dyn ObjectStore>),
    /// Objects that this process alone uses.
    Own(Arc<dyn ObjectStore>),
}

impl StoreLocation {
    /// What the configuration names: an S3-compatible bucket, else the data folder.
    ///
    /// # Errors
    /// `invalid_request` when the bucket cannot be used as it is named.
    pub fn of(config: &Config) -> Result<Self> {
        let Some((bucket, prefix)) = config.bucket()? else {
            return Ok(Self::Folder(config.data_dir.clone()));
        };
        crate::crypto::install();
        let timeout = Duration::from_millis(config.limits.store_timeout_ms);
        let client = ClientOptions::new()
            .with_allow_http(config.s3_allow_http)
            .with_connect_timeout(timeout.min(Duration::from_secs(5)))
            .with_timeout(timeout);
        // Keys come from the environment alone, by the names that every S3 tool knows.
        let mut builder = AmazonS3Builder::from_env()
            .with_bucket_name(bucket)
            .with_client_options(client)
            .with_retry(RetryConfig {
                max_retries: S3_RETRIES_MAX,
                retry_timeout: timeout,
                ..RetryConfig::default()
            });
        if let Some(endpoint) = &config.s3_endpoint {
            builder = builder.with_endpoint(endpoint);
        }
        if let Some(region) = &config.s3_region {
            builder = builder.with_region(region);
        }
        let s3 = builder.build().map_err(|e| {
            Error::invalid(format!("config: store s3://{bucket} cannot be used")).caused_by(e)
        })?;
        Ok(Self::Shared(if prefix.is_empty() {
            Arc::new(s3)
        } else {
            Arc::new(PrefixStore::new(s3, prefix))
        }))
    }
}

impl Store {
    /// Opens a place, and gives the record of every scene in it; none where replicas share it,
    /// which read scenes when they need them.
    ///
    /// A scene whose record is bad gets it back from its scene file or its upload; one that has
    /// neither is reported as failed with `scene_corrupt`.
    ///
    /// # Errors
    /// `store_unavailable` when the place cannot be used, or another process uses the folder.
    pub fn open(place: &StoreLocation, limits: &Limits) -> Result<(Self, Vec<Record>)> {
        let timeout = Duration::from_millis(limits.store_timeout_ms);
        let (objects, shared, lock) = match place {
            StoreLocation::Folder(root) => {
                let lock = lock(root)?;
                // The folder may hold other things: only ours are touched.
                PREFIXES.iter().for_each(|ours| clear_cut_off(&root.join(ours)));
                let (folder, local) = local(root)?;
                (Objects::new(Arc::new(local), Some(folder), timeout)?, false, Some(lock))
            }
            StoreLocation::Shared(store) => {
                (Objects::new(Arc::clone(store), None, timeout)?, true, None)
            }
            StoreLocation::Own(store) => {
                (Objects::new(Arc::clone(store), None, timeout)?, false, None)
            }
        };
        let store = Self {
            objects: Arc::new(objects),
            shared,
            cache: Cache::new(limits.cache_bytes_max),
            turns: Mutex::default(),
            arriving: Mutex::default(),
            receiving: Mutex::default(),
            gone: Mutex::default(),
            probe: Name::from(format!("{PROBE}/{}", new_id()?)),
            _lock: lock,
        };
        let records = if shared {
            // Only to know now, and not at the first call, whether it can be used.
            store.beats()?;
            Vec::new()
        } else {
            store.recover()?
        };
        Ok((store, records))
    }

    /// The record of every scene; what was never acknowledged is removed.
    fn recover(&self) -> Result<Vec<Record>> {
        let unfinished = self.unfinished()?;
        let mut ids: Vec<SceneId> = self.stamps()?.into_keys().collect();
        ids.sort();
        let what = "read the scenes";
        let statuses = ids.iter().map(|id| of(id, STATUS)).collect();
        let statuses = self.objects.get_all(what, statuses)?;
        let mut records = Vec::with_capacity(ids.len());
        for (id, status) in ids.iter().zip(statuses) {
            match status.as_deref().and_then(|file| sound(id, file)) {
                Some(record) => {
                    // Where a crash came between the status and the end of the pending record.
                    if unfinished.contains_key(id) {
                        self.objects.delete(what, pending(id))?;
                    }
                    records.push(record);
                }
                None if status.is_none() && !self.was_acknowledged(id)? => self.drop_pending(id)?,
                None => records.extend(find_record(self, id)?),
            }
        }
        Ok(records)
    }
}

/// The lock of a data folder. The process that had it may still be ending, or a child that it began
/// may hold it for a moment, until the child is another program.
fn lock(root: &Path) -> Result<fs::File> {
    let prepare = || -> std::io::Result<fs::File> {
        create_private(root)?;
        fs::OpenOptions::new().create(true).truncate(false).write(true).open(root.join("lock"))
    };
    let lock = prepare().map_err(|cause| Error::unavailable("open the data folder", cause))?;
    let begun = Instant::now();
    while let Err(cause) = lock.file().try_lock() {
        if begun.elapsed() >= LOCK_WAIT {
            let code = ErrorCode::StoreUnavailable;
            let why = format!("another process uses the data folder {}", root.display());
            return Err(Error::new(code, why).caused_by(cause));
        }
        thread::sleep(LOCK_LOOK);
    }
    Ok(lock)
}

/// Makes a folder, where there is none, that nobody else may read.
fn create_private(folder: &Path) -> std::io::Result<()> {
    let mut builder = std::fs::DirBuilder::new();
    builder.recursive(true);
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.create(folder)
}

fn local(root: &Path) -> Result<(PathBuf, LocalFileSystem)> {
    let folder = fs::canonicalize(root)
        .map_err(|cause| Error::unavailable("open the data folder", cause))?;
    let local = LocalFileSystem::new_with_prefix(&folder)
        .map_err(|fault| super::objects::unavailable("open the data folder", fault))?;
    Ok((folder, local.with_fsync(true).with_automatic_cleanup(true)))
}

/// Removes what a crash cut off and no listing shows: staging files, `NAME#NUMBER`, and folders of
/// which nothing is left.
fn clear_cut_off(folder: &Path) {
    let is_staged = |name: &std::ffi::OsStr| {
        let number = name.to_str().and_then(|name| name.rsplit_once('#'));
        number.is_some_and(|(_, number)| number.bytes().all(|byte| byte.is_ascii_digit()))
    };
    for file in fs::read_dir(folder).into_iter().flatten().flatten() {
        // A folder with anything in it stays, and does no harm.
        if file.file_type().is_ok_and(|kind| kind.is_dir()) {
            clear_cut_off(&file.path());
            let _ = fs::remove_dir(file.path());
        } else if is_staged(&file.file_name()) {
            let _ = fs::remove_file(file.path());
        }
    }
}

/// The record in a file, where it is whole and of this scene.
pub(super) fn sound(id: &SceneId, file: &[u8]) -> Option<Record> {
    record::unseal(file).ok().filter(|record| record.status.id == *id)
}

/// The newest record of a scene: its status, else what is pending, else what can be rebuilt. One
/// of another version is told as a failure, and stays where it is for that version.
pub(super) fn find_record(store: &Store, id: &SceneId) -> Result<Option<Record>> {
    let what = "read a status";
    let status = || store.objects.get(what, of(id, STATUS));
    let mut found = status()?;
    let mut is_status = found.is_some();
    if !is_status {
        found = store.objects.get(what, pending(id))?;
    }
    if found.is_none() {
        // A scene that ends has its status before it pends no more.
        found = status()?;
        is_status = found.is_some();
    }
    let Some(file) = found else { return Ok(None) };
    let error = match record::unseal(&file) {
        Ok(record) if record.status.id == *id => return Ok(Some(record)),
        Ok(_) => Error::new(ErrorCode::SceneCorrupt, "the scene's status is another scene's"),
        Err(error) => error,
    };
    let failed = |error: &Error| {
        Record::new(SceneStatus {
            error: Some(SceneError::from(error)),
            ..SceneStatus::new(id.clone(), SceneState::Failed, super::now_ms())
        })
    };
    if error.code() == ErrorCode::OtherVersion {
        tracing::error!(scene = %id, error = %error, "a scene's status is left as it is");
        return Ok(Some(failed(&error)));
    }
    tracing::error!(scene = %id, error = %error, "a scene's status is bad; rebuilding it");
    let rebuilt = match from_scene(store, id)? {
        None => from_upload(store, id)?,
        found => found,
    };
    let rebuilt = rebuilt.unwrap_or_else(|| failed(&error));
    let put_aside = if is_status {
        let what = "put a bad status aside";
        store.objects.rename(what, of(id, STATUS), of(id, &aside(STATUS)))
    } else {
        Ok(())
    };
    let kept = put_aside.and_then(|()| store.put_record(&rebuilt));
    if let Err(error) = kept {
        tracing::error!(scene = %id, %error, "the rebuilt status cannot be written");
    }
    Ok(Some(rebuilt))
}

fn from_scene(store: &Store, id: &SceneId) -> Result<Option<Record>> {
    let Some(file) = store.objects.get("read the scene", of(id, SCENE))? else { return Ok(None) };
    let Ok((scene, sha256)) = read_scene(&file) else { return Ok(None) };
    let meta = scene.meta;
    if meta.id != *id {
        return Ok(None);
    }
    let growth = store.growth_of(&meta)?;
    let status = SceneStatus {
        fraction: 1.0,
        report: Some(meta.report),
        cameras: meta.cameras,
        version: 1,
        growth: growth.status(),
        ..SceneStatus::new(id.clone(), SceneState::Done, meta.created_ms)
    };
    // Without the upload only an admin sees it: better than the wrong owner.
    let owner = first_record(store, id)?.and_then(|record| record.owner);
    Ok(Some(Record {
        owner,
        options: meta.provenance.options,
        attempts: 1,
        growth,
        scene_sha256: Some(sha256),
        content_sha256: Some(meta.provenance.content_sha256).filter(|hash| !hash.is_empty()),
        ..Record::new(status)
    }))
}

fn from_upload(store: &Store, id: &SceneId) -> Result<Option<Record>> {
    let bad = store.objects.exists("look for a bad scene", of(id, &aside(SCENE)))?;
    if bad { Ok(None) } else { first_record(store, id) }
}

/// The record that the upload was kept with.
fn first_record(store: &Store, id: &SceneId) -> Result<Option<Record>> {
    let Some(file) = store.objects.get("read the upload", of(id, UPLOAD))? else { return Ok(None) };
    let read = store.read_upload(&file, id, UPLOAD);
    let record = read.ok().map(|(_, record)| record);
    Ok(record.filter(|record| record.status.id == *id))
}
