//! The photos that are posted: square ones of a scene folder, as PNG files with their cameras.

use std::path::Path;

use reqwest::multipart::{Form, Part};
use serde_json::json;

use crate::{
    error::{Error, Result},
    scene::{Camera, Upload, UploadCameras, UploadFile},
    scenes::{SIDE, nearest, squares},
};

/// How far the cameras of one upload are from those of the next, world units: a server may know an
/// upload that comes again.
const APART: f64 = 1e-9;

/// Photos of a folder, each as a file and a camera.
#[derive(Debug)]
pub(super) struct Photos {
    files: Vec<(UploadFile, Camera)>,
    /// For each photo the others, the nearest first.
    others: Vec<Vec<usize>>,
}

impl Photos {
    pub(super) fn read(dir: &Path) -> Result<Self> {
        let photos = squares(dir, SIDE)?;
        let file = |(i, posed): (usize, &crate::scene::PosedPhoto)| {
            let mut bytes = std::io::Cursor::new(Vec::new());
            let (width, height) = (posed.photo.width, posed.photo.height);
            image::RgbImage::from_raw(width, height, posed.photo.rgb.clone())
                .unwrap_or_default()
                .write_to(&mut bytes, image::ImageFormat::Png)
                .map_err(|e| Error::internal("a photo cannot be encoded").caused_by(e))?;
            let file = UploadFile { name: format!("{i:04}.png"), bytes: bytes.into_inner() };
            Ok((file, posed.camera))
        };
        let files = photos.iter().enumerate().map(file).collect::<Result<Vec<_>>>()?;
        let others = (0..files.len()).map(|i| nearest(&photos, i, files.len())).collect();
        Ok(Self { files, others })
    }

    /// The upload of `count` photos: one, and those nearest to it. `n` chooses the one; no two have
    /// the same bytes.
    pub(super) fn upload(&self, n: usize, count: usize) -> Result<Upload> {
        if !(2..=self.files.len()).contains(&count) {
            let most = self.files.len();
            return Err(Error::invalid(format!("photos is {count}; it must be 2 to {most}")));
        }
        let first = n % self.files.len();
        let chosen = [first].into_iter().chain(self.others[first].iter().copied()).take(count);
        let (photos, cameras): (Vec<_>, Vec<_>) = chosen
            .map(|i| {
                let (file, camera) = &self.files[i];
                let mut pose = camera.camera_to_world.to_row_major();
                pose[3] += n as f64 * APART;
                let camera = json!({
                    "file": file.name,
                    "intrinsics": camera.intrinsics,
                    "camera_to_world": pose.as_slice(),
                });
                (file.clone(), camera)
            })
            .unzip();
        let cameras = json!({ "cameras": cameras }).to_string().into_bytes();
        Ok(Upload { cameras: Some(UploadCameras::Cameras(cameras)), photos, ..Upload::default() })
    }
}

/// The body of `POST /v1/scenes`.
pub(super) fn form(upload: Upload) -> Form {
    let file = |name: String, bytes: Vec<u8>| Part::bytes(bytes).file_name(name);
    let cameras = match upload.cameras {
        Some(UploadCameras::Cameras(json) | UploadCameras::Transforms(json)) => json,
        None => Vec::new(),
    };
    let form = Form::new().part("cameras", file("cameras.json".to_owned(), cameras));
    upload
        .photos
        .into_iter()
        .fold(form, |form, UploadFile { name, bytes }| form.part("photo", file(name, bytes)))
}
