//! A small posed photo set with exact truth: what the demo posts and the tests compare with.
//!
//! In: options (how many photos, their size, a seed). Out: photos with OpenCV cameras, in memory
//! or as a folder of PNG files with a nerfstudio `transforms.json` (OpenGL). The same seed gives
//! the same room, and [`Room::view`] is the true picture and depth of it at any camera.

mod room;
mod texture;

use std::{
    io::{Cursor, Write},
    path::Path,
};

use glam::DVec3;
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use serde_json::json;
use zip::{CompressionMethod, ZipWriter, result::ZipError, write::SimpleFileOptions};

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
        let (least, most) = PHOTOS.into_inner();
        if !(least..=most).contains(&self.photos) {
            return Err(Error::invalid(format!(
                "sample: {} photos; it must be {least} to {most}",
                self.photos
            )));
        }
        let (least, most) = SIDE.into_inner();
        if [self.width, self.height].iter().any(|side| !(least..=most).contains(side)) {
            return Err(Error::invalid(format!(
                "sample: {}x{} px; each side must be {least} to {most}",
                self.width, self.height
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
            let k = posed.camera.intrinsics;
            json!({
                "file_path": posed.file,
                "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": k.width, "h": k.height,
                "transform_matrix": posed.camera.camera_to_world.to_opengl_rows(),
            })
        })
        .collect();
    format!("{:#}\n", json!({ "camera_model": "OPENCV", "frames": frames })).into_bytes()
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
        ..Upload::default()
    })
}

/// The photos and their `transforms.json` as one zip, which is an upload as it is.
///
/// # Errors
/// As [`photos`].
pub fn archive(options: &SampleOptions) -> Result<Vec<u8>> {
    let posed = photos(options)?;
    let cameras = UploadFile { name: "transforms.json".to_owned(), bytes: transforms_json(&posed) };
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let unwritten = |e: ZipError| Error::internal("sample: no zip can be made").caused_by(e);
    for UploadFile { name, bytes } in png_files(&posed)?.into_iter().chain([cameras]) {
        zip.start_file(name, stored).map_err(unwritten)?;
        zip.write_all(&bytes).map_err(|e| unwritten(e.into()))?;
    }
    Ok(zip.finish().map_err(unwritten)?.into_inner())
}

/// Writes the photos and `transforms.json` under `out_dir`. A missing folder is created.
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
