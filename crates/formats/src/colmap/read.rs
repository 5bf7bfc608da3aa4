//! Reads `cameras` and `images`, both `.bin` or `.txt`.
//!
//! Numbers of camera models: COLMAP's `src/colmap/scene/reconstruction_io_binary.cc`. `rigs` and
//! `frames` (COLMAP 3.12 and later) are not needed: `images` has the pose of every image beside
//! them. Points are skipped.

use std::collections::HashMap;

use crate::{
    captures::layout::{
        Base, CameraEntry, Decimals, Described, Folder, Layout, Lens, PoseAxes, Terms, count,
        inverse, names, number_of, numbers, pinhole, rotation, text,
    },
    error::{Error, Result, short},
};

pub(crate) struct Colmap;

/// Camera models by number: name, and how many numbers it has.
const MODELS: [(&str, usize); 18] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    ("SIMPLE_DIVISION", 4),
    ("DIVISION", 5),
    ("SIMPLE_FISHEYE", 3),
    ("FISHEYE", 4),
    ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
];
/// Bytes of a point of an image: x, y and the number of its point in space.
const POINT_BYTES: u64 = 24;

impl Layout for Colmap {
    fn name(&self) -> &'static str {
        "COLMAP"
    }

    fn has_mask_folder(&self) -> bool {
        true
    }

    fn find(&self, folder: &Folder<'_>) -> Vec<String> {
        models(folder).into_iter().map(|(model, _)| model).collect()
    }

    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described> {
        let model = models(folder).into_iter().find(|(model, _)| model == at);
        let (model, ending) = model.ok_or_else(|| Error::invalid("COLMAP: no model"))?;
        read_model(folder, &model, ending)
    }
}

/// The folders of models, each with the ending of its files. COLMAP reads `.bin` first.
fn models(folder: &Folder<'_>) -> Vec<(String, &'static str)> {
    let mut found: Vec<(String, &'static str)> = Vec::new();
    for path in folder.paths() {
        for ending in ["bin", "txt"] {
            let dir = names::folder(path);
            let is_images = names::file_name(path).strip_prefix("images.") == Some(ending);
            let new = found.last().is_none_or(|(last, _)| last != dir);
            if is_images && new && folder.has(&names::join(dir, &format!("cameras.{ending}"))) {
                found.push((dir.to_owned(), ending));
            }
        }
    }
    found
}

fn read_model(folder: &Folder<'_>, model: &str, ending: &str) -> Result<Described> {
    let [cameras, images] =
        ["cameras", "images"].map(|name| names::join(model, &format!("{name}.{ending}")));
    let (camera_bytes, image_bytes) =
        (folder.read_cameras(&cameras)?, folder.read_cameras(&images)?);
    let max = folder.limits.archive_entries_max;
    let entries = if ending == "bin" {
        let lenses = cameras_bin(&camera_bytes, &cameras, max)?;
        images_bin(&image_bytes, &images, &lenses, max)?
    } else {
        let lenses = cameras_txt(&text(&camera_bytes, &cameras)?, &cameras, max)?;
        images_txt(&text(&image_bytes, &images)?, &images, &lenses, max)?
    };
    Ok(Described::new(model, entries))
}

/// Lenses by the number of their camera.
type Lenses = HashMap<u32, Lens>;

/// Reads numbers one after another.
struct Bytes<'a> {
    rest: &'a [u8],
    path: &'a str,
    /// What is being read, for messages.
    item: String,
}

impl<'a> Bytes<'a> {
    fn new(bytes: &'a [u8], path: &'a str) -> Self {
        Self { rest: bytes, path, item: "its count".to_owned() }
    }

    fn cut(&self) -> Error {
        Error::invalid(format!("{}: cut short at {}", self.path, self.item))
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N]> {
        let (head, rest) = self.rest.split_first_chunk::<N>().ok_or_else(|| self.cut())?;
        self.rest = rest;
        Ok(*head)
    }

