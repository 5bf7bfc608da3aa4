//! Which file belongs to which camera: by path, then by file name, then without the extension.

use std::collections::{HashMap, HashSet};

use crate::{
    error::{Error, Result},
    limits::Limits,
    scene::{UploadFile, photo_label as label},
};

/// Extensions tried where a camera's file has none, as instant-ngp does.
const EXTENSIONS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

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

/// The paths of the files of a form, each within the limit, inside the folder and there once.
///
/// # Errors
/// `invalid_request`, `limit_exceeded`, each names the file.
pub(crate) fn paths(files: &[UploadFile], limits: &Limits) -> Result<Vec<String>> {
    let mut seen = HashSet::new();
    let path = |(i, file): (usize, &UploadFile)| {
        let what = label(i, &file.name);
        let (bytes, max) = (file.name.len(), limits.file_name_bytes_max);
        if bytes > max {
            return Err(Error::limit(format!("{what}: bytes of the file name"), bytes, max));
        }
        let path = normalise(&file.name).ok_or_else(|| {
            let why = "the path must be relative and stay inside the folder";
            Error::invalid(format!("{what}: {why}"))
        })?;
        if !seen.insert(file.name.clone()) {
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

/// The path that a camera file names. It may sit in a subfolder and point out of it: only the tail
/// counts then.
pub(crate) fn tail(wanted: &str) -> String {
    let tail = wanted.trim_start_matches("../");
    normalise(tail).unwrap_or_else(|| file_name(tail).to_owned())
}

/// For each wanted path the index of the sent file, or `None` where it was not sent.
///
/// Exact paths are settled first for all, so that a shared file name never steals a photo.
///
/// # Errors
/// `invalid_request` where two cameras claim one file, or two files fit one camera.
pub(crate) fn matched(wanted: &[&str], sent: &[&str]) -> Result<Vec<Option<usize>>> {
    let wanted_paths: Vec<String> = wanted.iter().map(|w| tail(w)).collect();
    let sent_paths: Vec<String> =
        sent.iter().map(|s| normalise(s).unwrap_or_else(|| (*s).to_owned())).collect();
    type Key = for<'a> fn(&'a str) -> Option<&'a str>;
    let levels: [(Key, Key); 4] = [
        (|w| Some(w), |s| Some(s)),
        (|w| Some(w), stem),
        (|w| Some(file_name(w)), |s| Some(file_name(s))),
        (|w| Some(file_name(w)), |s| stem(file_name(s))),
    ];
    let mut found: Vec<Option<usize>> = vec![None; wanted.len()];
    let mut taken: Vec<Option<usize>> = vec![None; sent.len()];
    for (level, (wanted_key, sent_key)) in levels.into_iter().enumerate() {
        let mut free: HashMap<&str, Vec<usize>> = HashMap::new();
        for (i, path) in sent_paths.iter().enumerate() {
            if taken[i].is_none()
                && let Some(key) = sent_key(path)
            {
                free.entry(key).or_default().push(i);
            }
        }
        let mut claims: Vec<(usize, usize)> = Vec::new();
        for (w, path) in wanted_paths.iter().enumerate() {
            let Some(fits) = wanted_key(path).and_then(|key| free.get(key)) else { continue };
            if found[w].is_some() {
                continue;
            }
            if let [first, second, ..] = fits[..] {
                return Err(Error::invalid(format!(
                    "the camera of {:?} fits two photos, {:?} and {:?}",
                    wanted[w], sent[first], sent[second]
                )));
            }
            claims.push((w, fits[0]));
        }
        for (w, s) in claims {
            if let Some(other) = taken[s] {
                let how = if level < 2 { "" } else { "; send its path as in the camera file" };
                return Err(Error::invalid(format!(
                    "photo {:?} has two cameras, {:?} (number {other}) and {:?} (number {w}){how}",
                    sent[s], wanted[other], wanted[w]
                )));
            }
            taken[s] = Some(w);
            found[w] = Some(s);
        }
    }
    // A second camera for a file that an exact path took.
    let places: HashMap<&str, usize> =
        sent_paths.iter().enumerate().map(|(s, path)| (path.as_str(), s)).collect();
    for (w, path) in wanted_paths.iter().enumerate() {
        if found[w].is_none()
            && let Some(&s) = places.get(path.as_str())
            && let Some(other) = taken[s]
        {
            return Err(Error::invalid(format!(
                "photo {:?} has two cameras, numbers {other} and {w}",
                sent[s]
            )));
        }
    }
    Ok(found)
}
