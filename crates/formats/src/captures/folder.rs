//! The files of a capture wherever they are: in a folder, in a zip or tar, or as parts of a form.
//!
//! All names are known first; bytes are unpacked when they are asked for, and those of photos not
//! before they are decoded. Names are checked, and sizes are limited while bytes are read.

use std::{
    borrow::Cow,
    cell::{Cell, RefCell},
    collections::BTreeMap,
    io::Read,
    path::{Path, PathBuf},
    sync::Arc,
};

use zip::{ZipReadOptions, read::OwnedZipFileEntry, unstable::read::ZipIterable};

use super::{
    bytes::{FileBytes, SentReader, told_or},
    names,
};
use crate::{
    error::{Error, Result, short},
    limits::Limits,
    scene::{SentBytes, SentFile},
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

/// An archive may be so large unpacked, whatever its own size, and beyond that so many times as
/// large as itself: photos are packed already.
const UNPACKED_FREE: u64 = 512 << 20;
const UNPACKED_TIMES: u64 = 4;

/// Files by path, `/` between its parts.
pub(crate) struct Folder<'a> {
    /// What it is in messages: `archive`, `upload`, or the path of a folder.
    pub(crate) what: String,
    files: BTreeMap<String, Stored>,
    source: Source<'a>,
    pub(crate) limits: &'a Limits,
    /// Bytes that were unpacked or read from a disk, and how many may be.
    unpacked: Cell<u64>,
    unpacked_max: u64,
    /// Files of cameras that were read from a disk.
    cameras_read: RefCell<BTreeMap<String, Vec<u8>>>,
}

/// A file that was not read yet.
#[derive(Clone, Copy, Debug)]
struct Stored {
    /// Bytes as listed.
    size: u64,
    /// Number of the entry, or where its bytes begin.
    at: usize,
}

