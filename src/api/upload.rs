//! Collects an upload piece by piece and stops at the first byte over a limit.
//!
//! HTTP and gRPC feed it as the bytes arrive, so a camera JSON of 200 MB is refused after 8 MiB.
//! The first `upload_memory_bytes_max` bytes stay in memory, files after them go to the store as
//! they come. All uploads together have a budget of memory.

use std::{
    collections::HashSet,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
};

use crate::{
    error::{Error, ErrorCode, Result, short},
    limits::Limits,
    scene::{FilePart, SceneId, Upload, UploadCameras, UploadFile},
    service::{Receiving, Service},
    telemetry::meter,
};

/// Bytes that all open uploads may hold together.
#[derive(Clone, Debug)]
pub(super) struct UploadBudget {
    held: Arc<AtomicUsize>,
    max: usize,
}

impl UploadBudget {
    pub(super) fn new(max: usize) -> Self {
        Self { held: Arc::default(), max }
    }

    /// Bytes held now.
    pub(super) fn held_bytes(&self) -> usize {
        self.held.load(Ordering::Relaxed)
    }
}

/// What the archive of an upload is called where its files are listed.
const ARCHIVE: &str = "archive";

/// What the next bytes belong to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Current {
    Nothing,
    Cameras,
    Photo,
    Archive,
    Splats,
}

/// An upload that is being read.
#[derive(Debug)]
pub(super) struct UploadBuilder<'a> {
    limits: &'a Limits,
    guard: UploadGuard,
    current: Current,
    upload: Upload,
    names: HashSet<String>,
    has_archive: bool,
    has_splats: bool,
    /// Photos that there must be.
    photos_min: usize,
    /// Who keeps what does not stay in memory, and the scene that the photos join.
    keeper: Option<(Service, Option<SceneId>)>,
    /// What goes to the store.
    receiving: Option<Receiving>,
    /// Whether the file that is being read stays in memory, its name, and its bytes so far.
    is_here: bool,
    file: String,
    file_bytes: usize,
}

impl<'a> UploadBuilder<'a> {
    /// An empty upload.
    pub(super) fn new(limits: &'a Limits, budget: &UploadBudget) -> Self {
        Self {
            limits,
            guard: UploadGuard::new(budget),
            current: Current::Nothing,
            upload: Upload::default(),
            names: HashSet::new(),
            has_archive: false,
            has_splats: false,
            photos_min: limits.photos_min,
            keeper: None,
            receiving: None,
            is_here: true,
            file: String::new(),
            file_bytes: 0,
        }
    }

    /// The same where the store takes what does not stay in memory: files of a new scene, or of
    /// photos that join `scene`.
    pub(super) fn kept_by(self, service: &Service, scene: Option<SceneId>) -> Self {
        Self { keeper: Some((service.clone(), scene)), ..self }
    }

    /// The same for an upload of so many photos at least.
    pub(super) fn at_least(self, photos_min: usize) -> Self {
        Self { photos_min, ..self }
    }

    /// Begins the camera description, with the bytes that are in it.
    pub(super) fn begin_cameras(&mut self, cameras: UploadCameras) -> Result<()> {
        if self.upload.cameras.is_some() {
            return Err(Error::invalid(
                "upload: camera description given twice; send transforms or cameras once",
            ));
        }
        let (UploadCameras::Transforms(json) | UploadCameras::Cameras(json)) = &cameras;
        let len = json.len();
        self.upload.cameras = Some(cameras);
        self.current = Current::Cameras;
        self.account(len)?;
        self.check_json()
    }

    /// Begins the photo `name`, or a camera file of a capture.
    pub(super) async fn begin_photo(&mut self, name: &str) -> Result<()> {
        let count = self.names.len();
        self.check_name(&format!("photo {count}"), name)?;
        let max = self.limits.archive_entries_max;
        if count >= max {
            return Err(Error::limit(
                "upload",
                format!("file {name:?} is number {}", count + 1),
                format!("{max} files an upload"),
            ));
        }
        if !self.names.insert(name.to_owned()) {
            return Err(Error::invalid(format!("upload: photo {name:?} was sent twice")));
        }
        if self.begin_file(Current::Photo, FilePart::Photo, name).await? {
            self.upload.photos.push(UploadFile { name: name.to_owned(), bytes: Vec::new() });
        }
        Ok(())
    }

    /// Begins the file of Gaussians `name`.
    pub(super) async fn begin_splats(&mut self, name: &str) -> Result<()> {
        if std::mem::replace(&mut self.has_splats, true) {
            return Err(Error::invalid("upload: two files of Gaussians; a scene is one"));
        }
        self.check_name("splats", name)?;
        if self.begin_file(Current::Splats, FilePart::Splats, name).await? {
            self.upload.splats = Some(UploadFile { name: name.to_owned(), bytes: Vec::new() });
        }
        Ok(())
    }

