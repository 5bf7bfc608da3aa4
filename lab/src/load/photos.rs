//! The photos that are posted: square ones of a scene folder, as PNG files with their cameras.

use std::path::Path;

use serde_json::json;

use crate::{
    error::{Error, Result},
    scene::{Camera, Upload, UploadCameras, UploadFile},
    scenes::{nearest, squares},
};

/// How far the cameras of one upload are from those of the next, world units: a server may know an
/// upload that comes again.
const APART: f64 = 1e-9;
/// Between the parts of a form.
const BOUNDARY: &str = "segsplat-lab-5f0c6d1e";

/// Photos of a folder, each as a file and a camera.
#[derive(Debug)]
pub(super) struct Photos {
    files: Vec<(UploadFile, Camera)>,
    /// For each photo the others, the nearest first.
    others: Vec<Vec<usize>>,
}

impl Photos {
    pub(super) fn read(dir: &Path) -> Result<Self> {
        let photos = squares(dir)?;
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

/// The body of `POST /v1/scenes`, and its content type.
pub(super) fn form(upload: &Upload) -> (Vec<u8>, String) {
    let cameras = match &upload.cameras {
        Some(UploadCameras::Cameras(json) | UploadCameras::Transforms(json)) => json.as_slice(),
        None => &[],
    };
    let photos = upload.photos.iter();
    let photos = photos.map(|photo| ("photo", photo.name.as_str(), photo.bytes.as_slice()));
    let mut body = Vec::new();
    for (part, name, bytes) in [("cameras", "cameras.json", cameras)].into_iter().chain(photos) {
        let head = format!(
            "--{BOUNDARY}\r\ncontent-disposition: form-data; name=\"{part}\"; \
             filename=\"{name}\"\r\n\r\n"
        );
        body.extend_from_slice(head.as_bytes());
        body.extend_from_slice(bytes);
        body.extend_from_slice(b"\r\n");
    }
    body.extend_from_slice(format!("--{BOUNDARY}--\r\n").as_bytes());
    (body, format!("multipart/form-data; boundary={BOUNDARY}"))
}
