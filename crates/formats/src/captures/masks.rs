//! Masks of photos: pictures that say which pixels of a photo take part in its scene. Black (0) is
//! left out, as COLMAP and nerfstudio mean it.
//!
//! A mask is known by what its camera says (`mask_path`), or by where it lies: in a folder `masks`
//! (`mask`, `masks_2`) under the path that its photo has among the photos, as `masks/a/0.png` or
//! `masks/a/0.jpg.png` of `images/a/0.jpg` (COLMAP). Beside a photo `dynamic_mask_0.png` of
//! instant-ngp is the other way round: what is not black is left out.
//!
//! Folders of this name also hold labels of things, beside cameras of other programs. So the folder
//! counts where COLMAP's cameras are read, and where a form has it, whose sender knows of it.

use std::collections::HashMap;

use super::{
    bytes::FileBytes,
    names::{self, Spelling},
};

/// The file of a photo's mask.
#[derive(Clone, Debug)]
pub struct FoundMask<'a> {
    /// The file as the folder calls it.
    pub path: String,
    /// The file.
    pub bytes: FileBytes<'a>,
    /// Whether it marks what is left out: black takes part.
    pub marks_left_out: bool,
}

/// What the name of an instant-ngp mask begins with.
const DYNAMIC: &str = "dynamic_mask_";

/// A file that is a mask by its place.
struct Placed {
    /// Its number among the files.
    file: usize,
    /// The folder that its photo is in or under, parts in lower case.
    around: Vec<String>,
    /// The end of the photo's path, with or without its extension, parts in lower case.
    tail: Vec<String>,
}

/// The masks among files, by the photos that they are of.
pub(super) struct Masks<'a> {
    paths: Vec<&'a str>,
    /// By the last part of the photo's path, with or without its extension.
    placed: HashMap<String, Vec<Placed>>,
    /// Pictures by the last part of their path.
    pictures: HashMap<String, Vec<usize>>,
}

impl<'a> Masks<'a> {
    /// The masks among the files of these paths; those in folders of masks where these count.
    pub(super) fn of(paths: impl Iterator<Item = &'a str>, in_folders: bool) -> Self {
        let paths: Vec<&str> = paths.filter(|path| names::is_photo(path)).collect();
        let mut masks = Self { paths, placed: HashMap::new(), pictures: HashMap::new() };
        for (file, path) in masks.paths.iter().enumerate() {
            let parts = parts(path);
            if let Some(last) = parts.last() {
                masks.pictures.entry(last.clone()).or_default().push(file);
            }
            if let Some((around, tail)) = placed(parts, in_folders)
                && let Some(last) = tail.last().cloned()
            {
                masks.placed.entry(last).or_default().push(Placed { file, around, tail });
            }
        }
        masks
    }

    /// The masks that lie where masks of other files lie: these are no photos.
    pub(super) fn placed(&self) -> impl Iterator<Item = &'a str> {
        let photos = self.paths.iter().filter_map(|photo| self.at_place(photo));
        let beside = photos.map(|(file, _)| self.paths[file]);
        let in_folders = self.placed.values().flatten();
        let in_folders = in_folders.map(|one| self.paths[one.file]).filter(|path| is_aside(path));
        beside.chain(in_folders)
    }

    /// The mask of a photo by the name that its camera gives it; the photos of `used` are none.
    pub(super) fn named(&self, name: &str, used: impl Fn(&str) -> bool) -> Option<&'a str> {
        let wanted = parts(name);
        let agree = |file: &&usize| {
            let own = parts(self.paths[**file]);
            own.iter().rev().zip(wanted.iter().rev()).take_while(|(a, b)| a == b).count()
        };
        let found = self.pictures.get(wanted.last()?)?.iter();
        let found = found.filter(|file| !used(self.paths[**file])).max_by_key(agree)?;
        // A folder's name at least: a depth map often has the name of the photo, too.
        (agree(&found) >= wanted.len().min(2)).then(|| self.paths[*found])
    }

    /// The mask that lies where that of the photo would, and whether it marks what is left out.
    pub(super) fn of_photo(&self, photo: &str) -> Option<(&'a str, bool)> {
        let (file, marks) = self.at_place(photo)?;
        Some((self.paths[file], marks))
    }

    fn at_place(&self, photo: &str) -> Option<(usize, bool)> {
        let whole = parts(photo);
        let mut bare = whole.clone();
        let last = bare.last_mut()?;
        *last = names::stem(last)?.to_owned();
        let fits = |photo: &[String]| {
            let of_name = self.placed.get(photo.last()?)?.iter();
            let fitting = of_name.filter(|one| {
                photo.ends_with(&one.tail)
                    && photo.starts_with(&one.around)
                    && photo.len() >= one.around.len() + one.tail.len()
                    && parts(self.paths[one.file]) != whole
            });
            let nearest = fitting.max_by_key(|one| one.around.len() + one.tail.len())?;
            let name = names::file_name(self.paths[nearest.file]).to_lowercase();
            Some((nearest.file, name.starts_with(DYNAMIC)))
        };
        fits(&whole).or_else(|| fits(&bare))
    }
}

