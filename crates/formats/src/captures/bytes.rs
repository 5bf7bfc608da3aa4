//! Bytes of files that are read when their turn comes.

use std::{
    borrow::Cow,
    error::Error as StdError,
    fmt,
    io::{self, Read, Seek, SeekFrom},
    sync::Arc,
};

use crate::{
    error::{Error, Result},
    scene::SentBytes,
};

/// Bytes that are read at a time of an archive that is not in memory.
const PIECE: u64 = 1 << 20;

/// The bytes of a file: in memory, or read and unpacked anew each time that they are asked for.
#[derive(Clone)]
pub struct FileBytes<'a>(Kind<'a>);

type Later<'a> = Arc<dyn Fn() -> Result<Cow<'a, [u8]>> + Send + Sync + 'a>;

#[derive(Clone)]
enum Kind<'a> {
    Here(&'a [u8]),
    Later { size: u64, read: Later<'a> },
}

impl fmt::Debug for FileBytes<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "FileBytes({} bytes)", self.size())
    }
}

impl<'a> From<SentBytes<'a>> for FileBytes<'a> {
    fn from(bytes: SentBytes<'a>) -> Self {
        match bytes {
            SentBytes::Here(bytes) => Self(Kind::Here(bytes)),
            SentBytes::Kept(file) => Self::later(file.size, move || SentBytes::Kept(file).read()),
        }
    }
}

impl<'a> FileBytes<'a> {
    pub(super) fn later(
        size: u64,
        read: impl Fn() -> Result<Cow<'a, [u8]>> + Send + Sync + 'a,
    ) -> Self {
        Self(Kind::Later { size, read: Arc::new(read) })
    }

    /// How many there are, as listed.
    #[must_use]
    pub fn size(&self) -> u64 {
        match &self.0 {
            Kind::Here(bytes) => bytes.len() as u64,
            Kind::Later { size, .. } => *size,
        }
    }

    /// All of them.
    ///
    /// # Errors
    /// `photo_unreadable` where they cannot be unpacked, `store_unavailable`, `scene_corrupt`.
    pub fn read(&self) -> Result<Cow<'a, [u8]>> {
        match &self.0 {
            Kind::Here(bytes) => Ok(Cow::Borrowed(bytes)),
            Kind::Later { read, .. } => read(),
        }
    }
}

/// Reads an archive from any place of it, a piece at a time where it is not in memory.
pub(super) struct SentReader<'a> {
    bytes: SentBytes<'a>,
    at: u64,
    /// Where the piece begins, and the piece.
    piece: (u64, Cow<'a, [u8]>),
}

impl<'a> SentReader<'a> {
    pub(super) fn new(bytes: SentBytes<'a>) -> Self {
        Self { bytes, at: 0, piece: (0, Cow::Borrowed(&[])) }
    }
}

impl Read for SentReader<'_> {
    fn read(&mut self, to: &mut [u8]) -> io::Result<usize> {
        if self.at >= self.bytes.size() || to.is_empty() {
            return Ok(0);
        }
        let (begins, piece) = &self.piece;
        if !(*begins..begins + piece.len() as u64).contains(&self.at) {
            let len = match self.bytes {
                SentBytes::Here(_) => u64::MAX,
                SentBytes::Kept(_) => PIECE,
            };
            self.piece = (self.at, self.bytes.range(self.at, len).map_err(io::Error::other)?);
        }
        let (begins, piece) = &self.piece;
        let from = usize::try_from(self.at - begins).map_err(io::Error::other)?;
        let some = &piece[from..];
        let count = some.len().min(to.len());
        to[..count].copy_from_slice(&some[..count]);
        self.at += count as u64;
        Ok(count)
    }
}

impl Seek for SentReader<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let at = match to {
            SeekFrom::Start(at) => Some(at),
            SeekFrom::End(by) => self.bytes.size().checked_add_signed(by),
            SeekFrom::Current(by) => self.at.checked_add_signed(by),
        };
        self.at = at.ok_or_else(|| io::Error::from(io::ErrorKind::InvalidInput))?;
        Ok(self.at)
    }
}

/// What a store said where that is why an archive cannot be read, else `damaged`.
pub(super) fn told_or<E: StdError + 'static>(error: E, damaged: impl FnOnce(E) -> Error) -> Error {
    let mut cause: Option<&(dyn StdError + 'static)> = Some(&error);
    while let Some(at) = cause {
        let inner = at.downcast_ref::<io::Error>().and_then(io::Error::get_ref);
        let own = inner.and_then(|inner| inner.downcast_ref::<Error>());
        if let Some(own) = own.or_else(|| at.downcast_ref::<Error>()) {
            let told = Error::new(own.code(), own.message());
            return own.retry_after().into_iter().fold(told, Error::retry_after_s);
        }
        cause = at.source();
    }
    damaged(error)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        error::ErrorCode,
        scene::{FilePart, KeptBytes, KeptFile},
    };

    struct Held(Vec<u8>);

    impl KeptBytes for Held {
        fn read(&self, from: u64, len: u64) -> Result<Vec<u8>> {
            let gone = || Error::new(ErrorCode::StoreUnavailable, "gone").retry_after_s(7);
            let range = from as usize..(from + len) as usize;
            self.0.get(range).map(<[u8]>::to_vec).ok_or_else(gone)
        }
    }

    fn kept(size: u64, bytes: Vec<u8>) -> KeptFile {
        let (part, name, sha256) = (FilePart::Archive, "a.zip".to_owned(), String::new());
        KeptFile { part, name, size, sha256, bytes: Arc::new(Held(bytes)) }
    }

    #[test]
    fn a_file_that_lies_elsewhere_is_read_from_any_place() {
        let bytes: Vec<u8> = (0..3 * PIECE + 5).map(|i| (i % 251) as u8).collect();
        let file = kept(bytes.len() as u64, bytes.clone());
        for sent in [SentBytes::Here(&bytes), SentBytes::Kept(&file)] {
            let mut reader = SentReader::new(sent);
            for from in [5, 2 * PIECE - 3, 0, 3 * PIECE + 1] {
                let mut got = vec![0; 4];
                reader.seek(SeekFrom::Start(from)).unwrap();
                reader.read_exact(&mut got).unwrap();
                assert_eq!(got, bytes[from as usize..][..4], "{from}");
            }
            reader.seek(SeekFrom::End(-2)).unwrap();
            let mut rest = Vec::new();
            reader.read_to_end(&mut rest).unwrap();
            assert_eq!(rest, bytes[bytes.len() - 2..]);
            assert_eq!(*FileBytes::from(sent).read().unwrap(), bytes);
        }
        let short = kept(9, vec![0; 4]);
        let failed = SentReader::new(SentBytes::Kept(&short)).read_to_end(&mut Vec::new());
        let error = told_or(failed.unwrap_err(), |_| Error::photo("damaged"));
        assert_eq!((error.code(), error.retry_after()), (ErrorCode::StoreUnavailable, Some(7)));
    }
}
