//! Just enough of `NumPy`'s `.npy` to read LLFF cameras and the laboratory's labelled photographs.

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
