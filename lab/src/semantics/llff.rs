//! Cameras of the LLFF kind: `poses_bounds.npy`, 17 numbers a photo of `images/`, by name.
//!
//! The first 15 are a 3x5 matrix: camera axes (down, right, backwards), centre, and height, width
//! and focal length; the last two are a depth range, which is not needed.

use std::path::Path;

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
    let rows = rows(bytes).ok_or_else(|| wrong("no array of 17 numbers a row"))?;
    let mut photos = Vec::new();
    let folder = fs_err::read_dir(dir.join("images"))
        .map_err(|e| Error::invalid("images: cannot be read").caused_by(e))?;
    for entry in folder {
        let path = entry.map_err(|e| wrong("images").caused_by(e))?.path();
        if path.is_file() {
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            photos.push((name, path));
        }
    }
    photos.sort();
    if photos.len() != rows.len() || photos.len() > limits.photos_max {
        return Err(wrong(&format!(
            "{} rows for {} photos, of which at most {} are taken",
            rows.len(),
            photos.len(),
            limits.photos_max
        )));
    }
    let (mut files, mut cameras) = (Vec::new(), Vec::new());
    for ((name, path), row) in photos.into_iter().zip(rows) {
        let bytes = fs_err::read(&path)
            .map_err(|e| Error::photo(format!("{name}: cannot be read")).caused_by(e))?;
        let file = UploadFile { name: format!("images/{name}"), bytes };
        let (width, height) = dimensions(&file)?;
        cameras.push(camera(&file.name, &row, width, height));
        files.push(file);
    }
    let cameras = serde_json::to_vec(&json!({ "cameras": cameras }))
        .map_err(|e| Error::internal("cameras").caused_by(e))?;
    Ok(Upload { cameras: Some(UploadCameras::Cameras(cameras)), photos: files, archive: None })
}

/// A camera entry; the focal length is scaled from the size it was written for.
fn camera(file: &str, row: &[f64; ROW], width: u32, height: u32) -> serde_json::Value {
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

/// Rows of a two-axis array of f64.
fn rows(bytes: Vec<u8>) -> Option<Vec<[f64; ROW]>> {
    let array = Array::parse(bytes).filter(|array| array.shape.get(1) == Some(&ROW))?;
    array.numbers()?.chunks_exact(ROW).map(|row| row.try_into().ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{npy::npy, photo_files as photos};

    #[test]
    fn axes_and_focal_length_are_turned_to_ours() {
        let dir = tempfile::tempdir().unwrap();
        fs_err::create_dir(dir.path().join("images")).unwrap();
        let mut data = Vec::new();
        for i in 0..2_u32 {
            let picture = image::RgbImage::from_pixel(8, 6, image::Rgb([1, 2, 3]));
            picture.save(dir.path().join(format!("images/{i}.png"))).unwrap();
            // Looks along world +z: right = +x, down = +y, backwards = -z; written for 16 x 12.
            let row: [f64; ROW] =
                [0., 1., 0., f64::from(i), 12., 1., 0., 0., 2., 16., 0., 0., -1., 3., 20., 0.1, 9.];
            data.extend(row.iter().flat_map(|v| v.to_le_bytes()));
        }
        let bytes = npy("<f8", "2, 17", &data);
        let path = dir.path().join("poses_bounds.npy");
        fs_err::write(&path, &bytes).unwrap();
        let limits = Limits::default();
        let photos = photos::read(&upload(dir.path(), &limits).unwrap(), &limits).unwrap();
        let camera = photos[1].camera;
        assert_eq!(camera.camera_to_world.center(), glam::DVec3::new(1.0, 2.0, 3.0));
        assert_eq!(camera.camera_to_world.axis(), glam::DVec3::Z);
        let lens = camera.intrinsics;
        assert_eq!((lens.fx, lens.fy, lens.cx, lens.cy), (10.0, 10.0, 4.0, 3.0));
        fs_err::write(&path, &bytes[..bytes.len() - ROW * 8]).unwrap();
        assert!(upload(dir.path(), &limits).is_err(), "a row too few");
    }
}
