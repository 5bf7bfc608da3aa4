//! The files of a capture wherever they are: in a folder, in a zip or tar, or as parts of a form.
//!
//! All names are known first; bytes are unpacked when they are asked for. Names are checked, and
//! sizes are limited while bytes are read.

use std::{
    borrow::Cow,
    cell::{Cell, RefCell},
    collections::BTreeMap,
    io::{Cursor, Read},
    path::{Path, PathBuf},
};

use zip::{ZipReadOptions, read::OwnedZipFileEntry, unstable::read::ZipIterable};

use super::names;
use crate::{
    error::{Error, Result, short},
    limits::Limits,
    scene::UploadFile,
};

/// Folders in folders that are looked into.
const DEPTH_MAX: usize = 8;

/// What packers that are not read begin with, and their names.
const PACKED: [(&[u8], &str); 6] = [
    (b"\x1F\x8B", "gzip"),
    (b"BZh", "bzip2"),
    (b"\xFD7zXZ\0", "xz"),
    (b"\x28\xB5\x2F\xFD", "zstd"),
    (b"7z\xBC\xAF\x27\x1C", "7-Zip"),
    (b"Rar!", "RAR"),
];

/// Files by path, `/` between its parts.
pub(crate) struct Folder<'a> {
    /// What it is in messages: `archive`, `upload`, or the path of a folder.
    pub(crate) what: String,
    files: BTreeMap<String, Stored>,
    source: Source<'a>,
    pub(crate) limits: &'a Limits,
    /// Bytes that were unpacked or read from a disk.
    unpacked: Cell<u64>,
    /// Files of cameras that were read from a disk.
    cameras_read: RefCell<BTreeMap<String, Vec<u8>>>,
}

/// A file that was not read yet.
#[derive(Clone, Copy)]
struct Stored {
    /// Bytes as listed.
    size: u64,
    /// Number of the entry, or where its bytes begin.
    at: usize,
}

