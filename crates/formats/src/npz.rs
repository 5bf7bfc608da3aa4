//! `NumPy`'s `.npz`: several arrays in a zip without compression, written part by part.

use std::io::{self, Write};

use zip::{
    CompressionMethod, ZipWriter,
    write::{SimpleFileOptions, StreamWriter},
};

use crate::npy::{Number, header};

/// Writes arrays one after another.
#[derive(Debug)]
pub struct NpzWriter<W: Write>(ZipWriter<StreamWriter<W>>);

impl<W: Write> NpzWriter<W> {
    /// Nothing written yet.
    pub fn new(to: W) -> Self {
        Self(ZipWriter::new_stream(to))
    }

    /// Begins the array `name`; its numbers follow by [`Self::extend`].
    ///
    /// # Errors
    /// Those of the writer.
    pub fn begin<T: Number>(&mut self, name: &str, shape: &[usize]) -> io::Result<()> {
        let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
        self.0.start_file(format!("{name}.npy"), stored.large_file(true))?;
        self.0.write_all(&header::<T>(shape))
    }

    /// More numbers of the array.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn extend<T: Number>(&mut self, values: &[T]) -> io::Result<()> {
        self.0.write_all(bytemuck::cast_slice(values))
    }

    /// A whole array.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn array<T: Number>(
        &mut self,
        name: &str,
        shape: &[usize],
        values: &[T],
    ) -> io::Result<()> {
        self.begin::<T>(name, shape)?;
        self.extend(values)
    }

    /// Writes the end.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn finish(self) -> io::Result<()> {
        self.0.finish()?.into_inner().flush()
    }
}
