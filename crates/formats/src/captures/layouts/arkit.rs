//! `ARKitScenes`: `lowres_wide.traj` with poses by time, and a folder of photos beside one of
//! `.pincam` files: `lowres_wide`, `vga_wide` or `wide`, the largest that is there.
//!
//! A line of the trajectory is time, rotation (axis times angle, radians) and translation in
//! metres, world to camera, in OpenCV axes. A photo `VIDEO_TIME.png` has the pose nearest in time,
//! at most 5 ms away, and the lens at most 1 ms away; a `.pincam` is width, height, fx, fy, cx, cy.
//! Source of all: the data set's own `threedod/benchmark_scripts/utils/tenFpsDataLoader.py`.

use glam::{DMat3, DVec3};

use crate::{
    captures::layout::{
        CameraEntry, Described, Folder, Layout, PoseAxes, called, count, inverse, names,
        numbers_of, pinhole, text,
    },
    error::Result,
    scene::LengthUnit,
};

pub(super) struct ArKitScenes;

/// Folders of photos, the largest pictures first.
const FOLDERS: [&str; 3] = ["wide", "vga_wide", "lowres_wide"];
/// Poses of a trajectory for each photo that may be there: photos are a part of its frames.
const POSES_A_PHOTO: usize = 16;
/// Seconds that a pose may be away from its photo.
const POSE_AWAY_MAX: f64 = 0.005;
/// Seconds that a lens may be away from its photo, with some room for rounding.
const LENS_AWAY_MAX: f64 = 0.0015;

/// The time in a name `VIDEO_TIME.ending`, seconds.
fn time(path: &str) -> Option<f64> {
    let name = names::file_name(path);
    let (stem, _) = name.rsplit_once('.')?;
    stem.rsplit('_').next()?.parse().ok().filter(|time: &f64| time.is_finite())
}

/// What is nearest in time, of a list sorted by time.
fn nearest<T>(sorted: &[(f64, T)], time: f64, away_max: f64) -> Option<&T> {
    let after = sorted.partition_point(|(at, _)| *at < time);
    let around = sorted[after.saturating_sub(1)..].iter().take(2);
    let (at, found) = around.min_by(|a, b| (a.0 - time).abs().total_cmp(&(b.0 - time).abs()))?;
    ((at - time).abs() <= away_max).then_some(found)
}

/// Files of a folder by their time.
fn timed<'a>(folder: &'a Folder<'_>, dir: &str, wanted: fn(&str) -> bool) -> Vec<(f64, &'a str)> {
    let inside = folder.paths().filter(|path| names::folder(path) == dir && wanted(path));
    let mut files: Vec<(f64, &str)> = inside.filter_map(|path| Some((time(path)?, path))).collect();
    files.sort_by(|a, b| a.0.total_cmp(&b.0));
    files
}

impl Layout for ArKitScenes {
    fn name(&self) -> &'static str {
        "ARKitScenes"
    }

    fn unit(&self) -> LengthUnit {
        LengthUnit::Metre
    }

    fn find(&self, folder: &Folder<'_>) -> Vec<String> {
        called(folder, "lowres_wide.traj")
    }

    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described> {
        let bytes = folder.read_cameras(at)?;
        let mut poses = Vec::new();
        for (i, line) in text(&bytes, at)?.lines().enumerate() {
            if line.trim().is_empty() {
                continue;
            }
            count(poses.len(), POSES_A_PHOTO * folder.limits.archive_entries_max, at)?;
            let [time, rx, ry, rz, tx, ty, tz] = numbers_of(line, at, i + 1)?;
            let turn = DVec3::new(rx, ry, rz);
            let rotation = match turn.length() {
                0.0 => DMat3::IDENTITY,
                angle => DMat3::from_axis_angle(turn / angle, angle),
            };
            poses.push((time, inverse(rotation, DVec3::new(tx, ty, tz))));
        }
        poses.sort_by(|a, b| a.0.total_cmp(&b.0));
        let root = names::folder(at);
        let is_lens: fn(&str) -> bool = |path| path.ends_with(".pincam");
        let mut entries = Vec::new();
        for dir in FOLDERS {
            let photos = timed(folder, &names::join(root, dir), names::is_photo);
            let lenses = timed(folder, &names::join(root, &format!("{dir}_intrinsics")), is_lens);
            for (time, photo) in photos {
                let (Some(pose), Some(lens)) =
                    (nearest(&poses, time, POSE_AWAY_MAX), nearest(&lenses, time, LENS_AWAY_MAX))
                else {
                    continue;
                };
                let bytes = folder.read_cameras(lens)?;
                let [w, h, fx, fy, cx, cy] = numbers_of(&text(&bytes, lens)?, lens, 1)?;
                let lens = pinhole([fx, fy, cx, cy], Some([w, h]));
                let file = format!("{dir}/{}", names::file_name(photo));
                entries.push(CameraEntry::new(file, lens, PoseAxes::OpenCv, *pose));
            }
            if !entries.is_empty() {
                break;
            }
        }
        Ok(Described::new(root, entries))
    }
}
