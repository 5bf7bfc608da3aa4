//! The photos of a folder under `images/`: the files as sent where their pixels are those of the
//! scene, else PNG. Cameras are those of the undistorted photos at the sizes that scenes keep.

use std::{borrow::Cow, collections::HashSet};

use super::{FolderPixels, PhotoFile, ZipFolder};
use crate::{
    error::Result,
    scene::{Camera, SceneCamera},
};

/// Endings of photos.
const ENDINGS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

/// A photo of a folder.
pub(crate) struct FolderPhoto {
    /// Its path under `images/`.
    pub(crate) file: String,
    pub(crate) camera: Camera,
    /// Whether its pixels are in the folder.
    pub(super) there: bool,
}

impl FolderPhoto {
    /// Its path without the ending, another one for each photo.
    pub(super) fn stem(&self) -> &str {
        split(&self.file).0
    }
}

/// Writes the photos that are kept, and says of those that are not how to put them there.
pub(super) fn write(
    cameras: &[SceneCamera],
    pixels: &mut dyn FolderPixels,
    zip: &mut ZipFolder<'_>,
) -> Result<Vec<FolderPhoto>> {
    let photo =
        |(file, of): (String, &SceneCamera)| FolderPhoto { file, camera: of.camera, there: false };
    let mut photos: Vec<FolderPhoto> = names(cameras).into_iter().zip(cameras).map(photo).collect();
    pixels.photos(&mut |i, sent| {
        let photo = &mut photos[i];
        let bytes = match sent {
            PhotoFile::Sent(bytes) => Cow::Borrowed(bytes),
            PhotoFile::Png(bytes) => {
                photo.file = format!("{}.png", photo.stem());
                Cow::Owned(bytes)
            }
        };
        photo.there = true;
        zip.file(&format!("images/{}", photo.file), &bytes)
    })?;
    let lacking: Vec<&FolderPhoto> = photos.iter().filter(|photo| !photo.there).collect();
    if !lacking.is_empty() {
        zip.begin_text("README.txt")?;
        zip.put(readme(&lacking, photos.len()).as_bytes())?;
    }
    Ok(photos)
}

/// What to do where photos are not in the folder.
fn readme(lacking: &[&FolderPhoto], all: usize) -> String {
    let mut text = format!(
        "{} of {all} photos are not in this folder: they are not kept, or the scene has none.\n\
         The cameras are those of undistorted photos of these names and sizes:\n\n",
        lacking.len()
    );
    for FolderPhoto { file, camera, .. } in lacking {
        let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
        text += &format!("images/{file}  {w} x {h} px\n");
    }
    text
}

/// A path and its ending; the ending of a photo alone is one.
fn split(path: &str) -> (&str, Option<&str>) {
    match path.rsplit_once('.') {
        Some((stem, end)) if ENDINGS.contains(&&*end.to_ascii_lowercase()) => (stem, Some(end)),
        _ => (path, None),
    }
}

/// Paths under `images/`, as the scene calls its photos. They can be unpacked anywhere, and no two
/// are the same without their endings.
fn names(cameras: &[SceneCamera]) -> Vec<String> {
    let mut all: Vec<Vec<String>> = cameras.iter().map(|camera| parts(&camera.file)).collect();
    if all.iter().all(|parts| parts.len() > 1 && parts[0] == "images") {
        all.iter_mut().for_each(|parts| drop(parts.remove(0)));
    }
    let mut seen = HashSet::new();
    let name = |(i, parts): (usize, Vec<String>)| {
        let path = if parts.is_empty() { format!("photo_{i:04}") } else { parts.join("/") };
        let (stem, end) = split(&path);
        let end = end.unwrap_or("png");
        let mut own = stem.to_owned();
        while !seen.insert(own.to_lowercase()) {
            own = format!("{own}_{i}");
        }
        format!("{own}.{end}")
    };
    all.into_iter().enumerate().map(name).collect()
}

/// The parts of a path that lead nowhere but down, without what some system cannot write.
fn parts(path: &str) -> Vec<String> {
    let odd = |c: char| c.is_control() || "<>:\"|?*".contains(c);
    // Of `.` and `..` nothing is left.
    let part = |part: &str| part.replace(odd, "_").trim_matches([' ', '.']).to_owned();
    path.split(['/', '\\']).map(part).filter(|part| !part.is_empty()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{CameraToWorld, Intrinsics};

    fn named(files: &[&str]) -> Vec<String> {
        let intrinsics = Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, width: 1, height: 1 };
        let pose = [1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
        let camera_to_world = CameraToWorld::from_row_major(&pose, "test").unwrap();
        let camera = Camera { intrinsics, camera_to_world };
        let camera = |file: &&str| SceneCamera { file: (*file).to_owned(), camera, network: None };
        names(&files.iter().map(camera).collect::<Vec<_>>())
    }

    #[test]
    fn names_stay_in_the_folder_and_differ() {
        assert_eq!(named(&["images/a.png", "images/b.JPG"]), ["a.png", "b.JPG"]);
        assert_eq!(named(&["images/a.png", "b.jpg"]), ["images/a.png", "b.jpg"]);
        let hostile = ["../../etc/passwd", "/x/..", "C:\\a:b\n.png", "..", "x.tar", " .png"];
        let safe =
            ["etc/passwd.png", "x.png", "C_/a_b_.png", "photo_0003.png", "x.tar.png", "png.png"];
        assert_eq!(named(&hostile), safe);
        assert_eq!(named(&["a.png", "A.jpg", "a.webp"]), ["a.png", "A_1.jpg", "a_2.webp"]);
    }
}
