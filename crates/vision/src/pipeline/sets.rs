//! The photos of an upload: with cameras, or without.

use crate::{
    photos,
    scene::{
        CamerasReport, Photo, PosedPhoto, SceneCamera, Stage, StageTime, UnposedPhoto, Warning,
        WarningCode,
    },
};

/// The photos of an upload with their cameras, read and undistorted.
#[derive(Clone, Debug)]
pub struct PhotoSet {
    /// The photos, in the order of the cameras.
    pub photos: Vec<PosedPhoto>,
    /// What of the upload was not used or not there.
    pub warnings: Vec<Warning>,
    /// How long the stages until here took.
    pub stages: Vec<StageTime>,
    /// Where the cameras come from.
    pub cameras: CamerasReport,
    /// Whether they are without what the words of their scene name.
    pub is_without_words: bool,
}

impl PhotoSet {
    /// Photos whose cameras were given, and how long reading them took, milliseconds.
    #[must_use]
    pub fn given(photos: Vec<PosedPhoto>, warnings: Vec<Warning>, read_ms: f64) -> Self {
        let stages = vec![read_time(read_ms)];
        let cameras = CamerasReport::default();
        Self { photos, warnings, stages, cameras, is_without_words: false }
    }

    /// Whether the upload has photos for the steps of a refinement alone.
    #[must_use]
    pub fn has_more(&self) -> bool {
        self.warnings.iter().any(|warning| warning.code == WarningCode::PhotosForSteps)
    }

    /// Bytes of the pixels.
    #[must_use]
    pub fn size_bytes(&self) -> u64 {
        self.photos.iter().map(|posed| bytes_of(&posed.photo)).sum()
    }

    /// These photos, then those of `more`, whose stages and warnings are the newest. A photo of
    /// `more` takes the place of one of its name.
    #[must_use]
    pub fn joined(mut self, more: Self) -> Self {
        self.photos.retain(|one| !more.photos.iter().any(|other| other.file == one.file));
        self.photos.extend(more.photos);
        let warnings = newest(&self.warnings, &more.warnings);
        Self { warnings, stages: more.stages, ..self }
    }

    /// The photos of these files, in their order; `None` where one is not there.
    #[must_use]
    pub fn only<'f>(&self, files: impl Iterator<Item = &'f str>) -> Option<Self> {
        let of = |file: &str| self.photos.iter().find(|posed| posed.file == file).cloned();
        let photos = files.map(of).collect::<Option<_>>()?;
        let (warnings, stages) = (self.warnings.clone(), self.stages.clone());
        let cameras = self.cameras.clone();
        Some(Self { photos, warnings, stages, cameras, is_without_words: self.is_without_words })
    }

    /// Whether they are the photos of these cameras, in their order.
    #[must_use]
    pub fn is_of(&self, cameras: &[SceneCamera]) -> bool {
        self.photos.iter().map(|posed| &posed.file).eq(cameras.iter().map(|camera| &camera.file))
    }
}

/// What is said of photos, and then of `more` that join them: of each kind only the newest, so that
/// a stream of photos does not say ever more.
pub(super) fn newest(before: &[Warning], more: &[Warning]) -> Vec<Warning> {
    let stays = |one: &&Warning| !more.iter().any(|new| new.code == one.code);
    before.iter().filter(stays).chain(more).cloned().collect()
}

fn bytes_of(photo: &Photo) -> u64 {
    (photo.rgb.len() + photo.valid.as_ref().map_or(0, Vec::len)) as u64
}

pub(super) fn read_time(ms: f64) -> StageTime {
    StageTime { stage: Stage::Photos.name().to_owned(), ms }
}

/// The photos of an upload, with cameras or without.
#[derive(Clone, Debug)]
pub enum ReadSet {
    /// Their cameras came with them.
    Posed(PhotoSet),
    /// Their cameras are to be solved: `cameras::posed`.
    Unposed(UnposedSet),
}

/// Photos of an upload without cameras.
#[derive(Clone, Debug)]
pub struct UnposedSet {
    /// The photos, in the order of their names.
    pub photos: Vec<UnposedPhoto>,
    /// What of the upload was not used.
    pub warnings: Vec<Warning>,
    /// How long reading took, milliseconds.
    pub read_ms: f64,
}

impl UnposedSet {
    /// Bytes of the pixels.
    #[must_use]
    pub fn size_bytes(&self) -> u64 {
        self.photos.iter().map(|unposed| bytes_of(&unposed.photo)).sum()
    }

    /// The photos of a scene that was made of these, with its cameras.
    #[must_use]
    pub fn posed_as(self, cameras: &[SceneCamera], report: &CamerasReport) -> PhotoSet {
        let Self { mut photos, warnings, read_ms } = self;
        let mut posed = Vec::with_capacity(cameras.len());
        for (file, solved) in photos::solved(cameras, report) {
            let Some(at) = photos.iter().position(|photo| photo.file == file) else { continue };
            posed.push(photos::posed(photos.swap_remove(at), &solved));
        }
        let stages = vec![read_time(read_ms)];
        let cameras = report.clone();
        PhotoSet { photos: posed, warnings, stages, cameras, is_without_words: false }
    }
}

#[cfg(test)]
mod tests {
    use super::{PhotoSet, Warning, WarningCode};

    #[test]
    fn of_each_kind_of_warning_the_newest_stays_where_photos_join() {
        let said = |code, value: f64| Warning { code, message: value.to_string(), value };
        let (low, unread) = (WarningCode::LowOverlap, WarningCode::KeysUnread);
        let set = |warnings: &[Warning]| PhotoSet::given(Vec::new(), warnings.to_vec(), 0.0);
        let before = set(&[said(low, 1.0), said(unread, 2.0)]);
        assert_eq!(before.clone().joined(set(&[])).warnings, before.warnings);
        let joined = before.joined(set(&[said(low, 3.0)]));
        assert_eq!(joined.warnings, [said(unread, 2.0), said(low, 3.0)]);
    }
}
