//! Photos into which something is pasted that is not in the scene.

use std::{collections::BTreeMap, fs::File, io::Read as _, path::Path};

use segsplat_testing::scenes::Random;

use super::segments::decode;
use crate::{
    error::{Error, Result},
    scene::PosedPhoto,
};

/// Every so many photos one gets a cut-out, from this one on.
const EVERY: usize = 3;
const FIRST: usize = 1;
/// Height of a cut-out, shares of that of the photo.
const HEIGHTS: [f32; 2] = [0.45, 0.75];
/// Level of a mask from which a pixel is inside.
const INSIDE: u8 = 128;

/// A photo and which of its pixels are pasted; `None` where none is.
pub(crate) type Pasted = (PosedPhoto, Option<Vec<bool>>);

/// The photos, a third of them with a cut-out of this tar (`images/N.jpg`, `masks/N.png`): another
/// one each, at another place, the same in each run.
///
/// # Errors
/// `invalid_request` where it is no such tar.
pub(crate) fn pasted(photos: &[PosedPhoto], tar: &Path) -> Result<Vec<Pasted>> {
    let files = unpacked(tar)?;
    let names: Vec<&String> = files.keys().filter(|name| name.starts_with("images/")).collect();
    let mut random = Random(40);
    let mut all = Vec::with_capacity(photos.len());
    for (i, posed) in photos.iter().enumerate() {
        if i % EVERY != FIRST {
            all.push((posed.clone(), None));
            continue;
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a number")]
        let name = names[(random.range(0.0, names.len() as f32) as usize).min(names.len() - 1)];
        let mask = name.replace("images/", "masks/").replace(".jpg", ".png");
        let lacks = || Error::invalid(format!("{}: {mask} is not there", tar.display()));
        let mask = decode(files.get(&mask).ok_or_else(lacks)?, &mask)?;
        let cut = decode(&files[name], name)?;
        let shares = [(); 2].map(|()| random.range(0.0, 1.0));
        let height = random.range(HEIGHTS[0], HEIGHTS[1]);
        all.push(with(posed, &cut, &mask, height, shares));
    }
    Ok(all)
}

/// A photo with a cut-out of so much of its height, there.
fn with(
    posed: &PosedPhoto,
    cut: &image::RgbImage,
    mask: &image::RgbImage,
    height: f32,
    [across, down]: [f32; 2],
) -> Pasted {
    let (width, rows) = (posed.photo.width as f32, posed.photo.height as f32);
    let inside = |x: u32, y: u32| mask.get_pixel(x, y)[0] >= INSIDE;
    let [w, h] = [cut.width().min(mask.width()), cut.height().min(mask.height())];
    let cells = (0..h).flat_map(|y| (0..w).map(move |x| (x, y)));
    let (mut from, mut to) = ([w, h], [0, 0]);
    for (x, y) in cells.filter(|&(x, y)| inside(x, y)) {
        (from, to) = ([from[0].min(x), from[1].min(y)], [to[0].max(x + 1), to[1].max(y + 1)]);
    }
    let mut pasted = posed.clone();
    let mut which = vec![false; pasted.photo.rgb.len() / 3];
    if from[0] >= to[0] {
        return (pasted, Some(which));
    }
    let scale = height * rows / (to[1] - from[1]) as f32;
    let size = [(to[0] - from[0]) as f32 * scale, (to[1] - from[1]) as f32 * scale];
    let left = across * (width - size[0]);
    let top = (0.5 + 0.5 * down) * (rows - size[1]);
    for (i, which) in which.iter_mut().enumerate() {
        let x = (i as u32 % posed.photo.width) as f32 + 0.5 - left;
        let y = (i as u32 / posed.photo.width) as f32 + 0.5 - top;
        if !(0.0..size[0]).contains(&x) || !(0.0..size[1]).contains(&y) {
            continue;
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "inside")]
        let [x, y] = [from[0] + (x / scale) as u32, from[1] + (y / scale) as u32];
        if inside(x.min(w - 1), y.min(h - 1)) {
            *which = true;
            let pixel = cut.get_pixel(x.min(w - 1), y.min(h - 1)).0;
            pasted.photo.rgb[3 * i..3 * i + 3].copy_from_slice(&pixel);
        }
    }
    (pasted, Some(which))
}

fn unpacked(path: &Path) -> Result<BTreeMap<String, Vec<u8>>> {
    let wrong = |e: std::io::Error| {
        Error::invalid(format!("{}: it is no tar that can be read", path.display())).caused_by(e)
    };
    let mut archive = tar::Archive::new(File::open(path).map_err(wrong)?);
    let mut files = BTreeMap::new();
    for file in archive.entries().map_err(wrong)? {
        let mut file = file.map_err(wrong)?;
        let name = file.path().map_err(wrong)?.to_string_lossy().into_owned();
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes).map_err(wrong)?;
        files.insert(name, bytes);
    }
    Ok(files)
}
