//! Photos of jobs in memory: jobs do not read again what the create call read.

use std::{collections::HashMap, sync::Arc};

use parking_lot::Mutex;

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
    uploads: Mutex<HashMap<SceneId, Arc<ReadUpload>>>,
}

impl ReadUploads {
    pub(super) fn new(bytes_max: u64) -> Self {
        Self { bytes_max, uploads: Mutex::default() }
    }

    /// Keeps an upload until it is forgotten, where it fits.
    pub(super) fn keep(&self, id: &SceneId, upload: Arc<ReadUpload>) {
        let mut uploads = self.uploads.lock();
        let kept: u64 = uploads.values().map(|upload| upload.photos.size_bytes()).sum();
        if kept + upload.photos.size_bytes() <= self.bytes_max {
            uploads.insert(id.clone(), upload);
        }
    }

    pub(super) fn find(&self, id: &SceneId) -> Option<Arc<ReadUpload>> {
        self.uploads.lock().get(id).cloned()
    }

    pub(super) fn forget(&self, id: &SceneId) {
        self.uploads.lock().remove(id);
    }
}
