//! Zip and tar, unpacked in memory. Entries are counted, names are checked, and sizes are limited
//! while bytes are read.

use std::{
    collections::HashMap,
    io::{Cursor, Read},
};

use zip::{ZipReadOptions, unstable::read::ZipIterable};

use super::{CAMERA_FILES, cameras_named, names};
use crate::{
    error::{Error, Result},
    limits::Limits,
    scene::{Upload, UploadFile},
};

/// What packers that are not read begin with, and their names.
const PACKED: [(&[u8], &str); 6] = [
    (b"\x1F\x8B", "gzip"),
    (b"BZh", "bzip2"),
    (b"\xFD7zXZ\0", "xz"),
    (b"\x28\xB5\x2F\xFD", "zstd"),
    (b"7z\xBC\xAF\x27\x1C", "7-Zip"),
    (b"Rar!", "RAR"),
];

/// The cameras and files of an archive of one folder.
///
/// # Errors
/// `photo_unreadable` when it is no archive or damaged, `invalid_request` for names that leave it
/// or links, `limit_exceeded` for too many entries or bytes.
pub(super) fn unpack(bytes: &[u8], limits: &Limits) -> Result<Upload> {
    let files = match bytes {
        [b'P', b'K', ..] => unzip(bytes, limits)?,
        _ if bytes.get(257..262) == Some(b"ustar") => untar(bytes, limits)?,
        _ => {
            let known = PACKED.iter().find(|(start, _)| bytes.starts_with(start));
            return Err(Error::photo(match known {
                Some((_, by)) => format!("archive: packed by {by}; send a zip or a plain tar"),
                None => "archive: neither a zip nor a tar file".to_owned(),
            }));
        }
    };
    folder(files)
}

/// Takes the camera file out; its folder is what the photos' paths are relative to.
fn folder(mut files: HashMap<String, Vec<u8>>) -> Result<Upload> {
    let mut found: Vec<&String> = files
        .keys()
        .filter(|path| CAMERA_FILES.contains(&path.rsplit('/').next().unwrap_or(path)))
        .collect();
    found.sort();
    let chosen = match found[..] {
        [] => return Err(Error::invalid("archive: no transforms.json and no cameras.json in it")),
        [one] => one.clone(),
        [first, second, ..] => {
            return Err(Error::invalid(format!(
                "archive: two camera files, {first:?} and {second:?}; a scene has one"
            )));
        }
    };
    let (root, name) = match chosen.rsplit_once('/') {
        Some((root, name)) => (format!("{root}/"), name.to_owned()),
        None => (String::new(), chosen.clone()),
    };
    let json = files.remove(&chosen).unwrap_or_default();
    let mut photos: Vec<UploadFile> = files
        .into_iter()
        .filter_map(|(path, bytes)| {
            let name = path.strip_prefix(&root)?.to_owned();
            Some(UploadFile { name, bytes })
        })
        .collect();
    photos.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(Upload { cameras: Some(cameras_named(&name, json)), photos, ..Upload::default() })
}

/// Counts entries and bytes of one archive against the limits.
struct Budget<'a> {
    limits: &'a Limits,
    entries: usize,
    bytes: u64,
}

impl<'a> Budget<'a> {
    fn new(limits: &'a Limits) -> Self {
        Self { limits, entries: 0, bytes: 0 }
    }

    /// Counts an entry and checks its name; the path of a file to read, `None` for what is skipped.
    fn entry(&mut self, name: &[u8], link: bool, folder: bool) -> Result<Option<String>> {
        self.entries += 1;
        if self.entries > self.limits.archive_entries_max {
            let max = self.limits.archive_entries_max;
            return Err(Error::limit("archive: entries", format!("more than {max}"), max));
        }
        let name = std::str::from_utf8(name).map_err(|e| {
            Error::invalid(format!("archive: the name of entry {} is not UTF-8", self.entries))
                .caused_by(e)
        })?;
        let shown: String = name.chars().take(80).collect();
        if name.len() > self.limits.file_name_bytes_max {
            let what = format!("archive: bytes of the name {shown:?}");
            return Err(Error::limit(what, name.len(), self.limits.file_name_bytes_max));
        }
        if link {
            return Err(Error::invalid(format!(
                "archive: {shown:?} is a link; only files may be in it"
            )));
        }
        let path = match names::normalise(name) {
            Some(path) => path,
            // The folder itself, as `tar -C folder .` writes it.
            None if folder && matches!(name, "." | "./") => return Ok(None),
            None => {
                return Err(Error::invalid(format!(
                    "archive: {shown:?} must be a relative path that stays inside the folder"
                )));
            }
        };
        let file = path.rsplit('/').next().unwrap_or(&path);
        let left_by_macos = path.starts_with("__MACOSX/") || file.starts_with("._");
        Ok((!folder && !left_by_macos).then_some(path))
    }

