//! The semantics of a scene as one container, beside the scene's own file.

use std::io::{self, Write};

use safetensors::Dtype;
use serde::{Deserialize, Serialize};

use super::{Container, ContainerArray, ContainerKind, write};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::{Bank, BankMask, IndexMap, RowViews, SceneId, Semantics, SemanticsReport},
};

const LABEL: ContainerKind = ContainerKind { kind: "segsplat-semantics", version: 1 };

/// What the arrays cannot say.
#[derive(Serialize, Deserialize)]
struct Header {
    scene: SceneId,
    /// Numbers a row of the bank.
    dim: usize,
    /// Width and height of each photo's map.
    maps: Vec<[u32; 2]>,
    report: SemanticsReport,
}

/// Writes the semantics of scene `id` and gives the file's sha256, hex.
///
/// # Errors
/// Those of the writer.
pub fn write_semantics(
    to: &mut dyn Write,
    id: &SceneId,
    semantics: &Semantics,
) -> io::Result<String> {
    let bank = &semantics.bank;
    let header = serde_json::to_string(&Header {
        scene: id.clone(),
        dim: bank.dim,
        maps: semantics.photos.iter().map(|map| [map.width, map.height]).collect(),
        report: semantics.report.clone(),
    })?;
    let cells: Vec<u16> = semantics.photos.iter().flat_map(|map| map.index.clone()).collect();
    let masks: Vec<[u32; 3]> =
        semantics.masks.iter().map(|m| [m.photo, m.mask, u32::from(m.entry)]).collect();
    let (views, seen) = (&semantics.views, semantics.views.entries.len());
    let mut arrays = vec![
        ContainerArray::new("bank", Dtype::F32, &[bank.len(), bank.dim], &bank.rows),
        ContainerArray::new("index", Dtype::U16, &[semantics.index.len()], &semantics.index),
        ContainerArray::new("photos", Dtype::U16, &[cells.len()], &cells),
        ContainerArray::new("masks", Dtype::U32, &[masks.len(), 3], &masks),
    ];
    if seen > 0 {
        arrays.extend([
            ContainerArray::new("view_entries", Dtype::U16, &[seen], &views.entries),
            ContainerArray::new("views", Dtype::F32, &[seen, bank.dim], &views.rows),
        ]);
    }
    write(to, &LABEL, &header, &arrays)
}

/// Reads the semantics of scene `id` and gives them with their file's sha256, hex.
///
/// # Errors
/// `scene_corrupt` when any byte differs from what was written, or they are another scene's;
/// `other_version`.
pub fn read_semantics(file: &[u8], id: &SceneId) -> Result<(Semantics, String)> {
    let corrupt =
        |why: String| Error::new(ErrorCode::SceneCorrupt, format!("the semantics file: {why}"));
    let container = Container::read(file, &LABEL, "the semantics file")?;
    let header: Header = container.header()?;
    if header.scene != *id {
        return Err(corrupt(format!("it is of scene {}, not of {id}", header.scene)));
    }
    let bank = Bank { dim: header.dim, rows: container.rows("bank", Dtype::F32)? };
    if bank.rows.len() != bank.len() * bank.dim || bank.rows.iter().any(|v| !v.is_finite()) {
        return Err(corrupt("the bank has no whole number of finite rows".to_owned()));
    }
    // Semantics without tracks have none, nor have those of earlier programs.
    let views = match container.has("views") {
        true => RowViews {
            entries: container.rows("view_entries", Dtype::U16)?,
            rows: container.rows("views", Dtype::F32)?,
        },
        false => RowViews::default(),
    };
    let known = |m: &u16| (1..=bank.len()).contains(&usize::from(*m));
    if views.rows.len() != views.entries.len() * bank.dim
        || views.rows.iter().any(|v| !v.is_finite())
        || !views.entries.iter().all(known)
        || !views.entries.is_sorted()
    {
        return Err(corrupt("the views are not finite rows of the bank, in its order".to_owned()));
    }
    let mut cells = &container.rows::<u16>("photos", Dtype::U16)?[..];
    let mut photos = Vec::new();
    for [width, height] in header.maps {
        let size = width as usize * height as usize;
        let (own, rest) = cells
            .split_at_checked(size)
            .ok_or_else(|| corrupt(format!("a map of {width}x{height} cells is cut short")))?;
        photos.push(IndexMap { width, height, index: own.to_vec() });
        cells = rest;
    }
    let index = container.rows("index", Dtype::U16)?;
    let mask = |[photo, mask, entry]: [u32; 3]| {
        let entry = u16::try_from(entry).ok().filter(|m| usize::from(*m) <= bank.len());
        let entry = entry.ok_or_else(|| corrupt(format!("mask {mask} has no row of the bank")))?;
        Ok(BankMask { photo, mask, entry })
    };
    // Earlier programs kept no masks.
    let masks = match container.has("masks") {
        true => {
            container.rows("masks", Dtype::U32)?.into_iter().map(mask).collect::<Result<_>>()?
        }
        false => Vec::new(),
    };
    Ok((Semantics { bank, views, index, photos, masks, report: header.report }, container.sha256))
}
