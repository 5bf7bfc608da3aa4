//! What the store keeps of a scene beside its arrays: status, request, attempts.

use std::collections::VecDeque;

use serde::{Deserialize, Serialize};

use crate::{
    error::{Error, ErrorCode, Result},
    formats::container::unread_json,
    names::hex,
    scene::{GrowthStatus, Refine, SceneCamera, SceneOptions, SceneStatus},
};
use sha2::{Digest, Sha256};

/// Idempotency keys of calls whose photos are all gone that a scene remembers.
const GONE_KEYS_MAX: usize = 64;

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
    /// Uploads whose photos joined it, in their order; of each the photos that are still there.
    /// Calls whose photos are all gone have no object any more: see [`Self::done`].
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
    /// File names of its photos; once they joined, of those that the scene has.
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

    /// Notes that a change is done, after which the scene has these cameras. Of calls whose photos
    /// are all gone the newest `GONE_KEYS_MAX` that had a key are known on, so that a call that
    /// is sent twice does nothing the second time.
    pub fn done(&mut self, change: Option<PhotoChange>, cameras: &[SceneCamera]) {
        if let Some(PhotoChange::Add(added)) = change {
            // A name that comes again is another photo.
            for before in &mut self.joined {
                before.files.retain(|file| !added.files.contains(file));
            }
            self.joined.push(added);
        }
        let is_there = |file: &String| cameras.iter().any(|camera| camera.file == *file);
        self.joined.iter_mut().for_each(|added| added.files.retain(is_there));
        let is_key =
            |added: &AddedPhotos| added.files.is_empty() && added.idempotency_key.is_some();
        let keys = self.joined.iter().filter(|added| is_key(added)).count();
        let mut old = keys.saturating_sub(GONE_KEYS_MAX);
        self.joined.retain(|added| {
            let is_old = is_key(added) && old > 0;
            old -= usize::from(is_old);
            !is_old && (is_key(added) || !added.files.is_empty())
        });
    }

    /// Objects whose photos the scene has, or is to have.
    pub fn objects(&self) -> impl Iterator<Item = &str> {
        self.added().filter(|added| !added.files.is_empty()).map(|added| &*added.object)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Camera, CameraToWorld, Intrinsics};

    #[test]
    fn of_calls_whose_photos_are_gone_the_newest_keys_are_known() {
        let call = |i: usize, key: bool| AddedPhotos {
            object: format!("added-{i}"),
            files: vec![format!("{i}.png"), format!("{i}b.png")],
            idempotency_key: key.then(|| i.to_string()),
            request_sha256: i.to_string(),
        };
        let intrinsics = Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width: 1, height: 1 };
        let pose = [1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
        let camera_to_world = CameraToWorld::from_row_major(&pose, "test").unwrap();
        let camera = Camera { intrinsics, camera_to_world };
        let of = |file: String| SceneCamera { file, camera, network: None };
        let mut growth = Growth::default();
        for i in 0..GONE_KEYS_MAX + 6 {
            // Each photo that comes drives out the one before.
            let cameras = [of(format!("{i}b.png"))];
            growth.done(Some(PhotoChange::Add(call(i, i % 3 > 0))), &cameras);
            growth.done(None, &cameras);
            assert_eq!(growth.objects().collect::<Vec<_>>(), [format!("added-{i}")]);
        }
        let last = growth.joined.last().unwrap();
        assert_eq!(last.files, [format!("{}b.png", GONE_KEYS_MAX + 5)]);
        // A photo of a name that was there is another one.
        let again = AddedPhotos { files: last.files.clone(), ..call(900, true) };
        let cameras = [of(again.files[0].clone())];
        growth.done(Some(PhotoChange::Add(again)), &cameras);
        assert_eq!(growth.objects().collect::<Vec<_>>(), ["added-900"]);
        for i in 1000..2000 {
            growth.done(Some(PhotoChange::Add(call(i, true))), &[of(format!("{i}.png"))]);
        }
        let keys: Vec<_> = growth.joined.iter().map(|one| one.object.clone()).collect();
        let newest = 2000 - GONE_KEYS_MAX - 1..2000;
        assert_eq!(keys, newest.map(|i| format!("added-{i}")).collect::<Vec<_>>());
    }
}