#[derive(Clone)]
enum Source<'a> {
    Form(Arc<[SentFile<'a>]>),
    Tar(SentBytes<'a>),
    Zip(SentBytes<'a>, Arc<Vec<OwnedZipFileEntry>>),
    Disk(PathBuf),
}

impl<'a> Source<'a> {
    /// A file whole, not one byte more than the size that is listed. `what` is the folder.
    fn read(&self, what: &str, path: &str, Stored { size, at }: Stored) -> Result<Cow<'a, [u8]>> {
        let whole = |from: &mut dyn Read| -> Result<Cow<'a, [u8]>> {
            let mut bytes = Vec::new();
            from.take(size.saturating_add(1)).read_to_end(&mut bytes).map_err(|e| {
                told_or(e, |e| {
                    Error::photo(format!("{what}: {path:?} is damaged or cut short")).caused_by(e)
                })
            })?;
            if bytes.len() as u64 > size {
                return Err(Error::photo(format!(
                    "{what}: {path:?} holds more than the {size} bytes that its header says"
                )));
            }
            Ok(Cow::Owned(bytes))
        };
        match self {
            Self::Form(sent) => sent[at].bytes.read(),
            Self::Tar(bytes) => bytes.range(at as u64, size),
            Self::Zip(bytes, entries) => {
                let mut body = SentReader::new(*bytes);
                let entry = entries[at].as_ref().with_reader(&mut body, ZipReadOptions::new());
                let mut entry = entry.map_err(|e| {
                    told_or(e, |e| {
                        let why = "is damaged or packed in an unknown way";
                        Error::photo(format!("archive: {path:?} {why}")).caused_by(e)
                    })
                })?;
                whole(&mut entry)
            }
            Self::Disk(dir) => {
                let mut file = fs_err::File::open(dir.join(path)).map_err(|e| {
                    Error::photo(format!("folder: {path:?} cannot be read")).caused_by(e)
                })?;
                whole(&mut file)
            }
        }
    }
}

impl<'a> Folder<'a> {
    /// The parts of a form, each with its path as name, without the encodings of HTTP clients where
    /// `decoded`.
    ///
    /// # Errors
    /// `invalid_request` for names that leave the folder or come twice, `limit_exceeded` for names
    /// that are too long.
    pub(crate) fn of_form(
        sent: impl Iterator<Item = SentFile<'a>>,
        decoded: bool,
        limits: &'a Limits,
    ) -> Result<Self> {
        let sent: Arc<[SentFile<'a>]> = sent.collect();
        let paths = names::paths(&sent, decoded, limits)?;
        let mut folder = Self::new("upload", Source::Form(Arc::clone(&sent)), limits);
        for (at, (file, path)) in sent.iter().zip(paths).enumerate() {
            folder.insert(path, Stored { size: file.bytes.size(), at })?;
        }
        Ok(folder)
    }

    /// The entries of a zip or a tar.
    ///
    /// # Errors
    /// `photo_unreadable` when it is no archive or damaged, `invalid_request` for names that leave
    /// it or links, `limit_exceeded` for too many entries or bytes.
    pub(crate) fn of_archive(bytes: SentBytes<'a>, limits: &'a Limits) -> Result<Self> {
        match &*bytes.range(0, 262)? {
            [b'P', b'K', ..] => Self::of_zip(bytes, limits),
            head if head.get(257..) == Some(b"ustar") => Self::of_tar(bytes, limits),
            head => {
                let known = PACKED.iter().find(|(start, _)| head.starts_with(start));
                Err(Error::photo(match known {
                    Some((_, by)) => format!("archive: packed by {by}; send a zip or a plain tar"),
                    None => "archive: neither a zip nor a tar file".to_owned(),
                }))
            }
        }
    }

    fn of_zip(bytes: SentBytes<'a>, limits: &'a Limits) -> Result<Self> {
        let damaged = |e| {
            told_or(e, |e| Error::photo("archive: the zip is damaged or cut short").caused_by(e))
        };
        // Unlike `ZipArchive` it reads no entry in `try_new`, so the number of entries, in ZIP64
        // too, is checked first. It also keeps entries that share a name.
        let config = zip::read::Config::default();
        let mut zip = ZipIterable::try_new(SentReader::new(bytes), config).map_err(damaged)?;
        if zip.len() > limits.archive_entries_max {
            return Err(Error::limit("archive: entries", zip.len(), limits.archive_entries_max));
        }
        let mut folder = Self::new("archive", Source::Zip(bytes, Arc::default()), limits);
        folder.unpacked_max = unpacked_max(bytes, limits);
        let (mut count, mut claimed_bytes, mut entries) = (0, 0_u64, Vec::new());
        for entry in zip.files().map_err(damaged)? {
            let entry = entry.map_err(damaged)?;
            let name = entry.name().map_err(damaged)?;
            let kind = Kind { link: entry.is_symlink(), folder: entry.is_dir() };
            let path = entry_path(&mut count, name.as_bytes(), kind, limits)?;
            claimed_bytes = claimed_bytes.saturating_add(entry.size());
            let max = folder.unpacked_max;
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
        folder.source = Source::Zip(bytes, Arc::new(entries));
        Ok(folder)
    }

    fn of_tar(bytes: SentBytes<'a>, limits: &'a Limits) -> Result<Self> {
        use tar::EntryType;

        let damaged = |e| {
            told_or(e, |e| Error::photo("archive: the tar is damaged or cut short").caused_by(e))
        };
        let mut folder = Self::new("archive", Source::Tar(bytes), limits);
        folder.unpacked_max = unpacked_max(bytes, limits);
        let mut count = 0;
        let mut tar = tar::Archive::new(SentReader::new(bytes));
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
            if size > folder.unpacked_max {
                return Err(over(&path, size, folder.unpacked_max));
            }
            let end = begin.saturating_add(size);
            let at = usize::try_from(begin).ok().filter(|_| end <= bytes.size());
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
        // Nothing is unpacked of a disk.
        folder.unpacked_max = limits.archive_unpacked_bytes_max;
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
            unpacked_max: u64::MAX,
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
    /// `photo_unreadable` where it is damaged, `limit_exceeded` where it, or all that was unpacked,
    /// is too large.
    pub(crate) fn read(&self, path: &str) -> Result<Cow<'a, [u8]>> {
        let stored = self.counted(path)?;
        self.source.read(&self.what, path, stored)
    }

    /// A file that is read when its turn comes. It counts as read now.
    ///
    /// # Errors
    /// As [`Self::read`], but for damage, which is found then.
    pub(crate) fn later(&self, path: &str) -> Result<FileBytes<'a>> {
        let stored = self.counted(path)?;
        let (source, what, path) = (self.source.clone(), self.what.clone(), path.to_owned());
        if let Source::Form(sent) = &source {
            return Ok(FileBytes::from(sent[stored.at].bytes));
        }
        let read = move || source.read(&what, &path, stored);
        Ok(FileBytes::later(stored.size, read))
    }

    /// A file whose size is within the limits, and of what is unpacked counted.
    fn counted(&self, path: &str) -> Result<Stored> {
        let Some(&stored) = self.files.get(path) else {
            return Err(Error::invalid(format!("{}: there is no {path:?}", self.what)));
        };
        let max = self.limits.upload_file_bytes_max;
        if stored.size > max as u64 {
            let what = format!("{}: bytes of {path:?}", self.what);
            return Err(Error::limit(what, stored.size, max));
        }
        if !self.is_form() {
            self.count(path, stored.size)?;
        }
        Ok(stored)
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
        let mut head = Vec::new();
        let damaged = |e| Error::photo(format!("{}: {path:?} is damaged", self.what)).caused_by(e);
        match &self.source {
            Source::Form(sent) => head.extend_from_slice(&sent[at].bytes.range(0, size)?),
            Source::Tar(bytes) => head.extend_from_slice(&bytes.range(at as u64, size)?),
            Source::Zip(bytes, entries) => {
                self.count(path, size)?;
                let mut body = SentReader::new(*bytes);
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

    fn count(&self, path: &str, bytes: u64) -> Result<()> {
        let all = self.unpacked.get().saturating_add(bytes);
        if all > self.unpacked_max {
            return Err(over(path, all, self.unpacked_max));
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

/// Bytes that an archive may have unpacked.
fn unpacked_max(bytes: SentBytes<'_>, limits: &Limits) -> u64 {
    let of_own = UNPACKED_FREE.max(UNPACKED_TIMES.saturating_mul(bytes.size()));
    limits.archive_unpacked_bytes_max.min(of_own)
}

fn over(path: &str, bytes: u64, max: u64) -> Error {
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
