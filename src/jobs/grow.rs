//! The job that changes the photos of a finished scene: some join it, or one leaves it. The scene
//! is served as it is meanwhile; the version with the change takes its place in one step, with its
//! semantics where the scene has some.
//!
//! What a call asked for is in the record, and its photos are in the store, before it is answered.
//! One call is one version, in the order of the calls. A refinement that waits or is at work begins
//! again after the last of them.

use std::sync::{Arc, atomic::AtomicBool};

use super::{
    change::Change,
    job::{Job, Reason},
    kind::{JobKind, Kind},
    photos::{Content, ReadUpload},
    records::Changed,
    refine::REFINE,
    shared::{Jobs, Work},
};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
    pipeline::{PhotoSet, Seen, growth, semantics::LabelledPhotos},
    scene::{
        GrowthState, GrowthStatus, PhotoHash, Provenance, Refine, Scene, SceneError, SceneId,
        SceneOptions, SceneStatus, Semantics, SemanticsState, Stage, Upload, Watch,
    },
    store::{self, AddedPhotos, PhotoChange, Record, RefineOrder, Store},
};

/// Changes the photos of a finished scene.
pub(super) struct GrowScene;

pub(super) const GROW: Kind = &GrowScene;

impl JobKind for GrowScene {
    fn name(&self) -> &'static str {
        "grow"
    }

    fn what(&self) -> &'static str {
        "the change of the scene's photos"
    }

    fn show(&self, status: &mut SceneStatus, stage: Stage, fraction: f32) {
        if status.is_growing() {
            status.growth.stage = Some(stage.name().to_owned());
            status.growth.fraction = stage.overall(fraction);
        }
    }

    fn attempts<'a>(&self, record: &'a mut Record) -> Option<&'a mut u32> {
        let waits = !record.growth.waiting.is_empty();
        waits.then_some(&mut record.growth.attempts)
    }

    fn requeued(&self, record: &mut Record) {
        record.status.growth = record.growth.status();
    }

    /// The change is given up; those after it go on.
    fn failed(&self, record: &mut Record, error: SceneError, now_ms: u64) {
        record.growth.waiting.pop_front();
        record.growth.attempts = 0;
        let growth = GrowthStatus { error: Some(error), ..record.growth.status() };
        let state = if growth.waiting > 0 { GrowthState::Running } else { GrowthState::Failed };
        record.status.growth = GrowthStatus { state, ..growth };
        record.status.updated_ms = now_ms;
    }
}

impl Work for GrowScene {
    fn span(&self, _: &Jobs, id: &SceneId) -> tracing::Span {
        tracing::info_span!("grow", scene = %id)
    }

    fn run(&self, jobs: &Jobs, job: &Job) -> Result<()> {
        jobs.grow_scene(job)
    }
}

/// A scene whose photos changed, before it is kept.
struct NewVersion {
    scene: Scene,
    semantics: Option<Semantics>,
    /// Its photos and what the networks said of them, for what comes next.
    upload: Arc<ReadUpload>,
    seen: Option<Seen>,
    labelled: Option<LabelledPhotos>,
}

impl ReadUpload {
    /// Whether a job of the scene of this status needs these photos, in this order.
    pub(super) fn fits(&self, status: &SceneStatus) -> bool {
        match &self.content {
            Content::Photos(photos) => status.cameras.is_empty() || photos.is_of(&status.cameras),
            Content::Unposed(_) | Content::Splats(_) => true,
        }
    }

    pub(super) fn with_photos(&self, photos: PhotoSet) -> Self {
        Self { files: self.files.clone(), content: Content::Photos(photos) }
    }
}

/// The limits of photos that join others: all of them together keep no more pixels than a scene
/// that is made at once.
fn limits_beside(limits: &Limits, photos: usize, others: usize) -> Limits {
    let share = photos as f64 / (photos + others).max(1) as f64;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share")]
    let photos_pixels_kept_max = (limits.photos_pixels_kept_max as f64 * share) as u64;
    Limits { photos_min: 1, photos_pixels_kept_max, ..limits.clone() }
}

