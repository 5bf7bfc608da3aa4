//! Which photo a camera means: the one place that compares names.
//!
//! A camera file names photos as its program saw them, perhaps on another machine: `C:\rig\0.jpg`,
//! `file:///home/x/images/0.jpg`, `../images/0.jpg`. Of such a name only the tail can fit, so the
//! photo with the longest common tail of whole parts is meant. Parts are compared in levels, from
//! strict to loose; a level sees only cameras and photos that the levels before it left over:
//!
//! 1. as written; 2. in one Unicode form (NFC); 3. in lower case; 4. decoded (percent, RFC 2047).
//!    In each of them first with the same extension, then where the camera has none.
//! 5. With another extension (a camera of `IMG_1.HEIC`, a photo `IMG_1.jpg`).

mod spelling;
mod tails;

use std::collections::{HashMap, HashSet};

pub use self::spelling::decoded;
pub(crate) use self::{spelling::Spelling, tails::Tails};
use crate::{
    error::{Error, Result},
    limits::Limits,
    scene::{SentFile, photo_label as label},
};

/// Extensions of photos, which are also tried where a camera's file has none, as instant-ngp does.
/// What a file is its bytes say.
const EXTENSIONS: [&str; 9] = ["png", "jpg", "jpeg", "jfif", "jpe", "webp", "tif", "tiff", "bmp"];
/// Extensions of photos that are not read, where the file holds what its name says.
const OTHERS: [&str; 12] =
    ["heic", "heif", "hif", "avif", "jxl", "jp2", "gif", "dng", "cr2", "cr3", "nef", "arw"];

/// A relative path with `/` between parts, or `None` when it is empty, absolute, holds a NUL or
/// leaves the folder.
pub(crate) fn normalise(name: &str) -> Option<String> {
    let slashed = name.replace('\\', "/");
    let drive = slashed.as_bytes().get(1) == Some(&b':');
    if slashed.starts_with('/') || slashed.contains('\0') || drive {
        return None;
    }
    let mut parts: Vec<&str> = Vec::new();
    for part in slashed.split('/') {
        match part {
            "" | "." => {}
            ".." => return None,
            part => parts.push(part),
        }
    }
    (!parts.is_empty()).then(|| parts.join("/"))
}

/// The paths of the files of a form, each within the limit, inside the folder and there once;
/// without the encodings of HTTP clients where `decode`.
///
/// # Errors
/// `invalid_request`, `limit_exceeded`, each names the file.
pub(crate) fn paths(files: &[SentFile<'_>], decode: bool, limits: &Limits) -> Result<Vec<String>> {
    let mut seen = HashSet::new();
    let path = |(i, file): (usize, &SentFile<'_>)| {
        let what = label(i, file.name);
        let (bytes, max) = (file.name.len(), limits.file_name_bytes_max);
        if bytes > max {
            return Err(Error::limit(format!("{what}: bytes of the file name"), bytes, max));
        }
        let name = if decode { decoded(file.name) } else { None };
        let path = normalise(name.as_deref().unwrap_or(file.name)).ok_or_else(|| {
            let why = "the path must be relative and stay inside the folder";
            Error::invalid(format!("{what}: {why}"))
        })?;
        if !seen.insert(file.name.to_owned()) {
            let why = "two photos have this name; send paths as in the camera file";
            return Err(Error::invalid(format!("{what}: {why}")));
        }
        Ok(path)
    };
    files.iter().enumerate().map(path).collect()
}

/// Whether the name has the extension of a photo.
pub(crate) fn is_photo(path: &str) -> bool {
    stem(path).is_some()
}

/// Whether the name has the extension of a photo of a format that is not read.
pub(crate) fn is_other_photo(path: &str) -> bool {
    let extension = path.rsplit_once('.').map_or("", |(_, extension)| extension);
    OTHERS.iter().any(|other| extension.eq_ignore_ascii_case(other))
}

/// The folder of a file, without a slash at its end; empty at the top.
pub(crate) fn folder(path: &str) -> &str {
    path.rsplit_once('/').map_or("", |(folder, _)| folder)
}

/// A file in a folder.
pub(crate) fn join(folder: &str, file: &str) -> String {
    if folder.is_empty() { file.to_owned() } else { format!("{folder}/{file}") }
}

/// The last part of a path.
pub(crate) fn file_name(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or(path)
}

/// The path without a photo's extension; `None` for other files.
pub(crate) fn stem(path: &str) -> Option<&str> {
    let (stem, extension) = path.rsplit_once('.')?;
    EXTENSIONS.iter().any(|e| extension.eq_ignore_ascii_case(e)).then_some(stem)
}

/// The path without an extension of any kind; a number after a dot is no extension.
fn without_extension(name: &str) -> &str {
    match name.rsplit_once('.') {
        Some((stem, extension))
            if !stem.is_empty()
                && (1..=5).contains(&extension.len())
                && extension.bytes().all(|byte| byte.is_ascii_alphanumeric())
                && !extension.bytes().all(|byte| byte.is_ascii_digit()) =>
        {
            stem
        }
        _ => name,
    }
}

/// How the extensions of a camera's file and of a photo are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ending {
    /// They are the same.
    Same,
    /// The camera has none.
    Absent,
    /// They differ.
    Other,
}

