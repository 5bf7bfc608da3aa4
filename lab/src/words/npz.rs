//! Labelled photographs in `NumPy`'s `.npz`: JPEG files one after another, and their classes.

use std::{
    fs::File,
    io::{BufReader, Read as _},
    path::Path,
};

use crate::{
    error::{Error, Result},
    npy::Array,
};

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
        let wrong = |what: &str| Error::invalid(format!("{set}.npz: {what}"));
        let file = File::open(path).map_err(|e| wrong("cannot be opened").caused_by(e))?;
        let mut zip = zip::ZipArchive::new(BufReader::new(file))
            .map_err(|e| wrong("is no zip").caused_by(e))?;
        let mut left = bytes_max;
        let mut member = |name: &str| -> Result<Array> {
            let fault = || wrong(&format!("array {name} cannot be read"));
            let entry = zip.by_name(&format!("{name}.npy")).map_err(|e| fault().caused_by(e))?;
            let mut bytes = Vec::new();
            entry.take(left + 1).read_to_end(&mut bytes).map_err(|e| fault().caused_by(e))?;
            left = left.checked_sub(bytes.len() as u64).ok_or_else(|| {
                Error::limit(format!("{set}.npz: bytes unpacked"), bytes.len(), bytes_max)
            })?;
            Array::parse(bytes).filter(|array| array.shape.len() == 1).ok_or_else(fault)
        };
        let kind = |name: &str| wrong(&format!("array {name} is of another kind"));
        let blob = member("blob")?.bytes().ok_or_else(|| kind("blob"))?;
        let offsets = member("offsets")?.counts().ok_or_else(|| kind("offsets"))?;
        let labels = member("label")?.counts().ok_or_else(|| kind("label"))?;
        let names = member("class_names")?.texts().ok_or_else(|| kind("class_names"))?;
        let fits = offsets.len() == labels.len() + 1
            && offsets.is_sorted()
            && offsets.last() == Some(&blob.len())
            && labels.iter().all(|label| *label < names.len());
        if !fits {
            return Err(wrong("its arrays do not fit together"));
        }
        Ok(Self { set, names, blob, offsets, labels })
    }

    /// The file of image `i`.
    pub(super) fn image(&self, i: usize) -> &[u8] {
        &self.blob[self.offsets[i]..self.offsets[i + 1]]
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Cursor, Write as _};

    use super::*;
    use crate::npy::npy;

    fn file(labels: &[i32], offsets: &[i64]) -> tempfile::NamedTempFile {
        let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
        let options = zip::write::SimpleFileOptions::default()
            .compression_method(zip::CompressionMethod::Stored);
        let names: Vec<u8> = ["cat\0", "tree"]
            .iter()
            .flat_map(|name| name.chars().flat_map(|c| u32::from(c).to_le_bytes()))
            .collect();
        let arrays = [
            ("blob", npy("|u1", "5,", b"abcde")),
            (
                "offsets",
                npy(
                    "<i8",
                    "3,",
                    &offsets.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>(),
                ),
            ),
            (
                "label",
                npy("<i4", "2,", &labels.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()),
            ),
            ("class_names", npy("<U4", "2,", &names)),
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
