//! Which file belongs to which camera: by path, then by file name, then without the extension.

use std::collections::HashMap;

use crate::error::{Error, Result};

/// Extensions tried where a camera's file has none, as instant-ngp does.
const EXTENSIONS: [&str; 4] = ["png", "jpg", "jpeg", "webp"];

/// A relative path with `/` between parts, or `None` when it is empty, absolute, holds a NUL or
/// leaves the folder.
pub(super) fn normalise(name: &str) -> Option<String> {
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

/// The name itself, then the name with each known extension.
pub(super) fn with_extensions(name: &str) -> impl Iterator<Item = String> + '_ {
    std::iter::once(name.to_owned())
        .chain(EXTENSIONS.iter().map(move |ext| format!("{name}.{ext}")))
}

fn file_name(path: &str) -> &str {
    path.rsplit('/').next().unwrap_or(path)
}

/// The path without a photo's extension; `None` for other files.
fn stem(path: &str) -> Option<&str> {
    let (stem, extension) = path.rsplit_once('.')?;
    EXTENSIONS.iter().any(|e| extension.eq_ignore_ascii_case(e)).then_some(stem)
}

/// For each wanted path the index of the sent file, or `None` where it was not sent.
///
/// Exact paths are settled first for all, so that a shared file name never steals a photo.
///
/// # Errors
/// `invalid_request` where two cameras claim one file, or two files fit one camera.
pub(super) fn matched(wanted: &[&str], sent: &[&str]) -> Result<Vec<Option<usize>>> {
    let wanted_paths: Vec<String> = wanted
        .iter()
        .map(|w| {
            // A camera file may sit in a subfolder and point out of it: only the tail counts then.
            let tail = w.trim_start_matches("../");
            normalise(tail).unwrap_or_else(|| file_name(tail).to_owned())
        })
        .collect();
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
    for (w, path) in wanted_paths.iter().enumerate() {
        if found[w].is_none()
            && let Some(s) = sent_paths.iter().position(|s| s == path)
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