/// How photos that join a scene are read: with the cameras that come with them.
fn read_joining(
    upload: &Upload,
    limits: &Limits,
    cancel: &AtomicBool,
) -> Result<(PhotoSet, Vec<PhotoHash>)> {
    let read = ReadUpload::of(upload, &SceneOptions::default(), limits, cancel)?;
    match read.content {
        Content::Photos(photos) => Ok((photos, read.files)),
        Content::Unposed(_) => Err(Error::invalid(
            "photos that join a scene need cameras in its frame: send transforms, cameras or a \
             capture's own camera files",
        )),
        Content::Splats(_) => {
            Err(Error::invalid("photos join a scene; a file of Gaussians is one of its own"))
        }
    }
}

impl Jobs {
    /// Makes photos safe in the store and orders that they join a finished scene. Whether an
    /// earlier call with the same key did.
    ///
    /// # Errors
    /// `scene_not_found`; `invalid_request`, `photo_unreadable`, `limit_exceeded` where the photos
    /// cannot join it; `idempotency_key_reused` when the key was used with others; `overloaded`
    /// when the queue is full or the server stops; `store_unavailable`.
    pub(crate) fn add_photos(
        &self,
        id: &SceneId,
        upload: Upload,
        idempotency_key: Option<String>,
    ) -> Result<bool> {
        let record = self.record(id)?;
        let (limits, there) = (self.parts.limits.get(), record.photos_to_be());
        let reading = limits_beside(&limits, upload.sent().count().max(1), there.len());
        let (photos, hashes) = read_joining(&upload, &reading, &AtomicBool::new(false))?;
        let request_sha256 = store::request_sha256(&hashes, &SceneOptions::default());
        if let Some(replayed) = replayed(&record, idempotency_key.as_deref(), &request_sha256)? {
            return Ok(replayed);
        }
        let files: Vec<String> = photos.photos.into_iter().map(|posed| posed.file).collect();
        if let Some(twice) = files.iter().find(|file| there.contains(&&***file)) {
            return Err(Error::invalid(format!("scene {id} has a photo {twice:?} already")));
        }
        let all = there.len() + files.len();
        if all > limits.network_photos_max {
            return Err(Error::limit("photos of the scene", all, limits.network_photos_max));
        }
        // Files that are in the store already are listed by it.
        let object = match &upload.kept {
            Some(kept) => kept.list.clone(),
            None => Store::added_name()?,
        };
        let added = AddedPhotos { object, files, idempotency_key, request_sha256 };
        self.parts.store.has_room()?;
        let mut waiting = (*record).clone();
        waiting.growth.waiting.push_back(PhotoChange::Add(added.clone()));
        self.order(&record, &PhotoChange::Add(added.clone()), || {
            self.parts.store.put_added(&added.object, upload, &waiting)
        })?;
        tracing::info!(scene = %id, photos = added.files.len(), "photos are to join");
        Ok(false)
    }

    /// Orders that a photo leaves a finished scene.
    ///
    /// # Errors
    /// `scene_not_found`; `not_found` where it has no such photo; `invalid_request` where too few
    /// would be left; `overloaded`, `store_unavailable`.
    pub(crate) fn remove_photo(&self, id: &SceneId, file: &str) -> Result<()> {
        let record = self.record(id)?;
        let (there, least) = (record.photos_to_be(), self.parts.limits.get().photos_min);
        if !there.contains(&file) {
            let message = format!("scene {id} has no photo {:?}", crate::error::short(file));
            return Err(Error::new(ErrorCode::NotFound, message));
        }
        if there.len() <= least {
            let message = format!("scene {id} has {} photos and needs {least}", there.len());
            return Err(Error::invalid(message));
        }
        self.order(&record, &PhotoChange::Remove(file.to_owned()), || Ok(()))
    }

