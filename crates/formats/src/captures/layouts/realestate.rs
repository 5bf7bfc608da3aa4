//! `RealEstate10K`: a text with the address of a video, then a line for each frame.
//!
//! A line is the time in microseconds, fx, fy, cx, cy as shares of width and height, two zeros, and
//! the first three rows of a world-to-camera matrix in OpenCV axes (the data set's page, "Data
//! format"). A photo is called by its time.

use crate::{
    captures::layout::{
        CameraEntry, Described, Folder, Layout, Lens, PoseAxes, count, inverse_of_rows, names,
        numbers_of, pinhole, text,
    },
    error::{Error, Result},
};

pub(super) struct RealEstate;

/// Texts that are looked into, and bytes of each.
const LOOKED_INTO_MAX: (usize, u64) = (16, 8 << 20);

/// Whether a text begins as one of this kind.
fn begins(bytes: &[u8]) -> bool {
    let head = std::str::from_utf8(&bytes[..bytes.len().min(2_048)]);
    let head =
        head.unwrap_or_else(|e| std::str::from_utf8(&bytes[..e.valid_up_to()]).unwrap_or_default());
    let mut lines = head.lines();
    lines.next().is_some_and(|line| line.starts_with("http"))
        && lines.next().is_some_and(|line| line.split_ascii_whitespace().count() == 19)
}

impl Layout for RealEstate {
    fn name(&self) -> &'static str {
        "RealEstate10K"
    }

    fn find(&self, folder: &Folder<'_>) -> Vec<String> {
        let (count, bytes) = LOOKED_INTO_MAX;
        let texts = folder.paths().filter(|path| path.ends_with(".txt"));
        let texts = texts.filter(|path| folder.size(path) <= bytes).take(count);
        let found = texts.filter(|path| folder.read_cameras(path).is_ok_and(|b| begins(&b)));
        found.map(str::to_owned).collect()
    }

    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described> {
        let bytes = folder.read_cameras(at)?;
        let mut entries = Vec::new();
        for (i, line) in text(&bytes, at)?.lines().enumerate().skip(1) {
            if line.trim().is_empty() {
                continue;
            }
            count(entries.len(), folder.limits.archive_entries_max, at)?;
            let v: [f64; 19] = numbers_of(line, at, i + 1)?;
            if v[5] != 0.0 || v[6] != 0.0 {
                let why = "has distortion, of a model that the format does not name";
                return Err(Error::invalid(format!("{at}: line {} {why}", i + 1)));
            }
            let lens = pinhole([v[1], v[2], v[3], v[4]], None);
            let lens = Lens { of_size: true, ..lens };
            let time = line.split_ascii_whitespace().next().unwrap_or_default().to_owned();
            let pose = inverse_of_rows(&v[7..]);
            entries.push(CameraEntry::new(time, lens, PoseAxes::OpenCv, pose));
        }
        Ok(Described::new(names::folder(at), entries))
    }
}
