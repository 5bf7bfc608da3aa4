//! A small posed photo set with exact truth: what the demo posts and the tests compare with.
//!
//! In: options (how many photos, their size, a seed). Out: photos with OpenCV cameras, in memory
//! or as a folder of PNG files with a nerfstudio `transforms.json` (OpenGL). The same seed gives
//! the same room, and [`Room::view`] is the true picture and depth of it at any camera.

mod room;
mod texture;

use std::path::Path;

use glam::DVec3;
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use serde_json::json;

use crate::{
    error::{Error, Result},
    scene::{Camera, CameraToWorld, Intrinsics, PosedPhoto, Upload, UploadCameras, UploadFile},
};

pub use room::{Room, TrueView};

/// Point that every camera of [`cameras`] looks at, room units, +y down.
pub const TARGET: DVec3 = DVec3::new(0.0, -0.62, 0.15);
/// Distance of the cameras from [`TARGET`], room units.
pub const DISTANCE: f64 = 3.6;
/// Angle between neighbouring cameras on the arc, radians: a baseline of 8 % of the distance.
const STEP: f64 = 0.08;
/// Widest half arc, radians; many photos stand closer together instead of going round.
const HALF_ARC_MAX: f64 = 0.6;
/// Focal length in picture widths: a horizontal field of view of 53 degrees.
const FOCAL_WIDTHS: f64 = 1.0;
/// Bounds of `photos` and of each side of a picture.
const PHOTOS: std::ops::RangeInclusive<usize> = 2..=64;
const SIDE: std::ops::RangeInclusive<u32> = 16..=4096;

/// What to generate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleOptions {
    /// Photos on the arc, 2 to 64.
    pub photos: usize,
    /// Width of each photo, pixels.
    pub width: u32,
    /// Height of each photo, pixels.
    pub height: u32,
    /// Seed of the room: where things stand and what they are made of.
    pub seed: u64,
}

impl Default for SampleOptions {
    fn default() -> Self {
        Self { photos: 4, width: 320, height: 240, seed: 1 }
    }
}

impl SampleOptions {
    fn validated(self) -> Result<Self> {
        if !PHOTOS.contains(&self.photos) {
            return Err(Error::invalid(format!(
                "sample: {} photos; it must be {} to {}",
                self.photos,
                PHOTOS.start(),
                PHOTOS.end()
            )));
        }
        if !SIDE.contains(&self.width) || !SIDE.contains(&self.height) {
            return Err(Error::invalid(format!(
                "sample: {}x{} px; each side must be {} to {}",
                self.width,
                self.height,
                SIDE.start(),
                SIDE.end()
            )));
        }
        Ok(self)
    }

    fn intrinsics(&self) -> Intrinsics {
        let (width, height) = (f64::from(self.width), f64::from(self.height));
        let focal = FOCAL_WIDTHS * width.max(height);
        Intrinsics {
            fx: focal,
            fy: focal,
            cx: width / 2.0,
            cy: height / 2.0,
            width: self.width,
            height: self.height,
        }
    }
}

/// A camera of the sample at `arc` (radians, 0 is straight ahead) that looks at [`TARGET`].
///
/// Positions between those of [`cameras`] are honest new views of the same room.
///
/// # Errors
/// `invalid_request` when the options are out of range or `arc` is not finite.
pub fn camera_at(options: &SampleOptions, arc: f64) -> Result<Camera> {
    let options = options.validated()?;
    if !arc.is_finite() {
        return Err(Error::invalid(format!("sample: arc is {arc}, not a finite number")));
    }
    let rise = -0.34 - 0.08 * (3.0 * arc).sin();
    let direction = DVec3::new(arc.sin(), rise, -arc.cos()).normalize();
    let eye = TARGET + direction * DISTANCE;
    let camera_to_world = CameraToWorld::look_at(eye, TARGET, -DVec3::Y, "sample")?;
    Ok(Camera { intrinsics: options.intrinsics(), camera_to_world })
}

/// The cameras of the photos, from left to right on the arc.
///
/// # Errors
/// `invalid_request` when the options are out of range.
pub fn cameras(options: &SampleOptions) -> Result<Vec<Camera>> {
    let count = options.validated()?.photos;
    let half = (STEP * (count - 1) as f64 / 2.0).min(HALF_ARC_MAX);
    (0..count)
        .map(|i| camera_at(options, half * (2.0 * i as f64 / (count - 1) as f64 - 1.0)))
        .collect()
}

/// The photos with their cameras; files are named `images/0000.png` and so on.
///
/// # Errors
/// `invalid_request` when the options are out of range.
pub fn photos(options: &SampleOptions) -> Result<Vec<PosedPhoto>> {
    let room = Room::new(options.seed);
    let posed = cameras(options)?.into_iter().enumerate().map(|(i, camera)| PosedPhoto {
        file: format!("images/{i:04}.png"),
        photo: room.view(&camera).photo,
        camera,
        intrinsics_made_for: None,
    });
    Ok(posed.collect())
}

/// `transforms.json` of the photos: nerfstudio, OpenGL camera-to-world, intrinsics per frame.
#[must_use]
pub fn transforms_json(photos: &[PosedPhoto]) -> Vec<u8> {
    let frames: Vec<_> = photos
        .iter()
        .map(|posed| {
            let mut m = posed.camera.camera_to_world.to_row_major();
            for row in 0..3 {
                m[row * 4 + 1] = -m[row * 4 + 1];
                m[row * 4 + 2] = -m[row * 4 + 2];
            }
            let k = posed.camera.intrinsics;
            json!({
                "file_path": posed.file,
                "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": k.width, "h": k.height,
                "transform_matrix": [&m[0..4], &m[4..8], &m[8..12], &m[12..16]],
            })
        })
        .collect();
    format!("{:#}\n", json!({ "camera_model": "OPENCV", "frames": frames })).into_bytes()
}