    /// Keeps what a change needs, then its order, and queues it.
    fn order(
        &self,
        record: &Record,
        change: &PhotoChange,
        keep: impl FnOnce() -> Result<()>,
    ) -> Result<()> {
        let id = &record.status.id;
        let reserved = self.queue.reserve(GROW, record.owner.as_deref());
        let place = reserved.map_err(|full| self.overloaded(full))?;
        let ordered = keep().and_then(|()| {
            let _turn = self.ordering.lock();
            self.replicas.begin_growing(&self.parts.store, id)?;
            // What another replica changed last.
            self.replicas.refresh(self, id)?;
            self.replicas.hold(id);
            let ordered = self.records.apply(id, &Change::PhotosOrdered(change))?;
            ordered.is_any().then_some(()).ok_or_else(|| {
                let why = format!("scene {id}: another call changed its photos; ask again");
                Error::new(ErrorCode::Overloaded, why).retry_after_s(1)
            })
        });
        if let Err(error) = ordered {
            self.drop_photos_of(id, change);
            self.end_growing(id);
            return Err(error);
        }
        // It begins again with all photos.
        self.queue.remove(id, Some(REFINE));
        self.running.stop(Reason::Cancelled, |job| job.kind == REFINE && job.scene == *id);
        self.queue.remove(id, Some(GROW));
        place.fill(id.clone());
        Ok(())
    }

    /// Forgets the photos of a change that is not done.
    fn drop_photos_of(&self, id: &SceneId, change: &PhotoChange) {
        if let PhotoChange::Add(added) = change
            && let Err(error) = self.parts.store.drop_added(id, &added.object)
        {
            tracing::warn!(scene = %id, %error, "photos that nothing needs are still kept");
        }
    }

    /// Forgets the photos of a change that a failure has taken off the record.
    pub(super) fn drop_given_up(&self, failed: &Changed) {
        let [before, after] = [&failed.before, &failed.after].map(|record| &record.growth.waiting);
        if after.len() < before.len()
            && let Some(change) = before.front()
        {
            self.drop_photos_of(&failed.after.status.id, change);
        }
    }

    /// Forgets uploads of which a change has left the scene no photo. One that a kill spares here
    /// goes with the scene.
    fn drop_gone(&self, grown: &Changed) {
        let id = &grown.after.status.id;
        for object in grown.before.growth.objects() {
            if !grown.after.growth.objects().any(|kept| kept == object)
                && let Err(error) = self.parts.store.drop_added(id, object)
            {
                tracing::warn!(scene = %id, %error, "photos that nothing needs are still kept");
            }
        }
    }

    /// Queues the next change after a job of this kind.
    pub(super) fn go_on_growing(&self, job: &Job) {
        if job.kind == GROW && !self.end_growing(&job.scene) {
            let owner = self.records.find(&job.scene).and_then(|record| record.owner.clone());
            // A job that waits again is there already.
            self.queue.remove(&job.scene, Some(GROW));
            self.queue.push(GROW, job.scene.clone(), owner.as_deref());
        }
    }

    /// Lets other replicas change the photos of a scene where none of its changes waits here;
    /// whether that is so.
    fn end_growing(&self, id: &SceneId) -> bool {
        let _turn = self.ordering.lock();
        let Some(record) = self.records.find(id) else { return true };
        if !record.growth.waiting.is_empty() {
            return false;
        }
        if let Err(error) = self.replicas.end_growing(&self.parts.store, id) {
            tracing::warn!(scene = %id, %error, "no other replica can change its photos now");
        }
        true
    }

