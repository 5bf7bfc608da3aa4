//! The job that makes a scene of photos, or of a file of Gaussians, and keeps it.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, atomic::Ordering},
    time::{Duration, Instant},
};

use super::{
    Jobs,
    job::{Job, Kind},
    photos::{Content, ReadUpload},
};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{
        Provenance, RefineState, RefineStatus, Scene, SceneId, SceneMeta, SceneState,
        SemanticsMode, SemanticsState, SemanticsStatus, Stage, unless_cancelled,
    },
    store::{self, Record},
    telemetry::meter,
};

/// Starts of one job before it is given up: a scene that kills the server must not do so forever.
const ATTEMPTS_MAX: u32 = 3;

/// Makes an unfinished record that of a queued scene.
pub(super) fn requeue(record: &mut Record) {
    record.status.state = SceneState::Queued;
    record.status.stage = None;
    record.status.fraction = 0.0;
}

/// What a job found or made.
enum Made {
    /// The scene that an earlier attempt kept, and its digest.
    Kept(Arc<Scene>, String),
    /// A scene of the same content.
    Known(Arc<Scene>),
    New(Box<Scene>),
}

/// Keeps other workers from making a scene of the same content, or from changing the same scene,
/// until it is dropped.
pub(super) struct WorkLock<'a> {
    jobs: &'a Jobs,
    name: String,
}

impl Drop for WorkLock<'_> {
    fn drop(&mut self) {
        self.jobs.contents.lock().remove(&self.name);
        self.jobs.content_free.notify_all();
    }
}

impl Jobs {
    pub(super) fn make_scene(&self, job: &Job) -> Result<()> {
        let (begun, id) = (Instant::now(), &job.scene);
        let Some(record) = self.records.update(id, |record| {
            record.attempts += 1;
            record.status.state = SceneState::Running;
            record.status.updated_ms = store::now_ms();
        }) else {
            return Ok(());
        };
        let waited_ms = record.status.updated_ms.saturating_sub(record.status.created_ms);
        meter::stage("wait", Duration::from_millis(waited_ms).as_secs_f64());
        if record.attempts > ATTEMPTS_MAX {
            return Err(Error::internal(format!(
                "given up: the server stopped {ATTEMPTS_MAX} times while making this scene"
            )));
        }
        // Its start is kept while the work begins, and before anything that ends it.
        let started = || self.parts.store.put_record(&record);
        let (started, made) = store::side_by_side(started, || self.find_or_make(job, &record));
        started?;
        let (made, _lock) = made?;
        let scene = match made {
            Made::Kept(scene, digest) => return self.finish(&scene, digest, None),
            Made::Known(known) => {
                tracing::info!(scene = %id, of = %known.meta.id, "copied: the same content");
                let created_ms = record.status.created_ms;
                let meta = SceneMeta { id: id.clone(), created_ms, ..known.meta.clone() };
                return self.keep(Scene { meta, ..(*known).clone() });
            }
            Made::New(scene) => *scene,
        };
        self.show(job, Stage::Store, 0.0);
        let took = u64::try_from(begun.elapsed().as_millis()).unwrap_or(u64::MAX);
        let before = self.scene_ms.load(Ordering::Relaxed);
        let smoothed = if before == 0 { took } else { (3 * before + took) / 4 };
        self.scene_ms.store(smoothed.max(1), Ordering::Relaxed);
        let stored = Instant::now();
        let finished = self.keep(scene);
        meter::stage(Stage::Store.name(), stored.elapsed().as_secs_f64());
        finished
    }

