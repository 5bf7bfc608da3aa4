//! Captures that have one camera JSON: nerfstudio, instant-ngp, `NeRF` scenes of Blender,
//! `ScanNet++` (`dslr/nerfstudio/transforms.json`), our own, and what a training of 3DGS leaves.

use crate::{
    captures::layout::{Described, Folder, Layout, called, cameras, names},
    error::Result,
};

pub(super) struct Transforms;
pub(super) struct CamerasJson;

impl Layout for Transforms {
    fn name(&self) -> &'static str {
        "nerfstudio"
    }

    fn find(&self, folder: &Folder<'_>) -> Vec<String> {
        let whole = called(folder, "transforms.json");
        // Blender's scenes have one file for training and others for tests.
        if whole.is_empty() { called(folder, "transforms_train.json") } else { whole }
    }

    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described> {
        let cameras = cameras::transforms(&folder.read_json(at)?)?;
        Ok(Described { root: names::folder(at).to_owned(), cameras })
    }
}

impl Layout for CamerasJson {
    fn name(&self) -> &'static str {
        "cameras.json"
    }

    fn find(&self, folder: &Folder<'_>) -> Vec<String> {
        called(folder, "cameras.json")
    }

    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described> {
        let cameras = cameras::cameras(&folder.read_json(at)?)?;
        Ok(Described { root: names::folder(at).to_owned(), cameras })
    }
}
