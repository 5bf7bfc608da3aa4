//! What replicas tell each other through the store that they share.
//!
//! - `replicas/R`: the heartbeat of replica R. A replica whose heartbeat does not change for a
//!   lease counts as dead; no clocks are compared.
//! - `claims/ID.R`: who makes scene ID in place of R. Created once, so there is one heir; where the
//!   heir dies too, its own name begins the next claim.
//! - `growing/ID`: the replica that changes the photos of scene ID, as long as changes wait. One at
//!   a time, so that no call's photos get lost between two records.
//! - `deleted/ID`: a tombstone. A job that still makes ID removes what it wrote.
//!
//! Each call fails with `store_unavailable` where the store does.

use std::collections::HashMap;

use object_store::path::Path as Name;

use super::{Record, SCENE, STATUS, Store, UPLOAD, of, open, pending};
use crate::{error::Result, scene::SceneId};

fn growing(id: &SceneId) -> Name {
    Name::from(format!("growing/{id}"))
}

impl Store {
    /// Writes the heartbeat of `replica`; `count` differs from beat to beat.
    pub(crate) fn beat(&self, replica: &str, count: u64) -> Result<()> {
        let path = Name::from(format!("replicas/{replica}"));
        self.objects.put(
            "write the heartbeat of this replica",
            path,
            count.to_string().into_bytes(),
        )
    }

    /// Removes the heartbeat of a replica that stops, or has long been dead.
    pub(crate) fn end_replica(&self, replica: &str) -> Result<()> {
        let path = Name::from(format!("replicas/{replica}"));
        self.objects.delete("remove the heartbeat of a replica", path).map(drop)
    }

    /// Every replica that has a heartbeat, each with a stamp that changes with every beat.
    pub(crate) fn beats(&self) -> Result<Vec<(String, String)>> {
        self.listed("replicas", |name| Some(name.to_owned()))
    }

    /// Lets `heir` make scene `id` in place of `of`, unless another has claimed it; gives the
    /// replica that makes it.
    pub(crate) fn claim(&self, id: &SceneId, of: &str, heir: &str) -> Result<String> {
        let path = Name::from(format!("claims/{id}.{of}"));
        let what = "take over a scene";
        if self.objects.create(what, path.clone(), heir.as_bytes().to_vec())? {
            return Ok(heir.to_owned());
        }
        let winner = self.objects.get(what, path)?;
        Ok(winner.map_or_else(|| of.to_owned(), |name| String::from_utf8_lossy(&name).into_owned()))
    }

    /// Scenes that somebody makes in place of `replica`.
    pub(crate) fn claimed_from(&self, replica: &str) -> Result<Vec<SceneId>> {
        let claims = self.listed("claims", |name| {
            let (id, of) = name.split_once('.')?;
            (of == replica).then(|| id.parse().ok()).flatten()
        });
        Ok(claims?.into_iter().map(|(id, _)| id).collect())
    }

    pub(super) fn drop_claims(&self, id: &SceneId) -> Result<()> {
        let what = "end the claims on a scene";
        for object in self.objects.list(what, "claims")? {
            let is_its = |name: &str| name.split_once('.').is_some_and(|(of, _)| of == id.as_str());
            if object.path.filename().is_some_and(is_its) {
                self.objects.delete(what, object.path)?;
            }
        }
        Ok(())
    }

    /// Lets `replica` change the photos of a scene, unless another does; gives the one that does.
    pub(crate) fn begin_growing(&self, id: &SceneId, replica: &str) -> Result<String> {
        let what = "change the photos of a scene";
        loop {
            if self.objects.create(what, growing(id), replica.as_bytes().to_vec())? {
                return Ok(replica.to_owned());
            }
            // None where the other one has just ended.
            if let Some(at_work) = self.grows_at(id)? {
                return Ok(at_work);
            }
        }
    }

    /// The replica that changes the photos of a scene.
    pub(crate) fn grows_at(&self, id: &SceneId) -> Result<Option<String>> {
        let found = self.objects.get("change the photos of a scene", growing(id))?;
        Ok(found.map(|name| String::from_utf8_lossy(&name).into_owned()))
    }

