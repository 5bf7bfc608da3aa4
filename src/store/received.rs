//! Files of an upload that go to the store as they come, each as an object of its own.
//!
//! Beside the object that lists them, `upload.segsplat` or `added-*.segsplat`, lie `upload-00000`,
//! `upload-00001` and so on. The list is put last, and with it the upload is there: files without
//! it were never acknowledged. They go when the upload breaks off, and what a kill leaves of them
//! goes with the next sweep.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use object_store::path::Path as Name;
use sha2::{Digest, Sha256};

use super::{
    Record, Store,
    objects::{Objects, Writer},
    of, upload_file,
};
use crate::{
    error::{Error, ErrorCode, Result},
    names::hex,
    scene::{FilePart, KeptBytes, KeptFile, KeptFiles, SceneId, Upload},
};

/// Bytes that are gathered before they go on.
const PIECE_BYTES: usize = 1 << 20;
/// Bytes that are read at a time where a whole file is checked.
const CHECKED_BYTES: u64 = 8 << 20;
/// What the name of a list ends with.
const LIST: &str = ".segsplat";
/// How long other replicas leave files without a list alone: they cannot know of an upload that is
/// being received. One that takes longer may have to be sent again.
const RECEIVED_WITHIN: Duration = Duration::from_secs(6 * 60 * 60);

/// The object of a file of a list.
fn name_of(list: &str, number: usize) -> String {
    format!("{}-{number:05}", list.strip_suffix(LIST).unwrap_or(list))
}

/// The list of an object that is a file of one.
pub(super) fn list_of(object: &str) -> Option<String> {
    let (list, number) = object.rsplit_once('-')?;
    let is_number = number.len() >= 5 && number.bytes().all(|byte| byte.is_ascii_digit());
    is_number.then(|| format!("{list}{LIST}"))
}

/// Whether the object of this name is a list of such files, or may be one.
pub(super) fn is_list(object: &str) -> bool {
    object.ends_with(LIST)
}

/// A file of an upload in the store.
struct Stored {
    objects: Arc<Objects>,
    path: Name,
    sha256: String,
    size: u64,
    /// Whether it was read whole and is what was sent, or comes from this process.
    is_sound: AtomicBool,
    /// Until it is acknowledged.
    _place: Option<Arc<Place>>,
}

impl Stored {
    fn range(&self, from: u64, len: u64) -> Result<Vec<u8>> {
        let corrupt = |why: &str| {
            Error::new(
                ErrorCode::SceneCorrupt,
                format!("a file of the upload, {}, {why}", self.path),
            )
        };
        if from.saturating_add(len) > self.size {
            return Err(corrupt("is shorter"));
        }
        if len == 0 {
            return Ok(Vec::new());
        }
        let read =
            self.objects.get_range("read the photos", self.path.clone(), from..from + len)?;
        let read = read.ok_or_else(|| corrupt("is gone"))?;
        if read.len() as u64 == len { Ok(read) } else { Err(corrupt("is cut short")) }
    }

    fn checked(&self, hash: Sha256) -> Result<()> {
        if hex(&hash.finalize()) != self.sha256 {
            let why = format!("a file of the upload, {}, fails its checksum", self.path);
            return Err(Error::new(ErrorCode::SceneCorrupt, why));
        }
        Ok(())
    }
}

impl KeptBytes for Stored {
    fn read(&self, from: u64, len: u64) -> Result<Vec<u8>> {
        if from == 0 && len == self.size {
            let whole = self.range(from, len)?;
            self.checked(Sha256::new_with_prefix(&whole))?;
            return Ok(whole);
        }
        // An archive: once whole, then any part of it.
        if !self.is_sound.load(Ordering::Acquire) {
            let (mut hash, mut at) = (Sha256::new(), 0);
            while at < self.size {
                let piece = self.range(at, CHECKED_BYTES.min(self.size - at))?;
                hash.update(&piece);
                at += piece.len() as u64;
            }
            self.checked(hash)?;
            self.is_sound.store(true, Ordering::Release);
        }
        self.range(from, len)
    }
}

/// Where the files of an upload go. Without their list they are removed with it.
struct Place {
    store: Arc<Store>,
    scene: SceneId,
    list: String,
}

impl Drop for Place {
    fn drop(&mut self) {
        let (store, scene) = (Arc::clone(&self.store), self.scene.clone());
        let list = std::mem::take(&mut self.list);
        // It waits for the store, which the thread that drops it may not.
        let clear = move || {
            let cleared = store.clear_received(&scene, &list);
            store.receiving.lock().remove(&of(&scene, &list));
            if let Err(error) = cleared {
                tracing::warn!(%scene, %error, "what is left of an upload stays for a sweep");
            }
        };
        if let Err(error) = std::thread::Builder::new().name("received".to_owned()).spawn(clear) {
            tracing::warn!(%error, "files of an upload that broke off stay until the next start");
        }
    }
}

/// An upload whose files go to the store as they come.
pub(crate) struct Receiving {
    place: Arc<Place>,
    files: Vec<KeptFile>,
    open: Option<Open>,
}

/// A file that is being received.
struct Open {
    part: FilePart,
    name: String,
    writer: Writer,
    /// What is gathered of it.
    piece: Vec<u8>,
    hash: Sha256,
    size: u64,
}

impl std::fmt::Debug for Receiving {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Receiving({} files of {})", self.files.len(), self.place.scene)
    }
}

