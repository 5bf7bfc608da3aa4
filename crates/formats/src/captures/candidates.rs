//! Which cameras of a folder make the scene. Beside a capture lie the capture it was made from,
//! several models of it, undistorted copies with their own cameras, and what trainings wrote.
//!
//! All cameras are read and paired with photos. Those are best whose sizes are those of the photos,
//! then those of most photos, then those of the better layout ([`Seen::class`]), then those with
//! the fewest folders around them. What was seen beside them is a warning. Two captures of other
//! photos that are about as good are refused.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BTreeSet, HashSet},
};

use super::{
    cameras::{CameraEntry, Cameras},
    folder::Folder,
    layouts::{self, Seen},
    lens::Sizes,
    names,
    places::{self, Place},
};
use crate::{
    error::{Error, Result},
    scene::{LengthUnit, Warning, WarningCode},
};

/// Cameras of a folder that are read.
const READ_MAX: usize = 16;
/// Cameras that one message names.
const NAMED_MAX: usize = 3;

/// The places of a camera and of its photo.
pub(super) type Pair = (usize, usize);

/// Cameras with the photo of each, and cameras without one.
pub(super) fn paired(entries: &[CameraEntry], sent: &[&str]) -> Result<(Vec<Pair>, Vec<usize>)> {
    let wanted: Vec<&str> = entries.iter().map(|entry| entry.file.as_str()).collect();
    let files = names::matched(&wanted, sent)?;
    let pairs = files.iter().enumerate().filter_map(|(i, file)| Some((i, (*file)?))).collect();
    let missing = (0..files.len()).filter(|i| files[*i].is_none()).collect();
    Ok((pairs, missing))
}

/// Cameras of a folder, and the photos of them.
pub(super) struct Candidate {
    seen: Seen,
    pub(super) entries: Vec<CameraEntry>,
    pub(super) held_out: Vec<String>,
    /// Keys of the camera file that are not read.
    pub(super) unread: BTreeSet<String>,
    pub(super) place: Place,
    /// Paths of the photos, from the top of the place.
    pub(super) sent: Vec<String>,
    pub(super) pairs: Vec<Pair>,
    /// Cameras without photo.
    pub(super) missing: Vec<usize>,
    /// Files of cameras that were read from a disk.
    pub(super) files: BTreeMap<String, Vec<u8>>,
}

impl Candidate {
    /// Reads cameras and finds their photos; `tests` are names of photos that are kept for tests.
    fn read(folder: &Folder<'_>, seen: &Seen, tests: &HashSet<String>) -> Result<Self> {
        folder.take_cameras_read();
        let described = seen.layout.read(folder, &seen.at)?;
        let files = folder.take_cameras_read();
        let Cameras { mut entries, mut held_out, unread } = described.cameras;
        entries.retain(|entry| {
            let kept = !tests.contains(names::file_name(&entry.file));
            if !kept {
                held_out.push(entry.file.clone());
            }
            kept
        });
        if entries.len() > folder.limits.archive_entries_max {
            let what = format!("{}: cameras", folder.what);
            return Err(Error::limit(what, entries.len(), folder.limits.archive_entries_max));
        }
        let place = places::find(folder, &described.root, &entries)?;
        let inside = |path: &'_ str| {
            let is_there = folder.is_photo(path) && place.dirs.contains(names::folder(path));
            let rest = path.strip_prefix(&place.top).unwrap_or(path);
            is_there.then(|| rest.trim_start_matches('/').to_owned())
        };
        let sent: Vec<String> = folder.paths().filter_map(inside).collect();
        let names: Vec<&str> = sent.iter().map(String::as_str).collect();
        let (pairs, missing) = paired(&entries, &names)?;
        let seen = seen.clone();
        Ok(Self { seen, entries, held_out, unread, place, sent, pairs, missing, files })
    }

    /// Whether a folder `masks` beside its photos holds their masks.
    pub(super) fn has_mask_folder(&self) -> bool {
        self.seen.layout.has_mask_folder()
    }

    /// What a unit of its poses is.
    pub(super) fn unit(&self) -> LengthUnit {
        self.seen.layout.unit()
    }

    /// How good it is beside one with `most` photos.
    fn rank(&self, most: usize) -> impl Ord + use<> {
        let (photos, held) = (self.pairs.len(), self.held_out.len());
        let Seen { class, .. } = self.seen;
        let depth = Reverse(self.seen.depth());
        (photos > 0, 2 * photos >= most, self.place.sizes, photos + held, Reverse(class), depth)
    }

    /// Names of its photos in lower case, without folders and extensions.
    fn stems(&self) -> HashSet<String> {
        let name = |(_, file): &Pair| names::file_name(&self.sent[*file]).to_lowercase();
        let stem = |pair: &Pair| {
            let name = name(pair);
            names::stem(&name).unwrap_or(&name).to_owned()
        };
        self.pairs.iter().map(stem).collect()
    }

    /// Whether it describes other photos, and nothing says that they are of the same capture.
    fn is_another_capture(&self, other: &Self) -> bool {
        let model = |seen: &Seen| -> Vec<String> {
            let parts = seen.at.split('/').filter(|part| part.parse::<u32>().is_err());
            parts.map(str::to_owned).collect()
        };
        let is_less = 2 * other.pairs.len() < self.pairs.len()
            || other.place.sizes < self.place.sizes.min(Sizes::Scaled);
        let is_of_same = !self.place.dirs.is_disjoint(&other.place.dirs);
        if is_less || is_of_same || other.pairs.is_empty() {
            return false;
        }
        if self.seen.class == other.seen.class
            && self.seen.layout.name() == other.seen.layout.name()
        {
            // `dense/sparse` is a model of what `sparse/0` is one of.
            let (own, of_other) = (model(&self.seen), model(&other.seen));
            let is_of_same = own.ends_with(&of_other) || of_other.ends_with(&own);
            return self.seen.depth() == other.seen.depth() && !is_of_same;
        }
        let (own, of_other) = (self.stems(), other.stems());
        2 * own.intersection(&of_other).count() < of_other.len()
    }

    fn shown(&self) -> String {
        let size = match self.place.sizes {
            _ if self.pairs.is_empty() => "",
            Sizes::Contradict => " of another aspect",
            Sizes::Scaled => " of another size",
            Sizes::Unknown | Sizes::Fit => "",
        };
        format!(
            "{} ({}, {} photos{size})",
            at(&self.seen),
            self.seen.layout.name(),
            self.pairs.len()
        )
    }
}

