//! Photos of jobs in memory: what the create call read is not read again by its jobs.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use crate::{
    pipeline::PhotoSet,
    scene::{PhotoHash, SceneId},
};

/// An upload as its jobs need it.
#[derive(Debug)]
pub(super) struct ReadUpload {
    pub(super) files: Vec<PhotoHash>,
    pub(super) photos: PhotoSet,
}

/// Uploads of scenes whose jobs wait or run, bounded by the bytes of their photos. One that does
/// not fit is read from the store when its job begins.
#[derive(Debug)]
pub(super) struct ReadUploads {
    bytes_max: u64,
    inner: Mutex<HashMap<SceneId, Arc<ReadUpload>>>,
}

impl ReadUploads {
    pub(super) fn new(bytes_max: u64) -> Self {
        Self { bytes_max, inner: Mutex::default() }
    }

    /// Keeps an upload until it is forgotten, where it fits.
    pub(super) fn keep(&self, id: &SceneId, upload: Arc<ReadUpload>) {
        let mut kept = self.lock();
        let held: u64 = kept.values().map(|upload| upload.photos.size_bytes()).sum();
        if held + upload.photos.size_bytes() <= self.bytes_max {
            kept.insert(id.clone(), upload);
        }
    }

    pub(super) fn find(&self, id: &SceneId) -> Option<Arc<ReadUpload>> {
        self.lock().get(id).cloned()
    }

    pub(super) fn forget(&self, id: &SceneId) {
        self.lock().remove(id);
    }

    fn lock(&self) -> MutexGuard<'_, HashMap<SceneId, Arc<ReadUpload>>> {
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Camera, CameraToWorld, Intrinsics, Photo, PosedPhoto};

    fn upload(bytes: usize) -> Arc<ReadUpload> {
        let lens = Intrinsics { fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5, width: 1, height: 1 };
        let pose = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        let pose = [&pose[..], &[0.0, 0.0, 0.0, 1.0]].concat();
        let pose: [f64; 16] = pose.try_into().expect("16 numbers");
        let camera_to_world = CameraToWorld::from_row_major(&pose, "test").unwrap();
        let photo = PosedPhoto {
            file: "a".to_owned(),
            photo: Photo { width: 1, height: 1, rgb: vec![0; bytes], valid: None },
            camera: Camera { intrinsics: lens, camera_to_world },
            intrinsics_made_for: None,
        };
        let photos = PhotoSet { photos: vec![photo], read_ms: 0.0 };
        Arc::new(ReadUpload { files: Vec::new(), photos })
    }

    #[test]
    fn uploads_are_kept_up_to_the_budget_until_they_are_forgotten() {
        let uploads = ReadUploads::new(100);
        let [a, b] = [1, 2].map(|byte| SceneId::from_bytes([byte; 16]));
        uploads.keep(&a, upload(60));
        uploads.keep(&b, upload(60));
        assert!(
            uploads.find(&a).is_some() && uploads.find(&b).is_none(),
            "the second is too large"
        );
        uploads.forget(&a);
        uploads.keep(&b, upload(100));
        assert!(uploads.find(&a).is_none() && uploads.find(&b).is_some());
    }
}
