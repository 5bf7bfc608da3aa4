//! The layout of nerfstudio: `transforms.json`, `images`, `depths`, `sparse_pc.ply`.
//!
//! Poses are camera-to-world in OpenGL axes. World and unit are those of the capture: there is no
//! `applied_transform`. A depth map is an f32 array in thousandths of the world's unit, which
//! nerfstudio brings back with its `depth_unit_scale_factor` of 0.001: 16-bit PNGs, its other
//! choice, end at 65.5 units.

use serde_json::{Value, json};

use super::{FolderContents, FolderPhoto, FolderPixels, FolderPoint, ZipFolder, points};
use crate::{error::Result, npy, scene::Intrinsics};

/// World units of one unit of a depth map: nerfstudio's default.
const DEPTH_UNIT: f64 = 0.001;
/// Points that are put together before they are written.
const PART: usize = 4096;

pub(crate) fn write(
    of: &FolderContents<'_>,
    photos: &[FolderPhoto],
    pixels: &mut dyn FolderPixels,
    zip: &mut ZipFolder<'_>,
) -> Result<()> {
    let frames: Vec<Value> = photos.iter().map(frame).collect();
    zip.begin_text("transforms.json")?;
    zip.put_json(&json!({
        "camera_model": "OPENCV",
        "ply_file_path": "sparse_pc.ply",
        "depth_unit_scale_factor": DEPTH_UNIT,
        "frames": frames,
    }))?;
    let points = points(of.scene, of.points_max);
    zip.begin("sparse_pc.ply")?;
    zip.put(
        format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {}\n\
             property double x\nproperty double y\nproperty double z\n\
             property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
            points.len()
        )
        .as_bytes(),
    )?;
    for part in points.chunks(PART) {
        let point = |p: &FolderPoint| {
            p.at.to_array().into_iter().flat_map(f64::to_le_bytes).chain(p.color).collect()
        };
        zip.put(&part.iter().map(point).collect::<Vec<Vec<u8>>>().concat())?;
    }
    for (i, photo) in photos.iter().enumerate() {
        let mut depth = pixels.depth(i)?;
        depth.iter_mut().for_each(|z| *z = (f64::from(*z) / DEPTH_UNIT) as f32);
        let Intrinsics { width, height, .. } = photo.camera.intrinsics;
        zip.begin(&depth_file(photo))?;
        zip.put(&npy::header::<f32>(&[height as usize, width as usize]))?;
        zip.put(bytemuck::cast_slice(&depth))?;
    }
    Ok(())
}

fn depth_file(photo: &FolderPhoto) -> String {
    format!("depths/{}.npy", photo.stem())
}

fn frame(photo: &FolderPhoto) -> Value {
    let k = photo.camera.intrinsics;
    json!({
        "file_path": format!("images/{}", photo.file),
        "depth_file_path": depth_file(photo),
        "w": k.width, "h": k.height,
        "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy,
        "transform_matrix": photo.camera.camera_to_world.to_opengl_rows(),
    })
}
