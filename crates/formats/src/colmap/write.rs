//! Writes `sparse/0` with a binary model, `stereo/depth_maps`, `images`.
//!
//! A depth map is `WIDTH&HEIGHT&1&` and little-endian f32, row
//! by row. World, axes and unit are those of the capture.

use glam::{DQuat, DVec3};

use crate::{
    error::Result,
    folders::{FolderContents, FolderPhoto, FolderPixels, FolderPoint, ZipFolder, points},
    scene::{Camera, Intrinsics},
};

/// COLMAP's number of a camera with two focal lengths and no distortion.
const PINHOLE: i32 = 1;
/// The error of a point that was not computed.
const NO_ERROR: f64 = -1.0;

/// A point of an image: pixels, and the number of its point in space.
type Seen = ([f64; 2], u64);

pub(crate) fn write(
    of: &FolderContents<'_>,
    photos: &[FolderPhoto],
    pixels: &mut dyn FolderPixels,
    zip: &mut ZipFolder<'_>,
) -> Result<()> {
    let mut lenses: Vec<Intrinsics> = Vec::new();
    for photo in photos {
        if !lenses.contains(&photo.camera.intrinsics) {
            lenses.push(photo.camera.intrinsics);
        }
    }
    let points = points(of.scene, of.points_max);
    let mut seen: Vec<Vec<Seen>> = photos.iter().map(|_| Vec::new()).collect();
    let tracks: Vec<Option<[u32; 2]>> =
        (1..).zip(&points).map(|(id, point)| track(id, point, photos, &mut seen)).collect();
    zip.file("sparse/0/cameras.bin", &cameras(&lenses))?;
    zip.begin("sparse/0/images.bin")?;
    zip.put(&(photos.len() as u64).to_le_bytes())?;
    for (i, (photo, seen)) in photos.iter().zip(&seen).enumerate() {
        let lens = lenses.iter().position(|lens| *lens == photo.camera.intrinsics).unwrap_or(0);
        zip.put(&image(i, photo, lens, seen))?;
    }
    zip.begin("sparse/0/points3D.bin")?;
    zip.put(&(points.len() as u64).to_le_bytes())?;
    for ((id, point), track) in (1_u64..).zip(&points).zip(&tracks) {
        zip.put(&space_point(id, point, *track))?;
    }
    for (i, photo) in photos.iter().enumerate() {
        let depth = pixels.depth(i)?;
        let Intrinsics { width, height, .. } = photo.camera.intrinsics;
        zip.begin(&format!("stereo/depth_maps/{}.geometric.bin", photo.file))?;
        zip.put(format!("{width}&{height}&1&").as_bytes())?;
        zip.put(bytemuck::cast_slice(&depth))?;
    }
    Ok(())
}

/// The photo whose pixel a point is, and where among the points of that photo.
fn track(
    id: u64,
    point: &FolderPoint,
    photos: &[FolderPhoto],
    seen: &mut [Vec<Seen>],
) -> Option<[u32; 2]> {
    let photo = point.photo?;
    let Camera { intrinsics, camera_to_world } = photos[photo].camera;
    let at = camera_to_world.viewmat().transform_point3(point.at);
    let (u, v) = intrinsics.project(at);
    let inside = |v: f64, side: u32| (0.0..f64::from(side)).contains(&v);
    if !(at.z > 0.0 && inside(u, intrinsics.width) && inside(v, intrinsics.height)) {
        return None;
    }
    seen[photo].push(([u, v], id));
    Some([photo as u32 + 1, seen[photo].len() as u32 - 1])
}

fn cameras(lenses: &[Intrinsics]) -> Vec<u8> {
    let mut bytes = (lenses.len() as u64).to_le_bytes().to_vec();
    for (id, k) in (1_u32..).zip(lenses) {
        bytes.extend(id.to_le_bytes());
        bytes.extend(PINHOLE.to_le_bytes());
        bytes.extend([k.width, k.height].map(|side| u64::from(side).to_le_bytes()).concat());
        bytes.extend(numbers(&[k.fx, k.fy, k.cx, k.cy]));
    }
    bytes
}

/// The image of a photo; ids are counted from 1.
fn image(i: usize, photo: &FolderPhoto, lens: usize, seen: &[Seen]) -> Vec<u8> {
    let pose = &photo.camera.camera_to_world;
    let rotation = pose.rotation().transpose();
    let DVec3 { x: tx, y: ty, z: tz } = -(rotation * pose.center());
    let [x, y, z, w] = DQuat::from_mat3(&rotation).normalize().to_array();
    let mut bytes = (i as u32 + 1).to_le_bytes().to_vec();
    bytes.extend(numbers(&[w, x, y, z, tx, ty, tz]));
    bytes.extend((lens as u32 + 1).to_le_bytes());
    bytes.extend(photo.file.bytes().chain([0]));
    bytes.extend((seen.len() as u64).to_le_bytes());
    for (at, id) in seen {
        bytes.extend(numbers(at));
        bytes.extend(id.to_le_bytes());
    }
    bytes
}

fn space_point(id: u64, point: &FolderPoint, track: Option<[u32; 2]>) -> Vec<u8> {
    let mut bytes = id.to_le_bytes().to_vec();
    bytes.extend(numbers(&point.at.to_array()));
    bytes.extend(point.color);
    bytes.extend(NO_ERROR.to_le_bytes());
    bytes.extend(u64::from(track.is_some()).to_le_bytes());
    bytes.extend(track.iter().flatten().flat_map(|id| id.to_le_bytes()));
    bytes
}

fn numbers(all: &[f64]) -> Vec<u8> {
    all.iter().flat_map(|v| v.to_le_bytes()).collect()
}