    /// Begins the archive, or goes on with it.
    pub(super) async fn begin_archive(&mut self) -> Result<()> {
        if self.current == Current::Archive {
            return Ok(());
        }
        if std::mem::replace(&mut self.has_archive, true) {
            return Err(Error::invalid("upload: two archives; a scene is one"));
        }
        if self.begin_file(Current::Archive, FilePart::Archive, ARCHIVE).await? {
            self.upload.archive = Some(Vec::new());
        }
        Ok(())
    }

    /// Begins a file in the store, where files go there by now; else it is to be in memory.
    async fn begin_file(&mut self, current: Current, part: FilePart, name: &str) -> Result<bool> {
        (self.current, self.file, self.file_bytes) = (current, name.to_owned(), 0);
        self.is_here = self.receiving.is_none();
        if let Some(receiving) = &mut self.receiving {
            receiving.begin_file(part, name.to_owned()).await?;
        }
        Ok(self.is_here)
    }

    /// Adds bytes to what was begun last.
    pub(super) async fn extend(&mut self, bytes: &[u8]) -> Result<()> {
        self.guard.receive("upload", bytes.len(), self.limits.upload_bytes_max)?;
        if self.current != Current::Cameras {
            self.check_file(bytes.len())?;
            let max = self.limits.upload_memory_bytes_max;
            if self.is_here && self.guard.held.saturating_add(bytes.len()) > max {
                self.go_to_store().await?;
            }
            if let (false, Some(receiving)) = (self.is_here, &mut self.receiving) {
                return receiving.write(bytes).await;
            }
        }
        self.guard.hold(bytes.len())?;
        let upload = &mut self.upload;
        let file = match self.current {
            Current::Nothing => None,
            Current::Cameras => upload
                .cameras
                .as_mut()
                .map(|(UploadCameras::Transforms(json) | UploadCameras::Cameras(json))| json),
            Current::Photo => upload.photos.last_mut().map(|photo| &mut photo.bytes),
            Current::Archive => upload.archive.as_mut(),
            Current::Splats => upload.splats.as_mut().map(|file| &mut file.bytes),
        };
        let file = file.ok_or_else(|| Error::invalid("upload: bytes before any file's name"))?;
        file.extend_from_slice(bytes);
        if self.current == Current::Cameras { self.check_json() } else { Ok(()) }
    }

    /// The file that is being read goes to the store from now on, and so do those after it.
    async fn go_to_store(&mut self) -> Result<()> {
        let Some((service, scene)) = &self.keeper else { return Ok(()) };
        let upload = &mut self.upload;
        let (part, file) = match self.current {
            Current::Nothing | Current::Cameras => return Ok(()),
            Current::Photo => (FilePart::Photo, upload.photos.pop()),
            Current::Splats => (FilePart::Splats, upload.splats.take()),
            Current::Archive => {
                let file = |bytes| UploadFile { name: ARCHIVE.to_owned(), bytes };
                (FilePart::Archive, upload.archive.take().map(file))
            }
        };
        let Some(UploadFile { name, bytes }) = file else { return Ok(()) };
        self.guard.hold(Receiving::BYTES)?;
        let mut receiving = service.receiving(scene.as_ref()).await?;
        receiving.begin_file(part, name).await?;
        receiving.write(&bytes).await?;
        self.guard.release(bytes.len());
        (self.receiving, self.is_here) = (Some(receiving), false);
        Ok(())
    }

    /// The whole upload; its bytes count against the budget until the guard is dropped.
    pub(super) async fn finish(self) -> Result<(Upload, UploadGuard)> {
        let mut upload = self.upload;
        if let Some(receiving) = self.receiving {
            upload.kept = Some(receiving.finish().await?);
        }
        let (min, photos) = (self.photos_min, upload.sent().count());
        let archive = upload.sent_archive().map(drop);
        if upload.sent_splats().is_some() {
            let others = photos > 0 || upload.cameras.is_some() || archive.is_some();
            let why = "upload: a file of Gaussians is a whole scene; send it without other files";
            return if others { Err(Error::invalid(why)) } else { Ok((upload, self.guard)) };
        }
        let wrong = match (archive, &upload.cameras) {
            (Some(_), Some(_)) => {
                "an archive holds its own camera description; send one or the other".to_owned()
            }
            (Some(_), None) if photos > 0 => {
                "an archive holds its own photos; send one or the other".to_owned()
            }
            (None, None) if photos == 0 => format!(
                "no photos and no cameras; send transforms or cameras and {min} photos or more, \
                 the files of a capture, an archive, or splats"
            ),
            (None, Some(_)) if photos < min => {
                let s = if photos == 1 { "" } else { "s" };
                format!("{photos} photo{s}; a scene needs at least {min}")
            }
            _ => return Ok((upload, self.guard)),
        };
        Err(Error::invalid(format!("upload: {wrong}")))
    }

    fn check_name(&self, what: &str, name: &str) -> Result<()> {
        let (bytes, max) = (name.len(), self.limits.file_name_bytes_max);
        if bytes > max {
            let what = format!("{what}: file name");
            return Err(Error::limit(what, format!("{bytes} bytes"), format!("{max} bytes")));
        }
        Ok(())
    }

