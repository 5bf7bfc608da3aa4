//! Collects an upload piece by piece and stops at the first byte over a cap.
//!
//! Both doors feed it as the bytes arrive, so a 200 MB camera JSON is refused after 8 MiB and the
//! 65th photo before its first pixel. All uploads together are held to a budget of memory.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
    scene::{Upload, UploadCameras, UploadFile},
    service::ModelsInfo,
    telemetry::meter,
};

/// Bytes that all uploads in flight may hold together.
#[derive(Clone, Debug)]
pub(super) struct UploadBudget {
    held: Arc<AtomicUsize>,
    max: usize,
}

impl UploadBudget {
    /// A budget of `max` bytes.
    pub(super) fn new(max: usize) -> Self {
        Self { held: Arc::default(), max }
    }

    /// Bytes held now.
    pub(super) fn held_bytes(&self) -> usize {
        self.held.load(Ordering::Relaxed)
    }
}

/// What the bytes that follow belong to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Current {
    Nothing,
    Cameras,
    Photo,
    Archive,
}

/// An upload on its way in.
#[derive(Debug)]
pub(super) struct UploadBuilder<'a> {
    limits: &'a Limits,
    guard: UploadGuard,
    current: Current,
    upload: Upload,
}

impl<'a> UploadBuilder<'a> {
    /// An empty upload.
    pub(super) fn new(limits: &'a Limits, budget: &UploadBudget) -> Self {
        Self {
            limits,
            guard: UploadGuard { budget: budget.clone(), held: 0 },
            current: Current::Nothing,
            upload: Upload::default(),
        }
    }

    /// The camera description follows.
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

    /// The photo `name` follows.
    pub(super) fn begin_photo(&mut self, name: &str) -> Result<()> {
        let max = self.limits.file_name_bytes_max;
        if name.len() > max {
            return Err(Error::limit(
                format!("photo {}: file name", self.upload.photos.len()),
                format!("{} bytes", name.len()),
                format!("{max} bytes"),
            ));
        }
        if self.upload.photos.len() >= self.limits.photos_max {
            return Err(Error::limit(
                "upload",
                format!("photo {name:?} is number {}", self.upload.photos.len() + 1),
                format!("{} photos a scene", self.limits.photos_max),
            ));
        }
        if self.upload.photos.iter().any(|photo| photo.name == name) {
            return Err(Error::invalid(format!("upload: photo {name:?} was sent twice")));
        }
        self.upload.photos.push(UploadFile { name: name.to_owned(), bytes: Vec::new() });
        self.current = Current::Photo;
        Ok(())
    }

    /// The archive follows, or goes on.
    pub(super) fn begin_archive(&mut self) {
        self.upload.archive.get_or_insert_default();
        self.current = Current::Archive;
    }

    /// Adds bytes to what was begun last.
    pub(super) fn extend(&mut self, bytes: &[u8]) -> Result<()> {
        self.account(bytes.len())?;
        match self.current {
            Current::Nothing => return Err(Error::invalid("upload: bytes before any file's name")),
            Current::Cameras => {
                if let Some(UploadCameras::Transforms(json) | UploadCameras::Cameras(json)) =
                    &mut self.upload.cameras
                {
                    json.extend_from_slice(bytes);
                }
                self.check_json()?;
            }
            Current::Photo => {
                if let Some(photo) = self.upload.photos.last_mut() {
                    photo.bytes.extend_from_slice(bytes);
                }
            }
            Current::Archive => {
                self.upload.archive.get_or_insert_default().extend_from_slice(bytes);
            }
        }
        Ok(())
    }

    /// The whole upload; its bytes count against the budget until the guard is dropped.
    pub(super) fn finish(self) -> Result<(Upload, UploadGuard)> {
        let upload = self.upload;
        let min = self.limits.photos_min;
        let photos = upload.photos.len();
        match (&upload.archive, &upload.cameras) {
            (Some(_), Some(_)) => {
                return Err(Error::invalid(
                    "upload: an archive holds its own camera description; send one or the other",
                ));
            }
            (Some(_), None) if photos > 0 => {
                return Err(Error::invalid(
                    "upload: an archive holds its own photos; send one or the other",
                ));
            }
            (Some(_), None) => {}
            (None, None) if photos == 0 => {
                return Err(Error::invalid(format!(
                    "upload: no photos and no cameras; send transforms or cameras and {min} to {} \
                     photos, or an archive",
                    self.limits.photos_max
                )));
            }
            (None, None) => {
                return Err(Error::invalid(
                    "upload: no camera description; send a part named transforms or cameras",
                ));
            }
            (None, Some(_)) if photos < min => {
                return Err(Error::invalid(format!(
                    "upload: {photos} photo{}; a scene needs at least {min}",
                    if photos == 1 { "" } else { "s" }
                )));
            }
            (None, Some(_)) => {}
        }
        Ok((upload, self.guard))
    }

