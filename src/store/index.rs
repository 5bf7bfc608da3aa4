//! Small objects that point at scenes: the use of an idempotency key, the scene of a content hash.
//!
//! A pointer whose scene is gone counts as absent, and a sweep removes it.

use object_store::path::Path as Name;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use sha2::{Digest, Sha256};

use super::{Record, Store};
use crate::{
    error::{Error, Result},
    names::hex,
    scene::SceneId,
};

/// What an idempotency key was used for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeyUse {
    /// The scene of that call.
    pub id: SceneId,
    /// sha256 over the upload and the options of the call, hex.
    pub request_sha256: String,
}

#[derive(Serialize, Deserialize)]
struct Content {
    id: SceneId,
}

/// Owner and key as one name: neither can be read from it, and no two owners share a name.
fn key_name(owner: Option<&str>, key: &str) -> Name {
    Name::from(format!("keys/{}", named_hash(owner, key)))
}

fn content_name(owner: Option<&str>, content_sha256: &str) -> Name {
    Name::from(format!("contents/{}", named_hash(owner, content_sha256)))
}

fn named_hash(owner: Option<&str>, what: &str) -> String {
    let mut hash = Sha256::new();
    hash.update([u8::from(owner.is_some())]);
    hash.update((owner.map_or(0, str::len) as u64).to_le_bytes());
    hash.update(owner.unwrap_or_default());
    hash.update(what);
    hex(&hash.finalize())
}

impl Store {
    /// Notes the use of an idempotency key, unless it was used: then that use.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn use_key(&self, owner: Option<&str>, key: &str, new: &KeyUse) -> Result<Option<KeyUse>> {
        let name = key_name(owner, key);
        let what = "keep the idempotency key";
        // A use that cannot be read is no use: it is replaced, once.
        for _ in 0..2 {
            if self.objects.create(what, name.clone(), json(new)?)? {
                return Ok(None);
            }
            if let Some(used) = self.pointer(&name)? {
                return Ok(Some(used));
            }
            self.objects.delete(what, name.clone())?;
        }
        Err(Error::internal("the idempotency key cannot be kept"))
    }

    /// What a key was used for.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn key_use(&self, owner: Option<&str>, key: &str) -> Result<Option<KeyUse>> {
        self.pointer(&key_name(owner, key))
    }

    /// Forgets the use of a key.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn forget_key(&self, owner: Option<&str>, key: &str) -> Result<()> {
        self.objects.delete("forget the idempotency key", key_name(owner, key)).map(drop)
    }

    /// The scene that was made of this content for this owner, if one was.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn scene_of_content(&self, owner: Option<&str>, sha256: &str) -> Result<Option<SceneId>> {
        let content = self.pointer::<Content>(&content_name(owner, sha256))?;
        Ok(content.map(|content| content.id))
    }

    /// Notes which scene was made of this content.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn put_content(&self, owner: Option<&str>, sha256: &str, id: &SceneId) -> Result<()> {
        let content = json(&Content { id: id.clone() })?;
        self.objects.put("keep the content hash", content_name(owner, sha256), content)
    }

    /// Removes the pointers that lead to this scene.
    pub(super) fn unlink(&self, record: &Record) -> Result<()> {
        let owner = record.owner.as_deref();
        let key = record.idempotency_key.iter().map(|key| key_name(owner, key));
        let content = record.content_sha256.iter().map(|content| content_name(owner, content));
        for name in key.chain(content) {
            // A use of a key has the field of a content pointer too.
            let content = self.pointer::<Content>(&name)?;
            if content.is_some_and(|content| content.id == record.status.id) {
                self.objects.delete("remove a deleted scene", name)?;
            }
        }
        Ok(())
    }

    /// The scene that a pointer leads to; `None` where it cannot be read.
    pub(super) fn pointed(file: &[u8]) -> Option<SceneId> {
        serde_json::from_slice::<Content>(file).ok().map(|content| content.id)
    }

    fn pointer<T: DeserializeOwned>(&self, name: &Name) -> Result<Option<T>> {
        let file = self.objects.get("read an index", name.clone())?;
        Ok(file.and_then(|file| serde_json::from_slice(&file).ok()))
    }
}

fn json(value: &impl Serialize) -> Result<Vec<u8>> {
    serde_json::to_vec(value).map_err(|e| Error::internal("no JSON").caused_by(e))
}
