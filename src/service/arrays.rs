//! The semantics of a scene as arrays: the bank, its masks and the index maps.

use std::io::{self, Write};

use crate::{
    error::{Error, ErrorCode, Result},
    formats::npz::NpzWriter,
    scene::Semantics,
};

/// Writes the bank, its masks and all indices of a scene.
pub(super) fn write_semantics(semantics: &Semantics, to: &mut dyn Write) -> Result<()> {
    let bank = &semantics.bank;
    let masks: Vec<[u32; 3]> =
        semantics.masks.iter().map(|m| [m.photo, m.mask, u32::from(m.entry)]).collect();
    let write = || -> io::Result<()> {
        let mut npz = NpzWriter::new(to);
        npz.array("bank", &[bank.len(), bank.dim], &bank.rows)?;
        npz.array("sizes", &[bank.len()], &semantics.row_sizes())?;
        npz.array("masks", &[masks.len(), 3], masks.as_flattened())?;
        npz.array("index", &[semantics.index.len()], &semantics.index)?;
        for (i, map) in semantics.photos.iter().enumerate() {
            let shape = [map.height as usize, map.width as usize];
            npz.array(&format!("photo_{i:03}"), &shape, &map.index)?;
        }
        npz.finish()
    };
    write().map_err(unwritten)
}

/// The error of arrays that cannot be written.
pub(super) fn unwritten(cause: io::Error) -> Error {
    Error::new(ErrorCode::StoreUnavailable, "the arrays cannot be written").caused_by(cause)
}