fn at(seen: &Seen) -> String {
    if seen.at.is_empty() { "the top folder".to_owned() } else { format!("{:?}", seen.at) }
}

/// The best cameras of a folder.
pub(super) struct Best {
    pub(super) candidate: Candidate,
    /// What else was seen, where there was something.
    pub(super) warning: Option<Warning>,
}

/// The best cameras of a folder.
///
/// # Errors
/// `invalid_request` where there are none or two captures, and as the readers.
pub(super) fn best(folder: &Folder<'_>, tests: &HashSet<String>) -> Result<Best> {
    let seen = layouts::find(folder);
    let (mut read, mut failed) = (Vec::new(), Vec::new());
    for seen in seen.iter().take(READ_MAX) {
        match Candidate::read(folder, seen, tests) {
            Ok(candidate) => read.push(candidate),
            Err(error) => failed.push((seen, error)),
        }
    }
    let most = read.iter().map(|candidate| candidate.pairs.len()).max().unwrap_or(0);
    // Of equal ones the first by path.
    read.sort_by_cached_key(|one| (Reverse(one.rank(most)), one.seen.at.clone()));
    let mut read = read.into_iter();
    let Some(best) = read.next() else { return Err(none(folder, failed)) };
    let others: Vec<Candidate> = read.collect();
    if best.pairs.is_empty() && !failed.is_empty() {
        return Err(none(folder, failed));
    }
    if let Some(other) = others.iter().find(|other| best.is_another_capture(other)) {
        return Err(Error::invalid(format!(
            "{}: two captures of other photos, {} and {}; a scene is made of one",
            folder.what,
            best.shown(),
            other.shown()
        )));
    }
    let count = seen.len() - 1;
    let not_read = failed.iter().map(|(seen, error)| {
        let why: String = error.message().chars().take(120).collect();
        format!("{} ({}, not read: {why})", at(seen), seen.layout.name())
    });
    let named: Vec<String> =
        not_read.chain(others.iter().map(Candidate::shown)).take(NAMED_MAX).collect();
    let more = count.saturating_sub(named.len());
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    let warning = (count > 0).then(|| Warning {
        code: WarningCode::CamerasChosen,
        message: format!("cameras from {}; also seen: {}{more}", best.shown(), named.join(", ")),
        value: count as f64,
    });
    Ok(Best { candidate: best, warning })
}

/// The error where no cameras can be read.
fn none(folder: &Folder<'_>, failed: Vec<(&Seen, Error)>) -> Error {
    let Some((_, first)) = failed.first() else {
        return Error::invalid(layouts::none(folder));
    };
    if failed.len() == 1 {
        let (_, error) = failed.into_iter().next().expect("there is one; this is a bug");
        return error;
    }
    let why = |(seen, error): &(&Seen, Error)| {
        let why: String = error.message().chars().take(120).collect();
        format!("{} ({}): {why}", at(seen), seen.layout.name())
    };
    let named: Vec<String> = failed.iter().take(NAMED_MAX).map(why).collect();
    let message = format!(
        "{}: {} camera files, none of which can be used: {}",
        folder.what,
        failed.len(),
        named.join("; ")
    );
    Error::new(first.code(), message)
}
