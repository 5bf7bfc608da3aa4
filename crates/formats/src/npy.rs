//! `NumPy`'s `.npy`: one array. Enough of it to read LLFF cameras and the laboratory's labelled
//! photographs, and to write arrays.

use bytemuck::Pod;

/// An array in C order.
#[derive(Debug)]
pub struct Array {
    kind: String,
    /// Its sides, the slowest first.
    pub shape: Vec<usize>,
    data: Vec<u8>,
}

impl Array {
    /// Reads a file; `None` where it is no such file or of Fortran order.
    #[must_use]
    pub fn parse(mut bytes: Vec<u8>) -> Option<Self> {
        if bytes.get(..6)? != b"\x93NUMPY" {
            return None;
        }
        let (length, from) = match bytes.get(6)? {
            1 => (u32::from(u16::from_le_bytes(bytes.get(8..10)?.try_into().ok()?)), 10),
            _ => (u32::from_le_bytes(bytes.get(8..12)?.try_into().ok()?), 12),
        };
        let start = usize::try_from(length).ok()?.checked_add(from)?;
        let header = std::str::from_utf8(bytes.get(from..start)?).ok()?;
        if !header.contains("'fortran_order': False") {
            return None;
        }
        let kind = header.split("'descr': '").nth(1)?.split('\'').next()?.to_owned();
        let sides = header.split("'shape': (").nth(1)?.split(')').next()?.split(',');
        let sides = sides.map(str::trim).filter(|side| !side.is_empty());
        let shape = sides.map(|side| side.parse().ok()).collect::<Option<_>>()?;
        Some(Self { kind, shape, data: bytes.split_off(start) })
    }

    /// The bytes of an array of bytes.
    #[must_use]
    pub fn bytes(self) -> Option<Vec<u8>> {
        (self.kind == "|u1").then_some(self.data)
    }

    /// Whole numbers that are not negative.
    #[must_use]
    pub fn counts(&self) -> Option<Vec<usize>> {
        match self.kind.as_str() {
            "<i4" => self.each(|c| i32::from_le_bytes(c).try_into().ok()),
            "<i8" => self.each(|c| i64::from_le_bytes(c).try_into().ok()),
            _ => None,
        }
    }

    /// Numbers of f64.
    #[must_use]
    pub fn numbers(&self) -> Option<Vec<f64>> {
        let wanted = self.kind == "<f8";
        self.each(|c| wanted.then_some(f64::from_le_bytes(c)))
    }

    /// Texts of fixed length in UTF-32, filled up with zeros.
    #[must_use]
    pub fn texts(&self) -> Option<Vec<String>> {
        let width = self.kind.strip_prefix("<U")?.parse::<usize>().ok().filter(|w| *w > 0)?;
        let letters = self.each(|c| char::from_u32(u32::from_le_bytes(c)))?;
        let text = |row: &[char]| row.iter().collect::<String>().trim_end_matches('\0').to_owned();
        Some(letters.chunks_exact(width).map(text).collect())
    }

    fn each<const N: usize, T>(&self, of: impl Fn([u8; N]) -> Option<T>) -> Option<Vec<T>> {
        self.data.chunks_exact(N).map(|c| of(c.try_into().ok()?)).collect()
    }
}

/// A number of an array, little-endian.
pub trait Number: Pod {
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
pub fn header<T: Number>(shape: &[usize]) -> Vec<u8> {
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
