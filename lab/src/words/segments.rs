//! A tar of photographs with a mask for each thing: `images/*.jpg`, `masks/*.png`,
//! `segments.json` (`{image: {segments: [{index, name, iscrowd}]}}`).

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::File,
    io::{BufReader, Read as _},
    path::Path,
};

use serde::Deserialize;

use super::decode;
use crate::{
    error::{Error, Result},
    scene::{Crop, IndexMap, MaskInfo, Photo, PhotoMasks},
};
use segsplat_vision::semantics::Cutter;

/// Smallest share of a photograph that a thing must cover to be asked about.
const SHARE_MIN: f64 = 0.002;

/// Photographs with named segments, in the order of their names.
#[derive(Debug)]
pub(super) struct Segmented {
    /// Name of the set: the file's stem.
    pub set: String,
    /// The photographs.
    pub images: Vec<SegmentedImage>,
}

/// One photograph, undecoded.
#[derive(Debug)]
pub(super) struct SegmentedImage {
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
    pub(super) fn open(path: &Path, bytes_max: u64) -> Result<Self> {
        let set = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let wrong = |what: &str| Error::invalid(format!("{set}.tar: {what}"));
        let file = File::open(path).map_err(|e| wrong("cannot be opened").caused_by(e))?;
        let mut archive = tar::Archive::new(BufReader::new(file));
        let mut files: BTreeMap<String, Vec<u8>> = BTreeMap::new();
        let mut left = bytes_max;
        let entries = archive.entries().map_err(|e| wrong("is no tar").caused_by(e))?;
        for entry in entries {
            let entry = entry.map_err(|e| wrong("is damaged").caused_by(e))?;
            let Ok(inside) = entry.path() else { continue };
            // Only the last folder counts: sets are packed with or without a folder around them.
            let mut parts: Vec<String> =
                inside.iter().map(|part| part.to_string_lossy().into_owned()).collect();
            let key = parts.split_off(parts.len().saturating_sub(2)).join("/");
            let key = if key.ends_with("segments.json") { "segments.json".to_owned() } else { key };
            let mut bytes = Vec::new();
            entry
                .take(left + 1)
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
    pub(super) fn class_names(&self) -> BTreeSet<&str> {
        self.images.iter().flat_map(|i| i.segments.iter().map(|s| s.name.as_str())).collect()
    }
}

impl SegmentedImage {
    /// Every thing of it, cut out, with its class name.
    pub(super) fn cut(&self, margin: f64) -> Result<Vec<(Crop, String)>> {
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
        let masks = PhotoMasks { map, masks: vec![MaskInfo::default(); wanted.len()] };
        let cutter = Cutter::new(&photo, &masks);
        let least = SHARE_MIN * values.len() as f64;
        let cut = |(k, segment): (usize, &&Segment)| {
            let large = count[usize::from(segment.index)] as f64 >= least;
            let crop = large.then(|| cutter.cut(k, margin)).flatten()?;
            Some((crop, segment.name.clone()))
        };
        Ok(wanted.iter().enumerate().filter_map(cut).collect())
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Cursor, Write as _};

    use super::*;

    fn png(picture: impl Into<image::DynamicImage>) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        picture.into().write_to(&mut bytes, image::ImageFormat::Png).unwrap();
        bytes.into_inner()
    }

    #[test]
    fn things_are_cut_out_with_their_names_and_crowds_are_not() {
        let photo = png(image::RgbImage::from_fn(4, 4, |x, _| image::Rgb([x as u8 + 1, 7, 7])));
        let mask = png(image::GrayImage::from_fn(4, 4, |x, y| {
            image::Luma([if y > 1 {
                3
            } else if x < 2 {
                5
            } else {
                0
            }])
        }));
        let json = br#"{"a.jpg": {"split": "x", "segments": [
            {"index": 3, "name": "people", "isthing": 1, "iscrowd": 1},
            {"index": 5, "name": "cup", "isthing": 1, "iscrowd": 0}]}}"#;
        let mut tar = tar::Builder::new(Vec::new());
        let files = [
            ("set/images/a.jpg", photo.as_slice()),
            ("set/masks/a.png", mask.as_slice()),
            ("set/segments.json", json.as_slice()),
        ];
        for (name, bytes) in files {
            let mut header = tar::Header::new_gnu();
            header.set_size(bytes.len() as u64);
            tar.append_data(&mut header, name, bytes).unwrap();
        }
        let file = tempfile::NamedTempFile::new().unwrap();
        file.as_file().write_all(&tar.into_inner().unwrap()).unwrap();
        let set = Segmented::open(file.path(), 1 << 20).unwrap();
        assert_eq!(set.class_names().into_iter().collect::<Vec<_>>(), ["cup", "people"]);
        let cut = set.images[0].cut(0.0).unwrap();
        assert_eq!(cut.len(), 1);
        let (crop, name) = &cut[0];
        assert_eq!((name.as_str(), crop.side), ("cup", 2));
        assert_eq!(crop.rgb, [1, 7, 7, 2, 7, 7, 1, 7, 7, 2, 7, 7]);
    }
}
