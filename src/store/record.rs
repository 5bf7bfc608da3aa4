//! What the store keeps of a scene beside its arrays: status, request, attempts.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::{
    error::{Error, ErrorCode, Result},
    formats::container::unread_json,
    names::hex,
    scene::{GrowthStatus, Refine, SceneOptions, SceneStatus},
};
use sha2::{Digest, Sha256};

/// A refinement that goes on after any restart.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefineOrder {
    /// Milliseconds of work that it is given.
    pub ms: u64,
    /// How often it was begun since it last published a version; bounds how often one that stops
    /// the server is begun again.
    pub attempts: u32,
}

/// Photos that join a scene after it was made, or leave it: what goes on after any restart.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Growth {
    /// Uploads whose photos joined it, in their order.
    pub joined: Vec<AddedPhotos>,
    /// What is still to be done, in the order of the calls.
    pub waiting: VecDeque<PhotoChange>,
    /// How often the first of these was begun; bounds how often one that stops the server is begun
    /// again.
    pub attempts: u32,
    /// Whether the scene is to be refined when nothing waits any more: it was when a call came.
    pub refine: Option<Refine>,
}

/// A change of the photos of a scene.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PhotoChange {
    /// They join it.
    Add(AddedPhotos),
    /// The photo of this file name leaves it.
    Remove(String),
}

/// An upload whose photos join a scene.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AddedPhotos {
    /// Name of its object, beside those of the scene.
    pub object: String,
    /// File names of its photos.
    pub files: Vec<String>,
    /// Idempotency key of the call.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub idempotency_key: Option<String>,
    /// sha256 over the upload, hex: what the key stands for.
    pub request_sha256: String,
}

impl Growth {
    fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// What callers are told of it.
    pub fn status(&self) -> GrowthStatus {
        match self.joined.is_empty() && self.waiting.is_empty() {
            true => GrowthStatus::default(),
            false => GrowthStatus::of(u32::try_from(self.waiting.len()).unwrap_or(u32::MAX)),
        }
    }

    /// The uploads that joined or wait.
    pub fn added(&self) -> impl Iterator<Item = &AddedPhotos> {
        let waiting = self.waiting.iter().filter_map(|change| match change {
            PhotoChange::Add(added) => Some(added),
            PhotoChange::Remove(_) => None,
        });
        self.joined.iter().chain(waiting)
    }
}

/// A scene's status and the request it came from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Record {
    /// What callers see.
    pub status: SceneStatus,
    /// The owner that the key of the call names; `None` where the server needs no keys.
    #[serde(default)]
    pub owner: Option<String>,
    /// Options of the call.
    pub options: SceneOptions,
    /// Idempotency key of the call.
    pub idempotency_key: Option<String>,
    /// sha256 over the upload and the options, hex: what the key stands for.
    pub request_sha256: String,
    /// How often a worker has begun; bounds how often a scene that stops the server is retried.
    pub attempts: u32,
    /// The refinement that waits or is at work.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub refine: Option<RefineOrder>,
    /// Photos that joined it, and changes of its photos that wait.
    #[serde(default, skip_serializing_if = "Growth::is_empty")]
    pub growth: Growth,
    /// sha256 of the scene container, hex, once done.
    pub scene_sha256: Option<String>,
    /// sha256 of the semantics container, hex, once they are ready.
    #[serde(default)]
    pub semantics_sha256: Option<String>,
    /// sha256 over photos, cameras, options, bundle and program, hex: what the scene is made of.
    #[serde(default)]
    pub content_sha256: Option<String>,
    /// The replica that makes it, where replicas share the store.
    #[serde(default)]
    pub replica: Option<String>,
    /// Id of the request that created it.
    #[serde(default)]
    pub request_id: Option<String>,
    /// Its span in the caller's trace (W3C), where spans are exported.
    #[serde(default)]
    pub traceparent: Option<String>,
}

impl Record {
    /// File names of the photos of a finished scene, once all that waits is done.
    pub fn photos_to_be(&self) -> Vec<&str> {
        let mut files: Vec<&str> = self.status.cameras.iter().map(|of| &*of.file).collect();
        for change in &self.growth.waiting {
            match change {
                PhotoChange::Add(added) => files.extend(added.files.iter().map(String::as_str)),
                PhotoChange::Remove(gone) => files.retain(|file| file != gone),
            }
        }
        files
    }

    /// A record of which nothing but the status is known.
    pub fn new(status: SceneStatus) -> Self {
        Self {
            status,
            owner: None,
            options: SceneOptions::default(),
            idempotency_key: None,
            request_sha256: String::new(),
            attempts: 0,
            refine: None,
            growth: Growth::default(),
            scene_sha256: None,
            semantics_sha256: None,
            content_sha256: None,
            replica: None,
            request_id: None,
            traceparent: None,
        }
    }
}

/// A record, or a list of edits, with its own checksum: a flipped digit in a number would still be
/// JSON.
#[derive(Serialize, Deserialize)]
struct Sealed {
    sha256: String,
    record: String,
}

pub(super) fn seal(record: &Record) -> serde_json::Result<Vec<u8>> {
    seal_text(serde_json::to_string(record)?)
}

/// A text with its checksum.
pub(super) fn seal_text(record: String) -> serde_json::Result<Vec<u8>> {
    serde_json::to_vec(&Sealed { sha256: hex(&Sha256::digest(&record)), record })
}

pub(super) fn unseal(file: &[u8]) -> Result<Record> {
    let what = "the scene's status";
    serde_json::from_str(&unseal_text(file, what)?).map_err(|e| unread_json(what, &e))
}

/// The text of a sealed file; `what` names it in the error `scene_corrupt`.
pub(super) fn unseal_text(file: &[u8], what: &str) -> Result<String> {
    let corrupt = |why: String| Error::new(ErrorCode::SceneCorrupt, format!("{what}: {why}"));
    let sealed: Sealed = serde_json::from_slice(file).map_err(|e| corrupt(e.to_string()))?;
    if sealed.sha256 != hex(&Sha256::digest(&sealed.record)) {
        return Err(corrupt("its checksum does not match its content".to_owned()));
    }
    Ok(sealed.record)
}
