//! An upload as one container, so that an acknowledged scene can be made after any restart.

use std::io;

use object_store::PutPayload;
use serde::{Deserialize, Serialize};

use super::files::sha256;
use crate::{
    error::Result,
    formats::container::{Container, ContainerArray, ContainerKind, Dtype, frame},
    scene::{PhotoHash, Upload, UploadCameras, UploadFile},
};

const LABEL: ContainerKind = ContainerKind { kind: "segsplat-upload", version: 1 };

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

/// Name and sha256 of every file of an upload.
pub fn hashes(upload: &Upload) -> Vec<PhotoHash> {
    parts(upload)
        .into_iter()
        .map(|(_, name, bytes)| PhotoHash { file: name.to_owned(), sha256: sha256(bytes) })
        .collect()
}

/// The file of an upload: its bytes go in as they are, none is copied.
pub(super) fn pack(upload: Upload, record: &super::Record) -> io::Result<PutPayload> {
    let parts = parts(&upload);
    let header = serde_json::to_string(&Header {
        record: record.clone(),
        parts: parts.iter().map(|(part, name, _)| (*part, (*name).to_owned())).collect(),
    })?;
    let arrays: Vec<_> = parts
        .iter()
        .enumerate()
        .map(|(i, (_, _, bytes))| {
            ContainerArray::new(format!("part_{i}"), Dtype::U8, &[bytes.len()], bytes)
        })
        .collect();
    let (head, digest) = frame(&LABEL, &header, &arrays)?;
    let cameras = upload.cameras.map(|cameras| match cameras {
        UploadCameras::Transforms(json) | UploadCameras::Cameras(json) => json,
    });
    let files = upload.photos.into_iter().chain(upload.splats).map(|file| file.bytes);
    let bytes = cameras.into_iter().chain(upload.archive).chain(files);
    let parts = std::iter::once(head).chain(bytes).chain([digest.to_vec()]);
    // A payload takes each part over as it is.
    Ok(parts.flat_map(PutPayload::from).collect())
}

/// The upload and the record it was acknowledged with.
pub(super) fn read(file: &[u8]) -> Result<(Upload, super::Record)> {
    let container = Container::read(file, &LABEL, "the stored upload")?;
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
    Ok((upload, header.record))
}