    /// The scene of this record: kept already, that of the same content, or made now. With it the
    /// lock of the content, where there is one.
    fn find_or_make(&self, job: &Job, record: &Record) -> Result<(Made, Option<WorkLock<'_>>)> {
        let (id, store) = (&job.scene, &self.parts.store);
        // What was kept of a file may lack its semantics, which are kept after it.
        if record.attempts > 1
            && let Some((scene, digest)) = self.kept_scene(id)?
            && scene.meta.report.file_format.is_none()
        {
            return Ok((Made::Kept(scene, digest), None));
        }
        let (files, of_photos) = match self.uploads.find(id) {
            Some(upload) => (upload.files.clone(), upload.photos().is_ok()),
            None => {
                let upload = store.upload(id)?;
                (store::hashes(&upload), upload.splats.is_none())
            }
        };
        let networks = if of_photos { self.parts.scenes.identity() } else { String::new() };
        let provenance = store::provenance(files, &record.options, &networks);
        let lock = Some(self.lock(&provenance.content_sha256, job)?);
        if let Some(known) = self.scene_of_content(&provenance.content_sha256, record)? {
            return Ok((Made::Known(known), lock));
        }
        let created_ms = record.status.created_ms;
        let scene = self.within_time(job, |watch| {
            (watch.progress)(Stage::Photos, 0.0);
            let upload = self.upload(id, watch)?;
            let room = upload.room(&self.parts.limits);
            let _room = self.room.take(room, watch.cancel)?;
            let Content::Photos(photos) = &upload.content else {
                self.uploads.forget(id);
                return of_file(upload, id, created_ms, provenance);
            };
            match record.options.semantics {
                SemanticsMode::Eager => {
                    self.uploads.keep(id, Arc::clone(&upload));
                    self.understand_early(record);
                }
                SemanticsMode::Lazy => self.uploads.leave(id, Arc::clone(&upload)),
                SemanticsMode::Off => self.uploads.forget(id),
            }
            let made = self.parts.scenes.make(photos, &record.options, watch)?;
            Ok(made.into_scene(id.clone(), created_ms, provenance))
        })?;
        Ok((Made::New(Box::new(scene)), lock))
    }

    /// Keeps a scene with the semantics that it has, and its record.
    fn keep(&self, scene: Scene) -> Result<()> {
        let (id, semantics) = (scene.meta.id.clone(), scene.semantics.clone());
        let (mut scene, digest) = self.parts.store.put_scene(scene)?;
        let mut semantics_digest = None;
        if let Some(semantics) = semantics {
            let semantics = Arc::unwrap_or_clone(semantics);
            let kept = self.parts.store.put_semantics(&id, semantics, |_| Ok(()))?;
            (scene, semantics_digest) = (kept.0, Some(kept.1));
        }
        self.finish(&scene, digest, semantics_digest)
    }