/// The parts of a path, in the loosest spelling.
fn parts(path: &str) -> Vec<String> {
    Spelling::Decoded.parts(path)
}

/// Whether a folder holds masks by its name.
fn is_mask_folder(name: &str) -> bool {
    let rest = name.strip_prefix("mask").map(|rest| rest.strip_prefix('s').unwrap_or(rest));
    let number = rest.map(|rest| rest.strip_prefix('_').unwrap_or(rest));
    number.is_some_and(|number| number.bytes().all(|byte| byte.is_ascii_digit()))
}

fn is_aside(path: &str) -> bool {
    let parts = parts(path);
    parts[..parts.len().saturating_sub(1)].iter().any(|part| is_mask_folder(part))
}

/// Where the photo of a mask is: the folder that it is in or under, and the end of its path.
fn placed(mut parts: Vec<String>, in_folders: bool) -> Option<(Vec<String>, Vec<String>)> {
    let last = parts.pop()?;
    let stem = names::stem(&last)?.to_owned();
    if let Some(at) = parts.iter().rposition(|part| is_mask_folder(part)).filter(|_| in_folders) {
        let mut tail = parts.split_off(at + 1);
        parts.pop();
        tail.push(stem);
        return Some((parts, tail));
    }
    let name = stem.strip_prefix(DYNAMIC)?.to_owned();
    Some((parts, vec![name]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_are_found_where_programs_put_them() {
        for (photo, mask, marks) in [
            ("images/0.jpg", "masks/0.png", false),
            ("images/0.jpg", "masks/0.jpg.png", false),
            ("images/a/0.jpg", "masks/a/0.png", false),
            ("images_2/0.JPG", "masks_2/0.png", false),
            ("rig/cam0/images/0.png", "rig/cam0/mask/0.png", false),
            ("0.jpg", "Masks/0.PNG", false),
            ("images/0.jpg", "images/dynamic_mask_0.png", true),
        ] {
            let others = ["depth/0.png", "images/1.jpg", "masks/10.png", "b/masks/c/0.png"];
            let masks = Masks::of(others.into_iter().chain([photo, mask]), true);
            assert_eq!(masks.of_photo(photo), Some((mask, marks)), "{photo}");
            assert!(masks.placed().any(|path| path == mask), "{mask}");
            assert!(masks.placed().all(|path| path != photo), "{mask}");
        }
        let none = ["images/0.jpg", "depth/0.png", "masks/1.png", "b/masks/0.png", "masked/0.png"];
        assert_eq!(Masks::of(none.into_iter(), true).of_photo("images/0.jpg"), None);
        // Where folders do not count.
        let labels = ["images/0.jpg", "masks/0.png"];
        assert_eq!(Masks::of(labels.into_iter(), false).of_photo("images/0.jpg"), None);
        // That of its own folder and of its whole name first.
        let both = ["masks/0.png", "masks/a/0.png", "masks/a/0.jpg.png"];
        assert_eq!(
            Masks::of(both.into_iter(), true).of_photo("images/a/0.jpg"),
            Some(("masks/a/0.jpg.png", false))
        );
    }

    #[test]
    fn a_camera_names_a_mask_by_the_end_of_its_path() {
        let files = ["images/0.png", "depth/0.png", "x/alpha/0.png", "ego.png"];
        let masks = Masks::of(files.into_iter(), false);
        let named = |name| masks.named(name, |path| path == "images/0.png");
        assert_eq!(named("C:\\data\\alpha\\0.png"), Some("x/alpha/0.png"));
        assert_eq!(named("./ego.png"), Some("ego.png"));
        for absent in ["masks/0.png", "images/0.png", "alpha/1.png", ""] {
            assert_eq!(named(absent), None, "{absent}");
        }
    }
}
