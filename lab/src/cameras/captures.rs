//! Rendered captures with exact cameras: rooms that are walked past, things on a turntable,
//! corridors that are walked along; with what spoils photos, one thing a capture or several.

use std::path::Path;

use glam::{DMat3, DVec3};
use image::{ExtendedColorType, ImageEncoder as _, ImageError, codecs::jpeg::JpegEncoder};
use rayon::prelude::*;
use segsplat_testing::scenes::Random;
use serde_json::json;

use crate::{
    error::{Error, Result},
    sample::{Room, TARGET},
    scene::{Camera, CameraToWorld, Intrinsics, Photo, Upload, UploadFile},
    warp::bilinear,
};

/// Captures that the bars of the issue are about.
pub(super) const CAPTURES: usize = 40;
/// Rays a pixel, per side.
const RAYS: u32 = 2;
/// Quality of the JPEG files.
const QUALITY: u8 = 92;
/// Photos of a capture with one of another place, and of one with few.
const WITH_FOREIGN: usize = 12;
const FEW: usize = 5;
/// Standard deviation of noise, of 255.
const NOISE: f64 = 5.0;
/// Length of the blur of a moved camera, shares of the width: least and most.
const BLUR: [f64; 2] = [0.002, 0.006];
/// Light of a photo, in stops about the capture's, and colours of it as shares.
const STOPS: f64 = 0.8;
const TINT: f64 = 0.06;
/// How far wrong EXIF is off: a crop that it does not tell.
const EXIF_WRONG: [f64; 2] = [0.7, 1.5];
/// Diagonal of a 35 mm film's picture, millimetres.
const FILM_DIAGONAL: f64 = 43.266_6;

/// Where a capture is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    Room,
    Turntable,
    Corridor,
}

/// What is wrong with the photos of a capture.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Spoilt {
    name: &'static str,
    noise: bool,
    blur: bool,
    exposure: bool,
    exif: Exif,
    foreign: bool,
    few: bool,
}

/// What EXIF says of the focal length.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Exif {
    #[default]
    Absent,
    Right,
    Wrong,
}

/// A capture: its files, and what is true of them.
pub(super) struct Rendered {
    pub(super) name: String,
    pub(super) place: Place,
    pub(super) exif: Exif,
    pub(super) upload: Upload,
    /// The true camera of each file.
    pub(super) cameras: Vec<(String, Camera)>,
    /// The file that shows another place.
    pub(super) foreign: Option<String>,
}

impl Place {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Room => "room",
            Self::Turntable => "turntable",
            Self::Corridor => "corridor",
        }
    }

    fn made(self, seed: u64) -> Room {
        match self {
            Self::Room => Room::new(seed),
            Self::Turntable => Room::turntable(seed),
            Self::Corridor => Room::corridor(seed),
        }
    }
}

impl Exif {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Absent => "absent",
            Self::Right => "right",
            Self::Wrong => "wrong",
        }
    }
}

/// What the captures of a place have, one after the other.
fn spoilt(turn: usize) -> Spoilt {
    let plain = Spoilt { name: "plain", ..Spoilt::default() };
    let all = [
        plain,
        Spoilt { name: "noise", noise: true, ..plain },
        Spoilt { name: "blur", blur: true, ..plain },
        Spoilt { name: "exposure", exposure: true, ..plain },
        Spoilt { name: "exif", exif: Exif::Right, ..plain },
        Spoilt { name: "wrong-exif", exif: Exif::Wrong, ..plain },
        Spoilt { name: "foreign", foreign: true, ..plain },
        Spoilt { name: "noise-exposure", noise: true, exposure: true, ..plain },
        Spoilt { name: "noise-blur-exposure", noise: true, blur: true, exposure: true, ..plain },
        Spoilt { name: "noise-wrong-exif", noise: true, exif: Exif::Wrong, ..plain },
        Spoilt { name: "exposure-foreign", exposure: true, foreign: true, ..plain },
        Spoilt { name: "few", few: true, ..plain },
        Spoilt {
            name: "all",
            noise: true,
            blur: true,
            exposure: true,
            exif: Exif::Wrong,
            foreign: true,
            few: false,
        },
    ];
    all[turn % all.len()]
}

/// Uniform in `low..high`.
fn between(random: &mut Random, low: f64, high: f64) -> f64 {
    low + (high - low) * ((random.bits() >> 11) as f64 / (1_u64 << 53) as f64)
}

/// A whole number under `bound`.
fn below(random: &mut Random, bound: usize) -> usize {
    usize::try_from(random.bits() % bound as u64).unwrap_or_default()
}

/// About 0, with a standard deviation of 1.
fn normal(random: &mut Random) -> f64 {
    let [length, angle] = [(); 2].map(|()| between(random, 1e-12, 1.0));
    (-2.0 * length.ln()).sqrt() * (std::f64::consts::TAU * angle).cos()
}