    fn u32(&mut self) -> Result<u32> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64> {
        self.take().map(u64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self) -> Result<[f64; N]> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = f64::from_le_bytes(self.take()?);
        }
        Ok(numbers)
    }

    fn skip(&mut self, bytes: u64) -> Result<()> {
        let count = usize::try_from(bytes).ok().filter(|count| *count <= self.rest.len());
        self.rest = &self.rest[count.ok_or_else(|| self.cut())?..];
        Ok(())
    }

    /// Text up to a byte of 0.
    fn text(&mut self) -> Result<&'a str> {
        let end = self.rest.iter().position(|byte| *byte == 0).ok_or_else(|| self.cut())?;
        let (name, rest) = self.rest.split_at(end);
        self.rest = &rest[1..];
        std::str::from_utf8(name)
            .map_err(|e| Error::invalid(format!("{}: not UTF-8 text", self.path)).caused_by(e))
    }

    /// Nothing may be left.
    fn end(&self) -> Result<()> {
        if self.rest.is_empty() {
            return Ok(());
        }
        let (path, left) = (self.path, self.rest.len());
        Err(Error::invalid(format!(
            "{path}: {left} bytes after the last entry; its count is wrong"
        )))
    }
}

fn cameras_bin(bytes: &[u8], path: &str, max: usize) -> Result<Lenses> {
    let mut bytes = Bytes::new(bytes, path);
    let (cameras, mut lenses) = (bytes.u64()?, Lenses::new());
    for i in 0..cameras {
        count(lenses.len(), max, path)?;
        bytes.item = format!("camera {i} of {cameras}");
        let (id, model) = (bytes.u32()?, bytes.u32()?);
        let size = [bytes.u64()? as f64, bytes.u64()? as f64];
        let known = usize::try_from(model).ok().and_then(|model| MODELS.get(model));
        let (name, numbers) = *known.ok_or_else(|| {
            let known = MODELS.len() - 1;
            Error::invalid(format!("{path}: camera {id} has model {model}; 0 to {known} are known"))
        })?;
        let mut values = [0.0; 16];
        for value in &mut values[..numbers] {
            [*value] = bytes.f64s()?;
        }
        insert(&mut lenses, id, lens(name, size, &values[..numbers], path, id)?, path)?;
    }
    bytes.end()?;
    Ok(lenses)
}

fn images_bin(bytes: &[u8], path: &str, lenses: &Lenses, max: usize) -> Result<Vec<CameraEntry>> {
    let mut bytes = Bytes::new(bytes, path);
    let (images, mut entries) = (bytes.u64()?, Vec::new());
    for i in 0..images {
        count(entries.len(), max, path)?;
        bytes.item = format!("image {i} of {images}");
        let _image = bytes.u32()?;
        let (turn, [x, y, z]) = (bytes.f64s::<4>()?, bytes.f64s::<3>()?);
        let (camera, name) = (bytes.u32()?, bytes.text()?);
        let points = bytes.u64()?;
        bytes.skip(points.saturating_mul(POINT_BYTES))?;
        entries.push(entry(name, turn, [x, y, z], camera, lenses, path)?);
    }
    bytes.end()?;
    Ok(entries)
}

fn cameras_txt(text: &str, path: &str, max: usize) -> Result<Lenses> {
    let (mut lenses, mut decimals) = (Lenses::new(), Decimals::default());
    for (i, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        count(lenses.len(), max, path)?;
        let mut words = line.split_whitespace();
        let id = words.next().and_then(|id| id.parse().ok());
        let model = words.next().unwrap_or_default();
        let words: Vec<&str> = words.collect();
        decimals.see(&words, path, i + 1)?;
        let values = numbers(&words.join(" "));
        let (Some(id), Some([width, height, values @ ..])) = (id, values.as_deref()) else {
            let why = format!("{path}: line {} is no camera", i + 1);
            return Err(Error::invalid(why));
        };
        insert(&mut lenses, id, lens(model, [*width, *height], values, path, id)?, path)?;
    }
    Ok(lenses)
}

/// Images and their points. COLMAP writes two lines an image, and reads the line after an image as
/// its points whatever it is. Here a line is known by its words, so that neither blank lines nor
/// missing points shift those after them.
fn images_txt(text: &str, path: &str, lenses: &Lenses, max: usize) -> Result<Vec<CameraEntry>> {
    let (mut entries, mut decimals) = (Vec::new(), Decimals::default());
    let mut after_image = false;
    for (i, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        if std::mem::take(&mut after_image) && are_points(line) {
            continue;
        }
        count(entries.len(), max, path)?;
        let (words, name) = first_words::<9>(line);
        decimals.see(&words[1..8], path, i + 1)?;
        let turn_and_place: Option<Vec<f64>> =
            words[1..8].iter().map(|word| number_of(word)).collect();
        let (image, camera) = (number_of(words[0]), words[8].parse());
        let (Some(_), Some(&[w, x, y, z, tx, ty, tz]), Ok(camera), false) =
            (image, turn_and_place.as_deref(), camera, name.is_empty())
        else {
            let why = "is no image; it must be number, quaternion, translation, camera and name";
            return Err(Error::invalid(format!("{path}: line {} {why}", i + 1)));
        };
        entries.push(entry(name, [w, x, y, z], [tx, ty, tz], camera, lenses, path)?);
        after_image = true;
    }
    Ok(entries)
}

