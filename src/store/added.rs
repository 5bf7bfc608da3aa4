//! Photos that join a finished scene: an object for each call, put before the call is answered.
//!
//! The names of the objects are in the record of the scene. One whose name is not, as a kill
//! between the two writes leaves it, was never acknowledged and goes with the scene.

use std::sync::Arc;

use super::{
    Growth, PhotoChange, Record, SEMANTICS, Store, new_id, now_ms, of, received, upload_file,
};
use crate::{
    error::{Error, ErrorCode, Result},
    formats::container::write_semantics,
    scene::{Scene, SceneId, SceneMeta, Semantics, Upload},
};

/// How the names of these objects begin.
const ADDED: &str = "added-";

impl Store {
    /// A name for photos that are to be kept: in the order of their names they are in the order of
    /// the calls.
    /// Fails with `internal` when the system gives no random numbers.
    pub(crate) fn added_name() -> Result<String> {
        Ok(format!("{ADDED}{:013}-{}.segsplat", now_ms(), new_id()?))
    }

    /// Keeps photos beside a scene: all of them or none, safe on return. `record` is that of the
    /// scene once they wait, as the last of all.
    /// Fails with `store_unavailable`; `scene_not_found` when the scene was deleted.
    pub(crate) fn put_added(&self, object: &str, upload: Upload, record: &Record) -> Result<()> {
        let id = &record.status.id;
        self.check_received(upload.kept.as_ref())?;
        // Its files are removed where nobody has them and there is no list of them.
        let _kept = upload.kept.clone();
        let file = upload_file::pack(upload, record)
            .map_err(|e| Error::internal("the photos cannot be packed").caused_by(e))?;
        self.objects.offer("keep the photos", of(id, object), file)?;
        self.unless_deleted(id)
    }

    /// Photos that were kept beside a scene.
    /// Fails with `scene_corrupt`, also when they are not kept, and `store_unavailable`.
    pub(crate) fn added(&self, id: &SceneId, object: &str) -> Result<Upload> {
        let file = self.objects.get("read the photos", of(id, object))?;
        let gone =
            || Error::new(ErrorCode::SceneCorrupt, format!("{object} of scene {id} is gone"));
        Ok(self.read_upload(&file.ok_or_else(gone)?, id, object)?.0)
    }

    /// Forgets photos that do not join their scene after all.
    pub(crate) fn drop_added(&self, id: &SceneId, object: &str) -> Result<()> {
        self.objects.delete("forget the photos", of(id, object))?;
        self.drop_files(id, object)
    }

    /// Keeps a version of a finished scene whose photos are others, with the semantics of all of
    /// them where it has some: readers find the one before until both are kept.
    /// Fails with `store_unavailable`; `scene_not_found` when the scene was deleted.
    pub(crate) fn put_grown(
        &self,
        scene: Scene,
        semantics: Option<Semantics>,
    ) -> Result<Arc<Scene>> {
        let Some(semantics) = semantics else { return self.put_version(scene) };
        let (id, semantics) = (scene.meta.id.clone(), Arc::new(semantics));
        let scene = scene.with_semantics(Arc::clone(&semantics))?;
        let mut file = Vec::new();
        let semantics_sha256 = write_semantics(&mut file, &id, &semantics)
            .map_err(|e| Error::internal("the semantics cannot be packed").caused_by(e))?;
        // A kill between the two leaves semantics that fit no Gaussians: they are made again.
        self.objects.put("keep the scene's semantics", of(&id, SEMANTICS), file)?;
        self.put_version(Scene { semantics_sha256, ..scene })
    }

    /// What is known of added photos without the record of their scene: those of which the scene
    /// has one joined it, all others wait.
    pub(super) fn growth_of(&self, scene: &SceneMeta) -> Result<Growth> {
        let (mut growth, id) = (Growth::default(), &scene.id);
        let objects = self.objects.list("read the scene", &format!("scenes/{id}"))?;
        let names = objects.iter().filter_map(|object| object.path.filename());
        let is_list = |name: &&str| name.starts_with(ADDED) && received::is_list(name);
        let mut names: Vec<&str> = names.filter(is_list).collect();
        names.sort_unstable();
        for name in names {
            let file = self.objects.get("read the photos", of(id, name))?;
            let read = file.map(|file| self.read_upload(&file, id, name));
            let Some(Ok((_, record))) = read else { continue };
            let Some(PhotoChange::Add(added)) = record.growth.waiting.back().cloned() else {
                continue;
            };
            let is_there = |file: &String| scene.cameras.iter().any(|camera| camera.file == *file);
            match added.files.iter().any(is_there) {
                true => growth.joined.push(added),
                false => growth.waiting.push_back(PhotoChange::Add(added)),
            }
        }
        Ok(growth)
    }
}