    /// The scene that an earlier attempt kept before it was cut off, and its digest.
    fn kept_scene(&self, id: &SceneId) -> Result<Option<(Arc<Scene>, String)>> {
        match self.parts.store.scene(id) {
            Ok(scene) => {
                let digest = self.parts.store.scene_digest(id)?;
                Ok(digest.map(|digest| (scene, digest)))
            }
            Err(e) if matches!(e.code(), ErrorCode::SceneNotFound | ErrorCode::SceneCorrupt) => {
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    /// The finished scene of this content and owner, where there is one and it is sound.
    fn scene_of_content(&self, content: &str, record: &Record) -> Result<Option<Arc<Scene>>> {
        let (store, owner) = (&self.parts.store, record.owner.as_deref());
        let Some(id) = store.scene_of_content(owner, content)? else { return Ok(None) };
        if id == record.status.id {
            return Ok(None);
        }
        // Where that one is bad, this one is made.
        let scene = store.scene(&id).ok();
        Ok(scene.filter(|scene| scene.meta.provenance.content_sha256 == content))
    }

    /// Waits until no other worker here has the lock of this content, or of this scene.
    /// Fails with `cancelled`.
    pub(super) fn lock(&self, name: &str, job: &Job) -> Result<WorkLock<'_>> {
        let mut names = self.contents.lock();
        while names.contains(name) {
            unless_cancelled(&job.cancel)?;
            self.content_free.wait_for(&mut names, Duration::from_millis(50));
        }
        names.insert(name.to_owned());
        Ok(WorkLock { jobs: self, name: name.to_owned() })
    }

    /// The scene is kept under its digest, and its semantics under theirs: its record is kept, then
    /// its watchers are told, then what a start would tidy up too is tidied up.
    fn finish(&self, scene: &Scene, digest: String, semantics: Option<String>) -> Result<()> {
        let (store, meta, id) = (&self.parts.store, &scene.meta, &scene.meta.id);
        // In the store first: a watcher who sees `done` may stop the machine.
        let Some(mut done) = self.records.find(id).map(Arc::unwrap_or_clone) else {
            return Ok(());
        };
        let content = &meta.provenance.content_sha256;
        done.scene_sha256 = Some(digest);
        done.content_sha256 = Some(content.clone()).filter(|hash| !hash.is_empty());
        done.replica = None;
        done.status.state = SceneState::Done;
        done.status.stage = None;
        done.status.fraction = 1.0;
        done.status.updated_ms = store::now_ms();
        done.status.report = Some(meta.report.clone());
        done.status.cameras.clone_from(&meta.cameras);
        done.status.version = 1;
        done.refine = self.first_order(&done);
        if done.refine.is_some() {
            done.status.refinement = RefineStatus::new(RefineState::Running);
        }
        if let (Some(digest), Some(semantics)) = (semantics, &scene.semantics) {
            done.semantics_sha256 = Some(digest);
            done.status.semantics = SemanticsStatus::ready(semantics.report.clone());
        }
        store.put_status(&done)?;
        // In one change, so that no watcher takes `done` for the end.
        let ready = done.status.semantics.state == SemanticsState::Ready;
        let eager = done.options.semantics == SemanticsMode::Eager && !ready;
        let (owner, refined) = (done.owner.clone(), done.refine.is_some());
        let mut waiting = false;
        self.records.update(id, |record| {
            // They may be under way already, or have failed.
            waiting = eager && record.status.semantics.state == SemanticsState::None;
            let begun = std::mem::take(&mut record.status.semantics);
            *record = done;
            if waiting {
                record.status.semantics = SemanticsStatus::new(SemanticsState::Running);
            } else if eager {
                record.status.semantics = begun;
            }
        });
        tracing::info!(scene = %id, "done");
        if refined {
            self.queue.push(Kind::Refine, id.clone(), owner.as_deref());
        }
        if waiting {
            self.queue.push(Kind::Semantics, id.clone(), owner.as_deref());
        }
        // The scene is there, whatever comes of these. The content first: the next job with this
        // content begins when this one ends.
        let noted = match content.is_empty() {
            true => Ok(()),
            false => store.put_content(owner.as_deref(), content, id),
        };
        if let Err(error) = noted.and_then(|()| store.settle(id)) {
            tracing::warn!(scene = %id, %error, "left for the next start");
        }
        self.prepare(scene);
        if !eager && !refined && !self.parts.keep_photos {
            store.drop_upload(id)?;
        }
        Ok(())
    }

    /// Puts a finished scene where its views are drawn. It is whole without that.
    fn prepare(&self, scene: &Scene) {
        let put = AssertUnwindSafe(|| self.parts.renderer.prepare(&scene.gaussians));
        let panicked = |_| Err(Error::internal("a panic"));
        if let Err(error) = catch_unwind(put).unwrap_or_else(panicked) {
            tracing::warn!(scene = %scene.meta.id, %error, "its first view uploads it");
        }
    }
}

/// The scene of an upload that is a file of Gaussians, under this id.
fn of_file(
    upload: Arc<ReadUpload>,
    id: &SceneId,
    created_ms: u64,
    provenance: Provenance,
) -> Result<Scene> {
    // Not copied where nobody else has it.
    let Content::Splats(scene) = Arc::unwrap_or_clone(upload).content else {
        return Err(Error::internal("an upload of photos is no file of Gaussians"));
    };
    let meta = SceneMeta { id: id.clone(), created_ms, provenance, ..scene.meta };
    Ok(Scene { meta, ..*scene })
}
