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
pub struct Labelled {
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
    ///
    /// # Errors
    /// `invalid_request` where the file is no such set, `limit_exceeded` where it is too large.
    pub fn open(path: &Path, bytes_max: u64) -> Result<Self> {
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
    #[must_use]
    pub fn image(&self, i: usize) -> &[u8] {
        &self.blob[self.offsets[i]..self.offsets[i + 1]]
    }
}