impl Ending {
    /// The parts of a camera's path as this level compares them; none where it does not apply.
    pub(crate) fn of_camera(self, mut parts: Vec<String>) -> Vec<String> {
        let Some(last) = parts.last_mut() else { return parts };
        match self {
            Self::Same => {}
            Self::Absent if is_photo(last) => return Vec::new(),
            Self::Absent => {}
            Self::Other => *last = without_extension(last).to_owned(),
        }
        parts
    }

    /// The parts of a photo's path as this level compares them.
    pub(crate) fn of_photo(self, mut parts: Vec<String>) -> Vec<String> {
        if let (Self::Absent | Self::Other, Some(last)) = (self, parts.last_mut()) {
            let is_other = is_other_photo(last);
            let bare = if is_other { Some(without_extension(last)) } else { stem(last) };
            *last = bare.unwrap_or(last).to_owned();
        }
        parts
    }
}

/// The levels, strict ones first.
const LEVELS: [(Spelling, Ending); 9] = [
    (Spelling::Written, Ending::Same),
    (Spelling::Written, Ending::Absent),
    (Spelling::Unicode, Ending::Same),
    (Spelling::Unicode, Ending::Absent),
    (Spelling::Case, Ending::Same),
    (Spelling::Case, Ending::Absent),
    (Spelling::Decoded, Ending::Same),
    (Spelling::Decoded, Ending::Absent),
    (Spelling::Decoded, Ending::Other),
];

/// For each wanted path the index of the sent file, or `None` where it was not sent.
///
/// Longer tails are settled first for all, so that a shared file name never steals a photo.
///
/// # Errors
/// `invalid_request` where two cameras claim one file, or two files fit one camera.
pub(crate) fn matched(wanted: &[&str], sent: &[&str]) -> Result<Vec<Option<usize>>> {
    let mut pairing =
        Pairing { wanted, sent, found: vec![None; wanted.len()], taken: vec![None; sent.len()] };
    for (spelling, ending) in LEVELS {
        if pairing.found.iter().all(Option::is_some) {
            break;
        }
        pairing.settle(spelling, ending)?;
    }
    pairing.check_doubles()?;
    Ok(pairing.found)
}

/// Cameras and photos, and who has whom.
struct Pairing<'a> {
    wanted: &'a [&'a str],
    sent: &'a [&'a str],
    /// The photo of each camera.
    found: Vec<Option<usize>>,
    /// The camera of each photo.
    taken: Vec<Option<usize>>,
}

