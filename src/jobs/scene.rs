//! The job that makes a scene of photos, or of a file of Gaussians, and keeps it.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, atomic::Ordering},
    time::{Duration, Instant},
};

use super::{
    change::Change,
    job::Job,
    kind::{JobKind, Kind},
    photos::{Content, ReadUpload},
    refine::REFINE,
    semantics::SEMANTICS,
    shared::{Jobs, Work, WorkLock},
};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{
        CamerasSource, Provenance, Scene, SceneError, SceneId, SceneMeta, SceneState, SceneStatus,
        SemanticsMode, SemanticsState, SemanticsStatus, Stage, Watch,
    },
    store::{self, Record},
    telemetry::{self, meter},
};

/// Makes a scene of an upload.
pub(super) struct MakeScene;

pub(super) const SCENE: Kind = &MakeScene;

impl JobKind for MakeScene {
    fn name(&self) -> &'static str {
        "scene"
    }

    fn what(&self) -> &'static str {
        "the scene"
    }

    fn show(&self, status: &mut SceneStatus, stage: Stage, fraction: f32) {
        // The store may not have kept its start yet.
        if status.state == SceneState::Queued {
            status.state = SceneState::Running;
        }
        status.stage = Some(stage.name().to_owned());
        status.fraction = stage.overall(fraction);
    }

    fn attempts<'a>(&self, record: &'a mut Record) -> Option<&'a mut u32> {
        Some(&mut record.attempts)
    }

    fn started(&self, record: &mut Record, now_ms: u64) {
        record.status.state = SceneState::Running;
        record.status.updated_ms = now_ms;
    }

    fn requeued(&self, record: &mut Record) {
        record.status.state = SceneState::Queued;
        record.status.stage = None;
        record.status.fraction = 0.0;
    }

    fn failed(&self, record: &mut Record, error: SceneError, now_ms: u64) {
        let status = &mut record.status;
        status.state = SceneState::Failed;
        status.stage = None;
        status.updated_ms = now_ms;
        status.error = Some(error);
        // It never has any.
        if status.semantics.state == SemanticsState::Running {
            status.semantics = SemanticsStatus::default();
        }
    }
}

impl Work for MakeScene {
    /// It belongs to the trace of the call that created the scene.
    fn span(&self, jobs: &Jobs, id: &SceneId) -> tracing::Span {
        let Some(record) = jobs.records.find(id) else { return tracing::Span::none() };
        let request_id = record.request_id.as_deref();
        let span = tracing::info_span!("scene", scene = %id, request_id);
        if let Some(parent) = &record.traceparent {
            telemetry::follow(&span, parent);
        }
        span
    }

    fn run(&self, jobs: &Jobs, job: &Job) -> Result<()> {
        jobs.make_scene(job)
    }
}

/// What a job found or made.
enum Made {
    /// The scene that an earlier attempt kept.
    Kept(Arc<Scene>),
    /// A scene of the same content.
    Known(Arc<Scene>),
    New(Box<Scene>),
}