impl Rendered {
    /// Capture `index`, with photos `width` pixels wide. The same number gives the same photos.
    pub(super) fn new(index: usize, width: u32) -> Result<Self> {
        let place = [Place::Room, Place::Turntable, Place::Corridor][index % 3];
        let spoilt = spoilt(index / 3);
        let seed = 1_000 + index as u64;
        let mut random = Random(seed);
        let count = match spoilt {
            Spoilt { foreign: true, .. } => WITH_FOREIGN,
            Spoilt { few: true, .. } => FEW,
            _ => 8 + below(&mut random, 5),
        };
        let lens = lens(place, width, &mut random);
        let poses = path(place, count, &mut random)?;
        let foreign = spoilt.foreign.then(|| below(&mut random, count));
        let [own, other] = [seed, seed + 500].map(|seed| place.made(seed));
        let seeds: Vec<u64> = (0..count).map(|_| random.bits()).collect();
        let off = EXIF_WRONG[below(&mut random, 2)];
        let told = match spoilt.exif {
            Exif::Absent => None,
            Exif::Right => Some(lens.fx),
            Exif::Wrong => Some(lens.fx * off),
        };
        let cameras = poses.into_iter().enumerate().map(|(i, camera_to_world)| {
            (format!("images/{i:04}.jpg"), Camera { intrinsics: lens, camera_to_world })
        });
        let cameras: Vec<(String, Camera)> = cameras.collect();
        let file = |(i, (name, camera)): (usize, &(String, Camera))| {
            let room = if foreign == Some(i) { &other } else { &own };
            let photo = taken(room.view_by(camera, RAYS).photo, spoilt, &mut Random(seeds[i]));
            Ok(UploadFile { name: name.clone(), bytes: jpeg(&photo, told)? })
        };
        let photos = cameras.par_iter().enumerate().map(file).collect::<Result<Vec<_>>>()?;
        Ok(Self {
            name: format!("{index:02}-{}-{}", place.name(), spoilt.name),
            place,
            exif: spoilt.exif,
            foreign: foreign.map(|i| cameras[i].0.clone()),
            upload: Upload { photos, ..Upload::default() },
            cameras,
        })
    }

    /// Writes the photos and their true cameras as a folder of `dir`: for other programs. The frame
    /// of another place has `foreign`.
    pub(super) fn write(&self, dir: &Path) -> Result<()> {
        let failed = |e: std::io::Error| Error::invalid(format!("--write: {e}"));
        let dir = dir.join(&self.name);
        fs_err::create_dir_all(dir.join("images")).map_err(failed)?;
        for UploadFile { name, bytes } in &self.upload.photos {
            fs_err::write(dir.join(name), bytes).map_err(failed)?;
        }
        let frame = |(file, camera): &(String, Camera)| {
            let Camera { intrinsics: k, camera_to_world } = camera;
            json!({
                "file_path": file, "foreign": self.foreign.as_ref() == Some(file),
                "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy, "w": k.width, "h": k.height,
                "transform_matrix": camera_to_world.to_opengl_rows(),
            })
        };
        let frames: Vec<_> = self.cameras.iter().map(frame).collect();
        let told = json!({ "camera_model": "OPENCV", "frames": frames }).to_string();
        fs_err::write(dir.join("transforms.json"), told).map_err(failed)
    }
}