    fn grow_scene(&self, job: &Job) -> Result<()> {
        let id = &job.scene;
        // Nothing else changes the scene, or makes its semantics, meanwhile.
        let _lock = self.lock(id.as_str(), job)?;
        let record = self.record(id)?;
        let Some(change) = record.growth.waiting.front() else { return Ok(()) };
        self.check_attempts(job.kind, &record)?;
        self.records.apply(id, &Change::Started(job.kind))?;
        let served = self.parts.store.scene(id)?;
        let version =
            self.within_time(job, |watch| self.changed(&record, change, &served, watch))?;
        self.show(job, Stage::Store, 0.0);
        let NewVersion { scene, semantics, upload, seen, labelled } = version;
        let scene = self.parts.store.put_grown(scene, semantics)?;
        let order = self.order_after(&record, &scene);
        // Jobs that come find the photos of the version that they see.
        self.uploads.leave(id, upload);
        if let Some(seen) = seen {
            self.uploads.keep_seen(id, seen);
        }
        if let Some(labelled) = labelled {
            self.uploads.keep_labelled(id, labelled);
        }
        let grown = self.records.apply(id, &Change::Grown(&scene, order))?;
        self.drop_gone(&grown);
        let grown = grown.after;
        let (version, photos) = (grown.status.version, scene.meta.cameras.len());
        tracing::info!(scene = %id, version, photos, "its photos changed");
        if grown.refine.is_some() {
            self.queue.push(REFINE, id.clone(), grown.owner.as_deref());
        }
        self.prepare(&scene);
        (self.parts.foresee)(id);
        Ok(())
    }

    /// The version of a scene in which a change of its photos is done.
    fn changed(
        &self,
        record: &Record,
        change: &PhotoChange,
        served: &Scene,
        watch: Watch<'_>,
    ) -> Result<NewVersion> {
        let (id, limits) = (&record.status.id, self.parts.limits.get());
        (watch.progress)(Stage::Photos, 0.0);
        let upload = self.upload(id, watch)?;
        let before = upload.photos()?;
        let stays = |file: &str| match change {
            PhotoChange::Add(added) => !added.files.iter().any(|new| new == file),
            PhotoChange::Remove(gone) => file != gone,
        };
        let files = before.photos.iter().map(|posed| &*posed.file);
        let kept: Vec<usize> =
            files.clone().enumerate().filter(|(_, file)| stays(file)).map(|(i, _)| i).collect();
        let stay = before.only(files.filter(|file| stays(file)));
        let stay = stay.ok_or_else(|| Error::internal("a photo is not among its own"))?;
        let (photos, hashes) = match change {
            PhotoChange::Add(added) => {
                let (new, hashes) = self.read_added(id, added, kept.len(), watch)?;
                (stay.joined(new), hashes)
            }
            PhotoChange::Remove(_) => (stay, Vec::new()),
        };
        // Of a version that was kept before a kill, and whose record was not, too.
        let cameras = served.meta.cameras.iter().enumerate();
        let served_kept: Vec<usize> =
            cameras.filter(|(_, of)| stays(&of.file)).map(|(i, _)| i).collect();
        let _room = self.room.take(photos.photos.len(), limits.network_photos_max, watch.cancel)?;
        let seen = self.uploads.find_seen(id);
        let seen = seen.filter(|seen| seen.photos() == before.photos.len());
        let seen = seen.map(|seen| seen.only(&kept));
        let scenes = &self.parts.scenes;
        let grown = scenes.make_more(&photos, kept.len(), seen, &record.options, watch)?;
        let made =
            growth::version(&*self.parts.renderer, served, &served_kept, &grown, &photos.photos)?;
        let provenance = changed_provenance(&served.meta.provenance, change, hashes);
        let scene = made.into_scene(id.clone(), served.meta.created_ms, provenance);
        let (semantics, labelled) = match record.status.semantics.state {
            SemanticsState::Ready => {
                let known = self.uploads.find_labelled(id);
                let known = known.filter(|known| known.photos() == before.photos.len());
                let known = known.map(|known| known.only(&kept));
                let scene = Arc::new(scene.clone());
                let made = || -> Result<Arc<Scene>> { Ok(Arc::clone(&scene)) };
                let method = &scene.meta.report.method;
                let (networks, photos) = (&self.parts.semantics, &photos.photos);
                let made = networks.make_more(photos, known.as_ref(), method, &made, watch)?;
                (Some(made.0), made.1)
            }
            _ => (None, None),
        };
        let upload = Arc::new(upload.with_photos(photos));
        Ok(NewVersion { scene, semantics, upload, seen: grown.seen, labelled })
    }