    /// Reads one file whole. The size in its header must be left in the budget. Not one byte more
    /// is unpacked.
    fn read(&mut self, path: &str, claimed: u64, from: impl Read) -> Result<Vec<u8>> {
        let max = self.limits.archive_unpacked_bytes_max;
        let left = max - self.bytes;
        let over = |bytes: String| {
            Error::limit(format!("archive: unpacked bytes at {path:?}"), bytes, max)
        };
        if claimed > left {
            return Err(over((self.bytes.saturating_add(claimed)).to_string()));
        }
        let mut bytes = Vec::new();
        from.take(claimed.saturating_add(1)).read_to_end(&mut bytes).map_err(|e| {
            Error::photo(format!("archive: {path:?} is damaged or cut short")).caused_by(e)
        })?;
        if bytes.len() as u64 > claimed {
            return Err(Error::photo(format!(
                "archive: {path:?} holds more than the {claimed} bytes that its header says"
            )));
        }
        self.bytes += bytes.len() as u64;
        Ok(bytes)
    }
}

fn insert(files: &mut HashMap<String, Vec<u8>>, path: String, bytes: Vec<u8>) -> Result<()> {
    if files.contains_key(&path) {
        return Err(Error::invalid(format!("archive: two entries are called {path:?}")));
    }
    files.insert(path, bytes);
    Ok(())
}

fn unzip(bytes: &[u8], limits: &Limits) -> Result<HashMap<String, Vec<u8>>> {
    let damaged = |e| Error::photo("archive: the zip is damaged or cut short").caused_by(e);
    // Unlike `ZipArchive` it reads no entry in `try_new`, so the number of entries, in ZIP64 too,
    // is checked first. It also keeps entries that share a name.
    let config = zip::read::Config::default();
    let mut zip = ZipIterable::try_new(Cursor::new(bytes), config).map_err(damaged)?;
    if zip.len() > limits.archive_entries_max {
        return Err(Error::limit("archive: entries", zip.len(), limits.archive_entries_max));
    }
    let mut budget = Budget::new(limits);
    let mut wanted = Vec::new();
    // All names and claims are checked before anything is unpacked.
    let mut claimed_bytes = 0_u64;
    for entry in zip.files().map_err(damaged)? {
        let entry = entry.map_err(damaged)?;
        let name = entry.name().map_err(damaged)?;
        let path = budget.entry(name.as_bytes(), entry.is_symlink(), entry.is_dir())?;
        claimed_bytes = claimed_bytes.saturating_add(entry.size());
        if claimed_bytes > limits.archive_unpacked_bytes_max {
            let max = limits.archive_unpacked_bytes_max;
            return Err(Error::limit("archive: unpacked bytes", claimed_bytes, max));
        }
        if let Some(path) = path {
            if entry.encrypted() {
                return Err(Error::photo(format!("archive: {path:?} is encrypted")));
            }
            wanted.push((entry, path));
        }
    }
    let mut files = HashMap::new();
    let mut body = Cursor::new(bytes);
    for (entry, path) in wanted {
        let size = entry.size();
        let entry = entry.with_reader(&mut body, ZipReadOptions::new()).map_err(|e| {
            Error::photo(format!("archive: {path:?} is damaged or packed in an unknown way"))
                .caused_by(e)
        })?;
        let read = budget.read(&path, size, entry)?;
        insert(&mut files, path, read)?;
    }
    Ok(files)
}

fn untar(bytes: &[u8], limits: &Limits) -> Result<HashMap<String, Vec<u8>>> {
    use tar::EntryType;

    let damaged = |e| Error::photo("archive: the tar is damaged or cut short").caused_by(e);
    let mut budget = Budget::new(limits);
    let mut files = HashMap::new();
    let mut tar = tar::Archive::new(Cursor::new(bytes));
    for entry in tar.entries().map_err(damaged)? {
        let entry = entry.map_err(damaged)?;
        let kind = entry.header().entry_type();
        if kind == EntryType::XGlobalHeader {
            continue;
        }
        let file = matches!(kind, EntryType::Regular | EntryType::Continuous);
        let folder = kind == EntryType::Directory;
        let name = entry.path_bytes().into_owned();
        if let Some(path) = budget.entry(&name, !file && !folder, folder)? {
            let claimed = entry.size();
            let read = budget.read(&path, claimed, entry)?;
            if read.len() as u64 != claimed {
                return Err(Error::photo(format!("archive: {path:?} is cut short")));
            }
            insert(&mut files, path, read)?;
        }
    }
    Ok(files)
}
