//! Uploads of jobs in memory: jobs do not read again what the create call read.

use std::{
    collections::HashMap,
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use parking_lot::Mutex;

use crate::{
    error::{Error, Result},
    formats::table::read_splats,
    limits::Limits,
    pipeline::{self, PhotoSet, ReadSet, Seen, UnposedSet, semantics::LabelledPhotos},
    scene::{
        PhotoHash, Scene, SceneId, SceneOptions, SceneStatus, SemanticsMode, Stage, StageTime,
        Upload,
    },
    store,
};

/// An upload as its jobs need it.
#[derive(Clone, Debug)]
pub(super) struct ReadUpload {
    pub(super) files: Vec<PhotoHash>,
    pub(super) content: Content,
}

/// What an upload holds.
#[derive(Clone, Debug)]
pub(super) enum Content {
    Photos(PhotoSet),
    /// Photos whose cameras are not solved yet.
    Unposed(UnposedSet),
    /// A file of Gaussians as a scene that has no id yet.
    Splats(Box<Scene>),
}

impl ReadUpload {
    /// Reads an upload, until it is cancelled.
    /// Fails as [`pipeline::read`], [`read_splats`] and `SplatsRead::into_scene` do.
    pub(super) fn of(
        upload: &Upload,
        options: &SceneOptions,
        limits: &Limits,
        cancel: &AtomicBool,
    ) -> Result<Self> {
        let read = || match upload.sent_splats() {
            None => Ok(match pipeline::read(upload, options.cameras, limits, cancel)? {
                ReadSet::Posed(photos) => Content::Photos(photos),
                ReadSet::Unposed(photos) => Content::Unposed(photos),
            }),
            Some(file) => {
                let begun = Instant::now();
                let bytes = file.bytes.read()?;
                let read = read_splats(&mut &bytes[..], file.name, limits)?;
                let mut scene = read.into_scene(options)?;
                let ms = begun.elapsed().as_secs_f64() * 1e3;
                let stage = Stage::Photos.name().to_owned();
                scene.meta.report.stages.push(StageTime { stage, ms });
                Ok(Content::Splats(Box::new(scene)))
            }
        };
        let (content, files) = rayon::join(read, || store::hashes(upload));
        Ok(Self { files, content: content? })
    }

    /// As it is once the scene of this status is made: photos that came without cameras have those
    /// of the scene.
    pub(super) fn of_scene(self, status: &SceneStatus) -> Self {
        let content = match (self.content, &status.report) {
            (Content::Unposed(photos), Some(report)) => {
                Content::Photos(photos.posed_as(&status.cameras, &report.cameras))
            }
            (content, _) => content,
        };
        Self { content, ..self }
    }

    /// Whether it is photos whose cameras are to be found.
    pub(super) fn is_unposed(&self) -> bool {
        matches!(self.content, Content::Unposed(_))
    }

    /// Whether it is photos, and no file of Gaussians.
    pub(super) fn is_of_photos(&self) -> bool {
        !matches!(self.content, Content::Splats(_))
    }

    /// The photos with their cameras.
    /// Fails with `invalid_request` where it is a file of Gaussians.
    pub(super) fn photos(&self) -> Result<&PhotoSet> {
        match &self.content {
            Content::Photos(photos) => Ok(photos),
            Content::Unposed(_) => {
                Err(Error::internal("the cameras of the photos are not solved yet"))
            }
            Content::Splats(_) => {
                Err(Error::invalid("the scene is a file of Gaussians; it has no photos"))
            }
        }
    }

    /// When the semantics of its scene are made, where the call says `asked`: those of a file are
    /// in it, or are never made.
    pub(super) fn semantics(&self, asked: SemanticsMode) -> SemanticsMode {
        match &self.content {
            Content::Splats(scene) if scene.semantics.is_none() => SemanticsMode::Off,
            _ => asked,
        }
    }

    /// Room that its scene takes while it is made: its photos; of a file as large a share of all
    /// room as of the bytes that one may have.
    pub(super) fn room(&self, limits: &Limits) -> usize {
        match &self.content {
            Content::Photos(photos) => photos.photos.len(),
            Content::Unposed(photos) => photos.photos.len(),
            Content::Splats(scene) => {
                let share = scene.size_bytes() as f64 / limits.splats_bytes_max.max(1) as f64;
                (share * limits.network_photos_max as f64).ceil() as usize
            }
        }
    }

    /// Bytes of its photos or Gaussians.
    pub(super) fn size_bytes(&self) -> u64 {
        match &self.content {
            Content::Photos(photos) => photos.size_bytes(),
            Content::Unposed(photos) => photos.size_bytes(),
            Content::Splats(scene) => scene.size_bytes(),
        }
    }
}

/// Uploads of scenes whose jobs wait or run, and for a time those of scenes that may be asked their
/// first text; bounded by the bytes of their photos and Gaussians. One that is not here is read
/// from the store when its job begins.
#[derive(Debug)]
pub(super) struct ReadUploads {
    bytes_max: u64,
    /// How long an upload stays for a first text.
    left_for: Duration,
    uploads: Mutex<HashMap<SceneId, Kept>>,
}

#[derive(Clone, Debug)]
struct Kept {
    upload: Arc<ReadUpload>,
    /// What the networks said of its photos, for a refinement, and for photos that join it.
    seen: Option<Arc<Seen>>,
    /// What its photos mean, for photos that join it.
    labelled: Option<Arc<LabelledPhotos>>,
    /// End of its time; none where a job waits for it.
    until: Option<Instant>,
}

impl Kept {
    fn is_fresh(&self, now: Instant) -> bool {
        self.until.is_none_or(|until| now < until)
    }

    fn size_bytes(&self) -> u64 {
        self.upload.size_bytes()
            + self.seen.as_ref().map_or(0, |seen| seen.size_bytes())
            + self.labelled.as_ref().map_or(0, |labelled| labelled.size_bytes())
    }
}

impl ReadUploads {
    pub(super) fn new(bytes_max: u64, left_for: Duration) -> Self {
        Self { bytes_max, left_for, uploads: Mutex::default() }
    }

    /// Keeps an upload until it is forgotten, where it fits. Those that wait for a first text make
    /// room, the oldest first.
    pub(super) fn keep(&self, id: &SceneId, upload: Arc<ReadUpload>) {
        self.insert(id, Kept { upload, seen: None, labelled: None, until: None });
    }

    /// Keeps an upload for a first text, where it fits.
    pub(super) fn leave(&self, id: &SceneId, upload: Arc<ReadUpload>) {
        let until = Some(Instant::now() + self.left_for);
        self.insert(id, Kept { upload, seen: None, labelled: None, until });
    }

    /// What the photos mean and what the networks said are kept only where they fit beside the
    /// upload.
    fn insert(&self, id: &SceneId, mut new: Kept) {
        let mut uploads = self.uploads.lock();
        uploads.remove(id);
        let needed = uploads.values().filter(|kept| kept.until.is_none());
        let room = self.bytes_max.saturating_sub(needed.map(Kept::size_bytes).sum());
        if new.size_bytes() > room {
            new.labelled = None;
        }
        if new.size_bytes() > room {
            new.seen = None;
        }
        if new.size_bytes() > room {
            return;
        }
        let all = |uploads: &HashMap<_, Kept>| uploads.values().map(Kept::size_bytes).sum::<u64>();
        while all(&uploads) + new.size_bytes() > self.bytes_max {
            let left = uploads.iter().filter_map(|(id, kept)| Some((kept.until?, id)));
            let Some(oldest) = left.min_by_key(|(until, _)| *until) else { break };
            let oldest = oldest.1.clone();
            uploads.remove(&oldest);
        }
        uploads.insert(id.clone(), new);
    }

    /// Keeps what the networks said of the photos beside an upload that is here, where it fits.
    pub(super) fn keep_seen(&self, id: &SceneId, seen: Seen) {
        self.keep_more(id, |kept| Kept { seen: Some(Arc::new(seen)), ..kept });
    }

    /// Keeps what the photos mean beside an upload that is here, where it fits.
    pub(super) fn keep_labelled(&self, id: &SceneId, labelled: LabelledPhotos) {
        self.keep_more(id, |kept| Kept { labelled: Some(Arc::new(labelled)), ..kept });
    }

    fn keep_more(&self, id: &SceneId, with: impl FnOnce(Kept) -> Kept) {
        let kept = self.uploads.lock().remove(id);
        if let Some(kept) = kept {
            self.insert(id, with(kept));
        }
    }

    /// What the photos mean.
    pub(super) fn find_labelled(&self, id: &SceneId) -> Option<Arc<LabelledPhotos>> {
        self.uploads.lock().get(id)?.labelled.clone()
    }

    /// What the networks said of the photos.
    pub(super) fn find_seen(&self, id: &SceneId) -> Option<Arc<Seen>> {
        self.uploads.lock().get(id)?.seen.clone()
    }

    pub(super) fn find(&self, id: &SceneId) -> Option<Arc<ReadUpload>> {
        let uploads = self.uploads.lock();
        let kept = uploads.get(id).filter(|kept| kept.is_fresh(Instant::now()));
        kept.map(|kept| Arc::clone(&kept.upload))
    }

    /// No job waits for an upload any more: its time for a first text begins.
    pub(super) fn renew(&self, id: &SceneId) {
        if let Some(kept) = self.uploads.lock().get_mut(id) {
            kept.until = Some(Instant::now() + self.left_for);
        }
    }

    pub(super) fn forget(&self, id: &SceneId) {
        self.uploads.lock().remove(id);
    }

    /// Bytes of all photos and Gaussians here.
    pub(super) fn size_bytes(&self) -> u64 {
        self.uploads.lock().values().map(Kept::size_bytes).sum()
    }

    /// Those whose time is over.
    pub(super) fn old(&self, now: Instant) -> Vec<SceneId> {
        let uploads = self.uploads.lock();
        let old = uploads.iter().filter(|(_, kept)| !kept.is_fresh(now));
        old.map(|(id, _)| id.clone()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Camera, CameraToWorld, Intrinsics, Photo, PosedPhoto};

    fn upload(bytes: usize) -> Arc<ReadUpload> {
        let intrinsics = Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width: 1, height: 1 };
        let pose = [1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
        let camera_to_world = CameraToWorld::from_row_major(&pose, "test").unwrap();
        let camera = Camera { intrinsics, camera_to_world };
        let photo = Photo { width: 1, height: 1, rgb: vec![0; bytes], valid: None };
        let posed = PosedPhoto { file: String::new(), photo, camera, intrinsics_made_for: None };
        let photos = PhotoSet::given(vec![posed], Vec::new(), 0.0);
        Arc::new(ReadUpload { files: Vec::new(), content: Content::Photos(photos) })
    }

    #[test]
    fn photos_for_a_first_text_make_room_and_go_in_their_time() {
        let uploads = ReadUploads::new(10, Duration::from_secs(60));
        let ids: Vec<SceneId> = (0..5).map(|byte| SceneId::from_bytes([byte; 16])).collect();
        let kept = || -> Vec<bool> { ids.iter().map(|id| uploads.find(id).is_some()).collect() };
        let forget_old = |seconds| {
            let old = uploads.old(Instant::now() + Duration::from_secs(seconds));
            old.iter().for_each(|id| uploads.forget(id));
        };
        uploads.leave(&ids[0], upload(4));
        uploads.leave(&ids[1], upload(4));
        uploads.keep(&ids[2], upload(4));
        assert_eq!(kept(), [false, true, true, false, false], "the oldest makes room");
        uploads.leave(&ids[3], upload(7));
        assert_eq!(kept(), [false, true, true, false, false], "what cannot fit drops no other");
        uploads.leave(&ids[3], upload(6));
        assert_eq!(kept(), [false, false, true, true, false], "never one that a job needs");
        uploads.keep(&ids[4], upload(6));
        assert_eq!(kept(), [false, false, true, false, true]);
        uploads.leave(&ids[4], upload(6));
        forget_old(50);
        assert_eq!(kept(), [false, false, true, false, true], "its time is not over");
        forget_old(70);
        assert_eq!(kept(), [false, false, true, false, false], "a job's photos have no time");
        uploads.renew(&ids[2]);
        forget_old(70);
        assert_eq!(kept(), [false; 5], "until no job waits for them");
    }
}
