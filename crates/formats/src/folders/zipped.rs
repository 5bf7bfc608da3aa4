//! A zip whose files are written one after another, part by part.

use std::io::{self, Write};

use serde::Serialize;
use serde_json::Value;
use zip::{
    CompressionMethod, ZipWriter,
    write::{SimpleFileOptions, StreamWriter},
};

use crate::error::{Error, ErrorCode, Result};

/// A folder in a zip. What is written goes to the file that was begun last.
pub(crate) struct ZipFolder<'w>(ZipWriter<StreamWriter<&'w mut dyn Write>>);

impl<'w> ZipFolder<'w> {
    pub(crate) fn new(to: &'w mut dyn Write) -> Self {
        Self(ZipWriter::new_stream(to))
    }

    /// Begins a file that is stored as it is: numbers and pictures hardly get smaller.
    pub(crate) fn begin(&mut self, path: &str) -> Result<()> {
        self.begin_as(path, CompressionMethod::Stored)
    }

    /// Begins a file of text.
    pub(crate) fn begin_text(&mut self, path: &str) -> Result<()> {
        self.begin_as(path, CompressionMethod::Deflated)
    }

    fn begin_as(&mut self, path: &str, method: CompressionMethod) -> Result<()> {
        let how = SimpleFileOptions::default().compression_method(method);
        self.0.start_file(path, how).map_err(|e| unwritten(e.into()))
    }

    /// Writes more of a file.
    pub(crate) fn put(&mut self, bytes: &[u8]) -> Result<()> {
        self.0.write_all(bytes).map_err(unwritten)
    }

    /// Writes more of a file, as JSON.
    pub(crate) fn put_json(&mut self, value: &impl Serialize) -> Result<()> {
        serde_json::to_writer(&mut self.0, value).map_err(|e| unwritten(e.into()))
    }

    /// A whole file.
    pub(crate) fn file(&mut self, path: &str, bytes: &[u8]) -> Result<()> {
        self.begin(path)?;
        self.put(bytes)
    }

    /// Writes a JSON object with the fields of `head`, whose last one is a list that is written
    /// value by value.
    pub(crate) fn begin_list(&mut self, head: &Value, name: &str) -> Result<JsonList<'_, 'w>> {
        let head = head.to_string();
        self.put(head.strip_suffix('}').unwrap_or(&head).as_bytes())?;
        self.put(format!(",\"{name}\":[").as_bytes())?;
        Ok(JsonList { zip: self, is_empty: true })
    }

    pub(crate) fn finish(self) -> Result<()> {
        let end = || -> io::Result<()> { self.0.finish()?.into_inner().flush() };
        end().map_err(unwritten)
    }
}

/// A list at the end of an object.
pub(crate) struct JsonList<'z, 'w> {
    zip: &'z mut ZipFolder<'w>,
    is_empty: bool,
}

impl JsonList<'_, '_> {
    pub(crate) fn push(&mut self, value: &impl Serialize) -> Result<()> {
        if !std::mem::take(&mut self.is_empty) {
            self.zip.put(b",")?;
        }
        self.zip.put_json(value)
    }

    pub(crate) fn end(self) -> Result<()> {
        self.zip.put(b"]}")
    }
}

fn unwritten(cause: io::Error) -> Error {
    let code = match cause.kind() {
        io::ErrorKind::TimedOut => ErrorCode::DeadlineExceeded,
        _ => ErrorCode::StoreUnavailable,
    };
    Error::new(code, "the folder cannot be written").caused_by(cause)
}
