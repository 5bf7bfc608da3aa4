//! Just enough of `NumPy`'s `.npz` to read labelled photographs: JPEG files one after another.

use std::{
    fs::File,
    io::{BufReader, Read as _},
    path::Path,
};

use crate::error::{Error, Result};

/// Images of a set with the class of each.
#[derive(Debug)]
pub(super) struct Labelled {
    /// Name of the set: the file's stem.
    pub set: String,
    /// Class names as stored.
    pub names: Vec<String>,
    /// Undecoded image files, one after another.
    blob: Vec<u8>,
    /// `[N + 1]` where each begins.
    offsets: Vec<usize>,
    /// `[N]` class of each, an index into `names`.
    pub labels: Vec<usize>,
}

impl Labelled {
    /// Reads `blob`, `offsets`, `label` and `class_names`; at most `bytes_max` unpacked.
    pub(super) fn open(path: &Path, bytes_max: u64) -> Result<Self> {
        let set = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let wrong = |what: &str| Error::invalid(format!("eval: {set}.npz: {what}"));
        let file = File::open(path).map_err(|e| wrong("cannot be opened").caused_by(e))?;
        let mut zip = zip::ZipArchive::new(BufReader::new(file))
            .map_err(|e| wrong("is no zip").caused_by(e))?;
        let mut left = bytes_max;
        let mut member = |name: &str| -> Result<Array> {
            let entry = zip
                .by_name(&format!("{name}.npy"))
                .map_err(|e| wrong(&format!("has no array {name}")).caused_by(e))?;
            let mut bytes = Vec::new();
            entry
                .take(left + 1)
                .read_to_end(&mut bytes)
                .map_err(|e| wrong(&format!("array {name} cannot be read")).caused_by(e))?;
            left = left.checked_sub(bytes.len() as u64).ok_or_else(|| {
                Error::limit(format!("{set}.npz: bytes unpacked"), bytes.len(), bytes_max)
            })?;
            Array::parse(bytes).ok_or_else(|| wrong(&format!("array {name} is of no known kind")))
        };
        let blob = member("blob")?.bytes("|u1").ok_or_else(|| wrong("blob is not of bytes"))?;
        let whole = |array: Array, name: &str| -> Result<Vec<usize>> {
            let numbers = array.integers().ok_or_else(|| wrong(&format!("{name}: no integers")))?;
            let unsigned = |v: &i64| usize::try_from(*v).ok();
            let found = numbers.iter().map(unsigned).collect::<Option<Vec<usize>>>();
            found.ok_or_else(|| wrong(&format!("{name} holds a negative number")))
        };
        let offsets = whole(member("offsets")?, "offsets")?;
        let labels = whole(member("label")?, "label")?;
        let names = member("class_names")?.texts().ok_or_else(|| wrong("class_names: no texts"))?;
        if offsets.len() != labels.len() + 1
            || offsets.windows(2).any(|pair| pair[0] > pair[1])
            || offsets.last() != Some(&blob.len())
        {
            return Err(wrong(&format!(
                "{} offsets over {} bytes for {} labels",
                offsets.len(),
                blob.len(),
                labels.len()
            )));
        }
        if let Some(label) = labels.iter().find(|label| **label >= names.len()) {
            return Err(wrong(&format!("label {label} of {} classes", names.len())));
        }
        Ok(Self { set, names, blob, offsets, labels })
    }

    /// The file of image `i`.
    pub(super) fn image(&self, i: usize) -> &[u8] {
        &self.blob[self.offsets[i]..self.offsets[i + 1]]
    }
}

/// One `.npy` array of one axis.
struct Array {
    kind: String,
    bytes: Vec<u8>,
    start: usize,
}