/// Whether a line is x, y and the number of its point in space, or -1, for each point of an image.
fn are_points(line: &str) -> bool {
    let words: Vec<&str> = line.split_whitespace().collect();
    words.len().is_multiple_of(3)
        && words.iter().all(|word| number_of(word).is_some())
        && words.iter().skip(2).step_by(3).all(|word| word.parse::<i64>().is_ok())
}

/// The first words of a line, empty where there are less, and the rest: a name may have spaces.
fn first_words<const N: usize>(line: &str) -> ([&str; N], &str) {
    let mut rest = line;
    let words = std::array::from_fn(|_| {
        let (word, after) = rest.split_once(char::is_whitespace).unwrap_or((rest, ""));
        rest = after.trim_start();
        word
    });
    (words, rest)
}

fn insert(lenses: &mut Lenses, id: u32, lens: Lens, path: &str) -> Result<()> {
    match lenses.insert(id, lens) {
        None => Ok(()),
        Some(_) => Err(Error::invalid(format!("{path}: camera {id} is there twice"))),
    }
}

fn entry(
    name: &str,
    turn: [f64; 4],
    translation: [f64; 3],
    camera: u32,
    lenses: &Lenses,
    path: &str,
) -> Result<CameraEntry> {
    let lens = lenses.get(&camera).ok_or_else(|| {
        let name = short(name);
        Error::invalid(format!("{path}: {name:?} has camera {camera}, which is not there"))
    })?;
    let pose = inverse(rotation(turn), translation.into());
    Ok(CameraEntry::new(name.to_owned(), lens.clone(), PoseAxes::OpenCv, pose))
}

/// The lens of a model and its numbers, in COLMAP's order.
fn lens(model: &str, size: [f64; 2], v: &[f64], path: &str, id: u32) -> Result<Lens> {
    let perspective = |focal, k: &[f64]| (focal, Terms { k: first(k), ..Terms::default() });
    let fisheye =
        |focal, k: &[f64]| (focal, Terms { base: Base::Angle, k: first(k), ..Terms::default() });
    let based = |focal, base| (focal, Terms { base, ..Terms::default() });
    let one = |v: &[f64]| [v[0], v[0], v[1], v[2]];
    let two = |v: &[f64]| [v[0], v[1], v[2], v[3]];
    let wrong = |why: String| Error::invalid(format!("{path}: camera {id} {why}"));
    let known = MODELS.iter().find(|(name, _)| *name == model);
    let Some((_, wanted)) = known else {
        let shown: String = model.chars().take(40).collect();
        return Err(wrong(format!("has model {shown:?}, which is not known")));
    };
    if v.len() != *wanted {
        return Err(wrong(format!("has {} numbers; {model} has {wanted}", v.len())));
    }
    let (focal, terms) = match model {
        "SIMPLE_PINHOLE" => perspective(one(v), &[]),
        "PINHOLE" => perspective(two(v), &[]),
        "SIMPLE_RADIAL" | "RADIAL" => perspective(one(v), &v[3..]),
        "OPENCV" => {
            let (focal, terms) = perspective(two(v), &v[4..6]);
            (focal, Terms { p: first(&v[6..]), ..terms })
        }
        "FULL_OPENCV" => {
            let (focal, terms) = perspective(two(v), &[v[4], v[5], v[8]]);
            (focal, Terms { p: first(&v[6..8]), d: first(&v[9..]), ..terms })
        }
        "SIMPLE_FISHEYE" | "SIMPLE_RADIAL_FISHEYE" | "RADIAL_FISHEYE" => fisheye(one(v), &v[3..]),
        "FISHEYE" | "OPENCV_FISHEYE" => fisheye(two(v), &v[4..]),
        "THIN_PRISM_FISHEYE" => {
            let (focal, terms) = fisheye(two(v), &[v[4], v[5], v[8], v[9]]);
            let s = [v[10], 0.0, v[11], 0.0];
            (focal, Terms { p: first(&v[6..8]), s, ..terms })
        }
        "RAD_TAN_THIN_PRISM_FISHEYE" => {
            let (focal, terms) = fisheye(two(v), &v[4..10]);
            // Its p0 goes with r² + 2 x², as p2 of the others does.
            let p = [v[11], v[10]];
            (focal, Terms { p, s: first(&v[12..]), after_radial: true, ..terms })
        }
        // At 0 it is a pinhole.
        "FOV" if v[4] == 0.0 => perspective(two(v), &[]),
        "FOV" => based(two(v), Base::Field(v[4])),
        "SIMPLE_DIVISION" => based(one(v), Base::Division(v[3])),
        "DIVISION" => based(two(v), Base::Division(v[4])),
        "EUCM" => based(two(v), Base::Unified(v[4], v[5])),
        _ => return Err(wrong(format!("has model {model}: its pictures are not flat"))),
    };
    Ok(Lens { terms: Some(terms), ..pinhole(focal, Some(size)) })
}

