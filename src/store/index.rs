//! Small objects that point at scenes: the use of an idempotency key, the scene of a content hash.
//!
//! A pointer whose scene is gone is rubbish: it is looked through, and a sweep removes it.

use object_store::path::Path as Name;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use sha2::{Digest, Sha256};

use super::{Record, Store, files::hex, objects::unavailable};
use crate::{
    error::{Error, Result},
    scene::SceneId,
};

/// What an idempotency key was used for.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeyUse {
    /// The scene it made.
    pub id: SceneId,
    /// sha256 over the upload and the options of the call, hex.
    pub request_sha256: String,
}

#[derive(Serialize, Deserialize)]
struct Content {
    id: SceneId,
}

/// Owner and key as one name: neither can be read from it, nor one owner's key meet another's.
fn key_name(owner: Option<&str>, key: &str) -> Name {
    Name::from(format!("keys/{}", named_hash(owner, key)))
}

/// One owner's scenes never answer for another's: the name holds the owner.
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
        let failed = |e| unavailable("keep the idempotency key", e);
        // A use that cannot be read is no use: it is replaced, once.
        for _ in 0..2 {
            if self.objects.create(name.clone(), json(new)?).map_err(failed)? {
                return Ok(None);
            }
            if let Some(used) = self.pointer(&name)? {
                return Ok(Some(used));
            }
            self.objects.delete(name.clone()).map_err(failed)?;
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
        let deleted = self.objects.delete(key_name(owner, key));
        deleted.map(drop).map_err(|e| unavailable("forget the idempotency key", e))
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
        let kept =
            self.objects.put(content_name(owner, sha256), json(&Content { id: id.clone() })?);
        kept.map_err(|e| unavailable("keep the content hash", e))
    }

    /// Removes the pointers that lead to this scene.
    pub(super) fn unlink(&self, record: &Record) -> Result<()> {
        let (id, owner) = (&record.status.id, record.owner.as_deref());
        let mut names = Vec::new();
        if let Some(key) = &record.idempotency_key {
            let name = key_name(owner, key);
            if self.pointer::<KeyUse>(&name)?.is_some_and(|used| used.id == *id) {
                names.push(name);
            }
        }
        if let Some(content) = &record.content_sha256 {
            let name = content_name(owner, content);
            if self.pointer::<Content>(&name)?.is_some_and(|content| content.id == *id) {
                names.push(name);
            }
        }
        for name in names {
            self.objects.delete(name).map_err(|e| unavailable("remove a deleted scene", e))?;
        }
        Ok(())
    }

    /// The scene that a pointer leads to; `None` where it cannot be read.
    pub(super) fn pointed(file: &[u8]) -> Option<SceneId> {
        serde_json::from_slice::<Content>(file).ok().map(|content| content.id)
    }

    fn pointer<T: DeserializeOwned>(&self, name: &Name) -> Result<Option<T>> {
        let file = self.objects.get(name.clone()).map_err(|e| unavailable("read an index", e))?;
        Ok(file.and_then(|file| serde_json::from_slice(&file).ok()))
    }
}

fn json(value: &impl Serialize) -> Result<Vec<u8>> {
    serde_json::to_vec(value).map_err(|e| Error::internal("no JSON").caused_by(e))
}