/// A lens of the place: things on a table are photographed from further away.
fn lens(place: Place, width: u32, random: &mut Random) -> Intrinsics {
    let height = width * 3 / 4;
    let [low, high] = match place {
        Place::Turntable => [1.0, 1.4],
        Place::Room | Place::Corridor => [0.72, 1.1],
    };
    let f = f64::from(width) * between(random, low, high);
    let (cx, cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
    Intrinsics { fx: f, fy: f, cx, cy, width, height }
}

/// Where the photos are taken from.
fn path(place: Place, count: usize, random: &mut Random) -> Result<Vec<CameraToWorld>> {
    let share = |i: usize| i as f64 / (count - 1) as f64;
    match place {
        Place::Room => {
            let half = between(random, 0.45, 0.7);
            let (distance, rise) = (between(random, 2.8, 3.5), between(random, -0.45, -0.2));
            let one = |i: usize| {
                let arc = half * (2.0 * share(i) - 1.0);
                let way = DVec3::new(arc.sin(), rise, -arc.cos()).normalize() * distance;
                let eye = TARGET + way + shaken(random, 0.08);
                let target = TARGET + shaken(random, 0.15);
                held(eye, target, between(random, -4.0, 4.0))
            };
            (0..count).map(one).collect()
        }
        Place::Turntable => {
            let step = between(random, 14.0, 22.0).min(360.0 / count as f64).to_radians();
            let (distance, tilt) = (between(random, 2.2, 2.7), between(random, 0.35, 0.65));
            let (first, roll) = (between(random, 0.0, 6.0), between(random, -2.0, 2.0));
            let target = DVec3::new(0.0, -0.25, 0.0);
            let one = |i: usize| {
                let angle = first + step * i as f64;
                let way =
                    DVec3::new(angle.sin() * tilt.cos(), -tilt.sin(), -angle.cos() * tilt.cos());
                held(target + way * distance, target, roll)
            };
            (0..count).map(one).collect()
        }
        Place::Corridor => {
            let step = between(random, 0.25, 0.4);
            let one = |i: usize| {
                let along = DVec3::new(0.0, -1.5, -0.6 + step * i as f64);
                let eye = along + shaken(random, 0.15);
                let side = 0.6 * (0.9 * i as f64).sin();
                let target = along + DVec3::new(side, 0.3, 4.0) + shaken(random, 0.2);
                held(eye, target, between(random, -3.0, 3.0))
            };
            (0..count).map(one).collect()
        }
    }
}

/// A step in any direction, each coordinate at most `most`.
fn shaken(random: &mut Random, most: f64) -> DVec3 {
    DVec3::from_array([(); 3].map(|()| between(random, -most, most)))
}

/// A camera that looks at `target`, turned about its axis by `roll` degrees.
fn held(eye: DVec3, target: DVec3, roll: f64) -> Result<CameraToWorld> {
    let level = CameraToWorld::look_at(eye, target, -DVec3::Y, "a rendered capture")?;
    let turn = DMat3::from_rotation_z(roll.to_radians());
    Ok(CameraToWorld::from_rotation(level.rotation() * turn, eye))
}

/// The photo as the camera takes it.
fn taken(photo: Photo, spoilt: Spoilt, random: &mut Random) -> Photo {
    let Photo { width, height, rgb, valid } = photo;
    let mut values: Vec<f64> = rgb.iter().map(|v| f64::from(*v)).collect();
    if spoilt.exposure {
        let light = between(random, -STOPS, STOPS).exp2();
        let gains = [(); 3].map(|()| light * between(random, 1.0 - TINT, 1.0 + TINT));
        for (i, value) in values.iter_mut().enumerate() {
            let linear = (*value / 255.0).powf(2.2) * gains[i % 3];
            *value = 255.0 * linear.min(1.0).powf(1.0 / 2.2);
        }
    }
    if spoilt.blur {
        let length = f64::from(width) * between(random, BLUR[0], BLUR[1]);
        let (y, x) = between(random, 0.0, std::f64::consts::TAU).sin_cos();
        values = blurred(&values, width as usize, [x * length, y * length]);
    }
    if spoilt.noise {
        values.iter_mut().for_each(|value| *value += NOISE * normal(random));
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped")]
    let rgb = values.iter().map(|value| value.round().clamp(0.0, 255.0) as u8).collect();
    Photo { width, height, rgb, valid }
}

/// RGB along a way about each pixel, which stays in its middle.
fn blurred(values: &[f64], width: usize, [x, y]: [f64; 2]) -> Vec<f64> {
    const STEPS: u32 = 9;
    let mut blurred = Vec::with_capacity(values.len());
    for i in 0..values.len() / 3 {
        let mut sum = [0.0; 3];
        for step in 0..STEPS {
            let share = f64::from(step) / f64::from(STEPS - 1) - 0.5;
            let (px, py) = ((i % width) as f64 + share * x, (i / width) as f64 + share * y);
            let found = bilinear(values, width, px, py);
            sum.iter_mut().zip(found).for_each(|(sum, found)| *sum += found);
        }
        blurred.extend(sum.map(|sum| sum / f64::from(STEPS)));
    }
    blurred
}

/// A JPEG file, with a focal length in its EXIF where one is told.
fn jpeg(photo: &Photo, focal: Option<f64>) -> Result<Vec<u8>> {
    let mut jpeg = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut jpeg, QUALITY);
    let told = focal.map_or(Ok(()), |focal| encoder.set_exif_metadata(exif(photo, focal)));
    told.map_err(ImageError::Unsupported)
        .and_then(|()| {
            encoder.encode(&photo.rgb, photo.width, photo.height, ExtendedColorType::Rgb8)
        })
        .map_err(|e| Error::internal("a rendered photo is no JPEG").caused_by(e))?;
    Ok(jpeg)
}

/// `FocalLengthIn35mmFilm` is whole millimetres, as phones write it.
fn exif(photo: &Photo, focal: f64) -> Vec<u8> {
    let diagonal = f64::from(photo.width).hypot(f64::from(photo.height));
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "tens")]
    let [low, high] = ((focal / diagonal * FILM_DIAGONAL).round() as u16).to_le_bytes();
    [
        // The first directory at 8: one entry, the EXIF directory at 26.
        &b"II*\0\x08\0\0\0\x01\0\x69\x87\x04\0\x01\0\0\0\x1A\0\0\0\0\0\0\0"[..],
        &b"\x01\0\x05\xA4\x03\0\x01\0\0\0"[..],
        &[low, high, 0, 0, 0, 0, 0, 0],
    ]
    .concat()
}