impl Pairing<'_> {
    /// Finds photos for the cameras that have none, at one level.
    fn settle(&mut self, spelling: Spelling, ending: Ending) -> Result<()> {
        let cameras: Vec<Vec<String>> =
            self.wanted.iter().map(|name| ending.of_camera(spelling.parts(name))).collect();
        let photos: Vec<Vec<String>> =
            self.sent.iter().map(|name| ending.of_photo(spelling.parts(name))).collect();
        let free = (0..photos.len()).filter(|s| self.taken[*s].is_none());
        let mut tails = Tails::new(free.map(|s| (s, &photos[s][..])));
        // In a rig, where cameras name one file in several folders, no folder that they name stands
        // for another.
        let folder = |parts: &[String]| parts.len().checked_sub(2).map(|at| parts[at].clone());
        let named: HashSet<String> = cameras.iter().filter_map(|parts| folder(parts)).collect();
        let files: HashSet<&String> = cameras.iter().filter_map(|parts| parts.last()).collect();
        let all: HashSet<&[String]> = cameras.iter().map(Vec::as_slice).collect();
        let is_rig = files.len() < all.iter().filter(|parts| !parts.is_empty()).count();
        let is_of_another = |camera: usize, photo: usize, length: usize| {
            let (camera, photo) = (folder(&cameras[camera]), folder(&photos[photo]));
            let differ = camera.is_some() && camera != photo;
            is_rig && length == 1 && differ && photo.is_some_and(|photo| named.contains(&photo))
        };
        let mut open: Vec<(usize, Vec<usize>)> = (0..cameras.len())
            .filter(|w| self.found[*w].is_none())
            .map(|w| (w, tails.walk(&cameras[w])))
            .collect();
        let longest = open.iter().map(|(_, nodes)| nodes.len()).max().unwrap_or(0);
        for length in (1..=longest).rev() {
            // Whom the others left only one photo finds it in the second round.
            for last in [false, true] {
                let mut claims: Vec<(usize, usize)> = Vec::new();
                for (w, nodes) in &open {
                    let Some(&node) = nodes.get(length - 1) else { continue };
                    match tails.free(node)[..] {
                        [] => {}
                        [s] if is_of_another(*w, s, length) => {}
                        [s] => claims.push((*w, s)),
                        [a, b, ..] if last => {
                            return Err(Error::invalid(format!(
                                "the camera of {:?} fits two photos, {:?} and {:?}",
                                self.wanted[*w], self.sent[a], self.sent[b]
                            )));
                        }
                        _ => {}
                    }
                }
                // Whose whole path is the tail comes first.
                claims.sort_by_key(|(w, _)| cameras[*w].len() > length);
                for (w, s) in claims {
                    if let Some(other) = self.taken[s] {
                        let is_whole = |w: usize| cameras[w].len() == length;
                        if is_whole(other) && !is_whole(w) {
                            continue;
                        }
                        return Err(self.two_cameras(s, other, w));
                    }
                    (self.taken[s], self.found[w]) = (Some(w), Some(s));
                    tails.take(s);
                }
                open.retain(|(w, _)| self.found[*w].is_none());
            }
        }
        Ok(())
    }

    fn two_cameras(&self, photo: usize, a: usize, b: usize) -> Error {
        Error::invalid(format!(
            "photo {:?} has two cameras, {:?} (number {a}) and {:?} (number {b}); send its path as \
             in the camera file",
            self.sent[photo], self.wanted[a], self.wanted[b]
        ))
    }

    /// Refuses a second camera of the path that another camera found its photo by.
    fn check_doubles(&self) -> Result<()> {
        let places: HashMap<Vec<String>, usize> = (self.sent.iter().enumerate())
            .map(|(s, name)| (Spelling::Written.parts(name), s))
            .collect();
        for (w, name) in self.wanted.iter().enumerate() {
            if self.found[w].is_none()
                && let Some(&s) = places.get(&Spelling::Written.parts(name))
                && let Some(other) = self.taken[s]
            {
                return Err(self.two_cameras(s, other, w));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
