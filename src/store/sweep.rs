//! Removing objects that belong to no scene: a kill between two writes leaves them.
//!
//! Files that an upload put as they came go without its list, which is put last.
//!
//! Safe beside callers and other replicas. A scene's record is there before anything else of it,
//! or the scene is known to arrive here. Its record goes first, and its status is there before its
//! pending record goes. So an id that has neither, looked for in that order, is no scene.

use std::{collections::HashSet, time::Duration};

use object_store::path::Path as Name;

use super::{PROBE, STATUS, Store, of, pending, received};
use crate::{error::Result, scene::SceneId};

/// What a sweep is, in an error.
const SWEEP: &str = "be swept";
/// Age from which the probe of another process is one that it left.
const PROBE_OLD: Duration = Duration::from_hours(1);

impl Store {
    /// Removes objects of scenes that do not exist, and tombstones older than `buried`: by then
    /// no job of a deleted scene runs any more. Gives how many objects went.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn sweep(&self, buried: Duration) -> Result<usize> {
        let mut removed = self.bury(buried)?;
        let known = self.stamps()?;
        let mut orphans = Vec::new();
        let objects = self.objects.list(SWEEP, "scenes")?;
        let all: HashSet<Name> = objects.iter().map(|object| object.path.clone()).collect();
        for object in objects {
            let id = object.path.parts().nth(1).and_then(|part| part.as_ref().parse().ok());
            // What is named otherwise is not ours.
            let Some(id): Option<SceneId> = id else { continue };
            let list = object.path.filename().and_then(received::list_of);
            match list.filter(|list| !all.contains(&of(&id, list))) {
                None => orphans.push((id, object)),
                Some(list) if self.may_be_received(&id, &list, object.age) => {}
                // The list may have come since.
                Some(list) if self.objects.exists(SWEEP, of(&id, &list))? => {}
                Some(_) => {
                    self.objects.delete(SWEEP, object.path)?;
                    removed += 1;
                }
            }
        }
        for object in self.objects.list(SWEEP, PROBE)? {
            if object.path != self.probe && object.age >= PROBE_OLD {
                self.objects.delete(SWEEP, object.path)?;
                removed += 1;
            }
        }
        let claims = self.objects.list(SWEEP, "claims")?;
        for object in claims.into_iter().chain(self.objects.list(SWEEP, "growing")?) {
            let id = object.path.filename().and_then(|name| name.split('.').next()?.parse().ok());
            orphans.extend(id.map(|id: SceneId| (id, object)));
        }
        for prefix in ["keys", "contents"] {
            let objects = self.objects.list(SWEEP, prefix)?;
            let paths = objects.iter().map(|object| object.path.clone()).collect();
            let files = self.objects.get_all(SWEEP, paths)?;
            for (object, file) in objects.into_iter().zip(files) {
                // One without a file is gone already.
                let Some(file) = file else { continue };
                match Self::pointed(&file) {
                    Some(id) => orphans.push((id, object)),
                    // A write that was cut short: it leads to no scene.
                    None => {
                        self.objects.delete(SWEEP, object.path)?;
                        removed += 1;
                    }
                }
            }
        }
        let mut gone: HashSet<SceneId> = HashSet::new();
        for (id, object) in orphans.into_iter().filter(|(id, _)| !known.contains_key(id)) {
            if gone.contains(&id) || !self.exists(&id)? {
                self.objects.delete(SWEEP, object.path)?;
                removed += 1;
                gone.insert(id);
            }
        }
        Ok(removed)
    }

    /// Removes old tombstones, and whatever lies under them.
    fn bury(&self, buried: Duration) -> Result<usize> {
        self.gone.lock().retain(|_, at| at.elapsed() <= buried);
        let mut removed = 0;
        let tombstones = self.objects.list(SWEEP, "deleted")?;
        for object in tombstones.into_iter().filter(|object| object.age > buried) {
            let id = object.path.filename().and_then(|name| name.parse::<SceneId>().ok());
            if let Some(id) = id {
                for path in [of(&id, STATUS), pending(&id)] {
                    self.objects.delete(SWEEP, path)?;
                }
                self.purge(&id)?;
            }
            self.objects.delete(SWEEP, object.path)?;
            removed += 1;
        }
        Ok(removed)
    }

    /// Whether there is such a scene, acknowledged or on its way to be.
    fn exists(&self, id: &SceneId) -> Result<bool> {
        if self.arriving.lock().contains(id) {
            return Ok(true);
        }
        let exists = |path| self.objects.exists(SWEEP, path);
        Ok(exists(pending(id))? || exists(of(id, STATUS))?)
    }
}