    /// The photos of an upload that joined the scene, or is to, beside so many others.
    fn read_added(
        &self,
        id: &SceneId,
        added: &AddedPhotos,
        others: usize,
        watch: Watch<'_>,
    ) -> Result<(PhotoSet, Vec<PhotoHash>)> {
        let upload = self.parts.store.added(id, &added.object)?;
        let limits = limits_beside(&self.parts.limits.get(), added.files.len(), others);
        let (photos, hashes) = read_joining(&upload, &limits, watch.cancel)?;
        let options = self.record(id)?.options.clone();
        if options.ignore.is_empty() {
            return Ok((photos, hashes));
        }
        let (words, method) = (&options.ignore, options.method());
        Ok((self.parts.semantics.without_words(photos, words, &method, watch)?, hashes))
    }

    /// What a scene was made of, with what joined it later and without what left it: the photos of
    /// its cameras.
    pub(super) fn with_joined(
        &self,
        read: ReadUpload,
        record: &Record,
        watch: Watch<'_>,
    ) -> Result<ReadUpload> {
        let (id, cameras) = (&record.status.id, &record.status.cameras);
        if read.fits(&record.status) && record.growth.joined.is_empty() {
            return Ok(read);
        }
        let mut all = read.photos()?.clone();
        let lacks = || Error::internal(format!("a photo of scene {id} is not in its uploads"));
        for added in record.growth.joined.iter().filter(|added| !added.files.is_empty()) {
            let (new, _) = self.read_added(id, added, all.photos.len(), watch)?;
            let new = new.only(added.files.iter().map(String::as_str)).ok_or_else(lacks)?;
            all = all.joined(new);
        }
        let photos = all.only(cameras.iter().map(|camera| &*camera.file));
        Ok(read.with_photos(photos.ok_or_else(lacks)?))
    }

    /// The refinement of a scene after the last change of its photos: as it was ordered before, or
    /// again where it was refined, or where its call or the configuration asks for one.
    fn order_after(&self, record: &Record, scene: &Scene) -> Option<RefineOrder> {
        if record.growth.waiting.len() > 1 || record.refine.is_some() {
            return None;
        }
        let how = match (record.growth.refine, &scene.meta.report.refinement) {
            (Some(how), _) => how,
            (None, Some(_)) => Refine::Auto,
            (None, None) => record.options.refine.unwrap_or(self.parts.refine),
        };
        let ms = self.parts.refiner.budget_ms(how, scene.meta.cameras.len())?;
        self.queue.reserve(REFINE, record.owner.as_deref()).ok()?;
        Some(RefineOrder { ms, attempts: 0 })
    }
}

/// Whether photos came with this key before.
fn replayed(record: &Record, key: Option<&str>, request_sha256: &str) -> Result<Option<bool>> {
    let Some(key) = key else { return Ok(None) };
    let mut used = record.growth.added();
    match used.find(|added| added.idempotency_key.as_deref() == Some(key)) {
        None => Ok(None),
        Some(added) if added.request_sha256 == request_sha256 => Ok(Some(true)),
        Some(_) => {
            let id = &record.status.id;
            let message = format!("the idempotency key was used with other photos (scene {id})");
            Err(Error::new(ErrorCode::IdempotencyKeyReused, message))
        }
    }
}

/// The sources of a scene after a change of its photos. Its content is no longer what one upload
/// holds: no other scene is copied of it.
fn changed_provenance(
    before: &Provenance,
    change: &PhotoChange,
    hashes: Vec<PhotoHash>,
) -> Provenance {
    let mut files = before.files.clone();
    let what = match change {
        PhotoChange::Add(added) => format!("with {}", added.request_sha256),
        PhotoChange::Remove(gone) => {
            files.retain(|of| of.file != *gone);
            format!("without {gone}")
        }
    };
    // Each call has a file of cameras: the first and the newest of a name stay.
    for hash in &hashes {
        let mut same = (0..files.len()).filter(|&i| files[i].file == hash.file);
        if let (Some(_), Some(old)) = (same.next(), same.next()) {
            files.remove(old);
        }
    }
    files.extend(hashes);
    let content_sha256 = store::sha256(format!("{} {what}", before.content_sha256).as_bytes());
    Provenance { files, content_sha256, ..before.clone() }
}