    fn account(&mut self, bytes: usize) -> Result<()> {
        let guard = &mut self.guard;
        guard.held += bytes;
        meter::uploaded(bytes);
        let all = guard.budget.held.fetch_add(bytes, Ordering::Relaxed) + bytes;
        if guard.held > self.limits.upload_bytes_max {
            return Err(Error::limit(
                "upload",
                format!("{} bytes so far", guard.held),
                format!("{} bytes", self.limits.upload_bytes_max),
            ));
        }
        if all > guard.budget.max {
            let message = format!(
                "uploads at work hold {all} bytes, over {} bytes; try again",
                guard.budget.max
            );
            return Err(Error::new(ErrorCode::Overloaded, message).retry_after_s(2));
        }
        Ok(())
    }

    fn check_json(&self) -> Result<()> {
        let (name, len) = match &self.upload.cameras {
            Some(UploadCameras::Transforms(json)) => ("transforms", json.len()),
            Some(UploadCameras::Cameras(json)) => ("cameras", json.len()),
            None => return Ok(()),
        };
        if len > self.limits.json_bytes_max {
            return Err(json_over(name, len, self.limits));
        }
        Ok(())
    }
}

/// Refuses a bundle that is not the loaded one; an empty name is the loaded one's.
pub(super) fn check_bundle(asked: &str, models: &ModelsInfo) -> Result<()> {
    if asked.is_empty() || asked == models.bundle {
        return Ok(());
    }
    let shown: String = asked.chars().take(40).collect();
    Err(Error::new(
        ErrorCode::ModelUnavailable,
        format!("bundle is {shown:?}; this server has {:?} loaded", models.bundle),
    ))
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

impl Drop for UploadGuard {
    fn drop(&mut self) {
        self.budget.held.fetch_sub(self.held, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn limits() -> Limits {
        Limits { photos_max: 3, json_bytes_max: 10, upload_bytes_max: 100, ..Limits::default() }
    }

    fn message<T>(result: Result<T>) -> (ErrorCode, String) {
        let error = result.err().expect("refused");
        (error.code(), error.message().to_owned())
    }

    #[test]
    fn caps_stop_at_the_first_byte_over_and_name_the_bound() {
        let (limits, budget) = (limits(), UploadBudget::new(1_000));
        let mut upload = UploadBuilder::new(&limits, &budget);
        upload.begin_cameras(UploadCameras::Transforms(Vec::new())).unwrap();
        upload.extend(&[b' '; 10]).unwrap();
        let (code, text) = message(upload.extend(b" "));
        assert_eq!(code, ErrorCode::LimitExceeded);
        assert!(text.contains("11 bytes") && text.contains("10 bytes"), "{text}");
        drop(upload);

        let mut upload = UploadBuilder::new(&limits, &budget);
        for name in ["a.png", "b.png", "c.png"] {
            upload.begin_photo(name).unwrap();
        }
        assert_eq!(message(upload.begin_photo("d.png")).0, ErrorCode::LimitExceeded);
        assert_eq!(message(upload.extend(&[0; 101])).0, ErrorCode::LimitExceeded);
        assert!(message(upload.begin_photo(&"x".repeat(257))).1.contains("257 bytes"));
        drop(upload);
        assert_eq!(budget.held.load(Ordering::Relaxed), 0, "bytes stay counted after a refusal");
    }

    #[test]
    fn all_uploads_together_keep_to_the_budget_until_their_guards_drop() {
        let (limits, budget) = (limits(), UploadBudget::new(150));
        let mut first = UploadBuilder::new(&limits, &budget);
        first.begin_archive();
        first.extend(&[0; 90]).unwrap();
        let (_, guard) = first.finish().unwrap();
        let mut second = UploadBuilder::new(&limits, &budget);
        second.begin_archive();
        assert_eq!(message(second.extend(&[0; 90])).0, ErrorCode::Overloaded);
        drop((second, guard));
        let mut third = UploadBuilder::new(&limits, &budget);
        third.begin_archive();
        third.extend(&[0; 90]).unwrap();
    }

    #[test]
    fn an_upload_that_cannot_be_a_scene_says_what_is_missing() {
        let (limits, budget) = (limits(), UploadBudget::new(1_000));
        let new = || UploadBuilder::new(&limits, &budget);
        assert!(message(new().finish()).1.contains("no photos"));
        let mut one = new();
        one.begin_photo("a.png").unwrap();
        assert!(message(one.begin_photo("a.png")).1.contains("twice"));
        assert!(message(one.finish()).1.contains("no camera description"));
        let mut one = new();
        one.begin_cameras(UploadCameras::Cameras(b"{}".to_vec())).unwrap();
        one.begin_photo("a.png").unwrap();
        assert!(message(one.finish()).1.contains("1 photo; a scene needs at least 2"));
        assert!(message(new().extend(b"x")).1.contains("before any file's name"));
    }
}
