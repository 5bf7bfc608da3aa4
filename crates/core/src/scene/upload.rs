//! An upload: camera JSON and photos, the files of a capture, one archive, or a file of Gaussians.
//! Its first bytes are in memory, files beyond them may lie elsewhere and be read one at a time.

use std::{borrow::Cow, fmt, sync::Arc};

use super::SceneId;
use crate::error::Result;

/// One file as sent: a photo, a camera file of a capture, or a file of Gaussians.
#[derive(Clone, PartialEq, Eq)]
pub struct UploadFile {
    /// File name as sent; never joined to a path.
    pub name: String,
    /// The file, undecoded.
    pub bytes: Vec<u8>,
}

impl fmt::Debug for UploadFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "UploadFile({:?}, {} bytes)", self.name, self.bytes.len())
    }
}

/// The camera description as sent, undecoded JSON.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum UploadCameras {
    /// A nerfstudio or instant-ngp `transforms.json` (OpenGL axes).
    Transforms(Vec<u8>),
    /// Our own `cameras` JSON (OpenCV axes).
    Cameras(Vec<u8>),
}

/// What a file of an upload is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FilePart {
    /// A photo, or a camera file of a capture.
    Photo,
    /// A zip or tar of a folder with a capture.
    Archive,
    /// A file of Gaussians.
    Splats,
}

/// Reads the bytes of a file that lies elsewhere. May block.
pub trait KeptBytes: Send + Sync {
    /// So many bytes from a place on, which must all be there.
    ///
    /// # Errors
    /// `store_unavailable`; `scene_corrupt` where the file is gone or another one.
    fn read(&self, from: u64, len: u64) -> Result<Vec<u8>>;
}

/// A file of an upload that lies elsewhere and is read when its turn comes.
#[derive(Clone)]
pub struct KeptFile {
    /// What it is.
    pub part: FilePart,
    /// File name as sent; never joined to a path.
    pub name: String,
    /// Bytes of it.
    pub size: u64,
    /// sha256 of it, hex.
    pub sha256: String,
    /// Where it lies.
    pub bytes: Arc<dyn KeptBytes>,
}

impl fmt::Debug for KeptFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "KeptFile({:?}, {:?}, {} bytes)", self.part, self.name, self.size)
    }
}

impl PartialEq for KeptFile {
    fn eq(&self, other: &Self) -> bool {
        let of = |file: &Self| (file.part, file.name.clone(), file.size, file.sha256.clone());
        of(self) == of(other)
    }
}

impl Eq for KeptFile {}

/// The files of an upload that lie elsewhere.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KeptFiles {
    /// The scene that they were put beside.
    pub scene: SceneId,
    /// What their list is called there.
    pub list: String,
    /// In the order sent, all after those in memory.
    pub files: Vec<KeptFile>,
}

/// Everything sent for one scene: cameras and photos, the files of a capture that has its own
/// camera files, an archive of one, or a file of Gaussians.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Upload {
    /// Camera description; `None` when it is among the files or in the archive.
    pub cameras: Option<UploadCameras>,
    /// Photos in the order sent, and the camera files of a capture.
    pub photos: Vec<UploadFile>,
    /// A zip or tar of a folder with a capture.
    pub archive: Option<Vec<u8>>,
    /// A file of Gaussians, which is a whole scene.
    pub splats: Option<UploadFile>,
    /// Files that are not in memory.
    pub kept: Option<KeptFiles>,
}

/// The bytes of a file of an upload, wherever they are.
#[derive(Clone, Copy, Debug)]
pub enum SentBytes<'a> {
    /// In memory.
    Here(&'a [u8]),
    /// Elsewhere.
    Kept(&'a KeptFile),
}

impl<'a> SentBytes<'a> {
    /// How many there are.
    #[must_use]
    pub fn size(self) -> u64 {
        match self {
            Self::Here(bytes) => bytes.len() as u64,
            Self::Kept(file) => file.size,
        }
    }

    /// All of them.
    ///
    /// # Errors
    /// As [`KeptBytes::read`].
    pub fn read(self) -> Result<Cow<'a, [u8]>> {
        self.range(0, self.size())
    }

    /// So many from a place on, as far as there are some.
    ///
    /// # Errors
    /// As [`KeptBytes::read`].
    pub fn range(self, from: u64, len: u64) -> Result<Cow<'a, [u8]>> {
        let from = from.min(self.size());
        let len = len.min(self.size() - from);
        match self {
            Self::Here(bytes) => {
                let at = |place: u64| usize::try_from(place).unwrap_or(usize::MAX);
                Ok(Cow::Borrowed(&bytes[at(from)..at(from + len)]))
            }
            Self::Kept(file) => file.bytes.read(from, len).map(Cow::Owned),
        }
    }
}

/// A file of an upload, wherever it is.
#[derive(Clone, Copy, Debug)]
pub struct SentFile<'a> {
    /// File name as sent.
    pub name: &'a str,
    /// The file, undecoded.
    pub bytes: SentBytes<'a>,
}

impl<'a> From<&'a UploadFile> for SentFile<'a> {
    fn from(file: &'a UploadFile) -> Self {
        Self { name: &file.name, bytes: SentBytes::Here(&file.bytes) }
    }
}

impl<'a> From<&'a KeptFile> for SentFile<'a> {
    fn from(file: &'a KeptFile) -> Self {
        Self { name: &file.name, bytes: SentBytes::Kept(file) }
    }
}

impl Upload {
    /// Photos in the order sent, and the camera files of a capture, wherever they are.
    pub fn sent(&self) -> impl Iterator<Item = SentFile<'_>> {
        let here = self.photos.iter().map(SentFile::from);
        here.chain(self.kept_files(FilePart::Photo).map(SentFile::from))
    }

    /// The archive, wherever it is.
    #[must_use]
    pub fn sent_archive(&self) -> Option<SentBytes<'_>> {
        let kept = || self.kept_files(FilePart::Archive).next().map(SentBytes::Kept);
        self.archive.as_deref().map(SentBytes::Here).or_else(kept)
    }

    /// The file of Gaussians, wherever it is.
    #[must_use]
    pub fn sent_splats(&self) -> Option<SentFile<'_>> {
        let kept = || self.kept_files(FilePart::Splats).next().map(SentFile::from);
        self.splats.as_ref().map(SentFile::from).or_else(kept)
    }

    /// The files that are not in memory.
    pub fn kept(&self) -> impl Iterator<Item = &KeptFile> {
        self.kept.iter().flat_map(|kept| &kept.files)
    }

    fn kept_files(&self, part: FilePart) -> impl Iterator<Item = &KeptFile> {
        self.kept().filter(move |file| file.part == part)
    }

    /// Bytes of all parts together.
    pub fn size_bytes(&self) -> usize {
        let kept = self.kept().map(|file| usize::try_from(file.size).unwrap_or(usize::MAX));
        kept.fold(self.memory_bytes(), usize::saturating_add)
    }

    /// Bytes of those that are in memory.
    pub fn memory_bytes(&self) -> usize {
        let cameras = match &self.cameras {
            Some(UploadCameras::Transforms(json) | UploadCameras::Cameras(json)) => json.len(),
            None => 0,
        };
        let files = self.photos.iter().chain(&self.splats);
        let files: usize = files.map(|file| file.bytes.len()).sum();
        cameras + files + self.archive.as_ref().map_or(0, Vec::len)
    }
}
