//! A tar of photographs with a mask for each thing: `images/*.jpg`, `masks/*.png`,
//! `segments.json` (`{image: {segments: [{index, name, iscrowd}]}}`).

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt,
    fs::File,
    io::{BufReader, Read as _},
    path::Path,
};

use image::ImageReader;
use serde::Deserialize;

use crate::{
    error::{Error, Result},
    scene::{Crop, CropShape, IndexMap, MaskInfo, Photo, PhotoMasks},
};
use segsplat_vision::semantics::Cutter;

/// Smallest share of a photograph that a thing must cover to be asked about.
const SHARE_MIN: f64 = 0.002;

/// Photographs with named segments, in the order of their names.
#[derive(Debug)]
pub struct Segmented {
    /// Name of the set: the file's stem.
    pub set: String,
    /// The photographs.
    pub images: Vec<SegmentedImage>,
}

/// One photograph, undecoded.
#[derive(Debug)]
pub struct SegmentedImage {
    name: String,
    photo: Vec<u8>,
    mask: Vec<u8>,
    segments: Vec<Segment>,
}

#[derive(Clone, Debug, Deserialize)]
struct Segment {
    index: u8,
    name: String,
    #[serde(default)]
    iscrowd: serde_json::Value,
}

#[derive(Deserialize)]
struct Named {
    segments: Vec<Segment>,
}

impl Segment {
    /// A crowd is many things under one mask: no one name is right for it.
    fn is_crowd(&self) -> bool {
        self.iscrowd.as_bool().unwrap_or(false) || self.iscrowd.as_u64().unwrap_or(0) > 0
    }
}

impl Segmented {
    /// Reads the archive; at most `bytes_max` unpacked.
    ///
    /// # Errors
    /// `invalid_request` where the file is no such set, `limit_exceeded` where it is too large.
    pub fn open(path: &Path, bytes_max: u64) -> Result<Self> {
        let set = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let wrong = |what: &str| Error::invalid(format!("{set}.tar: {what}"));
        let file = File::open(path).map_err(|e| wrong("cannot be opened").caused_by(e))?;
        let mut archive = tar::Archive::new(BufReader::new(file));
        let mut files: BTreeMap<String, Vec<u8>> = BTreeMap::new();
        let mut left = bytes_max;
        for file in archive.entries().map_err(|e| wrong("is no tar").caused_by(e))? {
            let file = file.map_err(|e| wrong("is damaged").caused_by(e))?;
            let Ok(inside) = file.path() else { continue };
            // Only the last folder counts: sets are packed with or without a folder around them.
            let mut parts: Vec<String> =
                inside.iter().map(|part| part.to_string_lossy().into_owned()).collect();
            let key = parts.split_off(parts.len().saturating_sub(2)).join("/");
            let key = if key.ends_with("segments.json") { "segments.json".to_owned() } else { key };
            let mut bytes = Vec::new();
            file.take(left + 1)
                .read_to_end(&mut bytes)
                .map_err(|e| wrong("is damaged").caused_by(e))?;
            left = left.checked_sub(bytes.len() as u64).ok_or_else(|| {
                Error::limit(format!("{set}.tar: bytes unpacked"), bytes.len(), bytes_max)
            })?;
            files.insert(key, bytes);
        }
        let json = files.get("segments.json").ok_or_else(|| wrong("has no segments.json"))?;
        let named: BTreeMap<String, Named> =
            serde_json::from_slice(json).map_err(|e| wrong("segments.json").caused_by(e))?;
        let mut images = Vec::new();
        for (name, Named { segments }) in named {
            let stem = Path::new(&name).with_extension("");
            let stem = stem.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let mut take = |key: String| {
                files.remove(&key).ok_or_else(|| wrong(&format!("{key} is not there")))
            };
            let photo = take(format!("images/{stem}.jpg"))?;
            let mask = take(format!("masks/{stem}.png"))?;
            images.push(SegmentedImage { name: stem, photo, mask, segments });
        }
        Ok(Self { set, images })
    }

    /// Every class name, once.
    #[must_use]
    pub fn class_names(&self) -> BTreeSet<&str> {
        self.images.iter().flat_map(|i| i.segments.iter().map(|s| s.name.as_str())).collect()
    }
}

impl SegmentedImage {
    /// Every thing of it, cut out, with its class name.
    ///
    /// # Errors
    /// `invalid_request` where photograph or mask is no picture.
    pub fn cut(&self, margin: f64, shape: CropShape) -> Result<Vec<(Crop, String)>> {
        let rgb = decode(&self.photo, &self.name)?;
        let mask = decode(&self.mask, &self.name)?;
        let photo =
            Photo { width: rgb.width(), height: rgb.height(), rgb: rgb.into_raw(), valid: None };
        // Grey masks are decoded to three equal channels.
        let values: Vec<u8> = mask.as_raw().iter().step_by(3).copied().collect();
        let mut first = [0_u16; 256];
        let mut count = [0_usize; 256];
        let wanted: Vec<&Segment> = self.segments.iter().filter(|s| !s.is_crowd()).collect();
        for (k, segment) in (1_u16..).zip(&wanted) {
            first[usize::from(segment.index)] = k;
        }
        values.iter().for_each(|v| count[usize::from(*v)] += 1);
        let index = values.iter().map(|v| first[usize::from(*v)]).collect();
        let map = IndexMap { width: mask.width(), height: mask.height(), index };
        let masks =
            PhotoMasks { wholes: Vec::new(), map, masks: vec![MaskInfo::default(); wanted.len()] };
        let cutter = Cutter::new(&photo, &masks);
        let least = SHARE_MIN * values.len() as f64;
        let cut = |(k, segment): (usize, &&Segment)| {
            let large = count[usize::from(segment.index)] as f64 >= least;
            let crop = large.then(|| cutter.cut(k, margin, shape)).flatten()?;
            Some((crop, segment.name.clone()))
        };
        Ok(wanted.iter().enumerate().filter_map(cut).collect())
    }
}

/// The pixels of an image file.
pub(super) fn decode(bytes: &[u8], what: &str) -> Result<image::RgbImage> {
    let fault = |e: &dyn fmt::Display| Error::invalid(format!("{what}: {e}"));
    let reader = ImageReader::new(std::io::Cursor::new(bytes)).with_guessed_format();
    Ok(reader.map_err(|e| fault(&e))?.decode().map_err(|e| fault(&e))?.into_rgb8())
}