/// The numbers, filled up with zeros.
fn first<const N: usize>(values: &[f64]) -> [f64; N] {
    let mut all = [0.0; N];
    all[..values.len()].copy_from_slice(values);
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::captures::layout::numbers_of;

    /// A model that pycolmap 4.2.1 wrote, with `rigs` and `frames`: a camera of each kind with one
    /// image, and what pycolmap itself makes of some rays and of the poses.
    const CAMERAS: [&[u8]; 2] = [
        include_bytes!("../../tests/fixtures/colmap/bin/cameras.bin"),
        include_bytes!("../../tests/fixtures/colmap/txt/cameras.txt"),
    ];
    const IMAGES: [&[u8]; 2] = [
        include_bytes!("../../tests/fixtures/colmap/bin/images.bin"),
        include_bytes!("../../tests/fixtures/colmap/txt/images.txt"),
    ];
    const EXPECTED: &str = include_str!("../../tests/fixtures/colmap/expected.txt");

    #[test]
    fn every_camera_model_bends_rays_as_colmap_does() {
        let max = 17;
        let lenses = cameras_bin(CAMERAS[0], "b", max).unwrap();
        let binary = images_bin(IMAGES[0], "b", &lenses, max).unwrap();
        let [cameras, images] = [CAMERAS[1], IMAGES[1]].map(|bytes| text(bytes, "t").unwrap());
        let lenses = cameras_txt(&cameras, "t", max).unwrap();
        let in_text = images_txt(&images, "t", &lenses, max).unwrap();
        for refused in [
            cameras_bin(CAMERAS[0], "b", 16).map(drop),
            cameras_txt(&cameras, "t", 16).map(drop),
            images_bin(IMAGES[0], "b", &lenses, 16).map(drop),
            images_txt(&images, "t", &lenses, 16).map(drop),
        ] {
            assert!(refused.unwrap_err().message().contains("more than 16"));
        }
        for entries in [binary, in_text] {
            assert_eq!(entries.len(), MODELS.len() - 1, "all but EQUIRECTANGULAR");
            let mut rays = 0;
            for line in EXPECTED.lines() {
                let words: Vec<&str> = line.split(' ').collect();
                let model = words[0].to_lowercase();
                let named = |entry: &&CameraEntry| {
                    entry.file.strip_prefix("left side/").is_some_and(|name| {
                        name.rsplit_once(' ').is_some_and(|(name, _)| name == model)
                    })
                };
                let entry = entries.iter().find(named).unwrap();
                if words[1] == "pose" {
                    let pose = entry.pose("test").unwrap().to_row_major();
                    let want = numbers(&words[2..].join(" ")).unwrap();
                    let off = pose.iter().zip(&want).map(|(a, b)| (a - b).abs());
                    assert!(off.fold(0.0, f64::max) < 1e-12, "{model}: {pose:?}, not {want:?}");
                    continue;
                }
                let [x, y, u, v] = numbers_of(&words[1..].join(" "), "", 0).unwrap();
                let lens = &entry.lens;
                let (to_x, to_y) = lens.terms.unwrap().apply(x, y);
                let at = |f: Option<f64>, c: Option<f64>, x: f64| f.unwrap() * x + c.unwrap();
                let got = (at(lens.fx, lens.cx, to_x), at(lens.fy, lens.cy, to_y));
                let off = (got.0 - u).abs().max((got.1 - v).abs());
                assert!(off < 1e-9, "{model} at {x}, {y}: {got:?}, not {u}, {v}");
                rays += 1;
            }
            assert_eq!(rays, 85);
        }
    }
}
