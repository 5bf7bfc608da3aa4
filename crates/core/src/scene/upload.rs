//! An upload as bytes: camera JSON and photos, the files of a capture, one archive, or a file of
//! Gaussians.

use std::fmt;

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
}

impl Upload {
    /// Bytes of all parts together.
    pub fn size_bytes(&self) -> usize {
        let cameras = match &self.cameras {
            Some(UploadCameras::Transforms(json) | UploadCameras::Cameras(json)) => json.len(),
            None => 0,
        };
        let files = self.photos.iter().chain(&self.splats);
        let files: usize = files.map(|file| file.bytes.len()).sum();
        cameras + files + self.archive.as_ref().map_or(0, Vec::len)
    }
}