impl Array {
    /// Reads the header; `None` where it is none, or of Fortran order, or of more axes than one.
    fn parse(bytes: Vec<u8>) -> Option<Self> {
        if bytes.get(..6)? != b"\x93NUMPY" {
            return None;
        }
        let (length, from) = match bytes.get(6)? {
            1 => (u32::from(u16::from_le_bytes(bytes.get(8..10)?.try_into().ok()?)), 10),
            _ => (u32::from_le_bytes(bytes.get(8..12)?.try_into().ok()?), 12),
        };
        let start = from + usize::try_from(length).ok()?;
        let header = std::str::from_utf8(bytes.get(from..start)?).ok()?;
        if !header.contains("'fortran_order': False") {
            return None;
        }
        let kind = header.split("'descr': '").nth(1)?.split('\'').next()?.to_owned();
        let shape = header.split("'shape': (").nth(1)?.split(')').next()?;
        let axes = shape.split(',').filter(|axis| !axis.trim().is_empty()).count();
        (axes == 1).then_some(Self { kind, bytes, start })
    }

    fn bytes(mut self, kind: &str) -> Option<Vec<u8>> {
        (self.kind == kind).then(|| self.bytes.split_off(self.start))
    }

    fn integers(&self) -> Option<Vec<i64>> {
        let data = &self.bytes[self.start..];
        match self.kind.as_str() {
            "<i4" => {
                let four = |c: &[u8]| Some(i32::from_le_bytes(c.try_into().ok()?).into());
                data.chunks_exact(4).map(four).collect()
            }
            "<i8" => {
                let eight = |c: &[u8]| Some(i64::from_le_bytes(c.try_into().ok()?));
                data.chunks_exact(8).map(eight).collect()
            }
            _ => None,
        }
    }

    /// Texts of fixed length in UTF-32, filled up with zeros.
    fn texts(&self) -> Option<Vec<String>> {
        let width = self.kind.strip_prefix("<U")?.parse::<usize>().ok().filter(|w| *w > 0)?;
        let letter = |c: &[u8]| char::from_u32(u32::from_le_bytes(c.try_into().ok()?));
        let text = |row: &[u8]| -> Option<String> {
            let letters = row.chunks_exact(4).map(letter).collect::<Option<String>>()?;
            Some(letters.trim_end_matches('\0').to_owned())
        };
        self.bytes[self.start..].chunks_exact(width * 4).map(text).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Cursor, Write as _};

    use super::*;

    fn npy(kind: &str, count: usize, data: &[u8]) -> Vec<u8> {
        let mut header =
            format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({count},), }}");
        header.push('\n');
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend(u16::try_from(header.len()).unwrap().to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(data);
        bytes
    }

    fn file(labels: &[i32], offsets: &[i64]) -> tempfile::NamedTempFile {
        let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
        let options = zip::write::SimpleFileOptions::default()
            .compression_method(zip::CompressionMethod::Stored);
        let names: Vec<u8> = ["cat\0", "tree"]
            .iter()
            .flat_map(|name| name.chars().flat_map(|c| u32::from(c).to_le_bytes()))
            .collect();
        let arrays = [
            ("blob", npy("|u1", 5, b"abcde")),
            (
                "offsets",
                npy("<i8", 3, &offsets.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()),
            ),
            (
                "label",
                npy("<i4", 2, &labels.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()),
            ),
            ("class_names", npy("<U4", 2, &names)),
        ];
        for (name, bytes) in arrays {
            zip.start_file(format!("{name}.npy"), options).unwrap();
            zip.write_all(&bytes).unwrap();
        }
        let made = tempfile::Builder::new().suffix(".npz").tempfile().unwrap();
        made.as_file().write_all(&zip.finish().unwrap().into_inner()).unwrap();
        made
    }

    #[test]
    fn images_labels_and_names_are_read() {
        let set = Labelled::open(file(&[1, 0], &[0, 2, 5]).path(), 1 << 20).unwrap();
        assert_eq!(set.names, ["cat", "tree"]);
        assert_eq!(set.labels, [1, 0]);
        assert_eq!((set.image(0), set.image(1)), (&b"ab"[..], &b"cde"[..]));
    }

    #[test]
    fn what_does_not_fit_together_is_refused() {
        for (labels, offsets) in [([2, 0], [0, 2, 5]), ([-1, 0], [0, 2, 5]), ([0, 1], [0, 3, 4])] {
            assert!(Labelled::open(file(&labels, &offsets).path(), 1 << 20).is_err());
        }
        assert!(Labelled::open(file(&[1, 0], &[0, 2, 5]).path(), 40).is_err(), "over the limit");
    }
}
