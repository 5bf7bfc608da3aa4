//! `NumPy` files: one array (`npy`), or several in a zip without compression (`npz`), written part
//! by part.

use std::io::{self, Write};

use bytemuck::Pod;
use zip::{
    CompressionMethod, ZipWriter,
    write::{SimpleFileOptions, StreamWriter},
};

/// A number of an array, little-endian.
pub(super) trait Number: Pod {
    /// `NumPy`'s name of it.
    const DESCR: &str;
}

impl Number for f32 {
    const DESCR: &str = "<f4";
}

impl Number for u16 {
    const DESCR: &str = "<u2";
}

impl Number for u32 {
    const DESCR: &str = "<u4";
}

/// The header of an array in C order, format version 1.0.
pub(super) fn header<T: Number>(shape: &[usize]) -> Vec<u8> {
    // A tuple of one has a comma, too.
    let comma = if shape.len() == 1 { "," } else { "" };
    let sides = shape.iter().map(usize::to_string).collect::<Vec<_>>().join(", ") + comma;
    let descr = T::DESCR;
    let mut words = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({sides}), }}");
    // Magic, version and length take 10 bytes; the data starts at a multiple of 64.
    let padded = (10 + words.len() + 1).next_multiple_of(64) - 10;
    words.push_str(&" ".repeat(padded - words.len() - 1));
    words.push('\n');
    let length = words.len() as u16;
    [b"\x93NUMPY\x01\x00", &length.to_le_bytes()[..], words.as_bytes()].concat()
}

/// Writes arrays one after another.
pub(super) struct NpzWriter<W: Write>(ZipWriter<StreamWriter<W>>);

impl<W: Write> NpzWriter<W> {
    pub(super) fn new(to: W) -> Self {
        Self(ZipWriter::new_stream(to))
    }

    /// Begins the array `name`; its numbers follow by [`Self::extend`].
    pub(super) fn begin<T: Number>(&mut self, name: &str, shape: &[usize]) -> io::Result<()> {
        let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
        self.0.start_file(format!("{name}.npy"), stored.large_file(true))?;
        self.0.write_all(&header::<T>(shape))
    }

    pub(super) fn extend<T: Number>(&mut self, values: &[T]) -> io::Result<()> {
        self.0.write_all(bytemuck::cast_slice(values))
    }

    /// A whole array.
    pub(super) fn array<T: Number>(
        &mut self,
        name: &str,
        shape: &[usize],
        values: &[T],
    ) -> io::Result<()> {
        self.begin::<T>(name, shape)?;
        self.extend(values)
    }

    pub(super) fn finish(self) -> io::Result<()> {
        self.0.finish()?.into_inner().flush()
    }
}