impl Receiving {
    /// Bytes that it takes in memory.
    pub(crate) const BYTES: usize = PIECE_BYTES + Writer::BYTES;

    /// Files that will be listed by the object `list` of a scene.
    /// Fails with `store_unavailable` where acknowledged scenes wait for room.
    pub(crate) async fn begin(store: &Arc<Store>, scene: SceneId, list: String) -> Result<Self> {
        store.receiving.lock().insert(of(&scene, &list));
        let place = Arc::new(Place { store: Arc::clone(store), scene, list });
        let looked = Arc::clone(store);
        let room = tokio::task::spawn_blocking(move || looked.has_room()).await;
        room.map_err(|e| Error::internal("nothing looks for room").caused_by(e))??;
        Ok(Self { place, files: Vec::new(), open: None })
    }

    /// Ends the file before, and begins one.
    pub(crate) async fn begin_file(&mut self, part: FilePart, name: String) -> Result<()> {
        self.end_file().await?;
        let object = name_of(&self.place.list, self.files.len());
        let path = of(&self.place.scene, &object);
        let writer = self.place.store.objects.writer("keep a file of the upload", path)?;
        let (piece, hash) = (Vec::new(), Sha256::new());
        self.open = Some(Open { part, name, writer, piece, hash, size: 0 });
        Ok(())
    }

    /// Adds bytes to the file that is open.
    pub(crate) async fn write(&mut self, bytes: &[u8]) -> Result<()> {
        let Some(open) = &mut self.open else {
            return Err(Error::internal("bytes of no file are received"));
        };
        open.hash.update(bytes);
        open.size += bytes.len() as u64;
        open.piece.extend_from_slice(bytes);
        if open.piece.len() >= PIECE_BYTES {
            open.writer.put(std::mem::take(&mut open.piece)).await?;
        }
        Ok(())
    }

    /// Ends the file that is open: it is safe on return.
    pub(crate) async fn end_file(&mut self) -> Result<()> {
        let Some(open) = self.open.take() else { return Ok(()) };
        let Open { part, name, mut writer, piece, hash, size } = open;
        writer.put(piece).await?;
        writer.end().await?;
        let Place { store, scene, list } = &*self.place;
        let sha256 = hex(&hash.finalize());
        let file = Stored {
            objects: Arc::clone(&store.objects),
            path: of(scene, &name_of(list, self.files.len())),
            sha256: sha256.clone(),
            size,
            is_sound: AtomicBool::new(true),
            _place: Some(Arc::clone(&self.place)),
        };
        self.files.push(KeptFile { part, name, size, sha256, bytes: Arc::new(file) });
        Ok(())
    }

    /// All files that came.
    pub(crate) async fn finish(mut self) -> Result<KeptFiles> {
        self.end_file().await?;
        let Place { scene, list, .. } = &*self.place;
        Ok(KeptFiles { scene: scene.clone(), list: list.clone(), files: self.files })
    }
}

impl Store {
    /// The upload in the object `list` of a scene, and the record it was acknowledged with.
    pub(super) fn read_upload(
        &self,
        file: &[u8],
        scene: &SceneId,
        list: &str,
    ) -> Result<(Upload, Record)> {
        let stored = |number: usize, sha256: &str, size: u64| -> Arc<dyn KeptBytes> {
            let (objects, path) = (Arc::clone(&self.objects), of(scene, &name_of(list, number)));
            let (sha256, is_sound) = (sha256.to_owned(), AtomicBool::new(false));
            Arc::new(Stored { objects, path, sha256, size, is_sound, _place: None })
        };
        upload_file::read(file, scene, list, &stored)
    }

    /// Removes the files of a list where there is no such list.
    fn clear_received(&self, scene: &SceneId, list: &str) -> Result<()> {
        let what = "forget an upload";
        if self.objects.exists(what, of(scene, list))? {
            return Ok(());
        }
        self.drop_files(scene, list)?;
        if let Some(folder) = self.folder() {
            // That of a scene which never was; one that holds others stays.
            let _ = std::fs::remove_dir(folder.join("scenes").join(scene.as_str()));
        }
        Ok(())
    }

    /// Removes the files of a list.
    pub(super) fn drop_files(&self, scene: &SceneId, list: &str) -> Result<()> {
        let what = "forget an upload";
        for object in self.objects.list(what, &format!("scenes/{scene}"))? {
            let own = object.path.filename().and_then(list_of);
            if own.as_deref() == Some(list) {
                self.objects.delete(what, object.path)?;
            }
        }
        Ok(())
    }

    /// Whether a file without a list may belong to an upload that is being received.
    pub(super) fn may_be_received(&self, scene: &SceneId, list: &str, age: Duration) -> bool {
        self.receiving.lock().contains(&of(scene, list)) || self.shared && age < RECEIVED_WITHIN
    }

    /// Fails where a sweep of another replica has removed files of an upload that took too long.
    pub(super) fn check_received(&self, kept: Option<&KeptFiles>) -> Result<()> {
        let Some(kept) = kept.filter(|_| self.shared) else { return Ok(()) };
        let what = "keep the upload";
        let objects = self.objects.list(what, &format!("scenes/{}", kept.scene))?;
        let names = objects.iter().filter_map(|object| object.path.filename().and_then(list_of));
        if names.filter(|list| *list == kept.list).count() >= kept.files.len() {
            return Ok(());
        }
        let why = "the upload took too long, and another replica removed its first files";
        Err(Error::new(ErrorCode::StoreUnavailable, why).retry_after_s(1))
    }
}