impl Jobs {
    fn make_scene(&self, job: &Job) -> Result<()> {
        let (begun, id) = (Instant::now(), &job.scene);
        let record = self.record(id)?;
        self.check_attempts(job.kind, &record)?;
        let waited_ms = store::now_ms().saturating_sub(record.status.created_ms);
        meter::stage("wait", Duration::from_millis(waited_ms).as_secs_f64());
        // Its start is kept while the work begins, and before anything that ends it.
        let started = || self.records.apply(id, &Change::Started(job.kind));
        let (started, made) = store::side_by_side(started, || self.find_or_make(job, &record));
        started?;
        let (made, _lock) = made?;
        let scene = match made {
            Made::Kept(scene) => return self.finish(&scene),
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
        if (record.attempts > 0 || store.scene_in_memory(id).is_some())
            && let Some(scene) = self.kept_scene(id)?
            && scene.meta.report.file_format.is_none()
        {
            return Ok((Made::Kept(scene), None));
        }
        let (files, of_photos) = match self.uploads.find(id) {
            Some(upload) => (upload.files.clone(), upload.is_of_photos()),
            None => {
                let upload = store.upload(id)?;
                (store::hashes(&upload), upload.sent_splats().is_none())
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
            let limits = self.parts.limits.get();
            let room = upload.room(&limits);
            let _room = self.room.take(room, limits.network_photos_max, watch.cancel)?;
            let upload = self.with_cameras(id, upload, watch)?;
            let Content::Photos(photos) = &upload.content else {
                self.uploads.forget(id);
                return of_file(upload, id, created_ms, provenance);
            };
            // By a refinement, or by photos that join the scene.
            let is_needed =
                self.parts.keep_photos || self.is_refined_next(record, photos.photos.len());
            match record.options.semantics {
                SemanticsMode::Eager => {
                    self.uploads.keep(id, Arc::clone(&upload));
                    // Photos may go from memory, and a job that reads them again has no cameras.
                    let is_given = photos.cameras.source == CamerasSource::Given;
                    if is_given && self.parts.semantics.begin_early(&record.options.method()) {
                        self.understand_early(id)?;
                    }
                }
                SemanticsMode::Lazy => self.uploads.leave(id, Arc::clone(&upload)),
                SemanticsMode::Off if is_needed => self.uploads.leave(id, Arc::clone(&upload)),
                SemanticsMode::Off => self.uploads.forget(id),
            }
            let made = match is_needed {
                false => self.parts.scenes.make(photos, &record.options, watch)?,
                true => {
                    let made = self.parts.scenes.make_keeping(photos, &record.options, watch)?;
                    let (made, seen) = made;
                    seen.into_iter().for_each(|seen| self.uploads.keep_seen(id, seen));
                    made
                }
            };
            Ok(made.into_scene(id.clone(), created_ms, provenance))
        })?;
        Ok((Made::New(Box::new(scene)), lock))
    }

    /// An upload whose photos have cameras: those that are solved now, where it has none.
    fn with_cameras(
        &self,
        id: &SceneId,
        upload: Arc<ReadUpload>,
        watch: Watch<'_>,
    ) -> Result<Arc<ReadUpload>> {
        if !matches!(upload.content, Content::Unposed(_)) {
            return Ok(upload);
        }
        (watch.progress)(Stage::Cameras, 0.0);
        // Not copied: nobody else has it.
        self.uploads.forget(id);
        let ReadUpload { files, content } = Arc::unwrap_or_clone(upload);
        let content = match content {
            Content::Unposed(photos) => Content::Photos(self.parts.scenes.pose(photos, watch)?),
            other => other,
        };
        let upload = Arc::new(ReadUpload { files, content });
        self.without_words(upload, &self.record(id)?.options, watch)
    }

    /// Keeps a scene with the semantics that it has, and its record.
    fn keep(&self, scene: Scene) -> Result<()> {
        let semantics = scene.semantics.clone();
        let mut scene = self.parts.store.put_scene(scene)?;
        if let Some(semantics) = semantics {
            let semantics = Arc::unwrap_or_clone(semantics);
            let packed = self.parts.store.pack_semantics(&scene.meta.id, semantics)?;
            scene = self.parts.store.put_semantics(packed)?;
        }
        self.finish(&scene)
    }

    /// The scene that an earlier attempt kept before it was cut off.
    fn kept_scene(&self, id: &SceneId) -> Result<Option<Arc<Scene>>> {
        match self.parts.store.scene(id) {
            Ok(scene) => Ok(Some(scene)),
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

    /// The scene is kept, and its semantics where it has some: its record is kept, then its
    /// watchers are told, then what a start would tidy up too is tidied up.
    fn finish(&self, scene: &Scene) -> Result<()> {
        let (store, meta, id) = (&self.parts.store, &scene.meta, &scene.meta.id);
        let record = self.record(id)?;
        let order = self.first_order(&record, scene);
        // The pending record goes later: nobody waits for that.
        let made = Change::Made(scene, order);
        let made = self.records.apply_with(id, &made, |record| store.put_status(record))?;
        tracing::info!(scene = %id, "done");
        let owner = record.owner.as_deref();
        let semantics = [&made.before, &made.after].map(|record| record.status.semantics.state);
        if order.is_some() {
            self.queue.push(REFINE, id.clone(), owner);
        }
        if semantics == [SemanticsState::None, SemanticsState::Running] {
            self.queue.push(SEMANTICS, id.clone(), owner);
        }
        // The scene is there, whatever comes of these. The content first: the next job with this
        // content begins when this one ends.
        let content = &meta.provenance.content_sha256;
        let noted = match content.is_empty() {
            true => Ok(()),
            false => store.put_content(owner, content, id),
        };
        if let Err(error) = noted.and_then(|()| store.settle(id)) {
            tracing::warn!(scene = %id, %error, "left for the next start");
        }
        self.prepare(scene);
        self.drop_upload_unless_needed(id);
        (self.parts.foresee)(id);
        Ok(())
    }

    /// Puts a finished scene where its views are drawn. It is whole without that.
    pub(super) fn prepare(&self, scene: &Scene) {
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