    fn account(&mut self, bytes: usize) -> Result<()> {
        self.guard.account("upload", bytes, self.limits.upload_bytes_max)
    }

    /// Counts the next bytes of a file, which is in memory when it is read.
    fn check_file(&mut self, bytes: usize) -> Result<()> {
        self.file_bytes = self.file_bytes.saturating_add(bytes);
        let (bytes, max) = (self.file_bytes, self.limits.upload_file_bytes_max);
        if self.current != Current::Archive && bytes > max {
            let file = format!("file {:?} of {bytes} bytes so far", short(&self.file));
            return Err(Error::limit("upload", file, format!("{max} bytes")));
        }
        Ok(())
    }

    fn check_json(&self) -> Result<()> {
        let (name, json) = match &self.upload.cameras {
            Some(UploadCameras::Transforms(json)) => ("transforms", json),
            Some(UploadCameras::Cameras(json)) => ("cameras", json),
            None => return Ok(()),
        };
        if json.len() > self.limits.json_bytes_max {
            return Err(json_over(name, json.len(), self.limits));
        }
        Ok(())
    }
}

/// Refuses a bundle that is not the loaded one; an empty name stands for the loaded one.
pub(super) fn check_bundle(asked: &str, loaded: &str) -> Result<()> {
    if asked.is_empty() || asked == loaded {
        return Ok(());
    }
    let message = format!("bundle is {:?}; this server has {loaded:?} loaded", short(asked));
    Err(Error::new(ErrorCode::ModelUnavailable, message))
}

/// The error of a JSON part of at least `len` bytes.
pub(super) fn json_over(name: &str, len: usize, limits: &Limits) -> Error {
    Error::limit(
        name,
        format!("{len} bytes of JSON so far"),
        format!("{} bytes", limits.json_bytes_max),
    )
}

/// Keeps an upload's bytes counted while it is being handled.
#[derive(Debug)]
pub(super) struct UploadGuard {
    budget: UploadBudget,
    /// Bytes that came.
    received: usize,
    /// Bytes of them in memory.
    held: usize,
}

impl UploadGuard {
    /// Counts nothing yet.
    pub(super) fn new(budget: &UploadBudget) -> Self {
        Self { budget: budget.clone(), received: 0, held: 0 }
    }

    /// Counts the next bytes of `what`, of which `max` are taken, and which stay in memory.
    pub(super) fn account(&mut self, what: &str, bytes: usize, max: usize) -> Result<()> {
        let received = self.receive(what, bytes, max);
        let held = self.hold(bytes);
        received.and(held)
    }

    /// Counts the next bytes of `what`, of which `max` are taken.
    fn receive(&mut self, what: &str, bytes: usize, max: usize) -> Result<()> {
        self.received = self.received.saturating_add(bytes);
        meter::uploaded(bytes);
        if self.received > max {
            let (received, max) =
                (format!("{} bytes so far", self.received), format!("{max} bytes"));
            return Err(Error::limit(what, received, max));
        }
        Ok(())
    }

    /// Counts bytes that stay in memory.
    fn hold(&mut self, bytes: usize) -> Result<()> {
        self.held += bytes;
        let all = self.budget.held.fetch_add(bytes, Ordering::Relaxed) + bytes;
        let max = self.budget.max;
        if all > max {
            let message = format!("all uploads hold {all} bytes, over {max} bytes; try again");
            return Err(Error::new(ErrorCode::Overloaded, message).retry_after_s(2));
        }
        Ok(())
    }

    /// Bytes that were held are in memory no more.
    fn release(&mut self, bytes: usize) {
        let bytes = bytes.min(self.held);
        self.held -= bytes;
        self.budget.held.fetch_sub(bytes, Ordering::Relaxed);
    }
}

impl Drop for UploadGuard {
    fn drop(&mut self) {
        self.budget.held.fetch_sub(self.held, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    // The messages are tested over HTTP, in `tests/it/uploads.rs`.
    #[tokio::test]
    async fn all_uploads_together_keep_to_the_budget_until_their_guards_drop() {
        let limits = Limits { upload_bytes_max: 100, ..Limits::default() };
        let budget = UploadBudget::new(150);
        let archive = async || {
            let mut upload = UploadBuilder::new(&limits, &budget);
            upload.begin_archive().await?;
            upload.extend(&[0; 90]).await.map(|()| upload)
        };
        let (_, guard) = archive().await.unwrap().finish().await.unwrap();
        assert_eq!(archive().await.unwrap_err().code(), ErrorCode::Overloaded);
        drop(guard);
        drop(archive().await.unwrap());
        assert_eq!(budget.held_bytes(), 0);
        let nameless = UploadBuilder::new(&limits, &budget).extend(b"x").await.unwrap_err();
        assert!(nameless.message().contains("before any file's name"), "{nameless}");
    }
}
