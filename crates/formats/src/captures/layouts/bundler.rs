//! Bundler's `bundle.out`, and the list of its photos, as `VisualSFM` and Metashape export it too.
//!
//! A line of a comment, the numbers of cameras and points, then for each camera f, k1, k2, three
//! rows of a world-to-camera rotation and a translation; the camera has x right, y up, z backwards
//! (Bundler's user's manual, "Output format and scene representation"). The list has a photo a
//! line, in the order of the cameras; words after its name are not needed. A camera whose f is 0
//! was not found. The principal point is the middle of the photo, f is in its pixels.

use glam::DMat3;

use crate::{
    captures::layout::{
        CameraEntry, Described, Folder, Layout, Lens, PoseAxes, count, inverse, names, number_of,
        text,
    },
    error::{Error, Result},
};

pub(super) struct Bundler;

/// Numbers of a camera.
const NUMBERS: usize = 15;

/// The photos of a list, a line each.
fn photos(text: &str) -> Vec<&str> {
    let name = |line| {
        let line: &str = str::trim(line);
        // A name may have spaces; zeros and a focal length may follow it.
        let mut ends = line.match_indices(char::is_whitespace).map(|(at, _)| at);
        let end = ends.find(|end| names::is_photo(&line[..*end]));
        &line[..end.unwrap_or(line.len())]
    };
    text.lines().map(name).filter(|line| !line.is_empty()).collect()
}

impl Layout for Bundler {
    fn name(&self) -> &'static str {
        "Bundler"
    }

    fn find(&self, folder: &Folder<'_>) -> Vec<String> {
        let outs = folder.paths().filter(|path| path.ends_with(".out"));
        let is_bundle = |path: &&str| {
            folder.head(path, 16).is_ok_and(|head| head.starts_with(b"# Bundle file"))
        };
        outs.filter(is_bundle).map(str::to_owned).collect()
    }

    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described> {
        let wrong = |what: &str| Error::invalid(format!("{at}: {what}"));
        let bytes = folder.read_cameras(at)?;
        let text_of = text(&bytes, at)?;
        let (_, body) = text_of.split_once('\n').ok_or_else(|| wrong("it is empty"))?;
        let mut words = body.split_whitespace();
        let mut next = || words.next().and_then(number_of).ok_or_else(|| wrong("it is cut short"));
        let (cameras, _points) = (next()?, next()?);
        let is_list = |path: &&str| {
            let name = names::file_name(path);
            name.ends_with(".txt") && name.contains("list") || name.ends_with(".list")
        };
        let mut list = Err(wrong("there is no list of its photos (list.txt)"));
        for path in folder.paths().filter(is_list) {
            let bytes = folder.read_cameras(path)?;
            let text = text(&bytes, path)?;
            let photos = photos(&text);
            if photos.len() as f64 == cameras {
                list = Ok(photos.into_iter().map(str::to_owned).collect::<Vec<_>>());
                break;
            }
            list = Err(wrong(&format!("{cameras} cameras, {path:?} has {} photos", photos.len())));
        }
        let mut entries = Vec::new();
        for file in list? {
            count(entries.len(), folder.limits.archive_entries_max, at)?;
            let mut v = [0.0; NUMBERS];
            for v in &mut v {
                *v = next()?;
            }
            let [f, k1, k2, rest @ ..] = v;
            if f == 0.0 {
                continue;
            }
            let rows: &[f64; 9] = rest.first_chunk().expect("there are 12; this is a bug");
            let rotation = DMat3::from_cols_array(rows).transpose();
            let pose = inverse(rotation, [rest[9], rest[10], rest[11]].into());
            let lens = Lens { fx: Some(f), k: [Some(k1), Some(k2), None, None], ..Lens::default() };
            entries.push(CameraEntry::new(file, lens, PoseAxes::OpenGl, pose));
        }
        Ok(Described::new(names::folder(at), entries))
    }
}
