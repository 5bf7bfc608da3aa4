//! Cameras of the LLFF kind: `poses_bounds.npy`, 17 numbers a photo of `images/`, by name.
//!
//! The first 15 are a 3x5 matrix: camera axes (down, right, backwards), centre, and height, width
//! and focal length; the last two are a depth range, which is not needed.

use std::path::{Path, PathBuf};

use serde_json::json;

use super::labels::dimensions;
use crate::{
    error::{Error, Result},
    limits::Limits,
    npy::Array,
    scene::{Upload, UploadCameras, UploadFile},
};

/// Numbers a photo.
const ROW: usize = 17;

/// The folder as an upload with our own camera JSON.
///
/// # Errors
/// `invalid_request` when the array is none of that kind, or its rows are not as many as photos.
pub(super) fn upload(dir: &Path, limits: &Limits) -> Result<Upload> {
    let wrong = |what: &str| Error::invalid(format!("poses_bounds.npy: {what}"));
    let bytes = fs_err::read(dir.join("poses_bounds.npy"))
        .map_err(|e| wrong("cannot be read").caused_by(e))?;
    let array = Array::parse(bytes).filter(|array| array.shape.get(1) == Some(&ROW));
    let numbers = array
        .and_then(|array| array.numbers())
        .ok_or_else(|| wrong("no array of 17 numbers a row"))?;
    let listed = fs_err::read_dir(dir.join("images"))
        .map_err(|e| Error::invalid("images: cannot be read").caused_by(e))?;
    let mut photos: Vec<PathBuf> = listed.flatten().map(|entry| entry.path()).collect();
    photos.retain(|path| path.is_file());
    photos.sort();
    let (rows, most) = (numbers.len() / ROW, limits.photos_max);
    if photos.len() != rows || rows > most {
        let photos = photos.len();
        return Err(wrong(&format!("{rows} rows for {photos} photos, of at most {most}")));
    }
    let (mut files, mut cameras) = (Vec::new(), Vec::new());
    for (path, row) in photos.into_iter().zip(numbers.chunks_exact(ROW)) {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let bytes = fs_err::read(&path)
            .map_err(|e| Error::photo(format!("{name}: cannot be read")).caused_by(e))?;
        let file = UploadFile { name: format!("images/{name}"), bytes };
        let (width, height) = dimensions(&file)?;
        cameras.push(camera(&file.name, row, width, height));
        files.push(file);
    }
    let cameras = serde_json::to_vec(&json!({ "cameras": cameras }))
        .map_err(|e| Error::internal("cameras").caused_by(e))?;
    Ok(Upload {
        cameras: Some(UploadCameras::Cameras(cameras)),
        photos: files,
        ..Upload::default()
    })
}

/// The JSON of a camera; the focal length is scaled from the size it was written for.
fn camera(file: &str, row: &[f64], width: u32, height: u32) -> serde_json::Value {
    let at = |r: usize, c: usize| row[r * 5 + c];
    let mut pose = [0.0; 16];
    for r in 0..3 {
        // Right, down, forward from down, right, backwards.
        pose[r * 4..r * 4 + 4].copy_from_slice(&[at(r, 1), at(r, 0), -at(r, 2), at(r, 3)]);
    }
    pose[15] = 1.0;
    let focal = at(2, 4) * f64::from(width) / at(1, 4);
    let lens = json!({
        "fx": focal, "fy": focal, "cx": f64::from(width) / 2.0, "cy": f64::from(height) / 2.0,
        "width": width, "height": height,
    });
    json!({ "file": file, "intrinsics": lens, "camera_to_world": pose })
}
