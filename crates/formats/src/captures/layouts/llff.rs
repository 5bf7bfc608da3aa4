//! LLFF's `poses_bounds.npy`: 17 numbers for each photo of `images/`, in the order of the names.
//!
//! The first 15 are a 3x5 matrix, row by row: camera axes down, right and backwards, centre, and
//! height, width and focal length; the last two are a depth range, which is not needed (LLFF's
//! README, "Using your own poses without running COLMAP").

use crate::{
    captures::layout::{CameraEntry, Described, Folder, Layout, PoseAxes, called, names, pinhole},
    error::{Error, Result},
    npy::Array,
};

pub(super) struct Llff;

/// Numbers a photo.
const ROW: usize = 17;

impl Layout for Llff {
    fn name(&self) -> &'static str {
        "LLFF"
    }

    fn find(&self, folder: &Folder<'_>) -> Vec<String> {
        called(folder, "poses_bounds.npy")
    }

    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described> {
        let wrong = |what: &str| Error::invalid(format!("{at}: {what}"));
        let array = Array::parse(folder.read_cameras(at)?.into_owned())
            .filter(|array| array.shape.len() == 2 && array.shape[1] == ROW);
        let rows = array.and_then(|array| {
            let all = array.shape[0].checked_mul(ROW)?;
            array.numbers().filter(|numbers| numbers.len() == all)
        });
        let rows = rows.ok_or_else(|| wrong("no array of 17 numbers (f64) a row"))?;
        let root = names::folder(at);
        let images = names::join(root, "images");
        let inside = |path: &&str| names::folder(path) == images && names::is_photo(path);
        let photos: Vec<&str> = folder.paths().filter(inside).collect();
        let (count, photos_count) = (rows.len() / ROW, photos.len());
        if count != photos_count {
            return Err(wrong(&format!("{count} rows for {photos_count} photos of {images}")));
        }
        let camera = |(path, row): (&str, &[f64])| {
            let at = |r: usize, c: usize| row[r * 5 + c];
            let mut pose = [0.0; 16];
            for r in 0..3 {
                // Right, down, forward from down, right, backwards.
                pose[r * 4..r * 4 + 4].copy_from_slice(&[at(r, 1), at(r, 0), -at(r, 2), at(r, 3)]);
            }
            pose[15] = 1.0;
            let (height, width, focal) = (at(0, 4), at(1, 4), at(2, 4));
            let centre = [0.5 * width, 0.5 * height];
            let lens = pinhole([focal, focal, centre[0], centre[1]], Some([width, height]));
            let file = format!("images/{}", names::file_name(path));
            CameraEntry::new(file, lens, PoseAxes::OpenCv, pose)
        };
        let entries = photos.into_iter().zip(rows.chunks_exact(ROW)).map(camera).collect();
        Ok(Described::new(root, entries))
    }
}
