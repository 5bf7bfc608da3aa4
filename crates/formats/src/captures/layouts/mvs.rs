//! `MVSNet`, `BlendedMVS` and those after them: `cams/NAME_cam.txt`, one for each photo.
//!
//! The word `extrinsic` and a 4x4 world-to-camera matrix in OpenCV axes, then the word `intrinsic`
//! and K, both row by row, then a depth range, which is not needed (`MVSNet`'s README, "File
//! formats"). K is for the photo as stored.

use std::collections::BTreeSet;

use crate::{
    captures::layout::{
        CameraEntry, Described, Folder, Layout, PoseAxes, inverse_of_rows, names, number_of,
        numbers, pinhole, text,
    },
    error::{Error, Result},
};

pub(super) struct MvsNet;

const ENDING: &str = "_cam.txt";

impl Layout for MvsNet {
    fn name(&self) -> &'static str {
        "MVSNet"
    }

    fn find(&self, folder: &Folder<'_>) -> Vec<String> {
        let dirs: BTreeSet<&str> =
            folder.paths().filter(|path| path.ends_with(ENDING)).map(names::folder).collect();
        dirs.into_iter().map(str::to_owned).collect()
    }

    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described> {
        let inside = |path: &&str| names::folder(path) == at && path.ends_with(ENDING);
        let mut entries = Vec::new();
        for path in folder.paths().filter(inside) {
            let bytes = folder.read_cameras(path)?;
            let wrong =
                || Error::invalid(format!("{path}: no `extrinsic` 4x4 and `intrinsic` 3x3"));
            let text = text(&bytes, path)?;
            let (_, after) = text.split_once("extrinsic").ok_or_else(wrong)?;
            let (pose, after) = after.split_once("intrinsic").ok_or_else(wrong)?;
            let is_pose = |m: &Vec<f64>| m.len() == 16 && m[12..] == [0.0, 0.0, 0.0, 1.0];
            let pose = numbers(pose).filter(is_pose).ok_or_else(wrong)?;
            let k: Option<Vec<f64>> = after.split_whitespace().take(9).map(number_of).collect();
            let k = k.filter(|k| k.len() == 9).ok_or_else(wrong)?;
            let lens = pinhole([k[0], k[4], k[2], k[5]], None);
            let stem = names::file_name(path).trim_end_matches(ENDING);
            let pose = inverse_of_rows(&pose);
            entries.push(CameraEntry::new(stem.to_owned(), lens, PoseAxes::OpenCv, pose));
        }
        Ok(Described::new(names::folder(at), entries))
    }
}