enum Source<'a> {
    Form(&'a [UploadFile]),
    Tar(&'a [u8]),
    Zip(&'a [u8], Vec<OwnedZipFileEntry>),
    Disk(PathBuf),
}

impl<'a> Folder<'a> {
    /// The parts of a form, each with its path as name, without the encodings of HTTP clients where
    /// `decoded`.
    ///
    /// # Errors
    /// `invalid_request` for names that leave the folder or come twice, `limit_exceeded` for names
    /// that are too long.
    pub(crate) fn of_form(
        sent: &'a [UploadFile],
        decoded: bool,
        limits: &'a Limits,
    ) -> Result<Self> {
        let mut folder = Self::new("upload", Source::Form(sent), limits);
        for (at, (file, path)) in sent.iter().zip(names::paths(sent, decoded, limits)?).enumerate()
        {
            folder.insert(path, Stored { size: file.bytes.len() as u64, at })?;
        }
        Ok(folder)
    }

    /// The entries of a zip or a tar.
    ///
    /// # Errors
    /// `photo_unreadable` when it is no archive or damaged, `invalid_request` for names that leave
    /// it or links, `limit_exceeded` for too many entries or bytes.
    pub(crate) fn of_archive(bytes: &'a [u8], limits: &'a Limits) -> Result<Self> {
        match bytes {
            [b'P', b'K', ..] => Self::of_zip(bytes, limits),
            _ if bytes.get(257..262) == Some(b"ustar") => Self::of_tar(bytes, limits),
            _ => {
                let known = PACKED.iter().find(|(start, _)| bytes.starts_with(start));
                Err(Error::photo(match known {
                    Some((_, by)) => format!("archive: packed by {by}; send a zip or a plain tar"),
                    None => "archive: neither a zip nor a tar file".to_owned(),
                }))
            }
        }
    }

    fn of_zip(bytes: &'a [u8], limits: &'a Limits) -> Result<Self> {
        let damaged = |e| Error::photo("archive: the zip is damaged or cut short").caused_by(e);
        // Unlike `ZipArchive` it reads no entry in `try_new`, so the number of entries, in ZIP64
        // too, is checked first. It also keeps entries that share a name.
        let config = zip::read::Config::default();
        let mut zip = ZipIterable::try_new(Cursor::new(bytes), config).map_err(damaged)?;
        if zip.len() > limits.archive_entries_max {
            return Err(Error::limit("archive: entries", zip.len(), limits.archive_entries_max));
        }
        let mut folder = Self::new("archive", Source::Zip(bytes, Vec::new()), limits);
        let (mut count, mut claimed_bytes, mut entries) = (0, 0_u64, Vec::new());
        for entry in zip.files().map_err(damaged)? {
            let entry = entry.map_err(damaged)?;
            let name = entry.name().map_err(damaged)?;
            let kind = Kind { link: entry.is_symlink(), folder: entry.is_dir() };
            let path = entry_path(&mut count, name.as_bytes(), kind, limits)?;
            claimed_bytes = claimed_bytes.saturating_add(entry.size());
            let max = limits.archive_unpacked_bytes_max;
            if claimed_bytes > max {
                return Err(Error::limit("archive: unpacked bytes", claimed_bytes, max));
            }
            let Some(path) = path else { continue };
            if entry.encrypted() {
                return Err(Error::photo(format!("archive: {path:?} is encrypted")));
            }
            folder.insert(path, Stored { size: entry.size(), at: entries.len() })?;
            entries.push(OwnedZipFileEntry::from(entry));
        }
        folder.source = Source::Zip(bytes, entries);
        Ok(folder)
    }

    fn of_tar(bytes: &'a [u8], limits: &'a Limits) -> Result<Self> {
        use tar::EntryType;

        let damaged = |e| Error::photo("archive: the tar is damaged or cut short").caused_by(e);
        let mut folder = Self::new("archive", Source::Tar(bytes), limits);
        let mut count = 0;
        let mut tar = tar::Archive::new(Cursor::new(bytes));
        for entry in tar.entries_with_seek().map_err(damaged)? {
            let entry = entry.map_err(damaged)?;
            let kind = entry.header().entry_type();
            if kind == EntryType::XGlobalHeader {
                continue;
            }
            let file = matches!(kind, EntryType::Regular | EntryType::Continuous);
            let is_folder = kind == EntryType::Directory;
            let name = entry.path_bytes().into_owned();
            let kind = Kind { link: !file && !is_folder, folder: is_folder };
            let Some(path) = entry_path(&mut count, &name, kind, limits)? else { continue };
            let (size, begin) = (entry.size(), entry.raw_file_position());
            if size > limits.archive_unpacked_bytes_max {
                return Err(over(&path, size, limits));
            }
            let end = begin.saturating_add(size);
            let at = usize::try_from(begin).ok().filter(|_| end <= bytes.len() as u64);
            let at = at.ok_or_else(|| Error::photo(format!("archive: {path:?} is cut short")))?;
            folder.insert(path, Stored { size, at })?;
        }
        Ok(folder)
    }

    /// The files under a folder of this machine, which belongs to who asks: links are followed.
    /// Names that begin with a dot are left out.
    ///
    /// # Errors
    /// `invalid_request` where it cannot be listed, `limit_exceeded` for too many files.
    pub(crate) fn of_dir(dir: &Path, limits: &'a Limits) -> Result<Self> {
        let what = dir.display().to_string();
        let mut folder = Self::new(what.as_str(), Source::Disk(dir.to_owned()), limits);
        let mut open = vec![(String::new(), 0)];
        while let Some((inside, depth)) = open.pop() {
            let unlisted =
                |e| Error::invalid(format!("{what}: {inside:?} cannot be listed")).caused_by(e);
            for entry in fs_err::read_dir(dir.join(&inside)).map_err(unlisted)? {
                let entry = entry.map_err(unlisted)?;
                let name = entry.file_name();
                let Some(name) = name.to_str().filter(|name| !name.starts_with('.')) else {
                    continue;
                };
                let path =
                    if inside.is_empty() { name.to_owned() } else { format!("{inside}/{name}") };
                let Ok(meta) = fs_err::metadata(entry.path()) else { continue };
                if meta.is_dir() && depth < DEPTH_MAX {
                    open.push((path, depth + 1));
                } else if meta.is_file() {
                    folder.insert(path, Stored { size: meta.len(), at: 0 })?;
                }
                let (files, max) = (folder.files.len() + open.len(), limits.archive_entries_max);
                if files > max {
                    return Err(Error::limit("folder: files", format!("more than {max}"), max));
                }
            }
        }
        Ok(folder)
    }

    fn new(what: impl Into<String>, source: Source<'a>, limits: &'a Limits) -> Self {
        let (files, unpacked) = (BTreeMap::new(), Cell::new(0));
        Self {
            what: what.into(),
            files,
            source,
            limits,
            unpacked,
            cameras_read: RefCell::default(),
        }
    }

    fn insert(&mut self, path: String, file: Stored) -> Result<()> {
        let what = &self.what;
        if self.has(&path) {
            return Err(Error::invalid(format!("{what}: two entries are called {path:?}")));
        }
        self.files.insert(path, file);
        Ok(())
    }

    /// Whether it is the parts of a form.
    pub(crate) fn is_form(&self) -> bool {
        matches!(self.source, Source::Form(_))
    }

    /// All paths, sorted.
    pub(crate) fn paths(&self) -> impl Iterator<Item = &str> {
        self.files.keys().map(String::as_str)
    }

    /// Whether a file is a photo: by its extension; where that is none or of a format that is not
    /// read, by what the file holds.
    pub(crate) fn is_photo(&self, path: &str) -> bool {
        let may_be = names::is_other_photo(path) || !names::file_name(path).contains('.');
        names::is_photo(path) || may_be && self.head(path, 16).is_ok_and(|head| is_read(&head))
    }

    /// Whether there is a file of this path.
    pub(crate) fn has(&self, path: &str) -> bool {
        self.files.contains_key(path)
    }

    /// Bytes of a file as listed; an archive may lie.
    pub(crate) fn size(&self, path: &str) -> u64 {
        self.files.get(path).map_or(0, |file| file.size)
    }

    /// A file that describes cameras and is no JSON.
    ///
    /// # Errors
    /// As [`Self::read`]; `limit_exceeded` where it is too large.
    pub(crate) fn read_cameras(&self, path: &str) -> Result<Cow<'a, [u8]>> {
        self.read_up_to(path, self.limits.camera_file_bytes_max)
    }

    /// A file that describes cameras in JSON, its size and values within the limits.
    ///
    /// # Errors
    /// As [`Self::read`]; `limit_exceeded`.
    pub(crate) fn read_json(&self, path: &str) -> Result<Cow<'a, [u8]>> {
        let bytes = self.read_up_to(path, self.limits.json_bytes_max)?;
        self.limits.check_json(path, &bytes)?;
        Ok(bytes)
    }

    fn read_up_to(&self, path: &str, max: usize) -> Result<Cow<'a, [u8]>> {
        let size = self.size(path);
        if size > max as u64 {
            return Err(Error::limit(format!("{}: bytes of {path:?}", self.what), size, max));
        }
        let bytes = self.read(path)?;
        if matches!(self.source, Source::Disk(_)) {
            self.cameras_read.borrow_mut().insert(path.to_owned(), bytes.to_vec());
        }
        Ok(bytes)
    }

    /// The files of cameras that were read from a disk since the last call, by path.
    pub(crate) fn take_cameras_read(&self) -> BTreeMap<String, Vec<u8>> {
        self.cameras_read.take()
    }

    /// A file whole.
    ///
    /// # Errors
    /// `photo_unreadable` where it is damaged, `limit_exceeded` where all that was unpacked is too
    /// large.
    pub(crate) fn read(&self, path: &str) -> Result<Cow<'a, [u8]>> {
        let Some(&Stored { size, at }) = self.files.get(path) else {
            return Err(Error::invalid(format!("{}: there is no {path:?}", self.what)));
        };
        match &self.source {
            Source::Form(sent) => Ok(Cow::Borrowed(&sent[at].bytes)),
            Source::Tar(bytes) => {
                self.count(path, size)?;
                let len = usize::try_from(size).unwrap_or(usize::MAX);
                Ok(Cow::Borrowed(&bytes[at..at.saturating_add(len)]))
            }
            Source::Zip(bytes, entries) => {
                let mut body = Cursor::new(*bytes);
                let entry = entries[at].as_ref();
                let entry = entry.with_reader(&mut body, ZipReadOptions::new()).map_err(|e| {
                    let why = "is damaged or packed in an unknown way";
                    Error::photo(format!("archive: {path:?} {why}")).caused_by(e)
                })?;
                self.unpack(path, size, entry).map(Cow::Owned)
            }
            Source::Disk(dir) => {
                let file = fs_err::File::open(dir.join(path)).map_err(|e| {
                    Error::photo(format!("folder: {path:?} cannot be read")).caused_by(e)
                })?;
                self.unpack(path, size, file).map(Cow::Owned)
            }
        }
    }

    /// The first bytes of a file, at most `max`.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub(crate) fn head(&self, path: &str, max: usize) -> Result<Vec<u8>> {
        let Some(&Stored { size, at }) = self.files.get(path) else {
            return Err(Error::invalid(format!("{}: there is no {path:?}", self.what)));
        };
        let size = size.min(max as u64);
        let wanted = usize::try_from(size).unwrap_or(max);
        let mut head = Vec::new();
        let damaged = |e| Error::photo(format!("{}: {path:?} is damaged", self.what)).caused_by(e);
        match &self.source {
            Source::Form(sent) => head.extend(sent[at].bytes.iter().take(wanted)),
            Source::Tar(bytes) => head.extend(bytes[at..].iter().take(wanted)),
            Source::Zip(bytes, entries) => {
                self.count(path, size)?;
                let mut body = Cursor::new(*bytes);
                let entry = entries[at].as_ref();
                let entry = entry.with_reader(&mut body, ZipReadOptions::new());
                let entry = entry.map_err(std::io::Error::other).map_err(damaged)?;
                entry.take(size).read_to_end(&mut head).map_err(damaged)?;
            }
            Source::Disk(dir) => {
                let file = fs_err::File::open(dir.join(path)).map_err(damaged)?;
                file.take(size).read_to_end(&mut head).map_err(damaged)?;
            }
        }
        Ok(head)
    }

    /// Reads one file whole. The size that is listed must be left of the limit. Not one byte more
    /// is unpacked.
    fn unpack(&self, path: &str, listed: u64, from: impl Read) -> Result<Vec<u8>> {
        self.count(path, listed)?;
        let what = &self.what;
        let mut bytes = Vec::new();
        from.take(listed.saturating_add(1)).read_to_end(&mut bytes).map_err(|e| {
            Error::photo(format!("{what}: {path:?} is damaged or cut short")).caused_by(e)
        })?;
        if bytes.len() as u64 > listed {
            return Err(Error::photo(format!(
                "{what}: {path:?} holds more than the {listed} bytes that its header says"
            )));
        }
        Ok(bytes)
    }

    fn count(&self, path: &str, bytes: u64) -> Result<()> {
        let all = self.unpacked.get().saturating_add(bytes);
        if all > self.limits.archive_unpacked_bytes_max {
            return Err(over(path, all, self.limits));
        }
        self.unpacked.set(all);
        Ok(())
    }
}

