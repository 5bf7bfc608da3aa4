//! Polycam's raw data: `keyframes/cameras/N.json` and `keyframes/images/N.jpg`, or `corrected_`
//! before both names, which is taken where it is there.
//!
//! `t_00` to `t_23` are the first three rows of the camera-to-world matrix of `ARKit`: camera x
//! right, y up, z backwards; the world has y up (Polycam's "raw data" page, and nerfstudio's
//! `process_data/polycam_utils.py`, which also turns the world; that is not done here). `width` and
//! `height` may be missing.

use std::collections::BTreeSet;

use crate::{
    captures::layout::{
        CameraEntry, Described, Folder, Layout, PoseAxes, names, number, object, pinhole,
    },
    error::{Error, Result},
    scene::LengthUnit,
};

pub(super) struct Polycam;

/// Folders of cameras and photos, the better first.
const FOLDERS: [[&str; 2]; 2] = [["corrected_cameras", "corrected_images"], ["cameras", "images"]];

/// Files that are looked into.
const LOOKED_INTO_MAX: usize = 4;

/// The JSON files of the cameras in a folder.
fn jsons<'a>(folder: &'a Folder<'_>, dir: &'a str) -> impl Iterator<Item = &'a str> {
    folder.paths().filter(move |path| path.ends_with(".json") && names::folder(path) == dir)
}

impl Layout for Polycam {
    fn name(&self) -> &'static str {
        "Polycam"
    }

    fn unit(&self) -> LengthUnit {
        LengthUnit::Metre
    }

    fn find(&self, folder: &Folder<'_>) -> Vec<String> {
        let dirs: BTreeSet<&str> = folder
            .paths()
            .filter(|path| path.ends_with(".json"))
            .map(names::folder)
            .filter(|dir| FOLDERS.iter().any(|[cameras, _]| names::file_name(dir) == *cameras))
            .collect();
        let has_pose = |path: &str| {
            let json = folder.read_json(path).unwrap_or_default();
            json.windows(6).any(|word| word == b"\"t_00\"")
        };
        let is_polycam = |dir: &&str| jsons(folder, dir).take(LOOKED_INTO_MAX).any(has_pose);
        let dirs = dirs.into_iter().filter(is_polycam);
        let tops: BTreeSet<&str> = dirs.map(names::folder).collect();
        tops.into_iter().map(str::to_owned).collect()
    }

    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described> {
        let there = |dirs: &&[&str; 2]| {
            let [cameras, images] = dirs.map(|dir| names::join(at, dir));
            jsons(folder, &cameras).next().is_some()
                && folder.paths().any(|path| names::folder(path) == images)
        };
        let [cameras, images] = FOLDERS.iter().find(there).unwrap_or(&FOLDERS[1]);
        let dir = names::join(at, cameras);
        let mut entries = Vec::new();
        for path in jsons(folder, &dir) {
            let json = object(&folder.read_json(path)?, path)?;
            let get = |key: &str| number(&json, key, path);
            let needed = |key: &str| {
                get(key)?.ok_or_else(|| Error::invalid(format!("{path}: {key} is missing")))
            };
            let mut pose = [0.0; 16];
            pose[15] = 1.0;
            for row in 0..3 {
                for column in 0..4 {
                    pose[4 * row + column] = needed(&format!("t_{row}{column}"))?;
                }
            }
            let size = get("width")?.zip(get("height")?);
            let focal = [needed("fx")?, needed("fy")?, needed("cx")?, needed("cy")?];
            let lens = pinhole(focal, size.map(|(width, height)| [width, height]));
            let stem = names::file_name(path).trim_end_matches(".json");
            let file = format!("{images}/{stem}");
            entries.push(CameraEntry::new(file, lens, PoseAxes::OpenGl, pose));
        }
        Ok(Described::new(at, entries))
    }
}