    /// `heir` changes the photos of a scene in place of another.
    pub(crate) fn go_on_growing(&self, id: &SceneId, heir: &str) -> Result<()> {
        let what = "change the photos of a scene";
        self.objects.put(what, growing(id), heir.as_bytes().to_vec())
    }

    /// No change of the photos of a scene waits.
    pub(crate) fn end_growing(&self, id: &SceneId) -> Result<()> {
        self.objects.delete("change the photos of a scene", growing(id)).map(drop)
    }

    /// Scenes whose photos change.
    pub(crate) fn growing(&self) -> Result<Vec<SceneId>> {
        let listed = self.listed("growing", |name| name.parse().ok())?;
        Ok(listed.into_iter().map(|(id, _)| id).collect())
    }

    /// Scenes that were deleted not long ago.
    pub(crate) fn tombstones(&self) -> Result<Vec<SceneId>> {
        let listed = self.listed("deleted", |name| name.parse().ok())?;
        Ok(listed.into_iter().map(|(id, _)| id).collect())
    }

    pub(super) fn put_tombstone(&self, id: &SceneId) -> Result<()> {
        self.objects.put("delete the scene", Name::from(format!("deleted/{id}")), Vec::new())
    }

    pub(super) fn has_tombstone(&self, id: &SceneId) -> Result<bool> {
        self.objects.exists("look for a deletion", Name::from(format!("deleted/{id}")))
    }

    /// Scenes that are being made, each with a stamp that changes when its record does.
    pub(crate) fn unfinished(&self) -> Result<HashMap<SceneId, String>> {
        Ok(self.listed("pending", |name| name.parse().ok())?.into_iter().collect())
    }

    /// Every scene, each with a stamp that changes when its record does.
    pub(crate) fn stamps(&self) -> Result<HashMap<SceneId, String>> {
        let mut all = self.unfinished()?;
        for object in self.objects.list("list the scenes", "scenes")? {
            let parts: Vec<_> = object.path.parts().collect();
            if let [_, id, name] = &parts[..]
                && name.as_ref() == STATUS
                && let Ok(id) = id.as_ref().parse()
            {
                all.insert(id, object.stamp);
            }
        }
        Ok(all)
    }

    /// The newest record of a scene, `None` where there is no such scene.
    pub(crate) fn record(&self, id: &SceneId) -> Result<Option<Record>> {
        open::find_record(self, id)
    }

    /// The newest records of many scenes, read side by side; `None` where there is no such scene.
    pub(crate) fn records(&self, ids: &[SceneId]) -> Result<Vec<Option<Record>>> {
        let statuses = ids.iter().map(|id| of(id, STATUS)).collect();
        let statuses = self.objects.get_all("be listed", statuses)?;
        let record = |(id, status): (&SceneId, Option<Vec<u8>>)| match status
            .and_then(|file| open::sound(id, &file))
        {
            Some(record) => Ok(Some(record)),
            None => self.record(id),
        };
        ids.iter().zip(statuses).map(record).collect()
    }

    /// Whether a scene was acknowledged: its upload is kept, or it is made.
    pub(crate) fn was_acknowledged(&self, id: &SceneId) -> Result<bool> {
        let exists = |name| self.objects.exists("look for the upload", of(id, name));
        Ok(exists(UPLOAD)? || exists(SCENE)?)
    }

    /// Removes the record of a scene that was never acknowledged, or that has a status.
    pub(crate) fn drop_pending(&self, id: &SceneId) -> Result<()> {
        self.objects.delete("remove the record of a scene that was never stored", pending(id))?;
        self.drop_claims(id)
    }

    /// Names under a prefix as `read` understands them, with their stamps.
    fn listed<T>(
        &self,
        prefix: &str,
        read: impl Fn(&str) -> Option<T>,
    ) -> Result<Vec<(T, String)>> {
        let objects = self.objects.list("be listed", prefix)?.into_iter();
        Ok(objects
            .filter_map(|object| Some((read(object.path.filename()?)?, object.stamp)))
            .collect())
    }
}
