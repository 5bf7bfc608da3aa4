//! Labelled scene folders, ours and those of 3D-OVS, as photos with a class for each pixel.
//!
//! Ours: `transforms.json` with `mask_file` in some frames and `masks/classes.json`; `scene.json`
//! may name `surroundings`: classes that are counted but not asked for. 3D-OVS: `images/`,
//! `segmentations/classes.txt`, `segmentations/FRAME/CLASS.png`, cameras in `transforms.json`,
//! `cameras.json` or `poses_bounds.npy` (LLFF). Labels go through the reader of photos, which
//! removes the lens distortion of both in the same way.

use std::{
    collections::BTreeMap,
    io::Cursor,
    path::{Component, Path, PathBuf},
    sync::atomic::AtomicBool,
};

use image::{DynamicImage, GrayImage, ImageFormat, RgbImage, imageops::FilterType};
use serde_json::Value;

use crate::{
    error::{Error, Result},
    limits::Limits,
    photo_files as photos,
    scene::{PosedPhoto, Upload, UploadFile},
};

/// A pixel that no photo shows: it is not judged.
pub const NOT_SEEN: u16 = u16::MAX;
/// A channel at this value or above belongs to the class.
const INSIDE: u8 = 128;

/// A class of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Class {
    /// The word that is asked.
    pub name: String,
    /// Whether its name is asked; surroundings are only counted as wrong where selected.
    pub asked: bool,
}

/// A photo with labels.
#[derive(Clone, Debug)]
pub struct LabelledFrame {
    /// Index of the photo.
    pub photo: usize,
    /// `[H * W]` class + 1 of each pixel, 0 = none of them, [`NOT_SEEN`].
    pub label: Vec<u16>,
}

/// A scene folder.
#[derive(Clone, Debug)]
pub struct LabelledScene {
    /// All photos, undistorted.
    pub photos: Vec<PosedPhoto>,
    /// All classes.
    pub classes: Vec<Class>,
    /// The photos that have labels.
    pub frames: Vec<LabelledFrame>,
}

/// Labels as stored: a class + 1 for each pixel of some photos, by the photo's place in the upload.
struct Stored {
    classes: Vec<Class>,
    maps: Vec<(usize, GrayImage)>,
}

/// Whether the folder holds labels of either layout.
#[must_use]
pub fn is_labelled(dir: &Path) -> bool {
    dir.join("masks/classes.json").is_file() || dir.join("segmentations/classes.txt").is_file()
}

/// Reads photos and labels.
///
/// # Errors
/// `invalid_request` when a file is missing, lies outside the folder or cannot be read.
pub fn read(dir: &Path, limits: &Limits) -> Result<LabelledScene> {
    let (read, upload) = photos::read_dir_until(dir, limits, &AtomicBool::new(false))?;
    let stored = if dir.join("masks/classes.json").is_file() {
        ours(dir, &upload)?
    } else {
        ovs(dir, &upload)?
    };
    let photos = read.photos;
    let frames = undo(&stored, &upload, &photos, limits)?;
    Ok(LabelledScene { photos, classes: stored.classes, frames })
}

fn json(dir: &Path, name: &str) -> Result<Value> {
    let wrong = || Error::invalid(format!("{name} cannot be read"));
    let text = fs_err::read_to_string(dir.join(name)).map_err(|e| wrong().caused_by(e))?;
    serde_json::from_str(&text).map_err(|e| wrong().caused_by(e))
}

/// A picture that a file of the folder names; the name must stay inside the folder.
fn picture(dir: &Path, name: &str) -> Result<GrayImage> {
    let wrong = |what: &str| Error::invalid(format!("{name:?}: {what}"));
    if Path::new(name).components().any(|part| !matches!(part, Component::Normal(_))) {
        return Err(wrong("the path must be relative and stay inside the folder"));
    }
    let bytes = fs_err::read(dir.join(name)).map_err(|e| wrong("cannot be read").caused_by(e))?;
    let picture = image::load_from_memory(&bytes).map_err(|e| wrong("no picture").caused_by(e))?;
    Ok(picture.into_luma8())
}

/// Width and height of a photo, from its header.
fn dimensions(file: &UploadFile) -> Result<(u32, u32)> {
    let wrong = || Error::photo(format!("{}: no photo", file.name));
    image::ImageReader::new(Cursor::new(&file.bytes))
        .with_guessed_format()
        .map_err(|e| wrong().caused_by(e))?
        .into_dimensions()
        .map_err(|e| wrong().caused_by(e))
}

/// Place in the upload of the photo that a label belongs to: by path, or by stem.
fn photo_called(upload: &Upload, name: &str) -> Option<usize> {
    let stem = |path: &str| Path::new(path).file_stem().map(ToOwned::to_owned);
    let whole = upload.photos.iter().position(|photo| photo.name == name);
    whole.or_else(|| upload.photos.iter().position(|photo| stem(&photo.name) == stem(name)))
}

