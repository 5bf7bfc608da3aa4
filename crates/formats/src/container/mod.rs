//! The one container: a safetensors file whose last 32 bytes are the sha256 of all before them.
//!
//! Any safetensors reader opens it; the digest is the tensor `sha256`. What the arrays mean is in
//! `__metadata__`: `kind`, `version`, and `json` with the rest. Every byte is under the digest.

mod scene;
mod semantics;

use std::io::{self, Write};

use bytemuck::Pod;
pub use safetensors::Dtype;
use safetensors::{SafeTensors, tensor::Metadata};
use serde::de::DeserializeOwned;
use serde_json::json;
use sha2::{Digest, Sha256};

pub use self::{
    scene::{read_scene, write_scene},
    semantics::{read_semantics, write_semantics},
};
use crate::{
    error::{Error, ErrorCode, Result},
    names::hex,
};

const DIGEST_BYTES: usize = 32;
const DIGEST_NAME: &str = "sha256";

/// One array to write: little-endian bytes, row-major.
#[derive(Debug)]
pub struct ContainerArray<'a> {
    name: String,
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: &'a [u8],
}

impl<'a> ContainerArray<'a> {
    /// `values` as the array `name`.
    pub fn new(
        name: impl Into<String>,
        dtype: Dtype,
        shape: &[usize],
        values: &'a [impl Pod],
    ) -> Self {
        let (name, shape) = (name.into(), shape.to_vec());
        Self { name, dtype, shape, bytes: bytemuck::cast_slice(values) }
    }
}

/// What a container is, before its arrays.
#[derive(Clone, Copy, Debug)]
pub struct ContainerKind {
    /// Its name in the file.
    pub kind: &'static str,
    /// The version of what its arrays mean.
    pub version: u32,
}

/// Writes a container; returns the digest in hex.
fn write(
    to: &mut dyn Write,
    label: &ContainerKind,
    meta_json: &str,
    arrays: &[ContainerArray<'_>],
) -> io::Result<String> {
    let (head, digest) = frame(label, meta_json, arrays)?;
    for part in [&head[..]].into_iter().chain(arrays.iter().map(|a| a.bytes)).chain([&digest[..]]) {
        to.write_all(part)?;
    }
    Ok(hex(&digest))
}

/// What goes before the arrays of a container, and the digest that goes after them.
///
/// # Errors
/// Where the header cannot be written down.
pub fn frame(
    label: &ContainerKind,
    meta_json: &str,
    arrays: &[ContainerArray<'_>],
) -> io::Result<(Vec<u8>, [u8; DIGEST_BYTES])> {
    let mut header = serde_json::Map::new();
    header.insert(
        "__metadata__".to_owned(),
        json!({ "kind": label.kind, "version": label.version.to_string(), "json": meta_json }),
    );
    let mut offset = 0;
    for array in arrays {
        let end = offset + array.bytes.len();
        header.insert(
            array.name.clone(),
            json!({ "dtype": array.dtype, "shape": array.shape, "data_offsets": [offset, end] }),
        );
        offset = end;
    }
    header.insert(
        DIGEST_NAME.to_owned(),
        json!({
            "dtype": Dtype::U8,
            "shape": [DIGEST_BYTES],
            "data_offsets": [offset, offset + DIGEST_BYTES],
        }),
    );
    let mut header = serde_json::to_vec(&header)?;
    header.resize(header.len().next_multiple_of(8), b' ');

    let head = [&(header.len() as u64).to_le_bytes()[..], &header].concat();
    let mut hash = Sha256::new();
    [&head[..]]
        .into_iter()
        .chain(arrays.iter().map(|a| a.bytes))
        .for_each(|part| hash.update(part));
    Ok((head, hash.finalize().into()))
}

/// A container whose digest, kind and version are right.
#[derive(Debug)]
pub struct Container<'a> {
    /// Its digest, hex.
    pub sha256: String,
    meta_json: String,
    tensors: SafeTensors<'a>,
    what: &'a str,
}

impl<'a> Container<'a> {
    /// Checks the whole file. `what` names it in messages.
    ///
    /// # Errors
    /// `scene_corrupt`.
    pub fn read(file: &'a [u8], label: &ContainerKind, what: &'a str) -> Result<Self> {
        let corrupt =
            |why: String| Error::new(ErrorCode::SceneCorrupt, format!("{what} is corrupt: {why}"));
        let split = file
            .len()
            .checked_sub(DIGEST_BYTES)
            .ok_or_else(|| corrupt(format!("{} bytes are too few for a container", file.len())))?;
        let (content, digest) = file.split_at(split);
        if Sha256::digest(content)[..] != *digest {
            return Err(corrupt("its checksum does not match its content".to_owned()));
        }
        let (_, metadata): (usize, Metadata) =
            SafeTensors::read_metadata(file).map_err(|e| corrupt(e.to_string()))?;
        let words = metadata.metadata().as_ref();
        let word = |name: &str| {
            words
                .and_then(|words| words.get(name))
                .ok_or_else(|| corrupt(format!("it has no {name}")))
        };
        if word("kind")? != label.kind || *word("version")? != label.version.to_string() {
            return Err(corrupt(format!(
                "it is {} version {}; this program reads {} version {}",
                word("kind")?,
                word("version")?,
                label.kind,
                label.version
            )));
        }
        let meta_json = word("json")?.clone();
        let tensors = SafeTensors::deserialize(file).map_err(|e| corrupt(e.to_string()))?;
        Ok(Self { sha256: hex(digest), meta_json, tensors, what })
    }

    /// What the file says beside its arrays.
    ///
    /// # Errors
    /// `scene_corrupt`.
    pub fn header<T: DeserializeOwned>(&self) -> Result<T> {
        serde_json::from_str(&self.meta_json).map_err(|e| {
            Error::new(ErrorCode::SceneCorrupt, format!("{}'s metadata: {e}", self.what))
        })
    }

    /// Whether there is an array of this name.
    fn has(&self, name: &str) -> bool {
        self.tensors.tensor(name).is_ok()
    }

    /// An array of the type expected as rows of `T`, copied so that alignment does not matter.
    ///
    /// # Errors
    /// `scene_corrupt`.
    pub fn rows<T: Pod>(&self, name: &str, dtype: Dtype) -> Result<Vec<T>> {
        let bad = |why: String| Error::new(ErrorCode::SceneCorrupt, format!("array {name}: {why}"));
        let view = self.tensors.tensor(name).map_err(|e| bad(e.to_string()))?;
        if view.dtype() != dtype {
            return Err(bad(format!("type {:?}, not {dtype:?}", view.dtype())));
        }
        let bytes = view.data();
        if bytes.len() % size_of::<T>() != 0 {
            return Err(bad(format!("{} bytes are no whole number of rows", bytes.len())));
        }
        Ok(bytemuck::pod_collect_to_vec(bytes))
    }
}
