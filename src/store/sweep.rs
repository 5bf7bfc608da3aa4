//! Removing what belongs to no scene: what a kill left between two writes.
//!
//! Safe beside callers and other replicas. A scene's record is there before anything else of it
//! and goes first, and its status is there before its pending record goes; so what has neither,
//! looked for in that order, is nobody's.

use std::{collections::HashSet, time::Duration};

use super::{STATUS, Store, objects::Listed, of, pending, unavailable};
use crate::{error::Result, scene::SceneId};

impl Store {
    /// Removes objects of scenes that do not exist, and tombstones older than `buried`: by then
    /// no job of a deleted scene is at work any more. Gives how many objects went.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn sweep(&self, buried: Duration) -> Result<usize> {
        let mut removed = self.bury(buried)?;
        let known: HashSet<SceneId> = self.stamps()?.into_iter().map(|(id, _)| id).collect();
        let mut orphans = Vec::new();
        for object in self.list("scenes")? {
            let id = object.path.parts().nth(1).and_then(|part| part.as_ref().parse().ok());
            // What is named otherwise is not ours.
            orphans.extend(id.map(|id: SceneId| (id, object)));
        }
        for object in self.list("claims")? {
            let id = object.path.filename().and_then(|name| name.split('.').next()?.parse().ok());
            orphans.extend(id.map(|id: SceneId| (id, object)));
        }
        for prefix in ["keys", "contents"] {
            let objects = self.list(prefix)?;
            let paths = objects.iter().map(|object| object.path.clone()).collect();
            let files = self.objects.get_all(paths).map_err(|e| unavailable("be swept", e))?;
            for (object, file) in objects.into_iter().zip(files) {
                // One without a file is gone already.
                let Some(file) = file else { continue };
                match Self::pointed(&file) {
                    Some(id) => orphans.push((id, object)),
                    // A write that was cut short: it leads to no scene.
                    None => {
                        self.delete(object)?;
                        removed += 1;
                    }
                }
            }
        }
        let mut nobodys: HashSet<SceneId> = HashSet::new();
        for (id, object) in orphans.into_iter().filter(|(id, _)| !known.contains(id)) {
            if nobodys.contains(&id) || !self.exists(&id)? {
                self.delete(object)?;
                removed += 1;
                nobodys.insert(id);
            }
        }
        Ok(removed)
    }

    /// Removes old tombstones, and whatever lies under them.
    fn bury(&self, buried: Duration) -> Result<usize> {
        self.lock_gone().retain(|_, at| at.elapsed() <= buried);
        let mut removed = 0;
        for object in self.list("deleted")?.into_iter().filter(|object| object.age > buried) {
            let id = object.path.filename().and_then(|name| name.parse::<SceneId>().ok());
            if let Some(id) = id {
                for path in [of(&id, STATUS), pending(&id)] {
                    self.objects.delete(path).map_err(|e| unavailable("be swept", e))?;
                }
                self.purge(&id)?;
            }
            self.delete(object)?;
            removed += 1;
        }
        Ok(removed)
    }

    /// Whether there is such a scene, acknowledged or on its way to be.
    fn exists(&self, id: &SceneId) -> Result<bool> {
        let there = |path| self.objects.exists(path).map_err(|e| unavailable("be swept", e));
        Ok(there(pending(id))? || there(of(id, STATUS))?)
    }

    fn list(&self, prefix: &str) -> Result<Vec<Listed>> {
        self.objects.list(prefix).map_err(|e| unavailable("be swept", e))
    }

    fn delete(&self, object: Listed) -> Result<()> {
        self.objects.delete(object.path).map(drop).map_err(|e| unavailable("be swept", e))
    }
}