/// `cameras` JSON of the photos: this project's own form, OpenCV camera-to-world.
#[must_use]
pub fn cameras_json(photos: &[PosedPhoto]) -> Vec<u8> {
    let cameras: Vec<_> = photos
        .iter()
        .map(|posed| {
            json!({
                "file": posed.file,
                "intrinsics": posed.camera.intrinsics,
                "camera_to_world": posed.camera.camera_to_world,
            })
        })
        .collect();
    format!("{:#}\n", json!({ "cameras": cameras })).into_bytes()
}

/// The photos as PNG files, in the cameras' order.
///
/// # Errors
/// `internal` when a photo's pixels do not fill its size.
pub fn png_files(photos: &[PosedPhoto]) -> Result<Vec<UploadFile>> {
    photos
        .iter()
        .map(|posed| {
            let mut bytes = Vec::new();
            let photo = &posed.photo;
            PngEncoder::new(&mut bytes)
                .write_image(&photo.rgb, photo.width, photo.height, ExtendedColorType::Rgb8)
                .map_err(|e| Error::internal("sample: PNG encoding failed").caused_by(e))?;
            Ok(UploadFile { name: posed.file.clone(), bytes })
        })
        .collect()
}

/// The photos and their `transforms.json` as a caller would send them.
///
/// # Errors
/// As [`photos`].
pub fn upload(options: &SampleOptions) -> Result<Upload> {
    let posed = photos(options)?;
    Ok(Upload {
        cameras: Some(UploadCameras::Transforms(transforms_json(&posed))),
        photos: png_files(&posed)?,
        archive: None,
    })
}

/// Writes the photos and `transforms.json` under `out_dir`, which is made where it is missing.
///
/// # Errors
/// `invalid_request` when the options are out of range or the folder cannot be written.
pub fn run(out_dir: &Path, options: &SampleOptions) -> Result<()> {
    let posed = photos(options)?;
    let failed = |e: std::io::Error| Error::invalid(format!("sample: cannot write: {e}"));
    fs_err::create_dir_all(out_dir.join("images")).map_err(failed)?;
    for UploadFile { name, bytes } in png_files(&posed)? {
        fs_err::write(out_dir.join(name), bytes).map_err(failed)?;
    }
    fs_err::write(out_dir.join("transforms.json"), transforms_json(&posed)).map_err(failed)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: SampleOptions = SampleOptions { photos: 3, width: 48, height: 36, seed: 7 };

    #[test]
    fn the_same_seed_gives_the_same_photos_and_another_does_not() {
        let first = photos(&SMALL).unwrap();
        let again = photos(&SMALL).unwrap();
        let other = photos(&SampleOptions { seed: 8, ..SMALL }).unwrap();
        assert_eq!(first.len(), 3, "photos asked for");
        assert_eq!(first[1].photo.rgb, again[1].photo.rgb, "same seed, other pixels");
        assert_ne!(first[1].photo.rgb, other[1].photo.rgb, "the seed changes nothing");
    }

    #[test]
    fn depth_and_cameras_agree_between_two_views() {
        let room = Room::new(SMALL.seed);
        let cameras = cameras(&SMALL).unwrap();
        let [a, b] = [room.view(&cameras[0]), room.view(&cameras[1])];
        let (mut close, mut inside) = (0, 0);
        for (i, &depth) in a.depth.iter().enumerate() {
            let (u, v) = ((i % 48) as f64 + 0.5, (i / 48) as f64 + 0.5);
            let at = cameras[0].intrinsics.unproject(u, v, f64::from(depth));
            let world = cameras[0].camera_to_world.matrix().transform_point3(at);
            let there = cameras[1].camera_to_world.viewmat().transform_point3(world);
            let (x, y) = cameras[1].intrinsics.project(there);
            if x >= 0.0 && y >= 0.0 && x < 48.0 && y < 36.0 {
                inside += 1;
                let other = f64::from(b.depth[y as usize * 48 + x as usize]);
                close += usize::from((other - there.z).abs() < 0.05 * there.z);
            }
        }
        assert!(inside > 1200, "only {inside} pixels of the first view land in the second");
        assert!(close * 10 > inside * 9, "only {close} of {inside} depths agree");
    }

    #[test]
    fn transforms_are_opengl_and_options_are_checked() {
        let posed = photos(&SMALL).unwrap();
        let value: serde_json::Value = serde_json::from_slice(&transforms_json(&posed)).unwrap();
        let rows = value["frames"][2]["transform_matrix"].as_array().unwrap();
        let flat: Vec<f64> =
            rows.iter().flat_map(|r| r.as_array().unwrap()).map(|v| v.as_f64().unwrap()).collect();
        let back =
            CameraToWorld::from_opengl_row_major(&flat.try_into().unwrap(), "frame 2").unwrap();
        let off = (back.center() - posed[2].camera.camera_to_world.center()).length();
        assert!(off < 1e-9, "the pose moved by {off}");
        assert!((back.axis() - posed[2].camera.camera_to_world.axis()).length() < 1e-9);
        for bad in [SampleOptions { photos: 1, ..SMALL }, SampleOptions { width: 5000, ..SMALL }] {
            assert!(photos(&bad).unwrap_err().message().contains("must be"), "{bad:?} passed");
        }
    }
}
