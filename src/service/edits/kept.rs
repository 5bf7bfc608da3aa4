//! What is kept of edits: the list beside a scene, and edited scenes in memory.

use std::{
    collections::HashMap,
    sync::{Arc, OnceLock},
    time::{Duration, Instant},
};

use parking_lot::Mutex;
use serde::{Deserialize, Serialize};
use tokio::sync::watch;

use super::spec::EditSpec;
use crate::{
    cache::Cache,
    error::{Error, ErrorCode, Result},
    limits::Limits,
    scene::{Edit, Scene, SceneId},
    store::sha256,
};

/// A list of edits as it is kept.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(in crate::service) struct EditList {
    /// As they were sent.
    pub(super) specs: Vec<EditSpec>,
    /// The same ones, ready to be applied.
    pub(super) resolved: Vec<Edit>,
    /// sha256 of the semantics that they were resolved with, hex; empty where without.
    pub(super) semantics_sha256: String,
    /// sha256 of this list as text, hex; empty where there are no edits.
    #[serde(skip)]
    pub(super) sha256: String,
}

impl EditList {
    /// Its hash; empty where there are no edits.
    pub(in crate::service) fn sha256(&self) -> &str {
        &self.sha256
    }

    /// How many there are.
    pub(in crate::service) fn len(&self) -> usize {
        self.specs.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.specs.is_empty()
    }

    pub(super) fn needs_semantics(&self) -> bool {
        self.specs.iter().any(EditSpec::needs_semantics)
    }

    pub(super) fn read(json: &str) -> Result<Self> {
        let list: Self = serde_json::from_str(json).map_err(|e| {
            let why = format!("the scene's edits cannot be read ({e}); send the list anew");
            Error::new(ErrorCode::SceneCorrupt, why)
        })?;
        let sha256 = if list.is_empty() { String::new() } else { sha256(json.as_bytes()) };
        Ok(Self { sha256, ..list })
    }
}

/// A scene after its edits.
#[derive(Clone, Debug)]
pub(super) struct EditedScene {
    /// Tells base and edits from all others.
    pub(super) tag: String,
    pub(super) scene: Arc<Scene>,
    pub(super) counts: Arc<[u64]>,
    /// As [`super::SceneEdits`] has it, once it was asked for.
    pub(super) uncovered: Arc<OnceLock<f64>>,
}

/// Scenes whose lists stay in memory. That of another one is read again.
const LISTS_MAX: usize = 4096;

/// The lists that were read, and the edited scenes in memory.
#[derive(Debug)]
pub(in crate::service) struct Edits {
    /// With the time at which each was read; those read last.
    lists: Mutex<HashMap<SceneId, (Instant, Arc<EditList>)>>,
    /// The last state of each scene; by the bytes of its arrays.
    pub(super) scenes: Cache<SceneId, EditedScene>,
    /// One lock a scene being edited, so that many callers edit it once.
    pub(super) applying: Mutex<HashMap<SceneId, Arc<Mutex<()>>>>,
    /// Held while a list is put: what is put last is what is read here.
    pub(super) putting: Mutex<()>,
    /// Rung when a list that is known becomes another one.
    changed: watch::Sender<()>,
}

impl Edits {
    pub(in crate::service) fn new(limits: &Limits) -> Self {
        Self {
            lists: Mutex::default(),
            scenes: Cache::new(limits.edited_cache_bytes_max),
            applying: Mutex::default(),
            putting: Mutex::default(),
            changed: watch::Sender::default(),
        }
    }

    /// Rings when the list of some scene changes.
    pub(in crate::service) fn watch(&self) -> watch::Receiver<()> {
        self.changed.subscribe()
    }

    /// Bytes of edited scenes in memory.
    pub(in crate::service) fn cached_bytes(&self) -> u64 {
        self.scenes.weight()
    }

    /// Forgets a scene that was deleted.
    pub(in crate::service) fn forget(&self, id: &SceneId) {
        self.lists.lock().remove(id);
        self.scenes.remove(id);
    }

    pub(super) fn known(&self, id: &SceneId, fresh: Option<Duration>) -> Option<Arc<EditList>> {
        let lists = self.lists.lock();
        let (read, list) = lists.get(id)?;
        fresh.is_none_or(|fresh| read.elapsed() < fresh).then(|| Arc::clone(list))
    }

    pub(super) fn learn(&self, id: &SceneId, list: EditList) -> Arc<EditList> {
        let list = Arc::new(list);
        let now = (Instant::now(), Arc::clone(&list));
        let before = {
            let mut lists = self.lists.lock();
            let before = lists.insert(id.clone(), now);
            if lists.len() > LISTS_MAX
                && let Some(oldest) = lists.iter().min_by_key(|(_, (read, _))| *read)
            {
                let oldest = oldest.0.clone();
                lists.remove(&oldest);
            }
            before
        };
        if before.is_none_or(|(_, before)| before.sha256 != list.sha256) {
            self.changed.send_replace(());
        }
        list
    }

    pub(super) fn scene(&self, id: &SceneId, tag: &str) -> Option<EditedScene> {
        self.scenes.find(id).filter(|known| known.tag == tag)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_that_were_read_first_are_forgotten() {
        let edits = Edits::new(&Limits::default());
        let id = |n: usize| {
            let mut bytes = [0; 16];
            bytes[..8].copy_from_slice(&n.to_le_bytes());
            SceneId::from_bytes(bytes)
        };
        for n in 0..=LISTS_MAX {
            edits.learn(&id(n), EditList::default());
        }
        assert!(edits.known(&id(0), None).is_none());
        assert!(edits.known(&id(1), None).is_some() && edits.known(&id(LISTS_MAX), None).is_some());
        assert_eq!(edits.lists.lock().len(), LISTS_MAX);
    }
}
