//! Photos with known cameras. Their lens distortion is already undone.

use crate::scene::Camera;

/// 8-bit sRGB pixels, row-major, with the pixels that have a source.
#[derive(Clone, Debug)]
pub struct Photo {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// `[height * width * 3]`, sRGB as stored.
    pub rgb: Vec<u8>,
    /// `[height * width]`, false where undistortion found no source; `None` when all have one.
    pub valid: Option<Vec<bool>>,
}

/// A square cut of a photo around one thing, black elsewhere: what an image tower is shown.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Crop {
    /// Width and height, pixels of the photo.
    pub side: u32,
    /// `[side * side * 3]`, sRGB as stored; 0 outside the thing and outside the photo.
    pub rgb: Vec<u8>,
}

/// A photo, its camera (of the undistorted pixels, same size) and the file it came from.
#[derive(Clone, Debug)]
pub struct PosedPhoto {
    /// File name as uploaded.
    pub file: String,
    /// Pixels.
    pub photo: Photo,
    /// Camera of these pixels.
    pub camera: Camera,
    /// Width and height that the uploaded intrinsics were made for, where these are not the
    /// photo's: `camera` was scaled to the photo, and the capture report says so.
    pub intrinsics_made_for: Option<[u32; 2]>,
}
