//! An upload as one container, so that an acknowledged scene can be made after any restart. Files
//! that are objects of their own are listed in it; programs that know no such list find another
//! version.

use std::{io, sync::Arc};

use object_store::PutPayload;
use serde::{Deserialize, Serialize};

use super::files::sha256;
use crate::{
    error::{ErrorCode, Result},
    formats::container::{Container, ContainerArray, ContainerKind, Dtype, frame},
    scene::{
        FilePart, KeptBytes, KeptFile, KeptFiles, PhotoHash, SceneId, Upload, UploadCameras,
        UploadFile,
    },
};

const KIND: &str = "segsplat-upload";
const WHOLE: ContainerKind = ContainerKind { kind: KIND, version: 1 };
const LISTED: ContainerKind = ContainerKind { kind: KIND, version: 2 };

#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum UploadPart {
    Transforms,
    Cameras,
    Archive,
    Photo,
    Splats,
}

#[derive(Serialize, Deserialize)]
struct Header {
    record: super::Record,
    /// Part and name of each array, in order.
    parts: Vec<(UploadPart, String)>,
    /// Files that are objects beside it, in order.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    kept: Vec<Kept>,
}

/// A file that is an object of its own.
#[derive(Serialize, Deserialize)]
struct Kept {
    part: UploadPart,
    name: String,
    size: u64,
    sha256: String,
}

impl From<&KeptFile> for Kept {
    fn from(file: &KeptFile) -> Self {
        let part = match file.part {
            FilePart::Photo => UploadPart::Photo,
            FilePart::Archive => UploadPart::Archive,
            FilePart::Splats => UploadPart::Splats,
        };
        Self { part, name: file.name.clone(), size: file.size, sha256: file.sha256.clone() }
    }
}

fn parts(upload: &Upload) -> Vec<(UploadPart, &str, &[u8])> {
    let cameras = upload.cameras.iter().map(|cameras| match cameras {
        UploadCameras::Transforms(json) => (UploadPart::Transforms, "transforms.json", &json[..]),
        UploadCameras::Cameras(json) => (UploadPart::Cameras, "cameras.json", &json[..]),
    });
    let archive = upload.archive.iter().map(|bytes| (UploadPart::Archive, "archive", &bytes[..]));
    let photos = upload.photos.iter().map(|p| (UploadPart::Photo, p.name.as_str(), &p.bytes[..]));
    let splats = upload.splats.iter().map(|s| (UploadPart::Splats, s.name.as_str(), &s.bytes[..]));
    cameras.chain(archive).chain(photos).chain(splats).collect()
}

/// Name and sha256 of every file of an upload, the same wherever its files are.
pub fn hashes(upload: &Upload) -> Vec<PhotoHash> {
    let here = parts(upload)
        .into_iter()
        .map(|(_, name, bytes)| PhotoHash { file: name.to_owned(), sha256: sha256(bytes) });
    let kept = upload.kept();
    here.chain(kept.map(|of| PhotoHash { file: of.name.clone(), sha256: of.sha256.clone() }))
        .collect()
}

/// The file of an upload: its bytes go in as they are, none is copied.
pub(super) fn pack(upload: Upload, record: &super::Record) -> io::Result<PutPayload> {
    let parts = parts(&upload);
    let header = serde_json::to_string(&Header {
        record: record.clone(),
        parts: parts.iter().map(|(part, name, _)| (*part, (*name).to_owned())).collect(),
        kept: upload.kept().map(Kept::from).collect(),
    })?;
    let arrays: Vec<_> = parts
        .iter()
        .enumerate()
        .map(|(i, (_, _, bytes))| {
            ContainerArray::new(format!("part_{i}"), Dtype::U8, &[bytes.len()], bytes)
        })
        .collect();
    let label = if upload.kept.is_some() { &LISTED } else { &WHOLE };
    let (head, digest) = frame(label, &header, &arrays)?;
    let cameras = upload.cameras.map(|cameras| match cameras {
        UploadCameras::Transforms(json) | UploadCameras::Cameras(json) => json,
    });
    let files = upload.photos.into_iter().chain(upload.splats).map(|file| file.bytes);
    let bytes = cameras.into_iter().chain(upload.archive).chain(files);
    let parts = std::iter::once(head).chain(bytes).chain([digest.to_vec()]);
    // A payload takes each part over as it is.
    Ok(parts.flat_map(PutPayload::from).collect())
}

/// Gives the bytes of a file that is an object: by its number, sha256 and size.
type FindKept<'s> = &'s dyn Fn(usize, &str, u64) -> Arc<dyn KeptBytes>;

/// The upload of a scene and the record it was acknowledged with, from its object `list`.
pub(super) fn read(
    file: &[u8],
    scene: &SceneId,
    list: &str,
    stored: FindKept<'_>,
) -> Result<(Upload, super::Record)> {
    let what = "the stored upload";
    let container = match Container::read(file, &WHOLE, what) {
        Err(error) if error.code() == ErrorCode::OtherVersion => {
            Container::read(file, &LISTED, what)?
        }
        read => read?,
    };
    let header: Header = container.header()?;
    let mut upload = Upload::default();
    for (i, (part, name)) in header.parts.into_iter().enumerate() {
        let bytes = container.rows(&format!("part_{i}"), Dtype::U8)?;
        match part {
            UploadPart::Transforms => upload.cameras = Some(UploadCameras::Transforms(bytes)),
            UploadPart::Cameras => upload.cameras = Some(UploadCameras::Cameras(bytes)),
            UploadPart::Archive => upload.archive = Some(bytes),
            UploadPart::Photo => upload.photos.push(UploadFile { name, bytes }),
            UploadPart::Splats => upload.splats = Some(UploadFile { name, bytes }),
        }
    }
    if !header.kept.is_empty() {
        let file = |(i, of): (usize, Kept)| {
            let part = match of.part {
                UploadPart::Archive => FilePart::Archive,
                UploadPart::Splats => FilePart::Splats,
                // Cameras are never apart.
                UploadPart::Photo | UploadPart::Transforms | UploadPart::Cameras => FilePart::Photo,
            };
            let bytes = stored(i, &of.sha256, of.size);
            KeptFile { part, name: of.name, size: of.size, sha256: of.sha256, bytes }
        };
        let files = header.kept.into_iter().enumerate().map(file).collect();
        let (scene, list) = (scene.clone(), list.to_owned());
        upload.kept = Some(KeptFiles { scene, list, files });
    }
    Ok((upload, header.record))
}
