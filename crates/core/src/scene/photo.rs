//! Photos with known cameras, whose lens distortion is already undone, and photos without.

use serde::Deserialize;

use crate::{
    error::short,
    scene::{Camera, IndexMap},
};

/// 8-bit sRGB pixels, row-major, with the pixels that have a source.
#[derive(Clone, Debug)]
pub struct Photo {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// `[height * width * 3]`, sRGB as stored.
    pub rgb: Vec<u8>,
    /// `[height * width]`, the photo's mask: false where a pixel takes no part in the scene: when
    /// undistortion found no source for it, it is transparent, or the mask that was sent leaves it
    /// out. `None` when all take part. Gaussians, steps of refinement and names come from valid
    /// pixels alone.
    pub valid: Option<Vec<bool>>,
}

impl Photo {
    /// Pixels where `map` has an entry take no part in the scene from now on.
    pub fn leave_out(&mut self, map: &IndexMap) {
        if map.index.iter().all(|entry| *entry == 0) {
            return;
        }
        let (width, height) = (self.width as usize, self.height as usize);
        let share = |at: usize, side: usize| (at as f64 + 0.5) / side as f64;
        let valid = self.valid.get_or_insert_with(|| vec![true; width * height]);
        for (i, valid) in valid.iter_mut().enumerate() {
            *valid &= map.at(share(i % width, width), share(i / width, height)) == 0;
        }
    }
}

/// A cut of a photo around one thing, black elsewhere: what an image tower is shown.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Crop {
    /// Width, pixels of the photo.
    pub width: u32,
    /// Height, pixels of the photo.
    pub height: u32,
    /// `[height * width * 3]`, sRGB as stored; 0 outside the thing and outside the photo.
    pub rgb: Vec<u8>,
}

/// What a crop shows of a box that is no square.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CropShape {
    /// The box in the middle of a square, with black beside it.
    #[default]
    Square,
    /// The box alone: the image tower sees it stretched to its square.
    Stretched,
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

/// A photo whose camera is not known, upright, and the file it came from.
#[derive(Clone, Debug)]
pub struct UnposedPhoto {
    /// File name as uploaded.
    pub file: String,
    /// Pixels.
    pub photo: Photo,
    /// Width and height of the file's picture, upright: `photo` may be smaller.
    pub file_size: [u32; 2],
    /// Focal length in pixels, as the photo's EXIF gives it: some per cent off.
    pub focal: Option<f64>,
}

/// How a photo is called in messages: `photo 3 ("images/0003.jpg")`.
pub fn photo_label(index: usize, file: &str) -> String {
    format!("photo {index} ({:?})", short(file))
}
