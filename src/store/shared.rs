//! What replicas tell each other through the store they share, and nothing else.
//!
//! - `replicas/R`: the heartbeat of replica R. Who sees no change for a lease takes R for dead; no
//!   clock is compared.
//! - `claims/ID.R`: who makes scene ID in place of R. Created once, so there is one heir; where the
//!   heir dies too, its own name begins the next claim.
//! - `deleted/ID`: a tombstone. A job still at work on ID removes what it wrote.

use object_store::path::Path as Name;

use super::{Record, SCENE, STATUS, Store, UPLOAD, objects::unavailable, of, open, pending};
use crate::{error::Result, scene::SceneId};

/// A replica as its neighbours see it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Beat {
    /// Its name.
    pub replica: String,
    /// Changes with every beat.
    pub stamp: String,
}

impl Store {
    /// Tells the neighbours that `replica` lives; `count` differs from beat to beat.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn beat(&self, replica: &str, count: u64) -> Result<()> {
        let path = Name::from(format!("replicas/{replica}"));
        let kept = self.objects.put(path, count.to_string().into_bytes());
        kept.map_err(|e| unavailable("tell that this replica lives", e))
    }

    /// Takes a replica off: it stops, or has long been dead.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn end_replica(&self, replica: &str) -> Result<()> {
        let ended = self.objects.delete(Name::from(format!("replicas/{replica}")));
        ended.map(drop).map_err(|e| unavailable("take a replica off", e))
    }

    /// Every replica that ever beat and was not taken off.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn beats(&self) -> Result<Vec<Beat>> {
        let beats = self.listed("replicas")?.into_iter();
        Ok(beats.map(|(replica, stamp)| Beat { replica, stamp }).collect())
    }

    /// Makes `heir` the one who makes scene `id` in place of `of`; gives who it is.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn claim(&self, id: &SceneId, of: &str, heir: &str) -> Result<String> {
        let path = Name::from(format!("claims/{id}.{of}"));
        let failed = |e| unavailable("take over a scene", e);
        if self.objects.create(path.clone(), heir.as_bytes().to_vec()).map_err(failed)? {
            return Ok(heir.to_owned());
        }
        let winner = self.objects.get(path).map_err(failed)?;
        Ok(winner.map_or_else(|| of.to_owned(), |name| String::from_utf8_lossy(&name).into_owned()))
    }

    /// Scenes that somebody makes in place of `replica`.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn claimed_from(&self, replica: &str) -> Result<Vec<SceneId>> {
        let claims = self.listed("claims")?.into_iter();
        let from_it = |(name, _): (String, String)| {
            let (id, of) = name.split_once('.')?;
            (of == replica).then(|| id.parse().ok()).flatten()
        };
        Ok(claims.filter_map(from_it).collect())
    }

    pub(super) fn drop_claims(&self, id: &SceneId) -> Result<()> {
        let failed = |e| unavailable("end the claims on a scene", e);
        for object in self.objects.list("claims").map_err(failed)? {
            let is_its = |name: &str| name.split_once('.').is_some_and(|(of, _)| of == id.as_str());
            if object.path.filename().is_some_and(is_its) {
                self.objects.delete(object.path).map_err(failed)?;
            }
        }
        Ok(())
    }

    /// Scenes that were deleted not long ago.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn tombstones(&self) -> Result<Vec<SceneId>> {
        let names = self.listed("deleted")?.into_iter();
        Ok(names.filter_map(|(name, _)| name.parse().ok()).collect())
    }

    pub(super) fn put_tombstone(&self, id: &SceneId) -> Result<()> {
        let kept = self.objects.put(Name::from(format!("deleted/{id}")), Vec::new());
        kept.map_err(|e| unavailable("delete the scene", e))
    }

    pub(super) fn has_tombstone(&self, id: &SceneId) -> Result<bool> {
        let found = self.objects.exists(Name::from(format!("deleted/{id}")));
        found.map_err(|e| unavailable("look for a deletion", e))
    }

    /// Scenes that are being made, each with a stamp that changes when its record does.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn unfinished(&self) -> Result<Vec<(SceneId, String)>> {
        let names = self.listed("pending")?.into_iter();
        Ok(names.filter_map(|(name, stamp)| Some((name.parse().ok()?, stamp))).collect())
    }

    /// Every scene, each with a stamp that changes when its record does.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn stamps(&self) -> Result<Vec<(SceneId, String)>> {
        let mut all: std::collections::HashMap<_, _> = self.unfinished()?.into_iter().collect();
        let failed = |e| unavailable("list the scenes", e);
        for object in self.objects.list("scenes").map_err(failed)? {
            let parts: Vec<_> = object.path.parts().collect();
            if let [_, id, name] = &parts[..]
                && name.as_ref() == STATUS
                && let Ok(id) = id.as_ref().parse()
            {
                all.insert(id, object.stamp);
            }
        }
        Ok(all.into_iter().collect())
    }

    /// The newest record of a scene, `None` where there is no such scene.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn record(&self, id: &SceneId) -> Result<Option<Record>> {
        open::find_record(self, id)
    }

    /// The newest records of many scenes, read side by side; `None` where there is no such scene.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn records(&self, ids: &[SceneId]) -> Result<Vec<Option<Record>>> {
        let statuses = ids.iter().map(|id| of(id, STATUS)).collect();
        let statuses = self.objects.get_all(statuses).map_err(|e| unavailable("be listed", e))?;
        let record = |(id, status): (&SceneId, Option<Vec<u8>>)| match status
            .as_deref()
            .and_then(|file| open::sound(id, file))
        {
            Some(record) => Ok(Some(record)),
            None => open::find_record(self, id),
        };
        ids.iter().zip(statuses).map(record).collect()
    }

    /// Whether a scene was acknowledged: its upload is kept, or it is made.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn was_acknowledged(&self, id: &SceneId) -> Result<bool> {
        let failed = |e| unavailable("look for the upload", e);
        Ok(self.objects.exists(of(id, UPLOAD)).map_err(failed)?
            || self.objects.exists(of(id, SCENE)).map_err(failed)?)
    }

    /// Removes the record of a scene that was never acknowledged, or that has a status.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn drop_pending(&self, id: &SceneId) -> Result<()> {
        let dropped = self.objects.delete(pending(id));
        dropped.map(drop).map_err(|e| unavailable("end a scene that never was", e))?;
        self.drop_claims(id)
    }

    /// Names under a prefix with their stamps.
    fn listed(&self, prefix: &str) -> Result<Vec<(String, String)>> {
        let objects = self.objects.list(prefix).map_err(|e| unavailable("be listed", e))?;
        let named = |object: super::objects::Listed| {
            Some((object.path.filename()?.to_owned(), object.stamp))
        };
        Ok(objects.into_iter().filter_map(named).collect())
    }
}