fn ours(dir: &Path, upload: &Upload) -> Result<Stored> {
    let wrong = |what: &str| Error::invalid(what);
    let named: BTreeMap<String, String> = serde_json::from_value(json(dir, "masks/classes.json")?)
        .map_err(|e| wrong("masks/classes.json: no value to name table").caused_by(e))?;
    let surroundings: Vec<String> = if dir.join("scene.json").is_file() {
        serde_json::from_value(json(dir, "scene.json")?["surroundings"].clone()).unwrap_or_default()
    } else {
        Vec::new()
    };
    let (mut classes, mut class_of) = (Vec::new(), [0_u8; 256]);
    for (value, name) in named {
        let value: u8 = value.parse().ok().filter(|v| *v > 0).ok_or_else(|| {
            wrong(&format!("masks/classes.json: value {value:?} must be 1 to 255"))
        })?;
        let asked = !surroundings.contains(&name);
        classes.push(Class { name, asked });
        class_of[usize::from(value)] =
            u8::try_from(classes.len()).map_err(|_| wrong("over 255 classes"))?;
    }
    let mut maps = Vec::new();
    let cameras = json(dir, "transforms.json")?;
    for frame in cameras["frames"].as_array().into_iter().flatten() {
        let (Some(file), Some(mask)) = (frame["file_path"].as_str(), frame["mask_file"].as_str())
        else {
            continue;
        };
        let photo = photo_called(upload, file)
            .ok_or_else(|| wrong(&format!("{mask:?} is of {file:?}, no photo of the folder")))?;
        let mut map = picture(dir, mask)?;
        map.pixels_mut().for_each(|v| v.0[0] = class_of[usize::from(v.0[0])]);
        maps.push((photo, map));
    }
    Ok(Stored { classes, maps })
}

fn ovs(dir: &Path, upload: &Upload) -> Result<Stored> {
    let wrong = |what: &str| Error::invalid(format!("segmentations: {what}"));
    let top = dir.join("segmentations");
    let text = fs_err::read_to_string(top.join("classes.txt"))
        .map_err(|e| wrong("classes.txt cannot be read").caused_by(e))?;
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let classes: Vec<Class> =
        lines.map(|name| Class { name: name.to_owned(), asked: true }).collect();
    if classes.is_empty() || classes.len() > 255 {
        return Err(wrong(&format!("classes.txt names {} classes, not 1 to 255", classes.len())));
    }
    let listed = fs_err::read_dir(&top).map_err(|e| wrong("cannot be read").caused_by(e))?;
    let mut folders: Vec<PathBuf> = listed.flatten().map(|entry| entry.path()).collect();
    folders.retain(|path| path.is_dir());
    folders.sort();
    let mut maps = Vec::new();
    for folder in folders {
        let frame = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let photo = photo_called(upload, &frame)
            .ok_or_else(|| wrong(&format!("frame {frame:?} is no photo of the folder")))?;
        let mut map: Option<GrayImage> = None;
        for (value, class) in (1_u8..).zip(&classes) {
            let name = format!("segmentations/{frame}/{}.png", class.name);
            if !dir.join(&name).is_file() {
                continue;
            }
            let mask = picture(dir, &name)?;
            let map = map.get_or_insert_with(|| GrayImage::new(mask.width(), mask.height()));
            if map.dimensions() != mask.dimensions() {
                return Err(wrong(&format!("{name}: another size than the frame's other masks")));
            }
            // Where masks overlap, the one named first keeps the pixel.
            for (to, from) in map.pixels_mut().zip(mask.pixels()) {
                if to.0[0] == 0 && from.0[0] >= INSIDE {
                    to.0[0] = value;
                }
            }
        }
        maps.extend(map.map(|map| (photo, map)));
    }
    Ok(Stored { classes, maps })
}

/// Labels of the undistorted photos. The reader takes three classes at a time, as the channels of a
/// photo.
fn undo(
    stored: &Stored,
    upload: &Upload,
    photos: &[PosedPhoto],
    limits: &Limits,
) -> Result<Vec<LabelledFrame>> {
    let blank = |&(photo, _): &(usize, GrayImage)| {
        let valid = photos[photo].photo.valid.as_ref();
        let pixels = photos[photo].photo.rgb.len() / 3;
        let label = |p: usize| if valid.is_some_and(|valid| !valid[p]) { NOT_SEEN } else { 0 };
        LabelledFrame { photo, label: (0..pixels).map(label).collect() }
    };
    let mut frames: Vec<LabelledFrame> = stored.maps.iter().map(blank).collect();
    let values: Vec<u8> = (1..=u8::MAX).take(stored.classes.len()).collect();
    for group in values.chunks(3) {
        let mut labels = upload.clone();
        for (photo, map) in &stored.maps {
            let (width, height) = dimensions(&upload.photos[*photo])?;
            let flags = RgbImage::from_fn(map.width(), map.height(), |x, y| {
                let value = map.get_pixel(x, y).0[0];
                let inside = |c: usize| group.get(c).is_some_and(|of| *of == value);
                image::Rgb([0, 1, 2].map(|c| if inside(c) { u8::MAX } else { 0 }))
            });
            let flags =
                DynamicImage::ImageRgb8(flags).resize_exact(width, height, FilterType::Nearest);
            let mut bytes = Cursor::new(Vec::new());
            flags
                .write_to(&mut bytes, ImageFormat::Png)
                .map_err(|e| Error::internal("labels cannot be encoded").caused_by(e))?;
            labels.photos[*photo].bytes = bytes.into_inner();
        }
        let read = photos::read(&labels, limits)?;
        for frame in &mut frames {
            let flags = &read[frame.photo].photo.rgb;
            for (label, flags) in frame.label.iter_mut().zip(flags.chunks_exact(3)) {
                let class = group.iter().zip(flags).find(|(_, flag)| **flag >= INSIDE);
                if let Some((value, _)) = class.filter(|_| *label == 0) {
                    *label = u16::from(*value);
                }
            }
        }
    }
    Ok(frames)
}
