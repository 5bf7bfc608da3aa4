//! The list of edits of a scene and its scale, each in an object of its own: any replica may
//! replace it while another one writes the record.
//!
//! The store does not read the list. A bad one stays where it is until another takes its place:
//! without it a scene would show what was deleted.

use super::{EDITS, SCALE, Store, of, record};
use crate::{
    error::{Error, Result},
    scene::SceneId,
};

impl Store {
    /// The list of edits that is kept of a scene, as it was given.
    /// Fails with `scene_corrupt` and `store_unavailable`.
    pub(crate) fn edits(&self, id: &SceneId) -> Result<Option<String>> {
        let file = self.objects.get("read the scene's edits", of(id, EDITS))?;
        let what = || format!("the edits of scene {id}");
        file.map(|file| record::unseal_text(&file, &what())).transpose()
    }

    /// What is kept of how large a scene is, as it was given.
    /// Fails with `scene_corrupt` and `store_unavailable`.
    pub(crate) fn scale(&self, id: &SceneId) -> Result<Option<String>> {
        let file = self.objects.get("read the scene's scale", of(id, SCALE))?;
        let what = || format!("the scale of scene {id}");
        file.map(|file| record::unseal_text(&file, &what())).transpose()
    }

    /// Keeps how large a scene is in place of what was kept, or nothing.
    /// Fails with `store_unavailable`; `scene_not_found` when the scene was deleted.
    pub(crate) fn put_scale(&self, id: &SceneId, scale: Option<String>) -> Result<()> {
        let Some(scale) = scale else {
            return self.objects.delete("forget the scene's scale", of(id, SCALE)).map(drop);
        };
        let sealed = record::seal_text(scale)
            .map_err(|e| Error::internal("the scale cannot be written").caused_by(e))?;
        self.objects.put("keep the scene's scale", of(id, SCALE), sealed)?;
        self.unless_deleted(id)
    }

    /// Keeps a list of edits in place of the one before.
    /// Fails with `store_unavailable`; `scene_not_found` when the scene was deleted.
    pub(crate) fn put_edits(&self, id: &SceneId, edits: String) -> Result<()> {
        let sealed = record::seal_text(edits)
            .map_err(|e| Error::internal("the edits cannot be written").caused_by(e))?;
        self.objects.put("keep the scene's edits", of(id, EDITS), sealed)?;
        self.unless_deleted(id)
    }
}
