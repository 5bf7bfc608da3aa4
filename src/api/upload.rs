//! Collects an upload piece by piece and stops at the first byte over a limit.
//!
//! HTTP and gRPC feed it as the bytes arrive, so a camera JSON of 200 MB is refused after 8 MiB.
//! All uploads together have a budget of memory.

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
    scene::{Upload, UploadCameras, UploadFile},
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
    /// Photos that there must be.
    photos_min: usize,
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
            photos_min: limits.photos_min,
        }
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
    pub(super) fn begin_photo(&mut self, name: &str) -> Result<()> {
        let count = self.upload.photos.len();
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
        self.upload.photos.push(UploadFile { name: name.to_owned(), bytes: Vec::new() });
        self.current = Current::Photo;
        Ok(())
    }

    /// Begins the file of Gaussians `name`.
    pub(super) fn begin_splats(&mut self, name: &str) -> Result<()> {
        if self.upload.splats.is_some() {
            return Err(Error::invalid("upload: two files of Gaussians; a scene is one"));
        }
        self.check_name("splats", name)?;
        self.upload.splats = Some(UploadFile { name: name.to_owned(), bytes: Vec::new() });
        self.current = Current::Splats;
        Ok(())
    }

    /// Begins the archive, or goes on with it.
    pub(super) fn begin_archive(&mut self) {
        self.upload.archive.get_or_insert_default();
        self.current = Current::Archive;
    }

    /// Adds bytes to what was begun last.
    pub(super) fn extend(&mut self, bytes: &[u8]) -> Result<()> {
        self.account(bytes.len())?;
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

    /// The whole upload; its bytes count against the budget until the guard is dropped.
    pub(super) fn finish(self) -> Result<(Upload, UploadGuard)> {
        let upload = self.upload;
        let (min, photos) = (self.photos_min, upload.photos.len());
        if upload.splats.is_some() {
            let others = photos > 0 || upload.cameras.is_some() || upload.archive.is_some();
            let why = "upload: a file of Gaussians is a whole scene; send it without other files";
            return if others { Err(Error::invalid(why)) } else { Ok((upload, self.guard)) };
        }
        let wrong = match (&upload.archive, &upload.cameras) {
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
    held: usize,
}

impl UploadGuard {
    /// Counts nothing yet.
    pub(super) fn new(budget: &UploadBudget) -> Self {
        Self { budget: budget.clone(), held: 0 }
    }

    /// Counts the next bytes of `what`, of which `max` are taken.
    pub(super) fn account(&mut self, what: &str, bytes: usize, max: usize) -> Result<()> {
        self.held += bytes;
        meter::uploaded(bytes);
        let all = self.budget.held.fetch_add(bytes, Ordering::Relaxed) + bytes;
        if self.held > max {
            let (held, max) = (format!("{} bytes so far", self.held), format!("{max} bytes"));
            return Err(Error::limit(what, held, max));
        }
        let max = self.budget.max;
        if all > max {
            let message = format!("all uploads hold {all} bytes, over {max} bytes; try again");
            return Err(Error::new(ErrorCode::Overloaded, message).retry_after_s(2));
        }
        Ok(())
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
    #[test]
    fn all_uploads_together_keep_to_the_budget_until_their_guards_drop() {
        let limits = Limits { upload_bytes_max: 100, ..Limits::default() };
        let budget = UploadBudget::new(150);
        let archive = || {
            let mut upload = UploadBuilder::new(&limits, &budget);
            upload.begin_archive();
            upload.extend(&[0; 90]).map(|()| upload)
        };
        let (_, guard) = archive().unwrap().finish().unwrap();
        assert_eq!(archive().unwrap_err().code(), ErrorCode::Overloaded);
        drop(guard);
        drop(archive().unwrap());
        assert_eq!(budget.held_bytes(), 0);
        let nameless = UploadBuilder::new(&limits, &budget).extend(b"x").unwrap_err();
        assert!(nameless.message().contains("before any file's name"), "{nameless}");
    }
}