/// Whether a file that begins so is a photo of a format that is read. No TIFF: raw files of cameras
/// begin as such.
fn is_read(head: &[u8]) -> bool {
    use image::ImageFormat::{Bmp, Jpeg, Png, WebP};
    image::guess_format(head).is_ok_and(|format| matches!(format, Bmp | Jpeg | Png | WebP))
}

fn over(path: &str, bytes: u64, limits: &Limits) -> Error {
    let max = limits.archive_unpacked_bytes_max;
    Error::limit(format!("archive: unpacked bytes at {path:?}"), bytes, max)
}

/// What an entry is, where it is no file.
struct Kind {
    link: bool,
    folder: bool,
}

/// Counts an entry and checks its name; the path of a file, `None` for what is skipped.
fn entry_path(
    count: &mut usize,
    name: &[u8],
    Kind { link, folder }: Kind,
    limits: &Limits,
) -> Result<Option<String>> {
    *count += 1;
    if *count > limits.archive_entries_max {
        let max = limits.archive_entries_max;
        return Err(Error::limit("archive: entries", format!("more than {max}"), max));
    }
    let name = std::str::from_utf8(name).map_err(|e| {
        Error::invalid(format!("archive: the name of entry {count} is not UTF-8")).caused_by(e)
    })?;
    let shown = short(name);
    if name.len() > limits.file_name_bytes_max {
        let what = format!("archive: bytes of the name {shown:?}");
        return Err(Error::limit(what, name.len(), limits.file_name_bytes_max));
    }
    if link {
        let why = format!("archive: {shown:?} is a link; only files may be in it");
        return Err(Error::invalid(why));
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
    let left_by_macos = path.starts_with("__MACOSX/") || names::file_name(&path).starts_with("._");
    Ok((!folder && !left_by_macos).then_some(path))
}
